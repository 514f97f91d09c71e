"""DH tables in the conventions of Craig, Paul and Hayati are one robot, through the command line and exactly."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.robot import write_robodk, write_robot
from rpim_opt.robot.formats.tables import read_sheet
from rpim_opt.robot.kinematics import numeric_frame, numeric_link
from rpim_opt.robot.library import read_arm
from tests.simulate import ARM
from tests.store.raw_files import HEAD, ROWS, text
from tests.test_cli import run

RNG = np.random.default_rng(4)
ALPHA = np.radians([-90.0, 0.0, -90.0, 90.0, -90.0, 30.0])
A = np.array([0.05, 0.44, 0.035, 0.0, 0.0, 0.02])
THETA = np.radians([0.0, -90.0, 0.0, 0.0, 180.0, 0.0])
D = np.array([0.33, 0.0, 0.02, 0.42, 0.0, 0.08])
BETA = np.array([0.0, 0.01, 0.0, 0.0, 0.0, 0.0])


def sheet(beta: np.ndarray | None = None, mark: str = ";", theta: str = "q{}{:+g}") -> str:
    """Return the table as people write it: the standard order, German decimals, variables with their offsets."""
    lines = [
        mark.join(["Joint", "theta [°]", "d [mm]", "a [mm]", "alpha [°]", *(["beta [°]"] if beta is not None else [])])
    ]
    for i in range(6):
        cells = [
            f"{i + 1}",
            theta.format(i + 1, round(np.degrees(THETA[i]), 6)),
            f"{1e3 * D[i]:.3f}",
            f"{1e3 * A[i]:.3f}",
        ]
        cells += [f"{np.degrees(ALPHA[i]):.3f}"] + ([repr(float(np.degrees(beta[i])))] if beta is not None else [])
        lines.append(mark.join(cell.replace(".", ",") for cell in cells))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("beta", [None, BETA])
def test_a_standard_table_reaches_the_same_poses(tmp_path: Path, beta: np.ndarray | None) -> None:
    path = tmp_path / "dh.csv"
    path.write_text(sheet(beta))
    arm = read_sheet(path, "standard" if beta is None else "hayati")
    q = RNG.uniform(-2, 2, (20, 6))
    tilt = np.zeros(6) if beta is None else beta
    found = numeric_frame(arm.base) @ ro.robot.forward_kinematics(arm.robot, q) @ numeric_frame(arm.tool)
    for row, T in zip(q, found, strict=True):
        truth = np.eye(4)
        for i in range(6):
            truth = truth @ numeric_link(theta=THETA[i] + row[i], d=D[i]) @ numeric_link(ALPHA[i], A[i])
            truth = truth @ numeric_link(beta=tilt[i])
        assert np.abs(T - truth).max() < 1e-12


def test_an_unknown_angle_of_a_sheet_is_offered_in_its_own_unit(tmp_path: Path) -> None:
    path = tmp_path / "arm.csv"
    path.write_text(sheet().replace("theta", "theta0"), encoding="utf-8")
    with pytest.raises(ro.InputError, match=r"unknown key 'theta0_deg'.*did you mean theta_deg"):
        read_sheet(path, "standard")


@pytest.mark.parametrize(
    ("cells", "turn"),
    [
        ("1.5708,0,-1.5708", "1.5708 is pi/2 rad"),
        ("0,-3.14,1.57", "3.1416 is pi rad"),
        ("90,0,1.5708", ""),
        ("1.6", ""),
    ],
)
def test_radians_in_a_column_of_degrees_are_named(tmp_path: Path, cells: str, turn: str) -> None:
    path = tmp_path / "dh.csv"
    path.write_text("alpha_deg,d_mm\n" + "".join(f"{cell},100\n" for cell in cells.split(",")))
    if not turn:
        assert len(read_sheet(path, "modified").robot.mdh) == len(cells.split(","))
        return
    with pytest.raises(ro.InputError, match=rf"dh.csv, column alpha_deg: found .* \({turn}: name the column alpha_rad"):
        read_sheet(path, "modified")


def test_a_table_that_does_not_say_its_convention_is_asked_for(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("dh.csv").write_text(sheet())
    Path("raw.csv").write_text(text([HEAD], ROWS))
    arguments = ["new", "cell", "--robot", "dh.csv", "--data", "raw.csv"]
    assert run(monkeypatch, *arguments) == 2
    error = capsys.readouterr().err.strip()
    assert "\n" not in error
    assert "--dh modified" in error
    assert "--dh standard" in error
    assert run(monkeypatch, *arguments, "--dh", "standard") == 0
    loaded = ro.load("cell").problem
    assert np.abs(loaded.robot.mdh[1:, 0] - ALPHA[:-1]).max() < 1e-12
    tool = dict(zip(loaded.parameters.names, loaded.parameters.nominal.tolist(), strict=True))
    assert tool["tool_x"] == pytest.approx(A[-1])
    assert tool["tool_rx"] == pytest.approx(ALPHA[-1])


def test_a_remark_below_a_table_is_no_row_of_it(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("dh.csv").write_text(sheet() + "\nPayload;12 kg;;;\n")
    Path("raw.csv").write_text(text([HEAD], ROWS))
    assert run(monkeypatch, "new", "cell", "--robot", "dh.csv", "--dh", "standard", "--data", "raw.csv") == 0
    assert "\ndh.csv, line 9 is not a row of the table: 'Payload, 12 kg' ignored.\n" in capsys.readouterr().out
    assert ro.load("cell").problem.robot.dof == 6


@pytest.mark.parametrize(
    "row", ["7;theta7;8O;none;O", "7;;85;;", "Flange;;85;;", "Joint 7;;;;", "Joint;theta;d;a;alpha"]
)
def test_a_row_of_a_sheet_is_not_lost(tmp_path: Path, row: str) -> None:
    path = tmp_path / "dh.csv"
    path.write_text(f"{sheet()}{row}\n")
    with pytest.raises(ro.InputError, match=f"'{row.split(';')[0]}.*accepted: one row per joint"):
        read_sheet(path, "standard")


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("i,alpha(i-1) [deg],a(i-1) [mm],d [mm],theta [deg]", "modified"),
        ("i,alpha_i-1 [°],a_i-1 [mm],d_i [mm],theta offset [°]", "modified"),
        ("Gelenk,alpha(i-1) [°],a(i-1) [mm],d(i) [mm],theta(i) Offset [°]", "modified"),
        ("i,alpha_i-1 [deg],a_i-1 [mm],d_i [mm],theta_i [deg]", "modified"),
        ("i,alpha [deg],a [mm],d [mm],theta [deg]", ""),
    ],
)
def test_an_index_of_the_link_before_says_that_it_is_modified(tmp_path: Path, header: str, said: str) -> None:
    path = tmp_path / "dh.csv"
    path.write_text(f"{header}\n1,0,0,330,0\n2,-90,50,0,-90\n")
    if said:
        assert read_sheet(path).robot.mdh[1, 1] == pytest.approx(0.05)
    else:
        with pytest.raises(ro.InputError, match="not stated"):
            read_sheet(path)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        (
            "dh.csv",
            "KR 6 R900;;;;;;\nJoint;1;2;3;4;5;6\na [mm];25;455;35;0;0;0\nalpha [deg];-90;0;-90;90;-90;0\n"
            "d [mm];400;0;0;420;0;80\ntheta;q1;q2;q3 - 90\u00b0;q4;q5;q6\n",
        ),
        (
            "dh.md",
            "# KR 6 R900\n\n| Kinematics | theta [rad] | a [m] | d [m] | alpha |\n|---|---|---|---|---|\n"
            "| Joint 1 | 0 | 0.025 | 0.4 | \u2212\u03c0/2 |\n| Joint 2 | 0 | 0.455 | 0 | 0 |\n"
            "| Joint 3 | -pi/2 | 0.035 | 0 | -pi/2 |\n| Joint 4 | 0 | 0 | 0.42 | 0.5 * pi |\n"
            "| Joint 5 | 0 | 0 | 0 | -\u03c0/2 |\n| Joint 6 | 0 | 0 | 0.08 | 0 |\n",
        ),
        (
            "toolbox.txt",
            "DHRobot: KR 6 R900, 6 joints (RRRRRR), standard DH parameters\n┌──┬──┬──┬──┐\n"
            "│ θⱼ │ dⱼ [m] │ aⱼ [m] │ \u237aⱼ │\n├──┼──┼──┼──┤\n│ q1 │ 0.4 │ 0.025 │ -90.0° │\n"
            "│ q2 │ 0 │ 0.455 │ 0.0° │\n│ q3 - 90° │ 0 │ 0.035 │ -90.0° │\n│ q4 │ 0.42 │ 0 │ 90.0° │\n"
            "│ q5 │ 0 │ 0 │ -90.0° │\n│ q6 │ 0.08 │ 0 │ 0.0° │\n└──┴──┴──┴──┘\n",
        ),
        (
            "units.csv",
            "Units: m\nAchse,theta-Offset,a,d,alpha [rad]\n1,0,0.025,0.4,-pi/2\n2,0,0.455,0,0\n3,-pi/2,0.035,0,-pi/2\n"
            "4,0,0,0.42,pi/2\n5,0,0,0,-pi/2\n6,0,0,0.08,0\n",
        ),
        (
            "plain.csv",
            "i,theta_i,a_i [mm],d_i [mm],alpha_i [deg]\n1,q1,25,400,-90\n2,q2,455,0,0\n3,q3-90,35,0,-90\n"
            "4,q4,0,420,90\n5,q5,0,0,-90\n6,q6,0,80,0\n",
        ),
        (
            "toolbox.m",
            "% KR 6 R900, L(7) = Link([0 1 1 0])\nL(1) = Link([0 0.4 0.025 -pi/2]);\n"
            "L(2) = Link([0, 0, 0.455, 0, 0]);\n"
            "L(3) = Link('a', 0.035, 'offset', -pi/2, 'alpha', -90*pi/180, ...\n  'qlim', [-pi pi]);\n"
            'L(4) = Link([0 0.42 0 pi/2], "standard");\nL(5) = Revolute(\'alpha\', -pi/2);\n'
            "L(6) = Link('revolute', 'd', 0.08);\nrobot = SerialLink(L, 'name', 'KR 6');\n",
        ),
        (
            "toolbox.py",
            "from math import pi  # RevoluteDH(d=1) was tried first\nrobot = DHRobot([\n"
            "    RevoluteDH(d=0.4, a=0.025, alpha=-pi/2), RevoluteDH(a=0.455),\n"
            "    RevoluteDH(a=0.035, alpha=-np.pi / 2, offset=np.deg2rad(-90), qlim=[-pi, pi]),\n"
            "    DHLink(d=0.42, alpha=pi/2), RevoluteDH(alpha=-pi/2), RevoluteDH(d=0.08)], name='KR 6')\n",
        ),
    ],
    ids=["a joint a column", "Markdown, parts of pi", "a box of lines", "a unit above the header", "names of angles",
         "a script for the Robotics Toolbox", "one in Python"],
)  # fmt: skip
def test_a_sheet_as_people_write_it_is_the_robot(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_text(content, encoding="utf-8")
    arm = read_arm(tmp_path / name, convention="standard")
    expected = np.array([[0, 0, 0, 0.4, 0], [-90, 0.025, 0, 0, 0], [0, 0.455, -90, 0, 0], [-90, 0.035, 0, 0.42, 0],
                         [90, 0, 0, 0, 0], [-90, 0, 0, 0.08, 0]])  # fmt: skip
    assert np.abs(arm.robot.mdh - expected * [np.pi / 180, 1, np.pi / 180, 1, 1]).max() < 1e-12


MODIFIED = (
    "L(1) = RevoluteMDH('d', 0.3);\nL(2) = Link('theta', pi/2, 'a', 0.3, 'alpha', pi, 'offset', 0.1, 'modified');\n"
    "L(3) = Link([0 9 0 0 1 0.2], 'modified');\n"
)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("scara.m", MODIFIED),
        ("scara.py", "[RevoluteMDH(d=0.3), PrismaticMDH(theta=pi/2, a=0.3, alpha=pi, offset=0.1),\n"
         "DHLink(sigma=1, offset=0.2, mdh=True)]"),
        ("scara.csv", "type,theta [deg],d [m],a [m],alpha [deg],convention\nR,0,0.3,0,0,Craig\n"
         "LIN,90,0.1,0.3,180,Craig\n"
         "T,0,0.2,0,0,Craig\n"),
    ],
)  # fmt: skip
def test_joints_that_slide_are_called_so_in_many_words(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_text(content, encoding="utf-8")
    robot = read_arm(tmp_path / name).robot
    expected = [[0, 0, 0, 0.3, 0], [np.pi, 0.3, np.pi / 2, 0.1, 0], [0, 0, 0, 0.2, 0]]
    assert robot.joint_types == ("revolute", "prismatic", "prismatic")
    np.testing.assert_allclose(robot.mdh, expected, atol=1e-15)


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("L(i) = Link(DH(i,:));", "a link: found 'DH(i,:)', accepted: numbers"),
        ("L(1) = Link('theta', 1, 'd', 2);", "a link: found"),
        ("robot = SerialLink(dh);", "no link of the Robotics Toolbox"),
        ("L(1) = Link([0 d1 0 0]);", "'d1'"),
        (MODIFIED + "L(4) = Link([0 0 0 0]);", "modified and standard"),
    ],
)
def test_a_script_without_numbers_is_refused(tmp_path: Path, script: str, said: str) -> None:
    (tmp_path / "robot.m").write_text(script)
    with pytest.raises(ro.InputError, match=re.escape(said)):
        read_arm(tmp_path / "robot.m")


@pytest.mark.parametrize(
    ("header", "turn", "said"),
    [
        ("theta,alpha [rad]", "-1.57079633", ""),
        ("theta,alpha [rad]", "q2 - 90", r"'theta' without a unit, accepted: theta \[deg\] or theta \[rad\]"),
        ("theta,alpha [deg]", "1.5708", "pi/2 rad"),
        ("theta,alpha", "0", "'theta' without a unit"),
    ],
)
def test_an_angle_without_a_unit_is_in_that_of_the_others(tmp_path: Path, header: str, turn: str, said: str) -> None:
    path = tmp_path / "dh.csv"
    path.write_text(f"d [m],a [m],{header}\n1,0,0,0\n0,1,{turn},0\n", encoding="utf-8")
    if said:
        with pytest.raises(ro.InputError, match=said):
            read_sheet(path, "standard")
    else:
        arm = read_sheet(path, "standard")
        assert arm.robot.mdh[1, 2] == pytest.approx(-np.pi / 2)
        assert "column 'theta' states no unit: rad, as the other angles are." in arm.notes


def test_units_that_no_header_states_are_those_of_the_option(tmp_path: Path) -> None:
    path = tmp_path / "dh.csv"
    path.write_text("alpha,a,theta,d\n0,0,0,0.4\n-1.2,0.3,0,0\n", encoding="utf-8")
    with pytest.raises(ro.InputError, match=r"'alpha' without a unit, accepted: .* or units deg,mm or rad,m"):
        read_arm(path, convention="modified")
    arm = read_arm(path, convention="modified", units={"angle": "rad", "length": "m"})
    assert arm.robot.mdh[1, :2].tolist() == [-1.2, 0.3]
    assert "column 'a' states no unit: m by --units." in arm.notes
    path.write_text("alpha [deg],a [mm],theta [deg],d [mm]\n-90,0.3,0,0\n", encoding="utf-8")
    arm = read_arm(path, convention="modified", units={"angle": "rad", "length": "m"})
    assert arm.robot.mdh[0, :2] == pytest.approx([-np.pi / 2, 0.0003])


@pytest.mark.parametrize(
    "cell", ["±170", "-170..170", "-170/+170", "-170 to 170", "± 170°", "-170°…170°", "-170 - 170"]
)
def test_both_limits_may_be_in_a_cell(tmp_path: Path, cell: str) -> None:
    path = tmp_path / "dh.csv"
    path.write_text(f"alpha [deg],d [mm],theta [deg],Range [deg]\n0,100.5,0,{cell}\n0,1,0,\n", encoding="utf-8")
    limits = read_sheet(path, "modified").robot.limits
    assert limits[0] == pytest.approx(np.radians([-170, 170]))
    assert np.isinf(limits[1]).all()


def test_a_written_table_has_one_system_of_units_and_reads_back_exactly(tmp_path: Path) -> None:
    path = tmp_path / "arm.csv"
    mdh = ARM.mdh + 1e-4 * RNG.normal(size=(6, 5))
    arm = ro.robot.Robot("arm", mdh)
    write_robot(arm, path)
    assert path.read_text().splitlines()[0] == "alpha_rad,a_m,theta_rad,d_m,beta_rad,convention"
    assert (read_sheet(path).robot.mdh == mdh).all()


def test_common_normals_far_away_are_warned_of(tmp_path: Path) -> None:
    mdh = ARM.mdh.copy()
    mdh[1, 4] = 1e-4
    (note,) = write_robodk(ro.robot.Robot("arm", mdh), tmp_path / "robodk.csv")
    assert "rounded to 0.0001 degrees cause" in note
    assert write_robodk(ARM, tmp_path / "plain.csv") == []
