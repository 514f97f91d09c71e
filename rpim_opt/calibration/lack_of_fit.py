"""Lack of fit: components of a calibration's residuals, missing effects, and remedies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import scipy
from scipy.special import fdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import joined
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.bayes.model_selection import SESSIONS, SPEAK, WARMTH, Candidate, Comparison
from rpim_opt.bayes.outliers import by_block
from rpim_opt.bayes.prior import kind_of
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.calibration.verdict import against_gravity, upward_sentence
from rpim_opt.problem.noise import UNITS, Repeatability, in_unit
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.row_functions import measured_torques, repeated

FEWEST = 6  # least number of redundant equations, or repetitions, for a judgement
CORRELATED = 4.0  # z-score from which residuals are called autocorrelated
ROUGH, FINE = 2.0, 0.3  # repeatability over noise: above, the robot limits accuracy; below, the instrument does
GROSS = 300.0  # repeatability over measurement noise that means wrong data
NEGLIGIBLE = 0.1  # parts below this share of a larger one are not reported
RARE = 1e-3  # probability that residuals exceed the standard deviation of repeated readings by chance
PERMUTATIONS = 300  # permutations for the distribution of an autocorrelation
FEWEST_NEIGHBOURS = 8  # least number of configurations for an autocorrelation
TOGETHER = (
    "An update keeps the model: calibrate all tables together (`rpim-opt new FOLDER --data OLD --data NEW ...`, then "
    "`calibrate`)."
)


class Extension(NamedTuple):
    """A model extension: its parameter patterns, its name, a sentence on its effect, and its terms.

    The terms are tried at a result; first moments of links belong to gravity, since either can represent the other.
    """

    identify: tuple[str, ...]
    name: str
    effect: str = ""
    terms: tuple[str, ...] = ()


EXTENSIONS = {
    "gravity": Extension(("compliance?",), "gravity", "The arm deflects under gravity", ("compliance", "moment")),
    "first harmonic": Extension(
        ("ecc_cos?", "ecc_sin?"),
        "eccentric encoders or gears (once per revolution)",
        "Encoders or gears of joints have once-per-revolution errors",
        ("ecc",),
    ),
    "second harmonic": Extension(
        ("ecc2_cos?", "ecc2_sin?"), "second harmonics of joints", "Joints have twice-per-revolution errors", ("ecc2",)
    ),
    "moments": Extension(("moment*",), "gravity on masses whose centres differ from the assumed ones"),
    SESSIONS: Extension(
        ("session_*",),
        "a registration that differs from session to session",
        "The registration differs from session to session",
        ("session",),
    ),
    WARMTH: Extension(
        ("expansion",), "lengths that grow with temperature", "Lengths grow with temperature", ("expansion",)
    ),
}


class Autocorrelation(NamedTuple):
    """Autocorrelation of residuals of nearest configurations, and its z-score among permutations."""

    correlation: float
    z: float


@dataclass(frozen=True, eq=False)
class LackOfFit:
    """Components of a calibration's residuals, as RMS of vectors over the rows [m; rad or px without lengths].

    ``residual_dof`` are residual degrees of freedom of the ``equations``; below 6 nothing else is known. ``residual``
    is the RMS of the errors; parts of the noise are ``instrument`` (stated or estimated), ``position`` (the robot's
    repeatability in position, without lengths in orientation) and ``joint``; ``repeatable`` is what the extensions
    ``missing`` would explain: a ``share`` of the mean squared residual, with -2 ln L falling by ``gain``;
    ``parameters`` are the patterns that identify them. ``present`` is the decrease of -2 ln L by each extension of the
    model. ``autocorrelation`` is that of the residuals with all missing effects, None for too few rows; ``upward`` are
    joints with a significantly negative compliance, which gravity cannot cause. ``repeated`` is the RMS of repeated
    readings about their mean, None without enough; ``excess`` that of the residuals beyond it, if significant.
    ``overstated`` means that residuals are smaller than the stated noise, by the chi-squared test (`NoiseTest`);
    ``updated`` that an earlier calibration is the prior, and extensions were not tried.
    """

    configurations: int
    equations: int
    residual_dof: float
    dimension: str
    residual: float
    instrument: float = 0.0
    position: float = 0.0
    joint: float = 0.0
    repeatable: float = 0.0
    missing: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    gain: float = 0.0
    share: float = 0.0
    present: Mapping[str, float] = field(default_factory=dict)
    autocorrelation: Autocorrelation | None = None
    upward: tuple[str, ...] = ()
    repeated: float | None = None
    excess: float = 0.0
    overstated: bool = False
    updated: bool = False

    @property
    def robot(self) -> float:
        """RMS of the robot's repeatability."""
        return float(np.hypot(self.position, self.joint))

    @property
    def alarming(self) -> bool:
        """Whether a missing effect is reported."""
        return bool(self.missing or self.upward) or (
            self.autocorrelation is not None and self.autocorrelation.z > CORRELATED
        )

    def sentences(self) -> list[str]:
        """Return the paragraph, sentence by sentence."""
        rms = f"Residual RMS per reading {_size(self, self.residual)}"
        if not self.instrument:
            freedom = f"degrees of freedom: {max(round(self.residual_dof), 0)}, too few to separate its components"
            return [f"{rms}; {freedom}. Measure more configurations."]
        parts = [f"measurement noise {_size(self, self.instrument)}"]
        if self.repeatable:
            parts.append(f"missing effects {_size(self, self.repeatable)}")
        if self.robot > NEGLIGIBLE * self.instrument:
            parts.append(f"repeatability {_size(self, self.robot)}")
            if self.joint > NEGLIGIBLE * self.robot:
                parts[-1] += f", including {_size(self, self.joint)} from the joints"
        lines = [f"{rms} ({', '.join(parts)})."]
        for extension, gain in self.present.items():
            lines.append(f"{EXTENSIONS[extension].effect} (likelihood-ratio statistic {gain:.0f}).")
        if self.missing:
            what = joined([EXTENSIONS[extension].name for extension in self.missing])
            remedy = f': model = "auto" includes it; or add {joined(self.parameters)} to `identify`.'
            if self.updated:
                remedy = f". {TOGETHER}"
            lines.append(
                f"{what[0].upper()}{what[1:]} would explain {self.share:.0%} of the mean square residual (likelihood-"
                f"ratio statistic {self.gain:.0f}){remedy}"
            )
        if self.upward:
            said = upward_sentence(self.upward)
            lines.append(f"C{said[1:]} Do not use this fit outside the measured joint ranges.")
        lines += filter(None, [_limit(self)])
        if self.repeated is not None:
            beyond = ": residuals are no larger."
            if self.excess:
                beyond = f"; {_size(self, self.excess)} of the residuals is systematic (repeatable), if the "
                beyond += "robot moved away between the readings."
            lines.append(f"Repeated readings of a configuration agree to {_size(self, self.repeated)} RMS{beyond}")
        return lines

    def __str__(self) -> str:
        return " ".join(self.sentences())

    def content(self) -> dict[str, Any]:
        """Return the same as a document [mm, mrad or px]."""
        unit, si = UNITS[self.dimension]
        document = dict(vars(self))
        for key in ("residual", "instrument", "position", "joint", "repeatable", "repeated", "excess"):
            size = document.pop(key)
            document[f"{key}_{unit}"] = None if size is None else size / si
        document["identify"] = list(document.pop("parameters"))
        del document["overstated"], document["updated"]  # which sentences say
        autocorrelation = self.autocorrelation and self.autocorrelation._asdict()
        return {**document, "autocorrelation": autocorrelation, "alarming": self.alarming, "text": self.sentences()}


