"""Tables of measurements become a dataset, row by row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from string import ascii_uppercase
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, RowError
from rpim_opt.basics.tables import Columns, numbers, read_columns, texts
from rpim_opt.basics.units import joint_columns
from rpim_opt.data.dataset import Block, Dataset, named_sessions
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.measurements.position import position
from rpim_opt.data.noise import covariances, declared_noise
from rpim_opt.data.tables.columns import Numbers, further_columns, labels, numeric, values_form
from rpim_opt.robot.mdh import Robot


def read_data(
    source: Any, robot: Robot, noise: Mapping[str, Any] | None = None, measurement: Measurement = position
) -> Dataset:
    """Return the measurements of a table.

    Every column's name carries its unit: ``label, q1_deg, ..., x_mm, y_mm, z_mm``. Optional columns are

    - ``label``; ``configuration`` (rows of one stay together; rows with equal joint values by default);
    - ``marker`` (which reflector); ``fixture`` (which anchor, plane or sphere); ``point``
      or ``plane`` (which one was touched); ``session`` (any text: rows of one share an error of the registration);
    - ``sigma_mm``, ``sigma_x_mm`` (standard deviations of a row, of one component), ``u95_mm``, ``u95_x_mm``
      (expanded uncertainties, coverage factor 2), ``cov_x_y_mm2``, ``cov_x_rx_mm_mrad`` (covariances);
    - ``tau1_Nm``, ... (joint torques); ``payload_kg`` (mass at the flange); ``approach1``, ... (direction in which the
      joint moved last, -1 or 1, 0 where it is not known); ``temperature_C`` (of the robot, for ``expansion``);
    - what terms (`Model`) of the robot and a measurement of your own name as their columns;
    - for a second point ``to_q1_deg``, ..., ``to_marker``, ``to_tau1_Nm``, ``to_approach1``.

    Parameters
    ----------
    source
        A path (``.csv``, ``.parquet``, ``.xlsx``), a pandas or polars data frame, or a mapping from column names
        to cells.
    robot
        Its joints' number and types decide the joint columns.
    noise
        Standard deviations where no column states them: ``{"position_mm": 0.03}``, ``{"x_mm": 0.03, ...}``, and
        ``{"tracker": {"range_um": 15, "range_ppm": 6, ...}}`` for a laser tracker (`LaserTracker`), added to them.
    measurement
        Decides the columns of measured values.

    Raises
    ------
    InputError
        Naming the file, the row or column, what was found and what is accepted.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> arm = ro.robot.Robot("two links", np.array([[0, 0, 0, 0, 0], [0, 0.4, 0, 0, 0]]))
    >>> table = {"q1_deg": [0, 90], "q2_deg": [0, 30], "x_mm": [401, 2], "y_mm": [0, 400], "z_mm": [0, 1]}
    >>> data = ro.read_data(table, arm, {"position_mm": 0.05})
    >>> data.q.round(3).tolist(), data.blocks[0].y[0].tolist()  # [rad], [m]
    ([[0.0, 0.0], [1.571, 0.524]], [0.401, 0.0, 0.0])
    """
    declared = declared_noise(noise or {}, measurement)  # outside: a mistake there is not the table's
    try:
        return _dataset(read_columns(source), robot, declared, measurement)
    except InputError as error:
        raise error.within(source if isinstance(source, str | Path) else None) from None


def _dataset(table: Columns, robot: Robot, declared: Mapping[str, Any], kind: Measurement) -> Dataset:
    N = len(next(iter(table.values())))
    kind = next((variant for column, variant in kind.variants.items() if column in table), kind)
    label = labels(table, N)
    columns = numeric(table, robot, kind, label)
    stems, convert = values_form(columns, kind)
    try:
        y = kind.prepare(convert(_beside_each_other(columns, stems, N)))
    except RowError as error:
        raise error.named(f"row {label[error.row]}") from None
    q = _of_joints("q", columns, robot, kind, N)
    payload = columns.get(("payload", ""))
    if payload is not None and not (payload >= 0).all():
        row = int(np.argmin(payload))
        raise InputError(f"row {label[row]}, column payload_kg", f"{payload[row]:g}", "a mass that is not negative")
    approach = None
    if ("approach1", "") in columns:
        approach = _of_joints("approach", columns, robot, kind, N)
        for row, point, joint in np.argwhere(~np.isin(approach, (-1.0, 0.0, 1.0))):
            where = f"row {label[row]}, column approach{joint + 1}"
            raise InputError(where, f"{approach[row, point, joint]:g}", "-1, 0 (not known) or 1")
    naming = [column for column in kind.names if column in table]  # points that were touched, or that a camera sees
    if kind.touching and len(naming) != 1:
        accepted = f"{' or '.join(f'a column {column}' for column in kind.names)}: what a row touched"
        raise InputError("the header", ", ".join(table), accepted)
    whole = Block(
        kind,
        q=q,
        y=y,
        covariance=covariances(columns, declared, kind, y, label),
        row=np.arange(N),
        torque=_of_joints("tau", columns, robot, kind, N) if ("tau1", "") in columns else None,
        payload=payload,
        approach=approach,
        columns={name: columns[name, ""] for name in further_columns(robot, kind) if (name, "") in columns},
        point=np.array(_names(table, naming, N), dtype=object)[:, None] if naming else None,
        session=named_sessions(texts(table.get("session", ()), "session"), N),
    )
    markers = [_names(table, column, N) for column in [["marker"], ["to_marker", "marker"]][: kind.points]]
    if kind.points == 2:
        for i, name in enumerate(label):
            if markers[0][i] == markers[1][i] and np.array_equal(q[i, 0], q[i, 1]):
                found = "twice the same reflector in the same configuration"
                raise InputError(f"row {name}", found, "to_marker or to_q1, ... of another point")
    if "configuration" in table:
        configuration = np.unique(texts(table["configuration"], "configuration"), return_inverse=True)[1]
    else:
        joints = q.reshape(N, -1)
        order = np.lexsort(joints.T[::-1])  # np.unique of whole rows takes ten times as long
        configuration = np.empty(N, dtype=int)
        configuration[order] = np.cumsum(np.any(np.diff(joints[order], axis=0, prepend=joints[order[:1]]) != 0, axis=1))
    blocks: tuple[Block, ...] = (replace(whole, markers=("",) * kind.points),)
    if {"marker", "to_marker", "fixture"} & set(table):
        groups: dict[tuple[str, ...], list[int]] = {}  # by reflectors and fixture, in the order of their first rows
        for i, key in enumerate(zip(*markers, _names(table, ["fixture"], N), strict=True)):
            groups.setdefault(key, []).append(i)
        parts = ((names, place, np.array(rows)) for (*names, place), rows in groups.items())
        blocks = tuple(
            replace(whole.take(index, index), markers=tuple(names), fixture=place) for names, place, index in parts
        )
    data = Dataset(blocks, label, configuration)
    return data.grouped_by_points() if kind.touching else data


def _beside_each_other(columns: Numbers, stems: Sequence[str], N: int) -> Array:
    return np.column_stack([columns[stem, ""] for stem in stems]) if stems else np.empty((N, 0))


def _of_joints(stem: str, columns: Numbers, robot: Robot, kind: Measurement, N: int) -> Array:
    """Return joint values, torques or directions (N, p, dof); a second point without its own has the first's."""
    own = [f"{stem}{i}" for i in range(1, robot.dof + 1)]
    points = [own, [f"to_{name}" for name in own] if (f"to_{stem}1", "") in columns else own][: kind.points]
    values = [_beside_each_other(columns, names, N) for names in points]
    return values[0][:, None] if len(values) == 1 else np.stack(values, axis=1)  # of one point without a copy


