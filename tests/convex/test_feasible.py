"""How far a point is from constraints, whose gradients are asked once where they are the same everywhere."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.convex import feasible


def test_a_constant_gradient_is_asked_once(monkeypatch) -> None:
    z = cp.Variable(3)
    gain = cp.Parameter(value=1.0)
    constant: dict[int, np.ndarray] = {}
    affine = 3 * z[:2] + z[1:] <= 1
    scaled = gain * z[0] == 1
    curved = cp.norm(z) <= 1
    whole = [affine, scaled, curved]

    def missed(value: list[float]) -> list[float]:
        z.value = np.array(value)
        return [feasible._missed(each, z, constant) for each in whole]

    # 3 x + y <= 1 is missed by 8 at (3, 0, 0), in steps of sqrt(10); a norm of 3 by 2
    assert missed([3, 0, 0]) == pytest.approx([8 / np.sqrt(10), 2, 2])
    assert list(constant) == [affine.id]
    gain.value = 2.0
    assert missed([3, 0, 0]) == pytest.approx([8 / np.sqrt(10), 2.5, 2])
    monkeypatch.setattr(feasible, "_speeds", lambda *_: pytest.fail("asked again"))
    whole = [affine]
    assert missed([0, 2, 0]) == pytest.approx([5 / np.sqrt(10)])


def test_a_cone_changes_as_fast_as_the_fastest_of_its_sides() -> None:
    """What CVXPY says is missed of |3 (x, y)| <= z, over 3; a side that is constant does not change."""
    z = cp.Variable(3)
    z.value = np.array([6.0, 0.0, 0.0])
    for cone, speed in ((cp.SOC(z[2], 3 * z[:2]), 3.0), (cp.SOC(cp.Constant(1.0), 0.5 * z[:2]), 0.5)):
        assert feasible._missed(cone, z, {}) == pytest.approx(cone.violation() / speed, rel=1e-9)


def test_the_nearest_point_of_a_box_is_the_point_itself_inside_and_on_a_side_outside() -> None:
    problem = ro.load("paper_arm").problem
    tight = problem.with_parameters(problem.parameters.toleranced({"length_mm": 0.5, "angle_mrad": 0.5}))
    free = tight.parameters.free
    program = ro.convex.pose(ro.bounded, tight.linearize(np.zeros(len(free))))
    side = free.tolerance / free.scale
    assert np.array_equal(program.nearest(0.5 * side), 0.5 * side)
    assert program.nearest(3 * side) == pytest.approx(side)
    beyond = np.where(np.arange(len(free)) == 2, -3.0, 0.2) * side
    assert program.nearest(beyond) == pytest.approx(np.where(np.arange(len(free)) == 2, -1.0, 0.2) * side)
