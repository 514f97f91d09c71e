"""Several problems as one: each keeps its equations, what is shared is known better, and every path takes it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration.lack_of_fit import lack_of_fit
from rpim_opt.robot.kinematics import numeric_frame
from tests.simulate import ALL, ARM, simulated

SIGMA = 5e-5
OTHER = ro.robot.Robot(
    "other arm", ARM.mdh[:5] * 1.1, joint_map=np.diag([1.0, -1, 1, 1, 1]), gravity=ro.robot.Gravity((0, -1, 0))
)
"""Five joints, of which the controller counts one backwards, mounted on a wall."""
REPEATABLE = ro.problem.Repeatability()
TOOL = ("tool_[xyz]",)
DRAWS = 400


def measured(problem: ro.CalibrationProblem, truth: dict[str, float], seed: int, noise: float = SIGMA):
    """Return the problem on measurements of a robot with these deviations, all others zero."""
    x = np.array([truth.get(name, 0.0) for name in problem.parameters.free.names])
    blocks = []
    rng = np.random.default_rng(seed)
    for block, values in zip(problem.data.blocks, problem.modelled(x), strict=True):
        blocks.append(replace(block, y=values + noise * rng.normal(size=values.shape)))
    return problem.on(replace(problem.data, blocks=tuple(blocks)))


def drawn(problem: ro.CalibrationProblem, tool: np.ndarray, seed: int) -> dict[str, float]:
    """Return deviations of a robot, drawn by its scales, with a tool."""
    free = problem.parameters.free
    values = np.random.default_rng(seed).normal(size=len(free)) * free.scale
    return dict(zip(free.names, values, strict=True)) | dict(zip(("tool_x", "tool_y", "tool_z"), tool, strict=True))


def two(seed: int = 0, counts: tuple[int, int] = (20, 15), other: ro.robot.Robot = OTHER, identify=ALL):
    """Return two problems with one tool, measured, and what is true of it (3,) [m]."""
    tool = 5e-3 * np.random.default_rng(seed).normal(size=3)
    problems = []
    for robot, count, k in ((ARM, counts[0], 1), (other, counts[1], 2)):
        problem, _ = simulated(identify, count, robot=robot, seed=10 * seed + k)
        problems.append(measured(problem, drawn(problem, tool, 10 * seed + k), seed=100 * seed + k))
    return problems[0], problems[1], tool


def by_name(problem: ro.CalibrationProblem, x: np.ndarray) -> dict[str, float]:
    return dict(zip(problem.parameters.free.names, x, strict=True))


def parts_of(whole: ro.CalibrationProblem, part: ro.CalibrationProblem, robot: str, x: np.ndarray) -> np.ndarray:
    """Return the deviations of one robot in the order of its own problem."""
    values = by_name(whole, x)
    return np.array([values.get(f"{robot}.{name}", values.get(name)) for name in part.parameters.free.names])


def test_every_problem_keeps_its_equations_and_columns() -> None:
    left, right, _ = two()
    whole = ro.together(left=left, right=right, shared=TOOL)
    free = whole.parameters.free
    assert len(free) == len(left.parameters.free) + len(right.parameters.free) - 3
    assert {"left.a2", "right.a2", "tool_x", "right.base_rx"} <= set(free.names)
    assert not {"a2", "left.tool_x", "right.alpha6"} & set(free.names)
    x = np.random.default_rng(0).normal(size=len(free)) * free.scale
    xl, xr = parts_of(whole, left, "left", x), parts_of(whole, right, "right", x)
    assert np.array_equal(whole.residual(x), np.concatenate([left.residual(xl), right.residual(xr)]))
    J = whole.jacobian(x)
    m = len(left.residual(xl))
    for part, robot, rows, own in ((left, "left", J[:m], xl), (right, "right", J[m:], xr)):
        places = [free.names.index(whole.parameters.called(robot, name)) for name in part.parameters.free.names]
        assert np.array_equal(rows[:, places], part.jacobian(own))
        assert not np.delete(rows, places, axis=1).any()
        alone = whole.alone(robot)
        assert set(alone.parameters.free.names) == set(part.parameters.free.names)
        again = np.array([by_name(part, own)[name] for name in alone.parameters.free.names])
        assert np.array_equal(alone.residual(again), part.residual(own))


def test_a_term_of_a_users_own_stays_its_robots() -> None:
    """Its parameters are the robot's, not a frame's, under whatever name."""
    soft = ro.Model([ro.robot.Term(lambda joint, size: size * joint.q**2, {"wave_mrad": 0.1}, joints=(2, 3))])
    left, right, _ = two(identify=("theta?",))
    left = left.with_model(soft)
    whole = ro.together(left=left, right=right, shared=TOOL)
    assert whole.parameters.terms == ("left.wave2", "left.wave3")
    names = whole.parameters.free.names
    assert not whole.parameters.free.of_frames[[names.index(name) for name in whole.parameters.terms]].any()
    assert set(whole.alone("left").parameters.free.names) == set(left.parameters.free.names)
    x = np.random.default_rng(0).normal(size=len(names)) * whole.parameters.free.scale
    own = parts_of(whole, left, "left", x)
    assert np.array_equal(whole.residual(x)[: len(left.residual(own))], left.residual(own))


def test_names_say_of_what_kind_a_parameter_is_whosever_it_is() -> None:
    left, right, _ = two()
    free = ro.together(left=left, right=right, shared=TOOL).parameters.free
    for part, robot in ((left, "left"), (right, "right")):
        own = part.parameters.free
        places = [i for i, name in enumerate(free.names) if name.startswith(robot)]
        same = [own.names.index(free.names[i].partition(".")[2]) for i in places]
        assert np.array_equal(free.of_frames[places], own.of_frames[same])
        assert np.array_equal(free.periodic[places], own.periodic[same])
        assert [free.groups[i] for i in places] == [own.groups[k] for k in same]
    x = 4.0 * np.ones(len(free))
    assert (free.wrapped(x) < np.pi).sum() == free.periodic.sum()


def test_configurations_labels_repeatability_and_gravity_are_each_robots_own() -> None:
    left, right, _ = two()
    left, right = (
        part.with_parameters(part.parameters.identify(["d?", "compliance[23]", *TOOL])) for part in (left, right)
    )
    whole = ro.together(left=left, right=right, shared=TOOL)
    assert len(set(whole.data.configuration)) == 35
    assert whole.labels[0] == "left:1"
    assert whole.data.q.shape == (35, 6)
    m = 3 * 20
    slopes = whole.joint_slopes()
    assert np.array_equal(slopes[:m], left.joint_slopes())
    assert np.array_equal(slopes[m:, :5], right.joint_slopes())
    assert not slopes[m:, 5].any()
    x = np.zeros(len(whole.parameters.free))
    rough = ro.problem.Repeatability(position=1e-4, joint=1e-4)
    expected = np.concatenate([part.with_repeatability(rough).linearize(parts_of(whole, part, robot, x)).b
                               for part, robot in ((left, "left"), (right, "right"))])  # fmt: skip
    assert np.abs(whole.with_repeatability(rough).linearize(x).b - expected).max() < 1e-9
    values = np.random.default_rng(1).normal(size=len(x)) * whole.parameters.free.scale
    for part, robot in ((left, "left"), (right, "right")):
        own = parts_of(whole, part, robot, values)
        where = whole.data.of_robot(robot)
        assert np.array_equal(whole.on(ro.Dataset.of_robots({robot: where})).residual(values), part.residual(own))


HOW: dict[str, dict] = {
    "learned": {},
    "learned, extensions": {"model": "auto"},
    "robust, learned": {"formulation": ro.robust},
    "number": {"weight": 1.0},
    "reml": {"weight": "reml"},
    "l_curve": {"weight": "l_curve"},
    "k_fold": {"weight": "k_fold"},
    "lasso": {"formulation": ro.lasso, "weight": 1.0},
    "group lasso": {"formulation": ro.group_lasso, "weight": 1.0},
}


@pytest.mark.parametrize("how", HOW)
def test_every_way_of_calibrating_takes_it(how: str) -> None:
    left, right, tool = two(counts=(30, 30))
    whole = ro.together(left=left, right=right, shared=TOOL)
    result = ro.calibrate(whole, **{"formulation": ro.tikhonov, **HOW[how]})
    assert result.converged, result.message
    values = by_name(result.problem, result.x)
    # tool_z and d6 of the first arm are one direction: what a penalty makes of it is its own affair
    found = np.array([values[name] for name in ("tool_x", "tool_y")])
    assert np.abs(found - tool[:2]).max() < 2e-4
    assert result.errors().mean() < 4 * SIGMA


def test_a_constraint_ties_parameters_of_two_robots() -> None:
    left, right, _ = two(other=ARM)
    whole = ro.together(left=left, right=right, shared=TOOL)
    same = ro.Formulation("same a2", penalty=cp.sum_squares, constraints=(ro.constraints.equal("left.a2", "right.a2"),))
    values = by_name(whole, ro.calibrate(whole, same, weight=1.0).x)
    assert values["left.a2"] == pytest.approx(values["right.a2"], abs=1e-9)


def test_a_constraint_bounds_positions_of_one_of_two_robots() -> None:
    left, right, _ = two(counts=(30, 30))
    whole = ro.together(left=left, right=right, shared=TOOL)
    q = np.full((1, 5), 0.3)
    height = ro.calibrate(whole, ro.tikhonov, weight=1.0).forward(q, robot="right")[0, 2, 3] + 1e-3

    def stated(robot: str) -> ro.Formulation:
        return ro.Formulation(
            "stated", penalty=cp.sum_squares, constraints=(lambda z, p: p.positions(q, robot=robot)[0, 2] == height,)
        )

    found = ro.calibrate(whole, stated("right"), weight=1.0)
    assert found.forward(q, robot="right")[0, 2, 3] == pytest.approx(height, abs=1e-7)
    with pytest.raises(ro.InputError, match="left"):
        ro.calibrate(whole, stated(""), weight=1.0)


def test_a_frame_that_was_stated_far_off_is_found_for_every_robot() -> None:
    left, right, _ = two(counts=(30, 30))
    whole = ro.together(left=left, right=right, shared=TOOL)
    p = whole.parameters
    nominal = p.nominal.copy()
    nominal[p.names.index("right.base_x")] += 3.0
    found = ro.calibrate(whole.with_parameters(replace(p, nominal=nominal)), ro.tikhonov, weight=1.0)
    same = ro.calibrate(whole, ro.tikhonov, weight=1.0)
    assert found.converged
    assert "Deviations refer to registered frames" in found.message
    assert np.abs(found.errors() - same.errors()).max() < 1e-4


def _stated(result) -> float:
    """Return the variance of the tool that a result states, for noise as declared."""
    names = result.problem.parameters.free.names
    k = [names.index(name) for name in ("tool_x", "tool_y", "tool_z")]
    return float(np.trace(result.covariance[np.ix_(k, k)])) / result.fit_covariance.noise_variance


def test_a_shared_tool_is_known_better_than_apart() -> None:
    """On simulated truth: the tool's RMS error of both together is below that of either apart, as is its variance."""
    apart: list[list[float]] = [[], []]
    both: list[float] = []
    for seed in range(12):
        left, right, tool = two(seed)
        whole = ro.calibrate(ro.together(left=left, right=right, shared=TOOL), ro.tikhonov, weight=1.0)
        results = [ro.calibrate(part, ro.tikhonov, weight=1.0) for part in (left, right)]
        for result, errors in zip((*results, whole), (*apart, both), strict=True):
            names = result.problem.parameters.free.names
            k = [names.index(name) for name in ("tool_x", "tool_y", "tool_z")]
            errors.append(float(np.sum((result.x[k] - tool) ** 2)))
        stated = [_stated(result) for result in (*results, whole)]
        assert stated[2] < min(stated[:2])
    assert np.mean(both) < 0.8 * min(np.mean(errors) for errors in apart)


