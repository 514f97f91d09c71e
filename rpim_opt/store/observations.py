"""The tables of a problem folder, read together: identification and validation data without the excluded rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns, read_columns
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.data.measurements.camera import Board, on_board
from rpim_opt.data.measurements.contact import Known, KnownAngle, KnownDistance, with_known
from rpim_opt.data.tables.reading import read_data
from rpim_opt.data.tables.robodk import robodk_columns
from rpim_opt.store.problem_file import AngleTable, DistanceTable, Observation, ProblemTable, Stated

ROLES = ("identification", "validation")
Tools = Mapping[str, tuple[float, ...]]
UNSTATED = 1e-5
"""Standard deviation [m or rad] of what only validates, where none is stated: of a good machine tool."""
RIGHT = (0.0, 90.0)
"""Angles [deg] that two planes may be known to have."""


@dataclass(frozen=True, eq=False)
class Tables:
    """What the tables of a folder hold: both sets of data, the files of each role, and where the reflectors start."""

    identification: Dataset
    validation: Dataset | None
    files: Mapping[str, Sequence[str]]
    tools: Tools


class _Part(NamedTuple):
    """One table of the folder."""

    role: str
    file: str
    data: Dataset


def read_tables(stated: Stated) -> Tables:
    """Return the measurements that a problem file names."""
    # RoboDK's export states the tools [mm] itself; the file's own go before them
    tcps = {marker: [1e3 * v for v in frame[:3]] for marker, frame in stated.tools.items() if stated.table.tool}
    parts = list(_parts(stated, tcps))
    files = {role: [part.file for part in parts if part.role == role] for role in ROLES}
    sets = {}
    for role in ROLES:
        if files[role]:
            own = [part.data for part in parts if part.role == role]
            sets[role] = Dataset.together(own, [Path(file).stem for file in files[role]])
    labels = {label for data in sets.values() for label in data.label}
    for label in stated.table.exclude:
        if label not in labels:
            raise InputError("key exclude", f"label '{label}'", "a label of the data", stated.path)
    for role, data in sets.items():
        rest = data.without(stated.table.exclude)
        if not len(rest):
            file = stated.path.parent / files[role][0]
            raise InputError("the table", "no row that is not excluded", "at least one", file)
        sets[role] = _with_known(rest, stated.table, role, stated.path)
    return Tables(sets["identification"], sets.get("validation"), files, _tools(stated, tcps))


def _parts(stated: Stated, tcps: dict[str, list[float]]) -> Iterator[_Part]:
    """Read the tables in the file's order, in which RoboDK's reflectors get their names."""
    for each in stated.observations:
        for role in ROLES:
            file = getattr(each, role)
            if file:
                yield _Part(role, file, _read(stated, each, file, tcps))


def _read(stated: Stated, each: Observation, file: str, tcps: dict[str, list[float]]) -> Dataset:
    path = stated.path.parent / file
    robodk = each.layout == "robodk"
    try:
        source: Any = robodk_columns(path, stated.robot.joint_dimensions, tcps) if robodk else path
        if stated.board is not None and stated.kinds[each.measurement].by_camera:
            source = _seen(path, stated.board)
        return read_data(source, stated.robot, each.noise or stated.table.noise, stated.kinds[each.measurement])
    except InputError as error:
        at_fault = path if robodk and error.where.startswith("row") else stated.path
        raise error.within(at_fault) from None


def _seen(path: Path, board: Board) -> Columns:
    """Return the columns of a table of corners, with where their points are on the board."""
    try:
        return on_board(read_columns(path), board)
    except InputError as error:
        raise error.within(path) from None


def _tools(stated: Stated, tcps: Mapping[str, list[float]]) -> Tools:
    if all(each.layout != "robodk" for each in stated.observations):
        return stated.tools
    exported = {marker: (*(1e-3 * v for v in tcp), 0.0, 0.0, 0.0) for marker, tcp in tcps.items()}
    return {marker: stated.tools.get(marker, place) for marker, place in exported.items()}


# --- [[known_distance]] and [[known_angle]] between touched points and planes ------------------------------------


def _with_known(data: Dataset, table: ProblemTable, role: str, path: Path) -> Dataset:
    """Return the measurements of a role with what a file knows of the points and planes that they touch."""
    known: list[Known] = []
    for number, distance in enumerate(table.known_distance, start=1):
        where = f"key known_distance {number}"
        pair, sigma = _pair(distance, where, path), _sigma(distance, f"{where}.sigma_mm", path)
        if distance.validation == (role == "validation"):
            known.append(KnownDistance(pair, distance.distance, sigma))
    for number, angle in enumerate(table.known_angle, start=1):
        where = f"key known_angle {number}"
        if angle.deg not in RIGHT:
            raise InputError(f"{where}.deg", f"{angle.deg:g}", "0 (parallel) or 90 (square)", path)
        pair, sigma = _pair(angle, where, path), _sigma(angle, f"{where}.sigma_mrad", path)
        if angle.validation == (role == "validation"):
            known.append(KnownAngle(pair, angle.deg == 0, sigma))
    try:
        whole = with_known(data, known)
        _require_enough(whole)
    except InputError as error:
        raise error.within(path) from None
    return whole


def _pair(table: DistanceTable | AngleTable, where: str, path: Path) -> tuple[str, str]:
    if len(table.between) != 2:
        raise InputError(f"{where}.between", f"{len(table.between)} names", "two", path)
    first, second = table.between
    return first, second


def _sigma(table: DistanceTable | AngleTable, where: str, path: Path) -> float:
    if table.sigma is not None:
        return table.sigma
    if not table.validation:
        raise InputError(where, "nothing", "the standard deviation of what the drawing states", path)
    return UNSTATED


def _require_enough(data: Dataset) -> None:
    """Refuse what was touched so few times that its touches say nothing."""
    blocks = [block for block in data.blocks if block.touched is not None]
    joined = {name for block in blocks if not block.measurement.touching for names in block.touched for name in names}
    count: Counter[str] = Counter()
    last: dict[str, tuple[Block, str]] = {}
    for block in blocks:
        if block.measurement.touching:
            count.update(names[0] for names in block.touched)
            last |= {names[0]: (block, data.label[i]) for i, names in zip(block.row, block.touched, strict=True)}
    for name, touches in count.items():
        block, label = last[name]
        least, column = (4, "plane") if block.measurement.planar else (2, "point")
        if touches < least - (name in joined):
            accepted = f"{least} or more, one less where a [[known_distance]] or [[known_angle]] joins it to another"
            raise InputError(f"row {label}, column {column}", f"'{name}' touched {touches} times", accepted)
