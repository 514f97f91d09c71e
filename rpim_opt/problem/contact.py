"""Elimination of unmeasured touched points and planes from the equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.problem.noise import Stack, equation_numbers


class Moved(NamedTuple):
    """Changes of a centre (3, c) [m], a normal (3, c) and, if any, directions in a plane (2, 3, c)."""

    centre: Array
    normal: Array
    across: Array | None = None


@dataclass(frozen=True, eq=False)
class Feature:
    """The point or plane of best fit to the positions p_i (K, 3) of its touches.

    A touch of a point observes its position p_i; one of a plane the coordinate s_i = n'(p_i - centre) along the normal
    n, the first coordinate here, with the two others zero. With the unknown point or plane eliminated, K touches
    constrain the robot only by these coordinates projected on an orthonormal basis (K, k) perpendicular to the
    ``places``: for a point to 1 (Helmert's contrasts: every touch minus the mean of the previous ones), for a plane to
    1, u, v, the coordinates in the plane. Contrasts keep the touches' independence and accuracy.

    ``centre`` and ``normal`` are (3,) each; ``across`` (2, 3) are two directions in the plane, the projection of the
    coordinate axis number ``axis`` (None for a plane that should be parallel to others) and the one perpendicular to
    it, zero for a point. ``height`` (K,) is s of every touch [m], ``places`` (K, 1 or 3) are 1, u, v [m], ``shown`` (3
    or 1, 3) the directions that a touch observes.
    """

    centre: Array
    normal: Array
    axis: int | None
    across: Array
    height: Array
    places: Array
    shown: Array

    @classmethod
    def of(cls, positions: Array, planar: bool) -> Feature:
        """Return the best-fitting point or plane of touches at (K, 3) [m]."""
        centre = positions.mean(axis=0)
        one = np.ones((len(positions), 1))
        if not planar:
            return cls(centre, np.zeros(3), None, np.zeros((2, 3)), np.zeros(len(positions)), one, np.eye(3))
        normal = np.linalg.svd(positions - centre)[2][2]
        normal = normal * np.copysign(1.0, normal[np.argmax(np.abs(normal))])
        axis = int(np.argmin(np.abs(normal)))
        first = np.eye(3)[axis] - normal * normal[axis]
        first = first / np.linalg.norm(first)
        across = np.array([first, np.cross(normal, first)])
        places = np.hstack([one, (positions - centre) @ across.T])
        return cls(centre, normal, axis, across, (positions - centre) @ normal, places, normal[None])

    @property
    def planar(self) -> bool:
        """Whether this is a plane."""
        return len(self.shown) == 1

    @property
    def level(self) -> Feature:
        """The feature without nominal errors: all touches on it, planes exactly parallel where stated."""
        return replace(self, height=np.zeros_like(self.height), axis=None)

    @cached_property
    def aside(self) -> Array:
        """Orthonormal basis (K, k) of the contrasts."""
        if self.planar:
            return np.linalg.qr(self.places, mode="complete")[0][:, 3:]
        return -scipy.linalg.helmert(len(self.places)).T

    def kept(self, equations: np.ndarray) -> np.ndarray:
        """Return the equations (k, 3 or 1), of the touches' (K, 3), that the contrasts replace."""
        return equations[self.places.shape[1] :, : len(self.shown)]

    def observed(self, values: Array) -> Array:
        """Return the components (K, 3, c) of values of the positions that a touch measures."""
        components = np.zeros_like(values)
        components[:, : len(self.shown)] = self.shown @ values
        return components

    def slopes(self, values: Array) -> Array:
        """Return the changes (K, 3, c) of the touches' residuals for changes (K, 3, c) of the positions."""
        moved = self.moved(values)
        slopes = self.observed(values - moved.centre)
        q = self.places[:, 1:] @ self.across[: self.places.shape[1] - 1] + np.outer(self.height, self.normal)
        slopes[:, 0] += q @ moved.normal
        return slopes

    def moved(self, values: Array) -> Moved:
        """Return the change of the point or plane for changes (K, 3, c) of its touches.

        n is the eigenvector to the smallest eigenvalue s's of M = sum_i q_i q_i', q_i = p_i - centre::

            dn = -E' (E M E' - s's)^-1 E dM n,    dM n = sum_i q_i n'dp_i + s_i dp_i,    E the directions in the plane
        """
        n = self.normal
        centre = values.mean(axis=0)
        if not self.planar:
            return Moved(centre, np.zeros(values.shape[1:]))
        E = self.across
        uv = self.places[:, 1:]
        turn = uv.T @ np.einsum("kic,i->kc", values, n) + E @ np.einsum("k,kic->ic", self.height, values)
        normal = -E.T @ np.linalg.solve(uv.T @ uv - self.height @ self.height * np.eye(2), turn)
        if self.axis is None:
            return Moved(centre, normal)
        # E_1 = (a - n n'a) / |a - n n'a| with a coordinate axis a, E_2 = n x E_1
        a = np.eye(3)[self.axis]
        first = -(np.outer(n, a @ normal) + normal * (a @ n))
        across = np.empty((2, *normal.shape))
        across[0] = (first - np.outer(E[0], E[0] @ first)) / np.sqrt(1 - n[self.axis] ** 2)
        across[1] = np.cross(normal, E[0][:, None], axis=0) + np.cross(n[:, None], across[0], axis=0)
        return Moved(centre, normal, across)


CLOSE = 0.05  # touches that spread by less [m] do not determine the size of a robot, whatever else is known
Features = Sequence[Feature]


class Tie(NamedTuple):
    """A known relation of two touched points or planes: its equations (e,), kind, value, and the two."""

    equations: np.ndarray
    kind: str
    value: float
    ends: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Touches:
    """Assignment of equations to touched points and planes, and their elimination.

    Touches at p_i have the equations c - p_i ~ 0 with an unknown point c, or n'(p_i - c) ~ 0 with a plane.
    Their best values follow from the touches (`Feature`); the equations constrain the robot only by contrasts, which do
    not depend on them: c is a fixed effect, exactly. A known dimension between two of them is an equation of these best
    values: d - |c_2 - c_1| for points, d - |n_1'(c_2 - c_1)| for planes, 0 - asin n_1'n_2 for perpendicular planes, n_2
    along two directions in the first for parallel ones.

    ``names`` are those of the points and planes, ``rows`` the numbers (K, 3) of the equations of the touches of each,
    ``planar`` states which are planes, ``ties`` are known relations of two of them, ``equations`` is the number of
    equations before the elimination. ``where`` are the points and planes located by the nominal robot, which define the
    contrasts, ``spread`` is the RMS distance [m] of the touches of each from their mean.
    """

    names: tuple[str, ...]
    rows: tuple[np.ndarray, ...]
    planar: tuple[bool, ...]
    ties: tuple[Tie, ...]
    equations: int
    where: Features = ()
    spread: float = 0.0

    @classmethod
    def of(cls, data: Dataset) -> Touches | None:
        """Return the touches of a dataset; None where there are none."""
        at: dict[str, list[int]] = {}
        planar: dict[str, bool] = {}
        known: list[tuple[np.ndarray, Block, int]] = []
        numbers = equation_numbers(data)
        for block, equations in zip(data.blocks, numbers, strict=True):
            if block.touched is None:
                continue
            if not block.measurement.touching:
                known += [(equations[i], block, i) for i in range(len(equations))]
                continue
            for equation, name in zip(equations[:, 0], block.touched[:, 0], strict=True):
                at.setdefault(name, []).append(int(equation))
                planar[name] = block.measurement.planar
        if not at:
            return None
        number = {name: i for i, name in enumerate(at)}
        ties = []
        for equations, block, i in known:
            one, other = (number.get(name) for name in np.asarray(block.touched)[i])
            if one is not None and other is not None:
                ties.append(Tie(equations, block.measurement.name, float(block.y[i, 0]), (one, other)))
        rows = tuple(np.array(first)[:, None] + np.arange(3) for first in at.values())
        return cls(tuple(at), rows, tuple(planar.values()), tuple(ties), sum(map(np.size, numbers)))

    def located(self, residual: Array) -> Features:
        """Return the points and planes of best fit, from a residual (m,) that is -p_i for touches."""
        return [Feature.of(-residual[index], flat) for index, flat in zip(self.rows, self.planar, strict=True)]

    def size(self, residual: Array) -> float:
        """Return the RMS distance of all touches from their mean [m], from a residual as for `located`."""
        p = -residual[np.concatenate(self.rows)]
        return float(np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1))))

    def centred(self, residual: Array, jacobian: Array) -> tuple[Array, Array]:
        """Return residual (m,) and Jacobian (m, n) about the points and planes of best fit.

        A robot that shrinks to a point touches everything at once. The remaining equations are therefore divided by the
        touches' spread and multiplied by the nominal robot's: they do not determine the size of the robot. Touches that
        spread by less than `CLOSE` are not scaled.
        """
        where = self.located(residual)
        spread = self.size(residual)
        unit = self.spread / spread if self.spread > CLOSE else 1.0
        left = residual.copy()
        slopes = jacobian.copy()
        for thing, index in zip(where, self.rows, strict=True):
            left[index] = unit * thing.observed((residual[index] + thing.centre)[:, :, None])[:, :, 0]
            slopes[index] = unit * thing.slopes(jacobian[index])
        if self.spread > CLOSE:
            every = np.concatenate(self.rows)
            away = -residual[every] - np.mean(-residual[every], axis=0)
            growth = np.einsum("ki,kin->n", away, jacobian[every]) / len(every) / spread**2
            slopes[every] += left[every][:, :, None] * growth
        for tie in self.ties:
            left[tie.equations], through = self.through(tie, where)
            slopes[tie.equations] = sum(G @ jacobian[index.ravel()] for index, G in through)
        return left, slopes

    def through(self, tie: Tie, where: Features) -> tuple[Array | float, list[tuple[np.ndarray, Array]]]:
        """Return a tie's residual (e,), and slopes (e, 3K) by its two features' touches with their equations (K, 3)."""
        first, second = (where[end] for end in tie.ends)
        rows = [self.rows[end] for end in tie.ends]
        eyes = [np.eye(index.size).reshape(*index.shape, -1) for index in rows]
        one, other = first.moved(eyes[0]), second.moved(eyes[1])
        apart = second.centre - first.centre
        cosine = first.normal @ second.normal
        same = np.copysign(1.0, cosine)
        off: Array | float
        if tie.kind == "known_square":
            off = -np.arcsin(np.clip(cosine, -1, 1))
            sine = np.sqrt(max(1 - cosine**2, 1e-12))
            slopes = [second.normal @ one.normal / sine, first.normal @ other.normal / sine]
        elif tie.kind == "known_parallel":
            off = -first.across @ second.normal * same
            turned = -first.across @ one.normal
            if one.across is not None:
                turned = same * np.einsum("aic,i->ac", one.across, second.normal)
            slopes = [turned, same * first.across @ other.normal]
        elif first.planar:
            off = tie.value - float(abs(first.normal @ apart))
            way = np.copysign(1.0, first.normal @ apart)
            slopes = [way * (apart @ one.normal - first.normal @ one.centre), way * first.normal @ other.centre]
        else:
            off = tie.value - float(np.linalg.norm(apart))
            u = apart / max(float(np.linalg.norm(apart)), 1e-300)
            slopes = [-u @ one.centre, u @ other.centre]
        return off, [(index, np.atleast_2d(G)) for index, G in zip(rows, slopes, strict=True)]

    @cached_property
    def kept(self) -> np.ndarray:
        """Which equations (m,) remain: all but those of touches, and those that contrasts replace."""
        mask = np.ones(self.equations, dtype=bool)
        for thing, index in zip(self.where, self.rows, strict=True):
            mask[index] = False
            mask[thing.kept(index)] = True
        return mask

    def contrasts(self, values: Array) -> Array:
        """Return values (m, c) of the equations, as from `centred`, with contrasts in place of touches, (k, c)."""
        contrasts = values.copy()
        for thing, index in zip(self.where, self.rows, strict=True):
            shown = values[index[:, : len(thing.shown)]]
            contrasts[thing.kept(index)] = np.tensordot(thing.aside.T, shown, axes=1)
        return contrasts[self.kept]

    def noise(self) -> scipy.sparse.csr_matrix:
        """Return the matrix (k, m) from the noise of the equations to that of the contrasts."""
        transform = scipy.sparse.identity(self.equations, format="lil")
        for thing, index in zip(self.where, self.rows, strict=True):
            transform[thing.kept(index).ravel()[:, None], index.ravel()] = np.kron(thing.aside.T, thing.shown)
        for tie in self.ties:
            for index, G in self.through(tie, self.where)[1]:
                transform[tie.equations[:, None], index.ravel()] = G
        return transform.tocsr()[self.kept]


