"""Formulations: the convex program of one linearization, in CVXPY's own algebra, solved by Clarabel."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np

from rpim_opt.exceptions import InputError, NoSolutionFound
from rpim_opt.parameters import Parameters
from rpim_opt.problem import LinearModel
from rpim_opt.robot import Array

Term = Callable[[Any], Any]
ROTATION_INVARIANT = (cp.sum_squares, cp.norm2)
"""Losses that see only the length of the residual: [A b] may be replaced by its triangular factor."""

TIGHT = {"tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12, "tol_feas": 1e-12}
FEASIBLE = 1e-9
"""By how much a solution may miss its constraints, relative to its largest entry."""


def squared_norm(value: Any) -> float:
    """Return |value|^2 of an array."""
    return float(np.sum(np.square(value)))


@dataclass(frozen=True)
class Formulation:
    """A convex way to identify the scaled total deviation z from whitened equations A z ~ b.

    ::

        minimize    loss(A z - b) + weight * penalty(z)     subject to    constraints(z)

    Parameters
    ----------
    name
        What reports call it.
    loss
        Convex function of the whitened residual (m,); the sum of squares by default.
    penalty
        Convex function of z (n,), or None.
    constraints
        Functions of z and of the identified `Parameters`, each returning a CVXPY constraint.
    """

    name: str
    loss: Term = cp.sum_squares
    penalty: Term | None = None
    constraints: tuple[Callable[[Any, Parameters], cp.Constraint], ...] = ()

    def compile(self, model: LinearModel) -> ConvexProgram:
        """Pose the program in CVXPY; `ConvexProgram.on` reuses it for other data of the same shape."""
        return ConvexProgram(self, model, _Posed(self, model))


@dataclass(frozen=True, eq=False)
class Estimate:
    """One solution: z (n,) at a weight, with the two values that the L-curve plots."""

    z: Array
    weight: float
    loss: float
    penalty: float


@dataclass(frozen=True, eq=False)
class ConvexProgram:
    """A formulation applied to a linear model, ready to be solved at any weight."""

    formulation: Formulation
    model: LinearModel
    _posed: _Posed

    def on(self, model: LinearModel) -> ConvexProgram:
        """Return the program for another model of the same shape, without posing it anew."""
        return ConvexProgram(self.formulation, model, self._posed)

    @property
    def quadratic(self) -> bool:
        """Whether loss and penalty are squared norms."""
        return self._posed.quadratic and self.formulation.penalty is not None

    @property
    def closed_form(self) -> bool:
        """Whether every solution on the path is a formula in the singular values (Tikhonov, least squares)."""
        return self._posed.quadratic and not self.formulation.constraints

    def value(self, z: Array) -> tuple[float, float]:
        """Return loss(A z - b) and penalty(z)."""
        loss, penalty = self.formulation.loss, self.formulation.penalty
        r = self.model.A @ z - self.model.b
        fit = squared_norm(r) if loss is cp.sum_squares else float(loss(cp.Constant(r)).value)
        if penalty is None:
            return fit, 0.0
        return fit, squared_norm(z) if penalty is cp.sum_squares else float(penalty(cp.Constant(z)).value)

    def violation(self, z: Array) -> float:
        """Return by how much z misses the constraints, in units of the scales."""
        return self._posed.violation(z)

    def solve(self, weight: float = 0.0) -> Estimate:
        """Return the solution at a weight, from Clarabel.

        Weight zero is the limit of small weights: directions that the data do not see stay nominal.

        Raises
        ------
        NoSolutionFound
            When the solver does not end with "optimal", or its point misses the constraints.
        """
        weight = self._weight(weight)
        z = self._posed.solve(self, weight)
        return Estimate(z, weight, *self.value(z))

    def path(self, weights: Sequence[float] | Array) -> list[Estimate]:
        """Return the solutions at many weights.

        A squared loss with a squared penalty has a formula, z = V diag(s / (s^2 + weight)) U'b; where that
        meets the constraints it is the solution, and only elsewhere a program is solved.
        """
        estimates = []
        for weight in map(self._weight, weights):
            z = self._formula(weight) if self._posed.quadratic else None
            if z is not None and (self.closed_form or self.violation(z) <= 0):
                estimates.append(Estimate(z, weight, *self.value(z)))
            else:
                estimates.append(self.solve(weight))
        return estimates

    def _weight(self, weight: float) -> float:
        """Return the weight, checked; zero where there is no penalty for it to multiply."""
        if not (np.isfinite(weight) and weight >= 0):
            raise InputError("weight", f"{weight}", "a finite number, zero or more")
        return 0.0 if self.formulation.penalty is None else float(weight)

    def _formula(self, weight: float) -> Array:
        beta, s, Vt = self.model.svd
        gain = np.divide(s, s**2 + weight, out=np.zeros_like(s), where=s > 0)
        return Vt.T @ (gain * beta)


class _Posed:
    """The CVXPY problem of a shape: data and weight are its parameters, so it is canonicalized once.

    With a squared loss and a squared (or no) penalty, both terms are one squared norm: in the singular
    basis, u = D (V'z - D^-2 s U'b) with D = sqrt(s^2 + weight) gives loss + weight penalty = |u|^2 + const.
    Posed in u the program is perfectly conditioned at every weight, where posed in z an interior-point
    solver calls answers "optimal" that have no correct digit.
    """

    def __init__(self, formulation: Formulation, model: LinearModel):
        m, n = model.A.shape
        self.n = n
        self.probe = cp.Variable(n)
        self.checks = [c(self.probe, model.parameters) for c in formulation.constraints]
        self.quadratic = formulation.loss is cp.sum_squares and formulation.penalty in (None, cp.sum_squares)
        self.reduced = formulation.loss in ROTATION_INVARIANT
        rows = n + 1 if self.reduced else m
        if self.quadratic:
            u = cp.Variable(n)
            self.basis, self.centre = cp.Parameter((n, n)), cp.Parameter(n)
            self.z, objective = self.basis @ u + self.centre, cp.sum_squares(u)
        else:
            self.z = cp.Variable(n)
            self.A, self.b, self.weight = (
                cp.Parameter((rows, n)),
                cp.Parameter(rows),
                cp.Parameter(nonneg=True),
            )
            objective = formulation.loss(self.A @ self.z - self.b)
            if formulation.penalty is not None:
                objective = objective + self.weight * formulation.penalty(self.z)
        constraints = [c(self.z, model.parameters) for c in formulation.constraints]
        self.problem = cp.Problem(cp.Minimize(objective), constraints)
        if not self.problem.is_dcp():
            raise InputError(f"formulation '{formulation.name}'", "a program that is not convex", "CVXPY's DCP rules")

    def violation(self, z: Array) -> float:
        self.probe.value = z
        return max((float(np.max(c.violation())) for c in self.checks), default=0.0)

    def solve(self, program: ConvexProgram, weight: float) -> Array:
        self._set(program.model, weight)
        status = ""
        for settings in (TIGHT, {}):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", UserWarning)
                    self.problem.solve(solver=cp.CLARABEL, **settings)
                status = self.problem.status
            except cp.SolverError as error:
                status = str(error)
            if status == cp.OPTIMAL and self.z.value is not None:
                z = np.array(self.z.value)
                if self.violation(z) > FEASIBLE * max(1.0, float(np.max(np.abs(z)))):
                    status = "optimal, but outside the constraints"
                    continue
                return z
        raise NoSolutionFound(program, weight, status)

    def _set(self, model: LinearModel, weight: float) -> None:
        if self.quadratic:
            beta, s, Vt = model.svd
            if self.checks and not s.all():
                # a nominal value for unseen directions may not meet the constraints: let them move, at a price
                weight = max(weight, 1e-16 * s[0] ** 2)
            D = np.sqrt(s**2 + weight)
            inverse = np.divide(1.0, D, out=np.zeros_like(D), where=D > 0)
            self.basis.value = Vt.T * inverse
            self.centre.value = Vt.T @ (inverse**2 * s * beta)
        else:
            R = model.triangle if self.reduced else np.column_stack([model.A, model.b])
            self.A.value, self.b.value, self.weight.value = R[:, : self.n], R[:, self.n], weight


def within_tolerance(z: Any, parameters: Parameters) -> cp.Constraint:
    """Constrain |x_i| <= tolerance_i, in the dimensionless z = x / scale."""
    bound = parameters.tolerance / parameters.scale
    limited = np.flatnonzero(np.isfinite(bound))
    if not len(limited):
        raise InputError("table tolerance", "no tolerance for any identified parameter", "length_mm, angle_mrad, ...")
    return cp.abs(z[limited]) <= bound[limited]


least_squares = Formulation("least squares")
tikhonov = Formulation("Tikhonov", penalty=cp.sum_squares)
bounded = Formulation("bounded Tikhonov", penalty=cp.sum_squares, constraints=(within_tolerance,))

FORMULATIONS = {"least_squares": least_squares, "tikhonov": tikhonov, "bounded": bounded}
