"""Certified registration: base and tool from closed loops, with an optimality certificate."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module

import numpy as np
import scipy
from scipy.linalg import solve_triangular
from scipy.special import chdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.problem.registration.closed_forms import NOMINAL_ERROR, Place, proper, rigid

GAP = 1e-3  # tolerance of cost minus bound, over one plus the cost: a finer chi-squared has no meaning
UNKNOWN = 0.1  # standard deviation of a rotation [rad] above which it is undetermined
FAR = 0.5  # angle [rad] within which all equally good starts have to be, for the solution to be unique
AS_WELL = 1e-4  # probability that the truth fits worse than an equally good start
RIDGE = 1e-6
"""Least certainty of an expected translation, in units of all positions together: undetermined directions stay."""
FEWEST = 3  # measurements
LINEAR = 6  # unknowns that are eliminated exactly: the translations t of the tool and u of the base


@dataclass(frozen=True, eq=False)
class CertifiedStart:
    """Base and tool from closed loops, with an optimality certificate.

    ::

        cost   = sum_i |r_i|^2 + |t - expected|^2 / spread^2,   r_i in standard deviations
        bound <= cost of any base and tool whatever
        gap    = (cost - bound) / (1 + cost)

    Angles are in rad; ``bound`` and ``radius`` are proven. ``certified`` states that the optimum is global, unique and
    determined.
    """

    base: Array  # (4, 4) transform of the robot's base in the instrument's frame [m]
    tool: Array  # (4, 4) of the target in the flange frame; without rotation for positions
    cost: float
    bound: float
    gap: float
    rank_ratio: float  # second over first eigenvalue of the moment matrix: zero if the relaxation is tight
    uncertainty: float  # standard deviation of the least certain rotation
    radius: float  # angle from these rotations [rad] beyond which all others fit worse by more than noise explains
    certified: bool
    reason: str  # sentence on why it is certified or not


@one_blas_thread
def certified_hand_eye(
    flange: Array,
    measured: Array,
    *,
    sigma: tuple[float | Array, float | Array] = (NOMINAL_ERROR, NOMINAL_ERROR),
    expected: Place = (0, 0, 0),
    spread: float = np.inf,
) -> CertifiedStart:
    """Return base Z and tool X of A X = Z B, measured_i = Z flange_i X, with an optimality certificate.

    ::

        minimize  sum_i |r_i|^2,   |r_i|^2 = |Z_R'y_i - A_R,i t - A_t,i - u|^2 / sigma_position^2
                                             + |B_R,i X_R' - Z_R A_R,i|^2 / (2 sigma_orientation^2)

    over rotations Z_R, X_R and translations t = X_t, u = Z_R'Z_t. The translations are eliminated exactly; the
    rotations are relaxed to a moment matrix (`relax`).

    ``flange`` (N, 4, 4) are transforms of the flange in the robot's base [m], ``measured`` (N, 4, 4) of the tool in the
    instrument's frame, NaN for rotations that were not measured; or positions (N, 3). ``sigma`` are the standard
    deviations of a position [m] and an orientation [rad], each a number or (N,): those of the instrument and of the
    nominal robot together. The tool is ``expected`` (3,) in the flange frame [m] with standard deviation ``spread``
    [m]; directions that the measurements do not determine always stay there. InputError for fewer than three
    measurements, and invalid transforms.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> arm = ro.load("paper_arm").problem
    >>> flange = ro.robot.forward_kinematics(arm.robot, arm.data.q)
    >>> base, tool = np.eye(4), np.eye(4)
    >>> base[:3, 3], tool[:3, 3] = [2.0, 0.0, 0.5], [0.0, 0.02, 0.06]
    >>> start = ro.problem.certified_hand_eye(flange, base @ flange @ tool)
    >>> bool(np.abs(start.base - base).max() < 1e-6), bool(np.abs(start.tool - tool).max() < 1e-6), start.certified
    (True, True, True)
    """
    flange, measured, turned = _checked(flange, measured)
    N = len(flange)
    deviations = np.stack([np.broadcast_to(np.asarray(each, dtype=float), N) for each in sigma], axis=1)
    if not (np.isfinite(deviations).all() and (deviations > 0).all()):
        raise InputError("sigma", "a number that is not positive", "standard deviations of position and orientation")
    J = _equations(flange, measured, turned, deviations, np.asarray(expected, dtype=float)[:3], spread)
    # |T v| = |J v|, T upper: its last rows are the least over translations (a Schur complement), its first say which
    T = np.asarray(np.linalg.qr(J, mode="r"))
    best = smallest(T[LINEAR:, LINEAR:])
    t, u = solve_triangular(T[:LINEAR, :LINEAR], -T[:LINEAR, LINEAR:] @ lifted(best.rotations)).reshape(2, 3)
    first, *last = best.rotations
    gap = (best.value - best.bound) / (1 + best.value)
    weakest = float(np.linalg.eigvalsh(best.information)[0])
    uncertainty = float(1 / np.sqrt(weakest)) if weakest > 0 else float(np.inf)
    radius = best.radius(float(chdtri(LINEAR + 3 * len(best.rotations), AS_WELL)))
    cause = ""
    if uncertainty > UNKNOWN:
        rotations = f"the rotations (about {uncertainty:.2g} rad)"
        cause = f"the measurements do not determine {rotations}: rotations about two axes would"
    elif gap > GAP:
        cause = f"the relaxation is not tight: another start may be up to {100 * gap:.2g} % better"
    elif radius > FAR:
        cause = f"another start, up to {radius:.2g} rad away, may fit as well: measure more or other poses to decide"
    return CertifiedStart(
        base=rigid(first, first @ u), tool=rigid(last[0].T if last else np.eye(3), t), cost=best.value,
        bound=best.bound, gap=gap, rank_ratio=best.rank_ratio, uncertainty=uncertainty, radius=radius,
        certified=not cause, reason=cause or f"globally optimal (relative optimality gap at most {GAP:g})",
    )  # fmt: skip


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
    if measured.ndim == 2:
        measured = rigid(np.full((3, 3), np.nan), measured)
    turned = np.asarray(~np.isnan(measured[:, :3, :3]).any(axis=(1, 2)))
    poses = np.where(turned[:, None, None], measured, rigid(np.eye(3), measured[:, :3, 3]))
    if not (np.isfinite(flange).all() and np.isfinite(poses).all()):
        raise InputError("transforms", "numbers that are not finite", "finite numbers")
    for R in (flange[:, :3, :3], poses[:, :3, :3]):
        off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        wrong = np.flatnonzero((off > 1e-3) | (np.linalg.det(R) < 0))
        if len(wrong):
            found = f"a matrix that violates R R' = I by {off[wrong[0]]:.2g}"
            raise InputError(f"pose {wrong[0] + 1}", found, "a rotation")
    return flange, poses, turned


# --- closed loops -------------------------------------------------------------------------------------------------


def _equations(
    flange: Array, measured: Array, turned: np.ndarray, sigma: Array, expected: Array, spread: float
) -> Array:
    """Return J (12 N + 3, n): the loops ``measured = base flange tool`` and the expected t have residuals J v.

    ::

        v = (t, u, 1, vec Z_R, vec X_R'),  rotations' rows first,    t = X_t,  u = Z_R' Z_t
        (Z_R' y - A_R t - A_t - u) / sigma_position
        (B_R X_R' - Z_R A_R) / (sqrt(2) sigma_orientation)    if the orientation was measured

    The norm of the last is the angle between the two, up to third order. X_R is left out without orientations.
    """
    N = len(flange)
    eye = np.eye(3)
    A = flange[:, :3, :3]
    one = LINEAR
    of_base = slice(LINEAR + 1, LINEAR + 10)
    J = np.zeros((N, 12, LINEAR + 1 + 9 * (1 + turned.any())))
    J[:, :3, :3] = -A
    J[:, :3, 3:6] = -eye
    J[:, :3, one] = -flange[:, :3, 3]
    J[:, :3, of_base] = np.einsum("nb,ac->nabc", measured[:, :3, 3], eye).reshape(N, 3, 9)
    if turned.any():
        J[:, 3:, of_base] = -np.einsum("ai,njb->nabij", eye, A).reshape(N, 9, 9)
        J[:, 3:, of_base.stop :] = np.einsum("nai,bj->nabij", measured[:, :3, :3], eye).reshape(N, 9, 9)
    J[:, :3] /= sigma[:, 0, None, None]
    J[:, 3:] *= (turned / (np.sqrt(2) * sigma[:, 1]))[:, None, None]
    certainty = max(1 / spread, RIDGE * float(np.sqrt(np.sum(sigma[:, 0] ** -2))))
    prior = np.zeros((3, J.shape[2]))
    prior[:, :3] = certainty * eye
    prior[:, one] = -certainty * expected
    return np.vstack([*J, prior])


# --- quadratic forms of rotations: relaxation, rounding, refinement and a lower bound -----------------------------

TOLERANCE = 1e-8  # of gap and feasibility, in units of the form; rotations and multipliers are refined afterwards
SPREAD = 1e-3
"""Second over first eigenvalue above which moments mix several rotations, and some are drawn from them."""
CROSS = -np.cross(np.eye(3)[:, None], np.eye(3))  # the matrices of the cross products e_a x


@lru_cache
def rotation_constraints(count: int) -> Array:
    """Return C (c, n, n) with x'C x = 0 for x = (1, vec R_1, ..., vec R_count), rows first, and no other quadratic.

    These are the twenty independent ones of every rotation: R R' = 1 and R'R = 1, where one diagonal entry follows from
    the others, and each row as the cross product of the next two, so that R is right-handed.
    """
    C = np.zeros((20 * count, 1 + 9 * count, 1 + 9 * count))
    number = 0
    for k in range(count):
        at = 1 + 9 * k + np.arange(9).reshape(3, 3)
        orthonormal = [(entries, i, j) for entries in (at, at.T) for i in range(3) for j in range(i, 3)]
        for entries, i, j in orthonormal[:-1]:  # both sums of squares are three
            C[number, entries[i], entries[j]] = 1.0
            C[number, 0, 0] = -float(i == j)
            number += 1
        for i in range(3):
            p, q, r = np.roll(at, -i, axis=0)
            for a in range(3):
                b, c = (a + 1) % 3, (a + 2) % 3
                C[number, [p[b], p[c], 0], [q[c], q[b], r[a]]] = [1.0, -1.0, -1.0]
                number += 1
    return (C + C.swapaxes(1, 2)) / 2


def relax(Q: Array) -> tuple[Array, Array]:
    """Return moments (n, n) and multipliers (20 k,) of the relaxation of min x'Q x over x = (1, vec R_1, ..., vec R_k).

    ::

        maximize    bound
        subject to  Q - bound e e' - sum_j multipliers_j C_j  positive semidefinite,    e = (1, 0, ..., 0)

    For rotations the left side of the constraint times x x' is x'Q x - bound >= 0: no rotation has a smaller value. The
    constraint's multiplier is the moment matrix, which minimizes <Q, M> over all positive semidefinite M with M_00 = 1
    and <C_j, M> = 0; it is x x' if the relaxation is tight.
    """
    clarabel = import_module("clarabel")
    n = len(Q)
    first = np.zeros((1, n, n))
    first[0, 0, 0] = 1.0
    columns, rows = np.tril_indices(n)
    root = np.where(rows == columns, 1.0, np.sqrt(2))  # the cone's norm is the matrix norm
    C = np.concatenate([first, rotation_constraints((n - 1) // 9)])
    A = scipy.sparse.csc_matrix((root * C[:, rows, columns]).T)
    size = float(np.abs(Q).max()) or 1.0
    b = root * Q[rows, columns] / size
    q = np.zeros(A.shape[1])
    q[0] = -1.0
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.iterative_refinement_enable = False  # takes half of the time, for digits that are refined later
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
    P = scipy.sparse.csc_matrix((len(q), len(q)))
    solution = clarabel.DefaultSolver(P, q, A, b, [clarabel.PSDTriangleConeT(n)], settings).solve()
    M = np.zeros((n, n))
    M[rows, columns] = M[columns, rows] = np.array(solution.z) / root
    return M, size * np.array(solution.x)[1:]


@dataclass(frozen=True, eq=False)
class Smallest:
    """The rotations (k, 3, 3) that minimize |L x|^2 over x = (1, vec R_1, ..., vec R_k), and what is known of that."""

    rotations: Array
    value: float
    bound: float  # no rotations have a smaller value, up to rounding
    rank_ratio: float  # second over first eigenvalue of the moment matrix: zero for rank one
    information: Array  # (3k, 3k) half the Hessian by rotations [1/rad^2]
    steepness: float  # c: every x has at least bound + c |x_other|^2, x_other being the part perpendicular to the best

    def radius(self, excess: float) -> float:
        """Return the angle [rad] from the best beyond which every value exceeds the smallest by more than ``excess``.

        Both x have the length n = 1 + 3 k, squared, so that c = x'x_best / n has 1 - c^2 = |x_other|^2 / n, and
        |x - x_best|^2 = 2 n (1 - c), of which one rotation has 8 sin^2(angle / 2). A trace of -1 or more keeps c above
        (1 - k) / n.
        """
        if self.steepness <= 0:
            return float(np.pi)
        k = len(self.rotations)
        n = 1 + 3 * k
        square = 1 - (excess + self.value - self.bound) / (self.steepness * n)
        if square <= ((1 - k) / n) ** 2:
            return float(np.pi)
        apart = 2 * n * (1 - np.sqrt(square))
        return float(2 * np.arcsin(min(1.0, np.sqrt(apart / 8))))


def smallest(L: Array) -> Smallest:
    """Return the best rotations that the relaxation yields, with its bound.

    ::

        Q - f e e' - sum_j multipliers_j C_j  >=  mu 1,    mu <= 0
        x'Q x  >=  f + mu |x|^2  =  f + mu (1 + 3 k)    for every x = (1, vec R_1, ..., vec R_k)

    The multipliers are the solver's, with the least change that makes the left side vanish on the rotations found, and
    f is their value. The bound then does not depend on the solver's accuracy: mu is the smallest eigenvalue.
    """
    Q = L.T @ L
    moments, multipliers = relax(Q)
    eigenvalues, vectors = np.linalg.eigh(moments)
    rank_ratio = float(abs(eigenvalues[-2]) / eigenvalues[-1])
    lifts = [moments[:, 0]]  # the mean rotations of the moments
    if rank_ratio > SPREAD:  # and some drawn from them
        normal = np.random.default_rng(0).normal(size=(20, len(eigenvalues)))
        lifts += [*(normal * np.sqrt(np.maximum(eigenvalues, 0.0)) @ vectors.T)]
    rounded = [_refined(L, proper(np.copysign(1.0, lift[0]) * lift[1:].reshape(-1, 3, 3))) for lift in lifts]
    best = min(rounded, key=lambda R: _value(L, R))
    value = _value(L, best)
    x = lifted(best)
    C = rotation_constraints(len(best))
    S = Q - np.tensordot(multipliers, C, axes=1)
    S[0, 0] -= value
    moves = np.linalg.lstsq((C @ x).T, S @ x, rcond=1e-12)[0]
    eigenvalues = np.linalg.eigvalsh(S - np.tensordot(moves, C, axes=1))
    bound = value + min(0.0, float(eigenvalues[0])) * float(x @ x)
    steepness = max(0.0, float(eigenvalues[1]))
    return Smallest(best, value, bound, rank_ratio, _derivatives(L, best)[1] / 2, steepness)


def lifted(rotations: Array) -> Array:
    """Return x = (1, vec R_1, ..., vec R_k), rows first."""
    return np.concatenate([[1.0], rotations.ravel()])


def _value(L: Array, rotations: Array) -> float:
    return float(np.sum((L @ lifted(rotations)) ** 2))


def _derivatives(L: Array, rotations: Array) -> tuple[Array, Array]:
    """Return first (3k,) and second derivatives (3k, 3k) of |L x|^2 by rotation vectors w, R_i exp([w_i] x)."""
    k = len(rotations)
    residual = L @ lifted(rotations)
    G = (2 * L.T @ residual)[1:].reshape(k, 3, 3)
    D = np.zeros((L.shape[1], 3 * k))
    B = np.zeros((3 * k, 3 * k))
    for i, R in enumerate(rotations):
        own = slice(3 * i, 3 * i + 3)
        D[1 + 9 * i : 10 + 9 * i, own] = (R @ CROSS).reshape(3, 9).T
        M = R.T @ G[i]
        # the second order of exp([w] x) is ([w] x)^2 / 2 = (w w' - |w|^2) / 2
        B[own, own] = (M + M.T) / 2 - np.trace(M) * np.eye(3)
    J = L @ D
    return 2 * J.T @ residual, 2 * J.T @ J + B


def _refined(L: Array, rotations: Array) -> Array:
    """Return the stationary rotations to which Newton's steps lead, uphill directions turned, long steps halved."""
    value = _value(L, rotations)
    for _ in range(50):
        slope, curvature = _derivatives(L, rotations)
        eigenvalues, V = np.linalg.eigh(curvature)
        sizes = np.maximum(np.abs(eigenvalues), 1e-14 * np.abs(eigenvalues).max() + 1e-300)
        step = -V @ ((V.T @ slope) / sizes)
        step *= min(1.0, 1.0 / max(np.linalg.norm(step), 1e-300))
        for halved in step / 2.0 ** np.arange(12)[:, None]:
            turn = scipy.spatial.transform.Rotation.from_rotvec(halved.reshape(-1, 3)).as_matrix()
            candidate = proper(rotations @ turn)
            lower = _value(L, candidate)
            if lower < value:
                break
        else:
            return rotations
        rotations = candidate
        value = lower
        if np.linalg.norm(step) < 1e-13:  # rad
            break
    return rotations
