"""Acceptance test: whether a calibrated robot meets a tolerance at every configuration of a region."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.special import bdtrc, fdtri

from rpim_opt.basics.arrays import Array, rms
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import joined, listed, percent
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.basics.units import display
from rpim_opt.calibration.diagnosis import SLACK
from rpim_opt.calibration.held_out import (
    CHANGED,
    FEWEST,
    coverage_text,
    displacement,
    excluded_by_fit,
    headline_errors,
    of_positions,
    rows_used,
)
from rpim_opt.calibration.lack_of_fit import judged
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import held_out_errors
from rpim_opt.calibration.verdict import Verdict, ambiguous_deviation, refuse_misread, scatter
from rpim_opt.calibration.words import VAGUE, on_assumed_masses, underdetermined
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.record import HeldOut, Requirement
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.workspace import in_base, markers, within
from rpim_opt.robot.parameters import of_session

Conclusion = Literal["accepted", "rejected", "inconclusive"]
MEASURED = 1000  # configurations of a block whose uncertainty is compared with that of the region
INVALID = "Missing: valid prediction intervals."
MOST = 3  # joints or rows that a reason names
STATED = 1e9  # degrees of freedom of a stated uncertainty
WORST, BESIDE = 16, 16  # configurations from which the search for the largest bound goes on; neighbours tried of each
STEPS = (0.1, 0.05, 0.025, 0.0125)  # distances of neighbours, as fractions of the joint ranges
LEAST = 1e-9  # width of the range of a joint that never moved [rad or m]
ANYWHERE = Requirement(limit=1.0)  # the region of a result without requirement: joints within the measured ranges


# --- the region, and bounds in it -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Region:
    """Region of a requirement: a problem with its joint limits, a box (3, 2) [m] in the base frame, and a reflector.

    If only ``measured`` configurations (N, dof) are required, it consists of these.
    """

    problem: CalibrationProblem
    box: Array | None
    marker: str
    measured: Array | None = None

    @property
    def limits(self) -> Array:
        """Lower and upper limits (dof, 2) of the joints [rad or m]."""
        return self.problem.robot.limits

    def inside(self, q: Array, slack: float = 0.0) -> np.ndarray:
        """Return whether configurations (N, dof) are in the region (N,), with a margin as a fraction of its ranges."""
        low, high = self.limits.T
        spare = slack * (high - low)
        inside = ((q >= low - spare) & (q <= high + spare)).all(axis=1)
        if self.box is not None and inside.any():
            at = in_base(self.problem, q[inside], self.marker)
            inside[inside] = ((at >= self.box[:, 0]) & (at <= self.box[:, 1])).all(axis=1)
        return inside

    def rows(self, data: Dataset) -> np.ndarray:
        """Return which rows of measurements have all their points in the region or near it (N,)."""
        inside = np.zeros(len(data), dtype=bool)
        for block in data.blocks:
            points = [self.inside(block.q[:, point], SLACK) for point in range(block.q.shape[1])]
            inside[block.row] = np.all(points, axis=0)
        return inside

    def samples(self) -> Array:
        """Return configurations (N, dof) that represent the region; InputError if none reaches the box."""
        if self.measured is None:
            return within(self.problem, self.box, self.marker)
        if not self.inside(self.measured).any():
            raise InputError("acceptance", "no measured configuration in the region", "a region that holds some")
        return self.measured[self.inside(self.measured)]


def region_of(result: Outcome, requirement: Requirement) -> Region:
    """Return the region of a requirement; refuse several robots, and unknown joints and reflectors."""
    problem = result.problem
    if len(problem.arms) > 1 or "" not in problem.arms:
        raise InputError("acceptance", "several robots in one calibration", "a calibration of one robot")
    low, high = result.ranges[""]
    limits = np.column_stack([low, np.maximum(high, low + LEAST)])
    for joint, side in requirement.joints:
        if not 1 <= joint <= len(limits):
            raise InputError("acceptance", f"joint {joint}", f"1 to {len(limits)}")
        limits[joint - 1] = side
    sample = problem.sample()
    known = markers(sample)
    marker = requirement.marker or known[0]
    if marker not in known:
        raise InputError("acceptance", f"reflector '{marker}'", ", ".join(known))
    limited = replace(sample, robots=replace(problem.robot, limits=limits))
    measured = _measured(result) if requirement.measured else None
    return Region(limited, None if requirement.box is None else np.array(requirement.box), marker, measured)


def _measured(result: Outcome) -> Array:
    """Return the configurations (N, dof) of the identification rows, at most `MEASURED` of a block."""
    return np.concatenate([b.q[:MEASURED, 0] for part in result.problem.rows() for b in part.data.blocks])


@dataclass(frozen=True, eq=False)
class Workspace:
    """Expanded uncertainty (N,) [m] of the positions reached (N, 3) [m] at configurations q (N, dof) of a region.

    The last configuration is the worst one found by a search from the worst of the others.
    """

    requirement: Requirement
    region: Region
    q: Array
    position: Array
    expanded: Array

    @property
    def largest(self) -> float:
        """Maximum expanded uncertainty [m]."""
        return float(self.expanded[-1])

    @property
    def median(self) -> float:
        """Median expanded uncertainty of the sampled configurations [m]."""
        return float(np.median(self.expanded[:-1]))

    @property
    def summary(self) -> str:
        """Maximum and median in words."""
        name = self.requirement.marker
        reflector = f"reflector '{name}'" if name else "the reflector"
        found = "measured configurations" if self.requirement.measured else "configurations, refined by a search"
        return (
            f"Expanded uncertainty of the position that {reflector} reaches (U, "
            f"{percent(self.requirement.confidence)}): at most {1e3 * self.largest:.3f} mm (largest of "
            f"{len(self.q) - 1} {found}), median {1e3 * self.median:.3f} mm; "
            "`compensate --tool` states that of another point"
        )


def workspace(result: Outcome, requirement: Requirement, region: Region, drawn: Array) -> Workspace:
    """Return the expanded uncertainty at configurations (N, dof) of a region, and at the maximum found by a search."""
    rng = np.random.default_rng(0)
    span = np.ptp(region.limits, axis=1)
    q, bound = drawn, reached_positions(result, region, drawn, requirement.confidence)[1]
    for step in STEPS if region.measured is None else ():
        beside = q[np.argsort(-bound)[:WORST]].repeat(BESIDE, axis=0)
        beside = np.clip(beside + step * span * rng.normal(size=beside.shape), *region.limits.T)
        beside = beside[region.inside(beside)]
        if len(beside):
            q = np.concatenate([q, beside])
            bound = np.concatenate([bound, reached_positions(result, region, beside, requirement.confidence)[1]])
    q = np.vstack([drawn, q[np.argmax(bound)]])
    return Workspace(requirement, region, q, *reached_positions(result, region, q, requirement.confidence))


def reached_positions(result: Outcome, region: Region, q: Array, confidence: float) -> tuple[Array, Array]:
    """Return predicted positions (N, 3) [m] at configurations (N, dof), and their expanded uncertainties (N,)."""
    prediction = result.predict(q, region.marker, of="reached")
    return prediction.position, distance_quantile(prediction.covariance, result.noise_dof, confidence)


def distance_quantile(covariance: Array, freedom: float, probability: float) -> Array:
    """Return quantiles (N,) of the norm of Student-t vectors with scale matrices (N, k, k).

    The squared length of a normal vector with covariance S is approximately g chi^2 with h degrees of freedom
    (Satterthwaite), ``g = tr S^2 / tr S``, ``h = (tr S)^2 / tr S^2``; for a scale known to nu degrees of freedom
    Fisher's F results::

        quantile^2 = tr S F(h, nu; probability)

    This is exact if S has equal eigenvalues, or a single nonzero one, and otherwise accurate to some per cent; infinite
    if a variance is.
    """
    trace = np.trace(covariance, axis1=1, axis2=2)
    known = np.isfinite(trace)
    S = covariance[known]
    quantile = np.full(len(covariance), np.inf)
    squares = np.einsum("nij,nji->n", S, S)
    h = trace[known] ** 2 / np.maximum(squares, np.finfo(float).tiny)
    h = np.clip(h, 1.0, covariance.shape[1])
    quantile[known] = np.sqrt(trace[known] * fdtri(h, max(freedom, 1.0), probability))
    return quantile


def measured_workspace(result: Calibration) -> Workspace | None:
    """Return the workspace of a result's own region; None for several robots, and without finite uncertainty."""
    requirement = result.record.requirement or ANYWHERE
    try:
        region = region_of(result, requirement)
        sampled = workspace(result, requirement, region, region.samples())
    except InputError:
        return None
    return sampled if np.isfinite(sampled.expanded).all() else None


