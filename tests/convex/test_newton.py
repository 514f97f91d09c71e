"""Losses that are sums over rows: the same minimum as an interior point's, with a gap that bounds what is missing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.convex import by_rows, newton
from rpim_opt.convex.gap import duality_gap
from rpim_opt.convex.interior import interior
from rpim_opt.convex.objective import Damping
from rpim_opt.convex.program import Program
from rpim_opt.convex.tree import largest_of, rows_of
from tests.convex.test_formulation import model

MODEL = model(condition=30.0).scaled(np.geomspace(0.3, 30.0, 30))
EQUATIONS: dict[str, Any] = {
    "huber": lambda r: cp.sum(cp.huber(r, 1.5)),
    "absolute": cp.norm1,
    "quantile": lambda r: cp.sum(cp.maximum(0.9 * r, -0.1 * r)),
    "pseudo-Huber": lambda r: cp.sum(cp.norm(cp.vstack([r, np.ones(r.size)]), axis=0)),
    "log cosh": lambda r: cp.sum(2 * cp.logistic(2 * r) - 2 * r),
    "weighed": lambda r: cp.sum(cp.multiply(np.linspace(1, 2, r.size), cp.huber(r))) / 3,
    "one-sided": lambda r: cp.sum(cp.square(cp.pos(r))) + 0.1 * cp.sum(cp.abs(r)),
}
WRITTEN: dict[str, Any] = EQUATIONS | {
    "even power": lambda r: cp.sum(cp.power(r - 1, 4)),
    "minus minus": lambda r: 2 - cp.sum(-cp.huber(r)),
    "minus minus of each": lambda r: cp.sum(3 - (-cp.huber(r))),
    "in another shape": lambda r: cp.reshape(cp.sum(cp.abs(2 * r - 1)) / 4, (), order="F"),
    "squares by a number": lambda r: cp.quad_over_lin(r + 1, 2.0) + 0.5 * cp.sum(r),
    "exponentials": lambda r: cp.sum(cp.multiply(np.arange(1, 10), cp.exp(r))),
}
"""Sums over nine rows, as people may write them."""
NORMS: dict[str, Any] = {
    "huber": ro.huber(1.0),
    "norms": cp.sum,
    "half and half": lambda v: cp.sum(cp.huber(v)) + 0.5 * cp.sum(v),
    "pseudo-Huber": lambda v: cp.sum(cp.norm(cp.vstack([v, 2 * np.ones(v.size)]), axis=0)),
}
CASES = [(name, "equation") for name in EQUATIONS] + [(name, "configuration") for name in NORMS]


def stated(name: str, over: str) -> ro.Formulation:
    loss = (EQUATIONS if over == "equation" else NORMS)[name]
    return ro.Formulation(name, loss=loss, penalty=cp.sum_squares, loss_over=over)


def by_interior_point(program: Program, weight: float, damping: Damping | None = None) -> np.ndarray:
    found = interior(program, weight, damping)
    assert found.z is not None
    return found.z


@pytest.mark.parametrize(("name", "over"), CASES)
@pytest.mark.parametrize("weight", [1e-6, 1.0, 1e3])
def test_the_minimum_is_that_of_an_interior_point(name: str, over: str, weight: float) -> None:
    program = ro.convex.pose(stated(name, over), MODEL)
    assert program.separated is not None
    found = program.solve(weight)
    best = program.objective(by_interior_point(program, weight), weight)
    assert found.objective == pytest.approx(best, rel=1e-9)
    assert found.objective <= best * (1 + 1e-11)


@pytest.mark.parametrize(("name", "over"), CASES)
def test_the_minimum_is_that_of_the_written_problem(name: str, over: str) -> None:
    program = ro.convex.pose(stated(name, over), MODEL)
    accurate = {"tol_gap_rel": 1e-10, "tol_gap_abs": 1e-10, "tol_feas": 1e-10}
    written = program.problem(0.7).solve(solver="CLARABEL", **accurate)
    assert program.solve(0.7).objective == pytest.approx(written, rel=1e-8)


@pytest.mark.parametrize("loss", [EQUATIONS["weighed"], lambda r: cp.norm_inf(cp.multiply(np.geomspace(1, 9, 30), r))])
def test_a_loss_knows_equations_by_their_places_however_configurations_are_mixed(loss: Any) -> None:
    mixed = replace(MODEL, group=np.random.default_rng(5).permutation(MODEL.group))
    formulation = ro.Formulation("mine", loss=loss, penalty=cp.sum_squares)
    program = ro.convex.pose(formulation, mixed)
    assert program.separated is not None or program.worst is not None
    found = program.solve(0.7)
    assert found.objective == pytest.approx(program.objective(found.z, 0.7), rel=1e-12)
    assert found.objective == pytest.approx(ro.convex.pose(formulation, MODEL).solve(0.7).objective, rel=1e-9)
    some = program.without(mixed.group == 3).solve(0.7)
    expected = ro.convex.pose(formulation, mixed.scaled(np.where(mixed.group == 3, 0.0, 1.0))).solve(0.7)
    assert some.objective == pytest.approx(expected.objective, rel=1e-9)


@pytest.mark.parametrize(("name", "over"), CASES)
def test_no_point_lies_lower_than_the_gap_allows(name: str, over: str) -> None:
    """At points of all kinds, some near the minimum, objective - gap is a lower bound."""
    program = ro.convex.pose(stated(name, over), MODEL)
    best = program.proven(0.7)
    assert np.isclose(best.objective, program.solve(0.7).objective, rtol=1e-9)
    for k, noise in enumerate(np.random.default_rng(3).normal(size=(8, 12))):
        z = best.z + 10.0**-k * noise
        lower = program.objective(z, 0.7) - duality_gap(program, z, 0.7)
        assert lower <= best.objective * (1 + 1e-10)


@pytest.mark.parametrize("name", ["huber", "pseudo-Huber", "log cosh", "weighed"])
def test_the_gap_of_a_smooth_loss_vanishes_at_its_minimum_alone(name: str) -> None:
    program = ro.convex.pose(stated(name, "equation"), MODEL)
    best = program.solve(0.7)
    assert duality_gap(program, best.z, 0.7) <= 1e-10 * best.objective
    assert duality_gap(program, best.z * 1.01, 0.7) > 1e-4 * best.objective


@pytest.mark.parametrize("name", ["huber", "log cosh"])
@pytest.mark.parametrize(("low", "high"), [(-0.02, 0.03), (0.01, np.inf), (-np.inf, -0.01)])
def test_the_gap_in_a_box_vanishes_at_its_minimum_alone(name: str, low: float, high: float) -> None:
    """Components on bounds of either side count where they lead inwards, and not where they are held."""
    sides = ro.constraints.Box("box", lambda p: (np.full(len(p), low), np.full(len(p), high)))
    program = ro.convex.pose(replace(stated(name, "equation"), constraints=(sides,)), MODEL)
    found = program.solve(1.0)
    assert ((found.z == low) | (found.z == high)).any()
    assert duality_gap(program, found.z, 1.0) <= 1e-8 * found.objective
    middle = np.clip(0.5 * (max(low, -0.1) + min(high, 0.1)), low, high)
    for share in (0.01, 0.3):
        z = found.z + share * (middle - found.z)
        missing = program.objective(z, 1.0) - found.objective
        assert duality_gap(program, z, 1.0) >= missing * (1 - 1e-9)


def test_a_slope_that_is_none_proves_nothing() -> None:
    """Of a sum of norms every vector within the unit ball is a slope at zero; others than the minimum's prove less."""
    few = model(condition=30.0)
    program = ro.convex.pose(stated("norms", "configuration"), few)
    z = program.solve(1.0).z
    near = program._met.nearest(1.0)
    assert near is not None
    slope = np.empty(len(few.b))
    slope[program.order] = near.slope
    tight = duality_gap(program, z, 1.0, slope)
    assert tight <= 1e-9 * program.objective(z, 1.0)
    for wrong in (-slope, np.zeros_like(slope)):
        assert duality_gap(program, z, 1.0, wrong) > 1e3 * max(tight, 1e-12)


