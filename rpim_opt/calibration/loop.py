"""The outer loop: linearize, choose the weight, solve, step or damp, until the convex program promises nothing more."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, NoSolutionFound
from rpim_opt.basics.threads import phase
from rpim_opt.calibration.certificate import DECREASE, Certificate, certified
from rpim_opt.calibration.choosing import Choosing, choosing
from rpim_opt.calibration.outcome import Iteration
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.majorize import Squares, on_triangles
from rpim_opt.convex.program import Damping, Program, pose
from rpim_opt.convex.select import Selector
from rpim_opt.convex.trust import trusted_rows
from rpim_opt.problem.identified import around
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.parts import in_parts
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.source import Source

GOOD, POOR = 0.75, 0.25
"""Of the decrease that the convex program promises: above the first, damping gets less; below the second, more."""
HARDER, SOFTER, FIRST, LAST = 4.0, 0.5, 1.0, 1e-4
"""By how much; what damping first weighs against the promised decrease, and below what part of it there is none."""
BENT, BEND_STEP, MOST_BEND = 0.1, 0.1, 0.75
"""A step follows the curve of the residual where that bends by this part of the step's effect; measured so far along
the step; unless it would turn the step by more than the last."""
STRAIGHT = 1e-3
"""Steps shorter than this part of the solution are straight: what bends them is rounding."""
EXACT, INTERIOR, BEST = 1e-12, 1e-8, 1e-11
"""Relative accuracy of an objective: of formulas and active sets, of interior points, and of these at their best."""
VANISHING = 1e-12
"""Part of the first objective below which one has vanished."""
ROUNDING = 1e-9
"""By how much of itself an objective may rise at a step: what rounding makes of it, not where it leads."""
GUESS = 0.01
"""Accuracy of the first pass, relative: its linearization is no better."""
MANY = 6
"""Refused steps in a row after which a small promise is taken for the solver's noise; the certificate judges that."""
LONG = 10
"""Passes after which an objective that did not fall is taken to be the least; the certificate judges that."""
FEW = 10
"""Passes that are too few to begin with a weight that no selector was asked for."""
NEAR = 0.01
"""Part of the solution that the first weight's next step may be when the selector is asked: it would not tell."""
QUIET = 3
"""Passes in a row in which a program promises nothing beyond its accuracy: then it will not."""
PENALTY = 10.0
"""What missing ``largest`` by its own size costs, relative to the objective."""


@dataclass(frozen=True, eq=False)
class State:
    """Where the loop is.

    Parameters
    ----------
    z
        (n,) deviations in units of the scales.
    program
        Linearized at z.
    choice
        The weight.
    merit
        The nonlinear objective at z, and what missing ``largest`` costs.
    damping
        Weight of |size (step)|^2.
    size
        (n,) largest norm that each column of A has had.
    history
        The passes so far.
    evaluations
        Linearizations so far.
    quiet
        Passes in a row that promised nothing.
    refused
        Steps in a row that did not lower the objective.
    outcome
        Why the loop ended; empty while it goes on.
    slope
        Norm of the data's gradient where the loop began.
    floor
        What objectives are compared with where they vanish: a small part of the first one.
    """

    z: Array
    program: Program
    choice: Choosing
    merit: float
    size: Array
    damping: float = 0.0
    history: tuple[Iteration, ...] = ()
    evaluations: int = 1
    quiet: int = 0
    refused: int = 0
    outcome: str = ""
    slope: float = 0.0
    floor: float = 0.0


