"""Marginal likelihood of hyperparameters: restricted likelihood with Student-t priors, and its optima."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag, get_lapack_funcs

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.descent import descent
from rpim_opt.problem.scatter import Scatter, Stack

PRECISIONS = np.linspace(-14.0, 8.0, 200)
"""Logarithms of a deviation's own precision times its squared size, between which nearly all of a t_3 lies."""
MOST_WIDENED = 100.0
"""By how much tails may multiply a local variance: where data contradict them, nothing else bounds it."""


def added(z: Array, C: Array, v: Array, heavy: np.ndarray, size: Array, tails: float) -> Array:
    """Return by what deviations move (p, h): D, with D D' what tails add to their covariance C.

    The normal of variance v_j that stands for the t_nu of a deviation j has its curvature at the mean, not its width:
    where nothing decides z_j, v_j is size^2, and a t_3's variance is three times as much. What the data say of z_j,
    apart from that normal, has the precision p = 1 / C_jj - 1 / v_j and the mean z_j / (C_jj p). V_j is the variance
    of that times t_nu, and w_j = 1 / V_j - p the precision that a normal in the place of the tails needs to agree::

        C + D D' = (C^-1 - diag(1 / v - w))^-1        D = C B L^-T,    B B' = diag(1 / v - w),    L L' = I - B'C B

    Means stay. (One step of expectation propagation, from the mean field on.)

    Parameters
    ----------
    z, C
        (p,) and (p, p), with the local variances.
    v
        (p,) the local variances.
    heavy
        (h,) the deviations with tails, by number.
    size
        (h,) their sizes.
    tails
        Degrees of freedom.
    """
    c = C.diagonal()[heavy]
    local = v[heavy]
    known = np.maximum(1 / c - 1 / local, 0.0)
    precision = 1 / _variance(known * size**2, z[heavy] / c * size, tails) / size**2 - known
    B = np.sqrt(1 / local - np.clip(precision, 1 / (MOST_WIDENED * local), 1 / local))
    own = C[np.ix_(heavy, heavy)]
    L = np.linalg.cholesky(np.eye(len(B)) - own * np.outer(B, B))
    return np.asarray(np.linalg.solve(L, (C[:, heavy] * B).T).T, dtype=float)


def _variance(precision: Array, moved: Array, tails: float) -> Array:
    """Return the variances (h,) of t_nu times normals exp(moved t - precision t^2 / 2), as mixtures of normals."""
    logs = PRECISIONS * np.sqrt(3 / max(tails, 3.0))  # the nearer to a normal, the closer they are to zero
    own = np.exp(logs)
    both = precision[:, None] + own
    mean = moved[:, None] / both
    log = (tails * (logs - own) + logs - np.log(both) + moved[:, None] * mean) / 2
    share = np.exp(log - log.max(axis=1, keepdims=True))
    share /= share.sum(axis=1, keepdims=True)
    middle = np.sum(share * mean, axis=1, keepdims=True)
    return np.asarray(np.sum(share * (1 / both + (mean - middle) ** 2), axis=1), dtype=float)


CENTRES = {"position": 5e-5, "orientation": 1e-4, "joint": 5e-5, "instrument": 1.0}
"""Median of what a robot's scatter is believed to be before the data [m, rad, rad], and of the instrument's factor."""
NOISE_SD, GEOMETRY_SD, FAMILY_SD = 2.0, 3.0, 2.0
"""Standard deviations of the natural logarithms of sizes, before the data."""
BASE_SD = 1.0
"""The same of the base: wider, eight configurations take it for nearer than it is."""
APART = 1.0
"""That of the ratio of two sizes of the geometry: lengths, angles and joint offsets are made by different means, but
few data do not tell each size alone."""
FARTHEST, LONGEST = 7.0, 3.0
"""Logarithms of sizes stay within so much of their centres, and change by no more in a step."""
SETTLED, ROUGHLY, MOST_ROUNDS = 1e-8, 1e-4, 500
"""Local variances are a fixed point when their logarithms change by no more, and on the way to an optimum; rounds that
they may take."""
STEEPEST = 0.8
"""Local variances are taken to follow themselves by no more: steps are at most five times what the fixed point says."""
TOGETHER = 0.3
"""Changes of their logarithms below which their steps are Newton's, coupled."""
BASIN = 0.3
"""Logarithms of sizes within which of an optimum that is known no other is looked for."""
FARTHEST_STEP = 1.0
"""Of the logarithms, that such a step may go."""
WIDEST = 1e8
"""Local variances stay below, and below so many squares of a size that is above 1: nobody's deviation is ten thousand
scales, and beyond what rounding leaves of directions that nothing decides is all there is."""
RIDGE = 1e-13
"""Added to the scaled information: rounding in directions that nothing decides."""


