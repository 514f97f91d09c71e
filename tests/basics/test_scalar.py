"""The minimum of a function of one number is SciPy's."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from rpim_opt.basics.minimization import least

FUNCTIONS: list[tuple[Callable[[float], float], float, float]] = [
    (lambda x: (x - 2) ** 2 + 1, 0.0, 5.0),
    (lambda x: float(np.cosh(x - 0.3) * (1 + 0.1 * np.sin(3 * x))), -2.0, 3.0),
    (lambda x: abs(x - 1.234), 0.0, 2.0),
    (lambda x: -float(np.exp(-((x - 0.11) ** 2) / 1e-2)), 0.0, 0.4),
    (lambda x: x, 0.0, 1.0),
    (lambda x: -x, 0.0, 1.0),
]


@pytest.mark.parametrize(("function", "low", "high"), FUNCTIONS)
def test_the_minimum_is_scipys(function: Callable[[float], float], low: float, high: float) -> None:
    asked: list[float] = []

    def counted(x: float) -> float:
        asked.append(x)
        return function(x)

    x, value = least(counted, low, high, 1e-6)
    reference = minimize_scalar(function, bounds=(low, high), method="bounded", options={"xatol": 1e-6})
    assert abs(x - reference.x) < 2e-6
    assert value == function(x)
    assert len(asked) <= reference.nfev + 2
    assert low <= min(asked) <= max(asked) <= high


def test_a_constant_ends() -> None:
    x, value = least(lambda _: 1.0, 0.0, 1.0, 1e-6)
    assert value == 1.0
    assert 0 <= x <= 1
