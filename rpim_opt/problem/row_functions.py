"""CasADi functions of a measured row, and the loads on the joints that they depend on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from types import MappingProxyType
from typing import NamedTuple

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.threads import phase
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.data.measurements.measurement import Measurement, of_fixture
from rpim_opt.data.measurements.registry import READY
from rpim_opt.robot.evaluation import SYMBOLS, evaluate_rows, write_rows
from rpim_opt.robot.extensions import Statics
from rpim_opt.robot.kinematics import FRAME, chain, placed, product, translation
from rpim_opt.robot.mdh import Gravity, Robot
from rpim_opt.robot.parameter_names import (
    EXPANSION,
    REFERENCE,
    frame_of,
    of_session,
    of_term,
    session_prefix,
    tool_prefix,
)
from rpim_opt.robot.parameters import Parameters
from rpim_opt.robot.terms import Posture, Symbol, Term, Transmission, dependencies

Functions = Mapping[str, ca.Function]
"""``residual``, ``jacobian``, ``modelled``, ``metres`` of one row; inputs are deviations, nominal values, the row."""

transform = Measurement(
    "transform", lambda T: ca.vec(T.T), {f"t{i}{j}": "" for i in range(4) for j in range(4)}, noise={"entry": ""}
)
"""The reflector's transform itself, row by row: what a calibrated robot's forward kinematics evaluate."""

MANY = 1024
"""Functions that are kept, some hundred kB each: of some hundred reflectors each has its own."""
_READY = frozenset({*READY.values(), transform})


class Structure(NamedTuple):
    """What decides the functions of a block's rows besides the measurement.

    ``identified`` and ``absent`` are (P,) true or false as bytes; absent parameters are zero and not identified.
    ``loads`` are what a row states besides joint values, and the gravity that its joints' terms see; ``terms`` are a
    user's own; ``several`` whether other robots have rows, too; ``sessions`` the prefixes of what shifts the base, each
    with a column that is 1 where a row is of that session.
    """

    joint_types: tuple[str, ...]
    names: tuple[str, ...]
    identified: bytes
    absent: bytes
    markers: tuple[str, ...]
    fixture: str
    loads: Loads
    terms: tuple[Term, ...] = ()
    several: bool = False
    sessions: tuple[str, ...] = ()


class Row(NamedTuple):
    """The symbols and expressions of one row."""

    x: ca.SX
    nominal: ca.SX
    row: ca.SX
    residual: ca.SX
    modelled: ca.SX
    metres: ca.SX


class Kept:
    """Functions that are asked for once: what a calibration works with from its first pass to its last."""

    def __init__(self) -> None:
        self._functions: dict[tuple[Structure, Measurement], Functions] = {}

    def __call__(self, structure: Structure, measurement: Measurement) -> Functions:
        """Return the functions as they were when they were first asked for."""
        with SYMBOLS:
            if (structure, measurement) not in self._functions:
                self._functions[structure, measurement] = asked(structure, measurement)
            return self._functions[structure, measurement]

    def __getstate__(self) -> dict[tuple[Structure, Measurement], dict[str, str]]:
        """Return what cannot be asked for elsewhere: answers of a user's functions, as they were."""
        return {
            key: {name: function.serialize() for name, function in functions.items()}
            for key, functions in self._functions.items()
            if not _is_pure(*key)
        }

    def __setstate__(self, kept: dict[tuple[Structure, Measurement], dict[str, str]]) -> None:
        self._functions = {
            key: {name: _restored(text) for name, text in functions.items()} for key, functions in kept.items()
        }


@lru_cache(maxsize=256)
def _restored(text: str) -> ca.Function:
    """Return a function that was sent, the same one every time: what was prepared for many rows of it is not lost."""
    return ca.Function.deserialize(text)


def _is_pure(structure: Structure, measurement: Measurement) -> bool:
    """Whether the functions depend on nothing but what is asked."""
    return measurement in _READY and all(isinstance(term, Transmission) for term in structure.terms)


