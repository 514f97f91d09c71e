"""Formulations that users could write, more than sixty: atoms of CVXPY as losses, penalties and constraints."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cvxpy as cp
import numpy as np

import rpim_opt as ro

CASES: dict[str, Callable[[], ro.Formulation]] = {}
"""By name, what makes the formulation anew: its own variables and parameters belong to one formulation each."""

PROBLEMS = ("position", "paper_arm", "markers", "pose", "cable", "rank_deficient", "seven_axis", "mixed")
"""Shipped problems: positions, one with 27 equations, several reflectors, poses, cables, dependent parameters, ..."""


def case(name: str, loss: Any = cp.sum_squares, penalty: Any = None, *constraints: Any, **more: Any) -> None:
    CASES[name] = lambda: ro.Formulation(name, loss, penalty, constraints, **more)


def made(name: str) -> Callable[[Callable[[], dict[str, Any]]], None]:
    """Enter a formulation whose variables or parameters are made with it."""

    def enter(make: Callable[[], dict[str, Any]]) -> None:
        CASES[name] = lambda: ro.Formulation(name, **make())

    return enter


# --- matrices that depend on a size alone ------------------------------------------------------------------


def mixing(size: int) -> np.ndarray:
    """A well conditioned matrix (size, size) without structure."""
    rng = np.random.default_rng(size)
    return np.eye(size) + 0.3 * rng.normal(size=(size, size)) / np.sqrt(size)


def smoothing(size: int) -> np.ndarray:
    """Neighbours' differences, and the first: (size, size), of full rank."""
    return np.eye(size) - 0.9 * np.eye(size, k=-1)


