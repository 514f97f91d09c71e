"""Hand-eye calibration A X = Z B: base and tool from closed loops, by least squares from many starts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from scipy.linalg import solve_triangular
from scipy.special import chdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.problem.registration.closed_forms import NOMINAL_ERROR, Place, proper, rigid

UNKNOWN = 0.1
"""Standard deviation of a rotation [rad] from which it is not determined."""
FAR = 0.5
"""Angle [rad] from which on two solutions are different ones."""
AS_WELL = 1e-4
"""Probability that the truth fits worse than what counts as fitting as well."""
RIDGE = 1e-6
"""How certain an expected translation is at least, in units of all positions together: what they do not show stays."""
FEWEST = 3
LINEAR = 6
"""Unknowns that are eliminated exactly: the translations t of the tool and u of the base."""
TRIED, STARTS = 1000, 8
"""Rotations of the base that are tried, and those of them from which least squares begin, `FAR` from each other: the
sum of squares is quadratic in a rotation's entries, so that no basin is narrower than the tried ones lie apart."""
STEPS, SMALLEST_STEP = 100, 1e-13
CROSS = -np.cross(np.eye(3)[:, None], np.eye(3))
"""The matrices of the cross products e_a x."""


@dataclass(frozen=True, eq=False)
class HandEye:
    """Base and tool from closed loops, and whether the measurements determine them.

    ``base`` (4, 4) is the transform of the robot's base in the instrument's frame [m], ``tool`` (4, 4) that of the
    target in the flange frame, not turned by positions alone. ``cost`` is the sum of squares, ``uncertainty`` the
    standard deviation of the least certain rotation [rad]. ``determined``: that is small, and no other solution fits as
    well; ``reason`` says why not.
    """

    base: Array
    tool: Array
    cost: float
    uncertainty: float
    determined: bool
    reason: str


@one_blas_thread
def hand_eye(
    flange: Array,
    measured: Array,
    *,
    sigma: tuple[float | Array, float | Array] = (NOMINAL_ERROR, NOMINAL_ERROR),
    expected: Place = (0, 0, 0),
    spread: float = np.inf,
) -> HandEye:
    """Return base Z and tool X of A X = Z B, measured_i = Z flange_i X.

    ::

        minimize  sum_i |Z_R'y_i - A_R,i t - A_t,i - u|^2 / sigma_position^2
                        + |B_R,i X_R' - Z_R A_R,i|^2 / (2 sigma_orientation^2)  +  |t - expected|^2 / spread^2

    over rotations Z_R, X_R and translations t = X_t, u = Z_R'Z_t. The translations are eliminated exactly. Of
    rotations Z_R all over the group, each with its best X_R, those of least cost are refined by Levenberg-Marquardt.

    ``flange`` (N, 4, 4) are transforms of the flange in the robot's base [m], ``measured`` (N, 4, 4) of the tool in the
    instrument's frame, NaN for rotations that were not measured; or positions (N, 3). ``sigma`` are the standard
    deviations of a position [m] and an orientation [rad], each a number or (N,): of the instrument and of the robot,
    which differs from the nominal one. A direction of the tool that the measurements do not show stays as expected in
    any case. InputError for fewer than three measurements, and what is no transform.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> arm = ro.load("paper_arm").problem
    >>> flange = ro.robot.forward_kinematics(arm.robot, arm.data.q)
    >>> base, tool = np.eye(4), np.eye(4)
    >>> base[:3, 3], tool[:3, 3] = [2.0, 0.0, 0.5], [0.0, 0.02, 0.06]
    >>> found = ro.problem.hand_eye(flange, base @ flange @ tool)
    >>> found.determined, bool(np.abs(found.base - base).max() < 1e-6), bool(np.abs(found.tool - tool).max() < 1e-6)
    (True, True, True)
    """
    flange, measured, turned = _checked(flange, measured)
    deviations = np.stack([np.broadcast_to(np.asarray(each, dtype=float), len(flange)) for each in sigma], axis=1)
    if not (np.isfinite(deviations).all() and (deviations > 0).all()):
        raise InputError("sigma", "a number that is not positive", "standard deviations of position and orientation")
    rows = _equations(flange, measured, turned, deviations, np.asarray(expected, dtype=float)[:3], spread)
    n = rows.shape[1]
    # |T v|^2 is the cost: the last rows are the least over translations, the first ones say which these are
    T = np.asarray(np.linalg.qr(np.vstack([rows, np.zeros((n, n))]), mode="r"))
    found = _optima(T[LINEAR:, LINEAR:])
    first, *last = found.rotations[0]
    x = _lifted(found.rotations[:1])[0]
    t, u = solve_triangular(T[:LINEAR, :LINEAR], -T[:LINEAR, LINEAR:] @ x).reshape(2, 3)
    weakest = float(np.linalg.eigvalsh(found.information[0])[0])
    uncertainty = float(1 / np.sqrt(weakest)) if weakest > 0 else float(np.inf)
    as_well = found.cost <= found.cost[0] + chdtri(LINEAR + 3 * (1 + len(last)), AS_WELL)
    apart = float(found.angles()[as_well].max())
    reason = ""
    if uncertainty > UNKNOWN:
        reason = f"the measurements do not determine the rotations (about {uncertainty:.2g} rad): turn about two axes"
    elif apart > FAR:
        reason = f"another solution, {apart:.2g} rad away, fits as well: measure more or other poses to decide"
    base = rigid(first, first @ u)
    tool = rigid(last[0].T if last else np.eye(3), t)
    return HandEye(base, tool, float(found.cost[0]), uncertainty, not reason, reason)


