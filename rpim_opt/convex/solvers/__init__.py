"""Solvers of one convex program, chosen by its structure."""
