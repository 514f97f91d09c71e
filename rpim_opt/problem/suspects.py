"""Rows that cannot be right: no value, exchanged, copied, rounded, or measured after the instrument moved."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.special import fdtrc

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import listed, three_digits
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.misfit import Placed, Points, lever_arms, misfit, placed, points_of
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.kinematics import FRAME, forward_kinematics
from rpim_opt.robot.mdh import Robot

FAR = 5.0
"""A row is in question from so many medians of the errors on."""
FITS = 0.2
"""What a row is mistaken for leaves less than this part of its error."""
ALIKE = (0.4, 2.5)
"""Rounding explains errors that are between these multiples of what it makes."""
MOVED = 0.5
"""An instrument has moved if that leaves less than this part of the sum of squares."""
FAR_MOVED = 0.005
"""Points that fit better than this part of their extent show an instrument's motion in the residuals alone."""
RARE = 1e-6
FEWEST = 6
MOST_PLACES = 40
MOST_EQUATIONS = 3000


def rows_without_values(problem: CalibrationProblem) -> Iterator[str]:
    """Say which rows have zero or the same number for every measured coordinate: what an instrument writes for none.

    >>> from dataclasses import replace
    >>> import rpim_opt as ro
    >>> from rpim_opt.problem.suspects import rows_without_values
    >>> problem = ro.load("position").problem
    >>> block = problem.data.blocks[0]
    >>> y = block.y.copy()
    >>> y[3] = 0.0
    >>> wrong = problem.on(replace(problem.data, blocks=(replace(block, y=y),)))
    >>> print(*rows_without_values(wrong))
    row c3 has 0 for every measured coordinate: no measurement? Leave out what is none ([exclude]).
    """
    data = problem.data
    for block in data.blocks:
        if len(block.measurement.columns) < 3:
            continue
        y = block.y[:, :3]
        same = (y == y[:, :1]).all(axis=1)
        for value in np.unique(y[same, 0]):
            labels = [data.label[i] for i in block.row[same & (y[:, 0] == value)]]
            what = f"{_rows(labels, 'has', 'have')} {value:g} for every measured coordinate"
            yield f"{what}: no measurement? Leave out what is none ([exclude])."


def _rows(labels: list[str], of_one: str, of_several: str) -> str:
    """Name rows before their verb."""
    if len(labels) == 1:
        return f"row {labels[0]} {of_one}"
    return f"rows {listed(labels)} {of_several}"


def shared_rows(data: Dataset, validation: Dataset | None) -> Iterator[str]:
    """Say which rows of the validation set are copies of identification rows."""
    if validation is None:
        return
    own: dict[bytes, str] = {}
    for block in data.blocks:
        for i, row in enumerate(block.row):
            own.setdefault(block.q[i].tobytes() + block.y[i].tobytes(), data.label[row])
    copies = []
    for block in validation.blocks:
        for i, row in enumerate(block.row):
            key = block.q[i].tobytes() + block.y[i].tobytes()
            if key in own and block.measurement.columns:
                copies.append(_alias(validation.label[row], own[key]))
    if copies:
        yield (
            f"{len(copies)} of {len(validation)} rows of the validation set are identification rows as well: "
            f"{listed(copies)}. Its error says less than it seems: draw them apart (rpim-opt new --hold-out)."
        )


def _alias(label: str, other: str) -> str:
    if label == other:
        return label
    return f"{label} ({other})"


def exchanged_rows(problem: CalibrationProblem) -> Iterator[str]:
    """Say which rows fit the joint values, or the reflector, of another row."""
    points = points_of(problem)
    if points is None:
        return
    found = placed(problem.robot, points)
    label = [problem.data.label[i] for i in points.row]
    far = np.flatnonzero(found.error > FAR * np.median(found.error))
    pairs = _pairs(points, found, far)
    if pairs:
        named = listed([f"{label[i]} and {label[j]}" for i, j in pairs])
        yield f"the measured values of rows {named} fit each other's joint values: exchange them."
    markers = _other_markers(problem.robot, points, found, far)
    if markers:
        yield (
            f"{_rows([label[i] for i in markers], 'fits', 'fit')} another reflector than the stated one "
            "(column marker): reflectors swapped?"
        )


def _pairs(points: Points, found: Placed, far: np.ndarray) -> list[tuple[int, int]]:
    pairs = []
    for a, i in enumerate(far):
        for j in far[a + 1 :]:
            if points.marker[i] != points.marker[j]:
                continue
            crossed = np.linalg.norm([points.y[i] - found.modelled[j], points.y[j] - found.modelled[i]], axis=1)
            if (crossed < FITS * found.error[[i, j]]).all():
                pairs.append((int(i), int(j)))
    return pairs


def _other_markers(robot: Robot, points: Points, found: Placed, far: np.ndarray) -> list[int]:
    """Return the rows that fit another reflector, which the other rows place."""
    if len(points.tools) < 2 or not len(far):
        return []
    flange = forward_kinematics(robot, points.q[far])
    rows = []
    for k, i in enumerate(far):
        body = found.tools @ flange[k, :3, :3].T + flange[k, :3, 3]
        model = body @ found.base[:3, :3].T + found.base[:3, 3]
        error = np.linalg.norm(points.y[i] - model, axis=1)
        error[points.marker[i]] = np.inf
        if error.min() < FITS * found.error[i]:
            rows.append(int(i))
    return rows


