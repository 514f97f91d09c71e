"""Threads: one for linear algebra, whose matrices are small; all cores for blocks of rows, whose number is large."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import lru_cache, wraps
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

from rpim_opt.basics.phases import beside

Function = TypeVar("Function", bound=Callable[..., Any])
_lock = threading.Lock()
_inside = 0
_limit: Any = None
_worker = threading.local()
Item = TypeVar("Item")
Answer = TypeVar("Answer")


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
    turns = iter(range(len(waiting)))  # each taken by one thread
    answers: dict[int, Answer] = {}
    errors: dict[int, Exception] = {}

    def work() -> None:
        for k in turns:
            try:
                answers[k] = function(waiting[k])
            except Exception as error:
                errors[k] = error
                _spend(turns)

    with beside(workers) as counted:
        share = counted(work)
        others: list[Future[None]] = []
        _worker.busy = True
        try:
            for _ in range(workers - 1):
                others.append(_threads(cores(), os.getpid()).submit(share))
            share()  # here, too: where all others are busy, and wait for what this thread holds, it ends all the same
        finally:
            _worker.busy = False
            _spend(turns)
            wait([other for other in others if not other.cancel()])
    if errors:  # turns are taken in order: the first error is always the same
        raise errors[min(errors)]
    return [answers[k] for k in range(len(waiting))]


def _spend(turns: Iterator[int]) -> None:
    """Leave nothing to do: after an error, or Ctrl-C, nobody goes on."""
    for _ in turns:
        pass


@lru_cache(maxsize=1)
def _threads(count: int, process: int) -> ThreadPoolExecutor:
    """Return threads that stay: to start them takes as long as a block. A process has its own, a fork none of them."""
    return ThreadPoolExecutor(count, initializer=_begin)


def _begin() -> None:
    """Mark a thread as one of those that work at once: it starts no others."""
    _worker.busy = True


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
