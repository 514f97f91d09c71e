"""What a problem file believes before the data: its ``[prior]``, and joint offsets under ``[scale]``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, Field

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import Table, read_json
from rpim_opt.basics.patterns import fits
from rpim_opt.basics.units import split_unit
from rpim_opt.convex.prior import Prior
from rpim_opt.convex.stated import FRAMES
from rpim_opt.convex.stated import JOINT_OFFSET as FACTOR
from rpim_opt.data.models import Measurement
from rpim_opt.robot.overlay import JOINT_OFFSET, is_joint_offset
from rpim_opt.robot.parameters import Parameters


class PriorTable(Table):
    """The keys of ``[prior]``; tails may be infinite."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=True)

    known: list[str] = Field(default_factory=list)
    earlier: str = Field(default="", alias="from")
    without: list[str] = Field(default_factory=list)
    inflate: float | int = 1.0
    fleet: list[str] = Field(default_factory=list)
    tails: float | int = 3.0
    groups: list[str] = Field(default_factory=list)
    joint_offset: float | int = FACTOR
    frames: float | int = FRAMES
    centre: dict[str, float | int] = Field(default_factory=dict)
    scale: dict[str, float | int] = Field(default_factory=dict)


def stated_prior(
    table: PriorTable,
    scale: Mapping[str, float],
    parameters: Parameters,
    path: Path,
    measurements: Sequence[Measurement],
) -> Prior:
    """Return the prior that a problem file states, which fits the problem's parameters.

    Parameters
    ----------
    table
        ``[prior]``.
    scale
        ``[scale]``: what it says of joint offsets alone, or of a parameter by its name, is taken at its word.
    parameters
        Of the problem.
    path
        The file.
    measurements
        Models of a script's own that results may name.

    Raises
    ------
    InputError
        Naming the file and the key.
    """
    prior = _own(table, _offsets(scale, parameters), path)
    for i, text in enumerate(table.known, start=1):
        prior &= _named(f"key prior.known {i}", path, lambda text=text: Prior.known(text))
    if table.earlier:
        prior &= _named("key prior.from", path, lambda: _earlier(table, path.parent / table.earlier, measurements))
    if table.fleet:
        prior &= _named("key prior.fleet", path, lambda: _fleet(table.fleet, path, measurements))
    prior.stated(parameters)
    return prior


def prior_files(table: PriorTable) -> list[str]:
    """Return the files that a prior is read from, as ``[prior]`` names them."""
    if table.earlier:
        return [*table.fleet, table.earlier]
    return list(table.fleet)


def _own(table: PriorTable, offsets: Mapping[str, float], path: Path) -> Prior:
    """Return what the table says in its own numbers."""
    for key in ("inflate", "without"):
        if table.model_dump()[key] != PriorTable().model_dump()[key] and not table.earlier:
            raise InputError(f"key prior.{key}", "no key from beside it", "from = 'other/result.json'", path)
    try:
        return Prior(
            centre=table.centre,
            scale={**offsets, **table.scale},
            tails=float(table.tails),
            groups=tuple(tuple(group.split()) for group in table.groups),
            joint_offset=float(table.joint_offset),
            frames=float(table.frames),
        )
    except InputError as error:
        raise InputError(error.where.replace("prior, key ", "key prior."), error.found, error.accepted, path) from None


def _offsets(scale: Mapping[str, float], parameters: Parameters) -> dict[str, float]:
    """Return what ``[scale]`` says of joint offsets and of nothing else, and of single parameters by their names.

    Somebody has thought of those: a certificate's standard uncertainty of a reflector's place, for instance.
    """
    return {key: value for key, value in scale.items() if _at_its_word(split_unit(key)[0], parameters)}


def _at_its_word(stem: str, parameters: Parameters) -> bool:
    if stem == JOINT_OFFSET or stem in parameters.names:
        return True
    met = [name for name in parameters.names if fits(name, stem)]
    return bool(met) and all(map(is_joint_offset, met))


def _named(key: str, path: Path, make: Any) -> Prior:
    """Return what ``make`` returns; an error of it names the key, where it does not name a file."""
    try:
        return make()
    except InputError as error:
        if error.file:
            raise
        raise InputError(key, error.found, error.accepted, path) from None


def _earlier(table: PriorTable, file: Path, measurements: Sequence[Measurement]) -> Prior:
    """Return the prior that a file holds, or the posterior of a result."""
    from rpim_opt.store.prior_file import is_prior, prior_of  # most folders name no earlier result
    from rpim_opt.store.result_file import load_result

    if file.is_dir():
        file = file / "result.json"
    stored = read_json(file)
    if is_prior(stored):
        return prior_of(stored, file)
    return Prior.from_result(load_result(file, measurements), table.inflate, table.without)


def _fleet(files: Sequence[str], path: Path, measurements: Sequence[Measurement]) -> Prior:
    from rpim_opt.store.result_file import load_result

    return Prior.from_fleet({name: load_result(path.parent / name, measurements) for name in files})
