"""Population prior of several robots of one type, by empirical Bayes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, pick
from rpim_opt.basics.units import UNITS, accepted_units
from rpim_opt.bayes.prior_terms import Result, default_widths, marginal
from rpim_opt.convex.constraints import FAR
from rpim_opt.problem.linear import reduced_rows

PRIOR_ROBOTS = 3.0  # degrees of freedom of the hyperprior of the variances: the number of robots that it counts for
PRIOR_RATIO, PRIOR_PARAMETERS = 1.0, 2.0
"""Prior ratio of common to individual mean squares, and the number of parameters that it counts for."""
ITERATIONS, SETTLED = 1000, 1e-6  # of expectation and maximization; relative change of the variances at convergence


def random_effects(arms: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return prior means and standard deviations (p,) for another robot by a random-effects model, in generic scales.

    Each robot is given by rows (p, p) u - values (p,) ~ N(0, I). A deviation of robot k, in generic scales, has a
    common and an individual part::

        u_kj = m_j + d_kj,    d_kj ~ N(0, s_j^2),    m_j ~ N(0, rho s_j^2),    s_j^2 ~ scaled inverse chi^2 (3, tau^2)

    rho, tau and s are estimated by expectation and maximization (Efron and Morris 1975, JASA 70:311; Dempster, Laird
    and Rubin 1977, JRSS B 39:1). With few robots, or with data that say little, every s_j is nearly tau.
    """
    P = np.array([rows.T @ rows for rows, _ in arms])
    q = np.array([rows.T @ values for rows, values in arms])
    K, n = q.shape
    s2 = np.full(n, 1 / (1 + PRIOR_RATIO))
    tau2, ratio = 1 / (1 + PRIOR_RATIO), PRIOR_RATIO
    for _ in range(ITERATIONS):
        m, C_m, d2 = expectation(P, q, s2, ratio)
        m2 = m**2 + np.diag(C_m)
        before = np.append(s2, ratio)
        s2 = (PRIOR_ROBOTS * tau2 + d2.sum(axis=0) + m2 / ratio) / (PRIOR_ROBOTS + K + 1)
        tau2 = (n + PRIOR_PARAMETERS) / (np.sum(1 / s2) + PRIOR_PARAMETERS * (1 + PRIOR_RATIO))
        ratio = (float(np.sum(m2 / s2)) + PRIOR_PARAMETERS * PRIOR_RATIO) / (n + PRIOR_PARAMETERS)
        if np.max(np.abs(np.append(s2, ratio) / before - 1)) <= SETTLED:
            break
    m, C_m, _ = expectation(P, q, s2, ratio)
    return m, np.sqrt(s2 + np.diag(C_m))


def expectation(P: Array, q: Array, s2: Array, ratio: float) -> tuple[Array, Array, Array]:
    """Return mean (n,) and covariance (n, n) of the common effects, and mean squares (K, n) of the individual ones."""
    s = np.sqrt(s2)
    eye = np.eye(len(s2))
    left = np.linalg.inv(eye + s[:, None] * P * s)  # in units of s: posterior covariance of a robot's individual part
    H = (eye - left) / np.outer(s, s)
    h = np.einsum("kij,kj->ki", left, s * q) / s
    C_m = np.linalg.inv(H.sum(axis=0) + np.diag(1 / (ratio * s2)))
    m = C_m @ h.sum(axis=0)
    C = left * np.outer(s, s)
    own = np.einsum("kij,kj->ki", C, q + m / s2) - m
    turned = C / s2 - eye
    variance = np.einsum("kii->ki", C) + np.einsum("kij,jl,kil->ki", turned, C_m, turned)
    return m, C_m, own**2 + variance


def population(results: Sequence[Result] | Mapping[str, Result]) -> tuple[dict[str, float], dict[str, float]]:
    """Return prior means and standard deviations for another robot's parameters, by name with unit.

    They come from the data of several robots of one type (`random_effects`), without their calibrations' priors, and
    with frames integrated out; arguments as for `Prior.from_population`.
    """
    if isinstance(results, Mapping):
        named = dict(results)
    else:
        named = {f"arm {i}": result for i, result in enumerate(results, start=1)}
    if len(named) < 2:
        raise InputError("Prior.from_population", f"{len(named)} results", "results of two robots or more")
    tables = [each.problem.parameters for each in named.values()]
    every = [name for p in tables for name, frame in zip(p.free.names, p.free.of_frames, strict=True) if not frame]
    names = tuple(dict.fromkeys(every))
    table = tables[0].take(_places(tables[0].names, names))
    first = next(iter(named.values()))
    stated = dict(zip(tables[0].free.names, _stated_widths(first).tolist(), strict=True))
    generic = np.array([stated.get(name, width) for name, width in zip(names, default_widths(table), strict=True)])
    arms = []
    for label, result in named.items():
        robot, rows, values = data_likelihood(result)
        places = _places(names, robot)
        own = result.problem.parameters.take(_places(result.problem.parameters.names, robot))
        apart = own.nominal - table.nominal[places]
        far = np.abs(apart) > FAR * own.scale
        if far.any():
            found = f"nominal {own.names[int(np.argmax(far))]} of '{label}', far from that of the first robot"
            raise InputError("Prior.from_population", found, "robots of one type")
        full = np.zeros((len(rows), len(names)))
        full[:, places] = rows * generic[places]
        arms.append((full, values + rows @ apart))
    centre, width = random_effects(arms)
    units = [accepted_units(dimension)[0] for dimension in table.dimensions]
    keys = [f"{name}_{unit}" for name, unit in zip(names, units, strict=True)]
    in_unit = generic / [UNITS[unit].si for unit in units]
    return (
        dict(zip(keys, (centre * in_unit).tolist(), strict=True)),
        dict(zip(keys, (width * in_unit).tolist(), strict=True)),
    )


def data_likelihood(result: Result) -> tuple[tuple[str, ...], Array, Array]:
    """Return names (p), rows (p, p) [1/SI] and values (p,) of the likelihood of a result's data, without frames."""
    free = result.problem.parameters.free
    fit = result.fit_covariance
    R = fit.linear.qr_factor / np.sqrt(fit.noise_variance * fit.linear.factor)
    n = len(free)
    own = np.eye(n)[free.of_frames] * (free.scale / _stated_widths(result))[free.of_frames, None]
    robot = np.flatnonzero(~free.of_frames)  # frames have their default priors and are integrated out
    rows, values = marginal(np.vstack([R[:, :n], own]), np.append(R[:, n], np.zeros(len(own))), robot)
    both = reduced_rows(np.column_stack([rows, values]))
    p = len(robot)
    return tuple(free.names[i] for i in robot), both[:p, :p] / free.scale[robot], both[:p, p]


def _stated_widths(result: Result) -> Array:
    """Return the prior standard deviations (n,) [SI] of a result's parameters before their scales were estimated."""
    return default_widths(result.problem.parameters.free) if result.learned is None else result.learned.stated


def _places(names: Sequence[str], some: Sequence[str]) -> np.ndarray:
    """Return where some parameters stand in a table."""
    known = {name: i for i, name in enumerate(names)}
    return np.array([pick(known, name, "Prior.from_population", also="robots of one type, all with ") for name in some])
