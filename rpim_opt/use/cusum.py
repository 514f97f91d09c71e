"""Page's cumulative sum of standard normal deviates, and the limit that chance passes rarely in so many of them."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from rpim_opt.basics.arrays import Array

SLACK = 0.5
"""What is taken off every deviate: sums answer fastest to a shift of twice as much."""
CELLS = 150
"""Steps of a sum's range in the Markov chain of its distribution."""
HIGHEST = 50.0
"""No limit is beyond."""


def cumulative(deviate: Array) -> Array:
    """Return Page's sums (N,), S_t = max(0, S_(t-1) + u_t - `SLACK`).

    >>> import numpy as np
    >>> from rpim_opt.use.cusum import cumulative
    >>> cumulative(np.array([0.0, 2.0, 1.0, -3.0])).tolist()
    [0.0, 1.5, 2.0, 0.0]
    """
    found = np.zeros(len(deviate))
    total = 0.0
    for t, u in enumerate(deviate):
        total = max(0.0, total + float(u) - SLACK)
        found[t] = total
    return found


def limit(count: int, rare: float) -> float:
    """Return what sums of so many independent standard normal deviates pass with probability ``rare``.

    By Brook and Evans' Markov chain (1972), bisected.

    >>> from rpim_opt.use.cusum import limit
    >>> limit(10, 0.01) < limit(100, 0.01) < limit(1000, 0.01)
    True
    """
    low, high = 0.0, HIGHEST
    while high - low > 1e-3:
        middle = (low + high) / 2
        if passing(middle, count) > rare:
            low = middle
        else:
            high = middle
    return high


def passing(h: float, count: int) -> float:
    """Return the probability that one of so many sums passes h."""
    if h <= 0:
        return 1.0
    width = h / CELLS
    centre = width * (np.arange(CELLS) + 0.5)
    # from sum i the next is in cell j where u - SLACK is within half a cell of their difference; zero has its own cell
    states = np.concatenate([[0.0], centre])
    upper = ndtr(np.concatenate([[0.0], centre + width / 2])[None, :] - states[:, None] + SLACK)
    step = np.diff(upper, axis=1, prepend=0.0)
    stays = np.linalg.matrix_power(step, count)[0].sum()
    return float(1.0 - stays)


def since(sums: Array, alarm: int) -> int:
    """Return the first of the deviates that led to an alarm: after the last sum that was zero.

    >>> import numpy as np
    >>> from rpim_opt.use.cusum import since
    >>> since(np.array([0.0, 1.5, 0.0, 2.0, 4.0]), 4)
    3
    """
    zeros = np.flatnonzero(sums[: alarm + 1] == 0)
    if not len(zeros):
        return 0
    return int(zeros[-1]) + 1
