"""Elements of a comparison: problems, held-out sets, methods, and metrics."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rpim_opt.basics.arrays import Array, finite_numbers, statistics
from rpim_opt.basics.exceptions import InputError, pick
from rpim_opt.basics.units import number
from rpim_opt.calibration import baselines
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import held_out_errors
from rpim_opt.calibration.verdict import judge
from rpim_opt.convex.formulation import FORMULATIONS, formulation_of, tikhonov
from rpim_opt.convex.rules.selection import require_weight
from rpim_opt.convex.select import LEARNED, SELECTORS, weight_of
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.record import Record
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.frames import fitted_frames
from rpim_opt.store.instances import Instance, load
from rpim_opt.store.problem_file import find_problem
from rpim_opt.study.studies import Row

ACCEPTED = "a folder, a name, ro.load(...), a problem, or a function of a seed that returns one"
RETURNS = "an instance, a simulated arm, a problem, or a pair of a problem and validation data"
FOLDER = "folder"
MOST_FOLDS = 10_000  # each is a calibration, and is listed before the first begins
NONE = "none"  # the selector of methods without weight
BASELINES: dict[str, Callable[[CalibrationProblem], Any]] = {
    "nominal": fitted_frames,
    **{name: getattr(baselines, name) for name in baselines.__all__},
}
"""Methods without convex programming; ``nominal`` fits base and tools alone."""
UNDELIVERED = "not delivered"  # but with figures
Thing = TypeVar("Thing")
Problem = Instance | Callable[[int], Any]  # a problem, or a function of a seed with another problem for every seed


def listed(stated: Any) -> list[tuple[str, Any]]:
    """Return one object, a list or a mapping as pairs of name and object; names are empty except in a mapping."""
    if isinstance(stated, Mapping):
        return [(str(label), each) for label, each in stated.items()]
    if isinstance(stated, str) or callable(stated) or not isinstance(stated, Iterable):
        return [("", stated)]
    return [("", each) for each in stated]


def _by_name(where: str, named: Iterable[tuple[str, Thing]], accepted: str) -> dict[str, Thing]:
    known: dict[str, Thing] = {}
    for name, each in named:
        if name in known:
            raise InputError(where, f"'{name}' twice", "a unique name for each: {'a name': ...}")
        known[name] = each
    if not known:
        raise InputError(where, "none", accepted)
    return known


def _function(label: str, each: Any, ready: Mapping[str, Any], where: str, argument: str) -> tuple[str, Any]:
    """Return name and function of what is stated as a function, or by the name of a ready one."""
    if isinstance(each, str):
        return label or each, pick(ready, each, where, also=f"a function of {argument}, ")
    if not callable(each):
        raise InputError(where, f"{each!r}", f"functions of {argument}, or {', '.join(ready)}")
    return label or _name(each), each


def _name(function: Any) -> str:
    return getattr(function, "__name__", type(function).__name__)


# --- problems --------------------------------------------------------------------------------------------------------


def problems_of(stated: Any) -> dict[str, Problem]:
    """Return the problems of a comparison by their names; InputError for anything else, and for duplicate names."""
    return _by_name("problems", _problems(stated), ACCEPTED)


def _problems(stated: Any, label: str = "") -> Iterator[tuple[str, Problem]]:
    instance = _instance(stated, label)
    if instance is not None:
        yield label or instance.record.title or instance.problem.robot.name, instance
    elif isinstance(stated, Mapping):
        for name, problem in stated.items():
            yield from _problems(problem, str(name))
    elif isinstance(stated, str | Path):
        paths: list[str | Path] = [stated]
        if not label and Path(stated).is_dir() and not Path(stated, "problem.toml").is_file():
            paths = [each.parent for each in sorted(Path(stated).glob("*/problem.toml"))]
        for path in paths:
            yield label or find_problem(path).name or str(path), load(path)
    elif isinstance(stated, Iterable) and not label:
        for problem in stated:
            yield from _problems(problem)
    elif callable(stated):
        yield label or _name(stated), stated
    else:
        raise InputError("problems", f"a {type(stated).__name__}", ACCEPTED)


def _instance(candidate: Any, label: str) -> Instance | None:
    """Return a problem in one of its forms as an instance; None for anything else."""
    match candidate:
        case Instance():
            return candidate
        case CalibrationProblem():
            return Instance(candidate, tikhonov, None, record=Record(label))
        case (CalibrationProblem() as problem, Dataset() as validation, *_):  # a simulated arm, too
            return Instance(problem, tikhonov, None, record=Record(label, validation=validation))
    return None


# --- what is held out ------------------------------------------------------------------------------------------------


def splits_of(stated: Any) -> dict[str, float]:
    """Return by name what is held out: ``"folder"`` 0, a fraction (0.25), or in how many folds (5)."""
    splits: dict[str, float] = {}
    for _, each in listed(stated) or [("", stated)]:
        size = each if isinstance(each, int | float) and not isinstance(each, bool) else 0
        if each == FOLDER:
            splits[FOLDER] = 0
        elif 0 < size < 1:
            splits[f"{size:g} held out"] = size
        elif 2 <= size <= MOST_FOLDS and size == int(size):
            splits[f"{int(size)} folds"] = int(size)
        else:
            accepted = f"'folder', a fraction of the configurations between 0 and 1, or folds, 2 to {MOST_FOLDS}"
            raise InputError("splits", f"{each!r}", accepted)
    return splits


def _divided(instance: Instance, split: float, case: Mapping[str, Any]) -> tuple[Instance, Dataset]:
    """Return an instance with the data to fit, and the held-out data: all rows of a configuration, or none."""
    seed = case["seed"]
    data = instance.problem.data
    held_out = instance.validation
    if split:
        known = np.unique(data.configuration)
        if len(known) < split:
            raise InputError("splits", f"{len(known)} configurations", f"at least {split} for {split} folds")
        drawn = np.random.default_rng(seed).permutation(known)
        if split < 1:
            apart = drawn[: min(max(round(split * len(known)), 1), len(known) - 1)]
        else:
            apart = np.array_split(drawn, int(split))[case["fold"] - 1]
        held = np.isin(data.configuration, apart)
        held_out = data.take(np.flatnonzero(held))
        data = data.take(np.flatnonzero(~held))
    if held_out is None:
        accepted = "a folder with validation data, a fraction (0.25), or folds (5)"
        raise InputError("splits", "no validation data", accepted)
    if case["count"] is not None:
        data = data.configurations(case["count"], seed)
    record = replace(instance.record, validation=held_out)
    return replace(instance, problem=instance.problem.on(data), record=record), held_out


# --- methods ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Method:
    """A calibration with ``settings`` in place of the folder's, or a ``function`` of the problem (`errors_by`)."""

    formulation: str = NONE
    selector: str = NONE
    settings: Mapping[str, Any] = field(default_factory=dict)
    function: Callable[[CalibrationProblem], Any] | None = None


