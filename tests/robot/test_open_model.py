"""Terms of a user's own are terms like the built-in ones: the same numbers where those exist, and files, and errors."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import casadi as ca
import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration import words
from rpim_opt.robot.kinematics import FRAME, frame, numeric_frame
from tests.simulate import ALL, ARM, simulated

N = 60
Q = np.random.default_rng(0).uniform(-2, 2, (N, 6))
SIDE = np.random.default_rng(1).choice([-1.0, 1.0], (N, 6))
SIGMA = 5e-5

OWN: dict[str, tuple[Callable, dict]] = {
    "ratio": (lambda joint, size: size * joint.q, {"own_ppm": 1000}),
    "ecc2_cos": (lambda joint, size: size * ca.cos(2 * joint.q), {"own_mrad": 0.1}),
    "compliance": (lambda joint, size: size * joint.gravity, {"own_mrad_per_Nm": 0.01}),
    "backlash": (lambda joint, size: size * joint.approach, {"own_mrad": 0.1}),
    "moment{}_5x": (lambda joint, size: size * joint.moment(5, "x"), {"own_mrad": 0.1}),
}
"""Built-in terms, and what a user would write for them."""


def blank(**columns: np.ndarray) -> ro.CalibrationProblem:
    """Return a problem whose measured values are zero."""
    whole = simulated(("alpha?", "a?", "d?", "tool_[xyz]", "base_*"))[0]
    return whole.on(ro.Dataset.of(Q, np.zeros((N, 3)), SIGMA, approach=SIDE, columns=columns))


def measured(problem: ro.CalibrationProblem, noise: float = 0.0, **truth: float) -> ro.CalibrationProblem:
    """Return the problem on measurements of an arm with these deviations, all others zero."""
    x = np.array([truth.get(name, 0.0) for name in problem.parameters.free.names])
    y = problem.modelled(x)[0] + noise * np.random.default_rng(2).normal(size=(N, 3))
    block = problem.data.blocks[0]
    return problem.on(replace(problem.data, blocks=(replace(block, y=y),)))


def both(built: str) -> tuple[ro.CalibrationProblem, ro.CalibrationProblem]:
    """Return the same problem with a built-in term of joints 2 to 4, and with a user's."""
    moves, scales = OWN[built]
    problem = blank()
    names = [built.format(i) if "{}" in built else f"{built}{i}" for i in (2, 3, 4)]
    # its columns stand behind the frames: where its parameters are, and nothing else, differs
    with_built = problem.with_parameters(problem.parameters.identify([*problem.parameters.free.names, *names]))
    own = problem.with_model(ro.Model([ro.robot.Term(moves, scales, joints=(2, 3, 4))]))
    (key,) = scales
    scale = {f"{name}_{key.removeprefix('own_')}": scales[key] for name in names}
    return with_built.with_parameters(with_built.parameters.scaled(scale)), own


def in_order(built: str, problem: ro.CalibrationProblem) -> list[int]:
    """Return where the parameters of the problem with a user's term stand in that with the built-in one."""
    names = problem.parameters.free.names
    stem = built.partition("{}")[0]
    mine = [i for i, name in enumerate(names) if name.startswith(stem)]
    return [i for i in range(len(names)) if i not in mine] + mine


@pytest.mark.parametrize("built", OWN)
def test_a_users_term_is_the_built_in_one(built: str) -> None:
    with_built, own = both(built)
    order = in_order(built, with_built)
    x = np.random.default_rng(3).normal(size=len(order)) * own.parameters.free.scale
    there = np.empty(len(order))
    there[order] = x
    assert np.abs(own.residual(x) - with_built.residual(there)).max() < 1e-14
    assert np.abs(own.jacobian(x) - with_built.jacobian(there)[:, order]).max() < 1e-13


