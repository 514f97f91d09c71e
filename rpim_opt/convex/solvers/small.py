"""The small program: squares of n + 1 rows, a penalty and constraints; by an active set, or by Clarabel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from typing import Any

import numpy as np
from scipy.linalg import qr, solve_triangular

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.canonical import ATTEMPTS, SOLVED, Canonical, clarabel_settings

RANK = 1e-9
"""Singular values of a face below this part of the largest count as zero."""
DENSE = 4e5
"""Entries of the constraints' matrix up to which active sets are tried."""
CENTRED = 1e-10
"""Least weight of |z|^2, relative to the squares, of the point about which Clarabel's unknowns are counted."""
FACES = 8
"""Faces that are tried before Clarabel is asked for one."""


class Unsolved(RuntimeError):
    """A program that the solver does not solve; its argument is the solver's word."""


@dataclass(frozen=True, eq=False)
class Squares:
    """The quadratic function |R z - y|^2 + g'z; H = 2 R'R is never formed, whose condition is that of R squared.

    Parameters
    ----------
    R, y, g
        (n + 1, n), (n + 1,) and (n,).
    """

    R: Array
    y: Array
    g: Array

    @classmethod
    def of_rows(cls, A: Array, b: Array, g: Array | None = None) -> Squares:
        """Return the squares of rows (m, n) and (m,), reduced by QR."""
        n = A.shape[1]
        T = np.linalg.qr(np.column_stack([A, b]), mode="r")
        T = np.vstack([T, np.zeros((n + 1 - len(T), n + 1))])
        return cls(T[:, :n], T[:, n], np.zeros(n) if g is None else g)

    def damped(self, size: Array | None, centre: Array | None) -> Squares:
        """Return the squares with |size (z - centre)|^2 added, both (n,)."""
        if size is None or centre is None:
            return self
        return Squares.of_rows(np.vstack([self.R, np.diag(size)]), np.concatenate([self.y, size * centre]), self.g)

    def value(self, z: Array) -> float:
        """Return the function at z (n,)."""
        r = self.R @ z - self.y
        return float(r @ r + self.g @ z)


@dataclass(frozen=True, eq=False)
class Point:
    """A minimum: x (N,) of the penalty's form, the multipliers of its rows (m,), and the solver's iterations.

    ``rest`` are the unknowns of the exact loss, ``slope`` the multipliers of its link with the residuals.
    """

    x: Array
    dual: Array
    iterations: int = 0
    rest: Array | None = None
    slope: Array | None = None


