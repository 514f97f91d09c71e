"""Threads and time: all cores for blocks of rows, one thread for small matrices, and seconds by phase."""

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
_worker = threading.local()


def cores() -> int:
    """Return how many threads may work at once: the processor's cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def on_all_cores(function: Callable[[Item], Answer], items: Iterable[Item]) -> list[Answer]:
    """Return the answers to items, in their order; as many are worked on at once as there are cores.

    What the items are does not depend on the number of cores, and so neither does any digit of the answers. Inside a
    thread of its own it works one by one.

    >>> from rpim_opt.basics.threads import on_all_cores
    >>> on_all_cores(lambda k: k**2, range(4))
    [0, 1, 4, 9]
    """
    waiting = list(items)
    workers = min(cores(), len(waiting))
    if workers < 2 or getattr(_worker, "busy", False):
        return [function(item) for item in waiting]
    with beside(workers) as counted, ThreadPoolExecutor(workers, initializer=_begin) as pool:
        return list(pool.map(counted(function), waiting))


def _begin() -> None:
    """Mark a thread as one of those that work at once: it starts no others."""
    _worker.busy = True


_lock = threading.Lock()
_inside = 0
_limit: Any = None


@lru_cache(maxsize=1)
def _controller() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401 - its BLAS must be loaded to be found

    return ThreadpoolController()


def one_blas_thread(function: Function) -> Function:
    """Let the function's matrix products and factorizations run on one thread each, and restore what was there.

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


# Phases


PHASES = ("evaluation", "reduction", "canonicalization", "solve", "selection")
_running: ContextVar[Clock | None] = ContextVar("clock", default=None)


class Clock:
    """Seconds by phase; a phase inside another one counts for itself alone."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = dict.fromkeys(PHASES, 0.0)
        self.started = self._since = time.perf_counter()
        self._stack: list[str] = []

    def switch(self, phase: str | None) -> None:
        """Begin a phase, or end the one that runs."""
        now = time.perf_counter()
        if self._stack:
            self.seconds[self._stack[-1]] += now - self._since
        self._since = now
        if phase is None:
            self._stack.pop()
        else:
            self._stack.append(phase)

    @property
    def busy(self) -> bool:
        """Whether a phase runs."""
        return bool(self._stack)

    def rows(self) -> list[tuple[str, float]]:
        """Return the seconds of every phase, and what is left of the time since the clock was made."""
        other = time.perf_counter() - self.started - sum(self.seconds.values())
        return [*self.seconds.items(), ("other", other)]


@contextmanager
def clock() -> Iterator[Clock]:
    """Measure what runs inside: ``with clock() as c: calibrate(...)``, then ``c.rows()``."""
    running = Clock()
    token = _running.set(running)
    try:
        yield running
    finally:
        _running.reset(token)


@contextmanager
def beside(workers: int) -> Iterator[Callable[[Callable[..., Any]], Callable[..., Any]]]:
    """Count the phases of threads that work at once: ``with beside(2) as counted: threads.map(counted(work), ...)``.

    A second in each of several threads is one second; what runs inside a phase of the caller's counts for that phase.
    """
    running = _running.get()
    clocks: list[Clock] = []

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        if running is None:
            return function
        inside = running.busy

        def timed(*arguments: Any) -> Any:
            with clock() as own:
                if not inside:
                    clocks.append(own)
                return function(*arguments)

        return timed

    yield counted
    if running is not None:
        for own in clocks:
            for name, seconds in own.seconds.items():
                running.seconds[name] += seconds / workers


class phase:  # noqa: N801 - used like a function
    """Count what runs inside as a phase, if a clock runs: ``with phase("solve"): ...``."""

    __slots__ = ("_clock", "_name")

    def __init__(self, name: str):
        self._name = name
        self._clock = _running.get()

    def __enter__(self) -> None:
        if self._clock is not None:
            self._clock.switch(self._name)

    def __exit__(self, *_: object) -> None:
        if self._clock is not None:
            self._clock.switch(None)
