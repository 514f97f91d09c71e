"""Checks over time: no drift where there is none, and where there is one, since when and of what."""

from __future__ import annotations

import json
import re
from base64 import b64decode
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.basics import InputError
from rpim_opt.basics.tables import csv_text
from rpim_opt.data.tables.joining import seconds, time_column
from rpim_opt.use.monitoring import cusum, cusum_limit
from tests.calibration.mistakes import simulated_arm
from tests.simulate import simulated
from tests.test_cli import run

SIGMA = 5e-5
FIRST, PLACES, CHECKS = 40, 6, 24


@cache
def calibrated(seed: int) -> tuple[ro.calibration.Calibration, np.ndarray, np.ndarray]:
    """Return a calibration, the true deviations, and places where the arm is checked."""
    problem, truth = simulated(configurations=FIRST + PLACES, noise=SIGMA, seed=seed)
    first = problem.on(problem.data.take(np.arange(FIRST)))
    return ro.calibrate(first, ro.tikhonov, weight=1.0), truth, problem.data.q[FIRST:]


def checked(
    seed: int, course: np.ndarray, *names: str, around: float = 0.0
) -> tuple[ro.calibration.Calibration, ro.Dataset]:
    """Return a calibration, and checks of its arm while parameters, theta3 by default, move by a course (N,) [SI].

    They are ``around`` one place if that is a standard deviation of joints [rad].
    """
    result, truth, places = calibrated(seed)
    k = np.flatnonzero(np.isin(result.problem.parameters.free.names, names or ("theta3",)))
    q = places[np.arange(len(course)) % PLACES]
    if around:
        q = places[:1] + around * np.random.default_rng(seed).normal(size=q.shape)
    problem = result.problem.on(ro.Dataset.of(q, np.zeros((len(q), 3)), SIGMA))
    y = []
    for i, moved in enumerate(course):
        x = truth.copy()
        x[k] += moved
        y.append(-problem.residual(x).reshape(-1, 3)[i])
    noise = SIGMA * np.random.default_rng([seed, 5]).normal(size=(len(q), 3))
    return result, ro.Dataset.of(q, np.array(y) + noise, SIGMA)


def test_a_robot_that_stays_as_it_is() -> None:
    found = ro.use.monitor(*checked(0, np.zeros(CHECKS)))
    assert not found.drifts
    assert found.content()["moved"] is None
    assert str(found).startswith("No drift in 24 checks.")


def test_checks_of_a_robot_that_is_not_delivered_say_so() -> None:
    """No drift was the answer of intervals of 60 mm."""
    result, data = checked(0, np.zeros(CHECKS))
    (block,) = result.problem.data.blocks
    off = 0.02 * np.random.default_rng(1).normal(size=block.y.shape)
    shaken = result.problem.on(replace(result.problem.data, blocks=(replace(block, y=block.y + off),)))
    found = ro.use.monitor(ro.calibrate(shaken), data)
    assert str(found).splitlines()[0] == "No drift in 24 checks."
    assert "The calibration is not delivered: its prediction intervals may hide a change of the robot." in str(found)
    assert not ro.use.monitor(result, data).undelivered


def test_a_step_is_found_with_its_moment_and_size() -> None:
    found = ro.use.monitor(*checked(1, np.where(np.arange(CHECKS) >= 12, 5e-4, 0.0)))
    assert found.drifts
    assert found.alarm is not None
    assert 12 <= found.alarm <= 16
    drift = found.drift
    assert drift is not None
    assert (drift.cause.name, drift.first, drift.steady) == ("theta3", 12, False)
    assert drift.moved is not None
    assert abs(drift.moved.change - 5e-4) < 4 * drift.moved.std


@pytest.mark.parametrize("moves", [False, True])
def test_one_wrong_check_of_a_place_is_named_and_no_other(moves: bool) -> None:
    """Six places are checked four times; one reading is 0.8 mm off, and `update` leaves that one out."""
    result, data = checked(0, np.full(CHECKS, 1e-3 * moves))
    (block,) = data.blocks
    y = block.y.copy()
    y[14, 0] += 8e-4
    data = replace(data, blocks=(replace(block, y=y),))
    updated = ro.use.update(result, data)
    readings = [cause for cause in updated.changes if cause.kind == "reading"]
    assert [cause.members for cause in readings] == [(data.label[14],)]
    assert updated.changed == moves
    if not moves:
        found = ro.use.monitor(result, data)
        assert [cause.members for cause in found.wrong] == [(data.label[14],)]
        assert (found.drift, found.alarm, found.beyond) == (None, None, (14,))
        assert str(found).startswith("No drift in 23 of 24 checks; the others are wrong readings.")


