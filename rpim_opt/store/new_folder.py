"""Creation of problem folders from a robot and tables of measurements."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics import files
from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, in_file
from rpim_opt.basics.layout import TableOptions
from rpim_opt.basics.tables import Columns, csv_text
from rpim_opt.basics.text import joined, listed, three_digits
from rpim_opt.basics.units import UNITS, split
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.camera import CAMERAS, INTRINSICS, Board, grid_board, on_board, read_board
from rpim_opt.data.measurements.measurement import Measurement, of_fixture
from rpim_opt.data.tables.names import EXTERNAL, recognize
from rpim_opt.data.tables.reading import read_data
from rpim_opt.problem.causes.rows import rows_without_values
from rpim_opt.problem.multi_robot import NAME
from rpim_opt.problem.problem import CalibrationProblem, identifiable
from rpim_opt.problem.registration.camera import camera_blocks, with_poses
from rpim_opt.problem.registration.frames import (
    largest_session,
    locate,
    sessions_apart,
    starting_cameras,
    starting_parameters,
)
from rpim_opt.robot.chain import MOUNT, ORIGIN, RobotSetup, placed, row_origins, same_place
from rpim_opt.robot.formats.tables import exact, toml, write_robot
from rpim_opt.robot.formats.urdf import branching_tip
from rpim_opt.robot.kinematics import FRAME, forward_kinematics, numeric_frame
from rpim_opt.robot.library import READY, find_robot, read_arm
from rpim_opt.robot.mdh import MDH, MOUNTINGS, Robot
from rpim_opt.robot.parameters import frame_of, model_parameters
from rpim_opt.store.raw import CLEARLY, Interpretation, in_time_order, interpret_tables, rows_of, usual_noise

TABLES = ("identification.csv", "validation.csv", "target.csv")  # of a new folder
ROBOT_OF_CHAINS = "robot.urdf"
SHARED = (
    'Chains share their common joints. State other shared parameters as `shared` in problem.toml: ["base_*"] where '
    'one instrument measured several chains from one link; by chain as { left = ["base_*"], ... }.'
)
GRID = re.compile(r"(\d{1,6})\s*x\s*(\d{1,6})\s*,\s*(\d+\.?\d*|\.\d+)\s*(mm|m)", re.ASCII)
EXPORTED = re.compile(rb"calibrated (\d{4}-\d\d-\d\d, digest \w+)")  # in the notes of an exported file
TEMPLATE = Path(__file__).with_name("problem.toml.jinja")
UNLIKE = 5.0  # ratio of the spreads of measured points and nominal flange that suggests wrong units
UPRIGHT = 0.9  # cosine of the angle between two gravity directions of the same mounting


class Started(NamedTuple):
    """A new folder: rows by file, notes on guesses, the interpretation of tables; not ``written`` by a dry run."""

    folder: Path
    rows: Mapping[str, int]
    notes: tuple[str, ...]
    understood: Interpretation
    written: bool = True

    def __str__(self) -> str:
        lines = [f"{name}: {count} rows" for name, count in self.rows.items()]
        if not self.written:
            return "\n".join([f"Dry run, nothing written: {self.folder}", *lines, *self.notes])
        then = f"Check {self.folder / 'problem.toml'}, then run: rpim-opt inspect {self.folder}"
        return "\n".join([f"Created: {self.folder}", *lines, *self.notes, then])


def new_problem(
    folder: str | Path,
    robot: str | Path,
    data: str | Path | Sequence[str | Path],
    *,
    measurement: str | None = None,
    options: TableOptions | None = None,
    validation: str | Path | Sequence[str | Path] | None = None,
    hold_out: float | None = None,
    seed: int = 0,
    urdf_base: str | None = None,
    urdf_tip: str | None = None,
    chain: str = "",
    target: str = "",
    dh: str = "",
    understood: Callable[[Interpretation], None] | None = None,
    dry_run: bool = False,
) -> Started:
    """Make a problem folder that `load` reads, completely or not at all; with ``dry_run`` check all and write nothing.

    ``folder`` is new, or for a further chain one whose problem file has chains of the same URDF. ``robot`` is the name
    of a ready robot, or a file; ``data`` are text, Excel or Parquet files. ``measurement`` is the measurement type, by
    default poses, positions or distances, depending on the columns; ``options`` state how to read the tables.
    ``urdf_base`` and ``urdf_tip`` are the links between which a URDF's robot is, ``dh`` is the convention of a DH
    table, ``"modified"`` or ``"standard"``, if it states none (`read_sheet`).

    ``validation`` is a table or several; or ``hold_out`` is the part of the configurations that is drawn at random with
    ``seed``. ``chain`` is the NAME of ``[chain.NAME]``, a problem on the origins of a URDF's joints, required for a
    chain that goes up the tree through moving joints and down again. ``target`` is a camera's board: a table with
    point, x_mm, y_mm, or a grid ``7x5,30mm``. ``understood`` is called with the interpretation of the tables before any
    computation. InputError for a folder that exists already, and for a robot or data that cannot be used, or are
    ambiguous.

    >>> import rpim_opt as ro
    >>> arm = ro.store.find_problem("paper_arm")
    >>> made = ro.store.new_problem("cell7", str(arm / "robot.toml"), arm / "identification.csv", hold_out=0.25)
    >>> made.rows
    {'identification.csv': 7, 'validation.csv': 2}
    """
    folder = Path(folder)
    source = find_robot(str(robot))
    before = _with_chains(folder, source, chain)
    chain = chain or branching_tip(source, urdf_base, urdf_tip)
    if validation and hold_out is not None:
        raise InputError("validation", "a table and a fraction to hold out", "one of them")
    options = options or TableOptions()
    arm = read_arm(source, urdf_base, urdf_tip, dh, origins=bool(chain), units=options.units)
    identified, validated, seen = (f"{chain}_{name}" if chain else name for name in TABLES)
    board, stated, points = stated_target(target, seen)
    paths, later = _files(data), _files(validation or ())
    tell = understood or (lambda found: None)
    found = in_time_order(interpret_tables(arm, paths, measurement, options))
    tell(found)
    kind, how = _kind(arm, found, board, measurement)
    found = replace(found, kind=kind)
    rows = rows_of(found, on_board(found.columns, board), arm, kind)
    held = _held_out(rows, hold_out, seed)
    tables = {identified: _rows(found.columns, ~held), validated: _rows(found.columns, held), seen: points}
    if later:
        other = in_time_order(interpret_tables(arm, later, kind.name, found.options))
        tell(other)
        rows_of(other, on_board(other.columns, board), arm, kind)
        tables[validated] = other.columns
    sources = [*paths, *later]
    alike = len({file.name for file in sources}) < len(sources)
    digests = {str(file) if alike else file.name: files.sha256_of(file) for file in sources}
    with in_file(found.file):
        text, guessed = _problem_text(
            arm, source, found, rows.take(np.flatnonzero(~held)), chain=chain, first=not before,
            links={"urdf_base": urdf_base, "urdf_tip": urdf_tip}, target=stated, identification=identified,
            columns=how, data=paths[0].name, validation=validated, held_out=held.any(), seed=seed,
            validated_by=next((file.name for file in later), ""), raw=digests,
        )  # fmt: skip
    counts = {name: len(next(iter(each.values()))) for name, each in tables.items() if any(map(len, each.values()))}
    contents = {name: csv_text(tables[name], zip(*tables[name].values(), strict=True)).encode() for name in counts}
    contents["problem.toml"] = before + text.encode()
    if before and not dry_run:
        files.write_files({folder / name: content for name, content in contents.items()})
    elif not dry_run:
        _write_whole(folder, contents, arm, source, bool(chain))
    added = f"Chain '{chain}' identifies the URDF's own origins; --chain NAME adds another chain to {folder}."
    of_chain = [SHARED if before else added] if chain else []
    notes = (*_remarks(arm, source, found, rows), f"Measurement {kind.name}: {how}.", guessed, *of_chain)
    return Started(folder, counts, notes, found, not dry_run)


def _held_out(rows: Dataset, fraction: float | None, seed: int) -> np.ndarray:
    """Return which rows (N,) belong to configurations that are drawn at random, whole poses of equal joint values."""
    if fraction is None:
        return np.zeros(len(rows), dtype=bool)
    rows = Dataset.together([rows], [""])
    known = len(np.unique(rows.configuration))
    if not 0 < fraction < 1 or known < 2:
        accepted = "a fraction between 0 and 1 of two or more configurations"
        raise InputError("--hold-out", f"{fraction:g} of {known} configurations", accepted)
    drawn = rows.configurations(min(max(round(fraction * known), 1), known - 1), seed)
    return np.isin(rows.configuration, drawn.configuration)


def _assumed(found: Interpretation) -> dict[str, float]:
    """Return the noise that is assumed where no column states any."""
    return {} if any(name.startswith(("sigma", "u95")) for name in found.columns) else usual_noise(found.kind)


def _remarks(arm: RobotSetup, source: Path, understanding: Interpretation, rows: Dataset) -> Iterator[str]:
    """Yield the assumed noise, base and flange of a converted table, joint values of no joint, lost values."""
    assumed = ", ".join(f"{name} = {value:g}" for name, value in _assumed(understanding).items())
    if assumed:
        yield (
            f"Assumed measurement noise (1 sigma): {assumed}. State the instrument's own in [noise] of problem.toml: "
            "noise beyond it is taken for the robot's repeatability."
        )
    yield from (f"{source.name}, {note}" for note in arm.notes)
    if exported := EXPORTED.search(files.read_bytes(source)):
        yield (
            f"{source.name} was exported from a calibration ({exported[1].decode()}): its values count as nominal, "
            "without their uncertainty. To add measurements to that calibration: rpim-opt update RESULTS TABLE; to "
            "start again, use the robot's original file."
        )
    there = "the flange's origin"
    if placed(arm.tool) != placed(np.zeros(6)):  # from a URDF, or a DH table in another convention than modified
        frame = "the last frame of the DH table" if source.suffix.lower() == ".csv" else "the tip link"
        there = f"{frame}, {placed(arm.tool)} in the flange frame"
    yield (
        f"{understanding.kind.words.at_flange} starts at {there}: state its position in [tool] if it is known. [tool], "
        "`known` and --tool refer to the flange frame after the last joint."
    )
    if placed(arm.base) != placed(np.zeros(6)):
        yield (
            "[base], boxes and poses for `compensate` refer to the robot's base, the first frame of its DH table. In "
            f"the base of {source.name} it is at {placed(arm.base)}."
        )
    further = _ignored_joints(arm, understanding)
    if further:
        yield (
            f"Ignored joint values: {further}. The robot ({arm.robot.source or arm.robot.name}) has {arm.robot.dof} "
            'joints; if these move the tool, state another robot (a rail is its first joint, type = "prismatic"), or '
            "a tip link beyond them (--urdf-tip)."
        )
    yield from (f"{text[0].upper()}{text[1:]}" for text in rows_without_values(rows, {"": arm.robot}))


def _ignored_joints(arm: RobotSetup, understanding: Interpretation) -> str:
    """Return the columns of joints behind the robot's last one, or of an external axis that moved; empty without."""
    beyond = {f"q{i}" for i in range(arm.robot.dof + 1, arm.robot.dof + 9)}
    stems = {name: recognize(split(name)[0], arm.names).stem for name in understanding.left_out}
    moved = {name for name in stems if len({*understanding.raw.get(name.lower(), ())}) > 1}
    further = [n for n, stem in stems.items() if stem in beyond or (n in moved and EXTERNAL.fullmatch(stem))]
    return joined(further) if further else ""


