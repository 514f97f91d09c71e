"""Robots as tables: ``robot.toml`` and the same keys in JSON, one row per joint in CSV, and RoboDK's four columns."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, of_file, pick
from rpim_opt.basics.files import read_json, read_toml, write_json, write_text
from rpim_opt.basics.layout import PART_OF_PI, RawTable, read_table
from rpim_opt.basics.schema import Angle, Length, Mass, Misfit, Table, validate
from rpim_opt.basics.tables import csv_text, is_numeral
from rpim_opt.basics.units import DISPLAY, UNITS, accepted_units, display, split
from rpim_opt.robot.chain import Chain, RobotSetup, describe, joint_values, standard_table, without_beta
from rpim_opt.robot.formats.robotics_toolbox import read_links
from rpim_opt.robot.kinematics import frame_numbers, numeric_link
from rpim_opt.robot.mdh import MDH, MDH_DIMENSION, MOUNTINGS, Gravity, Robot

READY = Path(__file__).resolve().parents[1] / "ready"
SHEETS = (".csv", ".tsv", ".txt", ".md", ".xlsx", ".m", ".py")  # endings of tables with one row per joint
WRITTEN = (".toml", ".json", ".csv")  # endings of what is written
LIMITS = ("lower", "upper")
CENTRE = ("centre_x", "centre_y", "centre_z")
SI = {"angle": "rad", "length": "m"}
FAR = 10.0  # a common normal further away than this [m] means nearly parallel axes
CONVENTIONS = {"modified": "modified", "craig": "modified", "proximal": "modified", "mdh": "modified",
               "standard": "standard", "paul": "standard", "distal": "standard", "classic": "standard",
               "hayati": "standard"}  # fmt: skip
"""Common names of the conventions of Denavit-Hartenberg tables."""
INDEX_BEFORE = re.compile(r"[_\s(\[{]*(?:[ij]\s*[-\u2212]\s*1|ⱼ₋₁)[)\]}]*", re.IGNORECASE)
"""Index i-1 on alpha or a, those of the previous link: the table is modified."""
INDEX = re.compile(r"(?:[_\s(\[{]+i|ⱼ)[)\]}]*(?=\s|$)")
"""Index i, ``d(i)``, ``theta_i``: used in all conventions."""
SHEET = {"\u03b1": "alpha", "\u237a": "alpha", "θ": "theta", "β": "beta", "twist": "alpha", "theta offset": "theta",
         "offset": "theta", "r": "a", "min": "lower", "minimum": "lower", "max": "upper", "maximum": "upper",
         "q\u207b": "lower", "q\u207a": "upper", "sigma": "type", "\u03c3": "type", "joint type": "type"}  # fmt: skip
"""Other names of columns, including those that the Robotics Toolbox prints."""
TYPES = {
    **dict.fromkeys(("r", "rot", "rotary", "rotational", "continuous", "0"), "revolute"),
    **dict.fromkeys(("p", "t", "lin", "linear", "trans", "translational", "1"), "prismatic"),
}
"""Other words for a joint's type; 0 and 1 are sigma of the Robotics Toolbox."""
RANGE = re.compile(r"[\s_]*(?:range|limits?|bereich|grenzen?)[\s_]*")
"""Word for joint limits: beside the word of one limit, ``range min``, ``lower limit``; alone, a column of both."""
BOTH_LIMITS = re.compile(
    r"(?:[±+]\s*({0})|([+-]?{0})\s*°?\s*(?:\.\.+|…|/|to|bis|~|-|\u2013)\s*([+-]?{0}))?\s*°?".format(r"\d+(?:\.\d+)?")
)
"""Two limits in a cell, ``±180``, ``-180..180``; text files are read with + for ±."""
SHEET_ORDER = ("theta", "d", "a", "alpha", "beta")  # of a data sheet in the standard convention
JOINT_NAMES = ("joint", "i", "link", "no", "no.", "axis", "achse", "gelenk")  # columns of the joints' own names
ANGLE_OF = re.compile(r"(?:q|θ|theta|t|th)_?\{?\d+\}?\*?\s*([+-]?\s*[\d.]*)\s*°?", re.IGNORECASE)
"""A joint's variable with its offset, ``q2 - 90``."""
ANGLES = tuple(name for name, dimension in MDH_DIMENSION.items() if dimension == "angle")
TURNS, NEARLY = {np.pi / 2: "pi/2", np.pi: "pi"}, 0.002
"""Angles [rad] that most tables mean, and the largest error of stating them with three digits."""
SIGNS = {"°": "deg", "pi": "rad", "π": "rad"}  # of units in cells
LARGEST_TURN = 2 * np.pi  # [rad]; larger angles in a table are in degrees
JOINT_NAME = re.compile(r"(?:joint|axis|link|achse|gelenk)[\s_]*\d+", re.IGNORECASE)  # in a cell
WITHOUT_COLUMN = {
    "coupling": "a coupling of joints",
    "mounting": "another mounting than on the floor",
    "payload": "a payload",
}
"""Properties of a robot that a table with one row per joint cannot hold."""
Mounting = str | list[Annotated[float, Field(strict=False)]]
"""``"floor"``, ``"ceiling"``, ``"wall"``, or the direction of gravity in the robot's base frame."""