@pytest.mark.parametrize(("name", "over"), CASES)
def test_a_box_holds_and_its_multipliers_are_the_slopes(name: str, over: str) -> None:
    """The sign of every parameter is stated: about half of them end at zero."""
    boxed = replace(stated(name, over), constraints=(ro.convex.constraints.signed(1, "*"),))
    program = ro.convex.pose(boxed, MODEL)
    assert program.separated is not None
    found = program.solve(0.1)
    best = program.objective(np.maximum(by_interior_point(program, 0.1), 0.0), 0.1)
    assert found.objective == pytest.approx(best, rel=1e-7)
    assert found.objective <= best * (1 + 1e-10)
    assert found.z.min() == 0.0
    gradient = program.gradient(found.z, 0.1)
    if not program.separated.kinks and gradient is not None:
        assert found.duals[0] == pytest.approx(np.where(found.z == 0, gradient, 0.0), abs=1e-6 * np.abs(gradient).max())


def test_damping_is_a_term_of_the_objective() -> None:
    program = ro.convex.pose(stated("huber", "configuration"), MODEL)
    damping = Damping(np.full(12, 0.5), np.linspace(1, 30, 12))
    for weight in (0.0, 0.3):
        found = program.solve(weight, damping=damping)
        other = by_interior_point(program, weight, damping)
        assert found.z == pytest.approx(other, abs=1e-6)


