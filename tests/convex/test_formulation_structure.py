"""Structure of a formulation before any data: boxes, norms, residuals or configurations, and parameters."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.convex.expressions import Frozen, Term, listed, norms, scalar, term
from rpim_opt.convex.infeasible import conflict, name_of
from rpim_opt.convex.quadratic import quadratic
from rpim_opt.convex.rules.scores import linear_rule
from rpim_opt.convex.rules.selection import EDGES
from rpim_opt.problem import LinearModel
from tests.convex.test_formulation import model

MODEL = model(condition=30.0)
N = 12
L = np.random.default_rng(4).normal(size=(7, N))


def posed(**stated: Any) -> Any:
    return ro.convex.pose(ro.Formulation("mine", **{"penalty": cp.sum_squares, **stated}), MODEL).structure


def box(lower: Any, upper: Any) -> ro.constraints.Box:
    return ro.constraints.Box("box", lambda p: (np.broadcast_to(lower, len(p)), np.broadcast_to(upper, len(p))))


def test_a_triangle_stands_for_its_equations_where_the_loss_sees_their_length() -> None:
    R = MODEL.qr_factor
    qr_factor = LinearModel(R[:, :N], R[:, N], np.zeros(N + 1, dtype=int), MODEL.parameters, stands_for=30)
    for formulation in (ro.tikhonov, ro.lasso):
        whole, reduced = (ro.convex.pose(formulation, m).solve(0.7).objective for m in (MODEL, qr_factor))
        assert reduced == pytest.approx(whole, rel=1e-7)
    for formulation in (ro.robust, ro.Formulation("l1", loss=cp.norm1)):
        with pytest.raises(ro.InputError, match="equations in blocks, of which only the QR factor is kept"):
            ro.convex.pose(formulation, qr_factor)


def test_norms_of_uneven_configurations_in_any_order() -> None:
    group = np.array([7, 2, 2, 5, 7, 5, 5, 9])
    r = np.arange(1.0, 9.0)
    want = [np.linalg.norm(r[group == g]) for g in (2, 5, 7, 9)]
    model = LinearModel(np.zeros((8, N)), r, group, MODEL.parameters)
    assert model.norms(r) == pytest.approx(want, rel=1e-12)
    assert norms(cp.Constant(r), group).value == pytest.approx(want, rel=1e-9)


def test_boxes_meet_in_one() -> None:
    lower, upper = posed(constraints=(box(-1.0, 2.0), box(-3.0, 0.5))).box
    assert (lower == -1.0).all()
    assert (upper == 0.5).all()
    free = posed().box
    assert np.isneginf(free[0]).all()
    assert np.isposinf(free[1]).all()
    point = posed(constraints=(box(-1.0, 0.5), box(0.5, 2.0))).box
    assert (point[0] == point[1]).all()
    assert posed(constraints=(box(-1.0, 0.0), box(1.0, 2.0))).box is None
    assert posed(constraints=(ro.in_ball(1.0, "*"),)).box is None


def test_what_constrains() -> None:
    assert not posed().constrained
    assert posed(constraints=(box(-1.0, 1.0),)).constrained


def test_a_penalty_over_norms_is_a_quadratic_where_it_is_one_of_theirs() -> None:
    groups = [np.eye(N)[:3], np.eye(N)[3:5], L]
    z = np.linspace(-1, 2, N)

    def form(penalty: Any) -> Any:
        return posed(penalty=penalty, penalty_over=lambda p: groups).penalty_form

    squares = np.array([np.sum((D @ z) ** 2) for D in groups])
    assert form(cp.sum_squares).value(z) == pytest.approx(squares.sum(), rel=1e-9)
    weighed = form(lambda v: cp.sum_squares(cp.multiply([1.0, 2.0, 3.0], v)) + 5.0)
    assert weighed.value(z) == pytest.approx(squares @ [1, 4, 9] + 5.0, rel=1e-9)
    assert form(cp.sum) is None
    assert form(lambda v: cp.sum_squares(v + 1)) is None
    assert form(lambda v: cp.sum_squares(np.tri(3) @ v)) is None


def test_a_loss_over_norms_is_a_quadratic_where_it_is_one_of_theirs() -> None:
    r = np.linspace(-1, 2, 30)

    def form(loss: Any, **more: Any) -> Any:
        return posed(loss=loss, loss_over="configuration", **more).loss_form

    squares = np.sum(r.reshape(-1, 3) ** 2, axis=1)
    assert form(cp.sum_squares).value(r) == pytest.approx(squares.sum(), rel=1e-9)
    weights = np.arange(1.0, 11.0)
    weighed = form(lambda v: cp.sum_squares(cp.multiply(weights, v)) + 5.0)
    assert weighed.value(r) == pytest.approx(squares @ weights**2 + 5.0, rel=1e-9)
    assert form(cp.sum) is None
    assert form(lambda v: cp.sum_squares(v + 1)) is None


def test_what_is_a_quadratic() -> None:
    v = cp.Variable(N)
    z = np.linspace(-1, 2, N)
    P = L.T @ L
    for expression in (
        cp.sum_squares(v),
        cp.sum_squares(L @ v - 1.0) + 2.0,
        3 * cp.quad_form(v - 0.5, P + np.eye(N)) + cp.sum(v),
        cp.sum_squares(cp.multiply(np.arange(N), v)) + v[3],
        0.5 * cp.sum_squares(v[:4]) - 7.0,
    ):
        form = quadratic(expression, v)
        assert form is not None
        assert form.value(z) == pytest.approx(
            float(cp.Problem(cp.Minimize(expression), [v == z]).solve(solver=cp.CLARABEL)), rel=1e-6
        )
        v.value = z
        assert form.value(z) == pytest.approx(float(expression.value), rel=1e-9)
        assert (np.linalg.norm(form.matrix @ z - form.c) ** 2 + form.constant) == pytest.approx(form.value(z), rel=1e-9)
        assert form.times(np.eye(N)) == pytest.approx(form.matrix, abs=1e-12)
    for expression in (
        cp.norm1(v),
        cp.norm2(v),
        cp.sum(v),
        cp.sum_squares(v[1:]) + v[0],
        cp.sum(cp.huber(v)),
        cp.sum_squares(v) + cp.max(v),
        cp.sum_squares(cp.pos(v)),
    ):
        assert quadratic(expression, v) is None, expression
    assert quadratic(cp.sum_squares(v) + cp.sum_squares(cp.Variable(2)), v) is None


def test_quadratics_are_diagonal_where_they_are() -> None:
    v = cp.Variable(N)
    diagonal, mixed = quadratic(cp.sum_squares(cp.multiply(np.arange(N), v)), v), quadratic(cp.sum_squares(L @ v), v)
    assert diagonal is not None
    assert mixed is not None
    assert (diagonal.diagonal, mixed.diagonal) == (True, False)
    assert len(mixed.c) == 7
    assert pytest.approx(np.arange(N), abs=1e-9) == diagonal.L


def test_a_large_quadratic_is_known_where_it_is_diagonal() -> None:
    v = cp.Variable(2001)
    assert quadratic(cp.sum_squares(v), v) is not None
    assert quadratic(cp.sum_squares(v[1:] - v[:-1]) + cp.sum_squares(v), v) is None


def test_how_large_a_quadratic_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rpim_opt.convex.quadratic.DENSE", 5)
    for size, known in ((5, True), (6, False)):
        v = cp.Variable(size)
        assert (quadratic(cp.sum_squares(v[1:] - v[:-1]) + cp.sum_squares(v), v) is not None) == known


# --- terms -------------------------------------------------------------------------------------------------


def test_a_term_is_evaluated_and_has_a_slope() -> None:
    log = term(lambda v: -cp.sum(cp.log(v)), 3, "here")
    at = np.array([1.0, 2.0, 4.0])
    assert log(at) == pytest.approx(-np.log(8.0), rel=1e-12)
    assert log(-at) == np.inf
    assert log.slope(at) == pytest.approx(-1 / at, rel=1e-12)
    assert log.slope(-at) is None
    one = cp.Variable(1)
    slope = Term(cp.sum_squares(one), one).slope(np.array([3.0]))
    assert slope is not None
    assert slope.shape == (1,)


def test_what_a_user_changes_later_does_not_reach_a_copy() -> None:
    z, p, own = cp.Variable(3), cp.Parameter(nonneg=True, value=2.0), cp.Variable(2, nonneg=True)
    copy = Frozen([z], "here")
    made = copy(p * cp.norm1(z) + p * cp.sum(own))
    again = copy(p * cp.sum(own) + cp.sum(z))
    assert not made.parameters()
    assert {id(v) for v in made.variables()} == {id(z), id(copy.own[0])}
    assert {id(v) for v in again.variables()} == {id(z), id(copy.own[0])}
    assert len(copy.own) == 1
    assert copy.own[0].attributes["nonneg"]
    assert copy.own[0].shape == (2,)
    with pytest.raises(ro.InputError, match="without a value"):
        copy(cp.Parameter(name="q") * z)
    for attribute in ("boolean", "integer"):
        with pytest.raises(ro.InputError, match="integer variable"):
            copy(cp.sum(cp.Variable(2, **{attribute: True})))


def test_answers_are_scalars_and_constraints() -> None:
    v = cp.Variable(3)
    assert scalar(cp.sum_squares(v[:1]) * np.ones(1), "here").shape == ()
    assert scalar(3, "here").shape == ()
    for wrong, said in ((v, r"a value of shape \(3,\)"), (1j * v[0], "complex"), (-cp.norm(v), "not convex")):
        with pytest.raises(ro.InputError, match=said):
            scalar(wrong, "here")
    long = -cp.norm(cp.hstack([v] * 60))
    with pytest.raises(ro.InputError, match=r"\.\.\.") as error:
        scalar(long, "here")
    assert len(str(error.value)) < 250
    assert len(listed([v >= 0, v <= 1], "here")) == 2
    assert len(listed(v >= 0, "here")) == 1
    for wrong, said in ((True, "True"), ([v >= 0, 3], "a int"), (cp.norm(v) >= 1, "not convex")):
        with pytest.raises(ro.InputError, match=said):
            listed(wrong, "here")


# --- conflicts ---------------------------------------------------------------------------------------------


def contradiction(*constraints: Any) -> Any:
    formulation = ro.Formulation("mine", penalty=cp.sum_squares, constraints=constraints)
    program = ro.convex.pose(formulation, MODEL)
    return conflict(program.structure), program.structure


def low(z: Any, p: Any) -> Any:
    return [z[0] >= 1.0, z[1] <= 5.0]


def high(z: Any, p: Any) -> Any:
    return z[0] <= 0.0


def test_a_conflict_is_irreducible_and_said_by_name() -> None:
    found, _ = contradiction(low, lambda z, p: z[2] >= 0, high)
    assert found.constraints == ("low (1)", "high")
    assert contradiction(low)[0] is None
    assert name_of(high, 0) == "high"
    name = name_of(lambda z, p: z[2] >= 0, 2)
    assert name == "z[2] >= 0"  # what it returns
    assert name_of(ro.in_ball(2.0, "a?"), 0) == "in_ball(2.0, 'a?')"


def test_a_conflict_says_the_least_loosening_of_boxes() -> None:
    """A box in [2, 3] and one in [-1, 0.5] are 1.5 scales apart; components 3 on alone are in both."""
    upper = np.full(N, 0.5)
    upper[3:] = 10.0
    found, _ = contradiction(box(2.0, 30.0), box(-1.0, upper))
    free = MODEL.parameters
    assert set(found.parameters) == set(free.names[:3])
    loosening = [found.parameters[name] / free.scale[i] for i, name in enumerate(free.names[:3])]
    assert loosening == pytest.approx([0.75] * 3, rel=1e-4)  # each box by half


# --- a rule's search ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [0, 1, 100, 198, 199])
def test_a_linear_rule_says_an_edge_and_refines_between_neighbours(k: int) -> None:
    program = ro.convex.pose(ro.tikhonov, MODEL)
    s = np.linalg.svd(MODEL.A)[1]
    weights = np.geomspace(1e-4 * s[-1] ** 2, 10 * s[0] ** 2, 200)
    step = np.log(weights[1] / weights[0])
    target = np.log(weights[k]) + (0.3 * step if 0 < k < 199 else 0.0)

    chosen = linear_rule(program, "mine", lambda w: (np.log(w) - target) ** 2, "found")
    assert np.log(chosen.weight) == pytest.approx(target, abs=1e-5)
    assert chosen.interior == (0 < k < 199)
    assert chosen.note == {0: EDGES["lower"], 199: EDGES["upper"]}.get(k, "found")


def test_a_local_rule_prefers_a_valley_to_an_edge() -> None:
    program = ro.convex.pose(ro.tikhonov, MODEL)

    def score(w: np.ndarray) -> np.ndarray:
        t = np.log(w / 1e-3)
        return np.minimum(t**2, 3.0) - 0.1 * np.abs(t) * (np.abs(t) > 3)

    local = linear_rule(program, "mine", score, "found", local=True)
    assert local.interior
    assert local.weight == pytest.approx(1e-3, rel=1e-3)
    assert not replace(local, interior=False).interior
    assert not linear_rule(program, "mine", lambda w: -np.abs(np.log(w / 1e-3)), "f").interior
