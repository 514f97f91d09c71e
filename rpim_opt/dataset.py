"""Measured data: joint values, measured values and their covariance, row by row."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.exceptions import InputError, choices
from rpim_opt.measurement import LaserTracker, Measurement, position
from rpim_opt.robot import Array, Robot
from rpim_opt.tables import Columns, numbers, read_columns, texts
from rpim_opt.units import quantities, split_unit, with_unit

TRACKER = {
    "range": ("length", "ratio"), "transverse": ("length",), "angle": ("angle",),
    "x": ("length",), "y": ("length",), "z": ("length",),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Block:
    """Rows of a dataset that one function evaluates: one measurement model, the same reflectors and fixture.

    Parameters
    ----------
    measurement
        What the instrument sees.
    q
        (N, p, dof) joint values of the controller [rad or m] at the p points of a row.
    y
        (N, c) measured values [SI], in the order of the measurement's columns.
    covariance
        (N, k, k) of the residual's components [SI], or (1, k, k) when it is the same for all rows.
    row
        (N,) which row of the dataset each one is.
    markers
        The reflector of each point; ``""`` for the only one.
    fixture
        Which anchor, plane or sphere; ``""`` for the only one.
    torque
        (N, p, dof) joint torques of the controller's joints [Nm], or None.
    """

    measurement: Measurement
    q: Array
    y: Array
    covariance: Array
    row: np.ndarray
    markers: tuple[str, ...] = ("",)
    fixture: str = ""
    torque: Array | None = None

    def take(self, index: np.ndarray, row: np.ndarray) -> Block:
        """Return the entries at ``index``, which become the rows ``row``."""
        covariance = self.covariance if len(self.covariance) == 1 else self.covariance[index]
        torque = None if self.torque is None else self.torque[index]
        return replace(self, q=self.q[index], y=self.y[index], covariance=covariance, row=row, torque=torque)


@dataclass(frozen=True, eq=False)
class Dataset:
    """Rows of measurements, of one kind or several.

    Parameters
    ----------
    blocks
        The rows, grouped by what evaluates them.
    label
        N row labels, unique.
    configuration
        (N,) number of the configuration a row belongs to: rows of one configuration stay together
        in cross-validation.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> data = ro.load("paper_arm").problem.data
    >>> len(data), data.q.shape, data.label[:3]
    (9, (9, 6), ('T2-1', 'T2-2', 'T2-3'))
    >>> data.take([2, 0]).label, data.without({"T2-1"}).label[:2]
    (('T2-3', 'T2-1'), ('T2-2', 'T2-3'))
    """

    blocks: tuple[Block, ...]
    label: tuple[str, ...]
    configuration: np.ndarray

    def __len__(self) -> int:
        return len(self.label)

    @property
    def q(self) -> Array:
        """Joint values of the controller at every row's first point, (N, dof) [rad or m]."""
        q = np.empty((len(self), self.blocks[0].q.shape[2]))
        for block in self.blocks:
            q[block.row] = block.q[:, 0]
        return q

    def take(self, index: Sequence[int] | np.ndarray) -> Dataset:
        """Return the rows at ``index`` (K,), in that order; a row may be taken more than once."""
        index = np.asarray(index, dtype=int)
        owner, place = np.empty(len(self), dtype=int), np.empty(len(self), dtype=int)
        for i, block in enumerate(self.blocks):
            owner[block.row], place[block.row] = i, np.arange(len(block.row))
        blocks = []
        for i, block in enumerate(self.blocks):
            row = np.flatnonzero(owner[index] == i)
            if len(row):
                blocks.append(block.take(place[index[row]], row))
        return Dataset(tuple(blocks), tuple(self.label[i] for i in index), self.configuration[index])

    def without(self, labels: Collection[str]) -> Dataset:
        """Return the rows whose label is not among ``labels``."""
        return self.take([i for i, label in enumerate(self.label) if label not in labels])

    def configurations(self, count: int, seed: int) -> Dataset:
        """Return the rows of some configurations drawn at random.

        Parameters
        ----------
        count
            How many configurations.
        seed
            Of the draw: the same seed gives the same rows.

        Raises
        ------
        InputError
            For a count below 1 or above the number of configurations.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> data = ro.load("markers").problem.data  # three reflectors: three rows a configuration
        >>> len(data), len(data.configurations(5, seed=0))
        (75, 15)
        """
        known = np.unique(self.configuration)
        if not 0 < count <= len(known):
            raise InputError("count", f"{count}", f"1 to {len(known)} configurations")
        drawn = np.random.default_rng(seed).choice(known, count, replace=False)
        return self.take(np.flatnonzero(np.isin(self.configuration, drawn)))

    @classmethod
    def of(
        cls, q: Array, y: Array, sigma: float | Array, label: tuple[str, ...] = (), measurement: Measurement = position
    ) -> Dataset:
        """Return a dataset from arrays.

        Parameters
        ----------
        q
            (N, dof) joint values of the controller [rad or m]; (N, p, dof) where a row involves p points.
        y
            (N, c) measured values [SI].
        sigma
            One standard deviation [SI] for all components of the residual, or their covariance, (k, k) or (N, k, k).
        label
            N row labels; numbers from 1 by default.
        measurement
            What the instrument sees.

        Raises
        ------
        InputError
            For shapes that do not fit together, numbers that are not finite, or a deviation that is not positive.

        Examples
        --------
        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> data = ro.Dataset.of(np.zeros((2, 6)), [[0.3, 0.0, 0.6], [0.3, 0.1, 0.6]], sigma=3e-5)
        >>> len(data), data.label
        (2, ('1', '2'))
        """
        q, y = np.asarray(q, float), np.asarray(y, float)
        q = q[:, None] if q.ndim == 2 else q
        shapes = f"shapes {q.shape} and {y.shape}"
        fits = (
            q.ndim == 3 and q.shape[:2] == (len(y), measurement.points) and y.shape[1:] == (len(measurement.columns),)
        )
        if not fits or not np.isfinite(q).all() or not np.isfinite(y).all():
            accepted = (
                f"finite numbers, {measurement.points} x dof joint and {len(measurement.columns)} measured values"
            )
            raise InputError("q and y", shapes, accepted + " a row")
        k, N = len(measurement.components), len(q)
        covariance = np.array(sigma, dtype=float) if np.ndim(sigma) else np.square(sigma) * np.eye(k)
        covariance = covariance[None] if covariance.ndim == 2 else covariance
        if covariance.shape[1:] != (k, k) or len(covariance) not in (1, N) or (np.ndim(sigma) == 0 and not sigma > 0):
            raise InputError("sigma", f"{sigma}", f"a number greater than zero, or a covariance of shape ({k}, {k})")
        labels, rows = label or tuple(str(i + 1) for i in range(N)), np.arange(N)
        block = Block(measurement, q, y, covariance, rows, ("",) * measurement.points)
        return cls((block,), labels, rows)

    @classmethod
    def together(cls, parts: Sequence[Dataset], names: Sequence[str]) -> Dataset:
        """Return several datasets as one.

        Rows of different parts belong to the same configuration when their joint values are equal.

        Parameters
        ----------
        parts
            The datasets, of a robot.
        names
            What precedes the labels of each part, ``name:label``, where labels occur twice.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> data = ro.load("paper_arm").problem.data
        >>> twice = ro.Dataset.together([data, data], ["morning", "evening"])
        >>> len(twice), twice.label[0], len(set(twice.configuration))
        (18, 'morning:T2-1', 9)
        """
        labels = [label for part in parts for label in part.label]
        if len(set(labels)) < len(labels):
            labels = [f"{name}:{label}" for name, part in zip(names, parts, strict=True) for label in part.label]
        blocks, configuration, rows, count = [], [], 0, 0
        for part in parts:
            blocks += [replace(block, row=block.row + rows) for block in part.blocks]
            configuration.append(part.configuration + count)
            rows += len(part)
            count += int(part.configuration.max()) + 1
        whole = cls(tuple(blocks), tuple(labels), np.concatenate(configuration))
        stop = np.unique(whole.q, axis=0, return_inverse=True)[1]
        first = np.full(rows, rows)
        np.minimum.at(first, stop, whole.configuration)
        joined = np.full(count, count)
        np.minimum.at(joined, whole.configuration, first[stop])
        return replace(whole, configuration=joined[whole.configuration])


