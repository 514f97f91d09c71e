"""A problem folder from a table of measurements and a robot: every key with what it means and where it comes from."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rpim_opt.dataset import Dataset, read_data
from rpim_opt.exceptions import InputError
from rpim_opt.exchange.chain import Described, placed, same_place
from rpim_opt.exchange.plain import exact, toml, write_robot
from rpim_opt.files import write_text
from rpim_opt.frames import locate, starting_parameters
from rpim_opt.instances import ROBOT_FILES, find_robot, lookup, proposed, read_arm
from rpim_opt.kinematics import FRAME, FRAME_DIMENSION
from rpim_opt.measurement import MEASUREMENTS, Measurement, pose, position
from rpim_opt.naming import Renamed, parse_units, rename
from rpim_opt.robot import MDH, Array
from rpim_opt.tables import Columns, csv_text, read_columns
from rpim_opt.units import split_unit

NOISE = {"length": ("mm", 0.05), "angle": ("mrad", 0.5)}
"""Standard deviations that are written where the data state none."""


@dataclass(frozen=True)
class Started:
    """A folder that was made: its files with their rows, and a sentence for all that was recognised or guessed."""

    folder: Path
    rows: Mapping[str, int]
    notes: tuple[str, ...]

    def __str__(self) -> str:
        """Return the files and the sentences."""
        lines = [f"{name}: {count} rows" for name, count in self.rows.items()]
        return "\n".join([f"Made: {self.folder}", *lines, *self.notes])


def new_problem(
    folder: str | Path,
    robot: str,
    data: str | Path,
    *,
    measurement: str | None = None,
    units: str = "",
    validation: str | Path | None = None,
    hold_out: float | None = None,
    seed: int = 0,
    urdf_base: str | None = None,
    urdf_tip: str | None = None,
) -> Started:
    """Make a problem folder that `load` reads; the folder is whole or not there.

    Parameters
    ----------
    folder
        A new one.
    robot
        The name of a ready robot, or a file ``.urdf``, ``.toml``, ``.json`` or ``.csv``.
    data
        Measurements, ``.csv``, ``.parquet`` or ``.xlsx``, with the columns of `read_data` or what `naming.rename`
        recognises.
    measurement
        What was measured; by default poses where the table has orientations, else positions.
    units
        Units of columns whose name carries none, ``"deg,mm"``.
    validation
        A table of measurements to keep apart.
    hold_out
        Instead of that, which part of the configurations to keep apart, drawn at random.
    seed
        Of the draw.
    urdf_base, urdf_tip
        Links between which a URDF's robot is.

    Raises
    ------
    InputError
        For a folder that is there already, and whatever of the robot or the data cannot be used.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> from rpim_opt.instances import find
    >>> arm = find("paper_arm")
    >>> made = ro.new_problem("cell7", str(arm / "robot.toml"), arm / "identification.csv", hold_out=0.25)
    >>> made.rows
    {'identification.csv': 7, 'validation.csv': 2}
    """
    folder, data, given = Path(folder), Path(data), parse_units(units)
    if folder.exists() or folder.is_symlink():
        raise InputError("the folder", "one that is there", "a new one: nothing is overwritten", folder)
    if validation is not None and hold_out is not None:
        raise InputError("validation", "a table and a part to hold out", "one of them")
    ready = not robot.endswith(ROBOT_FILES)
    file = find_robot(robot) if ready else Path(robot)
    if not file.is_file():
        raise InputError("the robot", "no such file", f"a file {', '.join(ROBOT_FILES)}, or a ready robot", file)
    arm = read_arm(file, urdf_base, urdf_tip)
    kind, table = _recognised(data, measurement, arm, given)
    noise = {f"{name}_{NOISE[d][0]}": NOISE[d][1] for name, d in kind.noise.items()}
    rows = _read(data, table, arm, noise, kind)
    columns = _labelled(table.columns, rows)
    tables, notes = {"identification.csv": columns}, _named(data, table)
    apart = '# validation = "validation.csv"   # a table that no choice may see; none was given'
    if validation is not None:
        other = _recognised(Path(validation), kind.name, arm, given)[1]
        _read(Path(validation), other, arm, noise, kind)
        tables["validation.csv"] = other.columns
        notes += _named(Path(validation), other)
        apart = f'validation = "validation.csv"\n# from {Path(validation).name}; no choice sees it'
    elif hold_out is not None:
        kept = _drawn(rows, hold_out, seed)
        tables = {"identification.csv": _taken(columns, ~kept), "validation.csv": _taken(columns, kept)}
        apart = f'validation = "validation.csv"\n# configurations drawn with seed {seed}; no choice sees them'
        rows = rows.take(np.flatnonzero(~kept))
    said = {
        "robot": toml(robot if ready else "robot.toml"),
        "drawing": "a ready robot" if ready else f"modified DH table, from {file.name}",
        "columns": "as you said" if measurement else f"guessed from the columns {', '.join(kind.columns)}",
        "data": data.name,
        "count": str(len(rows)),
        "validation": apart,
    }
    try:
        text, guessed = _problem(arm, kind, rows, noise, said)
    except InputError as error:
        raise error.within(data) from None
    folder.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=folder.parent, prefix=f"{folder.name}.") as temporary:
        made = Path(temporary) / folder.name
        write_text(made / "problem.toml", text)
        for name, each in tables.items():
            write_text(made / name, csv_text(each, zip(*each.values(), strict=True)))
        if file.suffix == ".toml" and not ready:
            write_text(made / "robot.toml", file.read_text(encoding="utf-8"))
        elif not ready:
            write_robot(arm.robot, made / "robot.toml")
        made.rename(folder)
    counts = {name: len(next(iter(each.values()))) for name, each in tables.items()}
    return Started(folder, counts, (*notes, *guessed))


# --- the tables --------------------------------------------------------------------------------------------


def _recognised(
    path: Path, measurement: str | None, arm: Described, units: Mapping[str, str]
) -> tuple[Measurement, Renamed]:
    """Return what a table measures, and the table under our names."""
    try:
        source = read_columns(path)
    except InputError as error:
        raise error.within(path) from None

    def renamed(kind: Measurement) -> Renamed:
        try:
            return rename(source, arm.robot, kind, units, arm.names)
        except InputError as error:
            raise error.within(path) from None

    if measurement is not None:
        kind = lookup(MEASUREMENTS, measurement, "measurement")
        return kind, renamed(kind)
    found = renamed(pose)
    stems = {split_unit(name)[0] for name in found.columns}
    if not stems & {"x", "y", "z"}:
        accepted = f"columns x, y, z, or --measurement {', '.join(MEASUREMENTS)}"
        raise InputError("the header", f"no positions among {', '.join(source)}", accepted, path)
    return (pose, found) if any(set(form) <= stems for form in _turns()) else (position, renamed(position))


def _turns() -> list[Sequence[str]]:
    return [tuple(pose.columns), *(tuple(form) for form, _ in pose.forms)]


def _read(path: Path, table: Renamed, arm: Described, noise: Mapping[str, float], kind: Measurement) -> Dataset:
    try:
        return read_data(table.columns, arm.robot, noise, kind)
    except InputError as error:
        raise error.within(path) from None


def _labelled(columns: Columns, rows: Dataset) -> Columns:
    """Return the columns with labels: a row keeps its number where rows are drawn."""
    return columns if "label" in columns else {"label": rows.label, **columns}


def _drawn(rows: Dataset, share: float, seed: int) -> np.ndarray:
    """Return which rows (N,) are held out: a share of the configurations, at least one."""
    known = len(np.unique(rows.configuration))
    if not 0 < share < 1 or known < 2:
        raise InputError("--hold-out", f"{share:g} of {known} configurations", "a part between 0 and 1 of two or more")
    drawn = rows.configurations(min(max(round(share * known), 1), known - 1), seed)
    return np.isin(rows.configuration, drawn.configuration)


def _taken(columns: Columns, rows: np.ndarray) -> Columns:
    return {name: [cells[i] for i in np.flatnonzero(rows).tolist()] for name, cells in columns.items()}


def _named(path: Path, table: Renamed) -> list[str]:
    notes = []
    if table.was:
        notes.append(f"{path.name}: " + ", ".join(f"{was} is {name}" for name, was in table.was.items()) + ".")
    if table.left_out:
        notes.append(f"{path.name}: left out {', '.join(table.left_out)}.")
    return notes


# --- the problem file --------------------------------------------------------------------------------------


TEMPLATE = """\
# Made by rpim-opt new; look at it, then: rpim-opt inspect, rpim-opt calibrate.
# Names carry units: _mm, _m, _deg, _mrad, _rad. What was guessed says so.

