"""The verdict on a calibration: whether its robot is delivered, and if not, why; likely causes of a poor fit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, cast

import numpy as np
from scipy.special import fdtrc

from rpim_opt.basics.arrays import TINY, Array, rms
from rpim_opt.basics.exceptions import InputError, NotDelivered
from rpim_opt.basics.text import joined, listed, three_digits
from rpim_opt.basics.units import fits
from rpim_opt.bayes.empirical_bayes import OUTLIER_SEARCHES
from rpim_opt.calibration.diagnosis import flagged
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.calibration.uncertainty import held_out_errors, unregistered
from rpim_opt.convex.constraints import name_of
from rpim_opt.convex.program import pose
from rpim_opt.convex.robust_loss import by_place
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.record import HeldOut
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.causes.misreadings import Better, better_interpretation, sibling
from rpim_opt.problem.causes.positions import (
    better_interpretations,
    computed_columns,
    computed_rows,
    odd_column,
    other_places,
    other_rows,
    single_rows,
    unrelated_rows,
)
from rpim_opt.problem.causes.residuals import (
    MOVED,
    NOISY,
    NOTICED,
    SLIGHT,
    another_robot,
    shown_by_residuals,
    wrong_gear_ratio,
)
from rpim_opt.problem.causes.rows import (
    ANGULAR,
    FEWEST,
    REACH,
    all_q,
    beyond_limits,
    copied_rows,
    decimals_of,
    every_rounding,
    filled_rows,
    first,
    hardly_moved,
    in_table_order,
    left_out_together,
    moved_one_by_one,
    rounded,
    roundings,
    rows_without_values,
    shared_rows,
    stretched_length,
)
from rpim_opt.problem.noise import UNITS, in_unit
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.camera import camera_blocks
from rpim_opt.problem.registration.frames import fitted_frames, ridge_deviations
from rpim_opt.problem.registration.points import of_sessions
from rpim_opt.problem.row_functions import measured_torques, repeated
from rpim_opt.robot.mdh import MDH, Robot, numbered
from rpim_opt.robot.parameters import frame_of, own_name

BAD = "Larger than expected"
"""Beginning of the sentence on a fit with large residuals or deviations that is delivered all the same."""
SLIGHTLY = "Slight, but significant"
"""Beginning of the sentence on an effect in residuals that are as small as instrument and robot explain."""
LIMITED = "the formulation, not the robot, limits the fit"
"""Beginning of the cause if loss, penalty or constraints contradict the data."""
REMARKS = (BAD, SLIGHTLY)  # beginnings of sentences on delivered robots, too
OVERSTATED = 0.05  # residual RMS over the stated noise below which the statement is wrong; for nominal errors 1 / NOISY
REPEATABILITY = {
    "position": ("mm", 2e-3),
    "orientation": ("mrad", 8e-3),
    "joint": ("mrad", 5e-3),
    "reading": ("mm", 2e-3),
}
"""Estimated repeatability [m, rad] beyond any robot's, whatever the stated noise; a service robot had 5.3 mrad."""
MACHINED = {"alpha": ("mrad", 0.06), "beta": ("mrad", 0.06), "a": ("mm", 0.03), "d": ("mm", 0.03)}
"""Deviation of machined dimensions [rad, m] beyond any robot's; joint zeros, set at assembly, are not limited."""
UNUSUAL = {"length": 0.004, "angle": 0.05}
"""Deviation [m, rad] above which a wrong frame, for lengths also another robot, is more likely."""
SCALED, BY_CHANCE, STATED = 0.001, 0.005, 6
"""Common deviation of the longest link [m] above which a wrong scale is more likely, and its p-value: F test against
the other deviations of lengths, with their stated scale as that many more."""
UNSCALED, SIGMAS = 0.005, 3.0  # such a deviation beyond any machined robot's, also in stated standard deviations
MOST_SCALED = 0.3  # above it, not a scale but a unit is wrong
LENGTHS, PRIORS = 2, 0.75
"""Identified lengths needed for a common deviation; largest part of a deviation that the prior may determine."""
ALIKE = 0.045  # part of an effect on the data that others may leave if the data do not distinguish them
DEPENDENT = 1e-6  # relative singular value below which effects are linearly dependent
TAKES_PART = 0.1  # part of the largest share in an effect for which a frame parameter is named
WIDE = 1e4  # prior standard deviations of parameters without penalty
REPEATABLE = 2e-4  # upper bound on industrial robots' repeatability over arm length: data sheets state 0.02 to 0.1 mm
EXCLUDED = 0.25  # largest share of outliers
COMPUTED, COMPUTED_RMS = 0.05, 2e-5  # nominal RMS over the stated noise, and itself [m], of computed positions
ROUNDED = 1.1  # nominal RMS over the rounding of measured values, below which they were computed, too
SPARE = 2.0  # equations per parameter of the frames below which nominal errors may be zero
INTERPOLATED = 0.1  # residual degrees of freedom below which nothing checks a fit; 73 good small tables had 0.3 or more
WORSE = 3.0  # standard errors by which squared held-out errors exceed the nominal robot's
ROWS = 12  # fewer rows give no useful standard error: only twice the nominal error counts
UPWARD = 5.0  # standard deviations of a compliance below zero, which gravity cannot cause
NOTABLE = 0.5  # a joint's effect of compliance over the largest, below which wrong masses explain its sign
ELSEWHERE = 0.5  # part of the residuals left by identifying the base, below which its statement is wrong
HOPELESS = 20.0  # residuals over the stated noise from which an unexplained fit is reported
OUTSIDE = 2.0  # distance from the limits in ranges of a joint that no other zero explains
SCALES = 10.0  # scales by which a robot's parameter may deviate
LARGEST_CURVE = 0.01  # standard deviation of transmission errors [rad] beyond any gear's: real ones are below 1 mrad
LARGEST = {"length": 0.02, "angle": 0.05}  # a machined and assembled robot deviates by less than this [m, rad]
ARM = ("compliance", "moment", "ecc", "transmission")  # beginnings of extension parameters of the arm
NOTHING = (
    "None of the tested input mistakes explains the residuals. Check the nominal parameters; did the arm move while it "
    "was measured, or is it compliant?"
)


