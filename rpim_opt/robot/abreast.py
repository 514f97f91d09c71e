"""CasADi functions of many rows abreast: every operation is done on a row of numbers before the next one begins.

CasADi's virtual machine spends most of its time between operations. Here it does each on `WIDTH` rows at once, so that
a row takes a fifteenth of the time; machine code does the same on the processor's vectors. What depends on the inputs
that all rows share is computed once. Operations and their order stay, and with them every bit of the values.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.room import room
from rpim_opt.basics.threads import on_all_cores
from rpim_opt.robot.compiled import MachineCode, compiled
from rpim_opt.robot.kinematics import call_rows
from rpim_opt.robot.posture import SYMBOLS

WIDTH = 256
"""Rows abreast in the virtual machine: their numbers stay in the processor's second cache."""
NARROW = 64
"""Rows abreast of small tables."""
VECTOR = 16
"""Rows abreast in machine code: two of the widest vectors."""
SHARE = 16 * WIDTH
"""Rows that one thread evaluates before it takes more."""
PAYS = 2_000
"""Rows, at once or in all, from which it pays to set them abreast: that takes as long as to evaluate them."""
SOME, MANY = 20_000, 10_000_000
"""Rows evaluated in all from which a library is worth loading, and worth making, which takes a compiler seconds."""
LONGEST = 6_000
"""Operations of a function that is compiled: a compiler takes more than its share of time for longer ones."""


class Abreast(NamedTuple):
    """A function of rows in two: ``common`` (shared inputs) and ``rows`` (that, rows (width, k)) -> (width, numbers).

    ``shapes`` are those of the function's outputs; ``machine_code`` is what evaluates any number of rows, or None.
    ``angles``, if any, is (common, rows) -> (width, t): their sines, and then their cosines, are t columns each that
    ``rows`` takes besides.
    """

    common: ca.Function
    rows: ca.Function
    width: int
    shapes: tuple[tuple[int, int], ...]
    machine_code: MachineCode | None = None
    angles: ca.Function | None = None


class _Effort:
    """Rows at which a function was evaluated."""

    rows = 0


@lru_cache(maxsize=256)
def _effort(_: ca.Function) -> _Effort:
    return _Effort()


def evaluated(function: ca.Function, shared: Sequence[Array], rows: Array, passing: bool = False) -> list[Array]:
    """Return what `call_rows` returns, the same bits, in the quickest way that pays for so many rows.

    Of many rows the values of every number stand side by side in memory: (N, c, r) arrays whose first axis is dense.

    Parameters
    ----------
    function, shared, rows
        As `call_rows` has them.
    passing
        Whether the caller is done with the values when it next asks in the same thread.
    """
    way = _quickest(function, len(shared), len(rows))
    if way is None:
        return call_rows(function, shared, rows)
    size = sum(r * c for r, c in way.shapes)
    if passing:
        numbers = room("evaluated", size, len(rows))
    else:
        numbers = np.empty((size, len(rows)))
    found = _of_outputs(numbers, [(c, r) for r, c in way.shapes])
    _on_columns(way, shared, rows, found, np.ones(size))
    return [values.transpose(2, 0, 1) for values in found]


def write(function: ca.Function, shared: Sequence[Array], rows: Array, found: Sequence[Array], factors: Array) -> None:
    """Write what `evaluated` returns, times factors, to where it is wanted, as quickly.

    Parameters
    ----------
    function, shared, rows
        As `call_rows` has them.
    found
        An array (c, r, N) for every output (r, c); from row to row they all go as far in memory.
    factors
        Of all outputs' numbers, one output after the other.
    """
    way = _quickest(function, len(shared), len(rows))
    if way is not None:
        _on_columns(way, shared, rows, found, factors)
        return
    by_output = _of_outputs(factors[:, None], [into.shape for into in found])
    for into, factor, values in zip(found, by_output, call_rows(function, shared, rows), strict=True):
        np.multiply(values.transpose(1, 2, 0), factor, out=into)