@one_blas_thread
def lack_of_fit(result: Outcome) -> LackOfFit:
    """Return the components of a calibration's residuals.

    The evidence of model extensions is computed at the linearization of the result, whatever its weight, from at most
    1000 configurations and without outlying rows.
    """
    compared = Comparison(result)
    problem, dimension = compared.problem, compared.dimension
    known: dict[str, Any] = {
        "configurations": compared.configurations,
        "equations": len(compared.row),
        "residual_dof": compared.residual_dof,
        "dimension": dimension,
        "residual": float(np.sqrt(np.nanmean(problem.errors(result.x, dimension) ** 2))),
    }
    if compared.residual_dof < FEWEST:
        return LackOfFit(**known)
    best = compared.best
    # an update keeps the repeatability of the earlier calibration, which few new readings do not determine
    kept = result.problem.repeatability if result.record.earlier and not best.extensions else None
    after = _parts(compared, best, kept)
    known |= after
    total = sum(part**2 for part in _parts(compared, compared.plain).values())  # the variance of a row
    share = 0.0
    if best.extensions:
        share = max(total - sum(part**2 for part in after.values()), 0.0) / total
    group = [kind_of(name) for name in compared.own]
    members = {name: np.isin(group, extension.terms) for name, extension in EXTENSIONS.items()}
    gains = {extension: compared.rise_without(own) for extension, own in members.items() if own.any()}
    present = {extension: gain for extension, gain in gains.items() if gain > SPEAK}
    again, freedom = _repeated(problem, result.x, dimension)
    excess = 0.0
    if again is not None:
        within = max(again**2, 1e-24)
        if total / within >= fdtri(compared.residual_dof, freedom, 1 - RARE):
            excess = float(np.sqrt(total - within))
    return LackOfFit(
        **known,
        repeatable=float(np.sqrt(share * total)),
        missing=best.extensions,
        parameters=tuple(p for extension in best.extensions for p in EXTENSIONS[extension].identify),
        gain=compared.plain.point.value - best.point.value,
        share=share,
        present=present,
        autocorrelation=_residual_autocorrelation(compared, best),
        upward=_upward(compared, present),
        repeated=again,
        excess=excess,
        overstated=not result.no_intervals and result.noise_test().overstated,
        updated=bool(result.record.earlier),
    )


