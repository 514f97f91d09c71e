"""Quadratic forms recognized in CVXPY's canonical form, and ridge regression at any weight by one SVD."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from scipy.linalg import qr

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.expressions import cp
from rpim_opt.problem.linear import RANK_TOLERANCE, LinearModel, svd

DENSE = 2000
"""Largest number of variables of a quadratic with mixed products that is factored."""
ROUNDING = 1e-12
"""Eigenvalues and slopes below this part of the largest are rounding errors."""


@dataclass(frozen=True, eq=False)
class Quadratic:
    """A convex quadratic f(v) = |L v - c|^2 + constant of v (n,); L is (k, n), or (n,) where it is diagonal."""

    L: Array
    c: Array
    constant: float = 0.0

    @property
    def diagonal(self) -> bool:
        """Whether f is a sum over the components of v."""
        return self.L.ndim == 1

    @property
    def matrix(self) -> Array:
        """L as a matrix (k, n)."""
        return np.diag(self.L) if self.diagonal else self.L

    def times(self, v: Array) -> Array:
        """Return L v, for v (n,) or a matrix (n, j)."""
        return (self.L * v.T).T if self.diagonal else self.L @ v

    @property
    def size(self) -> float:
        """Mean of |L e|^2 per squared term, for e of unit noise."""
        rows = self.L**2
        if not self.diagonal:
            rows = np.sum(rows, axis=1)
        return float(np.mean(rows[rows > 0]))

    def value(self, v: Array) -> float:
        """Return f(v)."""
        residual = self.times(v) - self.c
        return float(residual @ residual) + self.constant


def identity(n: int) -> Quadratic:
    """Return |v|^2, the quadratic form that `cp.sum_squares` declares."""
    return Quadratic(np.ones(n), np.zeros(n))


def quadratic(expression: Any, variable: cp.Variable) -> Quadratic | None:
    """Return an expression of one variable as a quadratic; None if it is not quadratic.

    In CVXPY's canonical form 1/2 x'P x + q'x with A x + s = b it is quadratic if all of s is zero (no inequality, no
    cone) and the equations determine the variables that CVXPY added.
    """
    if {v.id for v in expression.variables()} != {variable.id}:
        return None
    if not expression.is_quadratic() or expression.is_affine() or cp.huber in expression.atoms():
        return None  # affine expressions and huber are quadratic to CVXPY
    variable.save_value(None)  # atoms read their arguments' values, which may be stale
    data = cp.Problem(cp.Minimize(expression)).get_problem_data(cp.CLARABEL, solver_opts={})[0]
    if data.get("P") is None or data["dims"].zero != len(data["b"]) or data.get("lower_bounds") is not None:
        return None
    reduced = _reduced(data, variable)
    if reduced is None:
        return None
    variable.value = np.zeros(variable.size)
    return _completed(*reduced, float(expression.value))


def _reduced(data: dict[str, Any], variable: cp.Variable) -> tuple[Any, Array] | None:
    """Return H (sparse) and g of 1/2 v'H v + g'v, with CVXPY's own variables eliminated."""
    start = data["param_prob"].var_id_to_col[variable.id]
    own = start + np.arange(variable.size)
    rest = np.setdiff1d(np.arange(len(data["c"])), own)
    P: Any = scipy.sparse.csr_array(data["P"])
    A: Any = scipy.sparse.csc_array(data["A"])
    if A.shape[0] != len(rest):
        return None
    H: Any = P[own][:, own]
    g = data["c"][own]
    if not len(rest):
        return H, g
    try:
        factors = scipy.sparse.linalg.splu(scipy.sparse.csc_matrix(A[:, rest]))
    except RuntimeError:  # singular: v does not determine them
        return None
    M = -scipy.sparse.csr_array(factors.solve(A[:, own].toarray()))
    d = factors.solve(np.asarray(data["b"], dtype=float))
    cross, inner = P[own][:, rest], P[rest][:, rest]
    H = H + cross @ M + M.T @ cross.T + M.T @ inner @ M
    g = g + cross @ d + M.T @ (data["c"][rest] + inner @ d)
    return H, g


