"""Files at the border: TOML in, checked against a model; JSON out, whole or not at all."""

from __future__ import annotations

import json
import re
import tomllib
from collections import Counter
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import to_jsonable_python

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.inputs import LARGEST_DATA, read_bytes, read_text
from rpim_opt.basics.units import UNITS, number, quantities
from rpim_opt.basics.writing import write_text

Length = Annotated[float, "length"]
Angle = Annotated[float, "angle"]
Mass = Annotated[float, "mass"]
_DEEP = re.compile(r"(?<![\w\"'.-])(?:[\w\"'-]++\s*+\.\s*+){100}")
"""Dotted keys, which are read in a time that grows with the square of their length."""
_HALF_PAIR = re.compile(r"\\u[dD][89a-fA-F]")
"""Escapes that JSON reads one by one, whether or not two of them make a character."""
Name = Annotated[str, Field(max_length=200)]
"""A name or a pattern of names: long ones would take for ever to be matched."""


class Misfit(ValueError):
    """A key that a table cannot have: pydantic adds where it stands."""

    def __init__(self, key: str, found: str, accepted: str):
        super().__init__(found)
        self.key = key
        self.found = found
        self.accepted = accepted


class Table(BaseModel):
    """A TOML table in which quantities carry their unit: ``a_mm = 1.0`` sets ``a`` to 0.001.

    A field annotated ``Length``, ``Angle`` or ``Mass`` (or listing several) is given under its name plus a unit.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @classmethod
    @cache
    def _dimensions(cls) -> dict[str, tuple[str, ...]]:
        known = {unit.dimension for unit in UNITS.values()}
        return {
            name: tuple(m for m in field.metadata if m in known)
            for name, field in cls.model_fields.items()
            if any(m in known for m in field.metadata)
        }

    @model_validator(mode="before")
    @classmethod
    def _to_si(cls, table: Any) -> Any:
        if not isinstance(table, dict):
            return table
        dimensions = cls._dimensions()
        plain = [field.alias or name for name, field in cls.model_fields.items() if name not in dimensions]
        others = {key: value for key, value in table.items() if key not in plain}
        si = _quantities(others, dimensions, plain)
        kept = {key: value for key, value in table.items() if key not in others}
        return kept | si


def _quantities(table: dict[str, Any], dimensions: dict[str, tuple[str, ...]], plain: list[str]) -> dict[str, Any]:
    """Return the quantities of a table [SI]; a stem may stand there once, whatever its unit."""
    try:
        values = quantities(table, dimensions, convert=_scaled, also=plain)
    except InputError as error:
        key = ""
        if error.where.startswith("key "):
            key = error.where.removeprefix("key ")
        raise Misfit(key, error.found, error.accepted) from None
    si: dict[str, Any] = {}
    for (stem, _), value in values.items():
        if stem in si:
            raise Misfit(stem, "the same quantity twice", "one of them")
        si[stem] = value
    return si


def _scaled(value: Any, where: str, si: float) -> Any:
    if isinstance(value, list):
        return [_scaled(v, where, si) for v in value]
    return number(value, where) * si


Model = TypeVar("Model", bound=BaseModel)


def read_toml(path: Path) -> dict[str, Any]:
    """Return a TOML file's content.

    Raises
    ------
    InputError
        If there is no such file, or it is no TOML (with line and column).
    """
    text = read_text(path, endings=[".toml"])
    if _DEEP.search(text):
        raise InputError("the TOML text", "a key of more than a hundred parts", "keys that a person would write", path)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # integers of thousands of digits; tables that deep
        raise InputError("the TOML text", str(error), "TOML 1.0", path) from None


def validate(model: type[Model], content: dict[str, Any], file: object) -> Model:
    """Return ``content`` as ``model``, or raise an InputError for the first thing that does not fit."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        misfit = (first.get("ctx") or {}).get("error")
        where = _where(first["loc"])
        if isinstance(misfit, Misfit):
            where = ".".join(part for part in (where, misfit.key) if part) or "the top level"
            raise InputError(f"key {where}", misfit.found, misfit.accepted, file) from None
        if first["type"] == "missing":
            raise InputError(f"key {where}", "nothing", "this key is required", file) from None
        wanted = first["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
        raise InputError(f"key {where}", repr(first["input"])[:60], wanted, file) from None


def _where(loc: tuple[int | str, ...]) -> str:
    """Format pydantic's location the way a person counts: ``joint 3.a``."""
    text = ""
    for part in loc:
        if isinstance(part, str) and part.startswith("list["):  # which of several types, and no key
            continue
        text += f" {part + 1}" if isinstance(part, int) else f".{part}" if text else part
    return text


def write_json(path: Path, content: Any) -> None:
    """Write JSON so that ``path`` holds either the whole new content or what it held before."""
    write_text(path, _json(content))


def json_text(content: Any) -> str:
    """Return any content as JSON: arrays as lists, paths as texts, what is not finite as null."""
    return _json(to_jsonable_python(content, inf_nan_mode="null", fallback=lambda value: value.tolist()))


def _json(content: Any) -> str:
    """Return JSON; a row of numbers stands on one line.

    A text cannot be taken for such a row, since JSON escapes its line breaks.
    """
    text = json.dumps(content, indent=2, allow_nan=False)
    return re.sub(r"\[\n([^][{}\"]*)\n *]", lambda row: f"[{' '.join(row[1].split())}]", text) + "\n"


def read_json(path: Path) -> Any:
    """Return a JSON file's content.

    Raises
    ------
    InputError
        If there is no such file, or it is no JSON (with line and column).
    """
    text = read_text(path, LARGEST_DATA, [".json"])
    try:
        return parse_json(text)
    except ValueError as error:
        raise InputError("the JSON text", str(error), "a whole JSON file", path) from None


def parse_json(text: str) -> Any:
    """Return what JSON says, texts that can be written again.

    Raises
    ------
    ValueError
        For what is no JSON, is nested too deeply, states a key twice, or has half a surrogate pair, which no file of
        UTF-8 can hold.
    """
    try:
        content = json.loads(text, object_pairs_hook=_unique)
        if _HALF_PAIR.search(text):
            json.dumps(content, ensure_ascii=False).encode()
    except RecursionError as error:
        raise ValueError(str(error)) from None
    return content


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object's keys and values; of a key that stands there twice, nobody knows which value is meant."""
    found = dict(pairs)
    if len(found) < len(pairs):
        ((twice, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"the key '{twice}' twice in one object")
    return found


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal digits."""
    return sha256(read_bytes(path, LARGEST_DATA)).hexdigest()