def asked(structure: Structure, measurement: Measurement) -> Functions:
    """Return the functions of a row.

    Ready measurements are pure, and built once. A user's model or term may read a variable that has changed: it is
    asked anew, and what was built before is taken only when it answers the same expression.

    Raises
    ------
    InputError
        For a residual with more or fewer components than the measurement declares.
    """
    if _is_pure(structure, measurement):
        return _ready(structure, measurement)
    with SYMBOLS:
        expressions = _expressions(structure, measurement)
        answer = ca.Function("row", list(expressions[:3]), list(expressions[3:]))
        return _built(answer.serialize())


@lru_cache(maxsize=MANY)
def _ready(structure: Structure, measurement: Measurement) -> Functions:
    with SYMBOLS:
        return _derived(_expressions(structure, measurement))


@lru_cache(maxsize=256)
def _built(answer: str) -> Functions:
    function = ca.Function.deserialize(answer)
    symbols = function.sx_in()
    return _derived(Row(*symbols, *function.call(symbols)))


def _derived(of: Row) -> Functions:
    inputs = [of.x, of.nominal, of.row]
    # call_rows returns the transposes: the derivative by x stands in rows
    transposed = ca.densify(-ca.jacobian(of.residual, of.x).T)
    return {
        "residual": ca.Function("residual", inputs, [of.residual]),
        "jacobian": ca.Function("jacobian", inputs, [of.residual, transposed]),
        "modelled": ca.Function("modelled", inputs, [of.modelled]),
        "metres": ca.Function("metres", inputs, [of.metres]),
    }


class _Entries:
    """Entries of a vector by name, zero where a place is None; a row sees few of many, which are taken as asked for."""

    def __init__(self, vector: ca.SX, places: Mapping[str, int | None]) -> None:
        self._vector, self._places = vector, places

    def __getitem__(self, name: str) -> Symbol:
        place = self._places[name]
        if place is None:
            return ca.SX(0)
        return self._vector[place]

    def get(self, name: str) -> Symbol:
        """Return an entry, zero where there is none of this name."""
        if name not in self._places:
            return ca.SX(0)
        return self[name]


@lru_cache(maxsize=16)
def _places(
    names: tuple[str, ...], identified: bytes, absent: bytes
) -> tuple[dict[str, int | None], dict[str, int | None]]:
    """Return the places of nominal values, None where they are zero, and of deviations, None where they are none."""
    start: dict[str, int | None] = {name: i for i, name in enumerate(names)}
    start.update((names[i], None) for i in np.flatnonzero(np.frombuffer(absent, dtype=bool)))
    free = np.flatnonzero(np.frombuffer(identified, dtype=bool))
    return start, dict.fromkeys(names) | {names[i]: k for k, i in enumerate(free)}


class _Parameters(NamedTuple):
    """The parameters of a row by name: where they start, and the deviations of those that are identified."""

    x: ca.SX
    nominal: ca.SX
    start: _Entries
    deviation: _Entries

    @classmethod
    def of(cls, names: tuple[str, ...], identified: bytes, absent: bytes) -> _Parameters:
        start, deviation = _places(names, identified, absent)
        x = ca.SX.sym("x", sum(place is not None for place in deviation.values()))
        nominal = ca.SX.sym("nominal", len(names))
        return cls(x, nominal, _Entries(nominal, start), _Entries(x, deviation))

    def value(self, name: str) -> Symbol:
        """Return a parameter, zero where there is none of this name."""
        return self.start.get(name) + self.deviation.get(name)

    def place(self, prefix: str) -> list[ca.SX]:
        """Return the factors of the frame whose six parameters begin with a prefix."""
        names = [prefix + component for component in FRAME]
        return placed([self.start[name] for name in names], [self.deviation[name] for name in names])

    def chosen(self, prefixes: tuple[str, ...], chosen: ca.SX) -> list[ca.SX]:
        """Return the factors of one of several frames, whose entry of ``chosen`` is 1; the identity where all are 0."""
        start, moved = (
            [ca.dot(chosen, ca.vertcat(*(of.get(p + c) for p in prefixes))) for c in FRAME]
            for of in (self.start, self.deviation)
        )
        return placed(start, moved)