def rounded_joints(problem: CalibrationProblem, error: float) -> Iterator[str]:
    """Say whether joint values are rounded so that this explains the RMS error [m] of a fit."""
    points = points_of(problem)
    if points is None:
        return
    turning = np.array([kind == "revolute" for kind in problem.robot.joint_types])
    if not turning.any():
        return
    arms = lever_arms(problem.robot, points.q, points.tools[0])[:, turning]
    for unit, size in (("deg", np.pi / 180), ("rad", 1.0)):
        decimals = _decimals(points.q[:, turning] / size)
        if decimals is None:
            continue
        step = size * 10.0**-decimals
        made = step / np.sqrt(12) * float(np.sqrt(np.mean(np.sum(arms**2, axis=1))))
        if ALIKE[0] * made < error < ALIKE[1] * made:
            yield (
                f"joint values are rounded to {10.0**-decimals:g} {unit}: that alone makes "
                f"{three_digits(1e3 * made)} mm, the fit is off by {three_digits(1e3 * error)} mm: "
                "export them with more decimals."
            )
            return


def _decimals(values: Array) -> int | None:
    """Return how many decimals all values have at most, up to 4; None where they have more."""
    for decimals in range(5):
        scaled = values * 10.0**decimals
        if np.abs(scaled - scaled.round()).max() < 1e-6 * max(np.abs(scaled).max(), 1.0) ** 0.5:
            return decimals
    return None


def moved_far(problem: CalibrationProblem) -> Iterator[str]:
    """Say from which row on points fit another base: an instrument that was moved by more than a robot's errors."""
    points = points_of(problem)
    if points is None or len(points.row) < 2 * FEWEST:
        return
    whole = misfit(problem.robot, points)
    if whole < FAR_MOVED:
        return
    best = whole
    place = 0
    rows = np.arange(len(points.row))
    for k in _places(len(rows)):
        parts = [misfit(problem.robot, points.take(rows[part])) for part in (slice(0, k), slice(k, None))]
        if max(parts) < best:
            best, place = max(parts), k
    if best < FITS * whole:
        label = problem.data.label[points.row[place]]
        first = placed(problem.robot, points.take(rows[:place]))
        second = placed(problem.robot, points.take(rows[place:]))
        far = 1e3 * _apart(first, second)
        yield (
            f"from row {label} on the points fit another base, {three_digits(far)} mm away: the instrument or the "
            "robot's foot moved; calibrate the two parts apart, or register the second one anew."
        )


def _apart(first: Placed, second: Placed) -> float:
    """Return how far apart two bases put the points of the second one's rows [m], in the mean."""
    body = (second.modelled - second.base[:3, 3]) @ second.base[:3, :3]
    seen = body @ first.base[:3, :3].T + first.base[:3, 3]
    return float(np.linalg.norm(second.modelled - seen, axis=1).mean())


def _places(count: int) -> np.ndarray:
    """Return before which rows a table may be parted."""
    if count < 2 * FEWEST:
        return np.array([], dtype=int)
    return np.unique(np.linspace(FEWEST, count - FEWEST, MOST_PLACES).round().astype(int))


def moved(problem: CalibrationProblem, x: Array) -> Iterator[str]:
    """Say from which row on the residuals at x (n,) show a base that has moved: a change point.

    Six columns, the base's motion for the rows from there on, are added to the last linearization. They must explain
    half of the sum of squares, more than chance does once in a million (F test, all places counted).
    """
    names = problem.parameters.free.names
    base = [names.index(f"base_{c}") for c in FRAME if f"base_{c}" in names]
    data = problem.data
    if len(base) < len(FRAME) or len(data) < 2 * FEWEST:
        return
    model = problem.linearize(x)
    if len(model.b) > MOST_EQUATIONS:
        return
    z = x / problem.parameters.free.scale
    r = model.b - model.A @ z
    n = len(z)
    Q = np.linalg.qr(np.vstack([model.A, np.eye(n)]))[0]
    row = np.concatenate([np.repeat(block.row, len(block.measurement.components)) for block in data.blocks])
    rest = np.concatenate([r, np.zeros(n)])
    rest = rest - Q @ (Q.T @ rest)
    whole = float(r @ r)
    places = _places(len(data))
    best, place, step = 0.0, 0, np.zeros(6)
    for k in places:
        G = np.vstack([model.A[:, base] * (row >= k)[:, None], np.zeros((n, 6))])
        G = G - Q @ (Q.T @ G)
        found = np.asarray(np.linalg.lstsq(G, rest, rcond=1e-9)[0], dtype=float)
        gain = float(rest @ rest - np.sum((rest - G @ found) ** 2))
        if gain > best:
            best, place, step = gain, int(k), found
    freedom = max(len(r) - n - 6, 1)
    left = max(whole - best, 1e-300)
    chance = fdtrc(6, freedom, best / 6 / (left / freedom)) * len(places)
    if best > (1 - MOVED) * whole and chance < RARE:
        yield _moved_text(problem, x, base, place, step, np.sqrt(left / whole))


def _moved_text(problem: CalibrationProblem, x: Array, base: list[int], place: int, step: Array, left: float) -> str:
    free = problem.parameters.free
    components = list(problem.data.blocks[0].measurement.components)
    lengths = [i for i, name in enumerate(components) if name in ("x", "y", "z", "distance")]
    alone = problem.on(replace(problem.data, blocks=problem.data.blocks[:1]))
    change = alone.jacobian(x)[:, base] @ (free.scale[base] * step)
    vectors = change.reshape(-1, len(components))[problem.data.blocks[0].row >= place][:, lengths]
    far = 1e3 * float(np.linalg.norm(vectors, axis=1).mean())
    return (
        f"from row {problem.data.label[place]} on the points are {three_digits(far)} mm from where the others put "
        f"them, and fit a base that moved (that leaves {100 * left:.0f} % of the residuals): did the instrument or the "
        "robot's foot move? Calibrate the two parts apart."
    )