def tested(result: Calibration) -> tuple[Acceptance | None, Workspace | None]:
    """Return the acceptance test of a result that has a requirement, and the workspace of the test or of the result."""
    if result.record.requirement is None:
        return None, measured_workspace(result)
    accepted = accept(result)
    return accepted, accepted.workspace


def inconclusive(result: Calibration, found: Workspace | None) -> str:
    """Return a warning if U exceeds the error of the nominal robot, or readings scatter; otherwise an empty text."""
    if not (of_positions(result) and result.verdict.delivered):
        return ""
    if scatter(result):
        return "Inconclusive: check the condition below before using this robot."
    name, errors, _ = headline_errors(result)
    nominal = rms(errors)
    if found is None or found.median <= nominal:
        return ""
    advice = (
        "Measure more configurations (`rpim-opt design --augment`), with larger wrist rotations, or state what is "
        'known of the reflector ([prior] known = ["tool_x = 95 +- 0.5 mm", ...]).'
    )
    if any(map(of_session, result.problem.parameters.free.names)) and not result.problem.session:
        advice = _missing(result, nominal, found, 0.0)
    return (
        f"Inconclusive: the median U over the region, {1e3 * found.median:.3f} mm, is above the error of the "
        f"nominal robot, {1e3 * nominal:.3f} mm RMS on the {name} rows. {advice}"
    )


