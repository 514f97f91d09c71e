"""Conversion of dataclasses, named tuples, arrays and mappings to JSON and back, by annotations."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from functools import cache
from hashlib import sha256
from typing import TYPE_CHECKING, Any, TypeVar, get_origin

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.data.record import Record
from rpim_opt.robot.mdh import Robot

if TYPE_CHECKING:
    from cattrs import Converter

T = TypeVar("T")
NOT_FINITE = ("inf", "-inf", "nan")
"""How a file spells the numbers that JSON does not have."""
LARGEST = sys.float_info.max
KINDS = {bool: "boolean", int: "integer", str: "string"}


def plain(value: Any) -> Any:
    """Return a value as JSON data; numbers have the fewest digits that read back exactly."""
    return _converter().unstructure(value)


def structured(content: Any, kind: type[T]) -> T:
    """Return the instance of a class from the output of `plain`, without functions, which a file cannot hold."""
    from cattrs import BaseValidationError

    try:
        return _converter().structure(content, kind)
    except BaseValidationError as error:
        raise _refusal(error) from None


def digest(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a file's content without its digest, independent of layout and order."""
    rest = {key: value for key, value in content.items() if key != "digest"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return sha256(text.encode()).hexdigest()


@cache
def _converter() -> Converter:
    from cattrs import Converter
    from cattrs.cols import is_namedtuple, namedtuple_dict_structure_factory, namedtuple_dict_unstructure_factory
    from cattrs.gen import make_dict_structure_fn, make_dict_unstructure_fn, override

    made = Converter()
    for kind in (bool, int, float, str):
        made.register_structure_hook(kind, _scalar)
    for kind in (bool, int, str):
        made.register_unstructure_hook(kind, kind)
    made.register_unstructure_hook(float, _spelled)
    made.register_structure_hook_factory(is_namedtuple, namedtuple_dict_structure_factory)
    made.register_unstructure_hook_factory(is_namedtuple, namedtuple_dict_unstructure_factory)
    made.register_structure_hook_func(_is_array, _array)
    made.register_unstructure_hook_func(_is_array, _listed)
    elsewhere = override(omit=True)
    by_name = override(unstruct_hook=lambda kind: kind.name, struct_hook=lambda name, _: _scalar(name, str))
    fields: dict[type, dict[str, Any]] = {
        Record: {"validation": elsewhere, "digest": elsewhere},  # among the data; of the file itself
        Robot: {"model": elsewhere},  # functions of a script, who gives them again
        Block: {"measurement": by_name},
        Dataset: {"configuration": override(unstruct_hook=_listed, struct_hook=lambda v, _: _array(v, np.ndarray))},
    }
    for kind, changes in fields.items():
        made.register_unstructure_hook(kind, make_dict_unstructure_fn(kind, made, **changes))
        made.register_structure_hook(kind, make_dict_structure_fn(kind, made, **changes))
    return made


# --- texts, numbers, arrays --------------------------------------------------------------------------------------


def _scalar(value: Any, kind: type) -> Any:
    if kind is float:
        return _number(value)
    if type(value) is not kind:
        raise _unfit(value, f"a valid {KINDS[kind]}")
    return value


def _number(value: Any) -> float:
    if isinstance(value, str) and value in NOT_FINITE:
        return float(value)
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) <= LARGEST:
        raise _unfit(value, "a valid number")
    return float(value)


def _spelled(value: float) -> float | str:
    return float(value) if math.isfinite(value) else str(float(value))


def _is_array(kind: Any) -> bool:
    return kind is np.ndarray or get_origin(kind) is np.ndarray


def _listed(array: np.ndarray) -> Any:
    if array.dtype.kind != "f" or np.isfinite(array).all():
        return array.tolist()
    return [_listed(each) if array.ndim > 1 else _spelled(each) for each in array]


def _array(values: Any, kind: Any) -> np.ndarray:
    """Return lists as an array: of floats where the class says so, otherwise of integers, truth values or texts."""
    if not isinstance(values, list):
        raise _unfit(values, "a list")
    try:
        array = np.array(values)
    except (ValueError, OverflowError):
        raise InputError("", "rows of different lengths", "rows of the same length") from None
    if kind is not np.ndarray:
        if array.dtype.kind in "if" and np.isfinite(array).all():
            return array.astype(float)
        spelled = np.array(values, dtype=object)
        return np.array([_number(value) for value in spelled.ravel().tolist()], dtype=float).reshape(spelled.shape)
    if not array.size:
        return array.astype(int)
    if array.dtype.kind not in "biU":
        raise _unfit(values, "integers, booleans or strings")
    return array.astype(object) if array.dtype.kind == "U" else array


# --- errors ------------------------------------------------------------------------------------------------------


def _unfit(value: Any, accepted: str) -> InputError:
    return InputError("", repr(value)[:60], accepted)


def _refusal(error: BaseException, place: str = "") -> InputError:
    """Return the first error of a content, with the place as a person counts: ``data.blocks 1.q``."""
    for note in getattr(error, "__notes__", ()):
        if hasattr(note, "index") and isinstance(note.index, int):
            place += f" {note.index + 1}"
        elif hasattr(note, "index") or hasattr(note, "name"):
            place = f"{place}.{getattr(note, 'name', '') or note.index}".removeprefix(".")
    if isinstance(error, BaseExceptionGroup):
        return _refusal(error.exceptions[0], place)
    where = f"key {place}"
    if isinstance(error, InputError):
        return InputError(f"{where}, {error.where}" if error.where else where, error.found, error.accepted)
    if isinstance(error, KeyError):
        return InputError(where, "nothing", "this key is required")
    return InputError(where, f"a value of another type ({error})", "the saved type")
