"""Measured data: joint values, measured values and their covariance, row by row."""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rpim_opt.exceptions import InputError, choices
from rpim_opt.measurement import Measurement, position
from rpim_opt.robot import Array, Robot
from rpim_opt.units import accepted_units, quantities, split_unit


@dataclass(frozen=True, eq=False)
class Dataset:
    """Rows of measurements.

    Parameters
    ----------
    q
        (N, dof) joint values of the controller [rad or m].
    y
        (N, c) measured values [SI], in the order of the measurement's columns.
    covariance
        (N, k, k) of the residual's components [SI], or (1, k, k) when it is the same for all rows.
    label
        N row labels, unique.
    configuration
        (N,) number of the configuration a row belongs to: rows of one configuration stay together
        in cross-validation.
    """

    q: Array
    y: Array
    covariance: Array
    label: tuple[str, ...]
    configuration: np.ndarray

    def __len__(self) -> int:
        return len(self.q)

    def take(self, index: np.ndarray | list[int]) -> Dataset:
        """Return the rows at ``index``."""
        index = np.asarray(index, dtype=int)
        covariance = self.covariance if len(self.covariance) == 1 else self.covariance[index]
        labels = tuple(self.label[i] for i in index)
        return Dataset(self.q[index], self.y[index], covariance, labels, self.configuration[index])

    def without(self, labels: Collection[str]) -> Dataset:
        """Return the rows whose label is not among ``labels``."""
        return self.take([i for i, label in enumerate(self.label) if label not in labels])

    @classmethod
    def of(cls, q: Array, y: Array, sigma: float, label: tuple[str, ...] = ()) -> Dataset:
        """Return a dataset from arrays, with one standard deviation [SI] for all components of y."""
        q, y = np.atleast_2d(np.asarray(q, float)), np.atleast_2d(np.asarray(y, float))
        if len(q) != len(y) or not np.isfinite(q).all() or not np.isfinite(y).all():
            raise InputError("q and y", f"shapes {q.shape} and {y.shape}", "finite numbers, one row a measurement")
        if not sigma > 0:
            raise InputError("sigma", f"{sigma}", "a number greater than zero")
        labels = label or tuple(str(i + 1) for i in range(len(q)))
        return cls(q, y, sigma**2 * np.eye(y.shape[1])[None], labels, np.arange(len(q)))


def read_csv(
    path: str | Path, robot: Robot, noise: Mapping[str, float], measurement: Measurement = position
) -> Dataset:
    """Return the measurements of a CSV file.

    The header names every column with its unit: ``label, q1_deg, ..., x_mm, y_mm, z_mm``. Optional:
    ``label``, ``configuration``, ``sigma_mm`` (standard deviation of a row), ``sigma_x_mm`` (of one axis).

    Parameters
    ----------
    path
        The file, UTF-8.
    robot
        Its joints' number and types decide the joint columns.
    noise
        Standard deviations where no column states them: ``{"position_mm": 0.03}`` or ``{"x_mm": 0.03, ...}``.
    measurement
        Decides the columns of measured values.

    Raises
    ------
    InputError
        Naming the file, the row or column, what was found and what is accepted.
    """
    path = Path(path)
    declared = _declared(noise, measurement)  # outside: a mistake there is not the table's
    try:
        return _dataset(_table(path), robot, declared, measurement)
    except InputError as error:
        raise error.within(path) from None


