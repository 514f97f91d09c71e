"""Observability of the parameters, and optimal design of experiments by convex relaxation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, pick
from rpim_opt.basics.tables import numbers, read_columns
from rpim_opt.basics.text import Brief, counted
from rpim_opt.basics.units import UNITS, joint_columns, with_unit
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.pose import position
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.mdh import Robot

CRITERIA = {"D": "det^(1/n)", "A": "mean variance", "V": "predicted variance"}
ANYWHERE = 1.0  # standard deviation of the unknown position of a touched point [m]
MOST_STEPS, MOST_PASSES = 4000, 20  # of the relaxation; exchange passes over all chosen configurations


@dataclass(frozen=True, eq=False, repr=False)
class Design(Brief):
    """A chosen set of configurations.

    ``chosen`` (count,) are indices of the candidates, ``weights`` (M,) their weights in the relaxation, from 0 to 1.
    ``value`` is the ``criterion`` D, A or V of the chosen set (ln det M for D, [m^2] for V), ``bound`` a bound that no
    set of that size exceeds (for A and V: falls below), and ``gap`` the ratio of their efficiencies minus 1: 0.01 means
    that no set is more than 1 % better. D counts per parameter, det^(1/n).
    """

    chosen: np.ndarray
    weights: Array
    criterion: str
    value: float
    bound: float
    gap: float

    def _short(self) -> str:
        return f"{counted(len(self.chosen), 'configuration')} chosen"

    def __str__(self) -> str:
        count = f"{len(self.chosen)} of {len(self.weights)} configurations"
        what = f"{count}, {self.criterion}-optimal ({CRITERIA[self.criterion]})"
        if self.gap > 1:
            return f"{what}: too few for a useful optimality bound; choose more."
        return f"{what}: no other choice is more than {100 * self.gap:.2f} % better."


def random_candidates(robot: Robot, count: int, seed: int | np.random.Generator = 0, share: float = 1.0) -> Array:
    """Return joint values (count, dof) [rad or m], uniform in the middle part of every joint's range.

    ``seed`` is a seed or a generator; ``share`` is the used part of every joint's range, from 0 to 1. InputError for a
    joint without limits.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> q = ro.problem.random_candidates(ro.load("position").problem.robot, 1000, share=0.5)
    >>> np.degrees(q.max(axis=0)).round()
    array([ 82.,  55.,  25.,  80.,  60., 200.])
    """
    if not np.isfinite(robot.limits).all():
        raise InputError("limits", "a joint without limits", "limits for every joint, or candidates of your own")
    middle, half = robot.limits.mean(axis=1), share * np.ptp(robot.limits, axis=1) / 2
    return np.random.default_rng(seed).uniform(middle - half, middle + half, (count, robot.dof))


def read_candidates(source: Any, robot: Robot) -> Array:
    """Return the joint values (M, dof) of a table with columns ``q1_deg``, ...; other columns are left alone."""
    columns, q = read_columns(source), []
    for i, dimension in enumerate(robot.joint_dimensions, start=1):
        name = next((n for n in with_unit(f"q{i}", dimension) if n in columns), None)
        if name is None:
            raise InputError("the header", f"no column for 'q{i}'", " or ".join(with_unit(f"q{i}", dimension)), source)
        q.append(UNITS[name.split("_")[1]].si * numbers(columns[name], name))
    return np.column_stack(q)


def joint_cells(robot: Robot, q: Array, index: np.ndarray) -> dict[str, list[str]]:
    """Return joint values as the columns of a table, labelled by the number of the candidate."""
    units = joint_columns(robot.joint_dimensions)
    cells = {name: [f"{v / si:.4f}" for v in column] for (name, si), column in zip(units.items(), q.T, strict=True)}
    return {"label": [f"n{k}" for k in index], **cells}


def choose(
    problem: CalibrationProblem, candidates: Array, count: int, criterion: str = "V", measured: Dataset | None = None
) -> Design:
    """Choose the configurations that are most informative about the identified parameters.

    With rows A_i of the whitened, scaled Jacobian at nominal and the prior of the scales, the information of a set is M
    = 1 + sum A_i' A_i. Relaxed to weights 0 <= w_i <= 1 with sum w_i = count, each criterion is convex::

        D   maximize ln det M
        A   minimize tr M^-1
        V   minimize the mean variance of the candidates' positions, summed over the axes [m^2]

    If the problem's rows touch points, the candidates are configurations at one point (`configurations_at`), and V
    refers to positions of the tool.

    The relaxation is solved by multiplicative steps (Silvey, Titterington and Torsney 1978), whose gradients bound all
    sets. The largest weights are rounded, and the set is improved by exchanges (Fedorov 1972).

    The first block of the problem's data defines what is measured. ``candidates`` (M, dof) are possible joint values of
    the controller; ``measured`` is a `Dataset` of existing rows, which M then includes. InputError for another
    criterion, a count that the candidates do not allow, or measurements between two points.

    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> design = ro.problem.choose(problem, ro.problem.random_candidates(problem.robot, 60), count=30)
    >>> print(str(design).partition(":")[0])
    30 of 60 configurations, V-optimal (predicted variance)
    """
    pick(CRITERIA, criterion, "criterion")
    candidates = np.atleast_2d(np.asarray(candidates, dtype=float))
    if not 0 < count < len(candidates):
        raise InputError("count", f"{count}", f"1 to {len(candidates) - 1}, fewer than the candidates")
    A = _rows(problem, candidates)
    if problem.data.blocks[0].measurement.touching:
        # touches of one point, whose position is unknown to `ANYWHERE`: a fixed effect
        place = -ANYWHERE * np.linalg.inv(np.linalg.cholesky(np.median(problem.data.blocks[0].covariance, axis=0)))
        A = np.asarray(np.concatenate([A, np.broadcast_to(place, (len(A), 3, 3))], axis=2), dtype=float)
    n = A.shape[2]
    C = np.eye(n)
    if criterion == "V":
        P = _rows(problem, candidates, whitened=False)
        C = np.zeros((n, n))
        C[: P.shape[2], : P.shape[2]] = np.einsum("kin,kim->nm", P, P) / len(P)
    prior = np.eye(n)  # including existing measurements
    if measured is not None:
        if measured.blocks[0].measurement.touching:
            raise InputError("measured", "touches of points", "a measurement type with independent rows")
        known = problem.on(measured).linearize(np.zeros(len(problem.parameters.free))).A
        prior += known.T @ known
    weights, bound = _relaxed(A, prior, count, criterion, C)
    chosen = np.sort(_exchanged(A, prior, np.argsort(-weights)[:count], criterion, C))
    value, _ = _criterion(prior + np.einsum("kin,kim->nm", A[chosen], A[chosen]), criterion, C)
    gap = np.exp((bound - value) / n) - 1 if criterion == "D" else max(bound / value, value / bound) - 1
    sign = 1.0 if criterion == "D" else -1.0
    return Design(chosen, weights, criterion, sign * value, sign * bound, float(max(gap, 0.0)))


def _rows(problem: CalibrationProblem, q: Array, whitened: bool = True) -> Array:
    """Jacobians (M, k, n) of the candidates at nominal, in units of the scales; of positions [m] if not whitened."""
    block = problem.data.blocks[0]
    kind = block.measurement
    if kind.touching:  # the tool's position: the point's own columns have the directions that a touch does not observe
        kind = position
    if kind.points != 1:
        raise InputError("design", f"measurement '{kind.name}' between two points", "measurements of one point")
    covariance = np.broadcast_to(np.median(block.covariance, axis=0), block.covariance.shape[1:])
    torque = None if block.torque is None else np.zeros(q.shape)
    there = problem.measuring(q, kind, torque=torque, covariance=covariance)
    scale = problem.parameters.free.scale
    x = np.zeros(len(scale))
    rows = there.linearize(x).A if whitened else there.jacobian(x) * scale
    rows = rows.reshape(len(q), -1, len(scale))
    return rows if whitened else rows[:, [i for i, d in enumerate(kind.components.values()) if d == "length"]]


def _criterion(M: Array, criterion: str, C: Array) -> tuple[float, Array]:
    """Return the value, to be maximized, and Z: tr(A_i Z A_i') is what the relaxed criterion gains from candidate i."""
    inverse = np.asarray(np.linalg.inv(M), dtype=float)
    if criterion == "D":
        return float(np.linalg.slogdet(M)[1]), inverse
    return -float(np.sum(inverse * C.T)), inverse @ C @ inverse


def _relaxed(A: Array, prior: Array, count: int, criterion: str, C: Array) -> tuple[Array, float]:
    """Maximize over {0 <= w <= 1, sum w = count} by multiplicative steps; weights and a bound on the optimum.

    The criteria are concave, so that the gradient at any weights bounds them all.
    """
    n = A.shape[2]
    w = np.full(len(A), count / len(A))
    bound = np.inf
    flat = A.reshape(-1, n)
    power = 1.0 if criterion == "D" else 0.5
    for _ in range(MOST_STEPS):
        M = prior + (flat * np.repeat(w, A.shape[1])[:, None]).T @ flat
        value, Z = _criterion(M, criterion, C)
        gain = np.sum((flat @ Z) * flat, axis=1).reshape(len(A), -1).sum(axis=1)
        bound = min(bound, float(value + np.sort(gain)[-count:].sum() - gain @ w))
        off = (bound - value) / (n if criterion == "D" else abs(value))
        if off <= 2e-3:
            break
        # min(1, mu v) with mu such that the sum is count
        v = w * np.maximum(gain, 1e-300) ** power
        order = np.argsort(-v)
        mu = (count - np.arange(count)) / np.cumsum(v[order][::-1])[::-1][:count]  # if that many weights are 1
        w = np.minimum(1.0, mu[np.argmax(mu * v[order[:count]] <= 1)] * v)
    return w, bound


def _exchanged(A: Array, prior: Array, chosen: np.ndarray, criterion: str, C: Array) -> np.ndarray:
    """Exchange single configurations while that improves the criterion."""
    picked = [int(k) for k in chosen]
    eye = np.eye(A.shape[1])
    for _ in range(MOST_PASSES):
        changed = False
        for place in range(len(picked)):
            others = [c for c in picked if c != picked[place]]
            inverse = np.linalg.inv(prior + np.einsum("kin,kim->nm", A[others], A[others]))
            small = np.einsum("kin,nm,kjm->kij", A, inverse, A, optimize=True) + eye
            if criterion == "D":
                score = np.linalg.slogdet(small)[1]
            else:
                middle = np.einsum("kin,nm,kjm->kij", A, inverse @ C @ inverse, A, optimize=True)
                score = np.trace(np.linalg.solve(small, middle), axis1=1, axis2=2)
            score[others] = -np.inf
            best = int(np.argmax(score))
            if score[best] > score[picked[place]] * (1 + 1e-9 * np.sign(score[picked[place]])):
                picked[place], changed = best, True
        if not changed:
            break
    return np.array(picked)


TIE = 1e-6
"""Relative difference of sizes that is rounding: the order of the parameters decides then."""


@dataclass(frozen=True, eq=False, repr=False)
class Observability(Brief):
    """Identifiability of the n identified parameters (``names``) in a number of ``configurations``.

    ``singular_values`` (n,) are those of the whitened Jacobian in units of the scales: the change of the data, in
    standard deviations of the noise, for a deviation of one scale along that direction. Zeros are unidentifiable
    directions, and ``rank`` is the number of identifiable combinations. ``unidentifiable`` are parameters on which no
    measurement depends. ``redundant`` are combinations, name to coefficient [mm, mrad], along which the parameters may
    change without changing any measurement; their largest coefficient is 1. ``base`` are the base parameters that the
    data determine, each a sum, name to coefficient [mm, mrad]: the first name has coefficient 1, the others are
    redundant parameters that add to it (QR with column pivoting). ``condition`` is the largest over the smallest
    nonzero singular value.

    >>> import rpim_opt as ro
    >>> found = ro.problem.observe(ro.load("rank_deficient").problem)
    >>> len(found.names), found.rank, len(found.redundant), found.unidentifiable
    (45, 30, 12, ('beta5', 'theta6', 'ratio6'))
    """

    names: tuple[str, ...]
    singular_values: Array
    rank: int
    configurations: int
    unidentifiable: tuple[str, ...]
    redundant: tuple[dict[str, float], ...]
    base: tuple[dict[str, float], ...]
    condition: float

    @property
    def weak(self) -> int:
        """Number of identifiable combinations that the data determine less precisely than the prior."""
        return int(np.count_nonzero(self.singular_values[: self.rank] < 1))

    def _short(self) -> str:
        return f"{self.rank} of {len(self.names)} combinations identifiable, condition {self.condition:.3g}"

    def __str__(self) -> str:
        indices = ", ".join(f"{name} {value:.3g}" for name, value in self.indices.items())
        weak = f", {self.weak} of them more precisely from the prior than from the data" if self.weak else ""
        lines = [
            f"{self.rank} of {len(self.names)} parameter combinations are identifiable{weak}.",
            f"Condition number {self.condition:.3g} in prior scales and noise; observability {indices}.",
        ]
        if self.unidentifiable:
            lines.append(f"Unidentifiable: {', '.join(self.unidentifiable)}.")
        if self.redundant:
            named = "; ".join(map(combination, self.redundant))
            lines.append(f"Redundant combinations, without effect on the data (mm, mrad): {named}.")
        return "\n".join(lines)

    @property
    def indices(self) -> dict[str, float]:
        """Observability indices O1 to O5 on the identifiable combinations, larger is better.

        With singular values s_1 >= ... >= s_r and N configurations (Sun and Hollerbach 2008, ICRA)::

            O1 = (s_1 ... s_r)^(1/r) / sqrt(N)    O2 = s_r / s_1    O3 = s_r    O4 = s_r^2 / s_1    O5 = 1 / sum 1/s_i
        """
        s = self.singular_values[: self.rank]
        return {
            "O1": float(np.exp(np.mean(np.log(s))) / np.sqrt(self.configurations)),
            "O2": float(s[-1] / s[0]),
            "O3": float(s[-1]),
            "O4": float(s[-1] ** 2 / s[0]),
            "O5": float(1 / np.sum(1 / s)),
        }


def observe(problem: Source) -> Observability:
    """Return the observability of a problem's identified parameters, with data in memory or in blocks.

    It is linearized at nominal, where redundancies are exact. It depends on configurations, scales and covariance, not
    on measured values.
    """
    free = problem.parameters.free
    x = np.zeros(len(free))
    model = problem.linearize(x)
    s = model.svd[1]
    A, rank = model.qr_factor[: len(x), : len(x)], model.rank
    length = np.linalg.norm(A, axis=0)
    blind = length <= 1e-10 * length.max()
    # redundant columns are often parallel and equally long: the first counts as the longest, independent of rounding
    pivot = scipy.linalg.qr(A * (1 - TIE * np.arange(len(x))), mode="r", pivoting=True)[1][:rank]
    # column rest[j] = sum_i W_ij column pivot[i]
    rest = np.setdiff1d(np.arange(len(x)), pivot)
    Q, R = np.linalg.qr(A[:, pivot])
    W = np.linalg.solve(R, Q.T @ A[:, rest])
    W = np.where(np.abs(W) > 1e-6, W, 0.0)
    nulls = np.zeros((len(rest), len(x)))  # a sparse basis of the null space
    nulls[:, pivot] = -W.T
    nulls[np.arange(len(rest)), rest] = 1.0
    nulls = nulls[~blind[rest]] * free.scale
    # the first of the largest counts as one: rounding must not determine the sign of d6 - tool_z
    size = np.abs(nulls)
    largest = np.argmax(size >= (1 - TIE) * size.max(axis=1, keepdims=True), axis=1)
    nulls /= np.take_along_axis(nulls, largest[:, None], axis=1)
    in_order = sorted(nulls, key=lambda null: tuple(np.flatnonzero(null)))
    base = []
    for i in np.argsort(pivot):
        sums = W[i] * free.scale[pivot[i]] / free.scale[rest]
        added = {free.names[k]: float(v) for k, v in zip(rest, sums, strict=True) if v}
        base.append({free.names[pivot[i]]: 1.0} | added)
    return Observability(
        names=free.names, singular_values=s, rank=rank,
        configurations=sum(len(np.unique(part.data.configuration)) for part in problem.rows()),
        unidentifiable=tuple(n for n, b in zip(free.names, blind, strict=True) if b),
        redundant=tuple({free.names[k]: float(null[k]) for k in np.flatnonzero(null)} for null in in_order),
        base=tuple(base), condition=float(s[0] / s[rank - 1]),
    )  # fmt: skip


def combination(terms: dict[str, float]) -> str:
    """Return a combination as text, ``d2 + 0.5 d3``."""
    text = ""
    for name, value in terms.items():
        size = "" if abs(abs(value) - 1) < 5e-4 else f"{abs(value):.3g} "
        sign = ("" if value > 0 else "-") if not text else (" + " if value > 0 else " - ")
        text += f"{sign}{size}{name}"
    return text
