"""One mechanism: every combination of loss, penalty and constraints is solved as plain CVXPY solves it."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

import rpim_opt as ro
from rpim_opt.convex.formulation import FORMULATIONS
from rpim_opt.convex.program import Damping
from rpim_opt.convex.select import SELECTORS
from tests.convex.plain import objective_at, plain, violation
from tests.simulate import simulated

EQUAL, MISSED = 1e-7, 1e-7
"""Largest relative difference of objectives, and violation: ten times an interior point's default accuracy."""


def smooth_hinge(r: Any) -> Any:
    return cp.sum(cp.square(cp.pos(cp.abs(r) - 0.5)))


def quantile(r: Any) -> Any:
    return cp.sum(cp.maximum(0.9 * r, -0.1 * r))


def tail(r: Any) -> Any:
    threshold = cp.Variable()
    return threshold + cp.sum(cp.pos(cp.abs(r) - threshold)) / (0.1 * r.size)


def pseudo_huber(r: Any) -> Any:
    return cp.sum(cp.norm(cp.vstack([r, np.ones(r.size)]), 2, axis=0))


LOSSES: dict[str, dict[str, Any]] = {
    "squares": {},
    "weighed squares": {"loss": lambda r: cp.sum_squares(cp.multiply(np.linspace(1, 2, r.size), r))},
    "huber": {"loss": ro.huber(1.5)},
    "huber of norms": {"loss": ro.huber(2.0), "loss_over": "configuration"},
    "sum of norms": {"loss": cp.sum, "loss_over": "configuration"},
    "absolute": {"loss": cp.norm1},
    "quantile": {"loss": quantile},
    "logistic": {"loss": lambda r: cp.sum(cp.logistic(r) + cp.logistic(-r))},
    "insensitive": {"loss": lambda r: cp.sum(cp.pos(cp.abs(r) - 0.5))},
    "smooth hinge": {"loss": smooth_hinge},
    "fourth power": {"loss": lambda r: cp.sum(cp.power(r / 3, 4))},
    "pseudo-huber": {"loss": pseudo_huber},
    "minimax": {"loss": cp.max, "loss_over": "configuration"},
    "largest three": {"loss": lambda v: cp.sum_largest(v, 3), "loss_over": "configuration"},
    "tail": {"loss": tail},
}
PENALTIES: dict[str, Any] = {
    "squares": cp.sum_squares,
    "norm1": cp.norm1,
    "groups": lambda z: cp.sum(cp.hstack([cp.norm(z[k : k + 3]) for k in range(0, z.size - 2, 3)])),
    "elastic net": lambda z: cp.sum_squares(z) + cp.norm1(z),
}


def own_slacks(z: Any, _: Any) -> list[Any]:
    s = cp.Variable(z.size, nonneg=True)
    return [z <= 0.2 + s, cp.sum(s) <= 1]


def own_bounds(z: Any, _: Any) -> list[Any]:
    t = cp.Variable(z.size)
    return [cp.abs(z) <= t, cp.sum(t) <= 4, t <= 0.5]


def matrix_inequality(z: Any, _: Any) -> Any:
    S = cp.Variable((3, 3), symmetric=True)
    return [cp.diag(S) == z[:3] + 1, S[0, 1] == z[3], S[0, 2] == z[4], S[1, 2] == z[5], S >> 0]


CONSTRAINTS: dict[str, tuple[Any, ...]] = {
    "none": (),
    "tolerance": (ro.constraints.Box("half a scale", lambda p: (np.full(len(p), -0.5), np.full(len(p), 0.5))),),
    "inequality": (lambda z, _: cp.sum(z) <= 0.5,),
    "ball": (ro.in_ball(1.0, "*"),),
    "matrix inequality": (matrix_inequality,),
    "own slacks": (own_slacks,),
    "own bounds": (own_bounds,),
}
PROBLEMS = ("position", "paper_arm", "rank_deficient")
EVERY = [(a, b, c) for a in LOSSES for b in PENALTIES for c in CONSTRAINTS]


@lru_cache
def model_of(name: str) -> ro.problem.LinearModel:
    problem = ro.load(name).problem
    return problem.linearize(np.zeros(len(problem.parameters.free)))


def checked(loss: str, penalty: str, constraints: str, name: str, weight: float) -> None:
    mine = ro.Formulation("mine", penalty=PENALTIES[penalty], constraints=CONSTRAINTS[constraints], **LOSSES[loss])
    model = model_of(name)
    z = ro.convex.pose(mine, model).solve(weight).z
    best = plain(mine, model, weight)
    assert objective_at(mine, model, weight, z) <= best.objective + best.gained + EQUAL * max(1.0, abs(best.objective))
    assert violation(mine, model, z) <= MISSED * (1 + float(np.abs(z).max()))


