"""Losses that are the largest of many: the minimum of an interior point, with a gap that bounds what is missing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.convex.epigraph import Epigraph
from rpim_opt.convex.gap import duality_gap
from rpim_opt.convex.objective import Damping
from tests.convex.test_formulation import model
from tests.convex.test_newton import by_interior_point

FACTORS = np.geomspace(0.3, 30.0, 30)
MODEL = model(condition=30.0).scaled(FACTORS)
EQUATIONS: dict[str, Any] = {
    "absolute": cp.norm_inf,
    "of absolute values": lambda r: 2 * cp.max(cp.abs(r - 0.01)) + 1,
    "signed": lambda r: cp.max(cp.multiply(np.resize([1.0, -1.0], r.size), r)),
    "weighed": lambda r: cp.norm(cp.multiply(np.linspace(1, 2, r.size), r), "inf") / 3,
}
NORMS: dict[str, Any] = {
    "norms": cp.max,
    "weighed norms": lambda v: cp.max(cp.multiply(np.linspace(1, 2, v.size), v) + np.linspace(0, 0.1, v.size)),
}
CASES = [(name, "equation") for name in EQUATIONS] + [(name, "configuration") for name in NORMS]


def stated(name: str, over: str) -> ro.Formulation:
    loss = (EQUATIONS if over == "equation" else NORMS)[name]
    return ro.Formulation(name, loss=loss, penalty=cp.sum_squares, loss_over=over)


@pytest.mark.parametrize(("name", "over"), CASES)
@pytest.mark.parametrize("weight", [1e-6, 1e-2, 1.0, 1e3])
def test_the_minimum_is_that_of_an_interior_point(name: str, over: str, weight: float) -> None:
    program = ro.convex.pose(stated(name, over), MODEL)
    assert program.worst is not None
    found = program._by_rows(weight, None)
    assert found is not None
    best = program.objective(by_interior_point(program, weight), weight)
    assert found.objective == pytest.approx(best, rel=1e-7)
    assert found.objective <= best * (1 + 1e-10)


@pytest.mark.parametrize(("name", "over"), CASES)
def test_the_minimum_is_that_of_the_written_problem(name: str, over: str) -> None:
    program = ro.convex.pose(stated(name, over), MODEL)
    accurate = {"tol_gap_rel": 1e-10, "tol_gap_abs": 1e-10, "tol_feas": 1e-10}
    written = program.problem(0.02).solve(solver="CLARABEL", **accurate)
    assert program.solve(0.02).objective == pytest.approx(written, rel=1e-8)


@pytest.mark.parametrize(("name", "over"), CASES)
def test_no_point_lies_lower_than_the_gap_allows(name: str, over: str) -> None:
    """At points of all kinds and with slopes of all kinds, objective - gap is a lower bound; at the minimum it is one
    that is reached."""
    program = ro.convex.pose(stated(name, over), MODEL)
    best = program.proven(0.02)
    assert np.isclose(best.objective, program.solve(0.02).objective, rtol=1e-9)
    near = program._met.nearest(0.02)
    assert near is not None
    slope = np.empty(len(MODEL.b))
    slope[program.order] = near.slope
    assert duality_gap(program, best.z, 0.02, slope) <= 1e-9 * best.objective
    rng = np.random.default_rng(3)
    for k, noise in enumerate(rng.normal(size=(8, 12))):
        z = best.z + 10.0**-k * noise
        for proposed in (slope, np.abs(rng.normal(size=len(slope)))):
            lower = program.objective(z, 0.02) - duality_gap(program, z, 0.02, proposed)
            assert lower <= best.objective * (1 + 1e-10)


def test_order_of_the_equations_does_not_matter() -> None:
    """Configurations whose equations are not next to each other, and factors that belong to equations."""
    mixed = np.random.default_rng(0).permutation(30)
    shuffled = replace(MODEL, A=MODEL.A[mixed], b=MODEL.b[mixed], group=MODEL.group[mixed])
    factor = np.linspace(1, 2, 30)
    for over in ("equation", "configuration"):
        losses = [cp.norm_inf, cp.norm_inf]
        if over == "equation":
            losses = [lambda r, f=f: cp.norm_inf(cp.multiply(f, r)) for f in (factor, factor[mixed])]
        forms = [ro.Formulation("", loss=loss, penalty=cp.sum_squares, loss_over=over) for loss in losses]
        found = [ro.convex.pose(f, m).solve(0.1) for f, m in zip(forms, (MODEL, shuffled), strict=True)]
        assert found[0].objective == pytest.approx(found[1].objective, rel=1e-10)


@pytest.mark.parametrize(("name", "over"), CASES)
def test_a_box_holds_and_its_multipliers_are_what_loosening_it_gains(name: str, over: str) -> None:
    boxed = replace(stated(name, over), constraints=(ro.convex.constraints.signed(1, "*"),))
    program = ro.convex.pose(boxed, MODEL)
    assert program.worst is not None
    found = program._by_rows(0.01, None)
    assert found is not None
    best = program.objective(np.maximum(by_interior_point(program, 0.01), 0.0), 0.01)
    assert found.objective == pytest.approx(best, rel=1e-6)
    assert found.objective <= best * (1 + 1e-10)
    assert found.z.min() == 0.0
    k = int(np.argmax(found.duals[0]))
    looser = 1e-4
    moved = replace(
        program.formulation,
        constraints=(lambda z, p: [z[j] >= (-looser if j == k else 0.0) for j in range(12)],),
    )
    gained = found.objective - program.objective(by_interior_point(ro.convex.pose(moved, MODEL), 0.01), 0.01)
    assert gained == pytest.approx(looser * found.duals[0][k], rel=0.05, abs=1e-8 * best)


def test_damping_is_a_term_of_the_objective() -> None:
    program = ro.convex.pose(stated("norms", "configuration"), MODEL)
    damping = Damping(np.full(12, 0.5), np.linspace(0.1, 3, 12))
    for weight in (0.0, 0.3):
        found = program._by_rows(weight, damping)
        assert found is not None
        other = by_interior_point(program, weight, damping)
        assert found.z == pytest.approx(other, abs=1e-5)


def test_neighbours_change_where_the_method_begins_and_not_where_it_ends() -> None:
    for name, over in CASES:
        weights = np.geomspace(1e-5, 1e2, 8)
        warm = ro.convex.pose(stated(name, over), MODEL).path(weights)
        for estimate in warm[::3]:
            cold = ro.convex.pose(stated(name, over), MODEL).solve(estimate.weight)
            assert estimate.objective == pytest.approx(cold.objective, rel=1e-9)


def test_rows_of_zeros_and_what_the_data_do_not_see() -> None:
    kept = MODEL.scaled(np.where(MODEL.group % 3 == 0, 0.0, 1.0))
    program = ro.convex.pose(stated("norms", "configuration"), kept)
    found = program.solve(0.5)
    assert found.objective == pytest.approx(program.objective(by_interior_point(program, 0.5), 0.5), rel=1e-8)
    blind = replace(MODEL, A=MODEL.A * (np.arange(12) != 4))
    z = ro.convex.pose(stated("norms", "configuration"), blind).solve(0.1).z
    assert abs(z[4]) <= 1e-9


@pytest.mark.parametrize(
    "loss",
    [
        lambda r: cp.max(r) + cp.sum(cp.huber(r)),
        lambda r: cp.sum_largest(r, 2),
        lambda r: cp.square(cp.norm_inf(r)),
        lambda r: cp.max(cp.abs(np.ones((2, r.size)) @ r)),
        lambda r: cp.norm_inf(r[:4]),
        lambda r: cp.norm_inf(cp.multiply(np.arange(r.size), r)),
    ],
)
def test_what_is_no_largest_row_stays_an_interior_points(loss: Any) -> None:
    formulation = ro.Formulation("mine", loss=loss, penalty=cp.sum_squares)
    assert ro.convex.pose(formulation, MODEL).worst is None


@pytest.mark.parametrize("seed", range(6))
def test_quadratic_and_the_largest_of_lines_within_bounds(seed: int) -> None:
    """Minimum and multipliers meet the conditions of optimality, wherever the search begins."""
    rng = np.random.default_rng(seed)
    p, lines, bounds = 6, 25, 8
    root = rng.normal(size=(p, p)) * np.geomspace(1e-3, 1, p)
    H, g = root.T @ root + 1e-9 * np.eye(p), rng.normal(size=p)
    G = rng.normal(size=(lines + bounds, p))
    v = np.append(rng.normal(size=lines), -rng.uniform(0.01, 1.0, bounds))
    s = np.append(np.ones(lines), np.zeros(bounds))
    for start in ([], [3], list(range(5)), list(range(lines + 4)), [2, 2]):
        found = Epigraph(H, g, v, G, s).minimum(np.array(start, dtype=int), 500)
        assert found is not None
        slack = v + G @ found.d - s * found.t
        assert slack.max() <= 1e-12 * np.abs(v + G @ found.d).max()
        assert found.shares.min() >= 0
        assert found.shares @ s == pytest.approx(1.0)
        assert np.abs(slack[found.shares > 0]).max() <= 1e-12 * np.abs(v + G @ found.d).max()
        assert H @ found.d + g + G.T @ found.shares == pytest.approx(np.zeros(p), abs=1e-8)
