"""Priors that last: one JSON file each, in which every number reads back to the same bits."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import read_json, validate, write_json
from rpim_opt.convex.prior import Prior
from rpim_opt.convex.statement import Statement
from rpim_opt.store.parts import finite
from rpim_opt.store.schema import Matrix, Part, Vector

FORMAT = "rpim-opt prior"


class StatementPart(Part):
    """A linear Gaussian statement."""

    names: list[str]
    dimensions: list[str]
    rows: Matrix
    values: Vector
    reference: Vector | None
    whole: bool
    text: str


class PriorFile(Part):
    """A prior; no tails are infinite ones."""

    format: Literal["rpim-opt prior"]
    version: Literal[1]
    centre: dict[str, float]
    scale: dict[str, float]
    tails: float | None
    groups: list[list[str]]
    joint_offset: float
    frames: float
    statements: list[StatementPart]
    doubted: bool = False


def save_prior(prior: Prior, path: str | Path) -> None:
    """Write a prior to one JSON file, which `load_prior` and a problem file's ``[prior]`` read.

    Parameters
    ----------
    prior
        Any.
    path
        The file.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> prior = ro.convex.Prior(tails=5.0) & ro.convex.Prior.known("a2 + a3 +- 0.05 mm")
    >>> ro.store.save_prior(prior, "prior.json")
    >>> ro.store.load_prior("prior.json") == prior
    True
    """
    content = {
        "format": FORMAT,
        "version": 1,
        "centre": dict(prior.centre),
        "scale": dict(prior.scale),
        "tails": finite(prior.tails),
        "groups": [list(group) for group in prior.groups],
        "joint_offset": prior.joint_offset,
        "doubted": prior.doubted,
        "frames": prior.frames,
        "statements": [vars(each) for each in prior.statements],
    }
    write_json(Path(path), content)


def load_prior(path: str | Path) -> Prior:
    """Return the prior that a file holds.

    Parameters
    ----------
    path
        A file of `save_prior`.

    Raises
    ------
    InputError
        Naming the file, the key, what was found and what is accepted.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> ro.store.save_prior(ro.convex.Prior(tails=np.inf, scale={"theta?_mrad": 8.0}), "prior.json")
    >>> ro.store.load_prior("prior.json").tails
    inf
    """
    path = Path(path)
    stored = read_json(path)
    if not is_prior(stored):
        raise InputError("the file", "no prior of rpim-opt", "a file of store.save_prior()", path)
    return prior_of(stored, path)


def is_prior(stored: Any) -> bool:
    """Whether a file's content says that it is a prior."""
    return isinstance(stored, dict) and stored.get("format") == FORMAT


def prior_of(stored: dict[str, Any], path: Path) -> Prior:
    """Return the prior of a file's content."""
    file = validate(PriorFile, stored, path)
    try:
        return Prior(
            centre=file.centre,
            scale=file.scale,
            tails=np.inf if file.tails is None else file.tails,
            groups=tuple(tuple(group) for group in file.groups),
            joint_offset=file.joint_offset,
            doubted=file.doubted,
            frames=file.frames,
            statements=tuple(_statement(part, i) for i, part in enumerate(file.statements, start=1)),
        )
    except InputError as error:
        raise error.within(path) from None


def _statement(part: StatementPart, number: int) -> Statement:
    p, k = len(part.names), len(part.values)
    shapes = {len(part.dimensions), *map(len, part.rows), len(part.reference or part.names)}
    if shapes != {p} or len(part.rows) != k:
        accepted = f"{k} rows of {p} numbers, one a parameter"
        raise InputError(f"key statements {number}", "parts that do not fit together", accepted)
    reference = None
    if part.reference is not None:
        reference = tuple(part.reference)
    return Statement(
        names=tuple(part.names),
        dimensions=tuple(part.dimensions),
        rows=tuple(tuple(row) for row in part.rows),
        values=tuple(part.values),
        reference=reference,
        whole=part.whole,
        text=part.text,
    )
