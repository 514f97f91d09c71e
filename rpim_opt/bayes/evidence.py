"""Marginal likelihood of hyperparameters: restricted likelihood with Student-t priors, derivatives and optima."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy
from scipy.linalg import block_diag, get_lapack_funcs, solve_triangular

from rpim_opt.basics.arrays import Array
from rpim_opt.bayes.prior import BASE
from rpim_opt.problem.noise import Repeatability, Stack

CENTRES = {"position": 5e-5, "orientation": 1e-4, "joint": 5e-5, "reading": 1e-5, "instrument": 1.0}
"""Prior medians of the robot's repeatability [m, rad, rad, m], and of the factor on the instrument's noise."""
CURVES = {"transmission size": (1e-4, 2.0), "transmission length": (0.2, 1.5)}
"""Hyperparameters of transmission errors: prior median [rad], and standard deviation of the natural logarithm."""
WAVES, WAVES_LENGTH = 1.5e-4, 1.0
"""Standard deviation and length scale [rad] of additional waves, which are not estimated: within a part of a joint's
range they resemble its offset and eccentricity."""
NOISE_SD, GEOMETRY_SD, EXTENSION_SD = 2.0, 3.0, 2.0  # prior standard deviations of hyperparameters' logarithms
BASE_SD = 1.0  # of the base's: with a wider one, eight configurations make it appear closer than it is
RATIO_SD = 1.0
"""Of the ratio of two geometric scales: lengths, angles and joint offsets are made by different means, but few data do
not identify each scale alone."""
FARTHEST = 7.0  # logarithms of hyperparameters farther from their prior medians are implausible
SETTLED, MOST_ROUNDS = 1e-8, 500  # largest change of ln(local variance) at the fixed point; iterations
STEEPEST = 0.8  # bound on the slope of a local variance's map: its steps are at most five times the map's
COUPLED, LONGEST_COUPLED = 0.3, 1.0
"""Changes of ln(local variance) below which steps are coupled Newton steps; the longest of these."""
FEW = 60  # configurations up to which several optima are sought
BASIN = 0.3  # ln(hyperparameters) closer than this are one optimum
FIRST_RADIUS, LARGEST_RADIUS = 2.0, 3.0
"""Trust region of ln(hyperparameters): radius of the first step, and largest radius."""
WIDEST = 1e8
"""Upper bound on local variances, also divided by a squared scale above 1; above it, unobservable combinations are
rounding."""
RIDGE = 1e-13  # added to the scaled information matrix against rounding in unobservable directions
PRECISIONS = np.linspace(-14.0, 8.0, 200)
"""Logarithms of precision times squared scale of the normals whose mixture approximates a t_3."""
MOST_WIDENED = 100.0  # bound on the factor by which tails widen a local variance that data contradict
SHOWN = 6.0  # decrease of -2 ln L, a likelihood ratio of twenty, above which such a factor is not chance
FACTORS = np.geomspace(1.0, 30.0, 100)  # trial factors on the covariance of deviations for model errors


class Spectrum(NamedTuple):
    """Prior variances of Fourier coefficients that represent Gaussian processes with Matern covariance (3/2).

    They are the sum of size^2 8 r^3 / (r^2 + w^2)^2 / measure, r = sqrt(3) / length, over `WAVES` and the ripple, which
    is estimated; squared frequencies and measures are (c,).
    """

    w2: Array = np.zeros(0)
    measure: Array = np.zeros(0)

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        """Names of its hyperparameters; none without coefficients."""
        return tuple(CURVES) * (len(self.w2) > 0)

    def variances(self, size: float, length: float) -> tuple[Array, Array, Array]:
        """Return variances (c,) at logarithms of size and length, slopes (c, 2) and curvature of their ln."""
        r2, slow = 3 * np.exp(-2 * length), 3 / WAVES_LENGTH**2
        ripple = np.exp(2 * size) * 8 * r2**1.5 / (r2 + self.w2) ** 2
        waves = WAVES**2 * 8 * slow**1.5 / (slow + self.w2) ** 2
        share = ripple / (ripple + waves)
        of_ripple = np.column_stack([np.full(len(share), 2.0), 4 * r2 / (r2 + self.w2) - 3])
        curvature = np.einsum("i,ij,ik->ijk", share * (1 - share), of_ripple, of_ripple)
        curvature[:, 1, 1] -= share * 8 * r2 * self.w2 / (r2 + self.w2) ** 2
        return (ripple + waves) / self.measure, share[:, None] * of_ripple, curvature


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """Hierarchical prior of p deviations, in units of their scales.

    Deviations are normal, those ``heavy`` (p,) Student's t with ``tails`` degrees of freedom, those ``replaced`` (p,)
    without an own prior. A deviation's scale is multiplied by that of its group ``names[group]`` (p,), except for group
    -1. The last ones may have a ``spectrum``. In addition, rows z - values ~ N(0, I).
    """

    group: np.ndarray
    heavy: np.ndarray
    names: tuple[str, ...]
    tails: float
    replaced: np.ndarray
    rows: Array
    values: Array
    spectrum: Spectrum = field(default_factory=Spectrum)

    @property
    def geometry(self) -> np.ndarray:
        """Indices of the groups with Student-t priors."""
        return np.unique(self.group[self.heavy])

    @property
    def covariance(self) -> Array:
        """Prior covariance (g, g) of the logarithms of the scales."""
        geometry = np.isin(np.arange(len(self.names)), self.geometry)
        base = np.array([name == BASE for name in self.names], dtype=bool)
        covariance = np.diag(np.select([geometry, base], [GEOMETRY_SD, BASE_SD], EXTENSION_SD) ** 2)
        own = RATIO_SD**2 / 2
        covariance[np.ix_(geometry, geometry)] = GEOMETRY_SD**2 - own + own * np.eye(int(geometry.sum()))
        return covariance

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        """Names of the groups, and of the spectrum's hyperparameters."""
        return (*self.names, *self.spectrum.hyperparameters)

    def variances(self, logs: Array) -> tuple[Array, Array, Array]:
        """Return variances (p,) without local scales, slopes (p, s) of ln by the logs, and a spectrum's curvature."""
        g = len(self.names)
        variances = np.append(np.exp(2 * logs[:g]), 1.0)[self.group]
        slopes = np.zeros((len(variances), len(logs)))
        slopes[:, :g] = 2.0 * (self.group[:, None] == np.arange(g))
        curvature = np.zeros((0, len(CURVES), len(CURVES)))
        if len(self.spectrum.w2):
            own, curves = slice(len(variances) - len(self.spectrum.w2), None), slice(g, g + len(CURVES))
            variances[own], slopes[own, curves], curvature = self.spectrum.variances(*logs[curves])
        slopes[self.replaced] = 0.0
        return variances, slopes, curvature

    def of(self, keep: np.ndarray) -> Hierarchy:
        """Return the prior of a subset of the deviations (p,) that contains all of a spectrum or none."""
        used, number = np.unique(np.append(-1, self.group[keep]), return_inverse=True)
        return replace(
            self,
            group=number[1:] - 1,
            heavy=self.heavy[keep],
            names=tuple(self.names[i] for i in used[1:]),
            replaced=self.replaced[keep],
            rows=self.rows[:, keep],
        )


