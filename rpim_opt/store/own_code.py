"""User-defined measurement types and terms in Python files of a problem folder, executed only if allowed."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from types import ModuleType
from typing import TypeGuard, TypeVar

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import inside

T = TypeVar("T")
_ALLOWED: ContextVar[bool] = ContextVar("allow_code", default=False)


@contextmanager
def allow_code() -> Iterator[None]:
    """Allow problem folders and results read in this context to execute the Python files that they name.

    >>> import rpim_opt as ro
    >>> with ro.store.allow_code():
    ...     problem = ro.load("position").problem  # its file could name a measurement type "mine:height"
    """
    token = _ALLOWED.set(True)
    try:
        yield
    finally:
        _ALLOWED.reset(token)


def is_own(name: object) -> TypeGuard[str]:
    """Return whether a name is of an object in a Python file, ``mine:height`` for ``height`` in ``mine.py``."""
    return isinstance(name, str) and ":" in name


def run_file(source: Path, name: str) -> ModuleType:
    """Return the module of a Python file, which is run."""
    spec = importlib.util.spec_from_file_location(name, source)
    if spec is None or spec.loader is None:
        raise InputError("the file", source.name, "a Python file", source)
    content = importlib.util.module_from_spec(spec)
    sys.modules[name] = content  # where classes of the file look up their annotations
    spec.loader.exec_module(content)
    return content


def own_object(name: str, kind: type[T], where: str, file: Path) -> T:
    """Return an object of a Python file beside ``file``, which names it at ``where``, if code is allowed."""
    module, _, attribute = name.partition(":")
    source = inside(file.parent, f"{module}.py", where, file)
    if not _ALLOWED.get():
        accepted = "a name that comes with the package; or --allow-code, which runs that file with your permissions"
        raise InputError(where, f"'{name}', code of {source.name}", accepted, file)
    if not source.is_file():
        raise InputError(where, f"'{name}', but no file {source.name}", "a file beside this one: copy it there", file)
    try:
        content = run_file(source, f"rpim_opt_own.{module}")
    except (Exception, SystemExit) as error:  # foreign code may raise anything
        raise InputError(where, f"{type(error).__name__}: {error}", "code that runs without errors", source) from error
    named = getattr(content, attribute, None)
    if not isinstance(named, kind):
        raise InputError(where, f"{attribute} = {named!r}"[:80], f"a {kind.__name__} of that name", source)
    return named
