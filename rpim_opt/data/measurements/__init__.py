"""Types of measurements: one module a type, with everything about it, found by `registry`."""
