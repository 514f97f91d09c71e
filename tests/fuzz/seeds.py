"""What fuzzing starts from: files that are read, one or several a parser, and words that files have."""

from __future__ import annotations

import re
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

import rpim_opt as ro
from rpim_opt.robot.library import find_robot
from rpim_opt.store import problems_folder

CORPUS = Path(__file__).with_name("corpus")
PROBLEM = (
    'title = "T"\nsource = "S"\nrobot = "robot.toml"\nmeasurement = "position"\nidentification = "identification.csv"\n'
    'validation = "validation.csv"\nselector = "l_curve"\nformulation = "bounded"\nidentify = ["d?", "beta4"]\n'
    "[noise]\nposition_mm = 0.03\n[scale]\nlength_mm = 1.0\nangle_mrad = 2\n[base]\nx_mm = 10\nrz_deg = 90\n"
    "[tool]\nz_mm = 50.0\n[tolerance]\nlength_mm = 5\nangle_deg = 1\n[variant.other]\nselector = \"gcv\"\n"
)  # fmt: skip
SENTENCES = (
    "a2 = 560 mm", "d2 + d3 = 850.00 +- 0.05 mm", "|theta2 - theta3| <= 0.1 deg", "norm(theta1, theta2) <= 2 mrad",
    "d1 - 2*d2 >= -5 mm", "move at most 5 mm: home, workspace", "a2 = a3", "theta? = nominal +- 0.2 deg",
    "a2 ± 0.05 mm", "d[12] = 0.5 m", "|a2 - 3 mm| <= 1e-3 m",
)  # fmt: skip
KNOWN = (
    "a2 + a3 = nominal +- 0.05 mm", "a2 - 0.5 a3 = nominal +- 0.05 mm", "d5 +- 0.1 mm", "beta4 +- 1 mrad",
    "d2 = 106.95 +- 0.05 mm", "theta2 - theta3 = nominal +- 0.2 deg",
)  # fmt: skip
URDF = """<?xml version="1.0"?>
<robot name="two"><!-- c -->
<link name="base"/><link name="arm"/><link name="hand"/><link name="tip"/>
<joint name="j1" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.3" rpy="0 0 0"/>
<axis xyz="0 0 2"/><limit lower="-2" upper="1.5" effort="1" velocity="1"/></joint>
<joint name="j2" type="continuous"><parent link="arm"/><child link="hand"/>
<origin xyz="0.5 0.1 0" rpy="1.5707963 0 0.2"/><axis xyz="0 1 0"/></joint>
<joint name="j3" type="prismatic"><parent link="hand"/><child link="tip"/>
<origin xyz="0 0 0"/><axis xyz="1 0 0"/></joint>
</robot>
"""
KINEMATICS = "kinematics:\n" + "".join(
    f"  {name}:\n    x: {x}\n    y: {y}\n    z: 0.1\n    roll: {roll}\n    pitch: 0.001\n    yaw: -1e-05\n"
    for name, x, y, roll in (
        ("shoulder", 0, 0, 0), ("upper_arm", 0, 0, 1.570796327), ("forearm", -0.425, 0, 0),
        ("wrist_1", -0.39225, 0, 0), ("wrist_2", 0, -0.09, 1.570796327), ("wrist_3", 0, 0.08, -1.570796327),
    )
)  # fmt: skip
KINEMATICS += "  hash: calib_12788084448423163542\n"
CONF = (
    "[mounting]\ndelta_theta = [ 1e-7, -0.26, 6.2, -5.9, -1e-6, 2e-6 ]\n"
    "delta_a = [ 1e-4, 5e-5, -3e-4, 2e-5, 5e-6, 0]\ndelta_d = [ 0.0002, 12.5, -10.4, -2.1, 3e-5, 1e-4]\n"
    "delta_alpha = [0.0003, 0.0008, -0.002, 1e-4, 5e-5, 0]\njoint_checksum = [ 0x1, 0x2 ]\n"
)
TRACKED = "label,q1_deg,q2_deg,x_mm,y_mm,z_mm,sigma_mm,marker\nP1,0,10,100,200,300,0.01,A\nP2,5.5,-1e1,1,2,3,0.02,B\n"
POSES = "label,q1_deg,q2_deg,x_mm,y_mm,z_mm,qw,qx,qy,qz\nP1,0,10,100,200,300,1,0,0,0\nP2,5.5,-1,1,2,3,0.6,0.8,0,0\n"
ANGLES = "q1_rad,q2_rad,x_m,y_m,z_m,rx_deg,ry_deg,rz_deg,sigma_x_mm,cov_x_y_mm2\n0,1,.1,.2,.3,10,20,30,0.1,0.001\n"
CABLES = "label,q1_deg,q2_deg,length_mm,fixture,tau1_Nm,tau2_Nm,payload_kg\nP1,0,10,100,A,1,-2,3\nP2,5,-1,1,B,0,0,0\n"
PAIRS = "label,q1_deg,q2_deg,to_q1_deg,to_q2_deg,distance_mm,u95_mm\nP1,0,10,20,30,100,0.05\nP2,5,-1,3,4,50,0.05\n"
FLAT = "label,q1_deg,q2_deg,fixture,approach1,approach2\nP1,0,10,table,1,-1\nP2,5,-1,table,0,1\nP3,1,1,table,1,1\n"
TOUCHED = "label,q1_deg,q2_deg,point\nP1,0,10,S1\nP2,5,-1,S1\nP3,1,1,S2\nP4,2,2,S2\n"
PLANES = "label,q1_deg,q2_deg,plane,configuration\nP1,0,10,A,1\nP2,5,-1,A,1\nP3,1,1,A,2\nP4,2,2,B,3\n"
RAW = (
    "Point,A1,A2,X [mm],Y [mm],Z [mm]\nP1,0,-90,10,20,30\nP2,5,-80,0,0,10\n",
    "Point;J1;J2;X;Y;Z\nP1;0,5;-90;10,25;20;30\nP2;5;-80;0;0;10,125\n",
    "# comment\nname\tq1_deg\tq2_deg\tx_m\ty_m\tz_m\nP1\t0\t1\t.1\t.2\t.3\n",
    "q1 q2 x y z\n0 10 100 200 300\n1 20 101 202 303\n",
    "|a|b|\n|1|2|\n",
)
WORDS_OF_FILES = re.compile(rb"[A-Za-z_][A-Za-z_0-9]*")


