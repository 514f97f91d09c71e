"""Measurement types: self-contained modules, found by `registry`."""