@dataclass(frozen=True)
class Verdict:
    """Whether the robot of a calibration is delivered.

    Exit codes, exports, compensation and the report follow it. ``reasons`` state why it is not delivered, a sentence
    each; empty if it is. ``caution`` is a condition that uncertainties do not include: estimated signs and zeros of
    joints, constraints that the data contradict, a stated frame whose error would appear as a large deviation of the
    robot, joints that hardly moved, inconsistent readings; empty without any.

    >>> import rpim_opt as ro
    >>> print(ro.calibrate(ro.load("position").problem, "tikhonov", 1.0, max_iterations=1).verdict)
    Not delivered. Not converged: 1 iteration was not enough; allow more (max_iterations).
    """

    reasons: tuple[str, ...] = ()
    caution: str = ""

    @property
    def delivered(self) -> bool:
        """Whether there is no reason against delivery."""
        return not self.reasons

    def __str__(self) -> str:
        word = "Delivered under a condition." if self.caution else "Delivered."
        return " ".join([word if self.delivered else "Not delivered.", *self.reasons, self.caution]).rstrip()

    def content(self) -> dict[str, Any]:
        """Return it as a document."""
        return {"delivered": self.delivered, "reasons": list(self.reasons), "caution": self.caution or None}

    def beside(self, causes: Sequence[str]) -> list[str]:
        """Return the likely causes that the reasons do not already mention."""
        return [text for text in causes if text not in self.reasons and not (self.reasons and text.startswith(REMARKS))]

    def require(self, forced: bool = False) -> str:
        """Return the note for a robot used despite its verdict; if it is delivered, its caution.

        NotDelivered with the reasons if it is not delivered, unless ``forced``.
        """
        if self.delivered:
            return self.caution
        if not forced:
            found = f"not delivered: {' '.join(self.reasons)}".rstrip(".")
            raise NotDelivered(
                "the calibration", found, "a delivered calibration, or --despite-verdict (despite_verdict=True)"
            )
        return f"Written despite the verdict. {self}"


def judge(result: Outcome, causes: Sequence[str] = ()) -> Verdict:
    """Return the verdict on a calibration, with likely input mistakes, one sentence each.

    A robot is not delivered if the fit did not converge; if an update does not explain its new rows; if residuals
    without outliers exceed both 3 times the stated noise and 0.3 % of the arm's length; if repeatability, deviations or
    share of outliers are beyond any robot's; if held-out errors exceed the nominal robot's; if the fit interpolates all
    rows; if the data were computed; or if an input mistake is likely. The limits were set on 48 tables with mistakes
    and 36 good ones; joint zeros are not limited. If the formulation limits the fit, that is the only reason besides
    held-out rows.
    """
    mapping = result.mapping.caution if result.mapping else ""
    stretch, sigmas = _stretch(result)
    scaled = [_like_a_scale(result, stretch)] * (abs(stretch) > UNSCALED and sigmas > SIGMAS)
    ambiguous = [] if scaled else [ambiguous_deviation(result)]
    conditions = (mapping, result.contradiction, *ambiguous, *_little_motion(result))
    caution = " ".join(filter(None, conditions))
    limited = tuple(text for text in causes if LIMITED in text)
    if limited:
        return Verdict((*limited, *_worse(result)), caution)
    reasons = [sentence for earlier in result.record.earlier[-1:] for sentence in earlier.unresolved]
    reasons += [] if result.converged else [result.message]
    reasons += [*_residuals(result), *_repeatability(result), *_deviations(result, bool(causes)), *scaled]
    out = {*np.array(result.problem.labels)[~kept_rows(result)].tolist(), *(row.label for row in result.left_out)}
    rows = len(out.union(result.problem.labels))
    if len(out) > EXCLUDED * rows:
        reasons.append(f"{len(out)} of {rows} rows are outliers, more than {EXCLUDED:.0%}.")
    reasons += [*_worse(result), *_computed(result), *causes]
    if not reasons:
        caution = " ".join(filter(None, (caution, scatter(result))))
    return Verdict(tuple(dict.fromkeys(reasons)), caution)


def ambiguous_deviation(result: Outcome) -> str:
    """Return a sentence if data do not distinguish deviations from errors of stated frames or of a scale.

    A wrong length of a stated tool appears as a deviation of the last d, a wrong lateral position as one of its theta.
    """
    free = result.problem.parameters.free
    least = [UNUSUAL.get(dimension, np.inf) for dimension in free.dimensions]
    size = np.where(free.of_frames, 0.0, np.abs(result.x) / least)
    worst = int(size.argmax())
    stated = _taking_part(result, worst) if result.problem.keeps_rows and size[worst] >= 1 else []
    if not stated:
        return _like_a_scale(result, _stretch(result)[0])
    return (
        f"{free.names[worst]} deviates by {in_unit(result.x[worst], free.dimensions[worst])}, which the data do not "
        f"distinguish from an error of the stated {joined(stated)}: check the stated value. If that is wrong, the "
        "identified parameters are valid only in combination with it."
    )