def _of_outputs(numbers: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Return numbers (n, m) of all outputs by output, each (c, r, m)."""
    parts = []
    end = 0
    for c, r, *_ in shapes:
        begin, end = end, end + c * r
        parts.append(numbers[begin:end].reshape(c, r, numbers.shape[1]))
    return parts


def _quickest(function: ca.Function, shared: int, rows: int) -> Abreast | None:
    """Return how a function is evaluated at some rows more; None for one after the other."""
    effort = _effort(function)
    effort.rows += rows
    count = WIDTH
    while rows <= count // 2 and count > VECTOR:  # few of them are evaluated for nothing
        count //= 2
    if effort.rows < PAYS:
        return None
    if effort.rows >= SOME and function.n_instructions() <= LONGEST:
        made = _machine_code(function, shared, effort.rows >= MANY)
        if made is not None:
            return made
    return abreast(function, shared, max(count, NARROW))


@lru_cache(maxsize=256)
def _machine_code(function: ca.Function, shared: int, make: bool) -> Abreast | None:
    way = abreast(function, shared, VECTOR, apart=True)
    if way is None or way.angles is None:
        return None
    made = compiled(way.rows, way.angles, make)
    if made is None:
        return None
    return way._replace(machine_code=made)


@lru_cache(maxsize=256)
def abreast(function: ca.Function, shared: int, width: int, apart: bool = False) -> Abreast | None:
    """Return a function of scalar operations on many rows; None for one that calls others.

    Parameters
    ----------
    function
        Inputs: one column for each of ``shared``, then one column that changes with the row.
    shared
        Number of inputs that are the same for all rows.
    width
        Rows.
    apart
        Whether sines and cosines of the same angle, which cost less together, are left to who evaluates it.
    """
    if not function.is_a("SXFunction"):
        return None
    with SYMBOLS:
        inputs = function.sx_in()
        numbers = ca.cse(ca.vertcat(*map(ca.vec, function.call(inputs))))
        given = ca.vertcat(*inputs[:shared])
        left, symbols, values = ca.extract_parametric(numbers, given, {"extract_trivial": True})
        common = ca.Function("common", inputs[:shared], [ca.vertcat(ca.SX(0, 1), *values)])
        scalar = ca.Function("scalar", [ca.vertcat(ca.SX(0, 1), *symbols), inputs[-1]], [left])
        widened = _widened(scalar, width, apart)
    if widened is None:
        return None
    rows, angles = widened
    shapes = tuple(function.size_out(i) for i in range(function.n_out()))
    return Abreast(common, rows, width, shapes, angles=angles if apart else None)


class _Angles:
    """Angles of rows with symbols for their sines and cosines; none that depends on such a symbol itself."""

    def __init__(self, width: int):
        self.width = width
        self.angles: list[ca.MX] = []
        self.turned: dict[int, list[ca.MX]] = {ca.OP_SIN: [], ca.OP_COS: []}
        self._known: dict[int, tuple[int, ca.MX]] = {}

    def symbol(self, operation: int, angle: ca.MX) -> ca.MX:
        """Return what stands for the sine or the cosine of an angle."""
        if hash(angle) not in self._known:  # the node's address, which nothing else has as long as it is kept
            self._known[hash(angle)] = len(self.angles), angle
            self.angles.append(_dense(angle, self.width))
            for symbols in self.turned.values():
                symbols.append(ca.MX.sym("turned", self.width))
        return self.turned[operation][self._known[hash(angle)][0]]


def _widened(scalar: ca.Function, width: int, apart: bool) -> tuple[ca.Function, ca.Function] | None:
    """Return a function (common, row) -> numbers with the rows of a table (width, k) in the place of a row.

    And the angles of those rows whose sines and cosines it takes besides: none unless they stand apart.
    """
    common = ca.MX.sym("common", scalar.size1_in(0))
    table = ca.MX.sym("rows", width, scalar.size1_in(1))
    inputs = (ca.vertsplit(common), ca.horzsplit(table))
    column = ca.MX.zeros(width, 1)
    values: dict[int, ca.MX] = {}
    found = [column] * scalar.size1_out(0)
    angles = _Angles(width)
    turned: dict[int, bool] = {}  # whether a value depends on a sine or a cosine
    for k in range(scalar.n_instructions()):
        operation = scalar.instruction_id(k)
        taken = scalar.instruction_input(k)
        put = scalar.instruction_output(k)
        if operation == ca.OP_OUTPUT:
            found[put[1]] = _dense(values[taken[0]], width)
            continue
        turns = False
        if operation == ca.OP_INPUT:
            value = inputs[taken[0]][taken[1]]
        elif operation == ca.OP_CONST:
            value = ca.MX(scalar.instruction_constant(k))
        elif operation in (ca.OP_CALL, ca.OP_PARAMETER):
            return None
        elif apart and operation in angles.turned and not turned[taken[0]]:
            turns = True
            value = angles.symbol(operation, values[taken[0]])
        else:
            turns = any(turned[i] for i in taken)
            value = _operation(operation, [values[i] for i in taken])
        values[put[0]], turned[put[0]] = value, turns
    both = [*angles.turned[ca.OP_SIN], *angles.turned[ca.OP_COS]]
    rows = ca.Function("abreast", [common, table, *both], [ca.horzcat(*found)])
    return rows, ca.Function("angles", [common, table], [ca.horzcat(ca.MX(width, 0), *angles.angles)])


def _operation(operation: int, values: list[Any]) -> ca.MX:
    if len(values) == 1:
        return ca.MX.unary(operation, values[0])
    return ca.MX.binary(operation, *values)


def _dense(values: ca.MX, width: int) -> ca.MX:
    """Return a number of every row (width, 1), where it may be one for all."""
    values = ca.densify(values)
    if values.numel() == width:
        return values
    return ca.repmat(values, width, 1)


class _Memory:
    """A function's inputs and its output in one thread, set once: CasADi takes longer to set them than to evaluate."""

    def __init__(self, function: ca.Function, inputs: Sequence[Array], output: Array):
        self.inputs = inputs
        buffer: Any
        buffer, self.evaluate = function.buffer()
        for i, values in enumerate(inputs):
            buffer.set_arg(i, values.data)
        buffer.set_res(0, output.data)
        self._buffer = buffer


class _Own:
    """The memory of both functions in one thread: ``table`` (k, width) gives ``numbers`` (n, width)."""

    def __init__(self, way: Abreast):
        self.way = way
        self.given = np.zeros(way.rows.size1_in(0))
        self.shared = [np.zeros(way.common.size1_in(i)) for i in range(way.common.n_in())]
        self.common = _Memory(way.common, self.shared, self.given)
        if way.machine_code is None:
            self.table = np.zeros((way.rows.size2_in(1), way.width))
            self.numbers = np.zeros((way.rows.size2_out(0), way.width))
            self.rows = _Memory(way.rows, [self.given, self.table], self.numbers)

    def write(self, rows: Array, found: Sequence[Array], factors: Array) -> None:
        """Write the numbers of rows (N, k), times factors (n,), into arrays (c, r, N)."""
        made = self.way.machine_code
        if made is not None:
            step = found[0].strides[2] // found[0].itemsize
            made(self.given, np.ascontiguousarray(rows), _places(found), step, factors)
            return
        for start in range(0, len(rows), self.way.width):
            part = slice(start, start + self.way.width)
            self._together(rows[part], [into[:, :, part] for into in found], factors)

    def _together(self, rows: Array, found: Sequence[Array], factors: Array) -> None:
        """Evaluate ``width`` rows, or fewer; the last one stands for those that are not there."""
        there = len(rows)
        self.table[:, :there] = rows.T
        self.table[:, there:] = rows[-1][:, None]
        self.rows.evaluate()
        shapes = [into.shape for into in found]
        numbers, by_output = (_of_outputs(each, shapes) for each in (self.numbers[:, :there], factors[:, None]))
        for into, factor, values in zip(found, by_output, numbers, strict=True):
            np.multiply(values, factor, out=into)


@lru_cache(maxsize=64)
def _own(way: Abreast, _thread: int) -> _Own:
    return _Own(way)


def _places(found: Sequence[Array]) -> np.ndarray:
    """Return where in memory the first row's numbers of arrays (c, r, N) stand, (numbers,)."""
    return np.concatenate([into.ctypes.data + _further(into.shape[:2], into.strides[:2]) for into in found])


@lru_cache(maxsize=64)
def _further(shape: tuple[int, ...], strides: tuple[int, ...]) -> np.ndarray:
    """Return how much further in memory every number stands than the first one, (c * r,)."""
    return np.add.outer(strides[0] * np.arange(shape[0]), strides[1] * np.arange(shape[1])).ravel()


def _on_columns(way: Abreast, shared: Sequence[Array], rows: Array, found: Sequence[Array], factors: Array) -> None:
    """Find the numbers of a table (N, k), times factors (n,), in arrays (c, r, N)."""

    def evaluate(begin: int) -> None:
        own = _own(way, threading.get_ident())
        for own_values, values in zip(own.shared, shared, strict=True):
            own_values[:] = values
        own.common.evaluate()
        part = slice(begin, begin + SHARE)
        own.write(rows[part], [into[:, :, part] for into in found], factors)

    on_all_cores(evaluate, range(0, len(rows), SHARE))
