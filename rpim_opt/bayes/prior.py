"""The prior of the deviations from nominal."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import UNITS, fits
from rpim_opt.bayes import prior_terms as terms
from rpim_opt.bayes.prior_terms import FIXED, FRAMES, JOINT_OFFSET, Result, ScaledPrior, Statement, default_widths
from rpim_opt.convex.arguments import places
from rpim_opt.robot.chain import ORIGIN
from rpim_opt.robot.mdh import MDH
from rpim_opt.robot.parameters import Parameters, is_joint_offset, of_session, overlay, own_name

OFFSETS = "joint offsets"  # group of parameters set at assembly; lengths and angles are machined
SESSIONS = {"length": "sessions' shifts", "angle": "sessions' turns"}  # groups of session offsets
BASE = "base"
"""The group of the base: registered with the nominal robot, it is as far off as the robot's deviations cause.

Scales of tools and other frames, which are stated by hand or unknown, are not estimated.
"""
_KIND = re.compile(r"(ecc2|ecc|[a-z]+)")
_GEOMETRY = re.compile(rf"({'|'.join(MDH)})\d+|{ORIGIN}\w+_r?[xyz]")


@dataclass(frozen=True)
class Prior:
    """The prior of the deviations from nominal.

    By default deviations have Student's t with the parameters' scales, times three for joint offsets, which are set at
    assembly, and times ten for frames. The data estimate a factor for each group: lengths, angles and joint offsets,
    whose factors are similar a priori, and the base. `stated` returns the prior of a problem in numbers.

    ``centre`` are prior means of deviations by name, pattern or group with a unit as in `Parameters.scaled`,
    ``{"theta5_mrad": 4.0}``, zero by default; ``scale`` are prior standard deviations, ``{"theta?_mrad": 10.0,
    "tool_mm": 2.0}``, which are final: no factor for joint offsets or frames and no estimated scale of the base
    multiplies them. ``joint_offset`` and ``frames`` are those factors, the latter for base, reflectors and anchors.
    ``tails`` are the degrees of freedom of Student's t for the robot's geometry; infinity means a normal distribution.

    ``groups`` are patterns of robot parameters that share an estimated scale of their own: ``(("a?", "d?"),
    ("alpha?",))``. Of the others, lengths, angles (both with a URDF's origins), joint offsets and every model extension
    share one each; session offsets have one for shifts and one for rotations.

    ``statements`` are about linear combinations (`known`, `from_result`). ``optional`` are keys of centre and scale
    (`from_population`) that are dropped if the marginal likelihood is against them. InputError for invalid tails,
    factors or patterns.

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
    optional: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", dict(self.centre))
        object.__setattr__(self, "scale", dict(self.scale))
        groups = [tuple(group.split() if isinstance(group, str) else group) for group in self.groups]
        for group in groups:
            if not group or not all(isinstance(pattern, str) and pattern for pattern in group):
                raise InputError("prior, key groups", f"{group!r}", 'names or patterns of parameters, "a? d?"')
        object.__setattr__(self, "groups", tuple(groups))
        object.__setattr__(self, "statements", tuple(self.statements))
        for key in ("tails", "joint_offset", "frames"):
            value = getattr(self, key)
            finite = key == "tails" or np.isfinite(value)
            if isinstance(value, bool) or not (value > 0 and finite):
                raise InputError(f"prior, key {key}", f"{value}", "a number above zero")

    @classmethod
    def known(cls, text: str) -> Prior:
        """Return the prior with a known linear combination of parameters added.

        ``"a2 + a3 = 612.3 +- 0.05 mm"`` states the parameters' values, ``"a2 + a3 +- 0.05 mm"`` that they are nominal,
        and ``"a2 + a3 = nominal + 0.2 +- 0.05 mm"`` their deviation. If prior scales and noise are estimated (the
        default), the standard deviation is absolute; with one weight, given or chosen by a rule, the weight and the
        estimated noise multiply it like the rest of the prior. InputError for any other text.
        """
        from rpim_opt.convex.constraint_parser import combination  # texts are parsed only if there are any

        stated = combination(text)
        (combined,) = stated.sums
        row = tuple(factor / stated.limit for factor in combined.factors)
        dimensions = (UNITS[stated.unit].dimension,) * len(row)
        values = (-combined.constant / stated.limit,)
        reference = None if combined.nominal else (0.0,) * len(row)
        return cls(statements=(Statement(combined.names, dimensions, (row,), values, reference, text=text.strip()),))

    @classmethod
    def from_result(
        cls, result: Result, inflate: float = 1.0, without: Sequence[str] = (), *, noise: float | None = None
    ) -> Prior:
        """Return the posterior of an earlier calibration as a prior, replacing the scales of its parameters.

        For a linear model, calibrating with it at weight 1 equals calibrating with both sets of data. It includes the
        earlier penalty: of several results of one robot use only the last. With estimated hyperparameters its
        covariance is `Calibration.covariance`.

        ``inflate`` multiplies its standard deviations, above 1 if the robot may have changed; parameters that match
        ``without``, patterns of replaced parts, are marginalized out; ``noise`` is the standard deviation of its
        equations in units of the declared noise, by default the estimated one. InputError for a penalty without
        covariance (lasso), and for factors that are not positive.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> first = problem.on(problem.data.take(np.arange(30)))
        >>> prior = ro.bayes.Prior.from_result(ro.calibrate(first, ro.tikhonov, ro.reml), without=("base_*",))
        >>> stated = prior.stated(problem.parameters)
        >>> int(stated.replaced.sum()), stated.rows.shape
        (28, (28, 34))
        """
        return cls(statements=(terms.posterior(result, inflate, without, noise),))

    @classmethod
    def from_population(cls, results: Sequence[Result] | Mapping[str, Result]) -> Prior:
        """Return a prior for another robot of a type from several calibrated ones: mean and standard deviation.

        It is shrunken towards the generic scales if robots or data are few (empirical Bayes, `random_effects`), and
        dropped if the marginal likelihood of the other robot's data is against it (``optional``). Names in a mapping
        appear in messages. InputError for fewer than two results, and for different nominal parameters.
        """
        from rpim_opt.bayes.population import population

        centre, width = population(results)
        return cls(centre=centre, scale=width, optional=tuple(centre))

    def where_known(self, stated: Parameters, found: Parameters) -> Parameters:
        """Return the located parameters, with known frames and known parameters at their stated values.

        This also holds for orientations, and for frames whose stated scale is not wider than that of the table.
        """
        own = overlay(stated, np.full(len(stated), np.nan), self.scale, "prior, table scale")
        known = {name for each in self.statements if not each.whole for name in each.names}
        known |= set(np.array(stated.names)[stated.placed & (own <= stated.scale)].tolist())
        known |= {name[:-1] + axis for name in known for axis in "xyz" if name[:-1].endswith("_r")}
        nominal = np.where(np.isin(stated.names, list(known)), stated.nominal, found.nominal)
        for each in (each for each in self.statements if each.reference is not None and len(each.names) == 1):
            place = stated.placed & np.isin(stated.names, each.names) & (not each.whole)
            nominal[place] = each.values[0] / each.rows[0][0]
        return replace(found, nominal=nominal)

    def without_optional(self) -> Prior:
        """Return the prior without the terms that may be left out (``optional``)."""
        centre, scale = (
            {key: value for key, value in each.items() if key not in self.optional}
            for each in (self.centre, self.scale)
        )
        return replace(self, centre=centre, scale=scale, optional=())

    def __and__(self, other: Prior) -> Prior:
        """Return both together; InputError where they contradict each other on a key."""
        if not isinstance(other, Prior):
            return NotImplemented
        both: dict[str, Any] = {}
        for key, default in vars(Prior()).items():
            mine, theirs = getattr(self, key), getattr(other, key)
            if key == "statements":
                both[key] = mine + theirs
            elif isinstance(mine, dict):
                for name in mine.keys() & theirs.keys():
                    if mine[name] != theirs[name]:
                        found = f"'{name}' as {mine[name]:g} and {theirs[name]:g}"
                        raise InputError(f"prior, table {key}", found, "one of them")
                both[key] = {**mine, **theirs}
            elif mine not in (default, theirs) and theirs != default:
                raise InputError(f"prior, key {key}", f"{mine} and {theirs}", "one of them")
            else:
                both[key] = theirs if mine == default else mine
        return Prior(**both)

    def stated(self, parameters: Parameters, *, widened: bool = True) -> ScaledPrior:
        """Return the prior of the identified parameters of a whole table, in units of their scales.

        Unless ``widened``, ``joint_offset`` and ``frames`` are ignored, so that a penalty over the scales does not
        change without statements. InputError for unknown names or patterns, units that do not fit, and statements on
        values far from nominal.
        """
        free = parameters.free
        identified = parameters.identified
        centre = overlay(parameters, np.zeros(len(parameters)), self.centre, "prior, table centre", signed=True)
        own = overlay(parameters, np.full(len(parameters), np.nan), self.scale, "prior, table scale")
        widths = parameters.scale
        if widened:
            widths = default_widths(parameters, self.joint_offset, self.frames)
        width = np.where(np.isfinite(own), own, widths)
        rows, values, replaced = [np.zeros((0, len(free)))], [np.zeros(0)], np.zeros(len(free), dtype=bool)
        for each in self.statements:
            more, right, whole = each.on(parameters)
            rows.append(more)
            values.append(right)
            replaced |= whole
        group, names = self._grouped(parameters, np.isfinite(own))
        geometry = np.array([_GEOMETRY.fullmatch(own_name(name)) is not None for name in free.names])
        return ScaledPrior(
            parameters=free,
            centre=centre[identified] / free.scale,
            scale=width[identified] / free.scale,
            rows=np.vstack(rows),
            values=np.concatenate(values),
            replaced=replaced,
            group=group,
            heavy=geometry & bool(np.isfinite(self.tails)),
            names=names,
            tails=self.tails,
        )

    def _grouped(self, parameters: Parameters, known: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        """Return every identified parameter's group by number, and the names; some scales (P,) are known."""
        for pattern in (pattern for group in self.groups for pattern in group):
            places(parameters.names, pattern, "prior, key groups")
        free = parameters.free
        keys = []
        for name, dimension in zip(free.names, free.dimensions, strict=True):
            own = own_name(name)
            groups = [group for group in self.groups if any(fits(name, pattern) for pattern in group)]
            if own.startswith(f"{BASE}_"):
                keys.append(BASE)
            elif groups:
                keys.append(" ".join(groups[0]))
            elif of_session(name):
                keys.append(SESSIONS[dimension])
            elif is_joint_offset(name):
                keys.append(OFFSETS)
            else:
                keys.append(f"{dimension}s" if _GEOMETRY.fullmatch(own) else kind_of(name))
        of_base = np.array([own_name(name).startswith(f"{BASE}_") for name in parameters.names])
        fixed = (parameters.of_curves | parameters.placed & (known | ~of_base))[parameters.identified]
        names = tuple(dict.fromkeys(key for key, alone in zip(keys, fixed, strict=True) if not alone))
        numbers = [FIXED if alone else names.index(key) for key, alone in zip(keys, fixed, strict=True)]
        return np.array(numbers, dtype=int), names


def kind_of(name: str) -> str:
    """Return the model extension of a non-geometric parameter: ``ecc`` for ``ecc_cos3``."""
    match = _KIND.match(own_name(name))
    return match[1] if match else own_name(name)