def _expressions(of: Structure, measurement: Measurement) -> Row:
    p = _Parameters.of(of.names, of.identified, of.absent)
    stated = of.loads.symbols(len(of.joint_types), len(of.markers))
    session = ca.SX.sym("session", len(of.sessions))
    y = ca.SX.sym("y", len(measurement.columns))
    transforms = _reflectors(of, measurement, p, stated, session)
    own = _keywords(of, measurement, p, stated)
    modelled = ca.densify(measurement.model(*transforms, **own))
    residual = ca.densify(measurement.minus(y if measurement.columns else 0, modelled))
    if residual.numel() != len(measurement.components):
        found = f"{residual.numel()} components of the residual"
        raise InputError(f"measurement {measurement.name}", found, f"{len(measurement.components)} as it declares")
    metres = ca.SX(1)
    if measurement.metres is not None:
        metres = measurement.metres(*transforms, **own)
    return Row(p.x, p.nominal, ca.vertcat(*stated, session, y), residual, modelled, ca.densify(metres))


def _reflectors(of: Structure, measurement: Measurement, p: _Parameters, stated: Stated, session: ca.SX) -> list[ca.SX]:
    """Return the transform of each point's reflector in the frame that measures."""
    found = []
    for point, marker in enumerate(of.markers):
        posture = of.loads.posture(of.joint_types, p.start.__getitem__, stated, point)
        factors = []
        if of.several or not measurement.touching:  # touches differ by as much wherever one robot stands
            factors += p.place("base_")
        if of.sessions:
            factors += p.chosen(of.sessions, session)
        factors += _grown(chain(of.joint_types, posture, p.value, of.terms), p, posture.columns.get("temperature"))
        found.append(product([*factors, *p.place(tool_prefix(marker))]))
    return found


def _grown(flange: list[ca.SX], p: _Parameters, temperature: Symbol | None) -> list[ca.SX]:
    """Return the flange's factors when all lengths have grown with temperature: it is as far again from the base."""
    if temperature is None:
        return flange
    growth = p.value(EXPANSION) * (temperature - p.value(REFERENCE))
    return [translation(*ca.vertsplit(growth * product(flange)[:3, 3])), *flange]


def _keywords(of: Structure, measurement: Measurement, p: _Parameters, stated: Stated) -> dict[str, Symbol]:
    """Return the frames, parameters and columns that a measurement's model takes by name."""
    own = {name: product(p.place(of_fixture(name + "_", of.fixture))) for name in measurement.frames}
    in_frames = tuple(f"{prefix}_" for prefix in measurement.frames)
    for name in measurement.parameters:
        if not name.startswith(in_frames):
            own[name] = p.value(of_fixture(name, of.fixture))
    points = len(of.markers)
    known = of.loads.named(stated) | {"q": ca.reshape(stated.q, -1, points)}
    if stated.torque.numel():
        known["torque"] = ca.reshape(stated.torque, -1, points)
    return own | _seen(measurement, known)


def _seen(measurement: Measurement, known: Mapping[str, Symbol]) -> dict[str, Symbol]:
    """Return what a measurement sees besides transforms and parameters, by keyword."""
    for name in measurement.sees:
        if name not in known:
            where = f"measurement {measurement.name}"
            raise InputError(where, f"data without '{name}', which it sees", "data that state it in every row")
    return {name: known[name] for name in measurement.sees}


