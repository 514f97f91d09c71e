"""Unmeasured points and planes that were touched, eliminated from the equations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.problem.noise import Stack, equation_numbers

UNKNOWNS = 3
"""Of a point its coordinates; of a plane a distance and two tilts."""


class Moved(NamedTuple):
    """How a centre (3, c) [m], a normal (3, c) and directions in a plane (2, 3, c), if any, move."""

    centre: Array
    normal: Array
    across: Array | None = None


@dataclass(frozen=True, eq=False)
class Point:
    """A point at the mean of the positions p_i (K, 3) of its touches.

    Without it K touches say 3 (K - 1) things of the robot alone, the differences of every touch to the mean of those
    before it (Helmert's contrasts)::

        h_j = sqrt(j / (j + 1)) (r_{j+1} - mean(r_1 ... r_j)),    j = 1 ... K - 1

    They are orthonormal: independent touches of one accuracy have independent contrasts of that accuracy.

    ``centre`` (3,) is the mean [m], ``count`` K; ``normal`` and ``across`` are zero: a point has none.
    """

    centre: Array
    count: int
    normal: Array
    across: Array

    @classmethod
    def of(cls, positions: Array) -> Point:
        """Return the point that touches at (K, 3) [m] put where they are in the mean."""
        return cls(positions.mean(axis=0), len(positions), np.zeros(3), np.zeros((2, 3)))

    @property
    def level(self) -> Point:
        """The point itself."""
        return self

    @property
    def kept(self) -> np.ndarray:
        """Which of the touches' coordinates (K, 3) give a contrast its place."""
        found = np.ones((self.count, 3), dtype=bool)
        found[0] = False
        return found

    def seen(self, values: Array) -> Array:
        """Return what of values (K, 3, c) of the positions a touch shows, (K, 3, c)."""
        return values

    def slopes(self, values: Array) -> Array:
        """Return how far touches are off the point (K, 3, c) changes, where positions move by values (K, 3, c)."""
        return values - values.mean(axis=0)

    def contrasts(self, values: Array) -> Array:
        """Return the contrasts of values (K, 3, c), in the places that are kept."""
        found = np.zeros_like(values)
        j = np.arange(1, self.count)[:, None, None]
        before = np.cumsum(values, axis=0)[:-1] / j
        found[1:] = np.sqrt(j / (j + 1)) * (values[1:] - before)
        return found

    def moved(self, values: Array) -> Moved:
        """Return how it moves where its touches move by values (K, 3, c)."""
        return Moved(values.mean(axis=0), np.zeros(values.shape[1:]))


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane that fits the positions p_i (K, 3) of its touches best.

    A touch shows how far it is along the normal n, s_i = n'(p_i - centre), its first coordinate here; two others are
    zero. Without the plane K touches say K - 3 things of the robot alone: s in an orthonormal basis of what is
    perpendicular to 1, u, v, the coordinates in the plane.

    ``centre`` and ``normal`` are (3,) each, ``across`` (2, 3) two directions in the plane: the projection of the
    coordinate axis number ``axis`` (None for a plane that is parallel to those that should be), and what is
    perpendicular to that. ``height`` (K,) is s of every touch [m], ``places`` (K, 3) 1 and its coordinates u, v [m] in
    the plane, ``aside`` (K, K - 3) the orthonormal basis.
    """

    centre: Array
    normal: Array
    axis: int | None
    across: Array
    height: Array
    places: Array
    aside: Array

    @classmethod
    def of(cls, positions: Array) -> Plane:
        """Return the plane that is nearest to touches at (K, 3) [m]."""
        centre = positions.mean(axis=0)
        normal = np.linalg.svd(positions - centre)[2][2]
        normal = normal * np.copysign(1.0, normal[np.argmax(np.abs(normal))])
        axis = int(np.argmin(np.abs(normal)))
        first = np.eye(3)[axis] - normal * normal[axis]
        first = first / np.linalg.norm(first)
        across = np.array([first, np.cross(normal, first)])
        places = np.column_stack([np.ones(len(positions)), (positions - centre) @ across.T])
        aside = np.linalg.qr(places, mode="complete")[0][:, UNKNOWNS:]
        return cls(centre, normal, axis, across, (positions - centre) @ normal, places, aside)

    @property
    def level(self) -> Plane:
        """The plane with its touches in it, and parallel planes parallel: what the nominal robot is off is no noise."""
        return replace(self, height=np.zeros_like(self.height), axis=None)

    @property
    def kept(self) -> np.ndarray:
        """Which of the touches' coordinates (K, 3) give a contrast its place."""
        found = np.zeros((len(self.places), 3), dtype=bool)
        found[UNKNOWNS:, 0] = True
        return found

    def seen(self, values: Array) -> Array:
        """Return what of values (K, 3, c) of the positions a touch shows, (K, 3, c)."""
        found = np.zeros_like(values)
        found[:, 0] = np.einsum("kic,i->kc", values, self.normal)
        return found

    def slopes(self, values: Array) -> Array:
        """Return how s changes (K, 3, c), its first coordinate, where positions move by values (K, 3, c)."""
        found = np.zeros_like(values)
        moved = self.moved(values)
        q = self.places[:, 1:] @ self.across + np.outer(self.height, self.normal)
        found[:, 0] = np.einsum("kic,i->kc", values - moved.centre, self.normal) + q @ moved.normal
        return found

    def contrasts(self, values: Array) -> Array:
        """Return the contrasts of values (K, 3, c), in the places that are kept."""
        found = np.zeros_like(values)
        found[UNKNOWNS:, 0] = self.aside.T @ values[:, 0]
        return found

    def moved(self, values: Array) -> Moved:
        """Return how it moves where its touches move by values (K, 3, c).

        n is the eigenvector of M = sum_i q_i q_i', q_i = p_i - centre, with the least eigenvalue s's::

            dn = -E' (E M E' - s's)^-1 E dM n,    dM n = sum_i q_i n'dp_i + s_i dp_i,    E the directions in the plane
        """
        n = self.normal
        E = self.across
        uv = self.places[:, 1:]
        turn = uv.T @ np.einsum("kic,i->kc", values, n) + E @ np.einsum("k,kic->ic", self.height, values)
        normal = -E.T @ np.linalg.solve(uv.T @ uv - self.height @ self.height * np.eye(2), turn)
        if self.axis is None:
            return Moved(values.mean(axis=0), normal, None)
        # E_1 = (a - n n'a) / |a - n n'a| with a coordinate axis a, E_2 = n x E_1
        a = np.eye(3)[self.axis]
        first = -(np.outer(n, a @ normal) + normal * (a @ n))
        across = np.empty((2, *normal.shape))
        across[0] = (first - np.outer(E[0], E[0] @ first)) / np.sqrt(1 - n[self.axis] ** 2)
        across[1] = np.cross(normal, E[0][:, None], axis=0) + np.cross(n[:, None], across[0], axis=0)
        return Moved(values.mean(axis=0), normal, across)


AXES = np.arange(3)
CLOSE = 0.05
"""Touches that spread by less [m] do not show how large a robot is, whatever else is known."""
ROUNDING = 1e-12
"""Relative size of a covariance that is none."""
Things = Sequence[Point | Plane]


class Tie(NamedTuple):
    """What a drawing knows of two touched things: its equations (e,), of which kind, its value, and which two."""

    equations: np.ndarray
    kind: str
    value: float
    ends: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Touches:
    """Which equations touch which point or plane, and how these are eliminated.

    Touches at p_i have the equations c - p_i ~ 0 with an unknown point c, or n'(p_i - c) ~ 0 with a plane.
    Their best values follow from the touches (`touched.Point`, `touched.Plane`), and what the equations say of the
    robot alone are contrasts, which do not depend on them: c is a fixed effect, exactly. What a drawing knows of two
    of them is an equation of these best values: d - |c_2 - c_1| for points, d - |n_1'(c_2 - c_1)| for planes, 0 - asin
    n_1'n_2 for square ones, n_2 along two directions in the first for parallel ones.

    ``rows`` are the numbers (K, 3) of the equations of the touches of every thing, ``planar`` which of these are
    planes, ``ties`` what is known of two of them, ``equations`` how many there are before the elimination.
    """

    rows: tuple[np.ndarray, ...]
    planar: tuple[bool, ...]
    ties: tuple[Tie, ...]
    equations: int

    @classmethod
    def of(cls, data: Dataset) -> Touches | None:
        """Return the touches of a dataset; None where there are none."""
        at: dict[str, list[int]] = {}
        planar: dict[str, bool] = {}
        stated: list[tuple[np.ndarray, Block, int]] = []
        for block, numbers in zip(data.blocks, equation_numbers(data), strict=True):
            if block.touched is None:
                continue
            if not block.measurement.touching:
                stated += [(numbers[i], block, i) for i in range(len(numbers))]
                continue
            for equation, name in zip(numbers[:, 0], block.touched[:, 0], strict=True):
                at.setdefault(name, []).append(int(equation))
                planar[name] = block.measurement.planar
        if not at:
            return None
        number = {name: i for i, name in enumerate(at)}
        ties = []
        for equations, block, i in stated:
            ends = [number.get(name) for name in (() if block.touched is None else block.touched[i])]
            one, other = ends
            if one is not None and other is not None:
                ties.append(Tie(equations, block.measurement.name, float(block.y[i, 0]), (one, other)))
        rows = tuple(np.array(first)[:, None] + AXES for first in at.values())
        return cls(rows, tuple(planar.values()), tuple(ties), sum(map(np.size, equation_numbers(data))))

    def located(self, residual: Array) -> Things:
        """Return where points and planes are, of a residual (m,) that is -p_i for touches."""
        kinds = {False: Point, True: Plane}
        return [kinds[flat].of(-residual[index]) for index, flat in zip(self.rows, self.planar, strict=True)]

    def size(self, residual: Array) -> float:
        """Return how far all touches spread (RMS distance from their mean) [m], of a residual as `located` has it."""
        p = -residual[np.concatenate(self.rows)]
        return float(np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1))))

    def centred(self, residual: Array, jacobian: Array, size: float) -> tuple[Array, Array]:
        """Return residual (m,) and Jacobian (m, n) with every point and plane where its touches put it.

        A robot that shrinks to nothing would touch everything at once. What touches leave is therefore counted in
        units of how far they spread, times the nominal robot's: how large the robot is they do not say.
        ``size`` is that of the nominal robot; touches that spread by less than `CLOSE` count as they are.
        """
        where = self.located(residual)
        spread = self.size(residual)
        unit = 1.0
        if size > CLOSE:
            unit = size / spread
        left = residual.copy()
        for thing, index in zip(where, self.rows, strict=True):
            centre = np.broadcast_to(thing.centre, index.shape)
            left[index] = unit * thing.seen((residual[index] + centre)[:, :, None])[:, :, 0]
        for tie in self.ties:
            left[tie.equations] = _off(tie, where)
        slopes = jacobian.copy()
        for thing, index in zip(where, self.rows, strict=True):
            slopes[index] = unit * thing.slopes(jacobian[index])
        if size > CLOSE:
            every = np.concatenate(self.rows)
            away = -residual[every] - np.mean(-residual[every], axis=0)
            growth = np.einsum("ki,kin->n", away, jacobian[every]) / len(every) / spread**2
            slopes[every] += left[every][:, :, None] * growth
        for tie in self.ties:
            slopes[tie.equations] = self._through(tie, where, jacobian)
        return left, slopes

    def _through(self, tie: Tie, where: Things, values: Array) -> Array:
        """Return how what a tie compares changes (e, c) where positions move by values (m, c)."""
        ends = [where[end].moved(values[self.rows[end]]) for end in tie.ends]
        return _compared(tie, where, ends)

    @cached_property
    def alone(self) -> np.ndarray:
        """The equations of points that were touched once: they are met whatever the robot."""
        single = [index.ravel() for index in self.rows if len(index) == 1]
        return np.concatenate([np.empty(0, dtype=int), *single])

    def kept(self, where: Things) -> np.ndarray:
        """Return which of the equations' places contrasts have (m,)."""
        found = np.ones(self.equations, dtype=bool)
        for thing, index in zip(where, self.rows, strict=True):
            found[index] = thing.kept
        return found

    def contrasts(self, values: Array, where: Things) -> Array:
        """Return what m equations' values (m, c), as of `centred`, say without points and planes, (k, c)."""
        found = values.copy()
        for thing, index in zip(where, self.rows, strict=True):
            found[index] = thing.contrasts(values[index])
        return found[self.kept(where)]

    def noise(self, where: Things) -> Array:
        """Return by which noise of the m equations that of the contrasts is made, (k, m)."""
        eye = np.eye(self.equations)
        through = eye.copy()
        for thing, index in zip(where, self.rows, strict=True):
            through[index] = thing.seen(eye[index])
        for tie in self.ties:
            through[tie.equations] += self._through(tie, where, eye)
        return self.contrasts(through, where)

    def within(self, index: np.ndarray, things: Sequence[int], ties: Sequence[int]) -> Touches:
        """Return the touches among some equations, counted from the first of these."""
        place = np.full(self.equations, -1)
        place[index] = np.arange(len(index))
        number = {thing: i for i, thing in enumerate(things)}
        inside = tuple(
            tie._replace(equations=place[tie.equations], ends=(number[tie.ends[0]], number[tie.ends[1]]))
            for tie in (self.ties[i] for i in ties)
        )
        rows = tuple(place[self.rows[i]] for i in things)
        return Touches(rows, tuple(self.planar[i] for i in things), inside, len(index))