@pytest.mark.parametrize("first", [50, 51, 52])
def test_a_step_among_ninety_checks_is_found_at_its_own(first: int) -> None:
    """Forty moments are tried first; one beside the true one shifts the change by many standard deviations."""
    result, data = checked(0, np.where(np.arange(90) >= first, 1e-3, 0.0))
    drift = ro.use.monitor(result, data).drift
    assert drift is not None
    assert (drift.cause.name, drift.first) == ("theta3", first)
    assert drift.moved is not None
    assert abs(drift.moved.change - 1e-3) < 4 * drift.moved.std


def test_a_wrong_check_beside_a_change_is_named_and_raises_no_alarm_of_its_own() -> None:
    result, data = checked(1, np.where(np.arange(CHECKS) >= 12, 3e-3, 0.0))
    (block,) = data.blocks
    found = ro.use.monitor(
        result, replace(data, blocks=(replace(block, y=block.y + 1e-3 * np.eye(CHECKS)[:, [4, 4, 4]]),))
    )
    assert [cause.members for cause in found.wrong] == [(data.label[4],)]
    assert found.drift is not None
    assert (found.drift.cause.name, found.drift.first, found.since) == ("theta3", 12, 12)


def test_a_step_is_before_the_first_reading_of_its_configuration() -> None:
    """Three reflectors are read in one configuration: a step before the second of them is one before the first."""
    problem = simulated_arm("ur5e", count=50, markers=3)
    p, data = problem.parameters, problem.data
    slipped = np.where(np.array(p.free.names) == "theta3", 1e-3, 0.0)
    moved = problem.modelled(slipped)
    blocks = [
        replace(block, y=block.y + np.where(np.arange(50)[:, None] >= 45, far - near, 0.0))
        for block, far, near in zip(data.blocks, moved, problem.modelled(0 * slipped), strict=True)
    ]
    order = np.argsort(data.configuration, kind="stable")
    result = ro.calibrate(problem.on(data.take(order[:120])), "tikhonov", 1.0)
    checks = replace(data, blocks=tuple(blocks)).take(order[120:])
    drift = ro.use.monitor(result, checks).drift
    assert drift is not None
    assert (drift.cause.name, checks.label[drift.first]) == ("theta3", checks.label[15])


@pytest.mark.parametrize("common", [True, False], ids=["of the robot", "of each seat"])
def test_an_error_in_position_is_common_to_the_reflectors_of_a_stop(common: bool) -> None:
    """Joints of a SCARA do not explain it: as one of each reading, it raised alarms in these three of ten cases."""
    robot = ro.load("scara").problem.robot
    for seed in (0, 2, 4):
        problem = simulated_arm(robot, seed, count=60, markers=3)
        rng = np.random.default_rng([seed, 7])
        stops, seats = 8e-5 * rng.normal(size=(2, 3, 60, 3))
        errors = zip(problem.data.blocks, (stops[0],) * 3 if common else seats, strict=True)
        data = replace(problem.data, blocks=tuple(replace(block, y=block.y + error) for block, error in errors))
        data = data.take(np.argsort(data.configuration, kind="stable"))
        result = ro.calibrate(problem.on(data.take(np.arange(120))))
        assert result.learned is not None
        noise = {kind: size.value for kind, size in result.learned.noise.items()}
        assert (noise["position"] > noise["reading"]) == common
        assert max(noise["position"], noise["reading"]) == pytest.approx(8e-5, rel=0.25)
        found = ro.use.monitor(result, data.take(np.arange(120, 180)))
        assert not found.drifts, seed
        assert not found.beyond, seed