def _checked(flange: Array, measured: Array) -> tuple[Array, Array, np.ndarray]:
    """Return transforms and which were measured to turn; refuse what is none."""
    flange = np.asarray(flange, dtype=float)
    measured = np.asarray(measured, dtype=float)
    N = len(flange)
    if flange.shape != (N, 4, 4) or measured.shape not in ((N, 4, 4), (N, 3)):
        found = f"shapes {flange.shape}, {measured.shape}"
        raise InputError("transforms", found, "(N, 4, 4) both, or positions (N, 3)")
    if N < FEWEST:
        raise InputError("poses", f"{N}", f"{FEWEST} or more")
    points = measured if measured.ndim == 2 else measured[:, :3, 3]
    poses = rigid(np.eye(3), points)
    turned = np.zeros(N, dtype=bool)
    if measured.ndim == 3:
        turned = np.asarray(~np.isnan(measured[:, :3, :3]).any(axis=(1, 2)))
        poses[turned] = measured[turned]
    if not (np.isfinite(flange).all() and np.isfinite(poses).all()):
        raise InputError("transforms", "numbers that are not finite", "finite numbers")
    for R in (flange[:, :3, :3], poses[:, :3, :3]):
        off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        wrong = np.flatnonzero((off > 1e-3) | (np.linalg.det(R) < 0))
        if len(wrong):
            found = f"a matrix that misses R R' = 1 by {off[wrong[0]]:.2g}"
            raise InputError(f"pose {wrong[0] + 1}", found, "a rotation")
    return flange, poses, turned


def _equations(
    flange: Array, measured: Array, turned: np.ndarray, sigma: Array, expected: Array, spread: float
) -> Array:
    """Return the equations (m, n) of v = (t, u, 1, vec Z_R, vec X_R'), rotations' rows first: |equations v|^2 is cost.

    ::

        (Z_R' y - A_R t - A_t - u) / sigma_position,    t = X_t,  u = Z_R' Z_t
        (B_R X_R' - Z_R A_R) / (sqrt(2) sigma_orientation)    where the orientation was measured

    The norm of the second is the angle between the two, up to third order. X_R is left out where nothing turned.
    """
    N = len(flange)
    eye = np.eye(3)
    A = flange[:, :3, :3]
    of_base = slice(LINEAR + 1, LINEAR + 10)
    J = np.zeros((N, 12, LINEAR + 1 + 9 * (1 + turned.any())))
    J[:, :3, :3] = -A
    J[:, :3, 3:6] = -eye
    J[:, :3, LINEAR] = -flange[:, :3, 3]
    J[:, :3, of_base] = np.einsum("nb,ac->nabc", measured[:, :3, 3], eye).reshape(N, 3, 9)
    if turned.any():
        J[:, 3:, of_base] = -np.einsum("ai,njb->nabij", eye, A).reshape(N, 9, 9)
        J[:, 3:, of_base.stop :] = np.einsum("nai,bj->nabij", measured[:, :3, :3], eye).reshape(N, 9, 9)
    J[:, :3] /= sigma[:, 0, None, None]
    J[:, 3:] *= (turned / (np.sqrt(2) * sigma[:, 1]))[:, None, None]
    certainty = max(1 / spread, RIDGE * float(np.sqrt(np.sum(sigma[:, 0] ** -2))))
    prior = np.zeros((3, J.shape[2]))
    prior[:, :3] = certainty * eye
    prior[:, LINEAR] = -certainty * expected
    return np.vstack([J.reshape(12 * N, -1), prior])


