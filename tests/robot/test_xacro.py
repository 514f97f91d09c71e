"""Xacro files: the robot that they expand to, and who may name one."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.robot.library import find_robot

URDF = """<robot name="two">
<link name="base"/><link name="arm"/><link name="hand"/>
<joint name="j1" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.25"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2"/></joint>
<joint name="j2" type="revolute"><parent link="arm"/><child link="hand"/><origin xyz="0.5 0 0"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1"/></joint>
</robot>"""
PARTS = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:property name="reach" value="0.5"/>
<xacro:macro name="turning" params="name parent child xyz axis most">
<joint name="${name}" type="revolute"><parent link="${parent}"/><child link="${child}"/><origin xyz="${xyz}"/>
<axis xyz="${axis}"/><limit lower="${-most}" upper="${most}"/></joint>
</xacro:macro>
</robot>"""
XACRO = """<?xml version="1.0"?>
<robot name="two" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:include filename="parts.xacro"/>
<xacro:arg name="height" default="0.25"/>
<link name="base"/><link name="arm"/><link name="hand"/>
<xacro:turning name="j1" parent="base" child="arm" xyz="0 0 $(arg height)" axis="0 0 1" most="2"/>
<xacro:turning name="j2" parent="arm" child="hand" xyz="${reach} 0 0" axis="0 1 0" most="${1.0}"/>
</robot>"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "parts.xacro").write_text(PARTS)
    (tmp_path / "arm.urdf").write_text(URDF)
    path = tmp_path / "arm.urdf.xacro"
    path.write_text(XACRO)
    return path


def test_it_is_the_robot_that_it_expands_to(file: Path) -> None:
    expanded = ro.read_urdf(file)
    plain = ro.read_urdf(file.with_name("arm.urdf"))
    assert expanded.names == plain.names == ("j1", "j2")
    np.testing.assert_array_equal(expanded.robot.mdh, plain.robot.mdh)
    np.testing.assert_array_equal(expanded.robot.limits, plain.robot.limits)
    np.testing.assert_array_equal(expanded.base, plain.base)


def test_corrected_origins_go_into_what_it_expands_to(file: Path) -> None:
    robot = ro.read_urdf(file).robot
    table = robot.mdh.copy()
    table[1, 1] += 0.001
    target = file.with_name("corrected.urdf")
    ro.robot.write_urdf(file, replace(robot, mdh=table), target)
    np.testing.assert_allclose(ro.read_urdf(target).robot.mdh, table, atol=1e-12)
    assert b"xacro:" not in target.read_bytes()
    with pytest.raises(ro.InputError, match="what it expands to"):
        ro.robot.write_urdf(file, robot, file)
    assert file.read_text() == XACRO


def test_a_new_folder_has_its_table(file: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rows = [",".join(map(repr, row)) for row in rng.uniform(-1, 1, (12, 5)).tolist()]
    data = tmp_path / "measured.csv"
    data.write_text("\n".join(["q1_rad,q2_rad,x_m,y_m,z_m", *rows]))
    made = ro.store.new_problem(tmp_path / "cell", str(file), data)
    assert sorted(p.name for p in made.folder.iterdir()) == ["identification.csv", "problem.toml", "robot.toml"]
    np.testing.assert_array_equal(ro.load(made.folder).problem.robot.mdh, ro.read_urdf(file).robot.mdh)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (XACRO.replace("parts.xacro", "nowhere.xacro"), "nowhere.xacro"),
        (XACRO.replace("${reach}", "${far}"), "far"),
        (XACRO.replace('<xacro:arg name="height" default="0.25"/>', ""), "height"),
        (XACRO.replace("parts.xacro", "$(find nowhere_description)/parts.xacro"), "nowhere_description|ament"),
        (XACRO.replace("</robot>", ""), "no element found"),
        (XACRO.replace("${reach} 0 0", "${reach} 0"), "joint 'j2', origin xyz"),
    ],
)
def test_what_does_not_expand_is_said_in_a_sentence(file: Path, content: str, said: str) -> None:
    file.write_text(content)
    with pytest.raises(ro.InputError, match=said) as error:
        ro.read_urdf(file)
    assert "\n" not in str(error.value)
    assert file.name in str(error.value)


def test_without_its_package_the_sentence_says_what_to_install(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xacro", None)
    with pytest.raises(ro.InputError, match=r"rpim-opt\[xacro\]"):
        ro.read_urdf(file)


def test_a_problem_folder_may_name_none(file: Path) -> None:
    """A folder may be somebody else's, and a xacro file is carried out."""
    with pytest.raises(ro.InputError, match="may be named by commands and scripts only"):
        find_robot(file.name, file.parent)
