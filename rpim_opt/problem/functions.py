"""The CasADi functions of a row: residual, Jacobian and modelled values of a measurement, asked anew or kept."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.models import READY, Measurement, of_fixture
from rpim_opt.problem.loads import Loads, Stated
from rpim_opt.robot.evaluation import SYMBOLS
from rpim_opt.robot.kinematics import FRAME, chain, placed, product, translation
from rpim_opt.robot.parameter_names import EXPANSION, REFERENCE, tool_prefix
from rpim_opt.robot.posture import Symbol
from rpim_opt.robot.terms import Term

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
    return measurement in _READY and not structure.terms


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