def scatter(result: Outcome) -> str:
    """Return a sentence if residuals exceed any industrial robot's repeatability and few rows are repeated."""
    size, ratio = residual_rms(result)["length"]
    most = REPEATABLE * arm_length(result.problem)
    blocks = result.problem.sample().data.blocks
    if ratio <= NOISY or size <= most or sum(len(block.row) - repeated(block).max() - 1 for block in blocks) >= FEWEST:
        return ""
    noise = f"{three_digits(ratio)} times the {'assumed' if result.record.noise_assumed else 'stated'} noise"
    tried = result.learned is not None and len(result.learned.trials) > 1
    bends = "" if tried else 'Does the arm bend under gravity, or do its gears err (model = "auto")? '
    return (
        f"Readings scatter by {three_digits(1e3 * size)} mm RMS, {noise} and more than industrial robots of this size "
        f"({three_digits(1e3 * most)} mm). {bends}Did the arm vibrate, or something shake the instrument? Is the "
        "reflector, tool or base loose? Are joint values commanded, not read? Repeat five configurations, and state "
        "the instrument's noise ([noise])."
    )


def _little_motion(result: Outcome) -> Iterator[str]:
    """Say which joints of a robot that was identified hardly moved, or that they were moved one by one."""
    p = result.problem.parameters
    if not (p.identified & ~p.of_frames).any():
        return
    still = [text for name, arm in result.problem.arms.items() for text in hardly_moved(arm, result.ranges[name])]
    if still:
        yield (
            f"Too little motion: {joined(still)}. The result is valid only near the measured values of these "
            "joints; measure configurations in which they move before using other values."
        )
    problem = result.problem.sample()
    if not result.record.earlier and any(
        moved_one_by_one(arm, all_q(problem.alone(name).data)) for name, arm in problem.arms.items()
    ):
        yield (
            "In nearly all rows one joint alone differs from a common configuration, so that the data do not show how "
            "joints act together: measure configurations in which all joints differ."
        )


def _stretch(result: Outcome) -> tuple[float, float]:
    """Return the common deviation of lengths, as by a wrong scale, in stated standard deviations, too; 0 for none."""
    free, C = result.problem.parameters.free, result.known_covariance
    # meaningless for rows that do not fit, and for another robot
    if C is None or any(_residuals(result)) or any(_deviations(result)):
        return 0.0, 0.0
    lengths = (np.array(free.dimensions) == "length") & ~free.of_frames & (free.nominal != 0)
    fit = result.fit_covariance  # lengths that only the prior determines are near nominal
    lengths &= np.isfinite(np.diag(C)) & (fit.weight * np.diag(fit.form.prior(fit.weight)) < PRIORS)
    if lengths.sum() < LENGTHS:
        return 0.0, 0.0
    nominal, x = free.nominal[lengths], result.x[lengths]
    scale = free.scale if result.learned is None else result.learned.stated
    precision = np.linalg.inv(C[np.ix_(lengths, lengths)] + np.diag(scale[lengths] ** 2))  # of estimated deviations
    information = nominal @ precision @ nominal
    stretch = float(nominal @ precision @ x / information)
    gain = stretch**2 * information
    freedom = len(x) - 1 + STATED
    others = (float(x @ precision @ x) - gain + STATED) / freedom
    seen = np.abs(stretch * nominal).max() >= SCALED and fdtrc(1, freedom, gain / others) < BY_CHANCE
    return stretch * bool(seen and abs(stretch) <= MOST_SCALED), float(np.sqrt(gain))


def _like_a_scale(result: Outcome, stretch: float) -> str:
    """Return the sentence on a common deviation of all lengths; empty for none."""
    if not stretch:
        return ""
    what = "an instrument of another scale: check its units and its compensation"
    if scaled_by_board(result):
        what = "a board of another size, which views do not identify: measure it over all its squares"
    return (
        f"Lengths of the robot deviate by {100 * stretch:+.2g} % in common, as with {what}. If that is the cause, the "
        "identified lengths are wrong by the same percentage; if the robot is of that size, multiply the lengths in "
        f"its file by {1 + stretch:.4f}."
    )


def scaled_by_board(result: Outcome) -> bool:
    """Return whether the stated size of a camera's board is the only measure of lengths."""
    cameras, blocks = camera_blocks(result.problem.sample().data), result.problem.sample().data.blocks
    return len(cameras) == len(blocks) and not any("stretch" in name for name in result.problem.parameters.free.names)


def _taking_part(result: Outcome, k: int) -> list[str]:
    """Return the stated frame parameters whose effect on the data is that of parameter k; none if it is not.

    Stated frames are those not identified, or held by prior or constraints. Effects of free frames are projected out.
    """
    p = result.problem.parameters
    framed = cast(CalibrationProblem, result.problem).identifying(p.identified | p.of_frames)
    every = framed.parameters.free
    mine = np.isin(every.names, p.free.names)
    x = np.zeros(len(mine))
    x[mine] = result.x
    effects = framed.linearize(x).A
    norms = np.maximum(np.linalg.norm(effects, axis=0), TINY)
    effects /= norms
    stated = ~mine | np.isin(every.names, result.actively_constrained)
    form = result.program.penalty_form
    if form is not None:  # within its prior, a stated parameter has less effect than the one that absorbed its error
        prior = np.vstack([result.penalty_weight**0.5 * form.matrix, np.eye(len(result.x)) / WIDE])
        width = np.linalg.norm(np.linalg.pinv(prior), axis=1)
        stated[mine] |= width * norms[mine] < min(width[k], np.abs(result.z[k])) * norms[mine][k]
    free, held = effects[:, every.of_frames & ~stated], every.placed & stated
    left = np.column_stack([effects[:, mine][:, k], effects[:, held]])
    left -= free @ np.linalg.pinv(free, rcond=DEPENDENT) @ left
    own = left[:, 0]
    parts = left[:, 1:] * np.linalg.lstsq(left[:, 1:], own, rcond=DEPENDENT)[0]
    if np.linalg.norm(own) < ALIKE or np.linalg.norm(own - parts.sum(axis=1)) > ALIKE * np.linalg.norm(own):
        return []
    part = np.linalg.norm(parts, axis=0)
    return np.array(every.names)[held][part > TAKES_PART * part.max()].tolist()


