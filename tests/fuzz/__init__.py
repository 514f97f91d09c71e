"""Readers with inputs that nobody would write, by hypothesis; ``FUZZ=100000 pytest tests/fuzz`` goes on for longer."""
