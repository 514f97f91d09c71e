"""The outer loop: linearize, choose the weight, solve, step, until nothing changes; and its result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import cvxpy as cp
import numpy as np
from scipy.stats import chi2

from rpim_opt.dataset import Dataset
from rpim_opt.exceptions import InputError, NoSolutionFound
from rpim_opt.files import write_json
from rpim_opt.formulation import FEASIBLE, ConvexProgram, Estimate, Formulation, outlying, tikhonov
from rpim_opt.frames import relocated
from rpim_opt.markup import html_table
from rpim_opt.measurement import Measurement, position
from rpim_opt.phases import phase
from rpim_opt.problem import CalibrationProblem, LinearModel
from rpim_opt.record import Record, content
from rpim_opt.robot import MDH, Array, Robot
from rpim_opt.selection import SELECTORS, Selection, Selector, disagreement
from rpim_opt.streaming import in_parts
from rpim_opt.text import table
from rpim_opt.threads import one_blas_thread
from rpim_opt.units import display

MOST_REGIONS, SHRINK = 30, 0.25
"""How often a trust region may shrink in one pass, and by how much. Full steps that work need none."""
SETTLED = 1e-3
"""The weight is chosen anew while a step is longer than this part of the solution, then stays."""


@dataclass(frozen=True)
class Iteration:
    """One pass of the loop: the nonlinear objective after it, the step's length, and the trust region it needed."""

    objective: float
    step: float
    weight: float
    radius: float


class Flag(NamedTuple):
    """A row that a calibration distrusts: its residual in sigmas, and its error [mm]."""

    label: str
    sigmas: float
    error_mm: float


class Prediction(NamedTuple):
    """Predicted positions (N, 3) [m], their covariances (N, 3, 3) [m^2], and the coverage factor of their intervals."""

    position: Array
    covariance: Array
    coverage_factor: float = 1.0

    @property
    def standard(self) -> Array:
        """Standard uncertainties (N, 3) [m] of the coordinates."""
        return np.sqrt(np.einsum("nii->ni", self.covariance))

    @property
    def expanded(self) -> Array:
        """Half widths (N, 3) [m] of the intervals of the coordinates."""
        return self.coverage_factor * self.standard


_TRANSFORM = Measurement(
    "transform", lambda T: ca.vec(T.T), {f"t{i}{j}": "" for i in range(4) for j in range(4)}, noise={"entry": ""}
)
"""What `Calibration.forward` evaluates: the reflector's transform, row by row."""


class Held(NamedTuple):
    """A parameter at its bound [SI], the bound's multiplier, and the gain of loosening it by a tenth."""

    name: str
    bound: float
    multiplier: float
    gain: float


