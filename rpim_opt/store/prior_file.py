"""``[prior]`` of a problem file: what is known of parameters, an earlier result, a fleet."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from pydantic import ConfigDict, Field

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import inside
from rpim_opt.basics.schema import Table
from rpim_opt.basics.units import fits, split_unit
from rpim_opt.bayes.prior import Prior
from rpim_opt.bayes.prior_terms import FRAMES
from rpim_opt.bayes.prior_terms import JOINT_OFFSET as FACTOR
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.robot.parameters import JOINT_OFFSET, Parameters, is_joint_offset


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

    def files(self, path: Path) -> dict[str, Path]:
        """Return the files that the prior is read from, inside the problem's folder, by their names in its file."""
        named = [(file, "key prior.fleet") for file in self.fleet]
        if self.earlier:
            named.append((self.earlier, "key prior.from"))
        found = {}
        for name, key in named:
            try:
                found[name] = inside(path.parent, name, key, path)
                if found[name].is_dir():
                    found[name] = inside(path.parent, str(Path(name) / "result.json"), key, path)
            except InputError as error:
                accepted = f"{error.accepted}; a copy there, `rpim-opt update`, or calibrate(prior=...) in a script"
                raise InputError(key, error.found, accepted, path) from None
        return found


def stated_prior(
    table: PriorTable,
    scale: Mapping[str, float],
    parameters: Parameters,
    path: Path,
    measurements: Sequence[Measurement],
) -> Prior:
    """Return the prior that a problem file states, which fits the problem's parameters.

    What ``scale`` says of joint offsets alone, or of a parameter by its name, is taken at its word: somebody has
    thought of it, as of a certificate's standard uncertainty of a reflector's place.
    """
    for key in ("inflate", "without"):
        if key in table.model_fields_set and not table.earlier:
            raise InputError(f"key prior.{key}", "no key from beside it", "from = 'other/result.json'", path)
    offsets = {}
    for key, value in scale.items():
        stem = split_unit(key)[0]
        matches = [name for name in parameters.names if fits(name, stem)]
        if stem == JOINT_OFFSET or stem in parameters.names or (matches and all(map(is_joint_offset, matches))):
            offsets[key] = value
    try:
        prior = Prior(
            centre=table.centre,
            scale={**offsets, **table.scale},
            tails=float(table.tails),
            groups=tuple(tuple(group.split()) for group in table.groups),
            joint_offset=float(table.joint_offset),
            frames=float(table.frames),
        )
    except InputError as error:
        raise InputError(error.where.replace("prior, key ", "key prior."), error.found, error.accepted, path) from None
    files = table.files(path)

    def earlier() -> Prior:
        from rpim_opt.store.result_file import load_result  # most folders name no earlier result

        return Prior.from_result(load_result(files[table.earlier], measurements), table.inflate, table.without)

    def population() -> Prior:
        from rpim_opt.store.result_file import load_result

        return Prior.from_population({name: load_result(files[name], measurements) for name in table.fleet})

    parts: list[tuple[str, Callable[[], Prior]]] = []
    parts += [(f"known {i}", partial(Prior.known, text)) for i, text in enumerate(table.known, start=1)]
    if table.earlier:
        parts.append(("from", earlier))
    if table.fleet:
        parts.append(("fleet", population))
    for key, part in parts:
        try:
            prior &= part()
        except InputError as error:
            if error.file:
                raise
            raise InputError(f"key prior.{key}", error.found, error.accepted, path) from None
    prior.stated(parameters)
    return prior