@pytest.mark.parametrize("built", ["backlash", "ecc2_cos", "compliance"])
def test_a_calibration_with_it_is_the_same_to_1e_10_and_finds_the_truth(built: str) -> None:
    with_built, own = both(built)
    truth = {"own2": 2.0, "own3": -1.0, "a2": 5e-4}
    scale = dict(zip(own.parameters.free.names, own.parameters.free.scale, strict=True))
    truth |= {name: truth[name] * scale[name] for name in ("own2", "own3")}
    own = measured(own, noise=SIGMA, **truth)
    found = ro.calibrate(own, ro.tikhonov, weight=1e-2)
    same = ro.calibrate(with_built.on(own.data), ro.tikhonov, weight=1e-2)
    order = in_order(built, with_built)
    assert found.converged
    assert np.abs(found.z - same.z[order]).max() < 1e-10
    values = dict(zip(own.parameters.free.names, found.x, strict=True))
    std = dict(zip(own.parameters.free.names, np.sqrt(np.diag(found.covariance)), strict=True))
    for name in ("own2", "own3", "own4"):
        assert abs(values[name] - truth.get(name, 0.0)) < 4 * std[name]
    assert abs(values["own2"]) > 10 * std["own2"]


def test_a_third_harmonic_and_its_phase_are_found_where_no_built_in_term_is() -> None:
    """Nonlinear in its parameters: from a nominal phase that is not its own."""
    wave = ro.robot.Term(
        lambda joint, size, phase: size * ca.cos(3 * joint.q + phase),
        {"third_mrad": 0.3, "phase_deg": 60},
        joints=(2,),
        nominal={"third_mrad": 0.1},
    )
    problem = measured(blank().with_model(ro.Model([wave])), third2=2e-4, phase2=0.7)
    found = ro.calibrate(problem, ro.least_squares, weight=0.0)
    assert found.converged
    values = dict(zip(problem.parameters.free.names, found.x, strict=True))
    assert values["third2"] == pytest.approx(2e-4, abs=1e-9)
    assert values["phase2"] == pytest.approx(0.7, abs=1e-5)


def test_a_link_bends_under_gravity_and_grows_with_temperature_and_a_tool_sags() -> None:
    def bent(link, soft):
        return ca.vertcat(0, 0, 0, soft * ca.cross(ca.DM([1, 0, 0]), link.down))

    terms = [
        ro.robot.Term(bent, {"beam_mrad": 0.1}, at="link", joints=(2, 3)),
        ro.robot.Term(
            lambda link, rate: [rate * link.column("temperature"), 0, 0, 0, 0, 0],
            {"grown_um_per_K": 10},
            at="link",
            joints=(2,),
            columns={"temperature": "temperature"},
        ),
        ro.robot.Term(lambda tool, x: x * ca.vertcat(tool.down, 0, 0, 0), {"sag_mm": 0.1}, at="tool"),
    ]
    warm = np.linspace(-5, 20, N)
    problem = blank(temperature=warm).with_model(ro.Model(terms))
    assert problem.parameters.free.names[-4:] == ("beam2", "beam3", "grown2", "sag")
    truth = {"beam2": 3e-3, "beam3": -2e-3, "grown2": 4e-5, "sag": 2e-3}
    found = measured(problem, **truth).data.blocks[0].y
    assert np.abs(found - [_bent(q, dt, truth) for q, dt in zip(Q, warm, strict=True)]).max() < 1e-14
    x = np.random.default_rng(0).normal(size=len(problem.parameters.free)) * problem.parameters.free.scale
    J = problem.jacobian(x)
    for i in range(len(x) - 4, len(x)):
        step = np.eye(len(x))[i] * 1e-5
        slope = (problem.residual(x - step) - problem.residual(x + step)) / 2e-5
        assert np.abs(slope - J[:, i]).max() < 1e-8 * max(1.0, np.abs(J[:, i]).max())


def _bent(q: np.ndarray, temperature: float, truth: dict[str, float]) -> np.ndarray:
    """Return the position of the reflector, link by link, in numbers."""
    T = np.eye(4)
    nominal = np.eye(4)
    for i in range(6):
        one = replace(
            ARM, mdh=ARM.mdh[i : i + 1], joint_types=("revolute",), joint_map=np.eye(1), limits=np.empty((0, 0))
        )
        link = ro.robot.forward_kinematics(one, q[i : i + 1, None])[0]
        T = T @ link
        nominal = nominal @ link
        down = nominal[:3, :3].T @ [0, 0, -1]
        moved = np.zeros(6)
        moved[3:] = truth.get(f"beam{i + 1}", 0.0) * np.cross([1, 0, 0], down)
        if i == 1:
            moved[0] = truth["grown2"] * temperature
        T = T @ ca.DM(frame((0,) * 6, moved)).full()
    T = T @ ca.DM(frame((0,) * 6, [*(truth["sag"] * down), 0, 0, 0])).full()
    return (T @ [0.03, -0.02, 0.06, 1])[:3]


