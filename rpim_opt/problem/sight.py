"""Postures in which a camera sees its whole board."""

from __future__ import annotations

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.models import eye_in_hand, of_fixture
from rpim_opt.data.projection import INTRINSICS, pixels
from rpim_opt.problem.design import random_candidates
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.views import camera_blocks
from rpim_opt.robot.kinematics import FRAME, forward_kinematics, numeric_frame
from rpim_opt.robot.parameter_names import tool_prefix

DRAWN, TIMES = 4096, 100
"""Configurations that are drawn at once to find some in which the board is in sight, and how often."""
MARGIN = 0.04
"""Part of the image along its edges in which no point appears."""
LARGE = 0.15
"""Least width of a board in the image, as part of the image's."""
UPRIGHT = 0.5
"""Least cosine between line of sight and the board's normal: corners of a board that leans more are not found."""


def postures_in_sight(
    problem: CalibrationProblem,
    points: Array,
    count: int,
    seed: int | np.random.Generator = 0,
    x: Array | None = None,
    share: float = 1.0,
    image: tuple[float, float] = (1280, 960),
) -> Array:
    """Return joint values (count, dof) [rad or m] at which a camera sees all of its board, large and upright enough.

    Parameters
    ----------
    problem
        With rows of a camera, whose frames and intrinsics count.
    points
        (P, 3) of the board [m].
    count
        How many.
    seed
        Of the draws, or a generator to draw from.
    x
        (n,) deviations at which frames and intrinsics are taken [SI]; nominal by default.
    share
        Which part of every joint's range is used, from 0 to 1.
    image
        Width and height [px].

    Raises
    ------
    InputError
        For a problem without a camera, joints without limits, and a board that is hardly ever in sight.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> points = np.array(list(ro.data.grid_board(7, 5, 0.03).values()))
    >>> ro.problem.postures_in_sight(ro.load("camera").problem, points, 12).shape
    (12, 6)
    """
    blocks = camera_blocks(problem.data)
    if not blocks:
        raise InputError("postures_in_sight", "no row of a camera", "a problem with eye_in_hand or eye_to_hand")
    block = blocks[0]
    p = problem.parameters
    values = p.nominal.copy()
    if x is not None:
        values[p.identified] = p.free.values(x)
    at = dict(zip(p.names, values.tolist(), strict=True))
    base = numeric_frame([at[f"base_{c}"] for c in FRAME])
    tool = numeric_frame([at[tool_prefix(block.markers[0]) + c] for c in FRAME])
    camera = {name: at[of_fixture(f"camera_{name}", block.fixture)] for name in INTRINSICS}
    points = np.asarray(points, dtype=float)
    rng = np.random.default_rng(seed)
    found = np.zeros((0, problem.robot.dof))
    for _ in range(TIMES):
        q = random_candidates(problem.robot, DRAWN, rng, share)
        T: Array = base @ forward_kinematics(problem.robot, q) @ tool
        if block.measurement is eye_in_hand:
            T = np.asarray(np.linalg.inv(T), dtype=float)
        found = np.concatenate([found, q[_in_sight(T, points, camera, np.array(image))]])
        if len(found) >= count:
            return found[:count]
    found_text = f"{len(found)} of {count} views in which the board is in sight"
    raise InputError("postures_in_sight", found_text, "frames, a share and an image with which it is more often")


def _in_sight(T: Array, points: Array, camera: dict[str, float], image: Array) -> np.ndarray:
    """Return which poses (N, 4, 4) of the board in the camera's frame show all of it."""
    there = points @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
    before = (there[:, :, 2] > 0).all(axis=1)
    sight = there.mean(axis=1)
    normal = np.linalg.svd(points - points.mean(axis=0))[2][2]
    normal = normal * np.copysign(1.0, normal[np.argmax(np.abs(normal))])
    leaning = np.einsum("nij,j,ni->n", T[:, :3, :3], normal, sight)
    there[~before] = [0.0, 0.0, 1.0]
    uv = np.stack(pixels(*np.moveaxis(there, 2, 0), **camera), axis=2)
    inside = ((uv > MARGIN * image) & (uv < (1 - MARGIN) * image)).all(axis=(1, 2))
    large = np.ptp(uv, axis=1).max(axis=1) > LARGE * image[0]
    return before & inside & large & (leaning > UPRIGHT * np.linalg.norm(sight, axis=1))
