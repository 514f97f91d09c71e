"""A layer below everything that writes, which fails at the n-th call: every such call of a command can be tried."""

from __future__ import annotations

import builtins
import errno
import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

CALLS = ("mkdir", "rename", "replace", "link", "fsync", "fchmod", "chmod", "truncate", "ftruncate", "symlink")
STREAM = ("write", "flush", "close", "writelines", "truncate")
FAULTS: dict[str, BaseException] = {
    "no space": OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
    "not allowed": PermissionError(errno.EACCES, os.strerror(errno.EACCES)),
    "broken disk": OSError(errno.EIO, os.strerror(errno.EIO)),
    "interrupted call": InterruptedError(errno.EINTR, os.strerror(errno.EINTR)),
    "Ctrl-C": KeyboardInterrupt(),
}


class Layer:
    """Counts the calls that write, and raises at one of them."""

    def __init__(self, patch: pytest.MonkeyPatch):
        self.names: list[str] = []
        self.at: int | None = None
        self.fault: BaseException = FAULTS["no space"]
        self.counting = False
        for name in CALLS:
            patch.setattr(os, name, self._around(name, getattr(os, name)))
        patch.setattr(os, "open", self._os_open(os.open))
        opened = self._opening(io.open)
        patch.setattr(io, "open", opened)
        patch.setattr(builtins, "open", opened)

    @contextmanager
    def failing(self, at: int | None, fault: str) -> Iterator[None]:
        """Raise at the call of a number, from 0."""
        self.names = []
        self.at = at
        self.fault = FAULTS[fault]
        self.counting = True
        try:
            yield
        finally:
            self.counting = False

    def step(self, name: str) -> None:
        if not self.counting:
            return
        self.names.append(name)
        if len(self.names) - 1 == self.at:
            raise type(self.fault)(*self.fault.args)

    def _around(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            self.step(name)
            return real(*arguments, **options)

        return call

    def _os_open(self, real: Callable[..., int]) -> Callable[..., int]:
        def call(path: Any, flags: int, *arguments: Any, **options: Any) -> int:
            if flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
                self.step("os.open")
            return real(path, flags, *arguments, **options)

        return call

    def _opening(self, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(file: Any, mode: str = "r", *arguments: Any, **options: Any) -> Any:
            if not set(mode) & set("wax+") or not self.counting:
                return real(file, mode, *arguments, **options)
            self.step("open")
            return _Stream(real(file, mode, *arguments, **options), self)

        return call


class _Stream:
    """A file that is written, whose calls are counted, too."""

    def __init__(self, real: Any, layer: Layer):
        self._real = real
        self._layer = layer

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._real, name)
        if name not in STREAM:
            return found

        def call(*arguments: Any) -> Any:
            try:
                self._layer.step(name)
            except BaseException:
                if name == "close":  # a handle is let go of, whatever its last bytes met
                    self._real.close()
                raise
            return found(*arguments)

        return call

    def __enter__(self) -> _Stream:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


EVENTS = ("os.mkdir", "os.rename", "os.truncate", "os.link", "os.symlink", "os.chmod")


class Audit:
    """What the interpreter itself says of calls that write: none may go past the layer."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.listening = False
        sys.addaudithook(self._hear)  # for the rest of the process

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.listening:
            return
        if event == "open":
            path, _, flags = arguments
            if isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR) and ".pyc" not in str(path):
                self.names.append("open")
        elif event in EVENTS:
            self.names.append(event)