def test_a_base_that_was_set_up_anew_is_displaced_along_its_own_axes() -> None:
    def moved(base, x, turn):
        return [base.column("later") * v for v in (x, 0, 0, 0, 0, turn)]

    term = ro.robot.Term(moved, {"shift_mm": 0.1, "turn_mrad": 0.1}, at="base", columns={"later": ""})
    later = np.arange(N) % 2
    problem = blank(later=later).with_model(ro.Model([term]))
    assert problem.parameters.free.names[-2:] == ("shift", "turn")
    x = np.zeros(len(problem.parameters.free))
    before = problem.modelled(x)[0]
    x[-2:] = (2e-3, 0.3)
    found = problem.modelled(x)[0]
    base = numeric_frame([problem.parameters.nominal[problem.parameters.names.index(f"base_{c}")] for c in FRAME])
    inside = np.column_stack([before, np.ones(N)]) @ np.linalg.inv(base).T
    after = inside @ (base @ numeric_frame([2e-3, 0, 0, 0, 0, 0.3])).T
    expected = np.where(later[:, None] == 1, after[:, :3], before)
    assert np.abs(found - expected).max() < 1e-14
    with pytest.raises(ro.InputError, match="the base has one parameter"):
        ro.robot.Term(moved, {"shift{}a_mm": 0.1, "turn_mrad": 0.1}, at="base")


def test_sessions_are_a_component_of_their_own_size() -> None:
    """Simulated: the tracker stands elsewhere, by tenths of a millimetre, after every tenth configuration."""
    names = ("noon", "evening", "night")
    instance = ro.load("position")
    block = instance.problem.data.blocks[0]
    session = np.arange(len(block.y)) // 10
    moved = 2e-4 * np.random.default_rng(0).normal(size=(4, 3))
    moved[0] = 0
    columns = {name: session == k for k, name in enumerate(names, start=1)}
    data = ro.Dataset.of(block.q, block.y + moved[session], 3e-5, columns=columns)
    terms = [
        ro.robot.Term(
            lambda base, *shift, name=name: [*(base.column(name) * v for v in shift), 0, 0, 0],
            {f"{name}_{axis}_mm": 0.1 for axis in "xyz"},
            at="base",
            columns={name: ""},
        )
        for name in names
    ]
    apart = instance.problem.on(data).with_model(ro.Model(terms))
    with_sessions = ro.calibrate(apart, prior=ro.bayes.Prior(groups=["noon_* evening_* night_*"]))
    without = ro.calibrate(instance.problem.on(data))
    first = dict.fromkeys(names, np.zeros(len(instance.validation)))
    y = instance.validation.blocks[0].y
    q = instance.validation.q
    # the first session's frame is the one that stays, by which nothing was moved
    error = [
        np.sqrt(np.mean(np.sum((found.position - y) ** 2, axis=1)))
        for found in (with_sessions.predict(q, columns=first), without.predict(q))
    ]
    assert error[0] < 3.5e-5 < 1e-4 < error[1]
    assert "Residuals agree with the measurement noise" in str(with_sessions)
    # tenths of a millimetre over 0.03 mm
    assert re.search(r"Residuals are [3-6]\.\d+ times the measurement noise", str(without))
    assert "noon_* evening_* night_*" in str(with_sessions)


def test_a_correction_without_parameters_is_always_there() -> None:
    known = ro.robot.Term(lambda joint: 1e-3 * ca.sin(joint.q), {}, joints=(3,))
    moved = Q.copy()
    moved[:, 2] += 1e-3 * np.sin(Q[:, 2])
    problem = blank()
    x = np.zeros(len(problem.parameters.free))
    expected = problem.on(ro.Dataset.of(moved, np.zeros((N, 3)), SIGMA)).modelled(x)[0]
    assert np.abs(problem.with_model(ro.Model([known])).modelled(x)[0] - expected).max() < 1e-14


