"""The record of a calibration in its file, there and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.held_out import HeldOut
from rpim_opt.data.record import Earlier, Record
from rpim_opt.data.requirement import Requirement, Side
from rpim_opt.robot.mdh import Robot
from rpim_opt.store.parts import finite
from rpim_opt.store.schema import EarlierPart, HeldOutPart, RecordPart, RequirementPart


def record_part(record: Record) -> dict[str, Any]:
    """Return the record as a file has it; title and data stand elsewhere there."""
    return {
        "source": record.source,
        "files": dict(record.files),
        "excluded": dict(record.excluded),
        "simulated": record.simulated,
        "made": record.made,
        "versions": dict(record.versions),
        "details": dict(record.details),
        "requirement": _requirement_part(record.requirement),
        "held_out": _held_out_part(record.held_out),
        **_earlier_part(record),
    }


def record_of(
    title: str, stated: RecordPart, validation: Dataset | None, digest: str, arms: Mapping[str, Robot]
) -> Record:
    """Return the record that a file with a digest states of some robots."""
    return Record(
        title=title,
        source=stated.source,
        validation=validation,
        files=stated.files,
        excluded=stated.excluded,
        simulated=stated.simulated,
        made=stated.made,
        versions=stated.versions,
        details=stated.details,
        requirement=_requirement(stated.requirement),
        held_out=_held_out(stated.held_out),
        earlier=tuple(_earlier(each, arms) for each in stated.earlier),
        digest=digest,
    )


def _earlier_part(record: Record) -> dict[str, Any]:
    """Return what a calibration carries on; nothing of one that starts from a drawing, as files always were."""
    if not record.earlier:
        return {}
    parts = [each._asdict() for each in record.earlier]
    listed = [{**part, "let_go": list(part["let_go"]), "left_out": list(part["left_out"])} for part in parts]
    return {"earlier": listed}


def _earlier(part: EarlierPart, arms: Mapping[str, Robot]) -> Earlier:
    for name, ranges in part.ranges.items():
        if name not in arms or np.shape(ranges) != (2, arms[name].dof):
            accepted = "the least and the largest value of every joint, of the file's robots"
            raise InputError("key record.earlier", f"ranges of shape {np.shape(ranges)} of robot '{name}'", accepted)
    lists = {"let_go": tuple(part.let_go), "left_out": tuple(part.left_out)}
    return Earlier(part.title, part.made, part.digest, part.rows, part.ranges, part.inflate, **lists)


def _requirement_part(requirement: Requirement | None) -> dict[str, Any] | None:
    if requirement is None:
        return None
    box = None
    if requirement.box is not None:
        box = [list(side) for side in requirement.box]
    return {
        "limit": requirement.limit,
        "box": box,
        "joints": {str(joint): list(side) for joint, side in requirement.joints},
        "marker": requirement.marker,
        "confidence": requirement.confidence,
    }


def _requirement(stated: RequirementPart | None) -> Requirement | None:
    if stated is None:
        return None
    box = None
    if stated.box is not None:
        x, y, z = stated.box
        box = (_side(x), _side(y), _side(z))
    joints = tuple((int(joint), _side(side)) for joint, side in stated.joints.items())
    return Requirement(stated.limit, box, joints, stated.marker, stated.confidence)


def _side(stated: list[float]) -> Side:
    low, high = stated
    return low, high


def _held_out_part(held: HeldOut | None) -> dict[str, Any] | None:
    if held is None:
        return None
    columns = {"nominal": held.nominal, "error": held.error, "sigmas": held.sigmas, "allowed": held.allowed}
    rows = {name: [finite(value) for value in column] for name, column in columns.items()}
    return {"label": list(held.label), "used": held.used, **rows, "coverage": held.coverage}


def _held_out(stated: HeldOutPart | None) -> HeldOut | None:
    if stated is None:
        return None
    return HeldOut(
        tuple(stated.label),
        stated.used,
        nominal=_numbers(stated.nominal),
        error=_numbers(stated.error),
        sigmas=_numbers(stated.sigmas),
        allowed=_numbers(stated.allowed),
        coverage=stated.coverage,
    )


def _numbers(stated: list[float | None]) -> Array:
    return np.array([np.nan if value is None else value for value in stated])
