"""Quadratic plus the largest of many linear functions, within linear bounds: minimum by a dual active set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import get_lapack_funcs

from rpim_opt.basics.arrays import Array

_gesv: Any
(_gesv,) = get_lapack_funcs(("gesv",), (np.empty(1),))

SLACK = 1e-13
"""By how much a function may exceed the largest, relative to the largest value."""
NEGATIVE = 1e-12
"""Multipliers above minus this are no reason to let go of a function with which a search begins."""
PARALLEL = 1e-12
"""Falls below this part of what lengths would allow are rounding."""


class Least(NamedTuple):
    """A minimum: the step d (p,), the largest value t there, multipliers (N,), and how many systems were solved."""

    d: Array
    t: float
    shares: Array
    solved: int


@dataclass(frozen=True, eq=False)
class Epigraph:
    """minimize  d'H d / 2 + g'd + t  subject to  v_k + G_k d <= s_k t,  s_k being 1, or 0 for a bound.

    The multipliers of those with s_k = 1 add up to one. Goldfarb and Idnani's method (1983, Math. Program. 27:1): the
    functions that are equal to t form a set whose multipliers stay nonnegative; the one that exceeds t most enters,
    and those leave whose multipliers vanish on the way. It begins with the set of a neighbour, which it hardly changes.

    Parameters
    ----------
    H, g
        (p, p) positive definite, and (p,).
    v, G, s
        (N,), (N, p) and (N,).
    """

    H: Array
    g: Array
    v: Array
    G: Array
    s: Array

    def minimum(self, start: np.ndarray, most: int) -> Least | None:
        """Return the minimum, begun with some functions; None where so many systems do not lead there.

        Parameters
        ----------
        start
            Numbers of the functions.
        most
            Systems of equations that may be solved.
        """
        search = _Search(self)
        if not search.begun(list(start)):
            return None
        scale = max(float(np.max(np.abs(self.v))), 1e-300)
        while search.solved < most:
            slack = self.v + self.G @ search.d - self.s * search.t
            slack[search.active] = -np.inf
            worst = int(np.argmax(slack))
            if slack[worst] <= SLACK * scale:
                return search.ended()
            if not search.entered(worst, float(slack[worst]), most):
                return None
        return None


class _Search:
    """The active functions with the point and the multipliers that belong to them."""

    def __init__(self, of: Epigraph):
        self.of = of
        self.p = len(of.g)
        self.active: list[int] = []
        self.mu = np.empty(0)
        self.d = np.zeros(self.p)
        self.t = 0.0
        self.solved = 0

    def _solution(self, top: Array, beside: float, below: Array) -> Array | None:
        """Solve for (d, t, multipliers) of the active functions."""
        p, k = self.p, len(self.active)
        K = np.zeros((p + 1 + k, p + 1 + k), order="F")
        K[:p, :p] = self.of.H
        G, s = self.of.G[self.active], self.of.s[self.active]
        K[p + 1 :, :p] = G
        K[:p, p + 1 :] = G.T
        K[p, p + 1 :] = K[p + 1 :, p] = -s
        self.solved += 1
        found, failed = _gesv(K, np.concatenate([top, [beside], below]), overwrite_a=1)[2:]
        if failed or not np.isfinite(found).all():
            return None
        return found

    def _settled(self) -> bool:
        """Put point and multipliers where the active functions have them."""
        found = self._solution(-self.of.g, -1.0, -self.of.v[self.active])
        if found is None:
            return False
        self.d, self.t, self.mu = found[: self.p], float(found[self.p]), found[self.p + 1 :]
        return True

    def begun(self, start: list[int]) -> bool:
        """Begin with those of a set whose multipliers are positive, or with the largest function alone."""
        self.active = start
        if len(start) > self.p + 1 or not np.any(self.of.s[start]) or not self._settled():
            self.active = [int(np.argmax(np.where(self.of.s > 0, self.of.v, -np.inf)))]
            return self._settled()
        while np.min(self.mu) < -NEGATIVE:
            self.active = [k for k, mu in zip(self.active, self.mu, strict=True) if mu > 0]
            if not self._settled():
                return False
        return True

    def entered(self, j: int, slack: float, most: int) -> bool:
        """Let a function that exceeds the largest enter; whether it could."""
        of = self.of
        mu_j = 0.0
        while self.solved < most:
            change = self._solution(-of.G[j], float(of.s[j]), np.zeros(len(self.active)))
            if change is None:
                return False
            d, t, mu = change[: self.p], float(change[self.p]), change[self.p + 1 :]
            fall = float(of.s[j] * t - of.G[j] @ d)
            if len(self.active) > self.p or fall <= PARALLEL * float(np.linalg.norm(of.G[j]) * np.linalg.norm(d)):
                fall = 0.0
            whole = slack / fall if fall > 0 else np.inf
            falling = mu < 0
            ratios = np.full(len(mu), np.inf)
            ratios[falling] = np.maximum(self.mu[falling], 0.0) / -mu[falling]
            last = int(np.argmin(ratios))
            step = min(whole, float(ratios[last]))
            if not np.isfinite(step):
                return False
            self.d = self.d + step * d
            self.t += step * t
            self.mu = self.mu + step * mu
            mu_j += step
            slack -= step * fall
            if whole <= ratios[last]:
                break
            del self.active[last]
            self.mu = np.delete(self.mu, last)
            if not np.any(of.s[self.active]):  # it is the largest alone
                self.t += slack
                break
        self.active.append(j)
        self.mu = np.append(self.mu, mu_j)
        return True

    def ended(self) -> Least:
        """Return point and multipliers, free of what rounding has left on the way."""
        self._settled()
        shares = np.zeros(len(self.of.v))
        shares[self.active] = np.maximum(self.mu, 0.0)
        return Least(self.d, self.t, shares, self.solved)