@dataclass(frozen=True, eq=False)
class Linearized:
    """Equations y ~ X z in SI, z (p,) in units of the scales, with the noise components of every configuration."""

    X: Array
    y: Array
    stacks: Sequence[Stack]


class Whitened(NamedTuple):
    """One stack, L L' = R its covariances: L^-1 X (N, k, p), L^-1 y (N, k), L^-1 dR L^-T (q, N, k, k), and ln|R|."""

    X: Array
    y: Array
    noise: Array
    logdet: float


def whitened(data: Linearized, repeatability: Repeatability, noise: Sequence[str]) -> list[Whitened]:
    """Return whitened equations, with derivatives of the noise by the logarithms of some of its components."""
    models = []
    each = [replace(repeatability, **{kind: 0.0}) for kind in noise]  # the covariance is a sum of their squares
    for stack in data.stacks:
        N, k = stack.index.shape
        covariance = stack.covariance(repeatability)
        L = np.linalg.cholesky(covariance)
        inverse = np.linalg.inv(L)
        slopes = [2 * (covariance - stack.covariance(without)) for without in each]
        by_noise = inverse @ np.reshape(slopes, (-1, N, k, k)) @ inverse.transpose(0, 2, 1)
        y = (inverse @ data.y[stack.index][:, :, None])[:, :, 0]
        logdet = 2 * float(np.sum(np.log(np.diagonal(L, axis1=1, axis2=2))))
        models.append(Whitened(inverse @ data.X[stack.index], y, by_noise, logdet))
    return models