def contrasted(touches: Touches, stacks: Sequence[Stack], stop: np.ndarray) -> list[Stack]:
    """Return the noise components of the contrasts, from the equations' ``stacks`` and their configurations (m,)."""
    mask, noise = touches.kept, touches.noise()
    place = np.cumsum(mask) - 1
    own = np.ones(touches.equations, dtype=bool)
    for tie in touches.ties:
        own[tie.equations] = False  # its touches vary, not the statement
    by_size: dict[tuple[int, ...], list[tuple[Array, ...]]] = {}
    for stack in stacks:
        for n, index in enumerate(stack.index):
            kept = mask[index]
            rows = index[kept]
            if not len(rows):
                continue
            W = noise[place[rows]][:, index].toarray()
            stops = np.unique(stop[index], return_inverse=True)[1]
            joint = np.zeros((len(index), stops.max() + 1, stack.joint.shape[2]))
            joint[np.arange(len(index)), stops] = stack.joint[n] * own[index, None]
            joint = W @ joint.reshape(len(index), -1)
            if joint.shape[1] > len(joint):  # as many columns as equations suffice for the same J J'
                joint = np.asarray(np.linalg.qr(joint.T, mode="r")).T
            dimensions = (each[n][kept] & own[rows] for each in (stack.length, stack.angle))
            unit = (W * (stack.length[n] & own[index])) @ W.T
            each = (place[rows], W @ stack.instrument[n] @ W.T, *dimensions, joint, unit)
            by_size.setdefault(joint.shape, []).append(each)
    return [Stack(*map(np.stack, zip(*same, strict=True))) for same in by_size.values()]


