"""Which measurements can agree: turns never exclude what does, cores keep all that go together, rivals are found."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import rpim_opt as ro
from rpim_opt.problem.registration.loops import (
    MOST_PAIRED,
    Loops,
    Seen,
    Turns,
    alone,
    compatible,
    core,
    likeliest,
    of_motions,
    of_poses,
)
from rpim_opt.problem.registration.relaxation import lifted, smallest, undercut

BEYOND = float(chi2.ppf(0.99, 6))


def frames(rng: np.random.Generator, count: int, size: float) -> np.ndarray:
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    T[:, :3, 3] = size * rng.normal(size=(count, 3))
    return T


def seen(rng: np.random.Generator, flange: np.ndarray, measured: np.ndarray, sigma: tuple[float, float]) -> Loops:
    N = len(flange)
    one = np.zeros(N, dtype=int)
    deviations = np.tile(sigma, (N, 1))
    closing = Seen(flange, measured, np.ones(N, dtype=bool), one, one, deviations, np.zeros((1, 3)), np.inf)
    return of_poses(closing, scaled=False)


@pytest.mark.parametrize("sigma", [1e-3, 0.1])
def test_what_agrees_is_compatible(sigma: float) -> None:
    """Errors as large as agreeing allows, about any axes: pairs stay compatible, and the bound is one that is met."""
    rng = np.random.default_rng(0)
    largest = 2 * np.arcsin(sigma * np.sqrt(BEYOND) / 2)
    axes = rng.normal(size=(60, 3))
    E = Rotation.from_rotvec(largest * axes / np.linalg.norm(axes, axis=1)[:, None])
    A = Rotation.random(60, rng=rng)
    base, tool = Rotation.random(2, rng=rng)
    turns = Turns(A.as_matrix(), (E * base * A * tool).as_matrix(), np.full(60, sigma), np.zeros(60, dtype=int))
    assert compatible(turns, np.full(60, BEYOND)).all()
    # against each other about the axis of a turn, errors add up: that is just compatible, and hardly more is not
    turn = Rotation.from_rotvec([1.0, 0, 0])
    apart = Rotation.from_rotvec([2 * largest, 0, 0])
    for factor, expected in ((1 - 1e-6, True), (1 + 1e-4, False)):
        second = np.array([np.eye(3), (turn * apart**factor).as_matrix()])
        first = np.array([np.eye(3), turn.as_matrix()])
        pair = Turns(first, second, np.full(2, sigma), np.zeros(2, dtype=int))
        assert compatible(pair, np.full(2, BEYOND))[0, 1] == expected


def test_pairs_of_which_nothing_is_known_are_compatible() -> None:
    rng = np.random.default_rng(1)
    first, second = Rotation.random(12, rng=rng).as_matrix().reshape(2, 6, 3, 3)
    groups = np.array([0, 0, 1, 1, -1, -1])
    pairs = compatible(Turns(first, second, np.full(6, 1e-6), groups), np.full(6, BEYOND))
    known = np.array([[a == b >= 0 for b in groups] for a in groups])
    np.testing.assert_array_equal(pairs, ~known | np.eye(6, dtype=bool))
    N = MOST_PAIRED + 1
    many = Turns(np.zeros((N, 3, 3)), np.zeros((N, 3, 3)), np.ones(N), np.zeros(N, dtype=int))
    assert compatible(many, np.full(N, BEYOND)).all()


def test_rotations_of_four_digits_are_compatible() -> None:
    """Small turns, whose cosines say little, from a file that was written shortly."""
    rng = np.random.default_rng(2)
    A = Rotation.from_rotvec(0.01 * rng.normal(size=(40, 3)))
    base, tool = Rotation.random(2, rng=rng)
    second = np.round((base * A * tool).as_matrix(), 4)
    turns = Turns(np.round(A.as_matrix(), 4), second, np.full(40, 1e-6), np.zeros(40, dtype=int))
    assert compatible(turns, np.full(40, BEYOND)).all()


@pytest.mark.parametrize("seed", range(5))
def test_cores_keep_all_that_go_together(seed: int) -> None:
    """Beside every set of pairwise compatible ones, by trying them all; and what is left goes with enough of it."""
    rng = np.random.default_rng(seed)
    upper = np.triu(rng.random((9, 9)) < 0.5, 1)
    pairs = upper | upper.T | np.eye(9, dtype=bool)
    for count in range(1, 10):
        left = core(pairs, count)
        assert np.all(np.sum(pairs[:, left], axis=1)[left] >= count)
        for members in combinations(range(9), count):
            if pairs[np.ix_(members, members)].all():
                assert left[list(members)].all()
    most = max(count for count in range(1, 10) if core(pairs, count).any())
    np.testing.assert_array_equal(likeliest(pairs), core(pairs, most))


@pytest.mark.parametrize("seed", range(4))
def test_no_rotations_undercut_what_multipliers_say(seed: int) -> None:
    rng = np.random.default_rng(seed)
    L = rng.normal(size=(8, 19))
    bound = undercut(L)
    drawn = Rotation.random(6000, rng=rng).as_matrix().reshape(-1, 2, 3, 3)
    assert bound <= min(np.sum((L @ lifted(R)) ** 2) for R in drawn)
    assert bound >= smallest(L).bound - 1e-6


def consenting(groups: list[int], seed: int) -> tuple[Loops, np.ndarray]:
    """Return loops of so many poses for each of several bases, and which are of the first."""
    rng = np.random.default_rng(seed)
    flange = frames(rng, sum(groups), 0.5)
    tool = frames(rng, 1, 0.1)[0]
    bases = frames(rng, len(groups), 1.0)
    which = np.repeat(np.arange(len(groups)), groups)
    return seen(rng, flange, bases[which] @ flange @ tool, (1e-3, 1e-3)), which == 0


FAR_OFF = 1e6
"""A square that no good measurement has."""


@pytest.mark.parametrize(
    ("groups", "expected"),
    [([3, 1], True), ([3, 2], True), ([4, 4], False), ([4, 3, 3], True), ([3, 3, 1], False), ([1, 1], False)],
)
def test_who_agrees_is_alone_where_no_others_are_as_many(groups: list[int], expected: bool) -> None:
    loops, agreeing = consenting(groups, 3)
    assert alone(loops, FAR_OFF * ~agreeing, agreeing, np.full(len(agreeing), BEYOND)) == expected


def test_one_that_a_good_one_may_be_is_no_rival() -> None:
    """Left out by a hair it leads to the same frames; left out by far it does not, though it agrees with the others."""
    loops, agreeing = consenting([5, 3], 5)
    agreeing[0] = False
    beyond = np.full(8, BEYOND)
    squares = FAR_OFF * ~agreeing
    assert not alone(loops, squares, agreeing, beyond)
    squares[0] = 1.3 * BEYOND
    assert alone(loops, squares, agreeing, beyond)
    assert not alone(loops, FAR_OFF * (np.arange(8) < 5), np.arange(8) >= 5, beyond)


def test_turns_by_the_same_angle_are_told_apart_by_the_places() -> None:
    """A wrong pose that turned as the flange did, about the wrong point: its places do not fit."""
    rng = np.random.default_rng(7)
    flange = frames(rng, 4, 0.5)
    base, tool = frames(rng, 2, 0.5)
    measured = base @ flange @ tool
    measured[3, :3, 3] += 0.3
    loops = seen(rng, flange, measured, (1e-3, 1e-3))
    beyond = np.full(4, BEYOND)
    assert compatible(loops.turns, beyond).all()
    assert alone(loops, FAR_OFF * (np.arange(4) == 3), np.arange(4) < 3, beyond)


def test_motions_have_turns_too() -> None:
    rng = np.random.default_rng(9)
    tool = frames(rng, 1, 0.1)[0]
    A = frames(rng, 7, 0.3)
    B = np.linalg.inv(tool) @ A @ tool
    B[4:] = frames(rng, 3, 0.3)
    loops = of_motions(A, B, np.full((7, 2), 1e-3), np.zeros(3), np.inf, scaled=False)
    assert compatible(loops.turns, np.full(7, BEYOND))[:4, :4].all()
    start = ro.problem.certified_motions(A, B, sigma=(1e-3, 1e-3), loss="truncated")
    assert start.certified
    np.testing.assert_array_equal(start.weights, np.arange(7) < 4)
