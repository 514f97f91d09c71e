"""Evaluation of CasADi functions at many rows.

CasADi's virtual machine spends most of its time between operations. `_vectorize` rebuilds a function of scalars so that
every operation is done on `WIDTH` rows at once, in a fifteenth of the time; what depends on shared inputs alone is
computed once. Operations and their order stay, and with them every bit of the values.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.threads import on_all_cores

SYMBOLS = threading.RLock()
"""CasADi counts its symbols without a lock; reentrant, since a user's function may itself evaluate a problem."""
WIDTH = 256
"""Rows of one call: in the virtual machine their numbers stay in the processor's second cache."""
NARROW = 64
"""Rows of one call for small tables."""
SHARE = 16 * WIDTH
"""Rows that one thread evaluates before it takes more: enough to be worth handing over."""
PAYS = 2_000
"""Rows, at once or in all, from which a vectorized function pays: to build it takes as long as to evaluate them."""


def call_rows(function: ca.Function, shared: Sequence[Array], rows: Array) -> list[Array]:
    """Evaluate a CasADi function on every row of a table, many in one call, without copies."""
    results = [np.zeros((len(rows), *reversed(function.size_out(i)))) for i in range(function.n_out())]
    arguments = [np.ascontiguousarray(values, dtype=float) for values in (*shared, rows)]

    def evaluate(begin: int) -> None:
        buffers: dict[int, Any] = {}
        end = min(begin + SHARE, len(rows))
        for start in range(begin, end, WIDTH):
            part = slice(start, min(start + WIDTH, end))
            N = len(rows[part])
            if N not in buffers:
                buffers[N] = _mapped(function, len(shared), N).buffer()
                for i, values in enumerate(arguments[:-1]):
                    buffers[N][0].set_arg(i, values.data)
            buffer, trigger = buffers[N]
            buffer.set_arg(len(shared), arguments[-1][part].data)
            for i, values in enumerate(results):
                buffer.set_res(i, values[part].data)
            trigger()

    on_all_cores(evaluate, range(0, len(rows), SHARE))
    return results


@lru_cache(maxsize=512)
def _mapped(function: ca.Function, shared: int, N: int) -> ca.Function:
    """Return the function of N rows."""
    return ca.Function.map(function, "rows", "serial", N, list(range(shared)), [], {})


def evaluate_rows(function: ca.Function, shared: Sequence[Array], rows: Array) -> list[Array]:
    """Return what `call_rows` returns, the same bits, in the quickest way that pays for so many rows."""
    evaluated = _evaluated(function)
    evaluated[0] += len(rows)
    vectorized = None
    if evaluated[0] >= PAYS:
        width = WIDTH
        while len(rows) <= width // 2 and width > NARROW:  # few of them are evaluated for nothing
            width //= 2
        vectorized = _vectorize(function, len(shared), width)
    if vectorized is None:
        return call_rows(function, shared, rows)
    numbers = _evaluate(vectorized, shared, rows)
    ends = np.cumsum([r * c for r, c in vectorized.shapes])
    parts = zip(np.split(numbers, ends[:-1]), vectorized.shapes, strict=True)
    return [part.reshape(c, r, len(rows)).transpose(2, 0, 1) for part, (r, c) in parts]


class _Vectorized(NamedTuple):
    """A function in two: ``common`` of shared inputs, ``rows`` of that and a table (width, k) -> (width, numbers)."""

    common: ca.Function
    rows: ca.Function
    width: int
    shapes: tuple[tuple[int, int], ...]


@lru_cache(maxsize=256)
def _evaluated(_: ca.Function) -> list[int]:
    """Return a list with the number of rows at which a function was evaluated, to be counted up."""
    return [0]


@lru_cache(maxsize=256)
def _vectorize(function: ca.Function, shared: int, width: int) -> _Vectorized | None:
    """Return a function of scalar operations at ``width`` rows; None for one that calls others."""
    if not function.is_a("SXFunction"):
        return None
    with SYMBOLS:
        inputs = function.sx_in()
        numbers = ca.cse(ca.vertcat(*map(ca.vec, function.call(inputs))))
        constant = ca.vertcat(*inputs[:shared])
        remaining, symbols, values = ca.extract_parametric(numbers, constant, {"extract_trivial": True})
        common = ca.Function("common", inputs[:shared], [ca.vertcat(ca.SX(0, 1), *values)])
        scalar = ca.Function("scalar", [ca.vertcat(ca.SX(0, 1), *symbols), inputs[-1]], [remaining])
        rows = _widen(scalar, width)
    if rows is None:
        return None
    return _Vectorized(common, rows, width, tuple(function.size_out(i) for i in range(function.n_out())))


