"""Losses with smoothed kinks: value, slope and curvature are those of the definition, for groups of any sizes."""

from __future__ import annotations

from typing import Any

import cvxpy as cp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.separated import Separated
from rpim_opt.convex.tree import rows_of
from tests.convex.test_newton import EQUATIONS, NORMS

COUNT = 7
OWN = {
    "each its own norm": lambda v: cp.sum(cp.multiply(np.linspace(0.5, 2.0, v.size), v)),
    "absolute values": lambda v: cp.sum(2 * cp.abs(v)) + cp.sum(cp.huber(v)),
    "each its own tilt": lambda v: cp.sum(cp.multiply(np.arange(1.0, 1.0 + v.size), cp.exp(v))),
}
OVER = {name: (loss, None) for name, loss in EQUATIONS.items()}
OVER |= {f"{name} of pairs": (loss, (2,) * COUNT) for name, loss in (NORMS | OWN).items()}
OVER |= {f"{name} of some": (loss, (3, 1, 2, 2, 1, 4, 3)) for name, loss in (NORMS | OWN).items()}
SHARPNESS = 4.0


def made(name: str) -> tuple[Separated, Any, cp.Variable]:
    """Return the loss, its expression, and the variable of that: what it gets."""
    loss, sizes = OVER[name]
    count = COUNT
    v = cp.Variable(count)
    expression = loss(v)
    rows = rows_of(expression, v)
    assert rows is not None
    if sizes is None:
        return Separated(rows, None, count), expression, v
    starts = np.cumsum((0, *sizes))[:-1]
    return Separated(rows, starts, sum(sizes)), expression, v


def norms(loss: Separated, r: Array) -> Array:
    """What the loss gets: numbers, or norms of groups one by one."""
    if loss.starts is None:
        return r
    return np.array([np.linalg.norm(part) for part in np.split(r, loss.starts[1:])])


def drawn(loss: Separated, seed: int = 1) -> tuple[Array, list[Array]]:
    """Return a residual, of which some groups are small, and multipliers of the kinks, inside and outside of them."""
    rng = np.random.default_rng(seed)
    r = rng.normal(size=loss.count) * np.where(rng.random(loss.count) < 0.4, 0.02, 1.0)
    return r, [0.3 * rng.normal(size=loss.count) for _ in loss.kinks]


def smoothed_value(loss: Separated, r: Array, y: list[Array], sharpness: float = SHARPNESS) -> float:
    """Return a loss with smoothed kinks: of each the largest l's - |l - y|^2 / (2 sharpness) in its ball."""
    found = loss.smoothed(r, y, sharpness)
    value = found.without_kinks
    for (_, (a, c)), old, new in zip(loss.kinks, y, found.multipliers, strict=True):
        value += float(new @ (a * r + c) - np.sum((new - old) ** 2) / (2 * sharpness))
    return value


@pytest.mark.parametrize("name", OVER)
def test_the_loss_is_that_of_the_expression(name: str) -> None:
    loss, expression, v = made(name)
    r, y = drawn(loss)
    v.value = norms(loss, r)
    assert loss.holds
    assert loss.at(r) == pytest.approx(expression.value, rel=1e-12)
    assert loss.missed(r, loss.smoothed(r, y, SHARPNESS))[0] == pytest.approx(expression.value, rel=1e-12)


@pytest.mark.parametrize("name", OVER)
def test_a_kink_is_its_moreau_envelope(name: str) -> None:
    """The least over the length of t, which lies along s + y / sharpness; but for |y|^2 / (2 sharpness)."""
    loss, _, _ = made(name)
    r, y = drawn(loss)
    value = loss._smooth(r)[0]
    missing = 0.0
    found = loss.smoothed(r, y, SHARPNESS)
    for (factor, (a, c)), old, new in zip(loss.kinks, y, found.multipliers, strict=True):
        s = a * r + c
        length = norms(loss, s + old / SHARPNESS)
        factors = np.broadcast_to(factor, length.shape)
        for k, far in zip(factors, np.abs(length), strict=True):
            best = minimize_scalar(
                lambda t, k=k, far=far: k * abs(t) + SHARPNESS / 2 * (t - far) ** 2,
                bounds=(0.0, far), method="bounded", options={"xatol": 1e-12},
            )  # fmt: skip
            value += min(best.fun, SHARPNESS / 2 * far**2)
        value -= old @ old / (2 * SHARPNESS)
        missing += float(np.sum(factors * np.abs(norms(loss, s)))) - new @ s
        assert (np.abs(norms(loss, new)) <= factors * (1 + 1e-12)).all()
    assert smoothed_value(loss, r, y) == pytest.approx(value, rel=1e-9)
    missed = loss.missed(r, found)[1]
    assert missed == pytest.approx(missing, rel=1e-9, abs=1e-12)
    assert missed >= 0


