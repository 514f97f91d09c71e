"""Tables of measurements: how they are written, what their columns mean, and how they become a dataset."""
