"""The prior of one problem in numbers: known combinations of parameters, scales, and the equivalent penalty."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import display
from rpim_opt.convex.constraints import FAR, Ready, matching
from rpim_opt.convex.expressions import SQUARES, cp, named, norms
from rpim_opt.convex.formulation import NAMED, Formulation
from rpim_opt.convex.quadratic import Quadratic
from rpim_opt.problem.linear import reduced_rows
from rpim_opt.robot.parameters import Parameters, is_joint_offset

FIXED = -1  # group of parameters whose prior scale is not estimated: frames except the base, and curves
JOINT_OFFSET, FRAMES = 3.0, 10.0  # factors on the scales of joint offsets and frames


def default_widths(parameters: Parameters, joint_offset: float = JOINT_OFFSET, frames: float = FRAMES) -> Array:
    """Return the default prior standard deviations (P,) [SI], if only scales are stated."""
    offsets = np.array([is_joint_offset(name) for name in parameters.names])
    factor = np.where(offsets, joint_offset, 1.0)
    factor[parameters.placed] = frames
    return factor * parameters.scale


@dataclass(frozen=True, eq=False)
class ScaledPrior:
    """Prior of the n identified parameters of a problem, in units of their scales.

    Parameters are independent, with an estimated scale tau_g per group, unless a statement replaces their prior::

        z_j ~ centre_j + tau_g scale_j t_nu     (heavy)        z_j ~ N(centre_j, (tau_g scale_j)^2)     (others)

    (tau is 1 without a group), and together rows z - values ~ N(0, I), rows (k, n) and values (k,) of the statements.
    ``parameters`` are the identified ones; prior means ``centre`` (n,) and standard deviations ``scale`` (n,) are in
    units of their scales. ``replaced`` (n,) have a statement in place of an own prior, ``heavy`` (n,) Student's t with
    ``tails`` degrees of freedom; ``names[group]`` (n,) are the groups, -1 is none.

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
        """Whether it consists of the parameters' scales alone."""
        informative = self.centre.any() or len(self.rows) or self.replaced.any()
        return not informative and bool((self.scale == 1).all())

    def inside(self, size: Array) -> ScaledPrior:
        """Return the prior in units of scales that were multiplied by ``size`` (n,), in which ``scale`` is 1."""
        larger = replace(self.parameters, scale=self.parameters.scale * size)
        ones = np.ones_like(self.scale)
        return replace(self, parameters=larger, centre=self.centre / size, scale=ones, rows=self.rows * size)

    def penalized(self, formulation: Formulation) -> Formulation:
        """Return the formulation with the prior's penalty; the formulation itself if no prior is stated.

        With zero in place of parameters whose prior statements replace, the penalty is::

            penalty((z - centre) / scale) + |rows z - values|^2

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
            groups = [nested(np.asarray(D, dtype=float)) for D in formulation.penalty_over(self.parameters)]
        parts = (keep.tolist(), self.centre.tolist(), nested(self.rows), self.values.tolist(), groups)
        return replace(formulation, penalty=prior_penalty(formulation.penalty, *parts), penalty_over=None)


def prior_penalty(
    penalty: Callable[[Any], Any] | None, keep: Any, centre: Any, rows: Any, values: Any, groups: Any
) -> Callable[[Any], Any]:
    """Return penalty(keep (z - centre)) + |rows z - values|^2; with groups D_k of norms |D_k keep (z - centre)|.

    ``keep`` is 1 / scale, and zero for parameters whose prior statements replace.
    """
    penalty = named(penalty)
    if groups is not None:
        groups = tuple(tuple(map(tuple, D)) for D in groups)
    arguments = (penalty, tuple(keep), tuple(centre), tuple(map(tuple, rows)), tuple(values), groups)
    if penalty is None or penalty in NAMED or isinstance(penalty, Ready):
        return _Penalty("prior_penalty", _penalized, arguments)
    return lambda z: _penalized(z, *arguments)


def _penalized(
    z: Any, penalty: Callable[[Any], Any] | None, keep: Any, centre: Any, rows: Any, values: Any, groups: Any
) -> Any:
    terms = []
    if penalty is not None:
        y = cp.multiply(np.array(keep), z - np.array(centre))
        if groups is None:
            terms.append(penalty(y))
        elif penalty == SQUARES:  # of norms: the sum of all squares, without a cone
            terms.append(cp.sum_squares(np.vstack([np.array(D) for D in groups]) @ y))
        else:
            which = np.repeat(np.arange(len(groups)), [len(D) for D in groups])
            terms.append(penalty(norms(np.vstack([np.array(D) for D in groups]) @ y, which)))
    if rows:
        terms.append(cp.sum_squares(np.array(rows) @ z - np.array(values)))
    return sum(terms[1:], terms[0])


@dataclass(frozen=True)
class _Penalty(Ready):
    """The penalty of a prior over a ready one: equal in content is equal in meaning, and a file holds it."""

    @cached_property
    def quadratic(self) -> Quadratic | None:  # type: ignore[override]
        """The penalty as a quadratic form, in its square root; None where it is not quadratic."""
        penalty, keep, centre, rows, values, groups = self.arguments
        if penalty not in (None, SQUARES) or (penalty is None and not rows):
            return None
        n = len(centre)
        L, c = np.zeros((0, n)), np.zeros(0)
        if penalty is not None:
            L = np.diag(keep)
            if groups is not None:
                L = np.vstack([np.array(D) for D in groups]) @ L
            c = L @ np.array(centre)
        L, c = np.vstack([L, np.reshape(rows, (-1, n))]), np.concatenate([c, values])
        if len(L) == n and not np.any(L - np.diag(np.diag(L))):
            return Quadratic(np.diag(L).copy(), c)
        return Quadratic(L, c)


# --- statements -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Statement:
    """Rows (v - reference) ~ N(values, I), where v are values of parameters; without a reference, their deviations.

    For p parameters with ``names`` and ``dimensions``: whitened rows (k, p) [1 / SI] and values (k,), reference (p,)
    [SI]. A ``whole`` statement replaces the parameters' own priors, and is marginalized if some of them are not
    identified; otherwise those are nominal. ``text`` is as written by a user.
    """

    names: tuple[str, ...]
    dimensions: tuple[str, ...]
    rows: tuple[tuple[float, ...], ...]
    values: tuple[float, ...]
    reference: tuple[float, ...] | None = None
    whole: bool = False
    text: str = ""

    @property
    def where(self) -> str:
        """Its name in error messages."""
        return f"prior '{self.text}'"

    def on(self, parameters: Parameters) -> tuple[Array, Array, np.ndarray]:
        """Return rows (k, n) and values (k,) in units of the scales of the n identified parameters of a whole table.

        The third result (n,) marks parameters whose own prior it replaces. InputError for an unknown name, another
        dimension, and a value far from nominal.
        """
        here = {name: i for i, name in enumerate(parameters.names)}
        missing = [name for name in self.names if name not in here]
        if missing and (not self.whole or len(missing) == len(self.names)):
            raise InputError(self.where, f"'{missing[0]}'", "parameters: " + choices(missing[0], parameters.names))
        known = [name for name in self.names if name in here]
        for name, dimension in zip(self.names, self.dimensions, strict=True):
            if name in here and dimension != (of := parameters.dimensions[here[name]]):
                raise InputError(self.where, f"a unit of {dimension} for '{name}'", f"one of {of}")
        place = np.array([here[name] for name in known], dtype=int)
        own = np.array([self.names.index(name) for name in known], dtype=int)
        offset = np.zeros(len(place))  # nominal values [SI] minus the reference
        if self.reference is not None:
            offset = parameters.nominal[place] - np.array(self.reference)[own]
            self._require_near(parameters, place, own, offset)
        identified = parameters.identified[place]
        rows = np.array(self.rows, dtype=float).reshape(len(self.values), len(self.names))
        values = np.array(self.values, dtype=float)
        if self.whole:
            rows, values = marginal(rows, values, own[identified])
            place, offset = place[identified], offset[identified]
        else:
            rows = rows[:, own]
        values = values - rows @ offset
        full, replaced = np.zeros((len(rows), len(parameters))), np.zeros(len(parameters), dtype=bool)
        full[:, place], replaced[place] = rows, self.whole
        if self.reference is not None and not self.whole:
            full = full @ parameters.slopes()
        full = (full * parameters.scale)[:, parameters.identified]
        says = full.any(axis=1)
        return full[says], values[says], replaced[parameters.identified]

    def _require_near(self, parameters: Parameters, place: np.ndarray, own: np.ndarray, offset: Array) -> None:
        """Refuse turned frames, and values far from nominal."""
        if self.whole:
            some = parameters.take(place)
            turned = np.flatnonzero(some.of_frames & some.periodic & (offset != 0))
            if len(turned):  # angles of frames are not additive
                found = f"'{some.names[turned[0]]}' relative to another nominal orientation"
                accepted = "the frame's earlier nominal values; or no prior on a frame that was re-registered"
                raise InputError(self.where, found, accepted)
            return
        rows = np.array(self.rows)[:, own]
        apart = np.abs(np.array(self.values) - rows @ offset)
        if (apart > FAR * (1 + np.linalg.norm(rows * parameters.scale[place], axis=1))).any():
            size = float(np.max(apart / np.linalg.norm(rows, axis=1)))
            unit, si = display(parameters.dimensions[place[0]])
            found = f"a value {size / si:.4g} {unit} off nominal"
            raise InputError(self.where, found, "a value near nominal; '= nominal +- ...' refers to the nominal value")


def marginal(rows: Array, values: Array, kept: np.ndarray) -> tuple[Array, Array]:
    """Return rows (k', p') and values (k',) of a statement marginalized to a subset of its parameters.

    The columns of the others are projected out.
    """
    if len(kept) == rows.shape[1] and (kept == np.arange(len(kept))).all():
        return rows, values
    others = np.setdiff1d(np.arange(rows.shape[1]), kept)
    norms = np.linalg.norm(rows, axis=0)
    Q, R = np.linalg.qr(rows[:, others] / np.where(norms[others] > 0, norms[others], 1.0))
    U, s, _ = np.linalg.svd(R)
    seen = Q @ U[:, s > 1e-10 * np.max(s, initial=0.0)]
    left = rows[:, kept] - seen @ (seen.T @ rows[:, kept])
    right = values - seen @ (seen.T @ values)
    return left, right


def nested(matrix: Array) -> tuple[tuple[float, ...], ...]:
    """Return a matrix (k, p) as nested tuples, which compare by content."""
    return tuple(tuple(row) for row in matrix.tolist())


# --- an earlier result -----------------------------------------------------------------------------------------------


Result = Any
"""A `Calibration`, defined in a later folder."""


def posterior(result: Result, inflate: float, without: Sequence[str], noise: float | None) -> Statement:
    """Return the posterior of a result's parameters; arguments as for `Prior.from_result`."""
    for name, value in (("inflate", inflate), ("noise", noise)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError(f"Prior.from_result, {name}", f"{value}", "a number above zero")
    free = result.problem.parameters.free
    fit = result.fit_covariance
    form = result.program.penalty_form
    variance = fit.linear.factor * (fit.noise_variance if noise is None else noise**2)
    parts = [fit.linear.qr_factor[:, : len(free)] / np.sqrt(variance)]
    if form is not None and fit.weight > 0:
        parts.append(np.sqrt(fit.weight / variance) * form.matrix)
    if isinstance(without, str):
        without = without.split()
    chosen = np.arange(len(free))
    if without:
        chosen = np.flatnonzero(~matching(free, without, "Prior.from_result, without"))
    if not len(chosen):
        raise InputError("Prior.from_result, without", "every parameter", "patterns that keep at least one")
    R = reduced_rows(np.vstack(parts))
    if fit.drift is not None:  # of the precision that belongs to (R'R)^-1 + D D'
        moved = R @ (fit.drift / free.scale[:, None])
        R = np.linalg.solve(np.linalg.cholesky(np.eye(len(R)) + moved @ moved.T), R)
    rows, _ = marginal(R, np.zeros(len(free)), chosen)
    rows = reduced_rows(rows) / (free.scale[chosen] * inflate)
    return Statement(
        names=tuple(free.names[i] for i in chosen),
        dimensions=tuple(free.dimensions[i] for i in chosen),
        rows=nested(rows),
        values=tuple((rows @ result.x[chosen]).tolist()),
        reference=tuple(free.nominal[chosen].tolist()),
        whole=True,
        text="an earlier result",
    )
