"""LAPACK's QR without Python's lock: SciPy holds it meanwhile, and other threads would wait."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache
from importlib import import_module

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.room import room


def qr_in_place(columns: Array, together: int) -> None:
    """Overwrite a matrix by its QR: R on and above the diagonal, Householder's vectors below (`geqrt`).

    LAPACK's blocked one whose blocks are reduced by halves: twice as fast as the usual one where rows are many.

    Parameters
    ----------
    columns
        (m, n) whose columns stand together in memory.
    together
        How many of them, n at most, are reduced together.

    Examples
    --------
    >>> import numpy as np
    >>> from rpim_opt.basics.lapack import qr_in_place
    >>> columns = np.array([[3.0, 1.0], [4.0, 2.0]], order="F")
    >>> qr_in_place(columns, 2)
    >>> columns[0].round(6)
    array([-5. , -2.2])
    """
    m, n = columns.shape
    factors, work = room("qr factors", together * n), room("qr work", together * n)
    size = [ctypes.byref(ctypes.c_int(number)) for number in (m, n, together, max(m, 1), together)]
    array = [each.ctypes.data for each in (columns, factors, work)]
    wrong = ctypes.byref(ctypes.c_int())  # only an argument could be
    _geqrt()(*size[:3], array[0], size[3], array[1], size[4], array[2], wrong)


@lru_cache
def _geqrt() -> Callable[..., None]:
    """Return the function of the LAPACK that SciPy brings, which is called without Python's lock."""
    capsule = vars(import_module("scipy.linalg.cython_lapack"))["__pyx_capi__"]["dgeqrt"]
    named = ctypes.pythonapi.PyCapsule_GetName
    named.restype, named.argtypes = ctypes.c_char_p, [ctypes.py_object]
    address = ctypes.pythonapi.PyCapsule_GetPointer
    address.restype, address.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    prototype = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 9)
    return prototype(address(capsule, named(capsule)))