# Schema


class PayloadTable(Table):
    """The payload on the flange: ``[payload]``."""

    mass: Mass
    x: Length = 0.0
    y: Length = 0.0
    z: Length = 0.0


class _JointTable(Table):
    name: str = ""
    alpha: Angle = 0.0
    a: Length = 0.0
    theta: Angle = 0.0
    d: Length = 0.0
    beta: Angle = 0.0
    type: Literal["revolute", "prismatic"] = "revolute"
    sign: Literal[1, -1] = 1
    limits: Annotated[list[float] | None, "angle", "length"] = None
    mass: Annotated[float | None, "mass"] = None
    centre_x: Length = 0.0
    centre_y: Length = 0.0
    centre_z: Length = 0.0

    @model_validator(mode="before")
    @classmethod
    def _limits_fit_the_type(cls, table: Any) -> Any:
        if isinstance(table, dict):
            moves = "length" if table.get("type") == "prismatic" else "angle"
            wrong = [u for u, unit in UNITS.items() if f"limits_{u}" in table and unit.dimension != moves]
            if wrong:
                accepted = ", ".join(f"limits_{u}" for u in accepted_units(moves))
                raise Misfit(f"limits_{wrong[0]}", "a unit that does not fit the joint's type", accepted)
        return table


class _RobotTable(Table):
    name: str
    source: str = ""
    convention: Literal["modified"] = "modified"
    joint: list[_JointTable] = Field(min_length=1)
    coupling: list[list[Annotated[float, Field(strict=False)]]] | None = None
    mounting: Mounting | None = None
    payload: PayloadTable | None = None


def gravity_with(
    gravity: Gravity, mounting: Mounting | None, payload: PayloadTable | None, file: object, base: Array | None = None
) -> Gravity:
    """Return gravity with the mounting and the payload that a file states; ``base`` is that of `Gravity.mounted`."""
    try:
        if mounting is not None:
            gravity = gravity.mounted(mounting, base)
        if payload is not None:
            gravity = gravity.carrying(payload.mass, (payload.x, payload.y, payload.z))
    except InputError as error:
        raise InputError(f"key {error.where}", error.found, error.accepted, file) from None
    return gravity