# --- the verdict ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Acceptance:
    """Result of the acceptance test of a calibration against a requirement.

    The verdict is ``"accepted"`` if the bound is within the limit at every configuration of the region and held-out
    rows confirm it; ``"rejected"`` if held-out rows exceed the limit more often than chance allows, or the lower bound
    of the robot's repeatability exceeds it; otherwise ``"inconclusive"``: something is missing. ``reasons`` are
    sentences; empty if accepted.

    ``requirement`` has limit, confidence and region, ``workspace`` the expanded uncertainties at its configurations;
    ``repeatability`` [m] is the largest of them for known parameters. ``held_out`` has the errors on held-out rows and
    the coverage of their intervals, a document [mm] with its ``sentence``. ``caution`` states how joint values count if
    signs or zeros of joints were estimated, and what was not checked.
    """

    requirement: Requirement
    verdict: Conclusion
    reasons: tuple[str, ...]
    workspace: Workspace | None = None
    repeatability: float | None = None
    held_out: Mapping[str, Any] | None = None
    caution: str = ""

    @property
    def bound(self) -> float | None:
        """Maximum expanded uncertainty [m]."""
        return None if self.workspace is None else self.workspace.largest

    @property
    def summary(self) -> str:
        """Verdict and reasons as one text."""
        return " ".join(["Acceptance of the calibration, whole model:", self.sentences()[0], *self.reasons])

    def on(self, calibration: Verdict) -> Verdict:
        """Return the verdict on a calibration, not delivered where the test rejects its robot."""
        return replace(calibration, reasons=calibration.reasons or (self.summary,) * (self.verdict == "rejected"))

    def sentences(self) -> list[str]:
        """Return the verdict with its reasons and the evidence, sentence by sentence."""
        requirement = self.requirement
        limit = f"limit {1e3 * requirement.limit:g} mm with {percent(requirement.confidence)} confidence"
        lines = [
            f"{self.verdict.capitalize()}: {limit} at every {'measured ' * requirement.measured}configuration of the "
            "region.",
            *self.reasons,
            *filter(None, [self.caution]),
            f"Region: {requirement.where}.",
        ]
        workspace = self.workspace
        if workspace is not None and np.isfinite(workspace.largest):
            lines.append(f"{workspace.summary}.")
        if self.held_out is not None:
            lines.append(self.held_out["sentence"])
        return lines

    def __str__(self) -> str:
        return "\n".join(self.sentences())

    def content(self) -> dict[str, Any]:
        """Return the same as a document [mm]."""
        r, workspace = self.requirement, self.workspace
        box = r.box and {axis: [1e3 * low, 1e3 * high] for axis, (low, high) in zip("xyz", r.box, strict=True)}
        lengths = {"bound": self.bound, "median": workspace and workspace.median, "repeatability": self.repeatability}
        return {
            "verdict": self.verdict,
            "limit_mm": 1e3 * r.limit,
            "confidence": r.confidence,
            "region": r.where,
            "box_mm": box,
            "configurations": 0 if workspace is None else len(workspace.q) - 1,
            **{f"{k}_mm": None if v is None or not np.isfinite(v) else 1e3 * v for k, v in lengths.items()},
            "worst": workspace and workspace.q[-1].tolist(),
            "place_mm": workspace and (1e3 * workspace.position[-1]).tolist(),
            "checked": self.held_out and {k: v for k, v in self.held_out.items() if k != "sentence"},
            "reasons": list(self.reasons),
            "caution": self.caution or None,
        }


