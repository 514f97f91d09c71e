"""One step of Newton's method for sums over rows: slope, second derivative, updates and promises are what they say."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.convex import coordinates, newton
from rpim_opt.convex import met as minima
from rpim_opt.convex.coordinates import Coordinates
from rpim_opt.convex.interior import _whitened
from rpim_opt.convex.met import Kinked, Met, Near
from rpim_opt.convex.newton import Newton, Point
from rpim_opt.convex.objective import Damping
from rpim_opt.problem.linear import LinearModel
from tests.convex.test_newton import CASES, MODEL, SMOOTH, stated
from tests.convex.test_separated import smoothed_value

RNG = np.random.default_rng(4)
N = MODEL.A.shape[1]
Z = RNG.normal(size=N)
BOX = (np.full(N, -0.2), np.full(N, 0.3))


def made(name: str, over: str, weight: float = 0.7, **more: Any) -> tuple[Newton, ro.convex.Program]:
    program = ro.convex.pose(stated(name, over), MODEL)
    assert program.separated is not None
    return Newton(program.separated, program.coordinates, weight, **more), program


def value(method: Newton, point: Point, a: Array) -> float:
    """The smoothed objective at other coordinates, multipliers as they are."""
    r = method.at.rows @ a - method.at.b
    return smoothed_value(method.loss, r, *point.kinked[:2]) + float(method.pull @ a**2)


def slope_at(method: Newton, point: Point, a: Array) -> Array:
    r = method.at.rows @ a - method.at.b
    return method.slope(a, method.loss.smoothed(r, *point.kinked[:2]).slope)


@pytest.mark.parametrize(("name", "over"), CASES)
def test_the_objective_is_the_programs(name: str, over: str) -> None:
    method, program = made(name, over)
    assert method.objective(Z) == pytest.approx(program.objective(Z, 0.7), rel=1e-10)
    point = method._placed(Z, None)
    ended = method._judged(point, method._slope(point), 0)
    assert ended.objective == pytest.approx(program.objective(Z, 0.7), rel=1e-10)


@pytest.mark.parametrize(("name", "over"), CASES)
def test_slope_and_second_derivative_are_those_of_the_smoothed_objective(name: str, over: str) -> None:
    method, _ = made(name, over)
    point = method._placed(Z, None)
    h = 1e-6 * method.unit
    steps = np.diag(h)
    slope = [(value(method, point, point.a + d) - value(method, point, point.a - d)) / 2e-6 for d in steps]
    assert method._slope(point) == pytest.approx(slope, rel=1e-5, abs=1e-6 * np.max(np.abs(slope)))
    ahead = [slope_at(method, point, point.a + d) - slope_at(method, point, point.a - d) for d in steps]
    bend = np.array(ahead) / 2e-6
    H = method._whole(method._hessian(point))
    assert pytest.approx(bend, rel=1e-3, abs=1e-4 * np.max(np.abs(bend))) == H


@pytest.mark.parametrize(("name", "over"), SMOOTH)
def test_of_groups_that_say_the_same_some_tell_the_second_derivative(name: str, over: str) -> None:
    """Every configuration, or equation, three times: one of three is all that there is to know."""
    each = 3 if over == "configuration" else 1
    A, b = (
        np.repeat(M.reshape(-1, each, *M.shape[1:]), 3, axis=0).reshape(-1, *M.shape[1:]) for M in (MODEL.A, MODEL.b)
    )
    thrice = replace(MODEL, A=A, b=b, group=np.arange(len(b)) // each)
    program = ro.convex.pose(stated(name, over), thrice)
    assert program.separated is not None
    method = Newton(program.separated, program.coordinates, 0.7)
    point = method._placed(Z, None)
    whole = method._hessian(point)
    assert method._hessian(point, 3) == pytest.approx(whole, rel=1e-10, abs=1e-10 * np.max(np.abs(whole)))
    assert method._hessian(point, 2) != pytest.approx(whole, rel=1e-3)


@pytest.mark.parametrize(("name", "over"), SMOOTH)
@pytest.mark.parametrize("weight", [0.0, 0.7, 40.0])
def test_an_update_explains_how_the_slope_has_changed(name: str, over: str, weight: float) -> None:
    method, _ = made(name, over, weight)
    before, after = (method._placed(z, None) for z in (Z, 0.8 * Z + 0.1))
    change = method._slope(after) - method._slope(before)
    bent = method._hessian(before)
    updated = method._updated(bent, before, after, change)
    step = after.a - before.a
    assert method.unit * (updated @ step + 2 * method.pull * step) == pytest.approx(change, rel=1e-9, abs=1e-9)
    assert updated == pytest.approx(updated.T, rel=1e-9, abs=1e-12)
    assert np.linalg.eigvalsh(updated)[0] > -1e-9 * np.max(np.abs(updated))
    rest = np.linalg.qr(np.column_stack([step, bent @ step]))[0]
    other = RNG.normal(size=len(step))
    other -= rest @ (rest.T @ other)
    along = change / method.unit - 2 * method.pull * step
    other -= (other @ along) / (along @ along) * along
    other -= rest @ (rest.T @ other)
    if abs(other @ along) < 1e-9 * np.linalg.norm(other) * np.linalg.norm(along):
        assert updated @ other == pytest.approx(bent @ other, rel=1e-9, abs=1e-9)
    assert method._updated(bent, before, before, 0 * change) is bent
    assert method._updated(bent, before, after, -change - 1e3 * method.unit * step) is bent


@pytest.mark.parametrize(("name", "over"), SMOOTH)
def test_another_weight_begins_where_the_last_ended(name: str, over: str) -> None:
    """Of the same rows, nothing is computed again; and what is said there is what is true there."""
    first, _ = made(name, over)
    ended = first._by_secants(first._placed(Z, None))
    begun = replace(first, weight=0.2)._begin(ended.z, ended.kinked)
    again = first._placed(ended.z, ended.kinked)
    assert begun.along is not None
    assert begun.r == pytest.approx(again.r, rel=1e-9, abs=1e-9)
    of_loss = again.smooth.slope
    assert begun.along == pytest.approx(first.at.rows.T @ of_loss, abs=1e-8 * np.abs(of_loss).sum())
    assert begun.kinked.curved is ended.kinked.curved
    for other in (replace(first, loss=replace(first.loss)), replace(first, at=replace(first.at))):
        assert other._begin(ended.z, ended.kinked).along is None
    assert first._begin(ended.z.copy(), ended.kinked).along is None


@pytest.mark.parametrize(("name", "over"), SMOOTH)
def test_a_second_derivative_that_promises_nothing_finite_is_computed_anew(
    name: str, over: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rounding may leave a neighbour's without a Cholesky factor: no step with it is taken for a good one."""
    monkeypatch.setattr(newton, "DEAR", 0)
    method, _ = made(name, over)
    upside_down = Kinked([], 1.0, -np.eye(N))
    point = method._placed(Z, upside_down)
    bent = method._known(point)
    assert bent is not None
    assert method._promised(method._slope(point), 1e6 * bent) == np.inf
    found = method.minimum(Z, upside_down._replace(curved=-1e6 * np.eye(N)))
    assert found.good
    assert found.steps <= method.minimum(Z).steps + 1


