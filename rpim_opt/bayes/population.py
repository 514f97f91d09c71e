"""Population prior: what several robots of one type have in common, by empirical Bayes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import UNITS, accepted_units
from rpim_opt.bayes.prior_terms import default_widths
from rpim_opt.bayes.statements import FAR, Result, of_data
from rpim_opt.robot.parameters import Parameters

SHRUNKEN = 3.0
"""As many arms the spread that all parameters have in common counts for."""
EVEN = 1.0
"""Where nothing is known: the mean square of what arms share, over that of what is their own."""
HELD = 2.0
"""As many parameters that counts for."""
PASSES, SETTLED = 1000, 1e-6
"""Of expectation and maximization; relative change of the variances that ends them."""
SIZES = np.geomspace(0.03, 30.0, 41)
"""By which a prior may be too narrow or too wide, when arms are held against it."""


@dataclass(frozen=True, eq=False)
class Arm:
    """What the data of one arm say: ``rows u - values ~ N(0, I)`` of deviations u in generic widths.

    ``rows`` (p, p), ``values`` (p,).
    """

    label: str
    rows: Array
    values: Array

    def evidence(self, centre: Array, width: Array) -> float:
        """Return -2 ln likelihood of a prior of that centre and width (p,), at the size that fits best."""
        residual = self.values - self.rows @ centre
        spread = (self.rows * width**2) @ self.rows.T
        d, Q = np.linalg.eigh(spread)
        r2 = (Q.T @ residual) ** 2
        total = 1 + SIZES[:, None] ** 2 * np.maximum(d, 0)
        return float(np.min(np.sum(np.log(total) + r2 / total, axis=1)))


@dataclass(frozen=True, eq=False)
class Learned:
    """Centre and width (p,) of another arm, in generic widths, and the part of the mean square that arms share."""

    centre: Array
    width: Array
    share: float


def learned(arms: Sequence[Arm]) -> Learned:
    """Return what arms tell of another one, by expectation and maximization.

    >>> import numpy as np
    >>> from rpim_opt.bayes.population import Arm, learned
    >>> rng = np.random.default_rng(0)
    >>> deviations = np.array([1.0, -1.0]) + 0.1 * rng.standard_normal((50, 2))
    >>> found = learned([Arm("", 1e3 * np.eye(2), 1e3 * each) for each in deviations])
    >>> found.centre.round(1), found.width.round(1), round(found.share, 2)
    (array([ 1., -1.]), array([0.1, 0.1]), 0.98)
    """
    P = np.array([arm.rows.T @ arm.rows for arm in arms])
    q = np.array([arm.rows.T @ arm.values for arm in arms])
    K, n = q.shape
    s2 = np.full(n, 1 / (1 + EVEN))
    tau2, ratio = 1 / (1 + EVEN), EVEN
    for _ in range(PASSES):
        m, C_m, d2 = _expected(P, q, s2, ratio)
        m2 = m**2 + np.diag(C_m)
        before = np.append(s2, ratio)
        s2 = (SHRUNKEN * tau2 + d2.sum(axis=0) + m2 / ratio) / (SHRUNKEN + K + 1)
        tau2 = (n + HELD) / (np.sum(1 / s2) + HELD * (1 + EVEN))
        ratio = (float(np.sum(m2 / s2)) + HELD * EVEN) / (n + HELD)
        if np.max(np.abs(np.append(s2, ratio) / before - 1)) <= SETTLED:
            break
    m, C_m, _ = _expected(P, q, s2, ratio)
    return Learned(m, np.sqrt(s2 + np.diag(C_m)), ratio / (1 + ratio))


def _expected(P: Array, q: Array, s2: Array, ratio: float) -> tuple[Array, Array, Array]:
    """Return mean (n,) and covariance (n, n) of what arms share, and mean squares (K, n) of what is their own."""
    n = len(s2)
    s = np.sqrt(s2)
    eye = np.eye(n)
    left = np.linalg.inv(eye + s[:, None] * P * s)  # in units of s: what the data leave open of an arm's own part
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
class Fleet:
    """What several arms of one type have in common, by empirical Bayes.

    Deviations of arm k, in generic widths: what all share, and what is its own::

        u_kj = m_j + d_kj,    d_kj ~ N(0, s_j^2),    m_j ~ N(0, rho s_j^2),    s_j^2 ~ scaled inverse chi^2 (3, tau^2)

    rho, tau and s are learned by expectation and maximization from what the data of each arm say, without the prior
    that it was calibrated with, and with its frames integrated out (Efron and Morris 1975, JASA 70:311; Dempster,
    Laird and Rubin 1977, JRSS B 39:1). With few arms, or with data that say little, every s_j is nearly tau.

    Parameters
    ----------
    names, dimensions
        The p parameters of the robot.
    nominal
        (p,) from which deviations count [SI].
    generic
        (p,) generic widths [SI].
    arms
        What the data of each say.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> halves = [problem.on(problem.data.take(rows)) for rows in (np.arange(20), np.arange(20, 40))]
    >>> fleet = ro.bayes.Fleet.of([ro.calibrate(half, ro.tikhonov, ro.reml) for half in halves])  # the same arm twice
    >>> fleet.share > 0.9, fleet.centre.shape, fleet.width.shape, bool((fleet.gain > 0).all())
    (True, (25,), (25,), True)
    """

    names: tuple[str, ...]
    dimensions: tuple[str, ...]
    nominal: Array
    generic: Array
    arms: tuple[Arm, ...]

    @classmethod
    def of(cls, results: Sequence[Result] | Mapping[str, Result]) -> Fleet:
        """Return what the results of several arms of one type have in common.

        Parameters
        ----------
        results
            One an arm, of the same nominal robot; with names where a mapping has them.

        Raises
        ------
        InputError
            For fewer than two, and for arms of another nominal robot.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, ro.reml)
        >>> print(str(ro.bayes.Fleet.of({"left": result, "right": result})).splitlines()[0])
        2 arms share 100 % of their mean square deviation.
        """
        named = _named(results)
        first = next(iter(named.values())).problem.parameters
        every = [name for each in named.values() for name in _robot(each.problem.parameters.free)]
        names = tuple(dict.fromkeys(every))
        table = first.take(_places(first.names, names))
        empty = cls(names, table.dimensions, table.nominal, default_widths(table), ())
        arms = tuple(empty._seen(label, result) for label, result in named.items())
        return replace(empty, arms=arms)

    @cached_property
    def _learned(self) -> Learned:
        return learned(self.arms)

    @property
    def centre(self) -> Array:
        """(p,) deviations that are expected of another arm [SI]."""
        return self._learned.centre * self.generic

    @property
    def width(self) -> Array:
        """(p,) how far those of another arm lie from it [SI]."""
        return self._learned.width * self.generic

    @property
    def share(self) -> float:
        """Which part of a parameter's mean square deviation the arms have in common, from 0 to 1."""
        return self._learned.share

    @cached_property
    def gain(self) -> Array:
        """(K,) by how much each arm is more likely with what the others tell than with generic widths, 2 ln ratio.

        Both priors with the size that fits the arm best. A negative one: this arm is different from the others.
        """
        others = [learned([other for other in self.arms if other is not arm]) for arm in self.arms]
        return np.array([_gain(arm, found) for arm, found in zip(self.arms, others, strict=True)])

    def _seen(self, label: str, result: Result) -> Arm:
        """Return what an arm's data say of the parameters of the fleet."""
        free = result.problem.parameters.free
        robot, rows, values = of_data(result, default_widths(free))
        places = _places(self.names, robot)
        own = result.problem.parameters.take(_places(result.problem.parameters.names, robot))
        full = np.zeros((len(rows), len(self.names)))
        full[:, places] = rows * self.generic[places]
        return Arm(label, full, values + rows @ _moved(own, self.nominal[places], label))

    def tables(self) -> tuple[dict[str, float], dict[str, float]]:
        """Return centre and width of every parameter by its name with a unit, as `Prior` has them.

        >>> import rpim_opt as ro
        >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, ro.reml)
        >>> centre, width = ro.bayes.Fleet.of([result, result]).tables()
        >>> list(centre)[:2], centre.keys() == width.keys()
        (['alpha1_rad', 'a1_m'], True)
        """
        keys, sizes = [], []
        for name, dimension in zip(self.names, self.dimensions, strict=True):
            unit = accepted_units(dimension)[0]
            keys.append(f"{name}_{unit}")
            sizes.append(UNITS[unit].si)
        centre = (self.centre / sizes).tolist()
        width = (self.width / sizes).tolist()
        return dict(zip(keys, centre, strict=True)), dict(zip(keys, width, strict=True))

    def __str__(self) -> str:
        """Return what was learned as a person reads it."""
        lines = [f"{len(self.arms)} arms share {100 * self.share:.0f} % of their mean square deviation."]
        for arm, gain in zip(self.arms, self.gain, strict=True):
            verdict = "as the others tell" if gain > 0 else "unlike the others"
            lines.append(f"{arm.label}: {verdict} (2 ln likelihood ratio {gain:+.1f})")
        return "\n".join(lines)


