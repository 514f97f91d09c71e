"""Robot descriptions in and out: the same forward kinematics, and every other byte as it was."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.basics.files import LARGEST_TEXT
from rpim_opt.robot.kinematics import numeric_frame, roll_pitch_yaw
from rpim_opt.robot.library import find_robot, read_arm
from tests.simulate import ARM, simulated

EXACT = 1e-11
"""m and rad. Rounding is 1e-15 a joint; distances of axes below 1e-11 m count as zero."""
ROUNDING = 1e-13
"""Of a URDF there and back, arms of up to 13 m, where the last digit is 2e-15."""

LINK = """  <link name="{name}">
    <!-- as drawn, <origin> of the mesh -->
    <visual><origin xyz='0 0 0.1' rpy="0 0 0"/><geometry><mesh filename="package://arm/meshes/{name}.dae"/></geometry></visual>
  </link>
"""
JOINT = """  <joint type="{kind}" name="{name}">
    <parent link="{parent}"/> <child link="{child}"/>
    <origin rpy="{rpy}"  xyz='{xyz}'/><!-- measured > drawn -->
    {rest}
  </joint>
"""
EXTRA = """  <transmission name="t1">
    <joint name="J1"><hardwareInterface>Position</hardwareInterface></joint>
  </transmission>
  <gazebo reference="L1"><xacro:kept note="of another tool, 1 > 0"/></gazebo>
  <link name="camera"/>
  <joint name="camera_mount" type="floating"><parent link="base"/><child link="camera"/></joint>
