"""What people name instead of handing over: a ready formulation, a rule for the weight."""

from __future__ import annotations

from typing import Any

from rpim_opt.basics.exceptions import pick
from rpim_opt.convex.formulation import formulation_of
from rpim_opt.convex.select import SELECTORS, Selector

__all__ = ["LEARNED", "formulation_of", "selector_of", "weight_of"]
LEARNED = "learned"
"""What stands for sizes that are learned from the data, and no weight."""


def weight_of(stated: Any) -> Any:
    """Return a weight, a selector, weights of groups, or what a name stands for; None for sizes that are learned.

    Raises
    ------
    InputError
        For a name that no selector has.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> from rpim_opt.convex.named import weight_of
    >>> weight_of("reml") is ro.reml, weight_of("learned"), weight_of(3.0)
    (True, None, 3.0)
    """
    if not isinstance(stated, str):
        return stated
    if stated == LEARNED:
        return None
    return selector_of(stated, also=f"a number, a selector, {LEARNED}, ")


def selector_of(stated: Selector | str, also: str = "a selector, ") -> Selector:
    """Return a selector, or the ready one of that name; ``also`` is what else a reader could say."""
    if isinstance(stated, str):
        return pick(SELECTORS, stated, "weight", also=also)
    return stated