def _table(path: Path) -> dict[str, list[str]]:
    """Return the columns of a CSV file as text."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            lines = [row for row in csv.reader(stream, strict=True) if any(cell.strip() for cell in row)]
    except FileNotFoundError:
        near = sorted(p.name for p in path.parent.glob("*.csv")) if path.parent.is_dir() else []
        raise InputError("the file", "nothing", choices(path.name, near), path) from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError("the file", str(error), "a readable UTF-8 CSV file", path) from None
    if not lines:
        raise InputError("the table", "an empty file", "a header and at least one row")
    header = [name.strip() for name in lines[0]]
    for name in header:
        if header.count(name) > 1:
            raise InputError("the header", f"column '{name}' twice", "every column once")
    if len(lines) == 1:
        raise InputError("the table", "a header and no rows", "at least one row")
    for number, row in enumerate(lines[1:], start=1):
        if len(row) != len(header):
            raise InputError(f"row {number} ({row[0]})", f"{len(row)} cells", f"{len(header)} cells as in the header")
    return {name: [row[i].strip() for row in lines[1:]] for i, name in enumerate(header)}


def _dataset(table: dict[str, list[str]], robot: Robot, declared: Mapping[str, float], kind: Measurement) -> Dataset:
    N = len(next(iter(table.values())))
    label = tuple(table.get("label") or (str(i + 1) for i in range(N)))
    seen: set[str] = set()
    for i, name in enumerate(label):
        if not name or name in seen:
            raise InputError(f"row {i + 1}, column label", f"'{name}'", "a label that no other row has")
        seen.add(name)
    joints = {f"q{i}": dimension for i, dimension in enumerate(robot.joint_dimensions, start=1)}
    sigmas = {f"sigma_{name}": dimension for name, dimension in kind.components.items()}
    optional = sigmas if len(set(kind.components.values())) > 1 else {"sigma": "length", **sigmas}
    known = {**joints, **kind.columns, **optional}
    columns: dict[str, Array] = {}
    for name, cells in table.items():
        stem, unit = split_unit(name)
        if name in ("label", "configuration"):
            continue
        if stem not in known:
            accepted = [f"{s}_{accepted_units(d)[0]}" for s, d in known.items()]
            raise InputError("the header", f"column '{name}'", choices(name, ["label", "configuration", *accepted]))
        accepted = ", ".join(f"{stem}_{u}" for u in accepted_units(known[stem]))
        if unit is None or unit.dimension != known[stem]:
            raise InputError("the header", f"column '{name}' without a unit that fits", accepted)
        if stem in columns:
            raise InputError("the header", f"column '{stem}' in two units", "one of them")
        columns[stem] = unit.si * np.array([_number(cell, row, name) for cell, row in zip(cells, label, strict=True)])
    for stem, dimension in {**joints, **kind.columns}.items():
        if stem not in columns:
            accepted = " or ".join(f"{stem}_{u}" for u in accepted_units(dimension))
            raise InputError("the header", f"no column for '{stem}' among {', '.join(table)}", accepted)
    covariance = _covariance(columns, declared, kind)
    for column in sigmas | {"sigma": ""}:
        wrong = np.flatnonzero(columns.get(column, np.ones(N)) <= 0)
        if len(wrong):
            raise InputError(f"row {label[wrong[0]]}, column {column}", "zero or less", "a standard deviation > 0")
    configuration = (
        np.unique(table["configuration"], return_inverse=True)[1] if "configuration" in table else np.arange(N)
    )
    q = np.column_stack([columns[name] for name in joints])
    return Dataset(q, np.column_stack([columns[name] for name in kind.columns]), covariance, label, configuration)


def _number(cell: str, row: str, column: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"row {row}, column {column}", f"'{cell}'", "a finite number")
    return value


def _declared(noise: Mapping[str, float], kind: Measurement) -> dict[str, float]:
    """Return the standard deviations [SI] that hold where a table states none."""
    accepted = {name: (dimension,) for name, dimension in {**kind.noise, **kind.components}.items()}
    declared = {stem: value for (stem, _), value in quantities(noise, accepted, "table noise").items()}
    for stem, value in declared.items():
        if not value > 0:
            raise InputError(f"table noise, key {stem}", f"{value:g}", "a standard deviation > 0")
    return declared


def _covariance(columns: Mapping[str, Array], declared: Mapping[str, float], kind: Measurement) -> Array:
    """Return (N or 1, k, k): a row's own standard deviations, else the declared ones."""
    sigma = []
    for name, dimension in kind.components.items():
        common = next((key for key, d in kind.noise.items() if d == dimension), "")
        choice = [
            columns.get(f"sigma_{name}"),
            columns.get("sigma"),
            declared.get(name),
            declared.get(common),
        ]
        value = next((v for v in choice if v is not None), None)
        if value is None:
            raise InputError("table noise", f"no standard deviation for '{name}'", f"{common}_mm or sigma_{name}_mm")
        sigma.append(np.atleast_1d(value))
    spread = np.stack(np.broadcast_arrays(*sigma), axis=1)
    return spread[:, :, None] ** 2 * np.eye(spread.shape[1])
