"""What a file keeps of a calibration: everything that its figures follow from, in SI and with every digit."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Annotated, Any, Literal

import cvxpy as cp
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from rpim_opt.constraints import at_nominal, by_kind, by_link, differences, equal, in_ball, signed, within_tolerance
from rpim_opt.dataset import Block, Dataset
from rpim_opt.exceptions import InputError, NoSolutionFound, choices
from rpim_opt.formulation import Formulation, huber, lost
from rpim_opt.measurement import Measurement
from rpim_opt.parameters import Parameters
from rpim_opt.robot import Array, Robot
from rpim_opt.selection import Selection

FORMAT, VERSION = "rpim-opt result", 1
PACKAGES = ("rpim-opt", "numpy", "scipy", "casadi", "cvxpy-base", "clarabel")
READY = {
    "sum_squares": cp.sum_squares, "sum": cp.sum, "max": cp.max, "norm1": cp.norm1, "norm2": cp.norm2,
    "within_tolerance": within_tolerance, "by_link": by_link, "by_kind": by_kind,
}  # fmt: skip
"""Functions of a formulation that a file names; those that the next ones make are named with their arguments."""
MAKERS = {f.__name__: f for f in (huber, at_nominal, signed, equal, in_ball, differences)}


@dataclass(frozen=True, eq=False)
class Record:
    """Where a calibration's data come from, and what was kept apart.

    Parameters
    ----------
    title, source
        What was calibrated, and where every figure comes from.
    validation
        Measurements that no step of the calibration saw.
    files
        SHA-256 of the input files, by name.
    excluded
        Rows that were left out, label to reason.
    simulated
        Whether the measurements are simulated.
    made
        When, UTC (ISO 8601).
    versions
        Of the packages that made it, by name.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> record = ro.Record("Cell 7", source="Tracker campaign of May", excluded={"P17": "reflector bumped"})
    >>> record.made, sorted(record.dated().versions)[:3]
    ('', ['casadi', 'clarabel', 'cvxpy-base'])
    """

    title: str = ""
    source: str = ""
    validation: Dataset | None = None
    files: Mapping[str, str] = field(default_factory=dict)
    excluded: Mapping[str, str] = field(default_factory=dict)
    simulated: bool = False
    made: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)

    def dated(self) -> Record:
        """Return the record with today's date and versions, unless it has some."""
        if self.made:
            return self
        versions = {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}
        return replace(self, made=datetime.now(UTC).isoformat(timespec="seconds"), versions=versions)


# --- the file ----------------------------------------------------------------------------------------------


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False)


Vector = list[float]
Matrix = list[Vector]
Cube = list[Matrix]
Term = str | list[Any] | None
"""A ready function by its name, or by that of its maker and the arguments; None for one that only a script has."""


class _RobotPart(_Part):
    name: str
    source: str
    mdh: Matrix
    joint_types: list[str]
    joint_map: Matrix
    limits: list[Annotated[list[float | None], Field(min_length=2, max_length=2)]]


class _ParameterPart(_Part):
    name: str
    dimension: str
    nominal: float
    scale: float
    tolerance: float | None
    identified: bool


class _BlockPart(_Part):
    measurement: str
    markers: list[str]
    fixture: str
    row: list[int]
    q: Cube
    y: Matrix
    covariance: Cube
    torque: Cube | None


class _DataPart(_Part):
    label: list[str]
    configuration: list[int]
    blocks: list[_BlockPart]


class _SetsPart(_Part):
    identification: _DataPart
    validation: _DataPart | None = None


class _SelectionPart(_Part):
    weight: float
    name: str
    weights: Vector
    score: list[float | None]
    interior: bool
    note: str


class _DefinitionPart(_Part):
    loss: Term
    penalty: Term
    constraints: list[Term]
    loss_over: str
    penalty_over: Term
    largest: float | None


class _PassPart(_Part):
    objective: float
    step: float
    weight: float
    radius: float | None


class _TrustPart(_Part):
    """What a loss of a script made of the equations: a factor, and those that it left out."""

    factor: float
    left_out: list[int]


class _CertificatePart(_Part):
    gradient: float | None
    step: float
    violation: float


class _HeldPart(_Part):
    name: str
    bound: float
    multiplier: float
    gain: float


class _RecordPart(_Part):
    source: str
    files: dict[str, str]
    excluded: dict[str, str]
    simulated: bool
    made: str
    versions: dict[str, str]


class _RowPart(_Part):
    label: str
    nominal_mm: float | None
    identified_mm: float | None


class File(_Part):
    """A result file; what it holds besides follows from this."""

    format: Literal["rpim-opt result"]
    version: Literal[1]
    title: str
    formulation: str
    definition: _DefinitionPart
    weight: float
    selection: _SelectionPart | None
    converged: bool
    message: str
    history: list[_PassPart]
    x: Vector
    certificate: _CertificatePart | None
    trust: _TrustPart | None
    held: list[_HeldPart]
    robot: _RobotPart
    model: list[_ParameterPart]
    data: _SetsPart
    record: _RecordPart
    rows: dict[str, list[_RowPart]]


