"""Universal Robots' kinematics.yaml of the ROS driver: the origins of six joints, and back."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.inputs import read_bytes
from rpim_opt.basics.writing import write_bytes
from rpim_opt.robot.chain import Chain, Described, corrected, describe, require_same_arm
from rpim_opt.robot.kinematics import frame_numbers, numeric_frame
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.original import origin_numbers, reach, spliced
from rpim_opt.robot.ur_numbers import JOINTS, REVOLUTE, finite

SIX = ("x", "y", "z", "roll", "pitch", "yaw")


LINE = re.compile(rb"^( *)([A-Za-z_]\w*):[ \t]*([^\s#]*)[ \t]*(?:#.*)?\r?$")


def read_ur_kinematics(path: str | Path, limits: Array | None = None) -> Described:
    """Return the robot of a ``kinematics.yaml`` of ROS, in the controller's Base (``base_link`` turned half a turn).

    Under ``kinematics`` stand shoulder, upper_arm, forearm, wrist_1, wrist_2 and wrist_3, each with the origin of its
    joint in the frame of the one before, x y z [m] and roll pitch yaw [rad], and ``hash``, which names the robot
    (UniversalRobots/Universal_Robots_ROS_Driver, ur_calibration; read by ros-industrial/universal_robot,
    ur_description). ur_description puts the angles into a URDF, so that they mean R = Rz Ry Rx, as here.
    ur_calibration computes them for R = Rx Ry Rz: a file from a controller therefore describes the robot only to
    the product of its small yaw angles (about 1e-4 rad) and the reach; `read_ur_calibration` has no such loss.

    Parameters
    ----------
    path
        The file: plain keys, two spaces or more a level, one a line.
    limits
        (6, 2) joint limits [rad], which the file does not hold.

    Raises
    ------
    InputError
        Naming the file, the line or key, what was found and what is accepted.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> arm = ro.read_ur_kinematics("kinematics.yaml")
    >>> arm.names[:2], arm.robot.mdh[2:4, 1].round(3)  # a3 and a4 [m]
    (('shoulder', 'upper_arm'), array([-0.425, -0.392]))
    """
    path = Path(path)
    chain, _ = _yaml_chain(read_bytes(path), path)
    table, base, tool, _ = describe(chain)
    robot = Robot("Universal Robots", table, limits=np.empty((0, 0)) if limits is None else limits, source=path.name)
    return Described(robot, frame_numbers(base), frame_numbers(tool), JOINTS)


def write_ur_kinematics(source: str | Path, robot: Robot, target: str | Path) -> None:
    """Write a ``kinematics.yaml`` with an identified robot's origins, everything else (and the hash) as in ``source``.

    The driver compares the hash with the controller's own calibration; it is that of the robot, not of the numbers.

    Parameters
    ----------
    source
        The original, or ur_description's default_kinematics.yaml of the model. Its `read_ur_kinematics` has to be
        the robot whose parameters were identified.
    robot
        The identified robot.
    target
        Where to write; may be ``source``.

    Raises
    ------
    InputError
        As `read_ur_kinematics`, and for another robot or a beta after the last joint.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import rpim_opt as ro
    >>> robot = ro.read_ur_kinematics("kinematics.yaml").robot
    >>> mdh = robot.mdh.copy()
    >>> mdh[2, 1] -= 0.0005  # as if identified: the upper arm is half a millimetre longer
    >>> ro.robot.write_ur_kinematics("kinematics.yaml", replace(robot, mdh=mdh), "identified.yaml")
    >>> (1e3 * (ro.read_ur_kinematics("identified.yaml").robot.mdh - robot.mdh)[2:4, 1]).round(6) + 0.0  # [mm]
    array([-0.5,  0. ])
    """
    path = Path(source)
    data = read_bytes(path)
    chain, places = _yaml_chain(data, path)
    table, base, tool, G = describe(chain)
    require_same_arm(robot, table, REVOLUTE, path)
    origins, _ = corrected(G, robot.mdh, base, tool)
    if robot.mdh[-1, 4]:
        raise InputError("robot", "beta6, which follows the last joint", "a robot with beta6 = 0", path)
    size = reach(robot.mdh, base, tool)
    edits = {}
    for name, T, old in zip(JOINTS, origins, chain.origins, strict=True):
        texts = origin_numbers(T, old, size)
        numbers = [number for text in texts for number in (text.split() if text else [None] * 3)]
        edits |= {places[name, key]: n for key, n in zip(SIX, numbers, strict=True) if n is not None}
    write_bytes(Path(target), spliced(data, edits))


def _yaml_chain(data: bytes, path: Path) -> tuple[Chain, dict[tuple[str, str], tuple[int, int]]]:
    """Return the six joints, and by joint and key where its number stands."""
    values: dict[tuple[str, str], float] = {}
    places: dict[tuple[str, str], tuple[int, int]] = {}
    joint = ""
    for number, at, line in _yaml_lines(data):
        match = _line(line, number, path)
        key = match[2].decode()
        text = match[3].decode(errors="replace")
        if not text:
            joint = _opened(key, number, path)
        elif key in SIX:
            if joint not in JOINTS or (joint, key) in values:
                raise InputError(f"line {number}", f"{joint}.{key} twice or out of place", "each joint once", path)
            values[joint, key] = finite(text, f"line {number}, {joint}.{key}", path)
            places[joint, key] = (at + match.start(3), at + match.end(3))
    _require_all(values, path)
    origins = [numeric_frame([values[joint, key] for key in SIX]) for joint in JOINTS]
    return Chain.about_z(origins, np.eye(4)), places


def _yaml_lines(data: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield number, first byte and text of the lines that say something."""
    at = 0
    for number, line in enumerate(data.split(b"\n"), start=1):
        if line.strip() and not line.lstrip().startswith((b"#", b"---")):
            yield number, at, line
        at += len(line) + 1


def _require_all(values: Mapping[tuple[str, str], float], path: Path) -> None:
    for joint in JOINTS:
        for key in SIX:
            if (joint, key) not in values:
                raise InputError(f"key {joint}.{key}", "nothing", "a number [m or rad]", path)


def _line(line: bytes, number: int, path: Path) -> re.Match[bytes]:
    match = LINE.match(line)
    if match is None:
        found = repr(line.decode(errors="replace").strip()[:40])
        raise InputError(f"line {number}", found, "one 'key: value' a line", path)
    return match


def _opened(key: str, number: int, path: Path) -> str:
    """Return the joint whose numbers follow."""
    if key not in ("kinematics", *JOINTS):
        raise InputError(f"line {number}", f"'{key}'", choices(key, JOINTS), path)
    return key