def test_neighbours_change_where_the_method_begins_and_not_where_it_ends() -> None:
    for name, over in [("huber", "equation"), ("quantile", "equation"), ("norms", "configuration")]:
        weights = np.geomspace(1e-3, 1e3, 7)
        warm = ro.convex.pose(stated(name, over), MODEL).path(weights)
        for estimate in warm[::3]:
            cold = ro.convex.pose(stated(name, over), MODEL).solve(estimate.weight)
            assert estimate.objective == pytest.approx(cold.objective, rel=1e-9)


def test_rows_without_data_and_a_weight_of_zero() -> None:
    """Left-out configurations are rows of zeros; without a penalty, what the data do not see stays nominal."""
    kept = MODEL.scaled(np.where(MODEL.group % 3 == 0, 0.0, 1.0))
    for name, over in [("huber", "equation"), ("quantile", "equation"), ("norms", "configuration")]:
        program = ro.convex.pose(stated(name, over), kept)
        found = program.solve(0.5)
        assert found.objective == pytest.approx(program.objective(by_interior_point(program, 0.5), 0.5), rel=1e-9)
    blind = replace(MODEL, A=MODEL.A * (np.arange(12) != 4))
    z = ro.convex.pose(stated("huber", "equation"), blind).solve(0.0).z
    assert abs(z[4]) <= 1e-9


@pytest.mark.parametrize(
    ("loss", "over"),
    [
        (cp.max, "configuration"),
        (cp.norm2, "equation"),
        (lambda r: cp.sum(cp.huber(r[:20])), "equation"),
        (lambda r: cp.sum(r) + 1e-6 * cp.max(r), "configuration"),
        (lambda r: cp.sum(cp.huber(r)) + cp.norm_inf(r), "equation"),
        (lambda v: cp.sum(cp.maximum(v, 3.0)), "configuration"),
    ],
)
def test_what_is_no_sum_or_has_kinks_elsewhere_is_left_to_the_interior_point(loss: Any, over: str) -> None:
    formulation = ro.Formulation("other", loss=loss, penalty=cp.sum_squares, loss_over=over)
    program = ro.convex.pose(formulation, MODEL)
    assert program.separated is None
    assert program.solve(1.0).iterations > 0


