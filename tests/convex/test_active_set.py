"""Least squares in a box: never worse than bvls, optimal to rounding, and it ends."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import lsq_linear

import rpim_opt as ro
from rpim_opt.convex import active_set
from rpim_opt.convex.active_set import minimum_in_box

EPS = np.finfo(float).eps
UNBOUNDED = np.inf


class Case(NamedTuple):
    """Equations, bounds, and the condition number of the equations before the weight's rows."""

    A: np.ndarray
    b: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    condition: float = 1.0
    weight: float = 0.0

    def solved(self, start: np.ndarray | None = None) -> np.ndarray:
        return minimum_in_box(self.A, self.b, self.lower, self.upper, start)[0]

    def objective(self, z: np.ndarray) -> float:
        return float(np.sum((self.A @ z - self.b) ** 2))

    def terms(self, z: np.ndarray) -> float:
        return float(np.linalg.norm(self.b) + np.linalg.norm(self.A, axis=0) @ np.abs(z))

    def rounding(self, z: np.ndarray, objective: float) -> float:
        """By how much rounding alone may change the objective: the residual, a sum of n terms, is no more exact."""
        residual = len(z) * EPS * self.terms(z)
        return 2 * np.sqrt(objective) * residual + residual**2


def bounds(g: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    half = np.full(n, 10 ** g.uniform(-2, 1))
    if g.random() < 0.5:
        half = 10 ** g.uniform(-3, 1, n)
    lower = -half * g.choice([np.ones(n), g.uniform(0, 1, n)])
    upper = half.copy()
    kind = g.integers(4)
    if kind == 0:
        lower[g.random(n) < 0.3] = -UNBOUNDED
        upper[g.random(n) < 0.3] = UNBOUNDED
    if kind == 1:
        fixed = g.random(n) < 0.2
        lower[fixed] = upper[fixed]
    return lower, upper


def case(seed: int, largest_condition: float = 1e12) -> Case:
    """Return a triangle of random singular vectors, singular values in geometric order, and a weight's rows."""
    g = np.random.default_rng(seed)
    n = int(g.integers(5, 61))
    condition = largest_condition ** g.uniform(0, 1)
    s = condition ** -np.linspace(0, 1, n)
    U = np.linalg.qr(g.normal(size=(n + 1, n)))[0]
    V = np.linalg.qr(g.normal(size=(n, n)))[0]
    A = (U * s) @ V.T
    b = g.normal(size=n + 1)
    if g.random() < 0.3:
        b = A @ g.normal(size=n)  # the objective may be near zero
    R = np.linalg.qr(np.column_stack([A, 10 ** g.uniform(-3, 1) * b]), mode="r")
    lower, upper = bounds(g, n)
    weight = 0.0
    if g.random() < 0.7:
        weight = 10 ** g.uniform(-14, 4)
        R = np.vstack([R, np.eye(n, n + 1) * np.sqrt(weight)])
    return Case(R[:, :n], R[:, n], lower, upper, condition, weight)


def cases(seeds: range) -> Iterator[Case]:
    return map(case, seeds)


def well_conditioned(seeds: range) -> Iterator[Case]:
    return (case(seed, largest_condition=1e3) for seed in seeds)


def bvls(box: Case) -> np.ndarray:
    free = box.lower < box.upper
    z = box.lower.copy()
    b = box.b - box.A[:, ~free] @ z[~free]
    inside = (box.lower[free], box.upper[free])
    z[free] = lsq_linear(box.A[:, free], b, inside, method="bvls", tol=1e-15).x
    return np.clip(z, box.lower, box.upper)


def check_never_worse(box: Case) -> None:
    reference = bvls(box)
    least = box.objective(reference)
    assert box.objective(box.solved()) <= least * (1 + 1e-9) + box.rounding(reference, least)


def check_optimal(box: Case) -> None:
    """In the box; slopes zero off the bounds, outwards on them: to the rounding of the terms of the residual."""
    z, multipliers = minimum_in_box(box.A, box.b, box.lower, box.upper)
    assert (box.lower <= z).all()
    assert (z <= box.upper).all()
    rounding = 1e-14 * np.linalg.norm(box.A, axis=0) * box.terms(z)  # 4e-16 is the worst of 5,000 boxes
    slope = 2 * box.A.T @ (box.b - box.A @ z)
    fixed = box.lower == box.upper
    low = (z == box.lower) & ~fixed
    high = (z == box.upper) & ~fixed
    off = ~(low | high | fixed)
    assert (np.abs(slope[off]) <= rounding[off]).all()
    assert (slope[low] <= rounding[low]).all()
    assert (slope[high] >= -rounding[high]).all()
    expected = np.where(off, 0.0, np.where(low, -slope, np.where(high, slope, np.abs(slope))))
    assert (np.abs(multipliers - expected) <= rounding).all()
    assert (multipliers >= 0).all()
    assert (multipliers[off] == 0).all()


def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return the list to which every small least-squares problem adds its size."""
    sizes: list[int] = []
    solve = active_set._gelsy

    def counting(A: np.ndarray, *arguments, **options):
        sizes.append(A.shape[1])
        return solve(A, *arguments, **options)

    monkeypatch.setattr(active_set, "_gelsy", counting)
    return sizes


def test_never_worse_than_bvls() -> None:
    for box in cases(range(300)):
        check_never_worse(box)


def test_optimal_to_rounding() -> None:
    for box in cases(range(300)):
        check_optimal(box)


@pytest.mark.slow
def test_five_thousand_boxes() -> None:
    for box in cases(range(1000, 6000)):
        check_never_worse(box)
        check_optimal(box)


def test_where_the_minimum_is_well_defined_it_is_that_of_bvls() -> None:
    for box in well_conditioned(range(60)):
        assert box.solved() == pytest.approx(bvls(box), rel=1e-8, abs=1e-8)  # 1e3^2 times the rounding, and a margin


def test_few_small_problems_are_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = counted(monkeypatch)
    for box in cases(range(100)):
        box.solved()
    assert len(sizes) / 100 < 23  # 20 in the mean of 5,000; 31 if a step went to its first bound only


def degenerate(seed: int) -> Case:
    """Return equations with ties, repeated or zero columns, fewer rows than unknowns, multipliers of zero."""
    g = np.random.default_rng(seed)
    n = int(g.integers(3, 40))
    k = int(g.integers(max(1, n - 5), 2 * n + 2))
    A = g.normal(size=(k, n))
    b = g.normal(size=k)
    half = n // 2
    kind = seed % 5
    if kind == 0:
        A = g.integers(-1, 2, size=(k, n)).astype(float)
        b = g.integers(-3, 4, size=k).astype(float)
    if kind == 1:
        A[:, -half:] = A[:, :half] + 1e-13 * g.normal(size=(k, half))
    if kind == 2:
        A[:, -half:] = A[:, :half]
    if kind == 3:
        A[:, -half:] = 0.0
    if kind == 4:
        b = A @ np.clip(g.normal(size=n), -1, 1)
    return Case(A, b, -np.ones(n), np.ones(n))


@pytest.mark.parametrize("kind", range(5))
def test_degenerate_boxes_end_optimal(kind: int) -> None:
    for seed in range(kind, 250, 5):
        check_optimal(degenerate(seed))


def far_from_nominal(seed: int, reach: float) -> Case:
    """Return the cooperative manipulator linearized far off, in bounds about as wide as its least squares."""
    problem = ro.load("paper_arm").problem
    n = len(problem.parameters.free)
    g = np.random.default_rng(seed)
    offset = g.normal(size=n) * 10 ** g.uniform(-3, 2)
    model = problem.linearize(problem.parameters.free.scale * offset)
    beta, s, Vt = model.svd
    seen = s > 0
    least_squares = (beta[seen] / s[seen]) @ Vt[seen]
    half = np.abs(least_squares) * g.uniform(0, reach, n) + 1e-3
    R = model.triangle
    return Case(R[:, :n], R[:, n], -half, half)


@pytest.mark.parametrize("seed", [36, 299, 326, 1, 2])
def test_bounds_without_penalty_end(seed: int) -> None:
    """A monotone active set without a rule against cycling has no end here: 299 on Haswell's kernels, 36 on others."""
    box = far_from_nominal(seed, 2.0)
    check_optimal(box)
    check_never_worse(box)


def test_what_is_given_up_in_vain_stays_and_the_method_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Were every fall of the objective rounding, all bounds would be tried once, alone and together, then no more."""
    tried = []

    def never(self: object, other: object) -> bool:
        tried.append(self)
        return False

    box = case(3)
    right = box.solved()
    monkeypatch.setattr(active_set._Minimum, "lower_than", never)
    z = box.solved()
    first = tried[0]
    assert 1 < len(tried) <= len(z) + 1
    assert box.objective(z) > box.objective(right)
    assert box.objective(z) >= box.objective(first.z)  # the trial was better, had it been believed


def test_rounding_is_no_fall() -> None:
    """A point is not lower than itself or one beside it; where the objective is lower by 1e-12 of itself, it is."""
    g = np.random.default_rng(0)
    n = 20
    everywhere = np.full(n, UNBOUNDED)
    box = active_set._Box(np.asfortranarray(g.normal(size=(40, n))), g.normal(size=40), -everywhere, everywhere)
    least = box.face_minimum(np.zeros(n), np.ones(n, dtype=bool))

    def at(z: np.ndarray) -> active_set._Minimum:
        return active_set._Minimum(box, z, box.residual(z), np.ones(n, dtype=bool))

    direction = g.normal(size=n)
    direction *= np.linalg.norm(least.r) / np.linalg.norm(box.A @ direction)
    beside = at(least.z * (1 + EPS))
    away = at(least.z + 1e-6 * direction)
    assert not least.lower_than(least)
    assert not least.lower_than(beside)
    assert not beside.lower_than(least)
    assert least.lower_than(away)
    assert not away.lower_than(least)


def test_columns_of_zeros_stay_exactly_where_the_start_has_them() -> None:
    for seed in range(20):
        g = np.random.default_rng(seed)
        box = degenerate(5 * seed + 3)
        unseen = ~box.A.any(axis=0)
        assert (box.solved()[unseen] == 0).all()
        start = g.uniform(-1, 1, len(unseen))
        start[-1] = 1 - 1e-9  # beside a bound is not on it
        assert (box.solved(start)[unseen] == start[unseen]).all()


def test_unseen_directions_stay_where_the_start_has_them() -> None:
    g = np.random.default_rng(1)
    n = 12
    V = np.linalg.qr(g.normal(size=(n, n)))[0]
    unseen = V[:, :3]
    A = g.normal(size=(n + 1, n - 3)) @ V[:, 3:].T
    b = g.normal(size=n + 1)
    wide = np.full(n, 1e3)
    assert minimum_in_box(A, b, -wide, wide)[0] == pytest.approx(np.linalg.pinv(A) @ b, abs=1e-13)
    start = g.normal(size=n)
    z, _ = minimum_in_box(A, b, -wide, wide, start)
    assert unseen.T @ z == pytest.approx(unseen.T @ start, abs=1e-13)
    assert A.T @ (A @ z - b) == pytest.approx(np.zeros(n), abs=1e-12)


def test_what_the_data_see_to_twelve_digits_less_is_seen() -> None:
    """Without bounds it is the textbook's least squares, at a condition of 1e12 too: in the residual, to rounding."""
    g = np.random.default_rng(2)
    n = 10
    U = np.linalg.qr(g.normal(size=(n + 1, n)))[0]
    V = np.linalg.qr(g.normal(size=(n, n)))[0]
    A = (U * np.geomspace(1, 1e-12, n)) @ V.T
    b = g.normal(size=n + 1)
    nowhere = np.full(n, UNBOUNDED)
    z, multipliers = minimum_in_box(A, b, -nowhere, nowhere)
    least = np.sum(b**2) - np.sum((U.T @ b) ** 2)
    assert np.sum((A @ z - b) ** 2) == pytest.approx(least, rel=2e-3)  # z is of size 1e12: A z has four digits
    assert (multipliers == 0).all()


def test_bounds_on_one_side_and_fixed_components() -> None:
    b = np.array([3.0, -2.0, 5.0, -5.0, 0.25])
    lower = np.array([-UNBOUNDED, -UNBOUNDED, 1.0, 0.0, 0.0])
    upper = np.array([1.0, UNBOUNDED, 1.0, UNBOUNDED, UNBOUNDED])
    z, multipliers = minimum_in_box(np.eye(5), b, lower, upper)
    assert z.tolist() == [1.0, -2.0, 1.0, 0.0, 0.25]
    assert multipliers.tolist() == [4.0, 0.0, 8.0, 10.0, 0.0]


def test_everything_fixed_and_nothing_to_solve() -> None:
    at = np.array([1.0, -2.0])
    z, multipliers = minimum_in_box(np.eye(2), np.zeros(2), at, at, np.zeros(2))
    assert z.tolist() == at.tolist()
    assert multipliers.tolist() == [2.0, 4.0]


def test_multipliers_are_the_slopes_of_the_least_objective() -> None:
    checked = 0
    for box in well_conditioned(range(30)):
        z, multipliers = minimum_in_box(box.A, box.b, box.lower, box.upper)
        for k in np.flatnonzero(multipliers > 1e-2 * multipliers.max()):
            step = 1e-6 * (1 + abs(z[k]))
            values = []
            for sign in (1.0, -1.0):
                moved = box._replace(lower=box.lower.copy(), upper=box.upper.copy())
                moved.upper[k] += sign * step * (z[k] == box.upper[k])
                moved.lower[k] -= sign * step * (z[k] == box.lower[k] < box.upper[k])
                moved.lower[k] += sign * step * (box.lower[k] == box.upper[k])
                values.append(moved.objective(moved.solved()))
            slope = (values[1] - values[0]) / (2 * step)
            if box.lower[k] == box.upper[k]:
                slope = abs(slope)
            # differences of the objective lose its rounding over the step
            assert slope == pytest.approx(multipliers[k], rel=1e-4, abs=1e-8 * values[0])
            checked += 1
    assert checked > 200


def test_a_warm_start_ends_where_a_cold_one_does() -> None:
    for seed, box in enumerate(well_conditioned(range(60))):
        cold = box.solved()
        g = np.random.default_rng(seed)
        for start in (cold + 0.1 * g.normal(size=len(cold)), np.clip(-cold, box.lower, box.upper), 1e6 * cold):
            assert box.solved(start) == pytest.approx(cold, rel=1e-8, abs=1e-8)


def test_from_its_own_minimum_one_small_problem_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also when the start is off its bounds by rounding: those are the first to be tried."""
    held = 0
    for box in well_conditioned(range(40)):
        z, _ = minimum_in_box(box.A, box.b, box.lower, box.upper)
        free = np.count_nonzero((box.lower < z) & (z < box.upper))
        held += len(z) - free
        for start in (z, z * (1 + EPS), z * (1 - EPS)):
            with monkeypatch.context() as patch:
                sizes = counted(patch)
                again = box.solved(start)
            assert sizes == [free] * min(free, 1)
            assert again == pytest.approx(z, rel=1e-9, abs=1e-9)
    assert held > 200


def test_what_is_not_a_number_comes_back_as_such() -> None:
    """It must not keep the loop going; callers refuse such data before."""
    z, _ = minimum_in_box(np.eye(2), np.array([np.nan, 1.0]), -np.ones(2), np.ones(2))
    assert np.isnan(z).any()
    z, _ = minimum_in_box(np.full((3, 2), np.nan), np.ones(3), -np.ones(2), np.ones(2))
    assert np.isnan(z).any()


def test_arguments_stay_as_they_were() -> None:
    box = case(5)
    start = np.full(len(box.lower), 0.1)
    given = (box.A, box.b, box.lower, box.upper, start)
    before = [np.copy(array) for array in given]
    minimum_in_box(*given)
    for array, copy in zip(given, before, strict=True):
        assert (array == copy).all()


SCRIPT = """
import sys
import numpy as np
from tests.convex.test_active_set import cases, well_conditioned

objectives = [box.objective(box.solved()) for box in cases(range(100))]
points = [box.solved() for box in well_conditioned(range(100))]
np.savez(sys.argv[1], objectives=objectives, points=np.concatenate(points))
"""


@pytest.mark.parametrize("kernel", ["Haswell", "Nehalem"])
def test_every_processor_gives_the_same(kernel: str, tmp_path) -> None:
    """Kernels differ in the last digits of the boxes themselves, too: hence the tolerances."""
    file = tmp_path / "found.npz"
    environment = {**os.environ, "OPENBLAS_CORETYPE": kernel, "OPENBLAS_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    subprocess.run([sys.executable, "-c", SCRIPT, str(file)], env=environment, check=True, timeout=120)
    other = np.load(file)
    for box, objective in zip(cases(range(100)), other["objectives"], strict=True):
        z = box.solved()
        assert objective == pytest.approx(box.objective(z), rel=1e-9, abs=1e-12 * box.terms(z) ** 2)
    here = np.concatenate([box.solved() for box in well_conditioned(range(100))])
    assert other["points"] == pytest.approx(here, rel=1e-8, abs=1e-8)
