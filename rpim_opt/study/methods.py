"""What a comparison is made of: problems, what is held out of them, methods, and metrics of what these return."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rpim_opt.basics.arrays import Array, statistics
from rpim_opt.basics.exceptions import InputError, pick
from rpim_opt.basics.units import number
from rpim_opt.calibration import baselines
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.formulation import FORMULATIONS, formulation_of, tikhonov
from rpim_opt.convex.program import Program
from rpim_opt.convex.rules.selection import require_weight
from rpim_opt.convex.select import LEARNED, SELECTORS, weight_of
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.data.record import Record
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.frames import fitted_frames
from rpim_opt.store.instances import Instance, load
from rpim_opt.study.ranking import FAILED, IMPOSSIBLE, OK, UNCONVERGED
from rpim_opt.study.replicates import Row
from rpim_opt.use.validation import validate

ACCEPTED = "a folder, a name, ro.load(...), a problem, or a function of a seed that returns one"
RETURNS = "an instance, a simulated arm, a problem, or a pair of a problem and validation data"
FOLDER = "folder"
MOST_FOLDS = 10_000
"""Each is a calibration of its own, and is listed before the first begins."""
NOISE_STREAM = 11
"""Stream of the noise that is added, apart from those that draw configurations."""
NONE = "none"
"""The selector of what has no weight."""
BASELINES: dict[str, Callable[[CalibrationProblem], Any]] = {
    "nominal": fitted_frames,
    **{name: getattr(baselines, name) for name in baselines.__all__},
}
"""Methods without convex programming; ``nominal`` fits base and tools alone."""
Labelled = TypeVar("Labelled", bound=Any)


def each_once(where: str, labelled: Sequence[Labelled], what: str) -> tuple[Labelled, ...]:
    """Return things with labels as a tuple; InputError for a label that occurs twice."""
    twice = [label for label, count in Counter(each.label for each in labelled).items() if count > 1]
    if twice:
        raise InputError(where, f"'{twice[0]}' twice", f"a unique name for each: {{'a name': {what}}}")
    return tuple(labelled)


@dataclass(frozen=True, eq=False)
class Source:
    """A named problem, or a function of a seed with another problem for every seed."""

    label: str
    problem: Instance | Callable[[int], Any]

    @property
    def drawn(self) -> bool:
        """Whether it depends on a seed."""
        return not isinstance(self.problem, Instance)

    def instance(self, seed: int) -> Instance:
        """Return the instance of a seed."""
        if isinstance(self.problem, Instance):
            return self.problem
        instance = _instance(self.problem(seed), self.label)
        if instance is None:
            raise InputError(f"problem {self.label}", f"a function of a seed that returns no problem ({seed})", RETURNS)
        return instance


def sources_of(problems: Any) -> tuple[Source, ...]:
    """Return the problems of a comparison; InputError for anything else, and for duplicate names."""
    sources = each_once("problems", list(_sources(problems)), "problem")
    if not sources:
        raise InputError("problems", "none", ACCEPTED)
    return sources


def _sources(problems: Any, label: str = "") -> Iterator[Source]:
    instance = _instance(problems, label)
    if isinstance(problems, Mapping):
        for name, problem in problems.items():
            yield from _sources(problem, str(name))
    elif isinstance(problems, str | Path):
        place = Path(problems)
        paths: list[str | Path] = [problems]
        if not label and place.is_dir() and not (place / "problem.toml").is_file():
            paths = [each.parent for each in sorted(place.glob("*/problem.toml"))]
        if not paths:
            raise InputError("problems", f"no problem.toml in '{place}' or a folder in it", ACCEPTED)
        for path in paths:
            place = Path(path)
            name = place.parent.name if place.name == "problem.toml" else place.name
            yield Source(label or name or str(path), load(path))
    elif instance is not None:
        yield Source(label or instance.record.title or instance.problem.robot.name, instance)
    elif isinstance(problems, Iterable) and not label:
        for problem in problems:
            yield from _sources(problem)
    elif isinstance(problems, Program):
        raise InputError("problems", "a program", f"{ACCEPTED}; ro.select.compare compares selectors on a program")
    elif callable(problems):
        yield Source(label or getattr(problems, "__name__", type(problems).__name__), problems)
    else:
        raise InputError("problems", f"a {type(problems).__name__}", ACCEPTED)


def _instance(given: Any, label: str) -> Instance | None:
    """Return a problem in one of its forms as an instance; None for anything else."""
    match given:
        case Instance():
            return given
        case CalibrationProblem():
            return Instance(given, tikhonov, None, record=Record(label))
        case (CalibrationProblem() as problem, Dataset() as validation, *_):  # a simulated arm, too
            return Instance(problem, tikhonov, None, record=Record(label, validation=validation))
    return None


# --- what is held out ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Split:
    """A split of configurations: a random fraction held out, or folds."""

    label: str
    part: float = 0.0
    folds: int = 1

    def held_out(self, data: Dataset, fold: int, seed: int) -> np.ndarray:
        """Return which rows (N,) are held out; all rows of a configuration are, or none."""
        known = np.unique(data.configuration)
        drawn = np.random.default_rng(seed).permutation(known)
        if self.part:
            count = min(max(round(self.part * len(known)), 1), len(known) - 1)
            return np.isin(data.configuration, drawn[:count])
        if len(known) < self.folds:
            found = f"{len(known)} configurations"
            raise InputError("splits", found, f"at least {self.folds} for {self.folds} folds")
        return np.isin(data.configuration, np.array_split(drawn, self.folds)[fold - 1])


def splits_of(stated: Any) -> tuple[Split, ...]:
    """Return the splits: ``"folder"``, a fraction (0.25), a number of folds (5), or several of them."""
    several = isinstance(stated, Sequence) and not isinstance(stated, str) and stated
    parts: list[Any] = list(stated) if several else [stated]
    splits = []
    for each in parts:
        number = isinstance(each, int | float) and not isinstance(each, bool)
        if each == FOLDER:
            splits.append(Split(FOLDER))
        elif number and 0 < each < 1:
            splits.append(Split(f"{each:g} held out", part=float(each)))
        elif number and 2 <= each <= MOST_FOLDS and each == int(each):
            splits.append(Split(f"{int(each)} folds", folds=int(each)))
        else:
            accepted = f"'folder', a fraction of the configurations between 0 and 1, or folds, 2 to {MOST_FOLDS}"
            raise InputError("splits", f"{each!r}", accepted)
    return tuple(dict.fromkeys(splits))


def divide(instance: Instance, split: Split, fold: int, count: int | None, noise: float, seed: int) -> Instance:
    """Return an instance with the data to fit, and the held-out data as its validation data.

    Of the configurations that a split's fold (from 1) leaves, ``count`` are fitted, drawn at random, or all; their
    noise is ``noise`` times what it was. InputError for fewer configurations, or nothing that is held out.
    """
    data = instance.problem.data
    held_out = instance.validation
    if split.label != FOLDER:
        held = split.held_out(data, fold, seed)
        held_out = data.take(np.flatnonzero(held))
        data = data.take(np.flatnonzero(~held))
    if held_out is None:
        raise InputError(
            "splits", "no validation data", "a folder with validation data, a fraction (0.25), or folds (5)"
        )
    if count is not None:
        data = data.configurations(count, seed)
    if noise > 1:
        data = add_noise(data, noise, seed)
    return replace(instance, problem=instance.problem.on(data), record=replace(instance.record, validation=held_out))


def add_noise(data: Dataset, factor: float, seed: int) -> Dataset:
    """Return data with normal noise added to reach ``factor`` times the declared noise, which is updated.

    To a row of covariance S comes noise of covariance (factor^2 - 1) S; it then declares factor^2 S.
    """
    rng = np.random.default_rng([seed, NOISE_STREAM])

    def noisy(block: Block) -> Block:
        k = block.covariance.shape[1]
        root = np.sqrt(factor**2 - 1) * np.linalg.cholesky(block.covariance)
        error = (root @ rng.standard_normal((len(block.y), k, 1)))[:, :, 0]
        return replace(block, y=block.measurement.plus(block.y, error), covariance=factor**2 * block.covariance)

    return replace(data, blocks=tuple(map(noisy, data.blocks)))


# --- methods ---------------------------------------------------------------------------------------------------------


Answer = tuple[Callable[[Dataset, str], Array], Calibration | None]
"""Errors (N,) of data by dimension [m or rad] that a method leaves, and its calibration, if any."""


@dataclass(frozen=True, eq=False)
class Method:
    """A method: its names in the rows, and its function of an instance, whose result `answer_of` interprets."""

    label: str
    solve: Callable[[Instance], Any]
    formulation: str = NONE
    selector: str = NONE


def answer_of(returned: Any, problem: CalibrationProblem, label: str) -> Answer:
    """Interpret the result of a method: a calibration, a baseline, x (n,), or a function of q (N, dof).

    Instead of x alone it may be a problem that identifies other parameters, and x; InputError for anything else.
    """
    where = f"method {label}"
    match returned:
        case (CalibrationProblem() as problem, returned):
            pass
    n = len(problem.parameters.free)
    accepted = f"{n} finite deviations [SI], or a function from joint values (N, dof) to positions (N, 3) [m]"
    if isinstance(returned, Calibration):
        return returned.errors, returned
    if callable(returned):
        return partial(_predicted, returned), None
    try:
        x = np.asarray(getattr(returned, "x", returned), dtype=float)
    except (TypeError, ValueError):
        raise InputError(where, f"a {type(returned).__name__}", accepted) from None
    if x.shape != (n,) or not np.isfinite(x).all():
        raise InputError(where, f"shape {x.shape}, finite: {bool(np.isfinite(x).all())}", accepted)
    return lambda data, dimension: problem.on(data).errors(x, dimension), None


def _predicted(predict: Callable[[Array], Any], data: Dataset, dimension: str) -> Array:
    """Return the errors (N,) [m] of predicted positions; NaN of orientations."""
    if dimension != "length":
        return np.full(len(data), np.nan)
    if len(data.blocks) != 1 or data.blocks[0].measurement.name != "position":
        kinds = ", ".join(f"{block.measurement.name} {' '.join(block.markers)}".strip() for block in data.blocks)
        raise InputError("predicted positions", kinds, "data of the positions of one reflector")
    block = data.blocks[0]
    predicted = np.asarray(predict(block.q[:, 0]), dtype=float)
    if predicted.shape != block.y.shape:
        raise InputError("predicted positions", f"shape {predicted.shape}", f"{block.y.shape} [m]")
    errors = np.empty(len(data))
    errors[block.row] = np.linalg.norm(block.y - predicted, axis=1)
    return errors


def methods_of(formulations: Any, selectors: Any, functions: Any, options: Mapping[str, Any]) -> tuple[Method, ...]:
    """Return every formulation with every selector, then the functions; InputError for unknown or repeated names.

    A formulation without penalty has no weight: it is there once.
    """
    methods: list[Method] = []
    weights = [_selector(label, each) for label, each in _listed(selectors)]
    for own_name, each in _listed(formulations):
        name = own_name or FOLDER
        settings = dict(options)
        pairs = weights
        if each != FOLDER:
            formulation = formulation_of(each)
            ready = next((name for name, known in FORMULATIONS.items() if known is formulation), formulation.name)
            name = own_name or (each if isinstance(each, str) else ready)
            settings["formulation"] = formulation
            if formulation.penalty is None:
                pairs = [(NONE, 0.0)]
        for selector, weight in pairs:
            label = name if selector == NONE else f"{name}, {selector}"
            if name == selector == FOLDER:
                label = "as in the folder"
            own = settings if selector == FOLDER else {**settings, "weight": weight}
            methods.append(Method(label, partial(Instance.calibrate, **own), name, selector))
    for label, each in _listed(functions):
        name, function = _named(label, each, BASELINES, "methods", "the problem")
        methods.append(Method(name, partial(_of_problem, function)))
    if not methods:
        raise InputError("formulations", "none", f"names ({', '.join(FORMULATIONS)}), objects, or methods")
    return each_once("methods", methods, "...")


def _of_problem(function: Callable[[CalibrationProblem], Any], instance: Instance) -> Any:
    return function(instance.problem)


def _listed(stated: Any) -> list[tuple[str, Any]]:
    """Return what stands alone, in a list or under names, with its name, which is empty without one."""
    if isinstance(stated, Mapping):
        return [(str(label), each) for label, each in stated.items()]
    if isinstance(stated, str) or callable(stated) or not isinstance(stated, Iterable):
        return [("", stated)]
    return [("", each) for each in stated]


def _named(label: str, each: Any, ready: Mapping[str, Any], where: str, argument: str) -> tuple[str, Any]:
    """Return name and function of what is stated as a function, or by the name of a ready one."""
    if isinstance(each, str):
        return label or each, pick(ready, each, where, also=f"a function of {argument}, ")
    if not callable(each):
        raise InputError(where, f"{each!r}", f"functions of {argument}, or {', '.join(ready)}")
    return label or _name(each), each


def _name(function: Any) -> str:
    return getattr(function, "__name__", type(function).__name__)


def _selector(label: str, each: Any) -> tuple[str, Any]:
    """Return the name of a selector or weight, and what it is."""
    if each is None:
        each = LEARNED
    if isinstance(each, str):
        return label or each, each if each == FOLDER else weight_of(each)
    if callable(each):
        ready = next((name for name, known in SELECTORS.items() if known is each), _name(each))
        return label or ready, each
    if isinstance(each, bool) or not isinstance(each, int | float | np.number):
        accepted = f"a number, a selector, {LEARNED}, {FOLDER}, {', '.join(SELECTORS)}"
        raise InputError("selectors", f"{each!r}", accepted)
    if isinstance(each, int):
        each = number(each, "selectors")
    weight = require_weight(float(each), "selectors")
    return label or f"{weight:g}", weight


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

    def fit_errors(self) -> Array:
        """Return the errors (N,) [m] of the identification rows."""
        return self.errors_of(self.problem.data, "length")


def _p95(fitted: Fitted) -> float | None:
    errors = fitted.errors()
    known = errors[np.isfinite(errors)]
    return 1e3 * float(np.percentile(known, 95)) if len(known) else None


def _coverage(fitted: Fitted) -> float | None:
    share = None if fitted.result is None else validate(fitted.result, fitted.held_out).coverage
    return None if share is None else 100 * share


METRICS: dict[str, Callable[[Fitted], float | None]] = {
    "rms_mm": lambda fitted: statistics(fitted.errors())["rms_mm"],
    "mean_mm": lambda fitted: statistics(fitted.errors())["mean_mm"],
    "p95_mm": _p95,
    "max_mm": lambda fitted: statistics(fitted.errors())["max_mm"],
    "rms_mrad": lambda fitted: statistics(fitted.errors("angle"), "mrad")["rms_mrad"],
    "fit_rms_mm": lambda fitted: statistics(fitted.fit_errors())["rms_mm"],
    "covered_percent": _coverage,
    "seconds": lambda fitted: fitted.seconds,
}
USUAL = ("rms_mm", "mean_mm", "max_mm", "seconds")


def metrics_of(stated: Any) -> dict[str, Callable[[Fitted], float | None]]:
    """Return metrics by their names with units; InputError for anything else."""
    metrics = dict(_named(label, each, METRICS, "metrics", "a fit") for label, each in _listed(stated))
    if not metrics:
        raise InputError("metrics", "none", f"functions of a fit, or {', '.join(METRICS)}")
    return metrics


def measure(instance: Instance, answer: Answer, seconds: float, metrics: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the metrics of a result; None for a metric that is not finite."""
    if instance.validation is None:
        raise InputError("splits", "nothing held out", "validation data")
    fitted = Fitted(instance.problem, instance.validation, *answer, seconds)
    values = {name: metric(fitted) for name, metric in metrics.items()}
    return {name: float(v) if v is not None and np.isfinite(v) else None for name, v in values.items()}


