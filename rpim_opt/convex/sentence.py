"""A demand in the words of a drawing, ``d2 + d3 = 850.00 +- 0.05 mm``: read token by token, and never evaluated."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import LARGEST, UNITS
from rpim_opt.convex.combination import LINEAR, NUMBER, require_length, units

ACCEPTED = (
    "'d2 + d3 = 850.00 +- 0.05 mm', '|a2 - a3| <= 0.1 mm', 'alpha2 >= 89.9 deg', 'd5 = nominal +- 0.1 mm', "
    "'norm(tool_x - 10 mm, tool_y) <= 0.05 mm', or 'move at most 5 mm: workspace'"
)
Kind = Literal["equal", "most", "within", "norm", "move"]
_NAME = r"[A-Za-z_](?:[\w.*?]|\[[^\]]*\])*"
_TOKEN = re.compile(rf"\s*(?:(?P<number>{NUMBER})|(?P<name>{_NAME})|(?P<sign>\+-|±|<=|>=|≤|≥|==|[-+*=|(),]))")
_MOVE = re.compile(r"\s*move\b(?:\s+at\s+most\b)?([^:]*)(?::(.*))?")
_SIGNS = {"±": "+-", "≤": "<=", "≥": ">=", "==": "="}
_RELATIONS = ("=", "<=", ">=")


@dataclass(frozen=True)
class Sum:
    """A sum of parameters' values, numbers, and of the nominal value of all these parameters together.

    Parameters
    ----------
    names, factors
        Its terms; a name may be a pattern.
    constant
        Of the numbers [SI].
    nominal
        Not zero where the terms count from their nominal values.
    """

    names: tuple[str, ...] = ()
    factors: tuple[float, ...] = ()
    constant: float = 0.0
    nominal: int = 0

    def plus(self, other: Sum, sign: int = 1) -> Sum:
        """Return the sum of both, or with sign -1 their difference."""
        names = (*self.names, *other.names)
        factors = (*self.factors, *(sign * factor for factor in other.factors))
        return Sum(names, factors, self.constant + sign * other.constant, self.nominal + sign * other.nominal)


@dataclass(frozen=True)
class Sentence:
    """What a statement demands.

    Parameters
    ----------
    kind
        ``equal``: every sum is zero; ``most``: none is above zero; ``within``: none is larger than the limit;
        ``norm``: all together are not; ``move``: no predicted movement is larger than the limit.
    sums
        Of which it speaks.
    limit
        [SI]
    unit
        In which it was written; empty where no number had one.
    places
        Where nothing may move farther.
    """

    kind: Kind
    sums: tuple[Sum, ...] = ()
    limit: float = 0.0
    unit: str = ""
    places: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Side:
    """One side of a relation: a sum, or the size of sums, an absolute value (``within``) or a ``norm``."""

    sums: tuple[Sum, ...]
    size: Kind | None = None


def sentence(text: str) -> Sentence:
    """Return what a statement demands.

    Raises
    ------
    InputError
        For other words and signs, numbers without a unit, units of different dimensions, and demands that are not
        convex.

    Examples
    --------
    >>> from rpim_opt.convex.sentence import sentence
    >>> found = sentence("d2 + d3 = 850.00 +- 0.05 mm")
    >>> found.kind, found.limit, found.sums
    ('within', 5e-05, (Sum(names=('d2', 'd3'), factors=(1.0, 1.0), constant=-0.85, nominal=0),))
    >>> sentence("move at most 5 mm: home, workspace").places
    ('home', 'workspace')
    """
    if not isinstance(text, str):
        raise InputError("key stated", repr(text)[:60], f"a statement like {ACCEPTED}")
    require_length(text)
    moving = _MOVE.fullmatch(text)
    if moving is not None:
        return _movement(text, moving[1], moving[2])
    return _Reader(text).sentence()


def _movement(text: str, limit: str, where: str | None) -> Sentence:
    reader = _Reader(text, limit)
    most = reader.constant(reader.sum())
    reader.require_end()
    if UNITS[reader.unit or "mm"].dimension != "length":
        raise reader.wrong(f"a movement in {reader.unit}", "a length: 'move at most 5 mm'")
    if not most > 0:
        raise reader.wrong(f"a movement of {most:g}", "one above zero; at_nominal keeps parameters")
    said = (where or "").strip() or "workspace"
    places = tuple(place.strip() for place in said.split(","))
    return Sentence("move", limit=most, unit=reader.unit, places=places)


class _Reader:
    """Tokens of a statement, and where among them it is."""

    def __init__(self, text: str, part: str | None = None):
        self.text = text
        self._tokens = list(self._split(text if part is None else part))
        self._at = 0
        self.unit = self._unit()

    def wrong(self, found: str, accepted: str = f"a statement like {ACCEPTED}") -> InputError:
        """Return the error."""
        return InputError(f"constraint '{self.text.strip()}'", found, accepted)

    def _split(self, part: str) -> Sequence[tuple[str, str]]:
        place = 0
        end = len(part.rstrip())
        found: list[tuple[str, str]] = []
        while place < end:
            token = _TOKEN.match(part, place)
            if token is None:
                raise self.wrong(f"'{part[place:].strip()}'")
            kind = str(token.lastgroup)
            word = token[kind]
            found.append((kind, _SIGNS.get(word, word)))
            place = token.end()
        return found

    def _unit(self) -> str:
        """Return the unit of numbers that have none of their own: the last one."""
        said = [word for kind, word in self._tokens if kind == "name" and word in UNITS]
        for each in said:
            if UNITS[each].dimension not in LINEAR:
                raise self.wrong(f"unit '{each}'", choices(each, units()))
        if len({UNITS[each].dimension for each in said}) > 1:
            raise self.wrong(f"units {' and '.join(said)}", "units of one dimension")
        return said[-1] if said else ""

    def _next(self, *words: str) -> str:
        """Return the next token and pass it, where it is one of these; empty otherwise."""
        if self._at < len(self._tokens):
            kind, word = self._tokens[self._at]
            if word in words or (kind in words and not (kind == "name" and word in UNITS)):
                self._at += 1
                return word
        return ""

    def require_end(self) -> None:
        """Refuse what is left over."""
        if self._at < len(self._tokens):
            raise self.wrong(f"'{' '.join(word for _, word in self._tokens[self._at :])}'")

    # --- sentences -------------------------------------------------------------------------------------------

    def sentence(self) -> Sentence:
        """Return what the tokens demand."""
        sides = [self._side()]
        relations: list[str] = []
        while relation := self._next(*_RELATIONS):
            relations.append(relation)
            sides.append(self._side())
        tolerance = None
        if self._next("+-"):
            tolerance = self.constant(self.sum())
        self.require_end()
        if not relations:
            if tolerance is None:
                raise self.wrong("no =, <= or >=")
            relations, sides = ["="], [*sides, _Side((Sum(nominal=1),))]  # 'd5 +- 0.1 mm'
        made = self._related(sides, relations, tolerance)
        return replace(made, sums=tuple(self._checked(each) for each in made.sums), unit=self.unit)

    def _related(self, sides: list[_Side], relations: list[str], tolerance: float | None) -> Sentence:
        if tolerance is not None and relations != ["="]:
            raise self.wrong("a tolerance without =", "'= 850.00 +- 0.05 mm'")
        if any(side.size is not None for side in sides):
            return self._sized(sides, relations)
        if relations == ["="]:
            return self._equal(self._difference(sides[0].sums[0], sides[1].sums[0]), tolerance)
        if "=" in relations or len(set(relations)) > 1 or len(relations) > 2:
            raise self.wrong(" and ".join(relations), "one relation, or a chain like '89.9 deg <= alpha2 <= 90.1 deg'")
        if relations[0] == ">=":
            sides = sides[::-1]
        pairs = pairwise(sides)
        return Sentence("most", tuple(self._difference(low.sums[0], high.sums[0]) for low, high in pairs))

    def _equal(self, difference: Sum, tolerance: float | None) -> Sentence:
        if tolerance is None or tolerance == 0:
            return Sentence("equal", (difference,))
        if tolerance < 0:
            raise self.wrong("a tolerance below zero", "one above zero")
        return Sentence("within", (difference,), tolerance)

    def _sized(self, sides: list[_Side], relations: list[str]) -> Sentence:
        """Return the demand that an absolute value or norm is at most a number."""
        if len(relations) > 1:
            raise self.wrong(" and ".join(relations), "one relation after an absolute value or norm")
        if relations[0] == ">=":
            sides = sides[::-1]
        small, large = sides
        if relations[0] == "=" or small.size is None or large.size is not None:
            raise self.wrong("a demand that is not convex", "an absolute value or norm <= a number")
        limit = self.constant(large.sums[0])
        if not limit > 0:
            raise self.wrong(f"a limit of {limit:g}", "one above zero; '=' where nothing may differ")
        return Sentence(small.size, small.sums, limit)

    def _side(self) -> _Side:
        """Return a sum, or sums between bars or in ``norm(...)``."""
        if self._next("|"):
            sums = self._sums("|")
            return _Side(sums, "within" if len(sums) == 1 else "norm")
        if self._next("norm"):
            if not self._next("("):
                raise self.wrong("norm without (", "norm(tool_x - 10 mm, tool_y)")
            return _Side(self._sums(")"), "norm")
        return _Side((self.sum(),))

    def _sums(self, end: str) -> tuple[Sum, ...]:
        found = [self.sum()]
        while self._next(","):
            found.append(self.sum())
        if not self._next(end):
            raise self.wrong(f"no {end} at the end of a size")
        return tuple(found)

    # --- sums ------------------------------------------------------------------------------------------------

    def sum(self) -> Sum:
        """Return the sum that begins here."""
        found = self._item(self._next("+", "-"))
        while sign := self._next("+", "-"):
            found = found.plus(self._item(sign))
        if found.nominal not in (0, -1 if found.names else 1):
            raise self.wrong("nominal where it means nothing", "'d5 = nominal +- 0.1 mm', '|a2 - nominal| <= 0.1 mm'")
        return found

    def _item(self, sign: str) -> Sum:
        factor = -1.0 if sign == "-" else 1.0
        number = self._next("number")
        times = ""
        if number:
            factor *= float(number)
            if not abs(factor) <= LARGEST:
                raise self.wrong(f"{number}", f"numbers of at most {LARGEST:g}")
            times = self._next("*")
            unit = self._next(*UNITS)
            if unit and not times:
                return Sum(constant=factor * UNITS[unit].si)
        name = self._next("name")
        if name == "nominal":
            if number:
                raise self.wrong(f"{number} nominal", "nominal")
            return Sum(nominal=int(factor))
        if name:
            return Sum((name,), (factor,))
        if number and not times:
            return Sum(constant=factor * self._size_of_unit(factor))
        raise self.wrong(self._here())

    def _here(self) -> str:
        if self._at < len(self._tokens):
            return f"'{self._tokens[self._at][1]}' where a parameter or a number should stand"
        return "an end where a parameter or a number should stand"

    def _size_of_unit(self, number: float) -> float:
        if number == 0:
            return 1.0
        if not self.unit:
            raise self.wrong("no unit", f"one of {', '.join(units())}")
        return UNITS[self.unit].si

    def constant(self, found: Sum) -> float:
        """Return the number [SI] that a sum is."""
        if found.names or found.nominal:
            raise self.wrong("parameters where a number should stand", "a number with a unit")
        return found.constant

    def _checked(self, found: Sum) -> Sum:
        """Return a sum in which every parameter stands once, or say what is wrong."""
        if not found.names:
            raise self.wrong("no parameter", "parameters' names")
        twice = [name for name, times in Counter(found.names).items() if times > 1]
        if twice:
            raise self.wrong(f"'{twice[0]}' twice", "every parameter once")
        return found

    def _difference(self, left: Sum, right: Sum) -> Sum:
        if left.nominal and right.nominal:
            raise self.wrong("nominal on both sides", "on one of them")
        return left.plus(right, -1)
