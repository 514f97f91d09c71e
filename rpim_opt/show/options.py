"""What options of the command line mean, and what they may not be."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import LARGEST

if TYPE_CHECKING:
    from rpim_opt.data.requirement import Requirement
    from rpim_opt.data.understanding import Asked

Writer = tuple[Path, Callable[[Path], Any]]
"""A file, and what is to be done with it."""


def require_positive(where: str, value: float | None) -> None:
    """Refuse a limit that nothing can keep."""
    if value is not None and not value > 0:
        raise InputError(where, f"{value:g}", "a number greater than zero [mm]")


def corrected_files(writers: Sequence[tuple[Path | None, Callable[[Path], Any]]], out: Path | None) -> list[Writer]:
    """Return the corrected files that are asked for: where they go, and what writes them."""
    asked = [(source, write) for source, write in writers if source]
    if not asked:
        return []
    targets = _targets([source for source, _ in asked], out)
    return [(target, write) for target, (_, write) in zip(targets, asked, strict=True)]


def _targets(sources: Sequence[Path], out: Path | None) -> list[Path]:
    """Return where every corrected file goes: ``--out``, or a file of the same name in that folder."""
    if out is None:
        raise InputError("--out", "nothing", f"where to write the corrected {sources[0].name}")
    targets = [out]
    if len(sources) > 1 or out.is_dir():
        targets = [out / source.name for source in sources]
    for source, target in zip(sources, targets, strict=True):
        if target.resolve() == source.resolve():
            raise InputError("--out", f"the original, {source}", "another place: the original stays")
    return targets


def tool_frame(text: str | None) -> list[float] | None:
    """Return a tool [m, rad] from six numbers in mm and degrees."""
    if text is None:
        return None
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 6 or not all(abs(value) < LARGEST for value in values):
        raise InputError("--tool", f"'{text}'", "six numbers: x,y,z [mm], roll,pitch,yaw [deg]")
    return [*(1e-3 * v for v in values[:3]), *(radians(v) for v in values[3:])]


def carried(text: str | None) -> tuple[float | None, list[float] | None]:
    """Return a payload [kg] and, of four numbers, its centre [m]."""
    if text is None:
        return None, None
    try:
        mass, *centre = (float(part) for part in text.split(","))
    except ValueError:
        mass, centre = -1.0, []
    if mass < 0 or len(centre) not in (0, 3):
        raise InputError("--payload", f"'{text}'", "a mass [kg], or mass and centre: kg,x,y,z [mm]")
    return mass, [1e-3 * v for v in centre] or None


def required(limit: float | None, box: str | None, stated: Requirement | None) -> Requirement | None:
    """Return what a robot is accepted by: options before what is stated, None where neither says anything.

    Parameters
    ----------
    limit
        Of the position that is reached [mm].
    box
        ``x0,x1,y0,y1,z0,z1`` [mm] in the robot's base frame.
    stated
        What the problem or the result states.
    """
    from rpim_opt.data.requirement import Requirement

    require_positive("--limit", limit)
    if limit is None and stated is None:
        if box is not None:
            raise InputError("--box", "no limit", "--limit with it [mm]")
        return None
    sides = None
    if box is not None:
        sides = _box(box)
    if stated is None:
        return Requirement(1e-3 * (limit or 0.0), sides)
    if limit is not None:
        stated = replace(stated, limit=1e-3 * limit)
    return replace(stated, box=sides or stated.box)


def _box(text: str) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float]]:
    try:
        numbers = [1e-3 * float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 6 or not all(abs(number) < LARGEST for number in numbers):
        raise InputError("--box", f"'{text}'", "six numbers: x0,x1,y0,y1,z0,z1 [mm]")
    return (numbers[0], numbers[1]), (numbers[2], numbers[3]), (numbers[4], numbers[5])


def asked_of(
    units: str,
    *,
    columns: str,
    key: str,
    quaternion: str,
    rotation: str,
    within: float | None = None,
    **layout: str,
) -> Asked:
    """Return what the options of a command state of its raw tables."""
    from rpim_opt.basics.layouts import Layout
    from rpim_opt.data.spelling import parse_units
    from rpim_opt.data.understanding import Asked

    names = tuple(name.strip() for name in columns.split(",")) if columns else ()
    return Asked(Layout(columns=names, **layout), parse_units(units), quaternion, rotation, key, within)


def listed_words(text: str) -> list[str]:
    """Return the words of a list with commas, ``tikhonov,robust``."""
    return [word.strip() for word in text.split(",") if word.strip()]


def listed_numbers(text: str) -> list[str | int | float]:
    """Return the words of a list with commas, of which those that are numbers are numbers."""
    return [_number_or_word(word) for word in listed_words(text)]


def _number_or_word(word: str) -> str | int | float:
    for kind in (int, float):
        try:
            return kind(word)
        except ValueError:
            continue
    return word
