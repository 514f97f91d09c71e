"""A squared penalty with a weight a group: what its minimum is, and how it moves with the weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.patterns import fits
from rpim_opt.problem.linear import RANK_TOLERANCE, LinearModel
from rpim_opt.robot.parameter_names import own_name
from rpim_opt.robot.parameters import Parameters

OTHERS = "others"
"""What the parameters are called that no group names: their weight is 1."""


@dataclass(frozen=True, eq=False)
class Minimum:
    """The minimum of the objective at some weights.

    ``z`` (n,), ``inverse`` (n, n) of half the Hessian, ``misfit`` |A z - b|^2 with the statements, ``sizes`` (G,) the
    squared deviations of the groups.
    """

    z: Array
    inverse: Array
    misfit: float
    sizes: Array


@dataclass(frozen=True, eq=False)
class Grouped:
    """Minimize |A z - b|^2 + sum_j w_j own_j (z_j - centre_j)^2 + |rows z - values|^2, with a weight w_g a group.

    Parameters
    ----------
    model
        The equations, in units of the scales without weights.
    own
        (n,) 1 for parameters that are penalized, 0 for those that only statements hold.
    centre
        (n,) about which.
    rows, values
        (k, n) and (k,) of statements.
    names
        Of the G groups whose weights are to be chosen.
    member
        (n,) the number of a parameter's group; -1: its weight is given.
    given
        (n,) weights of the others.
    told
        Given weights by the keys that they were given under.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> model = problem.linearize(np.zeros(34))
    >>> kinds = ro.convex.groups.Grouped.of(model, {"alpha theta": None, "a d": None, "tool": 2.0})
    >>> kinds.names, kinds.penalty(np.log([0.1, 10.0])).round(1)[:5], kinds.at(np.zeros(2)).z.shape
    (('alpha theta', 'a d'), array([ 0.1, 10. ,  0.1, 10. ,  0.1]), (34,))
    """

    model: LinearModel
    own: Array
    centre: Array
    rows: Array
    values: Array
    names: tuple[str, ...]
    member: np.ndarray
    given: Array
    told: Mapping[str, float]

    @classmethod
    def of(cls, model: LinearModel, weights: Mapping[str, Any]) -> Grouped:
        """Return the penalty |z|^2 in groups: a number is a given weight, anything else is to be chosen."""
        n = len(model.parameters)
        found = members(model.parameters, weights)
        return cls(model, np.ones(n), np.zeros(n), np.zeros((0, n)), np.zeros(0), *found)

    def penalty(self, t: Array) -> Array:
        """Return the weights (n,) of the parameters at logarithms t (G,) of those of the groups."""
        chosen = self.member >= 0
        weights = self.given.copy()
        weights[chosen] = np.exp(t)[self.member[chosen]]
        return weights * self.own

    @cached_property
    def triangle(self) -> tuple[Array, Array]:
        """Rows R (k, n) and r (k,) with |R z - r|^2 the misfit of data and statements."""
        T = self.model.triangle
        return np.vstack([T[:, :-1], self.rows]), np.append(T[:, -1], self.values)

    def at(self, t: Array) -> Minimum:
        """Return the minimum at logarithms t (G,) of the weights."""
        R, r = self.triangle
        z, inverse = minimum(R, r, self.penalty(t), self.centre)
        away = self.own * (z - self.centre) ** 2
        return Minimum(z, inverse, float(np.sum((R @ z - r) ** 2)), self.sums(away))

    def sums(self, each: Array) -> Array:
        """Return the sums (G,) over the groups of numbers (n,)."""
        chosen = self.member >= 0
        sums = np.bincount(self.member[chosen], each[chosen], minlength=len(self.names))
        return sums.astype(float)  # whole numbers where there is nothing to add

    def slopes(self, t: Array, minimum: Minimum) -> Array:
        """Return dz / dt (n, G) at a minimum."""
        pull = self.penalty(t) * (minimum.z - self.centre)
        columns = np.zeros((len(pull), len(self.names)))
        chosen = np.flatnonzero(self.member >= 0)
        columns[chosen, self.member[chosen]] = pull[chosen]
        return -minimum.inverse @ columns

    def robot(self) -> Reduced:
        """Return the same without its fixed effects: frames that no group of frames alone has, and what is not held.

        How far a tripod stands says nothing about a gear. The rows are projected off their columns.
        """
        frames = self.model.parameters.placed
        alone = [g for g in range(len(self.names)) if frames[self.member == g].all()]
        free = (self.own == 0) | (frames & ~np.isin(self.member, alone))
        R, r = self.triangle
        columns = R[:, free]
        norms = np.linalg.norm(columns, axis=0)
        U, s, _ = np.linalg.svd(columns / np.where(norms > 0, norms, 1.0), full_matrices=False)
        U = U[:, s > RANK_TOLERANCE * np.max(s, initial=0.0)]
        kept = np.flatnonzero(~free)
        rest = replace(
            self,
            own=self.own[kept],
            centre=self.centre[kept],
            member=self.member[kept],
            given=self.given[kept],
        )
        left = R[:, kept] - U @ (U.T @ R[:, kept])
        equations = self.model.equations + len(self.values) - U.shape[1]
        return Reduced(rest, left, r - U @ (U.T @ r), equations)


@dataclass(frozen=True, eq=False)
class Reduced:
    """What is left without the fixed effects: |R z - r|^2 of R (k, n'), and how many equations that stands for."""

    grouped: Grouped
    R: Array
    r: Array
    equations: int


def minimum(R: Array, r: Array, penalty: Array, centre: Array) -> tuple[Array, Array]:
    """Return the minimum z (n,) of |R z - r|^2 + sum penalty_j (z_j - centre_j)^2, and half its Hessian's inverse.

    By QR of the rows stacked, columns of one length first: misfit and weights may differ by many orders.
    """
    root = np.sqrt(penalty)
    stacked = np.vstack([R, np.diag(root)])
    right = np.append(r, root * centre)
    size = np.linalg.norm(stacked, axis=0)
    size[size == 0] = 1.0
    Q, T = np.linalg.qr(stacked / size)
    if np.min(np.abs(np.diag(T)), initial=1.0) <= RANK_TOLERANCE:  # neither data nor penalty decide a direction
        inverse = np.linalg.pinv(T, rcond=RANK_TOLERANCE)
    else:
        inverse = solve_triangular(T, np.eye(len(size)))
    scaled = inverse / size[:, None]
    return scaled @ (Q.T @ right), scaled @ scaled.T


# --- which parameters a group has ------------------------------------------------------------------------------


class Members(NamedTuple):
    """Names of the groups to choose, every parameter's group (n,), given weights (n,), and those by their keys."""

    names: tuple[str, ...]
    member: np.ndarray
    given: Array
    told: dict[str, float]


def members(free: Parameters, weights: Mapping[str, Any]) -> Members:
    """Return which group every identified parameter is in, and which weights are given.

    Parameters
    ----------
    free
        The identified parameters.
    weights
        By patterns, names, or kinds (``"alpha"``, ``"tool"``, ``"length"``), several with a space between; a number is
        a given weight. ``"by_kind"`` and ``"by_link"`` stand for a group each.

    Raises
    ------
    InputError
        For a key that names nothing, a parameter in two groups, and weights that are not above zero.
    """
    member = np.full(len(free), -1)
    given = np.ones(len(free))
    taken: dict[int, str] = {}
    names: list[str] = []
    told: dict[str, float] = {}
    for key, weight in _written_out(free, weights).items():
        places = _places(key, free)
        for i in places:
            if i in taken:
                found = f"'{free.names[i]}' in '{taken[i]}' and in '{key}'"
                raise InputError("weight", found, "every parameter in one group")
            taken[i] = key
        if isinstance(weight, int | float | np.number) and not isinstance(weight, bool):
            if not (np.isfinite(weight) and weight > 0):
                raise InputError("weight", f"{weight} for '{key}'", "a finite number above zero, or a selector")
            given[places] = told[key] = float(weight)
        else:
            member[places] = len(names)
            names.append(key)
    if len(taken) < len(free):
        told[OTHERS] = 1.0
    return Members(tuple(names), member, given, told)


def _written_out(free: Parameters, weights: Mapping[str, Any]) -> dict[str, Any]:
    """Return the mapping with every kind, or every link, in the place of ``by_kind`` and ``by_link``."""
    if not weights:
        raise InputError("weight", "an empty mapping", "patterns of parameters with their weights")
    every = {"by_kind": _kind, "by_link": _link}
    written: dict[str, Any] = {}
    for key, weight in weights.items():
        if key in every:
            written |= dict.fromkeys(dict.fromkeys(map(every[key], free.names)), weight)
        else:
            written[key] = weight
    return written


def _kind(name: str) -> str:
    name = own_name(name)
    if name[-1].isdigit():
        return name.rstrip("0123456789")
    return name.split("_")[0]


def _link(name: str) -> str:
    name = own_name(name)
    stem = name.rstrip("0123456789")
    if stem == name:
        return name.split("_")[0]
    return f"link{name.removeprefix(stem)}"


def _places(key: Any, free: Parameters) -> list[int]:
    """Return which parameters a key names."""
    if not isinstance(key, str) or not key.split():
        raise InputError("weight", f"key {key!r}", "patterns of parameters, 'a? d?'")
    places: list[int] = []
    groups = free.groups
    for token in key.split():
        met = [i for i, name in enumerate(free.names) if _meant(token, name, groups[i])]
        if not met:
            known = [*dict.fromkeys(map(_kind, free.names)), *free.names]
            raise InputError("weight", f"'{token}'", "kinds, names or patterns: " + choices(token, known))
        places += [i for i in met if i not in places]
    return places


def _meant(token: str, name: str, group: str) -> bool:
    return fits(name, token) or token in (_kind(name), _link(name), group)