@dataclass(frozen=True, eq=False)
class Point:
    """The marginal likelihood at logarithms of hyperparameters (s,): scales of deviations, then q of noise.

    ``value`` is -2 ln of the restricted likelihood and of the hyperprior. ``z`` (p,), ``C`` (p, p) are posterior mean
    and covariance of the deviations, ``v`` (p,) their variances in an equivalent Tikhonov program. Derivatives are
    computed on demand: each order costs as much as all lower ones.
    """

    evidence: Evidence
    logs: Array
    value: float
    z: Array
    C: Array
    v: Array
    parts: Sequence[Whitened]

    @cached_property
    def gradient(self) -> Array:
        """Derivatives (s,) of the value."""
        evidence, prior, heavy = self.evidence, self.evidence.prior, self.evidence.heavy
        size2, of_size, _ = prior.variances(self.logs)
        slope = 2 * (1 - (self.z**2 + self.C.diagonal()) / self.v)
        slope[heavy] = 2 * prior.tails * (size2 / self.v - 1)[heavy]
        gradient = slope @ of_size / 2 + 2 * (evidence.root @ (self.logs - evidence.centre)) @ evidence.root
        gradient[len(prior.hyperparameters) :] += self._by_noise[0]
        return gradient

    @property
    def curvature(self) -> Array:
        """Second derivatives (s, s) of the value."""
        return self._second[0]

    @property
    def slopes(self) -> Array:
        """Derivatives (p, s) of the posterior mean."""
        return self._second[1]

    def falls(self, M: Array) -> Array:
        """Return the decreases (s,) of tr(M C^-1) for a symmetric M (p, p): by local variances, and by noise."""
        derivative = M.diagonal() @ self._second[2]
        for part in self.parts:
            blocks = part.X @ M @ part.X.transpose(0, 2, 1)
            derivative[len(derivative) - len(part.noise) :] += np.einsum("anij,nij->a", part.noise, blocks)
        return np.asarray(derivative, dtype=float)

    @cached_property
    def _by_noise(self) -> tuple[Array, Array, Array, list[Array]]:
        """The gradient (q,), X'R^-1 R_a u (q, p), 2 u'R_a R^-1 R_b u - tr(P R_a P R_b) but `_weighed_twice`, X C."""
        q, p = len(self.evidence.noise), len(self.z)
        gradient, f, among, products = np.zeros(q), np.zeros((q, p)), np.zeros((q, q)), []
        for part in self.parts:
            X, residual = part.X.reshape(-1, p), part.y - part.X @ self.z
            moved = (part.noise @ residual[:, :, None]).reshape(q, len(X))
            f += moved @ X
            XC = (X @ self.C).reshape(part.X.shape)  # one product: one per configuration takes three times as long
            products.append(XC)
            weighed = part.noise - 2 * XC @ part.X.transpose(0, 2, 1) @ part.noise
            gradient += np.einsum("ankk->a", part.noise + weighed) / 2 - moved @ residual.ravel()
            among += 2 * moved @ moved.T - np.einsum("anij,bnij->ab", part.noise, weighed)
        return gradient, f, among, products

    def _weighed_twice(self) -> tuple[Array, Array]:
        """Return tr(H R_a H R_b) (q, q), H = R^-1 X C X'R^-1, and diagonals (p, q) of C X'R^-1 R_a R^-1 X C."""
        q, p = len(self.evidence.noise), len(self.z)
        X = np.concatenate([part.X.reshape(-1, p) for part in self.parts])
        if len(X) < p:  # among equations: a third of the time
            diagonals, rows = np.zeros((p, q)), []
            for part, XC in zip(self.parts, self._by_noise[3], strict=True):
                H = (XC.reshape(-1, p) @ X.T).reshape(*part.y.shape, -1)
                rows.append((part.noise @ H).reshape(q, part.y.size, len(X)))
                diagonals += np.einsum("ankp,nkp->pa", part.noise @ XC, XC)
            M = np.concatenate(rows, axis=1)
            return np.einsum("aij,bji->ab", M, M), diagonals
        M = np.zeros((q, p, p))
        for part in self.parts:
            values, U = np.linalg.eigh(part.noise)
            roots = np.sqrt(np.maximum(values, 0.0))[..., None] * U.transpose(0, 1, 3, 2)
            for a, root in enumerate(roots):  # products of a matrix with its own transpose take half the time
                counts = values[a].max(axis=0) > RIDGE * values[a].max()  # of six components one noise has three, say
                half = (root[:, counts] @ part.X).reshape(-1, p)
                M[a] += half.T @ half
        M = self.C @ M
        return np.einsum("aij,bji->ab", M, M), np.einsum("aij,ji->ia", M, self.C)

    @cached_property
    def _second(self) -> tuple[Array, Array, Array]:
        """The curvature, the mean's slopes, and the decreases (p, s) of 1 / v."""
        evidence, z, C, v = self.evidence, self.z, self.C, self.v
        prior, heavy = evidence.prior, evidence.heavy
        s, e2 = len(prior.hyperparameters), z**2 + C.diagonal()
        size2, of_size, bend = prior.variances(self.logs)
        by_noise, f, among, _ = self._by_noise
        twice, C_by_noise = self._weighed_twice()
        # derivatives of the mean by noise, and of e^2 at constant local variances
        z_by_noise = -C @ f.T
        direct = np.zeros_like(of_size)
        direct[:, s:] = C_by_noise + 2 * z[:, None] * z_by_noise
        information = np.where(prior.replaced, 0.0, 1 / v)
        follows = C * (C + 2 * np.outer(z, z)) * information
        log_v = of_size.copy()  # derivatives (p, s) of ln v, an implicit equation for Student-t deviations
        log_v[heavy] = 0.0
        wanted = prior.tails * size2[heavy, None] * of_size[heavy] + direct[heavy] + follows[heavy] @ log_v
        system = np.diag((prior.tails + 1) * v[heavy]) - follows[np.ix_(heavy, heavy)]
        log_v[heavy] = np.linalg.solve(system, wanted)
        slopes = 2 * (e2[:, None] * of_size - direct - follows @ log_v) / v[:, None]
        slopes[heavy] = 2 * prior.tails * ((size2 / v)[:, None] * (of_size - log_v))[heavy]
        curvature = 2 * evidence.root.T @ evidence.root
        of_scales = of_size[:, :s].T @ slopes / 2
        curvature[:s] += of_scales
        curvature[s:, :s] += of_scales[:, s:].T
        precision = information[:, None] * log_v
        curvature[s:, s:] += among - twice - direct[:, s:].T @ precision[:, s:]
        curvature[s:, s:] += 2 * (f @ z_by_noise + np.diag(by_noise))
        if len(bend):
            curves = slice(s - len(CURVES), s)
            curvature[curves, curves] += np.tensordot((1 - e2 / v)[len(v) - len(bend) :], bend, axes=1)
        of_z = C @ (z[:, None] * precision)
        of_z[:, s:] += z_by_noise
        return curvature, of_z, precision


