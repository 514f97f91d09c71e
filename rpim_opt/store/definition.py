"""What a formulation is in a file: its functions by the names of ready ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.atoms import LARGEST, NORM1, NORM2, SQUARES, SUM
from rpim_opt.convex.believed import believed
from rpim_opt.convex.constraints import (
    at_nominal,
    by_kind,
    by_link,
    differences,
    equal,
    in_ball,
    parse,
    signed,
    within_tolerance,
)
from rpim_opt.convex.formulation import Formulation, huber, lost
from rpim_opt.convex.structure import Quadratic
from rpim_opt.store.parts import finite
from rpim_opt.store.schema import DefinitionPart, QuadraticPart, Term

READY: dict[str, Callable[..., Any]] = {
    "sum_squares": SQUARES,
    "sum": SUM,
    "max": LARGEST,
    "norm1": NORM1,
    "norm2": NORM2,
    "within_tolerance": within_tolerance,
    "by_link": by_link,
    "by_kind": by_kind,
}
"""Functions of a formulation that a file names; those that the next ones make are named with their arguments."""
MAKERS: dict[str, Callable[..., Any]] = {
    f.__name__: f for f in (huber, at_nominal, signed, equal, in_ball, differences, parse)
}
BELIEVED = "believed"
"""The maker of a prior's penalty, whose first argument is the penalty that it was made of."""


def definition(formulation: Formulation) -> dict[str, Any]:
    """Return the terms of a formulation by the names of ready-made functions; None for those of a script."""
    return {
        "loss": _term(formulation.loss),
        "penalty": _optional(formulation.penalty),
        "constraints": [_term(constraint) for constraint in formulation.constraints],
        "loss_over": formulation.loss_over,
        "penalty_over": _optional(formulation.penalty_over),
        "largest": finite(formulation.largest),
    }


def defined(formulation: Formulation) -> bool:
    """Whether a file can hold a formulation: all its functions are ready-made."""
    parts = definition(formulation)
    return None not in (parts["loss"], parts["penalty"], parts["penalty_over"], *parts["constraints"])


def forms(result: Calibration) -> dict[str, Any] | None:
    """Return the quadratics that the functions of a script are; ready ones say it themselves."""
    if defined(result.formulation):
        return None
    program = result.program
    return {"loss": _quadratic_part(program.loss_form), "penalty": _quadratic_part(program.penalty_form)}


def _quadratic_part(form: Quadratic | None) -> dict[str, Any] | None:
    if form is None:
        return None
    part: dict[str, Any] = {"diagonal": None, "matrix": None, "c": form.c.tolist(), "constant": form.constant}
    part["diagonal" if form.diagonal else "matrix"] = form.L.tolist()
    return part


def quadratic_of(part: QuadraticPart | None) -> Quadratic | None:
    """Return the quadratic that a file holds."""
    if part is None:
        return None
    L = np.array(part.matrix if part.diagonal is None else part.diagonal, dtype=float)
    return Quadratic(L, np.array(part.c), part.constant)


def formulation_of(name: str, part: DefinitionPart) -> Formulation:
    """Return the formulation that a file holds; one that cannot be solved where it names functions of a script."""
    return Formulation(
        name,
        loss=_function(part.loss, name),
        penalty=_function(part.penalty, name),
        constraints=tuple(_function(term, name) for term in part.constraints),
        loss_over=part.loss_over,
        penalty_over=_function(part.penalty_over, name),
        largest=np.inf if part.largest is None else part.largest,
        solvable=None not in (part.loss, part.penalty, part.penalty_over, *part.constraints),
    )


def _optional(function: Callable[..., Any] | None) -> Term:
    return "none" if function is None else _term(function)


def _term(function: Callable[..., Any]) -> Term:
    """Return what names a function of a formulation; None for one of a script."""
    for name, ready in READY.items():
        if ready == function:
            return name
    stated = getattr(function, "stated", None)
    if stated is None or stated[0] != BELIEVED:
        return stated
    maker, penalty, *numbers = stated
    return [maker, _optional(penalty), *numbers]


def _function(term: Term, name: str) -> Any:
    if term is None:
        return lost(name)
    if term == "none":
        return None
    if isinstance(term, str):
        return _known(READY, term)
    maker, *arguments = term
    if maker == BELIEVED:
        penalty, *numbers = arguments
        return believed(_function(penalty, name), *numbers)
    return _known(MAKERS, str(maker))(*arguments)


def _known(functions: dict[str, Callable[..., Any]], key: str) -> Callable[..., Any]:
    if key not in functions:
        raise InputError("key definition", f"'{key}'", choices(key, functions))
    return functions[key]
