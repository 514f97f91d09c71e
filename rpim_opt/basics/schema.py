"""Validation of TOML tables against models: keys, types, and quantities with units in their names."""

from __future__ import annotations

import re
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import DIMENSIONS, quantities, split_unit

Length = Annotated[float, "length"]
Angle = Annotated[float, "angle"]
Mass = Annotated[float, "mass"]
Name = Annotated[str, Field(max_length=200)]
"""A name or a pattern of names: long ones would take for ever to be matched."""
Model = TypeVar("Model", bound=BaseModel)
TYPES = {
    "string_type": "a text in quotes", "list_type": "a list in brackets", "dict_type": "a table",
    "model_type": "a table", "bool_type": "true or false", "int_type": "an integer", "float_type": "a number",
}  # fmt: skip
OF_UNION = re.compile(r"(str|float|dict|list|literal|[A-Z]\w*Table)(\[.*])?")  # no keys, but types of a union


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
        fields = cls.model_fields.items()
        of_fields = {name: tuple(each for each in field.metadata if each in DIMENSIONS) for name, field in fields}
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
        place, found = _stated(first, content)
        where = ".".join(filter(None, (table, place)))
        misfit = (first.get("ctx") or {}).get("error")
        if isinstance(misfit, Misfit):
            where = ".".join(filter(None, (where, misfit.where)))
            where = f"key {where}" if where else "the top level"
            raise InputError(where, misfit.found, misfit.accepted, file) from None
        if first["type"] == "missing":
            raise InputError(f"key {where}", "nothing", "this key is required", file) from None
        wanted = []
        for each in error.errors():
            if _stated(each, content)[0] == place:  # of several types that the key may have
                text = each["msg"].removeprefix("Input should be ").replace("List should have", "a list of")
                wanted.append(TYPES.get(each["type"], text.partition(" after validation")[0]))
        raise InputError(f"key {where}", repr(found)[:60], " or ".join(dict.fromkeys(wanted)), file) from None


def _stated(error: ErrorDetails, content: Any) -> tuple[str, Any]:
    """Return a key as a person counts, ``joint 3.a_mm``, and its value, both as ``content`` states them if it does."""
    place = ""
    for part in error["loc"]:
        if isinstance(part, int):
            place += f" {part + 1}"
            content = content[part]
        elif not OF_UNION.fullmatch(part):
            names = content if isinstance(content, dict) else {}
            name = next((name for name in names if part in (name, split_unit(name)[0])), part)
            place += f".{name}" if place else name
            content = names.get(name)
    return place, error["input"] if content is None else content
