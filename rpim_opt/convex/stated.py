"""What a prior says of the identified parameters of one problem: numbers in units of their scales."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.robot.overlay import is_joint_offset
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
    >>> stated = ro.convex.Prior.known("a2 + a3 +- 0.05 mm").stated(parameters)  # scales of 0.5 mm
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
        >>> prior = ro.convex.Prior(joint_offset=1.0, frames=1.0)
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
        >>> stated = ro.convex.Prior(centre={"d5_mm": 2.0}).stated(ro.load("position").problem.parameters)
        >>> tenfold = stated.inside(np.full(34, 10.0))
        >>> float(stated.centre.max()), float(tenfold.centre.max()), set(tenfold.scale.tolist())
        (4.0, 0.4, {1.0})
        """
        larger = replace(self.parameters, scale=self.parameters.scale * size)
        ones = np.ones_like(self.scale)
        return replace(self, parameters=larger, centre=self.centre / size, scale=ones, rows=self.rows * size)