@pytest.mark.parametrize("box", [None, BOX])
@pytest.mark.parametrize(("name", "over"), SMOOTH)
def test_from_far_away_the_residual_is_that_of_the_point(name: str, over: str, box: tuple[Array, Array] | None) -> None:
    """Sums of steps would keep the rounding of the first: the gap were that of other data."""
    wide = None if box is None else (1e12 * box[0], 1e12 * box[1])
    method, _ = made(name, over, box=wide)
    ended = method.minimum(1e10 * Z)
    assert ended.good
    assert ended.objective == pytest.approx(method.objective(ended.z), rel=1e-12)
    assert ended.objective == pytest.approx(method.minimum(Z).objective, rel=1e-10)


@pytest.mark.parametrize(("name", "over"), SMOOTH)
def test_what_is_promised_is_what_a_quadratic_would_give(name: str, over: str) -> None:
    method, _ = made(name, over)
    point = method._placed(Z, None)
    slope, bent = method._slope(point), method._hessian(point)
    H = method._whole(bent)
    expected = 0.5 * slope @ np.linalg.solve(H, slope)
    assert method._promised(slope, bent) == pytest.approx(expected, rel=1e-9)
    assert method._promised(slope, -bent) == np.inf
    boxed, _ = made(name, over, box=BOX)
    assert boxed._promised(slope, bent) == np.inf


@pytest.mark.parametrize("box", [None, BOX])
def test_of_squares_one_step_is_the_minimum(box: Any) -> None:
    """A Huber loss so far out that all residuals are squared, from anywhere, to the least in the box."""
    constraints = ()
    if box is not None:
        constraints = (ro.constraints.Box("box", lambda p: BOX),)
    wide = ro.Formulation("wide", loss=ro.huber(1e7), penalty=ro.tikhonov.penalty, loss_over="equation")
    program = ro.convex.pose(wide, MODEL)
    squares = ro.convex.pose(ro.Formulation("squares", penalty=ro.tikhonov.penalty, constraints=constraints), MODEL)
    assert program.separated is not None
    method = Newton(program.separated, program.coordinates, 0.7, box)
    point = method._placed(Z, None)
    ahead = method._stepped(point, method._slope(point), method._hessian(point))
    best = squares.solve(0.7)
    assert program.objective(ahead.z, 0.7) == pytest.approx(best.objective, rel=1e-9)
    assert ahead.z == pytest.approx(best.z, abs=1e-6)
    if box is not None:
        assert (ahead.z >= BOX[0]).all()
        assert (ahead.z <= BOX[1]).all()