def test_one_robot_in_two_campaigns_is_one_robot_with_two_bases() -> None:
    """Equal to the problem of all rows, where the base is one, too."""
    problem, _ = simulated(configurations=40, noise=SIGMA, seed=3)
    spring, autumn = (problem.on(problem.data.take(range(*rows))) for rows in ((0, 20), (20, 40)))
    everything = list(problem.parameters.names)
    whole = ro.together(spring=spring, autumn=autumn, shared=everything)
    assert whole.parameters.free.names == problem.parameters.free.names
    found = ro.calibrate(whole, ro.tikhonov, weight=1.0)
    same = ro.calibrate(problem, ro.tikhonov, weight=1.0)
    assert np.abs(found.z - same.z).max() < 1e-9
    assert np.abs(found.covariance / np.sqrt(np.outer(np.diag(same.covariance), np.diag(same.covariance)))
                  - same.covariance / np.sqrt(np.outer(np.diag(same.covariance), np.diag(same.covariance)))
                  ).max() < 1e-7  # fmt: skip
    apart = ro.together(spring=spring, autumn=autumn, shared=["[!b]*", "beta?", "moment*", "backlash?"])
    assert len(apart.parameters.free) == len(problem.parameters.free) + 6


@pytest.mark.slow
def test_a_result_goes_to_a_file_and_a_report_and_commands_and_back(tmp_path: Path) -> None:
    left, right, _ = two(counts=(30, 30))
    term = ro.robot.Term(lambda joint, size: size * joint.q**2, {"bow_mrad": 0.1}, joints=(2,))
    left = left.with_model(ro.Model([term]))
    whole = ro.together(left=left, right=right, shared=TOOL)
    assert whole.parameters.terms == ("left.bow2",)
    result = ro.calibrate(whole)
    assert result.converged
    ro.store.save_result(result, tmp_path / "result.json")
    with pytest.raises(ro.InputError, match="bow2"):
        ro.load_result(tmp_path / "result.json")
    again = ro.load_result(tmp_path / "result.json", model={"left": ro.Model([term])})
    assert np.array_equal(again.x, result.x)
    assert again.problem.parameters.terms == whole.parameters.terms
    assert np.array_equal(again.problem.parameters.periodic, whole.parameters.periodic)
    assert str(again) == str(result)
    assert ro.load_result(tmp_path / "result.json", model=ro.Model([term])).problem.arms.keys() == {"left", "right"}
    ro.report.write_report(result, tmp_path / "report.html")
    assert "left: test arm" in (tmp_path / "report.html").read_text()
    assert lack_of_fit(result).left < 3 * SIGMA
    assert ro.calibration.likely_causes(result) == []
    assert list(result.robots) == ["left", "right"]
    where = result.predict(right.data.q[:3], robot="right")
    assert np.abs(where.position - right.data.blocks[0].y[:3]).max() < 6 * SIGMA
    assert np.abs(result.forward(right.data.q[:3], robot="right")[:, :3, 3] - where.position).max() < 1e-12
    own = parts_of(result.problem, right, "right", result.x)
    assert np.abs(right.modelled(own)[0][:3] - where.position).max() < 1e-12
    commands = ro.use.compensate(result, q=right.data.q[:3], orientation=False, robot="right")
    assert commands.q.shape == (3, 5)
    assert commands.position_error.max() < 1e-7
    assert np.isfinite(commands.std).all()


