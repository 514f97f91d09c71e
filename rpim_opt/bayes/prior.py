"""The prior: what is assumed of the deviations before the data are seen."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import fits
from rpim_opt.bayes import statements
from rpim_opt.bayes.prior_terms import FIXED, FRAMES, JOINT_OFFSET, Stated, default_widths, penalized
from rpim_opt.bayes.statements import Result, Statement, posterior
from rpim_opt.convex.formulation import Formulation
from rpim_opt.robot.mdh import MDH, MDH_DIMENSION
from rpim_opt.robot.parameter_names import is_joint_offset, of_session, own_name
from rpim_opt.robot.parameters import Parameters, overlay

OFFSETS = "joint offsets"
"""The group of what is set at assembly; what is machined are ``lengths`` and ``angles``."""
SESSIONS = {"length": "sessions' shifts", "angle": "sessions' turns"}
"""Groups of what the readings of a session have in common."""
BASE = "base"
"""The group of the base, which is expected where the drawing's robot puts it: as far from there as its deviations lead.

Tools and other places are stated by hand, or nobody measured them: they have no size.
"""
_FAMILY = re.compile(r"(ecc2|ecc|[a-z]+)")
_GEOMETRY = re.compile(rf"({'|'.join(MDH)})\d+")


@dataclass(frozen=True)
class Prior:
    """The prior of the deviations, before the data are seen.

    By default deviations are about as large as the scales of the parameters say, some of them much larger (Student's
    t), joint offsets three times as large, because they are set at assembly, and frames may be anywhere within ten of
    their scales. How large a group of them is altogether, the data may tell: lengths, angles and joint offsets have a
    size each, which are alike a priori, and the base has one. `stated` says it of a problem in numbers.

    Parameters
    ----------
    centre
        Deviations that are expected, by name, pattern or group with a unit as in `Parameters.scaled`:
        ``{"theta5_mrad": 4.0}``. Zero where nothing is said.
    scale
        How far they lie from it, keys as for ``centre``: ``{"theta?_mrad": 10.0, "tool_mm": 2.0}``. What stands here
        is taken at its word: neither ``joint_offset`` nor ``frames`` multiplies it, nor the size of the base.
    tails
        Degrees of freedom of the Student's t of the robot's own geometry; infinity: a normal distribution.
    groups
        Parameters of the robot that share a size of their own, as patterns: ``(("a?", "d?"), ("alpha?",))``. Of what
        they leave out of its geometry the lengths, the angles and the joint offsets share one each, and so does every
        family of other terms (compliance, eccentricity, ...); the shifts of sessions share one, their turns another.
    joint_offset
        By how much the scale of a joint's theta is multiplied.
    frames
        By how much the scales of frames (base, reflectors, anchors) are multiplied. Of the base
        that is what is expected before the data.
    statements
        What is known of linear combinations: `known`, `gaussian`, `from_result`.
    doubted
        Whether centre and scale are left out where the evidence of the data is against them: `from_population`.

    Raises
    ------
    InputError
        For tails, factors or patterns that cannot be.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> Prior = ro.bayes.Prior
    >>> prior = Prior(scale={"theta?_mrad": 10.0}) & Prior.known("a2 + a3 +- 0.05 mm")
    >>> stated = prior.stated(ro.load("position").problem.parameters)
    >>> float(stated.scale.max()), len(stated.values), stated.names  # frames, statements, groups
    (10.0, 1, ('angles', 'lengths', 'joint offsets', 'base'))
    """

    centre: Mapping[str, float] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)
    tails: float = 3.0
    groups: tuple[tuple[str, ...], ...] = ()
    joint_offset: float = JOINT_OFFSET
    frames: float = FRAMES
    statements: tuple[Statement, ...] = ()
    doubted: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", dict(self.centre))
        object.__setattr__(self, "scale", dict(self.scale))
        object.__setattr__(self, "groups", tuple(_patterns(group) for group in self.groups))
        object.__setattr__(self, "statements", tuple(self.statements))
        for key in ("tails", "joint_offset", "frames"):
            value = getattr(self, key)
            finite = key == "tails" or np.isfinite(value)
            if isinstance(value, bool) or not (value > 0 and finite):
                raise InputError(f"prior, key {key}", f"{value}", "a number above zero")

    @classmethod
    def known(cls, text: str, value: float | None = None, *, sd: float | None = None) -> Prior:
        """Return the prior that also knows a linear combination of parameters.

        Parameters
        ----------
        text
            ``"a2 + a3 = 612.3 +- 0.05 mm"``, of the parameters' values; ``"a2 + a3 +- 0.05 mm"``, nominal to that
            standard deviation; ``"a2 + a3 = nominal + 0.2 +- 0.05 mm"``; or the combination alone.
        value
            Of the combination of the parameters' values [SI]; nominal by default.
        sd
            Standard deviation [SI].

        Raises
        ------
        InputError
            For a text that is no such statement, or an sd that is not above zero.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> one = ro.bayes.Prior.known("a2 + a3 = nominal +- 0.05 mm")
        >>> float(one.stated(ro.load("position").problem.parameters).rows.max())  # scale 0.5 mm
        10.0
        """
        return cls(statements=(statements.known(text, value, sd),))

    @classmethod
    def gaussian(
        cls,
        mean: Mapping[str, float],
        covariance: Any = None,
        *,
        precision: Any = None,
        sd: Any = None,
    ) -> Prior:
        """Return the prior that some deviations have a normal distribution, in the place of their own scales.

        Parameters
        ----------
        mean
            Of p deviations, by name with unit: ``{"a2_mm": 0.3, "theta3_mrad": 0.0}``.
        covariance, precision
            (p, p) in the units of the keys; a precision may leave directions open.
        sd
            (p,) in those units, or one number, for independent deviations.

        Raises
        ------
        InputError
            For a matrix that is no covariance or precision, and if not one of the three is given.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> prior = ro.bayes.Prior.gaussian({"a2_mm": 0.3, "a3_mm": 0.0}, [[0.04, 0.03], [0.03, 0.04]])
        >>> stated = prior.stated(ro.load("position").problem.parameters)
        >>> int(stated.replaced.sum()), stated.rows.shape
        (2, (2, 34))
        """
        return cls(statements=(statements.gaussian(dict(mean), covariance, precision, sd),))

    @classmethod
    def from_result(
        cls,
        result: Result,
        inflate: float = 1.0,
        without: Sequence[str] = (),
        *,
        noise: float | None = None,
    ) -> Prior:
        """Return the posterior of an earlier calibration as the prior of the next, in the place of its own scales.

        Where the model is linear, calibrating with it at weight 1 equals calibrating with the data of both. It holds
        the earlier penalty already: of several results of one arm only the last one is to be taken. Where sizes were
        learned it is as wide as `Calibration.covariance`, which knows of them and of heavy tails.

        Parameters
        ----------
        result
            A calibration whose penalty is a squared norm.
        inflate
            Factor on its standard deviations: above 1 where the robot may have changed.
        without
            Patterns of parameters that were set up anew, ``("base_*", "tool_*")``: the others are taken whatever
            those were.
        noise
            Standard deviation of its equations in units of the declared noise; what it found by default.

        Raises
        ------
        InputError
            For a result without covariance (lasso), and for factors that are not above zero.

        Examples
        --------
        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> first, second = (problem.on(problem.data.take(rows)) for rows in (np.arange(30), np.arange(30, 40)))
        >>> prior = ro.bayes.Prior.from_result(ro.calibrate(first, ro.tikhonov, ro.reml), without=("base_*",))
        >>> stated = prior.stated(problem.parameters)
        >>> int(stated.replaced.sum()), stated.rows.shape
        (28, (28, 34))
        """
        return cls(statements=(posterior(result, inflate, without, noise),))

    @classmethod
    def from_population(cls, results: Sequence[Result] | Mapping[str, Result]) -> Prior:
        """Return the prior of another arm of the type of several that were calibrated: their centre and spread.

        Both are estimated by empirical Bayes, and are shrunken towards the generic widths where arms or data are few
        (`PopulationPrior` has the evidence). Tails stay heavy, and where the marginal likelihood of another arm's data
        is against it, this prior is left out (``doubted``).

        Parameters
        ----------
        results
            Two or more, of the same nominal robot; squared losses, or what a robust one trusts.

        Raises
        ------
        InputError
            For fewer than two, and for arms of another nominal robot.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, ro.reml)
        >>> prior = ro.bayes.Prior.from_population([result, result, result])
        >>> stated = prior.stated(result.problem.parameters)
        >>> bool(stated.centre.any()), bool(stated.heavy.any()), len(stated.rows)
        (True, True, 0)
        """
        from rpim_opt.bayes.population import PopulationPrior

        centre, width = PopulationPrior.of(results).tables()
        return cls(centre=centre, scale=width, doubted=True)

    def __and__(self, other: Prior) -> Prior:
        """Return both together; InputError where they contradict each other on a key."""
        if not isinstance(other, Prior):
            return NotImplemented
        plain = Prior()
        both: dict[str, Any] = {}
        for key in (each.name for each in fields(self)):
            mine, theirs, default = getattr(self, key), getattr(other, key), getattr(plain, key)
            if key == "statements":
                both[key] = mine + theirs
            elif isinstance(mine, dict):
                both[key] = _merged(mine, theirs, key)
            elif mine not in (default, theirs) and theirs != default:
                raise InputError(f"prior, key {key}", f"{mine} and {theirs}", "one of them")
            else:
                both[key] = theirs if mine == default else mine
        return Prior(**both)

    def without_centre(self) -> Prior:
        """Return the same without centre and scale.

        >>> import rpim_opt as ro
        >>> prior = ro.bayes.Prior(centre={"d5_mm": 0.5}, tails=5.0)
        >>> prior.without_centre() == ro.bayes.Prior(tails=5.0)
        True
        """
        return replace(self, centre={}, scale={}, doubted=False)

    def stated(self, parameters: Parameters, *, widened: bool = True) -> Stated:
        """Return what it says of the identified parameters of a problem, in units of their scales.

        Parameters
        ----------
        parameters
            The whole table of the problem.
        widened
            Whether ``joint_offset`` and ``frames`` count. Without them a penalty over the scales stays what it is
            where nothing is stated.

        Raises
        ------
        InputError
            For names or patterns that the table has not, units that do not fit, values far from nominal.

        Examples
        --------
        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> parameters = ro.load("position").problem.parameters
        >>> stated = ro.bayes.Prior(centre={"d5_mm": 0.5}).stated(parameters)
        >>> stated.centre[stated.centre != 0], sorted(set(stated.scale.tolist()))  # joints, joint offsets, frames
        (array([1.]), [1.0, 3.0, 10.0])
        """
        free = parameters.free
        identified = parameters.identified
        centre = overlay(parameters, np.zeros(len(parameters)), self.centre, "prior, table centre", signed=True)
        widths = parameters.scale
        if widened:
            widths = default_widths(parameters, self.joint_offset, self.frames)
        width = overlay(parameters, widths, self.scale, "prior, table scale")
        rows, values, replaced = [np.zeros((0, len(free)))], [np.zeros(0)], np.zeros(len(free), dtype=bool)
        for each in self.statements:
            more, right, whole = each.on(parameters)
            rows.append(more)
            values.append(right)
            replaced |= whole
        group, names = self._grouped(parameters)
        return Stated(
            parameters=free,
            centre=centre[identified] / free.scale,
            scale=width[identified] / free.scale,
            rows=np.vstack(rows),
            values=np.concatenate(values),
            replaced=replaced,
            group=group,
            heavy=self._heavy(free),
            names=names,
            tails=self.tails,
        )

    def penalized(self, formulation: Formulation, stated: Stated) -> Formulation:
        """Return the formulation whose penalty is that of the prior; itself, where nothing is stated.

        The penalty becomes, with zero in the place of what the statements replace::

            penalty((z - centre) / scale) + |rows z - values|^2

        Parameters
        ----------
        formulation
            Any: its penalty sees the deviations from the centre; without a penalty the statements alone are one.
        stated
            What `stated` says of the problem.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> prior = ro.bayes.Prior.known("a2 + a3 = nominal + 0.3 +- 0.001 mm")
        >>> mine = prior.penalized(ro.tikhonov, prior.stated(problem.parameters))
        >>> result = ro.calibrate(problem, mine, weight=1.0)
        >>> names = problem.parameters.free.names
        >>> round(1e3 * float(result.x[names.index("a2")] + result.x[names.index("a3")]), 2)  # [mm]
        0.3
        """
        return penalized(formulation, stated)

    # --- groups and tails where nothing is stated ----------------------------------------------------------------

    def _heavy(self, free: Parameters) -> np.ndarray:
        geometry = np.array([_GEOMETRY.fullmatch(own_name(name)) is not None for name in free.names])
        return geometry & bool(np.isfinite(self.tails))

    def _grouped(self, parameters: Parameters) -> tuple[np.ndarray, tuple[str, ...]]:
        """Return the number of every identified parameter's group, and the groups' names."""
        for group in self.groups:
            for pattern in group:
                if not any(fits(name, pattern) for name in parameters.names):
                    raise InputError("prior, key groups", f"'{pattern}'", choices(pattern, parameters.names))
        free = parameters.free
        keys = [self._group_of(name, dimension) for name, dimension in zip(free.names, free.dimensions, strict=True)]
        fixed = self._fixed(parameters)
        names = tuple(dict.fromkeys(k for k, alone in zip(keys, fixed, strict=True) if not alone))
        number = {name: i for i, name in enumerate(names)}
        found = [FIXED if alone else number[key] for key, alone in zip(keys, fixed, strict=True)]
        return np.array(found, dtype=int), names

    def _fixed(self, parameters: Parameters) -> np.ndarray:
        """Return which identified parameters have a width that is no part of any size: tools, and what is stated."""
        stated = np.isfinite(overlay(parameters, np.full(len(parameters), np.nan), self.scale, "prior, table scale"))
        of_base = np.array([_of_base(name) for name in parameters.names])
        return (parameters.placed & (stated | ~of_base))[parameters.identified]

    def _group_of(self, name: str, dimension: str) -> str:
        if _of_base(name):
            return BASE
        for group in self.groups:
            if any(fits(name, pattern) for pattern in group):
                return " ".join(group)
        if of_session(name):
            return SESSIONS[dimension]
        if is_joint_offset(name):
            return OFFSETS
        found = _GEOMETRY.fullmatch(own_name(name))
        if found is None:
            return family_of(name)
        return f"{MDH_DIMENSION[found[1]]}s"


def family_of(name: str) -> str:
    """Return the family of a term of a joint that is not its geometry: ``ecc`` of ``ecc_cos3``.

    >>> from rpim_opt.bayes.prior import family_of
    >>> [family_of(name) for name in ("compliance2", "ecc_sin3", "ecc2_cos1", "ratio6")]
    ['compliance', 'ecc', 'ecc2', 'ratio']
    """
    found = _FAMILY.match(own_name(name))
    if found is None:
        return own_name(name)
    return found[1]


def _of_base(name: str) -> bool:
    return own_name(name).startswith(f"{BASE}_")


def _patterns(group: str | Iterable[str]) -> tuple[str, ...]:
    """Return the patterns of a group, which may stand in one text: ``"a? d?"``."""
    patterns = tuple(group.split() if isinstance(group, str) else group)
    if not patterns or not all(isinstance(pattern, str) and pattern for pattern in patterns):
        raise InputError("prior, key groups", f"{group!r}", 'names or patterns of parameters, "a? d?"')
    return patterns


def _merged(mine: Mapping[str, float], theirs: Mapping[str, float], key: str) -> dict[str, float]:
    for name in mine.keys() & theirs.keys():
        if mine[name] != theirs[name]:
            raise InputError(f"prior, table {key}", f"'{name}' as {mine[name]:g} and {theirs[name]:g}", "one of them")
    return {**mine, **theirs}