def judged(result: Outcome) -> LackOfFit | None:
    """Return `lack_of_fit`; None for a calibration that did not converge or has non-finite equations."""
    if not result.converged:
        return None
    try:
        return lack_of_fit(result)
    except np.linalg.LinAlgError:
        return None


def _parts(compared: Comparison, model: Candidate, known: Repeatability | None = None) -> dict[str, float]:
    """Return the RMS of a row's instrument, robot (in position, or orientation without lengths) and joints."""
    repeatability = known or model.evidence.repeatability(model.point.logs)
    only = replace(repeatability, instrument=0.0, joint=0.0)
    squares = {"instrument": 0.0, "position": 0.0, "joint": 0.0}
    for stack in model.evidence.data.stacks:
        which = stack.of(compared.dimension)
        variance = np.einsum("nkk->nk", stack.instrument)
        squares["instrument"] += repeatability.instrument**2 * float(np.sum(variance[which]))
        squares["joint"] += repeatability.joint**2 * float(np.sum(np.sum(stack.joint**2, axis=2)[which]))
        squares["position"] += float(np.sum(np.einsum("nkk->nk", stack.covariance(only))[which]))
    return {kind: float(np.sqrt(total / compared.rows)) for kind, total in squares.items()}


def _upward(compared: Comparison, present: Mapping[str, float]) -> tuple[str, ...]:
    """Return the joints that surely turn against gravity, where gravity is worth its parameters."""
    model = compared.best
    # signs of measured torques are the table's; numbers of joints would be ambiguous
    if measured_torques(compared.problem.data) or len(compared.problem.arms) > 1:
        return ()
    if "gravity" not in {*model.extensions, *present}:
        return ()
    z = model.point.z
    moves = np.linalg.norm(model.evidence.data.X[compared.equations] * z, axis=0)
    names = compared.names[compared.members(model.extensions)].tolist()
    return against_gravity(compared.problem.robot, names, z, np.sqrt(np.diag(model.point.C)), moves)


def _repeated(problem: CalibrationProblem, x: Array, dimension: str) -> tuple[float | None, int]:
    """Return the RMS [m or rad] of repeated readings about their mean, None for too few, and its freedom."""
    squares, rows, freedom = 0.0, 0, 0
    for block, residual in by_block(problem, problem.residual(x)):
        r = residual[:, [d == dimension for d in block.measurement.components.values()]]
        number = repeated(block)
        again = len(r) - len(np.unique(number))
        means = np.array([np.bincount(number, column) for column in r.T]).T / np.bincount(number)[:, None]
        squares += float(np.sum((r - means[number]) ** 2))
        rows += again
        freedom += again * r.shape[1]
    if freedom < FEWEST:
        return None, freedom
    return float(np.sqrt(squares / rows)), freedom


