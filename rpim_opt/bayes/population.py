"""Population prior: what several robots of one type have in common, by empirical Bayes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import UNITS, accepted_units
from rpim_opt.bayes.prior_terms import FAR, Result, default_widths, equation_variance, marginal, triangle_of

PRIOR_ROBOTS = 3.0
"""Degrees of freedom of the hyperprior of the parameters' variances: as many robots it counts for."""
PRIOR_RATIO, PRIOR_PARAMETERS = 1.0, 2.0
"""Prior mean square of what robots share over that of what is their own; as many parameters it counts for."""
ITERATIONS, SETTLED = 1000, 1e-6
"""Of expectation and maximization; relative change of the variances that ends them."""
SIZES = np.geomspace(0.03, 30.0, 41)
"""Factors on a prior's width, of which the most likely one counts where robots are compared with it."""


@dataclass(frozen=True, eq=False)
class Arm:
    """Data of one robot: rows (p, p) u - values (p,) ~ N(0, I), of deviations u in generic widths."""

    label: str
    rows: Array
    values: Array

    def evidence(self, centre: Array, width: Array) -> float:
        """Return -2 ln likelihood of a prior of that centre and width (p,), at the size that fits best."""
        residual = self.values - self.rows @ centre
        d, Q = np.linalg.eigh((self.rows * width**2) @ self.rows.T)
        total = 1 + SIZES[:, None] ** 2 * np.maximum(d, 0)
        return float(np.min(np.sum(np.log(total) + (Q.T @ residual) ** 2 / total, axis=1)))


@dataclass(frozen=True, eq=False)
class RandomEffects:
    """Centre and width (p,) of another robot, in generic widths, and the part of the mean square that robots share."""

    centre: Array
    width: Array
    share: float


def random_effects(arms: Sequence[Arm]) -> RandomEffects:
    """Return what robots tell of another one, by expectation and maximization; the model is `PopulationPrior`'s."""
    P = np.array([arm.rows.T @ arm.rows for arm in arms])
    q = np.array([arm.rows.T @ arm.values for arm in arms])
    K, n = q.shape
    s2 = np.full(n, 1 / (1 + PRIOR_RATIO))
    tau2, ratio = 1 / (1 + PRIOR_RATIO), PRIOR_RATIO
    for _ in range(ITERATIONS):
        m, C_m, d2 = expectation(P, q, s2, ratio)
        m2 = m**2 + np.diag(C_m)
        before = np.append(s2, ratio)
        s2 = (PRIOR_ROBOTS * tau2 + d2.sum(axis=0) + m2 / ratio) / (PRIOR_ROBOTS + K + 1)
        tau2 = (n + PRIOR_PARAMETERS) / (np.sum(1 / s2) + PRIOR_PARAMETERS * (1 + PRIOR_RATIO))
        ratio = (float(np.sum(m2 / s2)) + PRIOR_PARAMETERS * PRIOR_RATIO) / (n + PRIOR_PARAMETERS)
        if np.max(np.abs(np.append(s2, ratio) / before - 1)) <= SETTLED:
            break
    m, C_m, _ = expectation(P, q, s2, ratio)
    return RandomEffects(m, np.sqrt(s2 + np.diag(C_m)), ratio / (1 + ratio))


def expectation(P: Array, q: Array, s2: Array, ratio: float) -> tuple[Array, Array, Array]:
    """Return mean (n,) and covariance (n, n) of what robots share, and mean squares (K, n) of what is their own."""
    s = np.sqrt(s2)
    eye = np.eye(len(s2))
    left = np.linalg.inv(eye + s[:, None] * P * s)  # in units of s: what the data leave open of a robot's own part
    H = (eye - left) / np.outer(s, s)
    h = np.einsum("kij,kj->ki", left, s * q) / s
    C_m = np.linalg.inv(H.sum(axis=0) + np.diag(1 / (ratio * s2)))
    m = C_m @ h.sum(axis=0)
    C = left * np.outer(s, s)
    own = np.einsum("kij,kj->ki", C, q + m / s2) - m
    turned = C / s2 - eye
    variance = np.einsum("kii->ki", C) + np.einsum("kij,jl,kil->ki", turned, C_m, turned)
    return m, C_m, own**2 + variance


