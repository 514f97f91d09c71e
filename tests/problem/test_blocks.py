"""Data in blocks: a source of linear models, whose rows are those of the whole."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics import threads
from rpim_opt.calibration import words
from rpim_opt.convex.robust_loss import QuadraticModel, inliers_of
from rpim_opt.problem import PartitionedProblem
from rpim_opt.problem import blocks as parts_module
from rpim_opt.problem.blocks import in_parts, whole_configurations


def thirds(problem: ro.CalibrationProblem) -> list[np.ndarray]:
    """Rows of three parts, whole configurations."""
    groups = np.array_split(np.unique(problem.data.configuration), 3)
    return [np.flatnonzero(np.isin(problem.data.configuration, group)) for group in groups]


def apart(problem: ro.CalibrationProblem, compute=map) -> PartitionedProblem:
    parts = [partial(problem.data.take, rows) for rows in thirds(problem)]
    return PartitionedProblem(problem.robot, problem.parameters, parts[0](), parts, compute)


@pytest.fixture(scope="module")
def whole() -> ro.CalibrationProblem:
    return ro.load("blunders").problem


@pytest.fixture
def too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with more equations than are kept in memory."""
    monkeypatch.setattr(PartitionedProblem, "gathered", lambda self: None)


def x_of(problem) -> np.ndarray:
    return 0.3 * problem.parameters.free.scale


def test_it_is_no_problem_in_memory_and_says_so(whole: ro.CalibrationProblem) -> None:
    problem = apart(whole)
    assert not isinstance(problem, ro.CalibrationProblem)
    with pytest.raises(ro.InputError, match="data in blocks"):
        problem.data  # noqa: B018
    with pytest.raises(ro.InputError, match="parts: found none"):
        PartitionedProblem(whole.robot, whole.parameters, whole.data, ())


def test_rows_are_those_of_the_whole(whole: ro.CalibrationProblem) -> None:
    problem, x = apart(whole), x_of(whole)
    order = np.concatenate(thirds(whole))
    rows = list(problem.rows())
    assert sum(len(part.data) for part in rows) == len(order) == len(whole.data)
    configurations = [set(part.data.configuration) for part in rows]
    assert len(set().union(*configurations)) == sum(map(len, configurations))
    assert [label.partition(":")[2] for label in problem.labels] == [whole.labels[i] for i in order]
    assert [label for part in rows for label in part.labels] == list(problem.labels)
    assert [label.partition(":")[0] for label in problem.labels] == sorted(label[0] for label in problem.labels)
    np.testing.assert_allclose(problem.errors(x), whole.errors(x)[order], rtol=1e-12)
    for there, here in zip(whole.whitened_errors(x), problem.whitened_errors(x), strict=True):
        np.testing.assert_allclose(here, there[order], rtol=1e-12)
    for there, here in zip(whole.configuration_errors(x), problem.configuration_errors(x), strict=True):
        np.testing.assert_allclose(here, there, rtol=1e-12)


@pytest.mark.parametrize("name", ["markers", "pose", "mixed"])
def test_errors_of_several_kinds(name: str) -> None:
    problem = ro.load(name).problem
    x = x_of(problem)
    for dimension in ("length", "angle"):
        there, here = problem.errors(x, dimension), apart(problem).errors(x, dimension)
        np.testing.assert_allclose(np.sort(here), np.sort(there), rtol=1e-12)


