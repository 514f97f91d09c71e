"""Torques of gravity against potential energy, what first moments span, mountings, and files that state them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.robot import moment_slopes
from rpim_opt.robot.extensions import _draws
from rpim_opt.robot.kinematics import numeric_frame
from tests.robot.test_exchange import urdf_kinematics
from tests.simulate import ARM

G = 9.80665
"""Standard acceleration of free fall [m/s^2]."""
TYPES = ("revolute", "revolute", "prismatic", "revolute", "revolute")


def random_robot(seed: int, types: tuple[str, ...] = TYPES) -> ro.robot.Robot:
    """A robot with tilted axes, couplings, and masses and a payload anywhere, under gravity from anywhere."""
    rng = np.random.default_rng(seed)
    n = len(types)
    gravity = ro.robot.Gravity(
        direction=tuple(rng.normal(size=3)),
        masses=tuple(rng.uniform(1, 5, n)),
        centres=tuple(map(tuple, 0.2 * rng.normal(size=(n, 3)))),
        payload=2.0,
        payload_centre=tuple(0.1 * rng.normal(size=3)),
    )
    return ro.robot.Robot(
        "random", rng.normal(size=(n, 5)), types, joint_map=np.eye(n) + 0.2 * rng.normal(size=(n, n)), gravity=gravity
    )


def frames(robot: ro.robot.Robot, model: np.ndarray) -> np.ndarray:
    """The transforms (dof, N, 4, 4) after every joint, from the joint values of the model."""
    found = []
    for k in range(1, robot.dof + 1):
        part = ro.robot.Robot("part", robot.mdh[:k], robot.joint_types[:k])
        found.append(ro.robot.forward_kinematics(part, model[:, :k]))
    return np.array(found)


def energy(robot: ro.robot.Robot, model: np.ndarray, payload: float | None = None) -> np.ndarray:
    """The potential energy (N,) [J] at joint values of the model."""
    gravity = robot.gravity
    T = frames(robot, model)
    if payload is None:
        payload = gravity.payload
    if gravity.masses:
        loads = list(zip(T, gravity.centres, gravity.masses, strict=True))
    else:
        loads = [(T[-1], (0, 0, 0), 5.0), (T[3], (0, 0, 0), 10.0)]
    loads.append((T[-1], gravity.payload_centre, payload))
    places = [(T[:, :3, :3] @ np.array(centre) + T[:, :3, 3], mass) for T, centre, mass in loads]
    return -G * sum(mass * place @ np.array(gravity.direction) for place, mass in places)


@pytest.mark.parametrize("seed", range(4))
def test_torques_are_minus_the_slope_of_the_potential_energy(seed: int) -> None:
    robot = random_robot(seed)
    q = np.random.default_rng(seed).uniform(-2, 2, (6, robot.dof))
    model = q @ robot.joint_map.T
    h = 1e-6
    for payload in (None, 0.7):
        slope = np.empty(q.shape)
        for i, step in enumerate(h * np.eye(robot.dof)):
            slope[:, i] = (energy(robot, model + step, payload) - energy(robot, model - step, payload)) / (2 * h)
        slope[:, 2] = 0.0  # a prismatic joint has a force and no torque
        loaded = robot if payload is None else replace(robot, gravity=robot.gravity.carrying(payload))
        torques = ro.robot.gravity_torques(loaded, q)
        # 20 kg at some metres: 1000 J, of which a difference over 2e-6 keeps 1e-7
        assert np.abs(torques + slope).max() < 1e-6
        assert np.abs(torques).max() > 1


def test_an_arm_that_states_no_masses_has_five_kilograms_at_the_wrist_and_ten_at_frame_4() -> None:
    q = np.random.default_rng(0).uniform(-2, 2, (5, 6))
    h = 1e-6
    torques = ro.robot.gravity_torques(ARM, q)
    for i, step in enumerate(h * np.eye(6)):
        slope = (energy(ARM, q + step) - energy(ARM, q - step)) / (2 * h)
        assert np.abs(torques[:, i] + slope).max() < 1e-6
    short = ro.robot.Robot("two links", np.array([[np.pi / 2, 0, 0, 0, 0], [0, 0.4, 0, 0, 0]]))
    # both at the last frame, 0.4 m out
    assert ro.robot.gravity_torques(short, np.zeros((1, 2)))[0] == pytest.approx([-15 * G * 0.4, 0])


@pytest.mark.parametrize("seed", range(4))
def test_the_bends_of_a_table_say_all_that_masses_of_links_can_do(seed: int) -> None:
    # behind a prismatic joint moments grow with its value, too
    robot = random_robot(seed, ("revolute",) * 5)
    q = np.random.default_rng(9).uniform(-2, 2, (200, robot.dof))
    torques = ro.robot.gravity_torques(robot, q)
    slopes = ro.robot.moment_slopes(robot, q)
    for i in range(robot.dof):
        names = [name for name in ro.robot.moment_names(robot) if name.startswith(f"moment{i + 1}_")]
        places = [(int(name[:-1].split("_")[1]) - 1, "xyz".index(name[-1])) for name in names]
        # what a name was left out for: a constant, which the joint's offset says
        columns = np.column_stack([np.ones(len(q)), *(slopes[:, i, k, a] for k, a in places)])
        left = torques[:, i] - columns @ np.linalg.lstsq(columns, torques[:, i], rcond=None)[0]
        assert np.abs(left).max() < 1e-10 * np.abs(torques).max()


def test_the_bends_of_an_arm_do_not_hang_on_rounding() -> None:
    names = ro.robot.moment_names(ARM)
    assert len(names) == 30
    assert not [name for name in names if name.startswith("moment1_")]  # its axis is vertical
    rng = np.random.default_rng(0)
    for size in (1e-15, 1e-9, 1e-6, 1e-4):
        moved = replace(ARM, mdh=ARM.mdh + size * rng.normal(size=ARM.mdh.shape))
        assert ro.robot.moment_names(moved) == names
    assert ro.robot.moment_names(replace(ARM, mdh=ARM.mdh.round(4))) == names
    on_the_wall = replace(ARM, gravity=ARM.gravity.mounted("wall"))
    assert [name for name in ro.robot.moment_names(on_the_wall) if name.startswith("moment1_")]


@pytest.mark.parametrize("seed", range(3))
def test_kept_bends_are_neither_constant_nor_repeated_and_left_ones_are(seed: int) -> None:
    for robot in (ARM, random_robot(seed)):
        slopes = ro.robot.moment_slopes(robot, _draws(robot))
        kept = ro.robot.moment_names(robot)
        prismatic = [i for i, kind in enumerate(robot.joint_types) if kind == "prismatic"]
        assert not slopes[:, prismatic].any()
        for i in range(robot.dof):
            mine = [
                slopes[:, i, k, a]
                for k in range(robot.dof)
                for a in range(3)
                if f"moment{i + 1}_{k + 1}{'xyz'[a]}" in kept
            ]
            correlations = np.corrcoef(mine) - np.eye(len(mine)) if len(mine) > 1 else np.zeros((1, 1))
            assert np.abs(correlations).max() < 1 - 1e-5
            assert all(np.ptp(v) > 0.02 for v in mine)


def test_extensions_are_expected_to_bend_a_joint_by_a_tenth_of_a_milliradian() -> None:
    robot = replace(ARM, gravity=ARM.gravity.carrying(3.0, (0, 0, 0.1)))
    names = [name for of in ro.robot.model_extensions(robot).values() for name in of]
    scales = ro.robot.extension_scales(robot, names)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (300, 6))
    torques = ro.robot.gravity_torques(robot, q)
    slopes = ro.robot.moment_slopes(robot, q)
    for name, scale in zip(names, scales, strict=True):
        if name.startswith("compliance"):
            effect = torques[:, int(name[-1]) - 1]
        elif name.startswith("moment"):
            effect = slopes[:, int(name[6]) - 1, int(name[8]) - 1, "xyz".index(name[9])]
        else:
            effect = np.ones(1)
        assert scale * np.abs(effect).max() == pytest.approx(1e-4)
    assert ro.robot.extension_scales(ARM, ["compliance1"]) == [1e-5]  # a vertical axis has no torque to go by
    with pytest.raises(ro.InputError, match="term of a joint: found 'theta1'"):
        ro.robot.extension_scales(ARM, ["theta1"])


# --- where gravity points -------------------------------------------------------------------------------------------


def test_mountings_are_words_or_a_vector() -> None:
    gravity = ro.robot.Gravity()
    assert gravity.mounted("floor") == gravity == ro.robot.Gravity((0, 0, -9.81))
    assert gravity.mounted("ceiling").direction == (0.0, 0.0, 1.0)
    assert gravity.mounted("wall").direction == (-1.0, 0.0, 0.0)
    assert gravity.mounted([0, 3, 4]).direction == pytest.approx((0.0, 0.6, 0.8))
    q = np.random.default_rng(0).uniform(-2, 2, (5, 6))
    floor, ceiling = (
        ro.robot.gravity_torques(replace(ARM, gravity=gravity.mounted(m)), q) for m in ("floor", "ceiling")
    )
    assert np.array_equal(floor, -ceiling)
    # turned about its first axis an arm on the floor or the ceiling weighs the same, one on the wall does not
    turned = q + np.eye(6)[0]
    assert np.abs(ro.robot.gravity_torques(ARM, turned) - floor).max() < 1e-12
    wall = replace(ARM, gravity=gravity.mounted("wall"))
    assert np.abs(ro.robot.gravity_torques(wall, turned) - ro.robot.gravity_torques(wall, q)).max() > 1
    # stretched upwards, along x: nothing pulls at the first joint
    up = ro.robot.Robot("boom", np.array([[0, 0, 0, 0, 0], [0, 1.0, 0, 0, 0]]), gravity=gravity.mounted("wall"))
    sideways = ro.robot.gravity_torques(up, np.array([[0.0, 0.0], [np.pi / 2, 0.0], [0.1, 0.0]]))[:, 0]
    assert sideways[:2] == pytest.approx([0.0, 15 * G])
    assert sideways[2] > 0  # and it falls further the way it leans


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"direction": (0, 0, 0)}, "direction of gravity: found"),
        ({"direction": (0, np.nan, 1)}, "finite numbers of shape"),
        ({"direction": ("a", 0, 0)}, "finite numbers of shape"),
        ({"payload": -1.0}, "payload: found -1.0"),
        ({"masses": (1.0,)}, "one centre per mass"),
        ({"masses": (np.inf,), "centres": ((0, 0, 0),)}, "mass of a link: found inf"),
        ({"payload_centre": (0, 0)}, "centre of the payload"),
    ],
)
def test_what_is_no_gravity_is_refused(wrong: dict, match: str) -> None:
    with pytest.raises(ro.InputError, match=match):
        ro.robot.Gravity(**wrong)
    with pytest.raises(ro.InputError, match="found 'roof', accepted"):
        ro.robot.Gravity().mounted("roof")
    with pytest.raises(ro.InputError, match="2 masses, accepted: 6, one per joint"):
        replace(ARM, gravity=ro.robot.Gravity(masses=(1.0, 1.0), centres=((0, 0, 0),) * 2))


# --- files ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", ["toml", "json"])
@pytest.mark.parametrize("mounting", ["floor", "ceiling", [0.3, -0.1, 0.9]])
def test_a_robots_gravity_comes_back_from_its_file(tmp_path: Path, ending: str, mounting: str | list[float]) -> None:
    path = tmp_path / f"arm.{ending}"
    robot = random_robot(3)
    robot = replace(robot, gravity=robot.gravity.mounted(mounting))
    ro.robot.write_robot(robot, path)
    assert ro.read_robot(path).gravity == robot.gravity
    ro.robot.write_robot(ARM, path)
    assert ro.read_robot(path).gravity == ro.robot.Gravity()
    assert "mounting" not in path.read_text()


def test_a_table_of_joints_has_masses_and_no_place_for_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "arm.csv"
    masses = ro.robot.Gravity(masses=(1.0, 0, 2.0, 0, 0, 0.25), centres=((0.01, 0, 0.1), *[(0.0, 0.0, 0.0)] * 5))
    ro.robot.write_robot(replace(ARM, gravity=masses), path)
    assert ro.read_robot(path).gravity == masses
    for other, match in ((masses.mounted("wall"), "mounting"), (masses.carrying(1.0), "a payload")):
        with pytest.raises(ro.InputError, match=match):
            ro.robot.write_robot(replace(ARM, gravity=other), path)


def test_a_robots_file_with_a_wrong_mounting_or_mass_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    joint = "[[joint]]\nalpha_deg = 90\n"
    cases = {
        f'name = "a"\nmounting = "roof"\n{joint}': "key mounting: found 'roof'",
        f'name = "a"\nmounting = [0, 0]\n{joint}': "key mounting",
        f'name = "a"\n{joint}mass_kg = -1\n': "mass of a link: found -1",
        f'name = "a"\n[payload]\nmass_kg = -2\n{joint}': "key payload: found -2",
        f'name = "a"\n[payload]\nx_mm = 3\n{joint}': "mass",
    }
    for text, match in cases.items():
        path.write_text(text)
        with pytest.raises(ro.InputError, match=match):
            ro.read_robot(path)


URDF = """<robot name="arm"><link name="world"/>
<joint name="stand" type="fixed"><parent link="world"/><child link="base"/>
  <origin xyz="0 0 0.5" rpy="0.2 0 0.3"/></joint>