def kept_rows(result: Outcome) -> np.ndarray:
    """Return which rows (N,) are not flagged after a robust fit; rows that were excluded before it are not counted."""
    out = () if result.squared_loss else result.single
    return ~np.isin(result.problem.labels, [flag.label for flag in out])


def residual_rms(result: Outcome) -> dict[str, tuple[float, float]]:
    """Return the RMS residual [SI] of `kept_rows`, and its ratio to the stated noise, by dimension."""
    kept = kept_rows(result)
    errors = {each: np.where(kept, result.errors(dimension=each), np.nan) for each in UNITS}
    return {each: (rms(error), noise_ratio(result.problem, error, each)) for each, error in errors.items()}


def _worst_ratio(problem: CalibrationProblem, x: Array) -> float:
    """Return the largest `noise_ratio` of a problem's errors at x (n,)."""
    return max(noise_ratio(problem, problem.errors(x, each), each) for each in UNITS)


def noise_ratio(problem: Source, errors: Array, dimension: str = "length") -> float:
    """Return the RMS of errors (N,) [SI] over that of the stated noise; 0 if the dimension was not measured."""
    variance = stated_variance(problem, dimension)
    of = np.isfinite(errors) & (variance > 0)
    return rms(errors[of]) / float(np.sqrt(np.mean(variance[of]))) if of.any() else 0.0


def stated_variance(problem: Source, dimension: str) -> Array:
    """Return the stated noise variance of every row (N,) [SI]; zero if the row does not measure the dimension."""
    variance = np.zeros(len(problem.labels))
    start = 0
    for part in problem.rows():
        for block in part.data.blocks:
            of = [i for i, each in enumerate(block.measurement.components.values()) if each == dimension]
            variance[start + block.row] = np.einsum("nii->ni", block.covariance)[:, of].sum(axis=1)
        start += len(part.data)
    return variance


def arm_length(problem: Source) -> float:
    """Return the length of the longest arm stretched out [m], prismatic joints as far as they were measured."""
    return max(
        stretched_length(robot, (block for part in problem.rows() for block in part.data.blocks))
        for robot in problem.arms.values()
    )


def worse_than_nominal(nominal: Array, identified: Array, rows: str = "") -> str:
    """Return a sentence if errors (N,) [m] on some rows, or held-out ones, are larger than those of the nominal robot.

    They have to be significantly larger, by the mean difference of squares; otherwise the text is empty.
    """
    both = np.isfinite(nominal) & np.isfinite(identified)
    difference = identified[both] ** 2 - nominal[both] ** 2
    worse = rms(identified[both]) > 2 * rms(nominal[both])  # whatever the standard error is with few large errors
    if len(difference) >= ROWS:
        worse |= bool(difference.mean() > WORSE * difference.std(ddof=1) / np.sqrt(len(difference)))
    if not worse:
        return ""
    return (
        f"Errors on {rows or f'{len(nominal)} held-out rows'} are larger than those of the nominal robot: RMS "
        f"{three_digits(1e3 * rms(identified))} mm against {three_digits(1e3 * rms(nominal))} mm."
    )


# --- reasons ------------------------------------------------------------------------------------------------------


def _residuals(result: Outcome) -> Iterator[str]:
    """Say that residuals are beyond what instrument and robot make of them; of a camera in pixels and at the arm."""
    residuals = residual_rms(result)
    checked = _overdetermined(result)
    for each, (size, ratio) in residuals.items():
        nominal = noise_ratio(result.problem, result.nominal_errors(dimension=each), each)  # with fitted frames
        small = 0 < min(ratio / OVERSTATED, NOISY * nominal) < 1  # 0: it was not measured
        stated = each != "angle" or not result.record.noise_assumed  # that of orientations may be assumed far too large
        if checked and stated and size > COMPUTED_RMS and small:
            yield f"Residuals are {ratio:.2g} times the stated noise, which is in another unit or far too large."
    for each, largest in {"length": REACH * arm_length(result.problem), "angle": ANGULAR}.items():
        size, ratio = residuals[each]
        if each == "length":
            ratio = max(ratio, residuals["pixel"][1])
        if ratio > NOISY and size > largest:
            yield (
                f"Residual RMS {in_unit(size, each)}: {three_digits(ratio)} times the measurement noise; a robot's own "
                f"errors stay below {in_unit(largest, each)}."
            )


def _overdetermined(result: Outcome) -> bool:
    """Whether equations are so many that nominal errors with fitted frames do not vanish by themselves."""
    p = result.problem.parameters
    return result.program.model.equations >= SPARE * int((p.placed & p.identified).sum()) + 1


def _repeatability(result: Outcome) -> Iterator[str]:
    """Say that what was taken for repeatability or transmission errors is beyond those of any robot."""
    if result.learned is None:
        return
    noise, curves = result.learned.noise, result.learned.curves
    if curves is not None and curves.size.value > LARGEST_CURVE:
        yield (
            f"Estimated transmission errors {three_digits(1e3 * curves.size.value)} mrad (1 sigma): no gear is worse "
            f"than {1e3 * LARGEST_CURVE:g} mrad."
        )
    for kind in (kind for kind in noise if kind in REPEATABILITY):
        size, (unit, largest) = noise[kind], REPEATABILITY[kind]
        dimension = "length" if unit == "mm" else "angle"
        variance = stated_variance(result.problem, dimension)
        measured = variance[variance > 0]
        if len(measured) and kind != "joint":  # the stated noise is of all components together
            largest = max(largest, NOISY * float(np.sqrt(measured.mean() / 3)))
        if size.value > largest:
            yield (
                f"Estimated robot repeatability {three_digits(1e3 * size.value)} {unit} ({kind}): no robot is worse "
                f"than {1e3 * largest:.3g} {unit}."
            )


