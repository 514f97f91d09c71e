"""How far the evidence decides: other optima, edges, sizes that data hardly tell, directions that are prior alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import joined
from rpim_opt.convex.evidence import FARTHEST, Evidence, Point

NEARLY, APART = 6.0, 1.0
"""By how much -2 ln L of another optimum may be worse to be named, and its logarithms of sizes must differ."""
HARDLY = 1.0
"""Standard deviation of a logarithm from which on a size of the geometry is hardly told."""


def doubts(evidence: Evidence, point: Point, others: Sequence[Point], spread: Array) -> Iterator[str]:
    """Yield sentences.

    Parameters
    ----------
    evidence, point
        And its optimum.
    others
        Optima that were come to from other sides.
    spread
        (s,) standard deviations of the logarithms of sizes.
    """
    for other in others:
        if other.value - point.value < NEARLY and np.abs(other.logs - point.logs).max() > APART:
            yield (
                "The evidence has a second optimum that is nearly as good, with sizes "
                f"{_times(other, point)} as large: more configurations would decide."
            )
            break
    if (np.abs(point.logs - evidence.centre) > FARTHEST - 0.01).any():
        yield "A size came to the edge of what is believed possible: look at units, scales and declared noise."
    vague = [i for i in evidence.believed.geometry if spread[i] > HARDLY]
    if vague:
        names = joined([evidence.believed.names[i] for i in vague])
        factor = np.exp(max(spread[vague]))
        yield f"The data hardly tell how much {names} deviate (by a factor of {factor:.1f} either way)."
    m, n = evidence.data.X.shape
    if m < n:
        yield f"{m} equations for {n} parameters: at least {n - m} directions are prior alone."


def _times(other: Point, point: Point) -> str:
    ratios = np.exp(other.logs - point.logs)
    return ", ".join(f"{ratio:.1g}" for ratio in ratios) + " times"
