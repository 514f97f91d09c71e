"""Loss, penalty and constraints on one linear model: their structure, their values, and how well a point meets them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.shown import Brief
from rpim_opt.convex import feasible
from rpim_opt.convex.coordinates import Coordinates, coordinates
from rpim_opt.convex.faces import Faces
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.largest import Largest
from rpim_opt.convex.posed import Posed
from rpim_opt.convex.quadratic import Ridge, ridge
from rpim_opt.convex.separated import Separated
from rpim_opt.convex.split import Split
from rpim_opt.convex.structure import Quadratic
from rpim_opt.convex.trust import Trusted, kept_equations, outlying
from rpim_opt.problem.linear import LinearModel


class Damping(NamedTuple):
    """|size (z - centre)|^2, added to the objective: Levenberg's and Marquardt's term. Both (n,)."""

    centre: Array
    size: Array


@dataclass(frozen=True, eq=False, repr=False)
class Objective(Brief):
    """What a formulation makes of a linear model.

    Parameters
    ----------
    formulation, model
        What is stated, and the equations A z ~ b.
    """

    formulation: Formulation
    model: LinearModel
    _posed: Posed

    # --- structure ---------------------------------------------------------------------------------------------

    def _short(self) -> str:
        return f"'{self.formulation.name}' on {self.model._short()}"

    @property
    def loss_form(self) -> Quadratic | None:
        """The quadratic of the residual that the loss is; None where it is something else."""
        return self._posed.loss_form

    @property
    def penalty_form(self) -> Quadratic | None:
        """The quadratic |L z - c|^2 that the penalty is; None where it is something else, or there is none."""
        return self._posed.penalty_form

    @property
    def linear_penalty(self) -> bool:
        """Whether the penalty is quadratic, or there is none: the estimate is then linear in the data."""
        return self.formulation.penalty is None or self.penalty_form is not None

    @property
    def quadratic(self) -> bool:
        """Whether loss and penalty are quadratics, without ``largest``."""
        return self.loss_form is not None and self.linear_penalty

    @property
    def constrained(self) -> bool:
        """Whether there are constraints, or ``largest`` is one."""
        return self._posed.constrained

    @property
    def predicts(self) -> bool:
        """Whether constraints asked for positions, which are linear about some point."""
        return self._posed.predicts

    @property
    def inner(self) -> bool:
        """Whether loss or penalty have variables of their own."""
        return bool(self._posed.inner)

    @property
    def closed_form(self) -> bool:
        """Whether every solution on the path is a formula in the singular values (Tikhonov, least squares).

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("paper_arm").problem
        >>> model = problem.linearize(np.zeros(len(problem.parameters.free)))
        >>> for stated in (ro.tikhonov, ro.bounded, ro.lasso, ro.robust):
        ...     p = ro.convex.pose(stated, model)
        ...     print(f"{stated.name:17}", p.closed_form, p.quadratic, p.linear_penalty, p.constrained)
        Tikhonov          True True True False
        bounded Tikhonov  False True True True
        lasso             False False False False
        Huber             False False True False
        >>> lower, upper = ro.convex.pose(ro.bounded, model).box
        >>> float(upper.max())  # in units of the scales
        10.0
        """
        return self.quadratic and not self.constrained

    @property
    def box(self) -> tuple[Array, Array] | None:
        """Lower and upper bounds (n,) of z, infinite where there is none; None where a constraint is no `Box`."""
        return self._posed.box

    @cached_property
    def squared(self) -> LinearModel:
        """The equations whose squares a quadratic loss sums: |L (A z - b) - c|^2.

        Raises
        ------
        InputError
            For another loss.
        """
        form = self.loss_form
        if form is None:
            raise InputError(f"formulation '{self.formulation.name}'", "a loss that is no square", "a squared loss")
        if form.diagonal and (form.L == 1).all() and not form.c.any():
            return self.model
        A, b = form.times(self.model.A), form.times(self.model.b) + form.c
        group = self.model.group
        if form.diagonal:
            counts = form.L > 0  # an equation without weight is none
            A, b, group = A[counts], b[counts], group[counts]
        else:
            group = np.zeros(len(b), dtype=int)  # its rows mix configurations
        return replace(self.model, A=A, b=b, group=group, offset=self.model.offset + form.constant)

    @cached_property
    def ridge(self) -> Ridge:
        """The closed form of a program with quadratic loss and penalty, its constraints left out.

        >>> import cvxpy as cp
        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> mine = ro.Formulation("about one", penalty=lambda z: cp.sum_squares(2 * (z - 1)))
        >>> problem = ro.load("position").problem
        >>> program = ro.convex.pose(mine, problem.linearize(np.zeros(len(problem.parameters.free))))
        >>> program.penalty_form.value(np.zeros(34)), program.loss_form.diagonal, program.squared.equations
        (136.0, True, 120)
        >>> round(program.ridge.degrees_of_freedom(1.0), 1)
        26.1
        """
        return ridge(self.squared, self.penalty_form)

    @cached_property
    def faces(self) -> Faces | None:
        """The program in unknowns in which its penalty has its kinks at zero; None where it is no such program.

        >>> import cvxpy as cp
        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> model = problem.linearize(np.zeros(len(problem.parameters.free)))
        >>> mine = ro.Formulation("mine", penalty=lambda z: cp.norm1(z[:20]) + cp.norm(z[20:]))
        >>> ro.convex.pose(mine, model).faces.groups, ro.convex.pose(ro.minimax, model).faces
        (array([1.]), None)
        """
        return self.damped_faces(None)

    def damped_faces(self, damping: Damping | None) -> Faces | None:
        """Return `faces` with a damping term."""
        box, split = self.box, self._posed.split
        if self.loss_form is None or split is None or box is None:
            return None
        return split.faces(*self.stacked(0.0, damping), box)

    @property
    def split(self) -> Split | None:
        """The unknowns of `faces`; None where the penalty is no sum of norms of different unknowns."""
        return self._posed.split

    @property
    def on_triangles(self) -> bool:
        """Whether triangles of some of the equations, instead of these, give this program of them."""
        posed_on_triangle = self._posed.equations == self.model.A.shape[1] + 1
        return posed_on_triangle and self.linear_or_split and self.squared_rows

    @property
    def squared_rows(self) -> bool:
        """Whether the loss is the sum of the equations' squares."""
        return self.loss_form is not None and self.squared is self.model

    def loss_of_norms(self, v: Array) -> float:
        """Return a loss of the configurations' norms (N,)."""
        return self._posed.loss_of_norms(v)

    def row_slopes(self, v: Array) -> Array | None:
        """Return the loss's slopes by what it gets, residuals (m,) or norms (N,); None where CVXPY knows none."""
        return self._posed.row_slopes(v)

    @property
    def linear_or_split(self) -> bool:
        """Whether the minimum is a formula, or an active set's, or found from face to face."""
        return (self.quadratic and self.box is not None) or self.faces is not None

    @property
    def rows(self) -> tuple[Array, Array]:
        """A and b as the posed residual has them: the triangle, where that says all."""
        n = self.model.A.shape[1]
        if self._posed.equations == len(self.model.b):
            return self.model.A, self.model.b
        return self.model.triangle[:, :n], self.model.triangle[:, n]

    def stacked(self, weight: float, damping: Damping | None) -> tuple[Array, Array]:
        """Return rows whose squares are the quadratic terms of the objective."""
        n = self.model.A.shape[1]
        A, b = [np.zeros((0, n))], [np.zeros(0)]
        if self.loss_form is not None:
            R = self.squared.triangle
            A.append(R[:, :n])
            b.append(R[:, n])
        if self.penalty_form is not None and weight > 0:
            A.append(np.sqrt(weight) * self.penalty_form.matrix)
            b.append(np.sqrt(weight) * self.penalty_form.c)
        if damping is not None:
            A.append(np.diag(damping.size))
            b.append(damping.size * damping.centre)
        return np.vstack(A), np.concatenate(b)

    @cached_property
    def separated(self) -> Separated | None:
        """The loss as a sum over rows or configurations, where penalty and constraints let Newton's method serve.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> model = problem.linearize(np.zeros(len(problem.parameters.free)))
        >>> [ro.convex.pose(f, model).separated is not None for f in (ro.robust, ro.sum_of_norms, ro.minimax)]
        [True, True, False]
        """
        if not self._whitens:
            return None
        return self._posed.separated

    @property
    def _whitens(self) -> bool:
        """Whether penalty and constraints fit `Whitened`: squares, or none, and at most a box."""
        return self.linear_penalty and (self.box is not None or not self.constrained)

    @cached_property
    def worst(self) -> Largest | None:
        """The loss as the largest of rows or configurations, where penalty and constraints let that be solved.

        >>> import cvxpy as cp
        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> model = problem.linearize(np.zeros(len(problem.parameters.free)))
        >>> mine = ro.Formulation("largest residual", loss=cp.norm_inf, penalty=cp.sum_squares)
        >>> [ro.convex.pose(f, model).worst is not None for f in (ro.minimax, mine, ro.robust)]
        [True, True, False]
        """
        if not self._whitens:
            return None
        return self._posed.worst

    @property
    def order(self) -> np.ndarray:
        """(m,) equations in the order of their configurations, or as they are where the loss is over equations."""
        return self._posed.order

    @cached_property
    def coordinates(self) -> Coordinates:
        """Coordinates of z in which the squares of data and penalty are diagonal, of a loss that is no square."""
        return coordinates(self.model, self.penalty_form, self.order, multiplied=self.separated is None)

    # --- values ------------------------------------------------------------------------------------------------

    def value(self, z: Array, weight: float = 1.0) -> tuple[float, float]:
        """Return loss(A z - b) and penalty(z); variables of the functions' own are at their best for the weight.

        Parameters
        ----------
        z
            (n,) in units of the scales.
        weight
            Of the penalty; it matters to variables of the functions' own alone.
        """
        A, b = self.rows
        loss, penalty = self._posed.values(z, A @ z - b, weight)
        return loss + self.model.offset, penalty

    def objective(self, z: Array, weight: float) -> float:
        """Return loss(A z - b) + weight penalty(z); infinite outside the functions' domain.

        Parameters
        ----------
        z
            (n,) in units of the scales.
        weight
            Of the penalty.
        """
        loss, penalty = self.value(z, weight)
        if weight == 0:
            return loss
        return loss + weight * penalty

    def inside(self, z: Array, towards: Array, weight: float) -> Array:
        """Return z (n,), or where it lies just outside the functions' domain a point inside.

        An interior point ends at a boundary within its accuracy, and on either side of it: the point is moved a little
        towards another (n,), or towards nominal, or away from it where that lies outside.

        Parameters
        ----------
        z, towards
            (n,) each.
        weight
            Of the penalty.

        Examples
        --------
        >>> import cvxpy as cp
        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> mine = ro.Formulation("entropy", penalty=lambda z: cp.sum(cp.kl_div(z + 1, 1)))
        >>> problem = ro.load("position").problem
        >>> program = ro.convex.pose(mine, problem.linearize(np.zeros(len(problem.parameters.free))))
        >>> z = np.full(34, -1 - 1e-12)  # the entropy ends at -1
        >>> program.objective(z, 1.0), bool(np.isfinite(program.objective(program.inside(z, z, 1.0), 1.0)))
        (inf, True)
        """
        for share in (0.0, 1e-9, 1e-7, 1e-5, 1e-3, 1e-1):
            for anchor in (np.zeros_like(z), towards, 2 * z):
                nearer = z + share * (anchor - z)
                if np.isfinite(self.objective(nearer, weight)):
                    return nearer
        return z

    def norms(self, z: Array) -> Array:
        """Return the whitened norm of every configuration's residual (N,), in the order of their numbers."""
        return self.model.norms(self.model.A @ z - self.model.b)

    def violation(self, z: Array) -> float:
        """Return by how much z (n,) misses the constraints, in units of the scales; of ``largest`` relative to it.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> ball = ro.Formulation("ball", constraints=(ro.in_ball(2.0, "*"),), largest=100.0)
        >>> problem = ro.load("position").problem
        >>> program = ro.convex.pose(ball, problem.linearize(np.zeros(len(problem.parameters.free))))
        >>> z = program.solve().z
        >>> round(program.violation(3 * z), 6), bool(np.allclose(program.nearest(3 * z), z, atol=1e-6))
        (4.0, True)
        >>> program.excess(z), round(float(program.norms(z).max()), 1)  # sigmas
        (0.0, 16.4)
        """
        return max(feasible.violation(self._posed, z), self.excess(z))

    def excess(self, z: Array) -> float:
        """Return by how much at z (n,) the worst configuration exceeds ``largest``, relative to it."""
        if not self._posed.limited:
            return 0.0
        return max(0.0, float(np.max(self.norms(z))) / self.formulation.largest - 1)

    def nearest(self, z: Array) -> Array:
        """Return the point of the constraints of z that is nearest to z (n,)."""
        if feasible.violation(self._posed, z) == 0:
            return z
        if self.box is not None:
            return np.clip(z, *self.box)
        return feasible.nearest(self._posed, z)

    def gradient(self, z: Array, weight: float) -> Array | None:
        """Return the gradient (n,) of the objective, asked of the functions; None where CVXPY knows none.

        Parameters
        ----------
        z
            (n,) in units of the scales.
        weight
            Of the penalty.

        Examples
        --------
        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> program = ro.convex.pose(ro.robust, problem.linearize(np.zeros(len(problem.parameters.free))))
        >>> slopes = [np.linalg.norm(program.gradient(z, 1.0)) for z in (np.zeros(34), program.solve(1.0).z)]
        >>> bool(slopes[1] < 1e-6 * slopes[0])
        True
        """
        A, b = self.rows
        slope = self._posed.loss_slope(A @ z - b)
        if slope is None or len(slope) != len(b):
            return None
        gradient = A.T @ slope
        if self.formulation.penalty is None or weight == 0:
            return gradient
        price = self._posed.penalty_slope(z)
        if price is None:
            return None
        return gradient + weight * price

    def meets(self, z: Array) -> bool:
        """Whether z meets its constraints as well as is asked for."""
        return feasible.violation(self._posed, z) <= feasible.room(z) and self.excess(z) <= feasible.FEASIBLE

    # --- what a robust loss trusts -----------------------------------------------------------------------------

    def trust(self, z: Array) -> Trusted | None:
        """Return what a robust loss trusts at z (n,); None for a squared loss, which trusts everything.

        Raises
        ------
        InputError
            For a loss without a slope, or one that rests on few equations (minimax).
        """
        if self.loss_form is not None:
            return None
        return self._trusting(z)[0]

    def _trusting(self, z: Array) -> tuple[Trusted, np.ndarray]:
        """Return what the loss trusts at z (n,), and which equations (m,) those are."""
        which, count = self.model.members
        r = self.model.A @ z - self.model.b
        norms = self.model.norms(r)
        keep = (norms <= outlying(norms, count))[which]
        return self._posed.trusted(norms, count, r[keep]), keep

    def trusted(self, z: Array) -> LinearModel:
        """Return the squared-loss model that a robust fit amounts to: what it trusts at z (n,), weighed as it does.

        Degrees of freedom, likelihoods and covariances of a robust estimate are those of this model. With a squared
        loss it is that loss's. InputError as for `trust`.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("blunders").problem
        >>> program = ro.convex.pose(ro.robust, problem.linearize(np.zeros(len(problem.parameters.free))))
        >>> z = program.solve(1.0).z
        >>> program.model.equations, program.trusted(z).equations, round(program.trust(z).factor, 3)
        (150, 132, 1.0)
        """
        if self.loss_form is not None:
            return self.squared
        trust, keep = self._trusting(z)
        return kept_equations(self.model, keep, trust.factor)