title = {title}
source = ""                     # who measured what, when and with what: result and report repeat it

robot = {robot}
# {drawing}
measurement = {measurement}
# {columns}
identification = "identification.csv"
# {count} rows, from {data}
{validation}

# What may deviate from the drawing, by name or pattern: alpha, a, theta, d of every joint, Hayati's beta where axes
# are near parallel, base_x ... base_rz, tool_x ... tool_rz. This is what "auto" means for these data.
identify = {identify}

formulation = "tikhonov"        # "robust" where rows may be wrong; "bounded" keeps to [tolerance]
selector = "reml"               # how the penalty's weight is chosen: l_curve, gcv, k_fold, ..., or a number, "0.5"
{auto}
# Standard deviation of a measured value, for rows that state none (column sigma_mm). Guessed: a laser tracker, and a
# robot that repeats well. reml finds the level itself; what counts is how kinds and rows compare.
[noise]
{noise}

# Expected size of deviations (prior standard deviation). Guessed: a machined arm, a reflector measured roughly.
# Single parameters by name: d5_mm, theta3_mrad.
[scale]
length_mm = 1.0                 # a, d
angle_mrad = 1.0                # alpha, theta, beta
tool_mm = 10.0
tool_mrad = 10.0
base_mm = {scale}
base_mrad = {scale}