@dataclass(frozen=True, eq=False)
class Believed:
    """What is believed of p deviations before the data, in units of their scales.

    Parameters
    ----------
    group
        (p,) which size multiplies a deviation's scale; -1 for those that have none.
    heavy
        (p,) which deviations have Student's tails; the others are normal.
    names
        Of the sizes.
    covariance
        (s, s) of their logarithms, before the data: `alike`.
    tails
        Degrees of freedom of Student's t.
    replaced
        (p,) which deviations have no belief of their own, because `rows` say all.
    rows, values
        (k, p) and (k,): rows z - values ~ N(0, I).
    """

    group: np.ndarray
    heavy: np.ndarray
    names: tuple[str, ...]
    covariance: Array
    tails: float
    replaced: np.ndarray
    rows: Array
    values: Array

    @property
    def geometry(self) -> np.ndarray:
        """Numbers of the groups that have Student's tails."""
        return np.unique(self.group[self.heavy])


def alike(geometry: np.ndarray, base: np.ndarray) -> Array:
    """Return the covariance (s, s) of logarithms of sizes before the data.

    Parameters
    ----------
    geometry, base
        (s,) which sizes are of the geometry, whose are alike, and which of the base.
    """
    among = np.ix_(geometry, geometry)
    covariance = np.diag(np.select([geometry, base], [GEOMETRY_SD, BASE_SD], FAMILY_SD) ** 2)
    own = APART**2 / 2
    covariance[among] = GEOMETRY_SD**2 - own + own * np.eye(int(geometry.sum()))
    return covariance


@dataclass(frozen=True, eq=False)
class Linearized:
    """Equations y ~ X z in SI, z (p,) in units of the scales, and what divides their noise by configuration."""

    X: Array
    y: Array
    stacks: Sequence[Stack]


@dataclass(frozen=True, eq=False)
class Point:
    """What sizes make of the data.

    Parameters
    ----------
    value
        -2 ln of the restricted likelihood and of what was believed of the sizes.
    gradient
        By the logarithms of the sizes.
    z, C
        (p,) and (p, p): the deviations' mean and covariance, in units of the scales.
    v
        (p,) local variances: the prior's that a Tikhonov program has at these sizes.
    logs
        (s,) logarithms of the sizes: of deviations, then of noise.
    """

    value: float
    gradient: Array
    z: Array
    C: Array
    v: Array
    logs: Array


@dataclass(frozen=True, eq=False)
class Slopes:
    """How a point changes with the logarithms of its s sizes, q of them of noise.

    Parameters
    ----------
    curvature
        (s, s) second derivatives of the value.
    z
        (p, s) of the deviations' means.
    own, noise
        (p, s) and (q, p, p): the deviations' information C^-1 falls by diag(own), and by the latter for noise.
    """

    curvature: Array
    z: Array
    own: Array
    noise: Array

    def falls(self, M: Array) -> Array:
        """Return by what tr(M C^-1) falls (s,), for a symmetric M (p, p)."""
        found = M.diagonal() @ self.own
        found[len(found) - len(self.noise) :] += np.einsum("aij,ij->a", self.noise, M)
        return np.asarray(found, dtype=float)


