"""Whatever CVXPY can state is solved, and what it cannot is refused in a sentence: atoms that were errors once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from tests.convex.plain import objective_at, plain, violation

SQUARES = cp.sum_squares
N = 34
"""Parameters of the problem `position`."""


def grid(v: Any, rows: int, columns: int) -> Any:
    return cp.reshape(v[: rows * columns], (rows, columns), order="C")


def diagonal_part() -> dict[str, Any]:
    D = cp.Variable((3, 3), diag=True)
    return {"penalty": lambda z: SQUARES(z) + SQUARES(z[:3] - cp.diag(D)) + cp.norm1(cp.diag(D))}


def semidefinite_bound() -> dict[str, Any]:
    D = cp.Variable((3, 3), diag=True)
    return {"constraints": lambda z, p: [cp.diag(z[:3]) << D, cp.trace(D) <= 1]}


def perspective() -> dict[str, Any]:
    x, s = cp.Variable(), cp.Variable(nonneg=True)
    tied = lambda z, p: [x == z[0], s <= 2, s >= 0.1]  # noqa: E731
    return {"penalty": lambda z: cp.perspective(cp.square(x), s) + SQUARES(z), "constraints": tied}


def level() -> dict[str, Any]:
    c = cp.Variable()
    return {"loss": lambda r: SQUARES(r - c)}


def by_configuration(loss: Any) -> dict[str, Any]:
    return {"loss": loss, "loss_over": "configuration"}


SOLVED: dict[str, Callable[[], dict[str, Any]]] = {
    "norm_inf that binds": lambda: {"constraints": lambda z, p: cp.norm_inf(z) <= 0.6},
    "mixed norm": lambda: {"penalty": lambda z: cp.mixed_norm(grid(z, 2, 3), 2, "inf") + SQUARES(z)},
    "mixed norm of residuals": lambda: {"loss": lambda r: cp.mixed_norm(grid(r, 40, 3), 2, "inf") + SQUARES(r)},
    "cummax": lambda: {"penalty": lambda z: cp.sum(cp.cummax(cp.abs(z)))},
    "cvar of equations": lambda: {"loss": lambda r: cp.cvar(cp.abs(r), 0.9)},
    "cvar of configurations": lambda: by_configuration(lambda v: cp.cvar(v, 0.9)),
    "cvar of parameters": lambda: {"penalty": lambda z: cp.cvar(cp.abs(z), 0.8)},
    "the largest two and a half": lambda: by_configuration(lambda v: cp.sum_largest(v, 2.5)),
    "upper triangle": lambda: {"penalty": lambda z: SQUARES(z) + cp.norm1(cp.upper_tri(grid(z, 3, 3)))},
    "a diagonal variable": diagonal_part,
    "a diagonal variable in a semidefinite constraint": semidefinite_bound,
    "an indicator": lambda: {"penalty": lambda z: SQUARES(z) + cp.transforms.indicator([z <= 0.5, z >= -0.5])},
    "a perspective": perspective,
    "a level of residuals": level,
    "an infinite bound": lambda: {"constraints": lambda z, p: z <= np.append(np.full(N - 1, np.inf), 0.2)},
    "a penalty that is a norm": lambda: {"loss": cp.norm2, "penalty": cp.norm2},
}


@pytest.mark.parametrize("name", list(SOLVED))
def test_is_solved_as_plain_cvxpy_solves_it(name: str) -> None:
    problem = ro.load("position").problem
    made = lambda: ro.Formulation(name, **{"penalty": SQUARES, **SOLVED[name]()})  # noqa: E731
    result = ro.calibrate(problem, made(), 1.0)
    assert result.converged, result.message
    model = problem.linearize(result.x)
    z = result.x / model.parameters.scale
    if name == "an indicator":  # CVXPY's own takes what is missed by a thousandth for met
        return
    best = plain(made(), model, 1.0).objective
    assert objective_at(made(), model, 1.0, z) == pytest.approx(best, rel=1e-6, abs=1e-6)
    assert violation(made(), model, z) <= 1e-7


def test_a_bound_in_a_penalty_holds_as_one_in_a_constraint() -> None:
    problem = ro.load("position").problem
    stated = ro.Formulation("indicator", penalty=SOLVED["an indicator"]()["penalty"])
    bounds = ro.Formulation("bounds", penalty=SQUARES, constraints=lambda z, p: [z <= 0.5, z >= -0.5])
    ends = [
        ro.calibrate(problem, formulation, 1.0).x / problem.parameters.free.scale for formulation in (stated, bounds)
    ]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-5)  # an interior point's end in weak directions


def test_a_weight_beyond_all_measure_ends_at_nominal() -> None:
    result = ro.calibrate(ro.load("position").problem, ro.Formulation("norms", cp.norm2, cp.norm2), 1e12)
    assert result.converged
    np.testing.assert_allclose(result.x, 0, atol=1e-12)


def test_a_constant_loss_leaves_the_penalty_alone() -> None:
    result = ro.calibrate(ro.load("position").problem, ro.Formulation("none", lambda r: 3.0, SQUARES), 1.0)
    assert result.converged
    np.testing.assert_allclose(result.x, 0, atol=1e-12)


def suppfunc(z: Any) -> Any:
    x = cp.Variable(N)
    return cp.transforms.suppfunc(x, [cp.norm(x) <= 1])(z) + SQUARES(z)


def test_what_cvxpy_makes_with_a_solver_needs_that_solver() -> None:
    problem = ro.load("position").problem
    stated = ro.Formulation("support", penalty=suppfunc)
    if "SCS" in cp.installed_solvers():
        assert ro.calibrate(problem, stated, 1.0).converged
        return
    with pytest.raises(ro.InputError, match="penalty: found The solver SCS is not installed"):
        ro.calibrate(problem, stated, 1.0)


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "a penalty by name": ({"penalty": "norm1"}, "penalty: found 'norm1', accepted: a function"),
    "a loss by name": ({"loss": "huber"}, "loss: found 'huber', accepted: a function"),
    "a constraint by name": ({"constraints": ("box",)}, "constraints: found 'box', accepted: functions"),
    "a bound that is NaN": (
        {"constraints": lambda z, p: z <= np.nan},
        r"z <= np.nan: found a constant that .*\(NaN\)",
    ),
    "a factor that is NaN": ({"penalty": lambda z: np.nan * SQUARES(z)}, r"penalty: found a constant that .*\(NaN\)"),
}


@pytest.mark.parametrize("name", list(REFUSED))
def test_is_refused_in_a_sentence(name: str) -> None:
    stated, said = REFUSED[name]
    with pytest.raises(ro.InputError, match=said):
        ro.calibrate(ro.load("position").problem, ro.Formulation("mine", **{"penalty": SQUARES, **stated}), 1.0)


def test_a_covariance_that_needs_slopes_says_so() -> None:
    result = ro.calibrate(ro.load("position").problem, ro.Formulation("level", penalty=SQUARES, **level()), 1.0)
    with pytest.raises(
        ro.InputError,
        match="a loss with own variables, accepted: a loss with gradients, without own variables, which covariances",
    ):
        _ = result.covariance


def test_a_loss_that_is_linear_almost_everywhere_ends_at_its_minimum() -> None:
    """Huber of a threshold below most residuals: its Hessian says nothing of most directions, at any weight."""
    problem = ro.load("position").problem
    model = problem.linearize(np.zeros(N))
    for weight in (1e-4, 1.0):
        stated = ro.Formulation("linear", lambda r: cp.sum(cp.huber(r, 0.03)), cp.norm1)
        found = ro.convex.pose(stated, model).solve(weight)
        assert found.objective == pytest.approx(plain(stated, model, weight).objective, rel=1e-6)
