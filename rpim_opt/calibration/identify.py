"""Identification of a problem's parameters at a given weight or at estimated hyperparameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import count
from logging import getLogger
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array, finite_numbers
from rpim_opt.basics.exceptions import pick
from rpim_opt.basics.text import counted, joined
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.bayes.empirical_bayes import estimate, with_extensions
from rpim_opt.bayes.hyperparameters import Estimator, require_finite
from rpim_opt.bayes.prior import Prior
from rpim_opt.bayes.prior_terms import Statement
from rpim_opt.calibration.certificate import DECREASE
from rpim_opt.calibration.loop import FAR, ROUNDS, Ended, Iteration, Options, minimize, nearby
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.formulation import Formulation, formulation_of, tikhonov
from rpim_opt.convex.robust_loss import by_place
from rpim_opt.convex.rules.selection import Selector
from rpim_opt.convex.select import weight_of
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.multi_robot import require_affordable
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.frames import relocated
from rpim_opt.problem.registration.global_start import JointMapping, find_mapping

LOGGER = getLogger("rpim_opt")
NOISE = {
    "robot": ("position", "orientation", "joint", "reading"),
    "free": ("position", "orientation", "joint", "reading", "instrument"),
    "level": ("instrument",),
    "declared": (),
}
"""Estimated components of the noise, by the option's name."""
MODELS = {"geometry": ("position", "orientation", "reading", "instrument"), "auto": NOISE["free"]}
"""Components of the noise by model: without extensions, deflection under gravity would count as joint noise."""
LEVEL = 1e-9  # relative decrease of the objective over five iterations that is no progress
DIVERGES = "poorly identifiable combinations diverge without a penalty; add one."
DIVERGES_PENALIZED = (
    "combinations that neither data nor penalty determines diverge; use a larger weight, or penalize all parameters."
)
DISPLACED = "Deviations refer to registered frames"
ZERO = 0.1  # standard deviation [rad] of a joint zero found from the data


