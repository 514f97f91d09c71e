"""Formulations drawn at random from losses, penalties, constraints and variables of their own, against plain CVXPY."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from tests.convex.plain import objective_at, plain, violation

COUNT = 230
"""Formulations in all; seeds are their numbers."""
FORMULATIONS_A_TEST = 10
Rng = np.random.Generator
Made = Callable[[Any], Any]


def in_units(rng: Rng) -> float:
    """A threshold, in sigmas or scales."""
    return float(np.exp(rng.uniform(-1.5, 1.5)))


def huber(rng: Rng) -> Made:
    bound = in_units(rng)
    return lambda v: cp.sum(cp.huber(v, bound))


def deadzone(rng: Rng) -> Made:
    width = in_units(rng)
    return lambda v: cp.sum(cp.pos(cp.abs(v) - width))


def quantile(rng: Rng) -> Made:
    share = float(rng.uniform(0.1, 0.9))
    return lambda r: cp.sum(cp.maximum(share * r, (share - 1) * r))


def weighted(rng: Rng) -> Made:
    factors = rng.uniform(0.2, 3.0, 600)
    return lambda r: cp.sum(cp.multiply(factors[: r.size], cp.square(r)))


def tail(rng: Rng) -> Made:
    level = cp.Variable()
    share = float(rng.uniform(0.05, 0.5))
    return lambda v: level + cp.sum(cp.pos(cp.abs(v) - level)) / (share * v.size)


LOSSES: dict[str, Callable[[Rng], Made]] = {
    "squares": lambda rng: cp.sum_squares,
    "huber": huber,
    "L1": lambda rng: cp.norm1,
    "deadzone": deadzone,
    "quantile": quantile,
    "logistic": lambda rng: lambda r: cp.sum(cp.logistic(r) + cp.logistic(-r)),
    "weighted squares": weighted,
    "minimax": lambda rng: lambda v: cp.max(cp.abs(v)),
    "largest few": lambda rng: lambda v: cp.sum_largest(cp.abs(v), 7),
    "tail": tail,
    "norm": lambda rng: cp.norm2,
    "squares and L1": lambda rng: lambda v: cp.sum_squares(v) + 2 * cp.norm1(v),
}
BY_NORMS = {"squares", "huber", "L1", "deadzone", "minimax", "largest few", "tail", "norm", "squares and L1"}
"""Losses that are nondecreasing in norms."""


def about(rng: Rng) -> Made:
    centre = rng.normal(size=60)
    return lambda z: cp.sum_squares(z - centre[: z.size])


def split(rng: Rng) -> Made:
    def parts(z: Any) -> Any:
        sparse = cp.Variable(z.size)
        return cp.sum_squares(z - sparse) + 0.5 * cp.norm1(sparse)

    return parts


PENALTIES: dict[str, Callable[[Rng], Made]] = {
    "squares": lambda rng: cp.sum_squares,
    "about a centre": about,
    "lasso": lambda rng: cp.norm1,
    "elastic net": lambda rng: lambda z: cp.norm1(z) + cp.sum_squares(z),
    "huber": huber,
    "largest": lambda rng: cp.norm_inf,
    "total variation": lambda rng: lambda z: cp.tv(z) + 0.1 * cp.sum_squares(z),
    "groups": lambda rng: lambda z: cp.sum(cp.hstack([cp.norm(z[k : k + 3]) for k in range(0, z.size, 3)])),
    "dense and sparse": split,
}


def box(rng: Rng) -> Any:
    size = in_units(rng)
    return lambda z, p: [z <= size, z >= -size]


def ball(rng: Rng) -> Any:
    radius = 2 * in_units(rng)
    return lambda z, p: cp.norm(z) <= radius


def plane(rng: Rng) -> Any:
    normal = rng.normal(size=60)
    return lambda z, p: normal[: z.size] @ z <= 0.1


def equality(rng: Rng) -> Any:
    value = 0.1 * float(rng.normal())
    return lambda z, p: [cp.sum(z[:3]) == value, z[3] == z[4]]


def budget(rng: Rng) -> Any:
    size = in_units(rng)

    def slacks(z: Any, p: Any) -> list[Any]:
        slack = cp.Variable(z.size, nonneg=True)
        return [cp.abs(z) <= 0.2 * size + slack, cp.sum(slack) <= size]

    return slacks


CONSTRAINTS: dict[str, Callable[[Rng], Any]] = {
    "box": box,
    "ball": ball,
    "plane": plane,
    "equality": equality,
    "budget of slacks": budget,
    "L1 ball": lambda rng: lambda z, p: cp.norm1(z) <= 3.0,
    "exponentials": lambda rng: lambda z, p: cp.sum(cp.exp(z[:5])) <= 6.0,
}


def drawn(seed: int) -> tuple[str, ro.Formulation, float]:
    """The formulation of a seed, anew: it shares no variable with another."""
    rng = np.random.default_rng(seed)
    loss, penalty = str(rng.choice(list(LOSSES))), str(rng.choice(list(PENALTIES)))
    limits = [str(name) for name in rng.choice(list(CONSTRAINTS), rng.integers(0, 3), replace=False)]
    over = "configuration" if loss in BY_NORMS and rng.random() < 0.5 else "equation"
    weight = float(np.exp(rng.uniform(-2, 4)))
    stated = ro.Formulation(
        f"{seed}: {loss} of {over}s + {weight:.3g} {penalty}, {' and '.join(limits) or 'no constraint'}",
        LOSSES[loss](rng),
        PENALTIES[penalty](rng),
        tuple(CONSTRAINTS[name](rng) for name in limits),
        loss_over=over,
    )
    return stated.name, stated, weight


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, COUNT, FORMULATIONS_A_TEST))
def test_random_formulations_end_where_plain_cvxpy_ends(first: int) -> None:
    problems = [ro.load(name).problem for name in ("position", "paper_arm")]
    for seed in range(first, first + FORMULATIONS_A_TEST):
        name, stated, weight = drawn(seed)
        problem = problems[seed % 2]
        result = ro.calibrate(problem, stated, weight)
        model = problem.linearize(result.x)
        z = result.x / model.parameters.scale
        ours = objective_at(drawn(seed)[1], model, weight, z)
        try:
            best = plain(drawn(seed)[1], model, weight).objective
        except AssertionError:  # CVXPY has no answer to compare with
            best = ours
        assert result.converged, f"{name}: {result.message}"
        assert ours - best <= 1e-6 * max(abs(best), 1.0), f"{name}: {ours:.12g}, CVXPY {best:.12g}"
        assert violation(drawn(seed)[1], model, z) <= 1e-7, name
