"""Where the time of a calibration goes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

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
