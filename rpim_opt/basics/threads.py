"""Threads: all cores for blocks of rows, one BLAS thread for small matrices."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, wraps
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

Function = TypeVar("Function", bound=Callable[..., Any])
Item = TypeVar("Item")
Answer = TypeVar("Answer")
_worker = threading.local()


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def on_all_cores(function: Callable[[Item], Answer], items: Iterable[Item]) -> list[Answer]:
    """Return a function's results for items, in their order, computed on all cores.

    What the items are does not depend on the number of cores, and so neither does any digit of the answers. Inside a
    thread of its own it works one by one.
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