def _robot(content: dict[str, Any], path: Path) -> Robot:
    """Return the robot that the keys of a ``robot.toml`` describe, whatever file they come from."""
    table = validate(_RobotTable, content, path)
    for column in ANGLES:
        _refuse_radians(column, [joint.get(f"{column}_deg") for joint in content["joint"]])
    dof = len(table.joint)
    coupling = np.eye(dof).tolist() if table.coupling is None else table.coupling
    if len(coupling) != dof or {len(row) for row in coupling} - {len(coupling[0])} or not 0 < len(coupling[0]) <= dof:
        raise InputError("key coupling", f"{coupling}", f"{dof} rows of equal length, at most {dof} numbers each")
    limits = [joint.limits or [-np.inf, np.inf] for joint in table.joint]
    for number, pair in enumerate(limits, start=1):
        if len(pair) != 2 or not pair[0] < pair[1]:
            raise InputError(f"key joint {number}.limits", f"no range {pair} [SI]", "[lower, upper]")
    gravity = Gravity()
    if any(joint.mass is not None for joint in table.joint):  # links without a stated mass then weigh nothing
        masses = tuple(joint.mass or 0.0 for joint in table.joint)
        centres = tuple((joint.centre_x, joint.centre_y, joint.centre_z) for joint in table.joint)
        gravity = Gravity(masses=masses, centres=centres)
    robot = Robot(
        name=table.name,
        mdh=np.array([[getattr(joint, column) for column in MDH] for joint in table.joint]),
        joint_types=tuple(joint.type for joint in table.joint),
        joint_map=np.diag([float(joint.sign) for joint in table.joint]) @ np.array(coupling),
        source=table.source,
        joint_names=tuple(joint.name for joint in table.joint) if any(joint.name for joint in table.joint) else (),
        gravity=gravity_with(gravity, table.mounting, table.payload, path),
    )
    return replace(robot, limits=np.array([limits[i] for i in robot.leading], dtype=float))


def _refuse_radians(column: str, degrees: Sequence[float | None]) -> None:
    """Refuse a column of degrees whose numbers, but for zeros, are all quarters and halves of a turn in radians."""
    stated = [value for value in degrees if value]
    turns = [turn for value in stated for turn in TURNS if abs(abs(value) - turn) < NEARLY]
    if stated and len(turns) == len(stated):
        accepted = f"degrees ({turns[0]:.5g} is {TURNS[turns[0]]} rad: name the column {column}_rad)"
        raise InputError(f"column {column}_deg", f"{stated[0]:g}", accepted)


def _ending(path: Path, endings: Sequence[str], others: str = "") -> str:
    ending = path.suffix.lower()
    if ending not in endings:
        raise InputError("the file's name", f"'{path.name}'", f"a name ending in {', '.join(endings)}{others}")
    return ending


# Reading


@of_file
def read_robot(path: str | Path) -> Robot:
    """Return the robot of a ``.toml``, ``.json`` or ``.csv`` file, or a ready one by its name (``ro.robots()``).

    TOML and JSON have the keys of ``robot.toml`` (the guide "Your own robot"). CSV has one row per joint and the keys
    of a ``[[joint]]`` as columns, ``alpha_deg,a_mm,theta_deg,d_mm,beta_deg``; optional are ``type``, ``sign``,
    ``lower,upper`` (in the unit of theta, or of d for prismatic joints, unless the header states one), ``mass_kg`` and
    ``centre_x_mm,centre_y_mm,centre_z_mm``; a column ``convention`` states ``modified`` or ``standard``. InputError
    names file, key or column.

    >>> import rpim_opt as ro
    >>> ro.robot.write_robot(ro.load("paper_arm").problem.robot, "robot.toml")
    >>> ro.read_robot("robot.toml").mdh[1].round(4).tolist()  # alpha, a, theta, d, beta
    [1.5708, 0.0, 0.0, 0.107, 0.0]
    """
    path = next((ready for ready in READY.glob("*.toml") if ready.stem == str(path)), Path(path))
    ending = _ending(path, (*WRITTEN[:2], *SHEETS), "; read_urdf reads .urdf; ready robots are ro.robots()")
    if ending in SHEETS:
        described = read_sheet(path)
        if described.tool.any() or described.base.any():
            raise InputError("the table", "a link after the last joint", "a script's read_arm, or rpim-opt new")
        return described.robot
    content = read_json(path) if ending == ".json" else read_toml(path)
    if not isinstance(content, dict):
        raise InputError("the JSON text", type(content).__name__, "an object with the keys of robot.toml")
    return _robot(content, path)


