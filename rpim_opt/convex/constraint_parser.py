"""Parser of constraints and known values in text, ``d2 + d3 = 850.00 +- 0.05 mm``; nothing is evaluated as code."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import LARGEST, SMALLEST, UNITS

ACCEPTED = {
    "constraint": "'d2 + d3 = 850.00 +- 0.05 mm', '|a2 - a3| <= 0.1 mm', 'alpha2 >= 89.9 deg', "
    "'d5 = nominal +- 0.1 mm' (+- is a limit), 'norm(tool_x - 10 mm, tool_y) <= 0.05 mm', or 'move at most 5 mm: "
    "workspace'",
    "prior": "'a2 + a3 = 612.3 +- 0.05 mm' (+- is one standard deviation), 'a2 - 0.5 a3 = nominal +- 0.05 mm', or "
    "'d5 +- 0.1 mm'",
}
LONGEST = 20_000
"""Largest number of characters of a statement: some thousand parameters."""
DIMENSIONS = ("length", "angle", "ratio", "compliance")
"""Dimensions of parameters."""
Kind = Literal["equal", "most", "within", "norm", "move"]
_NUMBER = r"(?:\d++\.?+\d*+|\.\d++)(?:[eE][+-]?+\d++)?+"  # possessive: matched in linear time
_PARAMETER = re.compile(r"[\w.-]+")
_NAME = r"[A-Za-z_](?:[\w.*?]|\[[^\]]*\])*"
_TOOL = r"(?:\w+\.)?tool(?:(?!_r?[xyz]\b)[\w.*?-])*_r?[xyz]\b"  # a reflector's name may contain a hyphen: tool_SMR-A_x
_SIGN = r"\+-|±|<=|>=|≤|≥|==|[-+*=|(),]"
_TOKEN = re.compile(rf"\s*(?:(?P<number>{_NUMBER})|(?P<name>{_TOOL}|{_NAME})|(?P<sign>{_SIGN}))")
_MOVE = re.compile(r"\s*move\b(?:\s+at\s+most\b)?([^:]*)(?::(.*))?")
_SIGNS = {"±": "+-", "≤": "<=", "≥": ">=", "==": "="}


@dataclass(frozen=True)
class Sum:
    """A sum of factors times parameters' values and a constant [SI].

    ``nominal`` is the factor on the nominal value of the sum, which is added; names may be patterns.
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
    """A constraint in words.

    ``kind`` is ``equal`` (every sum is zero), ``most`` (every sum is at most zero), ``within`` (every sum's absolute
    value is at most the limit), ``norm`` (the norm of all sums is) or ``move`` (every predicted movement at ``places``
    is). ``limit`` is in SI units, ``unit`` as written, empty if no number had one.
    """

    kind: Kind
    sums: tuple[Sum, ...] = ()
    limit: float = 0.0
    unit: str = ""
    places: tuple[str, ...] = ()


def sentence(text: str) -> Sentence:
    """Parse a constraint.

    InputError for unknown words and signs, numbers without a unit, units of different dimensions, and constraints that
    are not convex.

    >>> from rpim_opt.convex.constraint_parser import sentence
    >>> found = sentence("d2 + d3 = 850.00 +- 0.05 mm")
    >>> found.kind, found.limit, found.sums
    ('within', 5e-05, (Sum(names=('d2', 'd3'), factors=(1.0, 1.0), constant=-0.85, nominal=0),))
    """
    moving = _MOVE.fullmatch(text) if isinstance(text, str) and len(text) <= LONGEST else None
    if moving is None:
        return _Reader(text, "constraint").sentence()
    return _Reader(text, "constraint", moving[1]).movement(moving[2] or "")


def combination(text: str) -> Sentence:
    """Parse a known value: a sum that is zero ``within`` its standard deviation, which is the limit.

    InputError for numbers without a unit, and a standard deviation that is not positive.

    >>> from rpim_opt.convex.constraint_parser import combination
    >>> known = combination("a2 - 0.5 a3 = nominal + 0.2 +- 0.05 mm")
    >>> known.limit, known.sums
    (5e-05, (Sum(names=('a2', 'a3'), factors=(1.0, -0.5), constant=-0.0002, nominal=-1),))
    """
    return _Reader(text, "prior").combination()


def units() -> list[str]:
    """Return the units that parameters have."""
    return [name for name, unit in UNITS.items() if unit.dimension in DIMENSIONS]