def _files(stated: str | Path | Sequence[str | Path]) -> list[Path]:
    return [Path(file) for file in ([stated] if isinstance(stated, str | Path) else stated)]


def _with_chains(folder: Path, robot: Path, chain: str) -> bytes:
    """Return the problem file of a folder for one more chain; nothing where the folder is to be made."""
    if chain and not NAME.fullmatch(chain):
        raise InputError("--chain", f"'{chain}'", "a name of letters, digits and _")
    if not folder.exists() and not folder.is_symlink():
        return b""
    stated = folder / "problem.toml"
    known = files.read_toml(stated).get("chain", {}) if chain and stated.is_file() else {}
    if not known:
        accepted = "a new folder, since nothing is overwritten; its own tables and problem.toml may be edited"
        raise InputError("the folder", "an existing folder", accepted, folder)
    if chain in known:
        raise InputError("--chain", f"'{chain}', which exists", "a unique name for every chain", folder)
    if files.read_bytes(folder / ROBOT_OF_CHAINS) != files.read_bytes(robot):
        raise InputError("the robot", f"another one than {ROBOT_OF_CHAINS}", "the same URDF for all chains", robot)
    return files.read_bytes(stated)


def _write_whole(folder: Path, contents: Mapping[str, bytes], arm: RobotSetup, source: Path, chains: bool) -> None:
    """Write a new folder with its robot beside its place, and move it there when it is whole."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with files.scratch_folder(folder) as scratch:
        made = Path(scratch, folder.name)
        files.write_files({made / name: content for name, content in contents.items()})
        if chains:
            files.write_files({made / ROBOT_OF_CHAINS: files.read_bytes(source)})
        elif source.suffix == ".toml":
            files.write_text(made / "robot.toml", files.read_text(source))  # with comments
        else:
            write_robot(arm.robot, made / "robot.toml")
        made.rename(folder)


def _rows(columns: Columns, chosen: np.ndarray) -> Columns:
    return {name: [cells[i] for i in np.flatnonzero(chosen).tolist()] for name, cells in columns.items()}


# --- what was measured, and the board that a camera sees ---------------------------------------------------------


def stated_target(text: str, file: str = TABLES[-1]) -> tuple[Board, str, Columns]:
    """Return the board of ``--target``, its line of a problem file, and the table to write unless it is a grid.

    The table is named ``file`` in the folder. All are empty without a board.
    """
    if not text:
        return {}, "", {}
    match = GRID.fullmatch(text.strip())
    if match:
        columns, rows, spacing, unit = match.groups()
        board = grid_board(int(columns), int(rows), float(spacing) * UNITS[unit].si)
        return board, f"target = {{ columns = {columns}, rows = {rows}, spacing_{unit} = {spacing} }}", {}
    if "." not in text:
        raise InputError("--target", f"'{text}'", "a table with point, x_mm, y_mm, or a grid such as 7x5,30mm")
    board = read_board(text)
    places = np.array(list(board.values())) * 1e3
    table = {"point": list(board)}
    table |= {f"{axis}_mm": [repr(float(v)) for v in column] for axis, column in zip("xyz", places.T, strict=True)}
    return board, f'target = "{file}"', table


def _kind(arm: RobotSetup, found: Interpretation, board: Board, measurement: str | None) -> tuple[Measurement, str]:
    """Return the measurement type and how it is known; refuse pixels without a board, and a board without pixels."""
    kind = found.kind
    if board and not kind.by_camera:
        raise InputError("--target", "a board", f"none: measurement {kind.name} uses no board", found.file)
    on_target = any(name.startswith("target_x") for name in found.columns)
    if kind.by_camera and not board and not on_target:
        accepted = "--target with what the camera sees: a table with point, x_mm, y_mm, or a grid such as 7x5,30mm"
        raise InputError("the target", "nothing", accepted, found.file)
    if measurement is not None:
        return kind, "as stated"
    if kind.touching:
        column = next(name for name in kind.names if name in found.columns)
        count = len(set(found.columns[column]))
        return kind, f"guessed: rows with the same {column} touched it, {count} in all, and nothing else is measured"
    if not kind.by_camera:
        return kind, f"guessed from the columns {', '.join(kind.columns)}"
    misfit = {}  # RMS [m] of the views' poses with the best base and tool, camera on the flange or beside the robot
    for name, each in CAMERAS.items():
        data = read_data(on_board(found.columns, board), arm.robot, {"pixel_px": 1.0}, each)
        poses = with_poses(data, starting_cameras(data, {}))
        base, tools, _ = locate(arm.robot, poses, {block.markers[0]: np.zeros(6) for block in poses.blocks})
        placed_so = model_parameters(arm.robot, base, tools).identify(["base_*"])
        errors = CalibrationProblem(arm.robot, placed_so, poses).errors(np.zeros(len(placed_so.free)))
        misfit[name] = float(np.sqrt(np.mean(errors**2)))
    best, other = sorted(misfit, key=lambda name: misfit[name])
    figures = f"{1e3 * misfit[best]:.3g} mm RMS, {other} {1e3 * misfit[other]:.3g} mm"
    if not misfit[other] > CLEARLY * misfit[best]:
        ambiguous = f"no clear mounting ({best} leaves {figures})"
        raise InputError("the camera", ambiguous, f"--measurement {best} or {other}")
    return CAMERAS[best], f"guessed: single views of the board, robot nominal and lens not fitted, leave {figures}"


# --- the text of problem.toml -------------------------------------------------------------------------------------


def _problem_text(
    arm: RobotSetup, source: Path, found: Interpretation, rows: Dataset, **context: Any
) -> tuple[str, str]:
    """Return the text of ``problem.toml``, and what was guessed of the base in a sentence."""
    from jinja2 import Environment, StrictUndefined

    robot, kind = arm.robot, found.kind
    markers = sorted({marker for block in rows.blocks for marker in block.markers})
    tools = dict.fromkeys(markers, arm.tool)
    apart = _apart(arm, rows, tools)
    base, how = _base(arm, largest_session(rows) if apart else rows, tools, kind)
    parameters = starting_parameters(robot, rows, base, tools)
    names = list(identifiable("auto", robot, parameters, rows))
    if apart:  # every session has its own base: a common one in addition would be undetermined
        names = [name for name in names if frame_of(name) != "base_"]
    if context["chain"] and markers == [""]:
        names = _at_the_ends(names, robot, base is not None)
    lenses = starting_cameras(rows, {})
    cameras = {
        fixture: {name: lenses[of_fixture(f"camera_{name}", fixture)] for name in list(INTRINSICS)[:4]}
        for fixture in sorted({block.fixture for block in camera_blocks(rows)})
    }
    touches = [block.touched for block in rows.blocks if block.touched is not None]
    touched = dict.fromkeys(str(name) for names in touches for name in names[:, 0])
    known = {direction: word for word, direction in MOUNTINGS.items()}
    options = {"trim_blocks": True, "lstrip_blocks": True, "keep_trailing_newline": True, "undefined": StrictUndefined}
    template = Environment(autoescape=False, **options)
    bare = re.compile(r"[\w-]+", re.ASCII)
    template.filters |= {"toml": toml, "frame": _frame, "key": lambda k: k if bare.fullmatch(k) else toml(k)}
    text = template.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        **context,
        source=source,
        ready=source.parent == READY,
        noise=usual_noise(kind),
        assumed=bool(_assumed(found)),
        ignored=_ignored_joints(arm, found),
        reading=replace(found.options, joints=arm.names).texts(),
        robot=robot,
        kind=kind,
        rows=rows,
        how=how,
        apart=apart,
        markers=markers,
        tool=np.where(np.abs(arm.tool) < 1e-12, 0.0, arm.tool),
        cameras=cameras,
        touched=list(touched)[:2],
        base=None if base is None else _frame(base),
        mounting=known.get(robot.gravity.direction, list(robot.gravity.direction)),
        linear=[f"ratio{i}" for i, kind in enumerate(robot.joint_types, start=1) if kind == "prismatic"],
        followers=[i for i in range(1, len(robot.mdh) + 1) if i - 1 not in robot.leading],
        identify=_patterns(names, len(robot.mdh)) + ["session_*"] * bool(apart),
    )
    return text, "\n".join(filter(None, [how, apart]))


def _at_the_ends(names: Sequence[str], robot: Robot, based: bool) -> list[str]:
    """Return the parameters of fixed joints at a chain's ends, if any, in place of base and tool."""
    every = [origin for carried in row_origins(robot.model.terms) for origin in carried.origins]
    mounts = {origin.up: origin.prefix for origin in every if origin.prefix.startswith(MOUNT)}
    instead = {"tool_": mounts.get(False, "tool_")} | ({"base_": mounts.get(True, "")} if based else {})
    moved = [(instead.get(frame_of(name), frame_of(name)), name) for name in names]
    return [name if frame == frame_of(name) else frame + name.rpartition("_")[2] for frame, name in moved if frame]


