"""Model extensions that the data support: which can be identified, and which the marginal likelihood selects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import chain, combinations
from operator import itemgetter
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.bayes.evidence import Evidence, Point
from rpim_opt.bayes.hyperparameters import Fit, Learning, Trial
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.family import families, family_scales
from rpim_opt.robot.parameter_names import EXPANSION, frame_of, of_session, own_name, session_prefix

TURNED = 2.0
"""Harmonics are looked for in joints that turned further [rad]: over less they are curve fitting."""
MANY = 40
"""Configurations from which on the last of the candidates is tried."""
TURNING = ("first harmonic", "second harmonic")
"""Families of joints that turned far enough."""
CANDIDATES = (
    (),
    ("gravity",),
    ("first harmonic",),
    ("gravity", "first harmonic"),
    ("gravity", "first harmonic", "second harmonic", "moments"),
)
"""The models of the arm that are compared."""
SESSIONS = "sessions"
"""The family of what the readings of a session have in common, which is none of the arm."""
WARMTH = "temperature"
"""The family of what grows with temperature."""
CONDITIONS = (SESSIONS, WARMTH)
"""Families of how and when was measured; each is a question of its own."""


def members(problem: CalibrationProblem) -> dict[str, tuple[str, ...]]:
    """Return the parameters of every family that these data may tell and that are not identified yet."""
    found: dict[str, tuple[str, ...]] = {}
    for robot in problem.arms:
        for family, names in _of_robot(problem, robot).items():
            found[family] = tuple(dict.fromkeys((*found.get(family, ()), *names)))
    shifts = _of_sessions(problem)
    if shifts:
        found[SESSIONS] = shifts
    known = set(problem.parameters.free.names)
    grows = tuple(name for name in problem.parameters.names if own_name(name) == EXPANSION and name not in known)
    if grows and np.ptp(problem.data.temperatures) > 0:
        found[WARMTH] = grows
    return found


def _of_sessions(problem: CalibrationProblem) -> tuple[str, ...]:
    """Return the shifts of sessions that are not identified yet, if sessions differ from single configurations."""
    data = problem.data
    known = set(problem.parameters.free.names)
    prefixes = {session_prefix(name) for name in data.sessions}
    if not 2 <= len(prefixes) <= len(np.unique(data.configuration)) / 2:
        return ()
    of_data = [name for name in problem.parameters.names if frame_of(name) in prefixes]
    return tuple(name for name in of_data if name not in known)


def _of_robot(problem: CalibrationProblem, robot: str) -> dict[str, list[str]]:
    """Return the same of one of several robots."""
    p = problem.parameters
    q = problem.alone(robot).joint_values
    turned = {str(i) for i, travel in enumerate(np.ptp(q, axis=0), start=1) if travel > TURNED}
    known = set(p.free.names)
    found = {}
    for family, names in families(problem.arms[robot]).items():
        left = names
        if family in TURNING:
            left = [name for name in names if name.rpartition("_")[2].lstrip("cosin") in turned]
        called = [p.called(robot, name) for name in left]
        found[family] = [name for name in called if name not in known]
    return {family: names for family, names in found.items() if names}


def _is_of_arm(name: str) -> bool:
    """Return whether the arm says how large a parameter is expected; others have their scale."""
    return not of_session(name) and own_name(name) != EXPANSION


def identifying(problem: CalibrationProblem, names: tuple[str, ...]) -> CalibrationProblem:
    """Return the problem that identifies parameters of families, too, at the scales that their effects suggest."""
    p = problem.parameters
    index = [p.names.index(name) for name in names]
    identified = p.identified.copy()
    scale = p.scale.copy()
    identified[index] = True
    for name, robot in problem.arms.items():
        mine = [i for i in p.places_of(name) if i in index and _is_of_arm(p.names[i])]
        scale[mine] = family_scales(robot, [own_name(p.names[i]) for i in mine])
    return problem.with_parameters(replace(p, identified=identified, scale=scale))


GAIN = 6.0
"""By how much -2 ln L must fall for a model with families: of 306 simulated arms without them one gained more.

