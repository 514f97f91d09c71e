"""Minima of programs whose penalty has kinks (lasso, group lasso): from face to face, in the penalty's own unknowns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.closed import shares
from rpim_opt.convex.faces import Face, Faces
from rpim_opt.convex.objective import Damping, Objective
from rpim_opt.convex.split import Split


class OnFaces(NamedTuple):
    """A minimum: z (n,), loss and penalty there, multipliers of the boxes, and what its gap says of it.

    It is ``certain``, or as ``good`` as an interior point's, or neither.
    """

    z: Array
    loss: float
    penalty: float
    duals: tuple[Array, ...]
    certain: bool
    good: bool


def minimum_on_faces(
    objective: Objective, weight: float, damping: Damping | None, start: Array | None = None
) -> OnFaces:
    """Return the minimum of a squared loss and a penalty with kinks, in a box, at a weight above zero.

    Parameters
    ----------
    objective
        One that has `faces`.
    weight, damping
        What is minimized.
    start
        A point (n,) near the minimum: that of a neighbouring weight. By default that with squares instead of norms.
    """
    faces, split = _of(objective, damping)
    face = faces.minimum(weight, None if start is None else split.y(start))
    z = split.z(face.y)
    rows = objective.squared.triangle
    r = rows[:, :-1] @ z - rows[:, -1]
    loss = float(r @ r) + objective.squared.offset
    return OnFaces(
        z, loss, faces.penalty(face.y) + split.constant, _held(objective, faces, face, weight), face.certain, face.good
    )


def _of(objective: Objective, damping: Damping | None) -> tuple[Faces, Split]:
    faces, split = objective.faces, objective.split
    if damping is not None:
        faces = objective.damped_faces(damping)
    if faces is None or split is None:
        raise InputError(f"formulation '{objective.formulation.name}'", "no faces", "a penalty that sums norms")
    return faces, split


def _held(objective: Objective, faces: Faces, face: Face, weight: float) -> tuple[Array, ...]:
    """Return the multipliers of the boxes at a minimum."""
    box = objective.box
    if box is None or not objective.formulation.constraints:
        return ()
    y, price = face.y, weight * faces.price
    slope = faces.slope(y, weight)
    right = slope + np.where(y >= 0, price, -price)
    left = slope + np.where(y > 0, price, -price)
    held = np.where(y <= faces.lower, np.maximum(left, 0.0), 0.0)
    held = held + np.where(y >= faces.upper, np.maximum(-right, 0.0), 0.0)
    z = np.where(y <= faces.lower, box[0], np.where(y >= faces.upper, box[1], face.y))
    return shares(objective, box, z, held)
