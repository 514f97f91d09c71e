"""Linear algebra on one thread, where many small matrices are multiplied."""

from __future__ import annotations

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from rpim_opt.basics.threads import one_blas_thread


def test_linear_algebra_runs_on_one_thread_and_gets_its_threads_back() -> None:
    def counts() -> set[int]:
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    inner = one_blas_thread(counts)
    outer = one_blas_thread(lambda: (inner(), counts()))
    with threadpool_limits(2, user_api="blas"):
        before = counts()
        assert outer() == ({1}, {1})
        assert counts() == before
        with pytest.raises(ZeroDivisionError):
            one_blas_thread(lambda: 1 / 0)()
        assert counts() == before