def _deviations(result: Outcome, named: bool = False) -> Iterator[str]:
    """Say which machined parameter deviates most, where no robot is machined so, and why if no cause is ``named``."""
    p = result.problem.parameters
    types = [(robot, *each) for robot, arm in result.problem.arms.items() for each in enumerate(arm.joint_types, 1)]
    zeros = {p.called(robot, f"d{joint}") for robot, joint, kind in types if kind == "prismatic"}
    kinds = [own_name(name).rstrip("0123456789") for name in p.free.names]
    size = np.zeros(len(kinds))
    for i, (name, kind) in enumerate(zip(p.free.names, kinds, strict=True)):
        if kind in MACHINED and kind != own_name(name) and name not in zeros:
            size[i] = abs(result.x[i]) / MACHINED[kind][1]
    i = int(size.argmax())
    if size[i] > 1:
        unit, largest = MACHINED[kinds[i]]
        alike = [k for k in np.argsort(-size) if size[k] > 1 and MACHINED[kinds[k]] == MACHINED[kinds[i]]]
        amounts = [f"{p.free.names[k]} deviates by {three_digits(1e3 * float(result.x[k]))} {unit}" for k in alike]
        cause = "" if named else _cause(result, i, largest)
        yield f"{listed(amounts, 3)}: manufacturing errors stay below {1e3 * largest:g} {unit}. {cause}".rstrip()


def _cause(result: Outcome, i: int, largest: float) -> str:
    """Return why the identified parameter at i deviates by more than any robot does, beyond ``largest`` [SI]."""
    form = result.program.penalty_form
    penalized = result.weight > 0 and form is not None and form.matrix[:, i].any()
    C = result.known_covariance
    if not penalized and C is not None and C[i, i] > largest**2:
        return "Neither data nor penalty determines it: add a penalty on it, or do not identify it."
    if not any(_residuals(result)):
        return (
            "The data fit with these values: check the robot file for misprints, and whether it describes this robot "
            "(a standard DH table has a and alpha one row earlier than a modified one)."
        )
    return "Check the order, signs and units of the joint columns, and the DH table."


def _worse(result: Outcome) -> Iterator[str]:
    """Say that the robot misses rows by more than the nominal one, or that none is left to tell."""
    sentence = worse_than_nominal(result.nominal_errors(), result.errors(), "the identification rows")
    if sentence and result.learned is None:
        tight = ", or constraints are too tight" if result.formulation.constraints else ""
        sentence = f"{sentence.removesuffix('.')}: the weight is too large{tight}."
    yield from filter(None, [sentence])
    held, validation = result.record.held_out, result.record.validation
    if held is None and validation is not None:
        held = held_out_errors(result, validation)
    if held is None:
        checked = result.record.earlier or result.known_covariance is None  # an update is judged by the earlier result
        if not checked and result.fit_covariance.residual_dof < INTERPOLATED:
            yield (
                f"The fit interpolates the data: {result.program.model.equations} equations leave no residual degrees "
                "of freedom, and no validation data check it. Measure more configurations."
            )
        return
    said = worse_than_nominal(held.nominal, held.error)
    if not said and rms(result.errors()) < rms(held.error):
        said = implausible(result, held)
    if said:
        read = ""
        if validation is not None and result.problem.keeps_rows:
            read = unregistered(result, validation, held) or misread(result, validation)
        yield f"Held-out rows do not fit. {read}" if read else said


def implausible(result: Outcome, held: HeldOut) -> str:
    """Return a sentence if most errors on held-out rows are larger than any robot's own; otherwise an empty text.

    Errors of the same size on the calibration's own rows mean another fault; errors that the uncertainty of a
    calibration from few rows explains mean none.
    """
    error, most = held.error, REACH * arm_length(result.problem)
    if held.fit is not None and held.fit.likely:
        return ""
    if not np.isfinite(error).any() or np.nanmedian(error) <= most or np.nanmedian(result.errors()) > most:
        return ""
    return (
        f"Median error on {len(error)} held-out rows {three_digits(1e3 * float(np.nanmedian(error)))} mm: a robot's "
        f"own errors stay below {100 * REACH:g} % of the arm's length. Either the instrument or the base moved (then "
        "--register in `validate`, `monitor` or `accept`), or another reflector, tool or robot was measured."
    )


def _computed(result: Outcome) -> Iterator[str]:
    """Say that the nominal robot explains the data to rounding: they were computed with it."""
    problem = result.problem
    measured = stated_variance(problem, "length") > 0
    if not _overdetermined(result) or not measured.any():
        return
    errors = result.nominal_errors()
    nominal = rms(errors[measured])
    rounding: list[float] = []  # RMS rounding error [m], none beyond four decimals of a millimetre
    for block in (block for part in problem.rows() for block in part.data.blocks):
        lengths = [i for i, dimension in enumerate(block.measurement.columns.values()) if dimension == "length"]
        decimals = decimals_of(1e3 * block.y[:, lengths]) if lengths else None
        rounding.append(0.0 if decimals is None else 1e-3 * 10.0**-decimals * np.sqrt(len(lengths) / 12))
    beside = ""
    if nominal < COMPUTED_RMS and noise_ratio(problem, errors) < COMPUTED:
        beside = "far below the measurement noise: the data seem to be computed from this robot, not measured."
    elif min(rounding) > 0 and nominal < ROUNDED * np.hypot(
        max(rounding), sum(each.made for each in every_rounding(problem.sample()) if each.step)
    ):
        beside = "no more than rounding causes: the data seem to be computed from this robot, or have too few decimals."
    if beside:
        yield f"The error of the nominal robot is {1e3 * nominal:.2g} mm RMS, {beside}"


# --- likely causes ------------------------------------------------------------------------------------------------


