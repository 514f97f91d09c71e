"""Robots that are none, and tables of parameters of which only a part is there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.robot.chain import Chain, corrected, describe, require_same_arm, same_place
from rpim_opt.robot.extensions import EXPECTED, family_scales
from rpim_opt.robot.formats.tables import write_robot
from rpim_opt.robot.kinematics import forward_kinematics, numeric_link
from tests.simulate import ARM

MDH = ARM.mdh
TURNS = 2 * np.pi * np.array([1, -2, 0, 3, 0, -1])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"mdh": MDH[:, :4]}, "shape (6, 4), accepted: finite numbers of shape (dof, 5)"),
        ({"mdh": MDH[0]}, "shape (5,)"),
        ({"mdh": MDH[:0]}, "shape (0, 5)"),
        ({"mdh": MDH * np.nan}, "finite numbers"),
        ({"mdh": MDH, "limits": np.tile([1.0, -1.0], (6, 1))}, "6 pairs lower < upper"),
        ({"mdh": MDH, "limits": np.tile([-1.0, 1.0], (5, 1))}, "6 pairs lower < upper"),
        ({"mdh": MDH, "joint_map": np.zeros((6, 6))}, ""),
        ({"mdh": MDH, "joint_map": np.eye(5)}, ""),
    ],
)
def test_a_robot_that_is_none(arguments: dict[str, Any], said: str) -> None:
    with pytest.raises(ro.InputError) as error:
        ro.robot.Robot("arm", **arguments)
    assert said in str(error.value)


def test_limits_of_some_joints_cannot_be_written(tmp_path: Path) -> None:
    limits = np.tile([-2.0, 2.0], (6, 1))
    limits[3] = -np.inf, 2.0
    with pytest.raises(ro.InputError, match="finite numbers, or no limits"):
        write_robot(ro.robot.Robot("half", MDH, limits=limits), tmp_path / "robot.toml")
    assert not (tmp_path / "robot.toml").exists()


def test_a_ratio_is_expected_to_show_as_much_as_other_families() -> None:
    """Over half a turn: 0.1 mrad or whatever is expected at the largest deflection."""
    assert family_scales(ARM, ["ratio2"]) == pytest.approx([EXPECTED / np.pi])


def test_a_table_of_some_angles_of_a_frame_is_added_up() -> None:
    """Those of a whole frame are composed as rotations, and a part of them as the numbers they are."""
    whole = ro.load("position").problem.parameters
    part = whole.identify(["base_rx", "base_ry"]).free
    x = np.array([0.1, 0.2])
    assert part.values(x) == pytest.approx(part.nominal + x, abs=1e-15)
    full = whole.identify(["base_r?"]).free
    turned = full.values(np.array([0.1, 0.2, 0.3]))
    assert not np.allclose(turned, np.add(full.nominal, [0.1, 0.2, 0.3]), atol=1e-3)


def test_tolerances_are_shown_where_there_are_some() -> None:
    parameters = ro.load("position").problem.parameters
    rows = parameters.toleranced({"length_mm": 0.5}).free._frame_rows()
    stated = {row["parameter"]: row.get("tolerance") for row in rows}
    assert stated["d5"] == pytest.approx(0.5)
    assert stated["alpha4"] is None


# --- chains --------------------------------------------------------------------------------------------------------


def chain(seed: int) -> Chain:
    """Any serial chain, with axes in all directions."""
    rng = np.random.default_rng(seed)
    origins = [numeric_link(*rng.uniform(-1, 1, 5)) for _ in range(4)]
    axes = rng.normal(size=(4, 3))
    return Chain(np.array(origins), axes / np.linalg.norm(axes, axis=1)[:, None], numeric_link(*rng.uniform(-1, 1, 5)))


def tip(of: Chain, q: np.ndarray) -> np.ndarray:
    """Where the tip is, joint by joint."""
    T = np.eye(4)
    for origin, axis, angle in zip(of.origins, of.axes, q, strict=True):
        K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        turn = np.eye(4)
        turn[:3, :3] += np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
        T = T @ origin @ turn
    return T @ of.tail


@pytest.mark.parametrize("seed", range(4))
def test_any_chain_is_a_table_and_the_table_with_other_numbers_is_the_chain_moved(seed: int) -> None:
    of = chain(seed)
    table, base, tool, G = describe(of)
    robot = ro.robot.Robot("any", table)
    q = np.random.default_rng(seed).uniform(-2, 2, (5, 4))
    expected = np.array([tip(of, each) for each in q])
    assert base @ forward_kinematics(robot, q) @ tool == pytest.approx(expected, abs=1e-12)
    rng = np.random.default_rng([seed, 1])
    moved = table + 0.01 * rng.normal(size=table.shape)
    origins, tail = corrected(G, moved, base, tool)
    other = Chain(np.array(origins), of.axes, tail)
    there = base @ forward_kinematics(ro.robot.Robot("moved", moved), q) @ tool
    assert there == pytest.approx(np.array([tip(other, each) for each in q]), abs=1e-12)


@pytest.mark.parametrize("seed", range(2))
def test_a_table_near_another_one_has_its_turns(seed: int) -> None:
    """Angles of whichever turn, and offsets of parallel axes, are those of the table that is wanted."""
    robot = ro.robot.Robot("six", MDH)
    origins = [numeric_link(*row[:4]) for row in MDH]
    near = MDH.copy()
    near[:, 2] += TURNS * seed
    table, base, tool, _ = describe(Chain.about_z(origins, np.eye(4)), near)
    assert table[:, 2] == pytest.approx(near[:, 2], abs=1e-9)
    q = np.random.default_rng(seed).uniform(-2, 2, (5, 6))
    assert base @ forward_kinematics(ro.robot.Robot("same", table), q) @ tool == pytest.approx(
        forward_kinematics(robot, q), abs=1e-12
    )


def test_two_frames_are_one_place_within_a_centimetre_and_a_tenth_of_a_radian() -> None:
    here = np.array([0.3, -0.2, 0.5, 0.4, -0.3, 1.0])
    for change, same in (
        ([0.009, 0, 0, 0, 0, 0], True),
        ([0.011, 0, 0, 0, 0, 0], False),
        ([0, 0, 0, 0, 0, 0.09], True),
        ([0, 0, 0, 0, 0, 0.11], False),
        ([0.011, 0, 0, 0, 0, 0.11], False),
    ):
        assert same_place(here, here + change) == same


def test_an_arm_of_another_file_is_refused() -> None:
    types = ("revolute",) * 6
    require_same_arm(ARM, np.add(MDH, [0, 0, 2 * np.pi, 0.05, 0]), types, Path("arm.urdf"))  # a turn is none
    with pytest.raises(ro.InputError, match=r"d1 off by 0\.2 m or rad"):
        require_same_arm(ARM, MDH + [[0, 0, 0, 0.2 * (i == 0), 0] for i in range(6)], types, Path("arm.urdf"))
    with pytest.raises(ro.InputError, match=r"alpha3 off by 0\.3 m or rad"):
        require_same_arm(ARM, MDH + [[0.3 * (i == 2), 0, 0, 0, 0] for i in range(6)], types, Path("arm.urdf"))
    with pytest.raises(ro.InputError, match="those of the file, revolute"):
        require_same_arm(ARM, MDH[:5], types[:5], Path("arm.urdf"))
    backwards = ro.robot.Robot("back", MDH, joint_map=np.diag([1.0, -1, 1, 1, 1, 1]))
    with pytest.raises(ro.InputError, match="with signs or couplings"):
        require_same_arm(backwards, MDH, types, Path("arm.urdf"))


def test_a_line_names_four_parameters_and_says_that_there_are_more() -> None:
    free = ro.load("position").problem.parameters.free
    names = ", ".join(free.names[:4])
    assert f"{names}, ..." in free._short()
    four = ro.load("position").problem.parameters.identify(list(free.names[:4])).free
    assert names in four._short()
    assert "..." not in four._short()
