"""How far a point is from constraints: in units of z, to first order the distance; and the nearest that meets them."""

from __future__ import annotations

from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.convex import feasible
from tests.convex.test_formulation import model

N = 12
Z = np.linspace(-2.0, 3.0, N)


def posed(*constraints: Any) -> Any:
    formulation = ro.Formulation("mine", penalty=cp.sum_squares, constraints=constraints)
    return ro.convex.pose(formulation, model())._posed


def box(lower: Any, upper: Any) -> ro.constraints.Box:
    return ro.constraints.Box("box", lambda p: (np.broadcast_to(lower, len(p)), np.broadcast_to(upper, len(p))))


def test_room_is_relative_to_the_largest_entry_from_one_scale_on() -> None:
    assert feasible.room(np.array([0.5, -0.9])) == pytest.approx(1e-7)
    assert feasible.room(np.array([0.5, -20.0])) == pytest.approx(20e-7)
    assert feasible.room(np.zeros(0)) == pytest.approx(1e-7)


def test_a_box_is_missed_by_the_farthest_component() -> None:
    assert feasible.violation(posed(box(-1.0, 1.0)), Z) == pytest.approx(2.0, rel=1e-14)
    assert feasible.violation(posed(box(-1.5, 2.9)), Z) == pytest.approx(0.5, rel=1e-14)
    assert feasible.violation(posed(box(-2.0, 3.0)), Z) == 0.0


def test_no_constraint_is_not_missed() -> None:
    assert feasible.violation(posed(), Z) == 0.0


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
def test_a_distance_does_not_depend_on_the_constraints_units(unit: float) -> None:
    half_space = posed(lambda z, p: unit * (3 * z[0] + 4 * z[1]) <= unit * 1.0)
    z = np.zeros(N)
    z[:2] = (3.0, 4.0)
    assert feasible.violation(half_space, z) == pytest.approx(24 / 5, rel=1e-9)
    assert feasible.violation(half_space, -z) == 0.0
    equality = posed(lambda z, p: unit * (3 * z[0] + 4 * z[1]) == unit * 1.0)
    assert feasible.violation(equality, z) == pytest.approx(24 / 5, rel=1e-9)
    assert feasible.violation(equality, -z) == pytest.approx(26 / 5, rel=1e-9)
    ball = posed(lambda z, p: unit * cp.norm(z) <= unit * 2.0)
    assert feasible.violation(ball, z) == pytest.approx(3.0, rel=1e-9)
    cone = posed(lambda z, p: cp.SOC(cp.Constant(unit * 2.0), unit * z))
    assert feasible.violation(cone, z) == pytest.approx(3.0, rel=0.5)  # a cone's own distance, to first order
    assert feasible.violation(cone, 0.3 * z) == 0.0


def test_the_worst_of_several_counts() -> None:
    several = posed(lambda z, p: [z[0] <= 1.0, z[1:3] <= np.array([1.0, 2.0])], lambda z, p: 10 * z[3] <= 10.0)
    z = np.zeros(N)
    z[:4] = (1.5, 1.25, 2.75, 0.0)
    assert feasible.violation(several, z) == pytest.approx(0.75, rel=1e-9)
    z[3] = 3.0
    assert feasible.violation(several, z) == pytest.approx(2.0, rel=1e-9)


def test_every_row_of_a_constraint_has_its_own_unit() -> None:
    rows = posed(lambda z, p: cp.multiply(np.array([1.0, 1e3]), z[:2]) <= np.array([1.0, 1e3]))
    z = np.zeros(N)
    z[:2] = (3.0, 1.5)
    assert feasible.violation(rows, z) == pytest.approx(2.0, rel=1e-9)
    z[:2] = (1.5, 3.0)
    assert feasible.violation(rows, z) == pytest.approx(2.0, rel=1e-9)


def test_outside_a_constraints_domain_is_infinitely_far() -> None:
    assert feasible.violation(posed(lambda z, p: cp.log(z[0]) >= 0.0), -np.ones(N)) == np.inf


def test_a_constraint_without_slope_is_missed_by_what_it_says() -> None:
    """At zero a norm has no slope: what is missed stands alone."""
    apart = posed(lambda z, p: cp.norm(z) <= z[0] - 2.0)
    assert 0 < feasible.violation(apart, np.zeros(N)) <= 2.0 + 1e-9


def test_a_matrix_inequality_is_missed_by_its_eigenvalue() -> None:
    positive = posed(lambda z, p: cp.diag(z[:3]) >> 0)
    assert feasible.violation(positive, Z) == pytest.approx(2.0, rel=0.5)
    assert feasible.violation(positive, np.abs(Z)) == 0.0


def test_with_variables_of_its_own_a_constraint_is_missed_by_the_distance() -> None:
    def own(z: Any, p: Any) -> list[Any]:
        t = cp.Variable(N)
        return [cp.abs(z) <= t, cp.sum(t) <= 1.0]  # a ball of the first norm

    z = np.zeros(N)
    z[0] = 4.0
    assert feasible.violation(posed(own), z) == pytest.approx(3.0, rel=1e-6)
    assert feasible.violation(posed(own), z / 8) == pytest.approx(0.0, abs=1e-7)


def test_the_nearest_point_is_the_projection() -> None:
    ball = feasible.nearest(posed(lambda z, p: cp.norm(z) <= 2.0), Z)
    assert ball == pytest.approx(2.0 * Z / np.linalg.norm(Z), abs=1e-7)
    normal = np.arange(1.0, N + 1)
    plane = feasible.nearest(posed(lambda z, p: normal @ z == 5.0), Z)
    assert plane == pytest.approx(Z + normal * (5.0 - normal @ Z) / (normal @ normal), abs=1e-7)


def test_without_a_point_that_meets_them_the_nearest_is_the_point_itself() -> None:
    nothing = posed(lambda z, p: [cp.sum(z) >= 1.0, cp.sum(z) <= 0.0])
    assert feasible.nearest(nothing, Z) is Z


def test_a_program_says_the_nearest_of_any_constraints() -> None:
    def nearest(*constraints: Any) -> np.ndarray:
        formulation = ro.Formulation("mine", penalty=cp.sum_squares, constraints=constraints)
        return ro.convex.pose(formulation, model()).nearest(Z)

    assert nearest() is Z
    assert (nearest(box(-1.0, 1.0)) == np.clip(Z, -1, 1)).all()
    assert nearest(lambda z, p: cp.norm(z) <= 20.0) is Z
    assert nearest(lambda z, p: cp.norm(z) <= 2.0) == pytest.approx(2.0 * Z / np.linalg.norm(Z), abs=1e-7)
