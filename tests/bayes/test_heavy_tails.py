"""What heavy tails add to covariances: against quadrature, without data and with many, and normal tails."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from rpim_opt.basics.arrays import Array
from rpim_opt.bayes.evidence import MOST_WIDENED, tail_widening


def field(H: Array, h: Array, size: Array, tails: float) -> tuple[Array, Array, Array]:
    """Return mean, covariance and local variances of the mean field, by its plain iteration."""
    v = size**2
    for _ in range(400):
        C = np.linalg.inv(H + np.diag(1 / v))
        z = C @ h
        v = (tails * size**2 + z**2 + np.diag(C)) / (tails + 1)
    return z, C, v


def widened(H: Array, h: Array, size: Array, tails: float) -> tuple[Array, Array]:
    """Return the covariance of the mean field, and that with what tails add."""
    z, C, v = field(H, h, size, tails)
    D = tail_widening(z, C, v, np.arange(len(v)), size, tails)
    return C, C + D @ D.T


@pytest.mark.parametrize("precision", [0.05, 0.4, 3.0])
@pytest.mark.parametrize("seen", [0.0, 2.0])
@pytest.mark.parametrize("tails", [3.0, 8.0])
def test_the_variance_of_one_deviation_is_the_integrals(precision: float, seen: float, tails: float) -> None:
    moved = precision * seen

    def density(z: float, power: int) -> float:
        return float(z**power * np.exp(moved * z - precision * z**2 / 2) * (1 + z**2 / tails) ** (-(tails + 1) / 2))

    total, first, second = (quad(density, -60, 60, args=(k,), limit=400, points=[0.0])[0] for k in range(3))
    C, wide = widened(np.array([[precision]]), np.array([moved]), np.ones(1), tails)
    exact = second / total - (first / total) ** 2
    assert wide[0, 0] == pytest.approx(exact, rel=1e-3)
    assert C[0, 0] < exact


def test_where_data_contradict_tails_the_data_alone_say() -> None:
    """Two modes, at zero and at what is seen: the variance is never more than the data's own."""
    _, wide = widened(np.array([[0.05]]), np.array([1.0]), np.ones(1), 3.0)
    assert 19.0 < wide[0, 0] <= 20.0


def test_what_nothing_decides_has_the_variance_of_student_t() -> None:
    size = np.array([0.3, 2.0])
    for tails in (3.0, 5.0, 30.0):
        C, wide = widened(np.zeros((2, 2)), np.zeros(2), size, tails)
        assert np.diag(C) == pytest.approx(size**2, rel=1e-6)
        assert np.diag(wide) == pytest.approx(size**2 * tails / (tails - 2), rel=2e-3)


def test_nothing_is_added_to_what_the_data_decide_or_where_tails_are_normal() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(9, 4))
    H, h = A.T @ A, A.T @ rng.normal(size=9)
    C, wide = widened(1e8 * H, 1e8 * h, np.ones(4), 3.0)
    assert np.diag(wide) == pytest.approx(np.diag(C), rel=1e-6)
    C, wide = widened(H, h, np.ones(4), 1e9)
    assert np.allclose(wide, C, rtol=1e-6, atol=1e-9)


def test_only_the_precisions_of_deviations_with_tails_change() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(3, 5))
    z, C, v = field(A.T @ A, A.T @ np.array([4.0, -1.0, 0.0]), np.ones(5), 3.0)
    heavy = np.array([0, 2, 3])
    D = tail_widening(z, C, v, heavy, np.ones(3), 3.0)
    change = np.linalg.inv(C) - np.linalg.inv(C + D @ D.T)
    less = np.diag(change)
    assert np.allclose(change, np.diag(less), atol=1e-10)
    assert (np.abs(less[[1, 4]]) < 1e-10).all()
    assert ((less[heavy] > 0) & (less[heavy] <= (1 - 1 / MOST_WIDENED) / v[heavy] + 1e-10)).all()