@dataclass(frozen=True, eq=False)
class Evidence:
    """The marginal likelihood of one linearization as a function of hyperparameters.

    ::

        y = X z + e
        z_j ~ t_nu(0, tau_g)     heavy ones: normal with own variance v_j = (nu tau^2 + z_j^2 + C_jj) / (nu + 1)
        z_j ~ N(0, tau_g^2)      other groups;    N(0, 1) without a group
        e_c ~ N(0, R_c)          `Repeatability`
        C = (X'R^-1 X + diag(1/v))^-1,    z = C X'R^-1 y
        -2 ln L = |y - X z|^2_R + z'z/v + ln|R| - ln|C| + sum ln v
                  + sum over heavy of  (nu + 1) ln((nu tau^2 + z^2 + C) / (nu + 1)) - nu ln tau^2 - ln v
                                       + 1 - (z^2 + C) / v

    and logarithms of hyperparameters are normal around those of `CENTRES` and 1 (`Hierarchy.covariance`). Student's t
    enters by its mean field (a variational bound); an undetermined deviation contributes nothing.

    Derivatives, with P = R^-1 - R^-1 X C X'R^-1, u = R^-1 (y - X z), R_a = dR / da and e^2 = z^2 + diag C::

        dz      = C (z / v) dln v  -  C X'R^-1 R_a u da
        dC      = C diag(dln v / v) C  +  C X'R^-1 R_a R^-1 X C da
        dln v_j = (2 nu tau^2 dln tau + de_j^2) / ((nu + 1) v_j)    heavy ones;    2 dln tau    others

    The derivative by a scale is the sum of 2 nu (tau^2 / v - 1) over its heavy deviations and of 2 (1 - e^2 / v) over
    others, by a noise tr(P R_a) - u'R_a u; by noises a and b the second derivative is that of variance components
    (Gilmour, Thompson and Cullis 1995) and a term of local variances::

        2 u'R_a P R_b u - tr(P R_a P R_b) + tr(P R_ab) - u'R_ab u - sum (de^2 / da at constant v) (dln v / db) / v

    ``noise`` names the estimated parts of the noise (`CENTRES`), ``fixed`` has the others.
    """

    data: Linearized
    prior: Hierarchy
    noise: tuple[str, ...]
    fixed: Repeatability = field(default_factory=Repeatability)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all hyperparameters: scales of deviations, then noise."""
        return (*self.prior.hyperparameters, *self.noise)

    @cached_property
    def centre(self) -> Array:
        """Prior medians of the logarithms of the hyperparameters (s,)."""
        medians = {name: median for name, (median, _) in CURVES.items()} | CENTRES
        return np.log([medians.get(name, 1.0) for name in self.names])

    @cached_property
    def root(self) -> Array:
        """Root L (s, s) of their prior precision L'L."""
        scales = np.linalg.inv(np.linalg.cholesky(self.prior.covariance))
        others = self.names[len(self.prior.names) :]
        spreads = {name: spread for name, (_, spread) in CURVES.items()}
        precisions = [1 / spreads.get(name, NOISE_SD) for name in others]
        return np.asarray(block_diag(scales, np.diag(precisions)), dtype=float)

    def repeatability(self, logs: Array) -> Repeatability:
        """Return the noise at logarithms of hyperparameters (s,)."""
        sizes = np.exp(logs[len(logs) - len(self.noise) :])
        return replace(self.fixed, **dict(zip(self.noise, map(float, sizes), strict=True)))

    def at(self, logs: Array, near: Point | None = None) -> Point:
        """Return the marginal likelihood at (s,); the iteration for local variances starts from those of ``near``."""
        prior, heavy = self.prior, self.heavy
        parts = whitened(self.data, self.repeatability(logs), self.noise)
        size2 = prior.variances(logs)[0]
        v = size2 if near is None else near.v * size2 / prior.variances(near.logs)[0]
        z, C, logdet, v = self._settled(parts, size2, v)
        own = ~prior.replaced
        off = self.root @ (logs - self.centre)
        value = logdet + sum(part.logdet for part in parts) + float(np.sum((prior.rows @ z - prior.values) ** 2))
        value += sum(float(np.sum((part.y - part.X @ z) ** 2)) for part in parts) + float(off @ off)
        value += float(np.sum(z[own] ** 2 / v[own]) + np.sum(np.log(v[own & ~prior.heavy])))
        nu, t2, t = prior.tails, size2[heavy], (z**2 + C.diagonal())[heavy]
        of_tails = (nu + 1) * np.log((nu * t2 + t) / (nu + 1)) - nu * np.log(t2) + 1 - t / v[heavy]
        return Point(self, logs, value + float(np.sum(of_tails)), z, C, v, parts)

    def optima(self, starts: Sequence[Array | Point], accuracy: float = 1e-5) -> list[Point]:
        """Return the local optima reached from some starts, logarithms (s,) or points there, the best first.

        Newton's method in a trust region (Conn, Gould and Toint 2000) ends at the first point where no derivative by
        the logarithms exceeds the accuracy: by rounding, its value may exceed the previous one.
        """
        known: list[Point] = []

        def ask(logs: Array) -> Point:
            nonlocal last
            if not np.array_equal(logs, last.logs):
                last = self.at(logs.copy(), last)
            if np.linalg.norm(last.gradient) <= accuracy:
                raise StopIteration  # SciPy's test waits for another decrease
            return last

        for start in starts:
            last = start if isinstance(start, Point) else self.at(start)
            with suppress(StopIteration):
                optimum = scipy.optimize.minimize(
                    lambda logs: float(np.nan_to_num(ask(logs).value, nan=np.inf)),
                    last.logs,
                    method="trust-exact",
                    jac=lambda logs: ask(logs).gradient,
                    hess=lambda logs: ask(logs).curvature,
                    options={"gtol": 0.0, "initial_trust_radius": FIRST_RADIUS, "max_trust_radius": LARGEST_RADIUS},
                )
                ask(optimum.x)
            if all(np.abs(last.logs - point.logs).max(initial=0.0) > BASIN for point in known):
                known.append(last)
        return sorted(known, key=lambda point: point.value)

    def starts(self) -> list[Array]:
        """Return the starts of the search: all residuals noise; for few data also prior medians, large deviations."""
        noisy = 3.0 * np.isin(self.names, self.noise)
        geometry = 2.0 * np.isin(np.arange(len(self.centre)), self.prior.geometry)
        starts = [self.centre + noisy, self.centre, self.centre + geometry]
        starts = [*{start.tobytes(): start for start in starts}.values()]  # without duplicates
        return starts if sum(len(stack.index) for stack in self.data.stacks) <= FEW else starts[:1]

    def restricted(self, keep: np.ndarray) -> Evidence:
        """Return the marginal likelihood of a model with a subset of the columns (p,)."""
        return replace(self, data=replace(self.data, X=self.data.X[:, keep]), prior=self.prior.of(keep))

    def overdispersion(self, point: Point, q: Array) -> Array:
        """Return the factors k >= 1 (joints,) by which the covariance C is too small, with joint values q (m, joints).

        Model errors are systematic, but C treats them as random, so that it is too small outside of the measured
        ranges; inside, the noise covers them. Equations in one half of a joint's range predict those in the other half
        with errors e of covariance I + k X C X', with C from the first half alone; k maximizes the product of both
        likelihoods. It is 1 unless the likelihood of all joints together rises by a factor of twenty with a common k.
        """
        X = np.vstack([part.X.reshape(-1, len(point.v)) for part in point.parts])
        y = np.concatenate([part.y.reshape(-1, 1) for part in point.parts])
        own, rows = np.where(self.prior.replaced, 0.0, 1 / point.v), self.prior.rows
        q = q[np.concatenate([stack.index.ravel() for stack in self.data.stacks])]
        lower = (q <= np.median(q, axis=0)).T
        value = np.zeros((len(lower), len(FACTORS)))
        for joint in np.flatnonzero(~lower.all(axis=1)):  # of joints that moved
            for half in (lower[joint], ~lower[joint]):
                inside, beyond = X[half], X[~half]
                L, d = _factored(inside.T @ inside + rows.T @ rows, own)
                Y = _half_solved(L, d, beyond.T)
                mean = _half_solved(L, d, inside.T @ y[half] + rows.T @ self.prior.values[:, None])
                spread, V = np.linalg.eigh(Y @ Y.T)
                informative = spread > 1e-6
                along = (V.T @ (Y @ (y[~half] - Y.T @ mean)))[informative, 0]
                variances = 1 + FACTORS[:, None] * spread[informative]
                value[joint] += np.sum(np.log(variances) + along**2 / spread[informative] / variances, axis=1)
        together = value.sum(axis=0)
        shown = together[0] - together.min() > SHOWN
        return FACTORS[np.argmin(value, axis=1)] if shown else np.ones(len(lower))

    # --- local variances ----------------------------------------------------------------------------------------

    @cached_property
    def heavy(self) -> np.ndarray:
        """Which deviations have local variances."""
        return np.flatnonzero(self.prior.heavy & ~self.prior.replaced)

    def _settled(self, parts: Sequence[Whitened], size2: Array, v: Array) -> tuple[Array, Array, float, Array]:
        """Return z, C, -ln|C| and v, which are solved jointly; curves are integrated out first."""
        p = len(size2)
        g = p - len(self.prior.spectrum.w2)
        X = np.concatenate([part.X.reshape(-1, p) for part in parts])
        y = np.concatenate([part.y.ravel() for part in parts])
        information, regression, own, logdet = _eliminated(X[:, g:], np.column_stack([X[:, :g], y]), size2[g:])
        rows = self.prior.rows[:, :g]
        H = information[:g, :g] + rows.T @ rows
        h = information[:g, g] + rows.T @ self.prior.values
        z, C, more, v = self._known(H, h, size2[:g], v[:g])
        follow = regression[:, :g] @ C
        C = np.block([[C, -follow.T], [-follow, own + follow @ regression[:, :g].T]])
        z = np.append(z, regression[:, g] - regression[:, :g] @ z)
        return z, C, logdet + more, np.append(v, size2[g:])

    def _known(self, H: Array, h: Array, size2: Array, v: Array) -> tuple[Array, Array, float, Array]:
        """Return z, C, -ln|C| and v of all but curves, from their information matrix H and vector h.

        Local variances of Student-t deviations are a fixed point, found by Newton's method for ln v:
        d C_ij / d v_k = C_ik C_kj / v_k^2, d z_j / d v_k = C_jk z_k / v_k^2.
        """
        heavy, tails = self.heavy, self.prior.tails
        own = np.where(self.prior.replaced[: len(v)], 0.0, 1.0)
        t2 = size2[heavy]
        widest = WIDEST * np.maximum(t2, 1.0)
        local = np.minimum(v[heavy], widest)
        v, before, rounds = size2.copy(), np.inf, 0
        while True:
            v[heavy] = local
            C, logdet = _inverse(*_factored(H, own / v))  # of M = H + diag(own / v)
            z = C @ h
            z_heavy, C_heavy = z[heavy], C[np.ix_(heavy, heavy)]
            weighed = np.minimum(tails * t2 + z_heavy**2 + C_heavy.diagonal(), (tails + 1) * widest)
            change = np.log(weighed / ((tails + 1) * local))
            largest = np.abs(change).max(initial=0.0)
            rounds += 1
            if largest <= SETTLED or rounds == MOST_ROUNDS:
                return z, C, logdet, v
            step = change  # always a descent direction, but slow
            if largest < before:
                step = _step(change, C_heavy * (C_heavy + 2 * np.outer(z_heavy, z_heavy)), weighed, local)
            local = np.minimum(local * np.exp(step), widest)
            before = min(before, largest)


