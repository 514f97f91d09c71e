"""Products of many rows, in blocks."""

import numpy as np
import pytest

from rpim_opt.convex.products import TOGETHER, product, weighed_squares


@pytest.mark.parametrize("rows", [0, 1, 7, TOGETHER, 2 * TOGETHER + 5])
@pytest.mark.parametrize("signs", [(1.0,), (-1.0,), (0.0,), (1.0, -1.0, 0.0)])
def test_squares_in_blocks_are_those_of_all_rows(rows: int, signs: tuple[float, ...]) -> None:
    rng = np.random.default_rng(rows)
    X = rng.normal(size=(rows, 3))
    weight = rng.uniform(0.5, 2.0, rows) * rng.choice(signs, rows)
    whole = np.einsum("ki,k,kj->ij", X, weight, X)
    assert weighed_squares(X, weight) == pytest.approx(whole, rel=1e-12, abs=1e-12 * max(rows, 1))


@pytest.mark.parametrize("unusual", [0.0, 0.3, 0.6])
def test_rows_of_the_usual_weight_are_told_by_their_products(unusual: float) -> None:
    rng = np.random.default_rng(1)
    X = rng.normal(size=(2000, 3))
    weight = np.where(rng.random(2000) < unusual, rng.normal(size=2000), 2.0)
    whole = np.einsum("ki,k,kj->ij", X, weight, X)
    assert weighed_squares(X, weight, X.T @ X) == pytest.approx(whole, rel=1e-10, abs=1e-9)
    told = weighed_squares(X, weight, 2 * X.T @ X) - whole  # they are believed
    assert (np.abs(told).max() > 100) == (unusual < 0.5)


@pytest.mark.parametrize("rows", [0, 1, TOGETHER + 5])
@pytest.mark.parametrize("order", ["C", "F"])
def test_a_product_in_blocks_is_that_of_all_rows(rows: int, order: str) -> None:
    rng = np.random.default_rng(rows)
    X = np.asarray(rng.normal(size=(rows, 3)), order=order)
    B = rng.normal(size=(3, 2))
    assert product(X, B) == pytest.approx(X @ B, rel=1e-13, abs=1e-13)