@dataclass(frozen=True, eq=False)
class PopulationPrior:
    """What several robots of one type have in common: a model of random effects, by empirical Bayes.

    Deviations of robot k, in generic widths: what all share, and what is its own::

        u_kj = m_j + d_kj,    d_kj ~ N(0, s_j^2),    m_j ~ N(0, rho s_j^2),    s_j^2 ~ scaled inverse chi^2 (3, tau^2)

    rho, tau and s are estimated by expectation and maximization from the data of each robot, without the prior that it
    was calibrated with, and with its frames integrated out (Efron and Morris 1975, JASA 70:311; Dempster, Laird and
    Rubin 1977, JRSS B 39:1). With few robots, or with data that say little, every s_j is nearly tau.

    Parameters
    ----------
    names, dimensions
        The p parameters of the robot.
    nominal, generic
        (p,) from which deviations count, and their generic widths [SI].
    arms
        What the data of each robot say.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> halves = [problem.on(problem.data.take(rows)) for rows in (np.arange(20), np.arange(20, 40))]
    >>> results = [ro.calibrate(half, ro.tikhonov, ro.reml) for half in halves]  # the same robot twice
    >>> found = ro.bayes.PopulationPrior.of(results)
    >>> found.share > 0.9, found.centre.shape, found.width.shape, bool((found.gain > 0).all())
    (True, (25,), (25,), True)
    """

    names: tuple[str, ...]
    dimensions: tuple[str, ...]
    nominal: Array
    generic: Array
    arms: tuple[Arm, ...]

    @classmethod
    def of(cls, results: Sequence[Result] | Mapping[str, Result]) -> PopulationPrior:
        """Return what the results of several robots of one type have in common.

        Parameters
        ----------
        results
            One a robot, of the same nominal parameters; with names where a mapping has them.

        Raises
        ------
        InputError
            For fewer than two, and for robots of other nominal parameters.
        """
        if isinstance(results, Mapping):
            named = dict(results)
        else:
            named = {f"arm {i}": result for i, result in enumerate(results, start=1)}
        if len(named) < 2:
            raise InputError("Prior.from_population", f"{len(named)} results", "those of two arms or more")
        tables = [each.problem.parameters for each in named.values()]
        every = [name for p in tables for name, frame in zip(p.free.names, p.free.of_frames, strict=True) if not frame]
        names = tuple(dict.fromkeys(every))
        table = tables[0].take(_places(tables[0].names, names))
        empty = cls(names, table.dimensions, table.nominal, default_widths(table), ())
        return replace(empty, arms=tuple(empty._seen(label, result) for label, result in named.items()))

    @cached_property
    def _effects(self) -> RandomEffects:
        return random_effects(self.arms)

    @property
    def centre(self) -> Array:
        """(p,) prior mean of the deviations of another robot [SI]."""
        return self._effects.centre * self.generic

    @property
    def width(self) -> Array:
        """(p,) their prior standard deviation [SI]."""
        return self._effects.width * self.generic

    @property
    def share(self) -> float:
        """Which part of a parameter's mean square deviation the robots have in common, from 0 to 1."""
        return self._effects.share

    @cached_property
    def gain(self) -> Array:
        """(K,) 2 ln likelihood ratio of each robot, prior from the others over generic widths, each at its best size.

        A negative one: it is different from the others.
        """
        p = len(self.generic)
        found = []
        for arm in self.arms:
            told = random_effects([other for other in self.arms if other is not arm])
            found.append(arm.evidence(np.zeros(p), np.ones(p)) - arm.evidence(told.centre, told.width))
        return np.array(found)

    def _seen(self, label: str, result: Result) -> Arm:
        """Return what a robot's data say of the parameters of the population."""
        table = result.problem.parameters
        robot, rows, values = of_data(result, default_widths(table.free))
        places = _places(self.names, robot)
        own = table.take(_places(table.names, robot))
        apart = own.nominal - self.nominal[places]
        far = np.abs(apart) > FAR * own.scale
        if far.any():
            found = f"nominal {own.names[int(np.argmax(far))]} of '{label}', far from that of the first arm"
            raise InputError("Prior.from_population", found, "arms of one type")
        full = np.zeros((len(rows), len(self.names)))
        full[:, places] = rows * self.generic[places]
        return Arm(label, full, values + rows @ apart)

    def tables(self) -> tuple[dict[str, float], dict[str, float]]:
        """Return centre and width of every parameter by its name with a unit, as `Prior` has them."""
        units = [accepted_units(dimension)[0] for dimension in self.dimensions]
        keys = [f"{name}_{unit}" for name, unit in zip(self.names, units, strict=True)]
        si = [UNITS[unit].si for unit in units]
        centre = dict(zip(keys, (self.centre / si).tolist(), strict=True))
        return centre, dict(zip(keys, (self.width / si).tolist(), strict=True))

    def __str__(self) -> str:
        """Return what was estimated as a person reads it."""
        lines = [f"{len(self.arms)} arms share {100 * self.share:.0f} % of their mean square deviation."]
        for arm, gain in zip(self.arms, self.gain, strict=True):
            verdict = "agrees with the others" if gain > 0 else "differs from the others"
            lines.append(f"{arm.label}: {verdict} (2 ln likelihood ratio {gain:+.1f})")
        return "\n".join(lines)


def of_data(result: Result, widths: Array) -> tuple[tuple[str, ...], Array, Array]:
    """Return names (p), rows (k, p) [1/SI] and values (k,) of what a result's data alone say of the robot.

    Frames have prior standard deviations ``widths`` (n,) [SI] and are integrated out.
    """
    free = result.problem.parameters.free
    R = result.linear.triangle / np.sqrt(equation_variance(result))
    n = len(free)
    own = np.eye(n)[free.of_frames] * (free.scale / widths)[free.of_frames, None]
    robot = np.flatnonzero(~free.of_frames)
    rows, values = marginal(np.vstack([R[:, :n], own]), np.append(R[:, n], np.zeros(len(own))), robot)
    both = triangle_of(np.column_stack([rows, values]))
    p = len(robot)
    return tuple(free.names[i] for i in robot), both[:p, :p] / free.scale[robot], both[:p, p]


def _places(names: Sequence[str], some: Sequence[str]) -> np.ndarray:
    """Return where some parameters stand in a table."""
    for name in some:
        if name not in names:
            raise InputError("Prior.from_population", f"parameter '{name}' that not all have", "arms of one type")
    return np.array([names.index(name) for name in some])
