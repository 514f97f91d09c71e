"""The tables of a problem folder, read together: identification and validation data without the excluded rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns, read_columns
from rpim_opt.data.board import Board, on_board
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.models import CAMERAS
from rpim_opt.data.tables.reading import read_data
from rpim_opt.data.tables.robodk import robodk_columns
from rpim_opt.store.known import with_stated
from rpim_opt.store.problem_file import Observation, Stated

ROLES = ("identification", "validation")
Tools = Mapping[str, tuple[float, ...]]


@dataclass(frozen=True, eq=False)
class Tables:
    """What the tables of a folder hold: both sets of data, the files of each role, and where the reflectors start."""

    identification: Dataset
    validation: Dataset | None
    files: Mapping[str, Sequence[str]]
    tools: Tools


def read_tables(stated: Stated) -> Tables:
    """Return the measurements that a problem file names."""
    # RoboDK's export states the tools [mm] itself; the file's own go before them
    tcps = {marker: [1e3 * v for v in frame[:3]] for marker, frame in stated.tools.items() if stated.table.tool}
    read = list(_parts(stated, tcps))
    files = {role: [part.file for part in read if part.role == role] for role in ROLES}
    sets = {role: _together([part for part in read if part.role == role]) for role in ROLES if files[role]}
    _require_labels(stated, sets)
    kept = {role: _kept(stated, data, files[role][0]) for role, data in sets.items()}
    kept = {role: with_stated(data, stated.table, role, stated.path) for role, data in kept.items()}
    return Tables(kept["identification"], kept.get("validation"), files, _tools(stated, tcps))


class _Part(NamedTuple):
    """One table of the folder."""

    role: str
    file: str
    data: Dataset


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
        if stated.board is not None and each.measurement in CAMERAS:
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


def _together(parts: Sequence[_Part]) -> Dataset:
    return Dataset.together([part.data for part in parts], [Path(part.file).stem for part in parts])


def _require_labels(stated: Stated, sets: Mapping[str, Dataset]) -> None:
    labels = {label for data in sets.values() for label in data.label}
    for label in stated.table.exclude:
        if label not in labels:
            raise InputError("key exclude", f"label '{label}'", "a label of the data", stated.path)


def _kept(stated: Stated, data: Dataset, file: str) -> Dataset:
    kept = data.without(stated.table.exclude)
    if not len(kept):
        raise InputError("the table", "no row that is not excluded", "at least one", stated.path.parent / file)
    return kept


def _tools(stated: Stated, tcps: Mapping[str, list[float]]) -> Tools:
    if all(each.layout != "robodk" for each in stated.observations):
        return stated.tools
    exported = {marker: (*(1e-3 * v for v in tcp), 0.0, 0.0, 0.0) for marker, tcp in tcps.items()}
    return {marker: stated.tools.get(marker, place) for marker, place in exported.items()}