<link name="base"><inertial><mass value="50"/></inertial></link>
<joint name="j1" type="revolute"><parent link="base"/><child link="l1"/><origin xyz="0 0 0.3" rpy="{rpy1}"/>
  <axis xyz="0 0 {sign}"/></joint>
<link name="l1"><inertial><origin xyz="0.01 0.02 0.1" rpy="1 2 3"/><mass value="4"/></inertial></link>
<joint name="j2" type="revolute"><parent link="l1"/><child link="l2"/><origin xyz="0.1 {up}" rpy="{rpy2}"/>
  <axis xyz="0.1 1 0"/></joint>
<link name="l2"><inertial><origin xyz="0.2 0 0.03"/><mass value="3"/></inertial></link>
<joint name="f2" type="fixed"><parent link="l2"/><child link="cover"/><origin xyz="0.2 0.1 0" rpy="0 0.5 0"/></joint>
<link name="cover"><inertial><origin xyz="0 0.05 0"/><mass value="1"/></inertial></link>
<joint name="j3" type="revolute"><parent link="cover"/><child link="l3"/><origin xyz="0.3 0 0" rpy="0 0.1 0"/>
  <axis xyz="0.1 1 0.02"/></joint>
<link name="l3"><inertial><origin xyz="0.1 0 0"/><mass value="2"/></inertial></link>
<joint name="f3" type="fixed"><parent link="l3"/><child link="tip"/><origin xyz="0.1 0 0" rpy="0 1 0"/></joint>
<link name="tip"/>
<joint name="finger" type="prismatic"><parent link="tip"/><child link="f"/><origin xyz="0 0.04 0.1"/><axis xyz="0 1 0"/>
</joint><link name="f"><inertial><origin xyz="0 0 0.02"/><mass value="0.5"/></inertial></link>
<joint name="grip" type="fixed"><parent link="f"/><child link="pad"/><origin xyz="0.02 0 0.05" rpy="1 0 0.4"/></joint>
<link name="pad"><inertial><origin xyz="0.01 0.03 0"/><mass value="0.25"/></inertial></link></robot>"""
DRAWN = {"rpy1": "0 0 0", "sign": "1", "up": "0.05 0.2", "rpy2": "0 0 0"}
"""The same arm with its first joint's frame, and its axis, upside down: 'rpy1' half a turn about x."""
UPSIDE_DOWN = {"rpy1": f"{np.pi!r} 0 0", "sign": "1", "up": "-0.05 -0.2", "rpy2": f"{np.pi!r} 0 0"}
TILTED = DRAWN | {"rpy1": "0.4 0.3 0.2"}
BODIES = {
    "l1": (4.0, (0.01, 0.02, 0.1)),
    "l2": (3.0, (0.2, 0, 0.03)),
    "cover": (1.0, (0, 0.05, 0)),
    "l3": (2.0, (0.1, 0, 0)),
}
GRIPPER = {"f": (0.5, (0, 0, 0.02)), "pad": (0.25, (0.01, 0.03, 0))}


