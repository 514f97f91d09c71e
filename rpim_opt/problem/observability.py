"""What the data can tell: singular values, redundant and base parameters, observability indices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import Brief
from rpim_opt.problem.linear import reduced_rows
from rpim_opt.problem.source import Source

FAINT = 1e-2
"""Coefficients of a combination (in millimetres and milliradians) below this part of its largest are left out."""
TIE = 1e-6
"""Sizes that differ by less than this part are the same but for rounding: the order of the parameters decides."""


@dataclass(frozen=True, eq=False, repr=False)
class Observability(Brief):
    """How well a set of configurations shows the identified parameters.

    Parameters
    ----------
    names
        The n identified parameters.
    singular_values
        (n,) of the whitened Jacobian in units of the scales: how many standard deviations of the noise a
        deviation of one scale along that direction moves the data. Zeros are unseen directions.
    rank
        Number of directions that the data see.
    configurations
        Number of configurations.
    unseen
        Parameters that no measurement depends on.
    redundant
        Combinations, name to coefficient [mm, mrad], along which the parameters may change without changing any
        measurement; the largest coefficient is 1.
    base
        Base parameters: what the data determine, each a sum, name to coefficient [mm, mrad]. The first name has
        coefficient 1; the redundant parameters add to it (QR with column pivoting).
    condition
        Largest over smallest singular value that is not zero.
    raw_condition
        |U| |U^-1| of the Jacobian in millimetres and radians, neither whitened nor scaled (paper, Eq. 24);
        infinite or above 1e15 where it is singular.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> found = ro.problem.observe(ro.load("rank_deficient").problem)
    >>> len(found.names), found.rank, len(found.redundant), found.unseen
    (45, 30, 12, ('beta5', 'theta6', 'ratio6'))
    >>> found = ro.problem.observe(ro.load("scara").problem)
    >>> {name: f"{value:.2g}" for name, value in found.indices.items()}
    {'O1': '1.4e+02', 'O2': '0.00017', 'O3': '11', 'O4': '0.002', 'O5': '4.5'}
    """

    names: tuple[str, ...]
    singular_values: Array
    rank: int
    configurations: int
    unseen: tuple[str, ...]
    redundant: tuple[dict[str, float], ...]
    base: tuple[dict[str, float], ...]
    condition: float
    raw_condition: float

    def _short(self) -> str:
        return f"{self.rank} of {len(self.names)} directions seen, condition {self.condition:.3g}"

    @property
    def indices(self) -> dict[str, float]:
        """Observability indices O1 to O5 on the directions that the data see, larger is better.

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


def observe(problem: Source, x: Array | None = None) -> Observability:
    """Return how well the data of a problem show its identified parameters.

    Parameters
    ----------
    problem
        In memory or in parts. Measured values do not matter, configurations, scales and covariance do.
    x
        (n,) deviations [SI] to linearize at; nominal by default, where redundancies are exact.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> found = ro.problem.observe(ro.load("paper_arm").problem)
    >>> f"{found.rank} of {len(found.names)} directions are seen, condition {found.condition:.3g}"
    '20 of 26 directions are seen, condition 2.87e+03'
    """
    x = np.zeros(len(problem.parameters.free)) if x is None else x
    model, free = problem.linearize(x), problem.parameters.free
    _, s, _ = model.svd
    A, rank, names = model.triangle[: len(x), : len(x)], model.rank, free.names
    length = np.linalg.norm(A, axis=0)
    blind = length <= 1e-10 * length.max()
    units = np.where(np.array(free.dimensions) == "length", 1.0, 1e3)  # mm per mm, mm per rad
    configurations = 0
    U = np.zeros((0, len(names)))
    for part in problem.rows():
        configurations += len(np.unique(part.data.configuration))
        U = reduced_rows(part.jacobian(x) * units, U)
    raw = np.linalg.svd(U, compute_uv=False)
    return Observability(
        names=names,
        singular_values=s,
        rank=rank,
        configurations=configurations,
        unseen=tuple(n for n, b in zip(names, blind, strict=True) if b),
        redundant=_redundant(A, rank, names, free.scale, blind),
        base=_base(A, rank, names, free.scale),
        condition=float(s[0] / s[rank - 1]),
        raw_condition=float(raw[0] / raw[-1]) if model.equations >= len(names) and raw[-1] > 0 else float("inf"),
    )


def _pivoted(A: Array, rank: int) -> tuple[np.ndarray, Array]:
    """Return the pivots and W (rank, n - rank): column pivot[rank + j] = sum_i W_ij column pivot[i]."""
    pivot = _independent(A, rank)
    rest = np.setdiff1d(np.arange(A.shape[1]), pivot)
    Q, R = np.linalg.qr(A[:, pivot])
    W = np.linalg.solve(R, Q.T @ A[:, rest])
    return np.concatenate([pivot, rest]), np.where(np.abs(W) > 1e-6, W, 0.0)


def _independent(A: Array, rank: int) -> np.ndarray:
    """Return independent columns (rank,): each time the first that is about as long as any, less those before it.

    Redundant columns are often parallel and of one length: without a margin rounding would choose between them.
    """
    left = A.copy()
    chosen: list[int] = []
    for _ in range(rank):
        length = np.linalg.norm(left, axis=0)
        length[chosen] = 0.0
        chosen.append(int(np.argmax(length >= (1 - TIE) * length.max())))
        direction = left[:, chosen[-1]] / length[chosen[-1]]
        left -= np.outer(direction, direction @ left)
    return np.array(chosen, dtype=int)


def _redundant(
    A: Array, rank: int, names: tuple[str, ...], scale: Array, blind: np.ndarray
) -> tuple[dict[str, float], ...]:
    """Sparse basis of the null space, in the order of the parameters: one dependent column with what it depends on."""
    pivot, W = _pivoted(A, rank)
    combinations = []
    for j, dependent in enumerate(pivot[rank:]):
        if blind[dependent]:
            continue
        null = np.zeros(len(names))
        null[dependent] = 1.0
        null[pivot[:rank]] = -W[:, j]
        null *= scale
        # the first of the largest counts as one, or rounding would choose the sign of d6 - tool_z
        null /= null[np.argmax(np.abs(null) >= (1 - TIE) * np.abs(null).max())]
        combinations.append(np.where(np.abs(null) > FAINT, null, 0.0))
    combinations.sort(key=lambda null: tuple(np.flatnonzero(null)))
    return tuple({names[k]: float(null[k]) for k in np.flatnonzero(null)} for null in combinations)


def _base(A: Array, rank: int, names: tuple[str, ...], scale: Array) -> tuple[dict[str, float], ...]:
    pivot, W = _pivoted(A, rank)
    sums = []
    for i in np.argsort(pivot[:rank]):
        own, others = pivot[i], pivot[rank:]
        kept = {k: W[i, j] * scale[own] / scale[k] for j, k in enumerate(others) if W[i, j]}
        sums.append({names[own]: 1.0} | {names[k]: float(v) for k, v in kept.items() if abs(v) > FAINT})
    return tuple(sums)


def combination(terms: dict[str, float]) -> str:
    """Return a combination as text, ``d2 + 0.5 d3``."""
    text = ""
    for name, value in terms.items():
        size = "" if abs(abs(value) - 1) < 5e-4 else f"{abs(value):.3g} "
        sign = ("" if value > 0 else "-") if not text else (" + " if value > 0 else " - ")
        text += f"{sign}{size}{name}"
    return text