class Loads(NamedTuple):
    """What the rows of a block state of their joints, which decides the functions that evaluate them.

    ``gravity`` is None where no parameter asks for it; ``weighs`` tells that its torques stand for measured ones;
    ``columns`` are those that a user's own terms and measurement see.
    """

    torques: bool = False
    payload: bool = False
    approach: bool = False
    gravity: Gravity | None = None
    weighs: bool = False
    columns: tuple[str, ...] = ()

    def symbols(self, dof: int, points: int) -> Stated:
        """Return the symbols of a row of some points: empty for what it does not state."""
        joints = dof * points
        return Stated(
            q=ca.SX.sym("q", joints),
            torque=ca.SX.sym("tau", joints * self.torques),
            payload=ca.SX.sym("payload", int(self.payload)),
            approach=ca.SX.sym("approach", joints * self.approach),
            columns=ca.SX.sym("columns", len(self.columns)),
        )

    def posture(
        self, joint_types: Sequence[str], nominal: Callable[[str], Symbol], stated: Stated, point: int = 0
    ) -> Posture:
        """Return what the joints of an arm of nominal parameters see at a point of a row, from the row's symbols."""
        dof = len(joint_types)
        at = slice(point * dof, (point + 1) * dof)
        q = ca.vertsplit(stated.q[at])
        torque = None
        if self.torques:
            torque = ca.vertsplit(stated.torque[at])
        elif not self.weighs:
            torque = [0.0] * dof
        weight = None
        if self.gravity is not None:
            weight = Statics(joint_types, q, nominal, self.gravity, stated.payload if self.payload else None)
        directions = None
        if self.approach:
            directions = ca.vertsplit(stated.approach[at])
        return Posture(q, torque, directions, weight, self.named(stated))

    def named(self, stated: Stated) -> dict[str, Symbol]:
        """Return the symbols of columns by name."""
        return {name: stated.columns[i] for i, name in enumerate(self.columns)}


class Stated(NamedTuple):
    """The symbols of what a row states of its joints, in the order in which `columns` lays it side by side.

    ``q``, ``torque`` and ``approach`` are (dof x points, 1), point by point; ``payload`` (1, 1), ``columns`` (c, 1).
    """

    q: ca.SX
    torque: ca.SX
    payload: ca.SX
    approach: ca.SX
    columns: ca.SX


class Needs(NamedTuple):
    """What the parameters that are identified, or not zero, need to know of a row."""

    torques: bool
    moments: bool
    payload: bool
    columns: frozenset[str]

    @classmethod
    def of(cls, robot: Robot, parameters: Parameters) -> Needs:
        """Return what a robot with a table of parameters needs."""
        used = parameters.identified | (parameters.nominal != 0)
        names = {parameters.names[i] for i in np.flatnonzero(used)}
        terms = [name for name in names if of_term(name)]
        asked = dependencies(robot.model, robot.joint_types, names.__contains__)
        return cls(
            torques=asked.torques or any(name.startswith("compliance") for name in terms),
            moments=asked.gravity or any(name.startswith("bend") for name in terms),
            payload=asked.gravity,
            columns=asked.columns,
        )


def measured_torques(data: Dataset, robot: str = "") -> bool:
    """Return whether data of a robot state torques: then those of gravity stand for none of them."""
    return any(block.torque is not None for block in data.blocks if block.robot == robot)


def loads_of(robot: Robot, needs: Needs, data: Dataset, block: Block) -> Loads:
    """Return what the rows of a block of some data state, and what they need of gravity."""
    weighs = needs.torques and not measured_torques(data, block.robot)
    return Loads(
        torques=block.torque is not None,
        payload=block.payload is not None,
        approach=block.approach is not None,
        gravity=robot.gravity if weighs or needs.moments else None,
        weighs=weighs,
        columns=tuple(block.columns),
    )


def loads_on(robot: Robot, parameters: Parameters, data: Dataset, torques: bool) -> Loads:
    """Return what commands state that are to be compensated: torques, or a payload where those of gravity count."""
    needs = Needs.of(robot, parameters)
    if needs.columns:
        accepted = "a calibration without it: nothing says what it will be where commands are to be corrected"
        raise InputError("compensation", f"a term that sees column '{min(needs.columns)}'", accepted)
    weighs = needs.torques and not measured_torques(data)
    gravity = robot.gravity if weighs or needs.moments else None
    return Loads(torques=torques, payload=weighs or needs.payload, gravity=gravity, weighs=weighs)


