"""Influence of every configuration on the parameters, and the expected improvement of the robot."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import TINY, Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import Tabled
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.basics.units import display
from rpim_opt.calibration.covariance import coverage_factor
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.convex.robust_loss import QuadraticModel
from rpim_opt.data.record import CONFIDENCE
from rpim_opt.problem.blocks import in_parts
from rpim_opt.problem.linear import RANK_TOLERANCE, LinearModel
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.workspace import bounding, moved, predicted
from rpim_opt.robot.kinematics import forward_kinematics, numeric_frame

ALONE = 1e-9  # share of a direction known without a configuration, below which that configuration alone determines it
UNIDENTIFIABLE = 1e-9  # smaller standard deviations, in scales, are rounding: the parameter is unidentifiable
IMPROVED = 0.9  # ratio of predicted to nominal error above which a calibration is no improvement
BALANCED = 1e-4  # gradient of weighted equations and penalty at the solution, relative to that of the data at nominal


@dataclass(frozen=True, eq=False, repr=False)
class Influence(Tabled):
    """Influence of C configurations on n parameters.

    ``label`` and ``configuration`` (C,) are those of their first rows, ``parameters`` and ``dimensions`` of the
    parameters. ``leverage`` (C,) is the trace of a configuration's block of the influence matrix; its sum is the fit's
    degrees of freedom. ``cook`` (C,) is Cook's distance (1977): the change of all predictions without the
    configuration, in units of the noise and per degree of freedom; about 1 means that the result depends on it.
    ``change`` (C, n) are the changes of the parameters [SI], NaN if no other configuration determines one;
    ``deviation`` (n,) their standard deviations from the noise [SI], zero for unidentifiable ones; ``weight`` (C,) the
    final weight of the configuration in a robust loss, relative to a squared one.
    """

    label: tuple[str, ...]
    configuration: np.ndarray
    parameters: tuple[str, ...]
    dimensions: tuple[str, ...]
    leverage: Array
    cook: Array
    change: Array
    deviation: Array
    weight: Array

    def _short(self) -> str:
        most = int(np.argmax(self.cook))
        return f"of {len(self.label)} configurations: {self.label[most]} has Cook's distance {self.cook[most]:.2g}"

    def _frame_rows(self) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        units = [display(dimension) for dimension in self.dimensions]
        for k, label in enumerate(self.label):
            row: dict[str, Any] = {"label": label, "configuration": int(self.configuration[k])}
            row |= {"leverage": float(self.leverage[k]), "cook": float(self.cook[k]), "weight": float(self.weight[k])}
            for name, (unit, si), change in zip(self.parameters, units, self.change[k], strict=True):
                row[f"{name}_{unit}"] = float(change / si)
            rows.append(row)
        return rows


@one_blas_thread  # small matrices: several threads would wait more than compute
def influence(result: Outcome) -> Influence:
    """Return the change of every parameter when one configuration is left out.

    At the solution z the data's equations A z ~ b with their weights W and the penalty w |L z - c|^2 have the
    information H = A'WA + w L'L. Without configuration k, whose weighted equations are A_k and residuals r_k,

        z_-k - z = H^-1 A_k' (I - A_k H^-1 A_k')^-1 r_k

    which is exact for the last linearization at the same weight, and needs one pass over the equations for all of them.
    With a robust loss, W are its final weights; they are held fixed, so that omitting a configuration changes no other
    weight. Parameters at a bound stay there.

    InputError for a penalty that is not quadratic, and a loss without weights of equations (minimax depends on a few).

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> found = ro.calibration.influence(ro.calibrate(ro.load("blunders").problem, ro.tikhonov, weight=1.0))
    >>> [found.label[k] for k in np.argsort(-found.cook)[:3]]  # blunders
    ['c43', 'c14', 'c1']
    """
    if not result.program.linear_penalty:
        raise result.no_covariance("k_fold accepts any formulation")
    free = result.problem.parameters.free
    model, first_label = _equations(result)
    numbers, which, equations = np.unique(model.group, return_inverse=True, return_counts=True)
    squares = (model.A @ result.z - model.b) ** 2
    formulation = result.formulation
    if not result.squared_loss:  # squares with the final weights of the loss
        model, _ = QuadraticModel(formulation.loss, formulation.name, formulation.loss_over)(model, result.z)
    A, b = model.qr_factor[:, :-1], model.qr_factor[:, -1]
    L, c = np.zeros((0, len(free))), np.zeros(0)
    form = result.program.penalty_form
    if form is not None:
        root = np.sqrt(result.penalty_weight)
        L, c = root * form.matrix, root * form.c
    at_bound = {each.name for each in result.active_bounds}
    moving = np.array([name not in at_bound for name in free.names])
    gradient = A.T @ (A @ result.z - b) + L.T @ (L @ result.z - c)
    if np.linalg.norm(gradient[moving]) > BALANCED * np.linalg.norm(A.T @ b):
        squares = "a squared loss, or a robust one that is solved by reweighted squares (Huber's)"
        accepted = f"{squares}; and no active constraints other than bounds"
        raise InputError("influence", f"formulation '{formulation.name}'", accepted)
    T = np.zeros((len(free), len(A) + len(L)))  # H^-1 = T T'
    T[moving] = np.linalg.pinv(np.vstack([A, L])[:, moving], rcond=RANK_TOLERANCE)
    residual = model.A @ result.z - model.b
    weight = np.divide(residual**2, squares, out=np.ones(len(squares)), where=squares > 0)
    leverage, change = _left_out(model.A @ T, residual, equations)
    change = change @ T.T
    used = float(np.sum(leverage))
    spare = len(residual) - used
    variance = float(residual @ residual) / spare if spare > 1e-6 else 1.0
    spread = np.sqrt(variance * np.sum((A @ T @ T.T) ** 2, axis=0))
    spread[spread < UNIDENTIFIABLE] = 0.0
    return Influence(
        label=tuple(first_label[number] for number in numbers),
        configuration=numbers,
        parameters=free.names,
        dimensions=free.dimensions,
        leverage=leverage,
        cook=np.sum((change @ A.T) ** 2, axis=1) / (max(used, TINY) * max(variance, TINY)),
        change=change * free.scale,
        deviation=spread * free.scale,
        weight=np.bincount(which, weight) / equations,
    )


def _equations(result: Outcome) -> tuple[LinearModel, dict[int, str]]:
    """Return the last linearization, sorted by configuration, and the label of every configuration's first row."""
    parts = list(in_parts(result.problem).rows())
    models = [part.linearize(result.x) for part in parts]
    A, b, group = (np.concatenate([getattr(each, name) for each in models]) for name in ("A", "b", "group"))
    order = np.argsort(group, kind="stable")
    labels: dict[int, str] = {}
    for part in parts:
        labels |= dict(zip(part.data.configuration[::-1], part.data.label[::-1], strict=True))
    return replace(models[0], A=A[order], b=b[order], group=group[order]), labels