@dataclass(frozen=True, eq=False)
class Loop:
    """What stays the same from pass to pass: the measurements, how a program is solved, when to stop."""

    source: Source
    asked: Formulation
    reweigh: Squares | None
    solver: Mapping[str, Any]
    tolerance: float
    most: int
    about: tuple[Array | None, Array | None] = (None, None)

    def linearized(self, z: Array, before: Array | None = None) -> LinearModel:
        """Return the linear model at z (n,)."""
        reweigh = self.reweigh
        if reweigh is not None and before is not None:
            reweigh = reweigh.after(before)
        return around(self.source.linearize(self.source.parameters.free.scale * z, reweigh), *self.about)

    def chosen(self, state: State) -> State:
        """Ask for the weight; the objective follows it."""
        choice = state.choice
        if not choice.answers and self.most > FEW:
            choice = choice.begun()
        if not choice.settled:
            choice = choice.asked(self._judged(state))
        if choice.weight == state.choice.weight and state.history:
            return replace(state, choice=choice)
        return replace(state, choice=choice, merit=_merit(state.program, state.z, choice.weight))

    def confirmed(self, state: State) -> State:
        """Ask the selector once more where the loop came to rest: a weight is chosen when it is its own answer."""
        if state.outcome != "rest" or state.choice.final:
            return state
        choice = state.choice.confirmed(self._judged(state))
        if choice.weight == state.choice.weight:
            return replace(state, choice=choice)
        merit = _merit(state.program, state.z, choice.weight)
        return replace(state, choice=choice, merit=merit, quiet=0, outcome="")

    def answered(self, state: State) -> State:
        """Ask a selector that was not asked yet."""
        choice = state.choice
        if choice.final or choice.answers:
            return state
        choice = replace(choice, settled=False).asked(self._judged(state))
        return replace(state, choice=choice, merit=_merit(state.program, state.z, choice.weight))

    def _judged(self, state: State) -> Program:
        """Return the program that a rule sees: of a robust loss the linear estimator that its fit amounts to."""
        if not state.choice.robust:
            return state.program
        if self.reweigh is None:
            return state.program.on_squares(state.program.trusted(state.z))
        x = self.source.parameters.free.scale * state.z
        trust = trusted_rows(self.source, x, self.asked)
        return state.program.on(around(self.source.linearize(x, trust), *self.about))

    def advanced(self, state: State) -> State:
        """Return the state after one attempt at a step."""
        accuracy = 0.0 if state.history or state.refused or self.solver.get("solver") else GUESS
        straight = self._solved(state.program, state, accuracy)
        promised = state.merit - _merit(state.program, straight, state.choice.weight)
        if accuracy and promised <= 10 * accuracy * abs(state.merit):
            straight = self._solved(state.program, state)
            promised = state.merit - _merit(state.program, straight, state.choice.weight)
        length = float(np.linalg.norm(straight - state.z))
        short = length <= self.tolerance * (1 + float(np.linalg.norm(state.z)))
        accuracy, best = self._accuracy(state)
        nothing = promised <= accuracy
        if state.damping > 0 and (short or nothing):
            return replace(state, damping=0.0)  # a short step of a damped program says nothing: ask for the full one
        quiet = state.quiet + 1 if nothing else 0
        if state.choice.settled and (promised <= best or quiet >= QUIET or self._stalled(state)):
            return replace(state, outcome="rest")
        if state.choice.waiting and state.damping == 0 and length <= NEAR * (1 + float(np.linalg.norm(state.z))):
            return self.answered(replace(state, quiet=0))
        return self._tried(replace(state, quiet=quiet), straight, promised, short, nothing)

    def _tried(self, state: State, straight: Array, promised: float, short: bool, nothing: bool) -> State:
        """Return the state after a step to the minimum (n,) of the convex program, or along the residual's curve."""
        z = self._bent(state, straight)
        candidate = state.program.on(self.linearized(z, state.z))
        merit = _merit(candidate, z, state.choice.weight)
        state = replace(state, evaluations=state.evaluations + 1)
        rounding = ROUNDING * abs(state.merit) + state.floor
        gain = 1.0
        if promised > 0 and not (nothing and abs(state.merit - merit) <= rounding):  # else rounding would damp
            gain = (state.merit - merit) / promised
        stepped = merit <= state.merit + rounding
        state = self._damped(state, gain, promised, z)
        if not stepped:
            state = replace(state, refused=state.refused + 1)
            hopeless = state.refused > MANY and promised <= DECREASE * max(abs(state.merit), 1.0)
            return self._refused(state, short or nothing or hopeless)
        return self._accepted(state, candidate, z, merit, short)

    def _solved(self, program: Program, state: State, accuracy: float = 0.0) -> Array:
        """Return the minimum (n,) of a convex program, damped as the state says."""
        weight = state.choice.weight
        with phase("solve"):
            estimate = program.solve(weight, damping=_term(state), accuracy=accuracy, **self.solver)
        return program.inside(estimate.z, state.z, weight)

    def _bent(self, state: State, straight: Array) -> Array:
        """Let a step follow the curve of the residual: the convex program again, b moved by half the curvature.

        (Geodesic acceleration; Transtrum and Sethna 2012, arXiv:1201.5885. The curvature is that along the step, by a
        difference of residuals.)
        """
        step = straight - state.z
        source, model = self.source, state.program.model
        length = float(np.linalg.norm(step))
        if not isinstance(source, CalibrationProblem) or length <= STRAIGHT * (1 + float(np.linalg.norm(state.z))):
            return straight
        along = model.A @ step
        ahead = source.whitened_residual(source.parameters.free.scale * (state.z + BEND_STEP * step))
        bend = (ahead - (model.b - model.A @ state.z) + BEND_STEP * along) / BEND_STEP**2
        if not np.isfinite(bend).all() or np.linalg.norm(bend) <= BENT * np.linalg.norm(along):
            return straight
        curved = self._curved(state, straight, bend)
        if curved is None:
            return straight
        turn = np.linalg.norm(state.size * (curved - straight))
        if 2 * turn > MOST_BEND * np.linalg.norm(state.size * step):
            return straight
        return curved

    def _curved(self, state: State, straight: Array, bend: Array) -> Array | None:
        """Return the minimum (n,) where b moves by (m,), from that where it does not."""
        program, model = state.program, state.program.model
        by = None
        if self.solver.get("solver") is None:
            by = program.moved(bend, state.choice.weight, _term(state))
        if by is not None:
            return straight + by
        try:
            return self._solved(program.on(model.with_values(model.b + bend)), state)
        except NoSolutionFound:
            return None

    def _stalled(self, state: State) -> bool:
        """Whether many passes together have changed the objective by no more than one may for nothing."""
        if len(state.history) <= LONG or state.history[-LONG].weight != state.choice.weight:
            return False
        accuracy, best = self._accuracy(state)
        fall = state.history[-LONG].objective - state.merit
        if np.isfinite(best):
            return fall <= accuracy
        return fall <= LONG * accuracy

    def _accuracy(self, state: State) -> tuple[float, float]:
        """Return what a promised decrease may be for nothing, when it is so again and again, and when it is so once."""
        exact = state.program.quadratic and state.program.box is not None
        size = max(abs(state.merit), state.floor)
        if exact and self.reweigh is None:
            return EXACT * size, -np.inf
        if not np.isfinite(state.merit):  # outside the functions' domain: any point inside is better
            return 0.0, -np.inf
        size = max(size, 1.0)  # an interior point's accuracy is absolute below one squared sigma
        return INTERIOR * size, BEST * size

    def _damped(self, state: State, gain: float, promised: float, z: Array) -> State:
        """Return the state with the damping that a gain asks for."""
        effect = float(np.sum((state.size * (z - state.z)) ** 2))
        damping = state.damping
        if gain < POOR and effect > 0 and promised > 0:
            damping = max(HARDER * damping, FIRST * promised / effect if damping == 0 else 0.0)
        elif gain > GOOD:
            damping = SOFTER * damping
            if damping * effect <= LAST * promised:
                damping = 0.0
        return replace(state, damping=damping)

    def _refused(self, state: State, nothing: bool) -> State:
        """Return the state after a step that does not lower the objective; where none was promised, it is at rest."""
        if nothing and state.choice.settled:
            return replace(state, outcome="rest")
        if nothing:
            return replace(state, choice=state.choice.after(0.0))
        if state.damping > 1e30 or not np.isfinite(state.damping):
            return replace(state, outcome="stuck")
        return state

    def _accepted(self, state: State, candidate: Program, z: Array, merit: float, short: bool) -> State:
        """Return the state at a better point."""
        scale = self.source.parameters.free.scale
        length = float(np.linalg.norm(z - state.z))
        x = scale * z
        wrapped = self.source.parameters.free.wrapped(x)
        if (wrapped != x).any():
            turned = wrapped / scale
            moved = candidate.model.with_values(candidate.model.b + candidate.model.A @ (turned - z))
            candidate, z = candidate.on(moved), turned
            merit = _merit(candidate, z, state.choice.weight)
        settled = state.choice.settled
        resting = settled and short
        passed = Iteration(merit, length, state.choice.weight, state.damping)
        return replace(
            state,
            z=z,
            program=candidate,
            merit=merit,
            refused=0,
            size=np.maximum(state.size, np.linalg.norm(candidate.model.A, axis=0)),
            history=(*state.history, passed),
            choice=state.choice.after(length / (1 + float(np.linalg.norm(z)))),
            outcome="rest" if resting else "",
        )


