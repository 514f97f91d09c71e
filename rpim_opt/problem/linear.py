"""A calibration problem linearized: whitened, scaled equations and their QR factor."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import get_lapack_funcs
from scipy.linalg import svd as scipy_svd

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import Brief, counted
from rpim_opt.robot.parameters import Parameters

RANK_TOLERANCE = 1e-10
"""Singular values below this part of the largest count as zero: unidentifiable directions."""


@dataclass(frozen=True, eq=False, repr=False)
class LinearModel(Brief):
    """A calibration linearized about a deviation z_k: A z ~ b, dimensionless.

    A (m, n) = Sigma^-1/2 J S is the whitened identification Jacobian in units of the scales, and b (m,) = Sigma^-1/2 r
    + A z_k, so that z is the *total* deviation in units of the scales. ``group`` (m,) are the numbers of the equations'
    configurations; ``parameters`` are the n identified ones.

    ``constrained`` states that measured values are constraints (a plane, a sphere): a robot shrunk to a point satisfies
    them, so that their residuals do not determine the noise. ``stands_for`` is the number of equations that a rotation
    reduced to A and b, None if they were not reduced; ``offset`` is the constant of the loss beside |A z - b|^2;
    ``factor`` multiplies squares in units of the noise, 1 unless a loss sets it.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("paper_arm").problem
    >>> model = problem.linearize(np.zeros(len(problem.parameters.free)))
    >>> model.A.shape, model.equations, model.rank, model.qr_factor.shape
    ((27, 26), 27, 20, (27, 27))
    """

    A: Array
    b: Array
    group: np.ndarray
    parameters: Parameters
    constrained: bool = False
    stands_for: int | None = None
    offset: float = 0.0
    factor: float = 1.0

    def _short(self) -> str:
        return f"{counted(self.equations, 'equation')}, {counted(self.A.shape[1], 'parameter')}"

    @property
    def equations(self) -> int:
        """Number of equations m, those of the data where A and b were reduced from them."""
        return len(self.b) if self.stands_for is None else self.stands_for

    @cached_property
    def svd(self) -> tuple[Array, Array, Array]:
        """U'b (n,), s (n,), V' (n, n) of A = U diag(s) V'; s below `RANK_TOLERANCE` times the largest are zero."""
        n, R = self.A.shape[1], self.qr_factor
        U, s, Vt = svd(R[:n, :n])
        s = np.where(s > RANK_TOLERANCE * s[0], s, 0.0)
        return U.T @ R[:n, n], s, Vt

    @cached_property
    def qr_factor(self) -> Array:
        """QR factor R (n+1, n+1) of [A b], upper triangular: |A z - b| = |R [z; -1]| for every z."""
        return reduced_rows(np.column_stack([self.A, self.b]))

    @cached_property
    def members(self) -> tuple[np.ndarray, np.ndarray]:
        """(m,) the place of every equation's configuration in the order of their numbers; (N,) how many each has."""
        _, which, count = np.unique(self.group, return_inverse=True, return_counts=True)
        return which, count

    def norms(self, r: Array) -> Array:
        """Return the norm (N,) of every configuration's part of a residual (m,), in the order of their numbers."""
        return np.sqrt(np.bincount(self.members[0], r**2))

    @property
    def rank(self) -> int:
        """Number of identifiable directions of the parameters."""
        return int(np.count_nonzero(self.svd[1]))

    def with_values(self, b: Array) -> LinearModel:
        """Return the model with other right-hand sides (m,)."""
        return replace(self, b=b)

    def scaled(self, rows: Array) -> LinearModel:
        """Return the model with its equations multiplied by numbers (m,)."""
        return replace(self, A=self.A * rows[:, None], b=self.b * rows)


def svd(A: Array) -> tuple[Array, Array, Array]:
    """Return U, s, V' of A (m, n), of min(m, n) singular values."""
    try:
        return np.linalg.svd(A, full_matrices=False)
    except np.linalg.LinAlgError:  # LAPACK's faster driver fails with 514 parameters of 80 sessions
        return scipy_svd(A, full_matrices=False, lapack_driver="gesvd")


NARROW, WIDE, MANY = 8, 32, 100
"""Columns that are reduced together if there are few, and if there are `MANY`: the fastest choice."""
(GEQRT,) = get_lapack_funcs(("geqrt",), dtype=np.float64)


def reduced_rows(rows: Array, R: Array | None = None) -> Array:
    """Return the QR factor R (n+1, n+1) of R over ``rows`` (m, n+1): LAPACK's blocked QR, twice as fast as NumPy's."""
    n = rows.shape[1]
    stacked = np.array(rows if R is None else np.vstack([R, rows]), order="F")
    k = min(stacked.shape)
    factor = np.zeros((n, n))
    if k:
        factor[:k] = np.triu(GEQRT(min(k, WIDE if n >= MANY else NARROW), stacked, overwrite_a=True)[0][:k])
    return factor


def reduced_models(models: Iterable[LinearModel]) -> LinearModel:
    """Reduce the equations of models, at least one, to one QR factor, which stands for them all."""
    R, equations, offset, last = None, 0, 0.0, None
    for last in models:
        equations += last.equations
        offset += last.offset
        R = reduced_rows(np.column_stack([last.A, last.b]), R)
    if last is None or R is None:
        raise InputError("data", "no row", "at least one")
    group = np.zeros(len(R), dtype=int)
    return replace(last, A=R[:, :-1], b=R[:, -1], group=group, stands_for=equations, offset=offset)


Reweigh = Callable[[LinearModel, Array], tuple[LinearModel, float]]
"""``reweigh(model, z)`` returns equations whose squares, plus the returned constant, model the loss at z (n,)."""
