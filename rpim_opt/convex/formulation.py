"""Formulations: loss, penalty and constraints in CVXPY's algebra, and the ready ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, pick
from rpim_opt.basics.text import Brief, counted
from rpim_opt.convex.constraints import Constraint, Ready, by_kind, by_link, within_tolerance
from rpim_opt.convex.expressions import ATOMS, LARGEST, NORM1, SQUARES, SUM, cp, named
from rpim_opt.robot.parameters import Parameters

Function = Callable[[Any], Any]
HUBER = 2.0
"""Whitened norm of a configuration above which Huber's loss is linear: a quarter of good positions exceed it."""
NAMED = (*ATOMS, by_link, by_kind)
"""Functions whose result does not change between calls, besides those that are `Ready`."""


@dataclass(frozen=True, repr=False)
class Formulation(Brief):
    """Loss, penalty and constraints that identify the scaled total deviation z from whitened equations A z ~ b.

    ::

        minimize    loss(A z - b) + weight * penalty(z)     subject to    constraints(z)

    The functions may hold variables and parameters of their own, and read anything: a calibration calls them twice, for
    its iterations and for its certificate, and twice per round if constraints use positions. With data in blocks
    the loss is called in every linearization, for some thousand rows at a time, and not for the certificate.

    Parameters
    ----------
    name
        Name in reports.
    loss
        Convex function of the whitened residual (m,); the sum of squares by default.
    penalty
        Convex function of z (n,), or None.
    constraints
        Functions of z and of the identified `Parameters`, each returning a CVXPY constraint or several.
    loss_over
        ``"equation"``, or ``"configuration"``: the loss then gets the whitened norm of each configuration (N,), and
        has to be nondecreasing in it.
    penalty_over
        A function of the identified `Parameters` that returns matrices D_k: the penalty then gets the norms
        |D_k z| (K,), and has to be nondecreasing. `by_link`, `by_kind`, `differences`.
    solvable
        False if read from a file that cannot hold a script's functions.

    InputError for another ``loss_over`` and for arguments that are not callable; once posed, if it is not convex.

    Examples
    --------
    >>> import cvxpy as cp
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> mine = ro.Formulation("L1 in a ball", loss=cp.norm1, constraints=(ro.in_ball(3.0, "*"),))
    >>> round(float(np.linalg.norm(ro.calibrate(ro.load("position").problem, mine).z)), 6)  # in units of the scales
    3.0
    """

    name: str
    loss: Function = SQUARES
    penalty: Function | None = None
    constraints: tuple[Constraint, ...] = ()
    loss_over: str = "equation"
    penalty_over: Callable[[Parameters], Sequence[Array]] | None = None
    solvable: bool = True

    def _short(self) -> str:
        loss, penalty = (
            str(getattr(each, "maker", "") or getattr(each, "__name__", type(each).__name__))
            for each in (self.loss, self.penalty)
        )
        text = f"'{self.name}': {loss}"
        if self.penalty is not None:
            text += f" + weight {penalty}"
        if self.constraints:
            text += f", {counted(len(self.constraints), 'constraint')}"
        return text

    def __post_init__(self) -> None:
        object.__setattr__(self, "loss", named(self.loss))
        object.__setattr__(self, "penalty", named(self.penalty))
        if self.loss_over not in ("equation", "configuration"):
            raise InputError("loss_over", f"'{self.loss_over}'", "equation, configuration")
        constraints: Any = self.constraints
        try:
            object.__setattr__(self, "constraints", (constraints,) if callable(constraints) else tuple(constraints))
        except TypeError:
            found = f"a {type(constraints).__name__}"
            raise InputError("constraints", found, "functions of z and the parameters, in a tuple") from None
        for key in ("loss", "penalty", "penalty_over"):
            function = getattr(self, key)
            if not callable(function) and (key == "loss" or function is not None):
                raise InputError(key, f"{function!r}", "a function, such as cp.norm1")
        for constraint in self.constraints:
            if not callable(constraint):
                raise InputError("constraints", f"{constraint!r}", "functions of z and the parameters")

    @property
    def ready(self) -> bool:
        """Whether all its functions are the package's own, whose result does not change between calls."""
        functions = [self.loss, self.penalty, self.penalty_over, *self.constraints]
        # a box is compared by its limits
        functions = [getattr(f, "limits", f) for f in functions if f is not None and f != within_tolerance]
        return all(isinstance(f, Ready) or f in NAMED for f in functions)


def _huber(v: Any, threshold: Any) -> Any:
    return cp.sum(cp.huber(v, threshold))


def unavailable(name: str) -> Callable[..., Any]:
    """Return a placeholder for functions that a file could not hold; calling it raises InputError."""

    def function(*_: Any) -> Any:
        accepted = "the script that defines them, to calibrate again"
        raise InputError(f"formulation '{name}'", "functions that a result file cannot hold", accepted)

    return function


