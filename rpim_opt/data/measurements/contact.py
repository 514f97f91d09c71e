"""Touches of unmeasured points and planes, and known distances and angles between them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, pick
from rpim_opt.basics.tables import Columns
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.data.measurements.distance import distance
from rpim_opt.data.measurements.measurement import XYZ, Measurement, Words, origin

COORDINATE = re.compile(r"(?<![a-z])[xyz](?![a-z])")
"""Coordinate in the name of a column that holds measured values."""
TOUCHED = ("point", "plane")  # columns that name the touched point or plane


def names_touches(tables: Sequence[Columns]) -> bool:
    """Return whether a table names touched points repeatedly and has no measured coordinates."""
    named = [(name.strip().lower(), cells) for table in tables for name, cells in table.items()]
    repeated = any(name in TOUCHED and len({str(cell) for cell in cells}) < len(cells) for name, cells in named)
    return repeated and not any(COORDINATE.search(name) for name, _ in named)


revisit_plane = Measurement(
    "revisit_plane",
    model=origin,
    columns={},
    components=XYZ,
    noise={"position": "length"},
    touching=True,
    planar=True,
    names=TOUCHED,
    words=Words(
        target="a tip",
        at_flange="The tip that touches, a ball's centre,",
        noise_of="a good robot, a tight fit",
        wrong="the tip slipped",
        columns={"point": "touched point", "plane": "touched plane"},
    ),
)
"""A touch of an unmeasured plane: r_i = n'(c - p_i), with n and c normal and centre of the best-fitting plane."""

revisit = replace(
    revisit_plane, name="revisit", planar=False, variants={"plane": revisit_plane}, shown_by=names_touches
)
"""A touch of an unmeasured point: r_i = c - p_i, with c the mean position of all its touches."""

known_distance = replace(distance, name="known_distance")
"""The known distance between two touched points or parallel planes: r = y - |c2 - c1|."""

known_square = Measurement(
    "known_square", lambda T1, T2: 0 * T1[0, 0], {"angle": "angle"}, noise={"angle": "angle"}, points=2
)
"""Two touched planes at right angles: r = -asin(n1'n2)."""

known_parallel = Measurement(
    "known_parallel",
    model=lambda T1, T2: 0 * T1[:2, 0],
    columns={"angle": "angle"},
    components={"tilt_1": "angle", "tilt_2": "angle"},
    noise={"angle": "angle"},
    points=2,
)
"""Two parallel touched planes: r = -(t1'n2, t2'n2), with two directions t in the first plane."""

TYPES = (revisit,)
KNOWN = (known_distance, known_square, known_parallel)
"""Known dimensions of touched objects: constraints in the form of measurement types."""
UNNAMED = (revisit_plane, *KNOWN)  # ready types that no problem file names as its measurement


@dataclass(frozen=True)
class KnownDistance:
    """Known distance between two touched points or two parallel touched planes.

    ``between`` are the two names, ``value`` > 0 is the distance [m], ``sigma`` its standard deviation [m].
    """

    between: tuple[str, str]
    value: float
    sigma: float
    measurement: ClassVar[Measurement] = known_distance

    def __post_init__(self) -> None:
        if not self.value > 0:
            raise InputError("known distance", f"{self.value:g} m", "a length greater than zero")
        _require_sound(self)


@dataclass(frozen=True)
class KnownAngle:
    """Known angle between two touched planes: parallel or perpendicular.

    ``between`` are the two names, ``sigma`` is the standard deviation of the angle [rad], ``value`` the deviation of
    the angle from 0 or 90 degrees [rad].
    """

    between: tuple[str, str]
    parallel: bool
    sigma: float
    value: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        _require_sound(self)

    @property
    def measurement(self) -> Measurement:
        """The model of its row."""
        return known_parallel if self.parallel else known_square


Known = KnownDistance | KnownAngle  # known dimensions, from a drawing or a certificate


def _require_sound(known: Known) -> None:
    where = known.measurement.name.replace("_", " ")
    if not known.sigma > 0:
        raise InputError(where, f"sigma {known.sigma:g}", "a standard deviation greater than zero")
    if known.between[0] == known.between[1]:
        raise InputError(where, f"'{known.between[0]}' twice", "two names")


def with_known(data: Dataset, known: Sequence[Known]) -> Dataset:
    """Return the measurements with rows added for known distances and angles.

    Points joined by a distance then belong together: cross-validation leaves out all or none of their rows. InputError
    for names that no row touches, and for points where planes are required.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> q = np.linspace(0, 1, 24).reshape(4, 6)
    >>> data = ro.data.touches(q, ["A", "A", "B", "B"], sigma=1e-4)
    >>> whole = ro.data.with_known(data, [ro.data.KnownDistance(("A", "B"), 0.3, 5e-6)])
    >>> whole.label, whole.configuration.tolist()
    (('1', '2', '3', '4', 'A to B'), [0, 0, 0, 0, 0])
    """
    if not known:
        return data
    touched: dict[str, Block] = {}  # the first touch of every point, a block of one row
    for block in data.blocks:
        if block.point is not None and block.measurement.touching:
            for name, i in zip(*np.unique(block.point[:, 0].astype(str), return_index=True), strict=True):
                touched.setdefault(str(name), block.take(np.array([i]), np.array([0])))
    parts = [data]
    for each in known:
        where = each.measurement.name.replace("_", " ")
        first, second = (pick(touched, name, where) for name in each.between)
        planar = {first.measurement.planar, second.measurement.planar}
        if len(planar) > 1 or (each.measurement is not known_distance and planar == {False}):
            accepted = "two planes, or two points for a distance"
            raise InputError(where, f"between '{each.between[0]}' and '{each.between[1]}'", accepted)
        # the row has the joint values of one touch of either, and a robot if all touches of both are by it
        if second.robot != first.robot:
            first = second
        stated: dict[str, Any] = {"payload": first.payload}
        for what in ("torque", "approach"):
            both = [getattr(one, what) for one in (first, second)]
            if all(values is not None for values in both):
                stated[what] = np.concatenate(both, axis=1)
        q = np.concatenate([first.q, second.q], axis=1)
        label = " to ".join(each.between)
        if any(label in part.label for part in parts[1:]):  # planes may have both an angle and a distance
            label = f"{label}, {each.measurement.name.removeprefix('known_')}"
        row = Dataset.of(q, np.array([[each.value]]), each.sigma, (label,), each.measurement, **stated)
        place = {"markers": (*first.markers, *second.markers), "robot": first.robot}
        block = replace(row.blocks[0], point=np.array([each.between], dtype=object), **place)
        parts.append(replace(row, blocks=(block,)))
    return Dataset.concatenated(parts, ["rows", *(" to ".join(each.between) for each in known)]).grouped_by_points()


def touches(q: Array, point: Sequence[str], sigma: float | Array, planes: bool = False) -> Dataset:
    """Return touches of unmeasured points or planes at joint values q (N, dof) of the controller [rad or m].

    ``point`` are N names: equal names are touches of one point, or of one plane if ``planes``. ``sigma`` is the
    standard deviation of a touch [m], or covariances (3, 3) or (N, 3, 3) [m^2].

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> data = ro.data.touches(np.linspace(0, 1, 24).reshape(4, 6), ["A", "B", "A", "B"], sigma=1e-4)
    >>> data.configuration.tolist()
    [0, 1, 0, 1]
    """
    kind = revisit_plane if planes else revisit
    if not len(point):
        raise InputError("point", "no names", f"{len(q)}, one per touch")
    return Dataset.of(q, np.empty((len(q), 0)), sigma, measurement=kind, point=point).grouped_by_points()