def read_data(
    source: Any, robot: Robot, noise: Mapping[str, Any] | None = None, measurement: Measurement = position
) -> Dataset:
    """Return the measurements of a table.

    Every column's name carries its unit: ``label, q1_deg, ..., x_mm, y_mm, z_mm``. Optional columns are

    - ``label``; ``configuration`` (rows of one stay together; rows with equal joint values by default);
    - ``marker`` (which reflector); ``fixture`` (which anchor, plane or sphere);
    - ``sigma_mm``, ``sigma_x_mm`` (standard deviations of a row, of one component), ``u95_mm``, ``u95_x_mm``
      (expanded uncertainties, coverage factor 2), ``cov_x_y_mm2``, ``cov_x_rx_mm_mrad`` (covariances);
    - ``tau1_Nm``, ... (joint torques);
    - for a second point ``to_q1_deg``, ..., ``to_marker``, ``to_tau1_Nm``.

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
    >>> arm = ro.Robot("two links", np.array([[0, 0, 0, 0, 0], [0, 0.4, 0, 0, 0]]))
    >>> table = {"q1_deg": [0, 90], "q2_deg": [0, 30], "x_mm": [401, 2], "y_mm": [0, 400], "z_mm": [0, 1]}
    >>> data = ro.read_data(table, arm, {"position_mm": 0.05})
    >>> data.q.round(3).tolist(), data.blocks[0].y[0].tolist()  # [rad], [m]
    ([[0.0, 0.0], [1.571, 0.524]], [0.401, 0.0, 0.0])
    """
    declared = _declared(noise or {}, measurement)  # outside: a mistake there is not the table's
    try:
        return _dataset(read_columns(source), robot, declared, measurement)
    except InputError as error:
        raise error.within(source if isinstance(source, str | Path) else None) from None


