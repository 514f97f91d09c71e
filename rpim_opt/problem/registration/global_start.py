"""Global start: joint signs, joint zeros, frames and reflectors of an arm that its nominal model does not explain.

Batched multi-start Levenberg-Marquardt (`fit_arms`) over joint zeros and reflectors, with the base (for lengths the
anchor) eliminated at every step: random zeros with all signs in turn, a few steps for all and more for the best, until
enough starts end in one optimum. There is no certificate: a better optimum that a start reaches with probability h is
missed with probability (1 - h)^starts. Lengths do not distinguish an arm from its mirror image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress, product
from typing import Any

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import joined, three_digits
from rpim_opt.data.measurements.measurement import of_fixture
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.closed_forms import proper, rigid, transformed
from rpim_opt.problem.registration.frames import ridge_deviations
from rpim_opt.problem.registration.points import (
    UNEXPLAINED,
    Candidates,
    Fit,
    Points,
    fit_arms,
    lengths_of,
    mirrored,
    points_of,
    rms,
    stacked,
)
from rpim_opt.robot.kinematics import FRAME, forward_kinematics, frame_numbers, numeric_frame
from rpim_opt.robot.mdh import MDH, MDH_DIMENSION, Robot, numbered
from rpim_opt.robot.parameters import tool_prefix

ACCEPTED = 0.02  # a mapping may leave this part of the extent: an arm's geometric errors are not fitted with it
EXPLAINED = 3.0
"""A mapping is taken if it leaves less than a third of what the nominal one leaves with zeros fitted near it."""
NEAR_ZERO = 0.2  # joint zeros up to this [rad] are left to the calibration, as deviations of theta
QUARTER = np.pi / 2
SHORT, LONG = 10, 45  # steps of all starts of a round, and of the best quarter
ROUNDS, HITS = 4, 5  # rounds at most, and starts that have to end in the best optimum
FEW = 40  # rows of a search; the best candidates are fitted to more
LEAST_NOISE = 5e-5  # floor of the error of a point [m]: what is nearer is rounding
ODDS = 30.0  # difference of chi-squared up to which data do not distinguish two mappings
GROSS = 6.0  # rows farther off than so many medians of the best fit's errors do not distinguish mappings
FEWEST_FREE = 4  # degrees of freedom below which any mapping would fit
MOST_JOINTS = 8  # joints beyond which signs are too many to be tried
SAME_TOOL = 0.05  # distances of a reflector from its stated place [m] whose multiples distinguish two descriptions
MIRRORED = 1.3  # a left-handed frame fits as well if it leaves up to so many times what a mapping leaves
COMPARED = 200  # configurations at which mappings are compared
WRITE = "write these joints' sign in robot.toml and add their zeros to theta_deg (or theta_rad)"  # the remedy
AS_STATED = "joints as stated"
TOLD = 2  # other mappings of equal fit that are named, the best ones
RARE_BASIN = 0.005  # probability of reaching a basin with one start whose probability of being missed is reported


@dataclass(frozen=True, eq=False)
class Alternative:
    """Another joint mapping of equal fit: signs and zeros (dof,), and its distance from the best one."""

    sign: Array
    zero: Array
    apart: float  # RMS distance of their predictions at other configurations [m]
    deciding: Array  # (dof,) joint values of the controller at which these are farthest apart [rad or m]
    mirror: bool = False  # whether it is the mirror image of the first one, so that lengths are the same everywhere
    moved: float = 0.0  # how far a reflector is from its stated place in the flange frame [m]


@dataclass(frozen=True, eq=False)
class JointMapping:
    """Signs and zeros of joints estimated from the data.

    ::

        q_model = joint_map (sign * q) + zero

    """

    joint_types: tuple[str, ...]
    sign: Array  # (dof,) +1 or -1
    zero: Array  # (dof,) [rad or m]
    nominal: float  # RMS error of the best three quarters of the points with joints as stated [m]
    left: float  # and with the mapping
    starts: int  # random starts of the search
    alternatives: tuple[Alternative, ...] = ()  # of equal fit, with other predictions
    mirrored: bool = False  # whether a left-handed measured frame and joints as stated fit as well
    behind: str = ""  # joints that fit as well in a left-handed frame, as stated or one of them reversed
    same: tuple[Alternative, ...] = ()  # other descriptions of the same robot that change as few joints
    moved: float = 0.0  # how far a reflector is from its stated place in the flange frame [m]
    lengths: tuple[str, ...] = ()  # one of which, with the other sign and joints as stated, is the same robot
    joint_names: tuple[str, ...] = ()

    @property
    def explanations(self) -> str:
        """Return the descriptions of the robot as text: lengths of the other sign, one number each, then mappings."""
        counted = [described(self, each.sign, each.zero) for each in (self, *self.same)]
        return ", or ".join([*(f"{name} with the opposite sign in the robot file" for name in self.lengths), *counted])

    @property
    def caution(self) -> str:
        """Return what table and robot file disagree about (signs, zeros), and what to check and to write."""
        far = ", or ".join(f"{three_digits(1e3 * each.moved)} mm" for each in (self, *self.same))
        there = f", with a reflector {far} from its stated place" if self.same else ""
        equally = f" (these explain the data equally well{there})" if self.same or self.lengths else ""
        text = (
            f"Signs or zeros of joints differ between table and robot file: {self.explanations}{equally}. The result "
            f"holds for the table's joint values. Check the pendant: if it displays the table's values, {WRITE}; if it "
            "displays the robot file's, correct the table's columns and calibrate again before using this robot."
        )
        return f"{text} Check the sign of {' and '.join(self.lengths)} first." if self.lengths else text

    @property
    def sentence(self) -> str:
        """Return a sentence on the mapping, its errors and its certainty."""
        return (
            f"Joint mapping estimated from the data: {described(self, self.sign, self.zero)} "
            f"({three_digits(1e3 * self.left)} mm instead of {three_digits(1e3 * self.nominal)} mm; "
            f"{self.starts} random starts: an optimum found by one start in {round(1 / RARE_BASIN)} is missed "
            f"with a probability of {(1 - RARE_BASIN) ** self.starts:.1g})."
        )

    @property
    def ambiguities(self) -> tuple[str, ...]:
        """Return sentences on alternatives of equal fit; no mirror image of one with stated signs and quarter turns."""
        turning = np.array(self.joint_types) == "revolute"
        as_nominal = bool((self.sign > 0).all() and (self.zero[turning] % QUARTER == 0).all())
        alternatives = [other for other in self.alternatives if not (other.mirror and as_nominal)]
        sentences = []
        if self.behind:
            sentences.append(
                f"A left-handed measured frame with {self.behind} fits as well: a known direction in the instrument's "
                "frame (such as up) or measured orientations would decide."
            )
        for other in alternatives[:TOLD]:
            what = described(self, other.sign, other.zero)
            if other.mirror:
                first = described(self, self.sign, self.zero)
                sentences.append(
                    f"The data fit {what} as well as {first}: lengths do not distinguish an arm from its mirror "
                    f"image. Measure a few positions to decide, or check the set-up, and {WRITE}."
                )
                continue
            values = ", ".join(_value(kind, v) for kind, v in zip(self.joint_types, other.deciding, strict=True))
            sentences.append(
                f"The data fit {what} as well, which differs by {three_digits(1e3 * other.apart)} mm at other "
                f"configurations: measure at pendant values ({values}) to decide."
            )
        more = len(alternatives) - TOLD
        if more > 0:
            sentences.append(f"{more} more mappings fit as well: joints moved too little, or data are wrong.")
        return tuple(sentences)


def described(robot: Robot | JointMapping, sign: Array, zero: Array) -> str:
    """Return signs and zeros (dof,) of its joints as text."""
    parts = []
    reversed_ = [numbered(i, robot.joint_names) for i in np.flatnonzero(sign < 0)]
    if reversed_:
        parts.append(f"joint{'s' * (len(reversed_) > 1)} {joined(reversed_)} reversed (sign = -1)")
    shifted = np.flatnonzero(np.abs(zero) > 1e-9)
    shifts = [f"joint {numbered(i, robot.joint_names)} {_value(robot.joint_types[i], zero[i], '+')}" for i in shifted]
    if shifts:
        parts.append(f"zero of {joined(shifts)}")
    return ", ".join(parts) or AS_STATED


def _value(kind: str, value: float, plus: str = "") -> str:
    if kind == "prismatic":
        return f"{1e3 * value:{plus}.1f} mm"
    return f"{np.degrees(value):{plus}.1f} deg"


def _turning(robot: Robot) -> np.ndarray:
    return np.array(robot.joint_types) == "revolute"


def _one_reversed(n: int) -> Array:
    """Return the signs (1 + n, n) of no joint reversed, and of each one."""
    return np.vstack([np.ones(n), np.ones((n, n)) - 2 * np.eye(n)])


def mapped(robot: Robot, sign: Array, zero: Array) -> Robot:
    """Return a robot whose joints are counted with signs (dof,) of the controller and zeros (dof,) of the model."""
    turning = _turning(robot)
    mdh = robot.mdh.copy()
    mdh[:, 2] += np.where(turning, zero, 0.0)
    mdh[:, 2] = np.where(turning & (zero != 0), np.angle(np.exp(1j * mdh[:, 2])), mdh[:, 2])
    mdh[:, 3] += np.where(turning, 0.0, zero)
    return replace(robot, mdh=mdh, joint_map=robot.joint_map * sign)


def find_mapping(problem: Source) -> tuple[JointMapping, CalibrationProblem] | None:
    """Return signs and zeros of the joints where the nominal robot fails, and the mapped problem.

    They are sought only if the base (for lengths the anchor) and all reflectors' positions are identified: otherwise
    the statements determine the joints. None if nominal signs and small zeros explain the data, if no mapping does, or
    if a left-handed measured frame does.
    """
    if not isinstance(problem, CalibrationProblem):
        return None
    points = points_of(problem) or lengths_of(problem)
    if points is None:
        return None
    needed = {tool_prefix(marker) + c for block in problem.data.blocks for marker in block.markers for c in FRAME[:3]}
    needed |= set(_anchor(problem)) if points.lengths else {f"base_{c}" for c in FRAME}
    if not needed <= set(problem.parameters.free.names) or explained(points):
        return None
    mapping = search(points, problem)
    if mapping is None or mapping.mirrored:
        return None
    return mapping, with_mapping(problem, points, mapping.sign, mapping.zero)


def _anchor(problem: CalibrationProblem) -> list[str]:
    """Return the names of the place and the offset of lengths, none of distances between points of the arm."""
    block = problem.data.blocks[0]
    return [of_fixture(name, block.fixture) for name in block.measurement.parameters]


def explained(points: Points) -> bool:
    """Whether the nominal robot explains the points, apart from gross errors."""
    few = points.evenly(FEW)
    return bool(rms(fit_arms(Candidates.of([few]), SHORT, robust=True))[0] <= UNEXPLAINED * few.extent)


def with_mapping(problem: CalibrationProblem, points: Points, sign: Array, zero: Array) -> CalibrationProblem:
    """Return the problem with the joints mapped, and base and reflectors registered to the points."""
    robot = mapped(problem.robot, sign, zero)
    fit = fit_arms(Candidates.of([replace(points, robot=robot)]), LONG, robust=True)
    p = problem.parameters
    values = {f"{of}{i}": v for of, k in (("theta", 2), ("d", 3)) for i, v in enumerate(robot.mdh[:, k], start=1)}
    free = {*p.free.names, *values}
    places = {}
    if not points.lengths:
        places["base_"] = fit.base[0]
    elif names := _anchor(problem):
        base = numeric_frame(p.nominal[p.frame("base_")])
        anchor = transformed(base, -fit.base[0, :3, 3])
        values |= dict(zip(names, [*anchor, fit.offset[0]], strict=True))
    several = len(fit.tools[0]) // len(points.names)
    for name, tool in zip(points.names, fit.tools[0].reshape(len(points.names), several, 3), strict=True):
        turn = proper((tool[1:] - tool[0]).T) if several > 1 else np.eye(3)
        places[tool_prefix(name)] = rigid(turn, tool[0])
    for prefix, T in places.items():
        values |= {prefix + c: value for c, value in zip(FRAME, frame_numbers(T), strict=True)}
    nominal = np.array(
        [values.get(name, value) if name in free else value for name, value in zip(p.names, p.nominal, strict=True)]
    )
    return replace(problem, robots=robot, parameters=replace(p, nominal=nominal))


def search(points: Points, problem: CalibrationProblem | None = None) -> JointMapping | None:
    """Return the mapping that explains the points; None if the nominal one does, too, or if none does.

    With a ``problem``, a simpler mapping has priority that explains them equally well with deviations within its prior.
    """
    rng = np.random.default_rng(0)
    robot = points.robot
    n = robot.dof
    if n < len(robot.mdh):  # a sign or zero of a joint would not say what follows it
        return None
    turning = _turning(robot)
    few = points.evenly(FEW if points.turns is None else FEW // 4)  # a pose is four points
    base = Candidates.of([few])
    free = few.y.size - max(n - 2, 0) - base.tools.size - 6
    if free < FEWEST_FREE or n > MOST_JOINTS:
        return None
    near = fit_arms(base, 2 * LONG, zeros=True, robust=True, noise=LEAST_NOISE)
    small = np.abs(np.where(turning, near.zero[0], 0.0))[1:-1].max(initial=0.0) < NEAR_ZERO
    if small and rms(near)[0] <= UNEXPLAINED * few.extent:
        return None
    signs = np.array(list(product([1.0, -1.0], repeat=n)))
    count = max(600, 6 * len(signs))
    # what happens most: any joints reversed, or at most one, and one that is a quarter or half a turn off
    off: Any = np.kron(np.eye(n)[turning], [[QUARTER], [-QUARTER], [2 * QUARTER]])
    one = _one_reversed(n)
    usual = np.vstack([signs, np.repeat(one, len(off), axis=0)])
    sign, pool = _round(few, usual, np.vstack([np.zeros_like(signs), np.tile(off, (len(one), 1))]))
    starts = 0
    for _ in range(ROUNDS):
        drawn = signs[np.resize(rng.permutation(len(signs)), count)]
        begun, fits = _round(few, drawn, rng.uniform(-np.pi, np.pi, (count, n)) * turning)
        sign, pool = np.concatenate([sign, begun]), stacked([pool, fits])
        starts += count
        if np.count_nonzero(pool.cost < 1.05 * pool.cost.min() + 1e-12) >= HITS:
            break
    best = np.argsort(pool.cost)[:64]  # they are fitted to all rows
    sign = np.vstack([np.ones((1, n)), sign[best]])
    zero, tools = np.vstack([near.zero, pool.zero[best]]), np.concatenate([near.tools, pool.tools[best]])
    candidates = _signed(points, sign)._replace(zero=zero, tools=tools)
    fits = fit_arms(candidates, LONG, zeros=True, robust=True, noise=LEAST_NOISE)
    return _judged(points, problem, sign, fits, starts, small, rng)


def _signed(points: Points, sign: Array) -> Candidates:
    """Return candidates of the points with signs (B, dof) of their joints."""
    candidates = Candidates.of([replace(points, q=each * points.q) for each in sign])
    return candidates._replace(spread=np.full(len(candidates.stated), 3.0 * candidates.spread.max()))


def _round(points: Points, sign: Array, zero: Array) -> tuple[Array, Fit]:
    """Return the best quarter of random starts, fitted: signs (B, dof) and fits."""
    candidates = _signed(points, sign)._replace(zero=zero)
    first = fit_arms(candidates, SHORT, zeros=True, noise=LEAST_NOISE)
    best = np.argsort(first.cost)[: max(len(sign) // 4, 1)]
    begun = candidates.take(best)._replace(zero=first.zero[best], tools=first.tools[best])
    return sign[best], fit_arms(begun, LONG, zeros=True, noise=LEAST_NOISE)


def _plainer(
    points: Points, problem: CalibrationProblem, sign: Array, fits: Fit, inliers: np.ndarray
) -> tuple[Array, Fit]:
    """Return signs (B, dof) and fits of mappings without zeros, or with quarter turns, that explain points as well.

    Equally well means residuals and penalty together, with deviations within the problem's prior, compared with the
    first of the others: zeros of any size absorb errors of the geometry if joints moved little.
    """
    n = points.robot.dof
    zero = np.array([QUARTER * np.round(_gauged(points.robot, each) / QUARTER) for each in fits.zero])
    zero *= _turning(points.robot)
    signs = np.array(list(product([1.0, -1.0], repeat=n)))
    both = np.unique(np.vstack([np.hstack([sign, zero]), np.hstack([signs, np.zeros_like(signs)])]), axis=0)
    tried = fit_arms(_signed(points, both[:, :n])._replace(zero=both[:, n:]), LONG, robust=True, noise=LEAST_NOISE)
    rows = points.row[np.unique(np.flatnonzero(inliers) // (len(inliers) // len(points.row)))]
    alone = problem.on(problem.data.take(np.sort(rows)))

    def squares(sign: Array, zero: Array) -> tuple[float, int]:
        there = with_mapping(alone, points, sign, zero)
        x = ridge_deviations(there)
        model = there.linearize(x)
        z = x / model.parameters.scale
        r = model.b - model.A @ z
        return float(r @ r + z @ z), len(r)

    least, count = squares(sign[0], fits.zero[0])
    near = np.flatnonzero(rms(tried) <= UNEXPLAINED * points.extent)
    as_well = [i for i in near if squares(*np.split(both[i], 2))[0] < least * (1 + ODDS / count)]
    return both[as_well, :n], Fit(*(each[as_well] for each in tried))


@dataclass(frozen=True, eq=False)
class _Mappings:
    """Mappings that explain points: signs (B, dof) and fits, those from ``sampled`` on added by `_plainer`."""

    points: Points
    sign: Array
    fits: Fit
    sampled: int

    @cached_property
    def zeros(self) -> list[Array]:
        """Zeros (dof,) without what base and tool absorb."""
        return [_gauged(self.points.robot, zero) for zero in self.fits.zero]

    @cached_property
    def moved(self) -> Array:
        """How far a reflector is from its stated place (B,) [m]."""
        return np.linalg.norm(self.fits.tools - Candidates.of([self.points]).stated, axis=-1).max(axis=-1)

    def plain(self, i: int) -> tuple[int, int, int, float, tuple[float, ...]]:
        """Sort key for the least change: number of changed joints, reflector, reversed joints, zeros, then signs."""
        reverse, zero = self.sign[i] < 0, np.abs(self.zeros[i])
        changed = int((reverse | (zero > NEAR_ZERO)).sum())
        size = round(float(zero.sum()), 2)
        return changed, int(self.moved[i] / SAME_TOOL), int(reverse.sum()), size, tuple(self.sign[i].tolist())

    def predicted(self, i: int, q: Array) -> Array:
        """Return the reflectors' places at q (N, dof), of lengths about their mean."""
        T = self.fits.base[i] @ forward_kinematics(mapped(self.points.robot, self.sign[i], self.fits.zero[i]), q)
        there = transformed(T[:, None], self.fits.tools[i])
        return there - there.mean(axis=(0, 1)) if self.points.lengths else there

    def robots(self, there: Mapping[int, Array], same: float) -> list[list[int]]:
        """Return the indices of the mappings, grouped by the robot that they describe, the best first.

        Two mappings are one robot if they predict the same, to ``same`` [m], or if the simpler one has the other's
        signs and nearly its zeros; groups are also merged by a third mapping.
        """

        def alike(i: int, k: int) -> bool:
            turns = np.abs(np.angle(np.exp(1j * (self.zeros[k] - self.zeros[i]))))
            near = max(i, k) >= self.sampled and (turns < NEAR_ZERO).all() and (self.sign[k] == self.sign[i]).all()
            return bool(near) or _apart(there[i], there[k], self.points.lengths) <= same

        links = [[alike(i, k) for k in there] for i in there]
        number = scipy.sparse.csgraph.connected_components(np.array(links))[1].tolist()
        return [[i for i, own in zip(there, number, strict=True) if own == k] for k in dict.fromkeys(number)]

    def same(self, robot: Sequence[int]) -> tuple[Alternative, ...]:
        """Return other descriptions of a robot that change as few joints as its plainest."""
        first, *others = sorted(robot, key=self.plain)
        arm = self.points.robot
        also = {described(arm, self.sign[first], self.zeros[first]): first}
        for k in others:
            if self.plain(k)[0] == self.plain(first)[0]:
                also.setdefault(described(arm, self.sign[k], self.zeros[k]), k)
        none = np.zeros(arm.dof)
        ways = list(also.values())[1:]
        return tuple(Alternative(self.sign[k], self.zeros[k], 0.0, none, moved=float(self.moved[k])) for k in ways)