def _off(tie: Tie, where: Things) -> Array:
    """Return by how much what a drawing states differs from where things are (e,)."""
    first, second = (where[end] for end in tie.ends)
    if tie.kind == "known_square":
        return -np.arcsin(np.clip(first.normal @ second.normal, -1, 1))[None]
    if tie.kind == "known_parallel":
        return -first.across @ second.normal * np.copysign(1.0, first.normal @ second.normal)
    apart = second.centre - first.centre
    distance = abs(first.normal @ apart) if isinstance(first, Plane) else np.linalg.norm(apart)
    return np.array([tie.value - float(distance)])


def _compared(tie: Tie, where: Things, moved: Sequence[Moved]) -> Array:
    """Return how what a tie compares changes (e, c) where its two things move."""
    first, second = (where[end] for end in tie.ends)
    one, other = moved
    if tie.kind == "known_square":
        cosine = first.normal @ second.normal
        turned = second.normal @ one.normal + first.normal @ other.normal
        return turned[None] / np.sqrt(max(1 - cosine**2, 1e-12))
    if tie.kind == "known_parallel":
        same = np.copysign(1.0, first.normal @ second.normal)
        if one.across is None:
            return first.across @ (same * other.normal - one.normal)
        return same * (first.across @ other.normal + np.einsum("aic,i->ac", one.across, second.normal))
    apart = second.centre - first.centre
    if isinstance(first, Plane):
        along = first.normal @ (other.centre - one.centre) + apart @ one.normal
        return along[None] * np.copysign(1.0, first.normal @ apart)
    u = apart / max(float(np.linalg.norm(apart)), 1e-300)
    return (u @ (other.centre - one.centre))[None]


