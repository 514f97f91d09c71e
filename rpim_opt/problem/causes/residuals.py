"""What residuals show: motions of frames, changes of joints, gear ratios, scales, backlash and scatter."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, combinations, combinations_with_replacement, product
from typing import Any, NamedTuple

import numpy as np
import scipy
from scipy.special import fdtrc, gammaln

from rpim_opt.basics.arrays import TINY, Array, rms
from rpim_opt.basics.text import joined, listed, three_digits
from rpim_opt.basics.units import display
from rpim_opt.data.measurements.measurement import of_fixture
from rpim_opt.problem.causes.misreadings import RARE, coupling, signs
from rpim_opt.problem.causes.positions import MOST_ROUNDS
from rpim_opt.problem.causes.rows import (
    ANGULAR,
    EXACT,
    FEW,
    FEWEST,
    OUTLYING,
    REACH,
    first,
    named_rows,
    roundings,
    stretched_length,
)
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.noise import Equations
from rpim_opt.problem.problem import SHIFTED, CalibrationProblem
from rpim_opt.problem.registration.frames import ridge_deviations
from rpim_opt.problem.registration.points import fit_points, points_of
from rpim_opt.robot.kinematics import FRAME, forward_kinematics, numeric_frame, numeric_link
from rpim_opt.robot.mdh import Robot, numbered
from rpim_opt.robot.parameters import of_session, tool_prefix

NOTICED = 2**0.5
"""Residuals over the noise from which a cause may explain half of the squares and leave no less than the noise."""
MOVED = 0.5  # an instrument moved if that leaves less than this part of the sum of squares
SLIGHT = (5 / 6) ** 2  # part of the squares left by an effect worth reporting: errors without it are a sixth smaller
NOISY = 3.0  # residual RMS over the stated noise that contradicts the stated instrument
SEVERAL = 0.85  # several joint zeros moved if that leaves less than this part of what one leaves
LOOSE = 4e-4  # backlash of a joint [rad, m] beyond any intact gear's: a quarter of it is usual
COUPLED = 0.004  # ratio below which a coupling of two joints is not made by gears: teeth of one over those of another
GEARS = {
    "revolute": ("turns", "gear ratio"),
    "prismatic": ("moves", "pitch of its screw or belt, or the scale of the instrument"),
}
"""What a joint does, and what its transmission is."""
LOADS, SINGULAR = 0.6, 1e-9
"""Largest part of the residuals left by two loads; part of the squares below which columns are the same."""
TWO_KINDS, STARTS = 0.4, 30
"""Largest part of the residuals left by two calibrations of two kinds of rows; starts of the search."""
SCATTERED = 5.0  # residuals of rows over those of others that make them another kind
FREE = 1.0  # standard deviation of positions of touched points and planes [m, rad]
NORMAL, HEAVY, LIKELIER = 1e3, 3.0, 7.0
"""Degrees of freedom of Student's distributions of all rows; log odds at which some are of another kind (1,000:1)."""
SHOWING = 1.5  # equations of rows over all parameters, from which on their residuals show their noise
STEADILY = "more and more from row to row"
JUMPING = 0.5  # mean square step of every joint over that of rows in random order, above which rows have no order
BENDS = 12  # degree of the polynomial that the side of a rail is
COURSES = 6  # half waves that a slow motion has over all rows at most
PLACES, PRECISE, SPANS = 40, 120, 12
"""Rows and joint values from which on something may have moved, and those between which it did and moved back."""
MOST_EQUATIONS = 3000  # equations up to which a change is looked for
BEYOND_SLOPES = 0.02  # movement of a joint [rad, m] from which on its slope says too little
OUTLYING_ROUNDS = 3  # in which outliers of the one calibration are found


Shares = dict[str, Array]
"""When something changes, and what part equations (m,) or (m, s) have in it."""


class Addition(NamedTuple):
    """Columns (m, c) that a linear model lacks, and what coefficients (c,) mean: what happened, and what to do."""

    columns: Array
    said: Callable[[Array], tuple[str, str]] | None  # None where it is no mistake
    most: float = np.inf  # coefficient from which on a slope says nothing
    joint_map: Callable[[Array], Array] | None = None  # the robot's joint map with it, of gears


def _explained(
    model: LinearModel, x: Array, angle: np.ndarray, additions: Iterable[Addition], left_at_most: float = MOVED
) -> tuple[float, Addition, Array] | None:
    """Return which part of a model's residual at x (n,) is left, by which addition, with which coefficients (c,).

    Together with the parameters and their prior the addition has to leave at most ``left_at_most`` of the sum of
    squares, with p-value below one in a million (F test, counting all additions): None if none does. If lengths and
    angles scatter differently from their stated noise, the sum of squares has the degrees of freedom of a chi-squared
    with its mean and variance (Satterthwaite 1946).
    """
    taken = _freedom(model)
    without = _without_parameters(model)
    rest = without((model.b - model.A @ (x / model.parameters.scale))[:, None])[:, 0]
    whole = float(rest @ rest)
    kinds = [rest[: len(angle)][part] ** 2 for part in (angle, ~angle) if part.any()]
    uneven = len(angle) * sum(float((each.sum() / max(whole, TINY)) ** 2) / len(each) for each in kinds)
    every = list(additions)
    tried: list[tuple[float, float, Addition, Array]] = []  # by the variance that is left: of many columns against few
    for addition in every:
        G = without(addition.columns)
        step = np.asarray(np.linalg.lstsq(G, rest, rcond=1e-9)[0], dtype=float)
        gain = whole - float(np.sum((rest - G @ step) ** 2))
        spare = max(len(model.A) - taken - len(step), 1)
        # one of many mistakes is ahead of what is none by chance, unless it is that many times as likely
        odds = 1.0 if addition.said is None else len(every) ** (2 / spare)
        tried.append(((whole - gain) / spare * odds, gain, addition, step))
    if not tried or not whole:
        return None
    _, gain, addition, step = min(tried, key=lambda each: round(each[0] / whole, 9))  # of equal ones the first
    spare = max((len(model.A) - taken - len(step)) / max(uneven, 1.0), 1)
    left = max(whole - gain, 1e-300)
    chance = fdtrc(len(step), spare, gain / len(step) / (left / spare))
    if gain <= (1 - left_at_most) * whole or chance * len(tried) >= RARE or np.abs(step).max() > addition.most:
        return None
    return float(np.sqrt(left / whole)), addition, step


