"""Changes since a calibration: every parameter, frame and reading as a likely cause of a misfit, by its evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc, logsumexp

from rpim_opt.basics.arrays import Array
from rpim_opt.bayes.prior_terms import default_widths
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.structure import Quadratic
from rpim_opt.problem.linear import RANK_TOLERANCE, LinearModel
from rpim_opt.robot.parameter_names import is_joint_offset, of_session
from rpim_opt.robot.parameters import Parameters

FALSE_ALARM = 0.01
"""Probability with which a robot that did not change is said to have changed, over all causes."""
SIZES = (1.0, 3.0, 10.0, 30.0)
"""Multiples of a deviation's prior width that a change may have, each as likely: tails that no crash leaves."""
UNCHANGED = 0.5
"""Prior probability that nothing changed; the other half is dealt out to the kinds of causes in use."""
OUTLIER_WIDTH = 10.0
"""Standard deviations by which a wrong reading is off, times `SIZES`."""
UNOBSERVABLE = 1e-9
"""Part of the largest eigenvalue below which readings do not observe a direction of a change."""


class Fit(NamedTuple):
    """Chi-squared of readings about what a prior expects of them, over how many equations, and its probability."""

    squares: float
    equations: int
    probability: float

    @property
    def likely(self) -> bool:
        """Whether chance alone makes it as large in more than one robot of a hundred."""
        return self.probability >= FALSE_ALARM


class Reading(NamedTuple):
    """A configuration's rows by their labels, and the numbers of their equations."""

    labels: tuple[str, ...]
    equations: np.ndarray


class Cause(NamedTuple):
    """A change that may be why readings miss their predictions.

    Its name, kind (``joint offset``, ``parameter``, ``frame``, ``reading``), parameters or rows; by how much
    chi-squared falls with it, the p-value of that where nothing changed, and the posterior probability.
    """

    name: str
    kind: str
    members: tuple[str, ...]
    gain: float = 0.0
    p_value: float = 1.0
    probability: float = 0.0


class Misfit:
    """By how much new readings miss their predictions, in standard deviations of those.

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
        Degrees of freedom of the estimate of that variance.
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
        squares = float(self.e @ self.e)
        # all of it has as many degrees of freedom as there are readings
        self.fit = Fit(squares, len(model.b), self._p_value(squares, len(model.b)))

    def of_parameters(self, index: Sequence[int]) -> tuple[Array, Array]:
        """Return g (p,) and G (p, p) of a change of some parameters."""
        return self._projected(slice(len(self.model.b), None), self.L[:, list(index)])

    def of_equations(self, index: np.ndarray) -> tuple[Array, Array]:
        """Return the same of readings that are wrong."""
        return self._projected(index, np.eye(len(index)))

    def of_drift(self, index: Sequence[int], course: Array) -> tuple[Array, Array]:
        """Return the same of parameters that move while readings are taken, by ``course`` (m,) of the whole change."""
        return self._projected(slice(len(course)), self.A[:, list(index)] * course[:, None])

    def _projected(self, rows: slice | np.ndarray, values: Array) -> tuple[Array, Array]:
        D = np.zeros((len(self.e), values.shape[1]))
        D[rows] = values
        along = self.Q.T @ D
        return D.T @ self.e, D.T @ D - along.T @ along

    def gain(self, g: Array, G: Array) -> tuple[float, float]:
        """Return by how much chi-squared falls, and the p-value of that."""
        s, U = np.linalg.eigh(G)
        observed = s > UNOBSERVABLE * max(float(s[-1]), 1.0)
        if not observed.any():
            return 0.0, 1.0
        fall = float(np.sum((U[:, observed].T @ g) ** 2 / s[observed]))
        return fall, self._p_value(fall, int(observed.sum()))

    def _p_value(self, squares: float, m: int) -> float:
        return float(fdtrc(m, self.freedom, squares / m))


def log_bayes_factor(g: Array, G: Array, width: Array) -> float:
    """Return ln of the Bayes factor for a change against none, of widths (p,) times each of `SIZES`.

    ::

        ln p(y | d ~ N(0, W^2)) / p(y | 0) = (g' (G + W^-2)^-1 g - ln det(I + W G W)) / 2
    """
    logs = []
    for size in SIZES:
        W = size * width
        inner = np.eye(len(g)) + W[:, None] * G * W
        squares = (W * g) @ np.linalg.solve(inner, W * g)
        logs.append(0.5 * (squares - np.linalg.slogdet(inner)[1]))
    return float(logsumexp(logs) - np.log(len(SIZES)))


def candidates(free: Parameters, reset: Sequence[str] = ()) -> list[Cause]:
    """Return the changes to look for: each of the robot's parameters, and every frame as a whole, but for the reset."""
    causes = []
    frames: dict[str, list[str]] = {}
    for name, frame in zip(free.names, free.of_frames, strict=True):
        if name in reset or of_session(name):  # an earlier session is over
            continue
        if frame:
            frames.setdefault(name.rpartition("_")[0], []).append(name)
        else:
            causes.append(Cause(name, "joint offset" if is_joint_offset(name) else "parameter", (name,)))
    return causes + [Cause(name, "frame", tuple(names)) for name, names in frames.items()]


def weigh(misfit: Misfit, causes: Sequence[Cause], width: Array, readings: Sequence[Reading] = ()) -> tuple[Cause, ...]:
    """Return causes with their evidence, the most probable first.

    Kinds of causes are as likely as each other before the readings, and so are the causes of a kind.

    Parameters
    ----------
    misfit
        Of the readings.
    causes
        Changes of parameters.
    width
        (n,) prior standard deviations, in units of the scales.
    readings
        Each may be wrong itself.
    """
    free = misfit.model.parameters.names
    logs, weighed = [], []
    for cause in causes:
        index = [free.index(name) for name in cause.members]
        g, G = misfit.of_parameters(index)
        gain, p_value = misfit.gain(g, G)
        weighed.append(cause._replace(gain=gain, p_value=p_value))
        logs.append(log_bayes_factor(g, G, width[index]))
    for labels, index in readings:
        g, G = misfit.of_equations(index)
        weighed.append(Cause(labels[0], "reading", labels, *misfit.gain(g, G)))
        logs.append(log_bayes_factor(g, G, np.full(len(index), OUTLIER_WIDTH)))
    if not weighed:
        return ()
    kinds = [cause.kind for cause in weighed]
    share = (1 - UNCHANGED) / len(set(kinds))
    posterior = np.array(logs) + np.log([share / kinds.count(kind) for kind in kinds])
    whole = logsumexp([np.log(UNCHANGED), *posterior])
    order = np.argsort(-posterior)
    return tuple(weighed[i]._replace(probability=float(np.exp(posterior[i] - whole))) for i in order)


def significant(causes: Sequence[Cause]) -> Cause | None:
    """Return the most probable of the causes that chance does not explain; None where there is none."""
    return next((cause for cause in causes if cause.p_value * len(causes) < FALSE_ALARM), None)


def prior_widths(result: Calibration) -> Array:
    """Return the prior standard deviations (n,) [SI] before any calibration."""
    p = result.problem.parameters
    scale = p.scale.copy()
    if result.learned is not None:
        scale[p.identified] = result.learned.stated
    return default_widths(replace(p, scale=scale))[p.identified]