@of_file
def read_sheet(path: Path, convention: str = "", units: Mapping[str, str] = MappingProxyType({})) -> RobotSetup:
    """Return the robot of a table with one row per joint, in the convention stated there or by ``convention``.

    ``units`` by dimension hold for angles or lengths for which neither header nor cells state a unit.

    ``modified`` (Craig, proximal) is the convention of this package. ``standard`` (Paul, distal) and Hayati's, which
    has a column beta, are converted exactly; what follows the last joint becomes the tool::

        modified   Rot(x, alpha) Trans(x, a) Rot(z, theta) Trans(z, d) Rot(y, beta)
        standard   Rot(z, theta) Trans(z, d) Trans(x, a) Rot(x, alpha) Rot(y, beta)
    """
    if path.suffix.lower() in (".m", ".py"):
        raw = read_links(path)
    else:
        raw = read_table(path, turned=lambda grid: {"alpha", "a", "d"} <= {_stem(row[0])[0] for row in grid.rows})
    for row in raw.left:  # a remark below the table: few cells, not only numbers
        cells = [cell for cell in row if cell]
        if len(cells) > len(raw.columns) / 2 or any(map(is_numeral, cells)) or JOINT_NAME.fullmatch(cells[0]):
            raise InputError("the table", f"'{', '.join(cells)[:60]}', no row of numbers", "one row per joint")
    columns, notes = _sheet_columns(raw, units)
    conventions = {convention, *(cell.lower() for cell in columns.pop("convention", []))} - {""}
    if any(INDEX_BEFORE.search(name) for name in raw.columns):
        conventions.add("modified")
    known = {CONVENTIONS.get(each, each) for each in conventions}
    if len(known) != 1 or not known <= set(CONVENTIONS.values()):
        accepted = "--dh modified (Craig, alpha first), --dh standard (Paul, theta first), or column `convention`"
        raise InputError("the convention of the table", " and ".join(sorted(known)) or "not stated", accepted)
    joints = [_joint(dict(zip(columns, cells, strict=True))) for cells in zip(*columns.values(), strict=True)]
    robot = _robot({"name": path.stem, "joint": joints}, path)
    if robot.gravity.masses and known != {"modified"}:
        raise InputError("the table", "masses of links in the frames of another convention", "--dh modified")
    arm = RobotSetup(robot) if known == {"modified"} else _from_standard(robot)
    return replace(arm, notes=(*(note for note in raw.notes if "is not a row of the table" in note), *notes))


def _sheet_columns(raw: RawTable, units: Mapping[str, str]) -> tuple[dict[str, list[str]], list[str]]:
    """Return the columns of a sheet as texts, by the keys of ``robot.toml``, and notes; without joints' names."""
    columns: dict[str, list[str]] = {}
    notes: list[str] = []
    stated = {unit for stem, unit in map(_stem, raw.columns) if stem in ANGLES and unit}
    for name, cells in raw.columns.items():
        texts = [str(cell) for cell in cells]
        stem, unit = _stem(name.partition(" #")[0])
        unit = unit or raw.units.get(MDH_DIMENSION.get(stem, ""), "")
        if stem in JOINT_NAMES or not any(texts) or all(map(JOINT_NAME.fullmatch, texts)):
            continue
        if not unit:
            unit, note = _unstated(name, stem, texts, stated, units)
            notes += filter(None, [note])
        stems = {stem: texts}
        if stem == "limits":
            stems = _both_limits(name, texts)
        for stem, texts in stems.items():
            key = stem + (f"_{unit}" if unit else "")
            if key in columns:
                raise InputError("the header", ", ".join(raw.columns), "every column once")
            columns[key] = texts
    return columns, notes


def _unstated(
    name: str, stem: str, texts: Sequence[str], stated: Collection[str], units: Mapping[str, str]
) -> tuple[str, str]:
    """Return the unit of a column whose header has none, and a note on its source: cells, other angles or options.

    Empty for a column without unit; InputError if a unit is required and nothing states it.
    """
    dimension = MDH_DIMENSION.get(stem, "")
    if stem in ANGLES:
        for sign, unit in SIGNS.items():
            if sign in "".join(texts).lower():
                return unit, ""
        turns = [_joint({f"{stem}_rad": text}).get(f"{stem}_rad") for text in texts]
        degrees = any(isinstance(turn, float | int) and abs(turn) > LARGEST_TURN for turn in turns)
        if len(stated) == 1 and not (degrees and "rad" in stated):  # radians in a column of degrees are refused
            (unit,) = stated
            return unit, f"column '{name}' states no unit: {unit}, as the other angles are."
    if dimension in units:
        return units[dimension], f"column '{name}' states no unit: {units[dimension]} by --units."
    if dimension:
        accepted = " or ".join(f"{stem} [{of[dimension]}]" for of in (DISPLAY, SI)) + ", or --units deg,mm or rad,m"
        raise InputError("the header", f"column '{name}' without a unit", accepted)
    return "", ""