For sessions and for temperature once more each: they are other questions."""
LARGE = 3.0
"""By how much larger, in their logarithms, families are expected in another start."""
COMPARED = 1e-6
"""Of -2 ln L, to which models are compared: hundredths, of some thousands."""
Priced = tuple[float, tuple[str, ...], Any]
"""A model that was compared: what decides, its families, and what was found."""
ROUNDS = 3
"""Linearizations at which the sizes of the chosen model are looked for."""


def modelled(learning: Learning, fit: Fit) -> tuple[Fit, tuple[Trial, ...]]:
    """Return the fit of the model that the evidence wants, and the models compared, the wanted one first.

    Parameters
    ----------
    learning
        How sizes are found.
    fit
        Of the parameters that were to be identified.
    """
    added, trials, point = chosen(learning, fit)
    if not added:
        return fit, trials
    whole, x = extended(fit.problem, fit.x, added)
    return learning.fitted(whole, x, point.logs, ROUNDS), trials


def chosen(learning: Learning, fit: Fit) -> tuple[tuple[str, ...], tuple[Trial, ...], Point]:
    """Return the parameters of the families that the evidence wants, the models compared, and the winner's sizes.

    All models are compared at one linearization: families are small.
    """
    families = members(fit.problem)
    whole, x = extended(fit.problem, fit.x, tuple(chain.from_iterable(families.values())))
    columns = learning.evidence(whole, x)
    names = whole.parameters.free.names
    own = set(fit.problem.parameters.free.names)
    before = _named(fit.evidence, fit.point)
    sizes: dict[frozenset[str], dict[str, float]] = {}

    def tried(candidate: tuple[str, ...]) -> tuple[float, tuple[str, ...], Point]:
        used = own.union(*(families[family] for family in candidate))
        evidence = restricted(columns, np.array([name in used for name in names]))
        conditions = frozenset(candidate).intersection(CONDITIONS)
        point = evidence.mode(_starts(evidence, sizes.get(conditions, before)), COMPARED)[0]
        if conditions and conditions == set(candidate):  # what they explain stood among the noise
            sizes[conditions] = _named(evidence, point)
        return point.value + GAIN * _questions(candidate), candidate, point

    trials = sorted(compared(fit.problem, families, tried), key=itemgetter(0))
    _, best, point = trials[0]
    added = tuple(name for family in best for name in families[family])
    return added, tuple(Trial(candidate, each.value) for _, candidate, each in trials), point


def compared(
    problem: CalibrationProblem,
    families: dict[str, tuple[str, ...]],
    tried: Callable[[tuple[str, ...]], Priced],
) -> list[Priced]:
    """Return the models that were compared, what ``tried`` says of each: its price first, its families second.

    Families of the arm are chosen with all conditions in the model, which would stand for them else; then of the best
    one each condition is asked for.
    """
    conditions = tuple(condition for condition in CONDITIONS if condition in families)
    found = [tried((*candidate, *conditions)) for candidate in _of_arm(problem, families)]
    best = min(found, key=itemgetter(0))[1]
    kept = tuple(family for family in best if family not in conditions)
    for count in range(len(conditions)):
        found += [tried((*kept, *some)) for some in combinations(conditions, count)]
    return found


def _of_arm(problem: CalibrationProblem, families: dict[str, tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return the models of the arm that these data may tell apart, each once."""
    arm = CANDIDATES
    if len(np.unique(problem.data.configuration)) < MANY:
        arm = CANDIDATES[:-1]
    possible = [tuple(family for family in candidate if family in families) for candidate in arm]
    return list(dict.fromkeys(possible))


def _questions(families: tuple[str, ...]) -> int:
    """Return how many questions a model answers with yes: whether the arm has families, and each of the conditions."""
    conditions = set(families) & set(CONDITIONS)
    return len(conditions) + (len(families) > len(conditions))


def extended(problem: CalibrationProblem, x: Array, names: tuple[str, ...]) -> tuple[CalibrationProblem, Array]:
    """Return the problem that identifies more parameters, and its deviations, those zero."""
    whole = identifying(problem, names)
    known = dict(zip(problem.parameters.free.names, x, strict=True))
    return whole, np.array([known.get(name, 0.0) for name in whole.parameters.free.names])


def size_names(evidence: Evidence) -> tuple[str, ...]:
    """Return the names of all sizes: of deviations, then of noise."""
    return (*evidence.believed.names, *evidence.noise)


def _named(evidence: Evidence, point: Point) -> dict[str, float]:
    return dict(zip(size_names(evidence), point.logs.tolist(), strict=True))


def _starts(evidence: Evidence, sizes: Mapping[str, float]) -> list[Array]:
    """Return where the optimum of a model with families is looked for.

    Parameters
    ----------
    evidence
        Of the model.
    sizes
        Logarithms of sizes by name, of a model that was looked at before.
    """
    names = size_names(evidence)
    logs = np.array([sizes.get(name, centre) for name, centre in zip(names, evidence.centre, strict=True)])
    starts = [logs]
    new = [i for i, name in enumerate(names) if name not in sizes]
    if new:  # at small sizes the likelihood is flat in a family whose effect the noise has taken up
        large = logs.copy()
        large[new] += LARGE
        starts.append(large)
    return starts


def restricted(evidence: Evidence, keep: np.ndarray) -> Evidence:
    """Return the evidence of a model with some of the columns (n,)."""
    believed = evidence.believed
    group = believed.group[keep]
    used = np.unique(group[group >= 0])
    number = np.full(len(believed.names) + 1, -1)
    number[used] = np.arange(len(used))
    fewer = replace(
        believed,
        group=number[group],
        heavy=believed.heavy[keep],
        names=tuple(believed.names[i] for i in used),
        covariance=believed.covariance[np.ix_(used, used)],
        replaced=believed.replaced[keep],
        rows=believed.rows[:, keep],
    )
    return replace(evidence, data=replace(evidence.data, X=evidence.data.X[:, keep]), believed=fewer)
