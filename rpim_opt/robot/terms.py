"""What moves an arm besides its joint values: terms, functions of what they see and of parameters with names."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, NamedTuple

import casadi as ca

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import DISPLAY, SMALLEST, UNITS, number, split_unit
from rpim_opt.robot.posture import Joint, Symbol

Place = Literal["joint", "link", "base", "tool"]
_STEM = re.compile(r"(?!base_|tool_)[A-Za-z](\w*[A-Za-z_])?(\{\}\w+)?")
_FRAME = re.compile(r"\w*_r[xyz]")
SIZES: dict[Place, int] = {"joint": 1, "link": 6, "base": 6, "tool": 6}
"""How many numbers a term returns."""
ENDS = ("base", "tool")
"""Places that an arm has once: parameters there have no number."""


class Entry(NamedTuple):
    """A parameter of a term: its name without a joint's number, its dimension, its expected size and nominal [SI]."""

    stem: str
    dimension: str
    scale: float
    nominal: float


@dataclass(frozen=True, eq=False)
class Term:
    """A way in which an arm moves besides its joint values.

    Parameters
    ----------
    moves
        ``moves(joint, *parameters)`` in CasADi, from what it sees (`Joint`) and the parameters in the order of
        ``scales``. Of a joint: by how much it moves further [rad or m]. Of a link, of the base or of the tool: six
        numbers x, y, z [m], rx, ry, rz [rad], by which the frame behind the link, the robot's or the flange's, is
        displaced along and about its own axes. Small terms of a link add up.
    scales
        The parameters by name, with their unit and expected size: ``{"play_mrad": 0.1}``. Every joint or link has its
        own, ``play2``; ``{}`` in a name stands for the number.
    at
        ``"joint"``, ``"link"``, ``"base"`` or ``"tool"``.
    joints
        Numbers (from 1) or types (``"revolute"``, ``"prismatic"``) of the joints or links that have it; by default the
        revolute joints, and all links.
    columns
        Further columns of the data that it sees, name to dimension: ``{"temperature": "temperature"}`` stands for a
        column ``temperature_K``, ``{"hours": ""}`` for one without unit.
    nominal
        Values of the parameters on the drawing, keys as in ``scales``; zero by default.

    A term whose parameters are all zero must not move anything; it is not asked then.

    Raises
    ------
    InputError
        For names, units, scales, places and dimensions that cannot be.

    Examples
    --------
    >>> import casadi as ca
    >>> import rpim_opt as ro
    >>> third = ro.robot.Term(lambda joint, size: size * ca.cos(3 * joint.q), {"third_mrad": 0.1})
    >>> third.names(2), third.entries[0].dimension, third.entries[0].scale  # [rad]
    (('third2',), 'angle', 0.0001)
    >>> float(third.moves(ro.robot.Joint(2, ro.robot.Posture(q=[0.0, ca.pi / 3])), 2e-4))
    -0.0002
    >>> warm = ro.robot.Term(
    ...     lambda link, rate: [0, 0, rate * link.column("temperature"), 0, 0, 0],
    ...     {"warm_um_per_K": 10},
    ...     at="link",
    ...     joints=(2, 3),
    ...     columns={"temperature": "temperature"},
    ... )
    >>> warm.places(("revolute",) * 6), warm.names(3)
    ((2, 3), ('warm3',))
    """

    moves: Callable[..., Symbol]
    scales: Mapping[str, float]
    at: Place = "joint"
    joints: Sequence[str | int] = ()
    columns: Mapping[str, str] = field(default_factory=dict)
    nominal: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.at not in SIZES:
            raise InputError("term, at", repr(self.at), ", ".join(map(repr, SIZES)))
        require_columns(self.columns, "term")
        for entry in self.entries:
            _require_name(entry, self.at)
        if len({entry.stem for entry in self.entries}) < len(self.entries):
            raise InputError("term, scales", "one name in two units", "one of them")

    @cached_property
    def entries(self) -> tuple[Entry, ...]:
        """The parameters, in the order in which ``moves`` takes them."""
        nominal = {key: _quantity(key, value, "nominal")[2] for key, value in self.nominal.items()}
        unknown = nominal.keys() - self.scales.keys()
        if unknown:
            raise InputError("term, nominal", f"'{min(unknown)}'", "a key of its scales")
        found = [(key, *_quantity(key, value, "scales")) for key, value in self.scales.items()]
        return tuple(Entry(stem, dimension, scale, nominal.get(key, 0.0)) for key, stem, dimension, scale in found)

    @property
    def name(self) -> str:
        """The parameters' names without the joint's number.

        >>> import rpim_opt as ro
        >>> ro.robot.Term(lambda joint, a, b: a + b * joint.q, {"zero_mrad": 0.1, "slope_ppm": 10}).name
        'zero, slope'
        """
        return ", ".join(entry.stem.partition("{}")[0] for entry in self.entries) or "without parameters"

    def names(self, i: int) -> tuple[str, ...]:
        """Return the names of joint or link i's parameters; of the base's and the tool's, which have no number."""
        if self.at in ENDS:
            return tuple(entry.stem for entry in self.entries)
        return tuple(_numbered(entry.stem, i) for entry in self.entries)

    def places(self, joint_types: Sequence[str]) -> tuple[int, ...]:
        """Return the numbers of the joints or links that have it; the first for the base, the last for the tool."""
        if self.at == "base":
            return (1,)
        if self.at == "tool":
            return (len(joint_types),)
        wanted = tuple(self.joints)
        if not wanted:
            wanted = ("revolute",) if self.at == "joint" else ("revolute", "prismatic")
        return tuple(i for i, kind in enumerate(joint_types, start=1) if i in wanted or kind in wanted)