def test_measured_torques_are_what_a_term_sees_where_there_are_some() -> None:
    soft = ro.Model([ro.robot.Term(lambda joint, size: size * joint.torque, {"soft_mrad_per_Nm": 0.01})])
    torque = np.random.default_rng(4).uniform(-10, 10, (N, 6))
    problem = blank()
    stated = problem.on(ro.Dataset.of(Q, np.zeros((N, 3)), SIGMA, torque=torque))
    moved = Q + 1e-5 * torque
    expected = problem.on(ro.Dataset.of(moved, np.zeros((N, 3)), SIGMA)).modelled(
        np.zeros(len(problem.parameters.free))
    )
    found = measured(stated.with_model(soft), **{f"soft{i}": 1e-5 for i in range(1, 7)}).data.blocks[0].y
    assert np.abs(found - expected[0]).max() < 1e-14
    with pytest.raises(ro.InputError, match="joint torques"):
        problem.with_model(soft).on(stated.data)


def test_a_term_is_asked_anew_and_kept_within_a_calibration() -> None:
    size = {"factor": 1.0}
    moving = ro.robot.Term(lambda joint, p: p * size["factor"] * joint.q, {"own_mrad": 0.1}, joints=(2,))
    problem = blank().with_model(ro.Model([moving]))
    x = np.append(np.zeros(len(problem.parameters.free) - 1), 1e-3)
    kept = problem.frozen()
    before = problem.residual(x)
    size["factor"] = 2.0
    assert np.array_equal(kept.residual(x), before)
    assert np.abs(problem.residual(x) - before).max() > 1e-5


def test_scales_and_the_learned_prior_know_its_parameters() -> None:
    _, own = both("ecc2_cos")
    own = measured(own, noise=SIGMA, own2=3e-4)
    scaled = own.parameters.scaled({"own?_mrad": 0.7})
    assert scaled.free.scale[-3:] == pytest.approx(7e-4)
    assert own.parameters.scaled({"angle_mrad": 0.7}).free.scale[-1] == pytest.approx(7e-4)
    assert not own.parameters.free.of_frames[-3:].any()
    learned = ro.calibrate(own)
    assert learned.converged
    assert set(learned.learned.scales) == {"lengths", "angles", "own", "base"}
    assert " own2 " in words.parameter_table(learned)


def test_a_result_says_what_it_needs_and_checks_what_it_gets(tmp_path: Path) -> None:
    moves, scales = OWN["backlash"]
    model = ro.Model([ro.robot.Term(moves, scales, joints=(2, 3, 4))])
    problem = measured(blank().with_model(model), noise=SIGMA, own2=3e-4)
    result = ro.calibrate(problem, ro.tikhonov, weight=1.0)
    ro.store.save_result(result, tmp_path / "result.json")
    with pytest.raises(ro.InputError, match=r"found no term, accepted: model=.*joint \(own2, own3, own4\)"):
        ro.load_result(tmp_path / "result.json")
    other = ro.Model([ro.robot.Term(lambda joint, size: size * joint.q, scales, joints=(2, 3, 4))])
    with pytest.raises(ro.InputError, match="terms and measurement models"):
        ro.load_result(tmp_path / "result.json", model=other)
    again = ro.load_result(tmp_path / "result.json", model=model)
    assert np.array_equal(again.x, result.x)
    assert words.parameter_table(again) == words.parameter_table(result)


def test_columns_of_a_table_are_read_kept_and_missed(tmp_path: Path) -> None:
    warm = ro.robot.Term(
        lambda joint, rate: rate * joint.column("temperature") * joint.column("hours"),
        {"warm_urad_per_K": 10},
        joints=(2,),
        columns={"temperature": "temperature", "hours": ""},
    )
    model = ro.Model([warm])
    robot = replace(ARM, model=model)
    table = {f"q{i}_deg": np.degrees(Q[:, i - 1]) for i in range(1, 7)}
    table |= dict(zip(("x_mm", "y_mm", "z_mm"), 1e3 * measured(blank(), SIGMA).data.blocks[0].y.T, strict=True))
    full = table | {"temperature_K": np.arange(N), "hours": np.ones(N)}
    data = ro.read_data(full, robot, {"position_mm": 0.05})
    assert data.take([3, 1]).blocks[0].columns["temperature"].tolist() == [3.0, 1.0]
    with pytest.raises(ro.InputError, match="column 'hours'"):
        ro.read_data(full, ARM, {"position_mm": 0.05})
    with pytest.raises(ro.InputError, match="column 'temperature' without a unit of the right dimension"):
        ro.read_data(table | {"temperature": np.arange(N)}, robot, {"position_mm": 0.05})
    problem = blank()
    with pytest.raises(ro.InputError, match="no column 'hours'"):
        problem.on(ro.read_data(table, robot, {"position_mm": 0.05})).with_model(model)
    there = problem.on(data).with_model(model)
    result = ro.calibrate(there, ro.tikhonov, weight=1.0)
    ro.store.save_result(result, tmp_path / "result.json")
    again = ro.load_result(tmp_path / "result.json", model=model)
    assert again.problem.data.blocks[0].columns["temperature"].tolist() == list(range(N))
    with pytest.raises(ro.InputError, match="no column 'hours'"):
        again.forward(Q[:2])
    cold = again.forward(Q[:2], columns={"temperature": 0.0, "hours": 1.0})
    hot = again.forward(Q[:2], columns={"temperature": 50.0, "hours": 1.0})
    assert np.abs(hot - cold).max() > 0
    with pytest.raises(ro.InputError, match=r"compensation.*'(hours|temperature)'"):
        ro.use.compensate(again, q=Q[:2], despite_verdict=True)


