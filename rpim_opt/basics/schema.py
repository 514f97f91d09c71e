"""Validation of TOML tables against models: keys, types, and quantities with units in their names."""

from __future__ import annotations

import re
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import UNITS, quantities

Length = Annotated[float, "length"]
Angle = Annotated[float, "angle"]
Mass = Annotated[float, "mass"]
Name = Annotated[str, Field(max_length=200)]
"""A name or a pattern of names: long ones would take for ever to be matched."""
Model = TypeVar("Model", bound=BaseModel)
OF_UNION = re.compile(r"(str|float|dict|list)(\[.*])?")  # in pydantic's places the one of several types, and no key


class Misfit(InputError, ValueError):
    """An invalid key of a table: a ValueError, to which pydantic adds its location."""


class Table(BaseModel):
    """A TOML table: a field annotated ``Length``, ``Angle`` or ``Mass`` is given with its unit, ``a_mm = 1.0``."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _to_si(cls, table: Any) -> Any:
        """Return a table with its quantities in SI; every quantity may occur once, in any unit."""
        if not isinstance(table, dict):
            return table
        every = {unit.dimension for unit in UNITS.values()}
        of_fields = {name: tuple(m for m in field.metadata if m in every) for name, field in cls.model_fields.items()}
        dimensions = {name: known for name, known in of_fields.items() if known}
        plain = [field.alias or name for name, field in cls.model_fields.items() if name not in dimensions]
        others = {key: value for key, value in table.items() if key not in plain}
        try:
            values = quantities(others, dimensions, lists=True, also=plain)
        except InputError as error:
            key = error.where.removeprefix("key ") if error.where.startswith("key ") else ""
            raise Misfit(key, error.found, error.accepted) from None
        converted = {key: value for key, value in table.items() if key not in others}
        for (stem, _), value in values.items():
            if stem in converted:
                raise Misfit(stem, "the same quantity twice", "one of them")
            converted[stem] = value
        return converted


def validate(model: type[Model], content: dict[str, Any], file: object, table: str = "") -> Model:
    """Return ``content``, of a table of a file, as an instance of ``model``; InputError for the first invalid key."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        misfit = (first.get("ctx") or {}).get("error")
        where = table
        for part in first["loc"]:  # joint 3.a, as a person counts
            if isinstance(part, int):
                where += f" {part + 1}"
            elif not OF_UNION.fullmatch(part):
                where += f".{part}" if where else part
        if isinstance(misfit, Misfit):
            where = ".".join(filter(None, (where, misfit.where))) or "the top level"
            raise InputError(f"key {where}", misfit.found, misfit.accepted, file) from None
        if first["type"] == "missing":
            raise InputError(f"key {where}", "nothing", "this key is required", file) from None
        wanted = first["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
        if first["type"] in ("too_short", "too_long"):
            wanted = f"a list of {wanted.partition('should have ')[2].partition(' after')[0]}"
        raise InputError(f"key {where}", repr(first["input"])[:60], wanted, file) from None