def _residual_autocorrelation(compared: Comparison, model: Candidate) -> Autocorrelation | None:
    """Return that of a model's residuals in units of their noise; None where points were touched."""
    if compared.problem.touches is not None:
        return None
    repeatability = model.evidence.repeatability(model.point.logs)
    stacks = model.evidence.data.stacks
    residual = model.evidence.data.y - model.evidence.data.X @ model.point.z
    widest = max(stack.index.shape[1] for stack in stacks)
    errors, kinds, first = [], [], []
    for kind, stack in enumerate(stacks):
        e = residual[stack.index] / np.sqrt(np.einsum("nkk->nk", stack.covariance(repeatability)))
        errors.append(np.pad(e, ((0, 0), (0, widest - e.shape[1]))))
        kinds.append(np.full(len(e), kind))
        first.append(compared.row[stack.index[:, 0]])
    q = compared.problem.joint_values[np.concatenate(first)]
    return autocorrelation(q, np.concatenate(errors), np.concatenate(kinds))


def autocorrelation(q: Array, errors: Array, kinds: np.ndarray) -> Autocorrelation | None:
    """Return the autocorrelation of residuals with those of nearest neighbours in joint space (Moran).

    ::

        rho = sum_i e_i . e_nearest(i) / sum_i e_i . e_i

    and z = (rho - mean) / std over permutations of the residuals; mutual nearest neighbours count twice in both. ``q``
    (N, dof) are joint values, ``errors`` (N, k) residuals in units of their noise, and neighbours are sought among rows
    of the same of the ``kinds`` (N,). None for fewer than `FEWEST_NEIGHBOURS` rows of every kind.
    """
    unit = (q - q.mean(axis=0)) / (q.std(axis=0) + 1e-9)
    groups = [rows for kind in np.unique(kinds) if len(rows := np.flatnonzero(kinds == kind)) >= FEWEST_NEIGHBOURS]
    squares = sum(float(np.sum(errors[rows] ** 2)) for rows in groups)
    if not squares > 0:
        return None
    rng = np.random.default_rng(0)
    product = 0.0
    permuted = np.zeros(PERMUTATIONS)
    for rows in groups:
        e = errors[rows]
        near = scipy.spatial.KDTree(unit[rows]).query(unit[rows], k=2)[1]
        # points at the same place may come in any order
        nearest = np.where(near[:, 0] == np.arange(len(rows)), near[:, 1], near[:, 0])
        product += float(np.sum(e * e[nearest]))
        products = e @ e.T
        for k in range(PERMUTATIONS):
            order = rng.permutation(len(rows))
            permuted[k] += float(np.sum(products[order, order[nearest]]))
    spread = float(permuted.std())
    if not spread > 0:
        return None
    return Autocorrelation(product / squares, (product - float(permuted.mean())) / spread)


def _size(found: LackOfFit, value: float) -> str:
    return in_unit(value, found.dimension)


def _limit(found: LackOfFit) -> str:
    """Say what limits the result: an effect that the model lacks, the robot or the instrument."""
    if found.autocorrelation is not None and found.autocorrelation.z > CORRELATED:
        even = "Even then, residuals" if found.missing else "Residuals"
        together = f" {TOGETHER}" if found.updated and not found.missing else ""
        return (
            f"{even} of neighbouring configurations are correlated ({found.autocorrelation.correlation:.2f}, z = "
            f"{found.autocorrelation.z:.0f}): the model lacks an effect, which averaging more readings does not "
            f"remove.{together}"
        )
    if found.robot > GROSS * found.instrument:
        return "No robot has such poor repeatability: check units, signs, frames and rows first."
    if found.robot > ROUGH * found.instrument:
        limit = "The robot, not the instrument, limits the result"
        if found.repeated is not None:
            return f"{limit}." if found.excess else f"{limit}, by its repeatability, backlash or drift."
        return (
            f"{limit}; the data do not separate repeatability from an effect that the model lacks. Repeat five "
            "configurations, approached from both sides, before you buy a better instrument."
        )
    if found.overstated:
        return "Repeat one reading ten times and state its standard deviation as the measurement noise."
    if found.robot < FINE * found.instrument:
        return "The instrument limits the result: only a more accurate one would show the robot's repeatability."
    return ""