def likely_causes(result: Outcome) -> list[str]:
    """Return the likely causes of a poor fit, one sentence each; empty if the fit is good.

    A fit is poor if it did not converge, if rows that are not downweighted have residuals above `NOISY` times the
    stated noise, or if it deviates by many scales. Then other interpretations (`better_interpretation`), rows without
    values, exchanged rows, rounded joints and a base that moved are sought. If residuals exceed the noise at all,
    systematic parts are sought in them, and common properties of excluded rows. Contradicted known values come first;
    data in blocks are checked for these only.

    >>> from dataclasses import replace
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> block = problem.data.blocks[0]
    >>> wrong = replace(block, q=block.q[:, :, [0, 2, 1, 3, 4, 5]])
    >>> result = ro.calibrate(problem.on(replace(problem.data, blocks=(wrong,))), ro.tikhonov, weight=1.0)
    >>> causes = ro.calibration.likely_causes(result)
    >>> causes[1].partition(" with ")[2]
    'joints 2 and 3 exchanged: exchange the columns of joints 2 and 3.'
    """
    known = [] if result.learned is None else list(result.learned.contradicted)
    if not result.problem.keeps_rows:
        return known
    problem = cast(CalibrationProblem, result.problem)
    residuals = residual_rms(result)
    noticed = max(ratio for _, ratio in residuals.values()) > NOTICED
    signs = [*_large_residuals(result, residuals), *_large_deviations(result)]
    head = [f"{BAD}: {'; '.join(signs)}."] if signs else []
    ordered = in_table_order(problem, result.excluded, result.record.validation)
    shared = list(shared_rows(problem.data, result.record.validation))
    copied = list(copied_rows(problem.data))
    together = list(left_out_together(problem.labels, {row.label for row in result.left_out}))
    if result.mapping is not None:
        shared += result.mapping.ambiguities
    if known:
        causes, shared = [], [*known, *shared]
    elif signs or not result.converged:
        explanations = [
            _held(result, problem),
            _limited_by_formulation(result, problem),
            _other_readings(result, problem, ordered),
        ]
        if any(_deviations(result)):  # a misread table makes no robot; of another robot a frame may be wrong
            explanations.insert(0, explanations.pop())
        causes = first(computed_columns(problem), *explanations, _residual_causes(result, problem, ordered))
        ignored = result.record.details.get("ignored_joints")
        if ignored:
            state = "if these move the tool, state another robot (a rail is its first joint), or a tip link beyond them"
            causes.insert(0, f"joint values {ignored} are ignored (the robot has {problem.robot.dof} joints): {state}.")
        shared += together
    elif (other := _other_robot(result, problem)) is not None:
        causes = [other.sentence]
        shared += together
    else:
        causes, remarks = _beside_a_good_fit(result, problem, ordered, together, noticed)
        shared += remarks
    if noticed:
        causes += _upward(result, problem)
    if causes or shared or copied:
        return [*head, *copied, *(f"Likely: {cause}" for cause in causes), *shared]
    return [*head, NOTHING] if max(ratio for _, ratio in residuals.values()) > HOPELESS else []


def _beside_a_good_fit(
    result: Outcome, problem: CalibrationProblem, ordered: CalibrationProblem, together: list[str], noticed: bool
) -> tuple[list[str], list[str]]:
    """Return likely causes visible in single rows or residuals, and remarks: limits of the fit, slight effects.

    ``together`` are sentences on excluded rows next to each other, ``noticed`` states that residuals exceed the noise.
    """
    kept, parts = kept_rows(result), of_sessions(ordered)
    causes = list(filled_rows(ordered.data))  # which may fit
    if result.excluded is not None and len(problem.arms) == 1:
        by_result = [replace(part, robots=result.robot) for part in parts]
        apart = of_sessions(problem.on(result.excluded))
        causes = first(
            *map(single_rows, parts),
            *map(computed_rows, apart),
            *(explain(part) for explain in (other_places, other_rows) for part in by_result),
            *(another_robot(part, result.robot) for part in apart),
        )
    elif result.excluded is not None or not kept.all():
        causes = first(*map(single_rows, parts))
    if causes:
        causes[-1] += " The other rows fit: calibrate again with these corrected, or left out ([exclude])."
        return causes, []
    if len(problem.arms) > 1:
        return [], together
    limits = [*_held(result, problem), *_limited_by_formulation(result, problem)] if noticed else []
    if limits:
        return [], [*(f"{BAD}: residuals; {text}" for text in limits), *together]
    alone, x = _without_outliers(result, ordered, again=noticed)
    error = rms(problem.errors(result.x)[kept])
    causes = first(
        _in_place_of_extensions(result, alone),
        shown_by_residuals(alone, x) if noticed else (),
        roundings(problem, error, (1 - MOVED) ** -0.5) if noticed else (),
    )
    if causes:
        return causes, together
    slight = roundings(problem, error, (1 - SLIGHT) ** -0.5)
    effects = first(slight, shown_by_residuals(alone, x, most=SLIGHT))
    return [], [*(f"{SLIGHTLY}: {text}" for text in effects), *together]


def _large_residuals(result: Outcome, residuals: Mapping[str, tuple[float, float]]) -> Iterator[str]:
    """Say which residuals are beyond the stated noise, and which transmission errors beyond those of gears."""
    for dimension, (size, ratio) in residuals.items():
        if ratio > NOISY:
            yield f"residual RMS {in_unit(size, dimension)}, {three_digits(ratio)} times the measurement noise"
    if result.learned is None or result.learned.curves is None:
        return
    size, ratio = result.learned.curves.size.value, result.noise_test().ratio
    if size > LARGEST_CURVE:
        yield f"transmission errors of {three_digits(1e3 * size)} mrad (1 sigma)"
    if ratio > NOISY:
        noise = f"{three_digits(ratio)} times the measurement noise"
        yield f"residuals {noise}, corrected for the degrees of freedom of transmission errors"


