"""What a calibration leaves: instrument, robot, or an effect that the model lacks, and which."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError, NoSolutionFound
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.bayes.comparison import Comparison
from rpim_opt.bayes.learning import sampled
from rpim_opt.calibration.asking import calibrate
from rpim_opt.calibration.lack_numbers import LeftOver
from rpim_opt.calibration.lack_words import UNITS, sentences
from rpim_opt.calibration.left_over import (
    FEWEST,
    PATTERNS,
    errors_alike,
    excess,
    narrow,
    parts,
    present,
    repeated,
    upward,
)
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.convex.formulation import tikhonov
from rpim_opt.convex.select import reml
from rpim_opt.problem.source import Source

QUICK = 60
"""Configurations that are looked at before calibrating."""


@dataclass(frozen=True, eq=False)
class LackOfFit(LeftOver):
    """What a calibration leaves, and what it is made of; its fields are described with `LeftOver`.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> from rpim_opt.calibration.lack_of_fit import lack_of_fit
    >>> found = lack_of_fit(ro.calibrate(ro.load("position").problem))
    >>> found.missing, found.alarming, round(1e3 * found.instrument, 3)
    ((), False, 0.052)
    """

    def sentences(self) -> list[str]:
        """Return the paragraph, sentence by sentence."""
        return sentences(self)

    def __str__(self) -> str:
        """Return the paragraph."""
        return " ".join(self.sentences())

    def content(self) -> dict[str, Any]:
        """Return the same as a document [mm, mrad or px]."""
        unit, si = UNITS[self.dimension]
        milli = ("left", "instrument", "position", "joint", "repeatable", "excess")
        repeated = None
        if self.repeated is not None:
            repeated = self.repeated / si
        likeness = None
        if self.alike is not None:
            likeness = self.alike._asdict()
        own = {}
        for family, effect in self.present.items():
            size = None
            if effect.rms is not None:
                size = effect.rms / si
            own[family] = {"gain": effect.gain, f"rms_{unit}": size}
        return {
            "configurations": self.configurations,
            "equations": self.equations,
            "spare": self.spare,
            "dimension": self.dimension,
            **{f"{key}_{unit}": getattr(self, key) / si for key in milli},
            f"repeated_{unit}": repeated,
            "missing": list(self.missing),
            "identify": list(self.parameters),
            "gain": self.gain,
            "share": self.share,
            "present": own,
            "alike": likeness,
            "upward": list(self.upward),
            "narrow": list(self.narrow),
            "alarming": self.alarming,
            "text": self.sentences(),
        }


@one_blas_thread
def lack_of_fit(result: Outcome) -> LackOfFit:
    """Return what a calibration leaves, and what it is made of.

    The evidence of families is computed at the linearization of the result, whatever its weight; of large data at
    most 1000 configurations are looked at, and rows that the fit distrusts are left out.

    Parameters
    ----------
    result
        Any calibration, just made or read from a file.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> from rpim_opt.calibration.lack_of_fit import lack_of_fit
    >>> found = lack_of_fit(ro.calibrate(ro.load("position").problem, ro.tikhonov, ro.reml))
    >>> print(found.sentences()[0].partition(";")[0])
    Left: 0.0468 mm RMS
    """
    compared = Comparison(result)
    errors = compared.problem.errors(result.x, compared.dimension)
    left = float(np.sqrt(np.nanmean(errors**2)))
    known: dict[str, Any] = {
        "configurations": compared.configurations,
        "equations": len(compared.row),
        "spare": compared.spare,
        "dimension": compared.dimension,
        "left": left,
    }
    if compared.spare < FEWEST:
        return LackOfFit(**known)
    best = compared.best
    after = parts(compared, best)
    total = _square(parts(compared, compared.plain))
    explained = max(total - _square(after), 0.0)
    share = 0.0
    if best.families:
        share = explained / total
    again = repeated(compared.problem, result.x, compared.dimension)
    return LackOfFit(
        **known,
        instrument=after["instrument"],
        position=after["position"],
        joint=after["joint"],
        repeatable=float(np.sqrt(share * total)),
        missing=best.families,
        parameters=tuple(p for family in best.families for p in PATTERNS[family]),
        gain=compared.gain,
        share=share,
        present=present(compared),
        alike=errors_alike(compared, best),
        upward=upward(compared),
        narrow=narrow(compared.problem),
        repeated=again.rms,
        excess=excess(again, total, compared.spare),
    )


def judged(result: Outcome) -> LackOfFit | None:
    """Return `lack_of_fit`, or None for a calibration that did not converge, or whose equations are no numbers."""
    if not result.converged:
        return None
    try:
        return lack_of_fit(result)
    except np.linalg.LinAlgError:
        return None


def foreseen(problem: Source) -> LackOfFit | None:
    """Return what a quick fit of the geometry would leave, of at most 60 configurations; None where none succeeds.

    >>> import rpim_opt as ro
    >>> from rpim_opt.calibration.lack_of_fit import foreseen
    >>> foreseen(ro.load("position").problem).alarming
    False
    """
    try:
        return judged(calibrate(sampled(problem, QUICK), tikhonov, reml))
    except (InputError, NoSolutionFound, np.linalg.LinAlgError):
        return None


def _square(parts: Mapping[str, float]) -> float:
    """Return the variance of a row."""
    return sum(value**2 for value in parts.values())
