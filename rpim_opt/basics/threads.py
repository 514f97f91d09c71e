"""Threads: all cores for blocks of rows, one BLAS thread for small matrices."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ContextDecorator
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

Item = TypeVar("Item")
Answer = TypeVar("Answer")
WORKER = "rpim_opt"  # what the names of threads begin with


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def on_all_cores(function: Callable[[Item], Answer], items: Iterable[Item]) -> list[Answer]:
    """Return a function's results for items, in their order, computed on all cores; serially in a worker thread."""
    waiting = list(items)
    workers = min(cores(), len(waiting))
    if workers < 2 or threading.current_thread().name.startswith(WORKER):
        return [function(item) for item in waiting]
    with ThreadPoolExecutor(workers, WORKER) as pool:
        return list(pool.map(function, waiting))


class _OneThread(ContextDecorator):
    lock = threading.Lock()
    inside = 0
    controller: ThreadpoolController | None = None
    limit: Any = None

    def __enter__(self) -> None:
        with self.lock:
            if not self.inside:
                import scipy.linalg  # noqa: F401 - its BLAS must be loaded to be found

                self.controller = self.controller or ThreadpoolController()
                self.limit = self.controller.limit(limits=1, user_api="blas")
            self.inside += 1

    def __exit__(self, *error: object) -> None:
        with self.lock:
            self.inside -= 1
            if not self.inside:
                self.limit.restore_original_limits()


one_blas_thread = _OneThread()
"""Decorator that limits BLAS to one thread while a function runs.

On two cores that other work shares, LAPACK's QR of a few thousand rows took ten times as long with two threads as with
one. Calls may be nested and may come from several threads; the last one out restores.
"""
