"""Robots that are none, and tables of parameters of which only a part is there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.robot import extension_scales, write_robot
from rpim_opt.robot.extensions import EXPECTED
from tests.simulate import ARM

MDH = ARM.mdh


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"mdh": MDH[:, :4]}, "shape (6, 4), accepted: finite numbers of shape (dof, 5); beta may be 0"),
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


def test_a_ratio_is_expected_to_show_as_much_as_other_extensions() -> None:
    """Over half a turn: 0.1 mrad or whatever is expected at the largest deflection."""
    assert extension_scales(ARM, ["ratio2"]) == pytest.approx([EXPECTED / np.pi])


def test_a_table_of_some_angles_of_a_frame_is_added_up() -> None:
    """Those of a whole frame are composed as rotations, and a part of them as the numbers they are."""
    whole = ro.load("position").problem.parameters
    part = whole.identify(["base_rx", "base_ry"]).free
    x = np.array([0.1, 0.2])
    assert part.values(x) == pytest.approx(part.nominal + x, abs=1e-15)
    full = whole.identify(["base_r?"]).free
    turned = full.values(np.array([0.1, 0.2, 0.3]))
    assert not np.allclose(turned, np.add(full.nominal, [0.1, 0.2, 0.3]), atol=1e-3)


def test_a_line_names_four_parameters_and_says_that_there_are_more() -> None:
    free = ro.load("position").problem.parameters.free
    names = ", ".join(free.names[:4])
    assert f"{names}, ..." in free._short()
    four = ro.load("position").problem.parameters.identify(list(free.names[:4])).free
    assert names in four._short()
    assert "..." not in four._short()