def _freedom(model: LinearModel) -> float:
    """Return how many degrees of freedom the parameters take up beside their prior."""
    squares = model.svd[1] ** 2
    return float(np.sum(squares / (1 + squares)))


def _without_parameters(model: LinearModel) -> Callable[[Array], Array]:
    """Return a function of columns (m, c) that returns what parameters with their prior leave of them (m + n, c)."""
    n = model.A.shape[1]
    own = np.linalg.qr(np.vstack([model.A, np.eye(n)]))[0]

    def without(columns: Array) -> Array:
        G = np.vstack([columns, np.zeros((n, columns.shape[1]))])
        return np.asarray(G - own @ (own.T @ G), dtype=float)

    return without


def shown_by_residuals(problem: CalibrationProblem, x: Array, *, most: float | None = None) -> Iterator[str]:
    """Report what one addition to the linearization at x (n,) explains best: what moved, lags or is scaled.

    Tried are columns of a base for every session; of a base, fixture, reflector or joint zero from a row on, or between
    two of a few; of a joint zero also from a value of the joint on; of a reflector by the direction of gravity at the
    flange; the derivative by a joint's zero times a joint value, and all of these times the distance from the previous
    row; and derivatives by scale or offset of lengths, for positions by scales and skews of their axes. Otherwise
    backlash, rows of two kinds, and noise of one column or of some rows are sought. Nothing is reported if gravity and
    gear eccentricity outside the model explain more: that is lack of fit, no mistake. With ``most``, causes that leave
    at most this part of the squares are reported, otherwise only backlash: a side for every row adds 2 ln 2 to -2 ln L.
    Backlash is named instead of an addition that leaves twice as much.
    """
    if len(problem.owners) > MOST_EQUATIONS:
        return
    single = most is not None
    if not single:  # a noise that was learned takes up what is looked for
        problem = problem.with_repeatability(None)
    model = problem.linearize(x)
    # a cause that leaves more than instrument and robot do is beyond its linearization, or one of several mistakes
    norms, count = problem.with_repeatability(None).whitened_errors(x)
    of_noise = NOISY * np.sqrt(count.sum()) / np.sqrt(max(float(norms @ norms), TINY))
    largest = {"length": REACH * stretched_length(problem.robot, problem.data.blocks), "angle": ANGULAR}
    own = [part / size for each, part in largest.items() if (size := rms(problem.errors(x, each))) > TINY]
    acceptable = min(max(of_noise, min(own, default=0.0)), 1.0)
    most = min(MOVED if most is None else most, acceptable**2)
    moves = _moves(problem, x, along_joints=most <= MOVED)
    angle = problem.equations.angle
    best = _explained(model, x, angle, chain(moves, _gears(problem, model), _scales(problem, x, model)), most)
    left, limit = np.inf if best is None else best[0], min(TWO_KINDS, acceptable)
    if single:
        sides = min(limit, most**0.5 * 0.5 ** (len(problem.data) / len(model.b)), MOVED * left)
        states = two_states(problem, x, min(LOADS, sides))
        yield from first(two_positions(problem, x, sides), _said_of_addition(best), states)
        return
    # zeros of all joints fit two gross errors, whatever these are, but no more
    what, cause = "set of joint zeros", "did several joints slip, or were they remastered"
    changes = _changes(problem, x, model.A, problem.robot.zeros, what, cause, _shares(problem))
    several = _explained(model, x, angle, changes, most)
    if several is not None and several[0] < SEVERAL * left:
        best, left = several, several[0]
    rows, part = _two_kinds(problem, x)
    # what changed at a row is named by itself where that is enough
    kinds = part < limit and left > (MOVED if np.ptp(rows) == len(rows) - 1 else part / MOVED)
    if best is not None and not kinds:
        yield from first(two_positions(problem, x, min(limit, MOVED * left)), _said_of_addition(best))
    else:
        said = [_said_of_kinds(problem, rows, part)] if kinds else ()
        rounding = roundings(problem, rms(problem.errors(x)), (1 - MOVED) ** -0.5)
        noise = _uneven_noise(problem, x) if acceptable == 1 else ()  # else errors are too large for noise
        backlash = two_positions(problem, x, min(limit, part / MOVED) if kinds else limit)
        states = () if problem.touches else two_states(problem, x)
        yield from first(backlash, states, said, rounding, noise, scattered_rows(problem, x))


def _said_of_addition(best: tuple[float, Addition, Array] | None) -> Iterator[str]:
    """Say what an addition means and which part of the residuals it leaves, unless it is no mistake."""
    if best is not None and best[1].said is not None:
        what, remedy = best[1].said(best[2])
        yield f"{what} (the residual RMS falls to {100 * best[0]:.0f} %): {remedy}."


