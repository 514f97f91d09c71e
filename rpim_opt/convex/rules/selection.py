"""Result of a selection rule, and the grid of weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import Any

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, NoSolutionFound
from rpim_opt.basics.text import Tabled, counted
from rpim_opt.convex.expressions import cp, minimized
from rpim_opt.convex.program import Estimate, Program
from rpim_opt.convex.quadratic import Ridge, ridge
from rpim_opt.problem.linear import LinearModel

SMALLEST = 1e-100
LARGEST = 1e100
"""Largest weight: far beyond any problem's, and far within the range of doubles."""
LEAST, MOST = 1e-9, 1e-6
"""Limits of the lower end of a grid for a non-smooth penalty, relative to its largest weight: below the first, the
penalty is less than the accuracy of the objective."""

HOMOGENEOUS = 1e-9
"""Relative difference of penalty(2 z) and 2 penalty(z) that is rounding."""


@dataclass(frozen=True, eq=False, repr=False)
class Selection(Tabled):
    """A selected weight with its evidence.

    ``name`` is the rule's; for a rule of the package its function's, with which a stored result can be calibrated
    again. ``weights`` and ``score`` (K,) are those that it compared; ``interior`` states whether the choice lies inside
    of them, and ``note`` is a sentence for the report, which for a choice at the edge states what that means.

    A user's rule is a function of the program that returns a weight, or a `Selection` with its evidence:

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> def within_a_scale(program):
    ...     weights = np.geomspace(1e-3, 1e3, 60)
    ...     largest = np.array([np.abs(e.z).max() for e in program.path(weights)])
    ...     k = int(np.argmax(largest <= 1))
    ...     return ro.select.Selection(weights[k], "within a scale", weights, largest, interior=0 < k < 59)
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, within_a_scale)
    >>> result.selection.name, result.selection.interior
    ('within a scale', True)
    """

    weight: float
    name: str
    weights: Array
    score: Array
    interior: bool
    note: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):  # arguments in another order
            accepted = "a text, the second argument: Selection(weight, name, weights, score, interior, note)"
            raise InputError("Selection, name", f"a {type(self.name).__name__}", accepted)

    def _short(self) -> str:
        where = "inside" if self.interior else "at an edge of"
        return f"{self.name}: weight {self.weight:.4g}, {where} {counted(len(self.weights), 'weight')}"

    def _frame_rows(self) -> list[dict[str, Any]]:
        pairs = zip(self.weights, self.score, strict=True)
        return [{"weight": float(weight), "score": float(score)} for weight, score in pairs]

    def _notes(self) -> list[str]:
        return [self.note]


Selector = Callable[[Program], Selection | float]


def on_inliers(rule: Callable[..., Selection]) -> Callable[..., Selection]:
    """Apply a rule to the equivalent linear estimator of a robust fit, until its choice no longer changes."""

    @wraps(rule)
    def chosen(program: Program, *arguments: Any, **options: Any) -> Selection:
        if not program.separable or program.formulation.penalty is None:
            return rule(program, *arguments, **options)
        weight, rounds = 1.0, 0
        while True:
            z = program.solve(weight).z
            selection = rule(program.on_squares(program.inlier_model(z)), *arguments, **options)
            rounds += 1
            if abs(np.log(max(selection.weight, SMALLEST) / weight)) < SETTLED or rounds == ROUNDS:
                return selection
            weight = max(selection.weight, SMALLEST)

    return chosen


ROUNDS, SETTLED = 4, 0.02
"""Largest number of repetitions of a rule for a robust loss, and the change of ln weight that ends them."""

Score = Callable[[Array], Array]
"""Function from weights (K,) to the scores (K,) that a rule compares."""


SAME_WEIGHT = 1.1
"""Ratio of weights that a search need not distinguish."""

EDGES = {
    "lower": "the smallest weight of the grid is best: the data support no penalty",
    "upper": "the largest weight of the grid is best: the data support no deviation",
}
"""Meaning of a choice at an edge of the grid."""


def choice(name: str, weights: Array, score: Array, best: int, note: str, at_edge: str = "") -> Selection:
    """Return the selection of one of some weights (K,), with its note at an edge; NaN is where the solver failed."""
    failed = np.isnan(score)
    inside = 0 < best < len(weights) - 1
    if not inside:
        note = at_edge or EDGES["lower" if best == 0 else "upper"]
    note += skipped(int(failed.sum()))
    interior = inside and not failed[[best - 1, best + 1]].any()
    return Selection(float(weights[best]), name, weights[~failed], score[~failed], bool(interior), note)


def solved(program: Program, weights: Sequence[float] | Array) -> list[Estimate | None]:
    """Return the solutions at weights (K,), None where the solver fails.

    NoSolutionFound if it fails at every weight, or if constraints contradict each other.
    """
    if program.closed_form:
        return list(program.path(weights))
    estimates: dict[float, Estimate | None] = {}
    failure = None
    for weight in sorted(weights, reverse=True):
        try:
            estimates[weight] = program.solve(weight)
        except NoSolutionFound as error:
            if error.conflict is not None:
                raise
            estimates[weight], failure = None, error
    if failure and len(estimates) > 1 and not any(estimates.values()):
        raise failure
    return [estimates[weight] for weight in weights]


