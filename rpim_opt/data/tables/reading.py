"""Conversion of measurement tables to a dataset: permitted columns, values in SI, rows and noise."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, RowError, choices, in_file
from rpim_opt.basics.tables import Columns, numbers, read_columns, texts
from rpim_opt.basics.units import LARGEST, SMALLEST, Unit, quantities, split_unit, with_unit
from rpim_opt.data.dataset import Dataset, stops
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.measurements.pose import position
from rpim_opt.robot.mdh import Robot

Numbers = dict[tuple[str, str], Array]
"""Columns of numbers [SI] by (stem, dimension); also by (stem, "") if the stem has one dimension."""
TRACKER = {"range": ("length", "ratio"), "transverse": ("length",), "angle": ("angle",),
           "x": ("length",), "y": ("length",), "z": ("length",)}  # fmt: skip
"""The keys of ``[noise.tracker]`` and their dimensions."""
APPROACH = re.compile(r"(?:to_)?approach\d+")  # columns of directions
DEFINITE = 1e-9  # a correlation matrix needs a larger smallest eigenvalue
SPREADS = {"sigma": 1.0, "u95": 2.0}  # coverage factors of standard and expanded uncertainties, by stem


def read_data(
    source: Any, robot: Robot, noise: Mapping[str, Any] | None = None, measurement: Measurement = position
) -> Dataset:
    """Return the measurements of a table.

    Every column's name carries its unit: ``label, q1_deg, ..., x_mm, y_mm, z_mm``. Optional columns are

    - ``label``; ``configuration`` (by default the same for rows whose joint values differ by at most 0.1 mrad or
      0.1 mm); ``marker`` (name of the reflector); ``fixture`` (anchor, plane or sphere); ``point`` or ``plane`` (what
      was touched); ``session`` (any text: its rows share an error of the registration);
    - ``sigma_mm``, ``sigma_x_mm`` (standard deviations of a row, of one component), ``u95_mm``, ``u95_x_mm``
      (expanded uncertainties, coverage factor 2), ``cov_x_y_mm2``, ``cov_x_rx_mm_mrad`` (covariances);
    - ``tau1_Nm``, ... (joint torques); ``payload_kg`` (mass at the flange); ``approach1``, ... (direction in which the
      joint moved last, -1 or 1, 0 where it is not known); ``temperature_C`` (of the robot, for ``expansion``);
    - columns of user-defined terms (`Model`) and measurement types;
    - for a second point ``to_q1_deg``, ..., ``to_marker``, ``to_tau1_Nm``, ``to_approach1``.

    The ``source`` is a path (``.csv``, ``.parquet``, ``.xlsx``), a pandas or polars data frame, or a mapping from
    column names to cells. Number and types of the ``robot``'s joints determine the joint columns, ``measurement`` those
    of measured values. ``noise`` has standard deviations for rows without their own: ``{"position_mm": 0.03}``,
    ``{"x_mm": 0.03, ...}``, and in addition ``{"tracker": {"range_um": 15, "range_ppm": 6, ...}}`` for a laser tracker
    (its data sheet's terms along and across the beam). InputError names the file, the row or column, what was found and
    what is accepted.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> arm = ro.robot.Robot("two links", np.array([[0, 0, 0, 0, 0], [0, 0.4, 0, 0, 0]]))
    >>> table = {"q1_deg": [0, 90], "q2_deg": [0, 30], "x_mm": [401, 2], "y_mm": [0, 400], "z_mm": [0, 1]}
    >>> data = ro.read_data(table, arm, {"position_mm": 0.05})
    >>> data.q.round(3).tolist(), data.blocks[0].y[0].tolist()  # [rad], [m]
    ([[0.0, 0.0], [1.571, 0.524]], [0.401, 0.0, 0.0])
    """
    declared = declared_noise(noise or {}, measurement)  # outside: such a mistake is not the table's
    with in_file(source):
        return _dataset(read_columns(source), robot, declared, measurement)


def _dataset(table: Columns, robot: Robot, declared: Mapping[str, Any], kind: Measurement) -> Dataset:
    N = len(next(iter(table.values())))
    kind = next((variant for column, variant in kind.variants.items() if column in table), kind)
    label = labels(table, N)
    columns = numeric(table, robot, kind, label)
    stems, convert = values_form(columns, kind)
    try:
        y = kind.prepare(convert(_beside_each_other(columns, stems, N)))
    except RowError as error:
        raise InputError(f"row {label[error.row]}", error.found, error.accepted) from None
    q, torque, approach = (_of_joints(stem, columns, robot, kind, N) for stem in ("q", "tau", "approach"))
    stated = {"torque": torque, "payload": columns.get(("payload", "")), "approach": approach}
    noise = covariances(columns, declared, kind, y, label)
    further = {name: columns[name, ""] for name in further_columns(robot, kind) if (name, "") in columns}
    naming = [column for column in kind.names if column in table]
    if kind.touching and len(naming) != 1:
        accepted = f"{' or '.join(f'a column {column}' for column in kind.names)}: the touched point"
        raise InputError("the header", ", ".join(table), accepted)
    point = texts(table[naming[0]], naming[0]) if naming else ()
    session = texts(table.get("session", ()), "session")
    first = texts(table["marker"], "marker") if "marker" in table else ("",) * N
    second = texts(table["to_marker"], "to_marker") if "to_marker" in table else first
    markers = [first, second][: kind.points]
    for i in range(N if kind.points == 2 else 0):
        if markers[0][i] == markers[1][i] and np.array_equal(q[i, 0], q[i, 1]):
            accepted = "to_marker or to_q1, ... of another point; measurement cable for distances to a fixed anchor"
            raise InputError(f"row {label[i]}", "the same reflector twice in one configuration", accepted)
    marker = np.column_stack(markers) if {"marker", "to_marker"} & set(table) else ()
    stated |= {"marker": marker, "fixture": texts(table.get("fixture", ()), "fixture")}
    data = Dataset.of(q, y, noise, label, kind, columns=further, session=session, point=point, **stated)
    if "configuration" in table:
        stop = np.unique(texts(table["configuration"], "configuration"), return_inverse=True)[1]
    else:
        stop = stops(q)
    data = replace(data, configuration=stop)
    return data.grouped_by_points() if kind.touching else data


def _beside_each_other(columns: Numbers, stems: Sequence[str], N: int) -> Array:
    return np.column_stack([columns[stem, ""] for stem in stems]) if stems else np.empty((N, 0))


def _of_joints(stem: str, columns: Numbers, robot: Robot, kind: Measurement, N: int) -> Any:
    """Return joint values, torques or directions (N, p, dof), or None; a second point may have the first's."""
    if (f"{stem}1", "") not in columns:
        return None
    own = [f"{stem}{i}" for i in range(1, robot.dof + 1)]
    points = [own, [f"to_{name}" for name in own] if (f"to_{stem}1", "") in columns else own][: kind.points]
    return np.stack([_beside_each_other(columns, names, N) for names in points], axis=1)


# --- columns ---------------------------------------------------------------------------------------------------------


def text_columns(kind: Measurement) -> list[str]:
    """Return the columns of names that a table may have."""
    second = ["to_marker"] if kind.points == 2 else []
    return ["label", "configuration", "marker", "fixture", "session", *second, *kind.names]


def number_columns(robot: Robot, kind: Measurement) -> dict[str, list[str]]:
    """Return the columns of numbers that a table may have, name without unit to its dimensions; "" is a plain one."""
    joints = {f"q{i}": dimension for i, dimension in enumerate(robot.joint_dimensions, start=1)}
    joints |= {f"{stem}{i}": of for stem, of in (("tau", "torque"), ("approach", "")) for i in range(1, robot.dof + 1)}
    plain = {**further_columns(robot, kind), **joints, **kind.columns, "payload": "mass"}
    for form, _ in kind.forms:
        plain |= form
    if kind.points == 2:
        plain |= {f"to_{stem}": dimension for stem, dimension in joints.items()}
    known = {stem: [dimension] for stem, dimension in plain.items()}
    for spread in SPREADS:
        known[spread] = sorted(set(kind.components.values()))
        known |= {f"{spread}_{name}": [dimension] for name, dimension in kind.components.items()}
    for (a, of_a), (b, of_b) in combinations_with_replacement(kind.components.items(), 2):
        known[f"cov_{a}_{b}"] = [f"{of_a}2" if of_a == of_b else f"{of_a} {of_b}"]
    return known


def further_columns(robot: Robot, kind: Measurement) -> dict[str, str]:
    """Return the further columns that terms and measurement depend on, name to dimension."""
    return {"temperature": "temperature", **robot.model.columns, **kind.extra}


def numeric(table: Columns, robot: Robot, kind: Measurement, label: Sequence[str]) -> Numbers:
    """Return the columns of numbers [SI]; refuse unknown, duplicate and missing ones."""
    known = number_columns(robot, kind)
    columns = quantities_of(table, known, text_columns(kind), label)
    # joints, measured values, and partly present groups
    joints, *groups = ([f"{stem}{i}" for i in range(1, robot.dof + 1)] for stem in ("q", "tau", "approach"))
    required = [*joints, *values_form(columns, kind)[0], *(name for name in kind.depends_on if name in kind.extra)]
    if kind.points == 2:
        groups += [[f"to_{stem}" for stem in group] for group in (joints, *groups)]
    for group in groups:
        if any((stem, "") in columns for stem in group):
            required += group
    for stem in required:
        if (stem, "") not in columns:
            accepted = kind.accepted.get(stem, " or ".join(with_unit(stem, known[stem][0])))
            if stem[0] == "q" and stem[1:].isdigit():
                accepted += ", or rpim-opt new --constants for a joint that did not move"
            raise InputError("the header", f"no column for '{stem}' among {', '.join(table)}", accepted)
    return columns


def quantities_of(
    table: Columns, known: Mapping[str, Sequence[str]], names: Sequence[str], label: Sequence[str]
) -> Numbers:
    """Return all numeric columns in SI; refuse unknown ones."""
    columns: Numbers = {}
    for name in table:
        if name in names:
            continue
        stem, unit = split_unit(name)
        dimension, si, zero = unit or Unit("", 1.0)
        if stem not in known:
            others = {key: dimensions for key, dimensions in known.items() if "cov_" not in key}
            accepted = [each for key, dimensions in others.items() for each in with_unit(key, *dimensions, count=1)]
            raw = "; rpim-opt new (ro.store.new_problem) makes such a table of an instrument's or a controller's"
            raise InputError("the header", f"column '{name}'", choices(name, [*names, *accepted]) + raw)
        if dimension not in known[stem]:
            accepted = ", ".join(with_unit(stem, *known[stem]))
            raise InputError("the header", f"column '{name}' without a unit of the right dimension", accepted)
        if (stem, dimension) in columns:
            raise InputError("the header", f"column '{stem}' in two units", "one of them")
        values = si * numbers(table[name], name, label) + zero
        limits = [(np.abs(values) <= LARGEST, f"a magnitude of at most {LARGEST / si:g}")]
        if stem.startswith(tuple(SPREADS)):
            limits.append((values >= SMALLEST, f"an uncertainty greater than zero, from {SMALLEST / si:g} on"))
        elif stem == "payload":
            limits.append((values >= 0, "a mass that is not negative"))
        elif APPROACH.fullmatch(stem):
            limits.append((np.isin(values, (-1.0, 0.0, 1.0)), "-1, 0 (not known) or 1"))
        for fits, accepted in limits:
            for i in np.flatnonzero(~fits).tolist():
                raise InputError(f"row {label[i]}, column {name}", f"{values[i] / si:g}", accepted)
        columns[stem, dimension] = values
        if len(known[stem]) == 1:
            columns[stem, ""] = values
    return columns


def values_form(columns: Numbers, kind: Measurement) -> tuple[list[str], Callable[[Array], Array]]:
    """Return the columns that state the measured values, and the function from them to y."""
    plain = (kind.columns, lambda y: y)
    there = (each for each in (plain, *kind.forms) if all((stem, "") in columns for stem in each[0]))
    form, convert = next(there, plain)
    return list(form), convert


def labels(table: Columns, N: int) -> tuple[str, ...]:
    """Return the rows' labels, by default numbers from 1; refuse missing and duplicate ones."""
    if "label" in table:
        label = texts(table["label"], "label")
        require_unique(label, "label")
    else:
        label = tuple(map(str, range(1, N + 1)))
    for column in ("marker", "to_marker", "fixture", "configuration", "point", "plane", "session"):
        names = texts(table.get(column, ()), column)
        if "" in names:
            raise InputError(f"row {label[names.index('')]}, column {column}", "''", "a name")
    return label


def require_unique(names: Sequence[str], column: str) -> None:
    """Refuse a missing or duplicate label."""
    seen = {""}
    for i, name in enumerate(names, start=1):
        if name in seen:
            raise InputError(f"row {i}, column {column}", f"'{name}'", f"a unique {column}")
        seen.add(name)


# --- noise ------------------------------------------------------------------------------------------------------------


def _tracker_covariances(points: Array, terms: Mapping[str, float]) -> Array:
    """Return the covariances (N, 3, 3) [m^2] of points (N, 3) [m] in a laser tracker's frame, from its data sheet.

    With u the unit vector from the tracker's position x, y, z to the point at distance D::

        C = (range + range_ppm D)^2 u u' + (transverse + angle D)^2 (1 - u u')
    """
    beam = points - [terms.get(axis, 0.0) for axis in "xyz"]
    D = np.linalg.norm(beam, axis=1)
    u = beam / np.maximum(D, 1e-9)[:, None]
    along = (terms.get("range", 0.0) + terms.get("range_ppm", 0.0) * D) ** 2
    across = (terms.get("transverse", 0.0) + terms.get("angle", 0.0) * D) ** 2
    return across[:, None, None] * np.eye(3) + (along - across)[:, None, None] * (u[:, :, None] * u[:, None, :])


def declared_noise(noise: Mapping[str, Any], kind: Measurement) -> dict[str, Any]:
    """Return the declared noise for rows without a stated one: standard deviations [SI], or a ``tracker``."""
    declared: dict[str, Any] = {}
    plain = dict(noise)
    tracker = plain.pop("tracker", None)
    if tracker is not None:
        if not isinstance(tracker, Mapping) or not {"x", "y", "z"} <= set(kind.columns):
            raise InputError("table noise, key tracker", repr(tracker)[:60], "a table, for positions and poses")
        of_tracker = quantities(tracker, TRACKER, "table noise.tracker")
        terms = {"range_ppm" if of == "ratio" else stem: value for (stem, of), value in of_tracker.items()}
        if not any(terms.get(term, 0) > 0 for term in ("range", "transverse")):
            raise InputError("table noise.tracker", "no range_um and no transverse_um", "at least one of them > 0")
        declared["tracker"] = terms
    accepted = {name: (dimension,) for name, dimension in {**kind.noise, **kind.components}.items()}
    for (stem, _), value in quantities(plain, accepted, "table noise").items():
        if not value >= SMALLEST:
            accepted = f"a standard deviation > 0, from {SMALLEST:g} on"
            raise InputError(f"table noise, key {stem}", f"{value:g}", accepted)
        declared[stem] = value
    return declared


def covariances(
    columns: Numbers, declared: Mapping[str, Any], kind: Measurement, y: Array, label: Sequence[str]
) -> Array:
    """Return the covariances of the residual's components [SI], (N, k, k) or (1, k, k) if the same for all.

    A standard deviation stated in a row replaces the declared one, including the tracker's part.
    """
    names = list(kind.components)
    k = len(names)
    instrument = np.zeros((1, k, k))
    if "tracker" in declared:
        instrument = np.zeros((len(y), k, k))
        axes = [list(kind.columns).index(axis) for axis in "xyz"]
        instrument[:, :3, :3] = _tracker_covariances(y[:, axes], declared["tracker"])
    spread: list[Any] = []
    lacking = np.zeros(k, dtype=bool)
    for i, (name, dimension) in enumerate(kind.components.items()):
        # stated in rows: of this component before those of its dimension
        sources = [(key, factor) for of, factor in SPREADS.items() for key in ((f"{of}_{name}", ""), (of, dimension))]
        stated = [columns[key] / factor for key, factor in sources if key in columns]
        common = next((key for key, of in kind.noise.items() if of == dimension), "")
        own = stated[0] if stated else declared.get(name, declared.get(common))
        lacking[i] = not stated
        if own is None and not instrument[:, i, i].any() and (f"cov_{name}_{name}", "") not in columns:
            column = with_unit(f"sigma_{name}", dimension, count=2)[-1]
            accepted = f"{with_unit(common, dimension, count=2)[-1]}, or a column {column}"
            raise InputError("table noise", f"no standard deviation for '{name}'", accepted)
        spread.append(0.0 if own is None else own)  # the tracker's covariance or a column states it
    deviation = np.stack(np.broadcast_arrays(*map(np.atleast_1d, spread)), axis=1)
    covariance = deviation[:, :, None] ** 2 * np.eye(k) + instrument * np.outer(lacking, lacking)
    for i, j in np.ndindex(k, k):
        values = columns.get((f"cov_{names[i]}_{names[j]}", ""))
        if values is not None:
            covariance = np.tile(covariance, (1 if len(covariance) == len(y) else len(y), 1, 1))
            covariance[:, i, j] = covariance[:, j, i] = values
    unit = np.sqrt(np.einsum("nii->ni", covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.nan_to_num(covariance / (unit[:, :, None] * unit[:, None, :]))
    definite = np.linalg.eigvalsh(correlation)[:, 0] > DEFINITE
    for i in np.flatnonzero(~definite).tolist():
        found = "a covariance that is not positive definite"
        raise InputError(f"row {label[i]}, columns cov_...", found, "one that is")
    return covariance
