"""Reading of targets, measurements and checks, with the options of the calibration's tables."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices, in_file, pick
from rpim_opt.basics.layout import TableOptions
from rpim_opt.basics.tables import EXCEL
from rpim_opt.basics.units import display, joint_columns, split_unit
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.camera import board_of, on_board
from rpim_opt.data.measurements.contact import KNOWN
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.measurements.pose import pose, position
from rpim_opt.data.tables.joining import seconds, time_column
from rpim_opt.data.tables.reading import read_data
from rpim_opt.robot.chain import RobotSetup
from rpim_opt.robot.kinematics import FRAME
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import reflectors, tool_prefix
from rpim_opt.store.raw import Interpretation, interpret_tables, rows_of
from rpim_opt.use.sessions import registered_again


class Targets(NamedTuple):
    """Rows of a table; None for what it does not have."""

    label: tuple[str, ...]
    q: Array | None  # (N, dof)
    poses: Array | None  # (N, 7), or positions (N, 3)
    torque: Array | None  # (N, dof)
    payload: Array | None = None  # (N,)

    def take(self, rows: Sequence[int] | np.ndarray) -> Targets:
        """Return some of the rows."""
        values = [None if each is None else each[rows] for each in self[1:]]
        return Targets(tuple(self.label[i] for i in rows), *values)


def read_targets(
    result: Calibration,
    source: Any,
    options: TableOptions | None = None,
    tool: Sequence[float] | Array | None = None,
    marker: str = "",
) -> tuple[Targets, Interpretation]:
    """Return the targets of a table, whose columns are recognized by name, and their interpretation.

    Columns are joint values (``q1_deg``, ...), positions in the robot's base (``x_mm, y_mm, z_mm``), with
    ``qw, qx, qy, qz``, ``rx_deg, ry_deg, rz_deg`` or ``r11`` to ``r33`` poses, or both: joint values are then where to
    start values for those of the pose. Optional: ``label``, torques ``tau1_Nm``, ..., ``payload_kg``. ``source`` and
    ``options`` are as for `read_measurements`, ``tool`` and ``marker`` as for `compensate`: orientations that agree
    with the joint values beside them only in another convention are refused.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, ro.l_curve)
    >>> targets, _ = ro.use.read_targets(result, {"label": ["P1"], "x_mm": [400], "y_mm": [0], "z_mm": [500]})
    >>> targets.label, targets.q, targets.poses
    (('P1',), None, array([[0.4, 0. , 0.5]]))
    """
    robot, values = result.problem.robot, result.problem.parameters.by_name(result.x)
    known = reflectors(list(values))
    if tool is None:
        tool = [values[tool_prefix(marker if marker in known else known[0]) + axis] for axis in FRAME]
    arm = RobotSetup(robot, tool=np.asarray(tool, dtype=float))
    understanding = _understood(result, source, pose, options or TableOptions(), arm, targets=True)
    with in_file(source):
        targets = _targets(robot, understanding)
    angles = ("rx", "ry", "rz", "qw,")
    turned = [each for table in understanding.tables for each in table.meant if each.name.startswith(angles)]
    notes = [*understanding.notes, *_perhaps_radians(result, understanding, targets.q)]
    if turned:
        meant = ", ".join(f"{each.column}: {each.meaning.removeprefix('measured ')}" for each in turned)
        notes.append(f"Orientation of targets: {meant}.")
    return targets, replace(understanding, notes=tuple(notes))


def _targets(robot: Robot, understanding: Interpretation) -> Targets:
    """Return the targets of a table, read as measurements are, with zeros for the half that targets need not have."""
    columns = dict(understanding.columns)
    stems = {split_unit(name)[0] for name in columns}
    joints = not stems.isdisjoint(f"q{i}" for i in range(1, robot.dof + 1))
    oriented = not stems.isdisjoint({"qw", "rx", "r11"})
    positions = oriented or not stems.isdisjoint("xyz")  # an orientation without x, y, z is refused: half a pose
    if any(each.doubt == "quaternion" for each in understanding.tables):
        raise InputError("the header", "a quaternion whose components are numbered", "names qw, qx, qy, qz")
    if "rx_rad" in columns and not joints and any(each.doubt == "rotation" for each in understanding.tables):
        found = "rx, ry, rz in rad without joint values, which would tell a rotation vector from angles"
        accepted = "--rotation vector (Universal Robots), or --rotation 'extrinsic xyz' (roll, pitch, yaw)"
        raise InputError("the header", found, accepted)
    if not joints and not positions:
        raise InputError("the header", "no targets", "columns q1_deg, ..., or x_mm, y_mm, z_mm, or both")
    absent = [*joint_columns(robot.joint_dimensions)] * (not joints) + ["x_mm", "y_mm", "z_mm"] * (not positions)
    columns |= dict.fromkeys(absent, [0.0] * len(next(iter(columns.values()))))
    kind, noise = position, {"position_mm": 1}
    if oriented:
        kind, noise = pose, {"position_mm": 1, "orientation_mrad": 1}
    data = read_data(columns, robot, noise, kind)
    block, *others = data.blocks
    if others:
        raise InputError("column marker", "several reflectors", "targets of one")
    if block.approach is not None:
        accepted = "none: compensation assumes the middle of the backlash"
        raise InputError("column approach1", "directions of approach", accepted)
    torque = None if block.torque is None else block.torque[:, 0]
    stated = {"q": joints, "poses": positions}
    absent = [name for name, there in stated.items() if not there]
    return Targets(data.label, data.q, block.y, torque, block.payload)._replace(**dict.fromkeys(absent))


class Measured(NamedTuple):
    """Measurements of tables: rows, columns left out, how tables were joined and what was left out."""

    data: Dataset
    left_out: tuple[str, ...]
    notes: tuple[str, ...]
    clock: tuple[str, tuple[str, ...]]  # name and cells of a column time, timestamp or date

    @property
    def when(self) -> Array | None:
        """The rows' times (N,) [s]; None without a column of them."""
        return seconds(*self.clock) if self.clock[0] else None