@pytest.mark.usefixtures("too_many")
def test_flags_come_from_all_parts_and_are_dropped_in_all(whole: ro.CalibrationProblem) -> None:
    there = ro.calibrate(whole, ro.robust, 1.0)
    here = ro.calibrate(apart(whole), ro.robust, 1.0)
    flagged = [flag.label.partition(":") for flag in here.flagged]
    assert [label for _, _, label in flagged] == [flag.label for flag in there.flagged]
    assert len({part for part, _, _ in flagged}) > 1
    again = here.without_flagged()
    assert len(again.problem.labels) == len(whole.labels) - len(flagged)
    assert set(again.problem.labels) == set(here.problem.labels) - {flag.label for flag in here.flagged}
    wanted = there.without_flagged()
    assert (np.abs(again.x - wanted.x) / whole.parameters.free.scale).max() < 1e-6
    order = np.concatenate(thirds(whole))
    np.testing.assert_allclose(here.nominal_errors(), there.nominal_errors()[order], rtol=1e-9)
    assert str(here).splitlines()[-1] == here.message
    assert sum("Outliers" in line and "1:" in line for line in words.remarks(here, here.verdict)) == 1


def test_dropping_everything_is_refused(whole: ro.CalibrationProblem) -> None:
    problem = apart(whole)
    with pytest.raises(ro.InputError, match="data: found no row"):
        problem.without(problem.labels).linearize(x_of(whole))
    first = len(thirds(whole)[0])
    without = problem.without(problem.labels[:first])
    assert without.linearize(x_of(whole)).equations == 3 * (len(whole.data) - first)
    assert without.labels == problem.labels[first:]


def test_observability_of_parts_is_that_of_the_whole() -> None:
    problem = ro.load("rank_deficient").problem
    there, here = ro.problem.observe(problem), ro.problem.observe(apart(problem))
    assert (here.rank, here.unidentifiable, here.configurations) == (
        there.rank,
        there.unidentifiable,
        there.configurations,
    )
    np.testing.assert_allclose(
        here.singular_values, there.singular_values, rtol=0, atol=1e-9 * there.singular_values[0]
    )
    problem = ro.load("position").problem
    position = problem.with_parameters(problem.parameters.identify(["a3", "d4", "base_[xyz]"]))
    there, here = ro.problem.observe(position), ro.problem.observe(apart(position))