def _completed(H: Any, g: Array, at_zero: float) -> Quadratic | None:
    """Complete the square of 1/2 v'H v + g'v + at_zero; None where it has no minimum, or is too large to factor."""
    H = scipy.sparse.coo_array(H)
    diagonal = not np.any(H.data[H.row != H.col])
    vectors: Any = None
    if diagonal:
        values, slope = np.bincount(H.row, H.data, minlength=len(g)) / 2, g
    elif len(g) > DENSE:
        return None
    else:  # sum values_i y_i^2 + slope_i y_i + at_zero in y = vectors'v
        values, vectors = np.linalg.eigh(H.toarray() / 2)
        slope = vectors.T @ g
    largest = float(np.max(values, initial=0.0))
    curved = values > (0.0 if diagonal else ROUNDING) * largest
    flat_slope = float(np.max(np.abs(slope[~curved]), initial=0.0))
    if largest <= 0 or np.min(values) < -ROUNDING * largest:
        return None
    if flat_slope > 1e-9 * max(float(np.max(np.abs(slope))), largest):
        return None  # linear in some direction: no minimum of its own
    root = np.sqrt(np.where(curved, values, 0.0))
    c = np.divide(-slope, 2 * root, out=np.zeros_like(root), where=curved)
    constant = at_zero - float(c @ c)
    if diagonal:
        return Quadratic(root, c, constant)
    return Quadratic((vectors[:, curved] * root[curved]).T, c[curved], constant)


# --- closed forms ---


@dataclass(frozen=True, eq=False)
class Ridge:
    """Minimum of |A z - b|^2 + weight |L z - c|^2 over z, at every weight.

    With y = L z - c as unknowns, and the directions y0 that L does not see eliminated by projection, A becomes U
    diag(s) V', and the minimum is (Hansen 1998, Rank-Deficient and Discrete Ill-Posed Problems, sec. 2.3)::

        z(weight) = offset + B diag(s / (s^2 + weight)) beta,    beta = U'b

    Directions that neither A nor L sees stay at the penalty's centre, or nominal. beta, s (p,), where s below
    `RANK_TOLERANCE` times the largest is zero; B (n, p); offset (n,) is z at infinite weight; perp the sum of squares
    that no z explains; free (n, f) spans the identifiable directions without penalty, with covariance free free'; null
    (n, u) the others.
    """

    beta: Array
    s: Array
    B: Array
    offset: Array
    perp: float
    free: Array
    null: Array

    @property
    def unpenalized(self) -> int:
        """Number of identifiable directions that the penalty leaves free."""
        return self.free.shape[1]

    @cached_property
    def identifiable(self) -> np.ndarray:
        """Which of the p penalized directions are identifiable."""
        return self.s > 0

    @property
    def filters(self) -> tuple[Array, Array, float]:
        """beta^2 and s^2 of the identifiable directions, and the residual sum of squares that no weight can reduce."""
        kept = self.identifiable
        return self.beta[kept] ** 2, self.s[kept] ** 2, self.perp

    def minima(self, weights: Array) -> Array:
        """Return the minima (K, n) at weights (K,)."""
        gain = np.zeros((len(weights), len(self.s)))
        kept = self.identifiable
        gain[:, kept] = self.s[kept] * self.beta[kept] / (self.s[kept] ** 2 + weights[:, None])
        return self.offset + gain @ self.B.T

    def degrees_of_freedom(self, weight: float) -> float:
        """Return the trace of the influence matrix."""
        s2 = self.s[self.identifiable] ** 2
        return self.unpenalized + float(np.sum(s2 / (s2 + weight)))

    def misfits(self, weights: Array) -> tuple[Array, Array]:
        """Return |A z - b|^2, without what the penalty's centre adds, and the degrees of freedom at weights (K,)."""
        beta2, s2, perp = self.filters
        g = weights[:, None] / (s2 + weights[:, None])
        return g**2 @ beta2 + perp, self.unpenalized + np.sum(1 - g, axis=1)

    def noise(self, weight: float) -> Array:
        """Return the covariance (n, n) of the minimum for unit noise of b."""
        total = self.s**2 + weight
        by = np.divide(self.s**2, total**2, out=np.zeros_like(total), where=total > 0)
        return (self.B * by) @ self.B.T + self.free @ self.free.T

    def prior(self, weight: float) -> Array:
        """Return the mean square (n, n) of the bias for deviations of the penalty's size."""
        total = self.s**2 + weight
        by = np.divide(weight, total**2, out=np.zeros_like(total), where=total > 0)
        return (self.B * by) @ self.B.T

    def undetermined(self, weight: float) -> Array:
        """Return the directions (n, u) that neither data nor penalty determines."""
        if weight > 0:
            return self.null
        return np.hstack([self.null, self.B[:, ~self.identifiable]])


