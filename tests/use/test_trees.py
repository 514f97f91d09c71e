"""Sensors on several links of one URDF: one calibration of its joints' origins, and one corrected file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.robot.kinematics import frame_numbers, numeric_frame
from tests.robot.test_exchange import between_links, text
from tests.test_cli import run

SIGMA = 1e-4
NEW = 2000
"""Configurations at which positions are predicted."""


def random_tree(seed: int) -> tuple[str, list[str]]:
    """Return a URDF of 2 to 4 branches on a trunk, 5 to 25 joints of all kinds, and its tips."""
    rng = np.random.default_rng(seed)
    links, joints, moving = ["root"], [], []

    def add(kind: str, parent: str, tip: str = "") -> str:
        i = len(joints) + 1
        links.append(tip or f"link{i}")
        xyz, rpy, axis = 0.3 * rng.normal(size=3), rng.uniform(-3, 3, 3), rng.normal(size=3)
        rest = f'<axis xyz="{text(axis)}"/>'
        same = [name for name, each in moving if (each == "prismatic") == (kind == "prismatic")]
        if kind not in ("fixed", "continuous") and same and rng.random() < 0.2:
            rest += f'<mimic joint="{rng.choice(same)}" multiplier="{rng.uniform(0.5, 1.5)!r}" offset="0.1"/>'
        elif kind != "fixed":
            moving.append((f"j-{i}", kind))
        joints.append(
            f'<joint name="j-{i}" type="{kind}"><parent link="{parent}"/><child link="{links[-1]}"/>'
            f'<origin xyz="{text(xyz)}" rpy="{text(rpy)}"/>{rest}</joint>'
        )
        return links[-1]

    kinds = ["revolute", "continuous", "prismatic", "fixed"]
    branches = int(rng.integers(2, 5))
    total = int(rng.integers(max(5, 2 * branches + 2), 26))
    trunk = int(rng.integers(1, 3))
    parent = add("revolute", "root")
    for _ in range(trunk - 1):
        parent = add(str(rng.choice(kinds)), parent)
    counts = 1 + rng.multinomial(max(total - trunk - 2 * branches, 0), np.full(branches, 1 / branches))
    tips = []
    for k, count in enumerate(counts):
        at = add("revolute", parent)
        for _ in range(count - 1):
            at = add(str(rng.choice(kinds, p=[0.5, 0.2, 0.1, 0.2])), at)
        tips.append(add("fixed", at, f"tip{k}"))
    return f'<robot name="t">{"".join(f"<link name={n!r}/>" for n in links)}{"".join(joints)}</robot>', tips


def with_errors(path: Path, target: Path, seed: int) -> None:
    """Write the file with errors of 1 mm and 1 mrad in the origin of every joint that moves."""
    rng = np.random.default_rng([seed, 2])
    tree = ElementTree.parse(path)
    for joint in tree.getroot().findall("joint"):
        origin = joint.find("origin")
        if joint.get("type") == "fixed":
            continue
        place = np.array([*origin.get("xyz").split(), *origin.get("rpy").split()], dtype=float)
        six = frame_numbers(numeric_frame(1e-3 * rng.normal(size=6)) @ numeric_frame(place))
        origin.set("xyz", text(six[:3]))
        origin.set("rpy", text(six[3:]))
    tree.write(target)


def drawn(arm: ro.robot.RobotSetup, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return joint values, angles of up to 2 rad and travels of up to 0.3 m."""
    reach = np.where(np.array(arm.robot.joint_dimensions) == "angle", 2.0, 0.3)
    return rng.uniform(-reach, reach, (count, arm.robot.dof))


def chains(seed: int, tips: list[str]) -> dict[str, tuple[str, str]]:
    """Return which links measure which: a tracker two tips, and where there are three tips, one of them the first."""
    found = {"left": ("root", tips[0]), "right": ("root", tips[1])}
    if len(tips) > 2:
        found["head"] = (tips[2], tips[0])
    return found