def _apart(arm: RobotSetup, rows: Dataset, tools: Mapping[str, Array]) -> str:
    """Say which sessions have a registration of their own; empty without such."""
    off = sessions_apart(arm.robot, with_poses(rows, starting_cameras(rows, {})), tools)
    if not off:
        return ""
    first, *others = off
    figures = listed([f"'{name}' {three_digits(1e3 * off[name])} mm" for name in others])
    return (
        "Guessed: the instrument or the base was moved between sessions. RMS distance of their points from the nominal "
        f"robot, registered in session '{first}': {figures}. So session_*, a registration of each, is identified in "
        "place of base_*, with session_mm = 1000 and session_mrad = 1000 in [scale]."
    )


def _base(arm: RobotSetup, rows: Dataset, tools: Mapping[str, Array], kind: Measurement) -> tuple[Array | None, str]:
    """Return the base to state, None for registration, and why."""
    rows = with_poses(rows, starting_cameras(rows, {}))
    if not any(block.measurement.registers for block in rows.blocks):
        return arm.base, "The base is that of the robot file: these measurements do not depend on it."
    located, _, verdict = locate(arm.robot, rows, tools)
    if same_place(located, arm.base):
        offset = 1e3 * np.linalg.norm(located[:3] - arm.base[:3])
        return arm.base, f"Guessed: the data are in the robot's base frame, {offset:.1f} mm from the registered one."
    how = f"Guessed: the base was registered at {placed(located)}, {kind.words.frame} ({verdict})."
    down = -numeric_frame(located)[2, :3]
    if down @ arm.robot.gravity.direction < UPRIGHT and not kind.by_camera:
        close = [word for word, direction in MOUNTINGS.items() if down @ direction > UPRIGHT]
        stated = toml(close[0] if close else down.round(3).tolist())
        how += f" If the instrument's z points up, the robot is mounted otherwise than assumed: mounting = {stated}."
    blocks = [block for block in rows.blocks if block.measurement.registers]
    seen = np.vstack([block.y[:, :3] for block in blocks])
    flange = np.vstack([forward_kinematics(arm.robot, block.q[:, 0])[:, :3, 3] for block in blocks])
    measured, nominal = (1e3 * float(np.linalg.norm(points.std(axis=0))) for points in (seen, flange))
    if not nominal / UNLIKE < measured < nominal * UNLIKE:
        how += f" The measured points spread by {measured:.3g} mm RMS, those of the nominal flange by {nominal:.3g} mm"
        how += ": are the units right?"
    return None, how