def _likely(points: Points, fits: Fit) -> tuple[list[int], np.ndarray]:
    """Return the fits within `ODDS` of chi-squared, the best first, and which errors (E,) of the best are inliers."""
    best = int(np.argmin(rms(fits)))
    inliers = fits.error[best] <= GROSS * np.median(fits.error[best])
    equations = (1 if points.lengths else 3) * int(inliers.sum())
    free = max(equations - max(points.robot.dof - 2, 0) - fits.tools[0].size - len(FRAME), 1)
    cost = (fits.error[:, inliers] ** 2).sum(axis=1)
    chi2 = cost / max(cost[best] / free, LEAST_NOISE**2)
    return [int(i) for i in np.argsort(chi2) if chi2[i] < chi2.min() + ODDS], inliers


def _judged(
    points: Points,
    problem: CalibrationProblem | None,
    sign: Array,
    fits: Fit,
    starts: int,
    small: bool,
    rng: np.random.Generator,
) -> JointMapping | None:
    """Return the plainest mapping of the best robot class, and others that fit as well; the first fit is nominal."""
    left = rms(fits)
    least = float(left.min())
    if not least <= ACCEPTED * points.extent or (small and EXPLAINED * least >= left[0]):
        return None
    near, inliers = _likely(points, fits)
    sampled = len(sign)
    if problem is not None and not points.by_camera:
        plainer, more = _plainer(points, problem, sign[near], Fit(*(each[near] for each in fits)), inliers)
        near += range(sampled, sampled + len(plainer))
        sign, fits = np.vstack([sign, plainer]), stacked([fits, more])
    found = _Mappings(points, sign, fits, sampled)
    # within the joint limits, and wherever joints were measured
    measured = points.q.reshape(-1, points.robot.dof)
    low, high = measured.min(axis=0), measured.max(axis=0)
    limits = points.robot.limits.T
    ends = np.where(_turning(points.robot), [[-np.pi], [np.pi]], [low, high])
    ends = np.where(np.isfinite(limits), limits, ends)
    elsewhere = rng.uniform(np.minimum(ends[0], low), np.maximum(ends[1], high), (COMPARED, points.robot.dof))
    same = 0.5 * max(least, LEAST_NOISE)
    there = {i: found.predicted(i, elsewhere) for i in near}
    plainest = {min(each, key=found.plain): each for each in found.robots(there, same)}
    best = next(each for each in plainest.values() if near[0] in each)

    def mirrors(one: Sequence[int], other: Sequence[int]) -> bool:
        return points.lengths and _apart(-there[one[0]], there[other[0]], True) <= same

    # robots that a plainer mapping describes, and mirror images, are as good as the best
    as_good = [i for i, each in plainest.items() if each is best or mirrors(each, best) or max(each) >= sampled]
    i = min(as_good, key=found.plain)
    first = plainest.pop(i)
    changes = found.plain(i)[0]
    if not changes:
        return None
    others = []
    for k in sorted(plainest, key=found.plain):
        each = there[plainest[k][0]]
        far = np.linalg.norm(each - there[first[0]], axis=-1).max(axis=-1)
        apart = _apart(each, there[first[0]], points.lengths)
        deciding = elsewhere[int(np.argmax(far))]
        others.append(Alternative(found.sign[k], found.zeros[k], apart, deciding, mirrors(plainest[k], first)))
    nominal = float(rms(fit_arms(Candidates.of([points]), LONG, robust=True))[0])
    left = float(rms(fits)[i])
    behind = _behind_a_mirror(points, MIRRORED * left)
    if changes < 2:  # fewer changes than a mirror and a joint
        behind = [name for name in behind if name == AS_STATED]
    return JointMapping(
        points.robot.joint_types, sign[i], found.zeros[i], nominal, left, starts, tuple(others),
        mirrored=AS_STATED in behind, behind=" or ".join(behind), same=found.same(first), moved=float(found.moved[i]),
        lengths=_of_other_sign(points, MIRRORED * left), joint_names=points.robot.joint_names,
    )  # fmt: skip