@pytest.mark.parametrize(("loss", "penalty", "constraints"), EVERY[::7])
def test_a_minimum_is_that_of_plain_cvxpy(loss: str, penalty: str, constraints: str) -> None:
    k = EVERY.index((loss, penalty, constraints))
    checked(loss, penalty, constraints, PROBLEMS[k % 3], (1e-2, 1.0, 1e2)[k % 2 + k // 7 % 2])


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize(("loss", "penalty", "constraints"), EVERY)
def test_every_minimum_is_that_of_plain_cvxpy(loss: str, penalty: str, constraints: str, name: str) -> None:
    try:
        checked(loss, penalty, constraints, name, 1.0)
    except AssertionError as error:
        if "plain CVXPY has no answer" not in str(error):
            raise
        pytest.skip("plain CVXPY does not solve it in any of five ways")


@pytest.mark.parametrize("loss", ["absolute", "quantile", "insensitive", "sum of norms", "minimax"])
def test_kinks_of_many_rows_are_those_of_all_rows_in_one_program(monkeypatch: pytest.MonkeyPatch, loss: str) -> None:
    """From 400 entries on the loss is smoothed, and only rows near a non-smooth point are taken as they are."""
    problem, _ = simulated(configurations=500, noise=1e-4, seed=3)
    model = problem.linearize(np.zeros(34))
    mine = ro.Formulation("mine", penalty=cp.norm1, **LOSSES[loss])
    many = ro.convex.pose(mine, model)
    found = [many.solve(weight).z for weight in (1.0, 100.0, 10.0)]  # the later ones start warm
    monkeypatch.setattr("rpim_opt.convex.solvers.solve.FEW_ENTRIES", 10_000)
    one = ro.convex.pose(mine, model)
    for z, weight in zip(found, (1.0, 100.0, 10.0), strict=True):
        least = one.objective(one.solve(weight).z, weight)
        assert one.objective(z, weight) == pytest.approx(least, rel=EQUAL)


def test_norms_that_are_far_from_zero_do_not_stay_smoothed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Smoothing adds to every norm: with none near zero a fit ended 2e-6 above its minimum."""
    problem, _ = simulated(configurations=500, noise=1e-4, seed=3)
    model = problem.linearize(np.zeros(34))
    turns = np.random.default_rng(0).normal(size=(500, 3))
    far = replace(model, b=model.b + 100 * (turns / np.linalg.norm(turns, axis=1)[:, None]).ravel())
    mine = ro.Formulation("mine", penalty=cp.sum_squares, **LOSSES["sum of norms"])
    found = ro.convex.pose(mine, far).solve(1.0).z
    monkeypatch.setattr("rpim_opt.convex.solvers.solve.FEW_ENTRIES", 10_000)
    one = ro.convex.pose(mine, far)
    assert one.objective(found, 1.0) == pytest.approx(one.objective(one.solve(1.0).z, 1.0), rel=EQUAL)


def test_a_quantile_of_redundant_parameters_is_not_wrong_in_silence() -> None:
    """Rounding in directions that the data do not see once left it 5e-3 above the minimum."""
    for weight in (1e-4, 1.0):
        checked("quantile", "squares", "none", "rank_deficient", weight)


@pytest.mark.parametrize(
    ("loss", "penalty", "constraints", "weight"),
    [
        ("fourth power", "norm1", "own slacks", 1e-8),
        ("pseudo-huber", "groups", "none", 1e-8),
        ("weighed squares", "groups", "tolerance", 1e-3),
    ],
)
def test_hardly_identified_parameters_do_not_end_an_iteration_too_early(
    loss: str, penalty: str, constraints: str, weight: float
) -> None:
    checked(loss, penalty, constraints, "rank_deficient", weight)


@pytest.mark.parametrize("seed", range(8))
def test_a_box_is_that_of_an_active_set_method(seed: int) -> None:
    """Against scipy.optimize.lsq_linear (bvls): well posed, few equations, and redundant columns."""
    rng = np.random.default_rng(seed)
    model = model_of("paper_arm")
    n = model.A.shape[1]
    lower, upper = -rng.exponential(0.5, n), rng.exponential(0.5, n)
    box = ro.constraints.Box("box", lambda _: (lower, upper))
    program = ro.convex.pose(ro.Formulation("mine", penalty=cp.sum_squares, constraints=(box,)), model)
    for weight in np.geomspace(1e-4, 1e4, 5):
        estimate = program.solve(float(weight))
        A = np.vstack([model.A, np.sqrt(weight) * np.eye(n)])
        b = np.concatenate([model.b, np.zeros(n)])
        best = lsq_linear(A, b, (lower, upper), method="bvls", tol=1e-14)
        assert estimate.objective <= 2 * best.cost * (1 + 1e-11)
        assert (estimate.z >= lower - 1e-12).all()
        assert (estimate.z <= upper + 1e-12).all()
        slope = 2 * A.T @ (A @ estimate.z - b)
        size = 1e-6 * np.abs(slope).max()
        assert estimate.duals[0] == pytest.approx(np.abs(slope) * (np.abs(slope) > size), abs=2 * size)


@pytest.mark.parametrize("loss", ["squares", "huber of norms", "absolute", "minimax"])
@pytest.mark.parametrize("constraints", ["tolerance", "inequality", "ball"])
def test_multipliers_say_what_loosening_a_constraint_gains(loss: str, constraints: str) -> None:
    """By central differences of the least objective."""
    loosened = {
        "tolerance": lambda by: ro.constraints.Box("b", lambda p: (np.full(len(p), -0.1), np.full(len(p), 0.1 + by))),
        "inequality": lambda by: lambda z, _: cp.sum(z) <= -1.0 + by,
        "ball": lambda by: lambda z, _: cp.norm(z) <= 0.5 + by,
    }[constraints]

    def solved(by: float) -> Any:
        mine = ro.Formulation("mine", penalty=cp.sum_squares, constraints=(loosened(by),), **LOSSES[loss])
        return ro.convex.pose(mine, model_of("position")).solve(1.0)

    by = 1e-3
    gained = (solved(-by).objective - solved(by).objective) / (2 * by)
    at = solved(0.0)
    multiplier = at.duals[0]
    if constraints == "tolerance":
        multiplier = multiplier[at.z > 0]
    assert np.sum(multiplier) == pytest.approx(gained, rel=2e-2)


@pytest.mark.parametrize("loss", ["squares", "huber", "absolute", "minimax", "tail"])
def test_damping_is_a_term_of_the_objective(loss: str) -> None:
    model = model_of("position")
    rng = np.random.default_rng(4)
    size, centre = rng.exponential(3.0, 34), rng.normal(size=34)
    mine = ro.Formulation("mine", penalty=cp.norm1, **LOSSES[loss])
    damped = ro.Formulation("d", penalty=lambda z: cp.norm1(z) + cp.sum_squares(cp.multiply(size, z - centre)),
                            **LOSSES[loss])  # fmt: skip
    ours = ro.convex.pose(mine, model).solve(1.0, damping=Damping(centre, np.diag(size))).z
    best = ro.convex.pose(damped, model).solve(1.0)
    assert ro.convex.pose(damped, model).objective(ours, 1.0) == pytest.approx(best.objective, rel=1e-7)


@pytest.mark.parametrize("loss", list(LOSSES))
def test_where_a_path_begins_changes_nothing(loss: str) -> None:
    mine = ro.Formulation("mine", penalty=cp.sum_squares, **LOSSES[loss])
    weights = np.geomspace(1e-2, 1e3, 6)
    along = ro.convex.pose(mine, model_of("position")).path(weights)
    for weight, estimate in zip(weights, along, strict=True):
        alone = ro.convex.pose(mine, model_of("position")).solve(float(weight))
        assert estimate.objective == pytest.approx(alone.objective, rel=1e-7)


@pytest.mark.parametrize(
    ("loss", "over"),
    [
        (LOSSES["tail"]["loss"], "equation"),
        pytest.param(cp.max, "configuration", marks=pytest.mark.slow),
        (lambda r: 3 * cp.sum_largest(cp.abs(r), 40), "equation"),
        (lambda r: cp.sum_largest(cp.abs(r), 12.5), "equation"),
        (lambda r: 10 * cp.max(cp.multiply(np.linspace(1, 2, r.size), cp.abs(r))) / 3, "equation"),
        (lambda r: cp.norm(r, "inf") + 1.0, "equation"),
    ],
)
def test_some_rows_of_many_give_the_minimum_of_all(loss: Any, over: str) -> None:
    problem, _ = simulated(configurations=450, noise=1e-4, seed=3)
    model = problem.linearize(np.zeros(34))
    mine = ro.Formulation("mine", loss, cp.sum_squares, CONSTRAINTS["ball"], loss_over=over)
    for estimate in ro.convex.pose(mine, model).path([30.0, 1.0]):
        best = plain(mine, model, estimate.weight)
        assert estimate.objective == pytest.approx(best.objective, rel=1e-6)
        assert estimate.objective <= best.objective + 1e-7 * max(abs(best.objective), 1.0)


def test_loss_and_constraint_may_share_a_slack_on_many_rows() -> None:
    problem, _ = simulated(configurations=600, noise=1e-4, seed=1)
    slack = cp.Variable(nonneg=True)
    mine = ro.Formulation(
        "mine", lambda r: cp.sum(cp.huber(r, 1.5)) + 5 * slack, cp.sum_squares, (lambda z, p: cp.norm(z) <= 2 + slack,)
    )
    result = ro.calibrate(problem, mine, 1.0)
    assert result.converged, result.message


@pytest.mark.parametrize("formulation", ["robust", "sum_of_norms"])
@pytest.mark.parametrize("rule", ["reml", "l_curve", "corner", "gcv", "quasi_optimality"])
def test_storage_decides_nothing(formulation: str, rule: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same rows in one table, in two blocks and in seven that are never in memory together have the same result."""
    monkeypatch.setattr(ro.problem.PartitionedProblem, "gathered", lambda self: None)
    problem, _ = simulated(configurations=42, noise=1e-4, seed=1)
    data = problem.data
    whole = ro.calibrate(problem, formulation, rule)
    for count in (2, 7):
        blocks = [partial(data.take, rows) for rows in np.array_split(np.arange(42), count)]
        parted = ro.problem.PartitionedProblem(problem.robot, problem.parameters, data, blocks)
        found = ro.calibrate(parted, formulation, rule)
        assert found.converged
        assert whole.converged
        assert found.weight == pytest.approx(whole.weight, rel=1e-4)  # both end where an answer moves it by 1e-6
        assert found.z == pytest.approx(whole.z, abs=1e-5)


def calibrated(problem: Any, formulation: str, rule: str) -> ro.Calibration | None:
    """Return a calibration; None where the rule is refused."""
    try:
        return ro.calibrate(problem, formulation, rule)
    except ro.InputError:
        return None


@pytest.mark.slow
@pytest.mark.parametrize("formulation", [name for name in FORMULATIONS if name != "minimax"])
def test_neither_does_a_dask_cluster(formulation: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By every rule, but those that need the rows; they, and minimax, are refused where no memory has these."""
    monkeypatch.setattr(ro.problem.PartitionedProblem, "gathered", lambda self: None)
    problem, _ = simulated(configurations=42, noise=1e-4, seed=1)
    p = problem.parameters
    problem = problem.with_parameters(replace(p, tolerance=2 * p.scale))
    penalized = FORMULATIONS[formulation].penalty is not None
    blocks = [partial(problem.data.take, rows) for rows in np.array_split(np.arange(42), 3)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the cluster's own, of ports and event loops
        from distributed import Client, LocalCluster

        with (
            LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None) as cluster,
            Client(cluster) as client,
        ):

            def compute(task, each):
                return client.gather(client.map(task, list(each), pure=False))

            parted = ro.problem.PartitionedProblem(problem.robot, problem.parameters, problem.data, blocks, compute)
            for rule in SELECTORS if penalized else ("reml",):  # which nobody asks without a penalty
                whole, found = calibrated(problem, formulation, rule), calibrated(parted, formulation, rule)
                if whole is None or found is None:
                    assert found is None
                    assert whole is None or rule in ("leave_one_out", "k_fold", "two_step"), rule
                    continue
                searched = rule == "corner" and not whole.program.linear_penalty  # ends at an interval of 1 %
                searched |= rule == "l_curve" and formulation == "bounded"  # curvature jumps where a bound gets active
                assert found.weight == pytest.approx(whole.weight, rel=0.01 if searched else 1e-4), rule
                if searched:
                    whole = ro.calibrate(problem, formulation, found.weight)
                if np.abs(whole.z).max() < 1e3:  # without a penalty redundant parameters run away, where rounding wants
                    assert found.z == pytest.approx(whole.z, abs=1e-5), rule


@pytest.mark.slow
@pytest.mark.parametrize("rule", [ro.leave_one_out, ro.k_fold, ro.l_curve, ro.corner, ro.two_step])
@pytest.mark.parametrize(
    ("loss", "penalty", "constraints"),
    [("huber", "squares", "ball"), ("squares", "groups", "none"), ("tail", "squares", "none"),
     ("minimax", "squares", "tolerance"), ("absolute", "norm1", "inequality")],
)  # fmt: skip
def test_every_rule_serves_every_formulation(rule: Any, loss: str, penalty: str, constraints: str) -> None:
    problem, _ = simulated(configurations=14, noise=1e-4, seed=2)
    mine = ro.Formulation("mine", penalty=PENALTIES[penalty], constraints=CONSTRAINTS[constraints], **LOSSES[loss])
    program = ro.convex.pose(mine, problem.linearize(np.zeros(34)))
    chosen = rule(program)
    assert chosen.weight > 0
    assert np.isfinite(chosen.score).any()