@pytest.mark.parametrize("drawn", [DRAWN, UPSIDE_DOWN, TILTED])
def test_the_masses_of_a_urdf_are_where_the_file_has_them(tmp_path: Path, drawn: dict[str, str]) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(URDF.format(**drawn))
    arm = ro.read_urdf(path, base="base", tip="tip")
    assert arm.robot.gravity.masses == pytest.approx((4.0, 4.0, 2.75))
    assert arm.robot.mdh[:2, 4].any()  # Hayati's beta is there to be minded
    q = np.random.default_rng(0).uniform(-2, 2, (5, 3))

    def potential(q: np.ndarray) -> np.ndarray:
        world = np.linalg.inv(urdf_kinematics(path, "base", q[:, :0]))
        places = [
            (mass, (world @ urdf_kinematics(path, link, q))[:, :3] @ np.array([*centre, 1.0]))
            for link, (mass, centre) in {**BODIES, **GRIPPER}.items()
        ]
        return G * sum(mass * place[:, 2] for mass, place in places)

    h = 1e-6
    torques = ro.robot.gravity_torques(arm.robot, q)
    for i, step in enumerate(h * np.eye(3)):
        column = np.zeros((5, 4))  # a finger at zero
        column[:, :3] = q
        wide = np.append(step, 0.0)
        slope = (potential(column + wide) - potential(column - wide)) / (2 * h)
        assert np.abs(torques[:, i] + slope).max() < 1e-6