</robot>
"""


def text(values: np.ndarray) -> str:
    return " ".join(repr(float(v)) for v in values)


def random_urdf(seed: int, style: str) -> str:
    """Return an arm of one to seven joints, each with fixed joints around it, and what real files hold besides."""
    rng = np.random.default_rng(seed)
    parts = ['<?xml version="1.0"?>\n<robot name="arm &amp; co" xmlns:xacro="http://www.ros.org/wiki/xacro">\n']
    parts.append(LINK.format(name="base"))
    parent = "base"

    def add(kind: str, name: str, child: str, xyz: np.ndarray, rpy: np.ndarray, rest: str = "") -> None:
        nonlocal parent
        parts.append(LINK.format(name=child))
        parts.append(
            JOINT.format(kind=kind, name=name, parent=parent, child=child, xyz=text(xyz), rpy=text(rpy), rest=rest)
        )
        parent = child

    for i in range(1, int(rng.integers(1, 7)) + 2):
        kind = str(rng.choice(["revolute", "continuous", "prismatic"], p=[0.6, 0.2, 0.2]))
        xyz, rpy, axis = rng.normal(size=3), rng.uniform(-3, 3, 3), rng.normal(size=3)
        if style == "square":  # right angles, as in drawings
            rpy = np.pi / 2 * rng.integers(-2, 3, 3)
            axis = np.eye(3)[rng.integers(3)] * rng.choice([-1, 1])
        elif style == "parallel":  # or nearly so, or one line, or nearly so
            tilt = rng.choice([0.0, 1e-9, 1e-6, 1e-3, 0.05], 2) + rng.choice([0, np.pi], 2) * [1, 0]
            xyz, rpy, axis = xyz * rng.choice([0, 1e-6, 1]), np.append(tilt, rng.uniform(-3, 3)), np.array([0, 0, 1.0])
        if rng.random() < 0.3:
            add("fixed", f"F{i}", f"flange{i}", rng.normal(size=3) * (style != "parallel"), np.zeros(3))
        limits = '<limit lower="-2" upper="1.5" effort="1" velocity="1"/>' if kind != "continuous" else ""
        add(kind, f"J{i}", f"L{i}", xyz, rpy, f'<axis xyz="{text(axis)}"/>{limits}<dynamics damping="0.5"/>')
    add("fixed", "to_hand", "hand", rng.normal(size=3), rng.uniform(-3, 3, 3))
    if rng.random() < 0.5:
        add("fixed", "to_palm", "palm", rng.normal(size=3), rng.uniform(-3, 3, 3))
    return "".join(parts).replace(f'"{parent}"', '"tip"') + EXTRA


def joints_above(path: Path, link: str) -> list[ElementTree.Element]:
    """Return the joint elements from the root to a link."""
    joints = {j.find("child").get("link"): j for j in ElementTree.parse(path).getroot().findall("joint")}
    chain = []
    while link in joints:
        chain.insert(0, joints[link])
        link = joints[link].find("parent").get("link")
    return chain


def urdf_kinematics(path: Path, tip: str, q: np.ndarray) -> np.ndarray:
    """Return the transforms (N, 4, 4) from the root to a link, straight from the elements."""
    chain = joints_above(path, tip)
    result = np.tile(np.eye(4), (len(q), 1, 1))
    column = 0
    for joint in chain:
        origin = joint.find("origin")
        place = {} if origin is None else origin.attrib
        xyz, rpy = (np.array(place.get(key, "0 0 0").split(), dtype=float) for key in ("xyz", "rpy"))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), xyz
        result = result @ T
        if joint.get("type") == "fixed":
            continue
        axis = np.array(joint.find("axis").get("xyz").split() if joint.find("axis") is not None else [1, 0, 0], float)
        motion, along = np.tile(np.eye(4), (len(q), 1, 1)), q[:, column, None] * axis / np.linalg.norm(axis)
        if joint.get("type") == "prismatic":
            motion[:, :3, 3] = along
        else:
            motion[:, :3, :3] = Rotation.from_rotvec(along).as_matrix()
        result, column = result @ motion, column + 1
    return result


def reach(arm: ro.robot.RobotSetup, q: np.ndarray) -> np.ndarray:
    """Return the transforms (N, 4, 4) of the tip."""
    return numeric_frame(arm.base) @ ro.robot.forward_kinematics(arm.robot, q) @ numeric_frame(arm.tool)


def configurations(dof: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-3, 3, (8, dof))


CASES = [(style, seed) for style in ("askew", "square", "parallel") for seed in range(12)]


@pytest.mark.parametrize(("style", "seed"), CASES)
def test_a_urdf_reads_as_a_robot_with_the_same_kinematics(tmp_path: Path, style: str, seed: int) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(random_urdf(seed, style))
    arm = ro.read_urdf(path, tip="tip")
    q = configurations(arm.robot.dof)
    assert np.abs(reach(arm, q) - urdf_kinematics(path, "tip", q)).max() < ROUNDING
    assert np.abs(arm.robot.mdh[:, [1, 3]]).max() < 60  # a few metres a joint, and never a far common normal
    assert arm.names == tuple(f"J{i + 1}" for i in range(arm.robot.dof))
    limited = [f'type="continuous" name="{name}"' not in path.read_text() for name in arm.names]
    assert arm.robot.limits.tolist() == [[-2, 1.5] if known else [-np.inf, np.inf] for known in limited]
    assert (arm.robot.name, arm.robot.source) == ("arm & co", "arm.urdf, base to tip")


@pytest.mark.parametrize(("style", "seed"), CASES)
def test_identified_parameters_written_to_a_urdf_move_it_the_same(tmp_path: Path, style: str, seed: int) -> None:
    path, target = tmp_path / "arm.urdf", tmp_path / "new" / "arm.urdf"
    path.write_text(random_urdf(seed, style))
    arm = ro.read_urdf(path, tip="tip")
    rng = np.random.default_rng(seed)
    mdh = arm.robot.mdh + 0.01 * rng.normal(size=arm.robot.mdh.shape)
    base, tool = arm.base + 0.01 * rng.normal(size=6), arm.tool + 0.01 * rng.normal(size=6)
    better = ro.robot.RobotSetup(replace(arm.robot, mdh=mdh), base, tool)
    ro.robot.write_urdf(path, better.robot, target, tip="tip", base_frame=base, tool_frame=tool)
    q = configurations(arm.robot.dof)
    assert np.abs(reach(better, q) - urdf_kinematics(target, "tip", q)).max() < ROUNDING
    origins = re.compile(r"(?<=rpy=\")[^\"]*(?=\"  xyz)|(?<=xyz=')[^']*(?='/><!-- m)")
    assert origins.sub("", path.read_text()) == origins.sub("", target.read_text())
    assert path.read_text() != target.read_text()


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_a_robot_that_did_not_change_leaves_every_byte(tmp_path: Path, ending: str) -> None:
    path, target = tmp_path / "arm.urdf", tmp_path / "same.urdf"
    latin = (
        random_urdf(3, "square").replace("<?xml version", "<?xml version").replace("as drawn", "wie größer gezeichnet")
    )
    path.write_bytes(latin.replace("\n", ending).encode())
    ro.robot.write_urdf(path, ro.read_urdf(path, tip="tip").robot, target, tip="tip")
    assert target.read_bytes() == path.read_bytes()


PLAIN = """<robot name="two">
<link name="base"/><link name="arm"/><link name="hand"/>
<joint name="j1" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 2"/></joint>
<joint name="j2" type="continuous"><parent link="arm"/><child link="hand"/>
<origin xyz="0.5 0 0"/><limit lower="-1" upper="1"/></joint>
</robot>"""


@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_origins_that_the_file_leaves_out_are_put_in(tmp_path: Path, mark: str) -> None:
    path, target = tmp_path / "arm.urdf", tmp_path / "new.urdf"
    path.write_text(mark + PLAIN.replace("arm", "\u00e4rm"))
    arm = ro.read_urdf(path)
    assert np.isinf(arm.robot.limits).all()  # no limit element, and a continuous joint
    mdh = arm.robot.mdh + np.random.default_rng(0).uniform(-0.1, 0.1, (2, 5)) * [[1, 1, 1, 1, 1], [1, 1, 1, 1, 0]]
    better = ro.robot.RobotSetup(replace(arm.robot, mdh=mdh), arm.base, arm.tool)
    ro.robot.write_urdf(path, better.robot, target)
    q = configurations(2)
    assert np.abs(reach(better, q) - urdf_kinematics(target, "hand", q)).max() < EXACT
    with pytest.raises(ro.InputError, match=r"a tool or beta2 that moves link 'hand'.*joint 'j2' cannot express it"):
        ro.robot.write_urdf(path, better.robot, target, tool_frame=np.array([0, 0, 1e-3, 0, 0, 0]))


def test_only_the_joint_that_is_wrong_changes(tmp_path: Path) -> None:
    """Every link keeps its frame: an error of joint 2's zero is in joint 2's origin alone."""
    path, target = tmp_path / "arm.urdf", tmp_path / "new.urdf"
    path.write_text(random_urdf(1, "square"))
    arm = ro.read_urdf(path, tip="tip")
    mdh = arm.robot.mdh.copy()
    mdh[1, 2] += 0.01
    ro.robot.write_urdf(path, replace(arm.robot, mdh=mdh), target, tip="tip")
    changed = [
        a for a, b in zip(path.read_text().split("<joint "), target.read_text().split("<joint "), strict=True) if a != b
    ]
    assert [re.search('name="(.*?)"', part)[1] for part in changed] == ["J2"]


def test_a_drawings_table_comes_back(tmp_path: Path) -> None:
    """A URDF written from a modified DH table, joint axes z, reads as that table."""
    joints, links = "", '<link name="l0"/>'
    for i, row in enumerate(ARM.mdh, start=1):
        T = ro.robot.forward_kinematics(ro.robot.Robot("one", row[None]), np.zeros((1, 1)))[0]
        rpy = roll_pitch_yaw(T[:3, :3])
        links += f'<link name="l{i}"/>'
        joints += f'<joint name="j{i}" type="revolute"><parent link="l{i - 1}"/><child link="l{i}"/>'
        joints += f'<origin xyz="{text(T[:3, 3])}" rpy="{text(rpy)}"/><axis xyz="0 0 1"/></joint>\n'
    path = tmp_path / "arm.urdf"
    path.write_text(f'<robot name="arm">{links}{joints}</robot>')
    arm = ro.read_urdf(path)
    # the offset between the parallel axes 2 and 3 is at the second of them
    turned = np.abs(np.angle(np.exp(1j * (arm.robot.mdh - ARM.mdh)[:, [0, 2, 4]]))).max()
    assert turned < 1e-12
    assert np.abs((arm.robot.mdh - ARM.mdh)[:, [1, 3]]).max() < 1e-12
    assert not arm.base.any()
    assert not arm.tool.any()


BOMB = '<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'
HOSTILE = {
    "empty": ("", "no element found"),
    "no XML": ("hello", "line 1, column 1"),
    "unclosed": (PLAIN.replace("</robot>", ""), "no element found"),
    "not UTF-8": (PLAIN.replace("two", "zw\xf6lf").encode("latin-1"), "not well-formed"),
    "UTF-16": (PLAIN.encode("utf-16"), "zero bytes"),
    "unknown encoding": ('<?xml version="1.0" encoding="klingon"?>' + PLAIN, "unknown encoding|XML declaration"),
    "entity bomb": (BOMB + PLAIN.replace("two", "&b;"), "<!DOCTYPE"),
    "external entity": ('<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]>' + PLAIN, "<!DOCTYPE"),
    "external document type": ('<!DOCTYPE robot SYSTEM "http://127.0.0.1:9/x.dtd">' + PLAIN, "<!DOCTYPE"),
    "undefined entity": (PLAIN.replace("two", "&b;"), "undefined entity"),
    "deep": ("<robot>" + "<a>" * 5000 + "</a>" * 5000 + "</robot>", "more than 100 levels"),
    "not a robot": ("<sdf/>", "<sdf>, accepted: <robot>"),
    "no links": ("<robot/>", "no links"),
    "one link": ('<robot><link name="a"/></robot>', "no joint that moves"),
    "xacro": (PLAIN.replace('<link name="arm"/>', '<xacro:arm name="x"/>'), "found a xacro file, accepted: what ROS"),
    "xacro in a number": (PLAIN.replace("0.5 0 0", "${d} 0 0"), "joint 'j2', origin xyz.*what ROS's command"),
    "link twice": (PLAIN.replace('name="hand"/>', 'name="arm"/>', 1), "element <link>: found 'arm' twice"),
    "joint twice": (PLAIN.replace("j2", "j1"), "element <joint>: found 'j1' twice"),
    "no name": (PLAIN.replace('name="j1"', ""), "one without a name"),
    "missing link": (PLAIN.replace('link="hand"', 'link="hnd"'), "joint 'j2', child: found no link 'hnd'.*mean hand"),
    "no parent": (PLAIN.replace('<parent link="arm"/>', ""), "joint 'j2', parent: found nothing"),
    "two children": (PLAIN.replace('<child link="arm"/>', '<child link="arm"/>' * 2), "joint 'j1', child: found 2"),
    "two parents": (PLAIN.replace('child link="hand"', 'child link="arm"'), "link 'arm': found two parents"),
    "cycle": (PLAIN.replace('parent link="base"', 'parent link="hand"'), "a cycle of joints"),
    "own parent": (PLAIN.replace('parent link="base"', 'parent link="arm"'), "a cycle of joints"),
    "two roots": (PLAIN.replace("<link", '<link name="x"/><link', 1), "without a parent: found x, base"),
    "nan": (PLAIN.replace("0.5 0 0", "nan 0 0"), "'nan 0 0', accepted: 3 finite numbers"),
    "metres as no unit has them": (PLAIN.replace("0.5 0 0", "1e300 0 0"), "'1e300 0 0'"),
    "infinite": (PLAIN.replace("0.5 0 0", "1e999 0 0"), "'1e999 0 0'"),
    "degrees": (PLAIN.replace("0.5 0 0", '0.5 0 0" rpy="-90 0 0'), r"'-90 0 0' \(degrees\?\), accepted: radians"),
    "two numbers": (PLAIN.replace("0.5 0 0", "0.5 0"), "'0.5 0', accepted: 3 finite numbers"),
    "comma": (PLAIN.replace("0.5 0 0", "0,5 0 0"), "'0,5 0 0'"),
    "underscore": (PLAIN.replace("0.5 0 0", "1_0 0 0"), "'1_0 0 0'"),
    "other digits": (PLAIN.replace("0.5 0 0", "\u0663 0 0"), "accepted: 3 finite numbers"),
    "zero axis": (PLAIN.replace("0 0 2", "0 0 0"), "joint 'j1', axis xyz: found a vector of length 0"),
    "limits": (
        PLAIN.replace("continuous", "revolute").replace('upper="1"', 'upper="-2"'),
        "joint 'j2', limit: found -1 to -2",
    ),
    "floating": (PLAIN.replace("continuous", "floating"), "joint 'j2', type: found 'floating'"),
    "planar": (PLAIN.replace("revolute", "planar"), "joint 'j1', type: found 'planar'"),
    "no type": (PLAIN.replace('type="revolute"', ""), "joint 'j1', type: found ''"),
    "mimic of nothing": (PLAIN.replace('<origin xyz="0.5 0 0"/>', '<mimic joint="j"/>'), "mimic: found no joint 'j'"),
    "mimic of itself": (PLAIN.replace('<origin xyz="0.5 0 0"/>', '<mimic joint="j2"/>'), "does not follow this one"),
    "mimic at rest": (
        PLAIN.replace('<origin xyz="0.5 0 0"/>', '<mimic joint="j1" multiplier="0"/>'),
        "joint 'j2', mimic multiplier: found 0",
    ),
    "too large": (b" " * (LARGEST_TEXT + 1), "bytes"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_urdf_is_refused_in_one_sentence(tmp_path: Path, name: str) -> None:
    content, expected = HOSTILE[name]
    path = tmp_path / "arm.urdf"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ro.InputError, match=expected) as refused:
        ro.read_urdf(path)
    assert str(refused.value).startswith(str(path))
    assert len(str(refused.value)) < 500
    with pytest.raises(ro.InputError, match=expected):
        ro.robot.write_urdf(path, ARM, tmp_path / "new.urdf")
    assert [p.name for p in tmp_path.iterdir()] == ["arm.urdf"]


def test_links_are_found_or_listed(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(random_urdf(2, "askew"))
    with pytest.raises(ro.InputError, match="at the end of chains from 'base': found tip, camera"):
        ro.read_urdf(path)
    with pytest.raises(ro.InputError, match=r"link 'tipp': found nothing.*did you mean tip"):
        ro.read_urdf(path, tip="tipp")
    with pytest.raises(ro.InputError, match="camera_mount', type: found 'floating'"):
        ro.read_urdf(path, tip="camera")
    part = ro.read_urdf(path, base="L1", tip="L2")
    assert part.names == ("J2",)
    with pytest.raises(ro.InputError, match="the file: found nothing"):
        ro.read_urdf(tmp_path / "none.urdf")


def tree_urdf(seed: int) -> tuple[str, list[str]]:
    """Return a random tree of 5 to 12 joints of all kinds, some following others, and its links with fixed leaves."""
    rng = np.random.default_rng(seed)
    links = ["root"]
    joints = []
    kinds: dict[str, str] = {}

    def add(kind: str, parent: str) -> str:
        child = f"{'tip' if kind == 'fixed' else 'L'}{len(links)}"
        xyz, rpy, axis = rng.normal(size=3), rng.uniform(-3, 3, 3), rng.normal(size=3)
        rest = f'<axis xyz="{text(axis)}"/><limit lower="-2" upper="1.5" effort="1" velocity="1"/>'
        name = f"J{len(links)}"
        alike = [other for other, its in kinds.items() if (its == "prismatic") == (kind == "prismatic")]
        if kind != "fixed":
            if alike and rng.random() < 0.4:  # in a chain of them, too
                factor, offset = rng.choice([-1, 1]) * rng.uniform(0.2, 2), rng.uniform(-1, 1)
                rest += (
                    f'<mimic joint="{rng.choice(alike)}" multiplier="{float(factor)!r}" offset="{float(offset)!r}"/>'
                )
            kinds[name] = kind
        joints.append(
            JOINT.format(kind=kind, name=name, parent=parent, child=child, xyz=text(xyz), rpy=text(rpy), rest=rest)
        )
        links.append(child)
        return child

    for _ in range(int(rng.integers(5, 13))):
        add(str(rng.choice(["revolute", "continuous", "prismatic"])), str(rng.choice(links[-3:])))
    for link in list(links):
        add("fixed", link)
    return f'<robot name="tree">{"".join(LINK.format(name=n) for n in links)}{"".join(joints)}</robot>', links


def between_links(path: Path, names: tuple[str, ...], base: str, tip: str, q: np.ndarray) -> np.ndarray:
    """Return T_base_tip (N, 4, 4) of joint values q (N, n) by name, from the transforms of both links from the root."""
    elements = {each.get("name"): each for each in ElementTree.parse(path).getroot().findall("joint")}

    def value(name: str) -> np.ndarray:
        mimic = elements[name].find("mimic")
        if mimic is not None:
            return float(mimic.get("multiplier")) * value(mimic.get("joint")) + float(mimic.get("offset"))
        return q[:, names.index(name)] if name in names else np.zeros(len(q))

    places = []
    for link in (base, tip):
        moving = [j.get("name") for j in joints_above(path, link) if j.get("type") != "fixed"]
        values = np.array([value(name) for name in moving]).reshape(len(moving), len(q)).T
        places.append(urdf_kinematics(path, link, values))
    return np.linalg.inv(places[0]) @ places[1]


@pytest.mark.parametrize("seed", range(40))
def test_the_chain_between_any_two_links(tmp_path: Path, seed: int) -> None:
    """Through branches and reversed joints; corrected origins written back move both links alike."""
    path, target = tmp_path / "tree.urdf", tmp_path / "new.urdf"
    content, links = tree_urdf(seed)
    path.write_text(content)
    rng = np.random.default_rng([seed, 1])
    tips = [link for link in links if link.startswith("tip")]
    base, tip = rng.choice(tips, 2, replace=False)
    arm = ro.read_urdf(path, base=base, tip=tip)
    q = configurations(arm.robot.dof, seed)
    assert np.abs(reach(arm, q) - between_links(path, arm.names, base, tip, q)).max() < EXACT
    mdh = arm.robot.mdh + 0.01 * rng.normal(size=arm.robot.mdh.shape)
    place, tool = arm.base + 0.01 * rng.normal(size=6), arm.tool + 0.01 * rng.normal(size=6)
    better = ro.robot.RobotSetup(replace(arm.robot, mdh=mdh), place, tool)
    ro.robot.write_urdf(path, better.robot, target, base=base, tip=tip, base_frame=place, tool_frame=tool)
    assert np.abs(reach(better, q) - between_links(target, arm.names, base, tip, q)).max() < EXACT


def test_a_base_that_no_fixed_joint_holds_cannot_move(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(PLAIN)
    arm = ro.read_urdf(path, base="hand", tip="base")  # upside down
    assert arm.names == ("j2", "j1")
    q = configurations(2)
    there = urdf_kinematics(path, "hand", q[:, ::-1])
    assert np.abs(reach(arm, q) - np.linalg.inv(there)).max() < EXACT
    moved = arm.base + np.eye(6)[2] * 1e-3
    with pytest.raises(ro.InputError, match=r"a base that moves link 'hand'.*joint 'j2' cannot express it"):
        ro.robot.write_urdf(path, arm.robot, tmp_path / "new.urdf", base="hand", tip="base", base_frame=moved)


def test_a_mimic_joint_beside_the_chain_does_not_matter(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    finger = '<joint name="f" type="prismatic"><parent link="arm"/><child link="f"/><mimic joint="j1"/></joint>'
    path.write_text(PLAIN.replace("</robot>", f'<link name="f"/>{finger}</robot>'))
    assert ro.read_urdf(path, tip="hand").names == ("j1", "j2")


def test_other_robots_are_not_written(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(PLAIN)
    arm = ro.read_urdf(path).robot
    for robot in (ARM, replace(arm, joint_types=("revolute", "prismatic"))):
        with pytest.raises(ro.InputError, match="joints of the robot"):
            ro.robot.write_urdf(path, robot, tmp_path / "new.urdf")
    other = replace(arm, mdh=arm.mdh + np.array([[0, 0, 2 * np.pi, 0, 0], [0, 0.3, 0, 0, 0]]))
    with pytest.raises(ro.InputError, match=r"a2 differs from the file by 0\.3 m,"):
        ro.robot.write_urdf(path, other, tmp_path / "new.urdf")


def test_files_keep_their_own_joint_values(tmp_path: Path) -> None:
    """A controller that counts joints otherwise was refused, with the cure that had been followed."""
    path, target = tmp_path / "arm.urdf", tmp_path / "better.urdf"
    path.write_text(random_urdf(11, "askew"))
    arm = ro.read_urdf(path, tip="tip")
    joint_map = np.array([[-1.0, 0.0], [1.0, 1.0]])
    counted = replace(arm.robot, joint_map=joint_map)
    parameters = ro.robot.model_parameters(counted, arm.base, {"": arm.tool}).identify(["a?"])
    q = configurations(arm.robot.dof, 5)
    problem = ro.CalibrationProblem(counted, parameters, ro.Dataset.of(q, np.zeros((8, 3)), 1e-5))
    y = problem.modelled(1e-3 * np.arange(len(parameters.free)))[0]
    result = ro.calibrate(problem.on(ro.Dataset.of(q, y, 1e-5)), ro.tikhonov, weight=1e-3)
    notes = ro.use.export_files(result, target, urdf=path, tip="tip", despite_verdict=True).notes
    assert "joint 1 (J1) is at -1 q1 and joint 2 (J2) is at +1 q1 +1 q2" in notes[-1]
    found = urdf_kinematics(target, "tip", q @ joint_map.T)[:, :3, 3]
    assert np.abs(found - result.problem.modelled(result.x)[0]).max() < EXACT


def test_zeros_of_joints_stand_in_their_origins(tmp_path: Path) -> None:
    """A zero beyond 0.1 rad was another robot's, found in the data or written into robot.toml as advised."""
    path, target = tmp_path / "arm.urdf", tmp_path / "better.urdf"
    path.write_text(random_urdf(11, "askew"))
    arm = ro.read_urdf(path, tip="tip")
    zeros, signs = np.radians([15, 179]), np.diag([-1.0, 1.0])
    table = arm.robot.mdh + 1e-3 + np.outer(zeros, [0, 0, 1, 0, 0])
    robot = replace(arm.robot, mdh=table, joint_map=signs)
    notes = ro.robot.write_urdf(path, robot, target, tip="tip")
    assert "joint 1 (J1) is at -1 q1" in notes[0]
    assert "joint 1 (J1) by +15.057 deg and joint 2 (J2) by +179.057 deg" in notes[1]
    q = configurations(2, 5)
    expected = numeric_frame(arm.base) @ ro.robot.forward_kinematics(robot, q) @ numeric_frame(arm.tool)
    assert np.abs(urdf_kinematics(target, "tip", q @ signs) - expected).max() < EXACT


