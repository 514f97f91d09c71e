"""Symbolic kinematics in CasADi: homogeneous transforms, the MDH chain, frames; and functions at many rows.

Functions of symbols take and return CasADi ``SX`` (or numbers); they return 4 x 4 matrices, or the factors of a
`product`.
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Callable, Sequence
from functools import lru_cache, reduce
from typing import Any

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.threads import on_all_cores
from rpim_opt.robot.mdh import MDH, Robot
from rpim_opt.robot.terms import SYMBOLS, Configuration, Joint, Place, Symbol, Term, term_motion, terms_of

FRAME = ("x", "y", "z", "rx", "ry", "rz")
"""A frame's six numbers: origin [m], and roll, pitch, yaw [rad] about fixed axes, R = Rz Ry Rx."""

FRAME_DIMENSION = dict(zip(FRAME, ("length",) * 3 + ("angle",) * 3, strict=True))

EYE = ca.DM(np.eye(4))  # dense, as all transforms are
WIDTH = 256  # rows of one call: the virtual machine's numbers then fit into the second-level cache
SHARE = 16 * WIDTH  # rows that a thread evaluates per task: enough to outweigh the handover
PAYS = 1_000  # rows from which a vectorized function pays: building it costs as much as evaluating twice as many


def rotation(axis: int, angle: Symbol) -> ca.SX:
    """Rot(x, angle) for axis 0, Rot(y, angle) for 1, Rot(z, angle) for 2."""
    c, s = ca.cos(angle), ca.sin(angle)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    T = ca.SX(EYE)
    T[j, j], T[j, k] = c, -s
    T[k, j], T[k, k] = s, c
    return T


def translation(x: Symbol = 0.0, y: Symbol = 0.0, z: Symbol = 0.0) -> ca.SX:
    """Trans(x, y, z)."""
    T = ca.SX(EYE)
    T[:3, 3] = ca.vertcat(x, y, z)
    return T


def product(factors: Sequence[ca.SX]) -> ca.SX:
    """Return the product of transforms, from the right: a position needs no rotation of the frames before it."""
    return reduce(lambda T, factor: factor @ T, reversed(factors))


def link(alpha: Symbol, a: Symbol, theta: Symbol, d: Symbol, beta: Symbol) -> list[ca.SX]:
    """Return the factors Rot(x, alpha) Trans(x, a) Rot(z, theta) Trans(z, d) Rot(y, beta), the paper's Eq. (1)."""
    return [rotation(0, alpha), translation(x=a), rotation(2, theta), translation(z=d), rotation(1, beta)]


def numeric_link(alpha: float = 0, a: float = 0, theta: float = 0, d: float = 0, beta: float = 0) -> Array:
    """Return the link's transform (4, 4) as numbers."""
    return LINK(alpha, a, theta, d, beta).full()


_numbers = [ca.SX.sym(name) for name in MDH]
LINK = ca.Function("link", _numbers, [ca.densify(product(link(*_numbers)))])


def roll_pitch_yaw(R: Array) -> Array:
    """Return (rx, ry, rz) [rad] with R = Rz Ry Rx."""
    # roll is computed with yaw removed: the three angles give R back also at a pitch of 90 degrees
    yaw = np.arctan2(R[1, 0], R[0, 0]) if np.hypot(R[1, 0], R[0, 0]) > 1e-12 else np.arctan2(-R[0, 1], R[1, 1])
    c, s = np.cos(yaw), np.sin(yaw)
    roll = np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return np.array([roll, np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0])), yaw])


def frame(nominal: Sequence[Symbol], deviation: Sequence[Symbol] = (0,) * 6) -> ca.SX:
    """Return a frame displaced from its nominal place, the product of `placed`."""
    return product(placed(nominal, deviation))