def test_a_slow_drift_is_linear_in_time() -> None:
    """Its ramp followed the rows, six of which are read on a day: 10 % too much, or a step where a visit came late."""
    month = np.array([0.0, 4.0, 5.0, 6.0])[np.arange(CHECKS) // PLACES]
    found = ro.use.monitor(*checked(2, 1e-3 / 6 * month), 86400 * 30 * month)
    assert found.drift is not None
    assert (found.drift.cause.name, found.drift.steady) == ("theta3", True)
    assert found.drift.moved is not None
    assert abs(found.drift.moved.change - 1e-3) < 3 * found.drift.moved.std


def test_a_slow_drift_is_no_step() -> None:
    found = ro.use.monitor(*checked(2, np.linspace(0, 1e-3, CHECKS)))
    assert found.drift is not None
    assert (found.drift.cause.name, found.drift.steady) == ("theta3", True)
    assert "steadily" in str(found)


@pytest.mark.parametrize(("moved", "names"), [((1e-3, 1e-3, 1e-3), ["base"]), ((0.0, 0.0, 2e-3), ["d1", "base"])])
def test_a_base_that_moved_is_no_link_that_grew(moved: tuple[float, ...], names: list[str]) -> None:
    """What a frame of six numbers and one of the arm explain alike is said of both."""
    result, data = checked(3, np.zeros(CHECKS))
    (block,) = data.blocks
    found = ro.use.monitor(result, replace(data, blocks=(replace(block, y=block.y + np.array(moved)),)))
    assert found.drift is not None
    assert sorted([found.drift.cause.name, *found.drift.others]) == sorted(names)
    assert "the instrument or the base moved" in str(found)


def test_a_base_far_away_is_compared_without_a_fit(caplog) -> None:
    """A fit of a robot that did not move took 256 iterations, and figures of the comparison eleven digits."""
    result, data = checked(3, np.zeros(CHECKS))
    (block,) = data.blocks
    y = block.y @ Rotation.from_rotvec([0.0, 0.0, 1.7]).as_matrix().T + np.array([-1.5, 4.2, -0.1])
    with caplog.at_level("INFO", logger="rpim_opt"):
        found = ro.use.monitor(result, replace(data, blocks=(replace(block, y=y),)))
    assert found.mistake.startswith("Likely: the instrument or the base moved.")
    assert "iteration" not in caplog.text
    assert re.search(r"frame base, before the first check: chi-squared falls by [1-9]\d\d,000,000", str(found))


def test_an_instrument_that_was_set_up_anew_is_no_change_of_the_arm_where_the_base_was_not_identified() -> None:
    """The checks' frame was the robot's own: a link of 0.5 mm more, or of 0.3 m, was named."""
    instance = ro.load("paper_arm")
    result, data = instance.calibrate(), instance.validation
    (block,) = data.blocks
    for angle, shift in ((3e-4, 5e-4), (0.3, 0.3)):
        turn = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
        y = block.y @ turn.T + np.array([shift, -0.7 * shift, 0.3 * shift])
        found = ro.use.monitor(result, replace(data, blocks=(replace(block, y=y),)))
        assert found.mistake.startswith("Likely: the instrument or the base moved.")
        assert found.drift is not None
        assert found.drift.cause.name == "base"


def test_a_joint_that_slipped_is_no_moved_base() -> None:
    """Though checks of one region are displaced as a whole, nearly: a joint leaves clearly less of chi-squared."""
    result, data = checked(1, np.full(CHECKS, 1e-3), around=0.2)
    found = ro.use.monitor(result, data)
    assert found.drift is not None
    assert (found.drift.cause.name, found.mistake) == ("theta3", "")
    validated = ro.use.validate(result, data)
    assert re.match(r"Likely: theta3 changed: that leaves chi-squared \d+", validated.mistake)
    assert "--register in" not in str(found) + str(validated)
    accepted = ro.calibration.accept(result, ro.data.Requirement(limit=2e-4), data)  # which does not compare them
    assert "Likely" not in str(accepted)
    assert "If neither moved, the robot changed, and --register would hide that." in str(accepted)


@pytest.mark.parametrize("name", ["theta3", "theta5"])
def test_a_zero_that_changed_before_the_checks_is_no_backlash_of_another_joint(name: str) -> None:
    """Registered again, checks from two sides look like another joint's backlash, or like a loose reflector."""
    problem = simulated_arm("ur5e", count=100)
    result = ro.calibrate(problem.on(problem.data.take(np.arange(60))))
    checks = problem.on(problem.data.take(np.arange(60, 100)))
    changed = np.where(np.array(problem.parameters.free.names) == name, 2e-3, 0.0)
    by_change = checks.modelled(changed)[0] - checks.modelled(np.zeros(len(changed)))[0]
    (block,) = checks.data.blocks
    found = ro.use.monitor(result, replace(checks.data, blocks=(replace(block, y=block.y + by_change),)))
    assert found.drift is not None
    assert found.drift.cause.name == name
    assert not found.mistake


def test_a_plate_moves_all_its_reflectors() -> None:
    """Configurations were wrong one by one, beside a base that had moved."""
    problem = ro.load("markers").problem
    half = problem.data.configuration < np.median(problem.data.configuration)
    result = ro.calibrate(problem.on(problem.data.take(np.flatnonzero(half))))
    checks = problem.on(problem.data.take(np.flatnonzero(~half)))
    names = problem.parameters.free.names
    moved = np.array([5e-4 * (name.startswith("tool") and name.endswith("_x")) for name in names])
    moved += [-3e-4 * (name.startswith("tool") and name.endswith("_y")) for name in names]
    moves = zip(checks.data.blocks, checks.modelled(moved), checks.modelled(np.zeros(len(names))), strict=True)
    blocks = tuple(replace(block, y=block.y + there - here) for block, there, here in moves)
    found = ro.use.monitor(result, replace(checks.data, blocks=blocks))
    assert found.drift is not None
    assert found.drift.cause.name == "all reflectors"
    assert not found.wrong


@pytest.mark.parametrize("names", [("tool_x", "tool_y", "tool_z", "theta3"), ("theta2", "theta3", "tool_x", "tool_z")])
def test_readings_after_several_changes_are_not_wrong_by_themselves(names: tuple[str, ...]) -> None:
    """Fifteen of 24 right ones were, the same places at every visit, beside one of the changes."""
    found = ro.use.monitor(*checked(2, np.where(np.arange(48) >= 24, 1e-3, 0.0), *names))
    assert (found.drift, found.wrong) == (None, ())
    assert "No single parameter or frame explains the deviation. Recalibrate by `update`." in str(found)


def test_update_and_monitor_say_one_size_of_a_change() -> None:
    """What the first calibration did not know of a joint offset is no part of its change."""
    result, data = checked(4, np.full(CHECKS, 5e-4))
    drift, (moved,) = ro.use.monitor(result, data).drift, ro.use.update(result, data).moved
    assert drift is not None
    assert drift.moved is not None
    assert moved.name == drift.cause.name == "theta3"
    assert moved.change == pytest.approx(drift.moved.change, abs=0.1 * moved.std)
    assert moved.std == pytest.approx(drift.moved.std, rel=0.01)
    assert abs(moved.change - 5e-4) < 4 * moved.std


def set_up_anew(data: ro.Dataset) -> ro.Dataset:
    """Return checks by an instrument that stands elsewhere at each round of the places."""
    (block,) = data.blocks
    number = np.arange(len(data)) // PLACES
    rng = np.random.default_rng(8)
    turns = Rotation.from_rotvec(rng.normal(size=(len(data), 3)))[number]
    y = turns.apply(block.y) + rng.normal(size=(len(data), 3))[number]
    return ro.Dataset.of(block.q[:, 0], y, SIGMA, session=[f"M{i}" for i in number])


def test_a_link_that_was_bent_is_no_plate_of_reflectors_that_moved() -> None:
    """On a gantry's head, two of three reflectors once a visit: moved reflectors explained enough, a link far more."""
    turn = np.pi / 2
    mdh = np.zeros((5, 5))
    mdh[:, 0] = -turn, turn, turn, 0.0, turn
    mdh[:, 2] = turn, turn, 0.0, 0.0, 0.0
    mdh[3, 3] = 0.25
    gantry = ro.robot.Robot("gantry", mdh, ("prismatic",) * 3 + ("revolute",) * 2)
    rng = np.random.default_rng(4)
    arm = replace(gantry, mdh=mdh + rng.normal(size=(5, 5)) * [1e-3, 5e-4, 1e-3, 5e-4, 0.0])
    bent = np.zeros((5, 5))
    bent[3, 2], bent[4, :4] = -8e-4, (1.1e-3, 2.5e-4, 1.3e-3, 1e-4)
    tools = {"R1": [0.05, 0.03, 0.2], "R2": [-0.04, 0.05, 0.17], "R3": [0.02, -0.06, 0.22]}

    def readings(robot: ro.robot.Robot, q: np.ndarray, names: list[list[str]], **session: list[str]) -> ro.Dataset:
        """Return readings of some reflectors at every configuration, in a frame of its own if ``session`` is stated."""
        each = np.repeat(q, [len(some) for some in names], axis=0)
        marker = [name for some in names for name in some]
        places = np.array([[*tools[name], 1.0] for name in marker])
        y = np.einsum("nij,nj->ni", ro.robot.forward_kinematics(robot, each), places)[:, :3]
        if session:
            y = Rotation.from_rotvec(0.3 * rng.normal(size=3)).apply(y) + rng.normal(size=3)
        y += 3e-5 * rng.normal(size=y.shape)
        return ro.Dataset.of(each, y, 3e-5, marker=marker, **{name: ids * len(y) for name, ids in session.items()})

    def places(count: int) -> np.ndarray:
        return rng.uniform([0, 0, 0, -3, -1.8], [5, 2.5, 1.2, 3, 1.8], (count, 5))

    problem = ro.problem_from(
        gantry, readings(arm, places(40), [[*tools]] * 40), tool={m: [*at, 0, 0, 0] for m, at in tools.items()}
    )
    q, names = places(8), [[*tools], *[["R1"]] * 7]
    later = replace(arm, mdh=arm.mdh + bent)
    visits = [readings(robot, q, names, session=[f"M{k}"]) for k, robot in enumerate([arm] * 3 + [later] * 3)]
    result = ro.calibrate(problem)
    found = ro.use.monitor(result, ro.Dataset.together(visits, [v.session[0] for v in visits]), register=True)
    assert found.drift is not None
    assert (found.drift.cause.name, found.wrong) == ("link between joints 4 and 5", ())
    assert "Changed zeros of joint 1, joint 2 and joint 3 look like such a motion" in str(found)
    # another joint's backlash was likely, which leaves far more
    checked = ro.use.validate(result, readings(later, places(20), [[*tools]] * 20))
    assert checked.mistake.startswith("Likely: link between joints 4 and 5 changed: that leaves chi-squared ")


@pytest.mark.parametrize(("checks", "first"), [(CHECKS, 12), (PLACES, 0)])
def test_a_change_is_found_where_the_instrument_is_set_up_anew_each_time(checks: int, first: int) -> None:
    """One motion was fitted to all set-ups; of a single one it took a part of the change, by ten deviations."""
    result, data = checked(1, np.zeros(checks))
    assert not ro.use.monitor(result, set_up_anew(data), register=True).drifts
    if checks > PLACES:
        mistake = ro.use.monitor(result, set_up_anew(data)).mistake
        assert mistake.endswith("moved between sessions M0, M1, M2, M3. Use --register.")
    result, data = checked(1, np.where(np.arange(checks) >= first, 2e-3, 0.0))
    drift = ro.use.monitor(result, set_up_anew(data), register=True).drift
    assert drift is not None
    assert (drift.cause.name, drift.first) == ("theta3", first)
    assert drift.moved is not None
    assert abs(drift.moved.change - 2e-3) < 3 * drift.moved.std


def test_one_wrong_check_is_named() -> None:
    result, data = checked(0, np.zeros(CHECKS))
    block = data.blocks[0]
    y = block.y.copy()
    y[7] += 1e-3
    found = ro.use.monitor(result, ro.Dataset.of(block.q[:, 0], y, SIGMA))
    assert found.beyond == (7,)


def test_checks_in_another_unit_are_no_drift() -> None:
    result, data = checked(0, np.zeros(CHECKS))
    assert ro.use.monitor(result, data).mistake == ""
    (block,) = data.blocks
    found = ro.use.monitor(result, replace(data, blocks=(replace(block, y=block.y / 1e3),)))
    assert found.drifts
    assert (
        "with measured lengths a thousand times larger: name the columns x_m, y_m, z_m, or multiply an array by 1000; "
        in found.mistake
    )
    assert found.mistake in str(found)
    assert found.content()["mistake"] == found.mistake


def test_times_order_the_checks() -> None:
    result, data = checked(1, np.where(np.arange(CHECKS) >= 12, 5e-4, 0.0))
    order = np.random.default_rng(0).permutation(CHECKS)
    found = ro.use.monitor(result, data)
    shuffled = ro.use.monitor(result, data.take(order), 86400.0 * order)
    np.testing.assert_allclose(shuffled.sums, found.sums, atol=1e-6)
    with pytest.raises(InputError, match="monitor, when: found shape"):
        ro.use.monitor(result, data, np.zeros(3))


def test_the_limit_is_passed_as_rarely_as_it_says() -> None:
    """5000 draws of 30 deviates, of which one in twenty passes: within four standard deviations of that."""
    h = cusum_limit(30, 0.05)
    draws = np.random.default_rng(3).normal(size=(5000, 30))
    passed = np.mean([cusum(each).max() > h for each in draws])
    assert abs(passed - 0.05) < 4 * np.sqrt(0.05 * 0.95 / 5000)


def test_times_of_tables() -> None:
    assert time_column(["q1_deg", "Timestamp", "x_mm"]) == "Timestamp"
    assert time_column(["theta1", "x_mm", "tool"]) is None
    assert seconds("t [ms]", ["0", "1500"]).tolist() == [0.0, 1.5]
    assert np.ptp(seconds("stamp", ["1700000000000000000", "1700000001000000000"])) == pytest.approx(1.0)
    assert np.ptp(seconds("date", ["2026-03-01 10:00", "2026-03-01T10:01:00+00:00"])) == 60
    assert np.ptp(seconds("Datum", ["2026-03-01 10:00:00.5", "01.03.2026 10:01:00,500"])) == 60
    for text in ("noon", "1_000"):  # which is no number in any other column, either
        with pytest.raises(InputError, match=f"column 'time', row 2: found '{text}'"):
            seconds("time", ["0", text])


def test_the_command(monkeypatch, capsys, tmp_path) -> None:
    result, data = checked(1, np.where(np.arange(CHECKS) >= 12, 5e-4, 0.0))
    ro.store.save_result(result, tmp_path / "result.json")
    block = data.blocks[0]
    columns = {"date": [f"2026-03-{i + 1:02}" for i in range(CHECKS)]}
    columns |= {f"q{i + 1}_rad": [repr(float(v)) for v in block.q[:, 0, i]] for i in range(6)}
    columns |= {f"{axis}_m": [repr(float(v)) for v in block.y[:, i]] for i, axis in enumerate("xyz")}
    file = tmp_path / "checks.csv"
    file.write_text(csv_text(list(columns), zip(*columns.values(), strict=True)), encoding="utf-8")
    page = tmp_path / "checks.html"
    assert run(monkeypatch, "monitor", str(tmp_path), str(file), "--out", str(page), "--json") == 1
    document = json.loads(capsys.readouterr().out)
    assert document["moved"]["name"] == "theta3"
    assert document["rows"][0]["time"] == "2026-03-01"
    assert document["left_out"] == []
    text = page.read_text(encoding="utf-8")
    charts = [b64decode(chart).decode() for chart in re.findall(r"svg\+xml;base64,([^\"]+)", text)]
    assert all("days since the first check" in chart for chart in charts)
    assert len(charts) == 2
    assert text.count("<tr>") == 1 + CHECKS
    assert run(monkeypatch, "monitor", str(tmp_path), str(file), "--out", str(tmp_path / "checks.csv.txt")) == 2
    assert "ends in .html or .csv" in capsys.readouterr().err


@pytest.mark.parametrize("decimal", [".", ","])
def test_german_dates_are_no_numbers(decimal: str, monkeypatch, capsys, tmp_path) -> None:
    """Of five months, by day of the month they would be in another order."""
    result, data = checked(1, np.where(np.arange(CHECKS) >= 12, 5e-4, 0.0))
    ro.store.save_result(result, tmp_path / "result.json")
    block = data.blocks[0]
    dates = [f"{28 - 3 * (i % 5):02}.{1 + i // 5:02}.2026" for i in range(CHECKS)]
    dates.sort(key=lambda date: (date[3:5], date[:2]))
    rows = zip(dates, np.hstack([block.q[:, 0], block.y]), strict=True)
    lines = ["Datum;" + ";".join([*(f"q{i + 1}_rad" for i in range(6)), "x_m", "y_m", "z_m"])]
    lines += [";".join([date, *(f"{v:.7f}".replace(".", decimal) for v in row)]) for date, row in rows]
    (tmp_path / "checks.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert run(monkeypatch, "monitor", str(tmp_path), str(tmp_path / "checks.csv"), "--json") == 1
    document = json.loads(capsys.readouterr().out)
    assert document["moved"]["name"] == "theta3"
    assert document["moved"]["first"] == 12
    assert [row["time"] for row in document["rows"]] == dates