def semidefinite(size: int) -> np.ndarray:
    """A matrix (size, size) of half the rank."""
    half = np.random.default_rng(size).normal(size=(max(size // 2, 1), size))
    return half.T @ half / size


def expected(size: int) -> np.ndarray:
    return 0.3 * np.cos(np.arange(size))


def square(z: Any, side: int = 4) -> Any:
    """The first parameters as a matrix (side, side)."""
    return cp.reshape(z[: side * side], (side, side), order="C")


def both(v: Any) -> Any:
    return cp.hstack([v, -v])


# --- losses of the equations -------------------------------------------------------------------------------


def quantile(r: Any) -> Any:
    return cp.sum(0.7 * cp.pos(r) + 0.3 * cp.pos(-r))


def insensitive(r: Any) -> Any:
    return cp.sum(cp.pos(cp.abs(r) - 1.0))


def quadratic_form(r: Any) -> Any:
    weights = 1.0 + 0.5 * np.sin(np.arange(r.size))
    return cp.quad_form(r, cp.psd_wrap(np.diag(weights)))


case("least squares, in a ball", cp.sum_squares, None, lambda z, p: cp.norm(z) <= 2.0)
case("Tikhonov", cp.sum_squares, cp.sum_squares)
case("Tikhonov, lambdas", lambda r: cp.sum_squares(r), lambda z: cp.sum_squares(z))
case("weighted quadratic form + squares", quadratic_form, cp.sum_squares)
case("mixed rows + L(z - z0)", lambda r: cp.sum_squares(mixing(r.size) @ r), lambda z: quadratic_about(z))
case("Huber + squares", lambda r: cp.sum(cp.huber(r, 1.5)), cp.sum_squares)
case("Huber + nothing, in a box", lambda r: cp.sum(cp.huber(r, 2)), None, lambda z, p: cp.abs(z) <= 1.5)
case("L1 + squares", cp.norm1, cp.sum_squares)
case("L1 + L1", cp.norm1, cp.norm1)
case("L2 + squares", cp.norm2, cp.sum_squares)
case("L2 + L2", cp.norm2, cp.norm2)
case("largest equation + squares", cp.norm_inf, cp.sum_squares)
case("sum of the five largest + squares", lambda r: cp.sum_largest(cp.abs(r), 5), cp.sum_squares)
case("soft maximum + squares", lambda r: 10 * cp.log_sum_exp(0.1 * both(r)), cp.sum_squares)
case("power 1.5 + squares", lambda r: cp.sum(cp.power(cp.abs(r), 1.5)), cp.sum_squares)
case("power 1.5 + L1", lambda r: cp.sum(cp.power(cp.abs(r), 1.5)), cp.norm1)
case("quantile + squares", quantile, cp.sum_squares)
case("insensitive + squares", insensitive, cp.sum_squares)
case("squares and L1 + squares", lambda r: cp.sum_squares(r) + 0.5 * cp.norm1(r), cp.sum_squares)


@made("CVaR + squares")
def _() -> dict[str, Any]:
    threshold = cp.Variable()

    def tail(r: Any) -> Any:
        return threshold + cp.sum(cp.pos(cp.abs(r) - threshold)) / (0.2 * r.size)

    return {"loss": lambda r: 10 * tail(r), "penalty": cp.sum_squares}


@made("outliers of their own + squares")
def _() -> dict[str, Any]:
    def apart(r: Any) -> Any:
        outliers = cp.Variable(r.size)
        return cp.sum_squares(r - outliers) + 3 * cp.norm1(outliers)

    return {"loss": apart, "penalty": cp.sum_squares}


@made("bias of all equations + squares")
def _() -> dict[str, Any]:
    bias = cp.Variable()
    return {
        "loss": lambda r: cp.sum_squares(r - bias),
        "penalty": lambda z: cp.sum_squares(z) + 0.01 * cp.square(bias),
        "constraints": (lambda z, p: cp.abs(bias) <= 2.0,),
    }


@made("parameters in the loss")
def _() -> dict[str, Any]:
    factor = cp.Parameter(nonneg=True, value=0.5)
    return {"loss": lambda r: cp.sum_squares(r) + factor * cp.norm1(r), "penalty": cp.sum_squares}


@made("parameters in the penalty")
def _() -> dict[str, Any]:
    ridge = cp.Parameter(nonneg=True, value=0.3)
    centre = cp.Parameter(value=0.2)
    return {"penalty": lambda z: cp.norm1(z - centre) + ridge * cp.sum_squares(z)}


@made("parameters in the penalty and a constraint, Huber")
def _() -> dict[str, Any]:
    share = cp.Parameter(nonneg=True, value=2.0)
    radius = cp.Parameter(nonneg=True, value=3.0)
    return {
        "loss": lambda r: cp.sum(cp.huber(r, 1.5)),
        "penalty": lambda z: share * cp.sum_squares(z),
        "constraints": (lambda z, p: cp.norm(z) <= radius,),
    }


# --- losses of the configurations' norms -------------------------------------------------------------------


def over(name: str, loss: Any, penalty: Any = cp.sum_squares, *constraints: Any, **more: Any) -> None:
    case(name, loss, penalty, *constraints, loss_over="configuration", **more)


over("Huber of norms + squares", lambda v: cp.sum(cp.huber(v, 2)))
over("Huber of norms + L1, in a ball", lambda v: cp.sum(cp.huber(v, 2)), cp.norm1, lambda z, p: cp.norm(z) <= 3.0)
over("sum of norms + squares", cp.sum)
over("sum of norms + groups", cp.sum, cp.sum, penalty_over=ro.constraints.by_link)
over("largest norm + squares", cp.max)
over("largest norm + nothing, in a box", cp.max, None, lambda z, p: [z <= 1.0, z >= -1.0])
over("squared norms + L1", cp.sum_squares, cp.norm1)
over("three largest norms + squares", lambda v: cp.sum_largest(v, 3))


@made("CVaR of norms + squares")
def _() -> dict[str, Any]:
    threshold = cp.Variable()

    def tail(v: Any) -> Any:
        return threshold + cp.sum(cp.pos(v - threshold)) / (0.2 * v.size)

    return {"loss": tail, "penalty": cp.sum_squares, "loss_over": "configuration"}


# --- penalties ---------------------------------------------------------------------------------------------


def quadratic_about(z: Any) -> Any:
    return cp.sum_squares(smoothing(z.size) @ (z - expected(z.size)))


def relative_entropy(z: Any) -> Any:
    """Has a domain, z >= -1."""
    return cp.sum(cp.kl_div(z + 1, 1))


def elastic_net(z: Any) -> Any:
    return 0.5 * cp.norm1(z) + 0.5 * cp.sum_squares(z)


def groups_of_three(z: Any) -> Any:
    return cp.sum(cp.hstack([cp.norm(z[k : k + 3]) for k in range(0, z.size, 3)]))


case("squares + L(z - z0)", cp.sum_squares, quadratic_about)
case("squares + semidefinite form", cp.sum_squares, lambda z: cp.quad_form(z, cp.psd_wrap(semidefinite(z.size))))
case("lasso", cp.sum_squares, cp.norm1)
case("squares + L2", cp.sum_squares, cp.norm2)
case("squares + groups by link", cp.sum_squares, cp.sum, penalty_over=ro.constraints.by_link)
case("squares + largest group", cp.sum_squares, cp.max, penalty_over=ro.constraints.by_kind)
case("squares + kinds and their squares", cp.sum_squares, lambda v: cp.sum(v) + 0.1 * cp.sum_squares(v),
     penalty_over=ro.constraints.by_kind)  # fmt: skip
case("squares + groups of three", cp.sum_squares, groups_of_three)
case("elastic net", cp.sum_squares, elastic_net)
case("squares + Huber", cp.sum_squares, lambda z: cp.sum(cp.huber(z, 0.3)))
case("squares + relative entropy", cp.sum_squares, relative_entropy)
case("Huber + relative entropy", lambda r: cp.sum(cp.huber(r, 1.5)), relative_entropy)
case("squares + total variation", cp.sum_squares, lambda z: cp.tv(z) + 0.1 * cp.sum_squares(z))
case("Huber of norms + total variation", lambda v: cp.sum(cp.huber(v, 2)), cp.tv, loss_over="configuration")
case("squares + soft maximum", cp.sum_squares, lambda z: cp.log_sum_exp(both(z)))
case("squares + largest entry", cp.sum_squares, lambda z: cp.max(cp.abs(z)))
case("squares + nuclear norm", cp.sum_squares, lambda z: cp.normNuc(square(z)) + 0.1 * cp.sum_squares(z))
case("squares + largest eigenvalue", cp.sum_squares, lambda z: cp.lambda_max(square(z) + square(z).T) + cp.norm1(z))
case("squares + power 1.5", cp.sum_squares, lambda z: cp.sum(cp.power(cp.abs(z), 1.5)))
case("squares + signed", cp.sum_squares, lambda z: cp.sum(2 * cp.pos(z) + cp.neg(z)))


@made("squares + dense and sparse part")
def _() -> dict[str, Any]:
    def parts(z: Any) -> Any:
        sparse = cp.Variable(z.size)
        return cp.sum_squares(z - sparse) + 0.5 * cp.norm1(sparse)

    return {"penalty": parts}


@made("squares + common level")
def _() -> dict[str, Any]:
    level = cp.Variable()
    return {"penalty": lambda z: cp.norm1(z - level) + 0.1 * cp.square(level)}


# --- constraints -------------------------------------------------------------------------------------------


def half(p: Any) -> tuple[np.ndarray, np.ndarray]:
    return np.full(len(p), -0.5), np.full(len(p), 0.5)


def linked_balls(z: Any, p: Any) -> list[Any]:
    return [cp.norm(D @ z) <= 0.8 for D in ro.constraints.by_link(p)]


def matrix_inequality(z: Any, p: Any) -> Any:
    column = cp.reshape(z, (z.size, 1), order="C")
    return cp.bmat([[1.5 * np.eye(z.size), column], [column.T, np.array([[1.5]])]]) >> 0


def in_si(z: Any, p: Any) -> Any:
    return cp.abs(cp.multiply(p.scale, z)) <= 0.7 * p.scale


def level_plane(z: Any, p: Any) -> Any:
    return [cp.sum(z[:3]) == 0.5, z[0] == z[1]]


def exponential(z: Any, p: Any) -> Any:
    return cp.constraints.ExpCone(z[:4], np.ones(4), np.full(4, 1.2))


case("Tikhonov, Box", cp.sum_squares, cp.sum_squares, ro.constraints.Box("half a scale", half))
case("lasso, Box", cp.sum_squares, cp.norm1, ro.constraints.Box("half a scale", half))
case("Tikhonov, in a ball", cp.sum_squares, cp.sum_squares, ro.in_ball(1.0, "*"))
case("Tikhonov, in an L1 ball", cp.sum_squares, cp.sum_squares, lambda z, p: cp.norm1(z) <= 2.0)
case("L1, in an L1 ball", cp.norm1, cp.sum_squares, lambda z, p: cp.norm1(z) <= 2.0)
case("Tikhonov, absolute values", cp.sum_squares, cp.sum_squares, lambda z, p: cp.abs(z) <= 0.6)
case("Tikhonov, absolute values in SI", cp.sum_squares, cp.sum_squares, in_si)
case(
    "Huber of norms, a ball a link",
    lambda v: cp.sum(cp.huber(v, 2)),
    cp.sum_squares,
    linked_balls,
    loss_over="configuration",
)
TWINS: dict[str, tuple[Any, ...]] = {
    "Tikhonov, absolute values in SI": (lambda z, p: cp.abs(z) <= 0.7,),
    "Tikhonov, matrix inequality": (lambda z, p: cp.norm(z) <= 1.5,),
}
"""The same sets of constraints, stated so that plain CVXPY meets them to 1e-7: with rows of a thousandth it misses them
by 1e-5, and its optimum is then too low to compare with."""


case("Tikhonov, matrix inequality", cp.sum_squares, cp.sum_squares, matrix_inequality)
case("Tikhonov, second-order cone", cp.sum_squares, cp.sum_squares, lambda z, p: cp.SOC(1.0 + 0.5 * z[0], z[1:]))
case("Tikhonov, equalities", cp.sum_squares, cp.sum_squares, level_plane)
case("Huber, exponential cone", lambda r: cp.sum(cp.huber(r, 1.5)), cp.sum_squares, exponential)
case("Tikhonov, sum of exponentials", cp.sum_squares, cp.sum_squares, lambda z, p: cp.sum(cp.exp(z[:5])) <= 5.5)


@made("Tikhonov, slack of a box")
def _() -> dict[str, Any]:
    slack = cp.Variable(nonneg=True)
    return {
        "penalty": lambda z: cp.sum_squares(z) + 2 * slack,
        "constraints": (lambda z, p: cp.abs(z) <= 0.3 + slack,),
    }


@made("squares, budget of slacks")
def _() -> dict[str, Any]:
    slack = cp.Variable(3, nonneg=True)
    return {
        "penalty": cp.sum_squares,
        "constraints": (lambda z, p: cp.abs(z[:3]) <= 0.1 + slack, lambda z, p: cp.sum(slack) <= 0.5),
    }
