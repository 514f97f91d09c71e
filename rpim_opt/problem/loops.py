"""Closed loops of base, flange, tool and instrument, linear in rotations' entries, translations and a scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError

RIDGE = 1e-6
"""How certain an expected translation is at least, in units of all positions together: what they do not show stays."""
SINGULAR = 1e-13


@dataclass(frozen=True, eq=False)
class Turns:
    """Orientations of measurements B_i = Z A_i X, up to their errors: A_i'A_j and B_i'B_j turn by the same angle.

    Parameters
    ----------
    first, second
        (N, 3, 3) A_i and B_i.
    sigma
        (N,) standard deviations of B_i [rad].
    group
        (N,) numbers of what has the same Z and X; negative where the orientation was not measured.
    """

    first: Array
    second: Array
    sigma: Array
    group: np.ndarray


@dataclass(frozen=True, eq=False)
class Loops:
    """Residuals J_i v of measurements, v = (translations, scale, 1, vec R_1, ..., vec R_k), rotations' rows first.

    Parameters
    ----------
    rows
        (N, m, n) J_i, each residual in units of its standard deviation.
    prior
        (p, n) residuals of what is expected of translations.
    linear
        How many of the n are translations and the scale: they are eliminated exactly.
    freedom
        (N,) degrees of freedom of a measurement: 3 for a position, 6 for a pose.
    shared
        How many of the rotations, the first ones, others have products with; the others have none among themselves.
    turns
        What does not depend on the unknowns.
    """

    rows: Array
    prior: Array
    linear: int
    freedom: Array
    shared: int
    turns: Turns

    @property
    def unknowns(self) -> int:
        """How many numbers are sought: three a rotation."""
        n = self.rows.shape[2] - 1 - self.linear
        return self.linear + n // 3

    def triangle(self, weights: Array) -> Array:
        """Return T (n, n), upper, with |T v|^2 = sum_i weights_i |J_i v|^2 + |prior v|^2."""
        n = self.rows.shape[2]
        rows = (np.sqrt(weights)[:, None, None] * self.rows).reshape(-1, n)
        stacked = np.vstack([rows, self.prior, np.zeros((n, n))])
        return np.asarray(np.linalg.qr(stacked, mode="r"))

    def squares(self, v: Array) -> Array:
        """Return |J_i v|^2 (N,)."""
        return np.asarray(np.sum((self.rows @ v) ** 2, axis=1))

    def form(self, triangle: Array) -> Array:
        """Return L (n-linear, n-linear), with |L x|^2 the least over translations and scale (a Schur complement)."""
        pivots = np.abs(np.diag(triangle)[: self.linear])
        if pivots.min() <= SINGULAR * pivots.max():
            raise InputError("poses", "places that do not determine translations and scale", "places that differ")
        return triangle[self.linear :, self.linear :]

    def completed(self, triangle: Array, x: Array) -> Array:
        """Return v (n,) with the translations and the scale that are best for x."""
        T = triangle[: self.linear]
        y = solve_triangular(T[:, : self.linear], -T[:, self.linear :] @ x)
        return np.concatenate([np.asarray(y, dtype=float), x])


@dataclass(frozen=True, eq=False)
class Seen:
    """What closes the loops ``measured = base flange tool``.

    Parameters
    ----------
    flange
        (N, 4, 4) in the robot's base.
    measured
        (N, 4, 4) in an instrument's frame.
    turned
        (N,) whether the orientation was measured, too.
    instrument, marker
        (N,) numbers of what saw and what was seen, from 0.
    sigma
        (N, 2) standard deviations of a position [m] and an orientation [rad].
    expected
        (M, 3) where the markers are expected in the flange frame [m].
    spread
        Standard deviation of that [m]; may be infinite.
    """

    flange: Array
    measured: Array
    turned: np.ndarray
    instrument: np.ndarray
    marker: np.ndarray
    sigma: Array
    expected: Array
    spread: float


def of_poses(seen: Seen, scaled: bool) -> Loops:
    """Return the loops of bases Z and tools X, several of either.

    ::

        (Z_R' y - A_R t - A_t - u) / sigma_position,    t = X_t,  u = Z_R' Z_t
        (B_R X_R' - Z_R A_R) / (sqrt(2) sigma_orientation)    where the orientation was measured

    of the flange A and the measured B with its position y. For an unknown scale s of the instrument's lengths, both
    sides are in its unit: A_t / s, t / s and u / s. The norm of the second is the angle between the two, up to third
    order. Rotations are those of the bases Z_R, then X_R' of the tools that were measured to turn.
    """
    N = len(seen.flange)
    bases = int(seen.instrument.max()) + 1
    tools = len(seen.expected)
    turning = np.unique(seen.marker[seen.turned])
    linear = 3 * (tools + bases) + scaled
    one = linear
    lengths = 1 / seen.sigma[:, 0]
    angles = seen.turned / (np.sqrt(2) * seen.sigma[:, 1])
    J = np.zeros((N, 12, linear + 1 + 9 * (bases + len(turning))))
    each = np.arange(N)
    A = seen.flange[:, :3, :3]
    B = seen.measured[:, :3, :3]
    eye = np.eye(3)
    robot = linear - 1 if scaled else one
    J[:, :3, robot] = -seen.flange[:, :3, 3] * lengths[:, None]
    first = one + 1 + 9 * seen.instrument
    last = one + 1 + 9 * (bases + np.searchsorted(turning, seen.marker))  # of those turned
    for a in range(3):
        J[each, a, 3 * (tools + seen.instrument) + a] = -lengths
        for b in range(3):
            J[each, a, 3 * seen.marker + b] = -A[:, a, b] * lengths
            # (Z_R' y)_a = sum_b (Z_R)_ba y_b
            J[each, a, first + 3 * b + a] = seen.measured[:, b, 3] * lengths
    of_base = np.einsum("ai,njb->nabij", eye, A).reshape(N, 9, 9)
    of_tool = np.einsum("nai,bj->nabij", B, eye).reshape(N, 9, 9)
    at = np.flatnonzero(seen.turned)
    for k in range(9):
        J[at, 3:, first[at] + k] = -of_base[at, :, k] * angles[at, None]
        J[at, 3:, last[at] + k] = of_tool[at, :, k] * angles[at, None]
    weak = RIDGE * float(np.sqrt(np.sum(lengths**2)))
    prior = _expected(seen.expected, max(1 / seen.spread, weak), robot, J.shape[2])
    group = np.where(seen.turned, seen.instrument * tools + seen.marker, -1)
    turns = Turns(A, B, seen.sigma[:, 1], group)
    return Loops(J, prior, linear, np.where(seen.turned, 6, 3), bases, turns)


def of_motions(A: Array, B: Array, sigma: Array, expected: Array, spread: float, scaled: bool) -> Loops:
    """Return the loops A X = X B of motions (N, 4, 4), with X_R the only rotation.

    ::

        (X_R B_t - A_R t + t - A_t) / sigma_position,    t = X_t
        (A_R X_R - X_R B_R) / (sqrt(2) sigma_orientation)

    For an unknown scale s of the lengths in B: A_t / s and t / s.
    """
    N = len(A)
    linear = 3 + scaled
    J = np.zeros((N, 12, linear + 10))
    robot = linear - 1 if scaled else linear
    eye = np.eye(3)
    J[:, :3, :3] = eye - A[:, :3, :3]
    J[:, :3, robot] -= A[:, :3, 3]
    J[:, :3, linear + 1 :] = np.einsum("ai,nj->naij", eye, B[:, :3, 3]).reshape(N, 3, 9)
    left = np.einsum("nai,bj->nabij", A[:, :3, :3], eye)
    right = np.einsum("ai,njb->nabij", eye, B[:, :3, :3])
    J[:, 3:, linear + 1 :] = (left - right).reshape(N, 9, 9)
    J[:, :3] /= sigma[:, 0, None, None]
    J[:, 3:] /= np.sqrt(2) * sigma[:, 1, None, None]
    weak = RIDGE * float(np.sqrt(np.sum(sigma[:, 0] ** -2)))
    prior = _expected(expected[None], max(1 / spread, weak), robot, J.shape[2])
    turns = Turns(A[:, :3, :3], B[:, :3, :3], sigma[:, 1], np.zeros(N, dtype=int))
    return Loops(J, prior, linear, np.full(N, 6), 1, turns)


def _expected(points: Array, certainty: float, robot: int, n: int) -> Array:
    """Return the residuals (p, n) of translations, the first of v, that are expected at points."""
    prior = np.zeros((points.size, n))
    prior[:, : points.size] = certainty * np.eye(points.size)
    prior[:, robot] = -certainty * points.ravel()
    return prior
