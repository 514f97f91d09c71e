"""A loss that is a sum over rows, as squares that have its value, slope and (nearly) curvature where they were made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.atoms import SQUARES
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.posed import invariant
from rpim_opt.convex.terms import Term, term
from rpim_opt.problem.linear import LinearModel

SMALL = 1e-6
"""Residuals are taken as no smaller, in sigmas: below, a norm has no slope of its own."""
SHARE, STEP = 0.3, 1e-4
"""A step is expected to move a residual by this part of what the last one did, and by this part of it at least."""
CROSSING = 0.3
"""Where a loss has a kink at zero: residuals that moved by more than this part of themselves may yet end there."""
LEAST_CURVATURE = 1e-3
"""Curvature along a residual, relative to that across it, where the loss has less: a square needs some."""
SEPARATE = 1e-9
"""How exactly a loss of several residuals is the sum of their losses, relative."""


@dataclass(frozen=True)
class Squares:
    """Replaces a loss by squares, some equations at a time: a `Reweigh` for measurements in parts.

    With r_i the residual of a configuration (or of an equation) at z, v = |r_i|, u = r_i / v and w = loss'(v) / (2 v),
    the equations of i are multiplied by M and their right-hand side is moved such that ::

        |M (A_i z' - b_i) - shift|^2 + offset    with    M = sqrt(c) u u' + sqrt(w) (1 - u u')

    has the value and the gradient of the loss at z' = z, its curvature across u, and along u a secant of its slopes
    over the distance of a step: c is w in the first pass (iteratively reweighted least squares; Holland and Welsch
    1977), which never lies below the loss, and loss''(v) / 2 in the end, with which steps shorten as Newton's do. In
    between the loss may be above: the outer loop checks that and damps.

    Parameters
    ----------
    loss
        Convex function of residuals, the sum of what it is of each alone.
    name
        The formulation's, for messages.
    over
        ``"equation"`` or ``"configuration"``: what the loss gets, residuals or their norms.
    before
        (n,) where the last pass was; None in the first one. `after` sets it.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> from rpim_opt.convex.majorize import Squares
    >>> problem = ro.load("blunders").problem
    >>> z = np.zeros(len(problem.parameters.free))
    >>> model = problem.linearize(z)
    >>> squares, offset = Squares(ro.robust.loss, "Huber", "configuration")(model, z)
    >>> value = np.sum((squares.A @ z - squares.b) ** 2) + offset
    >>> bool(np.isclose(value, ro.convex.pose(ro.robust, model).value(z)[0], rtol=1e-12))
    True
    """

    loss: Callable[[Any], Any]
    name: str
    over: str
    before: Array | None = None

    def after(self, z: Array) -> Squares:
        """Return the squares for the pass after one at z (n,)."""
        return replace(self, before=z)

    def __call__(self, model: LinearModel, z: Array) -> tuple[LinearModel, float]:
        """Return the equations of the squares, and the constant that they lack; z is (n,)."""
        r = model.A @ z - model.b
        which = np.arange(len(r))
        if self.over == "configuration":
            which = model.members[0]
        norms = np.sqrt(np.bincount(which, r**2))
        v = np.maximum(norms, SMALL)
        priced = term(self.loss, len(v), f"formulation '{self.name}', loss")
        slope = self.slope(priced, v)
        across = slope / (2 * v)
        along = np.maximum(self._along(model, z, which, v, priced), LEAST_CURVATURE * across)
        u = r / v[which]
        along_u = scipy.sparse.csr_array((u, (which, np.arange(len(r)))), (len(v), len(r)))
        projected = along_u @ model.A  # u'A, group by group
        A = np.sqrt(across)[which, None] * model.A
        A += ((np.sqrt(along) - np.sqrt(across))[which] * u)[:, None] * projected[which]
        b = A @ z - (slope / (2 * np.sqrt(along)))[which] * u
        return replace(model, A=A, b=b), priced(norms) - float(np.sum((A @ z - b) ** 2))

    def _along(self, model: LinearModel, z: Array, which: np.ndarray, v: Array, priced: Term) -> Array:
        """Return half the curvature along residuals of norms v, from the slopes here and where a step may lead.

        The slope is odd, so that 2 v further on it is the negative one: along is then across, and the squares lie
        nowhere below the loss. That is where a calibration begins, which knows of no step yet.
        """
        change = 2 * v
        if self.before is not None:
            moved = np.sqrt(np.bincount(which, (model.A @ (z - self.before)) ** 2))
            change = np.clip(SHARE * moved, STEP * v, 2 * v)
            if self.slope(priced, np.full(len(v), SMALL))[0] > 0.1 * self.slope(priced, np.ones(len(v)))[0]:
                change = np.where(moved > CROSSING * v, 2 * v, change)
        there = v - change
        slope_there = np.sign(there) * self.slope(priced, np.maximum(np.abs(there), SMALL))
        return (self.slope(priced, v) - slope_there) / (2 * change)

    def slope(self, priced: Term, v: Array) -> Array:
        """Return the loss's slopes at norms v, one each; InputError where CVXPY knows none."""
        slope = priced.slope(v)
        if slope is None:
            raise InputError(f"formulation '{self.name}'", "a loss without slope", "one with a slope, as robust has")
        return slope


def separable(loss: Callable[[Any], Any], over: str = "configuration") -> bool:
    """Return whether a loss of several norms is the sum of what it is of each; of residuals, for either sign too.

    >>> import cvxpy as cp
    >>> import rpim_opt as ro
    >>> from rpim_opt.convex.majorize import separable
    >>> separable(ro.huber()), separable(cp.max), separable(lambda r: cp.sum(cp.pos(r)), "equation")
    (True, False, False)
    """
    v = np.geomspace(1e-3, 1e3, 7)
    try:
        several, one = term(loss, len(v), "loss"), term(loss, 1, "loss")
    except (ValueError, InputError):  # one that is made for a certain number of residuals
        return False
    whole = several(v)
    alone = sum(one(np.array([each])) for each in v)
    mirrored = several(-v) if over == "equation" else whole
    return max(abs(whole - alone), abs(whole - mirrored)) <= SEPARATE * (1 + abs(whole))


def on_triangles(formulation: Formulation, equations: Callable[[], int]) -> tuple[Formulation, Squares | None]:
    """Return the formulation that triangles can be solved with, and what makes its squares of the equations.

    A loss that sees only the length of the residual needs nothing. ``equations`` says how many they are.

    Raises
    ------
    InputError
        For a loss that is no sum over rows, and for a ``largest``.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> from rpim_opt.convex.majorize import on_triangles
    >>> on_triangles(ro.tikhonov, lambda: 120) == (ro.tikhonov, None)
    True
    >>> on_triangles(ro.robust, lambda: 120)[0].loss_over
    'equation'
    """
    if invariant(formulation, equations):
        return formulation, None
    where = f"formulation '{formulation.name}'"
    accepted = "a squared loss, or a sum over configurations or equations (robust)"
    if np.isfinite(formulation.largest):
        raise InputError(where, "a largest norm, with measurements in parts", accepted)
    if not separable(formulation.loss, formulation.loss_over):
        raise InputError(where, "a loss that is no sum, with measurements in parts", accepted)
    squares = Squares(formulation.loss, formulation.name, formulation.loss_over)
    return replace(formulation, loss=SQUARES, loss_over="equation"), squares