def test_the_covariance_of_one_robots_commands_is_that_of_the_whole() -> None:
    left, right, _ = two(counts=(40, 40))
    result = ro.calibrate(ro.together(left=left, right=right, shared=TOOL), ro.tikhonov, weight=1.0)
    commands = ro.use.compensate(result, q=right.data.q[:4], orientation=False, robot="right")
    expected = result.predict(commands.q, robot="right").covariance
    assert commands.std == pytest.approx(np.sqrt(np.trace(expected, axis1=1, axis2=2)), rel=1e-6)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda a, b: ro.together(a, shared=TOOL), "1 problems with 1 names"),
        (lambda a, b: ro.together(a, A=b, shared=TOOL), "2 problems with 1 names"),
        (lambda a, b: ro.together(a, b, shared=["flange_*"]), r"together, shared: found 'flange_\*'"),
        (lambda a, b: ro.together(a, b, shared="tool_*"), "patterns in a list"),
        (lambda a, b: ro.together(a, tool=b, shared=TOOL), "the name 'tool'"),
        (
            lambda a, b: ro.together(a, b.with_repeatability(ro.problem.Repeatability()), shared=TOOL),
            "problem 'B': found the robot's",
        ),
        (lambda a, b: ro.together(a, ro.together(a, b, shared=TOOL), shared=TOOL), "several robots"),
        (
            lambda a, b: ro.together(a, b.with_parameters(b.parameters.scaled({"tool_mm": 1.0})), shared=TOOL),
            "shared 'tool_x': found scale 0.005 in 'A' and 0.001 in 'B'",
        ),
        (
            lambda a, b: ro.together(a, b.with_parameters(b.parameters.identify(["a?"])), shared=TOOL),
            "identified True in 'A' and False in 'B'",
        ),
        (lambda a, b: ro.together(a, b, shared=["d?"]), "shared 'd1': found nominal values"),
        (lambda a, b: ro.together(a, b, shared=TOOL).robot, r"robot: found 2 in one problem \(A, B\)"),
        (lambda a, b: ro.calibration.inspect(ro.together(a, b, shared=TOOL)), r"accepted: one: problem.alone\('A'\)"),
        (lambda a, b: ro.together(a, b, shared=TOOL).alone("C"), "robot: found 'C'"),
        (lambda a, b: ro.together(a, b, shared=TOOL).on(a.data), "rows that name no robot"),
        (lambda a, b: a.on(ro.Dataset.of_robots({"A": a.data})), "rows of robot 'A'"),
        (
            lambda a, b: ro.Dataset.of_robots({"C": ro.together(a, b, shared=TOOL).data}),
            "data of 'C': found rows of several robots",
        ),
    ],
)
def test_what_cannot_be_put_together_is_said_in_a_sentence(make: Callable, sentence: str) -> None:
    left, right, _ = two()
    with pytest.raises(ro.InputError, match=sentence):
        make(left, right)


