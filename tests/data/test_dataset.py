"""Tables and parameters: units, standard deviations, scales and tolerances reach the equations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from tests.simulate import ARM

ARM2 = ro.robot.Robot("two joints", ARM.mdh[:2], ("revolute", "prismatic"))
NOISE = {"position_mm": 0.03}


def read(tmp_path: Path, text: str, noise: dict[str, float] | None = None) -> ro.Dataset:
    path = tmp_path / "data.csv"
    path.write_text(text, encoding="utf-8")
    return ro.read_data(path, ARM2, NOISE if noise is None else noise)


def test_labels_are_one_per_row() -> None:
    with pytest.raises(ro.InputError, match="label: found 1 names, accepted: 2, one per row"):
        ro.Dataset.of(np.zeros((2, 6)), np.zeros((2, 3)), 1e-4, label=("a",))


def test_units_of_the_header_are_converted(tmp_path: Path) -> None:
    mixed = read(tmp_path, "q1_mrad,q2_mm,x_m,y_mm,z_um\n500,20,1,2,3\n")
    assert mixed.q[0] == pytest.approx([0.5, 0.02])
    assert mixed.blocks[0].y[0] == pytest.approx([1.0, 2e-3, 3e-6])
    assert mixed.label == ("1",)
    assert mixed.blocks[0].covariance[0] == pytest.approx(9e-10 * np.eye(3))


def test_a_row_may_state_its_own_standard_deviations(tmp_path: Path) -> None:
    head = "label,q1_deg,q2_mm,x_mm,y_mm,z_mm"
    row = read(tmp_path, f"{head},sigma_mm\na,0,0,0,0,0,0.1\nb,0,0,0,0,0,0.2\n")
    assert row.blocks[0].covariance == pytest.approx(np.array([1e-8, 4e-8])[:, None, None] * np.eye(3))
    axis = read(tmp_path, f"{head},sigma_z_mm\na,0,0,0,0,0,0.1\n")
    assert np.sqrt(np.diag(axis.blocks[0].covariance[0])) == pytest.approx([3e-5, 3e-5, 1e-4])
    declared = read(tmp_path, f"{head}\na,0,0,0,0,0\n", {"x_mm": 1, "y_mm": 2, "z_mm": 3})
    assert np.sqrt(np.diag(declared.blocks[0].covariance[0])) == pytest.approx([1e-3, 2e-3, 3e-3])


def test_standard_deviations_are_asked_for_and_positive(tmp_path: Path) -> None:
    with pytest.raises(ro.InputError, match="no standard deviation for 'x', accepted: position_mm"):
        read(tmp_path, "q1_deg,q2_mm,x_mm,y_mm,z_mm\n0,0,0,0,0\n", {})
    with pytest.raises(ro.InputError, match="row b, column sigma_mm: found 0, accepted: an uncertainty"):
        read(tmp_path, "label,q1_deg,q2_mm,x_mm,y_mm,z_mm,sigma_mm\na,0,0,0,0,0,1\nb,0,0,0,0,0,0\n")


def test_rows_of_one_configuration_stay_together(tmp_path: Path) -> None:
    head = "configuration,q1_deg,q2_mm,x_mm,y_mm,z_mm"
    data = read(tmp_path, f"{head}\nA,0,0,0,0,0\nB,1,0,0,0,0\nA,0,0,0,0,0\n")
    parameters = ro.robot.model_parameters(ARM2).identify(["a?"])
    group = ro.CalibrationProblem(ARM2, parameters, data).linearize(np.zeros(2)).group
    assert group.tolist() == [0, 0, 0, 1, 1, 1, 0, 0, 0]


def test_a_prismatic_joint_wants_a_length(tmp_path: Path) -> None:
    with pytest.raises(
        ro.InputError, match="'q2_deg' without a unit of the right dimension, accepted: q2_m, q2_mm, q2_um"
    ):
        read(tmp_path, "q1_deg,q2_deg,x_mm,y_mm,z_mm\n0,0,0,0,0\n")


def test_a_single_parameters_scale_goes_before_a_patterns_before_a_groups() -> None:
    table = ro.robot.model_parameters(ARM).scaled({"d2_mm": 3, "d?_mm": 2, "length_mm": 4, "tool_mm": 7})
    scale = dict(zip(table.names, table.scale, strict=True))
    assert [scale[n] for n in ("d2", "d3", "a3", "tool_x")] == pytest.approx([3e-3, 2e-3, 4e-3, 7e-3])
    assert scale["alpha1"] == pytest.approx(1e-3)
    assert scale["base_x"] == pytest.approx(0.1)


def test_limits_carry_the_unit_of_their_joint(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text('name = "r"\n[[joint]]\nlimits_deg = [-90, 180]\n')
    assert ro.read_robot(path).limits[0] == pytest.approx([-np.pi / 2, np.pi])
    path.write_text('name = "r"\n[[joint]]\ntype = "prismatic"\nlimits_deg = [-90, 180]\n')
    with pytest.raises(ro.InputError, match=r"joint 1.limits_deg: found a unit that does not fit.*limits_mm"):
        ro.read_robot(path)
    path.write_text('name = "r"\ncoupling = [[1, 0]]\n[[joint]]\n')
    with pytest.raises(ro.InputError, match=r"coupling: .* 1 rows of equal length, at most 1 number"):
        ro.read_robot(path)


def test_a_ready_measurement_is_known_by_its_name() -> None:
    data = ro.Dataset.of(np.zeros((2, 6)), [[0.3], [0.4]], 1e-4, measurement="cable")
    assert list(data.blocks[0].measurement.columns) == ["distance"]
    with pytest.raises(ro.InputError, match=r"measurement: found 'cabel', accepted: .*did you mean cable"):
        ro.Dataset.of(np.zeros((2, 6)), [[0.3], [0.4]], 1e-4, measurement="cabel")


def test_sigmas_of_components_and_poses_as_transforms() -> None:
    q = np.zeros((2, 6))
    data = ro.Dataset.of(q, np.zeros((2, 3)), sigma=[1e-5, 2e-5, 3e-5])
    assert data.blocks[0].covariance[0] == pytest.approx(np.diag([1e-10, 4e-10, 9e-10]))
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1] = [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    half = np.sqrt(0.5)
    poses = ro.Dataset.of(q, T, sigma=1e-5, measurement="pose")
    assert poses.blocks[0].y[1] == pytest.approx([0.1, 0.2, 0.3, half, 0, 0, half])
    T[1, 0, 0] = 0.5
    with pytest.raises(ro.InputError, match="y, row 2: found a matrix that violates"):
        ro.Dataset.of(q, T, sigma=1e-5, measurement="pose")


@pytest.mark.parametrize(
    ("q", "y", "sigma", "sentence"),
    [
        (np.full((2, 6), np.nan), np.zeros((2, 3)), 1e-5, r"q, row 1: found \[nan, .*accepted: finite numbers"),
        ([], [], 1e-5, "q: found no rows, accepted: one or more"),
        (np.zeros((2, 6)), [[0.0, 0.0, 0.0], [0.0, np.inf, 0.0]], 1e-5, r"y, row 2: found \[0.0, inf, 0.0\]"),
        (
            np.zeros((2, 6)),
            np.zeros((3, 3)),
            1e-5,
            r"shapes \(2, 6\) and \(3, 3\), accepted: \(N, dof\) joint values and \(N, 3\)",
        ),
        (np.zeros((2, 6)), np.zeros((2, 3)), np.full((3, 2), 1e-5), r"\(2,\) or \(2, 3\) for the rows"),
        (np.zeros((2, 6)), np.zeros((2, 3)), [1e-5, 0.0, 1e-5], r"sigma: found \[1e-05, 0.0, 1e-05\]"),
    ],
)
def test_arrays_that_do_not_fit(q: np.ndarray, y: np.ndarray, sigma: object, sentence: str) -> None:
    with pytest.raises(ro.InputError, match=sentence):
        ro.Dataset.of(q, y, sigma)  # type: ignore[arg-type]


def test_standard_deviations_of_rows() -> None:
    """Laser trackers state them by row, and by component."""
    q, y = np.zeros((4, 6)), np.zeros((4, 3))
    rows = np.array([1e-5, 2e-5, 3e-5, 4e-5])
    by_row = ro.Dataset.of(q, y, rows).blocks[0].covariance
    assert by_row == pytest.approx(rows[:, None, None] ** 2 * np.eye(3))
    both = rows[:, None] * [1.0, 2.0, 3.0]
    assert ro.Dataset.of(q, y, both).blocks[0].covariance == pytest.approx(both[:, :, None] ** 2 * np.eye(3))


def test_configurations_at_the_same_joint_values_are_one_in_the_order_that_they_had() -> None:
    """Also over a chain of configurations; their numbers are those of the first table's, not of the rows."""
    q = np.array([[0.3, 0.0], [0.1, 0.0], [0.2, 0.0]])
    first = replace(ro.Dataset.of(q, np.zeros((3, 3)), 1e-5), configuration=np.array([2, 0, 1]))
    second = replace(ro.Dataset.of(q[[0, 1]], np.zeros((2, 3)), 1e-5), configuration=np.array([0, 0]))
    assert ro.Dataset.together([first, second], ["a", "b"]).configuration.tolist() == [0, 0, 1, 0, 0]
    second = ro.Dataset.of(q[[0, 1]], np.zeros((2, 3)), 1e-5)
    assert ro.Dataset.together([first, second], ["a", "b"]).configuration.tolist() == [2, 0, 1, 2, 0]
