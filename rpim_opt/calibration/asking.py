"""What a user asks: identify the parameters of a problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import count
from logging import getLogger
from typing import Any

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.bayes.empirical_bayes import estimate, with_extensions
from rpim_opt.bayes.hyperparameters import Estimator
from rpim_opt.bayes.prior import Prior
from rpim_opt.calibration.loop import nearby, require_finite, require_start
from rpim_opt.calibration.outcome import Iteration
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.weighed import calibrated, require_passes
from rpim_opt.convex.formulation import Formulation, tikhonov
from rpim_opt.convex.named import formulation_of, weight_of
from rpim_opt.convex.select import Selector
from rpim_opt.problem.registration.frames import relocated
from rpim_opt.problem.registration.global_start import JointMapping, find_mapping
from rpim_opt.problem.source import Source

LOGGER = getLogger("rpim_opt")
NOISE = {
    "robot": ("position", "orientation", "joint"),
    "free": ("position", "orientation", "joint", "instrument"),
    "level": ("instrument",),
    "declared": (),
}
"""Parts of the noise that are learned: the robot's beside the instrument as declared, that at a level of its own, one
level for all, or none."""
MODELS = ("geometry", "auto")
ROUGHLY = 1e-3
"""Tolerance of fits between two estimates of hyperparameters: the last fit is exact."""
ELSEWHERE = " Frames were stated far from where the data put them; their deviations count from there."


@one_blas_thread
def calibrate(
    problem: Source,
    formulation: Formulation | str = tikhonov,
    weight: float | str | Selector | Mapping[str, Any] | None = None,
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

    Without a weight, sizes are learned from the data first (`Evidence` has the formulas): how large deviations are,
    each with heavy tails, joint offsets expected three times as large, frames nearly free; and what noise there is
    beside the instrument's. They are laid into an ordinary problem, as scales and `Scatter`, that any formulation
    solves at weight 1.

    Every pass linearizes at the current deviations, solves for the *total* deviation and takes the step; a step that
    bends follows the curve of the residual, and where the nonlinear objective falls by less than a quarter of what the
    convex program promises, a term of Levenberg's and Marquardt's kind shortens the next one. The loop ends when the
    undamped program promises no decrease beyond its solver's accuracy, or its step is shorter than
    ``tolerance * (1 + ||z||)``. The result has converged if a `Certificate` computed anew agrees: then it is a
    stationary point of the nonlinear problem.

    Parameters
    ----------
    problem
        What was measured, and what is to be identified. ``ro.calibrate`` takes an instance of `load` as well, or the
        name or folder that it loads: what is not stated here is then as its file has it.
    formulation
        The convex program of a pass, or the name of a ready one (``"robust"``); its functions are asked now.
    weight
        None or ``"learned"``: sizes are learned. A number, or a selector (or its name) over the stated scales, which
        sees identification data only; it is asked anew until the steps become small, then the weight stays, and one
        that takes turns between weights is answered, with a sentence. Several weights by patterns, kinds or links of
        parameters: ``{"alpha? theta?": ro.reml, "a? d?": 3.0}``.
    prior
        Of the deviations, beyond the scales of the parameters.
    model
        ``"geometry"``, or ``"auto"``: families of parameters that geometry lacks (compliance under gravity,
        eccentric joints, ...) are added where the evidence wants them.
    noise
        What is learned of it: ``"robot"``, the robot's scatter beside the instrument's noise as declared; ``"free"``,
        that of the instrument too; ``"level"``, one factor on what was declared; ``"declared"``, nothing.
    start
        (n,) deviations [SI] to begin with; nominal by default. Then signs and zeros of joints are sought where the
        nominal robot does not explain the data (`global_start`), and frames that are stated metres or half a turn from
        where the data put them count from there (`frames.relocated`). The answer does not depend on
        a given start, as long as the loop converges: the deviations count from nominal all the same, angles within
        half a turn.
    max_iterations, tolerance
        When to stop: linearizations, and length of a step. A calibration that did not converge says so in ``converged``
        and ``message``.
    progress
        Called after every iteration, which the logger ``rpim_opt`` reports at level INFO, too.
    solver, settings, verbose
        Any installed solver of CVXPY, with its options (`Program.solve`).

    Raises
    ------
    InputError
        For fewer equations than unknowns without a penalty, a start that does not fit, unknown words.
    NoSolutionFound
        When a convex program fails.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> result = ro.calibrate(instance.problem)
    >>> print(f"{1e3 * result.errors(instance.validation).mean():.3f} mm. {result.message}")
    0.024 mm. Converged after 2 passes.
    >>> print(ro.calibrate(instance.problem, ro.tikhonov, weight=ro.reml).message)
    Converged after 4 passes.
    >>> ro.calibrate(instance.problem, "robust", "reml").formulation.name  # ready ones by their names
    'Huber'
    """
    formulation = formulation_of(formulation)
    weight = weight_of(weight)
    how = {
        "max_iterations": max_iterations,
        "tolerance": tolerance,
        "progress": _logged(progress),
        "solver": solver,
        "settings": settings,
        "verbose": verbose,
    }
    kinds = _noise(noise, model)
    if isinstance(weight, Mapping):
        from rpim_opt.calibration.group_weights import grouped

        return grouped(problem, formulation, weight, prior=prior, start=start, **how)
    given = {**how, "prior": prior, "model": model, "noise": noise, "progress": None}
    asked = partial(calibrate, formulation=formulation, weight=weight, **given)
    require_passes(max_iterations)
    require_finite(*(block.y for block in problem.sample().data.blocks))
    elsewhere = None
    mapping: JointMapping | None = None
    if start is not None:
        start = require_start(start, len(problem.parameters.free))
    else:
        found = find_mapping(problem)
        if found is not None:
            mapping, problem = found
        elsewhere = relocated(problem)
    problem = elsewhere or problem
    if weight is None and formulation.penalty is None:
        weight = 0.0
    believed = prior or Prior()
    if weight is None:
        found = estimate(problem, Estimator(believed, kinds, _refit), model, start)
        formulation = believed.penalized(formulation, found.stated)
        result = calibrated(found.problem, formulation, 1.0, start=found.x, **how)
        result = replace(result, learned=found.learned)
    else:
        if model == "auto":
            found = estimate(problem, Estimator(believed, kinds, _refit), model, start)
            problem = with_extensions(problem, found)
        if prior is not None:
            formulation = prior.penalized(formulation, prior.stated(problem.parameters, widened=False))
        result = calibrated(problem, formulation, weight, start=start, **how)
    message = result.message
    if elsewhere is not None:
        message += ELSEWHERE
    if mapping is not None:
        message += f" {mapping.sentence}"
    LOGGER.info(message)
    return replace(result, message=message, asked=mapped_as(mapping, asked), mapping=mapping)


