"""Diagnostics of a fit: flagged rows and their standardized residuals, and multipliers of bounds."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import rpim_opt as ro
from rpim_opt.bayes.outliers import error_vectors
from rpim_opt.calibration.diagnosis import Flag, flagged
from rpim_opt.convex.robust_loss import limits
from rpim_opt.report import report
from tests.simulate import simulated

COUNT = np.array([3, 3, 1, 3, 6, 3, 3, 3])
MEDIANS = np.sqrt(chi2.ppf(0.5, COUNT))
LABELS = tuple("abcdefgh")


def flags(norms: np.ndarray) -> tuple[Flag, ...]:
    """Of rows that have these whitened norms, and errors of as many millimetres."""
    problem: Any = SimpleNamespace(
        whitened_errors=lambda x: (norms, COUNT), labels=LABELS, errors=lambda x, dimension: 1e-3 * norms
    )
    return flagged(problem, np.zeros(3))


def test_a_good_fit_flags_nothing() -> None:
    assert flags(MEDIANS) == ()
    assert flags(limits(1.0, 8, COUNT) * (1 - 1e-9)) == ()


@pytest.mark.parametrize("noise", [0.5, 1.0, 6.0])
def test_flags_are_told_in_sigmas_of_the_noise_that_the_others_show(noise: float) -> None:
    """Declared noise at least: a norm of 60 declared sigmas is 60 of them, or 10 where the others vary by 6."""
    norms = noise * MEDIANS
    norms[[2, 6]] = (60.0, 90.0)
    found = flags(norms)
    assert [flag.label for flag in found] == ["g", "c"]
    assert [flag.sigmas for flag in found] == pytest.approx([90.0 / max(noise, 1.0), 60.0 / max(noise, 1.0)], rel=1e-9)
    assert [flag.error for flag in found] == pytest.approx([0.09, 0.06], rel=1e-12)


@pytest.mark.parametrize(("formulation", "weight"), [("tikhonov", None), ("robust", 1.0)])
def test_an_outlier_is_told_in_the_unit_of_what_stands_out(formulation: str, weight: float | None) -> None:
    """Two poses, one turned by 50 mrad and one moved by 3 mm."""
    problem = ro.load("pose").problem
    (block,) = problem.data.blocks
    y = block.y.copy()
    turned = Rotation.from_rotvec([0.05, 0, 0]) * Rotation.from_quat(y[3, 3:], scalar_first=True)
    y[3, 3:] = turned.as_quat(scalar_first=True)
    y[7, 0] += 3e-3
    result = ro.calibrate(problem.on(replace(problem.data, blocks=(replace(block, y=y),))), formulation, weight)
    if weight is None:
        assert {row.label: row.dimension for row in result.learned.left_out} == {"c3": "angle", "c7": "length"}
        (said,) = [line for line in str(result).splitlines() if line.startswith("Excluded outliers")]
    else:
        assert {flag.label: flag.dimension for flag in result.flagged} == {"c3": "angle", "c7": "length"}
        said = " ".join(result.without_flagged().record.excluded.values())
    assert re.search(r"(49|50|51)(\.\d+)? mrad", said)
    assert re.search(r"(2\.9\d*|3|3\.0\d*) mm", said)
    if weight is None:  # also in the report
        assert " mrad</td>" in report.page(result)


def test_a_row_is_flagged_from_its_own_limit_on() -> None:
    """Six equations may have a larger norm than one."""
    limit = limits(1.0, 8, COUNT)
    for row in range(8):
        norms = 0.5 * MEDIANS
        norms[row] = limit[row] * (1 + 1e-9)
        assert [flag.label for flag in flags(norms)] == [LABELS[row]]


def bounded_result() -> ro.calibration.Calibration:
    problem, _ = simulated(noise=5e-5, size=2.0)
    tight = ro.constraints.Box("tight", lambda p: (np.full(len(p), -1.0), np.full(len(p), 1.0)))
    return ro.calibrate(problem, ro.Formulation("boxed", penalty=cp.sum_squares, constraints=(tight,)), 1.0)


def test_held_parameters_are_at_their_bounds_and_cost_what_loosening_gains() -> None:
    found = bounded_result()
    free = found.problem.parameters.free
    helds = found.active_bounds
    assert len(helds) > 3
    gains = [h.gain for h in helds]
    assert gains == sorted(gains, reverse=True)
    assert min(gains) > 0
    program = found.program
    rows, loss = program.model.equations, program.value(found.z)[0]
    for h in helds:
        i = free.names.index(h.name)
        assert h.bound == pytest.approx(found.x[i], rel=1e-6)
        assert abs(h.bound) == pytest.approx(free.scale[i], rel=1e-12)
        less = max(loss - 0.1 * h.multiplier, 0.0)
        assert h.gain == pytest.approx(np.sqrt(loss / rows) - np.sqrt(less / rows), rel=1e-6)
    inside = [n for i, n in enumerate(free.names) if abs(found.z[i]) < 1 - 1e-5]
    assert inside
    assert not {h.name for h in helds} & set(inside)


def test_a_multiplier_is_the_slope_of_the_least_objective() -> None:
    found = bounded_result()
    free = found.problem.parameters.free
    h = found.active_bounds[0]
    i = free.names.index(h.name)
    by = 1e-4

    def loosened(p: Any) -> tuple[np.ndarray, np.ndarray]:
        half = np.ones(len(p))
        half[i] += by
        return -half, half

    looser = ro.Formulation("l", penalty=cp.sum_squares, constraints=(ro.constraints.Box("looser", loosened),))
    model = found.program.model
    before, after = found.program.solve(1.0).objective, ro.convex.pose(looser, model).solve(1.0).objective
    assert h.multiplier == pytest.approx((before - after) / by, rel=1e-2)


def test_nothing_is_held_without_a_box_or_where_it_is_wide() -> None:
    problem, _ = simulated(noise=5e-5)
    assert ro.calibrate(problem, ro.tikhonov, 1.0).active_bounds == ()
    wide = ro.constraints.Box("wide", lambda p: (np.full(len(p), -100.0), np.full(len(p), 100.0)))
    assert (
        ro.calibrate(problem, ro.Formulation("w", penalty=cp.sum_squares, constraints=(wide,)), 1.0).active_bounds == ()
    )
    ball = ro.Formulation("ball", penalty=cp.sum_squares, constraints=(ro.in_ball(1.0, "*"),))
    assert ro.calibrate(problem, ball, 1.0).active_bounds == ()


def test_a_fixed_parameter_is_not_held_by_a_tolerance() -> None:
    problem, _ = simulated(noise=5e-5)
    fixed = ro.Formulation("fixed", penalty=cp.sum_squares, constraints=(ro.constraints.at_nominal("a2"),))
    assert ro.calibrate(problem, fixed, 1.0).active_bounds == ()


def test_the_factor_of_a_loss_is_its_weight_against_squares() -> None:
    problem, _ = simulated(noise=5e-5)
    tripled = ro.Formulation("tripled", loss=lambda r: 3 * cp.sum_squares(r), penalty=cp.sum_squares)
    results = {each.name: ro.calibrate(problem, each, 1.0) for each in (ro.tikhonov, tripled, ro.robust)}
    assert results["Tikhonov"].fit_covariance.linear.factor == 1.0
    assert results["tripled"].fit_covariance.linear.factor == pytest.approx(3.0, rel=1e-9)
    robust = results["Huber"]
    inliers = robust.program.inliers(robust.z)
    assert inliers is not None
    assert robust.fit_covariance.linear.factor == inliers.factor


@pytest.mark.parametrize("name", ["mixed", "markers", "pose"])
def test_error_vectors_are_as_long_as_the_errors_of_their_rows(name: str) -> None:
    """Whatever else was measured beside positions; NaN where none was."""
    problem = ro.load(name).problem
    x = 0.3 * problem.parameters.free.scale
    vectors, errors = error_vectors(problem, x), problem.errors(x)
    positions = np.zeros(len(problem.data), dtype=bool)
    for block in problem.data.blocks:
        positions[block.row] = "x" in block.measurement.components
    assert np.linalg.norm(vectors, axis=1)[positions] == pytest.approx(errors[positions], rel=1e-9)
    assert np.isnan(vectors[~positions]).all()
    assert positions.any()