def test_what_a_calibration_identified_goes_into_a_file(tmp_path: Path) -> None:
    path, target = tmp_path / "arm.urdf", tmp_path / "better.urdf"
    path.write_text(random_urdf(11, "askew"))
    arm = ro.read_urdf(path, tip="tip")
    rng = np.random.default_rng(0)
    parameters = ro.robot.model_parameters(arm.robot, arm.base, {"": arm.tool}).identify(["a?", "tool_*", "base_*"])
    q = configurations(arm.robot.dof, 5)
    problem = ro.CalibrationProblem(arm.robot, parameters, ro.Dataset.of(q, np.zeros((8, 3)), 1e-5))
    x = 0.01 * rng.normal(size=len(parameters.free))
    data = ro.Dataset.of(q, -problem.residual(x).reshape(-1, 3), 1e-5)
    result = ro.calibrate(problem.on(data), ro.tikhonov, weight=1e-3)
    found = ro.use.identified(result)
    ro.robot.write_urdf(path, found.robot, target, tip="tip", base_frame=found.base, tool_frame=found.tool)
    modelled = result.problem.modelled(result.x)[0]
    assert np.abs(urdf_kinematics(target, "tip", q)[:, :3, 3] - modelled).max() < EXACT


def test_what_no_file_holds_is_named() -> None:
    problem, _ = simulated(("a?", "ratio2", "ecc_cos3"), configurations=10, noise=1e-5)
    result = ro.calibrate(problem, ro.tikhonov, 1.0)
    with pytest.raises(ro.InputError, match="found ratio2, ecc_cos3, accepted"):
        ro.use.identified(result)
    plain, _ = simulated(("a?",), configurations=10)
    with pytest.raises(ro.InputError, match="marker: found 'A'"):
        ro.use.identified(ro.calibrate(plain, ro.tikhonov, 1.0), "A")