# --- a replicate -----------------------------------------------------------------------------------------------------


def replicate(
    source: Source, split: Split, method: Method, metrics: Mapping[str, Callable[..., Any]], case: Mapping[str, Any]
) -> Row:
    """Return the metrics of a method on one split of a problem; a failure becomes a status and a reason."""
    row: Row = {"status": OK, "reason": "", "configurations": None, "parameters": None, "weight": None}
    seed = case["seed"]
    try:
        instance = divide(source.instance(seed), split, case["fold"], case["count"], case["noise_factor"], seed)
        begun = time.perf_counter()
        returned = method.solve(instance)
        seconds = time.perf_counter() - begun
        answer = answer_of(returned, instance.problem, method.label)
        values = measure(instance, answer, seconds, metrics)
        row["configurations"] = len(np.unique(instance.problem.data.configuration))
        row["parameters"] = len(instance.problem.parameters.free)
        result = answer[1]
        if result is not None:
            row["weight"] = float(result.weight)
            if not result.converged:
                row |= {"status": UNCONVERGED, "reason": result.message}
        return {**row, **values}
    except InputError as error:
        row |= {"status": IMPOSSIBLE, "reason": str(error)}
    except Exception as error:  # somebody's function, a solver: the other replicates go on
        row |= {"status": FAILED, "reason": f"{type(error).__name__}: {error}"}
    return {**row, **dict.fromkeys(metrics)}
