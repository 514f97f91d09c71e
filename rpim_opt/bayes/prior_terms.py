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
"""The group of a parameter whose width is no part of any size: of what is placed, but for the base."""

JOINT_OFFSET, FRAMES = 3.0, 10.0
"""By how much the scales of joint offsets, which are set at assembly, and of frames are multiplied."""


def default_widths(parameters: Parameters, joint_offset: float = JOINT_OFFSET, frames: float = FRAMES) -> Array:
    """Return the widths (P,) [SI] of deviations of which nothing but their scales is known."""
    offsets = np.array([is_joint_offset(name) for name in parameters.names])
    factor = np.where(offsets, joint_offset, 1.0)
    factor[parameters.placed] = frames
    return factor * parameters.scale


@dataclass(frozen=True, eq=False)
class Stated:
    """A prior of the n identified parameters of a problem, in units of their scales.

    Independently of each other, with a size tau_g a group, unless a statement replaces it::

        z_j ~ centre_j + tau_g scale_j t_nu     (heavy)        z_j ~ N(centre_j, (tau_g scale_j)^2)     (others)

    (tau is 1 where there is no group), and together rows z - values ~ N(0, I).

    Parameters
    ----------
    parameters
        The identified ones.
    centre
        (n,) where deviations are expected.
    scale
        (n,) their widths, which multiply ``parameters.scale``.
    rows, values
        (k, n) and (k,) of the statements.
    replaced
        (n,) for which parameters a statement stands in the place of their own width.
    group
        (n,) the number of the group whose size a parameter has; -1 where there is none.
    heavy
        (n,) whose tails are Student's.
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
    >>> for name, width, group in list(zip(stated.parameters.names, stated.scale, stated.group))[-11:-8]:
    ...     print(name, width, group)
    theta6 3.0 2
    d6 1.0 1
    base_x 10.0 3
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
        """Whether it says no more than that deviations are about as large as their scales.

        >>> import rpim_opt as ro
        >>> prior = ro.bayes.Prior(joint_offset=1.0, frames=1.0)
        >>> prior.stated(ro.load("position").problem.parameters).plain
        True
        """
        said = self.centre.any() or len(self.rows) or self.replaced.any()
        return not said and bool((self.scale == 1).all())

    def inside(self, size: Array) -> Stated:
        """Return the same for parameters whose scales have been multiplied by ``size`` (n,): their widths are 1 there.

        Learned widths become the scales of an ordinary problem in this way.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> stated = ro.bayes.Prior(centre={"d5_mm": 2.0}).stated(ro.load("position").problem.parameters)
        >>> tenfold = stated.inside(np.full(34, 10.0))
        >>> float(stated.centre.max()), float(tenfold.centre.max()), set(tenfold.scale.tolist())
        (4.0, 0.4, {1.0})
        """
        larger = replace(self.parameters, scale=self.parameters.scale * size)
        ones = np.ones_like(self.scale)
        return replace(self, parameters=larger, centre=self.centre / size, scale=ones, rows=self.rows * size)


Vector = tuple[float, ...]
Matrix = tuple[Vector, ...]


@dataclass(frozen=True)
class _Believed:
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
        """Return the CVXPY expression."""
        terms = []
        if self.penalty is not None:
            terms.append(self._own(cp.multiply(np.array(self.keep), z - np.array(self.centre))))
        if self.rows:
            terms.append(cp.sum_squares(np.array(self.rows) @ z - np.array(self.values)))
        return sum(terms[1:], terms[0])

    def __reduce__(self) -> Any:
        arguments = [getattr(self, each.name) for each in fields(self)]
        return believed, tuple(arguments)

    def _own(self, y: Any) -> Any:
        penalty: Any = self.penalty
        if self.groups is None:
            return penalty(y)
        differences = [np.array(D) for D in self.groups]
        if penalty == SQUARES:  # of norms: the sum of all squares, and no cone
            return cp.sum_squares(np.vstack(differences) @ y)
        return penalty(cp.hstack([cp.norm(D @ y) for D in differences]))


@dataclass(frozen=True)
class _ReadyBelieved(_Believed, Ready):
    """The same of a ready penalty: equal in content is equal in meaning, and a file holds it."""

    maker = "believed"

    @property
    def stated(self) -> list[Any]:
        """The maker's name and its arguments, the penalty by its own name."""
        return [self.maker, self.penalty, self.keep, self.centre, self.rows, self.values, self.groups]

    @property
    def quadratic(self) -> Quadratic | None:
        """The quadratic that it declares to be, without squared numbers in between; None where it is something else."""
        return self._quadratic

    @cached_property
    def _quadratic(self) -> Quadratic | None:
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
    parts: list[Any] = [penalty, tuple(keep), tuple(centre), tuple(map(tuple, rows)), tuple(values), None]
    if groups is not None:
        parts[-1] = tuple(tuple(map(tuple, D)) for D in groups)
    if penalty is None or penalty in NAMED or isinstance(penalty, Ready):
        return _ReadyBelieved(*parts)
    return _Believed(*parts)


def penalized(formulation: Formulation, stated: Stated) -> Formulation:
    """Return the formulation whose penalty is that of a prior; arguments as for `Prior.penalized`."""
    if stated.plain or (formulation.penalty is None and not len(stated.rows)):
        return formulation
    keep = np.where(stated.replaced, 0.0, 1 / stated.scale)
    groups = None
    if formulation.penalty is not None and formulation.penalty_over is not None:
        groups = [listed(np.asarray(D, dtype=float)) for D in formulation.penalty_over(stated.parameters)]
    penalty = believed(
        formulation.penalty,
        keep.tolist(),
        stated.centre.tolist(),
        listed(stated.rows),
        stated.values.tolist(),
        groups,
    )
    return replace(formulation, penalty=penalty, penalty_over=None)