def _both_limits(name: str, texts: Sequence[str]) -> dict[str, list[str]]:
    """Return lower and upper limits of cells that hold both, ``±180``, ``-170..190``."""
    pairs = [BOTH_LIMITS.fullmatch(text) for text in texts]
    if not all(pairs):
        accepted = "cells as ±180 or -170..190, or columns lower [deg] and upper [deg]"
        raise InputError("the header", f"both limits in a column, '{name}'", accepted)
    lower = [f"-{each[1]}" if each[1] else each[2] or "" for each in pairs if each]
    return {"lower": lower, "upper": [each[1] or each[3] or "" for each in pairs if each]}


def _stem(name: str) -> tuple[str, str]:
    """Return what a column of a sheet is called in ``robot.toml``, without indices, and its unit."""
    stem, unit = split(name)
    stem = INDEX.sub("", INDEX_BEFORE.sub("", stem).strip().lower())
    stem = RANGE.sub("", stem) or "limits"
    return SHEET.get(stem.replace("-", " "), stem), unit


def _from_standard(robot: Robot) -> RobotSetup:
    """Return the arm of numbers in the standard convention, with Hayati's beta behind every link."""
    robot = replace(robot, source="converted from a DH table in the standard convention (Paul)")
    alpha, a, theta, d, beta = robot.mdh.T
    shifted = np.column_stack([np.append(0.0, alpha[:-1]), np.append(0.0, a[:-1]), theta, d, beta])
    if not beta.any():  # the same numbers, with alpha and a one row further
        return RobotSetup(replace(robot, mdh=shifted), np.zeros(6), np.array([a[-1], 0.0, 0.0, alpha[-1], 0.0, 0.0]))
    turns = [numeric_link(theta=each, d=along) for each, along in zip(theta, d, strict=True)]
    links = [turn @ numeric_link(alpha[i], a[i], beta=beta[i]) for i, turn in enumerate(turns)]
    mdh, base, tool, _ = describe(Chain.about_z([np.eye(4), *links[:-1]], links[-1]), shifted)
    return RobotSetup(replace(robot, mdh=mdh), frame_numbers(base), frame_numbers(tool))


def _joint(cells: dict[str, str]) -> dict[str, Any]:
    """Return the keys of ``[[joint]]`` from a row, whose empty cells are left out."""
    joint: dict[str, Any] = {}
    for name, text in cells.items():
        if text and name != "note":
            if name == "type":
                text = TYPES.get(text.lower(), text.lower())
            joint[name] = text
            if name.startswith("theta"):
                text = ANGLE_OF.sub(r"\1", text).replace(" ", "") or "0"
            turns = PART_OF_PI.fullmatch(text)
            if turns and name.removesuffix("_rad") in ANGLES:
                text = str(float(f"{turns[1]}{turns[2] or 1}") * np.pi / float(turns[3] or 1))
            for kind in (float, int):
                with suppress(ValueError):
                    joint[name] = kind(text)
    variable = "d" if joint.get("type") == "prismatic" else "theta"
    own = next((unit for unit in UNITS if f"{variable}_{unit}" in cells), "")
    for unit in ("", *UNITS):  # limits without one have that of the joint's variable
        pair = [joint.pop(f"{which}_{unit}".rstrip("_"), None) for which in LIMITS]
        if any(value is not None for value in pair):
            joint[f"limits_{unit or own}"] = pair
    return joint


# Writing


