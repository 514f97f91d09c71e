"""Rotations come back after a full turn; nothing else does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rpim_opt as ro
from tests.data.test_measurement import KINDS, TYPES, measuring, random_problem


@settings(deadline=None, max_examples=25)
@given(st.sampled_from(KINDS), st.integers(0, 10**6), st.lists(st.sampled_from(TYPES), min_size=1, max_size=5))
def test_full_turns_change_no_residual(kind: str, seed: int, types: list[str]) -> None:
    problem, rng = random_problem(kind, seed, tuple(types))
    free = problem.parameters.free
    x = rng.normal(size=len(free))
    turned = x + 2 * np.pi * rng.integers(-2, 3, len(free)) * free.periodic
    back = free.wrapped(turned)
    assert ((back > -np.pi) & (back <= np.pi))[free.periodic].all()
    np.testing.assert_array_equal(back[~free.periodic], x[~free.periodic])
    near = measuring(problem, problem.modelled(x)[0])
    # pi is known to 1e-16, two turns of a robot of a few metres to 1e-14
    np.testing.assert_allclose(near.residual(back), near.residual(turned), rtol=0, atol=1e-12 * (1 + len(types)))


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_periodic_is_exactly_what_a_turn_leaves_alone(kind: str) -> None:
    problem, rng = random_problem(kind, 5, ("revolute", "prismatic", "revolute"))
    free = problem.parameters.free
    x = 0.1 * rng.normal(size=len(free))
    here = problem.modelled(x)[0]
    for i, name in enumerate(free.names):
        turn = np.zeros(len(free))
        turn[i] = 2 * np.pi
        same = np.abs(problem.modelled(x + turn)[0] - here).max() < 1e-12
        if name.startswith("backlash"):
            continue  # approached from -1, 0 or +1 times a turn, the joint is where it was: by chance, not as an angle
        if free.periodic[i]:
            assert same, name
        # a turn may leave a value alone that does not depend on the parameter; then its column is zero
        elif same:
            assert not problem.jacobian(x)[:, i].any(), name


def test_angles_of_an_own_measurement_are_its_own_affair() -> None:
    bent = ro.data.Measurement(
        "bent", lambda T, jig_rx: T[2, 3] + 0.1 * jig_rx, {"z": "length"}, parameters={"jig_rx": "angle"}
    )
    arm = ro.load("position").problem
    data = ro.Dataset.of(arm.data.q, np.zeros((40, 1)), 1e-5, measurement=bent)
    p = ro.problem.starting_parameters(arm.robot, data, own={"jig_rx": 0.0}).identify(["jig_rx", "theta1", "base_rz"])
    assert dict(zip(p.free.names, p.free.periodic, strict=True)) == {"theta1": True, "base_rz": True, "jig_rx": False}
    x = np.full(3, 4.0)
    np.testing.assert_allclose(p.free.wrapped(x), np.where(p.free.periodic, 4 - 2 * np.pi, 4.0), rtol=1e-15)


def test_frames_of_a_measurement_turn() -> None:
    p = ro.load("plane").problem.parameters
    periodic = dict(zip(p.names, p.periodic, strict=True))
    assert periodic["plane_rx"]
    assert not periodic["plane_x"]


@pytest.mark.parametrize(("x", "wrapped"), [(np.pi, np.pi), (-np.pi, np.pi), (0.3, 0.3), (7 * np.pi, np.pi)])
def test_the_interval_is_closed_at_pi(x: float, wrapped: float) -> None:
    free = ro.load("position").problem.parameters.identify(["theta1"]).free
    assert free.wrapped(np.array([x]))[0] == pytest.approx(wrapped, abs=1e-14)
