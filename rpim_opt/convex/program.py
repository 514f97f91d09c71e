"""The convex program of one linearization: what it is as a CVXPY problem, and its solutions at any weight."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, NoSolutionFound
from rpim_opt.basics.shown import Brief
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.convex.atoms import OPTIMAL, cp
from rpim_opt.convex.closed import Bounds, minimum, minimum_between, moved, path_between, shares, values
from rpim_opt.convex.formulation import Formulation, formulation_of
from rpim_opt.convex.gap import duality_gap
from rpim_opt.convex.interior import Found, interior
from rpim_opt.convex.kinked import minimum_on_faces
from rpim_opt.convex.met import Met
from rpim_opt.convex.objective import Damping, Objective
from rpim_opt.convex.posed import Unposed, posed
from rpim_opt.convex.written import by_solver, parametrized
from rpim_opt.problem.linear import LinearModel

PROVEN = 1e-9
"""Duality gap, relative to the objective, that proves a minimum."""


@dataclass(frozen=True, eq=False, repr=False)
class Estimate(Brief):
    """One solution: z (n,) at a weight, with the two values that the L-curve plots.

    Parameters
    ----------
    z
        (n,) in units of the scales.
    weight, loss, penalty
        The weight, loss(A z - b) and penalty(z).
    duals
        Multipliers of the formulation's constraints, one array each, (n,) for a `Box`: by how much the objective would
        fall if the constraint were loosened by one unit of the scales.
    status
        CVXPY's word.
    iterations, seconds
        What the solver needed; zero iterations: a formula, or an active set.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("paper_arm").problem
    >>> program = ro.convex.pose(ro.bounded, problem.linearize(np.zeros(len(problem.parameters.free))))
    >>> estimate = program.solve(1e-3)
    >>> estimate.status, estimate.objective == estimate.loss + 1e-3 * estimate.penalty, len(estimate.duals)
    ('optimal', True, 1)
    >>> program.solve(1e-3, solver="CLARABEL", settings={"max_iter": 100}).iterations > estimate.iterations == 0
    True
    """

    z: Array
    weight: float
    loss: float
    penalty: float
    duals: tuple[Array, ...] = ()
    status: str = OPTIMAL
    iterations: int = 0
    seconds: float = 0.0

    def _short(self) -> str:
        return f"{self.status} at weight {self.weight:.4g}: loss {self.loss:.4g}, penalty {self.penalty:.4g}"

    @property
    def objective(self) -> float:
        """Loss and weighted penalty together."""
        if self.weight == 0:
            return self.loss
        return self.loss + self.weight * self.penalty


@dataclass(frozen=True, eq=False, repr=False)
class Program(Objective):
    """A formulation applied to a linear model, ready to be solved at any weight.

    Parameters
    ----------
    formulation, model
        What is stated, and the equations A z ~ b.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> program = ro.convex.pose(ro.lasso, problem.linearize(np.zeros(len(problem.parameters.free))))
    >>> estimate = program.solve(5.0)
    >>> written = program.problem(5.0)  # the same program, to print, change, or give to another solver
    >>> bool(abs(written.solve(solver="CLARABEL") / estimate.objective - 1) < 1e-6), written.is_dcp(dpp=True)
    (True, True)
    >>> [round(e.penalty, 1) for e in program.path([0.5, 5.0, 50.0])]
    [13.4, 12.5, 10.4]
    >>> loss, penalty = program.value(estimate.z)
    >>> np.allclose([loss + 5.0 * penalty, program.objective(estimate.z, 5.0)], estimate.objective, rtol=1e-12)
    True
    >>> there = program.on(problem.linearize(estimate.z * problem.parameters.free.scale))
    >>> round(loss), round(there.value(estimate.z)[0])  # promised, and what the nonlinear model keeps
    (97, 100)
    """

    _met: Met = field(default_factory=Met, repr=False)  # shared with all programs that `on` makes of this one

    def __reduce__(self) -> Any:
        return pose, (self.formulation, self.model)  # what CVXPY made of the functions does not travel

    def on(self, model: LinearModel) -> Program:
        """Return the program for another model of the same shape, without asking the functions anew."""
        return Program(self.formulation, model, self._posed, self._met)

    def without(self, out: np.ndarray) -> Program:
        """Return the program without some equations, ``out`` (m,), which become rows of zeros.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("blunders").problem
        >>> program = ro.convex.pose(ro.robust, problem.linearize(np.zeros(len(problem.parameters.free))))
        >>> some = program.without(program.model.group == 7)  # the worst configuration
        >>> some.solve(1.0).loss < program.solve(1.0).loss
        True
        """
        left = replace(self, model=self.model.scaled(np.where(out, 0.0, 1.0)), _met=Met(self._met))
        if self.separated is not None or self.worst is not None:  # unknowns that whiten all whiten most
            vars(left)["coordinates"] = self.coordinates.of(~out[self.order])
        return left

    def problem(self, weight: float) -> cp.Problem:
        """Return the program as a CVXPY problem in the variable ``z``: what it minimizes is what `solve` minimizes.

        ``A``, ``b`` and ``weight`` are parameters of those names (`cp.Problem.param_dict`), and so are the parameters
        of the formulation's own functions. It obeys CVXPY's rules for parametrized programs (DPP): solved again with
        other values, it is not canonicalized again.

        Raises
        ------
        InputError
            For a weight that is negative or not finite.
        """
        return parametrized(self, self._weight(weight)).problem

    @one_blas_thread
    def solve(
        self,
        weight: float = 0.0,
        *,
        damping: Damping | None = None,
        solver: str | None = None,
        settings: Mapping[str, Any] | None = None,
        verbose: bool = False,
    ) -> Estimate:
        """Return the solution at a weight.

        Weight zero is the limit of small weights: directions that the data do not see stay nominal. With another loss
        than a squared one they may go anywhere: give it a penalty with a weight, or constraints. Quadratic programs
        have a formula, in a box an active set; a loss that is a sum over rows or configurations (robust, sum of norms,
        quantiles) with a squared penalty, in a box or without, has Newton's method, one that is the largest of them
        (minimax) has quadratic programs, both begun where the last minimum was and ended by a duality gap; everything
        else is Clarabel's, on data that are dimensionless.

        Parameters
        ----------
        weight
            Of the penalty, zero or more.
        damping
            A term that keeps the solution near a point.
        solver, settings, verbose
            Any installed solver of CVXPY with its options: then `problem` is solved by it, whatever the structure.

        Raises
        ------
        InputError
            For a weight that is negative or not finite, and a solver that is not installed.
        NoSolutionFound
            When the solver does not end with "optimal", or its point misses the constraints; ``conflict`` names
            what contradicts what when the program is infeasible.
        """
        begin = time.perf_counter()
        weight = self._weight(weight)
        box = self.box
        if solver or settings or verbose:
            asked = solver or cp.CLARABEL
            estimate = self._judged(by_solver(self, weight, damping, asked, settings or {}, verbose), weight)
        elif self.closed_form:
            estimate = self._at(minimum(self, weight, damping), weight)
        elif self.quadratic and box is not None:
            z, multipliers = minimum_between(self, box, weight, damping, near=self._met.begin)
            self._met.begin = z
            estimate = self._at(z, weight, shares(self, box, z, multipliers))
        elif weight > 0 and self.faces is not None:
            estimate = self._on_faces(weight, damping)
        else:
            estimate = self._by_rows(weight, damping) or self._by_interior_point(weight, damping)
        return replace(estimate, seconds=time.perf_counter() - begin)

    def beginning(self, z: Array) -> Program:
        """Return the same program, whose next minimum in a box, or first one of rows, is looked for from z (n,) on.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("paper_arm").problem
        >>> program = ro.convex.pose(ro.bounded, problem.linearize(np.zeros(len(problem.parameters.free))))
        >>> z = program.solve(1.0).z
        >>> bool(np.allclose(program.beginning(0.9 * z).solve(1.0).z, z))
        True
        """
        self._met.begin = z
        return self

    def proven(self, weight: float) -> Estimate:
        """Return the solution at a weight, on evidence that is independent of how it was found.

        Of a loss over rows a duality gap that is computed anew from the functions' own values and slopes
        (`gap.duality_gap`); where it leaves doubt, an interior point finds the solution, and of a penalty with kinks
        it is asked anyway.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("blunders").problem
        >>> program = ro.convex.pose(ro.robust, problem.linearize(np.zeros(len(problem.parameters.free))))
        >>> abs(program.proven(1.0).objective / program.solve(1.0).objective - 1) < 1e-12
        True
        """
        estimate = self.solve(weight)
        if estimate.weight > 0 and self.faces is not None:
            return self._lower_by_interior_point(estimate)
        if self.separated is None and self.worst is None:
            return estimate
        near = self._met.nearest(weight)
        proposed = None
        if near is not None and near.kinked.multipliers:
            proposed = np.empty(len(self.model.b))
            proposed[self.order] = near.slope
        gap = duality_gap(self, estimate.z, weight, proposed)
        if gap <= PROVEN * max(1.0, abs(estimate.objective)):
            return estimate
        return self._by_interior_point(weight, None)

    def _lower_by_interior_point(self, estimate: Estimate) -> Estimate:
        """Return what cones find where that is lower, beyond an interior point's accuracy."""
        try:
            other = self._by_interior_point(estimate.weight, None)
        except NoSolutionFound:
            return estimate
        if other.objective < estimate.objective - PROVEN * max(1.0, abs(estimate.objective)):
            return other
        return estimate

    def moved(self, by: Array, weight: float, damping: Damping | None = None) -> Array | None:
        """Return by how far the minimum (n,) of `solve` moves where b moves by (m,), much quicker than solving again.

        None where no formula says it, or not exactly.

        Parameters
        ----------
        by
            (m,) what is added to b.
        weight, damping
            As `solve` has them.

        Examples
        --------
        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> program = ro.convex.pose(ro.tikhonov, problem.linearize(np.zeros(len(problem.parameters.free))))
        >>> by = np.linspace(-1, 1, 120)
        >>> there = program.on(program.model.with_values(program.model.b + by))
        >>> bool(np.allclose(program.moved(by, 1.0), there.solve(1.0).z - program.solve(1.0).z, atol=1e-9))
        True
        """
        if not self.closed_form or self.squared is not self.model:
            return None
        return moved(self, weight, damping, self.model.A.T @ by)

    @one_blas_thread
    def path(self, weights: Sequence[float] | Array, near: Array | None = None, rough: bool = False) -> list[Estimate]:
        """Return the solutions at many weights (K,): all at once by formula, or each from its neighbour.

        Parameters
        ----------
        weights
            (K,), zero or more.
        near
            A point (n,) near the solution at the largest weight, if one is known.
        rough
            Whether points will do whose objective Newton's method expects to be within 1e-10 of the minimum, without a
            gap that says so: for a rule that compares them.

        Examples
        --------
        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> program = ro.convex.pose(ro.lasso, problem.linearize(np.zeros(len(problem.parameters.free))))
        >>> [round(estimate.penalty, 2) for estimate in program.path([1e2, 1e4, 1e6])]
        [10.07, 3.56, 0.33]
        """
        checked = np.array([self._weight(weight) for weight in weights])
        if self.closed_form:
            Z = self.ridge.minima(checked)
            rows = zip(Z, checked, *values(self, Z), strict=True)
            return [Estimate(z, float(w), float(loss), float(penalty)) for z, w, loss, penalty in rows]
        if self.faces is not None:
            return self._path_on_faces(checked, near)
        if self.quadratic and self.box is not None:
            return self._path_in_box(self.box, checked)
        found = {weight: self._one(weight, rough) for weight in sorted(set(checked.tolist()), reverse=True)}
        return [found[weight] for weight in checked.tolist()]

    def _path_in_box(self, box: Bounds, weights: Array) -> list[Estimate]:
        """Return the solutions of a quadratic program in a box at many weights."""
        Z, multipliers = path_between(self, box, weights)
        rows = zip(Z, weights, *values(self, Z), multipliers, strict=True)
        return [
            Estimate(z, float(w), float(loss), float(penalty), shares(self, box, z, held))
            for z, w, loss, penalty, held in rows
        ]

    def _weight(self, weight: float) -> float:
        """Return the weight, checked; zero where there is no penalty for it to multiply."""
        number = isinstance(weight, int | float | np.integer | np.floating) and not isinstance(weight, bool)
        if not (number and np.isfinite(weight) and weight >= 0):
            raise InputError("weight", f"{weight!r}", "a finite number, zero or more")
        if self.formulation.penalty is None:
            return 0.0
        return float(weight)

    def _at(self, z: Array, weight: float, duals: tuple[Array, ...] = (), iterations: int = 0) -> Estimate:
        if not self.quadratic:  # a quadratic is finite everywhere
            z = self.inside(z, np.zeros_like(z), weight)
        return Estimate(z, weight, *self.value(z, weight), duals, iterations=iterations)

    def _one(self, weight: float, rough: bool) -> Estimate:
        """Return one of many solutions."""
        if not rough:
            return self.solve(weight)
        return self._by_rows(weight, None, rough) or self._by_interior_point(weight, None)

    def _by_rows(self, weight: float, damping: Damping | None, rough: bool = False) -> Estimate | None:
        """Return the minimum of a loss that is a sum or the largest over rows, from the last one."""
        from rpim_opt.convex.by_rows import by_rows

        ended = by_rows(self, weight, damping, self._met.near(weight), rough)
        if ended is None:
            return None
        found, near = ended
        self._met.keep(weight, near)
        loss, penalty = near.loss + self.model.offset, self._posed.penalty_of(near.z)
        z = near.z.copy()  # whoever writes on it does not write on what the next one begins with
        return Estimate(z, weight, loss, penalty, found.duals, iterations=found.iterations)

    def _on_faces(self, weight: float, damping: Damping | None, start: Array | None = None) -> Estimate:
        """Return the minimum of a penalty with kinks, or where it is not certain the interior point's, if lower."""
        found = minimum_on_faces(self, weight, damping, start)
        estimate = Estimate(found.z, weight, found.loss, found.penalty, found.duals)
        if found.certain:
            return estimate
        try:
            other = self._by_interior_point(weight, damping)
        except NoSolutionFound:
            if found.good:
                return estimate
            raise
        damped = [self._damped_objective(each.z, weight, damping) for each in (other, estimate)]
        return (other, estimate)[int(np.argmin(damped))]

    def _damped_objective(self, z: Array, weight: float, damping: Damping | None) -> float:
        value = self.objective(z, weight)
        if damping is None:
            return value
        return value + float(np.sum((damping.size * (z - damping.centre)) ** 2))

    def _path_on_faces(self, weights: Array, start: Array | None) -> list[Estimate]:
        """Return the solutions at many weights, each from that of the next larger one."""
        found: dict[float, Estimate] = {}
        for weight in sorted({float(weight) for weight in weights}, reverse=True):
            if weight > 0:
                found[weight] = self._on_faces(weight, None, start)
            else:
                found[weight] = self._by_interior_point(weight, None)
            start = found[weight].z
        return [found[float(weight)] for weight in weights]

    def _by_interior_point(self, weight: float, damping: Damping | None) -> Estimate:
        """Return what Clarabel finds in our terms, and where it finds nothing, in CVXPY's."""
        found = interior(self, weight, damping)
        if found.z is None:
            first = found.status
            found = by_solver(self, weight, damping, cp.CLARABEL, {}, False)
            if found.z is None and "outside" not in found.status:
                found = Found(first)
        return self._judged(found, weight)

    def _judged(self, found: Found, weight: float) -> Estimate:
        """Return a solver's point as an estimate, or say why there is none."""
        if found.z is not None:
            return replace(self._at(found.z, weight, found.duals, found.iterations), status=found.status)
        from rpim_opt.convex.conflict import advice, conflict  # of programs without a solution

        status, contradiction = found.status, None
        if self.constrained:  # a solver may stop in other words, and the constraints contradict each other all the same
            contradiction = conflict(self._posed, self.model)
        elif status.startswith("infeasible"):
            status = "stalled"  # a program without constraints always has a point
        text = advice(self._posed, status, contradiction)
        raise NoSolutionFound(self.formulation.name, weight, status, contradiction, text)


def pose(formulation: Formulation | str, model: LinearModel) -> Program:
    """Return the program of a formulation on a linear model; the formulation's functions are asked now, once.

    Parameters
    ----------
    formulation
        What is stated, or the name of a ready formulation.
    model
        Equations A z ~ b.

    Raises
    ------
    InputError
        For functions that do not answer convex expressions and constraints of CVXPY.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("paper_arm").problem
    >>> program = ro.convex.pose(ro.tikhonov, problem.linearize(np.zeros(len(problem.parameters.free))))
    >>> program.closed_form, len(program.path([1e-3, 1.0]))
    (True, 2)
    """
    formulation = formulation_of(formulation)
    if not formulation.solvable:
        return Program(formulation, model, Unposed(formulation, model))
    return Program(formulation, model, posed(formulation, model))
