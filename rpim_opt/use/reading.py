"""Tables of targets, measurements and checks, read as the calibration's own were."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices, pick
from rpim_opt.basics.layout import RawTable, TableOptions
from rpim_opt.basics.tables import Columns, read_columns
from rpim_opt.basics.units import UNITS, accepted_units, joint_columns, parse_units, split_unit
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.camera import board_of, on_board
from rpim_opt.data.measurements.contact import KNOWN
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.measurements.pose import pose
from rpim_opt.data.measurements.position import position
from rpim_opt.data.tables.joining import seconds, time_column
from rpim_opt.data.tables.reading import read_data
from rpim_opt.data.tables.understanding import Understood, understand
from rpim_opt.robot.mdh import Robot

PLACE = ("x_mm", "y_mm", "z_mm")


class Targets(NamedTuple):
    """Rows of a table: labels; joint values (N, dof), poses (N, 7) or positions (N, 3), torques, payloads, or None.

    Torques are (N, dof), payloads (N,).
    """

    label: tuple[str, ...]
    q: Array | None
    poses: Array | None
    torque: Array | None
    payload: Array | None = None


def read_targets(source: Any, robot: Robot) -> Targets:
    """Return the targets of a table.

    Columns ``q1_deg``, ... are joint values; ``x_mm, y_mm, z_mm`` positions in the robot's base, with
    ``qw, qx, qy, qz``, ``rx_deg, ry_deg, rz_deg`` or ``r11`` to ``r33`` poses. A table has the former, the latter, or
    both: joint values are then where to look for those of the pose. Optional: ``label``, torques ``tau1_Nm``, ...,
    ``payload_kg``.

    Parameters
    ----------
    source
        A path (``.csv``, ``.parquet``, ``.xlsx``), a pandas or polars data frame, or a mapping from column names
        to cells.
    robot
        Its joints' number and types decide the joint columns.

    Raises
    ------
    InputError
        Naming the file, the row or column, what was found and what is accepted.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> robot = ro.load("paper_arm").problem.robot
    >>> targets = ro.use.read_targets({"label": ["P1"], "x_mm": [400], "y_mm": [0], "z_mm": [500]}, robot)
    >>> targets.label, targets.q, targets.poses
    (('P1',), None, array([[0.4, 0. , 0.5]]))
    """
    try:
        return _targets(dict(read_columns(source)), robot)
    except InputError as error:
        raise error.within(_file(source)) from None


def _targets(columns: dict[str, Any], robot: Robot) -> Targets:
    """Return the targets of columns; read as measurements are, with zeros for the half that targets need not have."""
    stems = {split_unit(name)[0] for name in columns}
    joints = not stems.isdisjoint(f"q{i}" for i in range(1, robot.dof + 1))
    oriented = not stems.isdisjoint({"qw", "rx", "r11"})
    positions = oriented or not stems.isdisjoint("xyz")  # without x, y, z an orientation is refused as half a pose
    if not joints and not positions:
        raise InputError("the header", "no targets", "columns q1_deg, ..., or x_mm, y_mm, z_mm, or both")
    absent = [*([] if joints else joint_columns(robot.joint_dimensions)), *([] if positions else PLACE)]
    columns = columns | dict.fromkeys(absent, [0.0] * len(next(iter(columns.values()))))
    noise = {"position_mm": 1, "orientation_mrad": 1} if oriented else {"position_mm": 1}
    data = read_data(columns, robot, noise, pose if oriented else position)
    block, *others = data.blocks
    if others:
        raise InputError("column marker", "several reflectors", "targets of one")
    if block.approach is not None:
        accepted = "none: joints are in the middle of their backlash"
        raise InputError("column approach1", "directions of approach", accepted)
    return Targets(
        data.label,
        data.q if joints else None,
        block.y if positions else None,
        None if block.torque is None else block.torque[:, 0],
        block.payload,
    )


def read_commands(result: Calibration, source: str | Path, units: str = "") -> tuple[Targets, tuple[str, ...]]:
    """Return the targets of a table that is read as the calibration's own were, and the columns that were left out."""
    robot = result.problem.robot
    try:
        found = _understood(source, robot, pose, result.record.reading, units, targets=True)
        return _targets(dict(found.columns), robot), found.left_out
    except InputError as error:
        raise error.within(source) from None


class Checks(NamedTuple):
    """Checks that were read: rows, their times (N,) [s] or None, the times as they stand there, columns left out."""

    data: Dataset
    when: Array | None
    times: tuple[str, ...]
    left_out: tuple[str, ...]