# Universal Robots ----------------------------------------------------------------------------------------------------

CONF = """# saved by the controller
[mounting]
delta_theta = [ -7.29007007e-05, -0.0171389729, -0.0370715941, 0.0542794622, 1.48898426e-07, 1.55149948e-05]
delta_a = [ 4.63113768e-05, -0.000125683153, 0.00186216581, 9.91859387e-05, 4.21546272e-06, 0]
delta_d = [ 0.00065609213, 1.44421624, 0.854147724, -2.29894259, -1.57349869e-05, 1.90724356e-05]
delta_alpha = [ 0.000211987864, -0.0072553626, -0.0134832268, 0.00134958202, -0.00126313616, 0]
joint_checksum = [ 0x6e0f7bf, 0xa32a713f, 0xf636a50, 0x9ec2338a, 0xa1afded8, 0xb29b2979]
calibration_status = 2 # 0 == notInitialized / 1 == notLinearised / 2 == Linearised
"""  # the deltas of ur_calibration's own test, on a UR10
FAR = """[mounting]
delta_theta = [ -8.2e-05, -0.103609197, 0.673631891, -0.570169747, -4.6e-05, 9.7e-07]
delta_a = [ -0.000161187342, 0.00304003844, 0.0916468556, -9.6e-05, -2.9e-05, 0]
delta_d = [ 0.000505390895, 11.1984515, -92.5270327, 81.3282684, -0.00021, -0.00012]
delta_alpha = [ -0.000321423999, -0.00565024519, -0.00378922622, -0.001, 0.00099, 0]
"""  # a robot's, forum.universal-robots.com, thread 18921
UR10 = ro.read_robot(find_robot("ur10"))


