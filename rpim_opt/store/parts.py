"""Robot, parameters, measurements and the weight's choice as parts of a result file, and back.

Numbers are written with the fewest digits that read back to the same bits; null stands for infinite.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.convex.selection import Selection
from rpim_opt.data.dataset import Block, Dataset, named_sessions
from rpim_opt.data.models import Measurement
from rpim_opt.robot.gravity import Gravity
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.open_model import Model
from rpim_opt.robot.parameters import Parameters
from rpim_opt.store.schema import BlockPart, DataPart, File, ParameterPart, RobotPart, SelectionPart


def finite(value: float) -> float | None:
    """Return a number as a file has it: null where it is infinite or none."""
    return float(value) if np.isfinite(value) else None


def robots_part(robots: Mapping[str, Robot]) -> dict[str, Any]:
    """Return the robot, or several by name, under its key of a file."""
    if "" in robots:
        return {"robot": robot_part(robots[""])}
    return {"robots": {name: robot_part(robot) for name, robot in robots.items()}}


def robot_part(robot: Robot) -> dict[str, Any]:
    """Return a robot as a file holds it."""
    return {
        "name": robot.name,
        "source": robot.source,
        "mdh": robot.mdh.tolist(),
        "joint_types": list(robot.joint_types),
        "joint_map": robot.joint_map.tolist(),
        "limits": [[finite(value) for value in pair] for pair in robot.limits],
        "gravity": {key: list(value) if key != "payload" else value for key, value in vars(robot.gravity).items()},
        "terms": terms_part(robot.model, robot.joint_types),
    }


def terms_part(model: Model, joint_types: Sequence[str]) -> list[dict[str, Any]]:
    """Return what a file says of a user's own terms: all but their functions."""
    parts = []
    for term in model.terms:
        names = [name for i in term.places(joint_types) for name in term.names(i)]
        parts.append({"at": term.at, "parameters": names, "columns": dict(term.columns)})
    return parts


def robot_of(part: RobotPart, model: Model) -> Robot:
    """Return the robot that a file holds, with the terms that somebody gives again.

    Raises
    ------
    InputError
        For terms that the file has and nobody gives, and others than it has.
    """
    stated = [each.model_dump() for each in part.terms]
    given = terms_part(model, part.joint_types)
    if stated != given:
        wanted = "; ".join(map(_in_words, stated)) or "none"
        accepted = f"model=ro.Model(terms=[...]) with what the calibration had: {wanted}"
        raise InputError("key robot.terms", "; ".join(map(_in_words, given)) or "no term given", accepted)
    limits = [[-np.inf if a is None else a, np.inf if b is None else b] for a, b in part.limits]
    mdh = _array(part.mdh, "key robot.mdh", -1, 5)
    joints = len(part.mdh)
    joint_map = _array(part.joint_map, "key robot.joint_map", joints, joints)
    types = tuple(part.joint_types)
    return Robot(part.name, mdh, types, joint_map, np.array(limits), part.source, _gravity_of(part), model)


def _in_words(term: Mapping[str, Any]) -> str:
    what = ", ".join(term["parameters"]) or "without parameters"
    seen = "".join(f", column {name} ({dimension or 'no unit'})" for name, dimension in term["columns"].items())
    return f"a term of the {term['at']} ({what}{seen})"


def robots_of(file: File, model: Model | Mapping[str, Model]) -> dict[str, Robot]:
    """Return the robots that a file holds by name, ``""`` for the only one."""
    if (file.robot is None) == (not file.robots):
        raise InputError("key robot", "no robot" if file.robot is None else "one beside several", "robot, or robots")
    if file.robot is not None:
        if not isinstance(model, Model):
            raise InputError("model", "models by name", "a Model, for the one robot of the file")
        return {"": robot_of(file.robot, model)}
    return {name: robot_of(part, _model_of(name, part, model)) for name, part in file.robots.items()}


def _model_of(name: str, part: RobotPart, model: Model | Mapping[str, Model]) -> Model:
    """Return the terms of one of several robots: given by name, or one model for all that have terms."""
    if not isinstance(model, Model):
        return model.get(name, Model())
    if not part.terms:
        return Model()
    return model


def _gravity_of(part: RobotPart) -> Gravity:
    """Return the gravity that a file holds; an older one has none, and nothing that would ask for it."""
    stated = part.gravity
    if stated is None:
        return Gravity()
    centres = tuple((x, y, z) for x, y, z in stated.centres)
    gravity = Gravity(masses=tuple(stated.masses), centres=centres).carrying(stated.payload, stated.payload_centre)
    return gravity.mounted(stated.direction)


def parameters_part(parameters: Parameters) -> list[dict[str, Any]]:
    """Return the model parameters as a file holds them, one entry each."""
    rows = zip(
        parameters.names,
        parameters.dimensions,
        parameters.nominal,
        parameters.scale,
        parameters.tolerance,
        parameters.identified,
        strict=True,
    )
    return [
        {
            "name": name,
            "dimension": dimension,
            "nominal": float(nominal),
            "scale": float(scale),
            "tolerance": finite(tolerance),
            "identified": bool(identified),
        }
        for name, dimension, nominal, scale, tolerance, identified in rows
    ]