def _term(state: State) -> Damping | None:
    """Return the term that shortens a step."""
    if state.damping == 0:
        return None
    return Damping(state.z, np.sqrt(state.damping) * state.size)


def _merit(program: Program, z: Array, weight: float) -> float:
    objective = program.objective(z, weight)
    excess = program.excess(z)
    if excess == 0:
        return objective
    return objective + PENALTY * (1 + abs(objective)) * excess


@dataclass(frozen=True, eq=False)
class Ended:
    """Where the loop ended, and the evidence that this is a solution."""

    state: State
    certificate: Certificate
    x: Array
    converged: bool
    message: str


def run(
    problem: Source,
    formulation: Formulation,
    weight: float | str | Selector,
    start: Array | None = None,
    max_iterations: int = 500,
    tolerance: float = 1e-8,
    progress: Callable[[Iteration], None] | None = None,
    how: Mapping[str, Any] = MappingProxyType({}),
    about: Array | None = None,
    farthest: Array | None = None,
) -> Ended:
    """Run the loop from some deviations (n,) [SI] to its end; arguments as for `calibrate`.

    Positions that constraints ask for are linear about deviations ``about`` (n,) [SI]; of regions also those that move
    farthest at ``farthest`` (n,) [SI].
    """
    loop, state = _rested(
        problem, formulation, weight, start, max_iterations, tolerance, progress, how, (about, farthest)
    )
    try:
        evidence = _certified(loop, formulation, problem, state)
    except NoSolutionFound as error:
        raise error.naming(_names(loop.source)) from None
    converged = state.outcome == "rest" and evidence.holds(state.z)
    message = _message(state, evidence, converged, max_iterations)
    return Ended(state, evidence, loop.source.parameters.free.scale * state.z, converged, message)