def standard_dh(conf: str, q: np.ndarray) -> np.ndarray:
    """Return the flange of a UR10 with a file's deltas, by the product of standard DH links."""
    rows = {n: np.array(eval(re.search(rf"delta_{n} = (\[.*\])", conf)[1])) for n in ("theta", "d", "a", "alpha")}
    theta, d = rows["theta"], rows["d"] + [0.1273, 0, 0, 0.163941, 0.1157, 0.0922]
    a = rows["a"] + [0, -0.612, -0.5723, 0, 0, 0]
    alpha = rows["alpha"] + np.pi / 2 * np.array([1, 0, 0, 1, -1, 0])
    T = np.tile(np.eye(4), (len(q), 1, 1))
    for i in range(6):
        along_z, along_x = np.tile(np.eye(4), (len(q), 1, 1)), np.eye(4)
        along_z[:, :3, :3] = Rotation.from_euler("z", q[:, [i]] + theta[i]).as_matrix()
        along_z[:, 2, 3] = d[i]
        along_x[:3, :3], along_x[0, 3] = Rotation.from_euler("x", alpha[i]).as_matrix(), a[i]
        T = T @ along_z @ along_x
    return T


def test_our_ur10_is_the_drivers() -> None:
    """A position from the tests of UniversalRobots/Universal_Robots_ROS_Driver, ur_calibration."""
    q = [[-1.600700203572, -1.727100197469, -2.20299989382, -0.807999912892, 1.595100045204, -0.030999962481]]
    want = [-0.179925914147547, -0.606869755162764, 0.230789102067257]
    assert np.abs(ro.robot.forward_kinematics(UR10, np.array(q))[0, :3, 3] - want).max() < 1e-10


@pytest.mark.parametrize("conf", [CONF, FAR])
def test_a_controllers_deltas_give_a_robot_near_nominal(tmp_path: Path, conf: str) -> None:
    path = tmp_path / "calibration.conf"
    path.write_text(conf)
    arm = ro.robot.read_ur_calibration(path, UR10)
    q = configurations(6)
    # d of 92 m: rounding of 1e-14 there
    assert np.abs(reach(arm, q) - standard_dh(conf, q)).max() < 1e-11
    assert not arm.base.any()
    # the wrong sign, order or unit would leave metres between the parallel axes
    assert np.abs((arm.robot.mdh - UR10.mdh)[:, [1, 3]]).max() < 3e-3
    assert np.abs((arm.robot.mdh - UR10.mdh)[:, [0, 2, 4]]).max() < 0.02


@pytest.mark.parametrize("conf", [CONF, FAR])
def test_deltas_written_read_as_the_same_robot(tmp_path: Path, conf: str) -> None:
    path, target = tmp_path / "calibration.conf", tmp_path / "new.conf"
    path.write_text(conf)
    arm = ro.robot.read_ur_calibration(path, UR10)
    change = 1e-4 * np.random.default_rng(0).normal(size=(6, 5))
    change[0, :2], change[5, 4] = 0, 0
    better = replace(arm.robot, mdh=arm.robot.mdh + change)
    ro.robot.write_ur_calibration(path, better, UR10, target)
    again = ro.robot.read_ur_calibration(target, UR10)
    q = configurations(6)
    assert np.abs(reach(again, q) - ro.robot.forward_kinematics(better, q)).max() < 1e-9
    lists = re.compile(r"(?<=delta_)(\w+ = \[).*(?=\])")
    assert lists.sub(r"\1", path.read_text()) == lists.sub(r"\1", target.read_text())
    assert target.read_text().count("e-") > 3  # numbers in full


def test_deltas_are_those_nearest_to_nominal(tmp_path: Path) -> None:
    """theta2 to theta4 added up to half a turn for a quarter of robots, and alpha4 and alpha5 with them."""
    path, target = tmp_path / "calibration.conf", tmp_path / "new.conf"
    path.write_text(CONF)
    rng = np.random.default_rng(0)
    for _ in range(12):
        change = 1e-3 * rng.normal(size=(6, 5)) * [1, 1, 1, 1, 0]
        change[0, :2], change[1:3, 4] = 0, 1e-3 * rng.normal(size=2)
        ro.robot.write_ur_calibration(path, replace(UR10, mdh=UR10.mdh + change), UR10, target)
        text = target.read_text()
        theta, alpha = (np.array(eval(re.search(rf"delta_{n} = (\[.*\])", text)[1])) for n in ("theta", "alpha"))
        assert np.abs([*alpha, theta[0], theta[4], theta[5], theta[1:4].sum()]).max() < 0.02


