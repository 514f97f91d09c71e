"""MDH tables for other tools: TOML, JSON, CSV, and RoboDK's four columns."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import read_json, write_json
from rpim_opt.basics.tables import csv_text, read_columns
from rpim_opt.basics.units import UNITS, display
from rpim_opt.basics.writing import write_text
from rpim_opt.robot.chain import without_beta
from rpim_opt.robot.mdh import MDH, Robot, read_robot, robot_of
from rpim_opt.robot.mounting import centre_keys, mounting_keys, payload_keys
from rpim_opt.robot.parameter_names import MDH_DIMENSION

LIMITS = ("lower", "upper")
WITHOUT_COLUMN = {
    "coupling": "a coupling of joints",
    "mounting": "a mounting other than on the floor",
    "payload": "a payload",
}
"""What a table with a row a joint has no place for."""


def read_mdh(path: str | Path) -> Robot:
    """Return the robot of a ``.toml``, ``.json`` or ``.csv`` file.

    JSON has the keys of ``robot.toml`` (the guide "Your own robot"). CSV has a row a joint and the keys of a
    ``[[joint]]`` as columns, ``alpha_deg,a_mm,theta_deg,d_mm,beta_deg``, and if wanted ``type``, ``sign``, and
    ``lower_deg,upper_deg`` (``_mm`` for prismatic joints), ``mass_kg,centre_x_mm,centre_y_mm,centre_z_mm``; an empty
    cell is left out.

    Raises
    ------
    InputError
        Naming the file, the key or column, what was found and what is accepted.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> ro.robot.write_robot(ro.load("paper_arm").problem.robot, "arm.csv")
    >>> ro.read_mdh("arm.csv").dof
    6
    """
    path = Path(path)
    readers = {".toml": read_robot, ".json": _read_json, ".csv": _read_csv}
    return _by_ending(readers, path)(path)


def write_robot(robot: Robot, path: str | Path) -> None:
    """Write a robot as ``.toml``, ``.json`` or ``.csv``, so that `read_mdh` gives back exactly the same numbers.

    Angles are in degrees and lengths in millimetres where that loses no bit, in rad and m elsewhere.

    Parameters
    ----------
    robot
        The robot, `Calibration.robot` for instance.
    path
        The file; whole or not written at all.

    Raises
    ------
    InputError
        For another ending, one of two limits infinite, or in CSV, which has no place for them, a coupling of joints,
        a mounting other than on the floor, a payload.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, weight=1e-3)
    >>> ro.robot.write_robot(result.robot, "identified.toml")
    >>> bool((ro.read_mdh("identified.toml").mdh == result.robot.mdh).all())
    True
    """
    path = Path(path)
    _by_ending({".toml": _write_toml, ".json": _write_json, ".csv": _write_csv}, path)(robot, path)


def write_robodk(robot: Robot, path: str | Path) -> None:
    """Write the four modified DH numbers of every joint as CSV, ``joint,alpha_deg,a_mm,theta_deg,d_mm``.

    For RoboDK's robot parameters, which are a modified DH table (Craig's, "DHM") in mm and degrees. Hayati's betas
    are turned into common normals. Its API takes such a table with base and tool
    (``SetRobotParams(robot, dhm, poseBase, poseTool)``, RoboDK/RoboDK-API, C#), but documents neither the columns'
    order nor a file that can be read: transfer the numbers by name, and compare a pose before you rely on them.

    Parameters
    ----------
    robot
        The robot, `Calibration.robot` for instance.
    path
        The CSV file.

    Raises
    ------
    InputError
        For signs or couplings of joints, and what `without_beta` refuses.

    Examples
    --------
    >>> from pathlib import Path
    >>> import rpim_opt as ro
    >>> ro.robot.write_robodk(ro.load("paper_arm").problem.robot, "robodk.csv")
    >>> print(Path("robodk.csv").read_text())
    joint,alpha_deg,a_mm,theta_deg,d_mm
    1,0.0,0.0,0.0,99.927
    2,90.0,0.0,0.0,106.95
    3,0.0,428.052,0.0,0.0
    4,0.0,398.551,0.0,0.0
    5,-90.0,0.0,0.0,93.16
    6,-90.0,0.0,0.0,81.91
    """
    table = without_beta(robot).mdh
    if not np.array_equal(robot.joint_map, np.eye(robot.dof)):
        raise InputError("robot", "signs or couplings of joints", "joints that count as RoboDK's", robot.name)
    units = {c: display(MDH_DIMENSION[c]) for c in MDH[:4]}
    numbers = table[:, :4] / [si for _, si in units.values()]
    rows = [[number, *map(repr, row)] for number, row in enumerate(numbers.tolist(), start=1)]
    write_text(Path(path), csv_text(["joint", *(f"{c}_{unit}" for c, (unit, _) in units.items())], rows))


def _by_ending(known: dict[str, Any], path: Path) -> Any:
    if path.suffix.lower() not in known:
        raise InputError("the file's name", f"'{path.name}'", "a name ending in " + ", ".join(known), path)
    return known[path.suffix.lower()]


def _read_json(path: Path) -> Robot:
    content = read_json(path)
    if not isinstance(content, dict):
        raise InputError("the JSON text", type(content).__name__, "an object with the keys of robot.toml", path)
    return robot_of(content, path)


def _read_csv(path: Path) -> Robot:
    try:
        columns = read_columns(path)
    except InputError as error:
        raise error.within(path) from None
    rows = range(len(next(iter(columns.values()))))
    joints = [_joint({name: cells[i] for name, cells in columns.items()}) for i in rows]
    return robot_of({"name": path.stem, "joint": joints}, path)


def _joint(cells: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of ``[[joint]]`` from a row, whose empty cells are left out."""
    joint = {name: _cell(text) for name, text in cells.items() if text and name != "joint"}
    for unit in UNITS:
        pair = [joint.pop(f"{which}_{unit}", None) for which in LIMITS]
        if any(value is not None for value in pair):
            joint[f"limits_{unit}"] = pair
    return joint


def _cell(text: str) -> Any:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def _content(robot: Robot) -> dict[str, Any]:
    """Return the keys of ``robot.toml`` with which it reads back the same, zeros left out."""
    signs = np.diag(robot.joint_map)
    plain = np.array_equal(robot.joint_map, np.diag(signs)) and set(np.abs(signs)) == {1.0}
    content: dict[str, Any] = {"name": robot.name}
    if robot.source:
        content["source"] = robot.source
    if not plain:
        content["coupling"] = robot.joint_map.tolist()
    content |= mounting_keys(robot.gravity)
    joints = [_keys(robot, i) for i in range(robot.dof)]
    for joint, sign in zip(joints, signs, strict=True):
        if plain and sign < 0:
            joint["sign"] = -1
    carried = payload_keys(robot.gravity)
    if carried:
        content["payload"] = carried
    return content | {"joint": joints}


def _keys(robot: Robot, i: int) -> dict[str, Any]:
    """Return the keys of a ``[[joint]]``, but for its sign."""
    joint: dict[str, Any] = {}
    for column, value in zip(MDH, robot.mdh[i], strict=True):
        if value:
            unit, (number,) = exact(MDH_DIMENSION[column], [value])
            joint[f"{column}_{unit}"] = number
    if robot.joint_types[i] != "revolute":
        joint["type"] = robot.joint_types[i]
    if np.isfinite(robot.limits[i]).any():
        unit, pair = exact(robot.joint_dimensions[i], robot.limits[i])
        joint[f"limits_{unit}"] = pair
    if robot.gravity.masses:
        joint["mass_kg"] = robot.gravity.masses[i]
        joint |= centre_keys(robot.gravity.centres[i], "centre_")
    return joint


def exact(dimension: str, values: Any) -> tuple[str, list[float]]:
    """Return values in the unit that is shown, or in SI where that would not read back the same."""
    if not np.isfinite(values).all():
        raise InputError("limits of the robot", f"{[float(v) for v in values]}", "finite numbers, or no limits")
    unit, si = display(dimension)
    numbers = [float(f"{v / si:.15g}") for v in values]
    if all(n * si == v for n, v in zip(numbers, values, strict=True)):
        return unit, numbers
    return {"angle": "rad", "length": "m"}[dimension], [float(v) for v in values]


def _write_json(robot: Robot, path: Path) -> None:
    write_json(path, _content(robot))


def _write_toml(robot: Robot, path: Path) -> None:
    content = _content(robot)
    joints = content.pop("joint")
    carried = content.pop("payload", None)
    blocks = [[f"{key} = {toml(value)}" for key, value in content.items()]]
    if carried:
        blocks.append(["[payload]", *(f"{key} = {toml(value)}" for key, value in carried.items())])
    blocks += [["[[joint]]", *(f"{key} = {toml(value)}" for key, value in joint.items())] for joint in joints]
    write_text(path, "\n\n".join("\n".join(block) for block in blocks) + "\n")


def toml(value: Any) -> str:
    """Return a text, number or list of lists as TOML, which writes them as JSON does."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _write_csv(robot: Robot, path: Path) -> None:
    content = _content(robot)
    for key, what in WITHOUT_COLUMN.items():
        if key in content:
            raise InputError("robot", what, "a name ending in .toml or .json", path)
    rows = [_cells(joint) for joint in content["joint"]]
    header = [f"{column}_{display(MDH_DIMENSION[column])[0]}" for column in MDH]
    header += sorted({key for row in rows for key in row} - set(header))
    write_text(path, csv_text(header, ([row.get(key, "") for key in header] for row in rows)))


def _cells(joint: dict[str, Any]) -> dict[str, Any]:
    """Return a joint's keys with the two limits in cells of their own."""
    cells = {key: value for key, value in joint.items() if not key.startswith("limits_")}
    for key in joint.keys() - cells.keys():
        unit = key.removeprefix("limits_")
        cells |= {f"{which}_{unit}": value for which, value in zip(LIMITS, joint[key], strict=True)}
    return cells