def parameters_of(parts: list[ParameterPart], robots: Mapping[str, Robot]) -> Parameters:
    """Return the model parameters that a file holds, of its robots."""
    table = _table_of(parts)
    terms = [(key, name) for key, robot in robots.items() for name in robot.model.names(robot.joint_types)]
    return replace(table, terms=tuple(dict.fromkeys(table.called(key, name) for key, name in terms)))


def _table_of(parts: list[ParameterPart]) -> Parameters:
    return Parameters(
        tuple(p.name for p in parts),
        tuple(p.dimension for p in parts),
        np.array([p.nominal for p in parts]),
        np.array([p.scale for p in parts]),
        np.array([np.inf if p.tolerance is None else p.tolerance for p in parts]),
        np.array([p.identified for p in parts]),
    )


def data_part(data: Dataset) -> dict[str, Any]:
    """Return measurements as a file holds them."""
    return {
        "label": list(data.label),
        "configuration": data.configuration.tolist(),
        "blocks": [_block_part(block) for block in data.blocks],
    }


def _block_part(block: Block) -> dict[str, Any]:
    return {
        "measurement": block.measurement.name,
        "markers": list(block.markers),
        "fixture": block.fixture,
        "row": block.row.tolist(),
        "q": block.q.tolist(),
        "y": block.y.tolist(),
        "covariance": block.covariance.tolist(),
        "torque": _optional(block.torque),
        "payload": _optional(block.payload),
        "approach": _optional(block.approach),
        "columns": {name: values.tolist() for name, values in block.columns.items()},
        "robot": block.robot,
        "point": _optional(block.point),
        "session": _optional(block.session),
    }


def _optional(values: Any) -> Any:
    return None if values is None else values.tolist()


def data_of(part: DataPart, known: Mapping[str, Measurement]) -> Dataset:
    """Return the measurements that a file holds, with the measurement models of these names."""
    blocks = [_block_of(block, known, f"key data.blocks {i}") for i, block in enumerate(part.blocks, start=1)]
    rows = sorted(row for block in part.blocks for row in block.row)
    if rows != list(range(len(part.label))) or len(part.configuration) != len(part.label):
        raise InputError("key data", f"{len(part.label)} labels for other rows", "one label and configuration a row")
    return Dataset(tuple(blocks), tuple(part.label), np.array(part.configuration))


def _block_of(part: BlockPart, known: Mapping[str, Measurement], where: str) -> Block:
    if part.measurement not in known:
        accepted = f"measurements=[...] with it, or {choices(part.measurement, known)}"
        raise InputError(f"{where}.measurement", f"'{part.measurement}'", accepted)
    kind = known[part.measurement]
    if len(part.markers) != kind.points:
        raise InputError(f"{where}.markers", f"{len(part.markers)} reflectors", f"{kind.points}, one a point")
    N = len(part.row)
    k = len(kind.components)
    torque = None
    if part.torque is not None:
        torque = _array(part.torque, f"{where}.torque", N, kind.points, -1)
    payload = None
    if part.payload is not None:
        payload = _array(part.payload, f"{where}.payload", N)
    approach = None
    if part.approach is not None:
        approach = _array(part.approach, f"{where}.approach", N, kind.points, -1)
    point = None
    if part.point is not None:
        point = _points(part.point, f"{where}.point", N, kind.points)
    return Block(
        kind,
        q=_array(part.q, f"{where}.q", N, kind.points, -1),
        y=_array(part.y, f"{where}.y", N, len(kind.columns)),
        covariance=_array(part.covariance, f"{where}.covariance", -1, k, k),
        row=np.array(part.row),
        markers=tuple(part.markers),
        fixture=part.fixture,
        torque=torque,
        payload=payload,
        approach=approach,
        columns={name: _array(values, f"{where}.columns.{name}", N) for name, values in part.columns.items()},
        robot=part.robot,
        point=point,
        session=named_sessions(part.session or (), N),
    )


def _points(names: list[list[str]], where: str, N: int, points: int) -> np.ndarray:
    """Return the names (N, points) of touched points."""
    if len(names) != N or any(len(row) != points for row in names):
        raise InputError(where, f"{len(names)} rows of names", f"{N} rows of {points}")
    return np.array(names, dtype=object).reshape(N, points)


def selection_part(selection: Selection | None) -> dict[str, Any] | None:
    """Return the choice of the weight as a file holds it, with its evidence."""
    if selection is None:
        return None
    return {
        **vars(selection),
        "weights": [float(weight) for weight in selection.weights],
        "score": [finite(value) for value in selection.score],
        "interior": bool(selection.interior),
        "groups": {name: float(weight) for name, weight in selection.groups.items()},
    }


def selection_of(part: SelectionPart | None) -> Selection | None:
    """Return the choice of the weight that a file holds."""
    if part is None:
        return None
    score = np.array([np.inf if value is None else value for value in part.score])
    return Selection(part.weight, part.name, np.array(part.weights), score, part.interior, part.note, part.groups)


def _array(values: Any, where: str, *shape: int) -> Array:
    """Return numbers as an array of a shape (-1: any length), or say that they are none."""
    try:
        array = np.array(values, dtype=float)
    except ValueError:
        raise InputError(where, "rows of different lengths", f"shape {shape}") from None
    if array.ndim != len(shape) or any(want not in (-1, have) for want, have in zip(shape, array.shape, strict=True)):
        raise InputError(where, f"shape {array.shape}", f"shape {shape}")
    return array
