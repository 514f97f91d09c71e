"""What has changed since a calibration: every parameter, frame and reading tried as the cause of what is missed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc, logsumexp

from rpim_opt.basics.arrays import Array
from rpim_opt.bayes.prior_terms import default_widths
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.structure import Quadratic
from rpim_opt.problem.linear import RANK_TOLERANCE, LinearModel
from rpim_opt.robot.overlay import is_joint_offset
from rpim_opt.robot.parameter_names import of_session
from rpim_opt.robot.parameters import Parameters

RARE = 0.01
"""Probability with which a robot that did not change is said to have changed, over all causes."""
SIZES = (1.0, 3.0, 10.0, 30.0)
"""Multiples of a deviation's width that a change may have, each as likely: tails that no crash leaves."""
NOTHING = 0.5
"""What is believed beforehand: that nothing changed; the other half is dealt out to the kinds of causes in use."""
WRONG = 10.0
"""Standard deviations by which a wrong reading is off, times `SIZES`."""
WEAK = 1e-9
"""Part of the largest eigenvalue below which readings do not see a direction of a change."""


class Fit(NamedTuple):
    """Chi-squared of readings about what a prior expects of them, over how many equations, and its probability."""

    squares: float
    equations: int
    probability: float

    @property
    def likely(self) -> bool:
        """Whether chance alone makes it as large in more than one robot of a hundred."""
        return self.probability >= RARE


class Reading(NamedTuple):
    """A configuration's rows by their labels, and the numbers of their equations."""

    labels: tuple[str, ...]
    equations: np.ndarray


class Cause(NamedTuple):
    """A change that may be why readings miss their predictions.

    Its name, kind (``joint offset``, ``parameter``, ``frame``, ``reading``), parameters or rows; by how much
    chi-squared falls with it, the probability of that where nothing changed, and how much it is believed afterwards.
    """

    name: str
    kind: str
    members: tuple[str, ...]
    gain: float = 0.0
    chance: float = 1.0
    believed: float = 0.0


class Missed:
    """What new readings miss, in units of what instrument, robot and the earlier calibration allow them together.

    With the readings' equations A z ~ b and the prior's L z ~ c, all in standard deviations, a change d of some
    deviations moves the prior alone, L (z - d) ~ c. By the residual e of both together and M = I - B (B'B)^-1 B' of
    B = [A; L], with D = [0; L] of the parameters that change::

        chi^2 = e' e        it falls by  g' G^-1 g,    g = D' e,    G = D' M D

    Parameters
    ----------
    model
        The readings' equations, linearized where readings and prior meet.
    prior
        |L z - c|^2.
    level
        Variance of the noise in units of the equations'.
    freedom
        Degrees of freedom of what is known of that variance.
    """

    def __init__(self, model: LinearModel, prior: Quadratic, level: float, freedom: float) -> None:
        sigma = np.sqrt(level)
        self.model = model
        self.L = prior.matrix / sigma
        self.freedom = max(freedom, 1.0)
        self.A = model.A / sigma
        B = np.vstack([self.A, self.L])
        y = np.concatenate([model.b / sigma, prior.c / sigma])
        U, s, _ = np.linalg.svd(B, full_matrices=False)
        self.Q = U[:, s > RANK_TOLERANCE * s[0]]
        self.e = y - self.Q @ (self.Q.T @ y)

    @cached_property
    def fit(self) -> Fit:
        """All of it: chi-squared has as many degrees of freedom as there are readings."""
        m = len(self.model.b)
        squares = float(self.e @ self.e)
        return Fit(squares, m, self._chance(squares, m))

    def of_parameters(self, index: Sequence[int]) -> tuple[Array, Array]:
        """Return g (p,) and G (p, p) of a change of some parameters."""
        D = np.zeros((len(self.e), len(index)))
        D[len(self.model.b) :] = self.L[:, list(index)]
        return self._moved(D)

    def of_equations(self, index: np.ndarray) -> tuple[Array, Array]:
        """Return the same of readings that are wrong."""
        D = np.zeros((len(self.e), len(index)))
        D[index, np.arange(len(index))] = 1.0
        return self._moved(D)

    def of_drift(self, index: Sequence[int], course: Array) -> tuple[Array, Array]:
        """Return the same of parameters that move while readings are taken, by ``course`` (m,) of the whole change."""
        D = np.zeros((len(self.e), len(index)))
        D[: len(course)] = self.A[:, list(index)] * course[:, None]
        return self._moved(D)

    def _moved(self, D: Array) -> tuple[Array, Array]:
        along = self.Q.T @ D
        return D.T @ self.e, D.T @ D - along.T @ along

    def gain(self, g: Array, G: Array) -> tuple[float, float]:
        """Return by how much chi-squared falls, and the probability of that where nothing changed."""
        s, U = np.linalg.eigh(G)
        seen = s > WEAK * max(float(s[-1]), 1.0)
        if not seen.any():
            return 0.0, 1.0
        fall = float(np.sum((U[:, seen].T @ g) ** 2 / s[seen]))
        return fall, self._chance(fall, int(seen.sum()))

    def _chance(self, squares: float, m: int) -> float:
        return float(fdtrc(m, self.freedom, squares / m))