@one_blas_thread
def calibrate(
    problem: Source,
    formulation: Formulation | str = tikhonov,
    weight: float | str | Selector | None = None,
    *,
    prior: Prior | None = None,
    model: str = "geometry",
    noise: str = "robot",
    start: Array | None = None,
    max_iterations: int = 500,
    tolerance: float = 1e-8,
    progress: Callable[[Iteration], None] | None = None,
    solver: str | None = None,
    settings: Mapping[str, Any] | None = None,
    verbose: bool = False,
) -> Calibration:
    """Identify the parameters of a problem.

    Without a weight, hyperparameters are estimated from the data first, by marginal likelihood (`Evidence` has the
    formulas): prior scales of the deviations, with heavy tails, joint offsets three times as large, frames nearly free;
    and the robot's repeatability beside the stated measurement noise. Any formulation then solves the problem with
    these scales and noise (`Repeatability`) at weight 1.

    Every iteration linearizes at the current deviations and solves for the *total* deviation; a curved step follows the
    curve of the residual (geodesic acceleration), and where the nonlinear objective falls by less than a quarter of
    what the convex program predicts, Levenberg-Marquardt damping shortens the next one. The loop ends when the undamped
    program predicts no decrease beyond its solver's accuracy, or its step is shorter than ``tolerance * (1 + ||z||)``.
    The result has converged if an independent `Certificate` agrees: then it is a stationary point of the nonlinear
    problem.

    Parameters
    ----------
    problem
        The measurements, and the parameters to identify. ``ro.calibrate`` also takes an instance of `load`, or its name
        or folder: arguments that are not given here are then those of its file.
    formulation
        Loss, penalty and constraints, or the name of a ready one (``"robust"``); its functions are called again.
    weight
        None or ``"learned"`` estimates hyperparameters. A number, or a selection rule (or its name), holds for the
        stated scales; a rule uses identification data only, is applied again at the solution, and its weight is final
        if unchanged. Weights of single groups of parameters are scales: ``Prior(scale={"a?_mm": 0.5})``.
    prior
        Prior of the deviations, in addition to the scales of the parameters.
    model
        ``"geometry"``, or ``"auto"``: model extensions (compliance under gravity, gear eccentricity, ...) are added
        if the marginal likelihood supports them.
    noise
        Noise that is estimated with ``"learned"``: ``"robot"``, the robot's repeatability in addition to the stated
        measurement noise; ``"free"``, also the measurement noise; ``"level"``, one factor on the stated noise;
        ``"declared"``, none. With another weight uncertainties follow the residuals if these are significantly larger.
    start
        (n,) deviations [SI] to start from; nominal by default. Without it, signs and zeros of joints are sought if the
        nominal robot does not explain the data (`global_start`), and frames stated metres or half a turn from their
        registration start there (`frames.relocated`), unless the prior states them. If the loop converges, the result
        does not depend on a stated start.
    max_iterations, tolerance
        Stopping criteria: number of linearizations, and length of a step. ``converged`` and ``message`` of the result
        report how the loop ended.
    progress
        Called after every iteration; the logger ``rpim_opt`` also reports it at level INFO.
    solver, settings, verbose
        An installed solver of CVXPY with its options (`Program.solve`), for the steps of the calibration; rules and
        hyperparameters do not use it.

    Raises
    ------
    InputError
        For fewer equations than unknowns without a penalty, a start that does not fit, unknown names, and so many
        sessions that identifying them takes too long (it states how long).
    NoSolutionFound
        If a convex program has no solution.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> result = ro.calibrate(instance.problem)
    >>> print(f"{1e3 * result.errors(instance.validation).mean():.3f} mm. {result.message}")
    0.024 mm. Converged after 2 iterations.
    >>> print(ro.calibrate(instance.problem, ro.tikhonov, weight=ro.reml).message)
    Converged after 4 iterations.
    >>> ro.calibrate(instance.problem, "robust", "reml").formulation.name  # ready ones by their names
    'Huber'
    """
    formulation = formulation_of(formulation)
    applied: float | Selector | None = weight_of(weight)
    options = Options(max_iterations, tolerance, _logged(progress), solver, settings, verbose)
    told_apart = pick(MODELS, model, "model")
    kinds = tuple(kind for kind in pick(NOISE, noise, "noise") if kind in told_apart)
    require_affordable(problem)
    require_finite(*(block.y for block in problem.sample().data.blocks))
    mapping: JointMapping | None = None
    stated: Source | None = None
    if start is not None:
        start = finite_numbers("start", start, (len(problem.parameters.free),))
    else:
        as_stated = problem.parameters
        if (found := find_mapping(problem)) is not None:
            mapping, problem = found
            prior = (prior or Prior()) & _wide_zeros(mapping)
        if (elsewhere := relocated(problem)) is not None:
            stated, problem = problem, elsewhere
        if prior is not None:
            problem = problem.with_parameters(prior.where_known(as_stated, problem.parameters))
    again: Callable[..., Calibration] = partial(
        calibrate,
        formulation=formulation,
        weight=applied,
        prior=prior,
        model=model,
        noise=noise,
        **(vars(options) | {"progress": None}),
    )
    if applied is None and formulation.penalty is None:  # such statements need standard deviations
        applied = 1.0 if prior is not None and prior.statements else 0.0
    estimator = Estimator(prior or Prior(), kinds, nearby)
    learned = None
    excluded = None
    if applied is None:
        keep = isinstance(problem, CalibrationProblem) and by_place(formulation, problem.groups)
        estimated = estimate(problem, estimator, model, start, keep)
        left_out = [row.label for row in estimated.learned.left_out]
        if left_out and isinstance(problem, CalibrationProblem):  # in memory
            excluded = problem.data.take(np.flatnonzero(np.isin(problem.labels, left_out)))
        problem, applied, start, learned = estimated.problem, 1.0, estimated.x, estimated.learned
        formulation = estimated.stated.penalized(formulation)
    else:
        if model == "auto":
            problem = with_extensions(problem, estimate(problem, estimator, model, start))
        if prior is not None:
            formulation = prior.stated(problem.parameters, widened=False).penalized(formulation)
    ended = minimize(problem, formulation, applied, start, options)
    choice = ended.state.choice
    message = _with_notes(ending(ended, max_iterations), stated, problem, mapping)
    LOGGER.info(message)
    return Calibration(
        problem=problem,
        formulation=formulation,
        x=ended.x,
        weight=choice.weight,
        selection=choice.selection,
        converged=ended.converged,
        message=message,
        history=ended.state.history,
        program=ended.state.program,
        certificate=ended.certificate,
        calibrate_again=mapped_as(mapping, again, stated),
        learned=learned,
        mapping=mapping,
        excluded=excluded,
    )


