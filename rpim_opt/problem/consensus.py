"""Which measurements can agree with one base and one tool, whatever these are: turns that do not depend on them."""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np
from scipy.special import chdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.problem.loops import Loops, Turns
from rpim_opt.problem.placing import proper
from rpim_opt.problem.rotations import undercut

MOST_PAIRED = 2000
"""Measurements up to which all pairs are compared."""
FEW = 10
"""Measurements of which each is left out in turn, and how many sets are begun with at most."""
FEWEST = 3
"""Measurements that have to have a weight."""
ASKED = 40
"""Measurements, evenly spread, of which is asked what they go with."""
MOST_SOLVED = 60
"""Pairs, and sets, of measurements whose relaxations are solved to show that they do not agree."""
ROUNDING = 1e-7
"""Error of an angle from its cosine [rad]."""
SURPRISE = 1e-4
"""Probability that a good measurement, or what is expected of translations, is off by more than counts as good."""


def compatible(turns: Turns, beyond: Array) -> np.ndarray:
    """Return which two measurements (N, N) can both have squared residuals up to these (N,), for some frames.

    ::

        B_i = E_i Z A_i X,  |E_i| <= 2 asin(sigma_i c_i / 2)    hence    ||A_i'A_j| - |B_i'B_j|| <= |E_i| + |E_j|

    |.| being the angle of a rotation: X and Z drop out. Pairs of which nothing is known are compatible.

    Examples
    --------
    The third has turned by another angle than the flange.

    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from rpim_opt.problem.consensus import compatible
    >>> from rpim_opt.problem.loops import Turns
    >>> A, B = (Rotation.from_rotvec([[0, 0, 0], each, [1, 0, 0]]).as_matrix() for each in ([0, 1, 0], [0, 0, 1]))
    >>> B[2] = Rotation.from_rotvec([0.5, 0, 0]).as_matrix()
    >>> compatible(Turns(A, B, np.full(3, 1e-3), np.zeros(3, dtype=int)), np.full(3, 16.8))
    array([[ True,  True, False],
           [ True,  True, False],
           [False, False,  True]])
    """
    N = len(beyond)
    if N > MOST_PAIRED:
        return np.ones((N, N), dtype=bool)
    first = proper(turns.first)
    second = proper(turns.second)
    # matrices that are rotations but for a few digits are taken for the nearest
    rough = _sizes(turns.first - first) + _sizes(turns.second - second)
    chord = turns.sigma * np.sqrt(beyond) / 2 + rough / np.sqrt(8)
    off = 2 * np.arcsin(np.minimum(1.0, chord)) + ROUNDING
    alike = np.abs(_angles(first) - _angles(second)) <= off[:, None] + off
    known = (turns.group[:, None] == turns.group) & (turns.group >= 0)
    return alike | ~known


def _angles(rotations: Array) -> Array:
    """Return the angles (N, N) between rotations."""
    flat = rotations.reshape(-1, 9)
    return np.arccos(np.clip((flat @ flat.T - 1) / 2, -1.0, 1.0))


def _sizes(matrices: Array) -> Array:
    return np.asarray(np.linalg.norm(matrices, axis=(1, 2)))


def core(pairs: np.ndarray, count: int) -> np.ndarray:
    """Return which measurements (N,) are left after those are dropped, in turn, that fewer than `count` go with.

    All sets of `count` that go with one another are among these (the k-core of a graph; Shi, Yang, Carlone 2021, IEEE
    ICRA, find outliers so).
    """
    left = np.ones(len(pairs), dtype=bool)
    while True:
        kept = left & (np.sum(pairs[:, left], axis=1) >= count)
        if np.array_equal(kept, left):
            return left
        left = kept


def likeliest(pairs: np.ndarray) -> np.ndarray:
    """Return the core (N,) of the largest count that leaves any."""
    return core(pairs, _largest(pairs))


def likely(pairs: np.ndarray, among: np.ndarray) -> list[np.ndarray]:
    """Return smaller sets (N,) to begin with, the larger first: what is likeliest of those that one of some goes with.

    And, where some are few, all but one of them: turning alike, it may be wrong all the same.
    """
    sets = []
    members = np.flatnonzero(among)
    for each in members[:: 1 + len(members) // ASKED]:
        near = np.flatnonzero(pairs[each])
        sets.append(np.isin(np.arange(len(pairs)), near[likeliest(pairs[np.ix_(near, near)])]))
    if len(members) <= FEW:
        sets += [among & (np.arange(len(pairs)) != each) for each in members]
    distinct = {each.tobytes(): each for each in sets if np.sum(each) >= FEWEST and not np.array_equal(each, among)}
    return sorted(distinct.values(), key=lambda each: -int(np.sum(each)))[:FEW]


def _largest(pairs: np.ndarray) -> int:
    """Return the largest count that has a core, by halving."""
    low, high = 1, len(pairs) + 1
    while high - low > 1:
        middle = (low + high) // 2
        if core(pairs, middle).any():
            low = middle
        else:
            high = middle
    return low


def alone(loops: Loops, squares: Array, agreeing: np.ndarray, beyond: Array) -> bool:
    """Return whether no other measurements than the agreeing (N,) can be as many that agree with something else.

    They cannot if fewer are left over than would have to, or if no other is in a core of that size; nor if every set
    of that size with another in it has a sum of squares, by its relaxation's bound, above what agreeing allows. One
    whose square (N,) a good one may have, in ten thousand, is no other.
    """
    N = len(agreeing)
    count = int(np.sum(agreeing))
    if count >= N // 2 + 2:
        return True
    if count < 2:
        return False
    pairs = compatible(loops.turns, beyond)
    strange = ~agreeing & (squares > chdtri(loops.freedom, SURPRISE))
    others = np.flatnonzero(core(pairs, count) & strange)
    if not _told_apart(loops, pairs, others, core(pairs, count), beyond):
        return False
    rivals: list[list[int]] = []
    for other in np.flatnonzero(core(pairs, count) & strange):
        rest = _around(pairs, int(other), count)
        if len(rivals) + comb(len(rest), count - 1) > MOST_SOLVED:
            return False
        rivals += [[int(other), *some] for some in combinations(rest, count - 1)]
    return not any(_may_agree(loops, rival, beyond) for rival in rivals)


def _told_apart(loops: Loops, pairs: np.ndarray, others: np.ndarray, among: np.ndarray, beyond: Array) -> bool:
    """Mark pairs of others whose relaxation shows that they do not go together; return whether they are few enough."""
    asked = {(min(i, j), max(i, j)) for i in others for j in np.flatnonzero(pairs[i] & among) if i != j}
    if len(asked) > MOST_SOLVED:
        return False
    for i, j in asked:
        pairs[i, j] = pairs[j, i] = _may_agree(loops, [i, j], beyond)
    return True


def _around(pairs: np.ndarray, other: int, count: int) -> list[int]:
    """Return what goes with a measurement and with enough of what does; nothing where that is too little."""
    near = np.flatnonzero(pairs[other])
    members = near[core(pairs[np.ix_(near, near)], count)].tolist()
    return [each for each in members if each != other] if other in members else []


def _may_agree(loops: Loops, members: list[int], beyond: Array) -> bool:
    """Return whether the relaxation leaves it open that measurements, and what is expected of translations, agree."""
    weights = np.zeros(len(loops.rows))
    weights[members] = 1.0
    least = undercut(loops.form(loops.triangle(weights)), loops.shared)
    return least <= float(np.sum(beyond[members]) + chdtri(len(loops.prior), SURPRISE))