def placed(nominal: Sequence[Symbol], deviation: Sequence[Symbol] = (0,) * 6) -> list[ca.SX]:
    """Return the factors of a frame that is displaced from its nominal place, along and about the parent's axes.

    ::

        origin = nominal origin + (x, y, z),    R = R(rx, ry, rz) R(nominal)

    which is regular for every nominal frame, while adding to roll, pitch and yaw is singular at a pitch of 90 degrees.
    """
    origin = [n + d for n, d in zip(nominal[:3], deviation[:3], strict=True)]
    turns = [rotation(axis, angles[axis]) for angles in (deviation[3:], nominal[3:]) for axis in (2, 1, 0)]
    return [translation(*origin), *turns]


def numeric_frame(place: Sequence[float] | Array) -> Array:
    """Return the transform (4, 4) of a frame's six numbers."""
    return PLACE([float(v) for v in place]).full()


_six = ca.SX.sym("place", 6)
PLACE = ca.Function("frame", [_six], [frame(ca.vertsplit(_six))])


def frame_numbers(T: Array) -> Array:
    """Return the six numbers of a transform (4, 4), the inverse of `numeric_frame`."""
    return np.concatenate([T[:3, 3], roll_pitch_yaw(T[:3, :3])])


def transforms(joint_types: Sequence[str], configuration: Configuration, value: Callable[[str], Symbol]) -> list[ca.SX]:
    """Return the transforms from the robot's base to the frame after every joint; the last is the flange's."""
    products = [product(factors) for factors in _by_joint(joint_types, configuration, value, ())[:-1]]
    return list(itertools.accumulate(products, operator.matmul))


def chain(
    joint_types: Sequence[str], configuration: Configuration, value: Callable[[str], Symbol], terms: Sequence[Term] = ()
) -> list[ca.SX]:
    """Return the factors of the transform from the robot's base to its flange; arguments as for `transforms`."""
    return list(itertools.chain.from_iterable(_by_joint(joint_types, configuration, value, terms)))


def _by_joint(
    joint_types: Sequence[str], configuration: Configuration, value: Callable[[str], Symbol], terms: Sequence[Term]
) -> list[list[ca.SX]]:
    """Return the factors up to every joint's frame from the one before, and those by which the tool is displaced."""
    dof = len(joint_types)
    every = (*terms_of(dof), *terms)

    def motion(at: Place, i: int) -> ca.SX | None:
        """Return the sum of the motions of all terms of joint or link i; None without any."""
        own = [term for term in every if term.at == at and i in term.places(joint_types)]
        motions = [term_motion(term, Joint(i, configuration), value) for term in own]
        parts = [part for part in motions if part is not None]
        return sum(parts[1:], parts[0]) if parts else None

    def displaced(at: Place, i: int) -> list[ca.SX]:
        by = motion(at, i)
        return [] if by is None else placed((0,) * 6, ca.vertsplit(by))

    steps = []
    before = displaced("base", 1)
    for i, kind in enumerate(joint_types, start=1):
        alpha, a, theta, d, beta = (value(f"{column}{i}") for column in MDH)
        q = configuration.q[i - 1]
        more = motion("joint", i)
        moved = q if more is None else q + more
        if kind == "revolute":
            theta = theta + moved
        else:
            d = d + moved
        steps.append([*before, *link(alpha, a, theta, d, beta), *displaced("link", i)])
        before = []
    return [*steps, displaced("tool", dof)]


def table_symbols(dof: int) -> tuple[ca.SX, dict[str, ca.SX]]:
    """Return the symbols of a table, row by row (5 dof,), and by name."""
    table = ca.SX.sym("mdh", dof * len(MDH))
    names = [f"{column}{i}" for i in range(1, dof + 1) for column in MDH]
    return table, dict(zip(names, ca.vertsplit(table), strict=True))


@lru_cache(maxsize=32)
def _flange(joint_types: tuple[str, ...]) -> ca.Function:
    """Build the flange's transform from the table, row by row, and joint values: once for all arms of a kind."""
    dof = len(joint_types)
    table, value = table_symbols(dof)
    q = ca.SX.sym("q", dof)
    T = product(chain(joint_types, Configuration(ca.vertsplit(q)), lambda name: value.get(name, 0.0)))
    return ca.Function("flange", [table, q], [T])