def _named(results: Sequence[Result] | Mapping[str, Result]) -> dict[str, Result]:
    """Return results by the names of their arms."""
    if isinstance(results, Mapping):
        named = dict(results)
    else:
        named = {f"arm {i}": result for i, result in enumerate(results, start=1)}
    if len(named) < 2:
        raise InputError("Prior.from_fleet", f"{len(named)} results", "those of two arms or more")
    return named


def _places(names: Sequence[str], some: Sequence[str]) -> np.ndarray:
    """Return where some parameters stand in a table."""
    for name in some:
        if name not in names:
            raise InputError("Prior.from_fleet", f"parameter '{name}' that not all have", "arms of one type")
    return np.array([names.index(name) for name in some])


def _robot(free: Parameters) -> list[str]:
    return [name for name, frame in zip(free.names, free.of_frames, strict=True) if not frame]


def _moved(own: Parameters, nominal: Array, label: str) -> Array:
    """Return by how much an arm's nominal values (p,) [SI] differ from those of the first one."""
    apart = own.nominal - nominal
    far = np.abs(apart) > FAR * own.scale
    if far.any():
        found = f"nominal {own.names[int(np.argmax(far))]} of '{label}', far from that of the first arm"
        raise InputError("Prior.from_fleet", found, "arms of one type")
    return apart


def _gain(arm: Arm, told: Learned) -> float:
    """Return how much more likely an arm is with what others tell than with generic widths, 2 ln ratio."""
    p = len(told.centre)
    return arm.evidence(np.zeros(p), np.ones(p)) - arm.evidence(told.centre, told.width)
