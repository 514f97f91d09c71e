"""Residuals of a calibration, part by part: noise, effects of model extensions, spatial autocorrelation, repetition."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy
from scipy.special import fdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.bayes.model_selection import FIRST, OWNED, SESSIONS, SPEAK, TURNED, WARMTH, Comparison, Judged
from rpim_opt.bayes.prior import family_of
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.row_functions import measured_torques, repeatable

PATTERNS = {
    "gravity": ("compliance?",),
    "first harmonic": ("ecc_cos?", "ecc_sin?"),
    "second harmonic": ("ecc2_cos?", "ecc2_sin?"),
    "moments": ("bend*",),
    SESSIONS: ("session_*",),
    WARMTH: ("expansion",),
}
"""What `identify` says for the families."""
FEWEST = 6
"""Equations that must be left over, or repeated, to judge by."""
NOTABLE = 0.5
"""Effect of a joint's compliance over the largest, below which wrong masses explain its sign."""
SURE = 3.0
"""Standard deviations by which a compliance is below zero before a joint is said to bend upwards."""
UNSEEN = 1e-10
"""Relative singular value of a direction of the geometry that the data do not see."""
RARE = 1e-3
"""Probability that what is left exceeds the scatter of repeated readings by chance."""
SHUFFLES = 300
"""Permutations that an autocorrelation is compared with."""
LEAST = 8
"""Configurations below which there is no autocorrelation."""
FEW = 500
"""Up to so many points all distances are found sooner than SciPy's tree is loaded."""
SURELY = 1 - 1e-9
"""Of squared distances that differ by less rounding decides which is smaller: then the tree does, for all points."""


class Effect(NamedTuple):
    """A family that the model has: by how much -2 ln L falls with it, and the RMS [m] that no geometry can imitate.

    The RMS is None where too few equations are left over to tell.
    """

    gain: float
    rms: float | None


class Repeated(NamedTuple):
    """RMS of repeated readings about their mean [m or rad], None for too few; its degrees of freedom."""

    rms: float | None
    freedom: int


def parts(compared: Comparison, model: Judged) -> dict[str, float]:
    """Return the RMS of a row's instrument, robot (in position, or orientation without lengths) and joints."""
    scatter = model.evidence.scatter(model.point.logs)
    squares = {"instrument": 0.0, "position": 0.0, "joint": 0.0}
    own = scatter.position
    if compared.dimension == "angle":
        own = scatter.orientation
    only = replace(scatter, instrument=0.0, joint=0.0)
    for stack in model.evidence.data.stacks:
        which = stack.of(compared.dimension)
        stated = np.einsum("nkk->nk", stack.instrument)
        levers = np.sum(stack.joint**2, axis=2)
        squares["instrument"] += scatter.instrument**2 * float(np.sum(stated[which]))
        if compared.dimension == "pixel":
            squares["position"] += float(np.sum(np.einsum("nkk->nk", stack.covariance(only))[which]))
        else:
            squares["position"] += own**2 * float(np.sum(which))
        squares["joint"] += scatter.joint**2 * float(np.sum(levers[which]))
    return {kind: float(np.sqrt(total / compared.rows)) for kind, total in squares.items()}


def present(compared: Comparison) -> Mapping[str, Effect]:
    """Return the families of the result's own model that are worth more than `SPEAK`, with what they do."""
    found = {}
    for family, members in compared.owned().items():
        gain = compared.rise_without(members)
        if gain > SPEAK:
            found[family] = Effect(gain, _beyond_geometry(compared, members))
    return found


def _beyond_geometry(compared: Comparison, members: np.ndarray) -> float | None:
    """Return the RMS of a row that some parameters (n,) move and geometry and frames cannot.

    What is left after the projection is divided by the equations that the others leave over, so that many of them do
    not make it small.
    """
    model = compared.plain
    X = model.evidence.data.X[compared.equations]
    terms = {term for terms in OWNED.values() for term in terms}
    family = np.array([family_of(name) in terms for name in model.names])
    moved = X[:, members] @ model.point.z[members]
    geometry = X[:, ~family]
    geometry = geometry / np.maximum(np.linalg.norm(geometry, axis=0), 1e-300)
    U, s, _ = np.linalg.svd(geometry, full_matrices=False)
    U = U[:, s > UNSEEN * s[0]]
    spare = len(moved) - U.shape[1]
    if spare < FEWEST:
        return None
    left = moved - U @ (U.T @ moved)
    return float(np.sqrt(left @ left / spare * len(moved) / compared.rows))


def upward(compared: Comparison) -> tuple[int, ...]:
    """Return the joints that surely turn against gravity, where gravity is worth its parameters."""
    model = compared.best
    if "gravity" not in {*model.families, *present(compared)}:
        return ()
    if measured_torques(compared.problem.data):
        return ()  # signs of measured torques are the table's
    if len(compared.problem.arms) > 1:
        return ()  # numbers of joints would not say whose
    z = model.point.z
    sd = np.sqrt(np.diag(model.point.C))
    moves = np.linalg.norm(model.evidence.data.X[compared.equations] * z, axis=0)
    joint = {i: int(name[10:]) for i, name in enumerate(model.names) if family_of(name) == "compliance"}
    largest = max((moves[i] for i in joint), default=0.0)
    return tuple(k for i, k in joint.items() if z[i] < -SURE * sd[i] and moves[i] > NOTABLE * largest)