def huber(threshold: float = HUBER) -> Function:
    """Return Huber's loss (1964): v^2 up to the threshold, 2 threshold |v| - threshold^2 beyond, summed.

    ``threshold`` is in standard deviations: of an equation, or with ``loss_over="configuration"`` of a configuration's
    norm. InputError if it is not positive.

    >>> import cvxpy as cp
    >>> import rpim_opt as ro
    >>> by_axis = ro.Formulation("Huber of equations", loss=ro.huber(1.5), penalty=cp.sum_squares)
    >>> result = ro.calibrate(ro.load("blunders").problem, by_axis, weight=1.0)
    >>> len(result.flagged)
    5
    """
    if not (np.isfinite(threshold) and threshold > 0):
        raise InputError("huber", f"threshold {threshold}", "a positive number of standard deviations")
    return Ready("huber", _huber, (threshold,))


least_squares = Formulation("least squares")
"""|A z - b|^2: linear least squares, without a weight; the parameters have to be independent."""
tikhonov = Formulation("Tikhonov", penalty=SQUARES)
"""|A z - b|^2 + weight |z|^2 (Tikhonov 1963): expects deviations of about the size of their scales."""
bounded = Formulation("bounded Tikhonov", penalty=SQUARES, constraints=(within_tolerance,))
"""`tikhonov` with |x_i| <= tolerance_i for all stated tolerances.

>>> import rpim_opt as ro
>>> problem = ro.load("paper_arm").problem
>>> result = ro.calibrate(problem, ro.bounded, weight=ro.l_curve)
>>> bool((abs(result.x) <= problem.parameters.free.tolerance).all())
True
"""
robust = Formulation("Huber", loss=huber(), penalty=SQUARES, loss_over="configuration")
"""`huber` of the norms of the configurations, + weight |z|^2: outliers have little influence, and are flagged.

>>> import rpim_opt as ro
>>> result = ro.calibrate(ro.load("blunders").problem, ro.robust, weight=ro.reml)
>>> [flag.label for flag in result.flagged]
['c43', 'c39', 'c7', 'c14', 'c1']
"""
sum_of_norms = Formulation("sum of norms", loss=SUM, penalty=SQUARES, loss_over="configuration")
"""sum_k |r_k| over the configurations, + weight |z|^2: an L1 loss that does not depend on the axes.

>>> import rpim_opt as ro
>>> instance = ro.load("paper_arm", variant="misprints")  # 27 points, two of them misprinted
>>> result = ro.calibrate(instance.problem, ro.sum_of_norms, weight=ro.reml)
>>> [f"{flag.label}: {1e3 * flag.error:.0f} mm" for flag in result.flagged[:2]]
['T8-6: 38 mm', 'T8-7: 15 mm']
"""
minimax = Formulation("minimax", loss=LARGEST, penalty=SQUARES, loss_over="configuration")
"""max_k |r_k| over the configurations, + weight |z|^2: only the largest residuals count.

The loss does not grow with the number of rows, N: a weight of about 1 / N compares with 1 of a sum.

>>> import rpim_opt as ro
>>> print(f"{1e3 * ro.calibrate(ro.load('position').problem, ro.minimax, weight=1e-3).errors().max():.3f} mm")
0.060 mm
"""
lasso = Formulation("lasso", penalty=NORM1)
"""|A z - b|^2 + weight |z|_1 (Tibshirani 1996): parameters that the data do not require stay nominal.

>>> import rpim_opt as ro
>>> result = ro.calibrate(ro.load("position").problem, ro.lasso, weight=5.0)
>>> int((abs(result.z) > 1e-6).sum()), len(result.z)
(27, 34)
"""
group_lasso = Formulation("group lasso by link", penalty=SUM, penalty_over=by_link)
"""|A z - b|^2 + weight sum_k |z_k| over links and frames (Yuan and Lin 2006): links stay nominal as a whole.

>>> import numpy as np
>>> import rpim_opt as ro
>>> result = ro.calibrate(ro.load("position").problem, ro.group_lasso, weight=20.0)
>>> groups = ro.constraints.by_link(result.problem.parameters.free)
>>> [round(float(np.linalg.norm(D @ result.z)), 1) for D in groups]  # links, base, tool
[0.0, 1.1, 2.5, 1.1, 1.2, 0.6, 0.0, 0.8]
"""

FORMULATIONS = {
    "least_squares": least_squares,
    "tikhonov": tikhonov,
    "bounded": bounded,
    "robust": robust,
    "sum_of_norms": sum_of_norms,
    "minimax": minimax,
    "lasso": lasso,
    "group_lasso": group_lasso,
}


def formulation_of(stated: Formulation | str) -> Formulation:
    """Return a formulation, or the ready one of that name; InputError for anything else."""
    if isinstance(stated, str):
        return pick(FORMULATIONS, stated, "formulation")
    if not isinstance(stated, Formulation):
        accepted = f"a Formulation, or the name of a ready one: {', '.join(FORMULATIONS)}"
        raise InputError("formulation", f"a {type(stated).__name__}", accepted)
    return stated