@dataclass(frozen=True, eq=False)
class _Whitened:
    """One stack of N configurations at some noise, L L' its covariances (N, k, k).

    Parameters
    ----------
    X, y
        (N k, p) and (N k,): L^-1 times the equations.
    noise
        (s, N, k, k): L^-1 dR L^-T by the logarithm of every noise that is to be found.
    logdet
        Of the covariances.
    """

    X: Array
    y: Array
    noise: Array
    logdet: float

    def noises(self, z: Array, C: Array) -> tuple[Array, Array]:
        """Return L^-1 dR L^-T L^-1 (y - X z) (s, N k), and the diagonal blocks of L^-1 X C X'L^-T (N, k, k)."""
        s, N, k, _ = self.noise.shape
        moved = self.noise @ (self.y - self.X @ z).reshape(N, k, 1)
        blocks = (self.X @ C).reshape(N, k, -1) @ self.X.reshape(N, k, -1).transpose(0, 2, 1)
        return moved.reshape(s, N * k), blocks


class _Informed(NamedTuple):
    """The stacks at some noise, and what they and what is known say of the deviations: H (p, p) and h (p,)."""

    noise: bytes
    parts: Sequence[_Whitened]
    H: Array
    h: Array


@dataclass(frozen=True, eq=False)
class Evidence:
    """The evidence of one linearization as a function of sizes.

    ::

        y = X z + e
        z_j ~ t_nu(0, size_g)     heavy ones: normal with own variance v_j = (nu size^2 + z_j^2 + C_jj) / (nu + 1)
        z_j ~ N(0, size_g^2)      other groups;    N(0, 1) what has none
        e_c ~ N(0, R_c)           `Scatter`
        C = (X'R^-1 X + diag(1/v))^-1,    z = C X'R^-1 y
        -2 ln L = |y - X z|^2_R + z'z/v + ln|R| - ln|C| + sum ln v
                  + sum over heavy of  (nu + 1) ln((nu size^2 + z^2 + C) / (nu + 1)) - nu ln size^2 - ln v
                                       + 1 - (z^2 + C) / v

    and logarithms of sizes are normal around those of `CENTRES` and 1, sizes of the geometry `alike`. Student's t
    enters by its mean field (a variational bound); a deviation that nothing decides adds nothing.

    Parameters
    ----------
    data
        The equations.
    believed
        Of deviations.
    noise
        Which parts of the scatter are to be found: names of `CENTRES`.
    fixed
        The other parts.
    """

    data: Linearized
    believed: Believed
    noise: tuple[str, ...]
    fixed: Scatter = field(default_factory=Scatter)

    @cached_property
    def centre(self) -> Array:
        """Logarithms of the sizes that are most likely before the data (s,)."""
        return np.concatenate([np.zeros(len(self.believed.names)), np.log([CENTRES[kind] for kind in self.noise])])

    @cached_property
    def root(self) -> Array:
        """Root L (s, s) of what is known of them: L'L is the inverse of their covariance."""
        sizes = np.linalg.inv(np.linalg.cholesky(self.believed.covariance))
        return np.asarray(block_diag(sizes, np.eye(len(self.noise)) / NOISE_SD), dtype=float)

    def scatter(self, logs: Array) -> Scatter:
        """Return the noise at logarithms of sizes (s,)."""
        sizes = np.exp(logs[len(self.believed.names) :])
        return replace(self.fixed, **dict(zip(self.noise, map(float, sizes), strict=True)))

    def at(self, logs: Array, before: Point | None = None, settled: float = SETTLED) -> Point:
        """Return the evidence at logarithms of sizes (s,); local variances are looked for from those of a point on."""
        b = self.believed
        _, whitened, H, h = self._informed(logs)
        size2 = self._size2(logs)
        v = size2
        if before is not None:
            v = before.v * size2 / self._size2(before.logs)
        z, C, logdet, v = self._settled(H, h, size2, v, settled)
        e2 = z**2 + np.diag(C)
        own = ~b.replaced
        normal = own & ~b.heavy
        value = float(np.sum((b.rows @ z - b.values) ** 2)) + logdet
        for part in whitened:
            value += float(np.sum((part.y - part.X @ z) ** 2)) + part.logdet
        value += float(np.sum(z[own] ** 2 / v[own]) + np.sum(np.log(v[normal])))
        value += self._tails(e2, size2, v)
        off = self.root @ (logs - self.centre)
        gradient = 2 * off @ self.root
        gradient[: len(b.names)] += self._by_size(e2, size2, v)
        gradient[len(b.names) :] += self._by_noise(whitened, z, C)
        return Point(value + float(off @ off), gradient, z, C, v, logs)

    def tails(self, point: Point) -> Array:
        """Return by what deviations move (p, h) beside `Point.C`: D, with D D' what Student's tails add to it."""
        b = self.believed
        size = np.sqrt(self._size2(point.logs)[self._heavy])
        return added(point.z, point.C, point.v, self._heavy, size, b.tails)

    def _informed(self, logs: Array) -> _Informed:
        """Return what the data say at a noise; the last one is kept, as often only sizes of deviations change."""
        b = self.believed
        noise = logs[len(b.names) :].tobytes()
        if self._last and self._last[0].noise == noise:
            return self._last[0]
        parts = self._whiten(self.scatter(logs))
        H = b.rows.T @ b.rows
        h = b.rows.T @ b.values
        for part in parts:
            H = H + part.X.T @ part.X
            h = h + part.X.T @ part.y
        self._last[:] = [_Informed(noise, parts, H, h)]
        return self._last[0]

    @cached_property
    def _last(self) -> list[_Informed]:
        return []

    def _whiten(self, scatter: Scatter) -> list[_Whitened]:
        p = self.data.X.shape[1]
        parts = []
        twice = 2 * np.array([getattr(scatter, kind) for kind in self.noise])[:, None, None, None] ** 2
        for stack, X, y, shares in self._stacked:
            L = np.linalg.cholesky(stack.covariance(scatter))
            inverse = np.asarray(np.linalg.inv(L), dtype=float)
            logdet = 2 * float(np.sum(np.log(np.diagonal(L, axis1=1, axis2=2))))
            noise = inverse @ (twice * shares) @ inverse.transpose(0, 2, 1)
            parts.append(_Whitened((inverse @ X).reshape(-1, p), (inverse @ y).ravel(), noise, logdet))
        return parts

    @cached_property
    def _heavy(self) -> np.ndarray:
        """Which deviations have local variances."""
        return np.flatnonzero(self.believed.heavy & ~self.believed.replaced)

    @cached_property
    def _light(self) -> np.ndarray:
        """Which deviations keep the variance that their size says."""
        return np.flatnonzero(~self.believed.heavy | self.believed.replaced)

    @cached_property
    def _stacked(self) -> list[tuple[Stack, Array, Array, Array]]:
        """The stacks, their equations (N, k, p) and (N, k, 1), and what a unit of every noise adds (s, N, k, k)."""
        found = []
        for stack in self.data.stacks:
            N, k = stack.index.shape
            shares = np.array([_share(stack, kind) for kind in self.noise]).reshape(-1, N, k, k)
            found.append((stack, self.data.X[stack.index], self.data.y[stack.index][:, :, None], shares))
        return found

    def _size2(self, logs: Array) -> Array:
        """Return the square of every deviation's size (p,)."""
        squares = np.append(np.exp(2 * logs[: len(self.believed.names)]), 1.0)
        return squares[self.believed.group]

    def _settled(self, H: Array, h: Array, size2: Array, v: Array, settled: float) -> tuple[Array, Array, float, Array]:
        """Return z, C, -ln|C| and v, which determine each other."""
        heavy = self._heavy
        local = v[heavy]
        v = size2.copy()
        own = np.where(self.believed.replaced, 0.0, 1.0)
        if len(heavy):
            # the others' variances stay: their share of the information is taken out once
            S, g = _without(H, h, own / v, heavy, self._light)
            v[heavy] = self._local(S, g, size2[heavy], local, settled)
        return *_posterior(H, h, own / v), v

    def _local(self, S: Array, g: Array, size2: Array, v: Array, settled: float) -> Array:
        """Return the local variances of heavy deviations, a fixed point: S is the information on them, S z = g.

        By Newton's steps for ln v: d C_ij / d v_k = C_ik C_kj / v_k^2, d z_j / d v_k = C_jk z_k / v_k^2.
        """
        tails = self.believed.tails
        before = np.inf
        widest = WIDEST * np.maximum(size2, 1.0)
        for _ in range(MOST_ROUNDS):
            v = np.minimum(v, widest)
            z, C, _ = _posterior(S, g, 1 / v)
            weighed = np.minimum(tails * size2 + z**2 + C.diagonal(), (tails + 1) * widest)
            change = np.log(weighed / ((tails + 1) * v))
            largest = np.abs(change).max()
            if largest <= settled:
                break
            step = change  # which always leads downhill, slowly
            if largest < before:
                step = _step(change, C * (C + 2 * np.outer(z, z)), weighed, v)
            v = v * np.exp(step)
            before = min(before, largest)
        return np.minimum(v, widest)

    def _tails(self, e2: Array, size2: Array, v: Array) -> float:
        """Return what heavy tails add to -2 ln L."""
        nu = self.believed.tails
        e2, t2, v = e2[self._heavy], size2[self._heavy], v[self._heavy]
        return float(np.sum((nu + 1) * np.log((nu * t2 + e2) / (nu + 1)) - nu * np.log(t2) + 1 - e2 / v))

    def _by_size(self, e2: Array, size2: Array, v: Array) -> Array:
        """Return the gradient by the logarithms of the deviations' sizes."""
        b = self.believed
        slope = 2 * (1 - e2 / v)
        if b.heavy.any():  # what is replaced has no size
            slope = np.where(b.heavy, 2 * b.tails * (size2 / v - 1), slope)
        sized = (b.group >= 0) & ~b.replaced
        return np.asarray(np.bincount(b.group[sized], slope[sized], minlength=len(b.names)), dtype=float)

    def _by_noise(self, whitened: Sequence[_Whitened], z: Array, C: Array) -> Array:
        """Return the gradient by the logarithms of the noise: 2 s^2 [tr(Q K) - u'K u], Q = R^-1 - R^-1 X C X'R^-1."""
        total = np.zeros(len(self.noise))
        if not self.noise:
            return total
        for part in whitened:
            moved, blocks = part.noises(z, C)
            k = blocks.shape[1]
            total += part.noise.reshape(len(total), -1) @ (np.eye(k) - blocks).ravel() - moved @ (part.y - part.X @ z)
        return total

    def slopes(self, point: Point) -> Slopes:
        """Return how a point of `at` changes with the logarithms of its sizes.

        With P = R^-1 - R^-1 X C X'R^-1, u = R^-1 (y - X z), R_a = dR / da and e^2 = z^2 + diag C::

            dz      = C (z / v) dln v  -  C X'R^-1 R_a u da
            dC      = C diag(dln v / v) C  +  C X'R^-1 R_a R^-1 X C da
            dln v_j = (2 nu size^2 dln size + de_j^2) / ((nu + 1) v_j)    heavy ones;    2 dln size    others

        A size's slope is the sum of 2 nu (size^2 / v - 1) over its heavy deviations and of 2 (1 - e^2 / v) over
        others, and by noises a and b the value has the derivatives of variance components (Gilmour, Thompson and
        Cullis 1995) and what local variances add::

            2 u'R_a P R_b u - tr(P R_a P R_b) + tr(P R_ab) - u'R_ab u - sum (de^2 / da at constant v) (dln v / db) / v
        """
        b = self.believed
        s, tails = len(b.names), b.tails
        z, C, v, size2 = point.z, point.C, point.v, self._size2(point.logs)
        S, f, among = self._by_noises(point)
        CS = C @ S
        z_by_noise = -C @ f.T
        among += 2 * f @ z_by_noise - np.einsum("aij,bji->ab", CS, CS)
        by_noise = np.einsum("aij,ji->ia", CS, C) + 2 * z[:, None] * z_by_noise  # of e^2, at constant v
        direct = np.column_stack([np.zeros((len(z), s)), by_noise])
        own = np.where(b.replaced, 0.0, 1 / v)
        of_size = np.where((b.group[:, None] == np.arange(len(point.logs))) & ~b.replaced[:, None], 2.0, 0.0)
        follows = C * (C + 2 * np.outer(z, z)) * own
        heavy = self._heavy
        moved = of_size.copy()  # of ln v
        moved[heavy] = 0.0
        if len(heavy):
            wanted = tails * size2[heavy, None] * of_size[heavy] + direct[heavy] + follows[heavy] @ moved
            system = np.diag((tails + 1) * v[heavy]) - follows[heavy][:, heavy]
            moved[heavy] = np.linalg.solve(system, wanted)
        slopes = 2 * ((z**2 + C.diagonal())[:, None] * of_size - direct - follows @ moved) / v[:, None]
        slopes[heavy] = 2 * tails * (size2 / v)[heavy, None] * (of_size - moved)[heavy]
        prior = 2 * self.root.T @ self.root
        slope = (point.gradient - prior @ (point.logs - self.centre))[s:]  # what the data say
        found = np.zeros_like(prior)
        found[:s] = of_size[:, :s].T @ slopes / 2
        found[s:, :s] = found[:s, s:].T
        found[s:, s:] = among + 2 * np.diag(slope) - by_noise.T @ (own[:, None] * moved[:, s:])
        precision = own[:, None] * moved
        of_z = C @ (z[:, None] * precision)
        of_z[:, s:] += z_by_noise
        return Slopes(found + prior, of_z, precision, S)

    def _by_noises(self, point: Point) -> tuple[Array, Array, Array]:
        """Return X'R^-1 R_a R^-1 X (s, p, p), X'R^-1 R_a u (s, p), and what of noises a and b (s, s) leaves C alone.

        The latter is 2 u'R_a R^-1 R_b u - tr(R^-1 R_a (R^-1 - 2 R^-1 X C X'R^-1) R_b).
        """
        z, C = point.z, point.C
        p, s = len(z), len(self.noise)
        S, f, among = np.zeros((s, p, p)), np.zeros((s, p)), np.zeros((s, s))
        if not s:
            return S, f, among
        for part in self._informed(point.logs).parts:
            moved, blocks = part.noises(z, C)
            N, k, _ = blocks.shape
            S += part.X.T @ (part.noise @ part.X.reshape(N, k, p)).reshape(s, N * k, p)
            f += moved @ part.X
            weighed = (np.eye(k) - 2 * blocks) @ part.noise
            among += 2 * moved @ moved.T - part.noise.reshape(s, -1) @ weighed.reshape(s, -1).T
        return S, f, among

    def mode(self, starts: Sequence[Array], tolerance: float = 1e-8) -> list[Point]:
        """Return the optima that are reached from some logarithms of sizes (s,) each, the best first.

        Raises
        ------
        numpy.linalg.LinAlgError
            When the data are not finite.
        """
        found: list[Point] = []
        for start in starts:
            point = self._climbed(start, tolerance, found)
            if point is not None:
                found.append(point)
        return sorted(found, key=lambda point: point.value)

    def _climbed(self, start: Array, tolerance: float, found: Sequence[Point]) -> Point | None:
        """Return the optimum that is reached from some sizes (s,); None where the way leads into one that is known."""
        last: Point | None = None

        def ask(logs: Array) -> Point:
            nonlocal last
            last = self.at(logs, last, ROUGHLY)
            return last

        box = self.centre - FARTHEST, self.centre + FARTHEST
        logs = start
        for point in descent(ask, self._curvature, start, box, LONGEST, tolerance):
            logs = point.logs
            if any(point.value >= known.value and np.abs(logs - known.logs).max() <= BASIN for known in found):
                return None
        return self.at(logs, last)

    def _curvature(self, point: Point) -> Array:
        return self.slopes(point).curvature

    def starts(self) -> list[Array]:
        """Return where optima are looked for: all of it noise, what is expected, and large deviations.

        The first one leads to the best optimum most often, where only one is climbed from.
        """
        noisy = 3.0 * (np.arange(len(self.centre)) >= len(self.believed.names))
        geometry = np.zeros(len(self.centre))
        geometry[self.believed.geometry] = 2.0
        found = [self.centre]
        if noisy.any():
            found.insert(0, self.centre + noisy)
        if geometry.any():
            found.append(self.centre + geometry)
        return found