SEEDS = [pytest.param(seed, marks=[] if seed < 4 else pytest.mark.slow) for seed in range(40)]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_tree_is_calibrated_as_a_whole_and_written_into_one_file(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    content, tips = random_tree(seed)
    Path("robot.urdf").write_text(content)
    with_errors(Path("robot.urdf"), Path("true.urdf"), seed)
    rng = np.random.default_rng([seed, 3])
    lines = ['title = "tree"', 'robot = "robot.urdf"', 'identify = ["origin_*"]', "[noise]", "position_mm = 0.1"]
    arms = {}
    for name, (base, tip) in chains(seed, tips).items():
        arms[name] = arm = ro.read_urdf("robot.urdf", base, tip, origins=True)
        q = drawn(arm, 60, rng)
        T = between_links(Path("true.urdf"), arm.names, base, tip, q)
        y = T[:, :3, 3] + SIGMA * rng.normal(size=(60, 3))
        columns = [f"q{i}_{'deg' if d == 'angle' else 'mm'}" for i, d in enumerate(arm.robot.joint_dimensions, 1)]
        units = [np.degrees(1) if d == "angle" else 1e3 for d in arm.robot.joint_dimensions]
        rows = [",".join(["label", *columns, "x_mm", "y_mm", "z_mm"])]
        rows += [
            ",".join([f"{name}{i}", *map(repr, row)]) for i, row in enumerate(np.hstack([q * units, 1e3 * y]).tolist())
        ]
        Path(f"{name}.csv").write_text("\n".join(rows) + "\n")
        lines += [f"[chain.{name}]", f'urdf_base = "{base}"', f'urdf_tip = "{tip}"', f'identification = "{name}.csv"']
    Path("problem.toml").write_text("\n".join(lines) + "\n")

    result = ro.load(".").calibrate()
    assert result.converged
    ro.store.save_result(result, "result.json")
    again = ro.load_result("result.json")
    assert np.array_equal(again.problem.residual(result.x), result.problem.residual(result.x))
    ro.use.export_files(result, "better.urdf", urdf="robot.urdf")
    for name, (base, tip) in chains(seed, tips).items():
        arm = arms[name]
        q = drawn(arm, NEW, rng)
        written = between_links(Path("better.urdf"), arm.names, base, tip, q)
        modelled = result.problem.measuring(q, robot=name).modelled(result.x)[0]
        assert np.abs(written[:, :3, 3] - modelled).max() < 1e-12 * max(1.0, np.abs(modelled).max())
        measured = between_links(Path("true.urdf"), arm.names, base, tip, q)[:, :3, 3] + SIGMA * rng.normal(
            size=(NEW, 3)
        )
        floor = np.sqrt(np.mean((measured - modelled) ** 2)) / SIGMA
        assert floor < 1.2


def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, more: str = "") -> None:
    """Write the problem of a tracker that measures two tips and of a third tip that measures the first, no errors."""
    monkeypatch.chdir(tmp_path)
    seed = 1
    content, tips = random_tree(seed)
    Path("robot.urdf").write_text(content)
    lines = ['title = "tree"', 'robot = "robot.urdf"', more, "[noise]", "position_mm = 0.1"]
    rng = np.random.default_rng(seed)
    for name, (base, tip) in chains(seed, tips).items():
        arm = ro.read_urdf("robot.urdf", base, tip, origins=True)
        q = drawn(arm, 60, rng)
        rows = np.hstack([q, between_links(Path("robot.urdf"), arm.names, base, tip, q)[:, :3, 3]])
        columns = [f"q{i}_{'rad' if d == 'angle' else 'm'}" for i, d in enumerate(arm.robot.joint_dimensions, 1)]
        text_of = [",".join(map(repr, row)) for row in rows.tolist()]
        Path(f"{name}.csv").write_text("\n".join([",".join([*columns, "x_m", "y_m", "z_m"]), *text_of]) + "\n")
        lines += [f"[chain.{name}]", f'urdf_base = "{base}"', f'urdf_tip = "{tip}"', f'identification = "{name}.csv"']
        lines += [f'validation = "{name}.csv"'] if name == "left" else []
    Path("problem.toml").write_text("\n".join(lines) + "\n")