def _wide_zeros(mapping: JointMapping) -> Prior:
    """Return the prior of joint zeros that were estimated: quarter turns are conventions, all others chance."""
    estimated = (mapping.zero % (np.pi / 2) != 0) & (np.array(mapping.joint_types) == "revolute")
    names = [f"theta{i + 1}" for i in np.flatnonzero(estimated)]
    return Prior(statements=tuple(Statement((name,), ("angle",), ((1 / ZERO,),), (0.0,), whole=True) for name in names))


def ending(ended: Ended, most: int) -> str:
    """Return a sentence on how the loop ended and why."""
    state = ended.state
    iterations = counted(len(state.history), "iteration")
    diverges = DIVERGES_PENALIZED if state.choice.weight else DIVERGES
    exceeded = f"eviations exceed {FAR:g} prior standard deviations: {diverges}"
    if not ended.settled:
        what = "positions predicted in the constraints still change: loosen these constraints, or use a larger weight"
        return f"Not converged: after {ROUNDS} linearizations {what}."
    if ended.converged:
        text = f"Converged after {iterations}."
        if state.far:
            text += f" D{exceeded}"
        return " ".join(filter(None, [text, state.choice.note]))
    if state.outcome == "converged":
        decrease = ended.certificate.decrease
        why = f"the constraints are violated by {ended.certificate.violation:.1g} prior standard deviations."
        if decrease is None:
            why = "the final convex program could not be solved again, so the solution is not certified."
        elif decrease > DECREASE:
            why = f"the final convex program still predicts a decrease of the objective by {100 * decrease:.1g} %."
        why += " Check [scale]; verbose=True shows the solver's messages."
    elif state.outcome == "stalled":
        why = (
            "no step, however short, decreases the nonlinear objective; the formulation may have no minimum "
            "here, or the start is far from it."
        )
    elif state.outcome == "far":
        why = f"d{exceeded}"
    else:
        why = f"{counted(most, 'iteration')} {'was' if most == 1 else 'were'} not enough"
        last = [iteration.objective for iteration in state.history[-5:]]
        if len(last) == 5 and last[0] - last[-1] <= LEVEL * abs(last[-1]):
            why += ", though the objective hardly changes: the data hardly determine the solution; use a larger weight."
        elif state.choice.weight == 0 and most > 1:
            why += f": {DIVERGES}"
        else:
            why += "; allow more (max_iterations)."
    return " ".join(filter(None, [f"Not converged: {why}", state.choice.note]))


def _with_notes(message: str, stated: Source | None, registered: Source, mapping: JointMapping | None) -> str:
    """Return a message with sentences on stated frames far from their registration, and on joints that were mapped."""
    apart = stated and _displaced_frames(stated, registered)
    return " ".join(filter(None, [message, apart, mapping and mapping.sentence]))


def _displaced_frames(stated: Source, registered: Source) -> str:
    """Return a sentence on stated frames far from their registration; one at the origin was not stated."""
    p, q = (dict(zip(s.parameters.names, s.parameters.nominal.tolist(), strict=True)) for s in (stated, registered))
    far = []
    for prefix in (name[:-1] for name in p if name.endswith("_x") and f"{name[:-1]}z" in p):
        was, now = (np.array([nominal[prefix + axis] for axis in "xyz"]) for nominal in (p, q))
        apart = 1e3 * float(np.linalg.norm(now - was))
        if apart > 0 and was.any():
            where = ", ".join(f"{1e3 * value:.0f}" for value in now)
            far.append(f"{prefix[:-1]} by {apart:.0f} mm (registered at {where} mm)")
    if not far:
        return ""
    return (
        f"{DISPLACED}, far from the stated ones: {joined(far)}. The flange frame is that of the DH table after the "
        "last joint; that of a data sheet may be rotated."
    )


def mapped_as(
    mapping: JointMapping | None, again: Callable[..., Calibration], stated: Source | None = None
) -> Callable[..., Calibration]:
    """Return a calibration of problems with estimated joint mappings or registered frames, which its message names."""

    def mapped(problem: Source, **other: Any) -> Calibration:
        result = again(problem, **other)
        ended = result.message.partition(f" {DISPLACED}")[0]  # frames are registered again, but were stated once
        return replace(result, mapping=mapping, message=_with_notes(ended, stated, result.problem, mapping))

    return mapped if mapping or stated else again


def _logged(progress: Callable[[Iteration], None] | None) -> Callable[[Iteration], None]:
    """Return a function of iterations that logs them before it passes them on."""
    number = count(1)

    def report(it: Iteration) -> None:
        LOGGER.info("iteration %d: objective %.6g, step %.1e", next(number), it.objective, it.step)
        if progress is not None:
            progress(it)

    return report