def _problems() -> list[str]:
    """Return the problem files that come along."""
    return [PROBLEM, *(path.read_text(encoding="utf-8") for path in sorted(problems_folder().glob("*/problem.toml")))]


def _robots() -> list[str]:
    texts = [find_robot(name).read_text(encoding="utf-8") for name in ("ur5e", "irb120", "iiwa14")]
    texts += [(problems_folder() / name / "robot.toml").read_text(encoding="utf-8") for name in ("scara", "paper_arm")]
    return texts


def _tables_of_robots(ending: str) -> list[str]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"robot{ending}"
        ro.robot.write_robot(ro.read_robot(find_robot("irb120")), path)
        return [path.read_text(encoding="utf-8")]


def make_cell(folder: Path) -> None:
    """Make a problem folder that is quick to read: twelve positions of an arm with two joints."""
    folder.mkdir(parents=True)
    arm = ro.robot.Robot(
        "two", np.array([[0.0, 0, 0, 0.3, 0], [1.5, 0.4, 0, 0, 0]]), limits=np.array([[-2.0, 2.0]] * 2)
    )
    ro.robot.write_robot(arm, folder / "robot.toml")
    rng = np.random.default_rng(0)
    q = np.degrees(rng.uniform(-2, 2, (12, 2)))
    T = ro.robot.forward_kinematics(arm, np.radians(q))
    points = 1e3 * T[:, :3, 3] + rng.normal(0, 0.2, (12, 3))
    rows = [f"P{i}," + ",".join(f"{v:.6f}" for v in (*q[i], *points[i])) + "\n" for i in range(12)]
    (folder / "identification.csv").write_text("label,q1_deg,q2_deg,x_mm,y_mm,z_mm\n" + "".join(rows))
    (folder / "problem.toml").write_text(
        'title = "T"\nrobot = "robot.toml"\nidentification = "identification.csv"\nidentify = ["d?", "a2", "theta?"]\n'
        "[noise]\nposition_mm = 0.2\n[scale]\nlength_mm = 1\nangle_mrad = 1\n"
        "[tolerance]\nlength_mm = 5\nangle_deg = 1\n"
    )


def _results() -> list[str]:
    texts = []
    with tempfile.TemporaryDirectory() as folder:
        make_cell(Path(folder) / "cell")
        instance = ro.load(Path(folder) / "cell")
        for formulation, weight in ((ro.bounded, 0.1), (ro.tikhonov, ro.l_curve)):
            result = ro.calibrate(instance.problem, formulation, weight)
            path = Path(folder) / "result.json"
            ro.store.save_result(replace(result, record=instance.record), path)
            texts.append(path.read_text(encoding="utf-8"))
    return texts


def _targets() -> list[str]:
    return [
        "label,q1_deg,q2_deg\nA,0,10\nB,1,2\n",
        "label,q1_deg,q2_deg,x_mm,y_mm,z_mm,qw,qx,qy,qz,payload_kg\nA,0,10,1,2,3,1,0,0,0,2\n",
        "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n100,200,300,0,90,0\n",
        "q1_deg,q2_deg,tau1_Nm,tau2_Nm\n0,10,1,2\n",
    ]


def _options() -> list[str]:
    return ["deg,mm", "rad,m", "0,0,100,0,90,0", "2.5,0,0,100", "tikhonov,robust", "learned,1.0", "1,3", "l_curve",
    "d?",
            "0.25", "folder,5", "x_mm,y_mm", "lasso", "reml", "k_fold"]  # fmt: skip


MAKERS = {
    "problem": _problems,
    "robot": _robots,
    "robot_json": lambda: _tables_of_robots(".json"),
    "robot_csv": lambda: _tables_of_robots(".csv"),
    "table": lambda: [TRACKED, POSES, ANGLES, CABLES, PAIRS, FLAT, TOUCHED, PLANES],
    "raw": lambda: [*RAW, TRACKED, POSES, TOUCHED],
    "targets": _targets,
    "urdf": lambda: [URDF],
    "kinematics": lambda: [KINEMATICS],
    "calibration_conf": lambda: [CONF],
    "sentence": lambda: list(SENTENCES),
    "stated": lambda: [*KNOWN, *SENTENCES],
    "result": _results,
    "options": _options,
}


@cache
def seeds(name: str) -> list[bytes]:
    """Return what a parser's fuzzing starts from, with what was found before."""
    made = [text.encode() for text in MAKERS[name]()]
    return made + [path.read_bytes() for path in found(name)]


def found(name: str) -> list[Path]:
    """Return the files of inputs that once failed."""
    return sorted((CORPUS / name).glob("*"))


@cache
def words(name: str) -> list[bytes]:
    """Return the words that the seeds of a parser have."""
    known = {word for seed in seeds(name) for word in WORDS_OF_FILES.findall(seed) if len(word) < 30}
    return sorted(known) or [b"x"]