# --- linear algebra ---------------------------------------------------------------------------------------------

_potrf, _potri = get_lapack_funcs(("potrf", "potri"), dtype=float)


def _factored(H: Array, precision: Array) -> tuple[Array, Array]:
    """Return L and d with L L' = M scaled by d to a diagonal of ones, M = H + diag(precision)."""
    d = 1 / np.sqrt(H.diagonal() + precision)
    scaled = H * d[:, None] * d
    scaled.flat[:: len(d) + 1] = 1 + RIDGE
    factor, failed = _potrf(scaled, lower=1)
    if failed:
        raise np.linalg.LinAlgError("information matrix is not positive definite")
    return factor, d


def _half_solved(factor: Array, d: Array, right: Array) -> Array:
    """Return Y with Y'Y = right'M^-1 right: an inverse loses all digits where frames are nearly free."""
    return np.asarray(solve_triangular(factor, right * d[:, None], lower=True, check_finite=False))


def _inverse(factor: Array, d: Array) -> tuple[Array, float]:
    """Return M^-1 and ln|M| from Cholesky's factor, which is overwritten."""
    logdet = 2 * float(np.sum(np.log(factor.diagonal() / d)))
    lower, _ = _potri(factor, lower=1)  # its upper half is zero, from Cholesky
    C = lower + lower.T
    C.flat[:: len(d) + 1] /= 2
    C *= d[:, None] * d
    return C, logdet