def contrasted(touches: Touches, stacks: Sequence[Stack], where: Things, stop: np.ndarray) -> list[Stack]:
    """Return what divides the contrasts' noise, of the equations' ``stacks`` and the numbers (m,) of their stops."""
    place = np.cumsum(touches.kept(where)) - 1
    of_thing = {int(index[0, 0]): i for i, index in enumerate(touches.rows)}
    of_tie = {int(tie.equations[0]): i for i, tie in enumerate(touches.ties)}
    found: dict[tuple[int, int], list[Stack]] = {}
    for stack in stacks:
        for n, index in enumerate(stack.index):
            things = sorted(of_thing[e] for e in index.tolist() if e in of_thing)
            ties = sorted(of_tie[e] for e in index.tolist() if e in of_tie)
            part = touches.within(index, things, ties)
            there = [where[i] for i in things]
            made = _stack(part, stack, n, there, stop[index])
            made = replace(made, index=place[index[part.kept(there)]][None])
            for each in _independent(made):
                found.setdefault((each.index.shape[1], each.joint.shape[2]), []).append(each)
    names = ("index", "instrument", "length", "angle", "joint", "unit")
    return [
        Stack(**{name: np.concatenate([getattr(each, name) for each in same]) for name in names})
        for (size, _), same in found.items()
        if size
    ]


