"""Pose accuracy and pose repeatability by ISO 9283:1998 (7.2.1 and 7.2.2), from arrays and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array, finite_numbers
from rpim_opt.basics.exceptions import InputError, of_file
from rpim_opt.basics.tables import csv_text, numbers, read_columns, texts
from rpim_opt.basics.text import Tabled, counted, listed, table
from rpim_opt.basics.units import LARGEST, UNITS, parse_units, split
from rpim_opt.data.tables.formats.registry import read_raw
from rpim_opt.data.tables.names import recognize

CYCLES, POSES = 30, 5  # cycles and poses of the standard
ANGLES = ("a", "b", "c")  # the standard's names of the rotations
AXES = ("x", "y", "z")
ROTATIONS = (("rx", "ry", "rz"), ANGLES, ("w", "p", "r"))
"""Possible names of three angles; each is evaluated separately, whatever its axis."""
DIMENSIONS = dict.fromkeys(AXES, "length") | {stem: "angle" for group in ROTATIONS for stem in group}
ACCEPTED = "pose, x_mm, y_mm, z_mm; with a command command_x_mm, ...; with an orientation rx_deg, ry_deg, rz_deg"


@dataclass(frozen=True, eq=False, repr=False)
class Performance(Tabled):
    """Accuracy and repeatability at the poses of a table.

    ``poses`` has one row per pose: its name ``pose``, ``cycles`` (approaches), and by name [mm, mrad] the distance
    ``AP_p_mm`` of the barycentre of attained positions from the command, its components ``AP_x_mm``, ..., None without
    command, and the positioning repeatability ``RP_l_mm``. If orientations were measured, it has for each angle, by its
    name in the table, mean minus command and 3 standard deviations, ``AP_a_mrad`` and ``RP_a_mrad``.
    """

    poses: tuple[Mapping[str, Any], ...]

    @property
    def accuracy(self) -> float | None:
        """The largest positioning accuracy AP of all poses [m]; None where no command is known."""
        known = [1e-3 * each["AP_p_mm"] for each in self.poses if each["AP_p_mm"] is not None]
        return max(known, default=None)

    @property
    def repeatability(self) -> float:
        """The largest positioning repeatability RP of all poses [m]."""
        return max(1e-3 * each["RP_l_mm"] for each in self.poses)

    def content(self) -> dict[str, Any]:
        """Return the figures [mm, mrad]."""
        return {
            "standard": "ISO 9283:1998, 7.2.1 and 7.2.2",
            "accuracy_mm": self.accuracy and 1e3 * self.accuracy,
            "repeatability_mm": 1e3 * self.repeatability,
            "poses": self.poses,
            "notes": self._notes(),
        }

    def csv(self) -> str:
        """Return the rows as CSV."""
        return csv_text(self.poses[0], (row.values() for row in self.poses))

    def __str__(self) -> str:
        rows = self.poses
        parts = []
        for unit in ("_mm", "_mrad"):
            shown = [key for key in rows[0] if key.endswith(unit) and rows[0][key] is not None]
            head = ["pose", "cycles", *(key.replace(unit, f" [{unit[1:]}]") for key in shown)]
            lines = [[row["pose"], str(row["cycles"]), *(f"{row[key]:.4f}" for key in shown)] for row in rows]
            if shown:
                parts.append(table(head, lines))
        return "\n".join([*parts, "ISO 9283:1998, 7.2.1 (AP) and 7.2.2 (RP).", *self._notes()])

    def _short(self) -> str:
        return f"at {counted(len(self.poses), 'pose')}, RP {1e3 * self.repeatability:.4g} mm"

    def _notes(self) -> list[str]:
        """Return how the table differs from what the standard requires, and what is not known."""
        lines: list[str] = []
        cycles = sorted({each["cycles"] for each in self.poses})
        if cycles[0] < CYCLES or len(self.poses) < POSES:
            found = f"{counted(len(self.poses), 'pose')}, with at least {cycles[0]} approaches each"
            lines.append(f"The standard requires {POSES} poses, {CYCLES} approaches each: the table has {found}.")
        if self.accuracy is None:
            lines.append("No commanded poses are known: repeatability is computed, accuracy is not.")
        return lines

    def _frame_rows(self) -> list[dict[str, Any]]:
        return [dict(each) for each in self.poses]


def iso9283(
    pose: Sequence[str],
    position: Array,
    command: Array | None = None,
    angles: Array | None = None,
    command_angles: Array | None = None,
    names: tuple[str, ...] = ANGLES,
) -> Performance:
    """Return pose accuracy and repeatability of repeated approaches.

    With n approaches of a pose, attained positions p_j, their barycentre m and the command c::

        AP_p = |m - c|                        AP_a = mean(a_j) - a_c
        l_j  = |p_j - m|                      S_a  = sqrt(sum (a_j - mean(a))^2 / (n - 1))
        S_l  = sqrt(sum (l_j - mean(l))^2 / (n - 1))
        RP_l = mean(l) + 3 S_l                RP_a = 3 S_a,  and the same for b and c

    (ISO 9283:1998, 7.2.1 and 7.2.2.) Attained positions are readings and contain measurement noise. Angles are taken
    within half a turn of the command, or of the first approach.

    ``pose`` are N names of the approached poses, ``position`` and ``command`` (N, 3) attained and commanded positions
    [m] in one frame, ``angles`` and ``command_angles`` (N, 3) the same for orientations [rad], three angles named
    ``names``. Without commands there is no accuracy. InputError for shapes that do not fit, and a pose that is
    approached once, or whose command changes.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> reached = 1e-3 * np.array([[0.1, 0, 0], [-0.1, 0, 0], [0, 0.1, 0], [0, -0.1, 0]])
    >>> found = ro.use.iso9283(["P1"] * 4, reached, command=np.full((4, 3), 1e-3))
    >>> print(f"{1e3 * found.accuracy:.3f} mm, {1e3 * found.repeatability:.3f} mm")
    1.732 mm, 0.100 mm
    """
    if not len(pose):
        raise InputError("iso9283", "no approach", "at least two per pose")
    stated = {"positions": position, "commanded positions": command}
    stated |= {"angles": angles, "commanded angles": command_angles}
    attained, commanded, turned, commanded_turns = (_rows(values, len(pose), what) for what, values in stated.items())
    poses = []
    for name in dict.fromkeys(pose):
        at = np.array([each == name for each in pose])
        if at.sum() < 2:
            raise InputError(f"pose '{name}'", "one approach", f"two or more, {CYCLES} by the standard")
        barycentre = attained[at].mean(axis=0)
        length = np.linalg.norm(attained[at] - barycentre, axis=1)
        offset = barycentre - _one_command(commanded[at], name, "position")
        figures = {"AP_p_mm": np.linalg.norm(offset)}
        figures |= {f"AP_{axis}_mm": part for axis, part in zip(AXES, offset, strict=True)}
        figures["RP_l_mm"] = length.mean() + 3 * length.std(ddof=1)
        if angles is not None:
            start = _one_command(commanded_turns[at], name, "orientation")
            from_start = turned[at] - np.where(np.isnan(start), turned[at][0], start)
            beside = (from_start + np.pi) % (2 * np.pi) - np.pi
            means = np.where(np.isnan(start), np.nan, beside.mean(axis=0))
            figures |= {f"AP_{angle}_mrad": mean for angle, mean in zip(names, means, strict=True)}
            spreads = 3 * beside.std(axis=0, ddof=1)
            figures |= {f"RP_{angle}_mrad": spread for angle, spread in zip(names, spreads, strict=True)}
        known = {key: None if np.isnan(value) else 1e3 * float(value) for key, value in figures.items()}
        poses.append({"pose": name, "cycles": int(at.sum()), **known})
    return Performance(tuple(poses))


def _one_command(values: Array, name: str, what: str) -> Array:
    """Return the command of a pose (3,), which all its rows repeat; NaN without one."""
    if np.ptp(values, axis=0).max() > 1e-9:
        raise InputError(f"pose '{name}'", f"commands of more than one {what}", "one command per pose")
    return values[0]


def _rows(values: Array | None, N: int, what: str) -> Array:
    """Return stated values (N, 3), or NaN."""
    if values is None:
        return np.full((N, 3), np.nan)
    array = finite_numbers(what, values, (N, 3))
    far = np.abs(array).max(axis=1) > LARGEST
    if far.any():
        row = int(far.argmax())
        raise InputError(f"{what}, row {row + 1}", f"{array[row]}", f"magnitudes of at most {LARGEST:g} m or rad")
    return array


@of_file
def read_approaches(source: Any, units: str = "") -> Performance:
    """Return pose accuracy and repeatability of a table of repeated approaches (`iso9283`).

    ``source`` is a text, Excel or Parquet file, or columns by name: ``pose``, attained ``x_mm, y_mm, z_mm``, commanded
    ``command_x_mm, ...`` (or Nominal X, Target X, ...), and angles ``rx_deg, ry_deg, rz_deg`` likewise. ``units`` are
    those of columns whose name has none, ``"deg,mm"``. InputError for missing columns, columns without unit, cells that
    are not numbers, and as for `iso9283`.

    >>> import rpim_opt as ro
    >>> columns = {"pose": ["P1", "P1"], "X [mm]": [1.0, 3.0], "Y [mm]": [0.0, 0.0], "Z [mm]": [0.0, 0.0]}
    >>> columns |= {f"Nominal {axis} [mm]": [0.0, 0.0] for axis in "XYZ"}
    >>> found = ro.use.read_approaches(columns)
    >>> round(1e3 * found.accuracy, 3), round(1e3 * found.repeatability, 3)
    (2.0, 1.0)
    """
    columns = read_raw(Path(source)).columns if isinstance(source, str | Path) else read_columns(source)
    stated = parse_units(units)
    poses: dict[str, str] = {}
    attained: dict[str, tuple[str, float]] = {}  # name and size in SI of the units of coordinates and angles
    commanded: dict[str, tuple[str, float]] = {}
    for name in columns:
        stem, unit = split(name)
        meaning = recognize(stem)
        of = {"measured": attained, "wanted": commanded}.get(meaning.kind or "measured")
        if meaning.stem in ("configuration", "label"):
            poses.setdefault(meaning.stem, name)
        elif of is not None and meaning.stem in DIMENSIONS:
            if meaning.stem in of:
                raise InputError("the header", f"'{of[meaning.stem][0]}' and '{name}'", "one of them")
            dimension = DIMENSIONS[meaning.stem]
            unit = unit or stated.get(dimension, "")
            if not unit or UNITS[unit].dimension != dimension:
                found = f"column '{name}' without a unit of {dimension}"
                raise InputError("the header", found, "x_mm, or --units deg,mm")
            of[meaning.stem] = name, UNITS[unit].si
    pose = poses.get("configuration", poses.get("label"))
    if pose is None or not set(AXES) <= set(attained):
        raise InputError("the header", listed(list(columns), 6), ACCEPTED)
    angles = next((group for group in ROTATIONS if set(group) <= set(attained)), ())

    def beside(of: Mapping[str, tuple[str, float]], stems: tuple[str, ...]) -> Any:
        """Return columns side by side (N, 3), or None where the table has none of them."""
        if not set(stems) & set(of):
            return None
        missing = [stem for stem in stems if stem not in of]
        if missing:
            raise InputError("the header", f"no column for {listed(missing)}", f"all of {', '.join(stems)}, or none")
        return np.column_stack([si * numbers(columns[name], name) for name, si in (of[stem] for stem in stems)])

    return iso9283(
        texts(columns[pose], pose), beside(attained, AXES), beside(commanded, AXES), beside(attained, angles),
        beside(commanded, angles), angles or ROTATIONS[0],
    )  # fmt: skip