def wrong_gear_ratio(problem: CalibrationProblem, x: Array, most: float) -> Iterator[str]:
    """Report a gear ratio or coupling, too large for a linearization, that reduces the squares at x (n,) to a part.

    The fit is repeated with it: with a ratio 3 % off, a joint is 50 mrad off at its ends.
    """
    model = problem.linearize(x)
    best = _explained(model, x, problem.equations.angle, _gears(problem, model))
    if best is None or (joint_map := best[1].joint_map) is None:
        return

    def changed(factor: float) -> CalibrationProblem:
        return replace(problem, robots=replace(problem.robot, joint_map=joint_map(np.array([factor]))))

    def error(factor: float) -> float:
        other = changed(factor)
        return rms(other.errors(ridge_deviations(other)))

    ends = np.sort(best[2] * [0.8, 1.2])
    found = scipy.optimize.minimize_scalar(error, bounds=ends, method="bounded", options={"xatol": 1e-3 * ends.std()})
    left = found.fun / max(rms(problem.errors(x)), TINY)
    turned = np.abs(changed(found.x).joint_values - problem.joint_values).max()
    if left**2 <= most and turned > BEYOND_SLOPES:
        yield from _said_of_addition((left, best[1], np.array([found.x])))


def _moves(problem: CalibrationProblem, x: Array, along_joints: bool) -> Iterator[Addition]:
    """Yield a base, fixture, reflector, joint zero or payload that changed, where something places the robot.

    With ``along_joints`` joint zeros also change at a value of the joint: gears have slight steps.
    """
    p, blocks = problem.parameters, problem.data.blocks
    placed = {"base": ([f"base_{c}" for c in FRAME], "did the instrument or the robot's base move")}
    for block in blocks:
        names = [of_fixture(name, block.fixture) for name in block.measurement.parameters]
        if names:
            what = names[0].split("_")[0]
            placed[what] = ([*placed.get(what, [()])[0], *names], "did it, or the robot's base, move")
    apart = any(map(of_session, p.free.names))
    if not apart and not set(p.free.names) & {name for names, _ in placed.values() for name in names}:
        return
    markers = dict.fromkeys(marker for block in blocks for marker in block.markers)
    parts = dict(placed)
    parts["reflector"] = ([tool_prefix(m) + c for m in markers for c in FRAME], "was the reflector exchanged")
    every = np.array(p.names)
    bends, eccentric = np.char.startswith(every, "compliance"), np.char.startswith(every, "ecc_")
    parts["payload"] = (every[bends].tolist(), "did the load at the flange change")
    based = apart & np.isin(every, placed["base"][0])  # a base may move within a session, too
    whole, there = _with_others(problem, x, bends | eccentric | based)  # a payload shows in them, identified or not
    A = whole.linearize(there).A
    shares = _shares(problem)
    free, named = whole.parameters.free, problem.data.sessions
    base = np.flatnonzero(np.isin(free.names, SHIFTED))
    if len(base) and 1 < len(named) <= len(problem.data) / FEWEST and not apart:
        apart = A[:, base, None] * (problem.data.session[problem.owners, None] == np.array(named[1:]))[:, None]
        between = f"the base differs from session to session ({listed(named)})"
        remedy = 'did it move between them? Add `session_*` to `identify`, or model = "auto"'
        yield Addition(apart.reshape(len(A), -1), lambda c: (between, remedy))
    for what, (changed, cause) in parts.items():
        yield from _changes(whole, there, A, changed, what, cause, shares)
    for i, name in enumerate(problem.robot.zeros):
        cause = "did the joint slip or fall back under its load, or was it remastered"
        by = shares | (_shares(problem, i) if along_joints else {})
        zero = f"zero of joint {numbered(i, problem.robot.joint_names)}"
        yield from _changes(whole, there, A, [name], zero, cause, by)
    model = replace(problem.robot, joint_map=np.eye(len(problem.robot.mdh)), limits=np.empty((0, 0)))
    flange = forward_kinematics(model, problem.joint_values)
    down = {
        "with the direction of gravity at the flange": problem.robot.gravity.direction @ flange[problem.owners, :3, :3]
    }
    cause = "is it loose in its nest, or its holder compliant"
    yield from _changes(whole, there, A, [tool_prefix(m) + c for m in markers for c in "xyz"], "reflector", cause, down)
    yield from _tilts(whole, A, flange[:, :3, 3])
    yield from _rails(whole, A)
    for family in (bends, eccentric, bends | eccentric):  # either alone explains more with fewer columns
        lacking = np.isin(free.names, every[family & ~p.identified])
        if lacking.any():
            yield Addition(A[:, lacking], None)
    nominal = whole.parameters.nominal[whole.parameters.identified]
    of_arm = (np.array(free.dimensions) == "length") & ~free.of_frames
    elapsed = problem.owners / max(len(problem.data) - 1, 1)
    grown = A @ np.where(of_arm, nominal / free.scale, 0.0) * elapsed
    warm = "did it warm up? Measure it warm, or in random order, or state temperature_C of every row (expansion)"
    what = "the arm grows from row to row, by {} from the first to the last"
    yield Addition(grown[:, None], lambda c: (what.format(f"{100 * c[0]:.2g} %"), warm))
    q = problem.joint_values[:, np.ptp(problem.joint_values, axis=0) > 0]
    if len(q) < 2 * FEWEST or not len(base):
        return
    steps = np.diff(q, axis=0).var(axis=0) / (2 * q.var(axis=0))  # of every joint; one in rows of random order
    if steps.min(initial=1.0) > JUMPING:  # else model errors follow the rows as well
        courses = np.cos(np.pi * np.outer(elapsed, range(1, COURSES + 1)))
        slow = "the instrument or the base drifted slowly, though the joint values are in no order"
        still = "temperature? Measure reference points between the rows, or all in a shorter time"
        yield Addition((A[:, base, None] * courses[:, None]).reshape(len(A), -1), lambda c: (slow, still))