@of_file
def write_robot(robot: Robot, path: str | Path, convention: str = "modified") -> None:
    """Write a robot as ``.toml``, ``.json`` or ``.csv``, so that `read_robot` gives back exactly the same numbers.

    Angles are in degrees and lengths in millimetres where this conversion is exact, otherwise in rad and m. With
    ``convention`` ``"standard"`` (or a synonym) a CSV goes from axis 1 to the same last frame, without alpha1 and a1
    and with a = alpha = 0 in the last row, in mm and degrees with 9 decimals.

    The file is written whole or not at all. InputError for another ending, one infinite limit of two, and in CSV for
    coupled joints, a mounting other than on the floor, and a payload.
    """
    path = Path(path)
    ending = _ending(path, WRITTEN)
    convention = pick(CONVENTIONS, convention.lower(), "--dh")
    if convention == "standard":
        if ending != ".csv":
            raise InputError("--dh", "standard", "a name ending in .csv: robot.toml and its JSON are modified", path)
        gravity = replace(robot.gravity, masses=(), centres=())
        robot = rounded(replace(robot, mdh=standard_table(robot), gravity=gravity))
    content = _content(robot)
    if ending == ".json":
        write_json(path, content)
    elif ending == ".csv":
        write_text(path, _csv(_content(replace(robot, joint_names=())), _in_si(robot), convention))
    else:
        joints = content.pop("joint")
        payload = content.pop("payload", None)
        blocks = [("", content), *([("[payload]\n", payload)] if payload else [])]
        blocks += [("[[joint]]\n", joint) for joint in joints]
        lines = [head + "\n".join(f"{key} = {toml(value)}" for key, value in keys.items()) for head, keys in blocks]
        write_text(path, "\n\n".join(lines) + "\n")


def rounded(robot: Robot) -> Robot:
    """Return a robot with numbers of 9 decimals in mm and degrees: a robot of 10 m stays within 1 nm."""
    units = np.array([display(dimension)[1] for dimension in MDH_DIMENSION.values()])
    return replace(robot, mdh=(np.round(robot.mdh / units, 9) + 0.0) * units)


def joints_alone(robot: Robot, file: Path) -> tuple[Robot, list[str]]:
    """Return the robot without joint map and limits, and a sentence on how the controller counts its joints."""
    alone = replace(robot, joint_map=np.empty((0, 0)), limits=np.empty((0, 0)))
    return alone, joint_values(robot, alone, file)


def write_robodk(robot: Robot, path: str | Path) -> list[str]:
    """Write the four modified DH numbers of every joint as CSV, ``joint,alpha_deg,a_mm,theta_deg,d_mm``.

    For RoboDK's robot parameters, a modified DH table (Craig's, "DHM") in mm and degrees; Hayati's betas become common
    normals. RoboDK's API takes such a table (``SetRobotParams(robot, dhm, poseBase, poseTool)``, RoboDK/RoboDK-API,
    C#), but documents neither the order of columns nor a file: transfer the numbers by name, and compare a pose. Return
    sentences on joint values that the table counts differently from the controller, and on axes so nearly parallel that
    rounding changes the robot noticeably; InputError for a beta after the last joint.
    """
    table = without_beta(robot).mdh
    notes = joints_alone(robot, Path(path))[1]
    units = {c: display(MDH_DIMENSION[c]) for c in MDH[:4]}
    far = [f"d{i} = {1e3 * d:.0f} mm" for i, d in enumerate(table[:, 3], start=1) if abs(d) > FAR]
    numbers = table[:, :4] / [si for _, si in units.values()]
    rows = [[number, *map(repr, row)] for number, row in enumerate(numbers.tolist(), start=1)]
    write_text(Path(path), csv_text(["joint", *(f"{c}_{unit}" for c, (unit, _) in units.items())], rows))
    if far:
        lost = 1e3 * np.radians(1e-4) * np.abs(table[:, 3]).max()
        notes.append(
            f"{Path(path).name}: use --mdh or --urdf if you can, which have beta. Here nearly parallel axes have their "
            f"common normal far away ({', '.join(far)}): transfer all digits (angles rounded to 0.0001 degrees cause "
            f"{lost:.2g} mm of error)."
        )
    return notes


