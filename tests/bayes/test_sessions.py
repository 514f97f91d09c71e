"""Sessions: readings of one share a shift and a turn of the registration, with sizes that the data tell (simulated)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.calibration.acceptance import inconclusive, measured_workspace
from rpim_opt.calibration.lack_of_fit import lack_of_fit
from rpim_opt.calibration.uncertainty import held_out_errors
from rpim_opt.problem import PartitionedProblem
from rpim_opt.problem.multi_robot import unknown_sessions
from rpim_opt.robot import model_parameters
from rpim_opt.robot.parameters import of_session
from rpim_opt.study.arms import BASE, KINDS, SCALES, TOOL

SHIFT, TURN = 3e-4, 1e-4
"""Standard deviations [m, rad] of a session's shift along, and of its turn about, an axis."""
NOISE = 3e-5


def turned(points: Array, shift: Array, turn: Array) -> Array:
    """Return points (N, 3) as an instrument reads them whose registration is off, about the robot's base."""
    base = np.array(BASE[:3])
    return (points - base) @ Rotation.from_rotvec(turn).as_matrix().T + base + shift


def in_sessions(seed: int, names: list[str], size: float = 1.0) -> ro.CalibrationProblem:
    """Return a simulated arm whose rows were measured in the sessions of these names, one a row."""
    problem = ro.study.simulated_arm(seed, len(names)).problem
    rng = np.random.default_rng([seed, 99])
    y = problem.data.blocks[0].y.copy()
    for name in dict.fromkeys(names):
        mine = np.array(names) == name
        shift, turn = SHIFT * rng.standard_normal(3), TURN * rng.standard_normal(3)
        y[mine] = turned(y[mine], size * shift, size * turn)
    return told(problem, seed, ro.Dataset.of(problem.data.q, y, NOISE, session=names))


def told(problem: ro.CalibrationProblem, seed: int, data: ro.Dataset) -> ro.CalibrationProblem:
    """Return the problem with data that name sessions, and with their parameters in its table."""
    tools = {"": list(TOOL)}
    table = model_parameters(problem.robot, list(BASE), tools, sessions=data.sessions).scaled(SCALES)
    identified = ["alpha?", "a?", "d?", "theta?", *KINDS[list(KINDS)[seed % 3]], "base_*", "tool_[xyz]"]
    return ro.CalibrationProblem(problem.robot, table.identify(identified), data)


def with_sessions(problem: ro.CalibrationProblem) -> ro.CalibrationProblem:
    """Return the problem that identifies the sessions, too, as ``session_*`` in a file does."""
    p = problem.parameters
    return problem.with_parameters(p.identify([*p.free.names, "session_*"]))


def off(result: ro.Calibration, arm: ro.study.SimulatedArm) -> float:
    """Return the RMS [m] of unseen positions after the best registration: what the robot itself is off."""
    true = arm.true.blocks[0].y
    found = result.problem.on(arm.true).modelled(result.x)[0]
    centred, wanted = found - found.mean(axis=0), true - true.mean(axis=0)
    turn, _ = Rotation.align_vectors(wanted, centred)
    return float(np.sqrt(np.mean(np.sum((turn.apply(centred) - wanted) ** 2, axis=1))))


DAYS = [f"day {1 + i // 10}" for i in range(40)]
SEED = 3


@pytest.fixture(scope="module")
def arm() -> ro.study.SimulatedArm:
    return ro.study.simulated_arm(SEED, len(DAYS))


@pytest.fixture(scope="module")
def problem() -> ro.CalibrationProblem:
    return in_sessions(SEED, DAYS)


@pytest.fixture(scope="module")
def automatic(problem: ro.CalibrationProblem) -> ro.Calibration:
    return ro.calibrate(problem, model="auto")


@pytest.fixture(scope="module")
def geometric(problem: ro.CalibrationProblem) -> ro.Calibration:
    return ro.calibrate(problem)


def test_the_evidence_takes_sessions_and_says_how_they_differ(automatic: ro.Calibration) -> None:
    learned = automatic.learned
    assert learned is not None
    assert learned.extensions == ("sessions",)
    assert learned.gain("sessions") > 100
    for kind, true in (("shifts", SHIFT), ("turns", TURN)):  # twelve draws each
        size = learned.scales[f"sessions' {kind}"]
        assert abs(np.log(1e-4 * size.value / true)) < 2.5 * size.log_std
        assert 0.15 < size.log_std < 0.5  # of twelve numbers 1 / sqrt(24) = 0.2
    assert "Session offsets (1 sigma): 0." in str(automatic)