def test_chains_share_what_they_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tracker's place is that of two chains; joints of two chains of three are no parameters of the third."""
    arms = 'identify = ["origin_*", "base_*"]\nshared = { left = ["base_*"], right = ["base_*"] }'
    folder(monkeypatch, tmp_path, arms)
    whole = ro.load(".")
    names = whole.problem.parameters.free.names
    assert {"base_x", "head.base_x", "origin_j_1_x"} <= set(names)
    assert not {"left.base_x", "right.base_x", "left.origin_j_1_x"} & set(names)
    assert set(whole.validation.robot) == {"left"}
    part = ro.load(".", chain="head").problem
    alone = whole.problem.alone("head")
    assert set(alone.parameters.names) == set(part.parameters.names)
    assert "origin_j_1_x" not in alone.parameters.names  # of the trunk, above both links
    x = np.random.default_rng(0).normal(size=len(names)) * whole.problem.parameters.free.scale
    values = dict(zip(names, x, strict=True))
    called = [whole.problem.parameters.called("head", name) for name in part.parameters.free.names]
    own = part.residual(np.array([values[name] for name in called]))
    assert np.array_equal(whole.problem.residual(x)[-len(own) :], own)
    assert run(monkeypatch, "inspect", ".") == 1  # the data of the folder are computed ones, which is said
    Path("problem.toml").write_text(Path("problem.toml").read_text().replace("right = [", "rigt = ["))
    with pytest.raises(ro.InputError, match=r"together, shared: found 'rigt', accepted: left, right, head.*mean right"):
        ro.load(".")
    with pytest.raises(ro.InputError, match=r"found 'base_\*', accepted: patterns in a list"):
        ro.together(left=part, right=part, shared={"left": "base_*"})


def test_auto_takes_origins_in_the_place_of_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder(monkeypatch, tmp_path, 'identify = "auto"')
    names = ro.load(".", chain="left").problem.parameters.free.names
    assert {name.split("_")[0] for name in names} == {"origin", "base", "tool"}
    mounts = ro.load(".", chain="left").problem.parameters.identify(["mount_*"]).free
    assert mounts.scale.tolist() == [0.01] * 6
    Path("problem.toml").write_text(Path("problem.toml").read_text().replace('"robot.urdf"', '"ur5e"'))
    with pytest.raises(ro.InputError, match=r"key chain.*'ur5e'.*a file \.urdf"):
        ro.load(".")