def _content(robot: Robot) -> dict[str, Any]:
    """Return the keys of ``robot.toml`` with which it reads back the same, zeros left out."""
    n = len(robot.mdh)
    signs = np.diag(robot.joint_map)
    plain = robot.dof == n and np.array_equal(robot.joint_map, np.diag(signs)) and set(np.abs(signs)) == {1.0}
    content: dict[str, Any] = {"name": robot.name}
    if robot.source:
        content["source"] = robot.source
    content["convention"] = "modified"
    if not plain:
        content["coupling"] = robot.joint_map.tolist()
    gravity = robot.gravity
    if gravity.direction != MOUNTINGS["floor"]:
        words = {direction: word for word, direction in MOUNTINGS.items()}
        content["mounting"] = words.get(gravity.direction, list(gravity.direction))
    if gravity.payload or any(gravity.payload_centre):
        content["payload"] = {"mass_kg": gravity.payload} | _quantities("xyz", gravity.payload_centre)
    in_si = _in_si(robot)
    limits = dict(zip(robot.leading, robot.limits, strict=True))
    content["joint"] = []
    for i, kind in enumerate(robot.joint_types):
        joint: dict[str, Any] = {"name": robot.joint_names[i]} if robot.joint_names else {}
        joint |= _quantities(MDH, robot.mdh[i], in_si)
        if kind != "revolute":
            joint["type"] = kind
        if i in limits and np.isfinite(limits[i]).any():
            unit, pair = exact("angle" if kind == "revolute" else "length", limits[i], in_si)
            joint[f"limits_{unit}"] = pair
        if gravity.masses:
            joint |= {"mass_kg": gravity.masses[i]} | _quantities(CENTRE, gravity.centres[i], in_si)
        if plain and signs[i] < 0:
            joint["sign"] = -1
        content["joint"].append(joint)
    return content


def _in_si(robot: Robot) -> bool:
    """Whether the numbers of a table are written in m and rad, all of them: some would not read back the same."""
    columns = zip(MDH, robot.mdh.T, strict=True)
    return any(exact(MDH_DIMENSION[column], values)[0] == SI[MDH_DIMENSION[column]] for column, values in columns)


def _quantities(stems: Iterable[str], values: Iterable[float], in_si: bool = False) -> dict[str, float]:
    """Return quantities that are not zero under their names with the unit: lengths but for the table's angles."""
    pairs = zip(stems, values, strict=True)
    written = {stem: exact(MDH_DIMENSION.get(stem, "length"), [value], in_si) for stem, value in pairs if value}
    return {f"{stem}_{unit}": number for stem, (unit, (number,)) in written.items()}


def exact(dimension: str, values: Any, in_si: bool = False) -> tuple[str, list[float]]:
    """Return values in their display unit, or in SI if requested or needed to read back exactly."""
    if not np.isfinite(values).all():
        raise InputError("limits of the robot", f"{[float(v) for v in values]}", "finite numbers, or no limits")
    unit, si = display(dimension)
    numbers = [float(f"{v / si:.15g}") for v in values]
    if not in_si and all(n * si == v for n, v in zip(numbers, values, strict=True)):
        return unit, numbers
    return SI[dimension], [float(v) for v in values]


def toml(value: Any) -> str:
    """Return a text, number or list of lists as TOML, which writes them as JSON does."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _csv(content: dict[str, Any], in_si: bool, convention: str) -> str:
    for key, what in WITHOUT_COLUMN.items():
        if key in content:
            raise InputError("robot", what, "a name ending in .toml or .json")
    units = {column: SI[kind] if in_si else display(kind)[0] for column, kind in MDH_DIMENSION.items()}
    sheet = convention == "standard"
    header = [f"{column}_{units[column]}" for column in (SHEET_ORDER if sheet else MDH)]
    rows = [dict.fromkeys(header, 0.0) | joint for joint in content["joint"]]
    if sheet:
        header = ["joint", *header]
        rows = [{"joint": number} | row for number, row in enumerate(rows, start=1)]
    for row in rows:
        for unit in UNITS:  # the two limits in cells of their own
            pair = zip(LIMITS, row.pop(f"limits_{unit}", ()), strict=False)
            row |= {f"{which}_{unit}": value for which, value in pair}
    if any("sign" in row for row in rows):
        rows = [{"sign": 1} | row for row in rows]
    header = list(dict.fromkeys([*header, *(key for row in rows for key in row)]))
    return csv_text([*header, "convention"], ([*(row.get(key, "") for key in header), convention] for row in rows))
