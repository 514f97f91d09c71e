"""Linear algebra on one thread, where many small matrices are multiplied; blocks of rows on all cores."""

from __future__ import annotations

import threading
import time

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from rpim_opt.basics import threads
from rpim_opt.basics.phases import clock, phase
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

    def work(k: int) -> int:
        used.add(threading.get_ident())
        time.sleep(0.001 * (7 - k))
        return k

    assert threads.on_all_cores(work, iter(range(7))) == list(range(7))
    assert len(used) == count
    assert (threading.get_ident() in used) == (count == 1)


def test_a_thread_of_many_starts_no_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "cores", lambda: 2)

    def inner(_: int) -> int:
        return threading.get_ident()

    found = threads.on_all_cores(lambda _: (threading.get_ident(), threads.on_all_cores(inner, range(3))), range(4))
    for own, below in found:
        assert below == [own] * 3


def test_an_error_in_a_thread_is_the_callers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "cores", lambda: 2)
    with pytest.raises(ZeroDivisionError):
        threads.on_all_cores(lambda k: 1 // k, range(3))


def test_phases_of_threads_count_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "cores", lambda: 2)

    def work(_: int) -> None:
        with phase("evaluation"):
            time.sleep(0.02)

    with clock() as running:
        threads.on_all_cores(work, range(4))
        with phase("reduction"):
            threads.on_all_cores(work, range(2))  # counts as the caller's
        seconds = dict(running.rows())
        whole = time.perf_counter() - running.started
    assert seconds["evaluation"] >= 0.04  # four of 0.02 s on two threads
    assert seconds["reduction"] >= 0.02
    assert sum(seconds.values()) <= whole