def test_blocks_are_whole_configurations() -> None:
    data = ro.load("markers").problem.data  # three rows each
    rng = np.random.default_rng(0)
    data = data.take(rng.permutation(len(data)))
    for most in (1, 3, 4, 10, 1000):
        groups = whole_configurations(data, most)
        seen = [set(data.configuration[rows]) for rows in groups]
        assert sum(map(len, seen)) == len(set().union(*seen)) == 25
        assert sorted(np.concatenate(groups)) == list(range(75))
        assert max(map(len, groups)) <= max(most, 3)
        assert len(groups) == -(-25 // max(most // 3, 1))


@pytest.mark.parametrize("over", ["configuration", "equation"])
@pytest.mark.parametrize("before", [False, True])
def test_squares_have_the_value_and_slope_of_the_loss(over: str, before: bool) -> None:
    problem = ro.load("markers").problem
    free = problem.parameters.free
    rng = np.random.default_rng(1)
    z = 0.05 * rng.normal(size=len(free))
    formulation = ro.Formulation("own", loss=ro.huber(3.0), penalty=cp.sum_squares, loss_over=over)
    squares = QuadraticModel(formulation.loss, "own", over, z + 0.01 * rng.normal(size=len(z)) if before else None)
    rows = problem.linearize(free.scale * z)
    model = problem.linearize(free.scale * z, squares)
    program = ro.convex.pose(formulation, rows)

    def value(at: np.ndarray) -> float:
        return float(np.sum((model.A @ at - model.b) ** 2)) + model.offset

    exact = program.value(z)[0]
    assert value(z) == pytest.approx(exact, rel=1e-10)
    for direction in rng.normal(size=(5, len(z))):
        h = 1e-6
        there = (program.value(z + h * direction)[0] - program.value(z - h * direction)[0]) / (2 * h)
        here = (value(z + h * direction) - value(z - h * direction)) / (2 * h)
        assert here == pytest.approx(there, rel=1e-5)
        if not before:  # nowhere below
            assert value(z + direction) >= program.value(z + direction)[0] * (1 - 1e-12)


ROBUST = {
    "robust": ro.robust,
    "huber of equations": ro.Formulation("own", loss=ro.huber(1.5), penalty=cp.sum_squares),
}


@pytest.mark.usefixtures("too_many")
@pytest.mark.parametrize("formulation", ROBUST)
@pytest.mark.parametrize(("name", "variant"), [("blunders", None), ("paper_arm", "misprints"), ("pose", None)])
def test_robust_losses_take_few_passes_more(name: str, variant: str | None, formulation: str) -> None:
    problem = ro.load(name, variant=variant).problem
    there = ro.calibrate(problem, ROBUST[formulation], 1.0)
    here = ro.calibrate(apart(problem), ROBUST[formulation], 1.0)
    assert here.converged
    assert len(here.history) <= 8  # plainly reweighted: 12 to 22
    assert here.history[-1].objective == pytest.approx(there.history[-1].objective, rel=1e-8)


@pytest.mark.usefixtures("too_many")
def test_inliers_of_a_robust_loss_are_the_same_in_blocks(whole: ro.CalibrationProblem) -> None:
    there, here = ro.calibrate(whole, ro.robust, 1.0), ro.calibrate(apart(whole), ro.robust, 1.0)
    assert here.fit_covariance.linear.equations == there.fit_covariance.linear.equations
    assert here.fit_covariance.noise_variance == pytest.approx(there.fit_covariance.noise_variance, rel=1e-5)
    np.testing.assert_allclose(here.covariance, there.covariance, rtol=0, atol=1e-5 * np.abs(there.covariance).max())
    chosen = ro.calibrate(apart(whole), ro.robust, ro.reml)
    inliers = inliers_of(ro.robust, *whole.configuration_errors(chosen.x))
    squared = ro.convex.pose(ro.tikhonov, whole.linearize(chosen.x, inliers))
    # the weight stays from where steps are shorter than a thousandth of the solution
    assert chosen.weight == pytest.approx(ro.reml(squared).weight, rel=1e-2)


@pytest.mark.usefixtures("too_many")
@pytest.mark.parametrize(
    "formulation",
    [ro.minimax,
     ro.Formulation("one sign", loss=lambda r: cp.sum(cp.pos(r)), penalty=cp.sum_squares),
     ro.Formulation("weighed", loss=lambda r: cp.sum(cp.multiply(np.ones(144), cp.abs(r))), penalty=cp.sum_squares)],
    ids=lambda f: f.name,
)  # fmt: skip
def test_losses_that_are_no_sums_are_refused(whole: ro.CalibrationProblem, formulation: ro.Formulation) -> None:
    with pytest.raises(ro.InputError, match="data in blocks"):
        ro.calibrate(apart(whole), formulation, 1.0)


@pytest.mark.usefixtures("too_many")
def test_threads_and_pickled_tasks_give_the_same(whole: ro.CalibrationProblem) -> None:
    def elsewhere(task, parts):
        return [pickle.loads(pickle.dumps(task))(part) for part in parts]

    there = ro.calibrate(apart(whole), ro.tikhonov, 1.0).x
    np.testing.assert_array_equal(ro.calibrate(apart(whole, compute=elsewhere), ro.tikhonov, 1.0).x, there)
    with ThreadPoolExecutor(3) as pool:
        np.testing.assert_array_equal(ro.calibrate(apart(whole, compute=pool.map), ro.tikhonov, 1.0).x, there)


@pytest.mark.usefixtures("too_many")
def test_an_own_measurement_in_parts_is_asked_once_a_calibration(monkeypatch) -> None:
    asked = []

    def model(T):
        asked.append(1)
        return T[2, 3]

    height = ro.data.Measurement("height", model, {"z": "length"})
    arm = ro.load("position").problem
    z = ro.robot.forward_kinematics(arm.robot, arm.data.q)[:, 2, 3:4]
    data = ro.Dataset.of(arm.data.q, z, 1e-5, measurement=height)
    problem = ro.CalibrationProblem(arm.robot, arm.parameters.identify(["base_z", "a2"]), data)
    ro.calibrate(apart(problem), ro.least_squares)
    assert len(asked) == 1
    monkeypatch.setattr(parts_module, "KEPT", 10)
    ro.calibrate(problem, ro.least_squares)
    assert len(asked) == 2


def test_frames_far_off_are_found_from_the_first_part() -> None:
    problem = ro.load("far_frames").problem
    there, here = ro.calibrate(problem, ro.tikhonov, 1.0), ro.calibrate(apart(problem), ro.tikhonov, 1.0)
    assert here.converged
    # deviations count from where a third of the rows put the base: the prior of 100 mm hardly pulls
    assert here.errors().mean() == pytest.approx(there.errors().mean(), rel=0.05)


def many(rows: int) -> ro.CalibrationProblem:
    problem = ro.load("position").problem
    rng = np.random.default_rng(0)
    q = rng.uniform(-2, 2, (rows, problem.robot.dof))
    return problem.on(ro.Dataset.of(q, rng.normal(size=(rows, 3)), 5e-5))


@pytest.mark.parametrize("rows", [9_000, 70_000])
def test_no_digit_depends_on_the_number_of_cores(monkeypatch: pytest.MonkeyPatch, rows: int) -> None:
    problem = in_parts(many(rows))
    x = np.zeros(len(problem.parameters.free))
    found = []
    for count in (1, 2, 5):
        monkeypatch.setattr(threads, "cores", lambda count=count: count)
        model = problem.linearize(x)
        found.append((model.qr_factor, problem.errors(x)))
    for qr_factor, errors in found[1:]:
        assert np.array_equal(qr_factor, found[0][0])
        assert np.array_equal(errors, found[0][1])


def test_functions_of_a_script_are_called_one_after_the_other() -> None:
    whole = ro.load("position").problem
    own = [lambda: whole.data.take(range(20)), lambda: whole.data.take(range(20, 40))]
    assert PartitionedProblem(whole.robot, whole.parameters, own[0](), own).compute is map
    files = ro.problem.partitions(["a.csv", "b.csv"], whole.robot, {"position_mm": 0.03})
    assert PartitionedProblem(whole.robot, whole.parameters, own[0](), files).compute is threads.on_all_cores


def test_rows_that_fit_are_those_of_one_table(whole: ro.CalibrationProblem) -> None:
    """So that every rule and every loss see the same, wherever the rows stand."""
    table = whole.on(whole.data.take(np.concatenate(thirds(whole))))
    there, here = (problem.linearize(x_of(whole)) for problem in (table, in_parts(apart(whole))))
    assert np.array_equal(here.A, there.A)
    assert np.array_equal(here.b, there.b)
    assert len(np.unique(here.group)) == len(np.unique(there.group))


@pytest.mark.parametrize("count", [2, pytest.param(7, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("formulation", "rule"),
    [pytest.param("minimax", "l_curve", marks=pytest.mark.slow), ("sum_of_norms", "leave_one_out"),
     pytest.param("lasso", "k_fold", marks=pytest.mark.slow), ("robust", "two_step"),
     ("group_lasso", "l_curve")],
)  # fmt: skip
def test_storage_decides_nothing(formulation: str, rule: str, count: int) -> None:
    table = ro.load("position").problem
    parts = [partial(table.data.take, rows) for rows in np.array_split(np.arange(40), count)]
    with ThreadPoolExecutor(2) as pool:
        blocks = PartitionedProblem(table.robot, table.parameters, table.data, parts, pool.map)
        there, here = ro.calibrate(table, formulation, rule), ro.calibrate(blocks, formulation, rule)
    assert here.converged == there.converged
    assert here.weight == pytest.approx(there.weight, rel=1e-5)  # sums in another order, through an interior point
    np.testing.assert_allclose(here.z, there.z, rtol=0, atol=2e-6)
