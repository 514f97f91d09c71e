"""Penalties with kinks, from CVXPY's expression to the minimum: recognised, brought apart, solved from face to face."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.convex.faces import Face, shrunk
from rpim_opt.convex.kinks import kinks
from rpim_opt.convex.objective import Damping
from rpim_opt.convex.selection import searched, weight_grid
from rpim_opt.convex.split import split
from rpim_opt.problem.linear import LinearModel
from tests.convex.test_formulation import model

N = 6
Penalty = Callable[[Any], Any]
PENALTIES: dict[str, Penalty] = {
    "absolute values": cp.norm1,
    "weighted absolute values": lambda z: cp.sum(cp.multiply(np.arange(1, z.size + 1), cp.abs(z - 0.1))),
    "elastic net": lambda z: 0.5 * cp.norm1(z) + 0.5 * cp.sum_squares(z),
    "one side dearer": lambda z: cp.sum(0.7 * cp.pos(z) + 0.3 * cp.neg(z)),
    "larger of two lines": lambda z: cp.sum(cp.maximum(z, -2 * z + 0.3)),
    "norms of parts": lambda z: cp.sum(cp.hstack([cp.norm(z[:2]), 2 * cp.norm(z[2:5]), cp.norm(z[5:])])),
    "norms of parts about a point": lambda z: cp.norm(3 * (z[:4] - 0.2)) + cp.norm1(z[4:]),
    "mixed norm": lambda z: cp.mixed_norm(cp.reshape(z, (z.size // 2, 2), order="C"), 2, 1),
    "total variation": lambda z: cp.tv(z) + cp.abs(z[0]),
    "some without price": lambda z: cp.norm1(z[: z.size // 2]),
    "squares of mixtures beside": lambda z: cp.norm1(z) + cp.sum_squares(np.tri(z.size) @ z - 0.2),
}
"""Sums of absolute values and norms of different unknowns."""
OTHERS: dict[str, Penalty] = {
    "largest": cp.norm_inf,
    "Huber": lambda z: cp.sum(cp.huber(z, 1)),
    "three lines": lambda z: cp.sum(cp.maximum(z, -z, 2 * z - 1)),
    "entropy": lambda z: cp.sum(cp.kl_div(z + 1, 1)),
    "largest eigenvalue": lambda z: cp.lambda_max(cp.diag(z)),
    "log-sum-exp": cp.log_sum_exp,
    "powers": lambda z: cp.sum(cp.power(cp.abs(z), 1.5)),
    "in a half-space": lambda z: cp.norm1(z) + cp.transforms.indicator([z[0] >= -9]),
    "sorted": lambda z: cp.sum_largest(cp.abs(z), 2),
}


@pytest.mark.parametrize("name", PENALTIES)
def test_a_sum_of_norms_is_recognised_as_the_function_that_it_is(name: str) -> None:
    z = cp.Variable(N)
    expression = PENALTIES[name](z)
    found = kinks(expression, z)
    assert found is not None
    rng = np.random.default_rng(0)
    for point in rng.normal(size=(5, N)):
        z.value = point
        assert found.value(point) == pytest.approx(float(expression.value), rel=1e-12)


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_no_sum_of_norms_is_left_to_the_cones(name: str) -> None:
    z = cp.Variable(N)
    assert kinks(OTHERS[name](z), z) is None


def test_norms_that_share_unknowns_are_left_to_the_cones() -> None:
    z = cp.Variable(N)
    sparse_groups = kinks(cp.norm1(z) + cp.norm(z[:3]), z)
    assert sparse_groups is not None
    assert split(sparse_groups) is None
    dependent = kinks(cp.norm(z[0] - z[1]) + cp.norm(z[1] - z[2]) + cp.norm(z[2] - z[0]), z)
    assert dependent is not None
    assert split(dependent) is None


def whitened(rows: int = 60, condition: float = 30.0) -> LinearModel:
    """A random model with noise of about one sigma."""
    return model(rows=rows, condition=condition).scaled(np.full(rows, 100.0))


def doubled() -> LinearModel:
    """One whose last four columns are the first four again."""
    tall = whitened()
    return replace(tall, A=np.hstack([tall.A[:, :8], tall.A[:, :4]]))


def short() -> LinearModel:
    """One of fewer equations than unknowns."""
    tall = whitened()
    return replace(tall, A=tall.A[:9], b=tall.b[:9], group=tall.group[:9])


MODELS = {"tall": whitened(), "weak": whitened(condition=1e6), "doubled": doubled(), "short": short()}


def above(program: ro.convex.Program, z: np.ndarray, weight: float, **solver: Any) -> float:
    """Return by how much z's objective is above that of the written problem's solution, relative."""
    settings = {"tol_gap_abs": 1e-13, "tol_gap_rel": 1e-13, "tol_feas": 1e-13}
    written = program.problem(weight)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it goes on as long as it can
        written.solve(solver=cp.CLARABEL, **settings)
    [v] = [v for v in written.variables() if v.name() == "z"]
    there = program.objective(np.asarray(v.value), weight)
    return (program.objective(z, weight) - there) / there


@pytest.mark.parametrize("name", PENALTIES)
@pytest.mark.parametrize("kind", MODELS)
def test_a_minimum_is_that_of_the_written_problem(name: str, kind: str) -> None:
    program = ro.convex.pose(ro.Formulation(name, penalty=PENALTIES[name]), MODELS[kind])
    faces = program.faces
    assert faces is not None
    largest = faces.largest() or 1.0
    for estimate in program.path(largest * np.array([0.5, 1e-2, 1e-4, 1e-6])):
        assert estimate.iterations == 0  # no cones were asked
        assert above(program, estimate.z, estimate.weight) <= 1e-8
        assert estimate.objective == pytest.approx(program.objective(estimate.z, estimate.weight), rel=1e-10)
        alone = program.solve(estimate.weight)
        assert alone.objective == pytest.approx(estimate.objective, rel=1e-9)


def box(low: float, high: float) -> Any:
    return ro.constraints.Box("box", lambda p: (np.full(len(p), low), np.full(len(p), high)))


@pytest.mark.parametrize("name", ["absolute values", "elastic net", "one side dearer", "some without price"])
@pytest.mark.parametrize(("low", "high"), [(-0.1, 0.1), (0.05, 0.2), (-np.inf, 0.0)])
def test_so_it_is_in_a_box(name: str, low: float, high: float) -> None:
    stated = ro.Formulation(name, penalty=PENALTIES[name], constraints=(box(low, high),))
    for m in (MODELS["tall"], MODELS["doubled"]):
        program = ro.convex.pose(stated, m)
        assert program.faces is not None
        for weight in (1e-1, 30.0):
            estimate = program.solve(weight)
            assert estimate.iterations == 0
            assert (estimate.z >= low).all()
            assert (estimate.z <= high).all()
            assert above(program, estimate.z, weight) <= 1e-8
            [held] = estimate.duals
            if high == 0:
                continue  # at a kink that is a bound, what holds is not told apart
            [other] = program.solve(weight, solver="CLARABEL").duals
            assert held == pytest.approx(other, abs=1e-3 * max(1.0, float(np.max(held))))


def test_a_box_of_a_groups_members_is_left_to_the_cones() -> None:
    stated = ro.Formulation("groups", penalty=PENALTIES["norms of parts"], constraints=(box(-0.1, 0.1),))
    program = ro.convex.pose(stated, MODELS["tall"])
    assert program.faces is None
    estimate = program.solve(1.0)
    assert estimate.iterations > 0
    assert above(program, estimate.z, 1.0) <= 1e-6


@pytest.mark.parametrize("name", ["position", "paper_arm", "rank_deficient", "markers", "seven_axis"])
@pytest.mark.parametrize("formulation", [ro.lasso, ro.group_lasso])
def test_paths_of_shipped_problems_are_certified(name: str, formulation: ro.Formulation) -> None:
    """Over nine decades of weights, each point by its gap: nothing is asked of another solver."""
    problem = ro.load(name).problem
    program = ro.convex.pose(formulation, problem.linearize(np.zeros(len(problem.parameters.free))))
    faces = program.faces
    assert faces is not None
    largest = faces.largest()
    assert largest is not None
    y = None
    for weight in largest * np.geomspace(2.0, 1e-9, 40):
        face = faces.minimum(weight, y)
        assert face.certain, weight
        y = face.y


def test_a_gap_tells_what_is_missing() -> None:
    program = ro.convex.pose(ro.lasso, MODELS["tall"])
    faces = program.faces
    assert faces is not None
    best = faces.minimum(1.0)
    rng = np.random.default_rng(1)
    for size in (1e-6, 1e-3, 1.0):
        y = best.y + size * rng.normal(size=len(best.y))
        missing = faces.value(y, 1.0) - best.value
        assert faces.gap(y, faces.slope(y, 1.0), 1.0) >= missing - 1e-13 * best.value


def test_from_the_largest_weight_on_nothing_is_left() -> None:
    for stated in (ro.lasso, replace(ro.group_lasso, penalty_over=lambda p: np.split(np.eye(12), 4))):
        program = ro.convex.pose(stated, MODELS["tall"])
        faces = program.faces
        assert faces is not None
        largest = faces.largest()
        assert largest is not None
        assert not program.solve(largest * (1 + 1e-9)).z.any()
        assert program.solve(largest * (1 - 1e-6)).z.any()
        grid = weight_grid(program, 20)
        assert grid[-1] == pytest.approx(largest, rel=1e-12)
        assert 1e-9 * largest <= grid[0] <= 1e-6 * largest * (1 + 1e-12)
    slope = np.abs(2 * MODELS["tall"].A.T @ MODELS["tall"].b)
    lasso = ro.convex.pose(ro.lasso, MODELS["tall"]).faces
    assert lasso is not None
    assert lasso.largest() == pytest.approx(slope.max(), rel=1e-12)


def test_damping_holds_on_faces_too() -> None:
    program = ro.convex.pose(ro.lasso, MODELS["tall"])
    damping = Damping(np.linspace(-0.2, 0.2, 12), np.geomspace(0.5, 3.0, 12))

    def objective(z: np.ndarray) -> float:
        return program.objective(z, 0.7) + float(np.sum((damping.size * (z - damping.centre)) ** 2))

    ours = program.solve(0.7, damping=damping)
    theirs = program.solve(0.7, damping=damping, solver="CLARABEL", settings={"tol_gap_rel": 1e-12})
    assert objective(ours.z) <= objective(theirs.z) * (1 + 1e-8)


def test_an_uncertain_minimum_is_the_cones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no face's gap closes, the interior point is asked, and the lower of both is the answer."""
    program = ro.convex.pose(ro.lasso, MODELS["tall"])
    want = program.solve(0.7)
    monkeypatch.setattr(Face, "certain", False)
    found = program.solve(0.7)
    assert found.iterations > 0
    assert found.objective == pytest.approx(want.objective, rel=1e-8)