def _tilts(problem: CalibrationProblem, A: Array, flange: Array) -> Iterator[Addition]:
    """Yield that the base tilts by the side of the flange (N, 3), by its weight, or by the first harmonic of joint 1.

    It tilts about two axes; a rotation about the first joint's axis is the effect of an eccentric gear.
    """
    p, robot = problem.parameters, problem.robot
    turns = [p.free.names.index(name) for name in ("base_rx", "base_ry", "base_rz") if name in p.free.names]
    if len(turns) < 3 or robot.joint_types[0] != "revolute":
        return
    base = numeric_frame(p.nominal[[p.names.index(f"base_{c}") for c in FRAME]])[:3, :3]
    across = numeric_frame([0, 0, 0, robot.mdh[0, 0], 0, 0])[:3, :2]
    tilts = A[:, turns] / p.free.scale[turns] @ base @ across
    reach, q1 = flange @ across, problem.joint_values[:, 0]
    side = reach / np.maximum(np.linalg.norm(reach, axis=1, keepdims=True), TINY)
    what = "the base tilts with the direction of the arm"
    remedy = "are its bolts tight, its foot and the bearing of joint 1 stiff? Fix it, and measure again"
    for share in (side, reach, np.column_stack([np.cos(q1), np.sin(q1)])):
        columns = tilts[:, :, None] * share[problem.owners, None]
        yield Addition(columns.reshape(len(A), -1), lambda c: (what, remedy))


def _rails(problem: CalibrationProblem, A: Array) -> Iterator[Addition]:
    """Yield that a linear axis in front of all that turn is not straight: it moves sideways by a polynomial."""
    p, robot = problem.parameters, problem.robot
    origin = [p.free.names.index(name) for name in ("base_x", "base_y", "base_z") if name in p.free.names]
    if len(origin) < 3:
        return
    turn = numeric_frame(p.nominal[[p.names.index(f"base_{c}") for c in FRAME]])[:3, :3]
    for i in range(next((k for k, kind in enumerate(robot.joint_types) if kind == "revolute"), 0)):
        turn = turn @ numeric_link(*robot.mdh[i])[:3, :3]
        q = problem.joint_values[:, i]
        if len(np.unique(q)) < FEWEST:
            continue
        place = 2 * (q - q.min()) / np.ptp(q) - 1
        course = np.polynomial.legendre.legvander(place, BENDS)[problem.owners, 2:]  # straight lines are in the robot
        sideways = A[:, origin] / p.free.scale[origin] @ turn[:, :2]

        def said(c: Array, of: str = numbered(i, robot.joint_names), course: Array = course) -> tuple[str, str]:
            far = three_digits(1e3 * float(np.linalg.norm(np.ptp(course @ c.reshape(2, -1).T, axis=0))))
            what = f"the axis of joint {of} is not straight, by {far} mm sideways along its measured range"
            return what, "align its rail, or calibrate in the part of it that is used"

        yield Addition((sideways[:, :, None] * course[:, None]).reshape(len(A), -1), said)


def _with_others(problem: CalibrationProblem, x: Array, others: np.ndarray) -> tuple[CalibrationProblem, Array]:
    """Return a problem that identifies other parameters too, and deviations x (n,) with zeros for these."""
    p = problem.parameters
    whole = problem.identifying(p.identified | others)
    there = np.zeros(len(whole.parameters.free))
    there[p.identified[whole.parameters.identified]] = x
    return whole, there


def _changes(
    problem: CalibrationProblem, x: Array, A: Array, names: Collection[str], what: str, cause: str, by: Shares
) -> Iterator[Addition]:
    """Yield that parameters changed in proportion to shares (m,) or (m, s), of three equations a parameter."""
    free = problem.parameters.free
    some = np.flatnonzero(np.isin(free.names, list(names)))
    if not len(some):
        return
    equations = problem.equations

    def say(when: str, share: Array, coefficients: Array) -> tuple[str, str]:
        rows = equations.length & share.any(axis=1)
        slopes = problem.contrasts(problem.jacobian(x))[np.ix_(rows, some)] * free.scale[some]
        by_share = slopes @ coefficients.reshape(len(some), -1)
        change = np.sum(by_share * share[rows], axis=1)
        far = 1e3 * float(np.sqrt(change @ change / max(len(np.unique(equations.row[rows])), 1)))
        moved = f"the points are {three_digits(far)} mm off the fit to the others"
        if not rows.any():  # nothing but angles was measured
            moved = "the measurements contradict the others"
        remedy = "Calibrate the two parts separately" + ", or name them in a column `session`" * (what == "base")
        if share.shape[1] > 1:  # motions of all points alike would be in the figure
            moved, remedy = "the points move to and fro", "Fix it, and measure again"
        warm = "did it warm up, or " * (when == STEADILY)
        return f"{when} {moved}, consistent with a changed {what}", f"{warm}{cause}? {remedy}"

    for when, part in by.items():
        share = part.reshape(len(A), -1)
        if np.count_nonzero(share.any(axis=1)) >= 3 * len(some):
            columns = A[:, some, None] * share[:, None]
            yield Addition(columns.reshape(len(A), -1), partial(say, when, share))


def _shares(problem: CalibrationProblem, joint: int | None = None) -> Shares:
    """Return what part equations (m,) have in a change, and when: from a row on, between two rows or steadily.

    Values of a ``joint`` may replace the order of rows: from one on only, as gear ripple is a change between two.
    """
    data, owners = problem.data, problem.owners
    at, places = np.arange(len(data)), [f"row {label}" for label in data.label]
    shares = {STEADILY: owners / max(len(data) - 1, 1)}
    if joint is not None:
        unit, si = display("angle" if problem.robot.joint_types[joint] == "revolute" else "length")
        side = signs(problem.robot.joint_map)[joint]
        values, at = np.unique(side * problem.joint_values[:, joint], return_inverse=True)
        shares, places = {}, [f"q{joint + 1} = {value / si:.4g} {unit}" for value in values]
    if len(places) < 2 * FEWEST:
        return {}
    ends = len(places)
    spans = [(k, ends) for k in _places(ends, PLACES if joint is None else PRECISE)]
    if joint is None:
        spans += combinations(_places(ends, SPANS), 2)
    for start, end in spans:
        inside = (at >= start) & (at < end)
        # rows of one configuration share what the model lacks of the arm, and are one piece of evidence
        if min(len(np.unique(data.configuration[part])) for part in (inside, ~inside)) >= FEWEST:
            until = "on" if end == ends else f"to {places[end - 1]}"
            shares[f"from {places[start]} {until}"] = inside[owners].astype(float)
    return shares


