"""Large data: the same answer from triangles, parts, threads and clusters as from the rows."""

from __future__ import annotations

import pickle
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.data.measurements.registry import MEASUREMENTS
from rpim_opt.problem import CalibrationProblem, PartitionedProblem, partitions
from rpim_opt.problem import blocks as streaming
from rpim_opt.problem.blocks import reduced
from rpim_opt.problem.linear import reduced_rows

PARTS, ROWS = 5, 1100


@pytest.fixture(scope="module")
def robot() -> ro.robot.Robot:
    return ro.load("paper_arm").problem.robot


@pytest.fixture(scope="module")
def parameters(robot: ro.robot.Robot) -> ro.robot.Parameters:
    chosen = ["alpha?", "a?", "theta?", "d?", "tool_[xyz]", "base_*"]
    return ro.robot.model_parameters(robot, tools={"": [0.03, -0.02, 0.06, 0, 0, 0]}).identify(chosen)


def simulated(robot: ro.robot.Robot, parameters: ro.robot.Parameters, seed: int) -> ro.Dataset:
    rng = np.random.default_rng(seed)
    truth = 0.3 * np.random.default_rng(99).normal(size=len(parameters.free)) * parameters.free.scale
    q = rng.uniform(-2, 2, (ROWS, 6))
    y = CalibrationProblem(robot, parameters, ro.Dataset.of(q, np.zeros((ROWS, 3)), 5e-5)).modelled(truth)[0]
    y += 5e-5 * rng.normal(size=y.shape)
    return ro.Dataset.of(q, y, 5e-5)


@pytest.fixture(scope="module")
def parts(robot: ro.robot.Robot, parameters: ro.robot.Parameters) -> list[ro.Dataset]:
    return [simulated(robot, parameters, seed) for seed in range(PARTS)]


@pytest.fixture(scope="module")
def whole(robot: ro.robot.Robot, parameters: ro.robot.Parameters, parts: list[ro.Dataset]) -> CalibrationProblem:
    return CalibrationProblem(robot, parameters, ro.Dataset.together(parts, [str(i) for i in range(PARTS)]))


def partitioned(problem: CalibrationProblem, parts: list[ro.Dataset], compute=map) -> PartitionedProblem:
    readers = tuple(partial(pickle.loads, pickle.dumps(part)) for part in parts)
    return PartitionedProblem(problem.robot, problem.parameters, parts[0], readers, compute)


def test_a_triangle_says_all_that_a_squared_loss_sees(whole: CalibrationProblem) -> None:
    x = 0.1 * whole.parameters.free.scale
    rows, qr_factor = whole.linearize(x), reduced(whole, x)
    assert qr_factor.A.shape == (len(x) + 1, len(x))
    assert qr_factor.equations == rows.equations == 3 * PARTS * ROWS
    for z in np.random.default_rng(0).normal(size=(5, len(x))):
        there, here = (np.linalg.norm(m.A @ z - m.b) for m in (rows, qr_factor))
        assert here == pytest.approx(there, rel=1e-12)
    gram = rows.A.T @ rows.A
    np.testing.assert_allclose(qr_factor.A.T @ qr_factor.A, gram, atol=1e-12 * np.abs(gram).max())


@pytest.mark.parametrize("name", ["position", "mixed", "pose", "tracker", "markers"])
@pytest.mark.parametrize("few", [3, 7, 4096])
def test_rows_that_are_reduced_some_at_a_time_say_the_same(name: str, few: int, monkeypatch) -> None:
    monkeypatch.setattr("rpim_opt.problem.blocks.ROWS", few)
    problem = ro.load(name).problem
    x = 0.1 * problem.parameters.free.scale
    rows, found = problem.linearize(x), reduced(problem, x)
    assert found.equations == len(rows.b)
    assert found.constrained == rows.constrained
    all_of_it, here = (np.column_stack([model.A, model.b]) for model in (rows, found))
    gram = all_of_it.T @ all_of_it
    np.testing.assert_allclose(here.T @ here, gram, rtol=0, atol=1e-12 * np.abs(gram).max())