_potrf: Any = get_lapack_funcs("potrf", dtype=float)
_potri: Any = get_lapack_funcs("potri", dtype=float)
_posv: Any = get_lapack_funcs("posv", dtype=float)
_trtrs: Any = get_lapack_funcs("trtrs", dtype=float)


def _factored(H: Array, precision: Array) -> tuple[Array, Array]:
    """Return L and d with L L' = M scaled by d to a diagonal of ones, M = H + diag(precision)."""
    n = len(precision)
    d = 1 / np.sqrt(H.diagonal() + precision)
    scaled = H * d[:, None] * d
    scaled.flat[:: n + 1] = 1 + RIDGE
    factor, failed = _potrf(scaled, lower=1)
    if failed:
        raise np.linalg.LinAlgError("information matrix is not positive definite")
    return factor, d


def _posterior(H: Array, h: Array, precision: Array) -> tuple[Array, Array, float]:
    """Return z = M^-1 h, M^-1 and ln|M| of M = H + diag(precision), with M scaled to a diagonal of ones."""
    factor, d = _factored(H, precision)
    logdet = 2 * float(np.sum(np.log(factor.diagonal() / d)))
    lower, _ = _potri(factor, lower=1)  # its upper half is zero, as potrf left it
    C = lower + lower.T
    C.flat[:: len(d) + 1] /= 2
    C *= d[:, None] * d
    return C @ h, C, logdet