@one_blas_thread
def accept(result: Calibration, requirement: Requirement | None = None, data: Dataset | None = None) -> Acceptance:
    """Test whether the calibrated robot meets a tolerance at every configuration of a region.

    The limit applies to the position that the robot reaches, as in `Calibration.predict`: with the uncertainty of the
    parameters and the robot's repeatability, without the instrument's noise. Its distance from the predicted position
    stays below the bound with the required confidence (`distance_quantile`); the bound is computed at 2048
    configurations of the region, and a search continues from the worst of them.

    The bound relies on the covariance, which rows not used by the calibration check: they have to lie in their
    intervals, and may not exceed the limit more often than chance allows.

    Requirement and measurements are by default those of the result's record, whether used since (`refit_all`) or not.
    InputError without a requirement, for a region that the robot lacks or does not reach, and for measurements that
    another interpretation (another unit, exchanged joints) fits far better.

    >>> import rpim_opt as ro
    >>> result = ro.load("position").calibrate()
    >>> box = ((0.0, 0.8), (-0.7, 0.7), (0.0, 1.0))
    >>> print(ro.calibration.accept(result, ro.data.Requirement(2e-4, box=box)).sentences()[0])
    Accepted: limit 0.2 mm with 95 % confidence at every configuration of the region.
    """
    requirement = requirement or result.record.requirement
    if requirement is None:
        raise InputError("acceptance", "no limit", "--limit [mm], or limit_mm in [acceptance]")
    if data is not None:
        refuse_misread(result, data)
    limit = requirement.limit
    region = region_of(result, requirement)
    requirement = replace(requirement, marker=region.marker)  # the first, if there are several and none is stated
    drawn = region.samples()
    held_out, missed, unheld = _held_out(result, region, requirement, data)
    lacking = [*_unmodelled(result, region), *unheld]
    if result.contradiction:
        lacking.append("Missing: constraints that agree with the data; U depends on them.")
    if ambiguous_deviation(result):
        check = "Missing: a check of the frame or scale named below; U does not include its error. If it is right, "
        lacking.append(f"{check}enter the identified values of the deviating parameters in the robot file.")
    undecided = () if result.mapping is None else result.mapping.ambiguities
    lacking += [reason for reason in result.verdict.reasons if reason in undecided]
    against = [reason for reason in result.verdict.reasons if reason not in undecided]
    masses = on_assumed_masses(result) if data is None else []
    caution = " ".join(filter(None, [result.verdict.caution, *underdetermined(result), *masses]))
    try:
        mapped = workspace(result, requirement, region, drawn)
    except InputError as error:
        reasons = (*against, *lacking, f"U is undefined. {result.no_intervals or error}")
        word: Conclusion = "rejected" if against else "inconclusive"
        return Acceptance(requirement, word, reasons, held_out=held_out, caution=caution)
    repeatability, least = repeatability_bounds(result, region, mapped.q[-1], requirement.confidence)
    against += missed
    if least > limit:
        fit = judged(result)
        what, remedy = "the robot's repeatability alone contributes", "only a more repeatable robot reduces it"
        if fit is not None and fit.excess:
            what, remedy = "an effect that it lacks contributes", str(fit).removesuffix(".")
        elif fit is None or fit.repeated is None:
            what = "the robot's repeatability, or an effect that the model lacks, contributes"
            remedy = "repeat five configurations, approached from both sides, to separate them, and measure others"
        against.append(f"With this model {what} at least {1e3 * least:.3f} mm: {remedy}.")
    if not mapped.largest <= limit:
        lacking.append(_missing(result, limit, mapped, repeatability))
    verdict: Conclusion = "accepted"
    if against or lacking:
        verdict = "rejected" if against else "inconclusive"
    reasons = tuple(against or lacking)
    return Acceptance(requirement, verdict, reasons, mapped, repeatability, held_out, caution)


