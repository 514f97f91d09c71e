"""Memory of a thread's own: the same again for the same purpose, another for another purpose or thread."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from rpim_opt.basics.room import LARGEST, room


def test_room_is_used_again_by_its_thread_alone() -> None:
    first = room("a test", 3, 4)
    assert first.shape == (3, 4)
    assert np.shares_memory(first, room("a test", 2, 5))
    assert not np.shares_memory(first, room("another", 3, 4))
    with ThreadPoolExecutor(1) as other:
        assert not np.shares_memory(first, other.submit(room, "a test", 3, 4).result())
    more = room("a test", 30, 4)
    assert more.shape == (30, 4)
    assert more.flags.c_contiguous


def test_much_room_is_not_kept() -> None:
    large = room("large", LARGEST, 2)
    assert not np.shares_memory(large, room("large", LARGEST, 2))
