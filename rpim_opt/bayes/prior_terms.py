"""A prior of one problem in numbers, and the convex penalty that it amounts to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.bayes.statements import listed
from rpim_opt.convex.constraints import Ready
from rpim_opt.convex.expressions import SQUARES, cp, named
from rpim_opt.convex.formulation import NAMED, Formulation
from rpim_opt.convex.quadratic import Quadratic
from rpim_opt.robot.parameter_names import is_joint_offset
from rpim_opt.robot.parameters import Parameters

FIXED = -1
"""The group of a parameter whose prior scale is not estimated: of frames, but for the base."""

JOINT_OFFSET, FRAMES = 3.0, 10.0
"""Factors on the scales of joint offsets, which are set at assembly, and of frames."""


def default_widths(parameters: Parameters, joint_offset: float = JOINT_OFFSET, frames: float = FRAMES) -> Array:
    """Return the prior standard deviations (P,) [SI] where nothing but the scales is stated."""
    offsets = np.array([is_joint_offset(name) for name in parameters.names])
    factor = np.where(offsets, joint_offset, 1.0)
    factor[parameters.placed] = frames
    return factor * parameters.scale


@dataclass(frozen=True, eq=False)
class Stated:
    """A prior of the n identified parameters of a problem, in units of their scales.

    Independently of each other, with an estimated scale tau_g a group, unless a statement replaces it::

        z_j ~ centre_j + tau_g scale_j t_nu     (heavy)        z_j ~ N(centre_j, (tau_g scale_j)^2)     (others)

    (tau is 1 without a group), and together rows z - values ~ N(0, I).

    Parameters
    ----------
    parameters
        The identified ones.
    centre, scale
        (n,) prior means and standard deviations, the latter times ``parameters.scale``.
    rows, values
        (k, n) and (k,) of the statements.
    replaced
        (n,) which parameters have a statement in the place of a prior of their own.
    group
        (n,) the number of the group whose scale a parameter has; -1 without one.
    heavy
        (n,) which have Student's t.
    names
        Of the groups, in the order of their numbers.
    tails
        Degrees of freedom of Student's t.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> parameters = ro.load("position").problem.parameters
    >>> stated = ro.bayes.Prior.known("a2 + a3 +- 0.05 mm").stated(parameters)  # scales of 0.5 mm
    >>> stated.names, stated.rows.shape, stated.rows[stated.rows != 0]
    (('angles', 'lengths', 'joint offsets', 'base'), (1, 34), array([10., 10.]))
    """

    parameters: Parameters
    centre: Array
    scale: Array
    rows: Array
    values: Array
    replaced: np.ndarray
    group: np.ndarray
    heavy: np.ndarray
    names: tuple[str, ...]
    tails: float

    @property
    def plain(self) -> bool:
        """Whether it says no more than the parameters' scales."""
        said = self.centre.any() or len(self.rows) or self.replaced.any()
        return not said and bool((self.scale == 1).all())

    def inside(self, size: Array) -> Stated:
        """Return the same for parameters whose scales have been multiplied by ``size`` (n,): ``scale`` is 1 there."""
        larger = replace(self.parameters, scale=self.parameters.scale * size)
        ones = np.ones_like(self.scale)
        return replace(self, parameters=larger, centre=self.centre / size, scale=ones, rows=self.rows * size)

    def penalized(self, formulation: Formulation) -> Formulation:
        """Return the formulation whose penalty is that of the prior; itself, where nothing is stated.

        The penalty becomes, with zero in the place of what the statements replace::

            penalty((z - centre) / scale) + |rows z - values|^2

        Examples
        --------
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> stated = ro.bayes.Prior.known("a2 + a3 = nominal + 0.3 +- 0.001 mm").stated(problem.parameters)
        >>> result = ro.calibrate(problem, stated.penalized(ro.tikhonov), weight=1.0)
        >>> names = problem.parameters.free.names
        >>> round(1e3 * float(result.x[names.index("a2")] + result.x[names.index("a3")]), 2)  # [mm]
        0.3
        """
        if self.plain or (formulation.penalty is None and not len(self.rows)):
            return formulation
        keep = np.where(self.replaced, 0.0, 1 / self.scale)
        groups = None
        if formulation.penalty is not None and formulation.penalty_over is not None:
            groups = [listed(np.asarray(D, dtype=float)) for D in formulation.penalty_over(self.parameters)]
        parts = (keep.tolist(), self.centre.tolist(), listed(self.rows), self.values.tolist(), groups)
        return replace(formulation, penalty=believed(formulation.penalty, *parts), penalty_over=None)


