"""Whether what a file states is what follows from it: the same structure, and numbers to their rounding."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from rpim_opt.basics.exceptions import InputError

RELATIVE = 1e-4
"""Standard deviations of hardly seen directions differ by that much from one processor to another."""
ABSOLUTE = 1e-6
"""A nanometre in mm."""


def agreement(stated: Any, found: Any, where: str) -> None:
    """Refuse a stated figure that is not the found one; keys of the file beyond those found are no matter of this.

    Raises
    ------
    InputError
        Naming the key.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> from rpim_opt.store.agreement import agreement
    >>> agreement({"weight": 1.0, "note": "mine"}, {"weight": 1.0 + 1e-12}, "key")
    >>> try:
    ...     agreement({"rows": [{"mm": 0.1}]}, {"rows": [{"mm": 0.2}]}, "key")
    ... except ro.InputError as error:
    ...     print(error)
    key rows 1.mm: found 0.1, accepted: 0.2, which follows from the file's data.
    """
    if isinstance(found, Mapping):
        for key, value in found.items():
            agreement(_entry(stated, key, where), value, _within(where, key))
    elif isinstance(found, list):
        if not isinstance(stated, list) or len(stated) != len(found):
            raise _refused(stated, found, where)
        for number, (one, other) in enumerate(zip(stated, found, strict=True), start=1):
            agreement(one, other, f"{where} {number}")
    elif not _same(stated, found):
        raise _refused(stated, found, where)


def _within(where: str, key: str) -> str:
    if where == "key":
        return f"key {key}"
    return f"{where}.{key}"


def _entry(stated: Any, key: str, where: str) -> Any:
    if not isinstance(stated, Mapping) or key not in stated:
        raise InputError(_within(where, key), "nothing", "this key, as it was written")
    return stated[key]


def _same(stated: Any, found: Any) -> bool:
    if isinstance(found, float) and isinstance(stated, int | float) and not isinstance(stated, bool):
        try:
            return math.isclose(stated, found, rel_tol=RELATIVE, abs_tol=ABSOLUTE)
        except OverflowError:  # an integer beyond all doubles
            return False
    return type(stated) is type(found) and stated == found


def _refused(stated: Any, found: Any, where: str) -> InputError:
    return InputError(where, _short(stated), f"{_short(found)}, which follows from the file's data")


def _short(value: Any) -> str:
    if isinstance(value, list):
        return f"{len(value)} entries"
    return repr(value)[:60]