def loads_in(robot: Robot, block: Block) -> list[Array]:
    """Return what rows state of the joints of the model, (N, c) each, in the order of `Stated`."""
    N = len(block.y)
    found = []
    if block.torque is not None:  # virtual work: tau_model = M^-T tau
        found.append((block.torque @ np.linalg.inv(robot.joint_map)).reshape(N, -1))
    if block.payload is not None:
        found.append(block.payload.reshape(N, 1))
    if block.approach is not None:
        found.append(np.sign(block.approach @ robot.joint_map.T).reshape(N, -1))
    return [*found, *(values.reshape(N, 1) for values in block.columns.values())]


def require_loads(robot: Robot, parameters: Parameters, data: Dataset) -> None:
    """Refuse to identify from data of a robot what needs columns that they do not have."""
    free = parameters.free.names
    sided = [name for name in free if (name.startswith("backlash") and of_term(name)) or _sees_approach(robot, name)]
    if sided and all(block.approach is None for block in data.blocks):
        found = f"'{sided[0]}' without directions of approach"
        raise InputError("key identify", found, "columns approach1, ... (-1, 0 or +1) in the data")
    needed = Needs.of(robot, parameters).columns
    for block in data.blocks:
        for name in sorted({*needed, *block.measurement.extra} - {*block.columns}):
            accepted = f"a column '{name}' of the table, or Dataset.of(..., columns={{'{name}': ...}})"
            raise InputError("data", f"no column '{name}', which a term or a measurement sees", accepted)


def _sees_approach(robot: Robot, name: str) -> bool:
    if all(isinstance(term, Transmission) for term in robot.model.terms):
        return False
    return dependencies(robot.model, robot.joint_types, lambda other: other == name).approach


def require_same_torques(robot: Robot, parameters: Parameters, data: Dataset, measured: bool) -> None:
    """Refuse torques of another kind than those of a problem's data, ``measured`` or not, where compliances need them.

    Without measured torques a compliance multiplies those of gravity, on masses that may be a guess.
    """
    if not Needs.of(robot, parameters).torques or measured_torques(data) == measured:
        return
    where = "compliances"
    if measured:
        accepted = "none, as in the problem's data: its compliances multiply the torques of gravity"
        raise InputError(where, "joint torques", accepted)
    raise InputError(where, "data without joint torques", "columns tau1_Nm, ..., as in the problem's data")


def bearing(
    data: Dataset,
    like: Dataset,
    torque: Array | None = None,
    payload: float | Array | None = None,
    columns: Mapping[str, Array] = MappingProxyType({}),
) -> Dataset:
    """Return rows of one point in one block with what their joints bear.

    Directions of approach are not known, 0, where the data of a problem ``like`` these state them: the joints are in
    the middle of their backlash.

    ``data``: the rows; ``like``: data of the problem whose rows these are to be; ``torque``: (N, dof) joint torques
    [Nm]; ``payload``: mass at the flange [kg], one or (N,); ``columns``: further columns by name [SI], one number or
    (N,).
    """
    (block,) = data.blocks
    if torque is not None:
        torque = np.reshape(np.asarray(torque, dtype=float), (len(data), 1, -1))
    if payload is not None:
        payload = np.broadcast_to(np.asarray(payload, dtype=float), (len(data),))
    approach = None
    if any(each.approach is not None for each in like.blocks):
        approach = np.zeros(block.q.shape)
    known = {name: np.broadcast_to(np.asarray(values, dtype=float), len(data)) for name, values in columns.items()}
    block = replace(block, torque=torque, payload=payload, approach=approach, columns=known)
    return replace(data, blocks=(block,))