def test_a_second_derivative_that_is_slightly_indefinite_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a millionth of the largest: the step goes where that leads."""
    steps: list[Array] = []
    monkeypatch.setattr(Newton, "_searched", lambda self, point, z, step: steps.append(step))
    method, _ = made("huber", "equation", 0.7)
    point = method._placed(Z, None)
    slope = method._slope(point)
    V = np.linalg.qr(RNG.normal(size=(len(slope), len(slope))))[0]
    for size in (1e-2, 1.0, 1e3):
        curved = size * (V * np.r_[-1e-7, np.geomspace(0.1, 1.0, len(slope) - 1)]) @ V.T
        bent = (curved - np.diag(2 * method.pull * method.unit**2)) / np.outer(method.unit, method.unit)
        H = method._whole(bent)
        raised = H + 1e-6 * np.max(np.diag(H)) * np.eye(len(H))
        expected = -method.unit * np.linalg.solve(raised, slope)
        method._stepped(point, slope, bent)
        assert steps[-1] == pytest.approx(expected, rel=1e-4, abs=1e-6 * np.max(np.abs(expected)))


@pytest.mark.parametrize(("name", "over"), CASES)
def test_coordinates_say_all_that_data_and_penalty_see(name: str, over: str) -> None:
    """A penalty of fewer rows than unknowns leaves the others to the data alone."""
    method, program = made(name, over)
    at = method.at
    a = at.inverse @ (Z - at.offset)
    assert at.offset + at.B @ a == pytest.approx(Z, abs=1e-8)
    residual = (MODEL.A @ Z - MODEL.b)[program.order]
    assert at.rows @ a - at.b == pytest.approx(residual, rel=1e-8, abs=1e-8)
    assert at.penalized.all()
    assert at.lengths == pytest.approx(np.sum(at.rows**2, axis=0), rel=1e-12)


def test_what_no_penalty_sees_is_not_penalized() -> None:
    free = ro.Formulation("free", loss=ro.huber(1.0), penalty=lambda z: ro.tikhonov.penalty(z[3:] - 0.1))
    program = ro.convex.pose(free, MODEL)
    at = program.coordinates
    assert np.count_nonzero(~at.penalized) == 3
    L = np.eye(N)[3:]
    a = at.inverse @ (Z - at.offset)
    assert float(np.sum((L @ Z - 0.1) ** 2)) == pytest.approx(float(np.sum(a[at.penalized] ** 2)), rel=1e-9)
    assert np.abs(L @ at.B[:, ~at.penalized]).max() < 1e-9


def test_coordinates_without_some_rows_are_those_of_the_others() -> None:
    at = made("huber", "equation")[0].at
    kept = np.arange(len(at.b)) % 3 != 1
    less = at.of(kept)
    assert less.gram == pytest.approx(less.rows.T @ less.rows, rel=1e-9, abs=1e-9 * np.max(at.gram))
    assert not less.rows[~kept].any()
    assert not less.b[~kept].any()
    assert np.array_equal(less.rows[kept], at.rows[kept])
    assert less.lengths == pytest.approx(np.sum(less.rows**2, axis=0), rel=1e-9)
    assert at.rows[~kept].any()  # those that it came from stay


def many(name: str, over: str, monkeypatch: pytest.MonkeyPatch, model: LinearModel = MODEL) -> Coordinates:
    """The coordinates of so many equations that the product is dear."""
    with monkeypatch.context() as patched:
        patched.setattr(coordinates, "DEAR", 0)
        return ro.convex.pose(stated(name, over), model).coordinates


@pytest.mark.parametrize(("name", "over"), CASES)
def test_rows_that_are_dear_to_multiply_are_turned_instead(
    name: str, over: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    method, program = made(name, over)
    at, turned = method.at, many(name, over, monkeypatch)
    assert at.turn is None
    assert turned.turn is not None
    assert np.array_equal(turned.rows, MODEL.A[program.order])
    a, y = RNG.normal(size=len(at.lengths)), RNG.normal(size=len(at.b))
    assert turned.by_row(a) == pytest.approx(at.by_row(a), abs=1e-9 * np.abs(at.rows).max())
    assert turned.along(y) == pytest.approx(at.along(y), abs=1e-9 * np.abs(at.rows).max())
    assert turned.lengths == pytest.approx(at.lengths, rel=1e-7, abs=1e-9 * at.lengths.max())
    other = replace(method, at=turned)
    one, two = (each._hessian(each._placed(Z, None)) for each in (method, other))
    assert two == pytest.approx(one, rel=1e-7, abs=1e-9 * np.abs(one).max())
    assert other.minimum(Z).objective == pytest.approx(method.minimum(Z).objective, rel=1e-9)
    kept = np.arange(len(at.b)) % 3 != 1
    assert turned.of(kept).lengths == pytest.approx(at.of(kept).lengths, rel=1e-7, abs=1e-9 * at.lengths.max())


def test_what_data_do_not_see_adds_nothing_to_turned_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two columns that are the same, their difference: rounding would be taken for something seen."""
    twice = replace(MODEL, A=np.where(np.arange(N) == 1, MODEL.A[:, [0]], MODEL.A))
    at = many("huber", "equation", monkeypatch, twice)
    assert at.turn is not None
    unseen = np.flatnonzero(~at.turn.any(axis=0))
    assert len(unseen) == N - twice.rank > 0
    assert np.abs(twice.A @ at.B[:, unseen]).max() < 1e-9 * np.abs(twice.A).max()
    assert (at.lengths[unseen] == 0).all()