def read_measurements(
    result: Calibration,
    source: Any,
    measurement: str | None = None,
    options: TableOptions | None = None,
    register: bool = False,
) -> Measured:
    """Return the measurements of tables, whose columns are recognized by name, as ``rpim-opt new`` reads them.

    Rows that state no uncertainty have that of the calibration's data.

    ``source`` is a text, Excel or Parquet file, a data frame, or a list of these, which are stacked or joined;
    ``measurement`` is one of the calibration's measurement types if it has several. ``options`` not stated are those of
    the calibration's own tables. If the instrument was moved since, ``register`` returns the rows after the motion that
    fits them best (`registered_again`), which the notes state.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, ro.l_curve)
    >>> table = {"date": ["2026-03-01", "2026-04-01"], **{f"joint_{i}": [0.0, 10.0] for i in range(1, 7)}}
    >>> table |= {"x": [826.6, 810.0], "y": [98.0, 240.0], "z": [107.0, 254.0], "note": ["", "warm"]}
    >>> found = ro.use.read_measurements(result, table, options=ro.data.TableOptions(units="deg,mm"))
    >>> len(found.data), found.left_out, float(found.when[1] - found.when[0]) / 86400
    (2, ('note',), 31.0)
    """
    blocks = result.problem.data.blocks
    types = {block.measurement.name: block.measurement for block in blocks if block.measurement not in KNOWN}
    if not measurement and len(types) != 1:
        raise InputError("measurement", "several", choices("", types))
    calibrated = pick(types, measurement or next(iter(types)), "measurement")
    arm = RobotSetup(result.problem.robot)
    understanding = _understood(result, source, calibrated, options or TableOptions(), arm)
    columns = understanding.columns
    stems = {split_unit(name)[0] for name in columns}
    kind = calibrated
    if not kind.stands_in(stems):
        # a part of what was calibrated: positions can validate poses
        kind = next((part for part in kind.parts if stems >= set(part.columns)), kind)
    board = board_of(result.problem.sample().data)
    if kind.by_camera and board and not any(column.startswith("target_") for column in columns):
        columns = on_board(columns, board)
    covariances = [block.covariance for block in blocks if block.measurement is calibrated]
    variance = np.mean([np.einsum("nii->ni", each).mean(axis=0) for each in covariances], axis=0)
    sigma = dict(zip(calibrated.components, np.sqrt(variance).tolist(), strict=True))
    units = {name: display(dimension) for name, dimension in kind.components.items()}
    noise = {f"{name}_{unit}": sigma[name] / si for name, (unit, si) in units.items()}
    data = rows_of(understanding, columns, arm, kind, noise)
    name = time_column(understanding.raw) or ""
    clock = name, tuple(str(cell) for cell in understanding.raw.get(name, ()))
    left_out = tuple(column for column in understanding.left_out if column.lower() != name)
    lost = re.compile(r"rows without|line \d|\d+ more lines")
    notes = [f"{each.file}: {note}" for each in understanding.tables for note in each.notes if lost.match(note)]
    notes += [*understanding.notes, *_perhaps_radians(result, understanding, data.q)]
    if register:
        data, motion = registered_again(result, data)
        notes.append(motion)
    return Measured(data, left_out, tuple(notes), clock)


def _perhaps_radians(result: Calibration, understanding: Interpretation, q: Array | None) -> list[str]:
    """Return a remark on joint values (N, dof) of three or more rows in degrees that radians would explain."""
    turning = [f"q{i}_deg" in understanding.columns for i in range(1, result.problem.robot.dof + 1)]
    if q is None or len(q) < 3 or not any(turning):
        return []
    now, then = (float(np.degrees(np.abs(each[:, turning]).max())) for each in (q, next(iter(result.ranges.values()))))
    if not now <= 2 * np.pi < then:
        return []
    said = f"Joint values are within {now:.3g} deg of zero, those of the calibration within {then:.3g} deg: if they are"
    return [f"{said} in radians, name the columns q1_rad, ..."]


def _understood(
    result: Calibration, source: Any, kind: Measurement, stated: TableOptions, arm: RobotSetup, targets: bool = False
) -> Interpretation:
    """Return the content of tables, read with the options of the calibration's own, or by headers if these do not fit.

    The tables are measurements, or targets of the tool of an ``arm``.
    """
    sources = source if isinstance(source, list | tuple) else [source]
    reading = dict(result.record.reading)
    if not all(Path(str(each)).suffix.lower() in EXCEL for each in sources):
        reading.pop("sheet", None)
    options = TableOptions.stated({**reading, **stated.texts()})
    try:
        return interpret_tables(replace(arm, names=options.joints), sources, kind, options, targets)
    except InputError as error:
        if error.where == "rx, ry, rz":  # another interpretation of the table does not help
            raise
        with suppress(InputError):  # a table with canonical names
            return interpret_tables(arm, sources, kind, stated, targets)
        raise
