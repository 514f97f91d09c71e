"""Where the data put base and reflectors on the nominal robot: by the certified start, else by closed forms."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.problem.placing import (
    NOMINAL_ERROR,
    TOOL_ERROR,
    Place,
    hand_eye,
    proper,
    register,
    tool_from_distances,
    transforms,
)
from rpim_opt.robot.kinematics import forward_kinematics, frame_numbers
from rpim_opt.robot.mdh import Robot

if TYPE_CHECKING:
    from rpim_opt.problem.verdict import CertifiedStart

ENOUGH = 2000
"""Rows of a measurement from which frames are placed, where there are more."""
FREE = 0.1
"""Standard deviation of a rotation [rad] from which closed forms are asked: they refuse what is not determined."""
MOST_PLACING = 30
"""Markers that place the base, where there are more: the others follow from the base."""
MOST_TURNING = 4
"""Markers whose orientations place the base, where more turn: those of the others follow from the base."""


class Located(NamedTuple):
    """Where base (6,) and reflectors (6,) by marker are [m, rad], and how that was found, in a sentence."""

    base: Array
    tools: dict[str, Array]
    how: str


def locate(robot: Robot, data: Dataset, tools: Mapping[str, Place]) -> Located:
    """Return the base and the reflectors by marker, from positions and poses on the nominal robot.

    All of them together by `certified_hand_eye`; of many reflectors some, from which the others follow. Where the
    rotations are not determined by that, closed forms say what they can: poses by `hand_eye`; of positions, distances
    correct the reflectors and registration places the base.

    Raises
    ------
    InputError
        When there are no positions and no poses, or they do not determine the base.
    """
    seen = [b for b in data.blocks if b.measurement.name in ("position", "pose")]
    seen = [b.take(k, k) for b in seen for k in [_spread(len(b.row))]]
    if not seen:
        raise InputError("key base", '"auto" without positions or poses', "a table [base]")
    places = {marker: np.asarray(place, dtype=float).copy() for marker, place in tools.items()}
    flanges = [forward_kinematics(robot, block.q[:, 0]) for block in seen]
    try:
        return _certified(seen, flanges, places)
    except InputError as error:
        base, found = _closed_forms(seen, flanges, places)
        return Located(base, found, f"by closed forms: {error.found}")


def _certified(seen: Sequence[Block], flanges: Sequence[Array], places: Mapping[str, Array]) -> Located:
    """Return the certified start, reflectors where they are stated up to `TOOL_ERROR`; refuse it where it is free."""
    turning = _most([block for block in seen if block.measurement.name == "pose"], MOST_TURNING)
    try:
        start = _started(seen, flanges, places, turning | _most(seen, MOST_PLACING), turning)
    except InputError:  # where every configuration shows other markers, it takes all of them
        if len(places) <= MOST_PLACING:
            raise
        start = _started(seen, flanges, places, set(places), turning)
    base = start.bases[""]
    found = _seen_from(base, seen, flanges, places)
    for marker, tool in start.tools.items():
        found[marker][:3] = tool[:3, 3]
    for block, flange in zip(seen, flanges, strict=True):
        if block.measurement.name == "pose":
            tool = np.eye(4)
            turned = (base @ flange)[:, :3, :3].transpose(0, 2, 1) @ transforms(block.y)[:, :3, :3]
            tool[:3, :3] = proper(turned.sum(axis=0))
            tool[:3, 3] = found[block.markers[0]][:3]
            found[block.markers[0]] = frame_numbers(tool)
    verdict = "certified" if start.certified else "not certified"
    return Located(frame_numbers(base), found, f"{verdict}: {start.reason}")


def _started(
    seen: Sequence[Block], flanges: Sequence[Array], places: Mapping[str, Array], placing: set[str], turning: set[str]
) -> CertifiedStart:
    """Return the certified start from some markers, of some with their orientations; refuse it where it is free."""
    from rpim_opt.problem.certified import certified_hand_eye  # CVXPY waits until a base is located

    asked = [(block, flange) for block, flange in zip(seen, flanges, strict=True) if block.markers[0] in placing]
    sigma = np.concatenate([_deviations(block) for block, _ in asked])
    start = certified_hand_eye(
        np.concatenate([flange for _, flange in asked]),
        np.concatenate([_measured(block, block.markers[0] in turning) for block, _ in asked]),
        marker=[block.markers[0] for block, _ in asked for _ in block.row],
        sigma=(sigma[:, 0], sigma[:, 1]),
        expected=places,
        spread=TOOL_ERROR,
    )
    if start.uncertainty > FREE:
        raise InputError("the data", start.reason, "turns about two axes")
    return start


def _seen_from(
    base: Array, seen: Sequence[Block], flanges: Sequence[Array], places: Mapping[str, Array]
) -> dict[str, Array]:
    """Return the reflectors (6,) by marker where their positions are least off, seen from a base (4, 4) that is known.

    They are expected where they are stated, up to `TOOL_ERROR`.
    """
    certain = dict.fromkeys(places, TOOL_ERROR**-2)
    total = {marker: place[:3] * TOOL_ERROR**-2 for marker, place in places.items()}
    for block, flange in zip(seen, flanges, strict=True):
        T = base @ flange
        there = np.einsum("nji,nj->ni", T[:, :3, :3], block.y[:, :3] - T[:, :3, 3])
        precision = _deviations(block)[:, 0] ** -2
        certain[block.markers[0]] += precision.sum()
        total[block.markers[0]] = total[block.markers[0]] + precision @ there
    found = {marker: place.copy() for marker, place in places.items()}
    for marker, place in found.items():
        place[:3] = total[marker] / certain[marker]
    return found


def _most(blocks: Sequence[Block], count: int) -> set[str]:
    """Return so many markers of those with the most rows, for each makes the relaxation larger."""
    rows: Counter[str] = Counter()
    for block in blocks:
        rows[block.markers[0]] += len(block.row)
    return {marker for marker, _ in rows.most_common(count)}


def _measured(block: Block, turning: bool) -> Array:
    """Return poses (N, 4, 4), their rotations NaN where positions alone count."""
    if turning and block.measurement.name == "pose":
        return transforms(block.y)
    T = np.full((len(block.y), 4, 4), np.nan)
    T[:, :3, 3] = block.y[:, :3]
    T[:, 3] = [0.0, 0.0, 0.0, 1.0]
    return T


def _deviations(block: Block) -> Array:
    """Return standard deviations (N, 2) of a position [m] and a turn [rad]: the instrument's and the robot's."""
    variance = np.full((len(block.row), 2), NOMINAL_ERROR**2)
    covariance = np.broadcast_to(block.covariance, (len(block.row), *block.covariance.shape[1:]))
    variance[:, 0] += np.trace(covariance[:, :3, :3], axis1=1, axis2=2) / 3
    if block.measurement.name == "pose":
        variance[:, 1] += np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2) / 3
    return np.sqrt(variance)


def _closed_forms(
    seen: Sequence[Block], flanges: Sequence[Array], places: Mapping[str, Array]
) -> tuple[Array, dict[str, Array]]:
    """Return the base and the reflectors, of which the first whose poses tell decide alone."""
    found = {marker: place.copy() for marker, place in places.items()}
    source, target, weight = [], [], []
    for block, flange in zip(seen, flanges, strict=True):
        marker = block.markers[0]
        if block.measurement.name == "pose":
            try:
                base, tool = hand_eye(flange, transforms(block.y), found[marker][:3])
            except InputError:
                pass  # too few turns: positions and the stated tool have to do
            else:
                found[marker] = frame_numbers(tool)
                return frame_numbers(base), found
        if len(flange) > 3:
            found[marker][:3] = tool_from_distances(flange, block.y[:, :3], found[marker][:3], TOOL_ERROR)
        source.append(flange[:, :3, :3] @ found[marker][:3] + flange[:, :3, 3])
        target.append(block.y[:, :3])
        variance = np.trace(block.covariance[:, :3, :3], axis1=1, axis2=2)
        weight.append(1 / np.broadcast_to(variance, len(flange)))
    q = np.concatenate(weight)
    return frame_numbers(register(np.concatenate(source), np.concatenate(target), q / q.max())), found


def _spread(count: int) -> np.ndarray:
    """Return which of so many rows place a frame: no more than `ENOUGH`, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, ENOUGH)).round().astype(int))
