"""Properties of the package, by the folders whose code they hold; where they are."""

from pathlib import Path

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"
"""Data of real robots, where a checkout has them beside it."""