def of_rows(touches: Touches, data: Dataset, each: Sequence[Array], reading: bool) -> list[Array]:
    """Return the covariance of every row's residual about its feature, from those (N, k, k) or (1, k, k) [SI] alone."""
    numbers = [index[:, 0] for index in equation_numbers(data)]
    touch = np.zeros((touches.equations, 3, 3))
    for block, V, first in zip(data.blocks, each, numbers, strict=True):
        if block.measurement.touching:
            touch[first] = V
    left = touch.copy()
    for thing, index in zip(touches.where, touches.rows, strict=True):
        V = touch[index[:, 0]]
        K = len(V)
        if K > 1:  # errors of the touches about their own point or plane
            through = thing.slopes(np.eye(3 * K).reshape(K, 3, 3 * K)).reshape(K, 3, K, 3)
            own = np.einsum("aibj,bjk,albk->ail", through, V, through)
            # directions that a touch does not observe have no error: any positive variance does
            diagonal = np.einsum("kii->ki", own)
            diagonal += np.where(diagonal > 0, 0.0, V.max())
            left[index[:, 0]] = own
    ties = {}
    for tie in touches.ties:
        parts = [
            (G.reshape(-1, *index.shape), touch[index[:, 0]]) for index, G in touches.through(tie, touches.where)[1]
        ]
        ties[tie.equations[0]] = sum(np.einsum("aki,kij,bkj->ab", G, V, G) for G, V in parts)
    covariances = []
    for block, V, first in zip(data.blocks, each, numbers, strict=True):
        if block.measurement.touching:
            covariances.append(left[first])
            continue
        rows = np.broadcast_to(V, (len(first), *V.shape[1:])).copy()
        for i, equation in enumerate(first):
            if equation in ties:
                rows[i] = reading * block.covariance[min(i, len(block.covariance) - 1)] + ties[equation]
        covariances.append(rows)
    return covariances
