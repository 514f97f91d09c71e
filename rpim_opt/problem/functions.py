"""The CasADi functions of a row: residual, Jacobian and modelled values of a measurement, asked anew or kept."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.models import READY, Measurement, of_fixture
from rpim_opt.problem.loads import Loads
from rpim_opt.robot.kinematics import FRAME, chain, frame
from rpim_opt.robot.parameter_names import tool_prefix
from rpim_opt.robot.posture import SYMBOLS, Posture, Symbol
from rpim_opt.robot.terms import Term

Functions = Mapping[str, ca.Function]
"""``residual``, ``jacobian`` and ``modelled`` of one row; inputs are deviations, nominal values and the row."""

transform = Measurement(
    "transform", lambda T: ca.vec(T.T), {f"t{i}{j}": "" for i in range(4) for j in range(4)}, noise={"entry": ""}
)
"""The reflector's transform itself, row by row: what a calibrated robot's forward kinematics evaluate."""

_READY = frozenset({*READY.values(), transform})


class Structure(NamedTuple):
    """What decides the functions of a block's rows besides the measurement.

    ``identified`` and ``absent`` are (P,) true or false as bytes; absent parameters are zero and not identified.
    ``loads`` are what a row states besides joint values, and the gravity that its joints' terms see; ``terms`` are a
    user's own; ``several`` whether other robots have rows, too.
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


class Row(NamedTuple):
    """The symbols and expressions of one row."""

    x: ca.SX
    nominal: ca.SX
    row: ca.SX
    residual: ca.SX
    modelled: ca.SX


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


def asked(structure: Structure, measurement: Measurement) -> Functions:
    """Return the functions of a row.

    Ready measurements are pure, and built once. A user's model or term may read a variable that has changed: it is
    asked anew, and what was built before is taken only when it answers the same expression.

    Raises
    ------
    InputError
        For a residual with more or fewer components than the measurement declares.
    """
    if measurement in _READY and not structure.terms:
        return _ready(structure, measurement)
    with SYMBOLS:
        expressions = _expressions(structure, measurement)
        answer = ca.Function("row", list(expressions[:3]), list(expressions[3:]))
        return _built(answer.serialize())


@lru_cache(maxsize=256)
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
    }


def _expressions(of: Structure, measurement: Measurement) -> Row:
    dof = len(of.joint_types)
    points = len(of.markers)
    free = np.flatnonzero(np.frombuffer(of.identified, dtype=bool))
    zero = np.frombuffer(of.absent, dtype=bool)
    x = ca.SX.sym("x", len(free))
    nominal = ca.SX.sym("nominal", len(of.names))
    loads = of.loads
    q = ca.SX.sym("q", dof * points)
    tau = ca.SX.sym("tau", dof * points if loads.torques else 0)
    payload = ca.SX.sym("payload", 1 if loads.payload else 0)
    approach = ca.SX.sym("approach", dof * points if loads.approach else 0)
    columns = ca.SX.sym("columns", len(loads.columns))
    y = ca.SX.sym("y", len(measurement.columns))
    start = {name: ca.SX(0) if zero[i] else nominal[i] for i, name in enumerate(of.names)}
    deviation = dict.fromkeys(of.names, ca.SX(0))
    deviation.update({of.names[i]: x[k] for k, i in enumerate(free)})

    def place(prefix: str) -> ca.SX:
        return frame([start[prefix + c] for c in FRAME], [deviation[prefix + c] for c in FRAME])

    def value(name: str) -> ca.SX:
        return start[name] + deviation[name] if name in start else ca.SX(0)

    def posture(point: int) -> Posture:
        at = slice(point * dof, (point + 1) * dof)
        joints = ca.vertsplit(q[at])
        return loads.posture(of.joint_types, joints, start.__getitem__, tau, payload, approach, columns, point)

    def reflector(point: int, marker: str) -> ca.SX:
        flange = chain(of.joint_types, posture(point), value, of.terms)
        if measurement.touching and not of.several:  # touches differ by as much wherever the robot stands
            return flange @ place(tool_prefix(marker))
        return place("base_") @ flange @ place(tool_prefix(marker))

    own = {name: place(of_fixture(name + "_", of.fixture)) for name in measurement.frames}
    in_frames = tuple(f"{prefix}_" for prefix in measurement.frames)
    for name in measurement.parameters:
        if not name.startswith(in_frames):
            own[name] = value(of_fixture(name, of.fixture))
    own |= _seen(measurement, loads.named(columns) | _of_joints(q, tau, points))
    transforms = [reflector(point, marker) for point, marker in enumerate(of.markers)]
    modelled = ca.densify(measurement.model(*transforms, **own))
    residual = ca.densify(measurement.minus(y if measurement.columns else 0, modelled))
    if residual.numel() != len(measurement.components):
        found = f"{residual.numel()} components of the residual"
        raise InputError(f"measurement {measurement.name}", found, f"{len(measurement.components)} as it declares")
    return Row(x, nominal, ca.vertcat(q, tau, payload, approach, columns, y), residual, modelled)


def _of_joints(q: ca.SX, tau: ca.SX, points: int) -> dict[str, Symbol]:
    """Return joint values and measured torques, one column a point."""
    found = {"q": ca.reshape(q, -1, points)}
    if tau.numel():
        found["torque"] = ca.reshape(tau, -1, points)
    return found


def _seen(measurement: Measurement, known: Mapping[str, Symbol]) -> dict[str, Symbol]:
    """Return what a measurement sees besides transforms and parameters, by keyword."""
    for name in measurement.sees:
        if name not in known:
            where = f"measurement {measurement.name}"
            raise InputError(where, f"data without '{name}', which it sees", "data that state it in every row")
    return {name: known[name] for name in measurement.sees}