def test_what_the_controller_cannot_hold_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "calibration.conf"
    path.write_text(CONF)

    def changed(joint: int, column: int, by: float) -> ro.robot.Robot:
        mdh = UR10.mdh.copy()
        mdh[joint, column] += by
        return replace(UR10, mdh=mdh)

    for robot, found in [
        (changed(0, 1, 1e-3), "alpha1 or a1 that deviate"),
        (changed(5, 4, 1e-3), "beta6 = 0.001 rad"),
        (changed(2, 4, 3e-10), "nearly parallel axes"),
    ]:
        with pytest.raises(ro.InputError, match=found):
            ro.robot.write_ur_calibration(path, robot, UR10, tmp_path / "new.conf")
    with pytest.raises(ro.InputError, match="joints of the robot: found revolute"):
        ro.robot.write_ur_calibration(path, ro.read_robot(find_robot("iiwa7")), UR10, tmp_path / "new.conf")
    another = changed(2, 1, 1.5)
    with pytest.raises(ro.InputError, match=r"found a2 = 888.* accepted: a Universal Robot"):
        ro.robot.write_ur_calibration(path, another, another, tmp_path / "new.conf")
    assert not (tmp_path / "new.conf").exists()


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("[mounting]", "[other]", r"section \[mounting\]: found nothing"),
        ("delta_d =", "delta_x =", "key delta_d: found 0 lists"),
        ("delta_a = [", "delta_a = [1,", "key delta_a: found 7 numbers"),
        ("4.63113768e-05", "nan", "key delta_a: found 'nan'"),
        ("4.63113768e-05", "", "key delta_a: found ''"),
        ("joint_checksum", "delta_a = [0,0,0,0,0,0]\njoint_checksum", "key delta_a: found 2 lists"),
    ],
)
def test_bad_deltas(tmp_path: Path, old: str, new: str, found: str) -> None:
    path = tmp_path / "calibration.conf"
    path.write_text(CONF.replace(old, new, 1))
    with pytest.raises(ro.InputError, match=found):
        ro.robot.read_ur_calibration(path, UR10)


YAML = """kinematics:
  shoulder:
    x: 0
    y: 0
    z: 0.1625
    roll: -0
    pitch: 0
    yaw: 1.5e-05   # as measured
  upper_arm: {x: 8.2e-05, y: 0, z: 0, roll: 1.5702793305568989, pitch: 0, yaw: 9.4e-05}
  forearm:
    x: -0.42514603197027351
    y: 0
    z: 0
    roll: 0.00027727163297603633
    pitch: 0.00074181659174685764
    yaw: 8.2061777589927939e-05
  wrist_1:
    x: -0.39231335412023205
    y: 0.00070367842866065884
    z: 0.11004902881674888
    roll: 3.1351985141209435
    pitch: -3.1400954402443415
    yaw: 3.1415185610293745
  wrist_2:
    x: 3.6501405590628345e-05
    y: -0.094721186124807052
    z: 0.0001791428279527357
    roll: 1.5689050644312028
    pitch: 0
    yaw: -1.320607040336194e-05
  wrist_3:
    x: 0.00015399008043081661
    y: 0.082421327089370319
    z: 0.00012632686207930083
    roll: 1.5723290218826846
    pitch: 3.1415926535897931
    yaw: -3.14158677108863
  hash: calib_15200003067234149431
"""


def yaml_kinematics(content: str, q: np.ndarray) -> np.ndarray:
    """Return the flange as ur_description's URDF has it: x y z, R = Rz Ry Rx, then the joint about z."""
    numbers = [float(v) for v in re.findall(r"(?:x|y|z|roll|pitch|yaw): ([^\s,}]+)", content)]
    T = np.tile(np.eye(4), (len(q), 1, 1))
    for i, six in enumerate(np.reshape(numbers, (6, 6))):
        origin, turn = np.eye(4), np.tile(np.eye(4), (len(q), 1, 1))
        origin[:3, :3], origin[:3, 3] = Rotation.from_euler("xyz", six[3:]).as_matrix(), six[:3]
        turn[:, :3, :3] = Rotation.from_euler("z", q[:, [i]]).as_matrix()
        T = T @ origin @ turn
    return T


def test_ros_kinematics_in_and_out(tmp_path: Path) -> None:
    path, target = tmp_path / "kinematics.yaml", tmp_path / "new.yaml"
    path.write_text(YAML)
    arm = ro.robot.read_ur_kinematics(path)
    q = configurations(6)
    assert np.abs(reach(arm, q) - yaml_kinematics(YAML, q)).max() < EXACT
    assert not arm.base.any()
    assert not arm.tool.any()
    ro.robot.write_ur_kinematics(path, arm.robot, target)
    assert target.read_bytes() == path.read_bytes()
    change = 1e-3 * np.random.default_rng(0).normal(size=(6, 5))
    change[5, 4] = 0
    better = replace(arm.robot, mdh=arm.robot.mdh + change)
    ro.robot.write_ur_kinematics(path, better, target)
    assert np.abs(yaml_kinematics(target.read_text(), q) - ro.robot.forward_kinematics(better, q)).max() < EXACT
    numbers = re.compile(r"(?<=: )-?[\d.]+(e-?\d+)?(?=[\s,}])")
    assert numbers.sub("", target.read_text()) == numbers.sub("", YAML)
    assert "# as measured" in target.read_text()
    with pytest.raises(ro.InputError, match="beta6, which follows the last joint"):
        ro.robot.write_ur_kinematics(path, replace(better, mdh=better.mdh + 1e-3), target)


def test_a_command_takes_the_drivers_file_as_robot(tmp_path: Path) -> None:
    path = tmp_path / "kinematics.yaml"
    path.write_text(YAML)
    arm = read_arm(find_robot(str(path)))
    assert np.array_equal(arm.robot.mdh, ro.robot.read_ur_kinematics(path).robot.mdh)


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (YAML.replace("{x", "[x"), r"line 9: found 'upper_arm: \[x"),
        (YAML.replace("wrist_2:", "wrist_4:"), "'wrist_4', accepted: shoulder.*mean wrist_"),
        (YAML.replace("    yaw: -3.14158677108863\n", ""), "key wrist_3.yaw: found nothing"),
        (YAML.replace("x: -0.42514603197027351", "x: far"), "forearm.x: found 'far'"),
        (YAML.replace("x: -0.42514603197027351", "x: .nan"), "forearm.x: found '.nan'"),
        (YAML.replace("  hash", "    yaw: 1\n  hash"), "wrist_3.yaw twice"),
        ("x: 1\n" + YAML, "line 1: found .x twice or out of place"),
        ("kinematics:\n- x\n", "line 2: found '- x'"),
        ("", "key shoulder.x: found nothing"),
    ],
)
def test_bad_ros_kinematics(tmp_path: Path, content: str, found: str) -> None:
    path = tmp_path / "kinematics.yaml"
    path.write_text(content)
    with pytest.raises(ro.InputError, match=found):
        ro.robot.read_ur_kinematics(path)


# Plain tables --------------------------------------------------------------------------------------------------------


