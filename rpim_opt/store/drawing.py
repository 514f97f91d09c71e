"""Where a new problem's robot comes from."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.inputs import require_file
from rpim_opt.robot.expanding import XACRO
from rpim_opt.robot.library import ROBOT_FILES, find_robot

NAMED = (*ROBOT_FILES, XACRO)
"""Kinds of files that a command or a script may name; a problem folder, those without code."""


class Source(NamedTuple):
    """Where the robot comes from: its file, what the problem states of it, and in words."""

    file: Path
    stated: str
    drawing: str


def find_source(robot: str) -> Source:
    """Return the source of a robot: a ready one by name, or a file."""
    if not robot.endswith(NAMED):
        return Source(find_robot(robot), robot, "a ready robot")
    file = Path(robot)
    if not file.exists():
        raise InputError("the robot", "no such file", f"a file {', '.join(NAMED)}, or a ready robot", file)
    require_file(file)
    return Source(file, "robot.toml", f"modified DH table, from {file.name}")
