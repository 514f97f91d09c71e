"""Universal Robots' files: the controller's calibration.conf (deltas) and the ROS driver's kinematics.yaml (origins).

Both describe six revolute joints; identified parameters replace the numbers in a file and leave all else as it is.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices, of_file
from rpim_opt.basics.files import read_bytes, write_files
from rpim_opt.basics.units import LARGEST, numeral
from rpim_opt.robot.chain import (
    Chain,
    RobotSetup,
    corrected,
    describe,
    origin_numbers,
    require_same_arm,
    spliced,
    without_beta,
)
from rpim_opt.robot.kinematics import frame_numbers, numeric_frame, numeric_link
from rpim_opt.robot.mdh import Robot

JOINTS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
DELTAS = {"theta": "delta_theta", "d": "delta_d", "a": "delta_a", "alpha": "delta_alpha"}
SIX = ("x", "y", "z", "roll", "pitch", "yaw")
PAIR = re.compile(rb"([A-Za-z_]\w*)[ \t]*:(?:[ \t]+|$|(?=\{))([^\s,{}]*)")  # also in a mapping {x: 0, y: 0}


def _number(text: bytes, where: str) -> float:
    value = numeral(text.decode(errors="replace"))
    if not abs(value) <= LARGEST:
        found = text.decode(errors="replace")[:40]
        raise InputError(where, f"'{found}'", f"a finite number, at most {LARGEST:g}")
    return value


def _in_base(robot: Robot) -> Robot:
    """Return the same arm in the controller's Base; ROS's ``base_link`` is rotated from it by half a turn about z.

    Rot(z, pi) T Rot(z, -pi) is the link T with alpha, a and beta negated; half a turn is left after the last joint.
    """
    if not (robot.mdh[2:4, 1] > 0).all():
        return robot
    mdh = robot.mdh * [-1.0, -1.0, 1.0, 1.0, -1.0]
    mdh[-1, 2] += np.pi
    return replace(robot, mdh=mdh)


# calibration.conf


@of_file
def read_ur_calibration(path: str | Path, nominal: Robot) -> RobotSetup:
    """Return the robot that a controller's ``calibration.conf`` describes, in the controller's Base.

    Its section ``[mounting]`` lists ``delta_theta``, ``delta_a``, ``delta_d`` and ``delta_alpha``, from the base joint
    to wrist 3, in rad and m. They are added to all standard DH parameters of the model::

        T = prod_i Rot(z, q_i + theta_i) Trans(z, d_i) Trans(x, a_i) Rot(x, alpha_i)

    Order, sign and units: UniversalRobots/Universal_Robots_ROS_Driver, ur_calibration (which adds such deltas in its
    tests), and forum.universal-robots.com, thread 1638, "UR10 Calibration.conf DH model generation". Along
    the nearly parallel axes 2, 3 and 4 the file's d are metres to kilometres, with theta and a to match; here beta2 and
    beta3 describe the tilt, and every number is close to nominal.

    ``nominal`` is the model, a ready robot such as ``read_robot("ur5e")``.

    >>> import rpim_opt as ro
    >>> nominal = ro.read_robot("ur10")
    >>> arm = ro.robot.read_ur_calibration("calibration.conf", nominal)
    >>> (1e3 * (arm.robot.mdh - nominal.mdh)[:, 3]).round(2)  # deviations of d [mm]
    array([ 0.66,  0.  ,  0.  , -0.83, -0.02,  0.02])
    """
    path = Path(path)
    deltas, _ = _deltas(read_bytes(path))
    require_same_arm(nominal, Robot(nominal.name, nominal.mdh), path)
    table = nominal.mdh.copy()
    table[:, 2:4] += np.column_stack([deltas["theta"], deltas["d"]])
    table[1:, :2] += np.column_stack([deltas["alpha"], deltas["a"]])[:-1]
    tail = numeric_link(alpha=deltas["alpha"][-1], a=deltas["a"][-1])
    plain, base, tool, _ = describe(Chain.about_z([numeric_link(*row) for row in table], tail), nominal.mdh)
    robot = Robot(nominal.name, plain, nominal.joint_types, nominal.joint_map, nominal.limits, path.name)
    return RobotSetup(robot, frame_numbers(base), frame_numbers(tool), JOINTS)


@of_file
def write_ur_calibration(source: str | Path, robot: Robot, nominal: Robot, target: str | Path) -> list[str]:
    """Write a ``calibration.conf`` with an identified robot's deltas, everything else as in ``source``.

    The betas become common normals first. Untested on a controller, whose checks (the file has checksums of the joints)
    are undocumented: keep the original. ``robot`` is in the controller's Base or, with ``nominal``, in ROS's
    ``base_link``. InputError if alpha1 or a1 deviate (they belong into the base), for beta6, and for axes too close to
    parallel.
    """
    path = Path(source)
    if not path.exists():
        raise InputError("the file", "nothing", "the robot's own file, copied from its controller")
    data = read_bytes(path)
    old, places = _deltas(data)
    robot, nominal = _in_base(robot), _in_base(nominal)
    notes = require_same_arm(robot, Robot(nominal.name, nominal.mdh, joint_names=JOINTS), path)
    if np.abs(robot.mdh[0, :2] - nominal.mdh[0, :2]).max() > 1e-12:
        raise InputError("robot", "alpha1 or a1 that deviate", "a base that includes the location of axis 1")
    if not (nominal.mdh[2:4, 1] < 0).all():
        found = f"a2 = {1e3 * nominal.mdh[2, 1]:.1f} mm and a3 = {1e3 * nominal.mdh[3, 1]:.1f} mm"
        raise InputError("robot", found, "a Universal Robot: a2 and a3 of its controller are negative")
    change = without_beta(robot).mdh - nominal.mdh
    change[:, 2] = np.angle(np.exp(1j * change[:, 2]))
    behind = np.vstack([change[1:], np.zeros(5)])  # alpha and a are one row further up
    new = {"theta": change[:, 2], "d": change[:, 3], "a": behind[:, 1], "alpha": behind[:, 0]}
    edits = {
        places[name]: ", ".join(repr(float(v)) for v in values)
        for name, values in new.items()
        if not np.array_equal(values, old[name])
    }
    write_files({Path(target): spliced(data, edits)})
    return notes


def _deltas(data: bytes) -> tuple[dict[str, Array], dict[str, tuple[int, int]]]:
    """Return the four lists (6,), and by name where in the file their numbers stand."""
    section = re.search(rb"^\s*\[mounting\](.*?)(?=^\s*\[\w+\]|\Z)", data, re.MULTILINE | re.DOTALL)
    if section is None:
        raise InputError("section [mounting]", "nothing", "a controller's calibration.conf")
    values = {}
    places = {}
    for name, key in DELTAS.items():
        line = rb"^[ \t]*" + key.encode() + rb"[ \t]*=[ \t]*\[([^\]\n]*)\]"
        lists = list(re.finditer(line, section[1], re.MULTILINE))
        parts = lists[0][1].split(b",") if len(lists) == 1 else []
        if len(parts) != 6:
            found = f"{len(parts)} numbers" if len(lists) == 1 else f"{len(lists)} lists"
            raise InputError(f"key {key}", found, "one list of six numbers")
        values[name] = np.array([_number(part.strip(), f"key {key}") for part in parts])
        places[name] = (section.start(1) + lists[0].start(1), section.start(1) + lists[0].end(1))
    return values, places


# kinematics.yaml


@of_file
def read_ur_kinematics(path: str | Path) -> RobotSetup:
    """Return the robot of a ``kinematics.yaml`` of ROS, in the controller's Base (``base_link`` turned half a turn).

    ``kinematics`` has shoulder, upper_arm, forearm, wrist_1, wrist_2 and wrist_3, each with the origin of its joint in
    the frame of the previous one, x y z [m] and roll pitch yaw [rad], and ``hash``, which identifies the robot
    (UniversalRobots/Universal_Robots_ROS_Driver, ur_calibration; read by ros-industrial/universal_robot,
    ur_description). ur_description puts the angles into a URDF, where they mean R = Rz Ry Rx, as here. ur_calibration
    computes them for R = Rx Ry Rz: a controller's file is therefore accurate only to the product of its small yaw
    angles (about 1e-4 rad) and the reach; `read_ur_calibration` has no such loss.

    >>> import rpim_opt as ro
    >>> arm = ro.robot.read_ur_kinematics("kinematics.yaml")
    >>> arm.names[:2], arm.robot.mdh[2:4, 1].round(3)  # a3 and a4 [m]
    (('shoulder', 'upper_arm'), array([-0.425, -0.392]))
    """
    path = Path(path)
    chain, _ = _yaml_chain(read_bytes(path))
    table, base, tool, _ = describe(chain)
    robot = Robot("Universal Robots", table, source=path.name, joint_names=JOINTS)
    return RobotSetup(robot, frame_numbers(base), frame_numbers(tool), JOINTS)


@of_file
def write_ur_kinematics(source: str | Path, robot: Robot, target: str | Path) -> list[str]:
    """Write a ``kinematics.yaml`` with an identified robot's origins, everything else (and the hash) as in ``source``.

    The driver compares the robot's hash with the controller's. ``source`` is the original file, or the model's
    default_kinematics.yaml of ur_description; its `read_ur_kinematics` has to be the robot whose parameters were
    identified, in the controller's Base or in ROS's ``base_link``. InputError for another robot, and for a beta after
    the last joint.
    """
    robot = _in_base(robot)
    path = Path(source)
    data = read_bytes(path)
    chain, places = _yaml_chain(data)
    notes = require_same_arm(robot, read_ur_kinematics(path).robot, path)
    if robot.mdh[-1, 4]:
        raise InputError("robot", "beta6, which follows the last joint", "a robot with beta6 = 0")
    origins, _, size = corrected(chain, robot.mdh, base=np.zeros(6))  # the base is stated even if the file had one
    edits = {}
    for name, T, old in zip(JOINTS, origins, chain.origins, strict=True):
        texts = origin_numbers(T, old, size)
        numbers = [number for text in texts for number in (text.split() if text else [None] * 3)]
        edits |= {places[name, key]: n for key, n in zip(SIX, numbers, strict=True) if n is not None}
    write_files({Path(target): spliced(data, edits)})
    return notes


def _yaml_chain(data: bytes) -> tuple[Chain, dict[tuple[str, str], tuple[int, int]]]:
    """Return the six joints, and by joint and key where its number stands."""
    values: dict[tuple[str, str], float] = {}
    places: dict[tuple[str, str], tuple[int, int]] = {}
    joint = ""
    for number, place in enumerate(re.finditer(rb"^[^#\r\n]*", data, re.MULTILINE), start=1):
        line = place[0]
        if PAIR.sub(b"", line).strip(b" \t,{}") not in (b"", b"---"):
            found = repr(line.decode(errors="replace").strip()[:40])
            raise InputError(f"line {number}", found, "'key: value', or {key: value, ...}")
        for match in PAIR.finditer(line):
            key = match[1].decode()
            if not match[2]:
                joint = key
                if key not in ("kinematics", *JOINTS):
                    accepted = f"{choices(key, JOINTS)} (of Universal Robots; another DH table as .csv or .toml)"
                    raise InputError(f"line {number}", f"'{key}'", accepted)
            elif key in SIX:
                if joint not in JOINTS or (joint, key) in values:
                    raise InputError(f"line {number}", f"{joint}.{key} twice or out of place", "each joint once")
                values[joint, key] = _number(match[2], f"line {number}, {joint}.{key}")
                places[joint, key] = (place.start() + match.start(2), place.start() + match.end(2))
    missing = [f"{joint}.{key}" for joint in JOINTS for key in SIX if (joint, key) not in values]
    if missing:
        raise InputError(f"key {missing[0]}", "nothing", "a number [m or rad]")
    origins = [numeric_frame([values[joint, key] for key in SIX]) for joint in JOINTS]
    return Chain.about_z(origins, np.eye(4)), places
