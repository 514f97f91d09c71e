"""What arms share and what is each one's own: variances of a hierarchy, by expectation and maximization."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rpim_opt.basics.arrays import Array

SHRUNKEN = 3.0
"""As many arms the spread that all parameters have in common counts for."""
EVEN = 1.0
"""Where nothing is known: the mean square of what arms share, over that of what is their own."""
HELD = 2.0
"""As many parameters that counts for."""
PASSES, SETTLED = 1000, 1e-6
"""Of expectation and maximization; relative change of the variances that ends them."""
SIZES = np.geomspace(0.03, 30.0, 41)
"""By which a prior may be too narrow or too wide, when arms are held against it."""


@dataclass(frozen=True, eq=False)
class Arm:
    """What the data of one arm say: ``rows u - values ~ N(0, I)`` of deviations u in generic widths.

    ``rows`` (p, p), ``values`` (p,).
    """

    label: str
    rows: Array
    values: Array

    def evidence(self, centre: Array, width: Array) -> float:
        """Return -2 ln likelihood of a prior of that centre and width (p,), at the size that fits best."""
        residual = self.values - self.rows @ centre
        spread = (self.rows * width**2) @ self.rows.T
        d, Q = np.linalg.eigh(spread)
        r2 = (Q.T @ residual) ** 2
        total = 1 + SIZES[:, None] ** 2 * np.maximum(d, 0)
        return float(np.min(np.sum(np.log(total) + r2 / total, axis=1)))


@dataclass(frozen=True, eq=False)
class Learned:
    """Centre and width (p,) of another arm, in generic widths, and the part of the mean square that arms share."""

    centre: Array
    width: Array
    share: float


def learned(arms: Sequence[Arm]) -> Learned:
    """Return what arms tell of another one, by expectation and maximization.

    >>> import numpy as np
    >>> from rpim_opt.convex.shared import Arm, learned
    >>> rng = np.random.default_rng(0)
    >>> deviations = np.array([1.0, -1.0]) + 0.1 * rng.standard_normal((50, 2))
    >>> found = learned([Arm("", 1e3 * np.eye(2), 1e3 * each) for each in deviations])
    >>> found.centre.round(1), found.width.round(1), round(found.share, 2)
    (array([ 1., -1.]), array([0.1, 0.1]), 0.98)
    """
    P = np.array([arm.rows.T @ arm.rows for arm in arms])
    q = np.array([arm.rows.T @ arm.values for arm in arms])
    K, n = q.shape
    s2 = np.full(n, 1 / (1 + EVEN))
    tau2, ratio = 1 / (1 + EVEN), EVEN
    for _ in range(PASSES):
        m, C_m, d2 = _expected(P, q, s2, ratio)
        m2 = m**2 + np.diag(C_m)
        before = np.append(s2, ratio)
        s2 = (SHRUNKEN * tau2 + d2.sum(axis=0) + m2 / ratio) / (SHRUNKEN + K + 1)
        tau2 = (n + HELD) / (np.sum(1 / s2) + HELD * (1 + EVEN))
        ratio = (float(np.sum(m2 / s2)) + HELD * EVEN) / (n + HELD)
        if np.max(np.abs(np.append(s2, ratio) / before - 1)) <= SETTLED:
            break
    m, C_m, _ = _expected(P, q, s2, ratio)
    return Learned(m, np.sqrt(s2 + np.diag(C_m)), ratio / (1 + ratio))


def _expected(P: Array, q: Array, s2: Array, ratio: float) -> tuple[Array, Array, Array]:
    """Return mean (n,) and covariance (n, n) of what arms share, and mean squares (K, n) of what is their own."""
    n = len(s2)
    s = np.sqrt(s2)
    eye = np.eye(n)
    left = np.linalg.inv(eye + s[:, None] * P * s)  # in units of s: what the data leave open of an arm's own part
    H = (eye - left) / np.outer(s, s)
    h = np.einsum("kij,kj->ki", left, s * q) / s
    C_m = np.linalg.inv(H.sum(axis=0) + np.diag(1 / (ratio * s2)))
    m = C_m @ h.sum(axis=0)
    C = left * np.outer(s, s)
    own = np.einsum("kij,kj->ki", C, q + m / s2) - m
    turned = C / s2 - eye
    variance = np.einsum("kii->ki", C) + np.einsum("kij,jl,kil->ki", turned, C_m, turned)
    return m, C_m, own**2 + variance
