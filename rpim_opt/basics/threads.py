"""Threads and timing: all cores for blocks of rows, one BLAS thread for small matrices, seconds by phase."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache, wraps
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

Function = TypeVar("Function", bound=Callable[..., Any])
Item = TypeVar("Item")
Answer = TypeVar("Answer")
PHASES = ("evaluation", "reduction", "canonicalization", "solve", "selection")
_running: ContextVar[Clock | None] = ContextVar("clock", default=None)
_worker = threading.local()


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def on_all_cores(function: Callable[[Item], Answer], items: Iterable[Item]) -> list[Answer]:
    """Return a function's results for items, in their order, computed on all cores.

    What the items are does not depend on the number of cores, and so neither does any digit of the answers. Inside a
    thread of its own it works one by one. Phases of a clock are the caller's.
    """
    waiting = list(items)
    workers = min(cores(), len(waiting))
    if workers < 2 or getattr(_worker, "busy", False):
        return [function(item) for item in waiting]

    def begin() -> None:
        _worker.busy = True

    with ThreadPoolExecutor(workers, initializer=begin) as pool:
        return list(pool.map(function, waiting))


_lock = threading.Lock()
_inside = 0
_limit: Any = None


@lru_cache(maxsize=1)
def _controller() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401 - its BLAS must be loaded to be found

    return ThreadpoolController()


def one_blas_thread(function: Function) -> Function:
    """Limit BLAS to one thread while the function runs.

    On two cores that other work shares, LAPACK's QR of a few thousand rows took ten times as long with two threads as
    with one. Calls may be nested and may come from several threads; the last one out restores.
    """

    @wraps(function)
    def limited(*arguments: Any, **options: Any) -> Any:
        global _inside, _limit
        with _lock:
            if not _inside:
                _limit = _controller().limit(limits=1, user_api="blas")
                _limit.__enter__()
            _inside += 1
        try:
            return function(*arguments, **options)
        finally:
            with _lock:
                _inside -= 1
                if not _inside:
                    _limit.__exit__(None, None, None)

    return limited  # type: ignore[return-value]


class Clock:
    """Seconds by phase; the time of a nested phase counts for that phase alone."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = dict.fromkeys(PHASES, 0.0)
        self.started = self._since = time.perf_counter()
        self.stack: list[str] = []

    def switch(self, phase: str | None) -> None:
        """Begin a phase, or end the current one."""
        now = time.perf_counter()
        if self.stack:
            self.seconds[self.stack[-1]] += now - self._since
        self._since = now
        if phase is None:
            self.stack.pop()
        else:
            self.stack.append(phase)

    def rows(self) -> list[tuple[str, float]]:
        """Return the seconds of every phase, and the rest of the time since the clock was made."""
        other = time.perf_counter() - self.started - sum(self.seconds.values())
        return [*self.seconds.items(), ("other", other)]


@contextmanager
def clock() -> Iterator[Clock]:
    """Time a block of code by phases: ``with clock() as c: calibrate(...)``, then ``c.rows()``."""
    running = Clock()
    token = _running.set(running)
    try:
        yield running
    finally:
        _running.reset(token)


@contextmanager
def phase(name: str) -> Iterator[None]:
    """Time a block of code as a phase, if a clock is running: ``with phase("solve"): ...``."""
    running = _running.get()
    if running is None:
        yield
        return
    running.switch(name)
    try:
        yield
    finally:
        running.switch(None)
