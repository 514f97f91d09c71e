"""Closed forms against their definitions: minima, freedom, noise, prior, and what nothing decides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rpim_opt.convex.quadratic import Quadratic, Ridge, identity, ridge, robot_alone
from rpim_opt.problem import LinearModel
from tests.convex.test_formulation import model

N = 12
WEIGHT = 0.03


def dense(seed: int = 1, rank: int = N) -> Quadratic:
    rng = np.random.default_rng(seed)
    return Quadratic(rng.normal(size=(rank, N)), rng.normal(size=rank))


def some_free() -> Quadratic:
    """Diagonal, with two components that cost nothing."""
    L = np.geomspace(0.2, 5.0, N)
    L[[3, 7]] = 0.0
    return Quadratic(L, np.where(L > 0, np.linspace(-1, 1, N), 0.0))


PENALTIES = {
    "identity": identity(N),
    "diagonal": Quadratic(np.geomspace(0.2, 5.0, N), np.linspace(-1, 1, N)),
    "some free": some_free(),
    "dense": dense(),
    "flat": dense(rank=8),
    "deficient": Quadratic(np.vstack([dense(rank=5).L, dense(rank=3).L]), np.ones(8)),
    "tall": Quadratic(np.vstack([dense().L, np.eye(N)]), np.ones(2 * N)),
}
"""By name, with full and with deficient rank."""


def normal_matrix(m: LinearModel, p: Quadratic, weight: float) -> np.ndarray:
    return m.A.T @ m.A + weight * p.matrix.T @ p.matrix


@pytest.mark.parametrize("name", PENALTIES)
def test_minima_solve_the_normal_equations(name: str) -> None:
    m, p = model(condition=30.0), PENALTIES[name]
    form = ridge(m, p)
    weights = np.array([1e-3, WEIGHT, 7.0])
    for z, weight in zip(form.minima(weights), weights, strict=True):
        want = np.linalg.solve(normal_matrix(m, p, weight), m.A.T @ m.b + weight * p.matrix.T @ p.c)
        assert z == pytest.approx(want, rel=1e-8, abs=1e-9)


@pytest.mark.parametrize("name", PENALTIES)
def test_freedom_noise_and_prior_are_their_definitions(name: str) -> None:
    m, p = model(condition=30.0), PENALTIES[name]
    form = ridge(m, p)
    inverse = np.linalg.inv(normal_matrix(m, p, WEIGHT))
    assert form.degrees_of_freedom(WEIGHT) == pytest.approx(np.trace(m.A @ inverse @ m.A.T), rel=1e-9)
    noise = inverse @ m.A.T @ m.A @ inverse
    assert form.noise(WEIGHT) == pytest.approx(noise, rel=1e-7, abs=1e-9)
    prior = WEIGHT * inverse @ p.matrix.T @ p.matrix @ inverse
    assert form.prior(WEIGHT) == pytest.approx(prior, rel=1e-7, abs=1e-9)
    assert form.noise(WEIGHT) + form.prior(WEIGHT) == pytest.approx(inverse, rel=1e-7, abs=1e-9)
    assert form.undetermined(WEIGHT).shape == (N, 0)


@pytest.mark.parametrize("name", PENALTIES)
def test_filters_give_the_residual_at_any_weight(name: str) -> None:
    m, p = model(condition=30.0), PENALTIES[name]
    form = ridge(m, p)
    beta2, s2, perp = form.filters
    for weight in (1e-3, WEIGHT, 7.0):
        z = form.minima(np.array([weight]))[0]
        g = weight / (s2 + weight)
        assert np.sum(g**2 * beta2) + perp == pytest.approx(np.sum((m.A @ z - m.b) ** 2), rel=1e-8)


def unseeing(*columns: int) -> LinearModel:
    m = model(condition=30.0)
    A = m.A.copy()
    A[:, list(columns)] = 0.0
    return replace(m, A=A)


def span(M: np.ndarray) -> np.ndarray:
    return M @ np.linalg.pinv(M)


def test_what_neither_data_nor_penalty_see_is_undecided_and_stays() -> None:
    """Component 3 costs nothing and is not seen; 5 costs something, which decides it at any weight above zero."""
    m, p = unseeing(3, 5), some_free()
    form = ridge(m, p)
    eye = np.eye(N)
    assert span(form.undetermined(WEIGHT)) == pytest.approx(np.diag(eye[3]), abs=1e-9)
    assert span(form.undetermined(0.0)) == pytest.approx(np.diag(eye[3] + eye[5]), abs=1e-9)
    assert (form.unpenalized, int(form.identifiable.sum())) == (1, 9)
    for weight in (1e-3, 7.0):
        z = form.minima(np.array([weight]))[0]
        assert z[3] == pytest.approx(0.0, abs=1e-12)
        assert z[5] == pytest.approx(p.c[5] / p.L[5], rel=1e-9)
    assert form.noise(0.0)[5, 5] == pytest.approx(0.0, abs=1e-12)
    seen = [i for i in range(N) if i not in (3, 5)]
    assert form.noise(0.0)[np.ix_(seen, seen)] == pytest.approx(
        np.linalg.inv(m.A[:, seen].T @ m.A[:, seen]), rel=1e-6, abs=1e-9
    )
    assert np.abs(form.prior(0.0)).max() == 0.0


def test_everything_free_is_least_squares() -> None:
    m = model(condition=30.0)
    form = ridge(m, Quadratic(np.zeros(N), np.zeros(N)))
    assert isinstance(form, Ridge)
    assert form.unpenalized == N
    assert form.minima(np.array([5.0]))[0] == pytest.approx(np.linalg.lstsq(m.A, m.b)[0], rel=1e-8)
    assert form.degrees_of_freedom(5.0) == pytest.approx(N)


@pytest.mark.parametrize("name", ["identity", "diagonal", "dense", "tall"])
def test_what_a_penalty_says_of_the_robot_is_its_least_over_the_frames(name: str) -> None:
    """The marginal of a normal density is, in its exponent, the minimum over what is left out."""
    p = PENALTIES[name]
    frames = np.arange(N) % 4 == 1
    alone = robot_alone(p, frames)
    L, c = p.matrix, p.c

    def least(z: np.ndarray) -> float:
        r = c - L[:, ~frames] @ z[~frames]
        return float(np.sum((L[:, frames] @ np.linalg.lstsq(L[:, frames], r)[0] - r) ** 2))

    points = np.random.default_rng(3).normal(size=(5, N))
    want = np.array([least(z) for z in points])
    got = np.array([alone.value(z) for z in points])
    assert got - got[0] == pytest.approx(want - want[0], rel=1e-8, abs=1e-9)
    moved = points[0] + 10.0 * frames
    assert alone.value(moved) == pytest.approx(alone.value(points[0]), rel=1e-9)


def test_a_flat_penalty_says_as_little_of_the_robot() -> None:
    frames = np.arange(N) % 4 == 1
    alone = robot_alone(dense(rank=8), frames)
    assert np.linalg.matrix_rank(alone.matrix) == 8 - frames.sum()
    assert alone.matrix.shape == (8 - frames.sum(), N)