def test_the_robot_is_found_as_if_the_instrument_had_not_been_moved(
    arm: ro.study.SimulatedArm, automatic: ro.Calibration, geometric: ro.Calibration
) -> None:
    still = ro.calibrate(arm.problem)
    assert off(automatic, arm) < 1.15 * off(still, arm)  # 18 of 120 equations tell the sessions: 1.08
    assert off(geometric, arm) > 4 * off(still, arm)


def test_lack_of_fit_proposes_sessions_and_then_is_content(
    automatic: ro.Calibration, geometric: ro.Calibration
) -> None:
    found = lack_of_fit(geometric)
    assert found.missing == ("sessions",)
    assert "add session_* to `identify`" in str(found)
    after = lack_of_fit(automatic)
    assert not after.alarming
    assert "The registration differs from session to session" in str(after)


def test_sessions_that_do_not_differ_are_not_taken_and_do_no_harm() -> None:
    same = in_sessions(SEED, DAYS, size=0.0)
    learned = ro.calibrate(same, model="auto").learned
    assert learned is not None
    assert "sessions" not in learned.extensions
    seen = ro.study.simulated_arm(SEED, len(DAYS))
    explicit = ro.calibrate(with_sessions(same))
    assert off(explicit, seen) < 1.02 * off(ro.calibrate(same), seen)
    assert "Session offsets (1 sigma): at most" in str(explicit)


@pytest.mark.slow
def test_sessions_that_do_not_differ_are_rarely_taken() -> None:
    taken = []
    for seed in range(300, 340):
        learned = ro.calibrate(in_sessions(seed, DAYS, size=0.0), model="auto").learned
        assert learned is not None
        taken.append("sessions" in learned.extensions)
    assert sum(taken) <= 1


def test_names_and_order_of_the_rows_do_not_matter(problem: ro.CalibrationProblem) -> None:
    plain = ro.calibrate(with_sessions(problem), weight=1.0)
    data = problem.data
    order = np.random.default_rng(0).permutation(len(data))
    renamed = [f"({chr(100 - int(name[-1]))}) ä {name[-1]}" for name in DAYS]
    block = replace(data.blocks[0], session=np.array(renamed, dtype=object))
    shuffled = replace(data, blocks=(block,)).take(order)
    other = ro.calibrate(with_sessions(told(problem, SEED, shuffled)), weight=1.0)
    own = ~plain.problem.parameters.free.of_frames
    assert np.allclose(other.x[own], plain.x[own], atol=1e-9)


@pytest.mark.parametrize("names", [["only"] * 12, [str(i) for i in range(12)]])
def test_one_session_and_sessions_of_one_configuration_are_harmless(names: list[str]) -> None:
    problem = in_sessions(SEED, names)
    learned = ro.calibrate(problem, model="auto").learned
    assert learned is not None
    assert "sessions" not in learned.extensions
    explicit = ro.calibrate(with_sessions(problem))
    assert explicit.converged
    assert np.isfinite(explicit.x).all()


def test_a_known_session_has_its_shift_and_an_unknown_one_a_wider_interval(
    automatic: ro.Calibration, problem: ro.CalibrationProblem
) -> None:
    data = problem.data
    unknown = replace(data, blocks=(replace(data.blocks[0], session=None),))
    assert automatic.errors(data).mean() < 0.2 * automatic.errors(unknown).mean()
    assert all((V == 0).all() for V in unknown_sessions(automatic.problem))
    more = unknown_sessions(automatic.problem.on(unknown))[0]
    free = automatic.problem.parameters.free
    size = free.scale[free.names.index("session_day_1_x")]
    assert (np.einsum("nkk->nk", more) >= size**2 * (1 - 1e-12)).all()
    sigmas = ro.use.validate(automatic, unknown).sigmas
    assert np.nanmax(sigmas) < 4  # the interval of a reading knows of it
    q = data.q[:3]
    standard = {of: automatic.predict(q, of=of).standard for of in ("reached", "reading")}
    assert (standard["reading"] > size).all()
    assert (standard["reached"] < standard["reading"]).all()


