"""Linear algebra on one thread, where many small matrices are multiplied; blocks of rows on all cores."""

from __future__ import annotations

import threading
import time

import pytest
import scipy.linalg  # noqa: F401 - its BLAS, and NumPy's, are counted
from threadpoolctl import threadpool_info, threadpool_limits

from rpim_opt.basics import threads
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


@pytest.mark.parametrize("count", [1, 2, 3])
def test_answers_come_in_order_whatever_the_number_of_cores(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setattr(threads, "cores", lambda: count)
    used = set()
    together = threading.Barrier(count)  # nobody goes on before all threads have an item

    def work(k: int) -> int:
        used.add(threading.get_ident())
        if k < count:
            together.wait(30)
        time.sleep(0.001 * (7 - k))
        return k

    assert threads.on_all_cores(work, iter(range(7))) == list(range(7))
    assert len(used) == count


def test_a_thread_of_many_starts_no_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "cores", lambda: 2)

    def inner(_: int) -> int:
        return threading.get_ident()

    found = threads.on_all_cores(lambda _: (threading.get_ident(), threads.on_all_cores(inner, range(3))), range(4))
    for own, below in found:
        assert below == [own] * 3


@pytest.mark.parametrize("wrong", [0, 1, 5])
def test_after_an_error_nothing_goes_on(monkeypatch: pytest.MonkeyPatch, wrong: int) -> None:
    """And of several errors the first one is told."""
    monkeypatch.setattr(threads, "cores", lambda: 2)
    met: list[int] = []

    def work(k: int) -> None:
        if k >= wrong:
            raise ZeroDivisionError(k)
        time.sleep(0.01)
        met.append(k)

    with pytest.raises(ZeroDivisionError, match=f"^{wrong}$"):
        threads.on_all_cores(work, range(50))
    assert sorted(met) == list(range(wrong))
    assert threads.on_all_cores(lambda k: k, range(4)) == [0, 1, 2, 3]
