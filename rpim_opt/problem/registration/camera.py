"""Camera poses by homographies (PnP) and start values of intrinsics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.data.measurements.camera import CAMERAS, INTRINSICS, eye_in_hand, targets
from rpim_opt.data.measurements.measurement import of_fixture
from rpim_opt.data.measurements.pose import from_matrices, pose
from rpim_opt.problem.registration.closed_forms import proper, rigid, transformed

FEWEST = {True: 4, False: 6}  # least number of points in a view: of a plane, of points in space
FLAT = 1e-6  # third over first singular value of a board's points, below which they are planar
LEAST_VIEWS = 3  # views that determine focal lengths and centre
UNCERTAIN = 3.0  # factor on the uncertainty of a view's pose beyond that of its points


def camera_blocks(data: Dataset) -> list[Block]:
    """Return the blocks that cameras have seen."""
    return [block for block in data.blocks if block.measurement in CAMERAS.values()]


def normalized(uv: Array, camera: Mapping[str, float]) -> Array:
    """Return the directions x = X / Z, y = Y / Z (N, 2) of pixels (N, 2), without distortion."""
    k1, k2, p1, p2, k3 = (camera.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3"))
    seen = (uv - [camera["cx"], camera["cy"]]) / [camera["fx"], camera["fy"]]
    xy = seen
    for _ in range(30):  # every iteration leaves a small part of the error
        x, y = xy.T
        r2 = x**2 + y**2
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        across = np.column_stack([2 * p1 * x * y + p2 * (r2 + 2 * x**2), p1 * (r2 + 2 * y**2) + 2 * p2 * x * y])
        xy = (seen - across) / np.maximum(radial, 0.1)[:, None]
    return np.asarray(xy, dtype=float)


def view_pose(points: Array, xy: Array) -> Array:
    """Return the pose of the board in the camera's frame (4, 4) [m] from its points' image: PnP.

    The start is a homography for planar points and the direct linear transform for others, followed by least squares;
    of the two similar poses of a plane the better fit is taken.

    ``points`` are (P, 3) on the board [m], ``xy`` (P, 2) directions as returned by `normalized`. InputError for fewer
    than four points of a plane or six in space, and for collinear points.
    """
    middle, axes, planar = _plane(points)
    local = (points - middle) @ axes.T
    if planar:
        H = _linear(local[:, :2], xy)  # columns: two axes of the board and its origin, in front of the camera
        H = H / np.copysign(np.sqrt(np.linalg.norm(H[:, 0]) * np.linalg.norm(H[:, 1])), H[2, 2])
        first = rigid(proper(np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])])), H[:, 2])
        # the pose with the normal tilted to the other side of the line of sight looks similar from far away: half a
        # turn about the line of sight, and half a turn about the board's normal
        sight = first[:3, 3] / np.linalg.norm(first[:3, 3])
        turn = np.diag([-1.0, -1.0, 1.0])
        to = scipy.spatial.transform.Rotation.align_vectors([[0, 0, 1]], [sight])[0].as_matrix()
        starts = [first, rigid(to.T @ turn @ to @ first[:3, :3] @ turn, first[:3, 3])]
    else:
        P = _linear(local, xy)
        P *= np.sign(np.linalg.det(P[:, :3]))
        starts = [rigid(proper(P[:, :3]), P[:, 3] / np.linalg.svd(P[:, :3])[1].mean())]
    T = min((_refined(start, local, xy) for start in starts), key=lambda found: found[1])[0]
    return T @ rigid(axes, -axes @ middle)


def _plane(points: Array) -> tuple[Array, Array, bool]:
    """Return a board's middle, right-handed axes (3, 3) in rows along which points spread, and whether it is flat."""
    middle = points.mean(axis=0)
    _, s, axes = np.linalg.svd(points - middle, full_matrices=True)
    s = np.append(s, np.zeros(3 - len(s)))
    planar = bool(s[2] <= FLAT * s[0])
    if len(points) < FEWEST[planar] or s[1] <= FLAT * s[0]:
        found = f"{len(points)} points" if s[1] > FLAT * s[0] else "points on a line"
        raise InputError("a view", found, f"{FEWEST[True]} or more of a plane, {FEWEST[False]} or more in space")
    axes[2] *= np.sign(np.linalg.det(axes))
    return middle, axes, planar


def _scaled(points: Array) -> Array:
    """Return a similarity (d + 1, d + 1) that puts points (P, d) about the origin, at a distance of about one."""
    d = points.shape[1]
    middle = points.mean(axis=0)
    size = float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1)) / d))
    T = np.eye(d + 1) / size
    T[:d, d] = -middle / size
    T[d, d] = 1.0
    return T


def _linear(points: Array, xy: Array) -> Array:
    """Return P (3, d + 1) with xy ~ P points, by the smallest singular value (direct linear transform)."""
    U = _scaled(points)
    V = _scaled(xy)
    ones = np.ones((len(points), 1))
    X = np.hstack([points, ones]) @ U.T
    x = np.hstack([xy, ones]) @ V.T
    zero = np.zeros_like(X)
    A = np.concatenate([np.hstack([X, zero, -x[:, :1] * X]), np.hstack([zero, X, -x[:, 1:2] * X])])
    P = np.linalg.svd(A)[2][-1].reshape(3, -1)
    return np.asarray(np.linalg.solve(V, P @ U), dtype=float)


