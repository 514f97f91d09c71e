"""What joints do besides their drawing: every term moves a joint by parameter times effect."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.robot import Configuration, Joint
from rpim_opt.robot.kinematics import transforms
from rpim_opt.robot.parameters import of_joint, of_term
from rpim_opt.robot.terms import JOINT_TERMS, Weight, terms_of
from tests.simulate import ARM

Q = np.random.default_rng(0).uniform(-2, 2, (7, 6))


def positions(values: dict[str, float], block: dict | None = None, robot: ro.robot.Robot = ARM) -> np.ndarray:
    """Positions (N, 3) at Q of a robot with these deviations, and with what its rows bear."""
    parameters = ro.robot.model_parameters(robot, tools={"": (0.03, -0.02, 0.06, 0, 0, 0)}).identify(values)
    data = ro.Dataset.of(Q, np.zeros((len(Q), 3)), 1e-5)
    data = replace(data, blocks=(replace(data.blocks[0], **(block or {})),))
    x = np.array([values[name] for name in parameters.free.names])
    return ro.CalibrationProblem(robot, parameters, data).modelled(x)[0]


def positions_at(q: np.ndarray) -> np.ndarray:
    tool = np.array([0.03, -0.02, 0.06, 1])
    return (ro.robot.forward_kinematics(ARM, q) @ tool)[:, :3]


def effects(rng: np.random.Generator) -> dict[str, tuple[np.ndarray, dict]]:
    """What multiplies the parameters of joint 3, at Q, and what the rows state for it."""
    q = Q[:, 2]
    side = rng.choice([-1.0, 0.0, 1.0], (len(Q), 1, 6))
    payload = rng.uniform(0, 3, len(Q))
    torque = rng.uniform(-10, 10, (len(Q), 1, 6))
    slopes = ro.robot.moment_slopes(ARM, Q)
    loaded = [replace(ARM, gravity=ARM.gravity.carrying(mass)) for mass in payload]
    borne = np.array([ro.robot.gravity_torques(robot, at)[0, 2] for robot, at in zip(loaded, Q, strict=True)])
    return {
        "ratio3": (q, {}),
        "ecc_cos3": (np.cos(q), {}),
        "ecc_sin3": (np.sin(q), {}),
        "ecc2_cos3": (np.cos(2 * q), {}),
        "ecc2_sin3": (np.sin(2 * q), {}),
        "backlash3": (side[:, 0, 2], {"approach": side}),
        "compliance3": (ro.robot.gravity_torques(ARM, Q)[:, 2], {}),
        "compliance3 and a payload": (borne, {"payload": payload}),
        "compliance3 and torques": (torque[:, 0, 2], {"torque": torque}),
        "moment3_5y": (slopes[:, 2, 4, 1], {}),
    }


@pytest.mark.parametrize("name", effects(np.random.default_rng(1)))
def test_a_term_moves_its_joint_by_parameter_times_effect(name: str) -> None:
    effect, block = effects(np.random.default_rng(1))[name]
    moved = Q.copy()
    moved[:, 2] += 2e-4 * effect
    found = positions({name.split()[0]: 2e-4}, block)
    assert np.abs(found - positions_at(moved)).max() < 1e-14
    assert np.abs(found - positions_at(Q)).max() > 1e-5


def test_terms_add_up() -> None:
    values = {"ecc_cos2": 1e-3, "ecc2_sin2": -2e-3, "compliance2": 1e-5, "moment2_3x": 3e-4, "ratio2": 1e-3}
    q = Q[:, 1]
    bent = 1e-5 * ro.robot.gravity_torques(ARM, Q)[:, 1] + 3e-4 * ro.robot.moment_slopes(ARM, Q)[:, 1, 2, 0]
    moved = Q.copy()
    moved[:, 1] += 1e-3 * np.cos(q) - 2e-3 * np.sin(2 * q) + 1e-3 * q + bent
    assert np.abs(positions(values) - positions_at(moved)).max() < 1e-14


def test_gravity_acts_on_the_nominal_arm_whatever_is_identified() -> None:
    bent = Q.copy()
    bent[:, 1] += 1e-4 * ro.robot.gravity_torques(ARM, Q)[:, 1]
    longer = replace(ARM, mdh=ARM.mdh + 0.05 * np.outer(np.arange(6) == 2, [0, 1, 0, 0, 0]))
    tool = np.array([0.03, -0.02, 0.06, 1])
    expected = (ro.robot.forward_kinematics(longer, bent) @ tool)[:, :3]
    assert np.abs(positions({"a3": 0.05, "compliance2": 1e-4}) - expected).max() < 1e-14


def test_a_controllers_signs_and_couplings_turn_directions_and_leave_gravity_to_the_axes() -> None:
    joint_map = np.diag([1.0, -1, 1, 1, 1, 1])
    joint_map[2, 1] = 1.0
    robot = replace(ARM, joint_map=joint_map)
    side = np.random.default_rng(0).choice([-1.0, 1.0], (len(Q), 1, 6))
    model = Q @ joint_map.T
    model[:, 1] -= 1e-3 * side[:, 0, 1]
    assert np.abs(positions({"backlash2": 1e-3}, {"approach": side}, robot) - positions_at(model)).max() < 1e-14
    model = Q @ joint_map.T
    model[:, 2] += 1e-5 * ro.robot.gravity_torques(ARM, model)[:, 2]
    assert np.abs(positions({"compliance3": 1e-5}, {}, robot) - positions_at(model)).max() < 1e-14


def test_a_prismatic_joint_has_a_ratio_and_nothing_else() -> None:
    robot = ro.robot.Robot("lift", ARM.mdh, ("prismatic", *["revolute"] * 5))
    names = ro.robot.model_parameters(robot).names
    assert [name for name in names if of_term(name) and name.endswith("1")] == ["ratio1"]
    assert not [name for name in names if name.startswith("moment1")]
    assert "ecc_cos2" in names


def test_an_effect_that_is_not_needed_is_not_written_down() -> None:
    class Never(Weight):
        def torque(self, i: int) -> float:
            raise AssertionError(i)

        def moment(self, i: int, k: int, axis: str) -> float:
            raise AssertionError(i, k, axis)

    values = {"ecc_cos1": 0.1, "compliance1": 0.0, "moment1_1x": ca.SX(0)}
    [link] = transforms(("revolute",), Configuration([0.5], weight=Never()), lambda name: values.get(name, 0.0))
    angle = 0.5 + 0.1 * np.cos(0.5)
    assert ca.DM(link).full()[:2, 0] == pytest.approx([np.cos(angle), np.sin(angle)])


def test_what_a_joint_sees_is_what_its_configuration_states() -> None:
    joint = Joint(2, Configuration([0.1, 0.2], torque=[3.0, 4.0], approach=[0.0, -1.0]))
    assert (joint.q, joint.every_q, joint.torque, joint.approach) == (0.2, [0.1, 0.2], 4.0, -1.0)
    free = Joint(2, Configuration([0.1, 0.2]))
    assert (free.torque, free.gravity, free.approach, free.moment(2, "x")) == (0.0, 0.0, 0.0, 0.0)


def test_names_say_what_a_parameter_belongs_to() -> None:
    for i in (1, 6):
        for term in terms_of(6):
            (name,) = term.names(i)
            assert of_term(name)
            assert of_joint(name)
    assert (of_term("theta3"), of_joint("theta3")) == (False, True)
    assert (of_term("tool_x"), of_joint("bend_x")) == (False, False)
    assert len({term.name for term in JOINT_TERMS}) == len(JOINT_TERMS)


def test_names_are_listed_as_patterns() -> None:
    with pytest.raises(ro.InputError, match=r"'moment1_1x', accepted: .*moment\?_\?x"):
        ro.robot.model_parameters(ARM).identify(["moment1_1x"])