def evidence(g: Array, G: Array, width: Array) -> float:
    """Return ln of the Bayes factor for a change against none: of widths (p,), each of `SIZES` as likely as the others.

    ::

        ln p(y | d ~ N(0, W^2)) / p(y | 0) = (g' (G + W^-2)^-1 g - ln det(I + W G W)) / 2
    """
    found = []
    for size in SIZES:
        W = size * width
        inner = np.eye(len(g)) + W[:, None] * G * W
        squares = (W * g) @ np.linalg.solve(inner, W * g)
        found.append(0.5 * (squares - np.linalg.slogdet(inner)[1]))
    return float(logsumexp(found) - np.log(len(SIZES)))


def possible(free: Parameters, known: np.ndarray) -> list[Cause]:
    """Return the changes of parameters that may be looked for: each of the robot's own, and every frame as a whole.

    Parameters
    ----------
    free
        The n identified parameters.
    known
        (n,) those of which the earlier calibration says something, and that are not said to have changed.
    """
    causes = []
    frames: dict[str, list[str]] = {}
    for name, frame, kept in zip(free.names, free.of_frames, known, strict=True):
        if not kept or of_session(name):  # an earlier session is over
            continue
        if frame:
            frames.setdefault(name.rpartition("_")[0], []).append(name)
        elif is_joint_offset(name):
            causes.append(Cause(name, "joint offset", (name,)))
        else:
            causes.append(Cause(name, "parameter", (name,)))
    return causes + [Cause(name, "frame", tuple(names)) for name, names in frames.items()]


def weighed(
    missed: Missed, causes: Sequence[Cause], width: Array, readings: Sequence[Reading] = ()
) -> tuple[Cause, ...]:
    """Return causes with their evidence, the most believed first.

    Kinds of causes are as likely as each other before the readings, and so are the causes of a kind.

    Parameters
    ----------
    missed
        What the readings miss.
    causes
        Changes of parameters.
    width
        (n,) how large deviations are expected, in units of their scales.
    readings
        Each may be wrong itself.
    """
    place = {name: i for i, name in enumerate(missed.model.parameters.names)}
    found = list(_tried(missed, causes, width, place))
    for labels, index in readings:
        g, G = missed.of_equations(index)
        # a blunder is as far off as it likes: tens to hundreds of a reading's standard deviations
        wide = np.full(len(index), WRONG)
        found.append((Cause(labels[0], "reading", labels, *missed.gain(g, G)), evidence(g, G, wide)))
    if not found:
        return ()
    kinds = [cause.kind for cause, _ in found]
    share = NOTHING / len(set(kinds))
    logs = np.array([log + np.log(share / kinds.count(cause.kind)) for cause, log in found])
    whole = logsumexp([np.log(NOTHING), *logs])
    order = np.argsort(-logs)
    return tuple(found[i][0]._replace(believed=float(np.exp(logs[i] - whole))) for i in order)


def most_believed(causes: Sequence[Cause]) -> Cause | None:
    """Return the most believed of the causes that chance does not explain; None where there is none."""
    for cause in causes:
        if cause.chance * len(causes) < RARE:
            return cause
    return None


def _tried(
    missed: Missed, causes: Sequence[Cause], width: Array, place: dict[str, int]
) -> Iterator[tuple[Cause, float]]:
    for cause in causes:
        index = [place[name] for name in cause.members]
        g, G = missed.of_parameters(index)
        gain, chance = missed.gain(g, G)
        yield cause._replace(gain=gain, chance=chance), evidence(g, G, width[index])


def widths(result: Calibration) -> Array:
    """Return how large deviations (n,) [SI] were expected before any calibration."""
    p = result.problem.parameters
    scale = p.scale.copy()
    if result.learned is not None:
        scale[p.identified] = result.learned.stated
    return default_widths(replace(p, scale=scale))[p.identified]
