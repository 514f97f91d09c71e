"""Inverse kinematics of a robot with known parameters, within joint limits, for many rows at once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.problem.row_functions import Loads
from rpim_opt.robot.kinematics import FRAME, call_rows, chain, placed, product
from rpim_opt.robot.mdh import Robot

NULL_SPACE_WEIGHT = 1e-10  # weight of a correction that moves nothing, relative to the largest squared singular value
STEP_TOLERANCE = 1e-10
DECREASE_TOLERANCE = 1e-6
"""A row has converged when its step is shorter [rad or m], or lowers the objective by a smaller part."""
MAX_ITERATIONS = 50


class Arm(NamedTuple):
    """A robot with all its parameters known."""

    function: ca.Function  # of model joint values, loads (`Loads`) and target, side by side: pose, its error, and J'
    joint_map: Array

    @classmethod
    def of(
        cls,
        robot: Robot,
        values: Mapping[str, float],
        nominal: Mapping[str, float],
        tool: str,
        before: Array,
        kind: Measurement,
        loads: Loads,
    ) -> Arm:
        """Build the function from parameter values by name; gravity acts on the nominal ones."""
        command = loads.symbols(len(robot.joint_types), 1)
        y = ca.SX.sym("y", len(kind.columns))

        def value(name: str) -> float:
            return values.get(name, 0.0)

        configuration = loads.configuration(robot.joint_types, nominal.__getitem__, command)
        flange = chain(robot.joint_types, configuration, value, robot.model.terms)
        T = product([ca.SX(ca.DM(before)), *flange, *placed([value(tool + c) for c in FRAME])])
        # how point and orientation of T move with the joints; gravity bends a joint by the values of all of them
        turn = sum(ca.skew(T[:3, k]) @ ca.jacobian(T[:3, k], command["q"]) for k in range(3)) / 2
        J = ca.vertcat(ca.jacobian(T[:3, 3], command["q"]), turn)[: len(kind.components), :]
        modelled = kind.model(T)
        outputs = [ca.densify(v) for v in (modelled, kind.minus(y, modelled), J.T)]
        return cls(ca.Function("arm", [ca.vertcat(*command.values(), y)], outputs), robot.joint_map)

    def at(self, q: Array, load: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the pose (N, c), its error (N, k) from y, and the Jacobian (N, k, dof) of the pose."""
        modelled, error, J = call_rows(self.function, [], np.hstack([q @ self.joint_map.T, load, y]))
        return modelled[:, 0], error[:, 0], J @ self.joint_map


def nearest(
    arm: Arm, load: Array, y: Array, start: Array, limits: tuple[Array, Array], W: Array, P: Array
) -> tuple[Array, Array, np.ndarray]:
    """Minimize |W error|^2 + D' P D over low <= q <= high, q = start + D, row by row.

    Gauss-Newton steps in the box, damped (Levenberg-Marquardt) in rows whose step does not lower the objective.
    Shapes: start (N, n), limits (N, n) or (n,), W (N or 1, k, k), P (N or 1, n, n). Returned are joint
    values (N, n), their errors (N, k), and which joints are at an active limit (N, n).
    """
    N, n = start.shape
    W = np.broadcast_to(W, (N, *W.shape[1:]))
    P = np.broadcast_to(P, (N, n, n))
    low, high = (np.broadcast_to(limit, start.shape) for limit in limits)
    to_low = low - start
    to_high = high - start

    def state(rows: np.ndarray, D: Array) -> tuple[Array, Array, Array, Array]:
        """Return errors, weighted errors, their slopes, and the objectives."""
        q = np.clip(start[rows] + D, low[rows], high[rows])
        _, error, J = arm.at(q, load[rows], y[rows])
        weighted = times(W[rows], error)
        value = np.sum(weighted**2, axis=1) + np.sum(D * times(P[rows], D), axis=1)
        return error, weighted, W[rows] @ J, value

    every = np.arange(N)
    D = np.clip(0.0, to_low, to_high)
    damping = np.zeros(N)
    error, weighted, A, value = here = state(every, D)

    def descent(rows: np.ndarray) -> Array:
        """Return half the negative gradients."""
        return np.einsum("nki,nk->ni", A[rows], weighted[rows]) - times(P[rows], D[rows])

    left = every
    for _ in range(MAX_ITERATIONS):
        if not len(left):
            break
        g = descent(left)
        H = A[left].transpose(0, 2, 1) @ A[left] + P[left]
        diagonal = np.einsum("nii->ni", H)  # a trace of damping keeps every one regular
        diagonal += damping[left, None] * diagonal + 1e-14 * diagonal.mean(axis=1, keepdims=True) + 1e-300
        step = _boxed(H, g, to_low[left] - D[left], to_high[left] - D[left])
        new = state(left, D[left] + step)
        better = new[-1] <= value[left] * (1 + 1e-14) + 1e-20  # below that it is rounding
        rows = left[better]
        D[rows] += step[better]
        for old, values in zip(here, new, strict=True):
            old[rows] = values[better]
        damping[rows] = np.where(damping[rows] > 1e-6, damping[rows] / 10, 0.0)
        damping[left[~better]] = np.maximum(10 * damping[left[~better]], 1e-3)
        long = np.abs(step).max(axis=1) > STEP_TOLERANCE
        promising = np.sum(step * g, axis=1) > DECREASE_TOLERANCE * value[left]
        left = left[long & promising & (value[left] > 1e-24)]
    g = descent(every)
    active = ((to_low >= D) & (g < 0)) | ((to_high <= D) & (g > 0))
    return np.clip(start + D, low, high), error, active


