"""Measured data: joint values, measured values and their covariance, row by row."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, RowError, pick
from rpim_opt.basics.text import Brief, Tabled, counted
from rpim_opt.basics.units import LARGEST, display
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.measurements.pose import from_matrices, pose, position
from rpim_opt.robot.parameters import session_prefix

AT_REST = 1e-4  # [rad, m] joint values of an arm at rest scatter by less; no two poses are chosen so close


@dataclass(frozen=True, eq=False, repr=False)
class Block(Brief):
    """Rows of a dataset with one measurement model and the same reflectors and fixture.

    ``q`` (N, p, dof) are the controller's joint values [rad or m] at the p points of a row, ``y`` (N, c) the measured
    values [SI] in the order of the measurement's columns, ``covariance`` (N, k, k) that of the residual's components
    [SI], or (1, k, k) if all rows have the same, ``row`` (N,) the rows' numbers in the dataset. ``markers`` are the
    points' reflectors, ``fixture`` is the anchor, plane or sphere (``""`` for a single one), ``robot`` the robot's
    name.

    Optional, as in `Dataset.of`: ``torque`` and ``approach`` (N, p, dof), ``payload`` (N,) (default: that of the
    robot's `Gravity`), ``point`` (N, p) and ``session`` (N,), both names, and ``columns`` (N,) by name.
    """

    measurement: Measurement
    q: Array
    y: Array
    covariance: Array
    row: np.ndarray
    markers: tuple[str, ...] = ("",)
    fixture: str = ""
    torque: Array | None = None
    payload: Array | None = None
    approach: Array | None = None
    columns: Mapping[str, Array] = field(default_factory=dict)
    robot: str = ""
    point: np.ndarray | None = None
    session: np.ndarray | None = None

    def _short(self) -> str:
        return f"{counted(len(self.row), 'row')} of {self.measurement.name}"

    @property
    def touched(self) -> np.ndarray | None:
        """(N, p) names of the touched points; None for views of a camera."""
        return None if self.measurement.by_camera else self.point

    @property
    def session_names(self) -> np.ndarray:
        """(N,) names of the rows' sessions, ``""`` where none is stated."""
        return np.full(len(self.row), "", dtype=object) if self.session is None else self.session

    def take(self, index: np.ndarray, row: np.ndarray) -> Block:
        """Return the entries at ``index``, which become the rows ``row``."""
        fields = ["q", "y", "torque", "payload", "approach", "point", "session"]
        fields += ["covariance"] if len(self.covariance) > 1 else []
        whole = {name: getattr(self, name) for name in fields}
        rows = {name: values[index] for name, values in whole.items() if values is not None}
        columns = {name: values[index] for name, values in self.columns.items()}
        return replace(self, row=row, columns=columns, **rows)

    def by_place(self, markers: np.ndarray | None, fixtures: np.ndarray | None) -> tuple[Block, ...]:
        """Return the rows by names of reflectors, (N,) or (N, p), and fixtures (N,), in the order of first rows."""
        N, p = self.q.shape[:2]
        own = np.array([""] * N, dtype=object) if markers is None else markers
        of_points = np.broadcast_to(own.reshape(N, -1), (N, p))
        groups: dict[tuple[str, ...], list[int]] = {}
        for i, key in enumerate(zip(*of_points.T, [""] * N if fixtures is None else fixtures, strict=True)):
            groups.setdefault(key, []).append(i)
        parts = ((names, place, np.array(rows)) for (*names, place), rows in groups.items())
        return tuple(replace(self.take(i, i), markers=tuple(names), fixture=place) for names, place, i in parts)


@dataclass(frozen=True, eq=False, repr=False)
class Dataset(Tabled):
    """Rows of measurements, of one kind or several.

    ``blocks`` are the rows, grouped by measurement model, reflectors and fixture; ``label`` are N unique labels;
    ``configuration`` (N,) are numbers of configurations, which cross-validation never divides.

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

    def _short(self) -> str:
        kinds = ", ".join(dict.fromkeys(block.measurement.name for block in self.blocks))
        configurations = counted(len(np.unique(self.configuration)), "configuration")
        return f"{counted(len(self), 'row')} of {kinds} in {configurations}"

    def _frame_rows(self) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = [{} for _ in self.label]
        for block in self.blocks:
            units = {column: display(dimension) for column, dimension in block.measurement.columns.items()}
            for row, y, session in zip(block.row, block.y, block.session_names, strict=True):
                cells = {"label": self.label[row], "configuration": int(self.configuration[row])}
                cells |= {"measurement": block.measurement.name, "marker": " ".join(block.markers)}
                cells |= {"session": str(session)} if session else {}
                values = zip(units.items(), y, strict=True)
                rows[row] = cells | {f"{column}_{unit}": float(value / si) for (column, (unit, si)), value in values}
        return rows

    def __len__(self) -> int:
        return len(self.label)

    @property
    def q(self) -> Array:
        """Joint values at every row's first point, (N, dof) [rad or m]; zero where its robot has fewer."""
        q = np.zeros((len(self), max(block.q.shape[2] for block in self.blocks)))
        for block in self.blocks:
            q[block.row, : block.q.shape[2]] = block.q[:, 0]
        return q

    @property
    def robot(self) -> tuple[str, ...]:
        """Name of every row's robot (N,); ``""`` for a single robot."""
        names = {row: block.robot for block in self.blocks for row in block.row}
        return tuple(names[row] for row in range(len(self)))

    @property
    def sessions(self) -> tuple[str, ...]:
        """The names of the sessions, sorted, without unnamed ones."""
        return tuple(sorted({str(name) for block in self.blocks for name in block.session_names} - {""}))

    @property
    def session(self) -> np.ndarray:
        """(N,) names of the rows' sessions, ``""`` where none is stated."""
        session = np.full(len(self), "", dtype=object)
        for block in self.blocks:
            session[block.row] = block.session_names
        return session

    @property
    def temperatures(self) -> Array:
        """The temperatures (N',) [K] of the rows that state one."""
        columns = [block.columns["temperature"] for block in self.blocks if "temperature" in block.columns]
        return np.concatenate([np.zeros(0), *columns])

    def by_session(self) -> list[np.ndarray]:
        """Return the configurations (k,) of every session, or group of sessions with common configurations."""
        part = _united(_numbered(self.session), np.arange(len(self)), self.configuration)
        return [np.unique(self.configuration[part == i]) for i in range(part.max() + 1)]

    def of_robot(self, robot: str) -> Dataset:
        """Return the rows of one of several robots, as that robot's own."""
        part = self.take([i for i, name in enumerate(self.robot) if name == robot])
        return replace(part, blocks=tuple(replace(block, robot="") for block in part.blocks))

    @classmethod
    def of_robots(cls, parts: Mapping[str, Dataset]) -> Dataset:
        """Return the measurements of several robots, by their names, as one, as a problem of `together` takes them."""
        for name, part in parts.items():
            if any(part.robot):
                raise InputError(f"data of '{name}'", "rows of several robots", "those of one")
        return cls.concatenated(list(parts.values()), list(parts), robots=list(parts))

    @classmethod
    def concatenated(cls, parts: Sequence[Dataset], names: Sequence[str], robots: Sequence[str] = ()) -> Dataset:
        """Return the rows of several datasets, with separate configurations; names are prefixed to duplicate labels."""
        rows = np.cumsum([0, *(len(part) for part in parts)])
        first = np.cumsum([0, *(int(part.configuration.max()) + 1 for part in parts)])
        blocks = tuple(
            replace(block, row=block.row + rows[i], robot=robots[i] if robots else block.robot)
            for i, part in enumerate(parts)
            for block in part.blocks
        )
        labels = [label for part in parts for label in part.label]
        if len(set(labels)) < len(labels):
            labels = [f"{name}:{label}" for name, part in zip(names, parts, strict=True) for label in part.label]
        configuration = [part.configuration + first[i] for i, part in enumerate(parts)]
        return cls(blocks, tuple(labels), np.concatenate(configuration))

    def take(self, index: Sequence[int] | np.ndarray) -> Dataset:
        """Return the rows at ``index`` (K,), in that order; a row may be taken more than once."""
        index = np.asarray(index, dtype=int)
        owner, place = np.empty((2, len(self)), dtype=int)
        for i, block in enumerate(self.blocks):
            owner[block.row] = i
            place[block.row] = np.arange(len(block.row))
        rows = [np.flatnonzero(owner[index] == i) for i in range(len(self.blocks))]
        parts = zip(self.blocks, rows, strict=True)
        blocks = tuple(block.take(place[index[row]], row) for block, row in parts if len(row))
        return Dataset(blocks, tuple(self.label[i] for i in index), self.configuration[index])

    def grouped_by_points(self) -> Dataset:
        """Return the measurements with one configuration number for all rows that share an unknown point.

        Such rows are touches of one point or plane, or of several with a known relation. Rows of one configuration stay
        together, so that a fold of a cross-validation has all of them or none.
        """
        touches = (zip(block.row, block.touched, strict=True) for block in self.blocks if block.touched is not None)
        pairs = [(row, name) for rows in touches for row, names in rows for name in names]
        rows = np.array([row for row, _ in pairs], dtype=int)
        united = _united(self.configuration, rows, _numbered(name for _, name in pairs))
        return replace(self, configuration=_numbered(united.tolist()))

    def without(self, labels: Collection[str]) -> Dataset:
        """Return the rows whose label is not among ``labels``."""
        return self.take([i for i, label in enumerate(self.label) if label not in labels])

    def configurations(self, count: int, seed: int) -> Dataset:
        """Return the rows of a random sample of configurations; the same seed gives the same rows."""
        known = np.unique(self.configuration)
        if not 0 < count <= len(known):
            raise InputError("count", f"{count}", f"1 to {len(known)} configurations")
        drawn = np.random.default_rng(seed).choice(known, count, replace=False)
        return self.take(np.flatnonzero(np.isin(self.configuration, drawn)))

    @classmethod
    def of(
        cls,
        q: Array,
        y: Array,
        sigma: float | Array,
        label: tuple[str, ...] = (),
        measurement: Measurement | str = position,
        *,
        torque: Array | None = None,
        payload: Array | None = None,
        approach: Array | None = None,
        columns: Mapping[str, ArrayLike] = MappingProxyType({}),
        session: Sequence[str] = (),
        point: Sequence[str] | np.ndarray = (),
        marker: Sequence[Any] | np.ndarray = (),
        fixture: Sequence[str] | np.ndarray = (),
    ) -> Dataset:
        """Return a dataset from arrays; rows in which the arm stood still are one configuration (`stops`).

        ``q`` (N, dof) are joint values of the controller [rad or m], (N, p, dof) if a row involves p points; ``y`` (N,
        c) are measured values [SI], of poses also transforms (N, 4, 4). ``sigma`` is the standard deviation [SI] of the
        residual: a number for all k components, (k,) per component, (N,) per row, or (N, k); or a covariance, (k, k) or
        (N, k, k). With N = k, (k,) is per component. The components are x, y, z of a position, and x, y, z [m], rx, ry,
        rz [rad] of a pose.

        ``label`` are N row labels, by default numbers from 1; ``measurement`` is the measurement type, or the name of a
        ready one, ``"cable"``. ``torque`` [Nm] and ``approach``, the directions of the last movement (-1, 0 or +1),
        have the shape of q; ``payload`` (N,) is the mass at the flange [kg]; ``columns`` maps names to further columns
        (N,) [SI] for user-defined terms and measurement types; ``session`` and ``point`` are N names of sessions, and
        of touched or seen points. ``marker``, (N,) or (N, p), and ``fixture``, (N,), name the reflector, and the
        anchor, plane or sphere, if there are several.

        InputError for an unknown name, shapes that do not fit together, numbers that are not finite, or a deviation
        that is not positive.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> data = ro.Dataset.of(np.zeros((2, 6)), [[0.3, 0.0, 0.6], [0.3, 0.1, 0.6]], sigma=3e-5)
        >>> len(data), data.label
        (2, ('1', '2'))
        """
        if isinstance(measurement, str):
            from rpim_opt.data.measurements.registry import MEASUREMENTS  # types of which import this module

            measurement = pick(MEASUREMENTS, measurement, "measurement")
        q = np.asarray(q, dtype=float)
        y = np.asarray(y, dtype=float)
        if q.ndim == 2:
            q = q[:, None]
        N = len(q)
        points, c = measurement.points, len(measurement.columns)
        if not N:
            raise InputError("q", "no rows", "one or more")
        for name, values in (("q", q), ("y", y)):
            for row in np.flatnonzero(~(np.abs(values) <= LARGEST).reshape(len(values), -1).all(axis=1)).tolist():
                accepted = f"finite numbers of at most {LARGEST:g} m or rad"
                raise InputError(f"{name}, row {row + 1}", f"{values[row].ravel().tolist()}", accepted)
        if y.shape[1:] == (4, 4) and measurement.columns == pose.columns:
            try:
                y = from_matrices(np.hstack([y[:, :3, 3], y[:, :3, :3].reshape(len(y), 9)]))
            except RowError as error:
                raise InputError(f"y, {error.where}", error.found, error.accepted) from None
        if q.ndim != 3 or q.shape[:2] != (len(y), points) or y.shape[1:] != (c,):
            of_q = "(N, dof)" if points == 1 else f"(N, {points}, dof)"
            joints = q[:, 0] if q.ndim == 3 and q.shape[1] == 1 else q
            accepted = f"{of_q} joint values and (N, {c}) measured values: {', '.join(measurement.columns)}"
            accepted += '; of poses, state measurement="pose"' if y.shape[1:] in ((4, 4), (7,)) else ""
            raise InputError("q and y", f"shapes {joints.shape} and {y.shape}", accepted)
        rows = np.arange(N)
        covariance = _covariances(sigma, N, len(measurement.components))
        beside = {"torque": (torque, q), "payload": (payload, rows), "approach": (approach, q)}
        stated = {name: _beside(values, name, like) for name, (values, like) in beside.items()}
        further = {name: _beside(values, f"column {name}", rows) for name, values in columns.items()}
        names = _names(point, "point", N)
        stated["point"] = None if names is None else names[:, None]
        stated["session"] = named_sessions(session, N)
        whole = Block(measurement, q, y, covariance, rows, ("",) * points, columns=further, **stated)
        if len(marker) or len(fixture):
            blocks = whole.by_place(_names(marker, "marker", N, points), _names(fixture, "fixture", N))
        else:
            blocks = (whole,)
        configuration = _numbered(stops(q).tolist())
        labels = _names(label, "label", N)
        return cls(blocks, tuple(str(i + 1) for i in range(N)) if labels is None else tuple(labels), configuration)

    @classmethod
    def together(cls, parts: Sequence[Dataset], names: Sequence[str]) -> Dataset:
        """Return several datasets of a robot as one (`concatenated`); equal joint values are one configuration."""
        whole = cls.concatenated(parts, names)
        return replace(whole, configuration=_united(whole.configuration, np.arange(len(whole)), stops(whole.q)))


def _numbered(keys: Iterable[Any]) -> np.ndarray:
    """Return numbers (N,) from 0 of N keys, the same of equal ones, in the order of their first."""
    number: dict[Any, int] = {}
    return np.array([number.setdefault(key, len(number)) for key in keys], dtype=int)


def stops(q: Array) -> np.ndarray:
    """Return group numbers (N,) of joint values (N, ...) [rad or m] that differ by at most `AT_REST`.

    In lexicographic order, each value without a group takes all others without one within that distance.
    """
    values, number = np.unique(q.reshape(len(q), -1), axis=0, return_inverse=True)
    tree = scipy.spatial.cKDTree(values)
    apart = tree.query(values, 2, p=np.inf, distance_upper_bound=AT_REST)[0][:, 1]
    first = np.arange(len(values))
    for i in np.flatnonzero(np.isfinite(apart)):
        if first[i] == i:
            near = np.array(tree.query_ball_point(values[i], AT_REST, p=np.inf))
            first[near[first[near] == near]] = i
    return np.unique(first[number.reshape(-1)], return_inverse=True)[1]


def _united(group: np.ndarray, rows: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Return group numbers (N,) of N rows, where groups are merged whose ``rows`` (K,) have equal ``keys`` (K,).

    They keep the order of the groups: another order of summation would change the last digits of results.
    """
    groups = int(group.max(initial=-1)) + 1
    count = groups + int(keys.max(initial=-1)) + 1
    shared = scipy.sparse.coo_array((np.ones(len(keys)), (group[rows], groups + keys)), shape=(count, count))
    return scipy.sparse.csgraph.connected_components(shared, directed=False)[1][group]


def _covariances(sigma: float | Array, N: int, k: int) -> Array:
    """Return covariances (1 or N, k, k) [SI] from them or from standard deviations, as `Dataset.of` takes both."""
    values = np.array(sigma, dtype=float)
    shape = values.shape
    if shape in ((k, k), (1, k, k), (N, k, k)):
        return values.reshape(-1, k, k)
    known = shape in ((), (k,), (N,), (N, k))
    if not known or not (values > 0).all():
        accepted = f"a standard deviation above zero, ({k},) of them for the components, ({N},) or ({N}, {k}) for the "
        accepted += f"rows, or covariances ({k}, {k}) or ({N}, {k}, {k})"
        raise InputError("sigma", f"{sigma}" if known else f"shape {shape}", accepted)
    return values.reshape(1 if shape in ((), (k,)) else N, 1, -1) ** 2 * np.eye(k)


def named_sessions(names: Sequence[Any] | np.ndarray, N: int) -> np.ndarray | None:
    """Return the names (N,) of the rows' sessions, or None; refuse names that differ in punctuation alone."""
    sessions = _names(names, "session", N)
    called: dict[str, str] = {}
    for name in dict.fromkeys(() if sessions is None else sessions):
        other = called.setdefault(session_prefix(name), name)
        if other != name:
            raise InputError("column session", f"'{other}' and '{name}'", "names that differ in letters or digits")
    return sessions


def _names(names: Sequence[Any] | np.ndarray, what: str, N: int, points: int = 1) -> np.ndarray | None:
    """Return names (N,), or (N, p) of p points, or None where there are none."""
    if len(names) not in (0, N):
        raise InputError(what, f"{len(names)} names", f"{N}, one per row")
    if not len(names):
        return None
    array = np.array(names, dtype=object)
    if array.shape not in ((N,), (N, points)):
        raise InputError(what, f"shape {array.shape}", f"{N} names, one per row" + (points > 1) * " or point")
    return array.astype(str).astype(object)


def _beside(values: ArrayLike | None, what: str, like: np.ndarray) -> Any:
    """Return what a row states besides, in the shape of the joint values or with one number per row."""
    if values is None:
        return None
    numbers = np.asarray(values, dtype=float)
    if numbers.size != like.size or numbers.shape[:1] != like.shape[:1] or not np.isfinite(numbers).all():
        raise InputError(what, f"shape {numbers.shape}", f"finite numbers of shape {like.shape}")
    return numbers.reshape(like.shape)


def whole_configurations(data: Dataset, most: int) -> list[np.ndarray]:
    """Return the rows in groups of whole configurations, of at most ``most`` rows unless one configuration has more."""
    order = np.argsort(data.configuration, kind="stable")
    ends = np.concatenate([[0], np.flatnonzero(np.diff(data.configuration[order])) + 1, [len(order)]])
    cuts = [0]
    while cuts[-1] < len(order):
        last_fitting = ends[np.searchsorted(ends, cuts[-1] + most, side="right") - 1]
        next_one = ends[np.searchsorted(ends, cuts[-1], side="right")]
        cuts.append(max(last_fitting, next_one))
    return np.split(order, cuts[1:-1])
