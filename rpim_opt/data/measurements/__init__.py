"""Measurement types: one self-contained module per type, found by `registry`."""
