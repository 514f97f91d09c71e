"""Weights of groups: scores against dense algebra, gradients against differences, choices against a grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration.group_weights import Grouped, members, minimum, reml_groups, restricted_likelihood
from rpim_opt.problem.linear import LinearModel

PROBLEM = ro.load("position").problem
FREE = PROBLEM.parameters.free
n = len(FREE)
ROBOT = ~FREE.of_frames
KINDS = {"alpha? theta? beta?": ro.reml, "a? d?": ro.reml}


def simulated(seed: int, sizes: dict[str, float], noise: float = 1.0, rows: int = 150) -> LinearModel:
    """Equations of deviations whose groups have those sizes."""
    rng = np.random.default_rng(seed)
    size = np.ones(n)
    for key, value in sizes.items():
        size[members(FREE, {key: ro.reml}).member == 0] = value
    A = 20 * rng.standard_normal((rows, n))
    b = A @ (size * rng.standard_normal(n)) + noise * rng.standard_normal(rows)
    return LinearModel(A, b, np.repeat(np.arange(rows // 3), 3), FREE)


def groups_of(model: LinearModel, weights: dict[str, object]) -> Grouped:
    """The penalty |z|^2 in groups."""
    count = len(model.parameters)
    own = members(model.parameters, weights)
    return Grouped(model, own, np.ones(count), np.zeros(count), np.zeros((0, count)), np.zeros(0))


def with_statements(grouped: Grouped) -> Grouped:
    """The same with a centre, a statement, and a parameter that only the statement holds."""
    rng = np.random.default_rng(3)
    own = np.ones(n)
    own[5] = 0.0
    rows = np.zeros((2, n))
    rows[:, [5, 7]] = [[2.0, 1.0], [0.0, 3.0]]
    return replace(grouped, own=own, centre=0.3 * rng.standard_normal(n), rows=rows, values=np.array([0.5, -1.0]))


def dense_restricted_likelihood(grouped: Grouped, t: np.ndarray) -> float:
    """-2 ln of the density of what is left of the data without fixed effects, sigma profiled out, by covariances."""
    weights = grouped.members.weights(t) * grouped.own
    A = np.vstack([grouped.model.A, grouped.rows])
    y = np.append(grouped.model.b, grouped.values) - A @ np.where(grouped.own > 0, grouped.centre, 0.0)
    fixed = FREE.of_frames | (grouped.own == 0)
    X, Z = A[:, fixed], A[:, ~fixed]
    V = np.eye(len(y)) + (Z / weights[~fixed]) @ Z.T
    VX = np.linalg.solve(V, X)
    XVX = X.T @ VX
    P = np.linalg.inv(V) - VX @ np.linalg.solve(XVX, VX.T)
    m = len(y) - X.shape[1]
    return m * np.log(y @ P @ y) + np.linalg.slogdet(V)[1] + np.linalg.slogdet(XVX)[1]


@pytest.mark.parametrize("statements", [False, True])
def test_the_likelihood_is_the_textbook_s(statements: bool) -> None:
    grouped = groups_of(simulated(1, {}, rows=60), KINDS)
    if statements:
        grouped = with_statements(grouped)
    objective = restricted_likelihood(grouped)
    rng = np.random.default_rng(2)
    points = [3 * rng.standard_normal(2) for _ in range(5)]
    wanted = [dense_restricted_likelihood(grouped, t) for t in points]
    found = [objective(t)[0] for t in points]
    # up to a constant; the textbook's inverse of V has six digits left where weights differ by e^9
    assert np.diff(found) == pytest.approx(np.diff(wanted), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("statements", [False, True])
def test_gradients_are_differences(statements: bool) -> None:
    grouped = groups_of(
        simulated(4, {}, rows=60), {"alpha? theta?": ro.reml, "a? d?": ro.reml, "tool": ro.reml, "base": 2.0}
    )
    if statements:
        grouped = with_statements(grouped)
    objective = restricted_likelihood(grouped)
    t = np.array([1.0, 4.0, 2.0])
    slope = objective(t)[1]
    step = 1e-5
    for g, one in enumerate(np.eye(3)):
        difference = (objective(t + step * one)[0] - objective(t - step * one)[0]) / (2 * step)
        assert slope[g] == pytest.approx(difference, rel=1e-6, abs=1e-6 * np.abs(slope).max())


@pytest.mark.parametrize("name", ["position", "paper_arm", "distance", "pose", "markers"])
def test_a_single_group_is_the_single_weight(name: str) -> None:
    problem = ro.load(name).problem
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    single = ro.reml(ro.convex.pose(ro.tikhonov, model))
    found = reml_groups(groups_of(model, {"*": ro.reml}))
    # a minimum of rounded numbers is as flat as their root
    assert np.log(found.groups["*"]) == pytest.approx(np.log(single.weight), abs=1e-5)
    z = [ro.convex.pose(ro.tikhonov, model).solve(weight).z for weight in (found.groups["*"], single.weight)]
    assert z[0] == pytest.approx(z[1], abs=1e-6 * np.abs(z[1]).max())


@pytest.mark.parametrize("seed", range(4))
def test_the_most_likely_weights_are_those_of_a_grid(seed: int) -> None:
    grouped = groups_of(simulated(seed, {"alpha? theta? beta?": 10.0, "a? d?": 0.1}), KINDS)
    objective = restricted_likelihood(grouped)
    found = reml_groups(grouped)
    t = np.log([found.groups[name] for name in grouped.members.names])
    axis = np.linspace(-12, 12, 49)
    values = np.array([[objective(np.array([u, v]))[0] for v in axis] for u in axis])
    i, j = np.unravel_index(np.argmin(values), values.shape)
    assert objective(t)[0] <= values.min()
    assert np.abs(t - [axis[i], axis[j]]).max() <= axis[1] - axis[0]
    assert found.interior


@pytest.mark.slow
def test_the_sizes_of_groups_are_found() -> None:
    logs = []
    for seed in range(20):
        grouped = groups_of(simulated(seed, {"alpha? theta? beta?": 10.0, "a? d?": 0.1}, rows=210), KINDS)
        logs.append(np.log([reml_groups(grouped).groups[name] for name in grouped.members.names]))
    # weight is sigma^2 over the squared size, of some 12 deviations each: sd of its logarithm 0.4 a run
    assert np.mean(logs, axis=0) == pytest.approx([-2 * np.log(10.0), 2 * np.log(10.0)], abs=0.4)


def test_frames_are_fixed_effects_unless_a_group_is_theirs_alone() -> None:
    model = simulated(1, {})
    robot = groups_of(model, {"alpha? a? theta? d? beta?": ro.reml})
    everything = groups_of(model, {"*": ro.reml})
    t = np.array([0.7])
    assert restricted_likelihood(robot)(t)[0] == pytest.approx(restricted_likelihood(everything)(t)[0], rel=1e-12)
    own = groups_of(model, {"alpha? a? theta? d? beta?": ro.reml, "base": ro.reml})
    slope = restricted_likelihood(own)(np.array([0.7, 0.2]))[1]
    assert slope[1] != 0.0


def test_points_on_a_surface_and_pure_noise_leave_the_weights_at_one() -> None:
    assert set(reml_groups(groups_of(replace(simulated(1, {}), constrained=True), KINDS)).groups.values()) == {1.0}
    rng = np.random.default_rng(8)
    noise = replace(simulated(1, {}), b=1e3 * rng.standard_normal(150))
    found = reml_groups(groups_of(noise, {"*": ro.reml}))
    if found.groups["*"] == 1.0:
        assert "the data do not determine" in found.note


def test_statements_hold_what_has_no_penalty() -> None:
    grouped = with_statements(groups_of(simulated(1, {}, rows=60), KINDS))
    t = np.array([0.5, -1.0])
    T = grouped.model.triangle
    R, r = np.vstack([T[:, :-1], grouped.rows]), np.append(T[:, -1], grouped.values)
    z, inverse = minimum(R, r, grouped.members.weights(t) * grouped.own, grouped.centre)
    A = np.vstack([grouped.model.A, grouped.rows])
    y = np.append(grouped.model.b, grouped.values)
    W = np.diag(grouped.members.weights(t) * grouped.own)
    wanted = np.linalg.solve(A.T @ A + W, A.T @ y + W @ grouped.centre)
    assert z == pytest.approx(wanted, rel=1e-9, abs=1e-12)
    assert inverse == pytest.approx(np.linalg.inv(A.T @ A + W), rel=1e-9, abs=1e-15)


# --- which parameters a group has -----------------------------------------------------------------------------------


def test_keys_are_patterns_names_kinds_and_links() -> None:
    found = members(FREE, {"alpha theta": ro.reml, "a2 a3 d?": 3.0, "tool": ro.reml})
    by_name = dict(zip(FREE.names, zip(found.member, found.given, strict=True), strict=True))
    assert found.names == ("alpha theta", "tool")
    assert by_name["theta4"] == (0, 1.0)
    assert by_name["a3"] == (-1, 3.0)
    assert by_name["a4"] == (-1, 1.0)
    assert by_name["tool_x"] == (1, 1.0)
    assert found.told == {"a2 a3 d?": 3.0, "others": 1.0}
    assert [FREE.names[i] for i in np.flatnonzero(members(FREE, {"link3": ro.reml}).member == 0)] == [
        name for name in FREE.names if name.endswith("3")
    ]
    assert (members(FREE, {"length": ro.reml}).member == 0).sum() == 12


@pytest.mark.parametrize(
    ("weights", "says"),
    [
        ({}, "an empty mapping"),
        ({"q?": 1.0}, "'q?'"),
        ({"": 1.0}, "key ''"),
        ({3: 1.0}, "key 3"),
        ({"a?": 1.0, "a2": 2.0}, "'a2' in 'a?' and in 'a2'"),
        ({"a?": 0.0}, "0.0 for 'a?'"),
        ({"a?": np.inf}, "inf for 'a?'"),
        ({"a?": ro.gcv}, "'gcv' for groups"),
        ({"a?": "best"}, "'best'"),
        ({"a?": True}, "'True'"),
        ({"a?": None}, "'None'"),
    ],
)
def test_keys_that_name_nothing_or_twice_are_refused(weights: dict[str, float], says: str) -> None:
    with pytest.raises(ro.InputError) as error:
        members(FREE, weights)
    assert says in str(error.value)


def test_a_frame_that_no_row_sees_takes_nothing_away() -> None:
    model = simulated(1, {}, rows=60)
    frames = np.flatnonzero(model.parameters.of_frames)
    A = model.A.copy()
    A[:, frames[0]] = 0.0
    _, R, _, equations = groups_of(replace(model, A=A), {"alpha? theta?": ro.reml, "a? d?": ro.reml}).robot()
    assert np.isfinite(R).all()
    assert equations == len(model.b) - np.linalg.matrix_rank(A[:, frames])
    assert np.abs(A[:, frames].T @ model.b).max() > 0
