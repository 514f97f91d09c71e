"""Constraints, multipliers, polishing and conflicts, against methods that are not ours."""

from __future__ import annotations

import re

import cvxpy as cp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

import rpim_opt as ro
from rpim_opt.basics import NoSolutionFound
from rpim_opt.convex.formulation import FORMULATIONS
from rpim_opt.problem import LinearModel
from rpim_opt.robot import Parameters
from tests.simulate import simulated

VARIANTS = (
    None,
    "tolerances",
    "equal_links",
    "parallel_axes",
    "offsets",
    "certified_tool",
    "drawing",
    "everything",
    "wrong_tolerance",
)


def random_model(seed: int, condition: float, tolerance: float = 0.5, m: int = 81, n: int = 26) -> LinearModel:
    g = np.random.default_rng(seed)
    U, V = np.linalg.qr(g.normal(size=(m, n)))[0], np.linalg.qr(g.normal(size=(n, n)))[0]
    A = (U * np.geomspace(1, 1 / condition, n)) @ V.T
    b = A @ g.normal(size=n) + 1e-3 * g.normal(size=m)
    names = tuple(f"a{i}" for i in range(n))
    parameters = Parameters(
        names, ("length",) * n, np.zeros(n), np.ones(n), np.full(n, tolerance), np.ones(n, dtype=bool)
    )
    return LinearModel(A, b, np.arange(m) // 3, parameters)


@pytest.mark.parametrize("condition", [1e1, 1e4, 1e8, 1e12])
@pytest.mark.parametrize("weight", [1e-12, 1e-9, 1e-6, 1e-3, 1.0, 1e2])
def test_bounded_solutions_are_those_of_an_active_set_method(condition: float, weight: float) -> None:
    model = random_model(int(np.log10(condition)), condition)
    z = ro.convex.pose(ro.bounded, model).solve(weight).z
    A = np.vstack([model.A, np.sqrt(weight) * np.eye(26)])
    want = lsq_linear(A, np.append(model.b, np.zeros(26)), (-0.5, 0.5), method="bvls", tol=1e-15, max_iter=2000).x
    assert np.abs(z).max() <= 0.5
    assert np.count_nonzero(np.abs(want) == 0.5) > 0 or weight > 0.1
    assert np.abs(z - want).max() < 1e-8


def test_a_box_has_one_row_for_each_finite_side_and_one_for_an_equality() -> None:
    lower = np.array([-np.inf, -1.0, 0.5, -np.inf])
    upper = np.array([np.inf, 2.0, 0.5, 3.0])
    box = ro.constraints.Box("sides", lambda parameters: (lower, upper))
    z = cp.Variable(4)
    made = box(z, random_model(0, 1.0, n=4).parameters)
    assert sum(constraint.size for constraint in made) == 4  # two of the second, one of the third and of the fourth
    z.value = np.array([1e9, 0.0, 0.5, -1e9])
    assert all(constraint.value() for constraint in made)


def test_multipliers_are_the_slopes_of_the_optimum() -> None:
    model = random_model(3, 1e2)
    program = ro.convex.pose(ro.bounded, model)
    estimate, h = program.solve(1e-2), 1e-5
    multiplier = estimate.duals[0]
    held = np.flatnonzero(multiplier > 1e-6)
    assert len(held) > 3
    for i in held:
        values = []
        for step in (-h, h):
            tolerance = model.parameters.tolerance.copy()
            tolerance[i] += step
            p = model.parameters
            moved = Parameters(p.names, p.dimensions, p.nominal, p.scale, tolerance, p.identified)
            e = ro.convex.pose(ro.bounded, LinearModel(model.A, model.b, model.group, moved)).solve(1e-2)
            values.append(e.loss + 1e-2 * e.penalty)
        assert (values[0] - values[1]) / (2 * h) == pytest.approx(multiplier[i], rel=1e-5)


@pytest.mark.parametrize("variant", VARIANTS)
def test_constrained_calibrations_reproduce_their_reference(variant: str | None) -> None:
    instance = ro.load("constrained", variant)
    result = instance.calibrate()
    assert result.converged
    assert 1e3 * result.errors(instance.validation).mean() == pytest.approx(
        *instance.reference["validation_mm"][:1], abs=1e-4
    )
    values = dict(
        zip(result.problem.parameters.free.names, result.problem.parameters.free.values(result.x), strict=True)
    )
    if variant in ("equal_links", "everything"):
        assert values["a3"] == pytest.approx(values["d4"], abs=1e-10)
    if variant in ("parallel_axes", "everything"):
        assert max(abs(values["alpha3"]), abs(values["beta2"])) < 1e-15
    if variant == "wrong_tolerance":
        assert "Active bound: a5 at" in str(result)
        assert result.active_bounds[0].gain > 1
    else:
        assert all(h.gain < 0.01 for h in result.active_bounds)


def test_a_robust_loss_tells_what_a_tolerance_costs_too() -> None:
    problem, truth = simulated(("a[234]", "d5"), noise=3e-5, configurations=20)
    tight = problem.parameters.toleranced({"a3_mm": 0.5e3 * abs(truth[1]), "a2_mm": 50})
    held = ro.calibrate(
        ro.CalibrationProblem(problem.robot, tight, problem.data),
        ro.Formulation("both", ro.huber(), cp.sum_squares, (ro.within_tolerance,), "configuration"),
        1.0,
    ).active_bounds
    assert [h.name for h in held] == ["a3"]
    assert held[0].gain > 0.1


def test_what_is_known_helps() -> None:
    errors = {}
    for variant in (None, "equal_links", "parallel_axes"):
        instance = ro.load("constrained", variant)
        result = instance.calibrate()
        errors[variant] = result.errors(instance.validation).mean()
    assert errors["equal_links"] < errors[None]
    assert errors["parallel_axes"] < errors[None]


def test_signs_and_balls() -> None:
    model = random_model(5, 1e2)
    positive = ro.Formulation(
        "signed", penalty=cp.sum_squares, constraints=(ro.constraints.signed(1, "a?"), ro.constraints.signed(-1, "a1?"))
    )
    z = ro.convex.pose(positive, model).solve(1e-3).z
    assert (z[:10] >= 0).all()
    assert (z[10:20] <= 0).all()
    ball = ro.Formulation("ball", penalty=cp.sum_squares, constraints=(ro.in_ball(0.7, "a?"),))
    z = ro.convex.pose(ball, model).solve(1e-3).z
    assert np.linalg.norm(z[:10]) == pytest.approx(0.7, abs=1e-7)
    problem, _ = simulated(("a[23]", "alpha2"), configurations=10)
    with pytest.raises(ro.InputError, match=r"equal: found a2 \(length\), alpha2 \(angle\)"):
        ro.calibrate(problem, ro.Formulation("x", constraints=(ro.constraints.equal("a2", "alpha2"),)))
    for nothing in (ro.constraints.at_nominal(), ro.constraints.signed(1), ro.in_ball(1.0)):
        with pytest.raises(ro.InputError, match="found no pattern"):
            ro.convex.pose(ro.Formulation("x", constraints=(nothing,)), model)
    with pytest.raises(ro.InputError, match="at_nominal: found 'q'"):
        ro.convex.pose(ro.Formulation("x", constraints=(ro.constraints.at_nominal("q"),)), model)
    with pytest.raises(ro.InputError, match="equal: found 'a99'"):
        ro.convex.pose(ro.Formulation("x", constraints=(ro.constraints.equal("a1", "a99"),)), model)


def test_an_infeasible_program_says_what_contradicts_what() -> None:
    problem, truth = simulated(("a[234]", "d5"), noise=1e-5, configurations=12)
    tight = problem.parameters.toleranced({"a3_mm": 0.01 * abs(1e3 * truth[1])})
    narrow = ro.CalibrationProblem(problem.robot, tight, problem.data)
    longer = ro.constraints.parse(f"a3 = nominal {1e3 * truth[1]:+.6f} mm")
    limited = ro.Formulation("limited", penalty=cp.sum_squares, constraints=(ro.within_tolerance, longer))
    with pytest.raises(NoSolutionFound) as refused:
        ro.calibrate(narrow, limited, 1.0)
    assert re.search(r"; loosen a3 by \d\.\d+ mm; loosen 'a3 = nominal .* mm' by \d\.\d+ mm\.$", str(refused.value))
    assert set(refused.value.conflict.parameters) == {"a3"}
    assert 0 < refused.value.conflict.parameters["a3"] < abs(truth[1])


def test_a_program_that_another_solver_cannot_solve_is_said_to_be_beyond_that_solver() -> None:
    """Neither a larger weight nor looser constraints would help."""
    problem, _ = simulated(("a[234]", "d5"), noise=1e-5, configurations=12)
    boxed = ro.Formulation("boxed", penalty=cp.sum_squares, constraints=(lambda z, p: cp.abs(z) <= 0.5,))
    with pytest.raises(NoSolutionFound, match="beyond SCIPY, or beyond its accuracy: tighten its settings, or use CLA"):
        ro.calibrate(problem, boxed, 1.0, solver="SCIPY")


@pytest.mark.parametrize("name", list(FORMULATIONS))
def test_every_ready_formulation_calibrates(name: str) -> None:
    problem, _ = simulated(("a[234]", "theta[234]", "d5"), noise=5e-5, configurations=20)
    bounds = problem.parameters.toleranced({"length_mm": 5, "angle_mrad": 5})
    problem = ro.CalibrationProblem(problem.robot, bounds, problem.data)
    result = ro.calibrate(problem, FORMULATIONS[name], 1e-3)
    assert result.converged
    assert 1e3 * result.errors().mean() < 0.12
    assert result.certificate.step < 1e-5  # where the objective is flat, 1e-9 of it is a step of 1e-5
    assert result.certificate.decrease < 1e-9
    known = name not in ("lasso", "group_lasso", "minimax")
    assert all((row["std"] is not None) == known for row in result.parameter_rows())
    assert "mm after" in str(result)
    assert result.certificate.violation < 1e-9


def test_group_lasso_leaves_good_links_alone() -> None:
    problem, _ = simulated(("a[2345]", "theta[2345]", "d[2345]"), configurations=40)
    free = problem.parameters.free
    truth = np.where([name.endswith("3") for name in free.names], 2.0, 0.0) * free.scale
    y = problem.modelled(truth)[0] + 3e-5 * np.random.default_rng(1).normal(size=(40, 3))
    result = ro.calibrate(problem.on(ro.Dataset.of(problem.data.q, y, 3e-5)), ro.group_lasso, 60.0)
    z = result.x / free.scale
    third = np.array([name.endswith("3") for name in free.names])
    assert np.abs(z[third]).min() > 0.5
    assert np.abs(z[~third]).max() < 0.05


def test_total_variation_finds_one_scale_of_all_encoders() -> None:
    problem, _ = simulated(("ratio?",), configurations=30)
    free = problem.parameters.free
    truth = 0.5 * np.ones(6) * free.scale
    y = problem.modelled(truth)[0] + 1e-4 * np.random.default_rng(1).normal(size=(30, 3))
    smooth = ro.Formulation("one scale", penalty=cp.sum, penalty_over=ro.constraints.differences("ratio?"))
    data = ro.Dataset.of(problem.data.q, y, 1e-4)
    error = [
        np.abs(ro.calibrate(problem.on(data), f, w).x - truth).max()
        for f, w in ((smooth, 1e3), (ro.least_squares, 0.0))
    ]
    assert error[0] < 0.5 * error[1]


def test_norms_by_configuration_with_uneven_groups() -> None:
    model = random_model(2, 1e2)
    uneven = LinearModel(model.A, model.b, np.sort(np.random.default_rng(1).integers(0, 20, 81)), model.parameters)
    program = ro.convex.pose(ro.robust, uneven)
    estimate = program.solve(0.1)
    z = cp.Variable(26)
    r = uneven.A @ z - uneven.b
    norms = cp.hstack([cp.norm(r[np.flatnonzero(uneven.group == g)]) for g in np.unique(uneven.group)])
    direct = cp.Problem(cp.Minimize(cp.sum(cp.huber(norms, 2)) + 0.1 * cp.sum_squares(z)))
    direct.solve(solver=cp.CLARABEL)
    assert estimate.loss + 0.1 * estimate.penalty == pytest.approx(direct.value, rel=1e-7)


@pytest.mark.parametrize("size", [10.0, 30.0, 60.0])
def test_large_errors_converge_to_the_same_answer(size: float) -> None:
    # tens of millimetres and tens of milliradians on every link
    robot = ("alpha?", "a?", "theta?", "d?", "beta3", "tool_[xyz]")
    problem, truth = simulated(robot, noise=3e-5, seed=2, size=size)
    result = ro.calibrate(problem, ro.tikhonov, 1e-3, max_iterations=60)
    assert result.converged, result.message
    assert 1e3 * result.errors().mean() < 0.08
    near = ro.calibrate(problem, ro.tikhonov, 1e-3, start=truth, max_iterations=60)
    scale = problem.parameters.free.scale
    assert np.abs((result.x - near.x) / scale).max() < 1e-5


def test_damping_costs_nothing_where_full_steps_work() -> None:
    problem, _ = simulated(noise=3e-5)
    assert all(it.damping == 0 for it in ro.calibrate(problem, ro.tikhonov, 1.0).history)