def _dataset(table: Columns, robot: Robot, declared: Mapping[str, Any], kind: Measurement) -> Dataset:
    N = len(next(iter(table.values())))
    label = _labels(table, N)
    columns = _numeric(table, robot, kind, label)

    def several(names: Sequence[str]) -> Array:
        return np.column_stack([columns[name, ""] for name in names]) if names else np.empty((N, 0))

    dof = range(1, robot.dof + 1)
    prefixes = ["", "to_"][: kind.points]
    q = [several([f"q{i}" for i in dof])]
    if kind.points == 2:
        q.append(several([f"to_q{i}" for i in dof]) if ("to_q1", "") in columns else q[0])
    torque = None
    if ("tau1", "") in columns:
        torque = np.stack([several([f"{p if (p + 'tau1', '') in columns else ''}tau{i}" for i in dof])
                           for p in prefixes], axis=1)  # fmt: skip
    y = several(_form(columns, kind)[0])
    try:
        y = kind.prepare(_form(columns, kind)[1](y))
    except InputError as error:
        raise InputError(f"row {label[int(error.where)]}", error.found, error.accepted) from None
    covariance = _covariance(columns, declared, kind, y, label)
    names = [_texts(table, (p + "marker", "marker"), N) for p in prefixes]
    fixture = _texts(table, ("fixture",), N)
    if kind.points == 2:
        still = [i for i in range(N) if names[0][i] == names[1][i] and np.array_equal(q[0][i], q[1][i])]
        if still:
            found = "twice the same reflector in the same configuration"
            raise InputError(f"row {label[still[0]]}", found, "to_marker or to_q1, ... of another point")
    if "configuration" in table:
        configuration = np.unique(texts(table["configuration"], "configuration"), return_inverse=True)[1]
    else:
        configuration = np.unique(np.hstack(q), axis=0, return_inverse=True)[1]
    whole = Block(kind, np.stack(q, axis=1), y, covariance, np.arange(N), torque=torque)
    if not {"marker", "to_marker", "fixture"} & set(table):
        return Dataset((replace(whole, markers=("",) * kind.points),), label, configuration)
    groups: dict[tuple[str, ...], list[int]] = {}
    for i, key in enumerate(zip(*names, fixture, strict=True)):
        groups.setdefault(key, []).append(i)
    blocks = []
    for (*markers, place), rows in groups.items():
        index = np.array(rows)
        blocks.append(replace(whole.take(index, index), markers=tuple(markers), fixture=place))
    return Dataset(tuple(blocks), label, configuration)


def _texts(table: Columns, columns: Sequence[str], N: int) -> Sequence[str]:
    """Return the texts of the first of the columns that is there, or N empty ones."""
    found = next((column for column in columns if column in table), None)
    return ("",) * N if found is None else texts(table[found], found)


