"""The outer loop: linearize, choose the weight, solve, step, until nothing changes; and its result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from rpim_opt.dataset import Dataset
from rpim_opt.exceptions import InputError
from rpim_opt.formulation import FEASIBLE, ConvexProgram, Formulation, tikhonov
from rpim_opt.frames import relocated
from rpim_opt.problem import CalibrationProblem
from rpim_opt.robot import MDH, Array, Robot
from rpim_opt.selection import Selection, Selector
from rpim_opt.text import table
from rpim_opt.units import display

SETTLED = 1e-3
"""The weight is chosen anew while a step is longer than this part of the solution, then stays."""


@dataclass(frozen=True)
class Iteration:
    """One pass of the loop: the nonlinear objective after it, the step's length and how often it was halved."""

    objective: float
    step: float
    weight: float
    halvings: int


@dataclass(frozen=True, eq=False)
class Calibration:
    """The result of a calibration.

    Parameters
    ----------
    problem, formulation
        What was asked.
    x
        (n,) identified deviations [SI], in the order of ``problem.parameters.free``.
    weight, selection
        The weight, and the choice it comes from (None when it was given).
    converged, message
        Whether the loop came to rest, and how it ended.
    history
        One entry a pass.
    program
        The convex program at the last linearization.
    """

    problem: CalibrationProblem
    formulation: Formulation
    x: Array
    weight: float
    selection: Selection | None
    converged: bool
    message: str
    history: tuple[Iteration, ...]
    program: ConvexProgram

    def errors(self, data: Dataset | None = None, dimension: str = "length") -> Array:
        """Return the position error of every row, (N,) [m]; of the identification data by default.

        With ``dimension="angle"`` the orientation error [rad], NaN for rows that are no poses.
        """
        return (self.problem.on(data) if data else self.problem).errors(self.x, dimension)

    def nominal_errors(self, data: Dataset | None = None) -> Array:
        """Return the position error of every row before calibration, (N,) [m].

        The robot is as its drawing says. Frames (base, reflectors, anchors, ...) that the calibration identifies
        are fitted to the identification data first: before that they say nothing about the robot.
        """
        problem, x = self._nominal
        return (problem.on(data) if data else problem).errors(x)

    @cached_property
    def _nominal(self) -> tuple[CalibrationProblem, Array]:
        """The problem that identifies frames alone, and its solution under the prior that the scales state."""
        frames = self.problem.parameters.of_frames & self.problem.parameters.identified
        if not frames.any():
            return self.problem, np.zeros_like(self.x)
        fitted = calibrate(self.problem.identifying(frames), tikhonov, 1.0)
        return fitted.problem, fitted.x

    @property
    def robot(self) -> Robot:
        """The robot with its identified MDH parameters."""
        mdh = self.problem.robot.mdh.copy()
        free = self.problem.parameters.free
        places = {f"{c}{i + 1}": (i, j) for i in range(len(mdh)) for j, c in enumerate(MDH)}
        for name, deviation in zip(free.names, self.x, strict=True):
            if name in places:
                mdh[places[name]] += deviation
        return replace(self.problem.robot, mdh=mdh)

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the deviations (n, n) [SI]: C = sigma^2 S (A'A + weight I)^-1 S.

        That is the Bayesian covariance with the prior that the penalty stands for; sigma^2 =
        RSS / (m - dof), dof = sum s_i^2 / (s_i^2 + weight), or the declared noise where no equation is
        left over. It holds for a squared loss, squared penalty and inactive constraints. Directions that
        neither data nor penalty see are infinite.
        """
        model = self.program.model
        _, s, Vt = model.svd
        total = s**2 + (self.weight if self.formulation.penalty is not None else 0.0)
        dof = float(np.sum(s[s > 0] ** 2 / total[s > 0]))
        spare = len(model.b) - dof
        rss = float(np.sum((model.A @ (self.x / model.parameters.scale) - model.b) ** 2))
        variance = rss / spare if spare > 1e-6 else 1.0
        scaled = np.divide(variance, total, out=np.zeros_like(total), where=total > 0)
        C = (Vt.T * scaled) @ Vt
        unseen = np.sum(Vt[total == 0] ** 2, axis=0) > 1e-12
        C[unseen, unseen] = np.inf
        return C * np.outer(model.parameters.scale, model.parameters.scale)

    def parameter_rows(self) -> list[dict[str, Any]]:
        """Return name, unit, nominal, identified, deviation and std of every identified parameter."""
        free, rows = self.problem.parameters.free, []
        values, std = free.values(self.x), np.sqrt(np.diag(self.covariance))
        for i, name in enumerate(free.names):
            unit, si = display(free.dimensions[i])
            rows.append(
                {
                    "name": name,
                    "unit": unit,
                    "nominal": float(free.nominal[i] / si),
                    "identified": float(values[i] / si),
                    "deviation": float(self.x[i] / si),
                    "std": float(std[i] / si) if np.isfinite(std[i]) else None,
                }
            )
        return rows

    def parameter_table(self) -> str:
        """Return the identified parameters as a table of text."""
        head = ["parameter", "unit", "nominal", "identified", "deviation", "std"]
        rows = []
        for r in self.parameter_rows():
            std = "-" if r["std"] is None else f"{r['std']:.4f}"
            figures = [f"{r['nominal']:.4f}", f"{r['identified']:.4f}", f"{r['deviation']:+.4f}", std]
            rows.append([r["name"], r["unit"], *figures])
        return table(head, rows)

    def __str__(self) -> str:
        """Return the parameters and errors as a person reads them."""
        before, after = (1e3 * e.mean() for e in (self.nominal_errors(), self.errors()))
        errors = f"Identification error (mean): {before:.4f} mm before, {after:.4f} mm after."
        return "\n".join([self.parameter_table(), "", errors, self.weight_sentence(), self.message])

    @property
    def selector(self) -> str:
        """Name of the rule that chose the weight, ``given`` for a number, ``none`` where there is no penalty."""
        if self.formulation.penalty is None:
            return "none"
        return self.selection.name if self.selection else "given"

    def weight_sentence(self) -> str:
        """Say the weight and where it came from."""
        if self.formulation.penalty is None:
            return f"Formulation '{self.formulation.name}' has no penalty and needs no weight."
        origin = self.selector + (f": {self.selection.note}" if self.selection else "")
        return f"Weight {self.weight:.4g} ({origin}), formulation '{self.formulation.name}'."


def calibrate(
    problem: CalibrationProblem,
    formulation: Formulation = tikhonov,
    weight: float | Selector = 0.0,
    *,
    start: Array | None = None,
    max_iterations: int = 20,
    tolerance: float = 1e-8,
    progress: Callable[[Iteration], None] | None = None,
) -> Calibration:
    """Identify the parameters of a problem.

    Every pass linearizes at the current deviations, solves for the *total* deviation and takes the
    step, halved until the nonlinear objective falls. The loop ends when a step is shorter than
    ``tolerance * (1 + ||z||)``; its fixed point is a stationary point of the nonlinear problem.

    Parameters
    ----------
    problem
        What was measured, and what is to be identified.
    formulation
        The convex program of a pass.
    weight
        A number, or a selector, which sees identification data only. It is asked anew until the steps
        become small; then the weight stays.
    start
        (n,) deviations [SI] to begin with; nominal by default, and then frames that are stated metres or half a
        turn from where the data put them count from there (`frames.relocated`). The answer does not depend on
        a given start, as long as the loop converges: the deviations count from nominal all the same.
    max_iterations, tolerance
        When to stop. A calibration that did not converge says so in ``converged`` and ``message``.
    progress
        Called after every pass.

    Raises
    ------
    InputError
        For fewer equations than unknowns without a penalty.
    NoSolutionFound
        When a convex program fails.
    """
    elsewhere = relocated(problem) if start is None else None
    problem = elsewhere or problem
    scale = problem.parameters.free.scale
    begin = np.zeros(len(scale)) if start is None else np.asarray(start, dtype=float)
    if begin.shape != scale.shape or not np.isfinite(begin).all():
        raise InputError("start", f"shape {begin.shape}", f"{len(scale)} deviations, finite, one a parameter")
    z = begin / scale
    model = problem.linearize(scale * z)
    fixed = None if callable(weight) else float(weight)
    if len(model.b) < len(z) and (formulation.penalty is None or fixed == 0):
        found = f"{len(model.b)} equations for {len(z)} parameters"
        raise InputError("data", found, "at least as many equations, or a formulation with penalty and weight")
    program, selection, history = formulation.compile(model), None, []
    lam, settled = fixed or 0.0, fixed is not None or formulation.penalty is None
    converged = False
    message = f"Not converged: {max_iterations} passes were not enough; give more, or a larger weight."
    for _ in range(max_iterations):
        if not settled and callable(weight):
            selection = weight(program)
            lam = selection.weight
        before = _objective(program, z, lam)
        start_feasible = program.violation(z) <= FEASIBLE
        step = program.solve(lam).z - z
        length, room = float(np.linalg.norm(step)), 1 + float(np.linalg.norm(z))
        for halvings in range(12):
            trial = z + step / 2**halvings
            candidate = program.on(problem.linearize(scale * trial))
            after = _objective(candidate, trial, lam)
            if after <= before * (1 + 1e-9) or not start_feasible or length <= tolerance * room:
                break
        else:
            message = "Not converged: no step along the solution lowers the nonlinear objective; check the start."
            break
        z, program = trial, candidate
        history.append(Iteration(after, length, lam, halvings))
        if progress:
            progress(history[-1])
        if settled and length <= tolerance * (1 + float(np.linalg.norm(z))):
            converged, message = True, f"Converged after {len(history)} passes."
            break
        settled = settled or length <= SETTLED * room or len(history) >= max_iterations // 2
    if elsewhere:
        message += " Frames were stated far from where the data put them; their deviations count from there."
    return Calibration(problem, formulation, scale * z, lam, selection, converged, message, tuple(history), program)


def _objective(program: ConvexProgram, z: Array, weight: float) -> float:
    """Value of the nonlinear problem at z, where ``program`` was linearized."""
    loss, penalty = program.value(z)
    return loss + weight * penalty
