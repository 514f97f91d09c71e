"""Equivalent least squares of a robust fit, for rules, covariances and blocks; `solvers.separable` solves the fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from scipy.special import chdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.expressions import Term, term
from rpim_opt.convex.formulation import Formulation
from rpim_opt.problem.linear import LinearModel

RARE = 0.01
"""Probability that a set of good data has any configuration beyond the outlier limit."""
SMALL = 1e-6
"""Lower bound on residuals, in sigmas: a norm has no derivative at zero."""
SHARE, STEP = 0.3, 1e-4
"""Expected change of a residual in the next step, as a part of the last change, and its lower bound."""
CROSSING = 0.3
"""For a loss that is not smooth at zero: a residual that changed by a larger relative amount may still become zero."""
LEAST_CURVATURE = 1e-3
"""Least curvature along a residual, relative to that across it: a quadratic model needs some."""
SEPARATE = 1e-9
"""Relative tolerance for recognizing a loss as the sum of its entries' losses."""


def _quantiles(beyond: float, count: np.ndarray) -> Array:
    """Return upper quantiles of the chi-squared distributions with ``count`` (N,) degrees of freedom."""
    several, which = np.unique(count, return_inverse=True)
    return chdtri(several, beyond)[which]


def noise_level(norms: Array, count: np.ndarray) -> float:
    """Return median(norm / median of chi_k) of whitened norms (N,) with k = ``count`` equations, at least 1."""
    return max(1.0, float(np.median(norms / np.sqrt(_quantiles(0.5, count)))))


def limits(noise: float, configurations: int, count: np.ndarray) -> Array:
    """Return the norm above which one of so many configurations with ``count`` equations is an outlier."""
    return noise * np.sqrt(_quantiles(RARE / configurations, count))


def outlying(norms: Array, count: np.ndarray) -> Array:
    """Return the whitened norms (N,) above which rows or configurations are outliers: s sqrt(chi2_k^-1(1 - 0.01 / N)).

    s is the `noise_level`. One set of good data in a hundred has any norm above its limit.
    """
    return limits(noise_level(norms, count), len(norms), count)


@dataclass(frozen=True)
class Inliers:
    """The equations that a robust loss keeps, times the square root of ``factor``; a `Reweigh` for blocks."""

    noise: float
    configurations: int
    factor: float

    def keeps(self, model: LinearModel, z: Array) -> np.ndarray:
        """Return which equations (m,) are kept at z (n,)."""
        which, count = model.members
        norms = model.norms(model.A @ z - model.b)
        return (norms <= limits(self.noise, self.configurations, count))[which]

    def __call__(self, model: LinearModel, z: Array) -> tuple[LinearModel, float]:
        """Return the kept equations at z (n,), and no constant."""
        return kept_equations(model, self.keeps(model, z), self.factor), 0.0


def kept_equations(model: LinearModel, keep: np.ndarray, factor: float) -> LinearModel:
    """Return some of a model's equations (m,), multiplied by the root of a factor."""
    A, b = np.compress(keep, model.A.T, axis=1).T, model.b[keep]  # column-major, as LAPACK requires
    A *= np.sqrt(factor)
    b *= np.sqrt(factor)
    return replace(model, A=A, b=b, group=model.group[keep], factor=factor)


def inliers_of(formulation: Formulation, norms: Array, count: np.ndarray, loss: Term | None = None) -> Inliers:
    """Return the inliers of a robust loss, from whitened norms (N,) of configurations with ``count`` equations.

    Their factor is the median of loss'(v) / (2 v), with v the norms, or norm / sqrt(count) for a loss over equations:
    each equation's share, whatever the storage. ``loss`` is that of one posed program. InputError for a loss without a
    slope, or one that depends on few equations (minimax).
    """
    noise = noise_level(norms, count)
    keep = norms <= limits(noise, len(norms), count)
    share = np.sqrt(count[keep]) if formulation.loss_over == "equation" else 1.0
    v = np.maximum(norms[keep] / share, SMALL)
    if loss is None or loss.variable.size < len(v):  # for blocks, or n + 1 rows
        loss = term(formulation.loss, len(v), f"formulation '{formulation.name}', loss")
    slope = None
    if len(loss.expression.variables()) == 1:  # own variables, if any, determine the slope
        slope = loss.slope(np.concatenate([v, np.full(loss.variable.size - len(v), SMALL)]))
    found = f"formulation '{formulation.name}'"
    accepted = "a loss with gradients, without own variables, which covariances, predictions and most rules need; "
    accepted += "`forward`, monte_carlo, l_curve and k_fold do not"
    if slope is None:
        lacking = "with own variables" if len(loss.expression.variables()) > 1 else "without gradient"
        raise InputError(found, f"a loss {lacking}", accepted)
    factor = float(np.median(np.abs(slope[: len(v)]) / (2 * v))) if len(v) else 0.0
    if not factor > 0:
        raise InputError(found, "a loss that depends on a few equations", accepted)
    return Inliers(noise, len(norms), factor)


