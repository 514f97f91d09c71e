"""Every parser as a function of bytes: it may refuse them with one sentence, and what it accepts it means.

A parser that raises anything but an `RpimError`, or whose reading does not come back from what is written, fails.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import rpim_opt as ro
from rpim_opt.basics.layout import TableOptions
from rpim_opt.basics.tables import csv_text, read_columns
from rpim_opt.basics.units import parse_units
from rpim_opt.convex.constraint_parser import sentence
from rpim_opt.convex.formulation import formulation_of
from rpim_opt.data import read_data
from rpim_opt.data.measurements.registry import MEASUREMENTS
from rpim_opt.report.console import listed_numbers, payload_of, tool_frame
from rpim_opt.robot import RobotSetup
from rpim_opt.robot.library import find_robot
from rpim_opt.store import problems_folder
from rpim_opt.store.problem_file import named_weight
from rpim_opt.store.raw import interpret_tables, usual_noise
from rpim_opt.store.result_file import digest

TWO = ro.robot.Robot("two", np.array([[0.0, 0, 0, 0.3, 0], [1.5, 0.4, 0, 0, 0]]))
IDENTITY = np.zeros(6)


def same(one: Any, other: Any) -> bool:
    """Whether two values are equal, arrays and dataclasses part by part."""
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    if hasattr(one, "__dataclass_fields__"):
        return type(one) is type(other) and all(
            same(getattr(one, f), getattr(other, f)) for f in one.__dataclass_fields__
        )
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other)


def require(condition: bool, what: str) -> None:
    """Fail where something accepted does not come back."""
    if not condition:
        raise AssertionError(what)


def _robot_file(data: bytes, folder: Path, ending: str, read: Callable[[Path], ro.robot.Robot]) -> None:
    path = folder / f"robot{ending}"
    path.write_bytes(data)
    robot = read(path)
    require(bool(np.isfinite(robot.mdh).all()), "a robot of finite numbers")
    for target in (folder / "again.toml", folder / "again.json"):
        ro.robot.write_robot(robot, target)
        again = ro.read_robot(target)
        require(same(robot.mdh, again.mdh), f"{target.suffix}: the same numbers")
        require(same(robot.limits, again.limits), f"{target.suffix}: the same limits")
        require(robot.joint_types == again.joint_types, f"{target.suffix}: the same joints")
        require(same(robot.joint_map, again.joint_map), f"{target.suffix}: the same map")


def robot(data: bytes, folder: Path) -> None:
    """Read robot.toml."""
    _robot_file(data, folder, ".toml", ro.read_robot)


def robot_json(data: bytes, folder: Path) -> None:
    """Read a robot's JSON file."""
    _robot_file(data, folder, ".json", ro.read_robot)


def robot_csv(data: bytes, folder: Path) -> None:
    """Read a robot's CSV file."""
    _robot_file(data, folder, ".csv", ro.read_robot)


def problem(data: bytes, folder: Path) -> None:
    """Read a problem folder: the tables are those of the problem with the same robot."""
    stated = re.search(rb'^robot *= *"(\w+)"', data, re.M)
    robot = b"robot.toml" if stated is None else stated[1]
    home = folder / "cell"
    home.mkdir(exist_ok=True)
    for name, text in _tables(robot).items():
        (home / name).write_text(text, encoding="utf-8")
    (home / "problem.toml").write_bytes(data)
    instance = ro.load(home)
    require(bool(np.isfinite(instance.problem.parameters.scale).all()), "finite scales")
    require(bool((instance.problem.parameters.scale > 0).all()), "scales above zero")


@cache
def _tables(robot: bytes) -> dict[str, str]:
    """Return the first rows of the tables that the problem with a robot has, of paper_arm where there is none."""
    homes = {path.parent: path.read_bytes() for path in problems_folder().glob("*/problem.toml")}
    fitting = [home for home, text in sorted(homes.items()) if b'robot = "' + robot + b'"' in text]
    home = fitting[0] if fitting and robot != b"robot.toml" else problems_folder() / "paper_arm"
    texts = {path.name: path.read_text(encoding="utf-8") for path in (*home.glob("*.csv"), *home.glob("robot.toml"))}
    return {
        name: "\n".join(text.split("\n")[:25]) + "\n" if name.endswith("csv") else text for name, text in texts.items()
    }


def table(data: bytes, folder: Path) -> None:
    """Read a table of measurements, of every kind."""
    path = folder / "table.csv"
    path.write_bytes(data)
    columns = read_columns(path)
    path.write_text(csv_text(columns, zip(*columns.values(), strict=True)), newline="", encoding="utf-8")
    again = read_columns(path)
    require({k: list(v) for k, v in columns.items()} == {k: list(v) for k, v in again.items()}, "the same cells")
    refusals = []
    for kind in MEASUREMENTS.values():
        try:
            rows = read_data(columns, TWO, usual_noise(kind), kind)
        except ro.InputError as error:
            refusals.append(error)
            continue
        require(bool(np.isfinite(rows.q).all()), "finite joint values")
        for block in rows.blocks:
            require(bool(np.isfinite(block.y).all()), "finite measurements")
        require(same(rows.q, read_data(path, TWO, usual_noise(kind), kind).q), "the same from the file")
    if len(refusals) == len(MEASUREMENTS):
        raise refusals[0]


