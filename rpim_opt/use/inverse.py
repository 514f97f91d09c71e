"""Joint values that bring a robot nearest to its targets, within bounds, row by row."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.robot.mdh import Robot
from rpim_opt.use.arm import Arm

KEPT = 1e-10
"""Weight of a correction that moves nothing, relative to the largest squared singular value."""


SETTLED = 1e-10
SLIGHT = 1e-6
"""A row is done when its step is shorter [rad or m], or lowers the sum by a smaller part."""
PASSES = 50
"""Most steps of a row."""


class Sum(NamedTuple):
    """What is minimized at some steps D (N, n): the error (N, k), what counts of it, its slope A, and the sum."""

    error: Array
    counted: Array
    A: Array
    value: Array


class Aim(NamedTuple):
    """Rows and what they aim at: |W error|^2 + D' P D, with q = start + unit D, low <= q <= high.

    What the joints bear (N, l), targets y (N, c), start, low and high (N, n), units (n,), W (N, k, k) or
    None where all errors count alike, P (N, n, n).
    """

    arm: Arm
    load: Array
    y: Array
    start: Array
    low: Array
    high: Array
    unit: Array
    W: Array | None
    P: Array

    def q(self, rows: np.ndarray, D: Array) -> Array:
        """Return the joint values of some rows after steps D."""
        return np.clip(self.start[rows] + self.unit * D, self.low[rows], self.high[rows])

    def at(self, rows: np.ndarray, D: Array) -> Sum:
        """Return what is minimized in some rows after steps D."""
        _, error, J = self.arm.at(self.q(rows, D), self.load[rows], self.y[rows])
        counted = error
        A = J * self.unit
        if self.W is not None:
            counted = times(self.W[rows], error)
            A = self.W[rows] @ A
        value = np.sum(counted**2, axis=1) + np.sum(D * times(self.P[rows], D), axis=1)
        return Sum(error, counted, A, value)

    def descent(self, rows: np.ndarray, D: Array, here: Sum) -> Array:
        """Return half the negative slope (len(rows), n) of the sum."""
        return np.einsum("nki,nk->ni", here.A[rows], here.counted[rows]) - times(self.P[rows], D[rows])


def nearest(
    arm: Arm,
    load: Array,
    y: Array,
    start: Array,
    low: Array,
    high: Array,
    unit: Array,
    W: Array | None = None,
    P: Array | None = None,
) -> tuple[Array, Array, np.ndarray]:
    """Minimize |W error|^2 + D' P D from ``start``, q = start + unit D, within low and high, row by row.

    Gauss-Newton steps in the box, damped (Levenberg-Marquardt) in rows whose step does not lower the sum.

    Returns
    -------
    Joint values (N, n), their errors (N, k), and which joints a bound holds back (N, n).
    """
    N, n = start.shape
    if P is None:
        P = np.zeros((N, n, n))
    if W is not None and len(W) != N:
        W = None  # the same projection for all rows is the identity: see `attainable`
    low = np.broadcast_to(low, start.shape)
    high = np.broadcast_to(high, start.shape)
    aim = Aim(arm, load, y, start, low, high, unit, W, P)
    to_low = (low - start) / unit
    to_high = (high - start) / unit
    D = np.clip(0.0, to_low, to_high)
    damping = np.zeros(N)
    left = np.arange(N)
    here = aim.at(left, D)
    for _ in range(PASSES):
        if not len(left):
            break
        g = aim.descent(left, D, here)
        step = _boxed(_curvature(aim, here, left, damping), g, to_low[left] - D[left], to_high[left] - D[left])
        tried = aim.at(left, D[left] + step)
        better = tried.value <= here.value[left] * (1 + 1e-14) + 1e-20  # below that it is rounding
        rows = left[better]
        D[rows] += step[better]
        for old, new in zip(here, tried, strict=True):
            old[rows] = new[better]
        damping[rows] = np.where(damping[rows] > 1e-6, damping[rows] / 10, 0.0)
        damping[left[~better]] = np.maximum(10 * damping[left[~better]], 1e-3)
        far = (np.abs(step).max(axis=1) > SETTLED) & (np.sum(step * g, axis=1) > SLIGHT * here.value[left])
        left = left[far & (here.value[left] > 1e-24)]
    every = np.arange(N)
    g = aim.descent(every, D, here)
    held = ((to_low >= D) & (g < 0)) | ((to_high <= D) & (g > 0))
    return aim.q(every, D), here.error, held


def _curvature(aim: Aim, here: Sum, rows: np.ndarray, damping: Array) -> Array:
    """Return the damped Gauss-Newton matrices (len(rows), n, n); a trace of damping keeps every one regular."""
    A = here.A[rows]
    H = A.transpose(0, 2, 1) @ A + aim.P[rows]
    diagonal = np.einsum("nii->ni", H)
    diagonal += damping[rows, None] * diagonal + 1e-14 * diagonal.mean(axis=1, keepdims=True) + 1e-300
    return H


def _boxed(H: Array, g: Array, low: Array, high: Array) -> Array:
    """Return steps d (N, n) that minimize d'Hd/2 - g'd within low <= 0 <= high, nearly.

    Entries at a bound that the slope pushes out stay; those that leave the box are set on its border and the
    others solved anew, until none leaves. Which bounds hold in the end the next step's slope decides.
    """
    n = g.shape[1]
    free = ~(((low >= 0) & (g < 0)) | ((high <= 0) & (g > 0)))
    step = np.zeros_like(g)
    rows = np.arange(len(g))
    for _ in range(n + 1):
        f = free[rows]
        pairs = f[:, :, None] & f[:, None, :]
        fixed = np.where(f, 0.0, step[rows])
        rest = np.where(f, g[rows] - np.einsum("nij,nj->ni", H[rows], fixed), 0.0)
        solved = np.linalg.solve(np.where(pairs, H[rows], np.eye(n)), rest[:, :, None])[:, :, 0]
        step[rows] = np.clip(np.where(f, solved, fixed), low[rows], high[rows])
        out = f & ((solved < low[rows]) | (solved > high[rows]))
        free[rows] &= ~out
        rows = rows[out.any(axis=1)]
        if not len(rows):
            break
    return step


def ranges(robot: Robot, equations: int) -> Array:
    """Return what counts as one for every joint: the ranges where there are more joints than equations, else 1."""
    span = np.ptp(robot.limits, axis=1)
    unit = np.ones(robot.dof)
    if robot.dof > equations:
        span[~np.isfinite(span)] = 2 * np.pi
        for kind in set(robot.joint_types):
            alike = np.array([k == kind for k in robot.joint_types])
            unit[alike] = span[alike] / span[alike].min()
    return unit


def attainable(J: Array) -> Array:
    """Return matrices W (N or 1, k, k) that project errors on those that count, from Jacobians (N, k, n).

    With six joints or more, or positions alone, all do. With fewer position comes first: of the orientation counts what
    can be turned without moving the point, which makes as many equations as joints.
    """
    k, n = J.shape[1:]
    if n >= k or k == 3:
        return np.eye(k)[None]
    still = np.linalg.svd(J[:, :3])[2][:, 3:]
    U, s, _ = np.linalg.svd(J[:, 3:] @ still.transpose(0, 2, 1), full_matrices=False)
    U = U * (s > 1e-6)[:, None]
    W = np.tile(np.eye(k), (len(J), 1, 1))
    W[:, 3:, 3:] = U @ U.transpose(0, 2, 1)
    return W


def times(W: Array, vectors: Array) -> Array:
    """Return matrices (N, k, k) times vectors (N, k), row by row."""
    return (W @ vectors[:, :, None])[:, :, 0]


def pinned(A: Array, due: Array, largest: float) -> Array:
    """Return the weights P (N, n, n) of corrections.

    With A = U diag(s) V', the correction in direction v_i would be e_i / s_i, e = U' due; see `compensate`.
    """
    n = A.shape[2]
    U, s, Vt = np.linalg.svd(A, full_matrices=True)
    some = s.shape[1]
    e = np.zeros((len(A), n))
    e[:, :some] = np.einsum("nij,ni->nj", U, due)[:, :some]
    s = np.pad(s, ((0, 0), (0, n - some)))
    p = np.maximum((e / largest) ** 2 - s**2, 0.0)
    p += KEPT * s[:, :1] ** 2 * (s <= 1e-9 * s[:, :1])
    return np.einsum("nki,nk,nkj->nij", Vt, p, Vt)
