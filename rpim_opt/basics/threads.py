"""One thread for linear algebra: the matrices of a calibration are small, and threads that wait for each other cost."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

Function = TypeVar("Function", bound=Callable[..., Any])
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
