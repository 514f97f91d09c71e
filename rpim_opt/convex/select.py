"""Selection of the weight from the identification data alone, with evidence: ``ro.select``."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError, NoSolutionFound, pick
from rpim_opt.convex.program import Program
from rpim_opt.convex.rules.curve import corner, l_curve
from rpim_opt.convex.rules.folds import RULES as HOLDING_OUT
from rpim_opt.convex.rules.folds import k_fold, leave_one_out, two_step
from rpim_opt.convex.rules.scores import discrepancy, gcv, quasi_optimality, reml
from rpim_opt.convex.rules.selection import Selection

__all__ = [
    "Selection",
    "compare",
    "corner",
    "discrepancy",
    "gcv",
    "k_fold",
    "l_curve",
    "leave_one_out",
    "quasi_optimality",
    "reml",
    "two_step",
]


def compare(program: Program) -> dict[str, Selection]:
    """Return the choice of every selector that applies to a program, by name.

    Cross-validation rules are omitted where they would take long: without a closed form, or with more than 200
    configurations.

    >>> import rpim_opt as ro
    >>> program = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=1.0).program
    >>> chosen = ro.select.compare(program)
    >>> for name in ("reml", "l_curve", "gcv"):
    ...     print(f"{name:8} {chosen[name].weight:.2g}")
    reml     1.5
    l_curve  7.3
    gcv      1
    """
    quick = program.closed_form and len(np.unique(program.model.group)) <= 200
    chosen = {}
    for name, rule in SELECTORS.items():
        if not quick and rule in HOLDING_OUT:
            continue
        with contextlib.suppress(InputError, NoSolutionFound):  # not applicable to this formulation or these data
            chosen[name] = rule(program)
    return chosen


_names = [each.name for each in iter_modules([str(Path(__file__).with_name("rules"))])]
_rules = [getattr(import_module(f"{__package__}.rules.{name}"), "RULES", ()) for name in reversed(_names)]  # REML first
SELECTORS: dict[str, Callable[[Program], Selection]] = {rule.__name__: rule for some in _rules for rule in some}
"""The rules of the package by the names of their functions: ``RULES`` of the modules in ``rules``."""
LEARNED = "learned"
"""Stated in place of a weight: hyperparameters are estimated from the data."""


def weight_of(stated: Any) -> Any:
    """Return a weight, or a selector by its name; None for "learned".

    InputError for an unknown name.
    """
    if not isinstance(stated, str):
        return stated
    return None if stated == LEARNED else pick(SELECTORS, stated, "weight", also=f"a number, a selector, {LEARNED}, ")
