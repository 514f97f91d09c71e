"""Monitoring of a calibrated robot by check readings: single checks, cumulative sum (CUSUM), drifting parameters."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy
from scipy.special import fdtrc, fdtri, ndtr, ndtri

from rpim_opt.basics.arrays import Array, finite_numbers, rms
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import columns_csv, records
from rpim_opt.basics.text import joined, listed, three_digits
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.bayes.outliers import by_block
from rpim_opt.calibration.covariance import noise_covariances
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import UNINFORMATIVE, held_out_errors, unregistered
from rpim_opt.calibration.verdict import misread
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.parameters import own_name
from rpim_opt.use import recalibration
from rpim_opt.use.sessions import registered_again, set_ups

TESTS = 3  # single checks, their sum, and parameters: each may err by a third of `recalibration.FALSE_ALARM`
MOMENTS = 40  # checks at which a change is first tried if there are more, then all near the best of a cause
SMALLEST = 1e-12  # lower bound on probabilities: 7 standard deviations
ALLOWANCE = 0.5  # CUSUM's reference value k, subtracted from every deviate: fastest for a shift of twice its size
CELLS = 150  # steps of a sum's range in the Markov chain of its distribution
HIGHEST_LIMIT = 50.0
SET_UP_ANEW = 3.0  # factor of errors without over with registration of every set-up, from which set-ups have moved
DAY = 86400.0  # seconds
FAR, NEARLY = 100.0, 0.9
"""Standard deviations of a motion that may be beyond linearization, and the part of chi-squared that it explains."""
UNDELIVERED = "The calibration is not delivered: its prediction intervals may hide a change of the robot."
MOTION = 1.0  # prior standard deviation of a motion determined from the checks [m, rad]


def _shown(cause: recalibration.Cause) -> dict[str, Any]:
    """Return a cause as a document, without the posterior probability, which checks over time do not get."""
    return {key: value for key, value in cause._asdict().items() if key != "probability"}


class Drift(NamedTuple):
    """A change during checks."""

    cause: recalibration.Cause
    first: int  # first check after it
    steady: bool  # from the first check to the last
    moved: recalibration.Moved | None  # total movement of a single parameter; None for a frame
    others: tuple[str, ...] = ()  # causes that explain the checks equally well

    def content(self) -> dict[str, Any]:
        """Return it as a document [mm, deg]."""
        moved = self.moved and self.moved.content()
        return {**_shown(self.cause), "first": self.first, "steady": self.steady, "moved": moved}


@dataclass(frozen=True, eq=False)
class Monitoring:
    """N checks of a robot in order of time, compared with the predictions of its calibration.

    ``times`` are their times as in the table and ``when`` (N,) in s; empty and None if unknown. ``error`` (N,) are the
    errors of the calibration [m]; ``sigmas`` (N,) the innovation of a check, beyond the calibration and previous
    checks, in standard deviations of a new reading, and ``allowed`` (N,) a limit that any of all N rarely exceeds;
    ``sums`` (N,) their cumulative sum (CUSUM) and ``limit`` its limit. ``drift`` is the change that explains them best,
    None if chance does; ``wrong`` are readings that an error of their own explains better, left out of sums and
    changes; ``mistake`` is a sentence on a likely mistake in the checks; ``registered`` states the motions of
    registered checks, ``undelivered`` that the calibration is not delivered.
    """

    label: tuple[str, ...]
    times: tuple[str, ...]
    when: Array | None
    error: Array
    sigmas: Array
    allowed: Array
    sums: Array
    limit: float
    drift: Drift | None = None
    wrong: tuple[recalibration.Cause, ...] = ()
    mistake: str = ""
    registered: str = ""
    undelivered: str = ""

    @property
    def beyond(self) -> tuple[int, ...]:
        """Numbers of the checks beyond the interval of a new reading."""
        return tuple(int(i) for i in np.flatnonzero(self.sigmas > self.allowed))

    @property
    def alarm(self) -> int | None:
        """The first check at which the cumulative sum exceeds its limit; None if it does not."""
        return next((int(i) for i in np.flatnonzero(self.sums > self.limit)), None)

    @property
    def drifts(self) -> bool:
        """Whether one check, their sum, or a parameter shows drift."""
        return bool(self.beyond) or self.alarm is not None or self.drift is not None

    def content(self) -> dict[str, Any]:
        """Return the figures, and the chart's points [mm]."""
        label: dict[int | None, str] = dict(enumerate(self.label))
        return {
            "drifts": self.drifts,
            "checks": len(self.label),
            "beyond": [self.label[i] for i in self.beyond],
            "alarm": label.get(self.alarm),
            "since": label.get(self.since),
            "limit": self.limit,
            "moved": self.drift and {**self.drift.content(), "label": label[self.drift.first]},
            "wrong": [_shown(cause) for cause in self.wrong],
            "mistake": self.mistake,
            "registered": self.registered,
            "undelivered": self.undelivered,
            "rows": records(self._columns()),
        }

    def csv(self) -> str:
        """Return the chart's points as CSV."""
        return columns_csv(self._columns())

    def __str__(self) -> str:
        count = f"{len(self.label)} checks"
        out = {label for cause in self.wrong for label in cause.members}
        lines = [f"No drift in {count}."]
        deviates = self.drift or self.alarm is not None or any(self.label[i] not in out for i in self.beyond)
        if deviates:
            lines = [f"The robot deviates from its calibration ({count}).", *filter(None, [self.mistake])]
        elif self.wrong:
            lines = [f"No drift in {len(self.label) - len(out)} of {count}; the others are wrong readings."]
        for cause in self.wrong:
            what = f"Reading {cause.members[0]} is wrong by itself"
            if len(cause.members) > 1:
                what = f"The readings {cause.name} of one configuration are wrong together"
            figures = f"chi-squared falls by {three_digits(cause.gain)}, p-value {cause.p_value:.2g}"
            lines.append(f"{what}: {figures}. Measure again.")
        if self.beyond:
            named = [f"{self._named(i)}, {1e3 * self.error[i]:.3f} mm" for i in self.beyond]
            lines.append(f"Outside the prediction interval of a new reading: {listed(named, between='; ')}.")
        if self.alarm is not None and self.since is not None:
            at, since = map(self._named, (self.alarm, self.since))
            lines.append(f"Cumulative sum above its limit at check {at}, rising since {since}.")
        if self.drift is not None:
            cause, first = self.drift.cause, self.drift.first
            what = f"{cause.kind} {self.drift.moved}" if self.drift.moved else str(cause)
            course, rows = f"in one step before {self._named(first)}", " with the checks from then on"
            if self.drift.steady:
                course, rows = "steadily from the first to the last check", " with the last ones"
            elif not first:
                course, rows = "before the first check", ""
            lines.append(
                f"Best explained by {what}, {course}: chi-squared falls by "
                f"{three_digits(cause.gain)}, p-value {cause.p_value:.2g}. Recalibrate by `update`{rows}."
            )
            if self.drift.others:
                lines.append(f"A change of {joined(self.drift.others)} explains the checks as well: measure more.")
        elif deviates:
            lines.append("No single parameter or frame explains the deviation. Recalibrate by `update`.")
        worst = int(np.argmax(self.sigmas / self.allowed))
        lines.append(
            f"Largest residual: {self._named(worst)}, {self.sigmas[worst]:.1f} standard deviations of a new reading "
            f"({self.allowed[worst]:.1f} allowed), {1e3 * self.error[worst]:.3f} mm. "
            f"Largest cumulative sum: {self.sums.max():.1f} ({self.limit:.1f} allowed)."
        )
        return "\n".join([*lines, *filter(None, [self.registered, self.undelivered])])

    @property
    def since(self) -> int | None:
        """The first check that led to the alarm, after the last sum that was zero; None without an alarm."""
        if self.alarm is None:
            return None
        return int(np.flatnonzero(np.append(0.0, self.sums[: self.alarm]) == 0)[-1])

    def _named(self, i: int) -> str:
        return f"{self.label[i]} ({self.times[i]})" if self.times else f"'{self.label[i]}'"

    def _columns(self) -> dict[str, Sequence[Any]]:
        figures = {"error_mm": 1e3 * self.error, "sigmas": self.sigmas, "allowed_sigmas": self.allowed}
        figures["sum"] = self.sums
        named = {"label": self.label, "time": self.times} | {name: values.tolist() for name, values in figures.items()}
        return {name: cells for name, cells in named.items() if cells}