def methods_of(formulations: Any, selectors: Any, functions: Any, options: Mapping[str, Any]) -> dict[str, Method]:
    """Return every formulation with every selector, then the functions; InputError for unknown or repeated names."""
    methods: list[tuple[str, Method]] = []
    weights = [_weight(label, each) for label, each in listed(selectors)]
    for own_name, each in listed(formulations):
        name = own_name or FOLDER
        settings = dict(options)
        choices = weights
        if each != FOLDER:
            formulation = formulation_of(each)
            ready = next((name for name, known in FORMULATIONS.items() if known is formulation), formulation.name)
            name = own_name or ready
            settings["formulation"] = formulation
            if formulation.penalty is None:
                choices = [(NONE, {"weight": 0.0})]
        for selector, weight in choices:
            label = name if selector == NONE else f"{name}, {selector}"
            if name == selector == FOLDER:
                label = "as in the folder"
            methods.append((label, Method(name, selector, settings | weight)))
    for label, each in listed(functions):
        name, function = _function(label, each, BASELINES, "methods", "the problem")
        methods.append((name, Method(function=function)))
    return _by_name("methods", methods, f"formulations ({', '.join(FORMULATIONS)}), or functions of the problem")


def _weight(label: str, each: Any) -> tuple[str, dict[str, Any]]:
    """Return the name of a selector or weight, and the setting that it is; the folder's own is none."""
    if each == FOLDER:
        return label or FOLDER, {}
    if each is None or isinstance(each, str):
        return label or each or LEARNED, {"weight": weight_of(each)}
    if callable(each):
        return label or _name(each), {"weight": each}
    if isinstance(each, bool) or not isinstance(each, int | float | np.number):
        raise InputError("selectors", f"{each!r}", f"a number, a selector, {LEARNED}, {FOLDER}, {', '.join(SELECTORS)}")
    weight = require_weight(number(each, "selectors") if isinstance(each, int) else float(each), "selectors")
    return label or f"{weight:g}", {"weight": weight}


def errors_by(returned: Any, problem: CalibrationProblem, label: str) -> Callable[[Dataset, str], Array]:
    """Return the errors (N,) of data by dimension [m or rad] that a method's result leaves.

    The result is a calibration, a baseline, x (n,), or a function of q (N, dof); x may come as a pair with the problem
    whose parameters it refers to. InputError for anything else.
    """
    if isinstance(returned, tuple | list) and len(returned) == 2 and isinstance(returned[0], CalibrationProblem):
        problem, returned = returned
    if isinstance(returned, Calibration):
        return returned.errors
    if callable(returned):
        return partial(_predicted, returned)
    n = len(problem.parameters.free)
    accepted = f"{n} finite deviations [SI], or a function from joint values (N, dof) to positions (N, 3) [m]"
    try:
        x = finite_numbers("x", getattr(returned, "x", returned), (n,))
    except InputError as error:
        raise InputError(f"method {label}", error.found, accepted) from None
    return lambda data, dimension: problem.on(data).errors(x, dimension)


