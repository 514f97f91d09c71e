"""One replicate of a comparison: a method on a problem's split, with its figures or the reason why there are none."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.study.methods import Answer, Method
from rpim_opt.study.metrics import measured
from rpim_opt.study.sources import Source
from rpim_opt.study.splits import Split, divided

OK = "ok"
UNCONVERGED = "not converged"
IMPOSSIBLE = "impossible"
FAILED = "failed"
NUMBERS = (OK, UNCONVERGED)
"""Of these there are figures."""


def replicate(
    source: Source, split: Split, method: Method, metrics: Mapping[str, Callable[..., Any]], case: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what a method finds; whatever goes wrong becomes a status and a reason.

    Parameters
    ----------
    source, split, method, metrics
        What is computed.
    case
        Its seed, fold, number of configurations and noise.
    """
    found: dict[str, Any] = {"status": OK, "reason": "", "configurations": None, "parameters": None, "weight": None}
    try:
        found |= _found(source, split, method, metrics, case)
    except InputError as error:
        found |= {"status": IMPOSSIBLE, "reason": str(error)}
    except Exception as error:  # somebody's function, a solver: the other replicates go on
        found |= {"status": FAILED, "reason": f"{type(error).__name__}: {error}"}
    return {**found, **{name: found.get(name) for name in metrics}}


def _found(
    source: Source, split: Split, method: Method, metrics: Mapping[str, Callable[..., Any]], case: Mapping[str, Any]
) -> dict[str, Any]:
    seed = case["seed"]
    instance, _ = divided(source.made(seed), split, case["fold"], case["count"], case["noise_factor"], seed)
    begun = time.perf_counter()
    answer = method(instance)
    seconds = time.perf_counter() - begun
    known = {
        "configurations": len(np.unique(instance.problem.data.configuration)),
        "parameters": len(instance.problem.parameters.free),
    }
    return {**known, **_said(answer), **measured(instance, answer, seconds, metrics)}


def _said(answer: Answer) -> dict[str, Any]:
    """Return what a calibration says of itself."""
    result = answer.result
    if result is None:
        return {}
    status = {"status": OK, "reason": ""}
    if not result.converged:
        status = {"status": UNCONVERGED, "reason": result.message}
    return {**status, "weight": float(result.weight)}