def _left_out(Q: Array, residual: Array, equations: np.ndarray) -> tuple[Array, Array]:
    """Return leverages (C,), and changes (C, k) by Q (m, k) of leaving out so many ``equations`` (C,) in turn."""
    leverage = np.empty(len(equations))
    change = np.full((len(equations), Q.shape[1]), np.nan)
    ends = np.cumsum(equations)
    for k, (start, end) in enumerate(zip(ends - equations, ends, strict=True)):
        q = Q[start:end]
        hat = q @ q.T
        leverage[k] = np.trace(hat)
        spare = np.eye(len(hat)) - hat
        if np.linalg.eigvalsh(spare)[0] >= ALONE:
            change[k] = q.T @ np.linalg.solve(spare, residual[start:end])
    return leverage, change


@dataclass(frozen=True)
class Improvement:
    """Expected position errors of the flange [m] over the joint ranges, with base and tool fitted.

    RMS ``before`` (nominal parameters) and ``after`` (identified ones); ``within`` is the limit of 95 % of the errors
    along any axis, at the least determined configuration.
    """

    before: float
    after: float
    within: float

    @property
    def improves(self) -> bool:
        """Whether the identified parameters are expected to be significantly better than the nominal ones."""
        return self.after < IMPROVED * self.before


def improvement(result: Outcome) -> Improvement | None:
    """Return the expected position errors of the flange, nominal and identified; None if undetermined.

    With the deviations x, their derivatives D of W positions over the joint ranges, less the part that fitting base and
    tool removes, N the covariance of x by noise and B the mean square of the penalty's bias::

        after^2  = tr(D (N + B) D') / W
        before^2 = (|D x|^2 - tr(D N D') + tr(D B D')) / W

    N is the jackknife's, from leaving out every configuration in turn, if that exceeds the noise's prediction: rows of
    a configuration then have common errors, of robot or camera, and more of them do not help.

    For a squared penalty or none, and one robot with joint limits.

    >>> import rpim_opt as ro
    >>> found = ro.calibration.improvement(ro.load("position").calibrate())
    >>> found.improves, found.before > 10 * found.after
    (True, True)
    """
    try:
        noise, prior = result.fit_covariance.noise, result.fit_covariance.prior
        D, directions = _slopes(result)
        change = influence(result).change
    except InputError:
        return None
    if np.isfinite(change).all():
        scale = result.problem.parameters.free.scale
        jackknife = change.T @ change * (len(change) - 1) / len(change)
        if np.trace(jackknife / np.outer(scale, scale)) > np.trace(noise / np.outer(scale, scale)):
            noise = jackknife
    count = len(directions)
    by_noise = float(np.sum((D @ noise) * D))
    by_prior = float(np.sum((D @ prior) * D))
    before = float(np.sum((D @ result.x) ** 2)) - by_noise + by_prior
    each = np.einsum("nij,jk,nik->ni", directions, noise + prior, directions)
    factor = coverage_factor(result.noise_dof, CONFIDENCE)
    return Improvement(
        before=float(np.sqrt(max(before, 0.0) / count)),
        after=float(np.sqrt((by_noise + by_prior) / count)),
        within=float(factor * np.sqrt(each.max())),
    )


def _slopes(result: Outcome) -> tuple[Array, Array]:
    """Return the slopes of flange positions less what fitting base and tool takes back, (3 W, n) and (W, 3, n)."""
    problem = result.problem.sample()
    parameters = result.problem.parameters
    tools = np.array([name.startswith("tool_") for name in parameters.names])
    nominal = np.where(tools, 0.0, parameters.nominal)
    at = np.where(tools[parameters.identified], 0.0, result.x)
    there = CalibrationProblem(problem.robot, replace(parameters, nominal=nominal), problem.data)
    q = bounding(there, None, None)
    p = predicted(there, q, None, at=at).position
    J = moved(there, q, None, at=at).slope
    D = J.reshape(-1, J.shape[2])
    p = p - p.mean(axis=0)
    turning = np.cross(np.eye(3), p[:, None])
    base = numeric_frame(nominal[parameters.frame("base_")])
    along = base[:3, :3] @ forward_kinematics(there.robot, q)[:, :3, :3]
    fitting = np.concatenate([np.tile(np.eye(3), (len(p), 1, 1)), turning, along], axis=2).reshape(-1, 9)
    U = np.linalg.qr(fitting)[0]
    D = D - U @ (U.T @ D)
    return D, D.reshape(J.shape)
