"""Tables of measurements: file formats, meanings of columns, and conversion to a dataset."""
