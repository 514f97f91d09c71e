"""CasADi functions of a measured row, and the joint loads that they depend on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.data.measurements.measurement import Measurement, of_fixture
from rpim_opt.data.measurements.registry import READY
from rpim_opt.robot.extensions import Statics
from rpim_opt.robot.kinematics import FRAME, chain, placed, product, translation
from rpim_opt.robot.mdh import Gravity, Robot
from rpim_opt.robot.parameters import EXPANSION, REFERENCE, Parameters, of_term, tool_prefix
from rpim_opt.robot.terms import SYMBOLS, Configuration, Dependencies, Symbol, Term, Weight, dependencies

Functions = Mapping[str, ca.Function]
"""``residual``, ``jacobian``, ``modelled``, ``metres`` of a row; arguments are deviations, nominal values, the row."""

transform = Measurement(
    "transform", lambda T: ca.vec(T.T), {f"t{i}{j}": "" for i in range(4) for j in range(4)}, noise={"entry": ""}
)
"""The reflector's transform itself, row by row, as evaluated by a calibrated robot's forward kinematics."""

MANY = 1024  # functions kept, some hundred kB each; each reflector has its own
_READY = frozenset({*READY.values(), transform})


class Structure(NamedTuple):
    """Properties of a block that determine the functions of its rows besides the measurement.

    ``identified`` and ``absent`` are (P,) true or false as bytes; absent parameters are zero and not identified.
    ``loads`` are the quantities of a row besides joint values, and the gravity of its joints' terms; ``terms`` are
    user-defined; ``several`` states whether other robots have rows; ``sessions`` are prefixes of session offsets, each
    with a column that is 1 for rows of that session.
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


Kept = dict[tuple[Structure, Measurement], Functions]
"""A user's functions as first built: their variables may have other values later, or in another process."""


def row_functions(structure: Structure, measurement: Measurement, kept: Kept) -> Functions:
    """Return the functions of a row, built once; those of a user's measurement types and terms are kept in ``kept``."""
    if measurement in _READY and all(term.ready for term in structure.terms):  # they depend on nothing else
        return _ready(structure, measurement)
    if (structure, measurement) not in kept:
        kept[structure, measurement] = _built(structure, measurement)
    return kept[structure, measurement]


def _built(structure: Structure, measurement: Measurement) -> Functions:
    with SYMBOLS:
        inputs, (residual, modelled, metres) = _expressions(structure, measurement)
        # evaluated rows are transposed: derivatives by x are in rows
        transposed = ca.densify(-ca.jacobian(residual, inputs[0]).T)
        return {
            "residual": ca.Function("residual", inputs, [residual]),
            "jacobian": ca.Function("jacobian", inputs, [residual, transposed]),
            "modelled": ca.Function("modelled", inputs, [modelled]),
            "metres": ca.Function("metres", inputs, [metres]),
        }


_ready = lru_cache(maxsize=MANY)(_built)


class _Parameters:
    """The parameters of a row by name: symbols are made at first use, since a row depends on few of many."""

    def __init__(self, of: Structure) -> None:
        there = np.flatnonzero(~np.frombuffer(of.absent, dtype=bool))
        free = np.flatnonzero(np.frombuffer(of.identified, dtype=bool))
        self._start = {of.names[i]: int(i) for i in there}  # nonzero or identified nominal values
        self._free = {of.names[i]: k for k, i in enumerate(free)}
        self.x = ca.SX.sym("x", len(self._free))
        self.nominal = ca.SX.sym("nominal", len(of.names))

    def start(self, name: str) -> Symbol:
        """Return the nominal value, zero where there is none of this name."""
        return self.nominal[self._start[name]] if name in self._start else 0.0

    def deviation(self, name: str) -> Symbol:
        """Return the deviation, zero where it is not identified."""
        return self.x[self._free[name]] if name in self._free else 0.0

    def value(self, name: str) -> Symbol:
        """Return the sum of both."""
        return self.start(name) + self.deviation(name)

    def frame(self, prefix: str) -> list[ca.SX]:
        """Return the factors of the frame whose six parameters begin with a prefix."""
        names = [prefix + component for component in FRAME]
        return placed([self.start(name) for name in names], [self.deviation(name) for name in names])

    def chosen(self, prefixes: tuple[str, ...], chosen: ca.SX) -> list[ca.SX]:
        """Return the factors of one of several frames, whose entry of ``chosen`` is 1; the identity where all are 0."""
        start, moved = (
            [ca.dot(chosen, ca.vertcat(*(of(prefix + component) for prefix in prefixes))) for component in FRAME]
            for of in (self.start, self.deviation)
        )
        return placed(start, moved)