def _widen(scalar: ca.Function, width: int) -> ca.Function | None:
    """Return a function (common, row) -> numbers with the rows of a table (width, k) in the place of a row."""
    common = ca.MX.sym("common", scalar.size1_in(0))
    table = ca.MX.sym("rows", width, scalar.size1_in(1))
    inputs = (ca.vertsplit(common), ca.horzsplit(table))
    values: dict[int, ca.MX] = {}
    outputs = [ca.MX.zeros(width, 1)] * scalar.size1_out(0)
    for k in range(scalar.n_instructions()):
        operation = scalar.instruction_id(k)
        source = scalar.instruction_input(k)
        target = scalar.instruction_output(k)
        if operation == ca.OP_OUTPUT:
            dense = ca.densify(values[source[0]])
            outputs[target[1]] = dense if dense.numel() == width else ca.repmat(dense, width, 1)
        elif operation == ca.OP_INPUT:
            values[target[0]] = inputs[source[0]][source[1]]
        elif operation == ca.OP_CONST:
            values[target[0]] = ca.MX(scalar.instruction_constant(k))
        elif operation in (ca.OP_CALL, ca.OP_PARAMETER):
            return None
        elif len(source) == 1:
            values[target[0]] = ca.MX.unary(operation, values[source[0]])
        else:
            first, second = source
            values[target[0]] = ca.MX.binary(operation, values[first], values[second])
    return ca.Function("vectorized", [common, table], [ca.horzcat(*outputs)])


class _Memory:
    """Inputs and outputs of both functions in one thread: ``table`` (k, width) gives ``numbers`` (n, width).

    They are set once: CasADi takes longer to set them than to evaluate.
    """

    def __init__(self, vectorized: _Vectorized):
        common, rows = vectorized.common, vectorized.rows
        constants = np.zeros(rows.size1_in(0))
        self.shared = [np.zeros(common.size1_in(i)) for i in range(common.n_in())]
        self.table = np.zeros((rows.size2_in(1), vectorized.width))
        self.numbers = np.zeros((rows.size2_out(0), vectorized.width))
        self.common = _buffer(common, self.shared, constants)
        self.rows = _buffer(rows, [constants, self.table], self.numbers)


def _buffer(function: ca.Function, inputs: Sequence[Array], output: Array) -> Any:
    """Return a buffer, what evaluates the function in it, and the arrays, all of which have to be kept."""
    made: tuple[Any, Any] = function.buffer()  # CasADi's stubs ask for sizes, which its wrapper takes from the arrays
    buffer, trigger = made
    for i, values in enumerate(inputs):
        buffer.set_arg(i, values.data)
    buffer.set_res(0, output.data)
    return trigger, buffer, inputs, output


@lru_cache(maxsize=64)
def _memory(vectorized: _Vectorized, _thread: int) -> _Memory:
    return _Memory(vectorized)


def _evaluate(vectorized: _Vectorized, shared: Sequence[Array], rows: Array) -> Array:
    """Return the numbers (n, N) of a table (N, k)."""
    numbers = np.empty((vectorized.rows.size2_out(0), len(rows)))

    def evaluate(begin: int) -> None:
        memory = _memory(vectorized, threading.get_ident())
        for own, values in zip(memory.shared, shared, strict=True):
            own[:] = values
        memory.common[0]()
        end = min(begin + SHARE, len(rows))
        for start in range(begin, end, vectorized.width):
            part = slice(start, min(start + vectorized.width, end))
            count = part.stop - start
            memory.table[:, :count] = rows[part].T
            memory.table[:, count:] = rows[part.stop - 1][:, None]  # stands for those missing
            memory.rows[0]()
            numbers[:, part] = memory.numbers[:, :count]

    on_all_cores(evaluate, range(0, len(rows), SHARE))
    return numbers
