"""Fuzzing: parsers and whole command lines with inputs that nobody would write.

``test_fuzz.py`` is the bounded version of the suite; ``python -m tests.fuzz`` goes on as long as it is let.
"""
