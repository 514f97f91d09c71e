"""Digests of what a comparison was given, functions of a script among it: other code has another one."""

from __future__ import annotations

import sys
import sysconfig
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

OURS = "rpim_opt"
PLACES = [Path(sysconfig.get_path(key)) for key in ("stdlib", "platstdlib", "purelib")]
PLACES += [Path(file).parents[1] for file in (__file__, np.__file__)]
LIBRARIES = tuple({str(place.resolve()) for place in PLACES})
"""Where code lies whose version a journal knows."""
Seen = dict[int, tuple[int, Any]]
"""Things that were met, by their ids, with their numbers; they are kept, so that an id is theirs alone."""


def fingerprint(thing: Any) -> str:
    """Return the SHA-256 of a value, an object, or a function with what it refers to.

    Functions count by their code, defaults, closures and the globals they read, not by where they stand; those of
    installed packages by their names, as a journal knows the versions.

    >>> from rpim_opt.study.fingerprint import fingerprint
    >>> threshold = 1.5
    >>> def loss(r):
    ...     return threshold * r
    >>> before = fingerprint(loss)
    >>> threshold = 2.0
    >>> fingerprint(loss) == before
    False
    """
    digest = sha256()
    for part in _parts(thing, {}):
        digest.update(len(part).to_bytes(8, "big"))
        digest.update(part)
    return digest.hexdigest()


def _parts(thing: Any, seen: Seen) -> Iterator[bytes]:
    """Yield what a thing is made of; one that was met before is its number, so that circles end."""
    if thing is None or isinstance(thing, bool | int | float | complex | str | bytes | Path | type(...)):
        yield f"{type(thing).__name__} {thing!r}".encode()
        return
    if id(thing) in seen:
        yield f"again {seen[id(thing)][0]}".encode()
        return
    seen[id(thing)] = (len(seen), thing)
    yield type(thing).__qualname__.encode()
    if isinstance(thing, np.ndarray | np.generic):
        yield from _of_array(np.asarray(thing))
    elif isinstance(thing, set | frozenset):
        yield from sorted(fingerprint(each).encode() for each in thing)
    elif isinstance(thing, FunctionType | BuiltinFunctionType | type | ModuleType | CodeType):
        yield from _of_code(thing, seen)
    else:
        held = _held(thing)
        yield from _of_object(thing, seen) if held is None else _all(held, seen)


def _held(thing: Any) -> Sequence[Any] | None:
    """Return what is all there is to a container or a bound function; None for anything else."""
    match thing:
        case Mapping():
            return [each for pair in thing.items() for each in pair]
        case list() | tuple():
            return thing
        case partial():
            return [thing.func, thing.args, thing.keywords]
        case MethodType():
            return [thing.__func__, thing.__self__]
    return None


def _all(things: Any, seen: Seen) -> Iterator[bytes]:
    yield str(len(things)).encode()
    for each in things:
        yield from _parts(each, seen)


def _of_array(array: np.ndarray) -> Iterator[bytes]:
    yield f"{array.dtype} {array.shape}".encode()
    if array.dtype == object:
        yield from _all(array.ravel().tolist(), {})
    else:
        yield np.ascontiguousarray(array).tobytes()


def _of_code(thing: Any, seen: Seen) -> Iterator[bytes]:
    """Yield a function, a class, a module or byte code: by name where it is a library's."""
    if isinstance(thing, CodeType):
        yield thing.co_code
        yield from _all([thing.co_consts, thing.co_names, thing.co_varnames, thing.co_freevars], seen)
        return
    module = getattr(thing, "__module__", None) or getattr(thing, "__name__", "")
    if isinstance(thing, ModuleType):
        module = thing.__name__
    yield getattr(thing, "__qualname__", module).encode()
    if _is_known(thing, module):
        yield module.encode()
    elif isinstance(thing, ModuleType):
        yield sha256(Path(str(thing.__file__)).read_bytes()).digest()
    elif isinstance(thing, FunctionType):
        yield from _parts(thing.__code__, seen)
        yield from _all([thing.__defaults__, thing.__kwdefaults__, *_closure(thing), *_globals(thing)], seen)
    else:
        own = {name: value for name, value in vars(thing).items() if callable(value) or not name.startswith("__")}
        yield from _all([*thing.__bases__, *(each for pair in own.items() for each in pair)], seen)


def _closure(function: FunctionType) -> list[Any]:
    """Return what a function's cells hold; one that is empty yet holds nothing."""
    held = []
    for cell in function.__closure__ or ():
        try:
            held.append(cell.cell_contents)
        except ValueError:
            held.append(None)
    return held


def _globals(function: FunctionType) -> list[Any]:
    """Return the globals that a function's code names, and those of the functions inside it."""
    names: dict[str, None] = {}
    waiting = [function.__code__]
    while waiting:
        code = waiting.pop()
        names |= dict.fromkeys(code.co_names)
        waiting += [each for each in code.co_consts if isinstance(each, CodeType)]
    return [function.__globals__[name] for name in names if name in function.__globals__]


def _of_object(thing: Any, seen: Seen) -> Iterator[bytes]:
    """Yield an object's fields; of a library's object its value where it has one, since its insides count calls."""
    kind = type(thing)
    yield from _parts(kind, seen)
    if is_dataclass(thing):
        yield from _all([getattr(thing, each.name) for each in fields(thing)], seen)
    elif _of_library(kind.__module__) and not kind.__module__.startswith(OURS):
        yield from _parts(getattr(thing, "value", None), seen)
    else:
        yield from _parts(dict(getattr(thing, "__dict__", {})), seen)


def _is_known(thing: Any, module: str) -> bool:
    """Whether a journal knows a function, class or module by its name."""
    if isinstance(thing, BuiltinFunctionType):
        return True
    if isinstance(thing, FunctionType):  # what a script executes may say that it is of any module
        return thing.__code__.co_filename.startswith(LIBRARIES)
    if isinstance(thing, ModuleType) and _is_own(thing):  # one that a script loaded by its path
        return False
    return _of_library(module)


def _is_own(module: ModuleType) -> bool:
    """Whether a module's file is none of a library's."""
    file = getattr(module, "__file__", None)
    return file is not None and not str(Path(file).resolve()).startswith(LIBRARIES)


def _of_library(module: str) -> bool:
    """Whether a module is the package's own, the language's, or an installed one."""
    top = module.partition(".")[0]
    if top == OURS or (top in sys.stdlib_module_names and top != "__main__"):
        return True
    file = getattr(sys.modules.get(module), "__file__", None)
    if module == "__main__":
        return False
    return file is None or str(Path(file).resolve()).startswith(LIBRARIES)