def _expressions(of: Structure, measurement: Measurement) -> tuple[list[ca.SX], list[ca.SX]]:
    """Return deviations, nominal values and the row; residual, modelled values, and metres of a residual of one."""
    p = _Parameters(of)
    points = len(of.markers)
    symbols = of.loads.symbols(len(of.joint_types), points)
    session = ca.SX.sym("session", len(of.sessions))
    y = ca.SX.sym("y", len(measurement.columns))
    # every point's reflector in the measuring frame
    transforms = []
    for point, marker in enumerate(of.markers):
        configuration = of.loads.configuration(of.joint_types, p.start, symbols, point)
        factors = []
        if of.several or not measurement.touching:  # touches of one robot differ equally for any base
            factors += p.frame("base_")
        if of.sessions:
            factors += p.chosen(of.sessions, session)
        flange = chain(of.joint_types, configuration, p.value, of.terms)
        temperature = configuration.columns.get("temperature")
        if temperature is not None:  # all lengths expand: the flange's distance from the base, too
            growth = p.value(EXPANSION) * (temperature - p.value(REFERENCE))
            factors.append(translation(*ca.vertsplit(growth * product(flange)[:3, 3])))
        transforms.append(product([*factors, *flange, *p.frame(tool_prefix(marker))]))
    # frames, parameters and columns passed to the model by name
    own: dict[str, Symbol] = {name: product(p.frame(of_fixture(name + "_", of.fixture))) for name in measurement.frames}
    in_frames = tuple(f"{prefix}_" for prefix in measurement.frames)
    for name in measurement.parameters:
        if not name.startswith(in_frames):
            own[name] = p.value(of_fixture(name, of.fixture))
    known = {name: ca.reshape(symbols[name], -1, points) for name in ("q", "torque") if name in symbols}
    known |= columns_of(symbols)
    for name in measurement.depends_on:
        if name not in known:
            where = f"measurement {measurement.name}"
            raise InputError(where, f"data without '{name}', on which it depends", "data that state it in every row")
        own[name] = known[name]
    modelled = ca.densify(measurement.model(*transforms, **own))
    residual = modelled
    if modelled.numel() == len(measurement.columns) or measurement.components != measurement.columns:
        residual = ca.densify(measurement.minus(y if measurement.columns else 0, modelled))
    if residual.numel() != len(measurement.components):
        found = f"{residual.numel()} components of the residual"
        raise InputError(f"measurement {measurement.name}", found, f"{len(measurement.components)} as it declares")
    metres = ca.SX(1)
    if measurement.metres is not None:
        metres = measurement.metres(*transforms, **own)
    return [p.x, p.nominal, ca.vertcat(*symbols.values(), session, y)], [residual, modelled, ca.densify(metres)]


RowSymbols = Mapping[str, ca.SX]
"""Symbols of a row's quantities per joint, point by point, in the order of `loads_in`."""
PER_JOINT = ("q", "torque", "approach")  # a row's quantities per joint
COLUMN = "column "  # prefix of a further column among a row's quantities


class Loads(NamedTuple):
    """Joint loads in the rows; ``gravity`` where a term needs it, ``weighs`` where it replaces measured torques."""

    stated: tuple[str, ...] = ()
    gravity: Gravity | None = None
    weighs: bool = False

    def symbols(self, dof: int, points: int) -> RowSymbols:
        """Return the symbols of a row of some points."""
        counts = {name: dof * points if name in PER_JOINT else 1 for name in ("q", *self.stated)}
        return {name: ca.SX.sym(name, count) for name, count in counts.items()}

    def configuration(
        self, joint_types: Sequence[str], nominal: Callable[[str], Symbol], stated: RowSymbols, point: int = 0
    ) -> Configuration:
        """Return the state of an arm of nominal parameters at a point of a row, from the row's symbols."""
        dof = len(joint_types)
        at = slice(point * dof, (point + 1) * dof)
        parts = {name: ca.vertsplit(stated[name][at]) for name in PER_JOINT if name in stated}
        torque = parts.get("torque")
        if torque is None and not self.weighs:
            torque = [0.0] * dof
        weight = Weight()
        if self.gravity is not None:
            payload = stated.get("payload", self.gravity.payload)
            weight = Statics(payload, joint_types=joint_types, q=parts["q"], nominal=nominal, gravity=self.gravity)
        return Configuration(parts["q"], torque, parts.get("approach"), weight, columns_of(stated))


def columns_of(stated: RowSymbols) -> dict[str, Symbol]:
    """Return the symbols of further columns by name."""
    return {name.removeprefix(COLUMN): symbol for name, symbol in stated.items() if name.startswith(COLUMN)}


def stated_in(block: Block) -> dict[str, Array]:
    """Return what the rows of a block state of their joints besides joint values, by name."""
    stated = {"torque": block.torque, "payload": block.payload, "approach": block.approach}
    stated |= {COLUMN + name: values for name, values in block.columns.items()}
    return {name: values for name, values in stated.items() if values is not None}


def needed(robot: Robot, parameters: Parameters) -> Dependencies:
    """Return the inputs of a row that a robot's identified or nonzero parameters depend on."""
    used = parameters.identified | (parameters.nominal != 0)
    names = {parameters.names[i] for i in np.flatnonzero(used)}
    of_arms = [name for name in names if of_term(name)]
    needs = dependencies(robot.model, robot.joint_types, names.__contains__)
    return needs._replace(
        torques=needs.torques or any(name.startswith("compliance") for name in of_arms),
        moments=any(name.startswith("moment") for name in of_arms),
    )


