"""Content hash of the arguments of a comparison, with the functions of a script."""

from __future__ import annotations

import sys
import sysconfig
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import cached_property
from pathlib import Path
from types import (
    CodeType,
    FunctionType,
    GetSetDescriptorType,
    MappingProxyType,
    MemberDescriptorType,
    MethodType,
    ModuleType,
)
from typing import Any

import cvxpy as cp
import numpy as np
from joblib.hashing import NumpyHasher

from rpim_opt.basics.exceptions import InputError

_FOLDERS = [Path(sysconfig.get_path(key)) for key in ("stdlib", "platstdlib", "purelib")]
_FOLDERS += [Path(file).parents[1] for file in (__file__, np.__file__)]
LIBRARIES = ("<frozen", *{str(folder.resolve()) for folder in _FOLDERS}, *map(str, _FOLDERS))
"""Where code lies that its name and its version stand for."""
DEEPEST = 10_000
"""Frames that hashing may stack, some twelve for a function that another one calls."""
ACCEPTED = "arguments that joblib can hash by their content, or no journal"


def content_hash(thing: Any, where: str) -> str:
    """Return the SHA-256 of a value, an object, or a function with what it refers to.

    joblib hashes what can be pickled. Functions and classes of a script count by their code, defaults, closures and
    the globals that they read, not by their names or by where they stand; those of installed packages by their names.
    InputError names what has no content that can be hashed: a generator, an open file, a lock.
    """
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(max(limit, DEEPEST))
    try:
        return str(_Hasher(where).hash(thing))
    finally:
        sys.setrecursionlimit(limit)


class _Hasher(NumpyHasher):
    """joblib's hasher, which takes functions, classes and methods by their names alone."""

    def __init__(self, where: str) -> None:
        super().__init__("sha256")
        self.where = where

    def save(self, obj: Any) -> None:
        if isinstance(obj, MethodType):
            obj = ("method", obj.__func__, obj.__self__)
        elif isinstance(obj, MappingProxyType):
            obj = ("read-only", dict(obj))
        elif isinstance(obj, set | frozenset):
            obj = (type(obj), sorted(content_hash(each, self.where) for each in obj))
        elif type(obj) is np.ndarray and obj.ndim:
            obj = np.ascontiguousarray(obj)  # joblib tells layouts apart
        elif isinstance(obj, np.ndarray) and type(obj) is not np.ndarray:
            obj = (type(obj), obj.__reduce__())  # of masked arrays joblib sees no mask
        try:
            super().save(obj)
        except InputError:
            raise
        except Exception as error:  # of any library's own making
            kind = type(obj)
            found = f"a {kind.__module__}.{kind.__qualname__}, whose content cannot be hashed ({error})"
            raise InputError(self.where, found, ACCEPTED) from None

    def reducer_override(self, thing: Any) -> Any:
        """Return how a thing is pickled whose pickle would not hold its content."""
        content = _content(thing)
        if content is None:
            return NotImplemented
        return _Content, (), content  # as a state, which is saved when the thing is known already: circles end


class _Content:
    """Stands for a thing of which the content follows."""


def _content(thing: Any) -> tuple[Any, ...] | None:
    """Return the content of what joblib knows by its name, or by more than its content; None for anything else."""
    kind = type(thing)
    match thing:
        case CodeType():
            signature = (thing.co_flags, thing.co_argcount, thing.co_posonlyargcount, thing.co_kwonlyargcount)
            names = (thing.co_names, thing.co_varnames, thing.co_freevars, thing.co_cellvars)
            return signature, names, thing.co_code, thing.co_exceptiontable, thing.co_consts
        case FunctionType():
            code: Any = thing.__code__
            if code.co_filename.startswith(LIBRARIES):
                code = (thing.__module__, thing.__qualname__)
            given = (thing.__defaults__, thing.__kwdefaults__)
            return "function", code, given, _read_by(thing), dict(vars(thing))
        case type() if not _is_library(thing.__module__):
            python = GetSetDescriptorType | MemberDescriptorType
            own = {
                name: value
                for name, value in vars(thing).items()
                if (callable(value) or not name.startswith("__"))
                and name != "_abc_impl"
                and not isinstance(value, python)
            }
            return "class", thing.__qualname__, thing.__bases__, own
        case ModuleType():
            file = getattr(thing, "__file__", None)
            if file is None or str(Path(file).resolve()).startswith(LIBRARIES):
                return "module", thing.__name__
            return "module", Path(file).read_bytes()
        case property():
            return "property", thing.fget, thing.fset, thing.fdel
        case staticmethod() | classmethod():
            return kind.__name__, thing.__func__
        case cached_property():
            return "cached property", thing.func
        case cp.Variable():
            return kind, thing.shape, thing.attributes
        case cp.Constant() | cp.Parameter():
            return kind, thing.shape, thing.attributes, thing.value
        case cp.Expression(args=args):  # whose pickle holds running numbers
            return kind, args, thing.get_data()
    if kind.__module__.startswith("rpim_opt.") and is_dataclass(thing) and not isinstance(thing, type):
        return kind, {each.name: getattr(thing, each.name) for each in fields(thing)}
    wrapped = getattr(thing, "__dict__", {}).get("__wrapped__")  # functools.lru_cache
    return None if wrapped is None else (kind, wrapped)


def _read_by(function: FunctionType) -> dict[str, Any]:
    """Return what a function's closure holds, and the globals that a script's one reads, of its modules too."""
    found: dict[str, Any] = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # it holds nothing yet
            found[f"cell {name}"] = cell.cell_contents
    if function.__code__.co_filename.startswith(LIBRARIES):
        return found
    names: set[str] = set()
    codes = [function.__code__]
    for code in codes:
        names.update(code.co_names)
        codes += [each for each in code.co_consts if isinstance(each, CodeType)]
    found |= {name: function.__globals__[name] for name in names if name in function.__globals__}
    modules = [each for each in found.values() if isinstance(each, ModuleType) and not _is_library(each.__name__)]
    for module in modules:
        found |= {f"{module.__name__}.{name}": getattr(module, name) for name in names if hasattr(module, name)}
    return found


def _is_library(module: str) -> bool:
    """Whether a module is the language's, an installed one, or this package's."""
    found = sys.modules.get(module)
    if found is None or module == "__main__":
        return False
    file = getattr(found, "__file__", None)
    return file is None or str(Path(file).resolve()).startswith(LIBRARIES)