def skipped(count: int) -> str:
    """Return a note on weights at which the solver failed."""
    return f"; {counted(count, 'weight')} skipped, where the solver failed" if count else ""


def with_rows(program: Program, name: str) -> LinearModel:
    """Return the model for a rule that leaves rows out; refuse a model without rows."""
    if program.model.stands_for is not None:
        found = f"{program.model.equations} equations in blocks, of which only the QR factor is kept"
        raise InputError(f"selector {name}", found, "reml, l_curve, gcv, discrepancy, or a number")
    return program.model


def require_weight(weight: float, where: str, file: object = None) -> float:
    """Return a weight; refuse one that is negative, or whose square or inverse is no number."""
    if not (np.isfinite(weight) and (weight == 0 or SMALLEST <= weight <= LARGEST)):
        accepted = f"a finite number, zero or more ({SMALLEST:g} to {LARGEST:g})"
        raise InputError(where, f"'{weight}'", accepted, file)
    return float(weight)


def weight_grid(program: Program, count: int = 200) -> Array:
    """Return a geometric grid of weights that covers all changes of the estimate.

    For a squared penalty it goes from 1e-4 s_r^2 to 10 s_1^2, with s the nonzero singular values of A; for a non-smooth
    penalty (lasso) it ends at the weight above which nothing is identified. If an interior-point method solves, the
    grid begins at or above eps s_1^2: smaller weights are rounding relative to the squares.
    """
    if program.formulation.penalty is None:
        raise InputError("weight", "a selector for a formulation without penalty", "weight 0")
    exact = program.quadratic and program.box is not None
    least = 0.0 if exact else float(np.finfo(float).eps)
    if program.quadratic:
        return grid_of(program.ridge, count, least)
    weights = grid_of(ridge(program.model, program.penalty_form), count, least)
    n = program.model.A.shape[1]
    slope = None  # of the loss, at nominal
    if program.loss_form is not None and not program.linear_penalty and not program.structure.inner:
        slope = -2 * program.squared.A.T @ program.squared.b
    probe = np.cos(np.arange(1, n + 1))
    none, once, twice = (program.value(k * probe)[1] for k in (0, 1, 2))
    if slope is None or none != 0 or abs(twice - 2 * once) > HOMOGENEOUS * once:
        return weights
    # of a positively homogeneous penalty the largest is max { -g'z : penalty(z) <= 1 }, g the loss's slope at nominal
    expressions = program.structure.expressions
    problem = cp.Problem(cp.Minimize(slope @ expressions.z), [expressions.penalty_of_z <= 1])
    value: Any = problem.value if minimized(problem) else 0.0
    if problem.status != cp.OPTIMAL or not value < 0:
        return weights
    return np.geomspace(np.clip(weights[0], LEAST * -value, MOST * -value), -value, count)


def grid_of(form: Ridge, count: int = 200, least: float = 0.0) -> Array:
    """Return the grid of weights of a closed-form estimator, from its singular values, above ``least`` s_1^2."""
    s = form.s[form.identifiable]
    if not len(s):
        raise InputError("data", "no sensitivity to any identified parameter", "data that depend on at least one")
    return np.geomspace(max(1e-4 * s[-1] ** 2, least * s[0] ** 2), 10 * s[0] ** 2, count)


def least_between(score: Score, weights: Array, best: int, ratio: float = 1 + 1e-6) -> tuple[float, float]:
    """Return the weight of smallest score between the neighbours of the best grid point, and that score.

    The weight is accurate to a factor ``ratio``.
    """
    low, high = np.log(weights[[best - 1, best + 1]])
    with np.errstate(invalid="ignore"):  # scores are NaN where the solver failed
        minimum: Any = scipy.optimize.minimize_scalar(
            lambda t: score(np.exp([t]))[0], bounds=(low, high), method="bounded", options={"xatol": np.log(ratio)}
        )
    return float(np.exp(minimum.x)), float(minimum.fun)


def searched(score: Score, grid: Array, begin: Score | None = None) -> tuple[Array, Array, int]:
    """Return weights (K,), their scores and the index of the smallest, known to a factor `SAME_WEIGHT`.

    The search starts where the scores on a coarse grid, or cheaper ones, ``begin``, are lowest; if scores fall towards
    an end of the searched range, it is extended.
    """
    tried: dict[float, float] = {}

    def recorded(weights: Array) -> Array:
        scores = score(weights)
        tried.update(zip(weights.tolist(), scores.tolist(), strict=True))
        return np.where(np.isnan(scores), np.inf, scores)

    last = len(grid) - 2
    centre = int(np.clip(np.nanargmin((begin or recorded)(grid)), 1, last))
    while True:
        if grid[centre] not in tried:
            recorded(grid[[centre]])
        least_between(recorded, grid, centre, SAME_WEIGHT**2)
        weights = np.array(sorted(tried))
        scores = np.array([tried[weight] for weight in weights])
        best = int(np.nanargmin(scores))
        centre += int(best == len(weights) - 1) - int(best == 0)
        if 0 < best < len(weights) - 1 or not 1 <= centre <= last:
            return weights, scores, best