@pytest.mark.parametrize("name", OVER)
def test_slope_and_curvature_are_the_derivatives(name: str) -> None:
    loss, _, _ = made(name)
    r, y = drawn(loss, 2)
    h = 1e-6 * np.eye(loss.count)
    found = loss.smoothed(r, y, SHARPNESS)
    ahead = [(loss.smoothed(r + d, y, SHARPNESS), loss.smoothed(r - d, y, SHARPNESS)) for d in h]
    slope = [(smoothed_value(loss, r + d, y) - smoothed_value(loss, r - d, y)) / 2e-6 for d in h]
    assert found.slope == pytest.approx(slope, rel=1e-6, abs=1e-6)
    bend = np.array([(one.slope - other.slope) / 2e-6 for one, other in ahead])
    whole = np.zeros((loss.count, loss.count))
    for across, along, u in loss.curvature(r, found, SHARPNESS):
        whole += np.diag(np.broadcast_to(across, loss.count))
        if len(u):
            whole += np.outer(u, u) * np.equal.outer(loss.which, loss.which) * along[loss.which]
    assert whole == pytest.approx(bend, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("name", ["huber", "norms of pairs", "norms of some"])
def test_rows_are_projected_group_by_group(name: str) -> None:
    loss, _, _ = made(name)
    rng = np.random.default_rng(3)
    u, rows = rng.normal(size=loss.count), rng.normal(size=(loss.count, 4))
    groups = np.array([0, 2, 5])
    expected = [u[loss.which == g] @ rows[loss.which == g] for g in groups]
    assert loss.projected(rows, u, groups) == pytest.approx(np.array(expected), rel=1e-12)
    some = loss.picked(2)
    assert set(loss.which[some]) == set(range(0, loss.which[-1] + 1, 2))
    assert loss.projected(rows[some], u[some], np.array([0, 1]), 2) == pytest.approx(np.array(expected[:2]), rel=1e-12)


def test_a_loss_that_falls_or_has_kinks_elsewhere_is_not_separated() -> None:
    starts = np.arange(0, 2 * COUNT, 2)
    v = cp.Variable(COUNT)
    beside = np.arange(COUNT) % 2
    for loss in (
        -cp.sum(v),
        cp.sum(cp.abs(v - 1)),
        cp.sum(cp.abs(v - beside)),
        cp.sum(cp.multiply(np.arange(COUNT) - 3.0, v)),
    ):
        rows = rows_of(loss, v)
        assert rows is not None
        assert not Separated(rows, starts, 2 * COUNT).holds
        assert Separated(rows, None, COUNT).holds


@pytest.mark.parametrize("name", OVER)
def test_away_from_zero_norms_have_no_kinks(name: str) -> None:
    """Value, slope and curvature of the same sum; of equations, and of what has no kinks, there is no other one."""
    loss, _, _ = made(name)
    if loss.starts is None or not loss.kinks:
        assert loss.away is None
        return
    away = loss.away
    assert away is not None
    r = 1 + np.random.default_rng(4).random(loss.count)
    assert (away.kinks, away.at(r)) == ([], pytest.approx(loss.at(r), rel=1e-12))
    nothing = [0 * r for _ in loss.kinks]
    sharp = loss.smoothed(r, nothing, 1e9)
    assert away.smoothed(r, [], 1.0).slope == pytest.approx(sharp.slope, rel=1e-12)
    v = norms(loss, r)
    h = 1e-6
    slopes = (values_of(away, v + h) - values_of(away, v - h)) / (2 * h)
    assert loss.slope_of_norms(v) == pytest.approx(slopes, rel=1e-7)
    assert away.slope_of_norms(v) == pytest.approx(slopes, rel=1e-7)
    bend = np.array([(away.smoothed(r + d, [], 1.0).slope - away.smoothed(r - d, [], 1.0).slope) / (2 * h)
                     for d in h * np.eye(loss.count)])  # fmt: skip
    (curvature,) = away.curvature(r, away.smoothed(r, [], 1.0), 1.0)
    same = np.equal.outer(loss.which, loss.which)
    whole = np.diag(curvature.across) + same * np.outer(curvature.u, curvature.u) * curvature.along[loss.which]
    assert whole == pytest.approx(bend, rel=1e-5, abs=1e-6)


def values_of(loss: Separated, v: Array) -> Array:
    """f_i(v_i), one by one, but for a constant: what the sum is when one norm is as given and the others are 1."""
    found = []
    for k, each in enumerate(v):
        alone = np.ones(len(v))
        alone[k] = each
        found.append(loss.rows.both(alone)[0] + sum(float(np.sum(f * np.abs(of.a * alone + of.c)))
                                                    for f, of in loss.rows.kinks))  # fmt: skip
    return np.array(found)
