"""What CVXPY's canonicalization says of a penalty with kinks: which absolute values and norms it sums, over what."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.late import sparse
from rpim_opt.convex.atoms import cp

LARGE = 1000
"""Unknowns up to which a penalty is looked at: what is below is dense."""


@dataclass(frozen=True, eq=False)
class Kinks:
    """A convex function f(z) = 1/2 z'H z + g'z + constant + sum_k price_k |D_k z - c_k| of z (n,).

    Parameters
    ----------
    H, g, constant
        Its smooth part: (n, n), (n,) and a number.
    norms
        (D_k, c_k, price_k) of every norm: (n_k, n), (n_k,) and a number above zero. An absolute value has one row.
    """

    H: Array
    g: Array
    constant: float
    norms: tuple[tuple[Array, Array, float], ...]

    def value(self, z: Array) -> float:
        """Return f(z)."""
        smooth = float(0.5 * z @ self.H @ z + self.g @ z) + self.constant
        return smooth + sum(price * float(np.linalg.norm(D @ z - c)) for D, c, price in self.norms)


def kinks(expression: Any, variable: cp.Variable) -> Kinks | None:
    """Return the absolute values and norms that an expression of one variable sums; None where it is something else.

    CVXPY brings ``minimize expression`` to a program in v and variables t that it adds. Each t that is priced has two
    inequalities, t >= u(v) and t >= w(v), which is (u + w) / 2 + |u - w| / 2, or one cone, t >= |D v - c|. Where every
    t is one of these, the sum of what they are is the function.

    >>> import cvxpy as cp
    >>> from rpim_opt.convex.kinks import kinks
    >>> z = cp.Variable(3)
    >>> found = kinks(cp.norm1(z) + cp.norm(z[:2] - 1) + cp.sum_squares(z), z)
    >>> [len(D) for D, _, _ in found.norms], kinks(cp.norm_inf(z), z) is None
    ([1, 1, 1, 2], True)
    """
    if {v.id for v in expression.variables()} != {variable.id} or variable.size > LARGE:
        return None
    data = cp.Problem(cp.Minimize(expression)).get_problem_data(cp.CLARABEL, solver_opts={})[0]
    reduced = _Reduced.of(data, variable)
    if reduced is None:
        return None
    smooth = reduced.H, reduced.g.copy()
    norms = reduced.norms(smooth[1])
    if norms is None:
        return None
    variable.value = np.zeros(variable.size)
    at_zero = sum(price * float(np.linalg.norm(c)) for _, c, price in norms)
    return Kinks(*smooth, float(expression.value) - at_zero, _merged(norms))


def _merged(norms: list[tuple[Array, Array, float]]) -> tuple[tuple[Array, Array, float], ...]:
    """Return norms with absolute values of the same line, or of multiples of it, as one."""
    found: dict[Any, tuple[Array, Array, float]] = {}
    for place, (D, c, price) in enumerate(norms):
        if len(D) > 1:
            found[place] = (D, c, price)
            continue
        line = np.append(D[0], c)
        size = line[np.argmax(np.abs(line[:-1]))]
        key = tuple(np.round(line / size, 12) + 0.0)
        before = found.get(key)
        if before is None:
            found[key] = (D, c, price)
        else:
            found[key] = (
                before[0],
                before[1],
                before[2] + price * float(np.linalg.norm(D) / np.linalg.norm(before[0])),
            )
    return tuple(found.values())


@dataclass(frozen=True, eq=False)
class _Reduced:
    """A canonical program whose equations are used up: its cones' slacks are r - B v - E t, the t cost ``price``."""

    H: Array
    g: Array
    price: Array
    B: Array
    E: Array
    r: Array
    single: int
    cones: tuple[int, ...]

    @staticmethod
    def of(data: dict[str, Any], variable: cp.Variable) -> _Reduced | None:
        """Return the program without the variables that its equations tie to v; None where that is not what they do."""
        dims = data["dims"]
        if data.get("lower_bounds") is not None or dims.psd or dims.exp or dims.p3d or getattr(dims, "pnd", ()):
            return None
        count = len(data["c"])
        own = data["param_prob"].var_id_to_col[variable.id] + np.arange(variable.size)
        A = sparse.csr_array(data["A"])
        equations = A[: dims.zero]
        tied = np.setdiff1d(np.unique(equations.indices), own)
        free = np.setdiff1d(np.arange(count), np.concatenate([own, tied]))
        back = _substitution(equations, np.asarray(data["b"][: dims.zero], dtype=float), own, tied)
        if back is None:
            return None
        M, d = back
        n = len(own)
        lift = np.zeros((count, n))
        lift[own] = np.eye(n)
        lift[tied] = M
        shift = np.zeros(count)
        shift[tied] = d
        P = data.get("P")
        P = sparse.csr_array((count, count)) if P is None else sparse.csr_array(P)
        if P[free].nnz:
            return None  # what is added has a price of its own, which is no norm
        rest = A[dims.zero :]
        H = np.asarray(lift.T @ (P @ lift))
        g = lift.T @ (data["c"] + P @ shift)
        r = data["b"][dims.zero :] - rest @ shift
        E = rest[:, free].toarray()
        return _Reduced(H, g, data["c"][free], rest @ lift, E, r, dims.nonneg, tuple(dims.soc))

    def norms(self, g: Array) -> list[tuple[Array, Array, float]] | None:
        """Return the norms that the priced variables stand for, and add to g what they have of a line."""
        price = self.price.copy()
        starts = (self.single + np.cumsum([0, *self.cones]))[:-1]
        cone_of = self._cones(starts)
        if cone_of is None:
            return None
        found = self._absolute(price, cone_of, g)
        if found is None:
            return None
        for t, place in cone_of.items():
            if price[t] <= 0:
                return None
            top = starts[place]
            below = slice(top + 1, top + self.cones[place])
            found.append((-self.B[below], -self.r[below], float(price[t])))
        return found

    def _absolute(self, price: Array, cone_of: dict[int, int], g: Array) -> list[tuple[Array, Array, float]] | None:
        """Return the absolute values that variables bounded by no cone stand for; None where one is something else."""
        found: list[tuple[Array, Array, float]] = []
        used = np.zeros(self.single, dtype=bool)
        for t in range(len(price)):
            if t in cone_of:
                continue
            rows = np.flatnonzero(self.E[: self.single, t])
            if price[t] < 0 or not self._pair(t, rows, price, cone_of, g, found):
                return None
            used[rows] = True
        if not used.all():
            return None  # inequalities of v alone: a domain
        return found

    def _cones(self, starts: np.ndarray) -> dict[int, int] | None:
        """Return which cone bounds which added variable; None where a cone is no t >= |D v - c|."""
        found: dict[int, int] = {}
        for place, (start, size) in enumerate(zip(starts, self.cones, strict=True)):
            tops = np.flatnonzero(self.E[start])
            inner = self.E[start + 1 : start + size]
            plain = len(tops) == 1 and not self.B[start].any() and self.r[start] == 0 and not inner.any()
            if not plain or self.E[start, tops[0]] != -1 or tops[0] in found:
                return None
            found[int(tops[0])] = place
        return found

    def _pair(self, t: int, rows: np.ndarray, price: Array, cone_of: dict[int, int], g: Array, found: list) -> bool:
        """Enter what two inequalities t >= u, t >= w make; False where they are something else."""
        E = self.E[rows]
        others = np.delete(np.arange(E.shape[1]), t)
        if len(rows) != 2 or (E[:, t] != -1).any():
            return False
        crossed = others[np.any(E[:, others] != 0, axis=0)]
        u = self.B[rows]
        c = self.r[rows]
        if len(crossed):  # |s| of a norm s is s
            s = crossed[0]
            factors = E[:, s]
            alone = len(crossed) == 1 and s in cone_of and not u.any() and not c.any()
            if not alone or factors.max() != -factors.min():
                return False
            price[s] += price[t] * factors.max()
            return True
        g += price[t] * (u[0] + u[1]) / 2
        if price[t] > 0 and (u[0] != u[1]).any():
            found.append((((u[0] - u[1]) / 2)[None], ((c[0] - c[1]) / 2)[None], float(price[t])))
        return True


def _substitution(equations: Any, b: Array, own: np.ndarray, tied: np.ndarray) -> tuple[Array, Array] | None:
    """Return M and d with tied variables M v + d, as the equations have them; None where they do not follow from v."""
    if len(tied) != equations.shape[0]:
        return None
    if not len(tied):
        return np.zeros((0, len(own))), np.zeros(0)
    try:
        factors = sparse.linalg.splu(sparse.csc_matrix(equations[:, tied]))
    except RuntimeError:  # singular
        return None
    return -factors.solve(equations[:, own].toarray()), factors.solve(b)