def read_checks(result: Calibration, source: Any, measurement: str | None = None, units: str = "") -> Checks:
    """Return check readings of a table with their times, where a column is called time, timestamp or date.

    Parameters
    ----------
    result, source, measurement, units
        As for `read_measurements`.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, ro.l_curve)
    >>> table = {"date": ["2026-03-01", "2026-04-01"], **{f"joint_{i}": [0.0, 10.0] for i in range(1, 7)}}
    >>> table |= {"x": [826.6, 810.0], "y": [98.0, 240.0], "z": [107.0, 254.0]}
    >>> checks = ro.use.read_checks(result, table, units="deg,mm")
    >>> checks.times, float(checks.when[1] - checks.when[0]) / 86400
    (('2026-03-01', '2026-04-01'), 31.0)
    """
    data, left_out, raw = _read(result, source, measurement, units)
    name = time_column(raw)
    if name is None:
        return Checks(data, None, (), left_out)
    cells = list(raw[name])
    try:
        when = seconds(name, cells)
    except InputError as error:
        raise error.within(_file(source)) from None
    return Checks(data, when, tuple(str(cell) for cell in cells), tuple(each for each in left_out if each != name))


def read_measurements(
    result: Calibration, source: Any, measurement: str | None = None, units: str = ""
) -> tuple[Dataset, tuple[str, ...]]:
    """Return the measurements of a table, whose columns are recognized by name, and columns that were left out.

    Rows that state no uncertainty have that of the calibration's data.

    Parameters
    ----------
    result
        The calibration.
    source
        A text, Excel or Parquet file as ``rpim-opt new`` takes it, or a data frame.
    measurement
        Which of the calibration's measurement types, where it has several.
    units
        Units of columns whose name carries none, ``"deg,mm"``.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, ro.l_curve)
    >>> table = {f"joint_{i}": [0.0, 10.0] for i in range(1, 7)}
    >>> table |= {"x": [826.6, 810.0], "y": [98.0, 240.0], "z": [107.0, 254.0], "note": ["", "warm"]}
    >>> data, left_out = ro.use.read_measurements(result, table, units="deg,mm")
    >>> len(data), left_out
    (2, ('note',))
    """
    return _read(result, source, measurement, units)[:2]


def _file(source: Any) -> str | Path | None:
    return source if isinstance(source, str | Path) else None


def _read(
    result: Calibration, source: Any, measurement: str | None, units: str
) -> tuple[Dataset, tuple[str, ...], Columns]:
    """Return measurements, columns left out, and all columns as they stand there, of the same rows."""
    robot = result.problem.robot
    blocks = result.problem.data.blocks
    types = {block.measurement.name: block.measurement for block in blocks if block.measurement not in KNOWN}
    if not measurement and len(types) != 1:
        raise InputError("measurement", "several", choices("", types))
    stated = pick(types, measurement or next(iter(types)), "measurement")
    try:
        found = _understood(source, robot, stated, result.record.reading, units)
        kind = stated
        if not found.stems >= set(stated.columns):  # poses may be validated by positions
            parts = [part for part in stated.parts if not any(found.stems >= set(form) for form, _ in stated.forms)]
            kind = next((part for part in parts if found.stems >= set(part.columns)), stated)
        columns = found.columns
        if found.left_out and not columns:
            accepted = f"joints' values and {', '.join(kind.columns)}"
            raise InputError("the header", f"nothing that is known among {', '.join(found.left_out)}"[:200], accepted)
        board = board_of(result.problem.sample().data)
        if kind.by_camera and board and not any(column.startswith("target_") for column in columns):
            columns = on_board(columns, board)
        data = read_data(columns, robot, _noise(result, stated, kind), kind)
    except InputError as error:
        raise error.within(_file(source)) from None
    return data, found.left_out, found.raw


def _understood(
    source: Any, robot: Robot, kind: Measurement, reading: Mapping[str, str], units: str, targets: bool = False
) -> Understood:
    """Return what a table says, read as the calibration's own were; one that does not fit that, as it says itself."""
    where = RawTable(read_columns(source)) if _file(source) is None else Path(source)
    plain = TableOptions(units=parse_units(units))
    if reading:
        options = TableOptions.stated({**reading, "units": units or reading.get("units", "")})
        try:
            return understand(where, robot, kind, options, options.joints, targets)
        except InputError as error:
            with suppress(InputError):  # one that has our names already
                return understand(where, robot, kind, plain, targets=targets)
            raise error from None
    found = understand(where, robot, kind, plain, targets=targets)
    if found.doubt == "quaternion" and "qw" in kind.columns:
        raise InputError("the header", "a quaternion whose components are numbered", "names qw, qx, qy, qz")
    return found


def _noise(result: Calibration, stated: Measurement, kind: Measurement) -> dict[str, float]:
    """Return the typical standard deviation of every component of a type or a part of it, as ``[noise]`` has it."""
    blocks = [block for block in result.problem.data.blocks if block.measurement is stated]
    variance = np.mean([np.einsum("nii->ni", block.covariance).mean(axis=0) for block in blocks], axis=0)
    si = {d: next(u for u in accepted_units(d) if UNITS[u].si == 1.0) for d in stated.components.values()}
    sigma = zip(stated.components.items(), np.sqrt(variance), strict=True)
    return {f"{name}_{si[dimension]}": float(value) for (name, dimension), value in sigma if name in kind.components}
