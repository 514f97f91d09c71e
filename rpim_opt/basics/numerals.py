"""Numbers as people write them: decimal commas, thousands, minus signs, and units behind them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from rpim_opt.basics.exceptions import InputError

NUMERAL = re.compile(r"[+-]?(?:\d[\d.,]*|[.,]\d+)(?:[eE][+-]?\d+)?")
GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}(?:[.,]\d{3})+")
"""What may be a whole number with its thousands apart, or one with three decimals."""
MEASURED = re.compile(r"([+-]?[\d.,]+(?:[eE][+-]?\d+)?)\s*([^\d\s.,+-]\S*)")
"""A number with its unit in the cell."""
MISSING = frozenset({"", "-", "--", "n/a", "na", "nan", "none", "null", "#n/a"})
"""How tables say that there is no value."""


def is_missing(cell: str) -> bool:
    """Return whether a cell says that it has no value."""
    return cell.strip().lower() in MISSING


def is_numeral(cell: str) -> bool:
    """Return whether a cell is a number, with whatever decimal mark.

    >>> from rpim_opt.basics.numerals import is_numeral
    >>> [is_numeral(cell) for cell in ("1.5", "-1,5", "1.234,5", "2e-3", "P1", "nan")]
    [True, True, True, True, False, False]
    """
    return NUMERAL.fullmatch(cell) is not None


def decimal_mark(columns: Iterable[Sequence[str]], stated: str = "") -> str:
    """Return the decimal mark of a table, a comma or a point.

    Where both stand in a number, the last one is the decimal mark. Where commas alone do, one that cannot part
    thousands decides. A stated mark holds unless a number contradicts it.

    Raises
    ------
    InputError
        For columns that differ, and where every comma could part thousands as well.

    Examples
    --------
    >>> from rpim_opt.basics.numerals import decimal_mark
    >>> decimal_mark([["1,5", "2,25"], ["3", "4"]]), decimal_mark([["1,234.5"]]), decimal_mark([["1.234,5"]])
    (',', '.', ',')
    """
    found: dict[str, str] = {}
    doubtful = ""
    for cells in columns:
        for cell in cells:
            mark = _mark(cell)
            if mark == "?":
                doubtful = doubtful or cell
            elif mark and GROUPED.fullmatch(found.get(mark, "1.000")):
                found[mark] = cell
    if stated:
        other = "." if stated == "," else ","
        cell = found.get(other, "")
        if cell and not GROUPED.fullmatch(cell):
            raise InputError("--decimal", f"'{stated}', and a number '{cell}'", "the mark that the numbers have")
        return stated
    if len(found) > 1:
        raise InputError("the numbers", f"'{found[',']}' and '{found['.']}'", "one decimal mark, or --decimal with it")
    if not found and doubtful:
        raise InputError("the numbers", f"'{doubtful}', of thousands or of decimals", "--decimal , or --decimal .")
    return next(iter(found), ".")


def _mark(cell: str) -> str:
    """Return the decimal mark that a cell shows, a question mark where it may part thousands, or nothing."""
    last = max(cell.rfind(","), cell.rfind("."))
    if last < 0 or not is_numeral(cell):
        return ""
    mark = cell[last]
    other = "," if mark == "." else "."
    if other in cell:
        return mark
    if cell.count(mark) > 1:  # 1.234.567
        return other
    if mark == "," and GROUPED.fullmatch(cell):
        return "?"
    return mark


def plain(cell: str, mark: str) -> str:
    """Return a numeral as Python writes it; other texts stay.

    >>> from rpim_opt.basics.numerals import plain
    >>> plain("-1.234,5", ","), plain("1,234.5", "."), plain("P1,5", ",")
    ('-1234.5', '1234.5', 'P1,5')
    """
    if not is_numeral(cell):
        return cell
    other = "," if mark == "." else "."
    return cell.replace(other, "").replace(mark, ".")


def with_units(cells: Sequence[str]) -> tuple[list[str], str] | None:
    """Return numbers without the unit that stands behind each of them, and the unit; None where it is not so.

    >>> from rpim_opt.basics.numerals import with_units
    >>> with_units(["1.5 mm", "2 mm"])
    (['1.5', '2'], 'mm')
    """
    matches = [MEASURED.fullmatch(cell) for cell in cells if not is_missing(cell)]
    units = {match[2] if match else "" for match in matches}
    if len(units) != 1 or "" in units:
        return None
    unit = units.pop()
    return [cell.removesuffix(unit).strip() for cell in cells], unit