def _large_deviations(result: Outcome) -> Iterator[str]:
    """Say which parameter of the robot deviates most, where no nominal model is as wrong as that."""
    parameters = result.problem.parameters
    free = parameters.free
    expected = free.scale if result.learned is None else result.learned.stated  # an estimated scale is no expectation
    largest = np.array([LARGEST.get(dimension, np.inf) for dimension in free.dimensions])
    share = np.abs(result.x) / np.maximum(largest, SCALES * expected)
    share[parameters.of_frames[parameters.identified]] = 0.0
    worst = int(np.argmax(share))
    if share[worst] > 1:
        yield f"{free.names[worst]} deviates by {in_unit(result.x[worst], free.dimensions[worst])}"


def _held(result: Outcome, problem: CalibrationProblem) -> Iterator[str]:
    """Say which stated frame or joint parameter is wrong and not identified; without curves, which would take it up."""
    if len(problem.arms) > 1:
        return
    p = problem.parameters
    now, own = rms(problem.errors(result.x)), result.x[~p.free.of_curves]
    problem = problem.identifying(p.identified & ~p.of_curves)
    p = problem.parameters
    held = ~p.identified & (p.placed | np.isin([name.rstrip("0123456789") for name in p.names], MDH))
    groups = [name if frame_of(name) == "_" else f"{frame_of(name)}*" for name in np.array(p.names)[held].tolist()]
    before = min(rms(problem.errors(x)) for x in (own, ridge_deviations(problem)))  # whatever limits the result
    best, said = min(now, ELSEWHERE * before, REACH * arm_length(problem)), ""
    for group in dict.fromkeys(groups):
        freed = problem.identifying(p.identified | [fits(name, group) for name in p.names])
        located = fitted_frames(freed)[0].parameters
        freed = freed.with_parameters(replace(located, identified=freed.parameters.identified))
        then = rms(freed.errors(ridge_deviations(freed)))
        if then < best:
            best, said = then, group
    if said:
        yield (
            f"the stated {said.removesuffix('_*')} is wrong, and not identified: with `{said}` in `identify` residuals "
            f"are {three_digits(1e3 * best)} mm instead of {three_digits(1e3 * now)} mm (RMS)."
        )


def _limited_by_formulation(result: Outcome, problem: CalibrationProblem) -> Iterator[str]:
    """Say that loss, penalty or constraints leave what a squared penalty at weight 1 explains of the same rows."""
    if result.record.earlier:  # its prior is the earlier knowledge
        return
    kept = kept_rows(result)
    if kept.mean() < 1 - EXCLUDED:  # downweighted in a fit that is wrong everywhere
        kept = np.ones_like(kept)
    rows, x = problem.on(problem.data.take(np.flatnonzero(kept))), result.x
    outliers = set() if result.squared_loss else {flag.label for flag in flagged(rows, ridge_deviations(rows))}
    if outliers:  # they bias the squares of the comparison, and losses that are not robust
        rows = rows.without(outliers)
    plain = _worst_ratio(rows, ridge_deviations(rows))
    if not 0 < plain <= NOISY:
        return
    away = sorted(set(problem.labels).difference(rows.labels))
    if away and by_place(result.formulation, problem.groups):
        yield f"outliers bias a loss that depends on the order of its equations: leave out {listed(away)}."
        return
    if away and not result.squared_loss:
        x = rows.parameters.free.scale * pose(result.formulation, rows.linearize(x)).solve(result.weight).z
    before, now = (_worst_ratio(rows, each) for each in (result.x, x))
    if now < max(NOTICED * plain, before / NOISY):  # outliers limited the fit
        return
    names = [name_of(constraint, k) for k, constraint in enumerate(result.formulation.constraints)]
    beside = f" without outliers ({listed(away)})" if away else ""
    remedy = f"Loosen its constraints ({joined(names)}) or use" if names else "Use"
    yield (
        f"{LIMITED}: residuals{beside} are {three_digits(now)} times the measurement "
        f"noise, but {three_digits(plain)} times with a squared penalty at weight 1 and no constraint. {remedy} a "
        "smaller weight."
    )


def _other_robot(result: Outcome, problem: CalibrationProblem) -> Better | None:
    """Return the ready robot that fits far better, sought where a length of the arm is not machined as stated."""
    free = problem.parameters.free
    lengths = (np.array(free.dimensions) == "length") & ~free.of_frames
    if len(problem.arms) > 1 or not (np.abs(result.x[lengths]) > UNUSUAL["length"]).any():
        return None
    return sibling(problem)


def against_gravity(robot: Robot, names: Sequence[str], x: Array, sd: Array, moves: Array) -> tuple[str, ...]:
    """Return the joints that significantly turn against gravity, from x, standard deviations and movements (n,)."""
    joints = {i: int(name.removeprefix("compliance")) for i, name in enumerate(names) if name.startswith("compliance")}
    largest = max((moves[i] for i in joints), default=0.0)
    upward = [k for i, k in joints.items() if x[i] < -UPWARD * sd[i] and moves[i] > NOTABLE * largest]
    return tuple(numbered(k - 1, robot.joint_names) for k in upward)


def upward_sentence(joints: Sequence[str]) -> str:
    """Say that joints turn against gravity: the mounting is another one, or a force is not gravity's."""
    of = f"compliances of joints {joined(joints)} are" if len(joints) > 1 else f"compliance of joint {joints[0]} is"
    return (
        f"{of} negative, which gravity cannot cause: check `mounting`, the payload, sag compensation, hoses, springs "
        "and counterweights."
    )


def _upward(result: Outcome, problem: CalibrationProblem) -> list[str]:
    """Say which joints turn against gravity."""
    free, x = problem.parameters.free, result.x
    bends = any(name.startswith("compliance") for name in free.names) and not measured_torques(problem.data)
    C = result.known_covariance if bends else None
    if C is None:
        return []
    moves = np.linalg.norm(problem.linearize(x).A * (x / free.scale), axis=0)
    joints = against_gravity(problem.robot, free.names, x, np.sqrt(np.diag(C)), moves)
    return [upward_sentence(joints)] if joints else []