def _stack(touches: Touches, stack: Stack, n: int, where: Things, stop: np.ndarray) -> Stack:
    """Return the contrasts of a stack's configuration n with what divides their noise; ``index`` is that of all."""
    m = touches.equations
    W = touches.noise(where)
    own = np.ones(m, dtype=bool)
    for tie in touches.ties:
        own[tie.equations] = False  # its touches scatter, and not what is stated
    stops = np.unique(stop, return_inverse=True)[1]
    spread = np.zeros((m, stops.max(initial=0) + 1, stack.joint.shape[2]))
    spread[np.arange(m), stops] = stack.joint[n] * own[:, None]
    joint = W @ spread.reshape(m, -1)
    if joint.shape[1] > len(joint):  # as many columns as equations have the same J J'
        joint = np.asarray(np.linalg.qr(joint.T, mode="r")).T
    kept = touches.kept(where)
    return Stack(
        index=stack.index[n : n + 1],
        instrument=(W @ stack.instrument[n] @ W.T)[None],
        length=(stack.length[n] & own)[None, kept],
        angle=(stack.angle[n] & own)[None, kept],
        joint=joint[None],
        unit=((W * (stack.length[n] & own)) @ W.T)[None],
    )


def _independent(stack: Stack) -> Iterator[Stack]:
    """Yield a configuration's equations in groups whose noise is independent of each other's."""
    k = stack.index.shape[1]
    if stack.joint.shape[2] or stack.unit is None:
        yield stack
        return
    V = stack.instrument[0]
    U = stack.unit[0]
    related = (np.abs(V) > ROUNDING * np.abs(V).max(initial=0.0)) | (np.abs(U) > ROUNDING)
    number = scipy.sparse.csgraph.connected_components(related | np.eye(k, dtype=bool))[1]
    for part in (np.flatnonzero(number == i) for i in range(number.max(initial=-1) + 1)):
        yield Stack(
            index=stack.index[:, part],
            instrument=V[np.ix_(part, part)][None],
            length=stack.length[:, part],
            angle=stack.angle[:, part],
            joint=np.zeros((1, len(part), 0)),
            unit=U[np.ix_(part, part)][None],
        )


