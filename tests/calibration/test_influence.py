"""Influence: what leaving out every configuration does, held against leaving it out."""

from __future__ import annotations

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration import Calibration, Influence, influence
from rpim_opt.problem import LinearModel, PartitionedProblem


def without(model: LinearModel, number: int) -> LinearModel:
    keep = model.group != number
    return LinearModel(model.A[keep], model.b[keep], model.group[keep], model.parameters, model.constrained)


def left_out(result: Calibration, number: int) -> np.ndarray:
    """Return the change [SI] by solving the last linearization without a configuration."""
    model = without(result.program.model, number)
    z = ro.convex.pose(result.formulation, model).solve(result.weight).z
    whole = result.program.solve(result.weight).z  # the loop ends within its tolerance of that
    return (z - whole) * result.problem.parameters.free.scale


def close(found: Influence, k: int, change: np.ndarray) -> bool:
    seen = found.deviation > 0
    expected = change[seen] / found.deviation[seen]
    # solutions are exact to 1e-11 of the scales (1 mm or 1 mrad): of a parameter that is known to 1e-9 that is seen
    rounding = 1e-14 / found.deviation[seen]
    missed = np.linalg.norm(found.change[k, seen] / found.deviation[seen] - expected)
    return bool(missed < 1e-5 * np.linalg.norm(expected) + np.linalg.norm(rounding))


@pytest.mark.parametrize("name", ["position", "markers", "pose", "mixed", "distance"])
def test_changes_are_those_of_leverage(name: str) -> None:
    result = ro.calibrate(ro.load(name).problem, ro.tikhonov, weight=1.0)
    found = influence(result)
    assert len(found.label) == len(np.unique(result.problem.data.configuration))
    assert found.leverage.sum() == pytest.approx(result.fit_covariance.degrees_of_freedom, rel=1e-9)
    assert (found.weight == 1).all()
    for k in range(0, len(found.label), 7):
        assert close(found, k, left_out(result, found.configuration[k]))


def test_a_configuration_is_left_out_of_the_nonlinear_problem_to_second_order() -> None:
    problem = ro.load("position").problem
    result = ro.calibrate(problem, ro.tikhonov, weight=1.0)
    found = influence(result)
    k = int(np.argmax(found.cook))
    again = ro.calibrate(problem.without([found.label[k]]), ro.tikhonov, weight=1.0, start=result.x)
    change = (again.x - result.x) / found.deviation
    assert np.linalg.norm(change) > 0.5
    assert np.linalg.norm(change - found.change[k] / found.deviation) < 0.01 * np.linalg.norm(change)


def test_cooks_distance_is_how_far_predictions_move() -> None:
    result = ro.calibrate(ro.load("markers").problem, ro.tikhonov, weight=1.0)
    found = influence(result)
    A = result.program.model.A
    for k in (0, 11):
        moved = A @ (found.change[k] / result.problem.parameters.free.scale)
        expected = moved @ moved / (result.fit_covariance.degrees_of_freedom * result.fit_covariance.noise_variance)
        assert found.cook[k] == pytest.approx(expected, rel=1e-8)


def test_a_robust_loss_counts_with_the_weights_that_it_ended_with() -> None:
    problem = ro.load("blunders").problem
    result = ro.calibrate(problem, ro.robust, weight=1.0)
    found = influence(result)
    model = result.program.model
    norms = result.program.norms(result.z)
    assert found.weight == pytest.approx(np.minimum(1, 2.0 / norms), rel=1e-9)
    rows = np.sqrt(found.weight)[np.unique(model.group, return_inverse=True)[1]]
    for k in range(0, len(found.label), 9):
        alone = without(model.scaled(rows), found.configuration[k])
        z = ro.convex.pose(ro.tikhonov, alone).solve(1.0).z
        change = (z - result.z) * problem.parameters.free.scale
        assert np.linalg.norm((found.change[k] - change) / found.deviation) < 1e-4
    blunders = {flag.label for flag in result.flagged}
    heaviest = [found.label[k] for k in np.argsort(found.weight)[: len(blunders)]]
    assert set(heaviest) == blunders


def tight() -> ro.CalibrationProblem:
    problem = ro.load("position").problem
    return problem.with_parameters(problem.parameters.toleranced({"length_mm": 0.3, "angle_mrad": 0.5}))


def test_parameters_at_a_bound_stay_there() -> None:
    result = ro.calibrate(tight(), ro.bounded, weight=1e-3)
    held = {each.name for each in result.active_bounds}
    assert held
    found = influence(result)
    columns = [found.parameters.index(name) for name in held]
    assert (found.change[:, columns] == 0).all()
    assert (np.abs(found.change).max(axis=0) > 0).sum() == len(found.parameters) - len(held)


def test_what_one_configuration_decides_alone_is_not_known_without_it() -> None:
    problem = ro.load("position").problem
    alone = problem.identifying(np.array([name == "a2" for name in problem.parameters.names]))
    found = influence(ro.calibrate(alone.on(alone.data.take([0])), ro.least_squares))
    assert np.isnan(found.change).all()


def test_in_parts_it_is_the_same() -> None:
    whole = ro.load("position").problem
    parts = [lambda: whole.data.take(range(17)), lambda: whole.data.take(range(17, 40))]
    problem = PartitionedProblem(whole.robot, whole.parameters, parts[0](), parts)
    for stated in (ro.tikhonov, ro.robust):
        one = influence(ro.calibrate(whole, stated, weight=1.0))
        other = influence(ro.calibrate(problem, stated, weight=1.0))
        order = [other.label.index(f"{part}:{name}") for part, name in _parted(one.label, whole)]
        assert np.abs((one.change - other.change[order]) / one.deviation).max() < 1e-4
        assert other.leverage[order] == pytest.approx(one.leverage, rel=1e-4)


def _parted(labels: tuple[str, ...], whole: ro.CalibrationProblem) -> list[tuple[int, str]]:
    first = set(whole.data.label[:17])
    return [(1 if label in first else 2, label) for label in labels]


@pytest.mark.parametrize(("stated", "accepted"), [(ro.lasso, "squared penalty"), (ro.minimax, "reweighted squares")])
def test_what_has_no_such_influence_is_refused(stated: ro.Formulation, accepted: str) -> None:
    result = ro.calibrate(ro.load("position").problem, stated, weight=1.0)
    with pytest.raises(ro.InputError, match=accepted):
        influence(result)


def test_the_frame_says_units() -> None:
    result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=1.0)
    found = influence(result)
    frame = found.to_frame()
    assert list(frame["label"]) == list(found.label)
    j = found.parameters.index("a2")
    assert frame["a2_mm"].to_numpy() == pytest.approx(1e3 * found.change[:, j])