def _places(count: int, most: int = PLACES) -> list[int]:
    """Return before which rows a table may be parted."""
    return np.unique(np.linspace(FEWEST, count - FEWEST, most).round().astype(int)).tolist()


def _two_kinds(problem: CalibrationProblem, x: Array) -> tuple[np.ndarray, float]:
    """Return the rows (K,) that have other parameters than the rest, none if too few, and which part that leaves.

    Two linear fits with the prior and the rows of each are found in turn, from random halves. Each kind of rows has
    its own parameters, and each row a degree of freedom for its choice.
    """
    model = problem.with_repeatability(None).linearize(x)
    A, b, owners, N = model.A, model.b, problem.owners, len(problem.data)
    rank = _freedom(model)
    spare = len(b) - 2 * rank - N
    if spare < rank:
        return np.zeros(0, dtype=int), np.inf

    def errors(of: np.ndarray) -> Array:
        z = np.linalg.solve(A[of].T @ A[of] + np.eye(A.shape[1]), A[of].T @ b[of])
        return np.bincount(owners, (b - A @ z) ** 2, N).astype(float)

    rng = np.random.default_rng(0)
    best, second = np.inf, np.zeros(N, dtype=bool)
    for _ in range(STARTS):
        now = rng.random(N) < 0.5
        for _ in range(MOST_ROUNDS):
            both = np.array([errors(~now[owners]), errors(now[owners])])
            left = float(both.min(axis=0).sum())
            if left < best:
                best, second = left, both[1] < both[0]
            before, now = now, both[1] < both[0]
            if (now == before).all():
                break
    kept = np.ones(N, dtype=bool)  # a few gross errors are outliers, and no kind of rows
    for _ in range(OUTLYING_ROUNDS):
        one = errors(kept[owners])
        kept = one <= np.sort(one)[N - N // OUTLYING - 1]
    left = float(np.sqrt(best / spare / (errors(kept[owners])[kept].sum() / (kept[owners].sum() - rank))))
    rows = np.flatnonzero(second == (second.sum() <= N / 2))
    return rows, left if len(rows) >= FEWEST else np.inf


def another_robot(problem: CalibrationProblem, identified: Robot) -> Iterator[str]:
    """Report rows that fit a robot of this type, but not the identified robot, whatever its base and reflector."""
    points = points_of(replace(problem, robots=identified))
    if points is None or points.by_camera or len(points.row) < FEWEST:
        return
    x, free = ridge_deviations(problem), problem.parameters.free
    model, z = problem.with_repeatability(None).linearize(x), x / free.scale
    spare = len(model.b) - _freedom(model)
    placed, own = rms(fit_points(points).error), rms(problem.errors(x))
    fits = spare > FEWEST and np.linalg.norm(model.b - model.A @ z) < NOTICED * np.sqrt(spare)
    if fits and rms(z[~free.of_frames]) < NOISY and placed > NOISY * own:
        yield (
            f"{named_rows(problem.data, points.row, 'fits', 'fit')} the nominal robot with deviations of their own "
            f"({three_digits(1e3 * own)} mm RMS), but not the robot of the others, whatever the base and reflector "
            f"({three_digits(1e3 * placed)} mm): were they measured at another robot of this type, or did several "
            "joints change? Calibrate the two groups separately, or leave one out ([exclude])."
        )


def _uneven_noise(problem: CalibrationProblem, x: Array) -> Iterator[str]:
    """Report a column of measured values whose residuals at x (n,) are far larger than those of the others.

    Standard deviations s of all columns, over the stated noise, are estimated alternately with the fit with weights 1 /
    s^2, since otherwise the noise of one is in the residuals of all: s^2 = sum r^2 / sum (1 - h), residuals r,
    leverages h.
    """
    model = problem.linearize(x)
    columns = {tuple(block.measurement.components) for block in problem.data.blocks}
    which = problem.equations.component
    if len(columns) > 1 or not which.any() or problem.touches:  # touches have no columns
        return
    size = freedom = np.ones(which.max() + 1)
    for _ in range(MOST_ROUNDS):
        A, b = model.A / size[which][:, None], model.b / size[which]
        own = np.linalg.qr(np.vstack([A, np.eye(A.shape[1])]))[0][: len(b)]
        freedom = np.maximum(np.bincount(which, 1 - np.sum(own**2, axis=1)), 1.0)
        size = np.maximum(size * np.sqrt(np.bincount(which, (b - own @ (own.T @ b)) ** 2) / freedom), EXACT)
    *_, second, worst = np.argsort(size)
    times = float(size[worst] / size[second])
    if times > NOISY and freedom.min() > 1 and len(size) * fdtrc(freedom[worst], freedom[second], times**2) < RARE:
        name = columns.pop()[worst]
        yield (
            f"residuals of column {name} are {three_digits(times)} times those of the other columns, with the same "
            f"stated noise: check what measured it, or state its noise (column sigma_{name}_mm, ...)."
        )


def scattered_rows(problem: CalibrationProblem, x: Array) -> Iterator[str]:
    """Report rows that scatter far more than the others, if these agree with the stated noise.

    Two normal distributions, one of them the stated noise, must be far more likely than one of any width, with or
    without heavy tails: in any sample the rows with the largest errors scatter more. The parameters' fit to these rows
    is integrated out (Laplace).
    """
    (A, b, owners), N = _row_by_row(problem, x), len(problem.data)
    if N < 2 * OUTLYING:  # few rows hardly show their noise
        return
    count = np.bincount(owners, minlength=N).astype(float)

    def fitted(spread: Callable[[Array], tuple[Array, Array]], w: Array) -> tuple[float, Array, Array]:
        """Return the log marginal likelihood of all rows, their weights (N,) and squares (N,)."""
        likelihood, squares = -np.inf, w
        for _ in range(2 * MOST_ROUNDS):
            H = (A.T * w[owners]) @ A + np.eye(A.shape[1])
            z = np.linalg.solve(H, A.T @ (w[owners] * b))
            squares = np.bincount(owners, (b - A @ z) ** 2, N).astype(float)
            w, each = spread(squares)
            likelihood = float(each.sum() - z @ z / 2 - np.linalg.slogdet(H)[1] / 2)
        return likelihood, w, squares

    def student(freedom: float, squares: Array) -> tuple[Array, Array]:
        size, w = float(squares.sum() / count.sum()), count
        for _ in range(MOST_ROUNDS):
            size = max(size, 1.0)
            w = (freedom + count) / (freedom + squares / size)
            size = float(w @ squares / count.sum())
        each = gammaln((freedom + count) / 2) - gammaln(freedom / 2) - count / 2 * np.log(freedom / 2 * size)
        return w / size, each - (freedom + count) / 2 * np.log1p(squares / size / freedom)

    def two(squares: Array) -> tuple[Array, Array]:
        far, size, each = (squares > NOISY**2 * count).astype(float), 1.0, squares
        for _ in range(MOST_ROUNDS):
            size = max(float(far @ squares) / max(float(far @ count), TINY), SCATTERED**2)
            part = np.clip(far.mean(), 1 / (2 * N), 1 - 1 / (2 * N))
            wide = np.log(part) - squares / size / 2 - count / 2 * np.log(size)
            each = np.logaddexp(np.log1p(-part) - squares / 2, wide)
            far = np.exp(wide - each)
        return 1 - far + far / size, each

    normal, w, _ = fitted(partial(student, NORMAL), np.ones(N))
    heavy, w, _ = fitted(partial(student, HEAVY), w)
    likelihood, w, squares = fitted(two, w)
    far = (w < 0.5) & (count > 0)
    # hardly more equations than parameters agree with any noise
    if count[~far].sum() < SHOWING * A.shape[1] or likelihood - max(normal, heavy) < LIKELIER or far.sum() < FEW:
        return
    times = float(np.sqrt(squares[far].sum() / count[far].sum()))
    rows = joined([problem.data.label[i] for i in np.flatnonzero(far)])  # all, as they are to be left out
    yield (
        f"residuals of rows {rows} are {three_digits(times)} times those of the others, which agree with the "
        "stated noise: was the reflector loose in its nest, or the arm not at rest? Measure them again, or leave "
        "them out ([exclude])."
    )


def _row_by_row(problem: CalibrationProblem, x: Array) -> tuple[Array, Array, np.ndarray]:
    """Return whitened equations A z ~ b, (m, n + c) and (m,), each of one row, and these rows (m,).

    For touches, c positions of touched points and planes, nearly free, are parameters, too.
    """
    touches = problem.touches
    if touches is None:
        model = problem.linearize(x)
        return model.A, model.b, problem.owners
    equations = Equations.of(problem.data)
    residual, jacobian = problem.slopes(x)
    own, places = [], []
    for thing, index in zip(touches.where, touches.rows, strict=True):
        own.append(index[:, : len(thing.shown)].ravel())
        places.append(FREE * np.kron(thing.places, np.eye(len(thing.shown))))
    some = np.concatenate(own)
    sigma = np.sqrt(equations.covariance[some, equations.component[some]])
    A = np.hstack([jacobian[some] * problem.parameters.free.scale, scipy.linalg.block_diag(*places)])
    return A / sigma[:, None], (residual + jacobian @ x)[some] / sigma, equations.row[some]


def _said_of_kinds(problem: CalibrationProblem, rows: np.ndarray, left: float) -> str:
    """Return the sentence on rows of two kinds."""
    named, label = named_rows(problem.data, rows, "fits", "fit", len(rows)), problem.data.label
    if np.ptp(rows) == len(rows) - 1:
        named = f"rows {label[rows[0]]} to {label[rows[-1]]} fit"
    return (
        f"{named} other parameters than the rest (with two calibrations the residual RMS falls to {100 * left:.0f} %): "
        "are they of another arm, tool or load, or were their joint values computed for another configuration of wrist "
        "or elbow? Calibrate the two groups separately, or leave one out ([exclude])."
    )


def two_positions(problem: CalibrationProblem, x: Array, most: float) -> Iterator[str]:
    """Report one or two joints that explain residuals at x (n,) if each is at either of two positions in every row.

    They leave less than a part ``most`` of the residuals, two joints at most half of what one does, with parameters
    fitted and their prior. Random errors leave 60 %, since signs are fitted but not magnitudes, and much less with
    fewer than three equations per parameter.
    """
    model, free = problem.with_repeatability(None).linearize(x), problem.parameters.free
    if len(model.b) < 3 * len(x):
        return
    r, without = model.b - model.A @ (x / free.scale), _without_parameters(model)
    joints = [(i, free.names.index(name)) for i, name in enumerate(problem.robot.zeros, 1) if name in free.names]
    joints = [(i, k) for i, k in joints if model.A[:, k].any()]
    best, alone, said = most, np.inf, ""
    for some in [*combinations(joints, 1), *combinations(joints, 2)]:
        numbers = [k for _, k in some]
        left, step, side = _either_side(r, without, problem.owners, [model.A[:, [k]] for k in numbers])
        if len(some) == 1:
            alone = min(alone, left)
        apart = 2e3 * np.abs(step) * free.scale[numbers]
        slipped = np.count_nonzero(np.diff(side, axis=0)) <= len(some)  # each joint once
        limit = best if len(some) == 1 else min(best, MOVED * alone)
        if left < limit and apart.min() >= 1e3 * LOOSE and not slipped:
            best = left
            units = ["mrad" if free.dimensions[k] == "angle" else "mm" for k in numbers]
            names = [numbered(i - 1, problem.robot.joint_names) for i, _ in some]
            steps = [f"joint {names[k]} by {apart[k]:.2g} {unit}" for k, unit in enumerate(units)]
            said = f"backlash, {joined(steps)}"
    if said:
        yield (
            f"{said}: with one of two positions in every row the residual RMS falls to {100 * best:.0f} %. "
            "Approach all configurations from one side, or state the directions of approach (columns approach1, ...)."
        )


def two_states(problem: CalibrationProblem, x: Array, most: float = LOADS) -> Iterator[str]:
    """Report rows whose residuals at x (n,) one of two loads, bases or reflectors explains, to the noise.

    They leave less than a part ``most`` of them.
    """
    model, p = problem.with_repeatability(None).linearize(x), problem.parameters
    whole, there = _with_others(problem, x, np.char.startswith(np.array(p.names), "compliance"))
    A = whole.with_repeatability(None).linearize(there).A
    if len(model.b) < 3 * len(x):
        return
    separately = "or calibrate the two groups separately"
    stated = f"State payload_kg of every row and add `compliance?` to `identify`, {separately}"
    states = {
        "load at the flange": ("compliance", f"was a tool or a workpiece attached? {stated}"),
        "base": (
            "base_",
            f"does the robot or the instrument tip, or stand loose? Fix it and measure again, {separately}",
        ),
        "reflector": ("tool_", f"is it loose, or are there two? Name them in a column `marker`, {separately}"),
    }
    r, without = model.b - model.A @ (x / p.free.scale), _without_parameters(model)
    best, said = most, ""
    for what, (prefix, cause) in states.items():
        columns = A[:, np.char.startswith(whole.parameters.free.names, prefix)]
        columns = columns[:, columns.any(axis=0)]
        if not columns.size:
            continue
        left, _, side = _either_side(r, without, problem.owners, [columns])
        rows = np.flatnonzero(side[:, 0] == (1 if side.sum() <= 0 else -1))
        if left < best and left * rms(r) < NOTICED and len(rows) >= FEWEST:
            best, fit = left, named_rows(problem.data, rows, "fits", "fit", len(rows))
            said = (
                f"{fit} another {what} (with one of two in every row the residual RMS falls to "
                f"{100 * left:.0f} %): {cause}."
            )
    if said:
        yield said


def _either_side(
    r: Array, without: Callable[[Array], Array], rows: np.ndarray, groups: Sequence[Array]
) -> tuple[float, Array, np.ndarray]:
    """Return what part of residuals r (m,) groups of columns (m, k) leave that count +1 or -1 in every row.

    Beside it their coefficients, and the sides (N, groups). They start with what changes residuals most.
    """
    steps: Any = []
    for G in groups:
        moments = np.column_stack([np.bincount(rows, column * r) for column in G.T])
        size = G.T @ G
        c = scipy.linalg.eigh(moments.T @ moments, size + SINGULAR * np.trace(size) * np.eye(len(size)))[1][:, -1]
        steps.append(c * np.linalg.norm(r) / max(np.linalg.norm(G @ c), TINY))
    sides = np.array(list(product((-1.0, 1.0), repeat=len(groups))))
    target, columns = r, np.hstack(groups)
    chosen, rest = sides[:1], without(r[:, None])[:, 0]
    for _ in range(MOST_ROUNDS):
        moved = np.column_stack([G @ step for G, step in zip(groups, steps, strict=True)])
        errors = [np.bincount(rows, (target - moved @ side) ** 2) for side in sides]
        before, chosen = columns, sides[np.argmin(errors, axis=0)]
        columns = np.hstack([G * chosen[rows, [i]][:, None] for i, G in enumerate(groups)])
        if np.array_equal(columns, before):
            break
        step = np.linalg.lstsq(without(columns), rest, rcond=None)[0]
        target = without((r - columns @ step)[:, None])[: len(r), 0] + columns @ step
        steps = np.split(step, np.cumsum([G.shape[1] for G in groups])[:-1])
    found = np.concatenate(steps, dtype=float)
    return float(np.linalg.norm(target - columns @ found) / max(np.linalg.norm(r), TINY)), found, chosen


def _gears(problem: CalibrationProblem, model: LinearModel) -> Iterator[Addition]:
    """Yield every gear ratio and coupling, and a lag of all joints."""
    robot, free = problem.robot, problem.parameters.free
    slopes = model.A / free.scale
    q = problem.joint_values
    of_zero = {i: slopes[:, free.names.index(name)] for i, name in enumerate(robot.zeros) if name in free.names}

    def joint_map(i: int, j: int, coefficients: Array) -> Array:
        to_model = robot.joint_map.copy()
        to_model[i] += coefficients[0] * robot.joint_map[j]
        return to_model

    def gear(i: int, j: int, coefficients: Array) -> tuple[str, str]:
        factor = coefficients[0]
        one, other = (numbered(k, robot.joint_names) for k in (i, j))
        moves, transmission = GEARS[robot.joint_types[i]]
        much = f"{three_digits(100 * abs(factor))} % {'more' if factor > 0 else 'less'}"
        what = f"joint {one} {moves} {much} than its encoder reads ({transmission})"
        if i != j:
            sign = signs(robot.joint_map)
            part = sign[i] * factor * sign[j]
            mixed = robot.joint_types[i] != robot.joint_types[j]
            units = " in m and rad" * mixed
            what = f"joint {one} is coupled to joint {other} (q{i + 1} {part:+.4f} q{j + 1}{units})"
            if abs(part) < COUPLED and not mixed:
                return what, "no gear has so small a ratio: check bearings, hoses and mounting of both joints"
        return what, coupling(joint_map(i, j, coefficients))

    for i, j in product(of_zero, range(q.shape[1])):
        if q[:, j].any():
            column = of_zero[i] * q[problem.owners, j]
            yield Addition(column[:, None], partial(gear, i, j), joint_map=partial(joint_map, i, j))
    if len(of_zero) == len(robot.mdh):
        way = np.diff(q, axis=0, prepend=q[:1])[problem.owners]
        lag = np.sum([zero * way[:, i] for i, zero in of_zero.items()], axis=0)
        yield _lag(lag, "joint values", "read both when the arm stands still")


def _lag(column: Array, what: str, remedy: str) -> Addition:
    """Return that values are those of a part of the way from the row before, by the equations (m,) of the whole way."""

    def said(c: Array) -> tuple[str, str]:
        return f"{what} {'lag behind' if c[0] > 0 else 'run ahead'} by {100 * abs(c[0]):.2g} % of each move", remedy

    return Addition(column[:, None], said)


def _scales(problem: CalibrationProblem, x: Array, model: LinearModel) -> Iterator[Addition]:
    """Yield the scale and the offset of lengths, and of positions the scales and skews of their axes."""
    free = problem.parameters.free
    base = [free.names.index(f"base_{c}") for c in "xyz" if f"base_{c}" in free.names]
    y, way = np.zeros((2, len(problem.data), 3))
    lengths = np.zeros((len(problem.data), 2))
    for block in problem.data.blocks:
        if block.measurement.name in ("position", "pose") and len(base) == 3:
            y[block.row] = block.y[:, :3]
            way[block.row] = np.diff(y[block.row], axis=0, prepend=y[block.row][:1])
        elif block.measurement.name in ("cable", "distance"):
            lengths[block.row] = np.column_stack([block.y, np.ones(len(block.y))])
    along = lengths[problem.owners]
    if lengths.any():  # in units of the equations
        slopes = problem.contrasts(problem.jacobian(x)) * free.scale
        unit = np.linalg.norm(model.A, axis=1) / np.linalg.norm(slopes, axis=1)
        along *= unit[:, None]
    y = y[problem.owners]
    of_axis = model.A[:, base] / free.scale[base]
    if y.any():
        radial = y / np.maximum(np.linalg.norm(y, axis=1, keepdims=True), 1e-9)
        along += np.column_stack([np.sum(of_axis * y, axis=1), np.sum(of_axis * radial, axis=1)])

    def too(what: str, size: float, unit: str) -> str:
        return f"{what} {three_digits(abs(size))} {unit} too {'long' if size > 0 else 'short'}"

    def scaled(column: Array, what: str, remedy: str, of: str = "") -> Addition:
        # a scale that shrinks positions to half and less fits values that have nothing to do with the robot
        said = f"{what} {{:+.2g}} % {of}".format if of else partial(too, what, unit="%")
        return Addition(column[:, None], lambda c: (said(100 * c[0]), remedy), most=0.5)

    def longer(share: Array | float, when: str, remedy: str) -> Addition:
        said = partial(too, f"{when}measured distances are", unit="mm")
        return Addition((along[:, 1] * share)[:, None], lambda c: (said(1e3 * c[0]), remedy))

    yield scaled(along[:, 0], "measured lengths are", "check the scale of the instrument")
    yield longer(1.0, "", "check the instrument's zero and the reflector's radius")
    for when, share in _shares(problem).items():
        yield longer(share, f"{when} ", "check the reflector and its radius in these rows")
    if y.any():
        of_way = -np.sum(of_axis * way[problem.owners], axis=1)
        yield _lag(of_way, "measured positions", "turn off the instrument's filter, or wait until it has settled")
        # of an instrument at the origin: index of the vertical circle, eccentricity of both
        flat = np.linalg.norm(y[:, :2], axis=1, keepdims=True)
        radius = np.maximum(np.linalg.norm(y, axis=1, keepdims=True), 1e-9)
        turn = np.column_stack([-y[:, 1], y[:, 0], np.zeros(len(y))])
        rise = np.column_stack([-y[:, :2] * y[:, [2]] / np.maximum(flat, 1e-9), flat])
        sines = np.hstack([y[:, :2] / np.maximum(flat, 1e-9), flat / radius, y[:, [2]] / radius])
        parts = [rise, *(sines[:, [k]] * (turn if k < 2 else rise) for k in range(4))]
        circles = np.column_stack([np.sum(of_axis * each, axis=1) for each in parts])
        said = "angles of the instrument at the origin are wrong by up to {} mrad (index and eccentricity of circles)"
        of_circles = "measure in both faces, and have it checked"
        yield Addition(circles, lambda c: (said.format(three_digits(1e3 * np.abs(c).max())), of_circles))
        middle = y - np.mean(y, axis=0)
        cubic = np.sum(of_axis * middle * np.sum(middle**2, axis=1, keepdims=True), axis=1)
        lens = "calibrate the instrument's lens or refraction, or measure nearer to its axis"
        distorted = "measured positions are distorted with the cube of their distance from the mean"
        yield Addition(cubic[:, None], lambda c: (distorted, lens))
    for i, j in combinations_with_replacement(range(3 * bool(y.any())), 2):
        what = (f"column {'xyz'[i]} is", "check its scale")
        if i != j:
            axes = "check whether the instrument's axes are square"
            what = (f"column {'xyz'[i]} contains", axes, f"of column {'xyz'[j]}")
        yield scaled(of_axis[:, i] * y[:, j], *what)