@pytest.mark.parametrize("name", WRITTEN)
def test_rows_have_the_value_slope_and_curvature_of_the_expression(name: str) -> None:
    r = cp.Variable(9)
    expression = WRITTEN[name](r)
    rows = rows_of(expression, r)
    assert rows is not None
    v = np.random.default_rng(2).normal(size=9)
    value, slope = rows.both(v)
    for factor, (a, c) in rows.kinks:
        value += float(np.sum(factor * np.abs(a * v + c)))
        slope = slope + factor * a * np.sign(a * v + c)
    r.value = v
    assert value == pytest.approx(expression.value, rel=1e-12)
    assert slope == pytest.approx(np.asarray(expression.grad[r].todense()).ravel(), rel=1e-9)
    h = 1e-5
    bend = (rows.both(v + h)[1] - rows.both(v - h)[1]) / (2 * h)
    assert rows.bend(v) == pytest.approx(bend, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize(
    ("write", "bend"),
    [
        (lambda r: cp.sum(cp.power(r - 1, 4)), lambda v: 12 * (v - 1) ** 2),
        (lambda r: cp.sum(cp.huber(2 * r + 0.5, 1.5)), lambda v: 8.0 * (np.abs(2 * v + 0.5) <= 1.5)),
        (lambda r: cp.sum(cp.square(3 - r / 2)) + cp.sum(r), lambda v: 0.5 + 0 * v),
    ],
)
def test_atoms_that_have_formulas_are_exact(write: Any, bend: Any) -> None:
    """To rounding, where differences of slopes would be eight digits."""
    r = cp.Variable(9)
    rows = rows_of(write(r), r)
    assert rows is not None
    v = np.random.default_rng(3).normal(size=9)
    assert rows.bend(v) == pytest.approx(bend(v), rel=1e-13)


def test_the_larger_of_a_line_and_a_number_has_its_kink_where_they_meet() -> None:
    r = cp.Variable(9)
    rows = rows_of(cp.sum(cp.maximum(2 * r, 3.0)), r)
    assert rows is not None
    ((factor, (a, c)),) = rows.kinks
    assert (factor * a, factor * c) == (pytest.approx(1.0), pytest.approx(-1.5))
    assert len(rows.pieces) == 1


NO_SUMS: dict[str, Any] = {
    "norms with a kink": lambda r: cp.sum(cp.norm(cp.vstack([r, 2 * r]), axis=0)),
    "of all": lambda r: cp.norm2(r) + cp.sum(cp.huber(r)),
    "of some": lambda r: cp.sum(cp.huber(r[:4])),
    "of neighbours": lambda r: cp.sum(cp.abs(cp.diff(r))),
    "mixed": lambda r: cp.sum(cp.huber(np.eye(9)[::-1] @ r)),
    "norms of few": lambda r: cp.sum(cp.norm(cp.vstack([r[:4], r[4:8]]), axis=0)),
}


@pytest.mark.parametrize("name", NO_SUMS)
def test_what_is_no_sum_over_rows_is_not_taken_for_one(name: str) -> None:
    r = cp.Variable(9)
    assert rows_of(NO_SUMS[name](r), r) is None


LARGEST: dict[str, Any] = {
    "largest": cp.max,
    "absolute": lambda r: cp.max(cp.abs(2 * r - 1)),
    "scaled": lambda r: 3 * (cp.norm_inf(r) / 2 + 1) - 0.5,
    "in another shape": lambda r: cp.reshape(cp.max(r), (), order="F") + 1,
}
NOT_LARGEST: dict[str, Any] = {
    "two": lambda r: cp.max(r) + cp.norm_inf(r),
    "smallest": lambda r: -cp.max(r),
    "of some": lambda r: cp.max(r[:3]),
    "of squares": lambda r: cp.max(cp.square(r)),
    "of rows": lambda r: cp.sum(cp.max(cp.vstack([r, -r]), axis=0)),
}


@pytest.mark.parametrize("name", LARGEST)
def test_the_largest_row_has_the_value_of_the_expression(name: str) -> None:
    r = cp.Variable(9)
    expression = LARGEST[name](r)
    found = largest_of(expression, r)
    assert found is not None
    for v in np.random.default_rng(4).normal(size=(5, 9)):
        r.value = v
        line = found.of.a * v + found.of.c
        if found.absolute:
            line = np.abs(line)
        assert found.factor * line.max() + found.constant == pytest.approx(expression.value, rel=1e-14)


@pytest.mark.parametrize("name", NOT_LARGEST)
def test_what_is_no_largest_row_is_not_taken_for_one(name: str) -> None:
    r = cp.Variable(9)
    assert largest_of(NOT_LARGEST[name](r), r) is None


SMOOTH = [
    ("huber", "equation"),
    ("log cosh", "equation"),
    ("huber", "configuration"),
    ("pseudo-Huber", "configuration"),
]


@pytest.mark.parametrize(("name", "over"), SMOOTH)
def test_with_few_second_derivatives_the_minimum_is_the_same(
    name: str, over: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of many equations: second derivatives are a neighbour's, and updated by slopes; with a box, too."""
    signs = (ro.convex.constraints.signed(1, "*"),)
    for formulation in (stated(name, over), replace(stated(name, over), constraints=signs)):
        weights = np.geomspace(1e3, 1e-4, 8)
        expected = ro.convex.pose(formulation, MODEL).path(weights)
        with monkeypatch.context() as patched:
            patched.setattr(newton, "DEAR", 0)
            patched.setattr(by_rows, "DEAR", 0)
            counted = Counted(newton.Newton._hessian)
            patched.setattr(newton.Newton, "_hessian", counted.method())
            program = ro.convex.pose(formulation, MODEL)
            found = program.path(weights)
            assert 1 <= counted.count < len(weights)
        for one, other in zip(found, expected, strict=True):
            assert one.iterations > 0
            assert one.objective == pytest.approx(other.objective, rel=1e-9)


@pytest.mark.parametrize(("name", "over"), SMOOTH)
def test_a_second_derivative_is_kept_while_what_steps_promise_falls(
    name: str, over: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where it must fall to nothing, as far as is asked for, or not at all: the minima are the same."""
    weights = np.geomspace(1e3, 1e-4, 8)
    expected = ro.convex.pose(stated(name, over), MODEL).path(weights)
    monkeypatch.setattr(newton, "DEAR", 0)
    counts = []
    for slow in (0.0, newton.SLOW, np.inf):
        with monkeypatch.context() as patched:
            patched.setattr(newton, "SLOW", slow)
            counted = Counted(newton.Newton._hessian)
            patched.setattr(newton.Newton, "_hessian", counted.method())
            found = ro.convex.pose(stated(name, over), MODEL).path(weights)
        counts.append(counted.count)
        for one, other in zip(found, expected, strict=True):
            assert one.objective == pytest.approx(other.objective, rel=1e-9)
    assert counts[0] >= counts[1] >= counts[2] == 1
    assert counts[0] > 1


@pytest.mark.parametrize(("name", "over"), SMOOTH)
def test_points_for_a_rule_are_within_what_newton_promises(
    name: str, over: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(newton, "DEAR", 0)
    weights = np.geomspace(1e2, 1e-3, 6)
    program = ro.convex.pose(stated(name, over), MODEL)
    rough = program.path(weights, rough=True)
    for one, other in zip(rough, ro.convex.pose(stated(name, over), MODEL).path(weights), strict=True):
        assert other.objective * (1 - 1e-10) <= one.objective <= other.objective * (1 + 1e-8)
        assert program.solve(one.weight).objective == pytest.approx(other.objective, rel=1e-9)


@pytest.mark.parametrize(("name", "over"), [*SMOOTH[-2:], ("norms", "configuration"), ("quantile", "equation")])
def test_points_for_a_rule_are_as_close_of_few_equations(name: str, over: str) -> None:
    """Kinks, too, are missed by no more."""
    weights = np.geomspace(1e2, 1e-3, 6)
    rough = ro.convex.pose(stated(name, over), MODEL).path(weights, rough=True)
    for one, other in zip(rough, ro.convex.pose(stated(name, over), MODEL).path(weights), strict=True):
        assert other.objective * (1 - 1e-10) <= one.objective <= other.objective * (1 + 1e-9)


class Counted:
    """How often a method is called."""

    def __init__(self, function: Any) -> None:
        self.function = function
        self.count = 0

    def method(self) -> Any:
        def called(*arguments: Any) -> Any:
            self.count += 1
            return self.function(*arguments)

        return called


@pytest.mark.parametrize(("name", "over"), [*SMOOTH, ("norms", "configuration"), ("quantile", "equation")])
def test_a_first_minimum_is_looked_for_where_it_is_said_to_be(name: str, over: str) -> None:
    there = ro.convex.pose(stated(name, over), MODEL).solve(0.5)
    near, far = (ro.convex.pose(stated(name, over), MODEL).beginning(z).solve(0.5) for z in (there.z, there.z + 100.0))
    for found in (near, far):
        assert found.objective == pytest.approx(there.objective, rel=1e-9)
    assert near.iterations < far.iterations


@pytest.mark.parametrize(("name", "over"), SMOOTH)
def test_who_writes_on_an_estimate_writes_on_nothing_else(
    name: str, over: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(newton, "DEAR", 0)
    program = ro.convex.pose(stated(name, over), MODEL)
    first = program.solve(0.5)
    objective = first.objective
    first.z[:] *= 1e3
    again = program.solve(0.5)
    assert program.objective(again.z, 0.5) == pytest.approx(objective, rel=1e-9)


def test_a_program_without_some_configurations_is_that_of_the_others() -> None:
    """Whatever unknowns it is solved in."""
    out = MODEL.group % 4 == 1
    for name, over in [("huber", "configuration"), ("norms", "configuration"), ("quantile", "equation")]:
        program = ro.convex.pose(stated(name, over), MODEL)
        without = program.without(out)
        alone = program.on(MODEL.scaled(np.where(out, 0.0, 1.0)))
        for weight in (1e-3, 1.0):
            assert without.solve(weight).objective == pytest.approx(alone.solve(weight).objective, rel=1e-9)


def test_some_of_the_data_begin_where_they_were() -> None:
    """And all of the data hear of it, which is where others of them begin."""
    program = ro.convex.pose(stated("norms", "configuration"), MODEL)
    one, other = (program.without(MODEL.group % 4 == k) for k in (1, 2))
    z = one.solve(1.0).z
    for each in (one, other, program):
        assert any(np.array_equal(near.z, z) for near in each._met.near(1.0))
    other.solve(1.0)
    assert any(np.array_equal(near.z, z) for near in one._met.near(1.1))
    assert not any(np.array_equal(near.z, z) for near in other._met.near(1.1))


def test_norms_are_taken_without_kinks_where_none_is_zero_and_else_with_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of many equations: the same minima, of noise and of data of which some are met exactly."""
    z = np.random.default_rng(8).normal(size=MODEL.A.shape[1])
    met = replace(MODEL, b=np.where(MODEL.group % 4 > 0, MODEL.A @ z, MODEL.b))
    weights = np.geomspace(1e3, 1e-3, 6)
    for linear, least, most in ((MODEL, 0, 5), (met, 1, 12)):
        expected = ro.convex.pose(ro.sum_of_norms, linear).path(weights)
        with monkeypatch.context() as patched:
            patched.setattr(newton, "DEAR", 0)
            patched.setattr(by_rows, "DEAR", 0)
            counted = Counted(newton.Newton._with_kinks)
            patched.setattr(newton.Newton, "_with_kinks", counted.method())
            found = ro.convex.pose(ro.sum_of_norms, linear).path(weights)
        assert least <= counted.count <= most
        for one, other in zip(found, expected, strict=True):
            assert one.objective == pytest.approx(other.objective, rel=1e-8)
