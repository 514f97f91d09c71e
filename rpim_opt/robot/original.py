"""A robot's file as it was handed over: its bytes, of which only the numbers that change are replaced."""

from __future__ import annotations

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.robot.kinematics import frame_numbers


def spliced(data: bytes, edits: dict[tuple[int, int], str]) -> bytes:
    """Return ``data`` with the bytes from start to end replaced by texts, everything else as it was."""
    for (start, end), text in sorted(edits.items(), reverse=True):
        data = data[:start] + text.encode() + data[end:]
    return data


ROUNDING = 1e-14
"""Of numbers of an arm of a metre, and of an angle's cosine."""


def reach(table: Array, *frames: Array) -> float:
    """Return the length of an arm stretched out [m], at least one, with the frames (4, 4) at its ends.

    Places on it are rounded in proportion.
    """
    ends = sum(float(np.linalg.norm(T[:3, 3])) for T in frames)
    return max(float(np.abs(table[:, 1::2]).sum()) + ends, 1.0)


def origin_numbers(T: Array, old: Array, size: float) -> tuple[str | None, str | None]:
    """Return an origin's new xyz and rpy as texts that read back exactly; None for what is as it was.

    ``size`` is the arm's `reach` [m].
    """
    six = frame_numbers(T) + 0.0  # no negative zeros
    texts = [" ".join(repr(float(v)) for v in part) for part in (six[:3], six[3:])]
    moved = np.abs(T[:3, 3] - old[:3, 3]).max() > ROUNDING * size
    turned = np.abs(T[:3, :3] - old[:3, :3]).max() > ROUNDING
    return texts[0] if moved else None, texts[1] if turned else None
