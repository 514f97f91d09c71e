"""Memory that a thread uses again and again: to ask the system for a few hundred kB anew costs as much as to fill it.

C's library learns to keep such memory, but where it is told to give it back, as in Dask's workers, it never does.
"""

from __future__ import annotations

import threading
from math import prod

import numpy as np

from rpim_opt.basics.arrays import Array

LARGEST = 2**20
"""Numbers that are kept; more are asked for anew, which costs little beside what is done with them."""
_own = threading.local()


def room(purpose: str, *shape: int) -> Array:
    """Return an array that stands until the same thread asks for one of the same purpose; its numbers are any.

    >>> from rpim_opt.basics.room import room
    >>> room("example", 2, 3).shape
    (2, 3)
    """
    size = prod(shape)
    if size > LARGEST:
        return np.empty(shape)
    kept = vars(_own).setdefault("kept", {})
    if purpose not in kept or kept[purpose].size < size:
        kept[purpose] = np.empty(size)
    return kept[purpose][:size].reshape(shape)
