"""What belongs to an exported robot besides its file: tool and base, as the one who enters them has them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.robot.kinematics import forward_kinematics
from rpim_opt.robot.library import read_arm
from tests.robot.test_exchange import CONF, UR10, YAML, configurations, reach, yaml_kinematics
from tests.simulate import ARM, simulated


def poses(text: str) -> list[Array]:
    """Return the frames (4, 4) that a text states as PolyScope does: mm, and a rotation vector in rad."""
    number = r"(-?[\d.]+)"
    frames = []
    for six in re.findall(rf"X {number} Y {number} Z {number} mm, RX {number} RY {number} RZ {number} rad", text):
        T = np.eye(4)
        T[:3, 3] = 1e-3 * np.array(six[:3], dtype=float)
        T[:3, :3] = Rotation.from_rotvec(np.array(six[3:], dtype=float)).as_matrix()
        frames.append(T)
    return frames


@pytest.mark.parametrize("ros", [False, True])
@pytest.mark.parametrize("file", ["calibration.conf", "kinematics.yaml"])
def test_files_of_universal_robots_state_the_tcp_and_the_base_that_belong_to_them(
    tmp_path: Path, file: str, ros: bool
) -> None:
    """File, TCP and Base together are the calibrated robot, whichever base and table frame it was calibrated with."""
    path, target = tmp_path / file, tmp_path / f"new_{file}"
    path.write_text(CONF if file.endswith("conf") else YAML)
    nominal = UR10 if file.endswith("conf") else ro.robot.read_ur_kinematics(path).robot
    standing = nominal.mdh.copy()
    if ros:  # base_link, half a turn from the controller's Base
        standing *= [-1.0, -1.0, 1.0, 1.0, -1.0]
        standing[-1, 2] += np.pi
    else:  # on a table
        standing[0, 2:4] += 0.3, 0.77
    own = ("alpha[1456]", "a1", "d4", "a[34]", "theta[2-6]", "base_*", "tool_*")
    problem, truth = simulated(own, robot=replace(nominal, mdh=standing), configurations=40, noise=1e-5)
    result = replace(ro.calibrate(problem, "tikhonov", 1.0), x=truth)
    options = {"ur_calibration" if file.endswith("conf") else "ur_kinematics": path}
    ro.use.export_files(result, target, **options, despite_verdict=True)
    # once more, into what was exported: the shoulder has all six numbers now, and the file notes of its own
    path.write_bytes(target.read_bytes())
    ro.use.export_files(result, target, **options, despite_verdict=True)
    assert target.read_text().count("TCP to enter") == 1
    assert re.search(
        r"largest of the measured configurations\): the flange [\d.]+ mm and [\d.]+ mrad\.", target.read_text()
    )
    q = configurations(6)
    if file.endswith("conf"):
        flange = reach(ro.robot.read_ur_calibration(target, UR10), q)
    else:
        flange = yaml_kinematics(target.read_text(), q)
    tcp, base = poses(target.read_text())
    wanted = result.forward(q)
    missed = base @ flange @ tcp - wanted
    assert np.abs(missed[:, :3, 3]).max() < 4e-5  # a rotation of 1e-5 rad, as is printed, 2 m away, and micrometres
    assert np.abs(missed[:, :3, :3]).max() < 4e-5


@pytest.mark.parametrize("made", [{"mdh": "arm.csv", "dh": "standard"}, {"mdh": "arm.csv"}, {"robodk": "arm.csv"}])
def test_a_table_of_coupled_joints_says_how_the_controller_counts_them(tmp_path: Path, made: dict[str, str]) -> None:
    coupling = np.eye(6)
    coupling[2, 1] = -1.0
    carrying = ARM.gravity.carrying(20.0, (0.0, 0.0, 0.1))
    problem, truth = simulated(("theta?", "d[1346]"), robot=replace(ARM, joint_map=coupling, gravity=carrying))
    result = replace(ro.calibrate(problem, "tikhonov", 1.0), x=truth)
    file = tmp_path / "arm.csv"
    notes = " ".join(ro.use.export_files(result, **{**made, next(iter(made)): file}, despite_verdict=True).notes)
    assert "arm.csv: for joint values q of the calibration, its joint 3 is at -1 q2 +1 q3" in notes
    assert "arm.csv lacks base and tool: base x 0.000" in notes
    q = configurations(6)
    read = read_arm(file, convention="modified" if "robodk" in made else "").robot
    missed = forward_kinematics(read, q @ coupling.T) - forward_kinematics(result.robot, q)
    assert np.abs(missed).max() < 1e-9  # nine decimals of mm and degrees