def nearby(
    problem: Source, formulation: Formulation, weight: float, start: Array, tolerance: float, steps: int
) -> Array:
    """Return deviations (n,) [SI] near to a minimum, or on the way to it after some steps: nothing certifies them."""
    loop, state = _rested(problem, formulation, weight, start, steps, tolerance)
    return loop.source.parameters.free.scale * state.z


def _rested(
    problem: Source,
    formulation: Formulation,
    weight: float | str | Selector,
    start: Array | None,
    max_iterations: int = 500,
    tolerance: float = 1e-8,
    progress: Callable[[Iteration], None] | None = None,
    how: Mapping[str, Any] = MappingProxyType({}),
    about: tuple[Array | None, Array | None] = (None, None),
) -> tuple[Loop, State]:
    """Return the loop and the state that it ends in."""
    source = in_parts(problem.frozen())
    solved = formulation
    reweigh = None
    if not source.keeps_rows:
        solved, reweigh = on_triangles(formulation, partial(_equations, source))
    loop = Loop(source, formulation, reweigh, how, tolerance, max_iterations, about)
    try:
        state = _begun(loop, solved, choosing(weight, formulation.penalty is not None), start)
        while not state.outcome and state.evaluations <= max_iterations:
            passes = len(state.history)
            state = loop.confirmed(loop.advanced(loop.chosen(state)))
            if progress and len(state.history) > passes:
                progress(state.history[-1])
        return loop, loop.answered(state)
    except NoSolutionFound as error:
        raise error.naming(_names(source)) from None


def _floor(merit: float) -> float:
    """Return below what an objective is as good as zero: noise-free data end at rounding, which has no digits."""
    if not np.isfinite(merit):
        return 0.0
    return VANISHING * abs(merit)


def _equations(source: Source) -> int:
    return sum(len(part.owners) for part in source.rows())


def require_start(start: Array, count: int) -> Array:
    """Return deviations (n,) to begin with, or refuse them."""
    accepted = f"{count} deviations, finite, one a parameter"
    try:
        x = np.asarray(start, dtype=float)
    except (TypeError, ValueError):
        raise InputError("start", f"a {type(start).__name__}", accepted) from None
    if x.shape != (count,):
        raise InputError("start", f"shape {x.shape}", accepted)
    if not np.isfinite(x).all():
        raise InputError("start", "a value that is not finite", accepted)
    return x


def require_finite(*arrays: Array) -> None:
    """Refuse residuals or slopes that are no numbers."""
    if not all(np.isfinite(values).all() for values in arrays):
        raise InputError("data", "residuals or slopes that are not finite", "measurements and a model that are")