def narrow(problem: CalibrationProblem) -> tuple[int, ...]:
    """Return the revolute joints that turned by less than harmonics need."""
    if len(problem.arms) > 1:
        return ()
    travel = np.ptp(problem.joint_values, axis=0)
    kinds = problem.robot.joint_types
    return tuple(i + 1 for i, kind in enumerate(kinds) if kind == "revolute" and travel[i] < TURNED[FIRST])


def errors_alike(compared: Comparison, model: Judged) -> Alike | None:
    """Return whether similar configurations err alike, errors in units of their noise; None where they touch points."""
    if compared.problem.touches is not None:
        return None
    row = compared.row
    scatter = model.evidence.scatter(model.point.logs)
    stacks = model.evidence.data.stacks
    widest = max(stack.index.shape[1] for stack in stacks)
    errors = []
    kinds = []
    first = []
    for kind, stack in enumerate(stacks):
        sd = np.sqrt(np.einsum("nkk->nk", stack.covariance(scatter)))
        e = model.residual[stack.index] / sd
        errors.append(np.pad(e, ((0, 0), (0, widest - e.shape[1]))))
        kinds.append(np.full(len(e), kind))
        first.append(row[stack.index[:, 0]])
    q = compared.problem.joint_values
    return alike(q[np.concatenate(first)], np.concatenate(errors), np.concatenate(kinds))


def repeated(problem: CalibrationProblem, x: Array, dimension: str) -> Repeated:
    """Return how repeated readings of a configuration by the same instrument and reflector scatter."""
    residual = problem.residual(x)
    start = 0
    squares = 0.0
    rows = 0
    freedom = 0
    for block in problem.data.blocks:
        components = list(block.measurement.components.values())
        end = start + len(components) * len(block.row)
        r = residual[start:end].reshape(-1, len(components))
        start = end
        r = r[:, [d == dimension for d in components]]
        same = np.unique(repeatable(block).round(7), axis=0, return_inverse=True)[1].ravel()
        count = np.bincount(same)
        mean = np.array([np.bincount(same, column) / count for column in r.T]).reshape(-1, len(count)).T
        squares += float(np.sum((r - mean[same]) ** 2))
        rows += len(r) - len(count)
        freedom += (len(r) - len(count)) * r.shape[1]
    if freedom < FEWEST:
        return Repeated(None, freedom)
    return Repeated(float(np.sqrt(squares / rows)), freedom)


def excess(again: Repeated, total: float, spare: float) -> float:
    """Return the RMS of what is left beyond repeated readings, where it is more than chance; total is a square."""
    if again.rms is None:
        return 0.0
    within = max(again.rms**2, 1e-24)
    if total / within < fdtri(spare, again.freedom, 1 - RARE):
        return 0.0
    return float(np.sqrt(total - within))


# --- spatial autocorrelation ------------------------------------------------------------------------------------------


class Alike(NamedTuple):
    """Correlation of the residuals of nearest configurations, and its z-score among permutations."""

    correlation: float
    z: float


def alike(q: Array, errors: Array, kinds: np.ndarray) -> Alike | None:
    """Return the autocorrelation of residuals with those of nearest neighbours in joint space (Moran).

    ::

        rho = sum_i e_i . e_nearest(i) / sum_i e_i . e_i

    and z = (rho - mean) / std over permutations of the residuals. The neighbours stay: two that are each other's
    nearest count twice in both.

    Parameters
    ----------
    q
        (N, dof) joint values.
    errors
        (N, k) residuals in units of their noise; zero beyond what was measured there.
    kinds
        (N,) which configurations have residuals of the same kind: neighbours are among those.

    Returns
    -------
    None for fewer than `LEAST` configurations of the same kind.
    """
    unit = (q - q.mean(axis=0)) / (q.std(axis=0) + 1e-9)
    groups = [rows for kind in np.unique(kinds) if len(rows := np.flatnonzero(kinds == kind)) >= LEAST]
    squares = sum(float(np.sum(errors[rows] ** 2)) for rows in groups)
    if not squares > 0:
        return None
    rng = np.random.default_rng(0)
    found = 0.0
    dealt = np.zeros(SHUFFLES)
    for rows in groups:
        e = errors[rows]
        nearest = _nearest(unit[rows])
        found += float(np.sum(e * e[nearest]))
        # a table of all products: shuffles only look up
        products = e @ e.T
        for k in range(SHUFFLES):
            order = rng.permutation(len(rows))
            dealt[k] += float(np.sum(products[order, order[nearest]]))
    spread = float(dealt.std())
    if not spread > 0:
        return None
    return Alike(found / squares, (found - float(dealt.mean())) / spread)


def _nearest(points: Array) -> np.ndarray:
    """Return the number (N,) of every point's nearest other one."""
    number = np.arange(len(points))
    if len(points) <= FEW:
        squares = np.sum((points[:, None] - points) ** 2, axis=2)
        np.fill_diagonal(squares, np.inf)
        nearest, next_one = np.partition(squares, 1)[:, :2].T
        if np.all(nearest < SURELY * next_one):
            return np.argmin(squares, axis=1)
    near = np.asarray(scipy.spatial.KDTree(points).query(points, k=2)[1])
    # of points at the same place either may come first
    return np.where(near[:, 0] == number, near[:, 1], near[:, 0])