class Certificate(NamedTuple):
    """How well the conditions of a solution are met; see `Calibration.certificate`."""

    gradient: float | None
    step: float
    violation: float


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
    record
        Where the data come from, for files and reports.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> result = ro.calibrate(instance.problem, ro.tikhonov, weight=ro.l_curve)
    >>> for name, errors in (("nominal", result.nominal_errors), ("identified", result.errors)):
    ...     print(f"{name:10} {1e3 * errors(instance.validation).mean():.3f} mm")
    nominal    2.649 mm
    identified 0.032 mm
    >>> result.selector, result.linear_penalty, result.penalty_weight == result.weight, result.equations
    ('l_curve', True, True, 27)
    >>> result.parameter_rows()[1]["name"], round(result.parameter_rows()[1]["deviation"], 2)  # [mm]
    ('a1', 0.01)
    >>> print(result.parameter_table().splitlines()[0])
     parameter   unit    nominal   identified   deviation      std
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
    record: Record = field(default_factory=Record)

    def save(self, path: str | Path, record: Record | None = None) -> None:
        """Write everything to one JSON file, which `load_result` reads; the file is whole or not written at all.

        Parameters
        ----------
        path
            The file, or a folder for ``result.json``.
        record
            Title, validation data and input files, as in ``load(...).record``; the calibration's own by default.

        Raises
        ------
        InputError
            For a `PartitionedProblem`, whose measurements the file cannot repeat.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> instance = ro.load("paper_arm")
        >>> ro.calibrate(instance.problem, ro.tikhonov, weight=1e-3).save("result.json", instance.record)
        >>> ro.load_result("result.json").record.title
        "The paper's cooperative manipulator"
        """
        if not self.problem.complete:
            raise InputError("save", "measurements in parts", "measurements in memory, which the file repeats")
        path = Path(path) / "result.json" if Path(path).is_dir() else Path(path)
        write_json(path, content(self if record is None else replace(self, record=record)))

    def forward(self, q: Array, marker: str = "", torque: Array | None = None) -> Array:
        """Return the transforms (N, 4, 4) of a reflector in the instrument's frame, with the identified parameters.

        Base, robot and tool, gears and joints' elasticity included; of `robot` alone: `forward_kinematics`.

        Parameters
        ----------
        q
            (N, dof) joint values of the controller [rad or m].
        marker
            The reflector; the only one by default.
        torque
            (N, dof) joint torques [Nm], where the compliance of joints is identified.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, weight=1e-3)
        >>> result.forward([[0, 0, 0, 0, 0, 0]])[0, :3, 3].round(3)  # [m]
        array([ 0.822, -0.026,  0.197])
        """
        return self._at(q, _TRANSFORM, marker, torque).modelled(self.x)[0].reshape(-1, 4, 4)

    def predict(self, q: Array, marker: str = "", torque: Array | None = None) -> Prediction:
        """Return the positions that a reflector will have, with their uncertainty; arguments as for `forward`.

        Positions in the instrument's frame; their covariance J C J', without the noise of a new measurement, at
        coverage factor 1. `Uncertainty.predict` states the factor of a confidence.

        Raises
        ------
        InputError
            For a penalty without covariance (lasso).

        Examples
        --------
        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
        >>> where = result.predict(np.radians([[10, 20, -30, 40, 50, 60]]))
        >>> where.position.round(3), (1e3 * where.standard).round(3)  # [m], [mm]
        (array([[ 1.522, -0.347,  0.972]]), array([[0.013, 0.014, 0.012]]))
        """
        if not self.linear_penalty:
            accepted = "a squared penalty or none; `forward` gives the positions alone"
            raise InputError("uncertainty", f"formulation '{self.formulation.name}'", accepted)
        problem = self._at(q, position, marker, torque)
        J = problem.jacobian(self.x).reshape(len(problem.data), 3, -1)
        return Prediction(problem.modelled(self.x)[0], np.einsum("nij,jk,nlk->nil", J, self.covariance, J))

    def _at(self, q: Array, measurement: Measurement, marker: str, torque: Array | None) -> CalibrationProblem:
        """Return the problem with a reflector seen by some measurement at the joint values q (N, dof)."""
        q = np.atleast_2d(np.asarray(q, dtype=float))
        data = Dataset.of(q, np.zeros((len(q), len(measurement.columns))), 1.0, measurement=measurement)
        torques = None if torque is None else np.reshape(np.asarray(torque, dtype=float), (len(q), 1, -1))
        return self.problem.on(replace(data, blocks=(replace(data.blocks[0], markers=(marker,), torque=torques),)))

    def error_vectors(self, data: Dataset | None = None, nominal: bool = False) -> Array:
        """Return measured minus modelled position of every row, (N, 3) [m]; NaN where no position was measured.

        Parameters
        ----------
        data
            The rows; of the identification data by default.
        nominal
            Of the model before calibration, as in `nominal_errors`.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> instance = ro.load("paper_arm")
        >>> result = ro.calibrate(instance.problem, ro.tikhonov, weight=1e-3)
        >>> (1e3 * result.error_vectors(instance.validation, nominal=True)[0]).round(2)  # [mm]
        array([-2.13, -0.71, -2.93])
        """
        problem, x = self._nominal if nominal else (self.problem, self.x)
        problem, start = problem.on(data) if data else problem, 0
        vectors, residual = np.full((len(problem.data), 3), np.nan), problem.residual(x)
        for block in problem.data.blocks:
            names = list(block.measurement.components)
            part = residual[start : start + len(block.row) * len(names)].reshape(-1, len(names))
            start += part.size
            if {"x", "y", "z"} <= set(names):
                vectors[block.row] = part[:, [names.index(axis) for axis in "xyz"]]
        return vectors

    def measured_positions(self, data: Dataset | None = None) -> Array:
        """Return the measured position of every row, (N, 3) [m]; the identified reflector's where none was measured.

        >>> import rpim_opt as ro
        >>> result = ro.calibrate(ro.load("cable").problem, ro.tikhonov, weight=1.0)
        >>> result.measured_positions()[0].round(2)  # [m]
        array([0.41, 0.35, 1.53])
        """
        data, points = data or self.problem.data, np.empty((len(data or self.problem.data), 3))
        for block in data.blocks:
            names = list(block.measurement.columns)
            torque = None if block.torque is None else block.torque[:, 0]
            modelled = self.forward(block.q[:, 0], block.markers[0], torque)[:, :3, 3]
            seen = {"x", "y", "z"} <= set(names)
            points[block.row] = block.y[:, [names.index(axis) for axis in "xyz"]] if seen else modelled
        return points

    def errors(self, data: Dataset | None = None, dimension: str = "length") -> Array:
        """Return the norm of every row's residual, (N,) [m]: for positions and poses the position error.

        Parameters
        ----------
        data
            The rows; the identification data by default.
        dimension
            ``"length"``, or ``"angle"`` for the orientation error [rad], NaN for rows that are no poses.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> instance = ro.load("pose")
        >>> result = ro.calibrate(instance.problem, ro.tikhonov, weight=1.0)
        >>> [f"{1e3 * result.errors(instance.validation, d).mean():.3f}" for d in ("length", "angle")]  # mm, mrad
        ['0.044', '0.101']
        """
        return (self.problem.on(data) if data else self.problem).errors(self.x, dimension)

    def nominal_errors(self, data: Dataset | None = None, dimension: str = "length") -> Array:
        """Return the error of every row before calibration, (N,) [m]; arguments as for `errors`.

        The robot is as its drawing says. Frames (base, reflectors, anchors, ...) that the calibration identifies
        are fitted to the identification data first: before that they say nothing about the robot.
        """
        problem, x = self._nominal
        return (problem.on(data) if data else problem).errors(x, dimension)

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
        """The robot with its identified MDH parameters; ratios, eccentricities and compliances are no part of it.

        >>> import rpim_opt as ro
        >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, weight=1e-3)
        >>> (1e3 * (result.robot.mdh - result.problem.robot.mdh)[:, 3]).round(2)  # deviations of d [mm]
        array([0.17, 0.45, 0.45, 0.45, 3.82, 0.7 ])
        """
        mdh = self.problem.robot.mdh.copy()
        free = self.problem.parameters.free
        places = {f"{c}{i + 1}": (i, j) for i in range(len(mdh)) for j, c in enumerate(MDH)}
        for name, deviation in zip(free.names, self.x, strict=True):
            if name in places:
                mdh[places[name]] += deviation
        return replace(self.problem.robot, mdh=mdh)

    @property
    def penalty_weight(self) -> float:
        """The weight, zero where there is no penalty."""
        return self.weight if self.formulation.penalty is not None else 0.0

    @property
    def linear_penalty(self) -> bool:
        """Whether the penalty is a squared norm, or there is none: the estimate is then linear in the data."""
        return self.formulation.penalty in (None, cp.sum_squares) and self.formulation.penalty_over is None

    @cached_property
    def equations(self) -> int:
        """How many equations the fit rests on: all m, with a robust loss those that it trusts."""
        if self.linear.stands_for is not None:
            return self.linear.stands_for
        return int(np.count_nonzero(np.any(self.linear.A != 0, axis=1) | (self.linear.b != 0)))

    @cached_property
    def _factor(self) -> float:
        """By how much a robust loss weighs the rows that it trusts, against the squared loss."""
        whole, part = self.program.model.A, self.linear.A
        rows = np.linalg.norm(part, axis=1) > 0
        return float(np.sum(part[rows] ** 2) / np.sum(whole[rows] ** 2)) if rows.any() else 1.0

    @cached_property
    def noise_variance(self) -> float:
        """sigma^2 = RSS / (m - dof) in units of the declared variance, or 1 where no equation is left over.

        >>> import rpim_opt as ro
        >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
        >>> round(result.noise_variance, 2), result.equations, round(result.degrees_of_freedom, 1)
        (1.04, 120, 26.5)
        """
        model = self.linear
        spare = self.equations - self.degrees_of_freedom
        rss = float(np.sum((model.A @ (self.x / model.parameters.scale) - model.b) ** 2))
        return rss / spare / self._factor if spare > 1e-6 else 1.0

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the deviations (n, n) [SI]: C = sigma^2 S (A'A + weight I)^-1 S.

        That is the Bayesian covariance with the prior that the penalty stands for (`Uncertainty` takes it apart).
        It holds for a squared loss, or for what a robust loss trusts, a squared penalty and inactive bounds.
        Directions that neither data nor penalty see are infinite.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
        >>> deviation = 1e3 * np.sqrt(np.diag(result.covariance))
        >>> f"a2 to {deviation[result.problem.parameters.free.names.index('a2')]:.3f} mm"
        'a2 to 0.007 mm'
        """
        _, s, Vt = self.linear.svd
        total = s**2 + self.penalty_weight
        scaled = np.divide(self.noise_variance * self._factor, total, out=np.zeros_like(total), where=total > 0)
        C = (Vt.T * scaled) @ Vt
        unseen = np.sum(Vt[total == 0] ** 2, axis=0) > 1e-12
        C[unseen, unseen] = np.inf
        scale = self.linear.parameters.scale
        return C * np.outer(scale, scale)

    @cached_property
    def flagged(self) -> tuple[Flag, ...]:
        """Rows that the fit distrusts, the worst first.

        Those beyond `formulation.outlying`, with the noise that the other rows show. After a squared loss blunders may
        hide behind each other: a robust loss finds them.

        >>> import rpim_opt as ro
        >>> result = ro.calibrate(ro.load("blunders").problem, ro.robust, weight=1.0)
        >>> len(result.flagged), len(result.without_flagged().flagged)
        (5, 1)
        """
        v, k = self.problem.whitened_errors(self.x)
        limit, error = outlying(v, k), 1e3 * self.errors()
        noise = limit / np.sqrt(chi2.ppf(1 - 0.01 / len(v), k))
        labels = self.problem.data.label
        return tuple(
            Flag(labels[i], float(v[i] / noise[i]), float(error[i])) for i in np.argsort(-v) if v[i] > limit[i]
        )

    def without_flagged(self) -> Calibration:
        """Return the calibration without the flagged rows, with the same formulation and selector."""
        data = self.problem.data.without({flag.label for flag in self.flagged})
        weight = SELECTORS.get(self.selection.name, self.weight) if self.selection else self.weight
        reasons = {f.label: f"distrusted, {f.sigmas:.0f} sigmas, {f.error_mm:.2f} mm" for f in self.flagged}
        record = replace(self.record, excluded={**self.record.excluded, **reasons})
        return replace(calibrate(self.problem.on(data), self.formulation, weight), record=record)

    @cached_property
    def linear(self) -> LinearModel:
        """The last linearization, of the rows that a robust loss trusts (`ConvexProgram.trusted`).

        >>> import rpim_opt as ro
        >>> ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, weight=1e-3).linear.A.shape
        (27, 26)
        """
        return self.program.trusted(self.x / self.problem.parameters.free.scale)

    @cached_property
    def degrees_of_freedom(self) -> float:
        """Degrees of freedom of the fit, sum s_i^2 / (s_i^2 + weight) with the singular values s_i of `linear`.

        >>> import rpim_opt as ro
        >>> problem = ro.load("paper_arm").problem
        >>> [round(ro.calibrate(problem, ro.tikhonov, weight).degrees_of_freedom, 1) for weight in (1e-3, 1e3)]
        [19.8, 5.9]
        """
        s = self.linear.svd[1]
        return float(np.sum(s[s > 0] ** 2 / (s[s > 0] ** 2 + self.penalty_weight)))

    @cached_property
    def _again(self) -> Estimate:
        """The solution of the convex program at the end, solved once more."""
        return self.program.solve(self.weight)

    @cached_property
    def held(self) -> tuple[Held, ...]:
        """What the tolerances cost: the parameters that a bound holds back, the costliest first.

        ``gain`` is by how much the root of the loss per equation (for a squared loss the whitened RMS) would fall if
        the bound were loosened by a tenth of its size, from its multiplier. A large gain is an alarm: wrong
        data, or a drawing that does not describe this robot.

        >>> import rpim_opt as ro
        >>> problem = ro.load("paper_arm").problem
        >>> tight = problem.parameters.toleranced({"length_mm": 0.5})
        >>> result = ro.calibrate(ro.CalibrationProblem(problem.robot, tight, problem.data), ro.bounded, weight=1e-3)
        >>> [f"{held.name} at {1e3 * held.bound:+.1f} mm, gain {held.gain:.2g}" for held in result.held[:2]]
        ['d6 at +0.5 mm, gain 0.085', 'a3 at -0.5 mm, gain 0.032']
        """
        box = self.program.box
        if box is None or not self.formulation.constraints:
            return ()
        z, parameters = self.x / self.problem.parameters.free.scale, self.problem.parameters.free
        multiplier = np.sum(self._again.duals, axis=0)
        loss, rows, found = self.program.value(z)[0], self.program.model.equations, []
        near = np.minimum(z - box[0], box[1] - z) < 1e-6 * (1 + np.abs(z))
        for i in np.flatnonzero((multiplier > 1e-6 * loss / rows) & near & (box[0] < box[1])):
            bound = box[1][i] if abs(z[i] - box[1][i]) < abs(z[i] - box[0][i]) else box[0][i]
            less = max(loss - 0.1 * abs(bound) * multiplier[i], 0.0)
            gain = float(np.sqrt(loss / rows) - np.sqrt(less / rows))
            found.append(Held(parameters.names[i], float(bound * parameters.scale[i]), float(multiplier[i]), gain))
        return tuple(sorted(found, key=lambda h: -h.gain))

    @cached_property
    def certificate(self) -> Certificate:
        """Evidence that this is a solution, computed anew and without the solver's word.

        ``gradient`` is that of the nonlinear problem (data of the last linearization, penalty, and multipliers of the
        bounds) relative to the data's at nominal; None where loss or penalty have no gradient. ``step`` is how far the
        convex program at the solution would still go, relative to 1 + |z|; ``violation`` by how much the constraints
        are missed, in units of the scales.

        >>> import rpim_opt as ro
        >>> certificate = ro.calibrate(ro.load("paper_arm").problem, ro.bounded, weight=1e-3).certificate
        >>> all(value < 1e-7 for value in certificate)
        True
        """
        z, program = self.x / self.problem.parameters.free.scale, self.program
        gradient = None
        if program.squared and program.box is not None:
            model = program.model
            g = 2 * (model.A.T @ (model.A @ z - model.b) + self.penalty_weight * z)
            box = program.box
            if self.formulation.constraints:
                at_low, at_high = z <= box[0] + 1e-9, z >= box[1] - 1e-9
                g = np.where((at_low & (g > 0)) | (at_high & (g < 0)), 0.0, g)
            start = in_parts(self.problem).linearize(np.zeros_like(self.x))
            gradient = float(np.linalg.norm(g) / max(float(np.linalg.norm(2 * start.A.T @ start.b)), 1e-300))
        step = float(np.linalg.norm(self._again.z - z) / (1 + np.linalg.norm(z)))
        return Certificate(gradient, step, program.violation(z))

    def _deviations(self) -> Array:
        """Return standard deviations (n,) [SI]; infinite where the formulation has none (lasso, minimax)."""
        unknown = np.full(len(self.x), np.inf)
        if not self.linear_penalty:
            return unknown
        try:
            return np.sqrt(np.diag(self.covariance))
        except InputError:  # a loss that no squared one stands for
            return unknown

    def parameter_rows(self) -> list[dict[str, Any]]:
        """Return name, unit, nominal, identified, deviation and std of every identified parameter, in that unit.

        ``std`` is None where the formulation has no covariance, or an infinite one.
        """
        free, rows = self.problem.parameters.free, []
        values, std = free.values(self.x), self._deviations()
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
        return table(*self._table())

    def _table(self) -> tuple[list[str], list[list[str]]]:
        head = ["parameter", "unit", "nominal", "identified", "deviation", "std"]
        rows = []
        for r in self.parameter_rows():
            std = "-" if r["std"] is None else f"{r['std']:.4f}"
            figures = [f"{r['nominal']:.4f}", f"{r['identified']:.4f}", f"{r['deviation']:+.4f}", std]
            rows.append([r["name"], r["unit"], *figures])
        return head, rows

    def __str__(self) -> str:
        """Return the parameters and errors as a person reads them."""
        return "\n".join([self.parameter_table(), "", *self._sentences()])

    def _repr_html_(self) -> str:
        """Return the same for a notebook."""
        return html_table(*self._table(), notes=self._sentences())

    def _sentences(self) -> list[str]:
        before, after = (1e3 * e.mean() for e in (self.nominal_errors(), self.errors()))
        errors = f"Identification error (mean): {before:.4f} mm before, {after:.4f} mm after."
        return [errors, self.weight_sentence(), *self.remarks()]

    @property
    def selector(self) -> str:
        """Name of the rule that chose the weight, ``given`` for a number, ``none`` where there is no penalty."""
        if self.formulation.penalty is None:
            return "none"
        return self.selection.name if self.selection else "given"

    def weight_sentence(self) -> str:
        """Say the weight and where it came from.

        >>> import rpim_opt as ro
        >>> print(ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=1.0).weight_sentence())
        Weight 1 (given), formulation 'Tikhonov'.
        """
        if self.formulation.penalty is None:
            return f"Formulation '{self.formulation.name}' has no penalty and needs no weight."
        origin = self.selector + (f": {self.selection.note}" if self.selection else "")
        text = f"Weight {self.weight:.4g} ({origin}), formulation '{self.formulation.name}'."
        return text if self.selection is None else " ".join(filter(None, [text, disagreement(self.program)]))

    def remarks(self) -> list[str]:
        """Say what a reader must know besides the figures: blunders, bounds that hold, what did not converge.

        >>> import rpim_opt as ro
        >>> ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=1.0, max_iterations=1).remarks()
        ['Not converged: 1 pass was not enough; give more, or a larger weight.']
        """
        lines = []
        if self.flagged:
            rows = ", ".join(f"{f.label} ({f.sigmas:.0f} sigmas, {f.error_mm:.2f} mm)" for f in self.flagged[:8])
            more = f" and {len(self.flagged) - 8} more" if len(self.flagged) > 8 else ""
            lines.append(f"Distrusted rows: {rows}{more}.")
            if self.formulation.loss is cp.sum_squares:
                lines.append("A squared loss lets such rows pull the fit: use formulation 'robust', or leave them out.")
        for h in self.held[:5]:
            unit, si = display(self.problem.parameters.dimension_of(h.name))
            tenth = f"{0.1 * abs(h.bound) / si:.3g} {unit}"
            lines.append(
                f"{h.name} is held at {h.bound / si:+.3g} {unit}: loosening its tolerance by {tenth} would lower the "
                f"whitened RMS by {h.gain:.2g}."
            )
        if not self.formulation.solvable:
            lines.append("The formulation has functions that the result's file cannot hold: it cannot be solved again.")
        return [*lines, self.message]


@one_blas_thread
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

    Every pass linearizes at the current deviations, solves for the *total* deviation and takes the step;
    where that does not lower the nonlinear objective, the program is solved again in a smaller trust region.
    The loop ends when a step is shorter than
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
        For fewer equations than unknowns without a penalty, and a start that does not fit.
    NoSolutionFound
        When a convex program fails.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> result = ro.calibrate(instance.problem, ro.tikhonov, weight=ro.reml)
    >>> print(f"{1e3 * result.errors(instance.validation).mean():.3f} mm. {result.message}")
    0.024 mm. Converged after 4 passes.
    """
    elsewhere = relocated(problem) if start is None else None
    problem, asked = elsewhere or problem, formulation
    solved, formulation = in_parts(problem).for_loss(asked)
    scale = problem.parameters.free.scale
    begin = np.zeros(len(scale)) if start is None else np.asarray(start, dtype=float)
    if begin.shape != scale.shape or not np.isfinite(begin).all():
        raise InputError("start", f"shape {begin.shape}", f"{len(scale)} deviations, finite, one a parameter")
    z = begin / scale
    model = solved.linearize(scale * z)
    fixed = None if callable(weight) else float(weight)
    if model.equations < len(z) and (formulation.penalty is None or fixed == 0):
        found = f"{model.equations} equations for {len(z)} parameters"
        raise InputError("data", found, "at least as many equations, or a formulation with penalty and weight")
    with phase("canonicalization"):
        program, selection, history = formulation.compile(model), None, []
    lam, settled = fixed or 0.0, fixed is not None or formulation.penalty is None
    converged, radius, names = False, np.inf, dict(zip(problem.data.configuration, problem.data.label, strict=True))
    passes = f"{max_iterations} passes were" if max_iterations != 1 else "1 pass was"
    message = f"Not converged: {passes} not enough; give more, or a larger weight."
    for _ in range(max_iterations):
        if not settled and callable(weight):
            with phase("selection"):
                selection = weight(program)
            lam = selection.weight
        before = _objective(program, z, lam)
        start_feasible = program.violation(z) <= FEASIBLE
        for _ in range(MOST_REGIONS):
            try:
                free = program.closed_form and np.isinf(radius)
                with phase("solve"):
                    estimate = program.path([lam])[0] if free else program.solve(lam, z, radius)
            except NoSolutionFound as error:
                raise error.naming(names) from None
            step = estimate.z - z
            length, room = float(np.linalg.norm(step)), 1 + float(np.linalg.norm(z))
            candidate = program.on(solved.linearize(scale * (z + step)))
            after = _objective(candidate, z + step, lam)
            if after <= before * (1 + 1e-9) or not start_feasible or length <= tolerance * room:
                break
            radius = SHRINK * float(np.max(np.abs(step)))
        else:
            message = (
                f"Not converged: no step lowers the nonlinear objective, not even one of {radius:.1e} scales; "
                "the formulation may have no minimum here, or the start be far off."
            )
            break
        touched = float(np.max(np.abs(step), initial=0.0)) > 0.99 * radius
        z, program = z + step, candidate
        history.append(Iteration(after, length, lam, radius))
        radius = 3 * radius if touched else np.inf if length < 0.1 * radius else radius
        if progress:
            progress(history[-1])
        if settled and length <= tolerance * (1 + float(np.linalg.norm(z))):
            converged, message = True, f"Converged after {len(history)} passes."
            break
        settled = settled or length <= SETTLED * room or len(history) >= max_iterations // 2
    else:
        last = [iteration.step for iteration in history[-4:]]
        if len(last) == 4 and min(last) > 0.5 * max(last):
            message = "Not converged: the steps no longer get shorter; the data hardly decide, give a larger weight."
    if elsewhere:
        message += " Frames were stated far from where the data put them; their deviations count from there."
    return Calibration(problem, asked, scale * z, lam, selection, converged, message, tuple(history), program)


def _objective(program: ConvexProgram, z: Array, weight: float) -> float:
    """Value of the nonlinear problem at z, where ``program`` was linearized."""
    loss, penalty = program.value(z)
    return loss + weight * penalty
