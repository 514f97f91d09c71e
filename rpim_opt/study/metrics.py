"""What a comparison measures of a fit on the configurations that it did not see."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, pick
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.store.instances import Instance
from rpim_opt.study.methods import Answer
from rpim_opt.use.validation import validate


@dataclass(frozen=True, eq=False)
class Fitted:
    """What a method found, and the data that it did not see: what a metric of one's own is a function of.

    Parameters
    ----------
    problem
        What was fitted.
    held_out
        The rows that were not.
    answer
        The method's: ``x`` (n,) [SI], ``result``, ``predict``, whichever it has.
    seconds
        That it took.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> def p95_mm(fitted):
    ...     return 1e3 * float(np.percentile(fitted.errors(), 95))
    >>> def over_fit(fitted):
    ...     return float(fitted.errors().mean() / fitted.fit_errors().mean())
    >>> found = ro.compare("position", "tikhonov", "reml", metrics=[p95_mm, over_fit])
    >>> round(found.rows[0]["p95_mm"], 3)
    0.039
    """

    problem: CalibrationProblem
    held_out: Dataset
    answer: Answer
    seconds: float

    def errors(self, dimension: str = "length") -> Array:
        """Return the errors (N,) of the rows that were held out, in m, or in rad for ``"angle"``; NaN without any."""
        return self._errors(self.held_out, dimension)

    def fit_errors(self) -> Array:
        """Return those (N,) [m] of the rows that were fitted."""
        return self._errors(self.problem.data, "length")

    def _errors(self, data: Dataset, dimension: str) -> Array:
        if self.answer.result is not None:
            return self.answer.result.errors(data, dimension)
        if self.answer.x is not None:
            problem = self.answer.problem or self.problem
            return problem.on(data).errors(self.answer.x, dimension)
        if dimension != "length":
            return np.full(len(data), np.nan)
        return self._missed(data)

    def _missed(self, data: Dataset) -> Array:
        """Return by how much predicted positions miss (N,) [m]."""
        if self.answer.predict is None or len(data.blocks) != 1 or data.blocks[0].measurement.name != "position":
            kinds = ", ".join(f"{block.measurement.name} {' '.join(block.markers)}".strip() for block in data.blocks)
            raise InputError("predicted positions", kinds, "data of the positions of one reflector")
        block = data.blocks[0]
        predicted = np.asarray(self.answer.predict(block.q[:, 0]), dtype=float)
        if predicted.shape != block.y.shape:
            raise InputError("predicted positions", f"shape {predicted.shape}", f"{block.y.shape} [m]")
        errors = np.empty(len(data))
        errors[block.row] = np.linalg.norm(block.y - predicted, axis=1)
        return errors


def _rms(errors: Array) -> float | None:
    return _of(errors, lambda e: float(np.sqrt(np.mean(e**2))))


def _of(errors: Array, figure: Callable[[Array], float]) -> float | None:
    """Return 1000 times a figure of the errors that are numbers, which makes mm of m; None where there are none."""
    known = errors[np.isfinite(errors)]
    if not len(known):
        return None
    return 1e3 * figure(known)


def _coverage(fitted: Fitted) -> float | None:
    if fitted.answer.result is None:
        return None
    share = validate(fitted.answer.result, fitted.held_out).coverage
    if share is None:
        return None
    return 100 * share


METRICS: dict[str, Callable[[Fitted], float | None]] = {
    "rms_mm": lambda fitted: _rms(fitted.errors()),
    "mean_mm": lambda fitted: _of(fitted.errors(), lambda e: float(e.mean())),
    "p95_mm": lambda fitted: _of(fitted.errors(), lambda e: float(np.percentile(e, 95))),
    "max_mm": lambda fitted: _of(fitted.errors(), lambda e: float(e.max())),
    "rms_mrad": lambda fitted: _rms(fitted.errors("angle")),
    "fit_rms_mm": lambda fitted: _rms(fitted.fit_errors()),
    "covered_percent": _coverage,
    "seconds": lambda fitted: fitted.seconds,
}
"""Ready ones: errors of rows held out and of rows fitted, the share of readings in their 95 % intervals, time."""
USUAL = ("rms_mm", "mean_mm", "max_mm", "seconds")


def metrics_of(stated: Any) -> dict[str, Callable[[Fitted], float | None]]:
    """Return metrics by their names, which are columns and carry their units.

    Raises
    ------
    InputError
        For an unknown name, or what is no function.
    """
    if isinstance(stated, Mapping):
        found = {str(name): each for name, each in stated.items()}
    elif isinstance(stated, str):
        found = {stated: stated}
    elif isinstance(stated, Iterable):
        found = {getattr(each, "__name__", str(each)): each for each in stated}
    else:
        found = {getattr(stated, "__name__", str(stated)): stated}
    ready = {}
    for name, each in found.items():
        ready[name] = pick(METRICS, each, "metrics", also="a function of a fit, ") if isinstance(each, str) else each
        if not callable(ready[name]):
            raise InputError("metrics", f"{each!r}", f"functions of a fit, or {', '.join(METRICS)}")
    if not ready:
        raise InputError("metrics", "none", f"functions of a fit, or {', '.join(METRICS)}")
    return ready


def measured(instance: Instance, answer: Answer, seconds: float, metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Return the metrics of an answer; None for one that is no number."""
    held_out = instance.validation
    if held_out is None:
        raise InputError("splits", "nothing held out", "validation data")
    fitted = Fitted(instance.problem, held_out, answer, seconds)
    found = {}
    for name, metric in metrics.items():
        value = metric(fitted)
        found[name] = float(value) if value is not None and np.isfinite(value) else None
    return found