def repeatable(block: Block) -> Array:
    """Return what is the same (N, c) in rows that repeat a measurement: joint values and a model's own columns."""
    seen = [block.columns[name][:, None] for name in block.measurement.sees if name in block.columns]
    return np.hstack([block.q.reshape(len(block.row), -1), *seen])


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Rows of a dataset, evaluated by the CasADi functions of their blocks.

    ``arms`` are the nominal robots by name, ``kept`` the functions that were asked for once, if any were.
    """

    arms: Mapping[str, Robot]
    parameters: Parameters
    data: Dataset
    kept: Kept | None = None

    def of(self, block: Block, what: str, x: Array, part: slice = slice(None)) -> list[Array]:
        """Return the results of a function of `Functions` for rows of a block at x (n,), (N, ...) each."""
        function = self.functions(block)[what]
        with phase("evaluation"):
            return evaluate_rows(function, [x, self.parameters.nominal], self._stated(block)[part])

    def values(self, block: Block, what: str, x: Array) -> Array:
        """Return the vector (N, c) of a function of every row of a block at x (n,)."""
        return self.of(block, what, x)[0][:, 0]

    def write(self, block: Block, x: Array, part: slice, found: Array, factors: Array) -> None:
        """Write [J r] of N rows, each entry times its factor, into ``found`` (n + 1, k, N)."""
        into = [found[-1:], found[:-1].transpose(1, 0, 2)]
        function = self.functions(block)["jacobian"]
        rows = self._stated(block)[part]
        with phase("evaluation"):
            write_rows(function, [x, self.parameters.nominal], rows, into, factors)

    def slopes_by(self, chosen: np.ndarray, at: Array | None = None) -> list[Array]:
        """Return the slopes (m, c) of each block by chosen parameters (P,), at values (P,) of all [SI] or nominal."""
        nominal = self.parameters.nominal if at is None else at
        alone = replace(self, parameters=replace(self.parameters, nominal=nominal, identified=chosen))
        x = np.zeros(int(chosen.sum()))
        return [alone.of(block, "jacobian", x)[1].reshape(-1, len(x)) for block in self.data.blocks]

    @cached_property
    def owners(self) -> np.ndarray:
        """Number of the row of every equation (m,)."""
        rows = [np.repeat(block.row, len(block.measurement.components)) for block in self.data.blocks]
        return np.concatenate(rows)

    def functions(self, block: Block) -> Functions:
        """Return the functions of a block's rows."""
        if block not in self._structures:
            self._structures[block] = self._structure(block)
        return (self.kept or asked)(self._structures[block], block.measurement)

    @cached_property
    def _structures(self) -> dict[Block, Structure]:
        return {}

    @cached_property
    def _arguments(self) -> dict[Block, Array]:
        return {}

    def _structure(self, block: Block) -> Structure:
        """Return what the functions of a block's rows depend on, besides its measurement."""
        p = self.parameters
        absent = (p.nominal == 0) & ~p.identified
        robot = self.arms[block.robot]
        names = p.names
        if block.robot:  # those of other robots keep their long names, which nobody asks for
            names = tuple(name.removeprefix(f"{block.robot}.") for name in names)
        needs = Needs.of(robot, p.of_robot(block.robot))
        return Structure(
            robot.joint_types, names, p.identified.tobytes(), absent.tobytes(), block.markers, block.fixture,
            loads_of(robot, needs, self.data, block), tuple(robot.model.terms), len(self.arms) > 1,
            self._sessions[block.robot],
        )  # fmt: skip

    def _stated(self, block: Block) -> Array:
        """Return joint values of the model, what the joints bear, sessions and measured values, side by side."""
        if block not in self._arguments:
            robot = self.arms[block.robot]
            joints = (block.q.reshape(-1, block.q.shape[-1]) @ robot.joint_map.T).reshape(len(block.y), -1)
            columns = loads_in(robot, block)
            self._arguments[block] = np.hstack([joints, *columns, self._of_sessions(block), block.y])
        return self._arguments[block]

    @cached_property
    def _sessions(self) -> dict[str, tuple[str, ...]]:
        """The prefixes of the sessions of every robot that shift anything."""
        p = self.parameters
        present = p.take(np.flatnonzero(p.identified | (p.nominal != 0)))
        return {
            robot: tuple(dict.fromkeys(frame_of(name) for name in present.of_robot(robot).names if of_session(name)))
            for robot in self.arms
        }

    def _of_sessions(self, block: Block) -> Array:
        """Return 1 where a row is of a session that shifts anything, (N, sessions)."""
        known = self._sessions[block.robot]
        if not known:
            return np.zeros((len(block.row), 0))
        mine = np.array([session_prefix(name) for name in block.session_names], dtype=object)
        return np.column_stack([mine == prefix for prefix in known]).astype(float)