def ridge(model: LinearModel, penalty: Quadratic | None) -> Ridge:
    """Decompose a linear model and a squared penalty; without a penalty, directions of the null space stay nominal."""
    R = model.qr_factor
    n = R.shape[1] - 1
    A, b = R[:n, :n], R[:n, n]
    # z = start + T y + N y0 with |L z - c|^2 = |y|^2 + const; T is None for the identity
    form = penalty or identity(n)
    T: Array | None = None
    if form.diagonal:
        held = form.L > 0
        inverse = np.divide(1.0, form.L, out=np.zeros(n), where=held)
        start, N = inverse * form.c, np.eye(n)[:, ~held]
        if not (form.L == 1).all():
            T = np.eye(n)[:, held] * inverse[held]
    else:
        U, s, Vt = np.linalg.svd(form.L)
        rank = int(np.count_nonzero(s > RANK_TOLERANCE * np.max(s, initial=0.0)))
        T, N = Vt[:rank].T / s[:rank], Vt[rank:].T
        start = T @ (U[:, :rank].T @ form.c)
    b = b - A @ start
    Q, free, null = np.zeros((n, 0)), N, N
    if N.size:  # identifiable directions that the penalty leaves free
        U, s, Vt = np.linalg.svd(A @ N, full_matrices=True)
        rank = int(np.count_nonzero(s > RANK_TOLERANCE * max(s[0], np.linalg.norm(A, 2))))
        Q, free, null = U[:, :rank], N @ (Vt[:rank].T / s[:rank]), N @ Vt[rank:].T
    b_y = b - Q @ (Q.T @ b)
    if T is None:
        U, s, Vt = svd(A)
        B = Vt.T
        least = RANK_TOLERANCE * np.max(s, initial=0.0)
    else:  # columns may differ by many orders: with the largest first, small s keep digits
        A_y = A @ T
        factors: Any = qr(A_y - Q @ (Q.T @ A_y), mode="economic", pivoting=True)
        U, s, Vt = np.linalg.svd(factors[1], full_matrices=False)
        U, Vt = factors[0] @ U, Vt[:, np.argsort(factors[2])]
        B = T @ Vt.T
        # in z, not in y: a direction with little penalty makes y long, and the other s small relative to its s
        least = RANK_TOLERANCE * np.linalg.norm(A, 2) * np.linalg.norm(B, axis=0)
    rounding = len(s) * float(np.finfo(float).eps) * np.max(s, initial=0.0)
    s = np.where((s > least) & (s > rounding), s, 0.0)
    beta = U.T @ b_y
    left = b_y - U[:, s > 0] @ beta[s > 0]
    if free.size:
        B = B - free @ (Q.T @ (A @ B))
        start = start + free @ (Q.T @ b)
    perp = float(R[n, n] ** 2 + left @ left)
    return Ridge(beta, s, B, start, perp, free, null)


def robot_alone(penalty: Quadratic, frames: np.ndarray) -> Quadratic:
    """Return the marginal of a normal prior with frames (n,) free: the Schur complement of its precision L'L."""
    if penalty.diagonal:
        return Quadratic(np.where(frames, 0.0, penalty.L), np.where(frames, 0.0, penalty.c))
    K = penalty.L.T @ penalty.L
    centre = np.linalg.lstsq(penalty.L, penalty.c, rcond=RANK_TOLERANCE)[0]
    rest = ~frames
    cross = K[np.ix_(rest, frames)]
    K_rest = K[np.ix_(rest, rest)] - cross @ np.linalg.pinv(K[np.ix_(frames, frames)], hermitian=True) @ cross.T
    values, vectors = np.linalg.eigh(K_rest)
    positive = values > RANK_TOLERANCE * np.max(values, initial=0.0)
    L = np.zeros((int(positive.sum()), len(frames)))
    L[:, rest] = (vectors[:, positive] * np.sqrt(values[positive])).T
    return Quadratic(L, L @ centre)


def ridge_within(model: LinearModel, penalty: Quadratic | None, moves: Array, z: Array) -> Ridge:
    """Decompose a linear model and a squared penalty over z + moves y, moves (n, k) orthonormal."""
    form = penalty or identity(len(z))
    inside = ridge(
        replace(model, A=model.A @ moves, b=model.b - model.A @ z),
        Quadratic(form.matrix @ moves, form.c - form.matrix @ z),
    )
    return replace(
        inside, B=moves @ inside.B, offset=z + moves @ inside.offset, free=moves @ inside.free, null=moves @ inside.null
    )