def _eliminated(U: Array, equations: Array, v: Array) -> tuple[Array, Array, Array, float]:
    """Integrate coefficients c ~ N(0, diag(v)) out of equations G ~ U c + e, e ~ N(0, I).

    Return the information G'(I + U diag(v) U')^-1 G of the equations, the regression C U'G of the coefficients on them,
    C = (U'U + diag(1 / v))^-1 and -ln|C|.
    """
    if len(U) < len(v):  # among equations: I + U diag(v) U' = L L'
        L = np.linalg.cholesky(np.eye(len(U)) + (U * v) @ U.T)
        Y = solve_triangular(L, np.hstack([U * v, equations]), lower=True, check_finite=False)
        follow, left = Y[:, : len(v)], Y[:, len(v) :]
        logdet = 2 * float(np.sum(np.log(L.diagonal()))) - float(np.sum(np.log(v)))
        return left.T @ left, follow.T @ left, np.diag(v) - follow.T @ follow, logdet
    if not len(v):
        return equations.T @ equations, np.zeros((0, equations.shape[1])), np.zeros((0, 0)), 0.0
    right = U.T @ equations
    factor, d = _factored(U.T @ U, 1 / v)
    Y = _half_solved(factor, d, right)
    C, logdet = _inverse(factor, d)
    return equations.T @ equations - Y.T @ Y, C @ right, C, logdet


