"""What a comparison compares: formulations with their weights, the baselines, and anybody's functions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, pick
from rpim_opt.basics.units import number
from rpim_opt.calibration import baselines
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.formulation import FORMULATIONS, Formulation, formulation_of
from rpim_opt.convex.named import LEARNED, weight_of
from rpim_opt.convex.select import SELECTORS
from rpim_opt.convex.selection import require_weight
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.frames import fitted_frames
from rpim_opt.store.instances import Instance
from rpim_opt.study.splits import FOLDER

NONE = "none"
"""The selector of what has no weight."""
Predictor = Callable[[Array], Array]
"""From joint values (N, dof) to predicted positions (N, 3) [m]."""


BASELINES: dict[str, Callable[[CalibrationProblem], Any]] = {
    "nominal": fitted_frames,
    **{name: getattr(baselines, name) for name in baselines.__all__},
}
"""Methods without convex programming; ``nominal`` fits base and tools alone."""


@dataclass(frozen=True, eq=False)
class Answer:
    """What a method says of a problem: deviations (n,), perhaps of a problem of its own; how it predicts positions."""

    x: Array | None = None
    result: Calibration | None = None
    predict: Predictor | None = None
    problem: CalibrationProblem | None = None


@dataclass(frozen=True, eq=False)
class Calibrating:
    """A formulation with a weight or a selector; None where the folder's own is meant.

    Parameters
    ----------
    formulation, selector
        What rows call them.
    stated, weight
        What they are.
    options
        Further ones of `calibrate`.
    """

    formulation: str
    selector: str
    stated: Formulation | None
    weight: Any
    options: Mapping[str, Any]

    @property
    def label(self) -> str:
        """What the method is called."""
        if self.selector == NONE:
            return self.formulation
        if self.formulation == self.selector == FOLDER:
            return "as the folder says"
        return f"{self.formulation}, {self.selector}"

    def __call__(self, instance: Instance) -> Answer:
        """Return what it makes of an instance."""
        asked: dict[str, Any] = dict(self.options)
        if self.stated is not None:
            asked["formulation"] = self.stated
        if self.selector != FOLDER:
            asked["weight"] = self.weight
        result = instance.calibrate(**asked)
        return Answer(result.x, result)


@dataclass(frozen=True, eq=False)
class Foreign:
    """A function of a problem that somebody else wrote, or a baseline.

    Parameters
    ----------
    label
        What the method is called.
    function
        Of the problem; see `answer_of` for what it may return.
    """

    label: str
    function: Callable[[CalibrationProblem], Any]
    formulation: str = NONE
    selector: str = NONE

    def __call__(self, instance: Instance) -> Answer:
        """Return what it makes of an instance's problem."""
        return answer_of(self.function(instance.problem), instance.problem, self.label)


def answer_of(found: Any, problem: CalibrationProblem, label: str) -> Answer:
    """Return what a function of a problem returned: a calibration, a baseline, x (n,), or a function of q (N, dof).

    Instead of x alone it may be a problem that identifies other parameters, and x.

    Raises
    ------
    InputError
        For anything else.
    """
    where = f"method {label}"
    own = None
    match found:
        case (CalibrationProblem() as own, found):
            problem = own
    n = len(problem.parameters.free)
    if isinstance(found, Calibration):
        return Answer(found.x, found)
    if callable(found):
        predict: Any = found  # what it returns is checked where it is asked
        return Answer(predict=predict)
    try:
        x = np.asarray(getattr(found, "x", found), dtype=float)
    except (TypeError, ValueError):
        raise InputError(where, f"a {type(found).__name__}", _returns(n)) from None
    if x.shape != (n,) or not np.isfinite(x).all():
        raise InputError(where, f"shape {x.shape}, finite: {bool(np.isfinite(x).all())}", _returns(n))
    return Answer(x, problem=own)


def _returns(n: int) -> str:
    return f"{n} finite deviations [SI], or a function from joint values (N, dof) to positions (N, 3) [m]"


Method = Calibrating | Foreign


def methods_of(formulations: Any, selectors: Any, functions: Any, options: Mapping[str, Any]) -> tuple[Method, ...]:
    """Return every formulation with every selector, then the functions.

    A formulation without penalty has no weight: it is there once.

    Raises
    ------
    InputError
        For an unknown name, or one that occurs twice.
    """
    found: list[Method] = []
    weights = _selectors(selectors)
    for label, formulation in _formulations(formulations):
        if formulation is not None and formulation.penalty is None:
            found.append(Calibrating(label, NONE, formulation, 0.0, options))
        else:
            found += [Calibrating(label, name, formulation, weight, options) for name, weight in weights]
    found += [Foreign(label, function) for label, function in _functions(functions)]
    labels = [method.label for method in found]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError("methods", f"'{label}' twice", "a name of its own for each: {'a name': ...}")
    if not found:
        raise InputError("formulations", "none", f"names ({', '.join(FORMULATIONS)}), objects, or methods")
    return tuple(found)


def _listed(stated: Any) -> list[tuple[str | None, Any]]:
    """Return what stands alone, in a list or under names, with its name."""
    if isinstance(stated, Mapping):
        return [(str(label), each) for label, each in stated.items()]
    if isinstance(stated, str) or callable(stated) or not isinstance(stated, Iterable):
        return [(None, stated)]
    return [(None, each) for each in stated]


def _formulations(stated: Any) -> list[tuple[str, Formulation | None]]:
    found: list[tuple[str, Formulation | None]] = []
    for label, each in _listed(stated):
        if each == FOLDER:
            found.append((label or FOLDER, None))
            continue
        formulation = formulation_of(each)
        name = each if isinstance(each, str) else _ready_name(formulation)
        found.append((label or name, formulation))
    return found


def _ready_name(formulation: Formulation) -> str:
    for name, ready in FORMULATIONS.items():
        if ready is formulation:
            return name
    return formulation.name


def _selectors(stated: Any) -> list[tuple[str, Any]]:
    return [_selector(label, each) for label, each in _listed(stated)]


def _selector(label: str | None, each: Any) -> tuple[str, Any]:
    """Return the name of a selector or weight, and what it is."""
    if each is None:
        each = LEARNED
    if each == FOLDER:
        return label or FOLDER, FOLDER
    if isinstance(each, str):
        return label or each, weight_of(each)
    if callable(each):
        return label or _rule_name(each), each
    if isinstance(each, Mapping) and label:
        return label, each
    weight = _weight(each)
    return label or f"{weight:g}", weight


def _weight(each: Any) -> float:
    if isinstance(each, bool) or not isinstance(each, int | float | np.number):
        accepted = f"a number, a selector, {LEARNED}, {FOLDER}, {', '.join(SELECTORS)}; weights of groups by a name"
        raise InputError("selectors", f"{each!r}", accepted)
    if isinstance(each, int):
        each = number(each, "selectors")
    return require_weight(float(each), "selectors")


def _rule_name(rule: Callable[..., Any]) -> str:
    for name, ready in SELECTORS.items():
        if ready is rule:
            return name
    return getattr(rule, "__name__", type(rule).__name__)


def _functions(stated: Any) -> list[tuple[str, Callable[[CalibrationProblem], Any]]]:
    found = []
    for label, each in _listed(stated):
        if isinstance(each, str):
            found.append((label or each, pick(BASELINES, each, "methods", also="a function of the problem, ")))
        elif callable(each):
            found.append((label or getattr(each, "__name__", type(each).__name__), each))
        else:
            raise InputError("methods", f"{each!r}", f"functions of the problem, or {', '.join(BASELINES)}")
    return found