def _labels(table: Columns, N: int) -> tuple[str, ...]:
    label = texts(table["label"], "label") if "label" in table else tuple(map(str, range(1, N + 1)))
    seen: set[str] = set()
    for i, name in enumerate(label if "label" in table else ()):
        if not name or name in seen:
            raise InputError(f"row {i + 1}, column label", f"'{name}'", "a label that no other row has")
        seen.add(name)
    for column in ("marker", "to_marker", "fixture", "configuration"):
        for i, name in enumerate(texts(table.get(column, ()), column)):
            if not name:
                raise InputError(f"row {label[i]}, column {column}", "''", "a name")
    return label


def text_columns(kind: Measurement) -> list[str]:
    """Return the columns of names that a table may have."""
    return ["label", "configuration", "marker", "fixture", *(["to_marker"] if kind.points == 2 else [])]


def number_columns(robot: Robot, kind: Measurement) -> dict[str, list[str]]:
    """Return the columns of numbers that a table may have, name without unit to its dimensions; "" is a plain one."""
    joints = {f"q{i}": dimension for i, dimension in enumerate(robot.joint_dimensions, start=1)}
    torques = {f"tau{i}": "torque" for i in range(1, robot.dof + 1)}
    known: dict[str, list[str]] = {stem: [d] for stem, d in {**joints, **kind.columns, **torques}.items()}
    for form, _ in kind.forms:
        known.update({stem: [dimension] for stem, dimension in form.items()})
    if kind.points == 2:
        known.update({f"to_{stem}": [dimension] for stem, dimension in {**joints, **torques}.items()})
    dims = list(kind.components.values())
    for spread in ("sigma", "u95"):
        known[spread] = sorted(set(dims))
        known.update({f"{spread}_{name}": [dimension] for name, dimension in kind.components.items()})
    for i, (a, da) in enumerate(kind.components.items()):
        for b, db in list(kind.components.items())[i:]:
            known[f"cov_{a}_{b}"] = [f"{da}2" if da == db else f"{da} {db}"]
    return known


def _numeric(table: Columns, robot: Robot, kind: Measurement, label: tuple[str, ...]) -> dict[tuple[str, str], Array]:
    """Return the numeric columns [SI] by (stem, dimension), and by (stem, "") where a stem has one dimension."""
    joints, torques = ([f"{stem}{i}" for i in range(1, robot.dof + 1)] for stem in ("q", "tau"))
    known, plain = number_columns(robot, kind), text_columns(kind)
    columns: dict[tuple[str, str], Array] = {}
    for name, cells in table.items():
        if name in plain:
            continue
        stem, unit = split_unit(name)
        dimension = unit.dimension if unit else ""
        if stem not in known:
            accepted = [n for s, ds in known.items() for d in ds for n in with_unit(s, d, 1) if "cov_" not in s]
            raise InputError("the header", f"column '{name}'", choices(name, [*plain, *accepted]))
        if dimension not in known[stem]:
            accepted = ", ".join(n for d in known[stem] for n in with_unit(stem, d))
            raise InputError("the header", f"column '{name}' without a unit that fits", accepted)
        if (stem, dimension) in columns:
            raise InputError("the header", f"column '{stem}' in two units", "one of them")
        values = (unit.si if unit else 1.0) * numbers(cells, label, name)
        columns[stem, dimension] = values
        if len(known[stem]) == 1:
            columns[stem, ""] = values
        if stem.startswith(("sigma", "u95")) and not (values > 0).all():
            row = label[int(np.argmin(values > 0))]
            found = f"{values.min() / (unit.si if unit else 1.0):g}"
            raise InputError(f"row {row}, column {name}", found, "an uncertainty greater than zero")
    groups = [torques]
    if kind.points == 2:
        groups += [[f"to_{s}" for s in group] for group in (joints, torques)]
    optional = [group for group in groups if any((stem, "") in columns for stem in group)]
    form = {stem: known[stem][0] for stem in _form(columns, kind)[0]}
    for stem in [*joints, *form, *(stem for group in optional for stem in group)]:
        if (stem, "") not in columns:
            accepted = " or ".join(with_unit(stem, known[stem][0]))
            raise InputError("the header", f"no column for '{stem}' among {', '.join(table)}", accepted)
    return columns