def _names(table: Columns, columns: Sequence[str], N: int) -> Sequence[str]:
    """Return the texts of the first of the columns that is there, or N empty ones."""
    column = next((each for each in columns if each in table), None)
    return texts(table[column], column) if column else ("",) * N


# --- RoboDK ----------------------------------------------------------------------------------------------------------


def robodk_columns(path: str | Path, joints: Sequence[str], tools: dict[str, list[float]]) -> Columns:
    """Return the columns of the file that RoboDK exports after calibration measurements: their order counts.

    They are the joints [deg or mm], the measured point x, y, z [mm], and the reflector in the flange frame x, y, z [mm]
    (RoboDK's macro library reads it so). ``joints`` are "angle" or "length" each; ``tools`` are the reflectors that are
    known, marker to x, y, z [mm], to which new ones are added as A, B, ...
    """
    try:
        table = list(read_columns(Path(path)).values())
        names = [*joint_columns(joints), "x_mm", "y_mm", "z_mm"]
        if len(table) < len(names) + 3:
            accepted = f"{len(joints)} joints, 3 measured and 3 of the tool"
            raise InputError("the header", f"{len(table)} columns", accepted)
        places = np.column_stack([numbers(table[i], f"{i + 1}") for i in range(len(names), len(names) + 3)])
    except InputError as error:
        raise error.within(path) from None
    markers = []
    for place in places:
        name = next((name for name, known in tools.items() if np.allclose(known, place, atol=1e-6)), None)
        if name is None:
            name = next(new for new in chain(ascii_uppercase, (f"M{i}" for i in count(1))) if new not in tools)
            tools[name] = place.tolist()
        markers.append(name)
    return {**dict(zip(names, table, strict=False)), "marker": markers}
