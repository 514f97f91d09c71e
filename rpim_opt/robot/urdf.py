"""URDF in, and the corrected origins back into the same file.

A corrected file keeps every byte but those of the origins that change.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.writing import write_bytes
from rpim_opt.robot.chain import Chain, Described, corrected, describe, require_same_arm
from rpim_opt.robot.expanding import XACRO
from rpim_opt.robot.gravity import Gravity
from rpim_opt.robot.kinematics import frame_numbers, numeric_frame
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.original import ROUNDING, reach, spliced
from rpim_opt.robot.urdf_masses import carried_masses, on_frames
from rpim_opt.robot.urdf_tree import Joint, Urdf, read_tree


def read_urdf(path: str | Path, base: str | None = None, tip: str | None = None) -> Described:
    """Return a serial chain of a URDF file as a robot in modified DH with Hayati's beta.

    ``base @ MDH chain(q) @ tool`` is the transform from link ``base`` to link ``tip``, with q the file's joint values;
    `chain.describe` states the conventions. Fixed joints are part of base, links and tool; limits are carried over
    (continuous joints, and limits that are left out or equal, have none). Angles are roll, pitch, yaw, R = Rz Ry Rx,
    and an axis that is left out is x (wiki.ros.org/urdf/XML/joint). Gravity points along -z of link ``base``, wherever
    the first axis points, and pulls at the masses that the file states.

    Parameters
    ----------
    path
        A URDF file, or a file ``.xacro``, which the package xacro expands by its own defaults (``rpim-opt[xacro]``).
    base, tip
        Names of links; the root, and the only leaf below the base.

    Raises
    ------
    InputError
        Naming the file, the element, what was found and what is accepted: no URDF, document types and entities, links
        or joints that are missing, twice or in a cycle, values that are no finite numbers, floating and planar joints
        or mimic joints between base and tip, no or several candidates for base or tip.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> arm = ro.read_urdf("arm.urdf", base="base", tip="tip")
    >>> arm.robot.dof, arm.names, arm.tool[:3]
    (1, ('j1',), array([0.4, 0. , 0. ]))
    """
    urdf = read_tree(Path(path))
    every, joints, chain = _chain(urdf, base, tip)
    table, T_base, T_tool, G = describe(chain)
    masses, centres = carried_masses(urdf, every)
    robot = Robot(
        name=urdf.name,
        mdh=table,
        joint_types=tuple(joint.kind for joint in joints),
        limits=np.array([joint.limits for joint in joints]),
        source=f"{urdf.path.name}, {every[0].parent} to {every[-1].child}",
        gravity=Gravity(masses=masses, centres=on_frames(centres, table, G)).mounted("floor", T_base[:3, :3]),
    )
    return Described(robot, frame_numbers(T_base), frame_numbers(T_tool), tuple(joint.name for joint in joints))


def write_urdf(
    source: str | Path,
    robot: Robot,
    target: str | Path,
    base: str | None = None,
    tip: str | None = None,
    base_frame: Array | None = None,
    tool_frame: Array | None = None,
) -> None:
    """Write a URDF file with the origins that an identified robot has, every other byte as in the original.

    An origin that does not change stays as it is written. Numbers are written so that they read back exactly.

    Parameters
    ----------
    source
        The original, or a file ``.xacro``: then what it expands to is. Its `read_urdf` with the same base and tip has
        to be the robot whose parameters were identified.
    robot
        The robot with identified parameters, `Calibration.robot` or `use.identified`, which refuses what
        a URDF cannot express.
    target
        Where to write; may be ``source``, unless that is a xacro file.
    base, tip
        Names of links, as for `read_urdf`.
    base_frame, tool_frame
        (6,) identified base and tool, x, y, z [m], roll, pitch, yaw [rad]; those of the original where not given.

    Raises
    ------
    InputError
        As `read_urdf`, and for another robot, couplings, or a tool or last beta for which the chain has no fixed
        joint after its last moving one.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import rpim_opt as ro
    >>> robot = ro.read_urdf("arm.urdf").robot
    >>> longer = replace(robot, mdh=robot.mdh + [0, 0, 0, 0.001, 0])  # as if identified: d1 is 1 mm longer
    >>> ro.robot.write_urdf("arm.urdf", longer, "identified.urdf")
    >>> robot.mdh[:, 3], ro.read_urdf("identified.urdf").robot.mdh[:, 3]  # [m]
    (array([0.3]), array([0.301]))
    """
    if Path(target).suffix.lower() == XACRO:
        raise InputError("the target", "a xacro file", "a file .urdf, for what it expands to", target)
    urdf = read_tree(Path(source))
    every, joints, chain = _chain(urdf, base, tip)
    table, T_base, T_tool, G = describe(chain)
    require_same_arm(robot, table, tuple(joint.kind for joint in joints), urdf.path)
    T_base = T_base if base_frame is None else numeric_frame(base_frame)
    T_tool = T_tool if tool_frame is None else numeric_frame(tool_frame)
    origins, tail = corrected(G, robot.mdh, T_base, T_tool)
    size = reach(robot.mdh, T_base, T_tool)
    edits: dict[tuple[int, int], str] = {}
    before = np.eye(4)
    place = 0
    for joint in every:
        if joint.kind:  # the fixed joints before it stay, this one takes the whole correction
            edits |= joint.origin_edits(urdf.data, np.linalg.inv(before) @ origins[place], size)
            before = np.eye(4)
            place = place + 1
        else:
            before = before @ joint.origin
    if np.abs(tail - chain.tail).max() > 10 * ROUNDING * size:
        if every[-1].kind:
            what = f"a tool or beta{len(joints)} that moves the tip '{every[-1].child}'"
            accepted = f"a tip that a fixed joint holds, as joint '{joints[-1].name}' cannot express it, or no tool"
            raise InputError("robot", what, accepted, urdf.path)
        rest = np.linalg.inv(before @ np.linalg.inv(every[-1].origin))
        edits |= every[-1].origin_edits(urdf.data, rest @ tail, size)
    write_bytes(Path(target), spliced(urdf.data, edits))


def _chain(urdf: Urdf, base: str | None, tip: str | None) -> tuple[list[Joint], list[Joint], Chain]:
    """Return all joints between two links, those of them that move, and their geometry."""
    every = urdf.path_between(base, tip)
    joints: list[Joint] = []
    origins: list[Array] = []
    T = np.eye(4)
    for joint in every:
        T = T @ joint.origin
        if joint.kind:
            mimic = [e.attributes.get("joint", "") for e in joint.element.children if e.tag == "mimic"]
            if mimic:
                raise joint.error("mimic", f"motion that follows joint '{mimic[0]}'", "joints that move on their own")
            joints.append(joint)
            origins.append(T)
            T = np.eye(4)
    if not joints:
        raise InputError("the chain", "no joint that moves", "a revolute, continuous or prismatic joint", urdf.path)
    return every, joints, Chain(np.array(origins), np.array([joint.axis for joint in joints]), T)