def test_commands_are_corrected_for_a_users_term_as_for_a_built_in_one() -> None:
    with_built, own = both("ecc2_cos")
    own = measured(own, noise=SIGMA, own2=3e-4)
    found = ro.calibrate(own, ro.tikhonov, weight=1.0)
    same = ro.calibrate(with_built.on(own.data), ro.tikhonov, weight=1.0)
    mine, theirs = (ro.use.compensate(result, q=Q[:5]) for result in (found, same))
    assert np.abs(mine.q - theirs.q).max() < 1e-9
    with pytest.raises(ro.InputError, match="own2"):
        ro.use.identified(found)


@pytest.mark.parametrize("weight", [None, 1.0, "reml"])
def test_files_hold_the_geometry_of_a_calibration_without_a_users_term(
    weight: float | str | None, tmp_path: Path
) -> None:
    _, own = both("ecc2_cos")
    own = measured(own, noise=SIGMA, own2=3e-4, own4=-2e-4, a2=5e-4)
    found = ro.calibrate(own, weight=weight)
    written = ro.use.export_files(found, mdh=tmp_path / "arm.toml")
    assert "Files cannot hold own2, own3, own4: their geometry is from a separate fit" in " ".join(written.notes)
    assert "It includes the error of leaving out the model extensions, at most 0." in " ".join(written.notes)
    rigid = ro.calibrate(blank().on(own.data), weight=weight)
    assert np.abs(ro.read_robot(tmp_path / "arm.toml").mdh - rigid.robot.mdh).max() < 1e-9
    known = own.parameters.names.index("own2")  # stated by the problem, not identified
    nominal = np.where(np.arange(len(own.parameters)) == known, 3e-4, own.parameters.nominal)
    stated = own.with_parameters(
        replace(
            own.parameters,
            nominal=nominal,
            identified=own.parameters.identified & ~np.isin(own.parameters.names, own.parameters.terms),
        )
    )
    alone, (said,) = ro.use.geometry_alone(ro.calibrate(stated, weight=weight))
    assert "Files cannot hold own2: " in said
    assert np.abs(alone.robot.mdh - rigid.robot.mdh).max() < 1e-9


@pytest.mark.parametrize("weight", [None, 1.0])
def test_functions_that_need_a_users_term_fit_no_geometry_without_it(weight: float | None, tmp_path: Path) -> None:
    _, own = both("ecc2_cos")
    own = measured(own, noise=SIGMA, own2=3e-4)
    D = np.eye(len(own.parameters.free))
    for functions in (
        {"penalty": lambda z: cp.sum_squares(D @ z)},
        {"penalty": cp.sum_squares, "constraints": (lambda z, p: p.x["own2"] <= 1e-3,)},
    ):
        found = ro.calibrate(own, ro.Formulation("mine", **functions), weight)
        with pytest.raises(
            ro.InputError, match="formulation 'mine': found no fit without own2, own3, own4, which files"
        ):
            ro.use.export_files(found, mdh=tmp_path / "arm.toml")
    assert not (tmp_path / "arm.toml").exists()


