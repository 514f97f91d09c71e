"""Quadratic models of a loss: its value and slope at the point, and above it in the first iteration."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.convex.expressions import SQUARES
from rpim_opt.convex.robust_loss import QuadraticModel, separable
from rpim_opt.convex.structure import in_blocks
from tests.convex.test_formulation import model

MODEL = model(condition=30.0).scaled(np.geomspace(0.3, 30.0, 30))
Z = np.random.default_rng(5).normal(size=12)
LOSSES: dict[str, tuple[Any, str]] = {
    "huber": (ro.huber(1.0), "configuration"),
    "huber by equation": (ro.huber(1.0), "equation"),
    "norms": (cp.sum, "configuration"),
    "absolute": (cp.norm1, "equation"),
    "quartic": (lambda v: cp.sum(cp.power(v, 4)), "configuration"),
}


def stated(name: str) -> ro.Formulation:
    loss, over = LOSSES[name]
    return ro.Formulation(name, loss=loss, penalty=cp.sum_squares, loss_over=over)


def of_squares(squares: QuadraticModel, at: np.ndarray) -> Any:
    made, offset = squares(MODEL, at)
    return lambda z: float(np.sum((made.A @ z - made.b) ** 2)) + offset


def slopes(function: Any, z: np.ndarray) -> np.ndarray:
    h = 1e-6
    return np.array([(function(z + h * e) - function(z - h * e)) / (2 * h) for e in np.eye(len(z))])


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("before", [None, Z + 0.01, Z + 1.0])
def test_squares_have_value_and_slope_of_the_loss(name: str, before: np.ndarray | None) -> None:
    loss, over = LOSSES[name]
    program = ro.convex.pose(stated(name), MODEL)
    squares = QuadraticModel(loss, name, over, before)
    value = of_squares(squares, Z)
    want = program.value(Z)[0]
    assert value(Z) == pytest.approx(want, rel=1e-10)
    slope = slopes(lambda z: program.value(z)[0], Z)
    assert slopes(value, Z) == pytest.approx(slope, rel=1e-4, abs=1e-5 * np.abs(slope).max())


@pytest.mark.parametrize("name", ["huber", "huber by equation", "norms", "absolute"])
def test_the_first_squares_lie_nowhere_below_the_loss(name: str) -> None:
    loss, over = LOSSES[name]
    program = ro.convex.pose(stated(name), MODEL)
    value = of_squares(QuadraticModel(loss, name, over), Z)
    for z in np.random.default_rng(6).normal(size=(50, 12)) * np.geomspace(0.01, 10, 50)[:, None]:
        assert value(Z + z) >= program.value(Z + z)[0] * (1 - 1e-9)


@pytest.mark.parametrize("size", [1e-2, 1e2])
def test_steps_are_short_beside_residuals_of_any_size(size: float) -> None:
    """Of sum v^4 as below, all residuals times a number."""
    model = MODEL.scaled(np.full(len(MODEL.b), size))
    made, _ = QuadraticModel(lambda v: cp.sum(cp.power(v, 4)), "quartic", "equation").after(Z + 1e-6)(model, Z)
    r = model.A @ Z - model.b
    expected = (model.A.T * 6 * r**2) @ model.A
    assert pytest.approx(expected, rel=2e-3, abs=1e-6 * np.abs(expected).max()) == made.A.T @ made.A


def test_with_short_steps_squares_have_the_curvature_of_the_loss() -> None:
    """Of sum v^4 over residuals: 12 v^2 along each, so that half the Hessian is A' diag(6 v^2) A."""
    quartic = QuadraticModel(lambda v: cp.sum(cp.power(v, 4)), "quartic", "equation").after(Z + 1e-6)
    made, _ = quartic(MODEL, Z)
    r = MODEL.A @ Z - MODEL.b
    assert pytest.approx((MODEL.A.T * 6 * r**2) @ MODEL.A, rel=2e-3) == made.A.T @ made.A
    whole = QuadraticModel(lambda v: cp.sum(cp.power(v, 4)), "quartic", "configuration").after(Z + 1e-6)
    made, _ = whole(MODEL, Z)
    hessian = np.zeros((12, 12))
    for g in np.unique(MODEL.group):  # of |r|^4: 4 |r|^2 + 8 r r', half of it
        A, part = MODEL.A[g == MODEL.group], r[g == MODEL.group]
        hessian += A.T @ (2 * (part @ part) * np.eye(3) + 4 * np.outer(part, part)) @ A
    assert pytest.approx(hessian, rel=2e-3, abs=1e-6 * np.abs(hessian).max()) == made.A.T @ made.A


