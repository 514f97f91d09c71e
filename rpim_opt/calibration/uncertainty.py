"""Uncertainty of identified parameters and of predicted positions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.special import fdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import Tabled, listed
from rpim_opt.bayes.hyperparameters import sessions_log_std
from rpim_opt.bayes.outliers import by_block
from rpim_opt.bayes.transmission import series
from rpim_opt.calibration.covariance import coverage_factor, noise_covariances, position_noise, row_dof
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.pose import position
from rpim_opt.data.record import CONFIDENCE, Fit, HeldOut
from rpim_opt.problem.multi_robot import identifying_sessions
from rpim_opt.robot.parameters import of_session
from rpim_opt.robot.terms import transmission

UNINFORMATIVE = 1e4  # variance of an unknown session over a reading's, above which an interval is useless
RARE = 0.01  # probability that data like the calibration's have any named row


@dataclass(frozen=True, eq=False, repr=False)
class Uncertainty(Tabled):
    """Uncertainty of a calibration by the law of propagation (JCGM 100) at its final linearization.

    With A = U diag(s) V' whitened and scaled, weight w and the noise level sigma::

        noise      sigma^2 S V diag(s^2 / (s^2 + w)^2) V' S          variation between data sets of this kind
        prior      sigma^2 S V diag(w / (s^2 + w)^2) V' S            mean squared bias by the penalty
        total      noise + prior = sigma^2 S (A'A + w)^-1 S          if deviations are as large as the penalty expects

    If hyperparameters were estimated, ``prior`` also includes their uncertainty (Kass and Steffey 1989), the excess
    width of Student's tails over the normals that represent them, and model errors, as far as halves of the joints'
    ranges predict each other worse than by chance (`Learned.drift`).

    It holds for a squared loss, or for the inliers of a robust loss, and a squared penalty; InputError for other
    penalties (lasso). Intervals disregard active bounds of the parameters in ``result.actively_constrained``.

    Parameters
    ----------
    result
        The calibration.
    confidence
        Confidence of the intervals, between 0 and 1.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> uncertainty = ro.calibration.Uncertainty(result, confidence=0.95)
    >>> print(f"{result.noise_dof:.1f} degrees of freedom, k = {uncertainty.coverage_factor:.2f}")
    93.5 degrees of freedom, k = 1.99
    >>> list(uncertainty.to_frame().columns)
    ['parameter', 'unit', 'value', 'u_noise', 'u_prior', 'u', 'U', 'actively_constrained']
    """

    result: Outcome
    confidence: float = 0.95

    def __post_init__(self) -> None:
        coverage_factor(self.result.fit_covariance.residual_dof, self.confidence)  # raises if there is no interval

    @property
    def coverage_factor(self) -> float:
        """Coverage factor k, the Student-t quantile at (1 + confidence) / 2 with at least one degree of freedom."""
        return float(coverage_factor(self.result.noise_dof, self.confidence))

    @property
    def expanded(self) -> Array:
        """Expanded uncertainties U = k u (n,) [SI] of the deviations: half-widths of their intervals."""
        return self.coverage_factor * np.sqrt(np.diag(self.result.covariance))

    def _short(self) -> str:
        return f"at confidence {self.confidence:g} of {repr(self.result).strip('<>')}"

    def _frame_rows(self) -> list[dict[str, Any]]:
        """Return the budget in GUM's terms: values, standard uncertainties u by what causes them, and U = k u."""
        free = self.result.problem.parameters.free
        fit = self.result.fit_covariance
        noise, prior, both = (np.sqrt(np.diag(C)) for C in (fit.noise, fit.prior, fit.covariance))
        columns = {"value": free.values(self.result.x), "u_noise": noise, "u_prior": prior, "u": both}
        columns["U"] = self.expanded
        constrained = (both == 0) | np.isin(free.names, self.result.actively_constrained)
        rows = free.rows(columns)
        return [{**row, "actively_constrained": bool(held)} for row, held in zip(rows, constrained, strict=True)]

    def _notes(self) -> list[str]:
        lines = [
            self.result.noise_test().verdict,
            f"k = {self.coverage_factor:.2f}; {self.result.noise_dof:.1f} degrees of freedom.",
        ]
        if any(row["actively_constrained"] for row in self._frame_rows()):
            lines.append("At an active bound or constraint: the interval is conditional on it.")
        return lines


def position_budget(result: Outcome, q: Array, marker: str | None = None) -> dict[str, Array]:
    """Return the contributions to u^2 (N,) [m^2] of the positions reached at q (N, dof), summed over all axes."""
    fit = result.fit_covariance
    there = result.problem.sample().measuring(q, position, marker, covariance=position_noise(result.problem))
    J = there.jacobian(result.x).reshape(len(q), 3, -1)
    prior = np.einsum("nij,jk,nik->n", J, fit.prior, J)
    drift = np.zeros(len(q)) if fit.drift is None else np.sum((J @ fit.drift) ** 2, axis=(1, 2))
    robot = np.trace(noise_covariances(there, result.variance_factor).robot[0], axis1=1, axis2=2)
    return {
        "measurement noise in the parameters": np.einsum("nij,jk,nik->n", J, fit.noise, J),
        "prior, in combinations that the data hardly identify": prior - drift,
        "estimated prior scales and variance components": drift,
        "repeatability of the robot": np.broadcast_to(robot, len(q)),
    }


class TransmissionError(NamedTuple):
    """Transmission error of a joint (from 1) at values ``q`` (K,), and its standard uncertainty [rad].

    Angles count as the controller's joint value, or as the model's for a joint coupled to several; ``called`` says
    which. ``measured`` are the least and largest measured value [rad], ``effect`` is the RMS change of measured lengths
    by the error [m], ``names`` are those of its coefficients.
    """

    joint: int
    called: str
    q: Array
    error: Array
    standard: Array
    measured: tuple[float, float]
    effect: float
    names: tuple[str, ...]

    def __str__(self) -> str:
        return f"joint {self.called}"

    @property
    def inside(self) -> np.ndarray:
        """Which values (K,) are within the measured range."""
        return (self.q >= self.measured[0]) & (self.q <= self.measured[1])

    @property
    def rms(self) -> float:
        """RMS within the measured range [rad]."""
        return float(np.sqrt(np.mean(self.error[self.inside] ** 2)))


def transmission_errors(result: Outcome) -> list[TransmissionError]:
    """Return the transmission errors of the joints at four values per period of the finest harmonic; empty if none."""
    free = result.problem.parameters.free
    if not free.of_curves.any():
        return []
    C = result.known_covariance
    part = next(iter(result.problem.rows()))
    J = part.jacobian(result.x)
    length = np.zeros(len(J), dtype=bool)
    for stack in part.stacks(joints=False):
        length[stack.index] = stack.length
    rows = max(len(np.unique(part.owners[length])), 1)
    at = part.joint_values
    if result.record.earlier:  # earlier measurements count, at the corners of their ranges
        at = np.vstack([at, *(ends @ part.robot.joint_map.T for ends in result.ranges.values())])
    errors = []
    for curve in part.robot.model.curves:
        names = transmission(curve).names(curve.joint)
        place = np.array([free.names.index(name) for name in names])
        q = curve.centre + curve.period * np.linspace(-0.5, 0.5, 4 * curve.harmonics + 1)
        columns: Array = series([curve._replace(joint=1)], q[:, None], np.ones((len(q), 1)))
        variance = np.full(len(q), np.nan)
        if C is not None:
            variance = np.sum((columns @ C[np.ix_(place, place)]) * columns, axis=1)
        effect = float(np.linalg.norm(J[np.ix_(length, place)] @ result.x[place]) / np.sqrt(rows))
        row = part.robot.joint_map[curve.joint - 1]
        own = np.flatnonzero(row)
        joint, factor = (int(own[0]) + 1, row[own[0]]) if len(own) == 1 else (curve.joint, 1.0)
        called = part.robot.joint(joint - 1) if len(own) == 1 else f"{joint} of the model (coupled)"
        table = np.array([q / factor, columns @ result.x[place] / factor, np.sqrt(variance) / abs(factor)])
        q, error, standard = table[:, :: int(np.sign(factor))]
        low, high = sorted((end(at[:, curve.joint - 1]) / factor).item() for end in (np.min, np.max))
        errors.append(TransmissionError(joint, called, q, error, standard, (low, high), effect, names))
    return errors


def monte_carlo(result: Outcome, draws: int = 200, seed: int = 0) -> Array:
    """Return deviations (draws, n) [SI] identified from data simulated at the fit with noise of the observed level.

    It checks the law of propagation (JCGM 101), with bounds and any loss: compare the spread of the draws with
    `FitCovariance.noise`. Every draw solves the linearized program at the same weight.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> spread = ro.calibration.monte_carlo(result, draws=500).std(axis=0)
    >>> stated = np.sqrt(np.diag(result.fit_covariance.noise))
    >>> bool(np.abs(spread / stated - 1).max() < 0.2)  # 500 draws tell each to 3 %
    True
    """
    rng = np.random.default_rng(seed)
    program = result.program
    fitted = program.model.A @ result.z
    if result.known_covariance is not None:
        variance = result.fit_covariance.noise_variance
    else:  # unknown degrees of freedom: as many as parameters
        squares = np.sum((fitted - program.model.b) ** 2)
        variance = squares / max(program.model.equations - len(result.z), 1)
    level = np.sqrt(variance)
    solutions = []
    for _ in range(draws):
        b = fitted + level * rng.normal(size=len(fitted))
        drawn = program.on(program.model.with_values(b))
        solutions.append(drawn.path([result.weight])[0].z)
    return np.array(solutions) * result.problem.parameters.free.scale


def held_out_errors(result: Outcome, data: Dataset, counted: np.ndarray | None = None) -> HeldOut:
    """Return the errors of a calibration on measurements that it did not use, with their prediction intervals.

    Coverage and fit are those of the ``counted`` rows (N,), by default all. If sessions are apart, rows of an
    unmeasured session have no interval. The fit is by the joint prediction of r, with the covariances V of readings and
    C of the deviations, which all rows share::

        chi^2 = r' (V + A C A')^-1 r = |u|^2 - u' B (I + B' B)^-1 B' u,    u = V^-1/2 r,    B = V^-1/2 A C^1/2
    """
    N = len(data)
    sigmas, allowed = np.full((2, N), np.nan)
    errors = result.nominal_errors(data), result.errors(data), result.errors(data, "angle")
    held = HeldOut(data.label, len(result.problem.labels), *errors, sigmas, allowed)
    C = result.known_covariance
    if C is None:
        return held
    counted = np.ones(N, dtype=bool) if counted is None else counted
    inside: list[np.ndarray] = []
    whitened: list[np.ndarray] = []
    problem = identifying_sessions(result.problem.on(data))
    scale = problem.parameters.free.scale
    new = scale[len(C) :]  # of sessions that the calibration does not know
    parts = by_block(problem, np.column_stack(problem.slopes(np.append(result.x, np.zeros_like(new)))))
    C = np.asarray(block_diag(C, np.diag(new**2)), dtype=float)
    known = np.isfinite(np.diag(C))
    C = np.where(np.outer(known, known), C, 0.0)
    s, U = np.linalg.eigh(C / np.outer(scale, scale))
    root = scale[:, None] * U * np.sqrt(np.maximum(s, 0.0))
    freedom = np.inf
    for (block, part), reading in zip(parts, noise_covariances(problem, result.variance_factor).reading, strict=True):
        k = len(block.measurement.components)
        r, A, V = part[:, :, 0], part[:, :, 1:], np.broadcast_to(reading, (len(part), k, k))
        S = A @ C @ A.transpose(0, 2, 1) + V
        of_new = A[:, :, len(result.x) :] * new
        session = of_new @ of_new.transpose(0, 2, 1)
        dof = row_dof(result.noise_dof, sessions_log_std(result.learned), S, session)
        squares = np.sum(r * np.linalg.solve(S, r[:, :, None])[:, :, 0], axis=1)
        predicted = (A[:, :, ~known] == 0).all(axis=(1, 2))
        predicted &= np.einsum("nkk->n", session - UNINFORMATIVE * V) < 0
        sigmas[block.row] = np.where(predicted, np.sqrt(squares), np.nan)
        limit = np.sqrt(k * fdtri(k, dof, 1 - RARE / N))
        allowed[block.row] = np.where(predicted, limit, np.nan)
        lengths = np.array([d in ("length", "pixel") for d in block.measurement.components.values()])
        factor = coverage_factor(dof, CONFIDENCE)[:, None]
        within = np.abs(r) <= factor * np.sqrt(np.einsum("nkk->nk", S))
        judged = predicted & counted[block.row]
        inside.append(within[judged][:, lengths].ravel())
        rows = np.linalg.solve(
            np.linalg.cholesky(V[judged]), np.concatenate([r[judged, :, None], A[judged] @ root], axis=2)
        )
        whitened.append(rows.reshape(-1, 1 + len(root)))
        freedom = min(freedom, float(dof[judged].min(initial=np.inf)))
    covered, whole = np.concatenate(inside), np.concatenate(whitened)
    if not len(whole):
        return held
    u, B = whole[:, 0], whole[:, 1:]
    squares = u @ u - (B.T @ u) @ np.linalg.solve(np.eye(len(root)) + B.T @ B, B.T @ u)
    share = float(covered.mean()) if len(covered) else None
    return replace(held, coverage=share, fit=Fit.of(float(squares), len(u), freedom))


def unregistered(result: Outcome, data: Dataset, held: HeldOut) -> str:
    """Return a sentence on sessions of unknown registration, whose rows have no interval; empty if there are none."""
    if result.no_intervals or not any(map(of_session, result.problem.parameters.free.names)):
        return ""
    sessions = {*data.session[np.isnan(held.sigmas)]} - {*result.problem.sample().data.session}
    named = listed(sorted(f"'{name}'" for name in sessions))
    return named and f"The registration of session {named} is unknown: register its rows (--register)."