def _behind_a_mirror(points: Points, largest: float) -> list[str]:
    """Return which joints, none or one reversed, explain a left-handed frame to ``largest`` [m]; none of lengths."""
    if points.lengths:
        return []
    robot, other = points.robot, mirrored(points)
    sign = _one_reversed(robot.dof)
    as_well = _explain([replace(other, q=each * other.q) for each in sign], largest)
    return [described(robot, sign[k], np.zeros(robot.dof)) for k in np.flatnonzero(as_well)]


def _of_other_sign(points: Points, largest: float) -> tuple[str, ...]:
    """Return the lengths of the DH table one of which, with the other sign, explains points to ``largest`` [m]."""
    others = {}
    for i, k in np.argwhere(points.robot.mdh):
        if MDH_DIMENSION[MDH[k]] == "length":
            others[f"{MDH[k]}{i + 1}"] = mdh = points.robot.mdh.copy()
            mdh[i, k] *= -1
    tries = [replace(points, robot=replace(points.robot, mdh=mdh)) for mdh in others.values()]
    return tuple(compress(others, _explain(tries, largest) if tries else ()))


def _explain(tries: Sequence[Points], largest: float) -> np.ndarray:
    """Return which points (B,) of one robot it explains to ``largest`` [m], with joint zeros near the stated ones."""
    fits = fit_arms(Candidates.of(tries), LONG, zeros=True, noise=LEAST_NOISE)
    small = [np.abs(_gauged(tries[0].robot, zero)).max() < NEAR_ZERO for zero in fits.zero]
    return small & (rms(fits) < largest)


def _apart(one: Array, other: Array, lengths: bool) -> float:
    """Return the RMS distance of points (..., 3); of lengths, which know no frame, as they are nearest."""
    if lengths:
        one = one @ proper(np.einsum("nmi,nmj->ij", other, one)).T
    return float(np.sqrt(((one - other) ** 2).sum(axis=-1).mean()))


def _gauged(robot: Robot, zero: Array) -> Array:
    """Return zeros (dof,) that base and tool do not take up, near multiples of a quarter turn these."""
    turning = _turning(robot)
    zero = np.where(turning, np.angle(np.exp(1j * zero)), zero)
    if turning[0]:
        zero[0] = 0.0
    if turning[-1] and robot.mdh[-1, 4] == 0:
        zero[-1] = 0.0
    quarter = QUARTER * np.round(zero / QUARTER)
    quarter = np.where(quarter < -1.5 * QUARTER, np.pi, quarter)  # half a turn either way
    return np.where(turning & (np.abs(np.angle(np.exp(1j * (zero - quarter)))) < np.radians(2)), quarter, zero)