def _boxed(H: Array, g: Array, low: Array, high: Array) -> Array:
    """Return steps d (N, n) that minimize d'Hd/2 - g'd within low <= 0 <= high, nearly.

    Entries that leave the box are set on its border and the others solved for again, until none leaves.
    """
    n = g.shape[1]
    free = ~(((low >= 0) & (g < 0)) | ((high <= 0) & (g > 0)))
    step = np.zeros_like(g)
    rows = np.arange(len(g))
    for _ in range(n + 1):
        f = free[rows]
        pairs = f[:, :, None] & f[:, None, :]
        fixed = np.where(f, 0.0, step[rows])
        rest = np.where(f, g[rows] - np.einsum("nij,nj->ni", H[rows], fixed), 0.0)
        solved = np.linalg.solve(np.where(pairs, H[rows], np.eye(n)), rest[:, :, None])[:, :, 0]
        step[rows] = np.clip(np.where(f, solved, fixed), low[rows], high[rows])
        out = f & ((solved < low[rows]) | (solved > high[rows]))
        free[rows] &= ~out
        rows = rows[out.any(axis=1)]
        if not len(rows):
            break
    return step


def attainable(J: Array) -> Array:
    """Return matrices W (N or 1, k, k) that project errors on the attainable ones, from Jacobians (N, k, n).

    With six joints or more, or positions alone, all do. With fewer position comes first: of the orientation counts what
    can be turned without moving the point, which makes as many equations as joints.
    """
    k, n = J.shape[1:]
    if n >= k or k == 3:
        return np.eye(k)[None]
    still = np.linalg.svd(J[:, :3])[2][:, 3:]
    U, s, _ = np.linalg.svd(J[:, 3:] @ still.transpose(0, 2, 1), full_matrices=False)
    U = U * (s > 1e-6)[:, None]
    W = np.tile(np.eye(k), (len(J), 1, 1))
    W[:, 3:, 3:] = U @ U.transpose(0, 2, 1)
    return W


def times(W: Array, vectors: Array) -> Array:
    """Return matrices (N, k, k) times vectors (N, k), row by row."""
    return (W @ vectors[:, :, None])[:, :, 0]


def correction_weights(A: Array, due: Array, largest: float) -> Array:
    """Return the weights P (N, n, n) of corrections: with A = U diag(s) V', see `compensate`."""
    n = A.shape[2]
    U, s, Vt = np.linalg.svd(A, full_matrices=True)
    some = s.shape[1]
    e = np.zeros((len(A), n))
    e[:, :some] = np.einsum("nij,ni->nj", U, due)[:, :some]
    s = np.pad(s, ((0, 0), (0, n - some)))
    p = np.maximum((e / largest) ** 2 - s**2, 0.0)
    p += NULL_SPACE_WEIGHT * s[:, :1] ** 2 * (s <= 1e-9 * s[:, :1])
    return np.einsum("nki,nk,nkj->nij", Vt, p, Vt)