def _missing(result: Calibration, limit: float, found: Workspace, repeatability: float) -> str:
    """Return a sentence on what is missing for a bound within the limit [m]."""
    bound = found.largest
    if not np.isfinite(bound):
        return "Missing: measurements that identify parameter combinations that neither data nor penalty determines."
    if repeatability > limit:
        return (
            f"Missing: a tighter bound on repeatability, which may contribute {1e3 * repeatability:.3f} mm. Approach "
            "some poses repeatedly (`rpim-opt iso9283`)."
        )
    if any(map(of_session, result.problem.parameters.free.names)) and not result.problem.session:
        return (
            "Missing: one registration for all sessions, to the same reference points. U, at most "
            f"{1e3 * bound:.3f} mm, includes session offsets, which more configurations do not reduce; "
            "`rpim_opt.use.in_session` gives the result in the frame of one session."
        )
    kinds = {b.measurement.name: b.measurement for part in result.problem.rows() for b in part.data.blocks}
    if not any(kind.registers for kind in kinds.values()):
        places = "first link, which places the base" + ", or three fixtures" * any(k.parameters for k in kinds.values())
        return (
            f"Missing: the base frame, which {joined(list(kinds))} readings do not determine: more of them hardly "
            f"reduce U, at most {1e3 * bound:.3f} mm. State in [prior] what is known of the {places} "
            '(known = ["theta1 = 0 +- 0.001 deg", ...] for its alpha, a, theta and d).'
        )
    measured = reached_positions(result, found.region, _measured(result), found.requirement.confidence)[1].max()
    apart = ""
    if measured < bound / 2:
        apart = f", at measured configurations {1e3 * measured:.3f} mm (--measured tests these alone, --box a part)"
    return (
        f"Missing: more measurements. U is at most {1e3 * bound:.3f} mm{apart}; with all parameters known the robot's "
        f"repeatability would still contribute {1e3 * repeatability:.3f} mm. `rpim-opt design --augment` names the "
        "configurations that help most."
    )


def _rows_apart(result: Calibration, data: Dataset | None) -> tuple[Dataset, HeldOut, list[str], str] | None:
    """Return held-out rows, their errors, labels that a fit to all rows excluded, and what moved; None without any."""
    apart, held = result.record.validation if data is None else data, result.record.held_out
    if apart is not None:
        used = rows_used(result, apart)
        if not used.keys() >= set(apart.label):
            apart = apart.without(used) if used else apart
            held = held_out_errors(result, apart)
            mistake, remark = displacement(result, apart, held)
            return apart, held, [], f"{mistake} `validate` compares the two causes." if mistake else remark
        if held is not None and not set(held.label).issuperset(used.values()):
            return None
    if held is None:
        return None
    row = {label: row for row, label in enumerate(result.problem.data.label)}
    apart = result.problem.data.take([row[label] for label in held.label if label in row])
    return apart, held, excluded_by_fit(result), ""


def _of_instrument(data: Dataset, confidence: float) -> Array:
    """Return what the instrument may add to the errors of rows (N,) [m], with a confidence."""
    largest = np.zeros(len(data))
    for block in data.blocks:
        lengths = [i for i, d in enumerate(block.measurement.components.values()) if d == "length"]
        if lengths:
            largest[block.row] = distance_quantile(block.covariance[:, lengths][:, :, lengths], STATED, confidence)
    return largest


