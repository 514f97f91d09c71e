"""A xacro file as the URDF that it stands for, by the package that ROS has for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.inputs import read_bytes

XACRO = ".xacro"


def urdf_text(path: Path) -> bytes:
    """Return the content of a URDF file, or what a xacro file says with its own defaults.

    Expressions are carried out and other files included: problem folders, which may be somebody else's, name no xacro.

    Raises
    ------
    InputError
        Where the package xacro is missing, or the file does not say all by itself.
    """
    content = read_bytes(path)
    if path.suffix.lower() != XACRO:
        return content
    try:
        import xacro
    except ImportError:
        accepted = "URDF, or the package that expands it: pip install 'rpim-opt[xacro]'"
        raise InputError("the robot", "a xacro file", accepted, path) from None
    try:
        document: Any = xacro.process_file(str(path))
    except Exception as error:  # of expressions, XML, missing files and packages: xacro has no type of error for all
        found = " ".join(str(error).split())
        accepted = "a file that expands without arguments, or what the command xacro makes of it with them"
        raise InputError("the robot", found, accepted, path) from None
    return bytes(document.documentElement.toxml("utf-8"))