def mapped_as(mapping: JointMapping | None, asked: Callable[[Source], Calibration]) -> Callable[[Source], Calibration]:
    """Return a calibration of problems whose joints are mapped already, which says so."""
    if mapping is None:
        return asked
    return lambda problem: replace(asked(problem), mapping=mapping)


def _logged(progress: Callable[[Iteration], None] | None) -> Callable[[Iteration], None]:
    """Return a function of iterations that logs them before it passes them on."""
    number = count(1)

    def report(it: Iteration) -> None:
        LOGGER.info("iteration %d: objective %.6g, step %.1e", next(number), it.objective, it.step)
        if progress is not None:
            progress(it)

    return report


def _refit(problem: Source, formulation: Formulation, start: Array, steps: int) -> Array:
    """Return deviations (n,) [SI] near a minimum at weight 1: what hyperparameters need between two linearizations."""
    return nearby(problem, formulation, 1.0, start, ROUGHLY, steps)


def _noise(noise: str, model: str) -> tuple[str, ...]:
    """Return which parts of the noise are learned.

    Raises
    ------
    InputError
        For an unknown word.
    """
    if model not in MODELS:
        raise InputError("model", f"'{model}'", choices(model, MODELS))
    if noise not in NOISE:
        raise InputError("noise", f"'{noise}'", choices(noise, NOISE))
    kinds = NOISE[noise]
    if model == "geometry":  # without the families joints would take gravity for noise
        kinds = tuple(kind for kind in kinds if kind != "joint")
    return kinds