class Small:
    """minimize |R z - y|^2 + g'z + loss(A z - b) + weight * penalty(z) subject to constraints(z).

    Parameters
    ----------
    penalty
        Penalty and constraints.
    rows
        Number of rows of R; 0 for none.
    loss
        Rows of a loss that are taken as they are, or None.
    sizes
        (N,) numbers of equations whose norms the loss gets; None where it gets equations.
    """

    def __init__(self, penalty: Canonical, rows: int, loss: Canonical | None = None, sizes: np.ndarray | None = None):
        self.penalty, self.rows, self.loss, self.sizes = penalty, rows, loss, sizes
        self.face = np.zeros(0, dtype=int)
        self.near = np.zeros(penalty.size)
        self._solver: Any = None

    def solve(self, squares: Squares | None, weight: float, A: Array | None = None, b: Array | None = None) -> Point:
        """Return the minimum; A (k, n) and b (k,) are the rows of the loss.

        Raises
        ------
        Unsolved
            Where there is none, or Clarabel does not find it.
        """
        p = self.penalty
        faces = self.loss is None and p.polyhedral and p.entries <= DENSE
        if faces and squares is not None:
            found = self._on_faces(squares, weight, self.face, self.near)
            if found is not None:
                return found
        point, slack = self._by_cones(squares, weight, A, b)
        if faces and squares is not None:
            tight = np.arange(p.zero, p.linear)
            face = tight[(point.dual > slack)[tight]]
            found = self._on_faces(squares, weight, face, point.x)
            if found is not None:
                return replace(found, iterations=point.iterations)
        return point

    # --- active set --------------------------------------------------------------------------------------------------

    def _on_faces(self, squares: Squares, weight: float, face: np.ndarray, near: Array) -> Point | None:
        """Return the minimum by a primal-dual active set: faces, until multipliers and slacks have the right signs."""
        p = self.penalty
        A = p.dense[0]
        inequalities = np.arange(p.zero, p.linear)
        seen: set[bytes] = set()
        for _ in range(FACES):
            if face.tobytes() in seen:
                return None
            seen.add(face.tobytes())
            active = np.concatenate([np.arange(p.zero), face])
            found = on_face(squares, weight, p, active, near)
            if found is None:
                return None
            x, multipliers = found
            slack = p.b[inequalities] - A[inequalities] @ x
            tight = np.isin(inequalities, face)
            dual = multipliers[p.zero :]
            rounding = 1e-9 * max(weight * np.abs(p.q).max(initial=0.0), np.abs(dual).max(initial=0.0))
            met = slack[~tight] >= -1e-11 * (1 + np.abs(p.b[inequalities][~tight]))
            if met.all() and (dual >= -rounding).all():
                self.face, self.near = face, x
                every = np.zeros(len(p.b))
                every[active] = multipliers
                return Point(x, every)
            keep = np.zeros(len(p.b), dtype=bool)
            keep[face[dual > 0]] = True
            keep[inequalities[~tight & (slack < 0)]] = True
            face = np.flatnonzero(keep)
        return None

    # --- Clarabel ----------------------------------------------------------------------------------------------------

    @cached_property
    def _data(self) -> _Data:
        return _Data(self)

    def _by_cones(
        self, squares: Squares | None, weight: float, A: Array | None, b: Array | None
    ) -> tuple[Point, Array]:
        """Return Clarabel's minimum, and the slacks of the penalty's rows."""
        clarabel = import_module("clarabel")  # a compiled module, without types
        d, k, p = self._data, self.rows, self.penalty
        x0 = np.zeros(p.size)  # tolerances are relative to the size of the unknowns: those are changes of a near point
        x0[p.at] = self._centre(squares, weight)
        matrix, bound = d.rows(squares, A, b, x0)
        P, q = d.objective(squares, weight, x0)
        residual = np.abs(bound[:k]).max(initial=0.0)
        scale = 1.0 / max(1.0, np.abs(q).max(), 1e-3 * weight, residual)  # tolerances are absolute below one
        P.data *= scale
        status = ""
        for settings in ATTEMPTS:
            if self._solver is None or settings:
                self._solver = clarabel.DefaultSolver(P, q * scale, matrix, bound, d.cones, clarabel_settings(settings))
            else:
                self._solver.update(P=P.data, q=q * scale, A=matrix.data, b=bound)
            found = self._solver.solve()
            status = str(found.status)
            if settings:
                self._solver = None
            if status in SOLVED:
                break
        else:
            raise Unsolved(status)
        x, z, s = np.array(found.x), np.array(found.z) / scale, np.array(found.s)
        x[: p.size] += x0
        self.near = x[: p.size]
        own = slice(k, k + len(p.b))
        rest = x[p.size + k :] if self.loss is not None else None
        slope = z[d.link] if self.loss is not None else None
        return Point(x[: p.size], z[own], int(found.iterations), rest, slope), s[own]

    def _centre(self, squares: Squares | None, weight: float) -> Array:
        """Return a point (n,) near the minimum: the last one, or that of the squares with some weight on |z|^2."""
        last = self.near[self.penalty.at]
        if squares is None or last.any():
            return last
        n = len(last)
        rows = np.vstack([squares.R, np.sqrt(weight + CENTRED * np.sum(squares.R**2)) * np.eye(n)])
        return np.asarray(np.linalg.lstsq(rows, np.concatenate([squares.y, np.zeros(n)]), rcond=None)[0], dtype=float)


