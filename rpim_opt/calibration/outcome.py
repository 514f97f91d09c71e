"""Numerical results of a calibration: parameters, errors, uncertainty, and diagnostics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple, Self, get_args

import numpy as np
from scipy.special import chdtrc

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, NoSolutionFound, choices
from rpim_opt.basics.text import joined, three_digits
from rpim_opt.bayes.hyperparameters import ExcludedRow, Learned, sessions_log_std
from rpim_opt.bayes.outliers import by_block, coherent, contradicted, error_vectors
from rpim_opt.bayes.prior_terms import default_widths
from rpim_opt.calibration import diagnosis
from rpim_opt.calibration.certificate import Certificate
from rpim_opt.calibration.covariance import (
    UNLIKELY,
    FitCovariance,
    Interval,
    NoiseTest,
    coverage_factor,
    noise_covariances,
    noise_test,
    position_noise,
    row_dof,
)
from rpim_opt.calibration.diagnosis import ActiveBound, Flag, Outside, ShadowPrice
from rpim_opt.calibration.loop import Iteration
from rpim_opt.convex.constraints import Parsed, name_of
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.program import Program, pose
from rpim_opt.convex.quadratic import ridge, ridge_within
from rpim_opt.convex.robust_loss import inliers_of
from rpim_opt.convex.select import Selection
from rpim_opt.convex.structure import INVARIANT
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.pose import position
from rpim_opt.data.record import Record
from rpim_opt.problem.blocks import Source, in_parts
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.noise import in_unit
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.frames import fitted_frames, ridge_deviations
from rpim_opt.problem.registration.global_start import JointMapping
from rpim_opt.problem.row_functions import transform
from rpim_opt.robot.mdh import MDH, Robot
from rpim_opt.robot.parameters import own_name

CONTRADICTED = 1e-6  # p-value of the cost of constraints below which they contradict the data
COVERAGE_FACTOR = 2.0  # without a stated confidence: about 95 % of a normal distribution


class Prediction(NamedTuple):
    """Predicted positions (N, 3) in the instrument's frame [m] with their ``covariance`` (N, 3, 3) [m^2].

    ``coverage_factor`` is k of U = k u; (N, 1) if rows have own degrees of freedom: readings of an unknown session,
    whose offset is estimated from few sessions. ``outside`` are the rows beyond the measured joint ranges, where
    intervals may be too narrow.
    """

    position: Array
    covariance: Array
    coverage_factor: float | Array = COVERAGE_FACTOR
    outside: Outside = Outside()

    def __repr__(self) -> str:
        largest = float(np.max(self.coverage_factor, initial=0.0))
        return f"<Prediction of {len(self.position)} positions, coverage factor {largest:.3g}>"

    @property
    def standard(self) -> Array:
        """Standard uncertainties (N, 3) [m] of the coordinates."""
        return np.sqrt(np.einsum("nii->ni", self.covariance))

    @property
    def expanded(self) -> Array:
        """Expanded uncertainties U = k u (N, 3) [m] of the coordinates: half-widths of their intervals."""
        return self.coverage_factor * self.standard


@dataclass(frozen=True, eq=False)
class Outcome:
    """The numerical part of a `Calibration`, which documents the fields."""

    problem: Source
    formulation: Formulation
    x: Array
    weight: float
    selection: Selection | None
    converged: bool
    message: str
    history: tuple[Iteration, ...]
    program: Program
    certificate: Certificate
    calibrate_again: Callable[..., Self]
    record: Record = field(default_factory=Record)
    learned: Learned | None = None
    mapping: JointMapping | None = None
    excluded: Dataset | None = None
    known: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        vars(self).update(self.known)  # instead of computing the cached properties of these names

    @property
    def z(self) -> Array:
        """The deviations (n,) in units of their scales."""
        return self.x / self.problem.parameters.free.scale

    @cached_property
    def contradiction(self) -> str:
        """Sentence on constraints that data contradict; empty if there are none, or the loss has no quadratic model.

        If the constraints hold for the robot, the sum of squares without them is smaller by chi-square with one degree
        of freedom per active constraint, times the residuals' variance if that exceeds the noise. For a robust loss the
        squares are those of its inliers without constraints. A penalty that is not quadratic is no prior: a decrease of
        it alone does not count, and parameters where its slope jumps count as active.
        """
        program = self.program
        if not self.formulation.solvable or self.moves is None:
            return ""
        bare = pose(replace(program.formulation, constraints=()), program.model)
        try:
            best = bare.solve(self.weight).z
            kept = bare.inlier_model(best)
        except (InputError, NoSolutionFound):
            return ""
        sums = [float(np.sum((kept.A @ z - kept.b) ** 2)) + kept.offset for z in (self.z, best)]
        penalties = [self.penalty_weight * bare.value(z, self.weight)[1] for z in (self.z, best)]
        held, without = np.add(sums, penalties).tolist()
        fall = held - without if program.linear_penalty else min(held - without, sums[0] - sums[1])
        active = len(self.z) - self.moves.shape[1]
        variance = max(1.0, without / max(program.model.equations - len(self.z), 1))
        if chdtrc(active, max(fall, 0.0) / variance) > CONTRADICTED:
            return ""
        names = joined(self.active_constraints)
        conditional = ""
        if not self.no_intervals:
            conditional = "Standard deviations and intervals are conditional on them and too small. "
        return (
            f"The data contradict constraints ({names}): without them the sum of squared residuals and "
            f"penalty is {three_digits(without)} instead of {three_digits(held)}. {conditional}Check the nominal "
            "parameters, or loosen the constraints."
        )

    # --- the robot that was found ------------------------------------------------------------------------------

    @property
    def robot(self) -> Robot:
        """The robot with its identified MDH parameters, without model extensions.

        >>> import rpim_opt as ro
        >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, weight=1e-3)
        >>> (1e3 * (result.robot.mdh - result.problem.robot.mdh)[:, 3]).round(2)  # deviations of d [mm]
        array([0.17, 0.45, 0.45, 0.45, 3.82, 0.7 ])
        """
        return self.robots["" if "" in self.problem.arms else self.problem.robot.name]  # of several robots it names one

    @property
    def robots(self) -> Mapping[str, Robot]:
        """The robots with their identified MDH parameters by name, ``""`` for the only one, as of `robot`."""
        free = self.problem.parameters.free
        robots = {}
        for robot, nominal in self.problem.arms.items():
            mdh = nominal.mdh.copy()
            places = {f"{c}{i + 1}": (i, j) for i in range(len(mdh)) for j, c in enumerate(MDH)}
            for k in free.places_of(robot):
                place = places.get(own_name(free.names[k]))
                if place is not None:
                    mdh[place] += self.x[k]
            robots[robot] = replace(nominal, mdh=mdh)
        return robots

    def forward(
        self,
        q: Array,
        marker: str = "",
        torque: Array | None = None,
        payload: float | Array | None = None,
        columns: Mapping[str, Array] = MappingProxyType({}),
        robot: str = "",
    ) -> Array:
        """Return the transforms (N, 4, 4) of a reflector in the instrument's frame, with the identified parameters.

        They include base, robot and tool, transmissions and elasticity of joints, with joints in the middle of their
        backlash unless `columns` state directions; `forward_kinematics` is of the robot alone.

        q (N, dof) are joint values of the controller [rad or m]; ``marker`` and ``robot`` may be omitted if there is
        one; ``torque`` (N, dof) are joint torques [Nm], if compliances were identified from measured ones; ``payload``
        is the mass at the flange [kg], a number or (N,), instead of that of the robot's `Gravity`; ``columns`` are
        those of user-defined terms by name, (N,) each [SI], and "approach" (N, dof), the direction in which each joint
        came, -1 or 1, if backlash was identified.

        >>> import rpim_opt as ro
        >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, weight=1e-3)
        >>> result.forward([[0, 0, 0, 0, 0, 0]])[0, :3, 3].round(3)  # [m]
        array([ 0.822, -0.026,  0.197])
        """
        there = self.problem.sample().measuring(q, transform, marker, torque, payload, columns, robot)
        return there.modelled(self.x)[0].reshape(-1, 4, 4)

    def predict(
        self,
        q: Array,
        marker: str | Sequence[str] = "",
        torque: Array | None = None,
        payload: float | Array | None = None,
        of: Interval = "reached",
        columns: Mapping[str, Array] = MappingProxyType({}),
        robot: str = "",
        confidence: float | None = None,
    ) -> Prediction:
        """Return predicted positions of a reflector with their uncertainty; arguments as for `forward`.

        ``marker`` may also be N names, one per row. Positions are in the instrument's frame, with standard
        uncertainties u and expanded ones U = 2 u, or with ``confidence`` U = k u with Student's factor. ``of="mean"``
        is the uncertainty of the model's position, J C J'; ``"reached"`` that of the position reached by the robot,
        with its repeatability; ``"reading"`` that of the instrument's reading there. InputError for a penalty without
        covariance (lasso), for which `forward` gives the positions.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
        >>> where = result.predict(np.radians([[10, 20, -30, 40, 50, 60]]), of="mean")
        >>> where.position.round(3), (1e3 * where.standard).round(3)  # [m], [mm]
        (array([[ 1.522, -0.347,  0.972]]), array([[0.013, 0.014, 0.012]]))
        """
        if of not in get_args(Interval):
            raise InputError("of", f"'{of}'", choices(of, get_args(Interval)))
        fit = self.fit_covariance  # raises for a penalty without covariance before any computation
        noise = position_noise(self.problem)
        problem = self.problem.sample().measuring(q, position, marker, torque, payload, columns, robot, noise)
        N = len(problem.data)
        at, covariance, session = np.empty((N, 3)), np.empty((N, 3, 3)), np.zeros((N, 3, 3))
        added = noise_covariances(problem, self.variance_factor)
        whole = {"mean": [np.zeros((3, 3))] * len(added.robot), "reached": added.robot, "reading": added.reading}[of]
        parts = by_block(problem, problem.jacobian(self.x))
        for (block, J), positions, more, sessions in zip(
            parts, problem.modelled(self.x), whole, added.session, strict=True
        ):
            at[block.row] = positions
            covariance[block.row] = fit.of_positions(J) + more
            session[block.row] = sessions
        factor = COVERAGE_FACTOR if confidence is None else coverage_factor(self.noise_dof, confidence)
        if of == "reading" and confidence is not None and session.any():
            dof = row_dof(self.noise_dof, sessions_log_std(self.learned), covariance, session)
            factor = coverage_factor(dof, confidence)[:, None]
        return Prediction(at, covariance, factor, self.outside(problem.data))

    def outside(self, data: Dataset) -> Outside:
        """Return which rows are outside the measured joint ranges, where the model extrapolates."""
        return diagnosis.outside(self.ranges, data)

    @cached_property
    def ranges(self) -> Mapping[str, Array]:
        """The measured range of every joint (2, dof) [rad or m], by robot, including earlier calibrations."""
        return diagnosis.measured_ranges(self.problem, self.record.earlier)

    # --- errors ------------------------------------------------------------------------------------------------

    def error_vectors(self, data: Dataset | None = None, nominal: bool = False) -> Array:
        """Return measured minus modelled position of every row, (N, 3) [m]; NaN without a measured position.

        By default of the identification data; with ``nominal``, of the nominal robot as in `nominal_errors`.
        """
        source, x = self._at(data, nominal)
        return np.concatenate([error_vectors(part, x) for part in source.rows()])

    def errors(self, data: Dataset | None = None, dimension: str = "length") -> Array:
        """Return the norm of every row's residual, (N,) [m], of the identification data by default.

        ``dimension="angle"`` is the orientation error [rad], NaN for rows without one; ``"pixel"`` an image error.

        >>> import rpim_opt as ro
        >>> instance = ro.load("pose")
        >>> result = ro.calibrate(instance.problem, ro.tikhonov, weight=1.0)
        >>> [f"{1e3 * result.errors(instance.validation, d).mean():.3f}" for d in ("length", "angle")]  # mm, mrad
        ['0.044', '0.101']
        """
        source, x = self._at(data)
        return source.errors(x, dimension)

    def nominal_errors(self, data: Dataset | None = None, dimension: str = "length") -> Array:
        """Return the error of every row for the nominal robot, (N,) [m]; arguments as for `errors`.

        Frames (base, reflectors, anchors, ...) that the calibration identifies are first fitted to the identification
        data, in an update also to the earlier ones: their nominal values do not describe the robot.
        """
        source, x = self._at(data, nominal=True)
        return source.errors(x, dimension)

    def _at(self, data: Dataset | None, nominal: bool = False) -> tuple[Source, Array]:
        """Return the problem, on some data, and its solution; or that which identifies frames alone."""
        source, x = self._nominal if nominal else (self.problem, self.x)
        return source if data is None else source.on(data), x

    @cached_property
    def _nominal(self) -> tuple[Source, Array]:
        """The problem that identifies frames only, and its solution under the prior of the scales.

        A recalibration uses its own prior, the earlier rows: the new ones may determine few frames.
        """
        form, p = self.program.penalty_form, self.stated.parameters
        frames = p.of_frames & p.identified
        if not self.record.earlier or form is None or not frames.any():
            return fitted_frames(self.stated)
        alone = self.stated.identifying(frames)
        free, of = self.problem.parameters.free, alone.parameters.free
        k = [free.names.index(name) for name in of.names]
        return alone, ridge_deviations(alone, prior=(form.matrix[:, k] / free.scale[k] * of.scale, form.c))

    @cached_property
    def stated(self) -> Source:
        """The original problem, without estimated scales, noise and model extensions."""
        learned = self.learned
        if learned is None:
            return self.problem
        p = self.problem.parameters
        scale = p.scale.copy()
        scale[p.identified] = learned.stated
        identified = p.identified & ~np.isin(p.names, learned.added)
        bare = self.problem.with_repeatability(None)
        bare = bare.with_parameters(replace(p, scale=scale, identified=identified))
        return bare if learned.curves is None else bare.with_transmission(())

    # --- how the fit is, and what it rests on ------------------------------------------------------------------

    @property
    def penalty_weight(self) -> float:
        """The weight, zero where there is no penalty."""
        return 0.0 if self.formulation.penalty is None else self.weight

    @property
    def selector(self) -> str:
        """Name of the rule that chose the weight; ``given`` for a number, ``none`` without a penalty."""
        if self.formulation.penalty is None:
            return "none"
        if self.record.earlier:
            return "earlier result"
        if self.learned is not None:
            return "learned"
        return "given" if self.selection is None else self.selection.name

    @property
    def squared_loss(self) -> bool:
        """Whether the requested loss is quadratic, even if blocks were solved with other squares."""
        return self.program.loss_form is not None and not self._reweighed

    @property
    def _reweighed(self) -> bool:
        """Whether blocks were solved with squares in the place of another loss."""
        return self.program.formulation is not self.formulation and self.formulation.loss not in INVARIANT

    @cached_property
    def squares(self) -> LinearModel:
        """The equations of the loss's quadratic model at the solution, multiplied by a factor."""
        program = self.program
        source = in_parts(self.problem)
        if self._reweighed:
            inliers = inliers_of(self.formulation, *source.configuration_errors(self.x))
        else:
            inliers = program.inliers(self.z)
        if inliers is None:
            return program.squared
        return inliers(program.model, self.z)[0] if source.keeps_rows else source.linearize(self.x, inliers)

    @cached_property
    def moves(self) -> Array | None:
        """Orthonormal basis (n, k) of the steps of z that active constraints permit; None if none is active."""
        return self.program.tangent(self.z, self.penalty_weight) if self.formulation.solvable else None

    @cached_property
    def fit_covariance(self) -> FitCovariance:
        """Covariance of the fit, from the equations that it keeps and its penalty.

        InputError for a penalty that is not quadratic, or a loss without a quadratic model.
        """
        if not self.program.linear_penalty:
            raise self.no_covariance("`forward` and monte_carlo work with any formulation")
        form = ridge(self.squares, self.program.penalty_form)
        if self.moves is not None:  # conditional on the active constraints
            form = ridge_within(self.squares, self.program.penalty_form, self.moves, self.z)
        level, drift = (None, None) if self.learned is None else (1.0, self.learned.drift)
        if len(self.record.opened):
            drift = self.record.opened if drift is None else np.hstack([drift, self.record.opened])
        return FitCovariance(self.squares, form, self.penalty_weight, self.z, level, drift)

    @property
    def _undefined(self) -> str:
        """The reason why there is no covariance; empty where there is one."""
        of = f"of formulation '{self.formulation.name}'"
        if not self.program.linear_penalty:
            return f"the penalty {of} is not quadratic; only a normal prior has a posterior covariance"
        if self.known_covariance is None:
            return f"the loss {of} has no quadratic model: it depends on a few equations or has variables of its own"
        return ""

    def no_covariance(self, instead: str) -> InputError:
        """Return the error that states why there is no covariance, and what serves ``instead``."""
        accepted = f"a squared penalty or none, and a loss with a gradient; {instead}"
        return InputError("uncertainty", self._undefined, accepted)

    @property
    def no_intervals(self) -> str:
        """Return a sentence on why there are no intervals; empty where there are."""
        return f"No uncertainties or prediction intervals: {self._undefined}." if self._undefined else ""

    @property
    def variance_factor(self) -> float:
        """Ratio of the noise variance to the stated one if significantly larger, otherwise 1."""
        if self.known_covariance is None or self.noise_test().probability >= UNLIKELY:
            return 1.0
        return max(self.fit_covariance.noise_variance, 1.0)

    def noise_test(self) -> NoiseTest:
        """Test the residuals against the measurement noise.

        >>> import rpim_opt as ro
        >>> ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml).noise_test().verdict
        'Residuals agree with the measurement noise (ratio 1.02; by chance 0.81 to 1.19 in 99 % of fits).'
        """
        linear = self.squares
        squares = float(np.sum((linear.A @ self.z - linear.b) ** 2)) / linear.factor
        if self.problem.repeatability is not None:
            bare = self.problem.with_repeatability(None)
            squares = float(sum(np.sum(part.whitened_errors(self.x)[0] ** 2) for part in bare.rows()))
        return noise_test(squares, self.fit_covariance.residual_dof)

    @property
    def noise_dof(self) -> float:
        """Degrees of freedom of the noise: those of its estimate, or the residual ones, m - sum f."""
        if self.learned is not None:
            return self.learned.noise_dof
        return max(self.fit_covariance.residual_dof, 0.0)

    @property
    def covariance(self) -> Array:
        """Covariance of the deviations (n, n) [SI]: C = sigma^2 S (A'A + weight I)^-1 S + D D'.

        `Uncertainty` documents its contents and validity; D D' is zero with a weight of your own. It is conditional on
        active constraints; variances that neither data nor penalty determine are infinite.
        """
        return self.fit_covariance.covariance

    @property
    def known_covariance(self) -> Array | None:
        """The `covariance` (n, n) [SI]; None for a penalty or loss without one."""
        try:
            return self.covariance
        except InputError:
            return None

    def parameter_rows(self) -> list[dict[str, Any]]:
        """Return parameter, unit, nominal, identified, deviation and std of every identified parameter, in that unit.

        ``std`` is None if the formulation has no covariance, or an infinite one.
        """
        free = self.problem.parameters.free
        C = self.known_covariance
        std = np.full(len(self.x), np.inf) if C is None else np.sqrt(np.diag(C))
        columns = {"nominal": free.nominal, "identified": free.values(self.x), "deviation": self.x, "std": std}
        return free.rows(columns)

    @cached_property
    def flagged(self) -> tuple[Flag, ...]:
        """Outliers, the worst first: rows above `robust_loss.outlying` for the noise of the other rows.

        After a robust loss only those that a fit without them contradicts, since it may fit half of few rows at the
        expense of the other half. After a squared loss outliers may mask each other: a robust loss finds them.

        >>> import rpim_opt as ro
        >>> result = ro.calibrate(ro.load("blunders").problem, ro.robust, weight=1.0)
        >>> len(result.flagged), len(result.without_flagged().flagged)
        (5, 0)
        """
        flags = diagnosis.flagged(self.problem, self.x)
        problem, program = self.problem, self.program
        if not flags or self.squared_loss or not program.linear_penalty or not isinstance(problem, CalibrationProblem):
            return flags
        model, free = program.model, problem.parameters.free
        if len(model.b) != len(problem.owners):  # reduced to a QR factor
            return flags
        number = dict(zip(problem.labels, problem.data.configuration, strict=True))
        groups = np.array([number[flag.label] for flag in flags])
        try:
            weight = self.penalty_weight / self.squares.factor
        except InputError:  # a loss with own variables has no quadratic model for that test
            return flags
        sure = contradicted(model, program.penalty_form, weight, default_widths(free) / free.scale, groups)
        return tuple(flag for flag, certain in zip(flags, sure, strict=True) if certain)

    @property
    def left_out(self) -> tuple[ExcludedRow, ...]:
        """The outliers that were excluded before the fit."""
        return () if self.learned is None else self.learned.left_out

    @cached_property
    def clustered(self) -> tuple[str, ...]:
        """Labels of flagged rows whose errors are correlated with those of neighbours in joint space or time.

        They are not outliers: the model is incomplete there, or the setup moved. `without_flagged` keeps them.
        """
        problem = self.problem
        if not self.flagged or not isinstance(problem, CalibrationProblem):
            return ()
        rows = np.flatnonzero(np.isin(problem.labels, [flag.label for flag in self.flagged]))
        return tuple(problem.labels[i] for i in rows[coherent(problem, self.x, rows)])

    @property
    def single(self) -> tuple[Flag, ...]:
        """The outliers that are not `clustered`."""
        return tuple(flag for flag in self.flagged if flag.label not in self.clustered)

    @property
    def outliers(self) -> list[str]:
        """Labels of all outliers: excluded before the fit, and flagged after it."""
        return [row.label for row in (*self.left_out, *self.flagged)]

    def without_flagged(self) -> Self:
        """Return the calibration without the flagged rows, with the same formulation, selector and solver.

        `clustered` rows stay: without them the robot would be extrapolated where the model fails.
        """
        rest = self.stated.without({flag.label for flag in self.single})
        size = {f.label: in_unit(f.error, f.dimension) for f in self.single}
        reasons = {f.label: f"outlier, {f.sigmas:.0f} standard deviations, {size[f.label]}" for f in self.single}
        record = replace(self.record, excluded={**self.record.excluded, **reasons}, digest="")
        return replace(self.calibrate_again(rest), record=record)

    @cached_property
    def active_bounds(self) -> tuple[ActiveBound, ...]:
        """The parameters at an active bound, the largest multiplier first.

        ``gain`` is the decrease of the root of the loss per equation (for a squared loss the whitened RMS) for
        loosening the bound by a tenth of its size, computed from its multiplier. A large gain is an alarm: wrong data,
        or nominal parameters that do not describe this robot.
        """
        program, z = self.program, self.z
        if program.box is None or not program.formulation.constraints:
            return ()
        low, high = program.box
        parameters, rows = program.model.parameters, program.model.equations
        multiplier = np.sum(self._multipliers, axis=0)
        loss = program.value(z)[0]
        bounds = []
        for i in np.flatnonzero((multiplier > 0) & (low < high)):
            bound = float(min(low[i], high[i], key=lambda side: abs(z[i] - side)))
            less = max(loss - 0.1 * abs(bound) * multiplier[i], 0.0)
            gain = float(np.sqrt(loss / rows) - np.sqrt(less / rows))
            scale = float(parameters.scale[i])
            bounds.append(ActiveBound(parameters.names[i], bound * scale, float(multiplier[i]), gain))
        return tuple(sorted(bounds, key=lambda held: -held.gain))

    @cached_property
    def shadow_prices(self) -> tuple[ShadowPrice, ...]:
        """Shadow prices of textual constraints (`constraints.parse`), in their order; empty if there are none."""
        program, z = self.program, self.z
        constraints, parameters = program.formulation.constraints, program.model.parameters
        texts = [(i, parsed) for i, parsed in enumerate(constraints) if isinstance(parsed, Parsed)]
        if not texts:
            return ()
        misfit = program.objective(z, self.weight)
        prices = []
        for i, parsed in texts:
            unit, si = parsed.unit
            slack = parsed.slack(z, parameters)
            multiplier = parsed.price(self._multipliers[i], parameters)
            gain = min(multiplier * parsed.step, misfit)
            figures = max(slack, 0.0) / si, multiplier * si, parsed.step / si, gain, misfit
            prices.append(ShadowPrice(parsed.text, unit, *figures))
        return tuple(prices)

    @cached_property
    def _multipliers(self) -> Sequence[Array]:
        """Multipliers of the formulation's constraints, zero where they are not active."""
        return self.program.active_multipliers(self.z, self.weight)

    @cached_property
    def active_constraints(self) -> tuple[str, ...]:
        """Names of the formulation's active constraints, on which intervals are conditional."""
        constraints = self.formulation.constraints
        if not constraints or not self.formulation.solvable:
            return ()
        return tuple(name_of(constraints[k], k) for k, values in enumerate(self._multipliers) if values.any())

    @cached_property
    def actively_constrained(self) -> tuple[str, ...]:
        """Names of the parameters at an active bound or in an active textual constraint."""
        names = [held.name for held in self.active_bounds]
        holding = {price.text for price in self.shadow_prices if price.holds}
        for constraint in self.formulation.constraints:
            if isinstance(constraint, Parsed) and constraint.text in holding:
                names += constraint.names(self.program.model.parameters)
        return tuple(dict.fromkeys(names))