def measured_torques(data: Dataset, robot: str = "") -> bool:
    """Return whether a robot's data have torques, which then replace those of gravity in all rows."""
    return any(block.torque is not None for block in data.blocks if block.robot == robot)


def loads_of(robot: Robot, needs: Dependencies, data: Dataset, block: Block) -> Loads:
    """Return the joint loads stated in the rows of a block, and those to compute from gravity."""
    weighs = needs.torques and not measured_torques(data, block.robot)
    return Loads(tuple(stated_in(block)), robot.gravity if weighs or needs.gravity or needs.moments else None, weighs)


def loads_on(robot: Robot, parameters: Parameters, data: Dataset, torques: bool) -> Loads:
    """Return the loads of commands to be compensated: torques, or a payload if torques are from gravity."""
    needs = needed(robot, parameters)
    if needs.columns:
        accepted = "a calibration without it: its value at the corrected commands is unknown"
        raise InputError("compensation", f"a term that depends on column '{min(needs.columns)}'", accepted)
    weighs = needs.torques and not measured_torques(data)
    gravity = robot.gravity if weighs or needs.gravity or needs.moments else None
    stated = {"torque": torques, "payload": weighs or needs.gravity}
    return Loads(tuple(name for name, there in stated.items() if there), gravity, weighs)


def loads_in(robot: Robot, block: Block) -> list[Array]:
    """Return what rows state of the joints of the model, (N, c) each, in the order of `Loads.symbols`."""
    inputs = {"q": block.q @ robot.joint_map.T, **stated_in(block)}
    if block.torque is not None:  # virtual work: tau_model = M^-T tau
        if robot.dof < len(robot.mdh):
            raise InputError("joint torques", "those of a robot with mimic joints", "a table without torques")
        inputs["torque"] = block.torque @ np.linalg.inv(robot.joint_map)
    if block.approach is not None:
        inputs["approach"] = np.sign(block.approach @ robot.joint_map.T)
    return [values.reshape(len(block.y), -1) for values in inputs.values()]


def require_loads(robot: Robot, parameters: Parameters, blocks: Sequence[Block]) -> None:
    """Refuse to identify from rows of a robot what needs columns that they do not have."""
    ready = all(term.ready for term in robot.model.terms)
    for name in parameters.free.names:
        sided = name.startswith("backlash") and of_term(name)
        if not sided and not ready:
            sided = dependencies(robot.model, robot.joint_types, lambda other, name=name: other == name).approach
        if sided and all(block.approach is None for block in blocks):
            found = f"'{name}' without directions of approach"
            raise InputError("key identify", found, "columns approach1, ... (-1, 0 or +1) in the data")
    columns = needed(robot, parameters).columns
    for block in blocks:
        for name in sorted({*columns, *block.measurement.extra} - {*block.columns}):
            accepted = f"a column '{name}' of the table, or Dataset.of(..., columns={{'{name}': ...}})"
            raise InputError("data", f"no column '{name}', on which a term or a measurement depends", accepted)


def require_same_torques(robot: Robot, parameters: Parameters, before: bool, now: bool) -> None:
    """Refuse other torques than a problem has where compliances need them: gravity's are on assumed masses."""
    if before != now and needed(robot, parameters).torques:
        accepted = (
            "columns tau1_Nm, ... in all data or in none: torques computed from gravity differ from measured ones"
        )
        raise InputError("compliances", f"data {'with' if now else 'without'} joint torques", accepted)


def masses_assumed(robot: Robot, parameters: Parameters, data: Dataset) -> bool:
    """Return whether compliances follow from gravity on links whose masses are not stated."""
    return not robot.gravity.masses and not measured_torques(data) and needed(robot, parameters).torques


def require_known_masses(robot: Robot, parameters: Parameters, data: Dataset, payload: Array) -> None:
    """Refuse payloads [kg] that were not measured, where masses of the links are assumed.

    Compliances absorb the error of these masses, but not the payload's.
    """
    if not masses_assumed(robot, parameters, data):
        return
    carried = [robot.gravity.payload if block.payload is None else block.payload for block in data.blocks]
    low, high = min(map(np.min, carried)), max(map(np.max, carried))
    if payload.min() < low or payload.max() > high:
        measured = " to ".join(dict.fromkeys((f"{low:g}", f"{high:g}")))
        found = f"{payload.max():g} kg; measured with {measured} kg, and the masses of the links are assumed"
        accepted = "a payload that was measured, or a calibration with mass_kg and centre_x_mm, ... of the links"
        raise InputError("payload", found, accepted)


def repeated(block: Block) -> np.ndarray:
    """Return numbers (N,) of what rows measured: equal where joint values and the model's columns are equal."""
    seen = [block.columns[name][:, None] for name in block.measurement.depends_on if name in block.columns]
    same = np.hstack([block.q.reshape(len(block.row), -1), *seen]).round(7)
    return np.unique(same, axis=0, return_inverse=True)[1].ravel()  # a column in NumPy 2.0