def test_a_urdf_whose_first_axis_points_down_weighs_the_same(tmp_path: Path) -> None:
    q = np.random.default_rng(0).uniform(-2, 2, (5, 3))
    path = tmp_path / "arm.urdf"
    found = []
    for drawn in (DRAWN, UPSIDE_DOWN):
        path.write_text(URDF.format(**drawn))
        arm = ro.read_urdf(path, base="base", tip="tip")
        found.append((numeric_frame(arm.base)[2, 2], arm.robot.gravity.direction, arm))
    assert [z for z, _, _ in found] == pytest.approx([1, -1])
    assert found[0][1] == (0, 0, -1)
    assert found[1][1] == pytest.approx((0, 0, 1))
    first, second = (
        ro.robot.gravity_torques(arm.robot, q * [s, 1, 1]) for s, (_, _, arm) in zip((1, -1), found, strict=True)
    )
    assert np.abs(first[:, 1:]).max() > 10
    assert np.abs(first - second)[:, 1:].max() < 1e-9


def test_a_urdf_without_masses_leaves_the_guess_and_a_wrong_mass_is_named(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    text = URDF.format(**DRAWN)
    path.write_text(text.replace("<mass ", "<mess "))
    assert ro.read_urdf(path, base="base", tip="tip").robot.gravity.masses == ()
    for wrong in ('value="three"', 'value="-3"', 'value="nan"'):
        path.write_text(text.replace('value="3"', wrong))
        with pytest.raises(ro.InputError, match="link 'l2', inertial"):
            ro.read_urdf(path, base="base", tip="tip")
    path.write_text(text.replace('value="0.5"', 'value="?"'))  # of a finger, beside the chain
    assert ro.read_urdf(path, base="base", tip="tip").robot.gravity.masses == pytest.approx((4.0, 4.0, 2.25))


@pytest.mark.parametrize("link", [1, 2, 3, 4])
def test_slopes_by_first_moments_are_differences_of_torques(link: int) -> None:
    """Of a link's mass that is moved along an axis of its frame; nothing before it feels it, nothing that slides."""
    types = ("revolute", "revolute", "prismatic", "revolute")
    mdh = np.random.default_rng(3).uniform(-1, 1, (4, 5))
    q = np.random.default_rng(4).uniform(-1, 1, (6, 4))
    tilted = (0.6, 0.0, -0.8)
    masses = tuple(2.0 * (k == link) for k in range(1, 5))
    slopes = moment_slopes(ro.robot.Robot("arm", mdh, types, gravity=ro.robot.Gravity(tilted)), q)
    assert not slopes[:, link:, link - 1].any()
    assert not slopes[:, 2].any()

    def torques(centre: np.ndarray) -> np.ndarray:
        centres = tuple(tuple((centre * (k == link)).tolist()) for k in range(1, 5))
        gravity = ro.robot.Gravity(tilted, masses, centres)
        return ro.robot.gravity_torques(ro.robot.Robot("arm", mdh, types, gravity=gravity), q)

    for axis in range(3):
        moved = torques(np.eye(3)[axis]) - torques(np.zeros(3))
        assert moved == pytest.approx(G * 2.0 * slopes[:, :, link - 1, axis], abs=1e-12)