def _held_out(
    result: Calibration, region: Region, requirement: Requirement, data: Dataset | None
) -> tuple[dict[str, Any] | None, list[str], list[str]]:
    """Return the test of a limit by held-out rows: a document [mm] or None, rows beyond it, and what is missing."""
    found = _rows_apart(result, data)
    if found is None:
        used = "; an update uses all its rows for identification" * bool(result.record.earlier)
        used = used if data is None else f"; all {len(data)} rows of the table are identification rows"
        return None, [], [f"Missing: held-out rows (`new --hold-out`, or a table for `accept --data`){used}."]
    apart, held, excluded, moved = found
    kept = ~np.isin(held.label, excluded)
    error, sigmas, allowed = held.error[kept], held.sigmas[kept], held.allowed[kept]
    inside = np.isfinite(error) & region.rows(apart)
    instrument = _of_instrument(apart, requirement.confidence)
    missing = [apart.label[i] for i in np.flatnonzero(inside & (error > requirement.limit + instrument))]
    beyond = [apart.label[i] for i in np.flatnonzero(sigmas > allowed)]
    rows, count = len(apart), int(inside.sum())
    largest = 1e3 * float(error[inside].max(initial=0.0))
    missed, lacking, chance = [], [], 1 - requirement.confidence
    if missing and bdtrc(len(missing) - 1, count, chance) < chance:
        missed.append(
            f"{len(missing)} of {count} rows have errors above the limit plus the instrument's uncertainty: "
            f"{listed(missing, MOST)}."
        )
        missed += [moved] if moved else []
    if count < FEWEST:
        lacking.append(f"Missing: at least {FEWEST} held-out rows in the region; it holds {count} of {rows}.")
    if beyond or held.contradiction:
        outside = f"Rows outside them: {listed(beyond, MOST)}." if beyond else ""
        advice = moved or "Repeat these measurements, or extend the model."
        if not moved and data is not None and held.contradiction:
            advice = CHANGED
        lacking.append(" ".join(filter(None, [INVALID, outside, held.contradiction, advice])))
    noise = 1e3 * instrument[inside].max(initial=0.0)
    what = "Held out" if data is None else "New measurements"
    sentence = f"{what}: {rows} rows, {count} of them in the region, maximum error there {largest:.3f} mm "
    sentence += f"(up to {noise:.3f} mm from the instrument alone)"
    sentence += "; " * (held.coverage is not None) + coverage_text(held)
    if not count:
        sentence = f"None of the {rows} held-out rows is in the region"
    if excluded:
        sentence += f". Not counted: held-out rows {listed(excluded, MOST)}, excluded from the fit to all rows"
    document: dict[str, Any] = {"rows": rows, "in_region": count, "largest_mm": largest, "missing": missing}
    document |= {"beyond": beyond, "excluded": excluded, "coverage95": held.coverage, "sentence": f"{sentence}."}
    document["fit"] = held.fit and held.fit._asdict()
    return document, missed, lacking


def repeatability_bounds(result: Calibration, region: Region, q: Array, confidence: float) -> tuple[float, float]:
    """Return the bounds [m] at q (dof,) if all parameters were known, for the estimated and the smallest repeatability.

    Zero if repeatability is not known apart from the noise; the smallest is also zero if data give only an upper bound.
    """
    results = [result]
    repeatability = result.problem.repeatability
    if repeatability is not None:
        learned = {} if result.learned is None else result.learned.noise
        least = {k: 0.0 if s.log_std > VAGUE else s.value * float(np.exp(-2 * s.log_std)) for k, s in learned.items()}
        results.append(replace(result, problem=result.problem.with_repeatability(replace(repeatability, **least))))
    bounds = [0.0, 0.0]
    for i, each in enumerate(results):
        mean, reached = (each.predict(q[None], region.marker, of=of).covariance for of in ("mean", "reached"))
        if np.isfinite(mean).all():
            bounds[i] = float(distance_quantile(reached - mean, each.noise_dof, confidence)[0])
    return bounds[0], bounds[1]


def _unmodelled(result: Calibration, region: Region) -> Iterator[str]:
    """Say that the model does not fit, and which joint ranges of the region were not measured."""
    fit = judged(result)
    if fit is not None and fit.alarming:
        yield f"Missing: a model that fits. {fit}"
    corners = Dataset.of(region.limits.T.copy(), np.zeros((2, 3)), 1.0)
    named: list[str] = []
    for joint in result.outside(corners).joints:
        unit, si = display(result.problem.robot.joint_dimensions[joint - 1])
        low, high = region.limits[joint - 1] / si
        named.append(f"joint {result.problem.robot.joint(joint - 1)} from {low:.4g} to {high:.4g} {unit}")
    if named:
        where = f"{joined(named)}, which is part of the region: no measurement checked the model there."
        yield f"Missing: measurements with {where}"