def test_commands_are_corrected_for_links_and_a_tool_under_any_payload() -> None:
    terms = [
        ro.robot.Term(
            lambda link, soft: ca.vertcat(0, 0, 0, soft * ca.cross(ca.DM([1, 0, 0]), link.down)),
            {"beam_mrad": 0.1},
            at="link",
            joints=(2, 3),
        ),
        ro.robot.Term(
            lambda tool, soft: soft * tool.payload * 9.81 * ca.vertcat(tool.down, 0, 0, 0),
            {"sag_um_per_N": 50},
            at="tool",
        ),
    ]
    empty = simulated(("a?", "d?"))[0].on(ro.Dataset.of(Q, np.zeros((N, 3)), SIGMA, payload=np.linspace(0, 9, N)))
    problem = measured(empty.with_model(ro.Model(terms)), beam2=3e-3, beam3=-2e-3, sag=5e-5, a2=1e-3)
    result = ro.calibrate(problem, ro.tikhonov, weight=1e-6)
    for carried in (0.0, 7.0):
        found = ro.use.compensate(result, q=Q[:5], orientation=False, payload=carried)
        nominal = (ro.robot.forward_kinematics(ARM, Q[:5]) @ [0.03, -0.02, 0.06, 1])[:, :3]
        there = result.forward(found.q, payload=carried)[:, :3, 3]
        assert found.position_before.min() > 1e-4
        assert np.abs(there - nominal).max() < 1e-7


def test_a_measurement_may_see_joint_values_torques_and_columns() -> None:
    """A tool that measures its own bending: the reading is z, and what the torque of joint 3 and q2 make of it."""

    def seen(T, gain, q, torque, hours):
        return T[2, 3] + gain * torque[2] * q[1] + hours

    kind = ro.data.Measurement(
        "own",
        seen,
        {"z": "length"},
        parameters={"gain": "length"},
        depends_on=("q", "torque", "hours"),
        extra={"hours": ""},
    )
    torque = np.random.default_rng(4).uniform(-10, 10, (N, 6))
    hours = np.linspace(0, 1, N)
    data = ro.Dataset.of(Q, np.zeros((N, 1)), SIGMA, measurement=kind, torque=torque, columns={"hours": hours})
    parameters = ro.robot.model_parameters(ARM, own={"gain": ("length", 0.0)}).identify(["d1", "gain"])
    problem = ro.CalibrationProblem(ARM, parameters, data)
    expected = ro.robot.forward_kinematics(ARM, Q)[:, 2, 3] + 0.01 * torque[:, 2] * Q[:, 1] + hours
    assert np.abs(problem.modelled(np.array([0.0, 0.01]))[0][:, 0] - expected).max() < 1e-14
    with pytest.raises(ro.InputError, match="without 'torque'"):
        problem.on(ro.Dataset.of(Q, np.zeros((N, 1)), SIGMA, measurement=kind, columns={"hours": hours})).residual(
            np.zeros(2)
        )
    with pytest.raises(ro.InputError, match="depends_on: found 'speed'"):
        replace(kind, depends_on=("speed",))


def test_two_points_are_seen_as_two_columns() -> None:
    kind = ro.data.Measurement(
        "difference", lambda T1, T2, q: q[1, 1] - q[1, 0], {"z": "length"}, points=2, depends_on=("q",)
    )
    q = np.stack([Q, Q[::-1]], axis=1)
    parameters = ro.robot.model_parameters(ARM).identify(["d1"])
    problem = ro.CalibrationProblem(ARM, parameters, ro.Dataset.of(q, np.zeros((N, 1)), SIGMA, measurement=kind))
    assert np.array_equal(problem.modelled(np.zeros(1))[0][:, 0], Q[::-1, 1] - Q[:, 1])


