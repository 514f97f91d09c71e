"""The gap of penalties with kinks: no point lies lower than it allows, wherever it is asked; steps stay in boxes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.faces import Faces

N = 6
ALONE = np.full(N, -1)
PAIRS = np.array([-1, -1, 0, 0, 1, 1])
KINDS: dict[str, dict[str, Any]] = {
    "priced": {},
    "with squares": {"H": True},
    "with a line": {"g": True},
    "some free": {"free": True},
    "boxed": {"box": (-0.3, 0.4)},
    "above": {"box": (0.1, np.inf)},
    "below": {"box": (-np.inf, -0.05), "free": True},
    "groups": {"member": PAIRS},
    "groups with squares, some free": {"member": PAIRS, "H": True, "free": True},
    "groups beside a box": {"member": PAIRS, "box": (-0.1, 0.1)},
    "few equations": {"rows": 3},
    "few equations in a box": {"rows": 3, "box": (-0.3, 0.4), "H": True},
}


def made(kind: str, seed: int) -> Faces:
    asked = KINDS[kind]
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    member = asked.get("member", ALONE)
    alone = member < 0
    price = np.where(alone, rng.uniform(0.2, 2.0, N), 0.0)
    if asked.get("free"):
        price[0] = 0.0
    H = None
    if asked.get("H"):
        root = rng.normal(size=(3, N))
        H = root.T @ root
    g = np.zeros(N)
    if asked.get("g"):
        g = np.where(alone, 0.5 * price * rng.uniform(-1, 1, N), 0.0)
    low, high = asked.get("box", (-np.inf, np.inf))
    groups = rng.uniform(0.5, 2.0, member.max() + 1)
    rows = asked.get("rows", 12)
    M, d = rng.normal(size=(rows, N)), 2 * rng.normal(size=rows)
    return Faces(M, d, H, g, price, member, groups, np.where(alone, low, -np.inf), np.where(alone, high, np.inf))


def written(faces: Faces, weight: float) -> float:
    """Return the minimum of the problem as it is written."""
    y = cp.Variable(N)
    penalty = faces.g @ y + faces.price @ cp.abs(y)
    for k, inside in enumerate(faces.members):
        penalty += faces.groups[k] * cp.norm(y[inside])
    if faces.H is not None:
        penalty += 0.5 * cp.quad_form(y, cp.psd_wrap(faces.H))
    held = [y[j] >= faces.lower[j] for j in np.flatnonzero(np.isfinite(faces.lower))]
    held += [y[j] <= faces.upper[j] for j in np.flatnonzero(np.isfinite(faces.upper))]
    problem = cp.Problem(cp.Minimize(cp.sum_squares(faces.M @ y - faces.d) + weight * penalty), held)
    problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-12, tol_gap_rel=1e-12)
    return float(problem.value)


def points(faces: Faces, best: Array, seed: int) -> list[Array]:
    """Return points of the box: near the best one, far away, and with components on kinks and bounds."""
    rng = np.random.default_rng(seed)
    found = []
    for size in (1e-4, 1e-2, 0.3, 3.0):
        y = best + size * rng.normal(size=N)
        y[rng.random(N) < 0.3] = 0.0
        found.append(np.clip(y, faces.lower, faces.upper))
    return found


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("weight", [0.3, 3.0])
def test_no_point_lies_lower_than_the_gap_allows(kind: str, weight: float) -> None:
    for seed in range(3):
        faces = made(kind, seed)
        least = written(faces, weight)
        face = faces.minimum(weight)
        assert face.certain
        assert face.value == pytest.approx(least, rel=1e-7, abs=1e-9)
        for y in points(faces, face.y, seed):
            missing = faces.value(y, weight) - face.value
            gap = faces.gap(y, faces.slope(y, weight), weight)
            assert gap >= missing * (1 - 1e-9) - 1e-12 * abs(face.value)


@pytest.mark.parametrize("kind", ["priced", "groups", "groups with squares, some free"])
def test_where_nothing_is_to_be_fitted_nothing_is_the_minimum(kind: str) -> None:
    faces = replace(made(kind, 1), d=np.zeros(12), g=np.zeros(N))
    face = faces.minimum(1.0)
    assert not face.y.any()
    assert (face.gap, face.value) == (0.0, 0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_value_slope_and_curvature_belong_together(kind: str) -> None:
    faces = made(kind, 5)
    y = np.random.default_rng(1).normal(size=N)
    weight, h = 0.7, 1e-6

    def whole(at: Array) -> Array:
        return faces.slope(at, weight) + faces.bent(at, weight)[0]

    values = [(faces.value(y + d, weight) - faces.value(y - d, weight)) / (2 * h) for d in h * np.eye(N)]
    assert whole(y) == pytest.approx(values, rel=1e-6, abs=1e-6)
    bends = np.array([(whole(y + d) - whole(y - d)) / (2 * h) for d in h * np.eye(N)])
    assert faces.gram + faces.bend(y, weight) == pytest.approx(bends, rel=1e-5, abs=1e-5)
    smooth = np.array([(faces.slope(y + d, weight) - faces.slope(y - d, weight)) / (2 * h) for d in h * np.eye(N)])
    assert faces.curvature(weight) == pytest.approx(smooth, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("kind", [kind for kind, asked in KINDS.items() if "member" not in asked])
def test_what_a_line_and_the_kinks_are_at_least_in_the_box(kind: str) -> None:
    """By trying all corners: bounds and kinks, and far away where there is no bound."""
    faces = made(kind, 6)
    rng = np.random.default_rng(2)
    price = 0.7 * faces.price
    y = np.clip(rng.normal(size=N), faces.lower, faces.upper)
    left = price * rng.uniform(-0.9, 0.9, N)
    left = np.where(np.isfinite(faces.lower) & np.isfinite(faces.upper), 3.0 * rng.normal(size=N), left)
    corners = np.array(
        [np.maximum(faces.lower, -1e3), np.minimum(faces.upper, 1e3), np.clip(0.0, faces.lower, faces.upper)]
    )
    least = np.min(left * corners + price * np.abs(corners), axis=0)
    expected = float(np.sum(left * y + price * np.abs(y) - least))
    assert faces._young(y, left, price, np.empty(0)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_a_step_never_raises_the_objective_nor_leaves_the_box(kind: str) -> None:
    rng = np.random.default_rng(3)
    for seed in range(4):
        faces = made(kind, 10 + seed)
        y = np.clip(rng.normal(size=N), faces.lower, faces.upper)
        value = faces.value(y, 1.0)
        for size in (0.1, 1.0, 10.0):
            slope = faces.slope(y, 1.0) + faces.bent(y, 1.0)[0]
            step = -size * slope / np.linalg.norm(slope)
            ahead, there, whole = faces._stepped(y, step, value, 1.0)
            assert faces.value(ahead, 1.0) == there <= value
            assert whole == np.array_equal(ahead, y + step)
            assert (ahead >= faces.lower).all()
            assert (ahead <= faces.upper).all()
            share = faces._first(y, step)
            assert 0 < share <= 1
            between = y + 0.999 * share * step  # no kink and no bound is passed before
            inside = (y > faces.lower) & (y < faces.upper)
            assert (between[inside] >= faces.lower[inside]).all()
            assert (between[inside] <= faces.upper[inside]).all()
            assert not (faces.kinked & (between * y < 0)).any()