def test_intervals_of_readings_cover_in_new_sessions(arm: ro.study.SimulatedArm, automatic: ro.Calibration) -> None:
    rng = np.random.default_rng(5)
    rows = arm.true.blocks[0]
    y = np.concatenate([
        turned(pair, SHIFT * rng.standard_normal(3), TURN * rng.standard_normal(3))
        for pair in np.split(rows.y, len(rows.y) // 2)
    ])  # fmt: skip
    found = ro.use.validate(automatic, ro.Dataset.of(arm.true.q, y + NOISE * rng.standard_normal(y.shape), NOISE))
    assert found.coverage is not None
    assert 0.85 < found.coverage <= 1.0  # of the base a mean of four sessions is known


def test_sessions_come_back_from_a_file(automatic: ro.Calibration, tmp_path: Path) -> None:
    ro.store.save_result(automatic, tmp_path)
    again = ro.load_result(tmp_path)
    assert again.problem.data.sessions == automatic.problem.data.sessions
    assert np.array_equal(again.problem.data.blocks[0].session_names, automatic.problem.data.blocks[0].session_names)
    assert np.allclose(again.x, automatic.x, atol=1e-12)
    assert np.allclose(again.errors(), automatic.errors(), atol=1e-12)
    assert again.learned is not None
    assert automatic.learned is not None
    assert again.learned.scales == automatic.learned.scales


def test_an_update_in_a_new_session_keeps_the_robot(arm: ro.study.SimulatedArm, automatic: ro.Calibration) -> None:
    rng = np.random.default_rng(7)
    rows = arm.true.blocks[0]
    moved = turned(rows.y[:8], np.array([3e-4, -2e-4, 4e-4]), np.array([1e-4, 0.0, -1e-4]))
    more = ro.Dataset.of(rows.q[:8, 0], moved + NOISE * rng.standard_normal(moved.shape), NOISE, session=["May"] * 8)
    found = ro.use.update(automatic, more)
    assert not found.changed
    free = found.result.problem.parameters.free
    at = [free.names.index(f"session_May_{axis}") for axis in "xyz"]
    base = [free.names.index(f"base_{axis}") for axis in "xyz"]
    shift = found.result.x[at] + found.result.x[base] - automatic.x[base]
    sd = np.sqrt(np.diag(automatic.covariance)[base])
    assert (np.abs(shift - [3e-4, -2e-4, 4e-4]) < 4 * sd + 1e-4).all()
    checked = ro.use.monitor(automatic, more)
    assert not checked.drifts


def test_folds_leave_whole_sessions_out(problem: ro.CalibrationProblem) -> None:
    by_session = partial(ro.k_fold, parts=problem.data.by_session())
    result = ro.calibrate(with_sessions(problem), weight=by_session)
    assert result.weight > 0
    with pytest.raises(ro.InputError, match="every configuration in exactly one"):
        ro.calibrate(problem, weight=partial(ro.k_fold, parts=problem.data.by_session()[:3]))


def test_sessions_that_share_a_configuration_are_left_out_together(problem: ro.CalibrationProblem) -> None:
    data = problem.data
    configuration = data.configuration.copy()
    configuration[10] = configuration[0]  # of day 2 and day 1
    parts = replace(data, configuration=configuration).by_session()
    assert sorted(len(part) for part in parts) == [10, 10, 19]


def test_a_raw_table_keeps_its_sessions_through_a_folder(
    problem: ro.CalibrationProblem, automatic: ro.Calibration, tmp_path: Path
) -> None:
    data = problem.data
    raw = {f"J{i + 1} [deg]": np.degrees(data.q[:, i]) for i in range(6)}
    raw |= {f"{axis} [mm]": 1e3 * data.blocks[0].y[:, k] for k, axis in enumerate("XYZ")}
    rows = zip(*raw.values(), DAYS, np.linspace(20, 24, len(DAYS)), strict=True)
    lines = [",".join([*raw, "Campaign", "Temperature [°C]"]), *(",".join(map(str, row)) for row in rows)]
    table = tmp_path / "raw.csv"
    table.write_text("\n".join(lines), encoding="utf-8")
    ro.store.new_problem(tmp_path / "cell", "ur10e", table)
    stated = tmp_path / "cell" / "problem.toml"
    assert "# session_* " in stated.read_text(encoding="utf-8")
    text = stated.read_text(encoding="utf-8").replace('"theta?",', '"theta?", "session_*", "expansion",')
    stated.write_text("temperature_C = 21.0\n" + text, encoding="utf-8")
    found = ro.load(tmp_path / "cell").problem
    assert found.data.sessions == data.sessions
    assert {"session_day_4_rz", "expansion"} <= set(found.parameters.free.names)
    assert found.parameters.nominal[found.parameters.names.index("reference_temperature")] == 273.15 + 21.0
    again, left_out, *_ = ro.use.read_measurements(automatic, table)
    assert left_out == ()
    assert automatic.errors(again) == pytest.approx(automatic.errors(data), abs=1e-9)


@pytest.mark.parametrize(
    ("column", "said"),
    [(["a"] * 39 + [""], "row 40, column session: found ''"), (["a 1"] * 20 + ["a-1"] * 20, "'a 1' and 'a-1'")],
)
def test_names_that_cannot_be_are_refused(problem: ro.CalibrationProblem, column: list[str], said: str) -> None:
    data = problem.data
    table = {f"q{i + 1}_rad": data.q[:, i] for i in range(6)}
    table |= {f"{axis}_m": data.blocks[0].y[:, k] for k, axis in enumerate("xyz")}
    with pytest.raises(ro.InputError, match=said):
        ro.read_data({**table, "session": column}, problem.robot, {"position_mm": 0.03})


def test_few_sessions_are_what_a_doubtful_result_lacks() -> None:
    """Offsets as large as the nominal robot's errors, and no more configurations would help."""
    problem = ro.study.simulated_arm(1, 40).problem
    day = np.arange(40) % 2
    y = problem.data.blocks[0].y + 0.01 * np.random.default_rng(3).normal(size=(2, 3))[day]
    data = ro.Dataset.of(problem.data.q, y, NOISE, session=[f"day {each}" for each in day])
    result = ro.calibrate(told(problem, 1, data), model="auto")
    said = inconclusive(result, measured_workspace(result))
    assert said.startswith("Inconclusive: the median U over the region")
    assert "Missing: one registration for all sessions, to the same reference points" in said
    assert "Measure more configurations" not in said


def test_session_parameters_have_scales_of_their_own(problem: ro.CalibrationProblem) -> None:
    table = with_sessions(problem).parameters.scaled({"session_mm": 0.5, "session_mrad": 0.2}).free
    sizes = {round(float(s), 9) for n, s in zip(table.names, table.scale, strict=True) if of_session(n)}
    assert sizes == {5e-4, 2e-4}
    assert not (table.placed & np.array([of_session(name) for name in table.names])).any()


# --- in parts ------------------------------------------------------------------------------------------------------


def test_parts_know_the_sessions_of_all_parts_and_say_where_they_do_not(problem: ro.CalibrationProblem) -> None:
    data = problem.data
    parts = [partial(data.take, range(start, start + 20)) for start in (0, 20)]  # two days each
    names = sorted({name for part in parts for name in part().sessions})
    assert names == list(data.sessions)
    start = partial(ro.problem.starting_parameters, problem.robot, parts[0](), BASE, {"": TOOL})
    identified = problem.parameters.free.names
    whole = start(sessions=names).scaled(SCALES).identify([*identified, "session_*"])
    found = ro.calibrate(PartitionedProblem(problem.robot, whole, parts[0](), parts))
    together = ro.calibrate(ro.CalibrationProblem(problem.robot, whole, data))
    assert sum(of_session(name) for name in found.problem.parameters.free.names) == 6 * len(names)
    assert found.x == pytest.approx(together.x, abs=1e-5)

    first = start().scaled(SCALES).identify([*identified, "session_*"])
    with pytest.raises(ro.InputError, match=r"session: found 'day 3' in block 2, accepted: sessions with parameters"):
        ro.calibrate(PartitionedProblem(problem.robot, first, parts[0](), parts))
    with pytest.raises(ro.InputError, match=r"'day 3' in block 2"):  # weights of one's own do not learn from all rows
        ro.calibrate(PartitionedProblem(problem.robot, first, parts[0](), parts), ro.tikhonov, 1.0)


# --- readings of a session that is not known ------------------------------------------------------------------------


def test_intervals_of_readings_are_wide_where_few_sessions_told_how_they_differ(automatic: ro.Calibration) -> None:
    """The factor is the one that `validate` counts with; the robot's own positions have that of all equations."""
    fresh = in_sessions(SEED, ["another day"] * 40)
    data = fresh.data
    uncertainty = ro.calibration.Uncertainty(automatic)
    reading = automatic.predict(data.q, of="reading", confidence=0.95)
    assert reading.coverage_factor.shape == (len(data), 1)
    assert (reading.coverage_factor > uncertainty.coverage_factor + 0.05).all()
    assert automatic.predict(data.q, confidence=0.95).coverage_factor == uncertainty.coverage_factor
    assert automatic.predict(data.q, of="mean", confidence=0.95).coverage_factor == uncertainty.coverage_factor
    y = data.blocks[0].y
    for scale in (0.5, 1.0, 2.0):  # at all of which some are inside and some are not
        moved = reading.position + scale * (y - reading.position)
        away = fresh.on(replace(data, blocks=(replace(data.blocks[0], y=moved),))).data
        inside = np.abs(moved - reading.position) <= reading.expanded
        assert held_out_errors(automatic, away).coverage == pytest.approx(inside.mean(), abs=1e-12)
