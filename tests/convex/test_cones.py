"""Constraints of any cone are met and never raise: seven kinds, eight problems, four radii, two losses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from tests.convex.plain import objective_at, plain

MISSED = 1e-7
"""By how much a constraint may be missed, relative to 1 + the largest entry of z."""
WEIGHT = 1.0
PROBLEMS = ("position", "paper_arm", "markers", "pose", "cable", "rank_deficient", "seven_axis", "distance")
RADII = (0.1, 0.5, 1.0, 3.0)


class Kind(NamedTuple):
    """A constraint of some radius as CVXPY states it, and what it bounds, in NumPy."""

    stated: Callable[[float], Callable[[Any, Any], Any]]
    size: Callable[[np.ndarray, Any], float]


def box(radius: float) -> ro.constraints.Box:
    return ro.constraints.Box("box", lambda p: (np.full(len(p), -radius), np.full(len(p), radius)))


def absolute(radius: float) -> Callable[[Any, Any], Any]:
    return lambda z, p: cp.abs(z) <= radius


def ball(radius: float) -> Callable[[Any, Any], Any]:
    return ro.in_ball(radius, "*")


def ball_a_link(radius: float) -> Callable[[Any, Any], Any]:
    return lambda z, p: [cp.norm(D @ z) <= radius for D in ro.constraints.by_link(p)]


def octahedron(radius: float) -> Callable[[Any, Any], Any]:
    return lambda z, p: cp.norm1(z) <= radius


def matrix_inequality(radius: float) -> Callable[[Any, Any], Any]:
    """[[t I, z], [z', t]] is positive semidefinite where |z| <= t."""

    def constraint(z: Any, p: Any) -> Any:
        column = cp.reshape(z, (z.size, 1), order="C")
        return cp.bmat([[radius * np.eye(z.size), column], [column.T, np.array([[radius]])]]) >> 0

    return constraint


def in_si(radius: float) -> Callable[[Any, Any], Any]:
    """As somebody writes it who thinks in metres and radians: rows of very different size."""
    return lambda z, p: cp.abs(cp.multiply(p.scale, z)) <= radius * p.scale


def largest_entry(z: np.ndarray, p: Any) -> float:
    return float(np.abs(z).max())


def length(z: np.ndarray, p: Any) -> float:
    return float(np.linalg.norm(z))


def longest_link(z: np.ndarray, p: Any) -> float:
    return max(float(np.linalg.norm(D @ z)) for D in ro.constraints.by_link(p))


def sum_of_entries(z: np.ndarray, p: Any) -> float:
    return float(np.abs(z).sum())


KINDS = {
    "box": Kind(box, largest_entry),
    "absolute values": Kind(absolute, largest_entry),
    "ball": Kind(ball, length),
    "ball a link": Kind(ball_a_link, longest_link),
    "L1 ball": Kind(octahedron, sum_of_entries),
    "matrix inequality": Kind(matrix_inequality, length),
    "absolute values in SI": Kind(in_si, largest_entry),
}
WELL_SCALED = {"absolute values in SI": absolute, "matrix inequality": ball}
"""The same sets, stated so that plain CVXPY meets them to 1e-7: with rows of a thousandth it misses them by 1e-5, and
its optimum is then too low to compare with."""
LOSSES: dict[str, dict[str, Any]] = {
    "squared": {},
    "Huber": {"loss": ro.huber(), "loss_over": "configuration"},
}
ALL = list(product(KINDS, PROBLEMS, RADII, LOSSES))


def spread(count: int) -> list[tuple[str, str, float, str]]:
    """Some of all, the same number of each kind; problems, radii and losses in turns that do not fall together."""
    some = []
    for i, kind in enumerate(KINDS):
        for k in range(count):
            problem = PROBLEMS[(k + 3 * i) % len(PROBLEMS)]
            radius = RADII[(k + i) % len(RADII)]
            loss = list(LOSSES)[(k // len(LOSSES) + i) % len(LOSSES)]
            some.append((kind, problem, radius, loss))
    return some


SPREAD = spread(len(RADII))


@lru_cache
def problem_of(name: str) -> ro.CalibrationProblem:
    return ro.load(name).problem


def met(kind: str, problem_name: str, radius: float, loss: str) -> None:
    stated = (KINDS[kind].stated(radius),)
    formulation = ro.Formulation(f"{loss}, {kind}", penalty=cp.sum_squares, constraints=stated, **LOSSES[loss])
    result = ro.calibrate(problem_of(problem_name), formulation, WEIGHT)
    free = result.problem.parameters.free
    z = result.x / free.scale
    room = MISSED * (1 + float(np.abs(z).max())) * np.sqrt(len(z))  # a sum of entries misses by more than each
    assert result.converged, result.message
    assert KINDS[kind].size(z, free) <= radius + room
    assert result.certificate.violation <= room
    model = result.problem.linearize(result.x)
    same = replace(formulation, constraints=(WELL_SCALED.get(kind, KINDS[kind].stated)(radius),))
    best = plain(same, model, WEIGHT)
    inside = best.z * min(1.0, radius / KINDS[kind].size(best.z, free))  # CVXPY's own point may miss by 1e-7
    ours = objective_at(formulation, model, WEIGHT, z)
    assert ours <= objective_at(formulation, model, WEIGHT, inside) * (1 + 1e-6)
    assert ours >= best.objective * (1 - 1e-6)


def names(cases: list[tuple[str, str, float, str]]) -> list[str]:
    return [f"{kind}, {problem}, {radius:g}, {loss}" for kind, problem, radius, loss in cases]


@pytest.mark.parametrize(("kind", "problem_name", "radius", "loss"), SPREAD, ids=names(SPREAD))
def test_a_constraint_is_met(kind: str, problem_name: str, radius: float, loss: str) -> None:
    met(kind, problem_name, radius, loss)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "problem_name", "radius", "loss"), ALL, ids=names(ALL))
def test_each_of_all_448_is_met(kind: str, problem_name: str, radius: float, loss: str) -> None:
    met(kind, problem_name, radius, loss)


def test_the_sample_has_everything_of_all() -> None:
    assert len(ALL) == 448
    assert len(set(SPREAD)) == len(SPREAD)
    for place, whole in enumerate((KINDS, PROBLEMS, RADII, LOSSES)):
        assert {case[place] for case in SPREAD} == set(whole)