def test_measurements_in_parts_are_refused() -> None:
    left, right, _ = two()
    parts = ro.problem.PartitionedProblem(left.robot, left.parameters, left.data, (lambda: left.data,))
    with pytest.raises(ro.InputError, match="a CalibrationProblem, in memory"):
        ro.together(parts, right, shared=TOOL)


def test_a_loaded_result_knows_which_angles_are_those_of_frames(tmp_path: Path) -> None:
    problem = ro.load("plane").problem
    ro.store.save_result(ro.calibrate(problem, ro.tikhonov, weight=1.0), tmp_path / "result.json")
    again = ro.load_result(tmp_path / "result.json").problem
    assert problem.parameters.own_frames
    assert np.array_equal(again.parameters.periodic, problem.parameters.periodic)


def test_more_equations_than_are_kept_come_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    left, right, _ = two(counts=(30, 30))
    whole = ro.together(left=left, right=right, shared=TOOL)
    expected = ro.calibrate(whole, ro.tikhonov, weight=1.0)
    monkeypatch.setattr("rpim_opt.problem.blocks.KEPT", 60)
    found = ro.calibrate(whole, ro.tikhonov, weight=1.0)
    assert found.converged
    assert np.abs(found.z - expected.z).max() < 1e-8


@pytest.mark.slow
def test_the_covariance_of_shared_parameters_is_right_by_monte_carlo() -> None:
    """Of DRAWS new sets of noise: the spread of the tool is the stated one, also between its components."""
    identify = ("alpha[2345]", "a[2345]", "theta[2345]", "d[45]", *TOOL, "base_*")
    left, right, _ = two(counts=(30, 25), other=ARM, identify=identify)
    whole = ro.together(left=left, right=right, shared=TOOL)
    truth = by_name(whole, ro.calibrate(whole, ro.least_squares).x)
    first = ro.calibrate(measured(whole, truth, seed=0), ro.least_squares)
    names = whole.parameters.free.names
    k = [names.index(name) for name in ("tool_x", "tool_y", "tool_z")]
    C = first.fit_covariance.noise[np.ix_(k, k)] / first.fit_covariance.noise_variance
    found = np.array([ro.calibrate(measured(whole, truth, seed), ro.least_squares).x[k] for seed in range(DRAWS)])
    off = found - [truth[name] for name in ("tool_x", "tool_y", "tool_z")]
    white = np.linalg.solve(np.linalg.cholesky(C), off.T).T
    spread = white.T @ white / DRAWS
    # a variance of 400 draws has a standard deviation of 7 %, a covariance of 5 %: three of them
    assert np.abs(spread - np.eye(3)).max() < 0.21
    assert np.abs(white.mean(axis=0)).max() < 3 / np.sqrt(DRAWS)
    alone = ro.calibrate(left, ro.least_squares)
    own = [left.parameters.free.names.index(name) for name in ("tool_x", "tool_y", "tool_z")]
    apart = alone.fit_covariance.noise[np.ix_(own, own)] / alone.fit_covariance.noise_variance
    assert np.linalg.eigvalsh(apart - C).min() > 0