def test_origins_of_another_robot_are_not_written(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(random_tree(0)[0])
    with pytest.raises(ro.InputError, match=r"parameters origin_torso_\*: found no such joint"):
        ro.robot.write_origins(path, {"origin_torso_": np.zeros(6)}, tmp_path / "new.urdf")


def test_two_hands_on_one_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Touches of one plane by two tips of a tree: those of other places lie in one plane, too, after and not before."""
    monkeypatch.chdir(tmp_path)
    seed, count = 4, 60
    content, tips = random_tree(seed)
    Path("robot.urdf").write_text(content)
    with_errors(Path("robot.urdf"), Path("true.urdf"), seed)
    rng = np.random.default_rng(seed)
    lines = ['title = "table"', 'robot = "robot.urdf"', 'measurement = "revisit"', 'identify = ["origin_*"]']
    lines += ["[noise]", "position_mm = 0.1"]
    others = {}
    for name, tip in (("left", tips[0]), ("right", tips[1])):
        arm = ro.read_urdf("robot.urdf", "root", tip, origins=True)
        q = drawn(arm, 400, rng)

        def heights(q: np.ndarray, names: tuple[str, ...] = arm.names, tip: str = tip) -> np.ndarray:
            return between_links(Path("true.urdf"), names, "root", tip, q)[:, 2, 3]

        for _ in range(15):  # Newton steps of least length onto the table
            z = heights(q)
            slopes = np.stack([(heights(q + 1e-6 * e) - z) / 1e-6 for e in np.eye(len(q[0]))], axis=1)
            q = q - ((z - 0.2) / (1e-3 + np.sum(slopes**2, axis=1)))[:, None] * slopes
        q = q[(np.abs(heights(q) - 0.2) < 1e-6) & (np.abs(q).max(axis=1) < 3)]
        others[name] = q[count:]
        columns = [f"q{i}_{'rad' if d == 'angle' else 'm'}" for i, d in enumerate(arm.robot.joint_dimensions, 1)]
        rows = [",".join([*map(repr, row), "table"]) for row in q[:count].tolist()]
        Path(f"{name}.csv").write_text("\n".join([",".join([*columns, "plane"]), *rows]) + "\n")
        lines += [f"[chain.{name}]", 'urdf_base = "root"', f'urdf_tip = "{tip}"', f'identification = "{name}.csv"']
    Path("problem.toml").write_text("\n".join(lines) + "\n")
    problem = ro.load(".").problem
    assert len(problem.touches.rows) == 1
    result = ro.calibrate(problem)

    def off(x: np.ndarray) -> float:
        """Return how far other touches are from the plane that fits them best [m, RMS]."""
        read = [
            result.problem.on(ro.Dataset.of_robots({name: ro.Dataset.of(q, np.zeros((len(q), 3)), 1e-4)})).modelled(x)[
                0
            ]
            for name, q in others.items()
        ]
        p = np.concatenate(read)
        return float(np.linalg.svd(p - p.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(p)))

    assert min(map(len, others.values())) > 50
    assert off(result.x) < 1e-4 < 1e-3 < off(0 * result.x)


def test_joints_whose_parameters_would_have_one_name_are_refused(tmp_path: Path) -> None:
    links = "".join(f'<link name="l{i}"/>' for i in range(3))
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/><axis xyz="0 0 1"/></joint>'
        for i, name in enumerate(["arm-1", "arm_1"])
    )
    (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{links}{joints}</robot>')
    with pytest.raises(ro.InputError, match=r"the parameters origin_arm_1_\* of joint 'arm-1', too"):
        ro.read_urdf(tmp_path / "arm.urdf", origins=True)


JOINT = (
    '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/>'
    '<origin xyz="{}" rpy="{}"/><axis xyz="0 0 1"/>{}</joint>'
)


def two_arms() -> str:
    """Return two arms on a torso, whose first axes are one line, each with a fourth joint that follows its second."""
    joints, links = [JOINT.format("torso", "revolute", "base", "chest", "0 0 0.9", "0 0 0", "")], ["base", "chest"]
    for side, y in (("left", 0.2), ("right", -0.2)):
        above = "chest"
        for i, place in enumerate([f"0 {y} 0.3", "0 0 0.1", "0 0.3 0", "0 0 0.05", "0 0.3 0", "0 0 0.15"], start=1):
            links.append(f"{side}_{i}")
            kind, tilt = ("fixed", 0) if i == 6 else ("revolute", np.sign(y) * np.pi / 2 * (-1) ** i)
            follows = f'<mimic joint="{side}_joint_2" multiplier="-0.5" offset="0.1"/>' if i == 4 else ""
            joints.append(JOINT.format(f"{side}_joint_{i}", kind, above, links[-1], place, f"{tilt} 0 0", follows))
            above = links[-1]
    return f'<robot name="two arms">{"".join(f"<link name={n!r}/>" for n in links)}{"".join(joints)}</robot>'


def raw_table(name: str, base: str, tip: str, seed: int) -> None:
    """Write what a person measures of a chain of true.urdf, by the names of the joints [deg], [mm]."""
    rng = np.random.default_rng(seed)
    names = ro.read_urdf("arms.urdf", base, tip).names
    q = rng.uniform(-1.5, 1.5, (60, len(names)))
    y = between_links(Path("true.urdf"), names, base, tip, q)[:, :3, 3] + SIGMA * rng.normal(size=(60, 3))
    rows = [",".join(["Point", *(f"{joint} [deg]" for joint in names), "X [mm]", "Y [mm]", "Z [mm]"])]
    for i, row in enumerate(np.hstack([np.degrees(q), 1e3 * y]).tolist()):
        rows.append(",".join([f"P{i}", *map(repr, row)]))
    Path(f"{name}.csv").write_text("\n".join(rows) + "\n")


def off(tip: str, base: str, file: str) -> float:
    """Return the position error of a file [m, RMS], in the frame of the base link."""
    names = ro.read_urdf("arms.urdf", base, tip).names
    q = np.random.default_rng(9).uniform(-1.5, 1.5, (300, len(names)))
    p, true = (between_links(Path(each), names, base, tip, q)[:, :3, 3] for each in (file, "true.urdf"))
    return float(np.sqrt(np.mean((p - true) ** 2)))


def test_new_makes_a_tree_chain_by_chain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One arm's hand sees the other's, through axes that are one line; a tracker sees both; one file has it all."""
    monkeypatch.chdir(tmp_path)
    Path("arms.urdf").write_text(two_arms())
    with_errors(Path("arms.urdf"), Path("true.urdf"), 5)
    arms = ["--robot", "arms.urdf"]
    raw_table("meet", "left_6", "right_6", 1)
    made = ["new", "hands", *arms, "--data", "meet.csv", "--urdf-base", "left_6", "--urdf-tip", "right_6"]
    assert run(monkeypatch, *made, "--hold-out", "0.2") == 0
    assert "[chain.to_right_6]" in Path("hands/problem.toml").read_text()
    assert run(monkeypatch, "calibrate", "hands", "--model", "geometry", "--out", "hands") == 0
    assert run(monkeypatch, "export", "hands", "--urdf", "arms.urdf", "--out", "hands.urdf") == 0
    assert off("right_6", "left_6", "hands.urdf") < 0.1 * off("right_6", "left_6", "arms.urdf")

    for i, side in enumerate(("left", "right")):
        raw_table(side, "base", f"{side}_6", i)
        more = [*arms, "--data", f"{side}.csv", "--urdf-tip", f"{side}_6", "--chain", side]
        assert run(monkeypatch, "new", "cell", *more) == 0
    text = Path("cell/problem.toml").read_text()
    Path("cell/problem.toml").write_text(text.replace("shared = []", 'shared = ["base_*"]'))
    assert "shared" in capsys.readouterr().out
    parameters = ro.load("cell").problem.parameters
    shown = {"left.mount_left_joint_6_x", "origin_torso_x"}
    assert shown <= set(parameters.free.names)
    assert "base_x" in parameters.names
    assert run(monkeypatch, "calibrate", "cell", "--model", "geometry", "--out", "cell") == 0
    assert run(monkeypatch, "export", "cell", "--urdf", "arms.urdf", "--out", "cell.urdf") == 0
    assert off("left_6", "base", "cell.urdf") < 0.05 * off("left_6", "base", "arms.urdf")

    before = Path("cell/problem.toml").read_bytes()
    Path("other.urdf").write_text(two_arms().replace("0.9", "0.8"))
    for options, said in (
        ([*made[2:], "--chain", "left"], "'left', which exists"),
        (made[2:], "nothing is overwritten"),
        ([*made[2:], "--chain", "a.b"], "letters, digits and _"),
        ([*made[2:4], "--chain", "c", *made[4:], "--robot", "other.urdf"], "the same URDF"),
        (["--robot", "ur5e", "--data", "meet.csv", "--chain", "c"], "robot.urdf"),
    ):
        assert run(monkeypatch, "new", "cell", *options) == 2
        assert said in capsys.readouterr().err
    assert run(monkeypatch, "new", "ready", "--robot", "ur5e", "--data", "meet.csv", "--chain", "c") == 2
    assert Path("cell/problem.toml").read_bytes() == before


def test_multipliers_of_joints_that_follow_are_identified(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As ratio of the table's row: the file's multiplier is what moved the joint."""
    monkeypatch.chdir(tmp_path)
    Path("arms.urdf").write_text(two_arms())
    Path("true.urdf").write_text(two_arms().replace("-0.5", "-0.49"))
    raw_table("left", "chest", "left_6", 3)
    options = ["--robot", "arms.urdf", "--data", "left.csv", "--urdf-base", "chest", "--urdf-tip", "left_6"]
    assert run(monkeypatch, "new", "arm", *options) == 0
    text = Path("arm/problem.toml").read_text()
    start = text.rindex("identify = ")
    Path("arm/problem.toml").write_text(text[:start] + 'identify = ["ratio4"]\n' + text[text.index("\n", start) :])
    assert "Joints 4 follow others" in text
    assert run(monkeypatch, "calibrate", "arm", "--model", "geometry", "--out", "arm") == 0
    assert run(monkeypatch, "export", "arm", "--urdf", "arms.urdf", "--out", "new.urdf", *options[4:]) == 0
    assert off("left_6", "chest", "new.urdf") < 1e-4 < 1e-3 < off("left_6", "chest", "arms.urdf")
    multipliers = [float(each.get("multiplier")) for each in ElementTree.parse("new.urdf").getroot().iter("mimic")]
    assert multipliers == [pytest.approx(-0.49, abs=1e-3), -0.5]


def test_one_joint_off_its_zero_leaves_the_others_where_they_are(tmp_path: Path) -> None:
    """Origins have tails and scales by kind: with a joint a degree off, positions elsewhere are as good as without."""
    (tmp_path / "arms.urdf").write_text(two_arms())
    rng = np.random.default_rng(3)
    parts, new = {}, {}
    for side in ("left", "right"):
        arm = ro.read_urdf(tmp_path / "arms.urdf", "base", f"{side}_6", origins=True)
        q = rng.uniform(-1.5, 1.5, (315, arm.robot.dof))
        data = ro.Dataset.of(q[:15], np.zeros((15, 3)), SIGMA)
        parts[side] = ro.problem_from(arm, data, identify=["origin_*"], base=arm.base)
        new[side] = ro.Dataset.of(q[15:], np.zeros((300, 3)), SIGMA)
    problem = ro.together(**parts, shared=["origin_*"])
    elsewhere = problem.on(ro.Dataset.of_robots(new))
    free = problem.parameters.free
    small = 2e-4 * rng.normal(size=len(free))
    noise = [SIGMA * rng.normal(size=y.shape) for y in problem.modelled(small)]
    errors = []
    for turn in (0.0, np.radians(1)):
        x = small + turn * (np.array(free.names) == "right.origin_right_joint_3_rz")
        measured = [y + e for y, e in zip(problem.modelled(x), noise, strict=True)]
        data = {side: ro.Dataset.of(parts[side].data.q, y, SIGMA) for side, y in zip(parts, measured, strict=True)}
        result = ro.calibrate(problem.on(ro.Dataset.of_robots(data)))
        assert result.learned is not None
        assert {"lengths", "angles"} <= set(result.learned.scales)
        missed = np.concatenate(elsewhere.modelled(x)) - np.concatenate(elsewhere.modelled(result.x))
        errors.append(np.sqrt(np.mean(missed**2)))
    assert errors[1] < 1.1 * errors[0]


@pytest.mark.parametrize("stated", [{"tip": "tip0"}, {"root": "root"}, {"tip_measured": True}, {"robot": "left"}])
def test_ends_of_one_chain_are_refused_where_all_origins_are_written(
    stated: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder(monkeypatch, tmp_path, 'identify = ["origin_*"]')
    result = ro.calibrate(ro.load(".").problem, ro.tikhonov, weight=1.0)
    (name,) = stated
    with pytest.raises(ro.InputError, match=f"origins: found {name}, accepted: none of these.*mount_"):
        ro.use.export_files(result, Path("new.urdf"), urdf=Path("robot.urdf"), despite_verdict=True, **stated)
    assert not Path("new.urdf").exists()


def test_what_a_urdf_does_not_hold_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder(monkeypatch, tmp_path, 'identify = ["origin_*", "ratio1"]')
    result = ro.calibrate(ro.load(".").problem, ro.tikhonov, weight=1.0)
    moved = replace(result, x=np.full(len(result.x), 1e-6))
    with pytest.raises(ro.InputError, match=r"found left.ratio1, .*accepted: origins"):
        ro.use.export_files(moved, "new.urdf", urdf="robot.urdf", despite_verdict=True)