def by_place(formulation: Formulation, groups: np.ndarray) -> bool:
    """Whether a loss of residuals (m,), or of the norms of their ``groups``, changes where these are exchanged."""
    if formulation.ready:
        return False
    size = len(groups if formulation.loss_over == "equation" else np.unique(groups))
    r = np.linspace(0.5, 1.5, size)
    loss = term(formulation.loss, size, f"formulation '{formulation.name}', loss")
    if len(loss.expression.variables()) > 1:  # own variables, which have no values here
        return False
    one, other = loss(r), loss(np.random.default_rng(0).permutation(r))
    return bool(np.isfinite(one) and abs(one - other) > SEPARATE * abs(one))


# --- blocks of rows ---


@dataclass(frozen=True)
class QuadraticModel:
    """Quadratic model of a loss that is a sum over rows, for blocks of equations: a `Reweigh`.

    With r_i the residual of a configuration (or an equation) at z, v = |r_i|, u = r_i / v and w = loss'(v) / (2 v), the
    equations of i are multiplied by M and their right-hand side is shifted such that ::

        |M (A_i z' - b_i) - shift|^2 + offset    with    M = sqrt(c) u u' + sqrt(w) (1 - u u')

    has the value and the gradient of the loss at z' = z, and its curvature across u. Along u its curvature is a secant
    of the loss's slopes over the expected step: first c = w, a model nowhere below the loss (iteratively reweighted
    least squares; Holland and Welsch 1977), at the end c = loss''(v) / 2, with Newton's convergence. In between the
    loss may exceed the model: the outer loop checks that and damps.

    ``over`` is ``"equation"`` or ``"configuration"``, as for the loss; ``before`` (n,) the point of the last iteration.
    """

    loss: Callable[[Any], Any]
    name: str
    over: str
    before: Array | None = None

    def after(self, z: Array) -> QuadraticModel:
        """Return the quadratic model for the iteration after z (n,)."""
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
        # half the curvature along residuals, from slopes here and at the expected step; at first from those at +-v,
        # since such squares lie nowhere below the loss
        change = 2 * v
        if self.before is not None:
            moved = np.sqrt(np.bincount(which, (model.A @ (z - self.before)) ** 2))
            change = np.clip(SHARE * moved, STEP * v, 2 * v)
            if self.slope(priced, np.full(len(v), SMALL))[0] > 0.1 * self.slope(priced, np.ones(len(v)))[0]:
                change = np.where(moved > CROSSING * v, 2 * v, change)
        there = v - change
        slope_there = np.sign(there) * self.slope(priced, np.maximum(np.abs(there), SMALL))
        along = np.maximum((slope - slope_there) / (2 * change), LEAST_CURVATURE * across)
        u = r / v[which]
        along_u = scipy.sparse.csr_array((u, (which, np.arange(len(r)))), (len(v), len(r)))
        projected = along_u @ model.A  # u'A, group by group
        A = np.sqrt(across)[which, None] * model.A
        A += ((np.sqrt(along) - np.sqrt(across))[which] * u)[:, None] * projected[which]
        shift = np.divide(slope, 2 * np.sqrt(along), out=np.zeros_like(slope), where=along > 0)
        b = A @ z - shift[which] * u
        return replace(model, A=A, b=b), priced(norms) - float(np.sum((A @ z - b) ** 2))

    def slope(self, priced: Term, v: Array) -> Array:
        """Return the loss's slopes at norms v, one each; InputError where CVXPY knows none."""
        slope = priced.slope(v)
        if slope is None:
            raise InputError(f"formulation '{self.name}'", "a loss without gradient", "one with a gradient: robust")
        return slope


def separable(loss: Callable[[Any], Any], over: str = "configuration") -> bool:
    """Return whether a loss of several norms or residuals is a sum over them; of residuals also an even function."""
    v = np.geomspace(1e-3, 1e3, 7)
    try:
        several, one = term(loss, len(v), "loss"), term(loss, 1, "loss")
    except (ValueError, InputError):  # a loss for a fixed number of residuals
        return False
    whole = several(v)
    alone = sum(one(np.array([each])) for each in v)
    mirrored = several(-v) if over == "equation" else whole
    return max(abs(whole - alone), abs(whole - mirrored)) <= SEPARATE * (1 + abs(whole))