def test_sessions_by_the_hundred_are_refused_with_what_they_cost() -> None:
    arm = ro.load("position").problem
    q = ro.problem.random_candidates(arm.robot, 800)
    data = ro.Dataset.of(q, np.zeros((800, 3)), 5e-5, session=[f"day {i // 2}" for i in range(800)])
    parameters = ro.problem.starting_parameters(arm.robot, data).identify([*arm.parameters.free.names, "session_*"])
    problem = ro.CalibrationProblem(arm.robot, parameters, data)
    with pytest.raises(ro.InputError, match=r"session: found 400 of them and 2,434 parameters, .* about 4 minutes"):
        ro.calibrate(problem)


def test_one_of_several_robots_goes_to_files(tmp_path: Path) -> None:
    """As the problem of this robot alone would at the same deviations: the place of its base and tool, too."""
    first, second, _ = two()
    whole = ro.together(left=first, right=second, shared=TOOL)
    result = ro.calibrate(whole)
    with pytest.raises(ro.InputError, match=r"robot: found '', accepted: left, right"):
        ro.use.export_files(result, mdh=tmp_path / "arm.toml")
    for name in ("left", "right"):
        notes = ro.use.export_files(result, robot=name, mdh=tmp_path / f"{name}.toml").notes
        written = ro.read_robot(tmp_path / f"{name}.toml")
        assert np.abs(written.mdh - result.robots[name].mdh).max() < 1e-11
        arm = ro.use.identified(result, robot=name)
        q = np.random.default_rng(0).uniform(-1, 1, (5, written.dof))
        chain = numeric_frame(arm.base) @ ro.robot.forward_kinematics(written, q) @ numeric_frame(arm.tool)
        assert np.abs(chain - result.forward(q, robot=name)).max() < 1e-10
        assert any(f"{1e3 * arm.tool[0]:.3f}" in note for note in notes)