def equal(a: ro.robot.Robot, b: ro.robot.Robot) -> bool:
    arrays = all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("mdh", "joint_map", "limits"))
    return arrays and a.joint_types == b.joint_types


NAMES = ("rail", "l7_joint_A1", "", 'a "quoted" one', "\u00e4")


def any_robot(seed: int, coupled: bool) -> ro.robot.Robot:
    rng = np.random.default_rng(seed)
    mdh = rng.normal(size=(5, 5)) * 10.0 ** rng.integers(-12, 3, (5, 5))
    mdh[rng.random((5, 5)) < 0.3] = 0.0
    mdh[0] = [np.pi / 2, 0.4251, -np.pi, 0.1, np.radians(0.1)]
    limits = np.sort(rng.normal(size=(5, 2)), axis=1)
    limits[2] = -np.inf, np.inf
    joint_map = rng.normal(size=(5, 5)) if coupled else np.diag(rng.choice([-1.0, 1.0], 5))
    kinds = tuple(rng.choice(["revolute", "prismatic"], 5).tolist())
    return ro.robot.Robot('Größe "5" \\ tab\t', mdh, kinds, joint_map, limits, "drawing\nsheet 2", joint_names=NAMES)


@pytest.mark.parametrize("ending", ["toml", "json", "csv"])
@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_tables_come_back_to_the_last_bit(tmp_path: Path, ending: str, coupled: bool, seed: int) -> None:
    robot, path = any_robot(seed, coupled), tmp_path / f"robot.{ending}"
    if coupled and ending == "csv":
        with pytest.raises(ro.InputError, match="a coupling of joints"):
            ro.robot.write_robot(robot, path)
        return
    ro.robot.write_robot(robot, path)
    again = ro.read_robot(path)
    assert equal(again, robot)
    if ending != "csv":
        assert (again.name, again.source, again.joint_names) == (robot.name, robot.source, NAMES)
    if ending == "toml":
        assert equal(ro.read_robot(path), robot)


@pytest.mark.parametrize(
    ("columns", "cells"),
    [
        ("min [deg],max [deg]", "-170,165"),
        ("Range min [deg],Range max [deg]", "-170,165"),
        ("lower limit [deg],upper limit [deg]", "-170,165"),
    ],
)
def test_limits_of_a_sheet_stand_in_two_columns(tmp_path: Path, columns: str, cells: str) -> None:
    header = f"alpha [deg],a [mm],theta [deg],d [mm],{columns},convention"
    (tmp_path / "r.csv").write_text(f"{header}\n0,100,0,300,{cells},modified\n")
    assert np.degrees(ro.read_robot(tmp_path / "r.csv").limits) == pytest.approx(np.array([[-170, 165]]))


def test_limits_without_a_unit_have_that_of_their_joint(tmp_path: Path) -> None:
    header = "type,alpha [deg],a [mm],theta [deg],d [mm],min,max,convention"
    cells = "revolute,0,100,0,300,-170,165,modified\nprismatic,0,0,0,0,0,200,modified\n"
    (tmp_path / "r.csv").write_text(f"{header}\n{cells}")
    assert ro.read_robot(tmp_path / "r.csv").limits == pytest.approx(np.array([np.radians([-170, 165]), [0, 0.2]]))


def test_a_table_is_written_as_a_person_would(tmp_path: Path) -> None:
    ro.robot.write_robot(UR10, tmp_path / "ur10.csv")
    lines = (tmp_path / "ur10.csv").read_text().splitlines()
    assert lines[0] == "alpha_deg,a_mm,theta_deg,d_mm,beta_deg,lower_deg,upper_deg,convention"
    assert lines[3] == "0.0,-612.0,0.0,0.0,0.0,-360.0,360.0,modified"
    ro.robot.write_robot(UR10, tmp_path / "ur10.toml")
    assert "[[joint]]\nalpha_deg = 90.0\nlimits_deg = [-360.0, 360.0]\n" in (tmp_path / "ur10.toml").read_text()