class _Data:
    """Clarabel's data of a small program, whose numbers are replaced and whose places stay."""

    def __init__(self, small: Small):
        from scipy import sparse

        clarabel = import_module("clarabel")
        p, k, loss, sizes = small.penalty, small.rows, small.loss, small.sizes
        N = p.size
        m = 0
        if loss is not None:
            m = len(loss.at) if sizes is None else int(sizes.sum())
        size = N + k + (0 if loss is None else loss.size)
        # rows: R z - s = y | penalty and constraints | loss | link of the loss to the residuals
        places = [_dense(np.arange(k), p.at), (np.arange(k), N + np.arange(k)), _sparse(p.A, k, 0)]
        self._fixed = [-np.ones(k), sparse.coo_array(p.A).data]
        cones = ([clarabel.ZeroConeT(k)] if k else []) + p.linear_cones
        top = k + len(p.b)
        self.link = np.zeros(0, dtype=int)
        self._norms = sizes is not None
        if loss is not None:
            places.append(_sparse(loss.A, top, N + k))
            self._fixed.append(sparse.coo_array(loss.A).data)
            cones += loss.linear_cones
            top += len(loss.b)
            if sizes is None:
                link = own = np.arange(m)
                cones.append(clarabel.ZeroConeT(m))
            else:  # (v_k, r_k) in a second-order cone
                own = np.concatenate([[0], np.cumsum(sizes + 1)[:-1]])
                link = np.setdiff1d(np.arange(m + len(sizes)), own)
                cones += [clarabel.SecondOrderConeT(int(count) + 1) for count in sizes]
            self.link = top + link
            places += [_dense(self.link, p.at), (top + own, N + k + loss.at)]
            self._fixed.append(-np.ones(len(own)))
            top += m + (0 if sizes is None else len(sizes))
        self.cones = cones
        rows, columns = (np.concatenate([place[i] for place in places]).astype(int) for i in (0, 1))
        self._order = np.lexsort((rows, columns))
        ends = np.searchsorted(columns[self._order], np.arange(size + 1))
        self._matrix = sparse.csc_matrix((np.zeros(len(rows)), rows[self._order], ends), shape=(top, size))
        self._bound = np.zeros(top)
        self._bound[k : k + len(p.b)] = p.b
        if loss is not None:
            self._bound[k + len(p.b) :][: len(loss.b)] = loss.b
        self._k, self._at, self._A, self._b, self._full_P = k, p.at, p.A, p.b, p.P
        left = sparse.csc_array((size - N, size - N))
        penalty_P = sparse.block_diag([sparse.triu(p.P), left], format="csc")
        own_P = [sparse.csc_array((N, N)), 2.0 * sparse.eye_array(k)]
        if loss is not None:
            own_P.append(sparse.triu(loss.P))
        exact_P = sparse.block_diag(own_P, format="csc")
        union = (abs(penalty_P) + abs(exact_P)).tocsc()
        union.sort_indices()
        self._P = sparse.csc_matrix(union)
        self._P_parts = _at_places(union, penalty_P), _at_places(union, exact_P)
        self._q_parts = np.zeros(size), np.zeros(size)
        self._q_parts[0][:N] = p.q
        if loss is not None:
            self._q_parts[1][N + k :] = loss.q

    def rows(self, squares: Squares | None, A: Array | None, b: Array | None, x0: Array) -> tuple[Any, Array]:
        """Return matrix and bounds of all rows, for changes of x0 (N,)."""
        k, z0 = self._k, x0[self._at]
        bound = self._bound.copy()
        bound[k : k + len(self._b)] -= self._A @ x0
        values = [np.zeros(0) if squares is None else squares.R.ravel(), *self._fixed[:2]]
        if squares is not None:
            bound[:k] = squares.y - squares.R @ z0
        if A is not None and b is not None:
            sign = -1.0 if self._norms else 1.0
            values += [self._fixed[2], sign * A.ravel(), self._fixed[3]]
            bound[self.link] = sign * (b - A @ z0)
        self._matrix.data = np.concatenate(values)[self._order]
        return self._matrix, bound

    def objective(self, squares: Squares | None, weight: float, x0: Array) -> tuple[Any, Array]:
        """Return P and q, for changes of x0 (N,)."""
        q = weight * self._q_parts[0] + self._q_parts[1]
        q[: len(x0)] += weight * (self._full_P @ x0)
        if squares is not None:
            q[self._at] += squares.g
        self._P.data = weight * self._P_parts[0] + self._P_parts[1]
        return self._P, q


def nearest(p: Canonical, z: Array) -> Array | None:
    """Return the point (n,) of a form's constraints that is nearest to z (n,); None where Clarabel finds none."""
    from scipy import sparse

    clarabel = import_module("clarabel")
    n, N = len(z), p.size
    link = sparse.coo_array((-np.ones(n + 1), (np.arange(n + 1), np.append(N, p.at))), (n + 1, N + 1))
    A = sparse.vstack([sparse.hstack([sparse.coo_array(p.A), sparse.coo_array((len(p.b), 1))]), link])
    bound = np.concatenate([p.b, [0.0], -z])  # (t, x - z) in a second-order cone, the least t
    q = np.append(np.zeros(N), 1.0)
    cones = [*p.linear_cones, clarabel.SecondOrderConeT(n + 1)]
    for settings in ATTEMPTS:
        P = sparse.csc_matrix((N + 1, N + 1))
        found = clarabel.DefaultSolver(P, q, sparse.csc_matrix(A), bound, cones, clarabel_settings(settings)).solve()
        if str(found.status) in SOLVED:
            return np.array(found.x)[p.at]
    return None


