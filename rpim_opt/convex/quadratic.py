"""Closed forms: squared loss and squared penalty, at any weight, from one singular value decomposition."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import qr

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.structure import Quadratic, identity
from rpim_opt.problem.linear import RANK_TOLERANCE, LinearModel


@dataclass(frozen=True, eq=False)
class Ridge:
    """Minimum of |A z - b|^2 + weight |L z - c|^2 over z, at every weight.

    With y = L z - c as unknowns, and what L does not see (y0) eliminated by projection, A turns into U diag(s) V' and
    the minimum is (Hansen 1998, Rank-Deficient and Discrete Ill-Posed Problems, sec. 2.3)::

        z(weight) = offset + B diag(s / (s^2 + weight)) beta,    beta = U'b

    Directions that neither A nor L see stay where the penalty's centre, or nominal, has them.

    Parameters
    ----------
    beta, s
        (p,) each; s below `RANK_TOLERANCE` times the largest are zero.
    B
        (n, p) the directions in z.
    offset
        (n,) z at infinite weight.
    perp
        Square of what no z explains.
    free
        (n, f) the seen directions that L leaves free, scaled such that free free' is their covariance.
    unseen
        (n, u) orthonormal: L leaves them free, and A does not see them.
    """

    beta: Array
    s: Array
    B: Array
    offset: Array
    perp: float
    free: Array
    unseen: Array

    @property
    def fixed(self) -> int:
        """How many directions the data alone decide, because the penalty leaves them free."""
        return self.free.shape[1]

    @cached_property
    def seen(self) -> np.ndarray:
        """Which of the p penalized directions the data see."""
        return self.s > 0

    @property
    def filters(self) -> tuple[Array, Array, float]:
        """beta^2 and s^2 of the seen directions, and what no weight explains."""
        seen = self.seen
        return self.beta[seen] ** 2, self.s[seen] ** 2, self.perp

    def minima(self, weights: Array) -> Array:
        """Return the minima (K, n) at weights (K,)."""
        gain = np.zeros((len(weights), len(self.s)))
        seen = self.seen
        gain[:, seen] = self.s[seen] * self.beta[seen] / (self.s[seen] ** 2 + weights[:, None])
        return self.offset + gain @ self.B.T

    def degrees_of_freedom(self, weight: float) -> float:
        """Return the trace of the influence matrix: free directions, and sum s^2 / (s^2 + weight)."""
        s2 = self.s[self.seen] ** 2
        return self.fixed + float(np.sum(s2 / (s2 + weight)))

    def noise(self, weight: float) -> Array:
        """Return the covariance (n, n) of the minimum for unit noise of b."""
        total = self.s**2 + weight
        by = np.divide(self.s**2, total**2, out=np.zeros_like(total), where=total > 0)
        return (self.B * by) @ self.B.T + self.free @ self.free.T

    def prior(self, weight: float) -> Array:
        """Return the mean square (n, n) of what the penalty holds back, if z is as large as it expects."""
        total = self.s**2 + weight
        by = np.divide(weight, total**2, out=np.zeros_like(total), where=total > 0)
        return (self.B * by) @ self.B.T

    def undecided(self, weight: float) -> Array:
        """Return the directions (n, u) that neither data nor penalty decide."""
        if weight > 0:
            return self.unseen
        return np.hstack([self.unseen, self.B[:, ~self.seen]])

    def hat_rows(self, A: Array) -> tuple[Array, Array]:
        """Return Q (m, p') and Q0 (m, f): at a weight the influence matrix is Q diag(s^2 / (s^2 + weight)) Q' + Q0 Q0'.

        Parameters
        ----------
        A
            (m, n) all rows, of which the decomposition may know the triangle alone.
        """
        seen = self.seen
        return A @ self.B[:, seen] / self.s[seen], A @ self.free


def ridge(model: LinearModel, penalty: Quadratic | None) -> Ridge:
    """Decompose a linear model and a squared penalty; without a penalty, unseen directions stay nominal."""
    R = model.triangle
    n = R.shape[1] - 1
    A, b = R[:n, :n], R[:n, n]
    T, N, start = _standard_form(penalty or identity(n), n)
    b = b - A @ start
    Q, kept, dropped = _free_directions(A, N)
    free = N @ kept
    A_y, b_y = A, b
    if T is not None:
        A_y = A @ T
    if free.size:
        A_y = A_y - Q @ (Q.T @ A_y)
        b_y = b - Q @ (Q.T @ b)
    if T is None:
        U, s, Vt = np.linalg.svd(A_y, full_matrices=False)
        B = Vt.T
        least = RANK_TOLERANCE * np.max(s, initial=0.0)
    else:
        U, s, Vt = _graded_svd(A_y)
        B = T @ Vt.T
        # In z, not in y: where L hardly holds a direction y is long, and s of the others small beside its s.
        least = RANK_TOLERANCE * np.linalg.norm(A, 2) * np.linalg.norm(B, axis=0)
    rounding = len(s) * float(np.finfo(float).eps) * np.max(s, initial=0.0)
    s = np.where((s > least) & (s > rounding), s, 0.0)
    beta = U.T @ b_y
    left = b_y - U[:, s > 0] @ beta[s > 0]
    if free.size:
        B = B - free @ (Q.T @ (A @ B))
        start = start + free @ (Q.T @ b)
    perp = float(R[n, n] ** 2 + left @ left)
    return Ridge(beta, s, B, start, perp, free, N @ dropped)


def _graded_svd(A: Array) -> tuple[Array, Array, Array]:
    """Return U, s, V' of a matrix whose columns may differ by many orders, the largest first: small s keep digits."""
    factors: Any = qr(A, mode="economic", pivoting=True)
    Q, R, order = factors
    U, s, Vt = np.linalg.svd(R, full_matrices=False)
    back = np.argsort(order)
    return Q @ U, s, Vt[:, back]


def _standard_form(penalty: Quadratic, n: int) -> tuple[Array | None, Array, Array]:
    """Return T (None for the identity), N and z0 with z = z0 + T y + N y0 and |L z - c|^2 = |y|^2 + const."""
    if penalty.diagonal:
        held = penalty.L > 0
        inverse = np.divide(1.0, penalty.L, out=np.zeros(n), where=held)
        z0 = inverse * penalty.c
        eye = np.eye(n)
        if (penalty.L == 1).all():
            return None, np.zeros((n, 0)), z0
        return eye[:, held] * inverse[held], eye[:, ~held], z0
    U, s, Vt = np.linalg.svd(penalty.L)
    rank = int(np.count_nonzero(s > RANK_TOLERANCE * np.max(s, initial=0.0)))
    T = Vt[:rank].T / s[:rank]
    return T, Vt[rank:].T, T @ (U[:, :rank].T @ penalty.c)


def _free_directions(A: Array, N: Array) -> tuple[Array, Array, Array]:
    """Return Q (k, f) spanning the seen part of A N, and in N's coordinates what is seen (scaled) and what is not."""
    if not N.size:
        return np.zeros((len(A), 0)), np.zeros((0, 0)), np.zeros((0, 0))
    U, s, Vt = np.linalg.svd(A @ N, full_matrices=True)
    rank = 0
    if s.size:
        rank = int(np.count_nonzero(s > RANK_TOLERANCE * max(s[0], np.linalg.norm(A, 2))))
    return U[:, :rank], Vt[:rank].T / s[:rank], Vt[rank:].T


def robot_alone(penalty: Quadratic, frames: np.ndarray) -> Quadratic:
    """Return what a penalty says of the robot's parameters whatever the frames (n,) are: they are left free.

    That is the marginal of the normal prior that it stands for: the Schur complement of its precision L'L.
    """
    if penalty.diagonal:
        return Quadratic(np.where(frames, 0.0, penalty.L), np.where(frames, 0.0, penalty.c))
    K = penalty.L.T @ penalty.L
    centre = np.linalg.lstsq(penalty.L, penalty.c, rcond=RANK_TOLERANCE)[0]
    rest = ~frames
    cross = K[np.ix_(rest, frames)]
    K_rest = K[np.ix_(rest, rest)] - cross @ np.linalg.pinv(K[np.ix_(frames, frames)], hermitian=True) @ cross.T
    values, vectors = np.linalg.eigh(K_rest)
    kept = values > RANK_TOLERANCE * np.max(values, initial=0.0)
    L = np.zeros((int(kept.sum()), len(frames)))
    L[:, rest] = (vectors[:, kept] * np.sqrt(values[kept])).T
    return Quadratic(L, L @ centre)


def ridge_within(model: LinearModel, penalty: Quadratic | None, moves: Array, z: Array) -> Ridge:
    """Decompose a linear model and a squared penalty where z (n,) may move in some directions alone.

    Parameters
    ----------
    model, penalty
        As for `ridge`.
    moves
        (n, k) orthonormal; z + moves y are the points that count, and covariances are conditional on them.
    z
        A point that meets the constraints.
    """
    form = penalty or identity(len(z))
    inside = ridge(
        replace(model, A=model.A @ moves, b=model.b - model.A @ z),
        Quadratic(form.matrix @ moves, form.c - form.matrix @ z),
    )
    return replace(
        inside,
        B=moves @ inside.B,
        offset=z + moves @ inside.offset,
        free=moves @ inside.free,
        unseen=moves @ inside.unseen,
    )
