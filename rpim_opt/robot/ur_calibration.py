"""Universal Robots' calibration.conf of the controller: deltas of DH parameters, and back."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.inputs import read_bytes
from rpim_opt.basics.writing import write_bytes
from rpim_opt.robot.chain import Chain, Described, describe, link_of, require_same_arm, without_beta
from rpim_opt.robot.kinematics import frame_numbers
from rpim_opt.robot.mdh import MDH, Robot
from rpim_opt.robot.original import spliced
from rpim_opt.robot.ur_numbers import JOINTS, REVOLUTE, finite

DELTAS = {"theta": "delta_theta", "d": "delta_d", "a": "delta_a", "alpha": "delta_alpha"}


def read_ur_calibration(path: str | Path, nominal: Robot) -> Described:
    """Return the robot that a controller's ``calibration.conf`` describes, in the controller's Base.

    Its section ``[mounting]`` lists ``delta_theta``, ``delta_a``, ``delta_d`` and ``delta_alpha``, from the base
    joint to wrist 3, in rad and m. They are added to the model's standard DH parameters, all of them::

        T = prod_i Rot(z, q_i + theta_i) Trans(z, d_i) Trans(x, a_i) Rot(x, alpha_i)

    Order, sign and units: UniversalRobots/Universal_Robots_ROS_Driver, ur_calibration (which adds such deltas in its
    tests), and forum.universal-robots.com, thread 1638, "UR10 Calibration.conf DH model generation". Along
    the nearly parallel axes 2, 3 and 4 the file's d are metres to kilometres, theta and a follow; here beta2 and
    beta3 take the tilt and every number is near nominal.

    Parameters
    ----------
    path
        The file.
    nominal
        The model, a ready robot such as ``read_robot(find_robot("ur5e"))``.

    Raises
    ------
    InputError
        Naming the file, the key, what was found and what is accepted; for a nominal robot without six revolute joints.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> from rpim_opt.robot.library import find_robot
    >>> nominal = ro.read_robot(find_robot("ur10"))
    >>> arm = ro.read_ur_calibration("calibration.conf", nominal)
    >>> (1e3 * (arm.robot.mdh - nominal.mdh)[:, 3]).round(2)  # deviations of d [mm]
    array([ 0.66,  0.  ,  0.  , -0.83, -0.02,  0.02])
    """
    path = Path(path)
    deltas, _ = _deltas(read_bytes(path), path)
    require_same_arm(nominal, nominal.mdh, REVOLUTE, path)
    table = nominal.mdh.copy()
    table[:, 2:4] += np.column_stack([deltas["theta"], deltas["d"]])
    table[1:, :2] += np.column_stack([deltas["alpha"], deltas["a"]])[:-1]
    tail = link_of(alpha=deltas["alpha"][-1], a=deltas["a"][-1])
    plain, base, tool, _ = describe(Chain.about_z([link_of(*row) for row in table], tail), nominal.mdh)
    robot = Robot(nominal.name, plain, nominal.joint_types, nominal.joint_map, nominal.limits, path.name)
    return Described(robot, frame_numbers(base), frame_numbers(tool), JOINTS)


def write_ur_calibration(source: str | Path, robot: Robot, nominal: Robot, target: str | Path) -> None:
    """Write a ``calibration.conf`` with an identified robot's deltas, everything else as in ``source``.

    The betas are turned into common normals first, as the controller's parameters are. Not tried on a controller:
    what else it checks (the file has checksums of the joints) is not documented. Keep the original.

    Parameters
    ----------
    source
        The robot's own file.
    robot
        The identified robot, in the controller's Base.
    nominal
        The model, as for `read_ur_calibration`.
    target
        Where to write; may be ``source``.

    Raises
    ------
    InputError
        For alpha1 or a1 that deviate (the base has to hold them), beta6, or axes too nearly parallel.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> from rpim_opt.robot.library import find_robot
    >>> nominal = ro.read_robot(find_robot("ur10"))
    >>> robot = ro.read_ur_calibration("calibration.conf", nominal).robot  # or an identified one
    >>> ro.robot.write_ur_calibration("calibration.conf", robot, nominal, "identified.conf")
    >>> again = ro.read_ur_calibration("identified.conf", nominal).robot
    >>> bool(np.allclose(again.mdh, robot.mdh, atol=1e-9))
    True
    """
    path = Path(source)
    data = read_bytes(path)
    old, places = _deltas(data, path)
    require_same_arm(robot, nominal.mdh, REVOLUTE, path)
    if np.abs(robot.mdh[0, :2] - nominal.mdh[0, :2]).max() > 1e-12:
        raise InputError("robot", "alpha1 or a1 that deviate", "a base that holds where axis 1 is", path)
    change = without_beta(robot).mdh - nominal.mdh
    shifted = {"theta": change[:, 2], "d": change[:, 3], "a": np.append(change[1:, 1], 0.0)}
    shifted["alpha"] = np.append(change[1:, 0], 0.0)
    edits = {
        places[name]: ", ".join(repr(float(v)) for v in values)
        for name, values in shifted.items()
        if not np.array_equal(values, old[name])
    }
    write_bytes(Path(target), spliced(data, edits))


def _deltas(data: bytes, path: Path) -> tuple[dict[str, Array], dict[str, tuple[int, int]]]:
    """Return the four lists, and by name where in the file their numbers stand."""
    section = re.search(rb"^\s*\[mounting\](.*?)(?=^\s*\[\w+\]|\Z)", data, re.MULTILINE | re.DOTALL)
    if section is None:
        raise InputError("section [mounting]", "nothing", "a controller's calibration.conf", path)
    values = {}
    places = {}
    for name in MDH:
        if name in DELTAS:
            values[name], (first, last) = _list(section[1], DELTAS[name], path)
            places[name] = (section.start(1) + first, section.start(1) + last)
    return values, places


def _list(section: bytes, key: str, path: Path) -> tuple[Array, tuple[int, int]]:
    """Return the six numbers of a key, and where they begin and end."""
    lists = list(re.finditer(rb"^[ \t]*" + key.encode() + rb"[ \t]*=[ \t]*\[([^\]\n]*)\]", section, re.MULTILINE))
    if len(lists) != 1:
        raise InputError(f"key {key}", f"{len(lists)} lists", "one list of six numbers", path)
    parts = lists[0][1].decode(errors="replace").split(",")
    if len(parts) != 6:
        raise InputError(f"key {key}", f"{len(parts)} numbers", "one list of six numbers", path)
    return np.array([finite(part.strip(), f"key {key}", path) for part in parts]), lists[0].span(1)