def _refined(T: Array, points: Array, xy: Array) -> tuple[Array, float]:
    """Return the pose that fits best near a first one, and its sum of squares."""

    def pose_at(step: Array) -> Array:
        turn = scipy.spatial.transform.Rotation.from_rotvec(step[:3]).as_matrix()
        return rigid(turn @ T[:3, :3], T[:3, 3] + step[3:])

    def residual(step: Array) -> Array:
        there = transformed(pose_at(step), points)
        return (there[:, :2] / np.maximum(there[:, 2:], 1e-6) - xy).ravel()

    solution = scipy.optimize.least_squares(
        residual, np.zeros(6), method="lm", x_scale="jac", xtol=1e-10, ftol=1e-15, gtol=1e-15
    )
    return pose_at(solution.x), float(2 * solution.cost)


def rows_by_view(data: Dataset, block: Block) -> Iterator[np.ndarray]:
    """Yield the entries of a camera's block that were seen in one configuration."""
    configuration = data.configuration[block.row]
    for number in np.unique(configuration):
        yield np.flatnonzero(configuration == number)


def starting_camera(data: Dataset, block: Block) -> dict[str, float]:
    """Return focal lengths and centre [px] from the homographies of three views or more of a plane (Zhang 2000)."""
    rows = []
    points = targets(block)
    middle, axes, planar = _plane(points)
    unit = _scaled(block.y)
    for view in rows_by_view(data, block):
        if planar and len(view) >= FEWEST[True]:
            seen = np.hstack([block.y[view], np.ones((len(view), 1))]) @ unit.T
            H = _linear((points[view] - middle) @ axes[:2].T, seen[:, :2])
            H = H / np.linalg.norm(H[:, 0])
            # rows of g' B h and g' B g - h' B h, in B11, B22, B13, B23, B33: the absolute conic's image without skew
            (g1, g2, g3), (h1, h2, h3) = H[:, 0], H[:, 1]
            rows.append([g1 * h1, g2 * h2, g1 * h3 + g3 * h1, g2 * h3 + g3 * h2, g3 * h3])
            rows.append([g1**2 - h1**2, g2**2 - h2**2, 2 * (g1 * g3 - h1 * h3), 2 * (g2 * g3 - h2 * h3), g3**2 - h3**2])
    accepted = (
        f"a table [camera] with fx_px, fy_px, cx_px, cy_px, or {LEAST_VIEWS} views of a flat board from several sides"
    )
    if len(rows) < 2 * LEAST_VIEWS:
        raise InputError("the camera", f"{len(rows) // 2} views of a flat board", accepted)
    _, s, axes = np.linalg.svd(np.array(rows))
    b11, b22, b13, b23, b33 = axes[-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        size = b33 - b13**2 / b11 - b23**2 / b22
        squares = np.array([size / b11, size / b22])
    if s[3] <= 1e-9 * s[0] or not (np.isfinite(squares).all() and (squares > 0).all()):
        raise InputError("the camera", "views that do not determine the focal length", accepted)
    scale = unit[0, 0]
    fx, fy = np.sqrt(squares) / scale
    cx, cy = (np.array([-b13 / b11, -b23 / b22]) - unit[:2, 2]) / scale
    return {"fx": float(fx), "fy": float(fy), "cx": float(cx), "cy": float(cy)}


def with_poses(data: Dataset, own: Mapping[str, float]) -> Dataset:
    """Return the data with a pose for every view of a camera; other measurements as they are."""
    if not camera_blocks(data):
        return data
    cameras = CAMERAS.values()
    views = [_views(data, each, own) if each.measurement in cameras else (each.row, {}) for each in data.blocks]
    some = data.take(np.concatenate([rows for rows, _ in views]))
    pairs = zip(some.blocks, views, strict=True)
    return replace(some, blocks=tuple(replace(block, **poses) for block, (_, poses) in pairs))


def _views(data: Dataset, block: Block, own: Mapping[str, float]) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the first row (V,) of every view that determines a pose, and what a block of these poses has instead."""
    camera = {name: own.get(of_fixture(f"camera_{name}", block.fixture), 0.0) for name in INTRINSICS}
    if not (camera["fx"] > 0 and camera["fy"] > 0):
        raise InputError("the camera", f"a focal length of {camera['fx']:g} px", "one greater than zero")
    points = targets(block)
    xy = normalized(block.y, camera)
    _, _, planar = _plane(points)
    placed = []  # first entry of each view, and its pose
    for view in rows_by_view(data, block):
        if len(view) >= FEWEST[planar]:
            with suppress(InputError):  # collinear points
                placed.append((int(view[0]), view_pose(points[view], xy[view])))
    if not placed:
        raise InputError("the camera", "no view that determines a pose", f"views of {FEWEST[planar]} points or more")
    index = np.array([i for i, _ in placed])
    T = np.array([there for _, there in placed])
    focus = float(np.sqrt(camera["fx"] * camera["fy"]))
    covariance = np.broadcast_to(block.covariance, (len(block.row), 2, 2))[index]
    deviation = UNCERTAIN * np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2) / focus * T[:, 2, 3]
    sigma = deviation[:, None] * [1, 1, 1, *[1 / float(np.ptp(points, axis=0).max())] * 3]
    if block.measurement is eye_in_hand:
        T = np.linalg.inv(T)
    y = from_matrices(np.hstack([T[:, :3, 3], T[:, :3, :3].reshape(-1, 9)]))
    poses = {"measurement": pose, "y": y, "covariance": sigma[:, :, None] ** 2 * np.eye(6)}
    return block.row[index], poses | {"fixture": "", "point": None, "columns": {}}
