"""The robot's repeatability: whitening by configuration, through blocks, reflectors and QR factors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.problem import Repeatability
from rpim_opt.problem.blocks import reduced
from rpim_opt.problem.linear import reduced_rows

REPEATABILITY = Repeatability(position=4e-5, orientation=1e-4, joint=7e-5, instrument=0.8, reading=2e-5)
NAMES = ("position", "pose", "markers", "mixed", "cable", "distance")


def dense(problem: ro.CalibrationProblem, repeatability: Repeatability) -> Array:
    """Return the covariance (m, m) of all equations, written down one by one."""
    groups, lengths, angles, V = [], [], [], []
    for block in problem.data.blocks:
        dimensions = list(block.measurement.components.values())
        covariance = np.broadcast_to(block.covariance, (len(block.row), len(dimensions), len(dimensions)))
        for row, C in zip(block.row, covariance, strict=True):
            groups += [problem.data.configuration[row]] * len(dimensions)
            lengths += [d == "length" for d in dimensions]
            angles += [d == "angle" for d in dimensions]
            V.append(C)
    m = len(groups)
    R = np.zeros((m, m))
    at = 0
    for C in V:
        R[at : at + len(C), at : at + len(C)] = repeatability.instrument**2 * C
        at += len(C)
    T = problem.joint_slopes(repeatability.at)
    p = problem.parameters
    moved = replace(p, identified=np.isin(p.names, ["base_x", "base_y", "base_z"]))
    G = problem.with_parameters(moved).jacobian(np.zeros(moved.identified.sum()))
    own = np.where(np.any(G, axis=1), 0.0, repeatability.position**2)  # distances without a base in the model
    R += np.diag((repeatability.reading**2 + own) * lengths + repeatability.orientation**2 * np.array(angles))
    same = np.equal.outer(groups, groups)
    return R + np.where(same, repeatability.joint**2 * T @ T.T + repeatability.position**2 * G @ G.T, 0.0)


@pytest.mark.parametrize("name", NAMES)
def test_whitened_equations_have_the_covariance(name: str) -> None:
    problem = ro.load(name).problem
    noisy = problem.with_repeatability(REPEATABILITY)
    x = 0.3 * problem.parameters.free.scale
    model = noisy.linearize(x)
    R = dense(problem, REPEATABILITY)
    A = problem.jacobian(x) * problem.parameters.free.scale
    b = problem.residual(x) + problem.jacobian(x) @ x
    assert np.allclose(model.A.T @ model.A, A.T @ np.linalg.solve(R, A), rtol=1e-8, atol=1e-8 * np.abs(model.A).max())
    assert np.allclose(model.A.T @ model.b, A.T @ np.linalg.solve(R, b), rtol=1e-8, atol=1e-6)
    assert model.b @ model.b == pytest.approx(b @ np.linalg.solve(R, b), rel=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_residual_and_norms_agree_with_the_model(name: str) -> None:
    problem = ro.load(name).problem.with_repeatability(REPEATABILITY)
    x = 0.3 * problem.parameters.free.scale
    model = problem.linearize(x)
    r = problem.whitened_residual(x)
    assert np.allclose(r, model.b - model.A @ (x / problem.parameters.free.scale), atol=1e-7 * np.abs(model.b).max())
    norms, count = problem.configuration_errors(x)
    assert np.sum(norms**2) == pytest.approx(r @ r, rel=1e-9)
    assert count.sum() == len(r)


def test_a_rows_norm_is_by_its_own_covariance() -> None:
    problem = ro.load("markers").problem
    noisy = problem.with_repeatability(REPEATABILITY)
    x = np.zeros(len(problem.parameters.free))
    norms, _ = noisy.whitened_errors(x)
    alone = problem.on(problem.data.take([4])).with_repeatability(REPEATABILITY)
    assert norms[4] == pytest.approx(np.linalg.norm(alone.whitened_residual(x)), rel=1e-9)


@pytest.mark.parametrize("name", ["position", "markers", "mixed"])
def test_triangles_and_parts_are_the_same_squares(name: str) -> None:
    problem = ro.load(name).problem.with_repeatability(REPEATABILITY)
    x = 0.2 * problem.parameters.free.scale
    model = problem.linearize(x)
    want = reduced_rows(np.column_stack([model.A, model.b]))
    small = np.column_stack([reduced(problem, x).A, reduced(problem, x).b])
    assert np.allclose(small.T @ small, want.T @ want, rtol=1e-9, atol=1e-7 * np.abs(want).max() ** 2)
    parts = [lambda rows=rows: problem.data.take(rows) for rows in np.array_split(np.arange(len(problem.data)), 1)]
    split = ro.problem.PartitionedProblem(problem.robot, problem.parameters, problem.data, parts).with_repeatability(
        REPEATABILITY
    )
    joined = np.column_stack([split.linearize(x).A, split.linearize(x).b])
    assert np.allclose(joined.T @ joined, want.T @ want, rtol=1e-9, atol=1e-7 * np.abs(want).max() ** 2)


def test_without_a_size_nothing_changes() -> None:
    problem = ro.load("mixed").problem
    x = 0.1 * problem.parameters.free.scale
    plain, bare = problem.linearize(x), problem.with_repeatability(Repeatability()).linearize(x)
    assert np.allclose(plain.A.T @ plain.A, bare.A.T @ bare.A, rtol=1e-9)
    assert np.array_equal(np.sort(plain.group), np.sort(bare.group))


def test_slopes_by_the_joints_are_differences() -> None:
    problem = ro.load("pose").problem
    h = 1e-6
    for joint, slopes in enumerate(problem.joint_slopes().T):
        ahead = np.zeros(problem.robot.dof)
        ahead[joint] = h
        moved = []
        for sign in (1, -1):
            blocks = tuple(replace(b, q=b.q + sign * ahead) for b in problem.data.blocks)
            there = problem.on(replace(problem.data, blocks=blocks))
            moved.append(there.residual(np.zeros(len(problem.parameters.free))))
        assert np.allclose(-(moved[0] - moved[1]) / (2 * h), slopes, atol=1e-7)


def test_slopes_are_taken_where_the_repeatability_says() -> None:
    problem = ro.load("position").problem
    p = problem.parameters
    x = 5 * p.free.scale
    values = p.nominal.copy()
    values[p.identified] = p.free.values(x)
    theta = [p.free.names.index(f"theta{i}") for i in range(2, 6)]
    J = problem.jacobian(x)
    assert np.allclose(problem.joint_slopes(values)[:, 1:5], J[:, theta], atol=1e-9)


def test_sliding_joints_do_not_turn() -> None:
    problem = ro.load("scara").problem
    slides = [i for i, kind in enumerate(problem.robot.joint_types) if kind == "prismatic"]
    assert slides
    assert not problem.joint_slopes()[:, slides].any()


def test_robots_part_and_reading_differ_by_the_instrument() -> None:
    problem = ro.load("pose").problem.with_repeatability(REPEATABILITY)
    for block, own, reading in zip(
        problem.data.blocks, problem.covariances(reading=False), problem.covariances(), strict=True
    ):
        assert np.allclose(reading - own, REPEATABILITY.instrument**2 * block.covariance)
        assert (np.linalg.eigvalsh(own) > 0).all()


def test_worse_noise_makes_wider_intervals_and_other_weights() -> None:
    problem = ro.load("position").problem
    calm = ro.calibrate(problem, ro.tikhonov, 1.0)
    rough = ro.calibrate(problem.with_repeatability(Repeatability(position=3e-4)), ro.tikhonov, 1.0)
    assert rough.fit_covariance.degrees_of_freedom < calm.fit_covariance.degrees_of_freedom
    assert rough.converged