def forward_kinematics(robot: Robot, q: Array) -> Array:
    """Return the transforms (N, 4, 4) from the robot's base to its flange, without base and tool frame.

    Each is the product of the links of `Robot` at the controller's joint values q (N, dof) [rad or m].

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> arm = ro.robot.Robot("two links", np.array([[0, 0, 0, 0, 0], [0, 0.4, 0, 0, 0]]))
    >>> ro.robot.forward_kinematics(arm, np.array([[0, 0], [np.pi / 2, 0]]))[:, :3, 3].round(9)
    array([[0.4, 0. , 0. ],
           [0. , 0.4, 0. ]])
    """
    configurations = np.atleast_2d(np.asarray(q, dtype=float)) @ robot.joint_map.T
    function = _flange(tuple(robot.joint_types))
    return call_rows(function, [robot.mdh.ravel()], configurations)[0].reshape(-1, 4, 4).transpose(0, 2, 1)


# Functions at many rows


def call_rows(function: ca.Function, shared: Sequence[Array], rows: Array) -> list[Array]:
    """Evaluate a CasADi function of shared vectors and a row on every row (N, k) of a table, on all cores.

    Return its outputs, a dense one of (r, c) as (N, c, r). CasADi's virtual machine spends most of its time between
    operations: for many rows the function is rebuilt so that every operation works on `WIDTH` rows at once. Operations
    and their order do not change, and the values agree to the last bit.
    """
    results = [np.zeros((len(rows), *reversed(function.size_out(i)))) for i in range(function.n_out())]
    arguments = [np.ascontiguousarray(values, dtype=float) for values in (*shared, rows)]
    vectorized = _vectorized(function) if len(rows) >= PAYS else None

    def evaluate(begin: int) -> None:
        buffers: dict[int, Any] = {}
        end = min(begin + SHARE, len(rows))
        for start in range(begin, end, WIDTH):
            part = slice(start, min(start + WIDTH, end))
            N = len(rows[part])
            if N not in buffers:
                mapped = vectorized if vectorized and N == WIDTH else _mapped(function, N)
                buffers[N] = mapped.buffer()
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
def _mapped(function: ca.Function, N: int) -> ca.Function:
    """Return the function of N rows, the columns of its last input."""
    return ca.Function.map(function, "rows", "serial", N, list(range(function.n_in() - 1)), [], {})


@lru_cache(maxsize=256)
def _vectorized(function: ca.Function) -> ca.Function | None:
    """Return the function of `WIDTH` rows, what depends on them as vectors; None for one that calls others."""
    if not function.is_a("SXFunction"):
        return None
    *shared, row = range(function.n_in())
    with SYMBOLS:
        inputs = [ca.MX.sym("shared", function.size1_in(i)) for i in shared]
        table = ca.MX.sym("rows", function.size1_in(row), WIDTH)
    entries = [*map(ca.vertsplit, inputs), ca.horzsplit(table.T)]
    outputs = [[ca.MX.zeros(1, WIDTH)] * function.nnz_out(i) for i in range(function.n_out())]
    values: dict[int, ca.MX] = {}
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        source = function.instruction_input(k)
        target = function.instruction_output(k)
        if operation == ca.OP_OUTPUT:
            dense = ca.densify(values[source[0]]).T
            outputs[target[0]][target[1]] = dense if dense.numel() == WIDTH else ca.repmat(dense, 1, WIDTH)
        elif operation == ca.OP_INPUT:
            values[target[0]] = entries[source[0]][source[1]]
        elif operation == ca.OP_CONST:
            values[target[0]] = ca.MX(function.instruction_constant(k))
        elif operation in (ca.OP_CALL, ca.OP_PARAMETER):
            return None
        elif len(source) == 1:
            values[target[0]] = ca.MX.unary(operation, values[source[0]])
        else:
            values[target[0]] = ca.MX.binary(operation, values[source[0]], values[source[1]])
    results = [ca.reshape(ca.vertcat(*each), function.size1_out(i), -1) for i, each in enumerate(outputs)]
    return ca.Function("vectorized", [*inputs, table], results)