@one_blas_thread
def monitor(
    result: Calibration, data: Dataset, when: Array | None = None, times: tuple[str, ...] = (), register: bool = False
) -> Monitoring:
    """Compare checks over time with the predictions of a calibration, singly and by their cumulative sum.

    A check is judged by the prediction interval of a new reading, given the calibration and all previous checks; the
    innovations are accumulated (Page's CUSUM); and a change of every parameter and frame is tried, either before some
    check or steady. The total probability of a false alarm for a robot without drift is 0.01.

    The result has a squared penalty or none. ``data`` are check readings in the calibration's instrument frame, in the
    order of ``when`` (N,) [s] if stated; ``times`` are N texts. With ``register``, each of their `set_ups` may be in a
    frame of its own: its motion is unknown in all tests, which costs six equations. InputError if there is not one time
    per check, for sessions with unknown registration, and for a result without covariance (lasso).

    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> found = ro.use.monitor(ro.calibrate(instance.problem), instance.validation)
    >>> found.alarm, found.beyond, found.drift, str(found).splitlines()[0]
    (None, (), None, 'No drift in 40 checks.')
    >>> found.csv().splitlines()[0]
    'label,error_mm,sigmas,allowed_sigmas,sum'
    """
    count = len(data)
    if when is not None:
        when = finite_numbers("monitor, when", when, (count,))
        order = np.argsort(when, kind="stable")
        data = data.take(order)
        when = when[order]
        times = tuple(times[i] for i in order[: len(times)])
    visit = None if when is None else np.unique(when, return_inverse=True)[1]
    own = np.array([data.session == name for name in set_ups(result, data) if register], float).reshape(-1, count)
    data, motion = registered_again(result, data) if register else (data, "")
    problem = recalibration.with_data(result, recalibration.by_visit(data, visit))
    level = recalibration.FALSE_ALARM / TESTS
    sigmas, deviate, equations = _innovations(result, problem, own, level / count)
    course = np.arange(count) if when is None or np.ptp(when) == 0 else when - when[0]
    drift, wrong = _drift(result, problem, own, course / max(course[-1], 1), level)
    right = ~np.isin(data.label, [label for cause in wrong for label in cause.members])
    held = held_out_errors(result, data)
    if unknown := unregistered(result, data, held):  # which would appear as a change of the robot
        raise InputError("the checks", unknown.partition(":")[0].replace("The", "the", 1), "--register")
    return Monitoring(
        label=data.label, times=times, when=when, error=result.errors(data), sigmas=sigmas,
        allowed=np.sqrt(equations * fdtri(equations, max(result.noise_dof, 1.0), 1 - level / count)),
        sums=cusum(deviate * right), limit=cusum_limit(count, level), drift=drift, wrong=wrong, registered=motion,
        mistake=_mistake(result, data, when, right, register, drift),
        undelivered=UNDELIVERED * (not result.verdict.delivered),
    )  # fmt: skip


