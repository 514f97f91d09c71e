"""Configurations left out of an estimate by one Newton step each, from the estimate of all."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.threads import on_all_cores
from rpim_opt.convex.left_out import Rows, by_size, solved, taken
from rpim_opt.convex.products import DEAR, TOGETHER, weighed_squares
from rpim_opt.convex.program import Estimate, Program

SMALL = 1e-5
"""Residuals below this part of the median are at a loss's kink, if it has one."""
NEARBY = 1e-4
"""How far apart, relative, the slopes are whose difference is the curvature."""
STIFF = 1e8
"""Curvature at a kink, in units of the median's."""
DROPPED = 1e-13
"""Curvatures of the objective below this part of the largest are rounding."""
ZERO = 1e-10
"""Components of an estimate below this part of the largest are at their kink."""
APART = 1e-9
"""How exactly the slope of a row depends on no other, relative."""


class Curved(NamedTuple):
    """A loss at residuals: slopes (m,), and the curvatures diag(rows) + extra_g u_g u_g' of each configuration.

    ``rows`` and the directions u are (m,), ``extra`` (N,).
    """

    slope: Array
    rows: Array
    extra: Array
    u: Array


@dataclass(frozen=True, eq=False)
class NewtonStep:
    """Leaves each configuration out of a program by one Newton step from the estimate of all.

    With slope s_g and curvature W_g of the loss over the residual r_g of a configuration, H the Hessian of the
    objective on the estimate's face, and S = A_g H^-1 A_g' (approximate leave-one-out: Beirami et al. 2017, NeurIPS;
    Wang et al. 2018, ICML)::

        r_g^- = r_g + S (1 - W_g S)^-1 s_g

    For squares it is exact where leaving out leaves the face as it is.

    Parameters
    ----------
    program
        With a loss that is a sum over rows or configurations and has slopes, and a penalty that is squared or has
        `faces`; `serves` says whether it is one.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> from rpim_opt.convex.left_out import solved_again
    >>> from rpim_opt.convex.newton_step import NewtonStep
    >>> problem = ro.load("position").problem
    >>> program = ro.convex.pose(ro.tikhonov, problem.linearize(np.zeros(len(problem.parameters.free))))
    >>> quick = NewtonStep(program).norms(program.solve(2.0))
    >>> slow = solved_again(program, np.array([2.0]), [np.array([k]) for k in range(40)])[0]
    >>> bool(np.allclose(quick, slow, rtol=1e-6))
    True
    """

    program: Program

    @cached_property
    def which(self) -> np.ndarray:
        """The place (m,) of each equation's configuration."""
        return self.program.model.members[0]

    @cached_property
    def parts(self) -> list[Rows]:
        """The rows of configurations, by their number of equations."""
        return by_size(self.program.model.group)

    @property
    def serves(self) -> bool:
        """Whether the program has the slopes and curvatures that a step needs."""
        program = self.program
        if program.squared_rows:
            return program.linear_or_split
        if program.loss_form is not None or program.penalty_form is None or program.box is None:
            return False
        return self._separate

    @cached_property
    def _separate(self) -> bool:
        """Whether the slope of each residual (or norm) depends on no other."""
        count = self._seen(self.program.model.b).size
        v = np.append(np.geomspace(0.1, 10.0, count // 2), np.geomspace(0.1, 10.0, count - count // 2))
        half = len(v) // 2
        one, other = self._slopes(v), self._slopes(np.append(v[:half], 2 * v[half:]))
        if one is None or other is None or self._by_equation_with_kink():
            return False
        return float(np.max(np.abs(one - other)[:half], initial=0.0)) <= APART * float(np.max(np.abs(one)))

    def _by_equation_with_kink(self) -> bool:
        """Whether the loss of an equation has a kink at zero: which ones are met exactly then changes in jumps."""
        if self.program.formulation.loss_over != "equation":
            return False
        count = len(self.program.model.b)
        right, left = self._at(np.full(count, SMALL)), self._at(np.full(count, -SMALL))
        return bool(np.any(np.abs(right - left) > 0.1 * np.abs(self._at(np.ones(count)))))

    def norms(self, estimate: Estimate) -> Array:
        """Return the norms (N,) of the residuals of the configurations, each left out."""
        model = self.program.model
        A, H = self._face(estimate)
        r = model.A @ estimate.z - model.b
        loss = self._loss(r, estimate)
        values, vectors = np.linalg.eigh(self._bent(A, loss) + H)
        root = np.zeros_like(values)
        kept = values > DROPPED * np.max(values, initial=0.0)
        root[kept] = 1 / np.sqrt(values[kept])
        norms = np.zeros(len(loss.extra))
        for some in self.parts:
            norms[some.configurations] = self._left(some, A, vectors * root, r, loss)
        return norms

    def _bent(self, A: Array, loss: Curved) -> Array:
        """Return the second derivative (p, p) of the loss along columns (m, p)."""
        gram = None
        if A is self.program.model.A and A.size >= DEAR:
            triangle = self.program.model.triangle[:, :-1]
            gram = triangle.T @ triangle
        bent = weighed_squares(A, np.maximum(loss.rows, 0.0), gram)
        if not loss.extra.any():
            return bent
        for some in self.parts:
            along = np.einsum("gk,gkp->gp", taken(loss.u, some.places), taken(A, some.places))
            bent += weighed_squares(along, loss.extra[some.configurations])
        return bent

    def _left(self, some: Rows, A: Array, B: Array, r: Array, loss: Curved) -> Array:
        """Return the norms (G,) of left-out residuals of some configurations; B B' is the inverse of the Hessian."""
        first = range(0, len(some.configurations), TOGETHER)
        blocks = [Rows(*(each[k : k + TOGETHER] for each in some)) for k in first]
        return np.concatenate(on_all_cores(lambda block: self._left_of(block, A, B, r, loss), blocks))

    def _left_of(self, some: Rows, A: Array, B: Array, r: Array, loss: Curved) -> Array:
        """Return the same of so many that a processor's cache holds them."""
        places = some.places
        k = places.shape[1]
        u, across = loss.u[places.T], loss.rows[places.T]
        X = (taken(A, places).reshape(places.size, len(B)) @ B).reshape(*places.shape, len(B))
        S = np.empty((k, k, len(places)))
        for i, j in combinations_with_replacement(range(k), 2):
            S[i, j] = S[j, i] = np.einsum("gp,gp->g", X[:, i], X[:, j])
        W = np.eye(k)[:, :, None] * across + loss.extra[some.configurations] * u[:, None] * u
        # S (1 - W S)^-1 = (1 - S W)^-1 S
        M = np.repeat(np.eye(k)[:, :, None], len(places), axis=2)
        for j in range(k):
            M -= S[:, j, None] * W[j]
        change = solved(M, np.einsum("ijg,jg->ig", S, loss.slope[places.T]))
        return np.sqrt(np.sum((r[places.T] + change) ** 2, axis=0))

    # --- the penalty -----------------------------------------------------------------------------------------------

    def _face(self, estimate: Estimate) -> tuple[Array, Array]:
        """Return the columns (m, p) along which the estimate moves, and the penalty's Hessian (p, p) there."""
        program, weight = self.program, estimate.weight
        A, z = program.model.A, estimate.z
        faces, split = program.faces, program.split
        if faces is not None and split is not None:
            y = faces.snapped(split.y(z), ZERO)
            free = faces.free(y)
            H = faces.bend(y, weight)
            if split.T is not None:
                A = A @ split.T
            return A[:, free], H[np.ix_(free, free)]
        L = np.zeros((0, len(z)))
        if program.penalty_form is not None:
            L = program.penalty_form.matrix
        free = np.ones(len(z), dtype=bool)
        if program.box is not None:
            free = (z > program.box[0]) & (z < program.box[1])
        if free.all():
            return A, 2 * weight * L.T @ L
        H = 2 * weight * L[:, free].T @ L[:, free]
        return A[:, free], H

    # --- the loss --------------------------------------------------------------------------------------------------

    def _seen(self, r: Array) -> Array:
        """Return what the loss gets: residuals, or the configurations' norms."""
        if self.program.formulation.loss_over == "equation":
            return r
        return self.program.model.norms(r)

    def _slopes(self, v: Array) -> Array | None:
        loss = self.program.separated
        if loss is not None and loss.starts is not None:  # the same as CVXPY's, in fewer passes
            slope = loss.slope_of_norms(v)
        else:
            slope = self.program.row_slopes(v)
        if slope is None or len(slope) != len(v) or not np.isfinite(slope).all():
            return None
        return slope

    def _loss(self, r: Array, estimate: Estimate) -> Curved:
        """Return slopes and curvatures of the loss at residuals (m,)."""
        count = int(self.which.max()) + 1
        if self.program.squared_rows:
            return Curved(2 * r, np.full(len(r), 2.0), np.zeros(count), np.zeros(len(r)))
        v = self._seen(r)
        size = max(float(np.median(np.abs(v))), np.finfo(float).tiny)
        near = np.maximum(np.abs(v), SMALL * size) * np.where(v < 0, -1.0, 1.0)
        slope = self._at(near)
        bend = (self._at(near * (1 + NEARBY)) - self._at(near * (1 - NEARBY))) / (2 * NEARBY * near)
        bend = np.maximum(bend, 0.0)
        at_kink = (np.abs(v) <= SMALL * size) & (np.abs(slope) > 0.1 * float(np.median(np.abs(slope))))
        if self.program.formulation.loss_over == "equation":
            stiff = STIFF * float(np.median(np.abs(slope) / np.abs(near)))
            curved = Curved(slope, np.where(at_kink, stiff, bend), np.zeros(count), np.zeros(len(r)))
            held = at_kink
        else:
            across = slope / near
            stiff = STIFF * float(np.median(across))
            across = np.where(at_kink, stiff, across)
            u = r / np.maximum(v, np.finfo(float).tiny)[self.which]
            extra = np.where(at_kink, 0.0, bend - across)
            curved = Curved(slope[self.which] * u, across[self.which], extra, u)
            held = at_kink[self.which]
        if held.any():
            curved.slope[held] = self._balancing(curved.slope, held, estimate)
        return curved

    def _at(self, v: Array) -> Array:
        slope = self._slopes(v)
        if slope is None:
            return np.zeros_like(v)
        return slope

    def _balancing(self, slope: Array, held: np.ndarray, estimate: Estimate) -> Array:
        """Return the slopes of residuals at a kink: those that balance all others."""
        program, A = self.program, self.program.model.A
        pull = A[~held].T @ slope[~held]
        form: Any = program.penalty_form
        L = form.matrix
        pull = pull + 2 * estimate.weight * L.T @ (L @ estimate.z - form.c)
        return -np.linalg.lstsq(A[held].T, pull, rcond=None)[0]