Vector = tuple[float, ...]
Matrix = tuple[Vector, ...]


@dataclass(frozen=True)
class _Penalty:
    """penalty(keep (z - centre)) + |rows z - values|^2; of norms |D_k keep (z - centre)| where groups D_k are given.

    ``keep`` is 1 / scale, and zero for what the statements replace.
    """

    penalty: Callable[[Any], Any] | None
    keep: Vector
    centre: Vector
    rows: Matrix
    values: Vector
    groups: tuple[Matrix, ...] | None = None

    def __call__(self, z: Any) -> Any:
        terms = []
        if self.penalty is not None:
            terms.append(self._own(cp.multiply(np.array(self.keep), z - np.array(self.centre))))
        if self.rows:
            terms.append(cp.sum_squares(np.array(self.rows) @ z - np.array(self.values)))
        return sum(terms[1:], terms[0])

    def __reduce__(self) -> Any:
        return believed, tuple(getattr(self, each.name) for each in fields(self))

    def _own(self, y: Any) -> Any:
        penalty: Any = self.penalty
        if self.groups is None:
            return penalty(y)
        differences = [np.array(D) for D in self.groups]
        if penalty == SQUARES:  # of norms: the sum of all squares, and no cone
            return cp.sum_squares(np.vstack(differences) @ y)
        return penalty(cp.hstack([cp.norm(D @ y) for D in differences]))


@dataclass(frozen=True)
class _ReadyPenalty(_Penalty, Ready):
    """The same of a ready penalty: equal in content is equal in meaning, and a file holds it."""

    maker = "believed"

    @property
    def stated(self) -> list[Any]:
        """The maker's name and its arguments, the penalty by its own name."""
        return [self.maker, self.penalty, self.keep, self.centre, self.rows, self.values, self.groups]

    @cached_property
    def quadratic(self) -> Quadratic | None:  # type: ignore[override]
        """The quadratic that it declares to be, without squared numbers in between; None where it is something else."""
        if self.penalty not in (None, SQUARES) or (self.penalty is None and not self.rows):
            return None
        n = len(self.centre)
        L = [np.zeros((0, n))]
        c = [np.zeros(0)]
        if self.penalty is not None:
            own = np.diag(self.keep)
            if self.groups is not None:
                own = np.vstack([np.array(D) for D in self.groups]) @ own
            L.append(own)
            c.append(own @ np.array(self.centre))
        if self.rows:
            L.append(np.array(self.rows))
            c.append(np.array(self.values))
        return _reduced(np.vstack(L), np.concatenate(c))


def _reduced(L: Array, c: Array) -> Quadratic:
    """Return |L z - c|^2 with no more rows than unknowns, diagonal where L is."""
    n = L.shape[1]
    if len(L) == n and not np.any(L - np.diag(np.diag(L))):
        return Quadratic(np.diag(L).copy(), c)
    if len(L) <= n:
        return Quadratic(L, c)
    R: Any = np.linalg.qr(np.column_stack([L, c]), mode="r")
    return Quadratic(R[:n, :n], R[:n, n], float(R[n, n] ** 2))


def believed(
    penalty: Callable[[Any], Any] | None, keep: Any, centre: Any, rows: Any, values: Any, groups: Any
) -> Callable[[Any], Any]:
    """Return the penalty of a prior."""
    penalty = named(penalty)
    if groups is not None:
        groups = tuple(tuple(map(tuple, D)) for D in groups)
    kept: Any = penalty
    ready = penalty is None or penalty in NAMED or isinstance(penalty, Ready)
    kind = _ReadyPenalty if ready else _Penalty
    return kind(kept, tuple(keep), tuple(centre), tuple(map(tuple, rows)), tuple(values), groups)