def _mistake(
    result: Calibration, data: Dataset, when: Array | None, right: np.ndarray, register: bool, drift: Drift | None
) -> str:
    """Return a likely mistake in checks (N,), or a motion by those that are right if drift may be one; or nothing."""
    names, apart = set_ups(result, data), data
    between, remedy = f"sessions {listed(names)}", "Use --register"
    if len(names) < 2 and when is not None and drift is None:
        days = (when // DAY).astype(str)
        apart = replace(data, blocks=tuple(replace(each, session=days[each.row]) for each in data.blocks))
        names = [*{*days}]
        between, remedy = "days", "Name its set-ups in a column `session`, and use --register"
    if len(names) > 1:
        with suppress(InputError):
            again = registered_again(result, apart)[0]
            if SET_UP_ANEW * rms(result.errors(again)) < rms(result.errors(data)):
                return f"Likely: the instrument or the base moved between {between}. {remedy}."
    found = misread(result, data)
    data = data.take(np.flatnonzero(right))
    moved = drift is None or (not register and (drift.cause.kind == "frame" or drift.others))
    if found or not moved or not len(data):
        return found
    return recalibration.moved_or_changed(result, data, held_out_errors(result, data))[0]


def _framed(problem: CalibrationProblem) -> tuple[CalibrationProblem, list[int], np.ndarray]:
    """Return the problem with all frames identified, and which deviations are of its bases and of the problem."""
    framed = problem.identifying(problem.parameters.identified | problem.parameters.of_frames)
    names = framed.parameters.free.names
    base = [i for i, name in enumerate(names) if own_name(name).startswith("base_")]
    return framed, base, np.flatnonzero(np.isin(names, problem.parameters.free.names))


def _innovations(
    result: Calibration, problem: CalibrationProblem, own: Array, level: float
) -> tuple[Array, Array, np.ndarray]:
    """Return innovations of N checks in standard deviations, as standard normal deviates, and their equations (N,).

    The calibration's error is common to all predictions. A Kalman filter estimates it from the checks, so that the
    innovations of a robot without drift are independent::

        e = r - J m,    S = J C J' + V,    K = C J' S^-1,    m + K e,    C - K J C

    with |S^-1/2 e| in standard deviations, V the covariance of a reading, and C the remaining covariance after
    calibration and earlier checks. Errors that all readings of a visit share are estimated with it, and anew at the
    next visit. Deviates are from Fisher's F, positive if a check misses more than usual. A check less probable than
    ``level`` does not update the filter. Components that nothing earlier predicts, as in the first checks of a set-up
    with rows ``own`` (s, N), are no equations.
    """
    C = result.known_covariance
    if C is None:
        raise result.no_covariance("`validate` gives errors without intervals")
    known = np.isfinite(np.diag(C))
    framed, base, mine = _framed(problem)
    # of sessions that the calibration does not know, and of motions
    wide = np.append(problem.parameters.free.scale[len(C) :], np.full(len(own) * len(base), MOTION))
    n = len(known)
    C = np.pad(np.where(np.outer(known, known), C, 0.0), (0, len(wide)))
    C[n:, n:] = np.diag(wide**2)
    residual, slopes = framed.slopes(recalibration.previous_deviations(result, framed))
    common = problem.common_errors()
    of_visit = slice(len(C), len(C) + common.shape[1])
    C = np.pad(C, (0, common.shape[1]))
    m = np.zeros(len(C))
    readings = noise_covariances(problem, result.variance_factor).reading
    rows: dict[int, tuple[Array, Array]] = {}
    for (block, part), V in zip(by_block(problem, np.column_stack([residual, slopes, common])), readings, strict=True):
        of_rows = zip(part, np.broadcast_to(V, (len(part), *V.shape[1:])), strict=True)
        rows |= zip(block.row.tolist(), of_rows, strict=True)
    freedom = max(result.noise_dof, 1.0)
    sigmas, p_values, degrees = np.zeros(len(rows)), np.full(len(rows), 0.5), np.zeros(len(rows), dtype=int)
    configuration, visit = problem.data.configuration, None
    first, of_row = np.unique(configuration, return_index=True, return_inverse=True)[1:]
    for t in np.argsort(first[of_row], kind="stable").tolist():
        equations, V = rows[t]
        r, A, D = np.split(equations, [1, 1 + slopes.shape[1]], axis=1)
        if configuration[t] != visit:
            visit = configuration[t]
            m[of_visit], C[of_visit], C[:, of_visit] = 0.0, 0.0, 0.0
            C[of_visit, of_visit] = np.eye(D.shape[1])
        J = np.hstack([A[:, mine], np.kron(own[:, t], A[:, base]), D])
        S = J @ C @ J.T + V - D @ D.T
        e = r[:, 0] - J @ m
        s, U = scipy.linalg.eigh(S, V)
        told = s < UNINFORMATIVE
        degrees[t] = told.sum()
        squares = float(np.sum((U.T @ e)[told] ** 2 / s[told]))
        sigmas[t] = np.sqrt(squares)
        if degrees[t]:
            p_values[t] = fdtrc(degrees[t], freedom, squares / degrees[t])
        if p_values[t] >= level:
            gain = np.linalg.solve(S, J @ C).T
            m = m + gain @ e
            C = C - gain @ S @ gain.T
    return sigmas, -np.asarray(ndtri(np.clip(p_values, SMALLEST, 1 - SMALLEST))), np.maximum(degrees, 1)


def cusum(deviate: Array) -> Array:
    """Return Page's sums (N,), S_t = max(0, S_(t-1) + u_t - `ALLOWANCE`)."""
    total = np.cumsum(deviate - ALLOWANCE)
    return total - np.minimum(np.minimum.accumulate(total), 0.0)


def cusum_limit(count: int, level: float) -> float:
    """Return the limit that sums of ``count`` normal deviates exceed with probability ``level`` (Brook, Evans 1972)."""

    def alarms(limit: float) -> float:
        """Return by how much the probability of an alarm exceeds the level."""
        width = limit / CELLS
        centre = width * (np.arange(CELLS) + 0.5)
        # from sum i to cell j if u - ALLOWANCE is within half a cell of their difference; zero is a cell
        states = np.concatenate([[0.0], centre])
        upper = ndtr(np.concatenate([[0.0], centre + width / 2])[None, :] - states[:, None] + ALLOWANCE)
        step = np.diff(upper, axis=1, prepend=0.0)
        return 1.0 - float(np.linalg.matrix_power(step, count)[0].sum()) - level

    return float(scipy.optimize.bisect(alarms, 1e-3, HIGHEST_LIMIT, xtol=1e-4))


Explained = tuple[float, Drift]
"""Logarithm of the probability of an explanation of checks, and the explanation."""


class _Explanations:
    """Changes before a check or steadily from the first to the last, and single wrong readings.

    Set-ups with rows ``own`` (s, N) may have moved in addition. A frame may have moved even if it was not identified:
    otherwise its motion would appear as a change of the robot. Rows of one configuration count as read together, at the
    time of the first.
    """

    def __init__(self, result: Calibration, problem: CalibrationProblem, own: Array, course: Array, bent: bool) -> None:
        framed, base, mine = _framed(problem)
        self.result, self.free, self.count = result, framed.parameters.free, len(problem.data)
        self.form = recalibration.penalty_of(recalibration.posterior_as_prior(result, problem), len(mine))
        model = framed.linearize(recalibration.previous_deviations(result, framed))
        self.A = model.A / np.sqrt(result.variance_factor)
        moves = [model.A[:, base] * rows[problem.owners, None] for rows in own]
        self.model = replace(model, A=np.hstack([model.A[:, mine], *moves]))
        self.width = recalibration.prior_widths(result, framed) / self.free.scale
        numbers, first = np.unique(problem.data.configuration, return_index=True)
        self.when, self.starts = first[np.searchsorted(numbers, model.group)], np.sort(first).tolist()
        self.course = course[self.when]
        moments = np.linspace(0, len(self.starts) - 1, min(len(self.starts), MOMENTS))
        self.moments = np.unique(moments.round().astype(int)).tolist()
        readings = list(recalibration.readings(problem, self.model))
        self.errors = {cause.members: (rows, errors) for cause, rows, errors in readings}
        causes = [*recalibration.candidates(framed, bent=bent), *(cause for cause, *_ in readings)]
        self.priors = dict(zip(causes, recalibration.log_priors(causes).tolist(), strict=True))

    def columns(self, drift: Drift) -> Array:
        """Return the effect (m, c) of a change: from its first check on, or linear over the checks if it is steady."""
        course = self.course if drift.steady else self.when >= drift.first
        return self.A[:, self._places(drift.cause)] * course[:, None]

    def misfit(self, kept: Array, beside: Drift | None = None) -> recalibration.Misfit:
        """Return the misfit of the equations that are kept (m, 1), with a change if one is given."""
        columns = self.columns(beside) * np.sqrt(self.result.variance_factor) if beside else np.zeros((len(kept), 0))
        model = replace(self.model, A=np.hstack([self.model.A, columns]) * kept, b=self.model.b * kept[:, 0])
        wide = np.pad(self.form.matrix, ((0, 0), (0, model.A.shape[1] - self.form.matrix.shape[1])))
        return recalibration.Misfit(self.result, model, replace(self.form, L=wide))

    def readings(self, misfit: recalibration.Misfit, kept: Array) -> list[Explained]:
        """Return every reading as wrong by itself."""
        return [self._wrong(misfit, kept, cause) for cause in self.priors if cause.kind == "reading"]

    def changes(self, misfit: recalibration.Misfit, kept: Array) -> list[Explained]:
        """Return all changes."""
        causes = [cause for cause in self.priors if cause.kind != "reading"]
        return [each for cause in causes for each in self._changes(misfit, kept, cause)]

    def _places(self, cause: recalibration.Cause) -> list[int]:
        return [self.free.names.index(name) for name in cause.members]

    def _changes(self, misfit: recalibration.Misfit, kept: Array, cause: recalibration.Cause) -> list[Explained]:
        """Return a change before some checks, all around the best of these, and steadily."""

        def before(i: int) -> Explained:
            return self._changed(misfit, kept, Drift(cause, self.starts[i], False, None))

        steps = list(map(before, self.moments))
        k = max(range(len(steps)), key=lambda k: steps[k][0])
        around = range(self.moments[max(k - 1, 0)] + 1, self.moments[min(k + 1, len(steps) - 1)])
        steps += [before(i) for i in around if i not in self.moments]
        return steps + [self._changed(misfit, kept, Drift(cause, 0, True, None))] * (self.count > 2)

    def _changed(self, misfit: recalibration.Misfit, kept: Array, drift: Drift) -> Explained:
        index = self._places(drift.cause)
        g, G = misfit.projected(slice(misfit.m), kept * self.columns(drift))
        moved, scale = None, float(self.free.scale[index[0]])
        if len(g) == 1 and G[0, 0] > 0:
            change, std = float(scale * g[0] / G[0, 0]), float(scale / np.sqrt(G[0, 0]))
            moved = recalibration.Moved(drift.cause.name, self.free.dimensions[index[0]], change, std)
        log = self.priors[drift.cause] + recalibration.log_bayes_factor(g, G, self.width[index])
        return log, drift._replace(cause=misfit.evidence(drift.cause, g, G), moved=moved)

    def _wrong(self, misfit: recalibration.Misfit, kept: Array, cause: recalibration.Cause) -> Explained:
        rows, errors = self.errors[cause.members]
        g, G = misfit.projected(rows, kept[rows] * errors)
        bayes = recalibration.log_bayes_factor(g, G, np.full(len(g), recalibration.OUTLIER_WIDTH))
        return self.priors[cause] + bayes, Drift(misfit.evidence(cause, g, G), int(self.when[rows[0]]), False, None)


def _likeliest(found: Iterable[Explained]) -> Explained:
    return max(found, key=lambda each: each[0])  # as in `update`: p-values favour few parameters


def _drift(
    result: Calibration, problem: CalibrationProblem, own: Array, course: Array, level: float
) -> tuple[Drift | None, tuple[recalibration.Cause, ...]]:
    """Return the change that explains checks best, set-ups moved or not, and the readings that are wrong by themselves.

    A steady change has its ``course`` (N,), from 0 to 1. None and an empty tuple if chance explains the checks,
    considering all causes that were tried.
    """
    explanations = _Explanations(result, problem, own, course, False)
    found = [_explained(explanations, level, True)]
    if not found[-1].enough:  # many wrong readings may be a change
        found.append(_explained(explanations, level, False))
    drift = found[-1].drift
    if not found[-1].enough or (drift and len(drift.cause.members) > 1):  # and several changes one of a link
        found.append(_explained(_Explanations(result, problem, own, course, True), level, False))
    best = max(found, key=lambda each: (each.log, each.drift is not None))
    return best.drift, best.wrong


class _Explanation(NamedTuple):
    """A change and wrong readings, the logarithm of their probability, and whether no other one is to be tried."""

    log: float
    drift: Drift | None
    wrong: tuple[recalibration.Cause, ...]
    enough: bool


def _explained(explanations: _Explanations, level: float, single: bool) -> _Explanation:
    """Return the explanation of checks; unless ``single``, first a change, together with which readings may be wrong.

    Its probability is zero if more than `recalibration.SPARED` of the readings would be wrong.
    """
    kept = np.ones((len(explanations.A), 1))
    wrong: list[recalibration.Cause] = []
    log, nearly = 0.0, None
    while len(wrong) <= recalibration.SPARED * len(explanations.starts):
        misfit = explanations.misfit(kept)
        found = explanations.changes(misfit, kept) + single * explanations.readings(misfit, kept)
        more, best = _likeliest(found)
        if best.cause.p_value * len(found) >= level:
            return _Explanation(log, None, tuple(wrong), len(wrong) <= 1)
        if len(best.cause.members) > 1:  # shown by one reading alone, as before the last one of a set-up
            alone = [
                each for each in found if each[1].cause.kind == "reading" and each[1].cause.gain >= best.cause.gain
            ]
            more, best = _likeliest(alone or [(more, best)])
        out = best
        if best.cause.kind != "reading":
            beside = explanations.misfit(kept, best)
            of_reading, out = _likeliest(explanations.readings(beside, kept))
            if out.cause.p_value * len(found) >= level:
                others = recalibration.as_good(best.cause, (drift.cause for _, drift in found))
                enough = len(wrong) <= 1 and beside.fit.likely
                return _Explanation(log + more, best._replace(others=tuple(others)), tuple(wrong), enough)
            far = misfit.fit.squares > FAR**2 * misfit.fit.equations
            if far and not wrong and best.cause.gain > NEARLY * misfit.fit.squares:
                nearly = best._replace(moved=None)
            together, second = _likeliest(explanations.changes(beside, kept))
            if not nearly and together > of_reading and second.cause.gain > out.cause.gain:  # several changes
                return _Explanation(log + more + together, None, tuple(wrong), False)
            more = of_reading
        log += more
        wrong.append(out.cause)
        kept[explanations.errors[out.cause.members][0]] = 0.0  # all equations of its configuration
    return _Explanation(-np.inf, nearly, (), False)