def _other_readings(result: Outcome, problem: CalibrationProblem, ordered: CalibrationProblem) -> Iterator[str]:
    """Say what is wrong with single rows, and what explains all or some of them if they are read otherwise."""
    if len(problem.arms) > 1:  # a table is reinterpreted with the nominal model of one robot
        yield from rows_without_values(problem.data, problem.arms)
        return
    explained = max(ratio for _, ratio in residual_rms(result).values()) < NOTICED
    most = REACH * arm_length(problem) if explained else np.inf  # otherwise wrong lengths explain more
    # in addition to single rows, at which something may have changed
    parts = of_sessions(ordered)
    yield from first(*(chain(single_rows(part), better_interpretations(part, most)) for part in parts))


def _residual_causes(result: Outcome, problem: CalibrationProblem, ordered: CalibrationProblem) -> Iterator[str]:
    """Say what explains the residuals of a calibration that is judged bad: something of all rows, else of some."""
    if len(problem.arms) > 1:
        return
    error = rms(problem.errors(result.x)[kept_rows(result)])
    beyond = error >= LARGEST["length"]  # possible size of a robot's own effects
    outside = beyond_limits(problem.robot, all_q(problem.data), OUTSIDE)
    yield from first(
        (f"{text}: check the unit and the column of its values." for text in outside),
        _shown_without_outliers(result, ordered),
        rounded(problem, error),
        odd_column(problem) if beyond else (),
        unrelated_rows(problem, error),
    )


def _without_outliers(
    result: Outcome, ordered: CalibrationProblem, again: bool = True
) -> tuple[CalibrationProblem, Array]:
    """Return the rows without outliers, others with no larger errors, and the deviations (n,) [SI] that fit them.

    Unless ``again``, it is the result's own fit if outliers are too small to matter.
    """
    kept = set(result.problem.labels) - {flag.label for flag in result.single}
    errors, own = ordered.errors(result.x), np.isin(ordered.labels, list(kept))
    largest = np.nan_to_num(errors[own]).max()
    alone = ordered.on(ordered.data.take(np.flatnonzero(own | (errors <= largest))))
    if not again or (result.squared_loss and not result.single):  # another loss may spread an outlier over all rows
        return alone, result.x
    x = ridge_deviations(alone)
    for _ in range(OUTLIER_SEARCHES):  # they mask each other, and make good rows look like outliers
        before, alone = alone, ordered.without({flag.label for flag in flagged(ordered, x)})
        if alone.labels == before.labels:
            break
        x = ridge_deviations(alone)
    return alone, x


def _shown_without_outliers(result: Outcome, ordered: CalibrationProblem) -> Iterator[str]:
    """Say that outliers make a loss fit badly what it fits without them, else what other residuals show."""
    alone, x = _without_outliers(result, ordered)
    out = set(result.problem.labels).difference(alone.labels)
    single = [flag.label for flag in flagged(ordered, x) if flag.label in out]
    ratio, before = _worst_ratio(alone, x), _worst_ratio(ordered if result.squared_loss else alone, result.x)
    loss = "a squared loss" if result.squared_loss else "this loss"
    if single and ratio <= min(NOISY, MOVED**0.5 * before):
        yield (
            f"outliers ({listed(single)}): without them residuals are {three_digits(ratio)} times the measurement "
            f"noise. They bias {loss}: use formulation 'robust', or leave them out ([exclude])."
        )
        return
    yield from first(_in_place_of_extensions(result, alone), shown_by_residuals(alone, x))


def _in_place_of_extensions(result: Outcome, alone: CalibrationProblem) -> Iterator[str]:
    """Report a single change that explains the rows better than the model's extensions, which may have absorbed it.

    Their decrease of -2 ln L is known; a change that leaves a part of m squares decreases it by m ln(1 / part).
    """
    learned = result.learned
    if learned is None or not learned.added or not all(name.startswith(ARM) for name in learned.added):
        return
    bare = cast(CalibrationProblem, result.stated).on(alone.data)
    plain = min((trial.value for trial in learned.trials if not trial.extensions), default=np.inf)
    most = np.exp((min(trial.value for trial in learned.trials) - plain) / result.program.model.equations)
    x, most = ridge_deviations(bare), min(MOVED, float(most))
    yield from first(shown_by_residuals(bare, x, most=most), wrong_gear_ratio(bare, x, most))


def better_fitting(result: Outcome, data: Dataset) -> Better | None:
    """Return the interpretation of new measurements that fits far better; None if they fit, or if there is none."""
    problem = result.problem.sample().on(data)
    return better_interpretation(problem) if noise_ratio(problem, result.errors(data)) > HOPELESS else None


def refuse_misread(result: Outcome, data: Dataset) -> None:
    """Refuse new measurements that `better_fitting` interprets differently."""
    better = better_fitting(result, data)
    if better is not None:
        stated, left = (three_digits(1e3 * error) for error in (better.stated, better.left))
        found = f"errors of {stated} mm, but {left} mm with {better.what}"
        raise InputError("the new measurements", found, better.remedy)


def misread(result: Outcome, data: Dataset) -> str:
    """Return the result of `better_fitting` as a sentence, or rows without values; empty where there is nothing."""
    lost = next(rows_without_values(data, result.problem.arms), "")
    if lost:
        return f"Likely: {lost}"
    better = better_fitting(result, data)
    return "" if better is None else f"Likely: {better.sentence}"


def mistakes(causes: Sequence[str]) -> list[str]:
    """Return the input mistakes among `likely_causes`."""
    return [text for text in causes if text != NOTHING and not text.startswith(REMARKS)]