@pytest.mark.parametrize("price", [0.1, 3.0, 30.0])
def test_a_shrunk_group_is_where_its_slope_vanishes(price: float) -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(3, 5))  # two directions without curvature
    K, c = root.T @ root, 5 * rng.normal(size=5)
    c = K @ c  # the data see what pulls
    v = shrunk(K, c, price)
    if np.linalg.norm(c) <= price:
        assert not v.any()
    else:
        slope = K @ v + c + price * v / np.linalg.norm(v)
        assert slope == pytest.approx(np.zeros(5), abs=1e-10 * np.linalg.norm(c))


def test_a_search_refines_where_the_score_is_least() -> None:
    asked: list[float] = []

    def score(weights: np.ndarray, at: float) -> np.ndarray:
        asked.extend(weights)
        return 1 + np.abs(np.log(weights / at))

    weights, found, best = searched(partial(score, at=0.37), np.geomspace(1e-4, 1e4, 9))
    assert abs(np.log(weights[best] / 0.37)) < 0.1
    assert (np.diff(weights) > 0).all()
    assert sorted(asked) == pytest.approx(weights)
    assert found[best] == found.min()
    edge = searched(partial(score, at=1e6), np.geomspace(1e-4, 1e4, 9))
    assert (len(edge[0]), edge[2]) == (9, 8)
    flat = searched(lambda w: np.ones(len(w)), np.geomspace(1e-4, 1e4, 9))
    assert len(flat[0]) == 9