def of_rows(touches: Touches, data: Dataset, each: Sequence[Array], where: Things, reading: bool) -> list[Array]:
    """Return the covariance of every row's residual, of those (N, k, k) or (1, k, k) [SI] of rows by themselves."""
    numbers = [index[:, 0] for index in equation_numbers(data)]
    touch = np.zeros((touches.equations, 3, 3))
    for block, V, first in zip(data.blocks, each, numbers, strict=True):
        if block.measurement.touching:
            touch[first] = V
    left = touch.copy()
    for thing, index in zip(where, touches.rows, strict=True):
        left[index[:, 0]] = _left(thing, touch[index[:, 0]])
    through = {tie.equations[0]: _of_tie(touches, tie, where, touch) for tie in touches.ties}
    found = []
    for block, V, first in zip(data.blocks, each, numbers, strict=True):
        if block.measurement.touching:
            found.append(left[first])
            continue
        rows = np.broadcast_to(V, (len(first), *V.shape[1:])).copy()
        for i, equation in enumerate(first):
            if equation in through:
                rows[i] = reading * block.covariance[min(i, len(block.covariance) - 1)] + through[equation]
        found.append(rows)
    return found


def _left(thing: Point | Plane, V: Array) -> Array:
    """Return the covariances (K, 3, 3) of what touches are off the thing that they put in its place, of their own."""
    K = len(V)
    if K == 1:
        return V
    through = thing.slopes(np.eye(3 * K).reshape(K, 3, 3 * K)).reshape(K, 3, K, 3)
    found = np.einsum("aibj,bjk,albk->ail", through, V, through)
    own = np.einsum("kii->ki", found)
    # directions that a touch does not show have no error: any positive variance serves
    own += np.where(own > 0, 0.0, V.max())
    return found


def _of_tie(touches: Touches, tie: Tie, where: Things, touch: Array) -> Array:
    """Return what the touches' noise adds to the covariance (e, e) of what a drawing states."""
    found = np.zeros((len(tie.equations), len(tie.equations)))
    for end in tie.ends:
        index = touches.rows[end]
        K = len(index)
        still = [Moved(np.zeros((3, 3 * K)), np.zeros((3, 3 * K)))] * 2
        still[tie.ends.index(end)] = where[end].moved(np.eye(3 * K).reshape(K, 3, 3 * K))
        each = _compared(tie, where, still).reshape(-1, K, 3)
        found += np.einsum("aki,kij,bkj->ab", each, touch[index[:, 0]], each)
    return found
