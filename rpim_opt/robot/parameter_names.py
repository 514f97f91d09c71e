"""What parameters are called, and what their names say: of a joint or a frame, which group, which reflector."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from rpim_opt.basics.exceptions import choices
from rpim_opt.robot.kinematics import JOINT_EXTRAS
from rpim_opt.robot.mdh import MDH

MDH_DIMENSION = {"alpha": "angle", "a": "length", "theta": "angle", "d": "length", "beta": "angle"}
_ON_THE_ROBOT = re.compile(rf"({'|'.join((*MDH, *JOINT_EXTRAS))})\d+")


def of_joint(name: str) -> bool:
    """Return whether a parameter is the robot's own, and not of a frame."""
    return _ON_THE_ROBOT.fullmatch(name) is not None


def group_of(name: str, dimension: str) -> str:
    """Return the group whose scale a parameter has: ``tool``, ``base``, or its dimension.

    What a measurement adds of its own (an anchor, a plane) is placed like the instrument: ``base``.
    """
    if name.startswith(("tool_", "tool.")):
        return "tool"
    if of_joint(name):
        return dimension
    return "base"


def tool_prefix(marker: str) -> str:
    """Return the prefix of a reflector's parameters: ``tool_``, or ``tool_A_`` for marker A."""
    if not marker:
        return "tool_"
    return f"tool_{marker}_"


def reflectors(names: Iterable[str]) -> list[str]:
    """Return the markers whose reflectors are among the parameters; ``""`` for the only one."""
    return [name[5:-2] for name in names if name.startswith("tool_") and name.endswith("_x")]


def known_patterns(names: Sequence[str], pattern: str) -> str:
    """List the known names, runs of a joint parameter shortened: ``alpha1..6``."""
    runs: dict[str, list[int]] = {}
    others = []
    for name in names:
        match = re.fullmatch(r"([a-z_]*[a-z])(\d+)", name)
        if match:
            runs.setdefault(match[1], []).append(int(match[2]))
        else:
            others.append(name)
    known = [f"{stem}{min(n)}..{max(n)}" for stem, n in runs.items()]
    # of what `choices` says of all the names only the guess: the list itself is shorter in runs
    _, guess, close = choices(pattern, names).partition(" (did")
    return "names or patterns of " + ", ".join(known + others) + guess + close