class _Reader:
    """Tokens of a statement, and where among them it is."""

    def __init__(self, text: str, what: str, part: str | None = None):
        self.text, self.what = str(text), what
        if not isinstance(text, str):
            where = "key stated" if what == "constraint" else what
            raise InputError(where, repr(text)[:60], f"a statement like {ACCEPTED[what]}")
        if len(text) > LONGEST:
            raise InputError(f"statement '{text[:60]}...'", f"{len(text)} characters", f"at most {LONGEST}")
        part = (text if part is None else part).rstrip()
        self._tokens: list[tuple[str, str]] = []
        place = 0
        while place < len(part):
            token = _TOKEN.match(part, place)
            if token is None:
                raise self._wrong(f"'{part[place:].strip()}'")
            kind = str(token.lastgroup)
            self._tokens.append((kind, _SIGNS.get(token[kind], token[kind])))
            place = token.end()
        self._at = 0
        named = [word for kind, word in self._tokens if kind == "name" and word in UNITS]
        for each in named:
            if UNITS[each].dimension not in DIMENSIONS:
                raise self._wrong(f"unit '{each}'", choices(each, units()))
        if len({UNITS[each].dimension for each in named}) > 1:
            raise self._wrong(f"units {' and '.join(named)}", "units of one dimension")
        self.unit = named[-1] if named else ""  # for numbers without their own

    def _wrong(self, found: str, accepted: str = "") -> InputError:
        accepted = accepted or f"a statement like {ACCEPTED[self.what]}"
        return InputError(f"{self.what} '{self.text.strip()}'", found, accepted)

    def _next(self, *words: str) -> str:
        """Return the next token and pass it, where it is one of these words or kinds; empty otherwise."""
        if self._at < len(self._tokens):
            kind, word = self._tokens[self._at]
            if word in words or (kind in words and not (kind == "name" and word in UNITS)):
                self._at += 1
                return word
        return ""

    def _require_end(self) -> None:
        if self._at < len(self._tokens):
            raise self._wrong(f"'{' '.join(word for _, word in self._tokens[self._at :])}'")

    # --- statements --------------------------------------------------------------------------------------------

    def movement(self, where: str) -> Sentence:
        limit = self._constant(self._sum())
        self._require_end()
        if UNITS[self.unit or "mm"].dimension != "length":
            raise self._wrong(f"a movement in {self.unit}", "a length: 'move at most 5 mm'")
        if not limit > 0:
            raise self._wrong(f"a movement of {limit:g}", "a positive limit; at_nominal fixes parameters")
        places = tuple(place.strip() for place in (where.strip() or "workspace").split(","))
        return Sentence("move", limit=limit, unit=self.unit, places=places)

    def combination(self) -> Sentence:
        words = [word for _, word in self._tokens]
        if "+-" not in words:
            raise self._wrong("no standard deviation")
        known = self.sentence()
        patterns = [name for name in known.sums[0].names if not _PARAMETER.fullmatch(name)]
        if patterns:
            raise self._wrong(f"'{patterns[0]}'", "names of single parameters")
        if known.sums[0].constant and "=" not in words:
            raise self._wrong("a number without =", "a sum of parameters, with its value after =")
        if not known.limit >= SMALLEST:
            found = f"a standard deviation of {known.limit:g} m or rad"
            raise self._wrong(found, "a positive standard deviation; [constraints] fixes parameters")
        return known

    def sentence(self) -> Sentence:
        sides = [self._side()]
        relations: list[str] = []
        while relation := self._next("=", "<=", ">="):
            relations.append(relation)
            sides.append(self._side())
        tolerance = self._constant(self._item(self._next("+", "-"))) if self._next("+-") else None
        self._require_end()
        if not relations and tolerance is not None:  # 'd5 +- 0.1 mm'
            relations, sides = ["="], [*sides, ("", (Sum(nominal=1),))]
        if not relations:
            raise self._wrong("no =, <= or >=")
        if tolerance is not None and relations != ["="]:
            raise self._wrong("a tolerance without =", "'= 850.00 +- 0.05 mm'")
        if relations[0] == ">=":
            sides = sides[::-1]
        if any(opening for opening, _ in sides):
            parsed = self._bounded(sides, relations)
        else:
            parsed = self._chain([each for _, (each,) in sides], relations, tolerance or 0.0)
        for each in parsed.sums:
            self._checked(each)
        return parsed

    def _bounded(self, sides: list[tuple[str, tuple[Sum, ...]]], relations: list[str]) -> Sentence:
        """Return that an absolute value or norm is at most a number."""
        if len(relations) > 1:
            raise self._wrong(" and ".join(relations), "one relation after an absolute value or norm")
        (opening, sums), (other, large) = sides
        if relations[0] == "=" or not opening or other:
            raise self._wrong("a constraint that is not convex", "an absolute value or norm <= a number")
        limit = self._constant(large[0])
        if not limit > 0:
            raise self._wrong(f"a limit of {limit:g}", "a positive limit; '=' for equality")
        return Sentence("within" if opening == "|" and len(sums) == 1 else "norm", sums, limit, self.unit)

    def _chain(self, sides: list[Sum], relations: list[str], tolerance: float) -> Sentence:
        """Return that sums are equal, to a tolerance, or each at most the next."""
        equal = "=" in relations
        if len(set(relations)) > 1 or len(relations) > (1 if equal else 2):
            accepted = "one relation, or a chain like '89.9 deg <= alpha2 <= 90.1 deg'"
            raise self._wrong(" and ".join(relations), accepted)
        pairs = list(pairwise(sides))
        if any(left.nominal and right.nominal for left, right in pairs):
            raise self._wrong("nominal on both sides", "on one of them")
        if tolerance < 0:
            raise self._wrong("a negative tolerance", "a positive tolerance")
        kind: Kind = "most"
        if equal:
            kind = "within" if tolerance else "equal"
        return Sentence(kind, tuple(left.plus(right, -1) for left, right in pairs), tolerance, self.unit)

    def _side(self) -> tuple[str, tuple[Sum, ...]]:
        """Return a sum, or with the sign of what they stand in, sums between bars or in ``norm(...)``."""
        opening = self._next("|", "norm")
        if not opening:
            return "", (self._sum(),)
        if opening == "norm" and not self._next("("):
            raise self._wrong("norm without (", "norm(tool_x - 10 mm, tool_y)")
        sums = [self._sum()]
        while self._next(","):
            sums.append(self._sum())
        end = "|" if opening == "|" else ")"
        if not self._next(end):
            raise self._wrong(f"no closing {end}")
        return opening, tuple(sums)

    # --- sums ------------------------------------------------------------------------------------------------

    def _sum(self) -> Sum:
        total = self._item(self._next("+", "-"))
        while sign := self._next("+", "-"):
            total = total.plus(self._item(sign))
        if total.nominal not in (0, -1 if total.names else 1):
            raise self._wrong(
                "nominal, which has no meaning here", "'d5 = nominal +- 0.1 mm', '|a2 - nominal| <= 0.1 mm'"
            )
        return total

    def _item(self, sign: str) -> Sum:
        factor = -1.0 if sign == "-" else 1.0
        number = self._next("number")
        times = ""
        if number:
            factor *= float(number)
            if not abs(factor) <= LARGEST:
                raise self._wrong(f"{number}", f"numbers of at most {LARGEST:g}")
            times = self._next("*")
            unit = self._next(*UNITS)
            if unit and not times:
                return Sum(constant=factor * UNITS[unit].si)
        name = self._next("name")
        if name == "nominal":
            if number:
                raise self._wrong(f"{number} nominal", "nominal")
            return Sum(nominal=int(factor))
        if name:
            if factor == 0:
                raise self._wrong(f"'{number} {name}'", "factors other than zero")
            return Sum((name,), (factor,))
        if not number or times:
            word = f"'{self._tokens[self._at][1]}'" if self._at < len(self._tokens) else "the end"
            raise self._wrong(f"{word} where a parameter or number is expected")
        if factor == 0:
            return Sum()
        if not self.unit:
            raise self._wrong("no unit", f"one of {', '.join(units())}")
        return Sum(constant=factor * UNITS[self.unit].si)

    def _constant(self, found: Sum) -> float:
        """Return the number [SI] that a sum is."""
        if found.names or found.nominal:
            raise self._wrong("parameters where a number is expected", "a number with a unit: " + ", ".join(units()))
        return found.constant

    def _checked(self, found: Sum) -> None:
        """Refuse a sum without parameters, or with one of them twice."""
        if not found.names:
            raise self._wrong("no parameter", "parameters' names")
        twice = [name for name, times in Counter(found.names).items() if times > 1]
        if twice:
            raise self._wrong(f"'{twice[0]}' twice", "every parameter once")
