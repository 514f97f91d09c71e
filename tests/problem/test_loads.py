"""What joints bear in a row: gravity without torque columns, payloads, sides; and which data go with which."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.data.measurements.registry import MEASUREMENTS
from rpim_opt.problem.row_functions import loads_of, needed, repeated
from tests.data.test_measurement import KINDS, random_problem
from tests.robot.test_gravity import random_robot
from tests.simulate import ARM, simulated

TERMS = ("compliance?", "moment*", "backlash?", "theta?")


@pytest.mark.parametrize("kind", KINDS)
def test_jacobians_under_gravity_are_differences_of_residuals(kind: str) -> None:
    types = ("revolute", "prismatic", "revolute", "revolute")
    problem, rng = random_problem(kind, 3, types, identify=TERMS)
    block = replace(problem.data.blocks[0], torque=None, payload=rng.uniform(0, 3, 6))
    data = replace(problem.data, blocks=(block,))
    robot = replace(problem.robot, gravity=random_robot(3, types).gravity)
    problem = ro.CalibrationProblem(robot, problem.parameters, data)
    free = problem.parameters.free
    # sizes at which the differences neither round nor bend: 50 Nm move a joint as far as 1e-5 / 50
    h = np.where(np.array(free.dimensions) == "compliance", 1e-7, 1e-5)
    x = 5e3 * h * rng.normal(size=len(free))
    J = problem.jacobian(x)
    gravity = [i for i, name in enumerate(free.names) if name.startswith(("compliance", "moment"))]
    assert np.abs(J[:, gravity]).max() > 0.1
    for i in gravity:
        step = h[i] * (np.arange(len(free)) == i)
        difference = (problem.residual(x - step) - problem.residual(x + step)) / (2 * h[i])
        assert np.abs(J[:, i] - difference).max() < 1e-6 * (1 + np.abs(J[:, i]).max()), free.names[i]


def test_compliance_is_identified_without_torques() -> None:
    """Truth comes back to 1e-8 without noise, with the payload of every row known and none measured."""
    problem, _ = simulated(("theta[2-6]", "a?", "compliance[2345]", "ecc2_cos3"), configurations=30)
    rng = np.random.default_rng(0)
    block = replace(problem.data.blocks[0], payload=rng.choice([0.0, 2.5], 30))
    problem = problem.on(replace(problem.data, blocks=(block,)))
    truth = rng.normal(size=len(problem.parameters.free)) * problem.parameters.free.scale
    block = replace(block, y=problem.modelled(truth)[0])
    result = ro.calibrate(problem.on(replace(problem.data, blocks=(block,))), ro.tikhonov, 1e-14)
    assert np.abs((result.x - truth) / problem.parameters.free.scale).max() < 1e-8


def test_predictions_know_the_side_from_which_a_joint_came() -> None:
    problem, _ = simulated(("base_*",), configurations=12)
    side = np.random.default_rng(0).choice([-1.0, 1.0], (12, 6))
    block = replace(problem.data.blocks[0], approach=side[:, None])
    problem = problem.on(replace(problem.data, blocks=(block,)))
    problem = problem.with_parameters(problem.parameters.identify(["base_*", "backlash[23]"]))
    truth = np.array([2e-4 if name.startswith("backlash") else 0.0 for name in problem.parameters.free.names])
    block = replace(block, y=problem.modelled(truth)[0])
    result = ro.calibrate(problem.on(replace(problem.data, blocks=(block,))), ro.tikhonov, 1e-10)
    q = problem.data.q
    there = result.predict(q, columns={"approach": side}).position
    assert np.abs(there - block.y).max() < 1e-8
    assert np.abs(result.predict(q).position - there).max() > 1e-5
    other = result.forward(q, columns={"approach": -side})[:, :3, 3]
    assert np.abs(other - there).max() > 1e-5


def test_measured_torques_go_before_those_of_gravity() -> None:
    problem, _ = simulated(("compliance?",), configurations=5)
    x = np.full(6, 1e-5)
    q = problem.data.q
    block = problem.data.blocks[0]
    zero = replace(problem.data, blocks=(replace(block, torque=np.zeros((5, 1, 6))),))
    still = ro.CalibrationProblem(ARM, problem.parameters, zero)
    assert np.abs(still.modelled(x)[0] - still.modelled(0 * x)[0]).max() == 0
    moved = ro.CalibrationProblem(ARM, problem.parameters, problem.data).modelled(x)[0]
    assert np.abs(moved - still.modelled(x)[0]).max() > 1e-4
    stated = ro.robot.gravity_torques(ARM, q)[:, None]
    given = ro.CalibrationProblem(ARM, problem.parameters, replace(zero, blocks=(replace(block, torque=stated),)))
    assert np.abs(given.modelled(x)[0] - moved).max() < 1e-14


def test_rows_without_torques_among_rows_with_them_bear_none() -> None:
    problem, _ = simulated(("compliance?",), configurations=4)
    block = problem.data.blocks[0]
    first = replace(block.take(np.arange(2), np.arange(2)), torque=np.full((2, 1, 6), 5.0))
    second = block.take(np.arange(2, 4), np.arange(2, 4))
    mixed = ro.CalibrationProblem(ARM, problem.parameters, replace(problem.data, blocks=(first, second)))
    x = np.full(6, 1e-4)
    with_torques, without = mixed.modelled(x)
    assert np.abs(without - mixed.modelled(0 * x)[1]).max() == 0
    assert np.abs(with_torques - mixed.modelled(0 * x)[0]).max() > 1e-5


def test_a_compliance_keeps_to_its_kind_of_torques() -> None:
    problem, _ = simulated(("compliance?",), configurations=4)
    block = replace(problem.data.blocks[0], torque=np.zeros((4, 1, 6)))
    loaded = replace(problem.data, blocks=(block,))
    measured = ro.CalibrationProblem(ARM, problem.parameters, loaded)
    with pytest.raises(ro.InputError, match="without joint torques"):
        measured.on(problem.data)
    with pytest.raises(ro.InputError, match="found data with joint torques"):
        problem.on(loaded)
    # whom compliances do not concern, torques do not
    geometry = problem.with_parameters(problem.parameters.identify(["a?"]))
    assert geometry.on(loaded).on(problem.data).data is problem.data


def test_a_nominal_compliance_bends_a_robot_too() -> None:
    problem, _ = simulated(("a?",), configurations=4)
    names = problem.parameters.names
    nominal = problem.parameters.nominal.copy()
    nominal[names.index("compliance2")] = 1e-5
    bent = problem.with_parameters(replace(problem.parameters, nominal=nominal))
    q = problem.data.q.copy()
    q[:, 1] += 1e-5 * ro.robot.gravity_torques(ARM, q)[:, 1]
    there = problem.on(ro.Dataset.of(q, np.zeros((4, 3)), 1.0))
    assert np.abs(bent.modelled(np.zeros(6))[0] - there.modelled(np.zeros(6))[0]).max() < 1e-14


def test_what_no_parameter_asks_for_is_not_evaluated() -> None:
    problem, _ = simulated(("a?", "ecc2_*"), configurations=4)
    for patterns, gravity in (("a?", None), ("compliance3", ARM.gravity), ("moment3_4x", ARM.gravity)):
        needs = needed(ARM, problem.parameters.identify([patterns]))
        assert loads_of(ARM, needs, problem.data, problem.data.blocks[0]).gravity is gravity


def test_backlash_needs_directions_of_approach() -> None:
    problem, _ = simulated(("a?",), configurations=4)
    with pytest.raises(ro.InputError, match="'backlash1' without directions of approach, accepted: columns approach1"):
        problem.with_parameters(problem.parameters.identify(["backlash?"]))


# --- tables ---------------------------------------------------------------------------------------------------------

TABLE = {"label": ["a", "b"], "q1_deg": [0, 10], "q2_deg": [5, 6], "x_mm": [1, 2], "y_mm": [3, 4], "z_mm": [5, 6]}
TWO = ro.robot.Robot("two links", np.array([[0, 0, 0, 0, 0], [0, 0.4, 0, 0, 0]]))


def read(**columns: list) -> ro.Dataset:
    return ro.read_data({**TABLE, **columns}, TWO, {"position_mm": 0.1})


def test_tables_state_payloads_and_sides() -> None:
    block = read(payload_kg=[0, 2.5], approach1=[-1, 1], approach2=[0, 1]).blocks[0]
    assert block.payload is not None
    assert block.approach is not None
    assert block.payload.tolist() == [0.0, 2.5]
    assert block.approach[:, 0].tolist() == [[-1, 0], [1, 1]]
    second = read(payload_kg=[0, 2.5], approach1=[-1, 1], approach2=[0, 1]).take([1]).blocks[0]
    assert second.payload is not None
    assert second.payload.tolist() == [2.5]
    plain = read().blocks[0]
    assert plain.payload is None
    assert plain.approach is None


@pytest.mark.parametrize(
    ("columns", "match"),
    [
        ({"payload_kg": [0, -1]}, "row b, column payload_kg: found -1"),
        ({"payload": [0, 1]}, "payload_kg"),
        ({"approach1": [1, 1]}, "no column for 'approach2'"),
        ({"approach1": [1, 1], "approach2": [1, 0.5]}, "row b, column approach2: found 0.5, accepted: -1, 0"),
    ],
)
def test_what_a_table_cannot_mean_is_refused(columns: dict, match: str) -> None:
    with pytest.raises(ro.InputError, match=match):
        read(**columns)


def test_a_distances_second_point_may_come_from_another_side() -> None:
    table = {k: v for k, v in TABLE.items() if k[0] not in "xyz"}
    table |= {"to_q1_deg": [1, 2], "to_q2_deg": [3, 4], "distance_mm": [5, 6]}
    sides = {"approach1": [1, 1], "approach2": [1, 1]}
    other = {"to_approach1": [-1, 0], "to_approach2": [-1, -1]}
    for columns, second in (({}, [[1, 1], [1, 1]]), (other, [[-1, -1], [0, -1]])):
        data = ro.read_data({**table, **sides, **columns}, TWO, {"distance_mm": 0.1}, MEASUREMENTS["distance"])
        approach = data.blocks[0].approach
        assert approach is not None
        assert approach[:, 1].tolist() == second


def test_what_rows_bear_is_theirs() -> None:
    problem = ro.load("position").problem
    q = problem.data.q[:4]
    torque = np.arange(24.0).reshape(4, 6)
    found = problem.measuring(q, torque=torque, payload=2.5, columns={"heat": 20.0}).data.blocks[0]
    assert found.torque is not None
    assert np.array_equal(found.torque, torque[:, None])
    assert found.payload is not None
    assert found.payload.tolist() == [2.5] * 4
    assert found.columns["heat"].tolist() == [20.0] * 4
    assert found.approach is None
    bare = problem.measuring(q).data.blocks[0]
    assert bare.torque is None
    assert bare.payload is None


def test_rows_that_read_the_same_thing_again_have_the_same_joints() -> None:
    """Of measurements between two points those of both; nothing else where the model sees no column."""
    for name in ("position", "distance"):
        block = ro.load(name).problem.data.blocks[0]
        again = block.take(np.array([0, 1, 0, 2, 1]), np.arange(5))
        number = repeated(again)
        assert (number[0], number[1]) == (number[2], number[4])
        assert len(set(number)) == 3
        one_joint = again.q.copy()
        one_joint[2, -1, 0] += 0.1
        assert len(set(repeated(replace(again, q=one_joint)))) == 4