def raw(data: bytes, folder: Path) -> None:
    """Understand a raw table."""
    path = folder / "raw.csv"
    path.write_bytes(data)
    arm = RobotSetup(TWO, IDENTITY, IDENTITY, ("A1", "A2"))
    found = None
    for units in ("", "deg,mm"):
        with suppress(ro.InputError):
            found = interpret_tables(arm, [path], options=TableOptions(units=parse_units(units)))
    if found is None:
        raise ro.InputError("raw", "nothing", "something")
    counts = {len(cells) for cells in found.columns.values()}
    require(len(counts) == 1, "columns of one length")
    str(found)
    json.dumps(found.content(), default=str)


@cache
def calibrated() -> ro.calibration.Calibration:
    """Return a calibration of the robot with two joints."""
    q = np.random.default_rng(0).uniform(-2, 2, (20, 2))
    parameters = ro.robot.model_parameters(TWO, [0.0] * 6, {"": [0.0] * 6}).identify(["a2"])
    data = ro.Dataset.of(q, ro.robot.forward_kinematics(TWO, q)[:, :3, 3], 1e-4)
    return ro.calibrate(ro.CalibrationProblem(TWO, parameters, data), ro.tikhonov, weight=1.0)


def targets(data: bytes, folder: Path) -> None:
    """Read targets."""
    path = folder / "targets.csv"
    path.write_bytes(data)
    read, _ = ro.use.read_targets(calibrated(), path)
    for values in (read.q, read.poses, read.torque, read.payload):
        require(values is None or bool(np.isfinite(values).all()), "finite targets")


def urdf(data: bytes, folder: Path) -> None:
    """Read a URDF."""
    path = folder / "arm.urdf"
    target = folder / "again.urdf"
    path.write_bytes(data)
    arm = ro.read_urdf(path)
    ro.robot.write_urdf(path, arm.robot, target)
    require(target.read_bytes() == data, "a robot that did not change leaves every byte")


def kinematics(data: bytes, folder: Path) -> None:
    """Read kinematics.yaml."""
    path = folder / "kinematics.yaml"
    target = folder / "again.yaml"
    path.write_bytes(data)
    arm = ro.robot.read_ur_kinematics(path)
    ro.robot.write_ur_kinematics(path, arm.robot, target)
    again = ro.robot.read_ur_kinematics(target)
    require(close(arm.robot.mdh, again.robot.mdh), "the same robot")


def close(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether numbers come back to rounding, of their largest."""
    return bool(np.abs(one - other).max() <= 1e-9 * (1 + np.abs(one).max()))


@cache
def _ur() -> ro.robot.Robot:
    return ro.read_robot(find_robot("ur5e"))


def calibration_conf(data: bytes, folder: Path) -> None:
    """Read calibration.conf."""
    path = folder / "calibration.conf"
    path.write_bytes(data)
    arm = ro.robot.read_ur_calibration(path, _ur())
    require(bool(np.isfinite(arm.robot.mdh).all()), "finite numbers")


def _sentence(data: bytes) -> str:
    return data.decode("utf-8", "replace")


def sentence_alone(data: bytes, folder: Path) -> None:
    """Read a statement in words."""
    text = _sentence(data)
    found = sentence(text)
    require(found == sentence(f" {text} "), "spaces around mean nothing")
    numbers = [found.limit, *(number for each in found.sums for number in (*each.factors, each.constant))]
    require(bool(np.isfinite(numbers).all()), "finite numbers")


@cache
def _parameters() -> Any:
    return ro.load("paper_arm").problem.parameters


def stated(data: bytes, folder: Path) -> None:
    """Read what is known of parameters."""
    prior = ro.bayes.Prior.known(_sentence(data))
    found = prior.stated(_parameters())
    require(bool(np.isfinite(found.rows).all()) and bool(np.isfinite(found.values).all()), "finite rows")


def result(data: bytes, folder: Path) -> None:
    """Read a result; one with a digest of what it says, so that more than the digest is asked."""
    path = folder / "result.json"
    path.write_bytes(data)
    with suppress(ValueError, RecursionError):
        content = json.loads(data)
        if isinstance(content, dict) and "digest" in content:
            path.write_text(json.dumps({**content, "digest": digest(content)}))
    found = ro.load_result(path)
    require(bool(np.isfinite(found.x).all()), "finite parameters")
    ro.store.save_result(found, path)
    require(same(ro.load_result(path).x, found.x), "the same parameters")


def options(data: bytes, folder: Path) -> None:
    """Read what options of commands mean."""
    text = _sentence(data)
    for read in (parse_units, tool_frame, payload_of, named_weight, formulation_of):
        with suppress(ro.InputError):
            read(text)
    listed_numbers(text)
    with suppress(ro.InputError):
        _parameters().scaled({text: 1.0})
    with suppress(ro.InputError):
        ro.constraints.signed(1, text)


PARSERS: dict[str, Callable[[bytes, Path], None]] = {
    "problem": problem,
    "robot": robot,
    "robot_json": robot_json,
    "robot_csv": robot_csv,
    "table": table,
    "raw": raw,
    "targets": targets,
    "urdf": urdf,
    "kinematics": kinematics,
    "calibration_conf": calibration_conf,
    "sentence": sentence_alone,
    "stated": stated,
    "result": result,
    "options": options,
}