def on_face(
    squares: Squares, weight: float, p: Canonical, active: np.ndarray, near: Array
) -> tuple[Array, Array] | None:
    """Return the minimum (N,) where some rows are equations A x = b, and their multipliers; None where there is none.

    Of several minima the nearest to ``near`` (N,). By the null space of the active rows, in corrected seminormal
    equations where that is all of the space.
    """
    A, b = p.dense[0][active], p.b[active]
    P, root = p.dense[1], p.root
    at, N = p.at, p.size

    def gradient(x: Array) -> Array:
        slope = weight * (P @ x + p.q)
        slope[at] += 2 * squares.R.T @ (squares.R @ x[at] - squares.y) + squares.g
        return slope

    if not len(b):
        R = np.zeros((len(squares.R), N))
        R[:, at] = np.sqrt(2) * squares.R
        L: Any = np.linalg.qr(np.vstack([R, np.sqrt(weight) * root]), mode="r")
        pivots = np.abs(np.diag(L))
        if len(L) >= N and pivots.min() > RANK * pivots.max():
            x = near
            for _ in range(3):
                x = x - solve_triangular(L, _transposed(L, gradient(x)))
            return x, np.zeros(0)
        Y, Z, T, order, rank = np.zeros((N, 0)), np.eye(N), np.zeros((0, 0)), np.zeros(0, dtype=int), 0
        x = near.copy()
    else:
        factors: Any = qr(A.T, pivoting=True)
        Q, T, order = factors
        pivots = np.abs(np.diag(T))
        rank = int((pivots > 1e-11 * pivots.max(initial=0.0)).sum())
        Y, Z, T = Q[:, :rank], Q[:, rank:], T[:rank, :rank]
        x = near + Y @ _transposed(T, (b - A @ near)[order[:rank]])
        if rank < len(b) and np.abs(A @ x - b).max() > 1e-9 * (1 + np.abs(b).max()):
            return None
    largest = np.abs(squares.R).max()
    reduced = np.vstack([np.sqrt(2) * squares.R @ Z[at], np.sqrt(weight) * root @ Z])
    slope = np.zeros(Z.shape[1])
    V = np.zeros((0, Z.shape[1]))
    if Z.shape[1]:
        _, values, V = np.linalg.svd(reduced, full_matrices=False)
        V = V[values > RANK * max(values.max(initial=0.0), 1e-3 * largest)]
        values = values[: len(V)]
        for _ in range(3):  # refined
            slope = Z.T @ gradient(x)
            with np.errstate(all="ignore"):  # no curvature: there is no minimum to be had by a formula
                x = x - Z @ (V.T @ (V @ slope / values**2))
            if not np.isfinite(x).all():
                return None
    rounding = 1e-14 * largest * max(np.abs(squares.R @ x[at]).max(), np.abs(squares.y).max())
    pull = 2 * squares.R.T @ squares.y - squares.g
    allowed = max(1e-9 * weight * np.abs(p.q).max(initial=0.0), 1e-14 * np.abs(pull).max(initial=0.0), rounding)
    if np.abs(slope - V.T @ (V @ slope)).max(initial=0.0) > allowed:
        return None  # unbounded on this face
    multipliers = np.zeros(len(b))
    if rank:
        multipliers[order[:rank]] = solve_triangular(T, -Y.T @ gradient(x))
    return x, multipliers


def _transposed(T: Array, b: Array) -> Array:
    """Return the solution of T'x = b with an upper triangle T."""
    return solve_triangular(T.T, b, lower=True)


def _dense(rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.repeat(rows, len(columns)), np.tile(columns, len(rows))


def _sparse(M: Any, row: int, column: int) -> tuple[np.ndarray, np.ndarray]:
    from scipy import sparse

    M = sparse.coo_array(M)
    return M.row + row, M.col + column


def _at_places(pattern: Any, M: Any) -> Array:
    """Return the numbers of M at the places of a pattern."""
    from scipy import sparse

    places = sparse.coo_array(pattern)
    if not places.nnz:
        return np.zeros(0)
    return np.asarray(sparse.csr_array(M)[places.row, places.col]).ravel()