class _Optima(NamedTuple):
    """S local minima, the best first: rotations (S, k, 3, 3), costs (S,) and half their Hessians (S, 3k, 3k)."""

    rotations: Array
    cost: Array
    information: Array  # by turns of the rotations [1/rad^2]

    def angles(self) -> Array:
        """Return the largest angle (S,) [rad] between rotations of the best one and the others."""
        apart = np.swapaxes(self.rotations[:1], 2, 3) @ self.rotations
        angles = scipy.spatial.transform.Rotation.from_matrix(apart.reshape(-1, 3, 3)).magnitude()
        return np.asarray(angles.reshape(apart.shape[:2]).max(axis=1))


def _lifted(rotations: Array) -> Array:
    """Return x = (1, vec R_1, ..., vec R_k) (S, n), rows first."""
    return np.concatenate([np.ones((len(rotations), 1)), rotations.reshape(len(rotations), -1)], axis=1)


def _optima(L: Array) -> _Optima:
    """Return local minima of |L x|^2 over x = (1, vec R_1, ..., vec R_k), k = 1 or 2."""
    tried = scipy.spatial.transform.Rotation.random(TRIED, rng=np.random.default_rng(0)).as_matrix()[:, None]
    x = _lifted(tried)
    if L.shape[1] > 10:  # squares of a second rotation are constant: what is linear in it decides
        last = proper(-(x @ L[:, :10].T @ L[:, 10:]).reshape(-1, 1, 3, 3))
        tried = np.concatenate([tried, last], axis=1)
        x = _lifted(tried)
    starts: list[int] = []
    for i in np.argsort(np.sum((x @ L.T) ** 2, axis=1)):
        cosines = (np.sum(tried[i, 0] * tried[starts, 0], axis=(1, 2)) - 1) / 2
        if len(starts) < STARTS and cosines.max(initial=-1.0) < np.cos(FAR):
            starts.append(int(i))
    found = _refined(L, tried[starts])
    order = np.argsort(found.cost)
    return _Optima(*(each[order] for each in found))


def _refined(L: Array, rotations: Array) -> _Optima:
    """Return the local minima to which damped Newton steps lead from rotations (S, k, 3, 3)."""
    S, k = rotations.shape[:2]
    damping = np.full(S, 1e-3)
    cost = np.sum((_lifted(rotations) @ L.T) ** 2, axis=1)
    H = np.zeros((S, 3 * k, 3 * k))
    for _ in range(STEPS):
        residual = _lifted(rotations) @ L.T
        M = np.swapaxes(rotations, 2, 3) @ (residual @ L)[:, 1:].reshape(rotations.shape)
        D = np.zeros((S, L.shape[1], 3 * k))  # slopes of x by turns
        H[:] = 0.0
        for i in range(k):
            own = slice(3 * i, 3 * i + 3)
            D[:, 1 + 9 * i : 10 + 9 * i, own] = np.swapaxes((rotations[:, i, None] @ CROSS).reshape(S, 3, 9), 1, 2)
            # the second order of exp([w] x) is ([w] x)^2 / 2 = (w w' - |w|^2) / 2
            trace = np.trace(M[:, i], axis1=1, axis2=2)
            H[:, own, own] = (M[:, i] + np.swapaxes(M[:, i], 1, 2)) / 2 - trace[:, None, None] * np.eye(3)
        J = L @ D
        squares = np.einsum("smi,smi->si", J, J)
        H += np.swapaxes(J, 1, 2) @ J
        more = damping[:, None] * squares + 1e-14 * squares.max(axis=1, keepdims=True)
        step = -np.linalg.solve(H + more[:, None] * np.eye(3 * k), np.einsum("smi,sm->si", J, residual)[..., None])
        turn = scipy.spatial.transform.Rotation.from_rotvec(step.reshape(-1, 3)).as_matrix()
        candidate = proper(rotations @ turn.reshape(rotations.shape))
        value = np.sum((_lifted(candidate) @ L.T) ** 2, axis=1)
        better = value <= (1 + 1e-12) * cost  # the last digits of a step do not show in the cost
        rotations = np.where(better[:, None, None, None], candidate, rotations)
        cost = np.where(better, value, cost)
        damping = np.where(better, damping / 10, np.maximum(10 * damping, 1e-9))
        if np.abs(step).max() < SMALLEST_STEP:
            break
    return _Optima(rotations, cost, H)
