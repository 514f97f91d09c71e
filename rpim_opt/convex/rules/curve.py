"""Selection rules by the corner of the L-curve."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rpim_opt.basics.arrays import TINY, Array
from rpim_opt.convex.program import Estimate, Program
from rpim_opt.convex.rules.selection import Selection, choice, least_between, on_inliers, skipped, solved, weight_grid

SLOWEST = 1e-200
"""Squared speed below which a curve is stationary."""
SHARP = 0.5
"""Part of the largest curvature that makes another corner of a path with a non-smooth penalty."""
GRID = 60
"""Number of weights searched for a corner if each has to be solved."""
GOLDEN = (1 + 5**0.5) / 2


@on_inliers
def l_curve(program: Program) -> Selection:
    """Choose the corner of the L-curve: the largest curvature of (ln |A z - b|, ln |z|).

    With a closed form the derivatives are analytic (Hansen 1998, Rank-Deficient and Discrete Ill-Posed
    Problems, sec. 4.6; sign such that the corner of an L is positive), and the maximum is refined between its
    neighbours on the grid. Otherwise the curvature is that of the circle through three neighbouring points (Cultrera
    and Callegaro 2020). A maximum at an edge is no corner, and a curve with negative curvature everywhere has none: the
    weight is then that edge, or the lower one.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, weight=ro.l_curve)
    >>> f"{result.weight:.2g}", result.selection.interior
    ('1.8e-05', True)
    """
    failed = ""
    if program.closed_form:
        weights = weight_grid(program)
        score = _curvature(program, weights)
    else:
        every = weight_grid(program, GRID)
        points = _points(solved(program, every))
        finite = np.isfinite(points[:, 0])
        failed = skipped(int(np.count_nonzero(~finite)))
        weights, score = every[finite], menger(points[finite])
    best = int(np.argmax(score))
    if not program.linear_penalty:  # where the last parameters vanish, the path has a spurious corner far above noise
        peaks = np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] > score[2:])) + 1
        sharp = peaks[score[peaks] >= SHARP * np.max(score)]
        best = int(sharp[0]) if len(sharp) else best
    if not score[best] > 0:
        best = 0
    no_corner = (
        f"the L-curve has no corner: the weight is at the {'lower' if best == 0 else 'upper'} edge of "
        f"{weights[0]:.1e} to {weights[-1]:.1e}; another selector, or a fixed weight, may be better"
    )
    chosen = choice("l_curve", weights, score, best, "corner of the L-curve" + failed, no_corner + failed)
    if chosen.interior and program.closed_form:
        refined, opposite = least_between(lambda tried: -_curvature(program, tried), weights, best)
        if -opposite > score[best]:  # the search finds one of several maxima
            chosen = replace(chosen, weight=refined)
    return chosen


def _points(estimates: list[Estimate | None]) -> Array:
    """Return ln |A z - b| and ln |z| of estimates, (K, 2); NaN of those that there are not."""
    squares = [[max(each.loss, TINY), max(each.penalty, TINY)] if each else [np.nan, np.nan] for each in estimates]
    return 0.5 * np.log(squares)


def _curvature(program: Program, weights: Array) -> Array:
    """Curvature of t = ln weight -> (u, v) = (ln rho, ln eta) / 2 with rho = |Az - b|^2, eta = |z|^2.

    With z_i = s_i beta_i / (s_i^2 + w): eta' = d eta / dt = -2 w sum z_i^2 / (s_i^2 + w), and rho' = -w eta'.
    """
    beta2, s2, perp = program.ridge.filters
    w = weights[:, None]
    z2 = s2 * beta2 / (s2 + w) ** 2
    eta = z2.sum(1)
    rho = (w**2 * beta2 / (s2 + w) ** 2).sum(1) + perp
    # first and second derivatives by t
    first = (z2 / (s2 + w)).sum(1)
    second = (z2 / (s2 + w) ** 2).sum(1)
    eta1 = -2 * weights * first
    eta2 = eta1 + 6 * weights**2 * second
    rho1 = -weights * eta1
    rho2 = -weights * (eta1 + eta2)
    eta = np.maximum(eta, TINY)
    rho = np.maximum(rho, TINY)
    u1 = rho1 / rho / 2
    v1 = eta1 / eta / 2
    u2 = rho2 / rho / 2 - 2 * u1**2
    v2 = eta2 / eta / 2 - 2 * v1**2
    speed = u1**2 + v1**2
    # without a corner: a stationary curve, of data that the nominal robot fits exactly
    return np.divide(u1 * v2 - v1 * u2, speed**1.5, out=np.zeros_like(speed), where=speed > SLOWEST)


def menger(points: Array) -> Array:
    """Signed curvature of the circle through each point (K, 2) and its neighbours; zero at the ends."""
    chords = np.diff(points, axis=0)
    before = chords[:-1]
    after = chords[1:]
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    sides = [np.linalg.norm(side, axis=1) for side in (before, after, points[2:] - points[:-2])]
    product = np.prod(sides, axis=0)
    # coincident points have no circle, nor have those that differ by rounding
    inner = np.divide(2 * cross, product, out=np.zeros(len(cross)), where=product > 1e-18)
    return np.concatenate([[0.0], inner, [0.0]])


@on_inliers
def corner(program: Program, tolerance: float = 0.01) -> Selection:
    """Search the corner of the L-curve without a grid: golden sections by Menger curvature, any formulation.

    Cultrera and Callegaro 2020 (IOP SciNotes 1:025004): of four points on the curve the inner one with the larger
    curvature is kept, and the interval shrinks to its neighbours; each step needs one new solution.

    It ends at a width ``tolerance`` of the interval of ln weight. InputError for a formulation without penalty.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.group_lasso, weight=ro.corner)
    >>> f"{result.weight:.1g}", result.selection.note
    ('0.7', 'corner of the L-curve by golden-section search')
    """
    low, high = np.log(weight_grid(program, 2))
    seen: dict[float, Array] = {}

    def curvature(*places: float) -> float:
        for t in places:
            if t not in seen:
                seen[t] = _points(solved(program, [float(np.exp(t))]))[0]
        return float(menger(np.array([seen[t] for t in places]))[1])

    # of the two inner points the one with the larger curvature stays, until they meet
    begin, end = low, high
    left = (end + GOLDEN * begin) / (1 + GOLDEN)
    right = begin + end - left
    best = left
    while end - begin > tolerance:
        on_the_right = curvature(left, right, end)
        # negative curvature is the flat end of the L, without a corner: it is cut off
        if on_the_right < 0 or curvature(begin, left, right) > on_the_right:
            best, end, right = left, right, left
            left = (end + GOLDEN * begin) / (1 + GOLDEN)
        else:
            best, begin, left = right, left, right
            right = begin + end - left
    order = [t for t in sorted(seen) if np.isfinite(seen[t]).all()]
    if not order:
        program.solve(float(np.exp(best)))  # raises the solver's error
    points = np.array([seen[t] for t in order])
    interior = bool(low + 0.1 < best < high - 0.1)
    note = "corner of the L-curve by golden-section search"
    if not interior:
        note = "the search ended at an edge: the L-curve has no corner; another selector may be better"
    note += skipped(len(seen) - len(order))
    return Selection(float(np.exp(best)), "corner", np.exp(order), menger(points), interior, note)


RULES = (l_curve, corner)