def test_where_a_loss_is_straight_along_residuals_squares_are_almost_flat() -> None:
    """Beyond Huber's threshold, with a short step: a thousandth of the curvature across, which is slope / (2 v)."""
    far = MODEL.with_values(MODEL.b + 1e3)
    r = far.A @ Z - far.b
    made, _ = QuadraticModel(ro.huber(1.0), "huber", "equation").after(Z + 1e-6)(far, Z)
    across = 1.0 / np.abs(r)
    assert np.abs(np.sum(made.A**2, axis=1) / np.sum(far.A**2, axis=1)) == pytest.approx(1e-3 * across, rel=1e-6)


def test_a_loss_with_a_kink_expects_residuals_that_moved_far_to_end_there() -> None:
    """Of |v|: after a step by more than 0.3 v the secant goes to the other side (c = w), after a shorter one not."""
    r = MODEL.A @ Z - MODEL.b
    direction = np.linalg.lstsq(MODEL.A, r)[0]
    moved = MODEL.A @ direction
    made, _ = QuadraticModel(cp.norm1, "absolute", "equation").after(Z - direction)(MODEL, Z)
    curvature = np.sum(made.A**2, axis=1) / np.sum(MODEL.A**2, axis=1)
    across = 0.5 / np.abs(r)
    far = np.abs(moved) > 0.3 * np.abs(r)
    assert far.any()
    assert (~far).any()
    assert curvature[far] == pytest.approx(across[far], rel=1e-9)
    assert curvature[~far] == pytest.approx(1e-3 * across[~far], rel=1e-9)


def test_what_is_a_sum_over_residuals() -> None:
    assert separable(ro.huber())
    assert separable(cp.sum)
    assert separable(cp.norm1, "equation")
    assert separable(lambda v: cp.sum(v), "configuration")
    assert not separable(cp.sum, "equation")  # another sign, another loss
    assert not separable(cp.max)
    assert not separable(cp.norm2)
    assert not separable(lambda v: cp.sum(v) + 1e-6 * cp.max(v))
    assert not separable(lambda v: cp.sum(cp.multiply(np.ones(30), v)))


def test_what_triangles_cannot_hold_is_refused() -> None:
    with pytest.raises(ro.InputError, match="found a loss that is not a sum, with data in blocks"):
        in_blocks(ro.minimax)
    squares = QuadraticModel(cp.norm1, "bent", "equation")
    flat: Any = SimpleNamespace(slope=lambda v: None)
    with pytest.raises(ro.InputError, match="formulation 'bent': found a loss without gradient"):
        squares.slope(flat, np.ones(3))


def test_a_loss_over_triangles_is_a_sum_of_squares_and_its_maker() -> None:
    solved, squares = in_blocks(ro.robust)
    assert (solved.loss, solved.loss_over, solved.penalty) == (SQUARES, "equation", ro.robust.penalty)
    assert squares is not None
    assert (squares.loss, squares.over, squares.before) == (ro.robust.loss, "configuration", None)
    assert squares.after(Z).before is Z


def test_a_length_of_norms_is_that_of_the_residual() -> None:
    solved, squares = in_blocks(ro.Formulation("norms", loss=cp.sum_squares, loss_over="configuration"))
    assert (solved.loss_over, squares) == ("equation", None)
