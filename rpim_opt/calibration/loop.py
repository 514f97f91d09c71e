"""The outer loop: linearize, choose the weight, solve, step or damp, until no decrease is predicted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, NoSolutionFound
from rpim_opt.bayes.hyperparameters import require_finite
from rpim_opt.calibration.certificate import Certificate, certified
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.program import Damping, Program, pose
from rpim_opt.convex.robust_loss import QuadraticModel, inliers_of
from rpim_opt.convex.rules.selection import SAME_WEIGHT, Selection, Selector, require_weight
from rpim_opt.convex.structure import in_blocks
from rpim_opt.problem.blocks import Source, in_parts
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.problem import CalibrationProblem, around

GAIN_GOOD, GAIN_POOR = 0.75, 0.25  # actual over predicted decrease: above, damping shrinks; below, it grows
DAMPING_GROWTH, DAMPING_SHRINK, DAMPING_FIRST, DAMPING_LEAST = 4.0, 0.5, 1.0, 1e-4
"""Factors; the first damping term over the predicted decrease; the ratio below which it is dropped."""
CURVATURE, CURVATURE_STEP, CURVATURE_TURN = 0.1, 0.1, 0.75
"""Relative curvature from which a step follows it; share of the step at which it is measured; largest turn of the
step."""
NEGLIGIBLE_STEP = 1e-3  # for shorter steps, relative to the solution, acceleration is rounding
EXACT, INTERIOR, BEST = 1e-12, 1e-8, 1e-11
"""Relative accuracy of an objective: by formulas and active sets, by interior-point methods, and by these at best."""
VANISHING = 1e-12  # share of the first objective that counts as zero: noise-free data end at rounding
ROUNDING = 1e-9  # relative increase of an objective by a step that is rounding
FEW_ITERATIONS = 10  # largest number of iterations at the first weight before a rule is asked
NEAR_FIRST = 0.01  # next step at the first weight, relative to the solution, at which the rule is asked
STALLED, STALLED_MOST = 2, 20
"""Evaluations in a row without decrease beyond accuracy, after which the loop ends: if the next step predicts none, and
in any case."""
FAR, FAR_ITERATIONS = 1000.0, 250
"""Deviations in prior standard deviations that count as divergence, and the iterations after which the loop then ends:
combinations that neither data nor penalty determine would drift on."""
DAMPING_MOST = 1e30  # damping at which no step, however short, lowers the objective
SAME_POSITIONS = 1e-4  # last change, relative to 1 + |z|, of a round: the error of predicted positions is its square
ROUNDS, LEAST_SHARE = 20, 1 / 8  # most rounds; least share of the way to its solution for the next linearization point
ROUGH_TOLERANCE = 1e-3  # tolerance of fits between two estimates of hyperparameters: only the last fit is exact
SETTLED = 1e-3  # the weight is selected again while a step is longer than this share of the solution, then kept
SAME = 0.01  # difference of logarithms up to which two weights are equal
SAME_SEARCH = float(np.log(SAME_WEIGHT))  # the same for weights from a search
SAME_ROBUST = 1e-6  # the same for a robust loss, whose weight does not depend on the storage of measurements
MOST_CHOICES = 10  # most different weights that a rule may select in turn


@dataclass(frozen=True)
class Iteration:
    """One iteration of the loop: the nonlinear objective after it, and the length of its step in units of the scales.

    ``weight`` is that of the penalty, ``damping`` that of the Levenberg-Marquardt term; zero for a full step.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=1.0)
    >>> print(*(f"{passed.objective:.3f}" for passed in result.history[:2]))
    111.417 109.557
    """

    objective: float
    step: float
    weight: float
    damping: float


@dataclass(frozen=True)
class Options:
    """Options of the loop, from the arguments of `calibrate`."""

    max_iterations: int = 500
    tolerance: float = 1e-8
    progress: Callable[[Iteration], None] | None = None
    solver: str | None = None
    settings: Mapping[str, Any] | None = None
    verbose: bool = False

    def __post_init__(self) -> None:
        most = self.max_iterations
        if isinstance(most, bool) or not isinstance(most, int) or most < 1:
            raise InputError("max_iterations", f"{most!r}", "a whole number, 1 or more")


@dataclass(frozen=True, eq=False)
class WeightChoice:
    """The weight of an iteration, and how it was chosen.

    A rule is applied (`updated`) at every point until steps are short if solutions have a closed form, otherwise once,
    and for robust losses only near the solution at weight 1: then its weight is settled. At convergence it is applied
    once more (`confirmed`), and the weight is final if unchanged; otherwise the loop continues with the new one.

    ``rule`` is None for a number; ``weights`` are all that it selected in turn, ``selection`` is the last one.
    ``settled``: the weight is kept until convergence; ``final``: for good. ``robust``: the loss is a sum over rows, but
    not quadratic.
    """

    rule: Selector | None
    weight: float = 0.0
    selection: Selection | None = None
    weights: tuple[float, ...] = ()
    settled: bool = False
    final: bool = False
    note: str = ""
    robust: bool = False

    def updated(self, program: Program) -> WeightChoice:
        """Return the choice of the rule for a program, unless the weight is final."""
        if self.settled or self.rule is None:
            return self
        selection = self.rule(program)
        name = getattr(self.rule, "__name__", "selector")
        if isinstance(selection, int | float | np.integer | np.floating) and not isinstance(selection, bool):
            selection = Selection(float(selection), name, np.empty(0), np.empty(0), True)
        if not isinstance(selection, Selection):
            raise InputError(f"selector {name}", f"a {type(selection).__name__}", "a weight, or a Selection with one")
        weight = float(selection.weight)
        if not (np.isfinite(weight) and weight >= 0):
            raise InputError(f"selector {selection.name}", f"weight {weight}", "a number, zero or more")
        chosen = replace(self, weight=weight, selection=selection, weights=(*self.weights, weight))
        if not program.closed_form:  # paths are expensive: the rule is asked again where this weight leads
            chosen = replace(chosen, settled=True)
        return chosen._checked()

    def after(self, step: float) -> WeightChoice:
        """Return the choice after a step of that relative length."""
        return self if step > SETTLED else replace(self, settled=True)

    def confirmed(self, program: Program) -> WeightChoice:
        """Return the choice after applying the rule to the final program: final, or another weight."""
        if self.final:
            return self
        again = replace(self, settled=False).updated(program)
        apart = SAME  # least difference of ln(weight) that counts
        selection = again.selection
        if self.robust and program.closed_form:
            apart = SAME_ROBUST
        elif selection is not None and selection.interior:  # a weight from a grid is only accurate to its neighbours
            order = np.sort(selection.weights)
            place = int(np.searchsorted(order, selection.weight))
            if 0 < place < len(order) - 1 and order[place] == selection.weight and order[place - 1] > 0:
                apart = float(np.clip(0.5 * np.log(order[place + 1] / order[place - 1]), SAME, SAME_SEARCH))
        if self.weights and _same(again.weight, self.weight, apart):
            return replace(self, settled=True, final=True, note=again.note)
        return again

    def _checked(self) -> WeightChoice:
        """Settle a rule that alternates, or never comes to rest, on the safer of its choices."""
        turns = [self.weights[0]]
        turns += [b for a, b in zip(self.weights, self.weights[1:], strict=False) if not _same(a, b)]
        ended = _alternate(turns, SAME) or len(turns) >= MOST_CHOICES
        if self.settled and len(turns) >= 3:  # cycles
            ended = ended or _same(turns[-1], turns[-3], SAME_SEARCH)
        last: Sequence[float] = turns
        if not ended and self.robust:  # closer to each other than `SAME`
            ended, last = _alternate(self.weights, SAME_ROBUST), self.weights
        if not ended:
            return self
        one, other = last[-2:]
        low, high = sorted((one, other))
        name = self.selection.name if self.selection else "selector"
        weight, which = high, "the larger one is used"
        if low > 0 and high <= 10 * low:
            weight = float(np.sqrt(low * high))
            which = f"their geometric mean, {weight:.2g}, is used"
        note = ""
        if not _same(one, other):
            note = f"The rule {name} alternates between {one:.2g} and {other:.2g}: {which}."
        return replace(self, weight=weight, settled=True, final=True, note=note)


def _alternate(weights: Sequence[float], apart: float) -> bool:
    if len(weights) < 4:
        return False
    a, b, c, d = weights[-4:]
    return _same(a, c, apart) and _same(b, d, apart) and not _same(c, d, apart)


def _same(one: float, other: float, apart: float = SAME) -> bool:
    if one <= 0 or other <= 0:
        return one == other
    return abs(np.log(one / other)) <= apart


def weight_choice(weight: float | Selector, penalized: bool) -> WeightChoice:
    """Return the choice for a number or a selector; refuse anything else."""
    if callable(weight):
        return WeightChoice(weight, settled=not penalized, final=not penalized)
    if isinstance(weight, bool) or not isinstance(weight, int | float | np.integer | np.floating):
        raise InputError("weight", f"{weight!r}", "a number, zero or more, or a selector")
    return WeightChoice(None, require_weight(weight, "weight"), settled=True, final=True)


@dataclass(frozen=True, eq=False)
class State:
    """State of the loop: the program linearized at z (n,) [scales], the weight, and the nonlinear objective.

    ``size`` (n,) is the largest norm so far of each column of A, ``damping`` the weight of |size (step)|^2. ``stalled``
    counts evaluations since the objective last decreased beyond its accuracy, to ``lowest``. ``outcome`` is how the
    loop ended (``"converged"``, ``"stalled"``, ``"far"``), ``floor`` the reference for a vanishing objective.
    """

    z: Array
    program: Program
    choice: WeightChoice
    merit: float
    size: Array
    floor: float = 0.0
    damping: float = 0.0
    history: tuple[Iteration, ...] = ()
    evaluations: int = 1
    stalled: int = 0
    lowest: float = np.inf
    outcome: str = ""

    def weighted(self, choice: WeightChoice) -> State:
        """Return the state with another weight and its objective."""
        merit = self.program.objective(self.z, choice.weight)
        return replace(self, choice=choice, merit=merit, stalled=0, lowest=merit)

    @property
    def far(self) -> bool:
        """Whether some deviation exceeds `FAR` prior standard deviations."""
        return float(np.abs(self.z).max(initial=0.0)) > FAR

    def relative(self, length: float) -> float:
        """Return a length relative to that of the solution."""
        return length / (1 + float(np.linalg.norm(self.z)))


@dataclass(frozen=True, eq=False)
class Loop:
    """The loop of one problem: its source of linear models, the user's formulation, and the one that is solved.

    The formulations differ for data in blocks: ``reweigh`` then models a robust loss by squares while rows are read.
    ``about`` are the linearization points (n,) [SI] of predicted positions in constraints.
    """

    source: Source
    formulation: Formulation
    solved: Formulation
    reweigh: QuadraticModel | None
    options: Options
    about: Array | None = None

    @classmethod
    def of(cls, problem: Source, formulation: Formulation, options: Options) -> Loop:
        """Return the loop of a problem."""
        source = in_parts(problem.frozen())
        solved, reweigh = formulation, None
        if not source.keeps_rows:
            solved, reweigh = in_blocks(formulation)
        return cls(source, formulation, solved, reweigh, options)

    @property
    def scale(self) -> Array:
        """Scales (n,) of the parameters."""
        return self.source.parameters.free.scale

    def linearized(self, z: Array, before: Array | None = None) -> LinearModel:
        """Return the linear model at z (n,)."""
        reweigh = self.reweigh
        if reweigh is not None and before is not None:
            reweigh = reweigh.after(before)
        return around(self.source.linearize(self.scale * z, reweigh), self.about)

    def run(self, weight: float | Selector, start: Array | None) -> State:
        """Return the state at the end, from deviations ``start`` (n,) [SI]."""
        state = self.initial(weight_choice(weight, self.formulation.penalty is not None), start)
        while not state.outcome and state.evaluations <= self.options.max_iterations:
            iterations = len(state.history)
            state = self.confirmed(self.advanced(self.chosen(state)))
            if self.options.progress and len(state.history) > iterations:
                self.options.progress(state.history[-1])
        return self.selected(state)

    def initial(self, choice: WeightChoice, start: Array | None) -> State:
        """Return the initial state, at a feasible point."""
        free = self.source.parameters.free
        z = np.zeros(len(free)) if start is None else free.wrapped(start) / free.scale
        model = self.linearized(z)
        require_finite(model.A, model.b)
        unpenalized = self.formulation.penalty is None or (choice.settled and choice.weight == 0)
        if model.equations < len(z) and unpenalized:
            found = f"{model.equations} equations for {len(z)} parameters"
            raise InputError("data", found, "at least as many equations, or a formulation with penalty and weight")
        program = pose(self.solved, model)
        nearest = program.nearest(z)
        if (nearest != z).any():
            z = nearest
            program = program.on(self.linearized(z))
        if start is not None:
            program.beginning(z)
        choice = replace(choice, robust=self.reweigh is not None or program.separable)
        objective = program.objective(z, choice.weight)
        floor = VANISHING * abs(objective) if np.isfinite(objective) else 0.0
        size = np.linalg.norm(program.model.A, axis=0)
        return State(z, program, choice, objective, size, floor, lowest=objective)

    # --- the weight ------------------------------------------------------------------------------------------

    def chosen(self, state: State) -> State:
        """Return the state with the weight that the rule selects, unless the weight is final."""
        choice = state.choice
        if choice.settled:
            return state
        if choice.robust and not choice.weights and self.options.max_iterations > FEW_ITERATIONS:
            # where weight 1 leads: at nominal, outliers are not visible yet
            return state.weighted(replace(choice, weight=1.0, settled=True))
        return state.weighted(choice.updated(self._judged(state)))

    def confirmed(self, state: State) -> State:
        """Apply the rule once more at convergence: a weight is final if the rule selects it again."""
        if state.outcome != "converged" or state.choice.final:
            return state
        choice = state.choice.confirmed(self._judged(state))
        if choice.weight == state.choice.weight:
            return replace(state, choice=choice)
        return replace(state.weighted(choice), outcome="")

    def selected(self, state: State) -> State:
        """Apply the rule if it was never applied."""
        if state.choice.final or state.choice.weights:
            return state
        return state.weighted(replace(state.choice, settled=False).updated(self._judged(state)))

    def _judged(self, state: State) -> Program:
        """Return the program that a rule sees: of a robust loss the linear estimator that its fit amounts to."""
        if not state.choice.robust:
            return state.program
        if self.reweigh is None:
            return state.program.on_squares(state.program.inlier_model(state.z))
        x = self.scale * state.z
        inliers = inliers_of(self.formulation, *self.source.configuration_errors(x))
        return state.program.on(around(self.source.linearize(x, inliers), self.about))

    # --- one step --------------------------------------------------------------------------------------------

    def advanced(self, state: State) -> State:
        """Solve the convex program at z; converge if it predicts no decrease, else step to its minimum, or damp."""
        if state.far and state.evaluations > FAR_ITERATIONS:
            return replace(state, outcome="far")
        try:
            solution = self._solved(state.program, state)
        except NoSolutionFound:
            if not 0 < state.damping <= DAMPING_MOST:
                raise
            # hardly identified directions, bounded by damping
            return replace(state, damping=DAMPING_GROWTH * state.damping, evaluations=state.evaluations + 1)
        choice, length = state.choice, state.relative(float(np.linalg.norm(solution - state.z)))
        predicted = state.merit - state.program.objective(solution, choice.weight)
        accuracy, best = self._accuracy(state)
        short, nothing = length <= self.options.tolerance, predicted <= accuracy
        if state.damping > 0 and (short or nothing) and state.stalled < STALLED_MOST:
            return replace(state, damping=0.0)  # a short step of a damped program proves nothing: take the full one
        at_rest = predicted <= best or state.stalled >= (STALLED if nothing else STALLED_MOST)
        if choice.settled and at_rest:
            return replace(state, outcome="converged")
        waiting = choice.settled and not choice.final and not choice.weights
        if waiting and state.damping == 0 and length <= NEAR_FIRST:  # where the first weight leads
            return self.selected(state)
        return self._stepped(state, solution, predicted, short, accuracy)

    def _stepped(self, state: State, solution: Array, predicted: float, short: bool, accuracy: float) -> State:
        """Step to a minimum if the nonlinear objective falls, else damp; one below ``accuracy`` promises nothing."""
        z = self._accelerated(state, solution)
        candidate = state.program.on(self.linearized(z, state.z))
        after = candidate.objective(z, state.choice.weight)
        rounding = ROUNDING * abs(state.merit) + state.floor
        fall, gain, nothing = state.merit - after, 1.0, predicted <= accuracy
        if predicted > 0 and not (nothing and abs(fall) <= rounding):  # otherwise rounding would cause damping
            gain = fall / predicted
        effect = float(np.sum((state.size * (z - state.z)) ** 2))
        damping = damped(state.damping, gain, predicted, effect)
        state = replace(state, evaluations=state.evaluations + 1, stalled=state.stalled + 1)
        if after < state.lowest - accuracy:
            state = replace(state, stalled=0, lowest=after)
        if after <= state.merit + rounding:
            return replace(self._accepted(state, candidate, z, after, short), damping=damping)
        state = replace(state, damping=damping)
        if (short or nothing) and state.choice.settled:
            return replace(state, outcome="converged")
        if short or nothing:
            return replace(state, choice=state.choice.after(0.0))
        if damping > DAMPING_MOST or not np.isfinite(damping):
            return replace(state, outcome="stalled")
        return state

    def _solved(self, program: Program, state: State) -> Array:
        o = self.options
        damping = Damping(state.z, np.diag(np.sqrt(state.damping) * state.size)) if state.damping else None
        how = {"solver": o.solver, "settings": o.settings, "verbose": o.verbose}
        return program.solve(state.choice.weight, damping=damping, **how).z

    def _accelerated(self, state: State, solution: Array) -> Array:
        """Let a step follow the curve of the residual: solve again, with b shifted by half the curvature along it.

        This is geodesic acceleration (Transtrum and Sethna 2012, arXiv:1201.5885).
        """
        step = solution - state.z
        source, model = self.source, state.program.model
        if not isinstance(source, CalibrationProblem) or state.relative(float(np.linalg.norm(step))) <= NEGLIGIBLE_STEP:
            return solution
        along = model.A @ step
        ahead = source.whitened_residual(self.scale * (state.z + CURVATURE_STEP * step))
        acceleration = (ahead - (model.b - model.A @ state.z) + CURVATURE_STEP * along) / CURVATURE_STEP**2
        if not np.isfinite(acceleration).all() or np.linalg.norm(acceleration) <= CURVATURE * np.linalg.norm(along):
            return solution
        try:
            by = self._solved(state.program.on(model.with_values(model.b + acceleration)), state) - solution
        except NoSolutionFound:
            return solution
        if 2 * np.linalg.norm(state.size * by) > CURVATURE_TURN * np.linalg.norm(state.size * step):
            return solution
        return solution + by

    def _accepted(self, state: State, candidate: Program, z: Array, after: float, short: bool) -> State:
        """Return the state at a better point, angles within half a turn."""
        length = float(np.linalg.norm(z - state.z))
        wrapped = self.source.parameters.free.wrapped(self.scale * z)
        if (wrapped != self.scale * z).any():
            turned = wrapped / self.scale
            moved = candidate.model.with_values(candidate.model.b + candidate.model.A @ (turned - z))
            candidate, z = candidate.on(moved), turned
            after = candidate.objective(z, state.choice.weight)
        passed = Iteration(after, length, state.choice.weight, state.damping)
        there = replace(
            state,
            z=z,
            program=candidate,
            merit=after,
            history=(*state.history, passed),
            size=np.maximum(state.size, np.linalg.norm(candidate.model.A, axis=0)),
            outcome="converged" if state.choice.settled and short else "",
        )
        return replace(there, choice=state.choice.after(there.relative(length)))

    def _accuracy(self, state: State) -> tuple[float, float]:
        """Return the predicted decrease that is none when it comes again and again, and that which is none at once."""
        exact = state.program.quadratic and state.program.box is not None
        size = max(abs(state.merit), state.floor)
        if exact and self.reweigh is None:
            return EXACT * size, -np.inf
        if not np.isfinite(state.merit):  # outside the functions' domain: any point inside is better
            return 0.0, -np.inf
        size = max(size, 1.0)  # an interior-point method's accuracy is absolute below one squared sigma
        return INTERIOR * size, BEST * size


@dataclass(frozen=True, eq=False)
class Ended:
    """Final state of the loop, deviations x (n,) [SI], and the optimality certificate."""

    state: State
    x: Array
    certificate: Certificate
    settled: bool = True

    @property
    def converged(self) -> bool:
        """Whether the loop converged to a solution that the certificate confirms."""
        return self.settled and self.state.outcome == "converged" and self.certificate.holds(self.state.z)


def minimize(
    problem: Source, formulation: Formulation, weight: float | Selector, start: Array | None, options: Options
) -> Ended:
    """Run the loop from deviations ``start`` (n,) [SI], and certify the result.

    Constraints on positions are linearized: the loop is repeated about its solution until both agree. If the solution
    moves as far as the linearization point, the next round linearizes between them.
    """
    loop = replace(Loop.of(problem, formulation, options), about=start)
    ended = _certified(loop, problem, loop.run(weight, start))
    if not ended.state.program.structure.predicts:
        return ended
    about = ended.x
    moved = np.zeros(len(about))
    for _ in range(ROUNDS - 1):
        loop = replace(loop, about=about)
        before = ended
        ended = _certified(loop, problem, loop.run(weight, ended.x))
        history = (*before.state.history, *ended.state.history)
        ended = replace(ended, state=replace(ended.state, history=history))
        step = ended.x - about
        if not ended.converged or ended.state.relative(float(np.linalg.norm(step / loop.scale))) <= SAME_POSITIONS:
            return ended
        factor = 0.0
        if moved.any():
            factor = np.linalg.norm((ended.x - before.x) / loop.scale) / np.linalg.norm(moved / loop.scale)
        # if the solution moves against the point by a factor, the fixed point is at 1 / (1 + factor) of the way
        share = max(1 / (1 + factor), LEAST_SHARE) if factor > 0.5 else 1.0
        moved = share * step
        about = about + moved
    return replace(ended, settled=False)


def nearby(problem: Source, formulation: Formulation, start: Array, steps: int) -> Array:
    """Return deviations (n,) [SI] at or near a minimum at weight 1, without a certificate."""
    loop = Loop.of(problem, formulation, Options(steps, ROUGH_TOLERANCE))
    return loop.scale * loop.run(1.0, start).z


def _certified(loop: Loop, problem: Source, state: State) -> Ended:
    """Certify the end of a loop by functions and model asked anew; blocks by the squares that stand for the loss."""
    model, residual = state.program.model, None
    if loop.source.keeps_rows:  # without rows in memory, the last iteration has to suffice
        anew = in_parts(problem.frozen())
        if isinstance(anew, CalibrationProblem):
            residual = lambda z: anew.whitened_residual(loop.scale * z)  # noqa: E731
        model = around(anew.linearize(loop.scale * state.z), loop.about)
    certificate = certified(loop.solved, model, state.z, state.choice.weight, state.floor, residual)
    return Ended(state, loop.scale * state.z, certificate)


def damped(damping: float, gain: float, predicted: float, effect: float) -> float:
    """Return the weight of the damping term after a step, from its gain ratio, predicted decrease and effect."""
    if gain < GAIN_POOR and effect > 0 and predicted > 0:
        return DAMPING_GROWTH * damping if damping else DAMPING_FIRST * predicted / effect
    if gain > GAIN_GOOD:
        damping = DAMPING_SHRINK * damping
        if damping * effect <= DAMPING_LEAST * predicted:
            return 0.0
    return damping