def _predicted(predict: Callable[[Array], Any], data: Dataset, dimension: str) -> Array:
    """Return the errors (N,) [m] of predicted positions; NaN of orientations."""
    if dimension != "length":
        return np.full(len(data), np.nan)
    if len(data.blocks) != 1 or data.blocks[0].measurement.name != "position":
        kinds = ", ".join(f"{block.measurement.name} {' '.join(block.markers)}".strip() for block in data.blocks)
        raise InputError("predicted positions", kinds, "data of the positions of one reflector")
    block = data.blocks[0]
    predicted = finite_numbers("predicted positions", predict(block.q[:, 0]), block.y.shape)
    errors = np.empty(len(data))
    errors[block.row] = np.linalg.norm(block.y - predicted, axis=1)
    return errors


# --- metrics ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Fitted:
    """Argument of metrics: the result of a method, and the held-out data.

    The ``problem`` was fitted and the rows ``held_out`` were not; ``errors_of`` gives the method's errors of data,
    ``result`` is a calibration's; ``seconds`` is its time.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> def p95_mm(fitted):
    ...     return 1e3 * float(np.percentile(fitted.errors(), 95))
    >>> found = ro.compare("position", "tikhonov", "reml", metrics=[p95_mm])
    >>> round(found.rows[0]["p95_mm"], 3)
    0.039
    """

    problem: CalibrationProblem
    held_out: Dataset
    errors_of: Callable[[Dataset, str], Array]
    result: Calibration | None
    seconds: float

    def errors(self, dimension: str = "length") -> Array:
        """Return the errors (N,) of the rows that were held out, in m, or in rad for ``"angle"``; NaN without any."""
        return self.errors_of(self.held_out, dimension)


def _coverage(fitted: Fitted) -> float | None:
    if fitted.result is None:
        return None
    share = held_out_errors(fitted.result, fitted.held_out).coverage
    return share and 100 * share


METRICS: dict[str, Callable[[Fitted], float | None]] = {
    "rms_mm": lambda fitted: statistics(fitted.errors())["rms_mm"],
    "mean_mm": lambda fitted: statistics(fitted.errors())["mean_mm"],
    "p95_mm": lambda fitted: statistics(fitted.errors())["p95_mm"],
    "max_mm": lambda fitted: statistics(fitted.errors())["max_mm"],
    "rms_mrad": lambda fitted: statistics(fitted.errors("angle"), "mrad")["rms_mrad"],
    "fit_rms_mm": lambda fitted: statistics(fitted.errors_of(fitted.problem.data, "length"))["rms_mm"],
    "covered_percent": _coverage,
    "seconds": lambda fitted: fitted.seconds,
}


def metrics_of(stated: Any) -> dict[str, Callable[[Fitted], float | None]]:
    """Return metrics by their names with units; InputError for anything else."""
    metrics = dict(_function(label, each, METRICS, "metrics", "a fit") for label, each in listed(stated))
    return _by_name("metrics", metrics.items(), f"functions of a fit, or {', '.join(METRICS)}")


def replicate(
    problem: Problem, split: float, method: Method, metrics: Mapping[str, Callable[..., Any]], case: Mapping[str, Any]
) -> Row:
    """Return the metrics of a method on one split, None if not finite; a failure becomes a status and a reason."""
    row: Row = {"status": "ok", "reason": "", "configurations": None, "parameters": None, "weight": None}
    try:
        label, seed = case["problem"], case["seed"]
        drawn = _instance(problem if isinstance(problem, Instance) else problem(seed), label)
        if drawn is None:
            raise InputError(f"problem {label}", f"a function of a seed that returns no problem ({seed})", RETURNS)
        instance, held_out = _divided(drawn, split, case)
        begun = time.perf_counter()
        returned = method.function(instance.problem) if method.function else instance.calibrate(**method.settings)
        seconds = time.perf_counter() - begun
        result = returned if isinstance(returned, Calibration) else None
        errors = errors_by(returned, instance.problem, case["method"])
        fitted = Fitted(instance.problem, held_out, errors, result, seconds)
        values = {name: metric(fitted) for name, metric in metrics.items()}
        values = {name: float(v) if v is not None and np.isfinite(v) else None for name, v in values.items()}
        row["configurations"] = len(np.unique(instance.problem.data.configuration))
        row["parameters"] = len(instance.problem.parameters.free)
        if result is not None:
            row["weight"] = float(result.weight)
            reasons = judge(result).reasons  # without likely mistakes in the data, common to all methods
            if reasons:
                row |= {"status": UNDELIVERED, "reason": " ".join(reasons)}
        return row | values
    except InputError as error:
        row |= {"status": "impossible", "reason": str(error)}
    except Exception as error:  # by foreign functions or a solver: the other replicates continue
        row |= {"status": "failed", "reason": f"{type(error).__name__}: {error}"}
    return {**row, **dict.fromkeys(metrics)}