def test_rows_are_multiplied_where_turns_would_cost_digits_or_all_is_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    step = 1e-7 * RNG.normal(size=len(MODEL.b))
    alike = replace(MODEL, A=np.where(np.arange(N) == 1, MODEL.A[:, [0]] + step[:, None], MODEL.A))
    assert many("huber", "equation", monkeypatch, alike).turn is None
    monkeypatch.setattr(coordinates, "DEAR", 0)
    assert ro.convex.pose(ro.minimax, MODEL).coordinates.turn is None


def test_a_minimum_begins_at_that_of_the_nearest_weight() -> None:
    """And at the last one that was met; of too many the first goes."""

    def near(k: int) -> Near:
        return Near(np.full(1, float(k)), Kinked([], 1.0), np.empty(0), 0.0)

    met = Met()
    assert met.nearest(1.0) is None
    assert met.near(1.0) == []
    weights = (0.0, 1e-3, 1.0, 100.0, 1e4)
    for k, weight in enumerate(weights):
        met.keep(weight, near(k))
    found = {asked: met.nearest(asked) for asked in (0.0, 1e-4, 0.04, 20.0, 3e5)}
    assert {asked: each.z[0] for asked, each in found.items() if each} == {0.0: 0, 1e-4: 1, 0.04: 2, 20.0: 3, 3e5: 4}
    assert [each.z[0] for each in met.near(20.0)] == [3, 4]
    assert [each.z[0] for each in met.near(1e4)] == [4]
    for k in range(minima.MOST):
        met.keep(1e6 + k, near(k))
    kept = met.nearest(1e4)
    assert kept is not None
    assert kept.z[0] == 0  # that at 1e6: those before it are gone
    assert len(met._at) == minima.MOST


@pytest.mark.parametrize("weight", [0.0, 0.7])
@pytest.mark.parametrize("damped", [False, True])
def test_cones_are_solved_where_data_penalty_and_damping_are_about_the_identity(weight: float, damped: bool) -> None:
    """In u with z = T u + c: c is the least of all three, and their curvature is one in every direction."""
    stated = ro.Formulation("squares", penalty=lambda z: ro.tikhonov.penalty(2 * z - 0.3))
    program = ro.convex.pose(stated, MODEL)
    damping = None
    A, b = [MODEL.A, np.sqrt(weight) * 2 * np.eye(N)], [MODEL.b, np.sqrt(weight) * np.full(N, 0.3)]
    if damped:
        damping = Damping(0.1 * Z, np.geomspace(0.5, 3.0, N))
        A.append(np.diag(damping.size))
        b.append(damping.size * damping.centre)
    rows, right = np.vstack(A), np.concatenate(b)
    T, c = _whitened(program, weight, damping)
    assert rows @ T @ T.T @ rows.T @ rows == pytest.approx(rows, rel=1e-5, abs=1e-6 * np.max(np.abs(rows)))
    assert T.T @ rows.T @ rows @ T == pytest.approx(np.eye(N), abs=1e-5)
    assert c == pytest.approx(np.linalg.lstsq(rows, right)[0], rel=1e-5, abs=1e-6)


def test_directions_that_nothing_sees_stay_nominal() -> None:
    blind = replace(MODEL, A=MODEL.A * (np.arange(N) != 4))
    program = ro.convex.pose(ro.Formulation("squares", loss=ro.huber(1e7), loss_over="equation"), blind)
    T, c = _whitened(program, 0.0, None)
    assert np.abs(T[4]).max() < 1e-8
    assert abs(c[4]) < 1e-12
    penalized = ro.convex.pose(ro.tikhonov, blind)
    assert np.abs(_whitened(penalized, 0.7, None)[0][4]).max() > 0.1
