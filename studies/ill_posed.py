"""Compare how near the selectors come to the best weight on classic ill-posed problems.

Everything is simulated. Problems as in P. C. Hansen, Regularization Tools 4.1 (Numerical Algorithms 46:189, 2007), from
their published formulas, by the midpoint rule; n = 64, white noise of 1e-1 to 1e-4 of the norm of the data. Compared is
the error of the solution at the chosen weight with the error at the best of 400 weights.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import rpim_opt as ro
from rpim_opt.basics.text import markdown
from rpim_opt.problem.linear import LinearModel
from rpim_opt.robot.parameters import Parameters
from rpim_opt.study import Metric, Report, distributions

NOISES = (1e-1, 1e-2, 1e-3, 1e-4)
SELECTORS = (ro.l_curve, ro.corner, ro.gcv, ro.reml, ro.discrepancy, ro.quasi_optimality, ro.leave_one_out)


def midpoints(n: int, low: float, high: float) -> tuple[np.ndarray, float]:
    """Return the midpoints of n intervals, and their width."""
    h = (high - low) / n
    return low + h * (np.arange(n) + 0.5), h


def shaw(n: int) -> tuple[np.ndarray, np.ndarray]:
    """One-dimensional image restoration (Shaw 1972)."""
    t, h = midpoints(n, -np.pi / 2, np.pi / 2)
    u = np.sin(t)[:, None] + np.sin(t)[None, :]
    K = (np.cos(t)[:, None] + np.cos(t)[None, :]) ** 2 * np.sinc(u) ** 2
    return h * K, 2 * np.exp(-6 * (t - 0.8) ** 2) + np.exp(-2 * (t + 0.5) ** 2)


def phillips(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Phillips 1962: kernel and solution phi(x) = 1 + cos(pi x / 3) on |x| < 3."""
    t, h = midpoints(n, -6, 6)

    def phi(x: np.ndarray) -> np.ndarray:
        return np.where(np.abs(x) < 3, 1 + np.cos(np.pi * x / 3), 0.0)

    return h * phi(t[:, None] - t[None, :]), phi(t)


def deriv2(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Second derivative: Green's function s (t - 1) or t (s - 1), solution t."""
    t, h = midpoints(n, 0, 1)
    s = t[:, None]
    return h * np.where(s < t, s * (t - 1), t * (s - 1)), t


def baart(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Baart 1982: kernel exp(s cos t), solution sin t."""
    t, h = midpoints(n, 0, np.pi)
    s, _ = midpoints(n, 0, np.pi / 2)
    return h * np.exp(s[:, None] * np.cos(t)), np.sin(t)


def gravity(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Gravity surveying at depth d = 0.25, solution sin(pi t) + 0.5 sin(2 pi t)."""
    t, h = midpoints(n, 0, 1)
    d = 0.25
    return h * d / (d**2 + (t[:, None] - t[None, :]) ** 2) ** 1.5, np.sin(np.pi * t) + 0.5 * np.sin(2 * np.pi * t)


def heat(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Inverse heat equation, kappa = 1 (Carasso 1982), solution in pieces as in Hansen's."""
    t, h = midpoints(n, 0, 1)
    k = h / (2 * t**1.5 * np.sqrt(np.pi)) * np.exp(-1 / (4 * t))
    K = np.array([[k[i - j] if i >= j else 0.0 for j in range(n)] for i in range(n)])
    u = 20 * t
    x = np.select(
        [u < 2, u < 3, u < 10], [0.75 * u**2 / 4, 0.75 + (u - 2) * (3 - u), 0.75 * np.exp(-(u - 3) * 2)], default=0.0
    )
    return K, x


PROBLEMS = {make.__name__: make for make in (shaw, phillips, deriv2, baart, gravity, heat)}
QUESTION = "Which selector comes nearest to the best weight on classic ill-posed problems?"
METRICS = {f"{name}_median": Metric("lower", 0.1) for name in ("gcv", "discrepancy", "leave_one_out", "l_curve")}


def cases(quick: bool) -> list[dict[str, Any]]:
    """Return every problem at every noise level, 100 seeds or 3."""
    seeds = range(3 if quick else 100)
    return [{"problem": name, "noise": noise, "seed": seed} for name in PROBLEMS for noise in NOISES for seed in seeds]


def run(problem: str, noise: float, seed: int, n: int = 64) -> dict[str, float]:
    """Return the error at the chosen weight over the error at the best weight, by selector."""
    A, x = PROBLEMS[problem](n)
    sigma = noise * np.linalg.norm(A @ x) / np.sqrt(n)
    b = A @ x + sigma * np.random.default_rng(seed).normal(size=n)
    size = np.linalg.norm(x) / np.sqrt(n)  # the scale: the root mean square of the solution
    names = tuple(f"a{i}" for i in range(n))
    p = Parameters(names, ("length",) * n, np.zeros(n), np.ones(n), np.full(n, np.inf), np.ones(n, dtype=bool))
    program = ro.convex.pose(ro.tikhonov, LinearModel(A * size / sigma, b / sigma, np.arange(n), p))

    def error(weight: float) -> float:
        return float(np.linalg.norm(size * program.path([weight])[0].z - x))

    s = program.model.svd[1]
    best = min(error(w) for w in np.geomspace(1e-8 * s[s > 0][-1] ** 2, 1e2 * s[0] ** 2, 400))
    return {rule.__name__: error(rule(program).weight) / best for rule in SELECTORS}


def report(rows: list[dict[str, Any]]) -> Report:
    """Return median, 95th percentile and share worse than 2, and the medians by problem."""
    lines, metrics = [], {}
    for rule in SELECTORS:
        name = rule.__name__
        v = np.array([row[name] for row in rows])
        each = [np.median([row[name] for row in rows if row["problem"] == problem]) for problem in PROBLEMS]
        metrics[f"{name}_median"] = float(np.median(v))
        figures = [f"{np.median(v):.2f}", f"{np.percentile(v, 95):.3g}", f"{100 * np.mean(v > 2):.0f} %"]
        lines.append([name, *figures, *(f"{e:.2f}" for e in each)])
    text = (
        f"Error of the solution at the chosen weight over the error at the best weight, {len(rows)} simulated cases of "
        "6 problems, noise 1e-1 to 1e-4, n = 64; on the right the median by problem. REML assumes white deviations, "
        "which these smooth solutions are not: it is the default for robots, not for them.\n\n"
    )
    head = ["selector", "median", "95th percentile", "worse than 2", *PROBLEMS]
    ratios = {rule.__name__: [min(row[rule.__name__], 1e3) for row in rows] for rule in SELECTORS}
    figure = distributions(ratios, "error over that at the best weight (beyond 1000 drawn at 1000)")
    return Report(text + markdown(head, lines), metrics, {"ill_posed": figure})
