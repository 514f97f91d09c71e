"""What CVXPY's canonicalization says of a convex function: whether it is a quadratic, and which."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.atoms import cp

DENSE = 2000
"""Variables up to which a quadratic with products of different variables is factored."""
ROUNDING = 1e-12
"""Eigenvalues and slopes below this part of the largest are what rounding leaves of zero."""


@dataclass(frozen=True, eq=False)
class Quadratic:
    """A convex quadratic f(v) = |L v - c|^2 + constant of v (n,).

    Parameters
    ----------
    L
        (k, n); or (n,) where it is diagonal.
    c
        (k,).
    constant
        The smallest value.
    """

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
        if self.diagonal:
            return np.diag(self.L)
        return self.L

    def times(self, v: Array) -> Array:
        """Return L v, for v (n,) or a matrix (n, j)."""
        if not self.diagonal:
            return self.L @ v
        if v.ndim == 1:
            return self.L * v
        return self.L[:, None] * v

    @property
    def size(self) -> float:
        """Mean of |L e|^2 over the squares that it sums, for e of unit noise."""
        rows = self.L**2
        if not self.diagonal:
            rows = np.sum(rows, axis=1)
        return float(np.mean(rows[rows > 0]))

    def value(self, v: Array) -> float:
        """Return f(v)."""
        residual = self.times(v) - self.c
        return float(residual @ residual) + self.constant


def identity(n: int) -> Quadratic:
    """Return |v|^2, which `cp.sum_squares` declares to be."""
    return Quadratic(np.ones(n), np.zeros(n))


def quadratic(expression: Any, variable: cp.Variable) -> Quadratic | None:
    """Return the quadratic that an expression of one variable is; None where it is something else.

    CVXPY brings ``minimize expression`` to 1/2 x'P x + q'x with A x + s = b. It is a quadratic where all of s is zero
    (no inequality, no cone) and the equations give what CVXPY added from v: then that is put in.
    """
    if {v.id for v in expression.variables()} != {variable.id}:
        return None
    if not expression.is_quadratic() or cp.huber in expression.atoms():  # which CVXPY counts among quadratics
        return None
    variable.save_value(None)  # atoms ask for the value of what they are made of, and may get a stale one
    data = cp.Problem(cp.Minimize(expression)).get_problem_data(cp.CLARABEL, solver_opts={})[0]
    if data.get("P") is None or data["dims"].zero != len(data["b"]) or data.get("lower_bounds") is not None:
        return None
    reduced = _reduced(data, variable)
    if reduced is None:
        return None
    H, g = reduced
    variable.value = np.zeros(variable.size)
    return _completed(H, g, float(expression.value))


def _reduced(data: dict[str, Any], variable: cp.Variable) -> tuple[Any, Array] | None:
    """Return H (sparse) and g of 1/2 v'H v + g'v, with what CVXPY added put in from its equations."""
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
    except RuntimeError:  # singular: they do not follow from v
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
    off = H.row != H.col
    if not np.any(H.data[off]):
        diagonal = np.bincount(H.row, H.data, minlength=len(g)) / 2
        return _from_spectrum(diagonal, g, None, at_zero, 0.0)
    if len(g) > DENSE:
        return None
    values, vectors = np.linalg.eigh(H.toarray() / 2)
    return _from_spectrum(values, vectors.T @ g, vectors, at_zero)


def _from_spectrum(
    values: Array, slope: Array, vectors: Array | None, at_zero: float, rounding: float = ROUNDING
) -> Quadratic | None:
    """Return the quadratic sum values_i y_i^2 + slope_i y_i + at_zero in y = vectors'v.

    Values below ``rounding`` times the largest are zero. Those of a diagonal are known one by one: none is too small.
    """
    largest = float(np.max(values, initial=0.0))
    curved = values > rounding * largest
    flat_slope = float(np.max(np.abs(slope[~curved]), initial=0.0))
    if largest <= 0 or np.min(values) < -ROUNDING * largest:
        return None
    if flat_slope > 1e-9 * max(float(np.max(np.abs(slope))), largest):
        return None  # linear in some direction: no minimum of its own
    root = np.sqrt(np.where(curved, values, 0.0))
    c = np.divide(-slope, 2 * root, out=np.zeros_like(root), where=curved)
    constant = at_zero - float(c @ c)
    if vectors is None:
        return Quadratic(root, c, constant)
    return Quadratic((vectors[:, curved] * root[curved]).T, c[curved], constant)
