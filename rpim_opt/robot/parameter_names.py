"""Names of parameters: of a joint or a frame, of which group, of which reflector."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from functools import lru_cache

from rpim_opt.basics.exceptions import choices
from rpim_opt.robot.mdh import MDH
from rpim_opt.robot.terms import JOINT_TERMS

_TABLE = re.compile(rf"({'|'.join(MDH)})\d+")
_OFFSET = re.compile(r"theta\d+")
_TERM = re.compile(rf"({'|'.join(term.name for term in JOINT_TERMS)})(\d+)|(bend)(\d+)_\d+[xyz]")

EXPANSION, REFERENCE = "expansion", "reference_temperature"
"""By how much all lengths of a robot grow with temperature, and the temperature at which they are nominal."""
JOINT_OFFSET = "joint_offset"
"""Stands in tables for every theta."""
KNOWN = 2**14
"""Names whose meaning is cached: those of a hundred robots."""


def own_name(name: str) -> str:
    """Return what the robot itself calls a parameter: ``a2`` for ``left.a2`` of several robots."""
    return name.rpartition(".")[2]


@lru_cache(KNOWN)
def of_joint(name: str) -> bool:
    """Return whether a parameter is a robot's own, and not of a frame."""
    return _TABLE.fullmatch(own_name(name)) is not None or of_term(name) or own_name(name) == EXPANSION


def of_term(name: str) -> bool:
    """Return whether a parameter is one of a joint's terms, and not of the table or of a frame."""
    return _TERM.fullmatch(own_name(name)) is not None


@lru_cache(KNOWN)
def is_joint_offset(name: str) -> bool:
    """Return whether a parameter is the offset of a revolute joint: set at assembly, and not machined."""
    return _OFFSET.fullmatch(own_name(name)) is not None


@lru_cache(KNOWN)
def group_of(name: str, dimension: str) -> str:
    """Return the group whose scale a parameter has: ``tool``, ``session``, ``base``, or its dimension."""
    for frame in ("tool", "session"):
        if own_name(name).startswith(f"{frame}_"):
            return frame
    if of_joint(name):
        return dimension
    return "base"


def session_prefix(session: str) -> str:
    """Return the prefix of a session's parameters: ``session_day_1_`` for "day 1"; letters, digits and _ alone."""
    return f"session_{re.sub(r'[^0-9A-Za-z]+', '_', session)}_"


def of_session(name: str) -> bool:
    """Return whether a parameter is by how much the readings of a session are shifted or turned."""
    return own_name(name).startswith("session_")


def frame_of(name: str) -> str:
    """Return the prefix of the frame that a parameter is of: ``session_day_1_`` of ``session_day_1_rx``."""
    return own_name(name).rpartition("_")[0] + "_"


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
    bends = [name for name in names if of_term(name) and own_name(name).startswith("bend")]
    for name in names:
        match = re.fullmatch(r"(.*[a-z])(\d+)", name)
        if name in bends:
            continue
        if match:
            runs.setdefault(match[1], []).append(int(match[2]))
        else:
            others.append(name)
    known = [f"{stem}{min(n)}..{max(n)}" for stem, n in runs.items()]
    if bends:
        known.append(f"bend* ({len(bends)} first moments, {bends[0]} .. {bends[-1]})")
    # of what `choices` says of all the names only the guess: the list itself is shorter in runs
    _, guess, close = choices(pattern, names).partition(" (did")
    return "names or patterns of " + ", ".join(known + others) + guess + close