def _begun(loop: Loop, formulation: Formulation, choice: Choosing, start: Array | None) -> State:
    """Return the state before the first pass, at a point that meets the constraints."""
    parameters = loop.source.parameters
    scale = parameters.free.scale
    x = np.zeros(len(scale))
    if start is not None:
        x = require_start(start, len(scale))
    z = parameters.free.wrapped(x) / scale
    model = loop.linearized(z)
    require_finite(model.A, model.b)
    unpenalized = formulation.penalty is None or (choice.settled and choice.weight == 0)
    if model.equations < len(z) and unpenalized:
        found = f"{model.equations} equations for {len(z)} parameters"
        raise InputError("data", found, "at least as many equations, or a formulation with penalty and weight")
    with phase("canonicalization"):
        program = pose(formulation, model)
        nearest = program.nearest(z)
    if (nearest != z).any():
        z = nearest
        program = program.on(loop.linearized(z))
    if start is not None:
        program.beginning(z)
    size = np.linalg.norm(program.model.A, axis=0)
    choice = replace(choice, robust=loop.reweigh is not None or program.separable)
    merit = _merit(program, z, choice.weight)
    slope = float(np.linalg.norm(2 * model.A.T @ model.b))
    return State(z, program, choice, merit, size, slope=slope, floor=_floor(merit))


def _certified(loop: Loop, formulation: Formulation, problem: Source, state: State) -> Certificate:
    """Ask everything anew: the formulation's functions, and the measurements' model."""
    solved, model = formulation, state.program.model
    if loop.reweigh is not None:
        solved, _ = on_triangles(formulation, lambda: model.equations)
    residual = None
    if loop.source.keeps_rows:  # of more than fits into memory the last pass has to do
        scale = loop.source.parameters.free.scale
        anew = problem.frozen()
        model = around(anew.linearize(scale * state.z), *loop.about)
        if isinstance(anew, CalibrationProblem):
            residual = partial(_whitened, anew, scale)
    z, weight = state.z, state.choice.weight
    return certified(solved, model, state.slope, z, weight, state.floor, residual, state.program)


def _whitened(problem: CalibrationProblem, scale: Array, z: Array) -> Array:
    """Return the whitened residual (m,) at z (n,) in units of the scales."""
    return problem.whitened_residual(scale * z)


def _names(source: Source) -> dict[int, str]:
    """Return a label for every configuration's number."""
    names: dict[int, str] = {}
    for part in source.rows():
        names |= dict(zip(part.data.configuration, part.data.label, strict=True))
    return names


def _message(state: State, evidence: Certificate, converged: bool, most: int) -> str:
    """Say how the loop ended, and why."""
    count = len(state.history)
    passes = f"{count} passes" if count != 1 else "1 pass"
    if converged:
        text = f"Converged after {passes}."
    elif state.outcome == "rest":
        text = _doubted(evidence)
    elif state.outcome == "stuck":
        text = (
            "Not converged: no step lowers the nonlinear objective, however short; "
            "the formulation may have no minimum here, or the start be far off."
        )
    else:
        text = f"Not converged: {_unfinished(state, most)}"
    if state.choice.note:
        text += f" {state.choice.note}"
    return text


def _doubted(evidence: Certificate) -> str:
    """Say why a loop at rest has not converged."""
    if evidence.decrease is None:
        return "Not converged: the convex program at the end could not be solved again, so that nothing certifies it."
    if evidence.decrease > 1e-6:
        return f"Not converged: the convex program at the end still promises {evidence.decrease:.1g} of the objective."
    return f"Not converged: the constraints are missed by {evidence.violation:.1g} scales."


def _unfinished(state: State, most: int) -> str:
    """Say what the loop was doing when its passes ran out."""
    passes = f"{most} passes were" if most != 1 else "1 pass was"
    last = [iteration.objective for iteration in state.history[-5:]]
    if len(last) == 5 and last[0] - last[-1] <= 1e-9 * abs(last[-1]):
        return (
            f"{passes} not enough, though the objective hardly changes: the data hardly decide, give a larger weight."
        )
    if state.choice.weight == 0 and most > 1:
        return f"{passes} not enough: what the data hardly see runs away without a penalty; give one, with a weight."
    return f"{passes} not enough; give more (max_iterations)."
