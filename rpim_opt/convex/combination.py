"""A statement in words, ``a2 + a3 = 612.3 +- 0.05 mm``: read term by term, and never evaluated."""

from __future__ import annotations

import re
from dataclasses import dataclass

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import LARGEST, SMALLEST, UNITS

ACCEPTED = "'a2 + a3 = 612.3 +- 0.05 mm', 'a2 - 0.5 a3 = nominal +- 0.05 mm', or 'd5 +- 0.1 mm'"
NUMBER = r"(?:\d++\.?+\d*+|\.\d++)(?:[eE][+-]?+\d++)?+"
"""Gives nothing back, as what follows could not begin with it: the time is that of reading it once."""
_TERM = re.compile(rf"\s*+([+-]?+)\s*+(?:({NUMBER})\s*+\*?+\s*+)?+([A-Za-z_][\w.]*+)\s*+")
_QUANTITY = re.compile(rf"\s*+([+-]?+\s*+{NUMBER})\s*+([A-Za-z]\w*+)?+\s*+")
_NOMINAL = re.compile(r"\s*+nominal\b(.*)")
LONGEST = 20_000
"""Characters of a statement: some thousand parameters."""
LINEAR = ("length", "angle", "ratio", "compliance")
"""Dimensions that parameters have."""


@dataclass(frozen=True)
class Combination:
    """A linear combination of parameters, and how well it is known.

    Parameters
    ----------
    names, factors
        Its terms.
    value
        What the combination of the parameters' values is [SI]; None where ``deviation`` says it.
    deviation
        By how much it differs from nominal [SI].
    sd
        Its standard deviation [SI]; None where the text says none.
    dimension
        Of the unit that it was written in; empty where there was none.
    """

    names: tuple[str, ...]
    factors: tuple[float, ...]
    value: float | None = None
    deviation: float = 0.0
    sd: float | None = None
    dimension: str = ""


def combination(text: str) -> Combination:
    """Return what a statement says.

    Raises
    ------
    InputError
        For what is no sum of parameters with numbers before them, for numbers without a unit, and for a standard
        deviation that is not above zero.

    Examples
    --------
    >>> from rpim_opt.convex.combination import combination
    >>> known = combination("a2 - 0.5 a3 = nominal + 0.2 +- 0.05 mm")
    >>> known.names, known.factors, known.deviation, known.sd
    (('a2', 'a3'), (1.0, -0.5), 0.0002, 5e-05)
    """
    if not isinstance(text, str):
        raise InputError("prior", repr(text)[:60], f"a statement like {ACCEPTED}")
    require_length(text)
    left, known, spread = text.replace("±", "+-").partition("+-")
    terms, equals, right = left.partition("=")
    names, factors = _terms(terms, text)
    if not known:
        if equals:
            raise _wrong(text, "no standard deviation")
        return Combination(names, factors)
    value, deviation, sd, dimension = _figures(right, bool(equals), spread, text)
    return Combination(names, factors, value, deviation, sd, dimension)


def require_length(text: str) -> None:
    """Refuse a statement so long that its terms would be compared for ever."""
    if len(text) > LONGEST:
        raise InputError(f"statement '{text[:60]}...'", f"{len(text)} characters", f"at most {LONGEST}")


def _wrong(text: str, found: str, accepted: str = f"a statement like {ACCEPTED}") -> InputError:
    return InputError(f"prior '{text.strip()}'", found, accepted)


def _terms(terms: str, text: str) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Return names and factors of a sum."""
    names: list[str] = []
    factors: list[float] = []
    place = 0
    while place < len(terms) or not names:
        found = _TERM.match(terms, place)
        if found is None or (names and not found[1]):
            raise _wrong(text, f"'{terms[place:].strip()}'")
        sign, factor, name = found.groups()
        if name in names:
            raise _wrong(text, f"'{name}' twice", "every parameter once")
        number = _number(f"{sign}{factor or 1}", text)
        if number == 0:
            raise _wrong(text, f"'{factor} {name}'", "factors other than zero")
        names.append(name)
        factors.append(number)
        place = found.end()
    return tuple(names), tuple(factors)


def _figures(right: str, equals: bool, spread: str, text: str) -> tuple[float | None, float, float, str]:
    """Return value (or None), deviation and standard deviation [SI], and their dimension."""
    sd, unit = _quantity(spread, text)
    if not unit:
        raise _wrong(text, "no unit", f"one of {', '.join(units())} at the end")
    if not sd * UNITS[unit].si >= SMALLEST:
        raise _wrong(text, f"a standard deviation of {sd:g} {unit}", "one above zero; [constraints] fixes parameters")
    dimension = UNITS[unit].dimension
    value: float | None = None
    deviation = 0.0
    relative = _NOMINAL.fullmatch(right)
    if relative is not None and relative[1].strip():
        deviation = _in_si(relative[1], unit, text)
    elif relative is None and equals:
        value = _in_si(right, unit, text)
    return value, deviation, sd * UNITS[unit].si, dimension


def _in_si(figure: str, unit: str, text: str) -> float:
    """Return a figure [SI], which may have a unit of its own, of the same dimension."""
    value, own = _quantity(figure, text)
    own = own or unit
    if UNITS[own].dimension != UNITS[unit].dimension:
        raise _wrong(text, f"units {own} and {unit}", "units of one dimension")
    return value * UNITS[own].si


def _quantity(figure: str, text: str) -> tuple[float, str]:
    """Return a number and its unit, empty where there is none."""
    found = _QUANTITY.fullmatch(figure)
    if found is None:
        raise _wrong(text, f"'{figure.strip()}'", f"a number with a unit; as in {ACCEPTED}")
    unit = found[2] or ""
    if unit and unit not in units():
        raise _wrong(text, f"unit '{unit}'", choices(unit, units()))
    return _number("".join(found[1].split()), text), unit


def _number(digits: str, text: str) -> float:
    value = float(digits)
    if not abs(value) <= LARGEST:
        raise _wrong(text, digits, f"numbers of at most {LARGEST:g}")
    return value


def units() -> list[str]:
    """Return the units that parameters have."""
    return [name for name, unit in UNITS.items() if unit.dimension in LINEAR]