def _step(change: Array, M: Array, weighed: Array, v: Array) -> Array:
    """Return a step in ln v (n,) towards a zero of the map's changes, whose derivatives by v are M / weighed / v.

    It is Newton's step if the map contracts (the system is positive definite), otherwise each component's own.
    """
    if np.abs(change).max() <= COUPLED:
        root = np.sqrt(weighed * v)
        ratio = np.sqrt(weighed / v)
        with suppress(np.linalg.LinAlgError):
            L = np.linalg.cholesky(np.eye(len(v)) - M / np.outer(root, root))
            step = scipy.linalg.cho_solve((L, True), change * ratio, check_finite=False) / ratio
            if np.abs(step).max() <= LONGEST_COUPLED:
                return np.asarray(step, dtype=float)
    return change / (1 - np.minimum(M.diagonal() / (weighed * v), STEEPEST))


# --- what tails and ranges of joints add to covariances ---------------------------------------------------------


def tail_widening(z: Array, C: Array, v: Array, heavy: np.ndarray, size: Array, tails: float) -> Array:
    """Return D (p, h), where D D' widens the covariance C for Student-t deviations (h,) with scales tau (h,).

    The normal of variance v_j in place of the t_nu of a deviation j has its curvature at the mean, not its width.
    Without that normal the data determine z_j with precision p = 1 / C_jj - 1 / v_j and mean z_j / (C_jj p). V_j is the
    variance of that density times t_nu, and w_j = 1 / V_j - p the precision of a normal that replaces the tails and
    agrees with it (one step of expectation propagation; means stay): D is `without_information` of 1 / v - w.
    """
    c = C.diagonal()[heavy]
    local = v[heavy]
    known = np.maximum(1 / c - 1 / local, 0.0)
    # t_nu in units of tau is a mixture of normals; close to a normal, the logarithms are close to zero
    logs = PRECISIONS * np.sqrt(3 / max(tails, 3.0))
    both = (known * size**2)[:, None] + np.exp(logs)
    moved = (z[heavy] / c * size)[:, None]
    mean = moved / both
    log = (tails * (logs - np.exp(logs)) + logs - np.log(both) + moved * mean) / 2
    share = np.exp(log - log.max(axis=1, keepdims=True))
    share /= share.sum(axis=1, keepdims=True)
    middle = np.sum(share * mean, axis=1, keepdims=True)
    variance = np.sum(share * (1 / both + (mean - middle) ** 2), axis=1)
    precision = 1 / variance / size**2 - known
    taken = np.zeros(len(z))
    taken[heavy] = 1 / local - np.clip(precision, 1 / (MOST_WIDENED * local), 1 / local)
    return without_information(C, taken)