@pytest.fixture(autouse=True)
def too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with more equations than are kept in memory."""
    monkeypatch.setattr(PartitionedProblem, "gathered", lambda self: None)


@pytest.mark.parametrize("rule", [ro.reml, ro.l_curve, ro.gcv, 1.0])
def test_parts_give_the_answer_of_the_rows(whole: CalibrationProblem, parts: list[ro.Dataset], rule) -> None:
    there, here = ro.calibrate(whole, ro.tikhonov, rule), ro.calibrate(partitioned(whole, parts), ro.tikhonov, rule)
    assert here.converged
    assert here.weight == pytest.approx(there.weight, rel=1e-3)  # it stays once steps are shorter than that
    again = ro.calibrate(partitioned(whole, parts), ro.tikhonov, there.weight)
    fixed = ro.calibrate(whole, ro.tikhonov, there.weight)
    np.testing.assert_allclose(again.x, fixed.x, rtol=0, atol=1e-13)
    assert again.fit_covariance.linear.equations == fixed.fit_covariance.linear.equations == 3 * PARTS * ROWS
    assert again.fit_covariance.noise_variance == pytest.approx(fixed.fit_covariance.noise_variance, rel=1e-9)
    assert 0.9 < again.fit_covariance.noise_variance < 1.1  # as simulated
    np.testing.assert_allclose(again.covariance, fixed.covariance, rtol=0, atol=1e-9 * np.abs(fixed.covariance).max())


TWICE = ro.Formulation("twice", loss=lambda r: 2 * cp.sum_squares(r), penalty=ro.tikhonov.penalty)


@pytest.mark.parametrize("formulation", [ro.tikhonov, ro.robust, TWICE], ids=str)
def test_parts_are_read_as_often_as_they_are_linearized(whole, parts, formulation) -> None:
    read = []

    def reader() -> ro.Dataset:
        read.append(1)
        return parts[0]

    problem = PartitionedProblem(whole.robot, whole.parameters, parts[0], [reader])
    result = ro.calibrate(problem, formulation, 1.0, max_iterations=3)
    assert len(read) == len(result.history) + 1


def test_bounds_on_parts(whole: CalibrationProblem, parts: list[ro.Dataset]) -> None:
    tight = whole.parameters.toleranced({"length_mm": 0.2, "angle_mrad": 0.2, "tool_mm": 2, "base_mm": 20})
    rows = CalibrationProblem(whole.robot, tight, whole.data)
    there, here = (ro.calibrate(p, ro.bounded, 1.0) for p in (rows, partitioned(rows, parts)))
    assert there.active_bounds
    np.testing.assert_allclose(here.x, there.x, rtol=0, atol=1e-10)


def test_large_problems_are_solved_in_parts_of_whole_configurations(whole, monkeypatch) -> None:
    monkeypatch.setattr(streaming, "KEPT", 4000)
    repeated = whole.data.take(np.repeat(np.arange(len(whole.data)), 2)[::-1])
    cut = streaming.in_parts(whole.on(repeated))
    assert isinstance(cut, PartitionedProblem)
    seen = [set(part().configuration) for part in cut.parts]
    assert sum(map(len, seen)) == len(set().union(*seen)) == len(whole.data)
    assert sum(len(part()) for part in cut.parts) == len(repeated)
    result = ro.calibrate(whole, ro.tikhonov, 1.0)
    monkeypatch.undo()
    np.testing.assert_allclose(result.x, ro.calibrate(whole, ro.tikhonov, 1.0).x, rtol=0, atol=1e-13)
    assert result.problem is whole  # parts are how it is solved, not what was asked
    assert result.fit_covariance.linear.equations == 3 * len(whole.data)


def test_what_needs_rows_says_so(whole: CalibrationProblem, parts: list[ro.Dataset]) -> None:
    problem = partitioned(whole, parts[:1])
    for rule in (ro.leave_one_out, ro.k_fold, ro.two_step):
        with pytest.raises(ro.InputError, match="QR factor"):
            ro.calibrate(problem, ro.tikhonov, rule)
    with pytest.raises(ro.InputError, match="data in blocks"):
        ro.calibration.inspect(problem)
    with pytest.raises(ro.InputError, match="data in blocks"):
        ro.store.save_result(ro.calibrate(problem, ro.tikhonov, 1.0), "nowhere.json")


@pytest.mark.slow
def test_files_threads_and_a_cluster(whole: CalibrationProblem, parts: list[ro.Dataset], tmp_path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    files = []
    for k, part in enumerate(parts):
        block = part.blocks[0]
        columns = {f"q{i + 1}_rad": block.q[:, 0, i] for i in range(6)}
        columns |= {f"{axis}_m": block.y[:, i] for i, axis in enumerate("xyz")}
        files.append(tmp_path / f"{k}.parquet")
        parquet.write_table(pa.table(columns), files[-1])
    readers = partitions(files, whole.robot, {"position_mm": 0.05})
    wanted = ro.calibrate(whole, ro.tikhonov, 1.0).x
    with ThreadPoolExecutor(2) as pool:
        problem = PartitionedProblem(whole.robot, whole.parameters, parts[0], readers, pool.map)
        np.testing.assert_allclose(ro.calibrate(problem, ro.tikhonov, 1.0).x, wanted, rtol=0, atol=1e-13)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the cluster's own, of ports and event loops
        from distributed import Client, LocalCluster

        with (
            LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None) as cluster,
            Client(cluster) as client,
        ):

            def compute(task, each):
                return client.gather(client.map(task, list(each), pure=False))

            problem = PartitionedProblem(whole.robot, whole.parameters, parts[0], readers, compute)
            np.testing.assert_allclose(ro.calibrate(problem, ro.tikhonov, 1.0).x, wanted, rtol=0, atol=1e-13)
    with pytest.raises(ro.InputError, match="no file"):
        partitions([], whole.robot, {"position_mm": 0.05})


def jacobian_of(problem: CalibrationProblem):
    return problem.functions(problem.data.blocks[0])["jacobian"]


def test_ready_measurements_stay_the_same_in_other_processes() -> None:
    for measurement in MEASUREMENTS.values():
        assert pickle.loads(pickle.dumps(measurement)) is measurement


@pytest.mark.parametrize(("rows", "columns"), [(400, 7), (500, 34), (300, 120), (40, 120)])
def test_a_triangle_is_that_of_lapacks_usual_reduction(rows: int, columns: int) -> None:
    """Up to signs and rounding; whichever columns LAPACK reduces together."""
    matrix = np.random.default_rng(columns).normal(size=(rows, columns))
    R = reduced_rows(matrix)
    want = np.linalg.qr(matrix, mode="r")
    found = R[: len(want)] * (np.sign(np.diag(R[: len(want)])) * np.sign(np.diag(want)))[:, None]
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-13 * np.abs(want).max())
    assert not R[len(want) :].any()


@pytest.mark.parametrize("alike", [True, False])
def test_rows_are_whitened_by_their_covariances(alike: bool, whole: CalibrationProblem) -> None:
    rng = np.random.default_rng(3)
    factors = np.tril(rng.uniform(0.1, 1.0, (1 if alike else 50, 3, 3))) + np.eye(3)
    data = whole.data.take(range(50))
    V = 1e-10 * factors @ factors.transpose(0, 2, 1)
    problem = whole.on(replace(data, blocks=(replace(data.blocks[0], covariance=V),)))
    x = 0.1 * whole.parameters.free.scale
    model = problem.linearize(x)
    residual, jacobian = problem.slopes(x)
    W = np.linalg.inv(1e-5 * factors)
    A = (W @ jacobian.reshape(50, 3, -1)).reshape(150, -1) * whole.parameters.free.scale
    np.testing.assert_allclose(model.A, A, rtol=0, atol=1e-12 * np.abs(A).max())
    r = (W @ residual.reshape(50, 3, 1)).ravel()
    np.testing.assert_allclose(model.b, r + A @ np.full(len(x), 0.1), rtol=0, atol=1e-12 * np.abs(model.b).max())


def test_what_workers_get_holds_no_function_that_they_know(whole: CalibrationProblem) -> None:
    """A function that arrives anew with every part would be prepared anew for its rows."""
    frozen = whole.on(whole.data.take([0])).frozen()
    frozen.linearize(0 * whole.parameters.free.nominal)
    sent = pickle.dumps(frozen)
    assert len(sent) < 20_000  # functions of this arm take twenty times that
    functions = [jacobian_of(pickle.loads(sent)) for _ in range(2)]
    assert functions[0] is functions[1]
    assert functions[0] is jacobian_of(whole)


def test_workers_get_a_users_function_as_it_was_asked() -> None:
    asked = []
    size = [1.0]

    def model(T, *, q):
        asked.append(size[0])
        return size[0] * T[:3, 3]

    mine = ro.data.Measurement(
        "mine", model, dict.fromkeys("xyz", "length"), noise={"position": "length"}, depends_on=("q",)
    )
    ready = ro.load("position").problem
    data = replace(ready.data, blocks=(replace(ready.data.blocks[0], measurement=mine),))
    frozen = ready.on(data).frozen()
    want = frozen.linearize(0 * ready.parameters.free.nominal)
    count = len(asked)
    size[0] = 2.0
    kept = pickle.loads(pickle.dumps(list(frozen.frozen_functions.values())))
    there = replace(frozen, frozen_functions=dict(zip(frozen.frozen_functions, kept, strict=True)))
    there = there.linearize(0 * ready.parameters.free.nominal)
    assert len(asked) == count
    np.testing.assert_array_equal(there.A, want.A)
