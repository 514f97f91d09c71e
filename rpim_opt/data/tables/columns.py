"""The columns that a table of measurements may have, and their numbers in SI."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.tables import Columns, numbers, texts
from rpim_opt.basics.units import LARGEST, SMALLEST, spelled, split_unit, with_unit
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.robot.mdh import Robot

Numbers = dict[tuple[str, str], Array]
"""Columns of numbers [SI] by (stem, dimension), and by (stem, "") where a stem has one dimension."""
SPREADS = ("sigma", "u95")
"""Stems of standard and expanded uncertainties."""


def text_columns(kind: Measurement) -> list[str]:
    """Return the columns of names that a table may have."""
    second = ["to_marker"] if kind.points == 2 else []
    return ["label", "configuration", "marker", "fixture", "session", *second, *kind.names]


def number_columns(robot: Robot, kind: Measurement) -> dict[str, list[str]]:
    """Return the columns of numbers that a table may have, name without unit to its dimensions; "" is a plain one."""
    joints = {f"q{i}": dimension for i, dimension in enumerate(robot.joint_dimensions, start=1)}
    joints |= {f"tau{i}": "torque" for i in range(1, robot.dof + 1)}
    joints |= {f"approach{i}": "" for i in range(1, robot.dof + 1)}
    plain = {**further_columns(robot, kind), **joints, **kind.columns, "payload": "mass"}
    for form, _ in kind.forms:
        plain |= form
    if kind.points == 2:
        plain |= {f"to_{stem}": dimension for stem, dimension in joints.items()}
    known = {stem: [dimension] for stem, dimension in plain.items()}
    for spread in SPREADS:
        known[spread] = sorted(set(kind.components.values()))
        known |= {f"{spread}_{name}": [dimension] for name, dimension in kind.components.items()}
    components = list(kind.components.items())
    for i, (a, of_a) in enumerate(components):
        for b, of_b in components[i:]:
            known[f"cov_{a}_{b}"] = [f"{of_a}2" if of_a == of_b else f"{of_a} {of_b}"]
    return known


def further_columns(robot: Robot, kind: Measurement) -> dict[str, str]:
    """Return the columns that terms and measurement see, name to dimension: temperature, and a user's own."""
    return {"temperature": "temperature", **robot.model.columns, **kind.extra}


def numeric(table: Columns, robot: Robot, kind: Measurement, label: Sequence[str]) -> Numbers:
    """Return the columns of numbers [SI]; refuse those that are unknown, in two units, or missing."""
    known = number_columns(robot, kind)
    columns = quantities_of(table, known, text_columns(kind), label)
    # joints, measured values, and whole groups of what is there in part
    joints, *groups = ([f"{stem}{i}" for i in range(1, robot.dof + 1)] for stem in ("q", "tau", "approach"))
    required = [*joints, *values_form(columns, kind)[0], *(name for name in kind.sees if name in kind.extra)]
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
    """Return all columns but those of names in SI; refuse those that are not known, stem to its dimensions."""
    columns: Numbers = {}
    for name in table:
        if name in names:
            continue
        stem, unit = split_unit(name)
        dimension = unit.dimension if unit else ""
        si = unit.si if unit else 1.0
        if stem not in known:
            others = {key: dimensions for key, dimensions in known.items() if "cov_" not in key}
            accepted = [each for key, dimensions in others.items() for each in spelled(key, dimensions, 1)]
            raise InputError("the header", f"column '{name}'", choices(name, [*names, *accepted]))
        if dimension not in known[stem]:
            accepted = ", ".join(spelled(stem, known[stem]))
            raise InputError("the header", f"column '{name}' without a unit of the right dimension", accepted)
        if (stem, dimension) in columns:
            raise InputError("the header", f"column '{stem}' in two units", "one of them")
        values = si * numbers(table[name], name, label) + (unit.zero if unit else 0.0)
        fits = np.abs(values) <= LARGEST
        accepted = f"a magnitude of at most {LARGEST / si:g}"
        if stem.startswith(SPREADS) and fits.all():
            fits = values >= SMALLEST
            accepted = f"an uncertainty greater than zero, from {SMALLEST / si:g} on"
        if not fits.all():
            i = int(np.argmin(fits))
            raise InputError(f"row {label[i]}, column {name}", f"{values[i] / si:g}", accepted)
        columns[stem, dimension] = values
        if len(known[stem]) == 1:
            columns[stem, ""] = values
    return columns


def values_form(columns: Numbers, kind: Measurement) -> tuple[list[str], Callable[[Array], Array]]:
    """Return the columns that state the measured values, and the function from them to y."""
    plain = all((stem, "") in columns for stem in kind.columns)
    for form, convert in () if plain else kind.forms:
        if all((stem, "") in columns for stem in form):
            return list(form), convert
    return list(kind.columns), lambda y: y


def labels(table: Columns, N: int) -> tuple[str, ...]:
    """Return the rows' labels, numbers from 1 by default; refuse names that are missing or there twice."""
    label = tuple(map(str, range(1, N + 1)))
    if "label" in table:
        label = texts(table["label"], "label")
        require_unique(label, "label")
    for column in ("marker", "to_marker", "fixture", "configuration", "point", "plane", "session"):
        for i, name in enumerate(texts(table.get(column, ()), column)):
            if not name:
                raise InputError(f"row {label[i]}, column {column}", "''", "a name")
    return label


def require_unique(names: Sequence[str], column: str) -> None:
    """Refuse a row without a name, or with one that an earlier row has."""
    seen: set[str] = set()
    for i, name in enumerate(names, start=1):
        if not name or name in seen:
            raise InputError(f"row {i}, column {column}", f"'{name}'", f"a {column} that no other row has")
        seen.add(name)