def require_columns(columns: Mapping[str, str], where: str) -> None:
    """Refuse columns of a dimension that is not known."""
    for name, dimension in columns.items():
        if dimension not in ("", *DISPLAY):
            raise InputError(f"{where}, column {name}", repr(dimension), f"'' (no unit), {', '.join(DISPLAY)}")


def _quantity(key: str, value: float, where: str) -> tuple[str, str, float]:
    """Return the name, dimension and value [SI] of a number whose key carries a unit."""
    place = f"term, {where}, key {key}"
    stem, unit = split_unit(key)
    if unit is None or unit.dimension not in DISPLAY:
        units = [name for name, each in UNITS.items() if each.dimension in DISPLAY]
        raise InputError(place, "no unit that fits", f"a name with one of {', '.join(units)}")
    return stem, unit.dimension, number(value, place) * unit.si


def _require_name(entry: Entry, at: Place) -> None:
    """Refuse a parameter's name that would be read as another's, and a scale that is none."""
    where = f"term, scales, parameter '{entry.stem}'"
    if not _STEM.fullmatch(entry.stem) or _FRAME.fullmatch(entry.stem):
        accepted = "letters, digits and _, no digit at the end, nothing like base_, tool_ and _rx, which are frames'"
        raise InputError(where, "a name that is another's", accepted)
    if at in ENDS and "{}" in entry.stem:
        raise InputError(where, "a place for a number", f"none: the {at} has one parameter")
    if not entry.scale >= SMALLEST:
        raise InputError(where, f"a scale of {entry.scale:g}", "a number greater than zero")


def _numbered(stem: str, i: int) -> str:
    if "{}" in stem:
        return stem.format(i)
    return f"{stem}{i}"


def moved(term: Term, joint: Joint, value: Callable[[str], Symbol]) -> ca.SX | None:
    """Return by how much a term moves, (1, 1) or (6, 1); None where its parameters are all zero.

    Raises
    ------
    InputError
        For a function that returns something else.
    """
    sizes = [value(name) for name in term.names(joint.number)]
    # an effect may take a whole chain to write down: not for a parameter that is not there
    if sizes and all(map(is_zero, sizes)):
        return None
    found = term.moves(joint, *sizes)
    if isinstance(found, list | tuple):
        found = ca.vertcat(*found)
    found = ca.SX(found)
    if found.numel() != SIZES[term.at]:
        accepted = f"{SIZES[term.at]}, as a term of a {term.at} returns"
        raise InputError(f"term '{term.name}'", f"{found.numel()} numbers", accepted)
    return ca.vec(found)


def is_zero(value: Symbol) -> bool:
    """Return whether a value is zero whatever the symbols in it."""
    if isinstance(value, ca.SX):
        return bool(value.is_zero())
    return value == 0
