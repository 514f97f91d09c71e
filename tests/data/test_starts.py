"""Starts in closed form: without noise they are the truth."""

from __future__ import annotations

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.data.measurements.distance import anchor_start, plane_start, sphere_start

POINTS = np.random.default_rng(3).normal([1.0, -2.0, 0.5], 0.3, size=(12, 3))
"""Of a tool, in a cell that is not about the origin [m]."""


@pytest.mark.parametrize("zero", [-0.4, 0.0, 0.25])
def test_an_anchor_and_the_zero_of_its_lengths(zero: float) -> None:
    anchor = np.array([-1.0, 3.0, 2.0])
    lengths = np.linalg.norm(POINTS - anchor, axis=1) + zero
    found = anchor_start(POINTS, lengths[:, None])
    assert list(found) == ["anchor_x", "anchor_y", "anchor_z", "length_0"]
    assert list(found.values()) == pytest.approx([*anchor, zero], abs=1e-10)


@pytest.mark.parametrize("start", [anchor_start, plane_start, sphere_start])
def test_points_on_a_line_determine_none(start: object) -> None:
    on = np.outer(np.linspace(0, 1, 8), [1.0, 2.0, 3.0])
    with pytest.raises(ro.InputError, match="8 points that do not determine"):
        start(on, np.ones((8, 1)))  # type: ignore[operator]