# --- to the file -------------------------------------------------------------------------------------------


def content(result: Any) -> dict[str, Any]:
    """Return what a file says of a `Calibration`.

    First the figures that a reader looks for, in mm and degrees; then what they follow from, in SI. Numbers are
    written with the fewest digits that read back to the same bits; null stands for infinite.
    """
    record: Record = result.record.dated()
    data = {"identification": result.problem.data}
    data |= {"validation": record.validation} if record.validation else {}
    formulation: Formulation = result.formulation
    return {
        "format": FORMAT,
        "version": VERSION,
        "title": record.title,
        "nominal": {name: statistics(result.nominal_errors(part)) for name, part in data.items()},
        "identification": statistics(result.errors()),
        "validation": statistics(result.errors(record.validation)) if record.validation else None,
        "weight": result.weight,
        "selector": result.selector,
        "corner": bool(result.selection.interior) if result.selection else None,
        "formulation": formulation.name,
        "converged": result.converged,
        "message": result.message,
        "iterations": len(result.history),
        "flagged": [flag.label for flag in result.flagged],
        "parameters": result.parameter_rows(),
        "rows": {name: _rows(result, part) for name, part in data.items()},
        "x": result.x.tolist(),
        "certificate": _certificate(result),
        "trust": None if defined(formulation) else _trust(result),
        "held": [held._asdict() for held in result.held],
        "history": [{**vars(it), "radius": _finite(it.radius)} for it in result.history],
        "selection": _selection(result.selection),
        "definition": definition(formulation),
        "robot": _robot(result.problem.robot),
        "model": _parameters(result.problem.parameters),
        "data": {name: _data(part) for name, part in data.items()},
        "record": {
            "source": record.source, "files": dict(record.files), "excluded": dict(record.excluded),
            "simulated": record.simulated, "made": record.made, "versions": dict(record.versions),
        },
    }  # fmt: skip


def statistics(errors: Array, unit: Literal["mm", "mrad"] = "mm") -> dict[str, Any]:
    """Return mean, RMS, largest [mm or mrad] and number of errors [m or rad]; None where none is a number."""
    of = 1e3 * errors[np.isfinite(errors)]
    if not len(of):
        return {f"mean_{unit}": None, f"rms_{unit}": None, f"max_{unit}": None, "count": 0}
    rms = float((of**2).mean() ** 0.5)
    return {f"mean_{unit}": float(of.mean()), f"rms_{unit}": rms, f"max_{unit}": float(of.max()), "count": len(of)}


def _rows(result: Any, data: Dataset) -> list[dict[str, Any]]:
    before, after = 1e3 * result.nominal_errors(data), 1e3 * result.errors(data)
    rows = zip(data.label, before, after, strict=True)
    return [{"label": label, "nominal_mm": _finite(b), "identified_mm": _finite(a)} for label, b, a in rows]


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _certificate(result: Any) -> dict[str, Any] | None:
    try:
        return result.certificate._asdict()
    except NoSolutionFound:  # the last program was solved in a trust region only
        return None


def _trust(result: Any) -> dict[str, Any] | None:
    try:
        kept = np.any(result.linear.A != 0, axis=1)
    except InputError:  # a loss that no squared one stands for
        return None
    return {"factor": float(np.sqrt(result._factor)), "left_out": np.flatnonzero(~kept).tolist()}


def _selection(selection: Selection | None) -> dict[str, Any] | None:
    if selection is None:
        return None
    score = [_finite(v) for v in selection.score]
    tried, interior = [float(w) for w in selection.weights], bool(selection.interior)
    return {**vars(selection), "weights": tried, "score": score, "interior": interior}


def _term(function: Any) -> Term:
    """Return what names a function of a formulation; None for one of a script."""
    name = next((name for name, ready in READY.items() if ready is function), None)
    return name or getattr(function, "stated", None)


def definition(f: Formulation) -> dict[str, Any]:
    """Return the terms of a formulation by the names of ready-made functions; None for those of a script."""
    return {
        "loss": _term(f.loss),
        "penalty": "none" if f.penalty is None else _term(f.penalty),
        "constraints": [_term(c) for c in f.constraints],
        "loss_over": f.loss_over,
        "penalty_over": "none" if f.penalty_over is None else _term(f.penalty_over),
        "largest": _finite(f.largest),
    }


def defined(formulation: Formulation) -> bool:
    """Whether a file can hold a formulation: all its functions are ready-made."""
    parts = definition(formulation)
    return None not in (parts["loss"], parts["penalty"], parts["penalty_over"], *parts["constraints"])


def _robot(robot: Robot) -> dict[str, Any]:
    limits = [[_finite(v) for v in pair] for pair in robot.limits]
    return {
        "name": robot.name, "source": robot.source, "mdh": robot.mdh.tolist(), "joint_types": list(robot.joint_types),
        "joint_map": robot.joint_map.tolist(), "limits": limits,
    }  # fmt: skip