def _step(change: Array, M: Array, weighed: Array, v: Array) -> Array:
    """Return a step in ln v (n,) to where the changes that the map asks for are zero; they follow v by M / weighed / v.

    Newton's where the map draws near to a fixed point (the system is positive definite), else each for itself.
    """
    largest = np.abs(change).max()
    if largest <= TOGETHER:
        root = np.sqrt(weighed * v)
        system = -M / np.outer(root, root)
        system.flat[:: len(v) + 1] += 1
        ratio = np.sqrt(weighed / v)
        _, step, failed = _posv(system, change * ratio)
        step = np.asarray(step, dtype=float) / ratio
        if not failed and np.abs(step).max() <= FARTHEST_STEP:
            return step
    return change / (1 - np.minimum(M.diagonal() / (weighed * v), STEEPEST))


def _without(H: Array, h: Array, precision: Array, kept: np.ndarray, others: np.ndarray) -> tuple[Array, Array]:
    """Return the information on some deviations, and its product with their mean, where the others are integrated.

    By Cholesky's factor, which loses no more than one of the whole matrix would: an inverse loses all digits where
    frames are nearly free.
    """
    if not len(others):
        return H, h
    factor, d = _factored(H[others][:, others], precision[others])
    right = np.column_stack([H[others][:, kept], h[others]]) * d[:, None]
    Y, _ = _trtrs(factor, right, lower=1)
    return H[kept][:, kept] - Y[:, :-1].T @ Y[:, :-1], h[kept] - Y[:, :-1].T @ Y[:, -1]


def _share(stack: Stack, kind: str) -> Array:
    """Return what a unit of a noise adds to the covariances (N, k, k)."""
    if kind == "joint":
        return stack.joint @ stack.joint.transpose(0, 2, 1)
    if kind == "instrument":
        return stack.instrument
    if kind == "position" and stack.unit is not None:
        return stack.unit
    mask = stack.length
    if kind == "orientation":
        mask = stack.angle
    return mask[:, :, None] * np.eye(mask.shape[1])
