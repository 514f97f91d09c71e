"""What Universal Robots' two files have in common: six revolute joints, and numbers as text."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import LARGEST

JOINTS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")


REVOLUTE = ("revolute",) * 6


def finite(text: str, where: str, path: Path) -> float:
    """Return a finite number, or say what stands in its place."""
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not abs(value) <= LARGEST or "_" in text:
        raise InputError(where, f"'{text[:40]}'", f"a finite number, at most {LARGEST:g}", path)
    return value