def _parameters(p: Parameters) -> list[dict[str, Any]]:
    rows = zip(p.names, p.dimensions, p.nominal, p.scale, p.tolerance, p.identified, strict=True)
    return [
        {
            "name": n, "dimension": d, "nominal": float(v), "scale": float(s), "tolerance": _finite(t),
            "identified": bool(i),
        }
        for n, d, v, s, t, i in rows
    ]  # fmt: skip


def _data(data: Dataset) -> dict[str, Any]:
    blocks = [
        {
            "measurement": b.measurement.name, "markers": list(b.markers), "fixture": b.fixture, "row": b.row.tolist(),
            "q": b.q.tolist(), "y": b.y.tolist(), "covariance": b.covariance.tolist(),
            "torque": None if b.torque is None else b.torque.tolist(),
        }
        for b in data.blocks
    ]  # fmt: skip
    return {"label": list(data.label), "configuration": data.configuration.tolist(), "blocks": blocks}


# --- and back ----------------------------------------------------------------------------------------------


def _array(values: Any, where: str, *shape: int) -> Array:
    """Return numbers as an array of a shape (-1: any length), or say that they are none."""
    try:
        array = np.array(values, dtype=float)
    except ValueError:
        raise InputError(where, "rows of different lengths", f"shape {shape}") from None
    if array.ndim != len(shape) or any(want not in (-1, have) for want, have in zip(shape, array.shape, strict=True)):
        raise InputError(where, f"shape {array.shape}", f"shape {shape}")
    return array


def robot_of(part: _RobotPart) -> Robot:
    """Return the robot that a file holds."""
    limits = [[-np.inf if a is None else a, np.inf if b is None else b] for a, b in part.limits]
    mdh, joints = _array(part.mdh, "key robot.mdh", -1, 5), len(part.mdh)
    joint_map = _array(part.joint_map, "key robot.joint_map", joints, joints)
    return Robot(part.name, mdh, tuple(part.joint_types), joint_map, np.array(limits), part.source)


def parameters_of(parts: list[_ParameterPart]) -> Parameters:
    """Return the model parameters that a file holds."""
    return Parameters(
        tuple(p.name for p in parts),
        tuple(p.dimension for p in parts),
        np.array([p.nominal for p in parts]),
        np.array([p.scale for p in parts]),
        np.array([np.inf if p.tolerance is None else p.tolerance for p in parts]),
        np.array([p.identified for p in parts]),
    )


def data_of(part: _DataPart, known: Mapping[str, Measurement]) -> Dataset:
    """Return the measurements that a file holds, with the measurement models of these names."""
    blocks = []
    for i, b in enumerate(part.blocks, start=1):
        if b.measurement not in known:
            accepted = f"measurements=[...] with it, or {choices(b.measurement, known)}"
            raise InputError(f"key data.blocks {i}.measurement", f"'{b.measurement}'", accepted)
        kind, N, where = known[b.measurement], len(b.row), f"key data.blocks {i}"
        if len(b.markers) != kind.points:
            raise InputError(f"{where}.markers", f"{len(b.markers)} reflectors", f"{kind.points}, one a point")
        k, cubes = len(kind.components), {"q": b.q, "torque": b.torque}
        given = {n: _array(v, f"{where}.{n}", N, kind.points, -1) for n, v in cubes.items() if v is not None}
        y = _array(b.y, f"{where}.y", N, len(kind.columns))
        covariance = _array(b.covariance, f"{where}.covariance", -1, k, k)
        blocks.append(
            Block(kind, given["q"], y, covariance, np.array(b.row), tuple(b.markers), b.fixture, given.get("torque"))
        )
    rows = sorted(row for b in part.blocks for row in b.row)
    if rows != list(range(len(part.label))) or len(part.configuration) != len(part.label):
        raise InputError("key data", f"{len(part.label)} labels for other rows", "one label and configuration a row")
    return Dataset(tuple(blocks), tuple(part.label), np.array(part.configuration))


def selection_of(part: _SelectionPart | None) -> Selection | None:
    """Return the choice of the weight that a file holds."""
    if part is None:
        return None
    score = np.array([np.inf if v is None else v for v in part.score])
    return Selection(part.weight, part.name, np.array(part.weights), score, part.interior, part.note)


def formulation_of(name: str, part: _DefinitionPart) -> Formulation:
    """Return the formulation that a file holds; one that cannot be solved where it names functions of a script."""
    terms = [part.loss, part.penalty, part.penalty_over, *part.constraints]
    loss, penalty, over, *constraints = (_function(term, name) for term in terms)
    return Formulation(
        name, loss, penalty, tuple(constraints), part.loss_over, over,
        np.inf if part.largest is None else part.largest, solvable=None not in terms,
    )  # fmt: skip


def _function(term: Term, name: str) -> Any:
    if term is None:
        return lost(name)
    if term == "none":
        return None
    key, arguments = (term, []) if isinstance(term, str) else (term[0], term[1:])
    known = READY if isinstance(term, str) else MAKERS
    if key not in known:
        raise InputError("key definition", f"'{key}'", choices(str(key), known))
    return known[key](*arguments) if known is MAKERS else known[key]