# Largest deviation, for the formulation "bounded" alone.
[tolerance]
length_mm = 5.0
angle_mrad = 10.0
{base}
# The reflector in the flange frame: {known}.
{tools}

# Rows to leave out, label = reason:
# [exclude]
# {label} = "the reflector was bumped"
"""


def _problem(
    arm: Described, kind: Measurement, rows: Dataset, noise: Mapping[str, float], said: Mapping[str, str]
) -> tuple[str, list[str]]:
    """Return the text of ``problem.toml``, and what was guessed in sentences."""
    markers = sorted({marker for block in rows.blocks for marker in block.markers})
    tools = dict.fromkeys(markers, arm.tool)
    base, how = _base(arm, rows, tools)
    parameters = starting_parameters(arm.robot, rows, base, tools)
    about = "# The robot's base in the instrument's frame; rx, ry, rz are roll, pitch, yaw (R = Rz Ry Rx)."
    text = TEMPLATE.format(
        **said,
        title=toml(arm.robot.name),
        measurement=toml(kind.name),
        identify=toml(_patterns(proposed(arm.robot, parameters, rows), arm.robot.dof)),
        auto=f'base = "auto"\n# {how}\n' if base is None else "",
        noise="\n".join(f"{key} = {value}" for key, value in noise.items()),
        scale="100.0" if base is None else "1.0",
        base="" if base is None else "\n".join(["", about, f"# {how}", "[base]", *_frame(base), ""]),
        known="where the file has its tip" if arm.tool.any() else "not known, and identified from the flange's origin",
        tools="\n".join(line for m in markers for line in [f"[tool.{_key(m)}]" if m else "[tool]", *_frame(arm.tool)]),
        label=_key(rows.label[0]),
    )
    return text, [how]


def _base(arm: Described, rows: Dataset, tools: Mapping[str, Array]) -> tuple[Array | None, str]:
    """Return the base to state, None for registration, and why."""
    if not {block.measurement.name for block in rows.blocks} & {"position", "pose"}:
        return arm.base, "As the robot's file has it: these measurements do not depend on it."
    found = locate(arm.robot, rows, tools)[0]
    if same_place(found, arm.base):
        offset = 1e3 * np.linalg.norm(found[:3] - arm.base[:3])
        return (
            arm.base,
            f"Guessed: the data put the base {offset:.1f} mm from the robot's own, so they are in its frame.",
        )
    return None, f"Guessed: the data put the base at {placed(found)}, so the instrument has a frame of its own."


def _patterns(names: Sequence[str], dof: int) -> list[str]:
    """Return names with those of all joints, or of a whole frame, as patterns."""
    left, patterns = list(names), []
    groups = {f"{c}?": [f"{c}{i}" for i in range(1, dof + 1)] for c in MDH} if dof < 10 else {}
    for prefix in dict.fromkeys(n[: n.rindex("_") + 1] for n in names if "_" in n):
        groups |= {f"{prefix}*": [prefix + c for c in FRAME], f"{prefix}[xyz]": [prefix + c for c in FRAME[:3]]}
    for pattern, members in groups.items():
        if set(members) <= set(left):
            left = [name for name in left if name not in members]
            patterns.append(pattern)
    return [*patterns, *left]


def _frame(place: Array) -> list[str]:
    lines = []
    for name, value in zip(FRAME, place, strict=True):
        unit, (number,) = exact(FRAME_DIMENSION[name], [value])
        lines.append(f"{name}_{unit} = {number + 0.0!r}")
    return lines


def _key(text: str) -> str:
    """Return a TOML key."""
    return text if re.fullmatch(r"[\w-]+", text, re.ASCII) else toml(text)
