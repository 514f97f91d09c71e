"""How figures are scaled: bins of errors, and how far error vectors are enlarged."""

from __future__ import annotations

import numpy as np

from rpim_opt.basics.arrays import Array


def error_bins(*errors: Array) -> Array:
    """Return edges of a histogram's bins, equal in the logarithm, four decades at most."""
    every = np.concatenate(errors)
    high = max(float(every.max(initial=0.0)), 1e-6) * 1.001
    low = max(float(every.min(initial=high)), 1e-4 * high)
    return np.geomspace(low, high, 25 if high > 1.01 * low else 2)


def magnification(points: Array, vectors: Array) -> float:
    """Return by how much to enlarge errors, the longest to a sixth of the points' extent: 1, 2 or 5 times 10^k."""
    longest = float(np.linalg.norm(vectors, axis=1).max(initial=0.0))
    exponent = np.log10(max(float(np.ptp(points, axis=0).max()), 1e-3) / 6 / max(longest, 1e-12))
    decade = 10.0 ** np.floor(exponent)
    return float(max(step for step in (1, 2, 5) if step * decade <= 10**exponent) * decade)