def _patterns(names: Sequence[str], dof: int) -> list[str]:
    """Return names with those of one column of all joints, of a whole frame, of a frame's place as patterns."""
    groups: dict[str, list[str]] = {f"{ORIGIN}*": [name for name in names if name.startswith(ORIGIN)]}
    if dof < 10:  # a question mark stands for one digit
        groups |= {f"{column}?": [f"{column}{i}" for i in range(1, dof + 1)] for column in MDH}
    for prefix in dict.fromkeys(name[: name.rindex("_") + 1] for name in names if "_" in name):
        groups[f"{prefix}*"] = [prefix + c for c in FRAME]
        groups[f"{prefix}[xyz]"] = [prefix + c for c in FRAME[:3]]
    groups["camera_*"] = [f"camera_{name}" for name in INTRINSICS]
    left = list(names)
    patterns = []
    for pattern, members in groups.items():
        if members and set(members) <= set(left):
            left = [name for name in left if name not in members]
            patterns.append(pattern)
    return [*patterns, *left]


def _frame(place: Array) -> str:
    lines = []
    for dimension, part in (("length", slice(3)), ("angle", slice(3, 6))):
        unit, numbers = exact(dimension, place[part])
        named = zip(FRAME[part], numbers, strict=True)
        lines += [f"{name}_{unit} = {round(number, 12) + 0.0!r}" for name, number in named]
    return "\n".join(lines)