@pytest.mark.parametrize(
    ("name", "content", "found"),
    [
        ("r.csv", "alpha_deg,a,convention\n1,2,modified\n", "column 'a' without a unit"),
        ("r.csv", "alpha_deg,alpha_rad,convention\n1,2,modified\n", "alpha twice, in two units"),
        ("r.csv", "alpha_deg,a_mm,d_mm,convention\nninety,1,2,modified\n", "joint 1.alpha_deg: found 'ninety'"),
        ("r.csv", "alpha_deg,a_mm,d_mm,convention\nnan,1,2,modified\n", "joint 1.alpha_deg"),
        ("r.csv", "a_mm,d_mm,type,convention\n1,1,screw,modified\n", "joint 1.type: found 'screw'"),
        ("r.csv", "d_mm,Range [deg],convention\n1,340,modified\n", r"both limits in a column, 'Range \[deg\]'"),
        ("r.csv", "d_mm,lower_deg,convention\n1,5,modified\n", "joint 1.limits_deg: found None"),
        ("r.csv", "", "an empty file"),
        ("r.json", "[]", "found list"),
        ("r.json", "{", "the JSON text"),
        ("r.json", '{"name": "x", "joint": []}', "key joint"),
        ("r.json", '{"name": "x", "joint": [{"d_mm": NaN}]}', "joint 1.d_mm: found nan"),
        ("r.xml", "", "a name ending in .toml, .json, .csv"),
    ],
)
def test_bad_tables(tmp_path: Path, name: str, content: str, found: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(ro.InputError, match=found) as refused:
        ro.read_robot(path)
    assert str(path) in str(refused.value)


def test_four_numbers_a_joint_move_the_same(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    mdh = ARM.mdh + 1e-3 * rng.normal(size=ARM.mdh.shape)
    mdh[-1, 4] = 0
    robot, path = replace(ARM, mdh=mdh), tmp_path / "dhm.csv"
    plain, q = ro.robot.without_beta(robot), configurations(6)
    assert not plain.mdh[:, 4].any()
    assert np.abs(ro.robot.forward_kinematics(plain, q) - ro.robot.forward_kinematics(robot, q)).max() < EXACT
    # theta stays near nominal, quarter turns and all, except on both sides of the far normal of axes 2 and 3
    assert np.abs(plain.mdh - mdh)[[0, 3, 4, 5], 2].max() < 0.01
    ro.robot.write_robodk(robot, path)
    assert path.read_text().startswith("joint,alpha_deg,a_mm,theta_deg,d_mm\n1,")
    table = np.loadtxt(path, delimiter=",", skiprows=1)[:, 1:]
    again = np.column_stack([np.radians(table[:, 0]), 1e-3 * table[:, 1], np.radians(table[:, 2]), 1e-3 * table[:, 3]])
    assert np.abs(again - plain.mdh[:, :4]).max() < 1e-12
    (note,) = ro.robot.write_robodk(replace(ARM, joint_map=np.diag([1.0, 1, -1, 1, 1, 1])), path)
    assert "joint 3 is at -1 q3" in note


# Problem files -------------------------------------------------------------------------------------------------------

PROBLEM = """title = "t"
robot = "arm.urdf"
urdf_tip = "tip"
identification = "data.csv"
identify = ["a?"]
[noise]
position_mm = 0.1
"""


def test_a_problem_may_name_a_urdf(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(random_urdf(5, "square"))
    arm = ro.read_urdf(tmp_path / "arm.urdf", tip="tip")
    q = configurations(arm.robot.dof, 9)
    p = reach(arm, q)[:, :3, 3]
    units = ["deg" if d == "angle" else "mm" for d in arm.robot.joint_dimensions]
    size = [180 / np.pi if unit == "deg" else 1e3 for unit in units]
    header = ",".join([*(f"q{i}_{u}" for i, u in enumerate(units, start=1)), "x_mm", "y_mm", "z_mm"])
    np.savetxt(tmp_path / "data.csv", np.hstack([q * size, 1e3 * p]), "%.17g", ",", header=header, comments="")
    (tmp_path / "problem.toml").write_text(PROBLEM)
    problem = ro.load(tmp_path).problem
    assert problem.errors(np.zeros(arm.robot.dof)).max() < EXACT
    (tmp_path / "problem.toml").write_text(PROBLEM + "[tool]\nx_mm = 1.0\n[base]\nz_mm = 2.0\n")
    stated = ro.load(tmp_path).problem.parameters
    frames = dict(zip(stated.names, stated.nominal, strict=True))
    assert (frames["tool_x"], frames["tool_y"], frames["base_z"], frames["base_x"]) == (1e-3, 0.0, 2e-3, 0.0)
    (tmp_path / "problem.toml").write_text(PROBLEM.replace("urdf_tip", "# "))
    with pytest.raises(
        ro.InputError, match=r"urdf_tip, also a key in problem\.toml, or ro\.read_urdf\(file, tip=link\)"
    ):
        ro.load(tmp_path)
    ro.robot.write_robot(arm.robot, tmp_path / "arm.json")
    (tmp_path / "problem.toml").write_text(PROBLEM.replace("arm.urdf", "arm.json"))
    with pytest.raises(ro.InputError, match="key urdf_base, urdf_tip"):
        ro.load(tmp_path)
    (tmp_path / "problem.toml").write_text(PROBLEM.replace("arm.urdf", "arm.json").replace("urdf_tip", "# "))
    assert equal(ro.load(tmp_path).problem.robot, arm.robot)


def test_small_errors_of_axes_that_are_nearly_parallel_are_small_deviations(tmp_path: Path) -> None:
    """The common normal of axes 10 degrees apart moves by 1 / sin(10 degrees) = 5.8 times an error; beta's does not."""
    path = tmp_path / "arm.urdf"

    def read(tilt: float, shift: float) -> np.ndarray:
        axis = Rotation.from_rotvec([0.0, tilt, 0.0]).apply([0.0, np.sin(np.radians(10)), np.cos(np.radians(10))])
        joints = [("0 0 0", "0 0 1"), (f"0.3 {shift} 0", text(axis)), ("0.3 0 0.1", "0 1 0")]
        links = "".join(f'<link name="l{i}"/>' for i in range(4))
        parts = "".join(
            f'<joint name="j{i}" type="continuous"><parent link="l{i}"/><child link="l{i + 1}"/>'
            f'<origin xyz="{xyz}"/><axis xyz="{of}"/></joint>'
            for i, (xyz, of) in enumerate(joints)
        )
        path.write_text(f'<robot name="arm">{links}{parts}</robot>')
        return ro.read_urdf(path).robot.mdh

    nominal = read(0.0, 0.0)
    for tilt, shift in ((1e-3, 0.0), (0.0, 1e-3)):
        change = np.abs(read(tilt, shift) - nominal)
        assert change.max() < 4e-3  # 1 mm of a link of 0.3 m is 3.3 mrad
    data = ro.Dataset.of(np.random.default_rng(0).uniform(-2, 2, (20, 3)), np.zeros((20, 3)), 1e-4)
    assert "beta1" in ro.problem_from(path, data, base=np.zeros(6)).parameters.free.names


@pytest.mark.parametrize("start", ["catalogue", "factory"])
def test_a_controllers_deltas_count_from_its_catalogue_whatever_the_calibration_began_with(
    tmp_path: Path, start: str
) -> None:
    """Of a calibration that began with the factory's robot the deltas were those from there: 0.4 m off at the tool."""
    path, target = tmp_path / "calibration.conf", tmp_path / "new.conf"
    path.write_text(CONF)
    robot = {"catalogue": UR10, "factory": ro.robot.read_ur_calibration(path, UR10).robot}[start]
    problem, truth = simulated(("d4", "a[34]", "theta[2-6]", "base_*"), robot=robot, configurations=40, noise=1e-5)
    result = replace(ro.calibrate(problem, "tikhonov", 1.0), x=truth)
    ro.use.export_files(result, target, ur_calibration=path, despite_verdict=True)
    q = configurations(6)
    written = ro.robot.read_ur_calibration(target, UR10)
    assert np.abs(reach(written, q) - ro.robot.forward_kinematics(result.robot, q)).max() < 1e-9


@pytest.mark.parametrize("file", ["calibration.conf", "kinematics.yaml"])
def test_a_robot_on_a_table_with_a_reversed_joint_goes_into_universal_robots_files(tmp_path: Path, file: str) -> None:
    """A URDF whose root is the floor has d1 and theta1 of the table in it: no Universal Robot, it was said."""
    path, target = tmp_path / file, tmp_path / f"new_{file}"
    path.write_text(CONF if file.endswith("conf") else YAML)
    nominal = UR10 if file.endswith("conf") else ro.robot.read_ur_kinematics(path).robot
    signs, standing = np.diag([1.0, 1, 1, -1, 1, 1]), nominal.mdh.copy()
    standing[0, 2:4] += 0.3, 0.77
    standing[4, 2] += np.pi / 2  # and the zero of a joint elsewhere
    robot = replace(nominal, mdh=standing, joint_map=signs)
    problem, truth = simulated(("d4", "a[34]", "theta[2-6]", "base_*"), robot=robot, configurations=40, noise=1e-5)
    result = replace(ro.calibrate(problem, "tikhonov", 1.0), x=truth)
    options = {"ur_calibration" if file.endswith("conf") else "ur_kinematics": path}
    notes = ro.use.export_files(result, target, **options, despite_verdict=True).notes
    assert any("770.000 mm along axis 1" in note for note in notes)
    assert any("joint 4 (wrist_1) is at -1 q4" in note for note in notes)
    assert any("within the joints' origins: joint 5 (wrist_2) by +" in note for note in notes)
    q = configurations(6)
    if file.endswith("conf"):
        written = reach(ro.robot.read_ur_calibration(target, UR10), q @ signs)
    else:
        written = yaml_kinematics(target.read_text(), q @ signs)
    base = ro.robot.forward_kinematics(result.robot, q) @ np.linalg.inv(written)
    assert np.abs(base - base[0]).max() < 1e-9
    assert np.abs(base[0] - numeric_frame([0, 0, 0.77, 0, 0, 0.3])).max() < 1e-9
