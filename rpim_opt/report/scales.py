"""What figures show and how it is scaled: bins of errors, tolerances, and how far error vectors are enlarged."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import joined
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.constraints import within_tolerance


def error_bins(*errors: Array) -> Array:
    """Return edges of a histogram's bins, equal in the logarithm, four decades at most."""
    every = np.concatenate(errors)
    high = max(float(every.max(initial=0.0)), 1e-6) * 1.001
    low = max(float(every.min(initial=high)), 1e-4 * high)
    return np.geomspace(low, high, 25 if high > 1.01 * low else 2)


def mm(value: float) -> str:
    """Return a length given in mm with the digits that matter."""
    if value < 10:
        return f"{value:.3f}"
    return f"{value:.2f}" if value < 100 else f"{value:.0f}"


def below(low: float, sets: Mapping[str, Array]) -> str:
    """Say how many errors of each set lie below the first bin, which counts them, too; nothing where none does."""
    said = [f"{int(np.sum(errors < low))} {when}" for when, errors in sets.items() if (errors < low).any()]
    if not said:
        return ""
    return f"The first bar holds all rows below {low:.2g} mm, too: {joined(said)}."


def kept_tolerance(result: Calibration) -> Array:
    """Return the tolerances (n,) [SI] that the formulation keeps to; infinite where it keeps to none."""
    stated = result.problem.parameters.free.tolerance
    if any(each is within_tolerance for each in result.formulation.constraints):
        return stated
    return np.full(len(stated), np.inf)


def magnification(points: Array, vectors: Array) -> float:
    """Return by how much to enlarge errors, the longest to a sixth of the points' extent: 1, 2 or 5 times 10^k."""
    longest = float(np.linalg.norm(vectors, axis=1).max(initial=0.0))
    exponent = np.log10(max(float(np.ptp(points, axis=0).max()), 1e-3) / 6 / max(longest, 1e-12))
    decade = 10.0 ** np.floor(exponent)
    return float(max(step for step in (1, 2, 5) if step * decade <= 10**exponent) * decade)