def test_a_problem_file_identifies_and_scales_what_a_script_adds(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    ro.robot.write_robot(ARM, folder / "robot.toml")
    header = [*(f"q{i}_deg" for i in range(1, 7)), "x_mm", "y_mm", "z_mm", "hours"]
    rows = np.column_stack([np.degrees(Q), np.zeros((N, 3)), np.arange(N)])
    text = "\n".join([",".join(header), *(",".join(map(repr, row.tolist())) for row in rows)])
    (folder / "identification.csv").write_text(text)
    (folder / "problem.toml").write_text(
        'title = "mine"\nidentification = "identification.csv"\nidentify = ["d?", "drift2"]\n'
        "[noise]\nposition_mm = 0.05\n[scale]\ndrift2_mrad = 0.3\n"
    )
    drift = ro.robot.Term(
        lambda joint, rate: rate * joint.column("hours"), {"drift_mrad": 0.1}, joints=(2,), columns={"hours": ""}
    )
    problem = ro.load(folder, model=ro.Model([drift])).problem
    assert problem.parameters.free.names[-1] == "drift2"
    assert problem.parameters.free.scale[-1] == pytest.approx(3e-4)
    with pytest.raises(ro.InputError, match="column 'hours'"):
        ro.load(folder)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: ro.robot.Term(lambda j, s: s, {"play": 1.0}), "no unit of the right dimension"),
        (lambda: ro.robot.Term(lambda j, s: s, {"play_mm_per_m": 1.0}), "no unit of the right dimension"),
        (lambda: ro.robot.Term(lambda j, s: s, {"play_mrad": 0.0}), "greater than zero"),
        (lambda: ro.robot.Term(lambda j, s: s, {"play_mrad": "much"}), "a finite number"),
        (lambda: ro.robot.Term(lambda j, s: s, {"tool_play_mrad": 1.0}), "a name that parameters cannot have"),
        (lambda: ro.robot.Term(lambda j, s: s, {"wave3_mrad": 1.0}), "no digit at the end"),
        (lambda: ro.robot.Term(lambda j, s: s, {"sag_rx_mrad": 1.0}, at="tool"), "a name that parameters cannot have"),
        (lambda: ro.robot.Term(lambda j, s: s, {"play_mrad": 1.0, "play_mm": 1.0}), "one name in two units"),
        (lambda: ro.robot.Term(lambda j, s: s, {"play_mrad": 1.0}, at="elbow"), "'joint', 'link', 'base', 'tool'"),
        (lambda: ro.robot.Term(lambda j, s: s, {"play_mrad": 1.0}, nominal={"gap_mrad": 1.0}), "a key of its scales"),
        (lambda: ro.robot.Term(lambda j, s: s, {"play_mrad": 1.0}, columns={"t": "heat"}), "column t"),
        (lambda: ro.Model([ro.robot.Term(lambda j, s: s, {"play_mrad": 1.0})] * 2), "'play' twice"),
        (lambda: blank().with_model(ro.Model([ro.robot.Term(lambda j, s: s, {"ratio_ppm": 1.0})])), "'ratio1'"),
        (lambda: blank().with_model(ro.Model([ro.robot.Term(lambda j, s: s, {"p_mm": 1.0})]), ["gap*"]), "'gap"),
        (
            lambda: blank().with_model(ro.Model([ro.robot.Term(lambda j, s: [s, s], {"p_mrad": 1.0})])),
            "found 2 numbers, accepted: 1",
        ),
        (
            lambda: blank().with_model(ro.Model([ro.robot.Term(lambda j, s: s * j.column("t"), {"p_mrad": 1.0})])),
            "column 't'",
        ),
        (
            lambda: blank().with_model(ro.Model([ro.robot.Term(lambda j, s: s + 1e-2, {"p_mrad": 1.0})])),
            "a motion of 0.01 rad or m with all parameters zero",
        ),
        (
            lambda: ro.Model(
                [
                    ro.robot.Term(lambda j, s: s, {"p_mm": 1.0}, columns={"t": ""}),
                    ro.robot.Term(lambda j, s: s, {"g_mm": 1.0}, columns={"t": "length"}),
                ]
            ),
            "column 't' in two dimensions",
        ),
    ],
)
def test_what_cannot_be_is_said_in_a_sentence(make: Callable, sentence: str) -> None:
    with pytest.raises(ro.InputError, match=sentence.replace("(", r"\(")):
        make()


def test_backlash_of_a_users_own_needs_directions() -> None:
    moves, scales = OWN["backlash"]
    problem, _ = simulated(ALL)
    with pytest.raises(ro.InputError, match="without directions of approach"):
        problem.with_model(ro.Model([ro.robot.Term(moves, scales)]))


@pytest.mark.parametrize(
    "moves",
    [
        lambda joint, size: size * joint.speed,
        lambda joint: joint.q,
        lambda joint, size: size if joint.q > 0 else -size,
    ],
)
def test_a_term_that_cannot_be_called_is_refused(moves: Callable) -> None:
    term = ro.robot.Term(moves, {"odd_mrad": 0.1})
    with pytest.raises(ro.InputError, match=r"term 'odd'.*accepted: moves\(joint, odd\)"):
        ro.load("position").problem.with_model(ro.Model([term]))