def _form(columns: Mapping[tuple[str, str], Array], kind: Measurement) -> tuple[list[str], Any]:
    """Return the columns that state the measured values, and the function from them to y."""
    for form, convert in kind.forms:
        if all((stem, "") in columns for stem in form):
            return list(form), convert
    return list(kind.columns), lambda y: y


def _declared(noise: Mapping[str, Any], kind: Measurement) -> dict[str, Any]:
    """Return what holds where a table states no uncertainty: standard deviations [SI], perhaps a ``tracker``."""
    accepted = {name: (dimension,) for name, dimension in {**kind.noise, **kind.components}.items()}
    declared: dict[str, Any] = {}
    tracker = noise.get("tracker")
    if tracker is not None:
        if not isinstance(tracker, Mapping) or not {"x", "y", "z"} <= set(kind.columns):
            raise InputError("table noise, key tracker", repr(tracker)[:60], "a table, for positions and poses")
        given = quantities(tracker, TRACKER, "table noise.tracker")
        terms = {"range_ppm" if d == "ratio" else stem: value for (stem, d), value in given.items()}
        if not any(terms.get(term, 0) > 0 for term in ("range", "transverse")):
            raise InputError("table noise.tracker", "no range_um and no transverse_um", "at least one of them > 0")
        declared["tracker"] = LaserTracker(**terms)
    plain = {key: value for key, value in noise.items() if key != "tracker"}
    for (stem, _), value in quantities(plain, accepted, "table noise").items():
        if not value > 0:
            raise InputError(f"table noise, key {stem}", f"{value:g}", "a standard deviation > 0")
        declared[stem] = value
    return declared


def _covariance(
    columns: Mapping[tuple[str, str], Array],
    declared: Mapping[str, Any],
    kind: Measurement,
    y: Array,
    label: Sequence[str],
) -> Array:
    """Return (N or 1, k, k): what a row states of itself, else the declared deviations and the tracker's."""
    names, k = list(kind.components), len(kind.components)
    tracker: LaserTracker | None = declared.get("tracker")
    instrument = np.zeros((1, k, k))
    if tracker is not None:
        at = [list(kind.columns).index(c) for c in "xyz"]
        instrument = np.zeros((len(y), k, k))
        instrument[:, :3, :3] = tracker.covariance(y[:, at])
    spread, own = [], []
    for i, (name, dimension) in enumerate(kind.components.items()):
        common = next((key for key, d in kind.noise.items() if d == dimension), "")
        stated = [columns.get((f"sigma_{name}", "")), columns.get(("sigma", dimension)),
                  _half(columns.get((f"u95_{name}", ""))), _half(columns.get(("u95", dimension)))]  # fmt: skip
        value = next((v for v in stated if v is not None), None)
        own.append(value is not None)
        value = value if value is not None else declared.get(name, declared.get(common))
        if value is None and not instrument[:, i, i].any() and (f"cov_{name}_{name}", "") not in columns:
            accepted = (
                f"{with_unit(common, dimension, 2)[-1]}, or a column {with_unit(f'sigma_{name}', dimension, 2)[-1]}"
            )
            raise InputError("table noise", f"no standard deviation for '{name}'", accepted)
        spread.append(np.atleast_1d(0.0 if value is None else value))
    deviation = np.stack(np.broadcast_arrays(*spread), axis=1)
    covariance = deviation[:, :, None] ** 2 * np.eye(k)
    shared = np.outer(~np.array(own), ~np.array(own))
    covariance = covariance + instrument * shared
    stated_cov = {(a, b): columns[f"cov_{a}_{b}", ""] for a in names for b in names if (f"cov_{a}_{b}", "") in columns}
    if stated_cov:
        covariance = np.broadcast_to(covariance, (len(y), k, k)).copy()
        for (a, b), values in stated_cov.items():
            i, j = names.index(a), names.index(b)
            covariance[:, i, j] = covariance[:, j, i] = values
    unit = np.sqrt(np.einsum("nii->ni", covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        smallest = np.linalg.eigvalsh(np.nan_to_num(covariance / (unit[:, :, None] * unit[:, None, :])))[:, 0]
    if not (smallest > 1e-9).all():
        row = label[int(np.argmin(smallest > 1e-9))]
        raise InputError(f"row {row}, columns cov_...", "a covariance that is not positive definite", "one that is")
    return covariance


def _half(values: Array | None) -> Array | None:
    """Return standard deviations from expanded uncertainties, coverage factor 2."""
    return None if values is None else values / 2