def without_information(C: Array, taken: Array) -> Array:
    """Return D (p, k), C + D D' = (C^-1 - diag(taken))^-1: the covariance without information ``taken`` (p,).

    ::

        D = C B L^-T,    B B' = diag(taken),    L L' = I - B'C B
    """
    some = np.flatnonzero(taken)
    B = np.sqrt(taken[some])
    L = np.linalg.cholesky(np.eye(len(B)) - C[np.ix_(some, some)] * np.outer(B, B))
    return np.asarray(np.linalg.solve(L, (C[:, some] * B).T).T, dtype=float)


def widening(C: Array, factor: float, rows: Array) -> Array:
    """Return D (p, k), C + D D' = ((C^-1 - R'R) / factor + R'R)^-1: all but what rows R (s, p) state is less certain.

    ::

        D = L K^1/2,    L L' = C,    V = L'R',    K = (factor - 1) I - factor V (I / (factor - 1) + V'V)^-1 V'
    """
    if factor == 1:
        return np.zeros((len(C), 0))
    L, d = _factored(C, np.zeros(len(C)))
    L = L / d[:, None]
    V = (rows @ L).T
    inner = np.eye(len(rows)) / (factor - 1) + V.T @ V
    left, U = np.linalg.eigh((factor - 1) * np.eye(len(C)) - factor * V @ np.linalg.solve(inner, V.T))
    return L @ (U * np.sqrt(np.maximum(left, 0.0)))
