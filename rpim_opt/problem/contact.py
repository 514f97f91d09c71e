"""What touches can see of a robot, and what known distances add: its scale."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.models import KNOWN, position
from rpim_opt.problem.problem import CalibrationProblem

STATED = frozenset(kind.name for kind in KNOWN)
"""Measurements that are statements of a drawing."""
CLOSE = 0.05
"""Places that are nearer [m] say little of the scale."""
LEAST = 1.0
"""A direction is seen that the data show better than the scales do."""


def contact_sentences(problem: CalibrationProblem) -> Iterator[str]:
    """Yield what the touches of a problem show, and what they do not; nothing where there are none.

    Of the scale it is said how well distances between touched places are known: the root of the mean square over all
    pairs of

    ::

        sd(|c_2 - c_1|) / |c_2 - c_1|,    var = g'(A'A + 1)^-1 g,    g the slope of the distance by z

    in units of the file's scales, before anything is learned.
    """
    touches = problem.touches
    if touches is None:
        return
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    s = model.svd[1]
    things = []
    points = touches.planar.count(False)
    planes = touches.planar.count(True)
    if points:
        things.append(f"{points} points")
    if planes:
        things.append(f"{planes} planes")
    count = sum(len(index) for index in touches.rows)
    yield (
        f"{count} touches of {' and '.join(things)}: {int(np.count_nonzero(s > LEAST))} of {len(s)} directions are "
        "seen better than the scales say. Where the robot stands and how its first joint is counted no touch shows."
    )
    yield _scale_sentence(problem, model.A)


def _scale_sentence(problem: CalibrationProblem, A: Array) -> str:
    without = problem.without({problem.labels[i] for b in problem.data.blocks if b.measurement.name in STATED
                               for i in b.row})  # fmt: skip
    bare = without.linearize(np.zeros(A.shape[1])).A
    alone = _scale(problem, bare)
    if alone is None:
        return "All that was touched is in one place: the robot's scale is that of the drawing."
    if len(without.data) == len(problem.data):
        return (
            f"Distances between touched places: known to {_per_metre(alone)} by touches and the scales of the file; a "
            "known distance between two of them ([[known_distance]]) would show how large the robot is."
        )
    known = _scale(problem, A)
    return (
        f"Distances between touched places: known to {_per_metre(known or alone)}, and to {_per_metre(alone)} without "
        "what the drawing knows of them."
    )


def _per_metre(sd: float) -> str:
    return f"{1e3 * sd:.2g} mm in a metre"


def _scale(problem: CalibrationProblem, A: Array) -> float | None:
    """Return the relative standard deviation of distances between touched places; None for a single one."""
    places, slopes = _places(problem)
    C = np.linalg.inv(A.T @ A + np.eye(A.shape[1]))
    squares = []
    for i, j in combinations(range(len(places)), 2):
        apart = places[j] - places[i]
        length = float(np.linalg.norm(apart))
        if length > CLOSE:
            g = apart @ (slopes[j] - slopes[i]) / length**2
            squares.append(float(g @ C @ g))
    if not squares:
        return None
    return float(np.sqrt(np.mean(squares)))


def _places(problem: CalibrationProblem) -> tuple[Array, Array]:
    """Return where the tool is at the touches of every thing in the mean (T, 3) [m], and its slopes by z (T, 3, n)."""
    free = problem.parameters.free
    x = np.zeros(len(free))
    names = []
    positions = []
    slopes = []
    for block in problem.data.blocks:
        if not block.measurement.touching or block.point is None:
            continue
        rows = np.arange(len(block.row))
        seen = replace(block, measurement=position, y=np.zeros((len(rows), 3)), row=rows, point=None)
        labels = tuple(str(i) for i in range(len(block.row)))
        there = problem.on(Dataset((seen,), labels, np.arange(len(labels))))
        names += block.point[:, 0].tolist()
        positions.append(there.modelled(x)[0])
        slopes.append((there.jacobian(x) * free.scale).reshape(len(labels), 3, -1))
    which = np.unique(names, return_inverse=True)[1]
    p = np.concatenate(positions)
    J = np.concatenate(slopes)
    each = [which == k for k in range(which.max() + 1)]
    return np.array([p[of].mean(axis=0) for of in each]), np.array([J[of].mean(axis=0) for of in each])
