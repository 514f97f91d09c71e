"""Robots by name: files of any format, and ready robots."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.files import inside, require_file
from rpim_opt.robot.chain import RobotSetup
from rpim_opt.robot.formats.tables import READY, SHEETS, read_robot, read_sheet

ROBOT_FILES = (".toml", ".urdf", ".json", ".yaml", ".yml", *SHEETS)


def robots() -> list[str]:
    """Return the names of the ready robots, as for ``robot = "ur5e"`` in a problem file.

    >>> import rpim_opt as ro
    >>> ro.robots()[-3:]
    ['ur3e', 'ur5', 'ur5e']
    """
    return sorted(p.stem for p in READY.glob("*.toml"))


def find_robot(name: str, folder: Path | None = None) -> Path:
    """Return the file of a robot: any, or one in ``folder``, or a ready robot by name."""
    if name.endswith(ROBOT_FILES):
        if folder is not None:
            return inside(folder, name, "key robot", folder / "problem.toml")
        require_file(Path(name), endings=ROBOT_FILES)
        return Path(name)
    ready = robots()
    if name in ready:
        return READY / f"{name}.toml"
    accepted = "a file .toml, .urdf, .json, .yaml (Universal Robots' kinematics), or a DH table .csv, .md, .m, ..."
    file = None if folder is None else folder / "problem.toml"
    if name.endswith(".xacro"):
        accepted = "a URDF, which ROS's command makes of it (xacro arm.urdf.xacro > arm.urdf)"
        raise InputError("key robot", f"'{name}'", accepted, file)
    plain = re.sub(r"[^a-z0-9]", "", (name.split() or [""])[-1].lower())  # UR-10, Universal Robots UR10
    accepted = f"{accepted}, or a ready robot (rpim-opt robots): {choices(plain, ready)}"
    raise InputError("key robot", f"'{name}'", accepted, file)


def read_arm(
    file: Path,
    urdf_base: str | None = None,
    urdf_tip: str | None = None,
    convention: str = "",
    origins: bool = False,
    units: Mapping[str, str] = MappingProxyType({}),
) -> RobotSetup:
    """Return the robot of a file, with base and tool if a URDF or a standard DH table states them.

    ``units`` (as in `TableOptions`) hold where a table states none.
    """
    if file.suffix == ".urdf":
        from rpim_opt.robot.formats.urdf import read_urdf

        return read_urdf(file, urdf_base, urdf_tip, origins)
    if origins:
        raise InputError("chain", f"a robot {file.name}", "a robot in a file .urdf")
    if file.suffix in SHEETS:
        return read_sheet(file, convention, units)
    if file.suffix in (".yaml", ".yml"):
        from rpim_opt.robot.formats.universal_robots import read_ur_kinematics

        return read_ur_kinematics(file)
    if convention:
        accepted = "a table of numbers; other files state their convention"
        raise InputError("--dh", f"'{convention}' of {file.name}", accepted)
    robot = read_robot(file)
    return RobotSetup(robot, names=tuple(robot.joint_names[k] for k in robot.leading if robot.joint_names))
