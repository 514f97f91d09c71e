"""Export of the identified robot to files of other tools."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, pick
from rpim_opt.basics.files import json_text, read_bytes, write_files, write_text
from rpim_opt.basics.tables import csv_text
from rpim_opt.basics.text import counted, joined, listed, percent
from rpim_opt.basics.units import numeral
from rpim_opt.bayes.model_selection import CONDITIONS
from rpim_opt.bayes.prior_terms import prior_penalty
from rpim_opt.calibration.acceptance import inconclusive, tested
from rpim_opt.calibration.held_out import sets
from rpim_opt.calibration.identify import calibrate
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import transmission_errors
from rpim_opt.calibration.words import underdetermined
from rpim_opt.data.measurements.camera import INTRINSICS
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.chain import OF_JOINTS, RobotSetup, placed, same_place
from rpim_opt.robot.formats.tables import CONVENTIONS, joints_alone, read_robot, rounded, write_robodk, write_robot
from rpim_opt.robot.formats.universal_robots import read_ur_kinematics, write_ur_calibration, write_ur_kinematics
from rpim_opt.robot.formats.urdf import read_urdf, remembered_ends, write_origins, write_urdf
from rpim_opt.robot.kinematics import FRAME, frame_numbers, numeric_frame, numeric_link
from rpim_opt.robot.library import robots
from rpim_opt.robot.mdh import Gravity, Robot
from rpim_opt.robot.parameters import frame_of, of_joint, of_term, own_name, reflectors, tool_prefix
from rpim_opt.use.compensation import tool_uncertainty, turns_measured
from rpim_opt.use.sessions import base_frame, in_session, session_notes

OF_BYTES = "surrogateescape"  # other tools' files keep their encoding
WRITER = "rpim_opt: "
EARLIER = re.compile(rf"^(?:# {WRITER}[^\n]*|<!-- {WRITER}.*?-->)\r?\n", re.MULTILINE)
"""Comments of an earlier export in a file."""
ANOTHER_MODEL = 0.01  # larger differences of lengths [m] mean another model, of d1 another base
FLANGE = "the flange frame (after the last joint; alpha and a in the last row of a DH sheet follow it)"
CONVENTION = {  # description of a table in a convention
    "modified": "modified DH (Craig), Rot(x, alpha) Trans(x, a) Rot(z, theta) Trans(z, d) Rot(y, beta). For the "
    "standard convention (Paul) write a .csv with --dh standard",
    "standard": "standard DH (Paul, Hayati), Rot(z, theta) Trans(z, d) Trans(x, a) Rot(x, alpha) Rot(y, beta), from "
    "axis 1 to the flange frame of [tool] and --tool: a and alpha of the last row are 0",
}


class Exported(NamedTuple):
    """Files, sentences on what they do not hold, and whether the verdict on them is inconclusive."""

    files: list[Path]
    notes: list[str]
    inconclusive: bool


Writer = tuple[Path, Callable[[Path], Sequence[str] | None]]
"""A file, and a function that writes to a path and returns notes for the user."""


def identified(result: Calibration, marker: str | None = None, robot: str = "") -> RobotSetup:
    """Return the identified robot, its base in the instrument's frame, and a reflector as tool.

    ``marker`` names the reflector, by default the first, ``robot`` is one of several. InputError for parameters that no
    description of a robot can hold (`beyond_geometry`), unknown markers and unknown robots.

    >>> import rpim_opt as ro
    >>> arm = ro.use.identified(ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml))
    >>> arm.base.round(2), (1e3 * arm.tool[:3]).round(1)  # [m, rad], [mm]
    (array([ 1.8 , -0.7 ,  0.35,  0.02, -0.04,  1.9 ]), array([18.8, -3.7, 61. ]))
    """
    arm = pick(result.robots, robot, "robot")
    result = in_session(result, robot)
    whole = result.problem.parameters
    p = whole.of_robot(robot)
    of = dict(zip(p.names, whole.values_at(result.x)[whole.places_of(robot)], strict=True))
    joint_map = arm.joint_map.copy()
    for i in set(range(len(joint_map))) - set(arm.leading):
        joint_map[i] *= 1 + of[f"ratio{i + 1}"]
    beyond = beyond_geometry(result)
    extras = [name for name in np.array(whole.names)[whole.places_of(robot)].tolist() if beyond.get(name)]
    if extras:
        accepted = "MDH parameters, base and tool: `export_files` fits these alone, `compensate` uses all parameters"
        raise InputError("the calibration", listed(extras, 6), accepted)
    prefix = tool_prefix(marker or reflectors(p.names)[0])
    if prefix + "x" not in of:
        raise InputError("marker", f"'{marker}'", "a reflector of the calibration")
    tool = np.array([of[prefix + c] for c in FRAME])
    return RobotSetup(replace(arm, joint_map=joint_map), frame_numbers(base_frame(result, robot)), tool)


def beyond_geometry(result: Calibration) -> dict[str, float]:
    """Return the values [SI] of the parameters that no description of a robot can hold, by name: those of terms.

    These are ratios (except of mimic joints, whose multipliers files hold), harmonics, backlash, compliances, bends,
    and user-defined terms; also origins, which only a URDF holds.
    """
    p = result.problem.parameters
    beyond = {name: x for name, x in p.by_name(result.x).items() if of_term(name) or name in p.terms}
    for robot, arm in result.problem.arms.items():
        for i in set(range(len(arm.joint_map))) - set(arm.leading):
            beyond.pop(p.called(robot, f"ratio{i + 1}"), None)
    return beyond


def export_files(
    result: Calibration,
    out: str | Path | None = None,
    *,
    urdf: str | Path | None = None,
    ur_kinematics: str | Path | None = None,
    ur_calibration: str | Path | None = None,
    camera_info: str | Path | None = None,
    mdh: str | Path | None = None,
    dh: str = "modified",
    robodk: str | Path | None = None,
    corrections: str | Path | None = None,
    marker: str | None = None,
    robot: str = "",
    despite_verdict: bool = False,
    **frames: str | bool | None,
) -> Exported:
    """Export the identified robot to files of other tools: all of them, or none.

    Of a calibration with more than geometry `geometry_alone` is written; ``corrections`` are of the whole model.

    ``urdf``, ``ur_kinematics`` (``kinematics.yaml`` of ROS), ``ur_calibration`` (``calibration.conf``) and
    ``camera_info`` (a camera's YAML of ROS) are files of the nominal robot that are corrected and written to ``out``, a
    folder for several. ``mdh`` (.csv, .json, .toml; in the convention ``dh``, as for `write_robot`), ``robodk`` (.csv,
    four numbers per joint, modified) and ``corrections`` are files to write. The last one has the transmission errors
    (no rows if the model has none): ``joint``, ``angle_deg`` (the controller's), ``correction_mrad``, to be subtracted
    from a command, and ``std_mrad``. ``marker`` is the reflector, ``robot`` one of several (`together`).

    ``root`` and ``tip`` are the links of the URDF between which the robot is, by default those with which it was read.
    The tip link keeps its place in the file behind the last joint, unless ``tip_measured``: then the reflector is its
    origin and is moved to its identified place. If origins were identified, those of all chains are written, and
    ``root`` and ``tip`` are refused.

    A robot that is neither accepted nor rejected, or whose uncertainty exceeds the nominal one's error, is written with
    the note that this is inconclusive. NotDelivered for a calibration that is not delivered, or rejected by the
    requirement of its record, unless ``despite_verdict``, which every file notes; InputError if there is nothing to
    write, or if a file cannot hold the identified parameters.
    """
    whole = in_session(result, robot)
    result, lost = geometry_alone(whole)
    note, of_geometry, remarks, undecided = _judged(whole, result, despite_verdict)
    of_geometry += [*lost, *session_notes(result, robot)]
    corrected: list[tuple[str | Path | None, Callable[[Path, Path], Any]]] = [
        (urdf, partial(_write_urdf, result, marker, robot, **frames)),
        (ur_kinematics, partial(_write_ur_kinematics, result, robot, marker)),
        (ur_calibration, partial(_write_ur_calibration, result, robot, marker)),
        (camera_info, partial(_write_camera, result)),
    ]
    made: list[tuple[str | Path | None, Callable[[Path], Any]]] = [
        (mdh, lambda target: _write_table(identified(result, marker, robot), dh, target)),
        (robodk, lambda target: _write_robodk(identified(result, marker, robot), target)),
    ]
    sources = [(Path(source), write) for source, write in corrected if source]
    if sources and out is None:
        raise InputError("--out", "nothing", f"where to write the corrected {sources[0][0].name}")
    if out is not None and not sources:
        raise InputError("--out", f"{out} without a file to correct", "--urdf, ...; --mdh and others name their own")
    place = Path(out or "")
    writers: list[Writer] = []
    for source, write in sources:
        target = place / source.name if len(sources) > 1 or place.is_dir() else place
        if target.resolve() == source.resolve():
            raise InputError("--out", f"the original, {source}", "another file: the original is not overwritten")
        writers.append((target, partial(write, source)))
    writers += [(Path(target), write) for target, write in made if target]
    writers = [(to, lambda path, write=write: [*of_geometry, *(write(path) or ())]) for to, write in writers]
    if corrections:
        writers.append((Path(corrections), partial(_write_joint_corrections, whole)))
    if not writers:
        options = "--urdf, --ur-kinematics, --ur-calibration, --camera-info, --mdh, --robodk, --corrections"
        raise InputError("export", "nothing to write", f"{options}, one or several")
    beside = [note] * bool(note)
    messages = write_all(writers, [f"{whole.record.identity}.", *beside])
    notes = list(dict.fromkeys([*beside, *of_geometry, *remarks, *messages]))
    return Exported([target for target, _ in writers], notes, undecided)


def _judged(whole: Calibration, alone: Calibration, despite_verdict: bool) -> tuple[str, list[str], list[str], bool]:
    """Return notes for every file and of the geometry, remarks, whether that is inconclusive; or raise NotDelivered."""
    accepted, found = tested(whole)
    said = {"inconclusive": inconclusive(whole, found)}
    # the condition of the whole model: what files cannot hold is no scatter of the readings
    verdict = replace(alone.verdict, caution=whole.verdict.caution)
    if accepted:
        verdict, said = accepted.on(verdict), {accepted.verdict: accepted.summary}
    remarks = list(filter(None, [whole.no_intervals, said.get("accepted")]))
    doubt = said.get("inconclusive", "") * verdict.delivered
    undecided = bool(doubt)
    note = " ".join(filter(None, [verdict.require(despite_verdict), doubt, *underdetermined(alone)]))
    if alone is whole or found is None:
        return note, [], remarks, undecided
    stays = np.linalg.norm(alone.forward(found.q, found.region.marker)[:, :3, 3] - found.position, axis=1)
    bound, required = float((found.expanded + stays).max()), found.requirement
    of_geometry = (
        "Expanded uncertainty of the position that the reflector reaches with this geometry (U, "
        f"{percent(required.confidence)}): at most {1e3 * bound:.3f} mm; region: {required.where}. It includes the "
        f"error of leaving out the model extensions, at most {1e3 * stays.max():.3f} mm there."
    )
    if accepted and bound > required.limit:
        undecided = True
        within = "; only the whole model's is within it" * (accepted.verdict == "accepted")
        of_geometry += f" It is above the limit of {1e3 * required.limit:g} mm{within}."
    remarks.append("Other points and the flange's orientation may be less certain: `compensate --tool` states their U.")
    return note, [of_geometry], remarks, undecided


def geometry_alone(result: Calibration) -> tuple[Calibration, list[str]]:
    """Return the calibration without parameters `beyond_geometry`, except origins, and a sentence on the accuracy lost.

    The geometry of the full model is not optimal without extensions and user-defined terms: the same rows are
    calibrated again, including those that only they explain. Returned unchanged if these parameters are zero.
    """
    every = beyond_geometry(result)
    beyond = {name: every[name] for name in every if not own_name(name).startswith(OF_JOINTS)}
    if not any(beyond.values()):
        return result, []
    free = result.problem.parameters.free.names

    def bare(problem: Source) -> Source:
        p = problem.parameters
        zero = np.isin(p.names, list(beyond))
        nominal = np.where(zero, 0.0, p.nominal)
        return problem.with_parameters(replace(p, nominal=nominal, identified=np.isin(p.names, free) & ~zero))

    learned, penalty = result.learned, result.formulation.penalty
    known: dict[str, Any] = {"causes": result.causes}  # the extension is no mistake
    selected, added = ((), ()) if learned is None else (learned.extensions, learned.added)
    left_out = {row.label for row in result.left_out}
    lost = [each for each in selected if each not in CONDITIONS]
    lost += [name for name, value in beyond.items() if value and name not in added]
    if penalty is None or getattr(penalty, "maker", "") != prior_penalty.__name__:
        stated = bare(result.stated).without(left_out)
        try:
            alone = result.calibrate_again(stated, model="geometry")
        except (InputError, ValueError) as error:  # raised by user-defined functions
            where = f"formulation '{result.formulation.name}'"
            found = f"no fit without {listed(lost, 6)}, which files cannot hold: {str(error).rstrip('.')}"
            raise InputError(where, found, "functions that do not use them") from error
        if isinstance(stated, CalibrationProblem) and alone.learned is not None and alone.left_out:
            again = calibrate(alone.problem.on(stated.data), alone.formulation, weight=alone.weight)
            alone = replace(again, learned=replace(alone.learned, left_out=()))
    else:  # a prior of all parameters, in units of their scales: unchanged, with those beyond geometry at zero
        kept = ~np.isin(free, list(beyond))
        among = np.eye(len(free))[:, kept]
        form = replace(result.formulation, penalty=lambda z: penalty(among @ z))
        alone = calibrate(bare(result.problem), form, weight=result.weight)
        if (drift := result.fit_covariance.drift) is not None:  # what the prior holds is as uncertain as before
            known["fit_covariance"] = replace(alone.fit_covariance, drift=drift[kept])
    alone = replace(alone, record=result.record, known=known)
    where, data = next(iter(sets(result).items()))
    whole, left = (float(1e3 * np.sqrt(np.nanmean(each.errors(data) ** 2))) for each in (result, alone))
    sentence = (
        f"Files cannot hold {listed(lost, 6)}: their geometry is from a separate fit to the same measurements, with "
        f"{left:.3f} mm RMS on the {where} rows ({whole:.3f} mm with the whole model)."
    )
    return alone, [sentence]


def _write_table(arm: RobotSetup, dh: str, target: Path) -> list[str]:
    """Write a DH table, with notes on its convention and on what one with a row per joint has no place for."""
    robot, counted = arm.robot, []
    if target.suffix.lower() == ".csv":
        robot = replace(robot, gravity=Gravity(masses=robot.gravity.masses, centres=robot.gravity.centres))
        if not np.array_equal(np.abs(robot.joint_map), np.eye(len(robot.mdh))):
            robot, counted = joints_alone(robot, target)
    write_robot(rounded(robot), target, dh)
    convention = CONVENTIONS[dh.lower()]
    alpha, a = arm.robot.mdh[0, :2]
    base, inside = arm.base, ""
    if convention == "standard" and (alpha or a):
        base = frame_numbers(numeric_frame(base) @ numeric_link(alpha, a))
        inside = f" Its base contains alpha1 = {1e3 * alpha:.4g} mrad and a1 = {1e3 * a:.4g} mm, which place axis 1."
    return [f"{target.name}: {CONVENTION[convention]}.{inside}", _ends(replace(arm, base=base), target), *counted]


def _write_robodk(arm: RobotSetup, target: Path) -> list[str]:
    return [*write_robodk(arm.robot, target), _ends(arm, target)]


def _ends(arm: RobotSetup, file: Path) -> str:
    """Return a sentence on base and tool, which a file does not hold."""
    ends = f"base {placed(arm.base)} in the instrument's frame, reflector {placed(arm.tool)} in {FLANGE}"
    return f"{file.name} lacks base and tool: {ends}."


def _write_joint_corrections(result: Calibration, target: Path) -> list[str]:
    """Write four rows a period of the finest harmonic in the measured ranges; return what they are, and their sizes."""
    curves = transmission_errors(result)
    lines = ["joint,angle_deg,correction_mrad,std_mrad"]
    for curve in curves:
        rows = np.column_stack([np.degrees(curve.q), 1e3 * curve.error, 1e3 * curve.standard])[curve.inside]
        lines += [f"{curve.joint},{angle:.4f},{value:.5f},{of_value:.5f}" for angle, value, of_value in rows]
    write_text(target, "\n".join(lines) + "\n")
    if not curves:
        others = [name for name, value in beyond_geometry(result).items() if value]
        without = f"; `compensate` corrects {listed(others)}" if others else ""
        return [f"{target.name} has no rows: the calibration has no transmission errors{without}."]
    errors = [f"{curve} {1e3 * curve.rms:.3f}" for curve in curves]
    return [
        f"Transmission errors (RMS, mrad): {joined(errors)}. Angles are those of the controller, within the "
        "measured ranges; std_mrad is the standard uncertainty (k = 1). The actual angle is angle_deg plus the "
        "correction: subtract it from a command. The corrections belong to the geometry of the whole model "
        "(`compensate` uses both), not to that of other exported files."
    ]


def _write_urdf(
    result: Calibration,
    marker: str | None,
    robot: str,
    source: Path,
    target: Path,
    root: str | None = None,
    tip: str | None = None,
    tip_measured: bool = False,
) -> list[str]:
    """Write the identified origins, and base and tool if they belong to the file; return where root and reflector are.

    An identified base near the file's root is the same frame, measured more accurately, and is written.
    """
    of = {own_name(name): x for name, x in zip(result.problem.parameters.free.names, result.x, strict=True)}
    if any(name.startswith(OF_JOINTS) for name in of):
        ends = {"root": root, "tip": tip, "tip_measured": tip_measured, "marker": marker, "robot": robot}
        stated = [name for name, value in ends.items() if value]
        if stated:
            accepted = "none of these: all origins are written; mount_* in identify moves a tip link"
            raise InputError("export of origins", joined(stated), accepted)
        return _write_tree(result, of, source, target)
    arm = identified(result, marker, robot)
    read = remembered_ends(source, result.problem.arms[robot])
    own = read_urdf(source, root or read[0], tip or read[1])
    root, tip = remembered_ends(source, own.robot)
    p = result.problem.parameters.of_robot(robot)
    known = reflectors(p.names)
    if tip_measured and marker is None and len(known) > 1:
        raise InputError("--tip-measured", f"{len(known)} reflectors", f"--marker with one of {', '.join(known)}")
    of_base, of_tool, of_session = (any(n.startswith(f) for n in p.free.names) for f in ("base_", "tool_", "session_"))
    base, tool, at_tip = None, None, own.tool
    notes = []
    frame = "the instrument's frame" + (result.problem.session and f" of session '{result.problem.session}'")
    if of_base and same_place(arm.base, own.base):
        base = arm.base
        notes.append(f"URDF: {root} is {frame}: the identified base, {placed(base)}, is in the first joint's origin.")
    elif of_base or of_session:
        at = placed(frame_numbers(numeric_frame(arm.base) @ np.linalg.inv(numeric_frame(own.base))))
        notes.append(f"URDF: {root} is at {at} in {frame}: use this pose, not an earlier one.")
    if of_tool and tip_measured:
        tool, at_tip = arm.tool, None
        moved = 1e3 * np.linalg.norm(tool[:3] - own.tool[:3])
        notes.append(
            f"URDF: {tip} moved by {moved:.3g} mm to the reflector, {placed(tool)} in the flange frame, with the links "
            "behind it; others on the flange keep their poses from the file, which were not measured."
        )
    elif of_tool:
        at = placed(frame_numbers(np.linalg.inv(numeric_frame(own.tool)) @ numeric_frame(arm.tool)))
        there = f"in its frame the reflector is at {at}; --tip-measured (tip_measured=True) moves it there"
        notes.append(f"URDF: {tip} keeps its pose from the file; {there}.")
    notes += _uncertainty_of(result, tip or "the tip link", at_tip, marker or known[0], robot)
    return notes + write_urdf(source, arm.robot, target, root, tip, base, tool)


def _uncertainty_of(result: Calibration, what: str, tool: Array | None, marker: str, robot: str) -> list[str]:
    """Return a sentence on the uncertainty of a frame, at ``tool`` in the flange frame or at the reflector."""
    problem = result.problem.sample().alone(robot)
    blocks = [block for block in problem.data.blocks if block.q.shape[2] == problem.robot.dof]
    q = np.concatenate([block.q[:, 0] for block in blocks])
    position, turn = (float(each.max()) for each in tool_uncertainty(result, q, tool, marker, robot))
    if not (position or turn):  # no identified parameter moves it
        return []
    if not np.isfinite([position, turn]).all():
        return [f"The pose of {what} is undetermined: check position and orientation by other means."]
    rests = " Positions of one reflector determine only part of its pose, the prior the rest."
    return [
        "Expanded uncertainty in the instrument's frame (k = 2, largest of the measured configurations): "
        f"{what} {2e3 * position:.2g} mm and {2e3 * turn:.2g} mrad.{rests * (not turns_measured(problem))}"
    ]


def _write_tree(result: Calibration, of: Mapping[str, float], source: str | Path, target: Path) -> list[str]:
    """Write the origins of the joints of all chains, from deviations by the joints' own names."""
    p = result.problem.parameters
    moved = np.array(p.free.names)[result.x != 0].tolist()
    others = [name for name in moved if not own_name(name).startswith(OF_JOINTS)]
    foreign = [name for name in others if of_joint(name) or name in p.terms]
    if foreign:
        raise InputError("the calibration", listed(foreign, 6), "origins: a URDF holds nothing else")
    prefixes = {frame_of(name) for name in of if name.startswith(OF_JOINTS)}
    parts = {prefix: np.array([of.get(prefix + axis, 0.0) for axis in FRAME]) for prefix in prefixes}
    write_origins(source, parts, target)
    frames = sorted({own_name(name).partition("_")[0] for name in others})
    return [f"The URDF holds origins; {joined(frames)} of the calibration stays in its result."] if frames else []


def _write_ur_kinematics(result: Calibration, robot: str, marker: str | None, source: Path, target: Path) -> list[str]:
    nominal = result.problem.arms[robot]
    arm, notes = _on_base(identified(result, marker, robot), nominal, read_ur_kinematics(source).robot, target)
    notes.append(
        "The ROS driver reads these origins; the controller keeps its own kinematics, and the hash is unchanged."
    )
    return [*notes, *_of_controller(result, marker, arm, robot), *write_ur_kinematics(source, arm.robot, target)]


def _write_ur_calibration(result: Calibration, robot: str, marker: str | None, source: Path, target: Path) -> list[str]:
    """Write a ``calibration.conf``, without alpha1 and a1, which locate the controller's Base."""
    nominal = result.problem.arms[robot]
    if np.abs(nominal.mdh[0, :2]).max() > 0:
        raise InputError("robot", "alpha1 or a1 that are not zero", "a ready robot of Universal Robots")

    def lengths(mdh: Array) -> Array:  # a is negative in Base only; of parallel axes 2 to 4 the sum of offsets counts
        return np.array([*np.abs(mdh[:, 1]), *mdh[4:, 3], mdh[1:4, 3].sum()])

    # a controller's deltas count from the ready robot, whatever the calibration began with
    ready = [read_robot(name) for name in robots() if name.startswith("ur")]
    apart = [float(np.abs(lengths(each.mdh) - lengths(nominal.mdh)).max()) for each in ready]
    if min(apart) > ANOTHER_MODEL:
        raise InputError("robot", nominal.name, "one of Universal Robots' models")
    catalogued = ready[int(np.argmin(apart))]
    arm, notes = _on_base(identified(result, marker, robot), nominal, catalogued, target)
    mdh = arm.robot.mdh.copy()
    axis = numeric_link(*mdh[0, :2])
    mdh[0, :2] = 0.0
    notes += write_ur_calibration(source, replace(arm.robot, mdh=mdh), catalogued, target)
    if b"joint_checksum" in read_bytes(source):
        notes.append("joint_checksum is that of the source: a controller may refuse the file. Keep the original.")
    if not np.array_equal(mdh, arm.robot.mdh):
        notes.append(
            "calibration.conf cannot hold the tilt and offset of axis 1 (alpha1, a1): its Base is defined on axis 1."
        )
    arm = replace(arm, base=frame_numbers(numeric_frame(arm.base) @ axis))
    return [*notes, *_of_controller(result, marker, arm, robot)]


def _of_controller(result: Calibration, marker: str | None, arm: RobotSetup, robot: str) -> list[str]:
    """Return TCP and Base that belong to a robot in files of Universal Robots, as PolyScope states poses, and U."""
    known = reflectors(result.problem.parameters.names)
    which = "the reflector" if len(known) == 1 else f"reflector {marker or known[0]} (--marker states another)"
    half = np.pi * bool((arm.robot.mdh[2:4, 1] > 0).all())  # from ROS's base_link to Base
    texts = []
    for T in (numeric_frame(arm.tool), numeric_frame(arm.base) @ numeric_link(theta=half)):
        lengths = (f"{name} {1e3 * value:z.3f}" for name, value in zip("XYZ", T[:3, 3], strict=True))
        vector = scipy.spatial.transform.Rotation.from_matrix(T[:3, :3]).as_rotvec()
        angles = (f"{name} {value:z.5f}" for name, value in zip(("RX", "RY", "RZ"), vector, strict=True))
        texts.append(f"{' '.join(lengths)} mm, {' '.join(angles)} rad")
    return [
        f"TCP to enter in PolyScope for {which} (rotation vector, from the tool flange): {texts[0]}. "
        f"The controller's Base in the instrument's frame (rotation vector): {texts[1]}.",
        *_uncertainty_of(result, "the flange", np.zeros(6), marker or known[0], robot),
    ]


def _on_base(arm: RobotSetup, nominal: Robot, of_file: Robot, file: Path) -> tuple[RobotSetup, list[str]]:
    """Return an identified robot with its base moved along axis 1 as in a file, and a sentence if it was elsewhere.

    A URDF may start at the table below the robot: theta1 and d1 of the nominal robot count from there.
    """
    away = nominal.mdh[0, 2:4] - of_file.mdh[0, 2:4]
    theta, d = np.where(np.abs(away) > ANOTHER_MODEL, away, 0.0)
    if not (theta or d):
        return arm, []
    mdh = arm.robot.mdh.copy()
    axis = numeric_link(*mdh[0, :2])
    base = numeric_frame(arm.base) @ axis @ numeric_link(theta=theta, d=d) @ np.linalg.inv(axis)
    mdh[0, 2:4] -= theta, d
    apart = f"{1e3 * d:z.3f} mm along axis 1 and {np.degrees(theta):z.5f} deg about it"
    moved = replace(arm, robot=replace(arm.robot, mdh=mdh), base=frame_numbers(base))
    return moved, [f"{file.name}: its base is {apart} from the base of the calibration's DH table."]


def _write_camera(result: Calibration, source: Path, target: Path) -> None:
    """Write a camera's YAML of ROS with the calibrated intrinsics, everything else as in ``source``.

    The projection matrix keeps its rectification: its focal lengths and centre change like those of the camera matrix.
    InputError for calibrations of no camera or of several, and files without one of the three lists.
    """
    p = result.problem.parameters
    cameras = {name.rpartition("_")[0] for name in p.names if own_name(name).startswith("camera_")}
    if len(cameras) != 1:
        raise InputError("the calibration", counted(len(cameras), "camera"), "one camera")
    values = p.by_name(result.x)
    fx, fy, cx, cy, *distortion = (values[f"{min(cameras)}_{name}"] for name in INTRINSICS)
    text = read_bytes(source).decode()
    before = _yaml_list(text, "camera_matrix", (3, 3), source)[0]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    P = _yaml_list(text, "projection_matrix", (3, 4), source)[0]
    P[[0, 1], [0, 1]] *= np.diag(K)[:2] / np.diag(before)[:2]
    P[:2, 2] += K[:2, 2] - before[:2, 2]
    lists = {"camera_matrix": K, "distortion_coefficients": np.array([distortion]), "projection_matrix": P}
    for key, numbers in lists.items():
        _, start, end = _yaml_list(text, key, numbers.shape, source)
        text = text[:start] + ", ".join(map(repr, numbers.ravel().tolist())) + text[end:]
    write_text(target, text)


def _yaml_list(text: str, key: str, shape: tuple[int, ...], path: Path) -> tuple[Array, int, int]:
    """Return the numbers of a list ``key: data: [...]``, and where they stand."""
    match = re.search(rf"^{key}:[^\n]*\n(?:[ \t]+[^\n]*\n)*?[ \t]+data:\s*\[([^\]]*)\]", text, re.MULTILINE)
    numbers = np.array([numeral(each) for each in match[1].replace(",", " ").split()]) if match else np.empty(0)
    if match is None or numbers.size != np.prod(shape) or not np.isfinite(numbers).all():
        accepted = f"data: [...] of {np.prod(shape)} finite numbers"
        raise InputError(f"key {key}", f"{numbers.size} numbers", accepted, path)
    return numbers.reshape(shape), match.start(1), match.end(1)


def noted(content: bytes, ending: str, notes: Sequence[str]) -> bytes:
    """Return the content of a file with notes: comments, a column of CSV, or the key ``source`` of JSON.

    Comments of an earlier export are removed: its frames are different.
    """
    text = EARLIER.sub("", content.decode("utf-8-sig", OF_BYTES))
    notes = ["".join(character if character.isprintable() else " " for character in each) for each in notes]
    note, end = " ".join(notes), "\r\n" if "\r\n" in text else "\n"
    if ending == ".json":
        whole = json.loads(text)
        text = json_text({**whole, "source": f"{note} {whole.get('source', '')}".strip()})
    elif ending == ".csv":
        header, *rows = csv.reader(text.splitlines())
        cells = [note, *[""] * len(rows)]
        text = csv_text([*header, "note"], [[*row, cell] for row, cell in zip(rows, cells, strict=False)])
    elif ending in (".urdf", ".xml"):
        note = re.sub("-+", "-", re.sub(r"--+(?=\w)", "option ", note))  # a comment may not contain two hyphens
        comment = f"<!-- {WRITER}{note} -->{end}"
        text = re.sub(r"(?s)(<\?xml.*?\?>\s*)?", lambda declared: f"{declared[0]}{comment}", text, count=1)
    else:
        text = "".join(f"# {WRITER}{each}{end}" for each in notes) + text
    return text.encode(errors=OF_BYTES)


def write_all(writers: Sequence[Writer], notes: Sequence[str] = ()) -> list[str]:
    """Write several files, or none if one fails; notes and its writer's messages stand in each; return the messages."""
    targets = [target for target, _ in writers]
    for target in targets:
        if target.is_dir() or targets.count(target) > 1:
            found = "a folder" if target.is_dir() else "two files with this name"
            raise InputError("the file", found, "a unique name for every file", target)
    messages: list[str] = []
    contents: dict[Path, bytes] = {}
    with TemporaryDirectory() as folder:
        for number, (target, write) in enumerate(writers):
            path = Path(folder) / str(number) / target.name
            path.parent.mkdir()
            try:
                own = list(write(path) or ())
            except InputError as error:
                file = target if error.file == path else error.file
                raise InputError(error.where, error.found, error.accepted, file) from None
            messages += own
            contents[target] = noted(read_bytes(path), path.suffix.lower(), [*notes, *own])
    write_files(contents)
    return messages
