"""What a result file says of a calibration: everything that its figures follow from."""

from __future__ import annotations

import json
from collections.abc import Mapping
from hashlib import sha256
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.statistics import statistics
from rpim_opt.calibration.acceptance import accept
from rpim_opt.calibration.outcome import Kept
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.store.definition import defined, definition, forms
from rpim_opt.store.figures import figures, sets
from rpim_opt.store.learned_parts import learned_part, scatter_part
from rpim_opt.store.parts import data_part, finite, parameters_part, robots_part, selection_part
from rpim_opt.store.record_part import record_part
from rpim_opt.store.schema import FORMAT, VERSION


def content(result: Calibration) -> dict[str, Any]:
    """Return what a file says of a calibration: its figures, then all that they follow from, and the digest of both.

    The figures that a reader looks for are in mm and degrees, what they follow from is in SI.
    """
    record = result.record.dated()
    data = sets(result.problem.data, record)
    parts = {
        "format": FORMAT,
        "version": VERSION,
        "title": record.title,
        **derived(result),
        "x": result.x.tolist(),
        "certificate": _certificate(result),
        "trust": _trust(result),
        "held": [held._asdict() for held in result.held],
        "prices": [price._asdict() for price in result.prices],
        "history": [{**vars(each)} for each in result.history],
        "selection": selection_part(result.selection),
        "definition": definition(result.formulation),
        "forms": forms(result),
        **robots_part(result.problem.arms),
        "model": parameters_part(result.problem.parameters),
        "data": {name: data_part(part) for name, part in data.items()},
        "scatter": scatter_part(result.problem.scatter),
        "learned": learned_part(result.learned),
        "record": record_part(record),
        "acceptance": acceptance_part(result),
    }
    return {**parts, "digest": digest(parts)}


def acceptance_part(result: Calibration) -> dict[str, Any] | None:
    """Return the verdict of what the record requires, or None where nothing is required."""
    if result.record.requirement is None:
        return None
    return accept(result).content()


def digest(parts: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a file's content without its digest, however it is laid out and ordered."""
    content = {key: value for key, value in parts.items() if key != "digest"}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return sha256(text.encode()).hexdigest()


def derived(result: Calibration) -> dict[str, Any]:
    """Return the figures of a file that follow from its data and parameters: they are computed anew where it is read.

    Those are what a reader looks for first, and the errors before and after, also row by row.
    """
    data = sets(result.problem.data, result.record)
    return {
        **figures(result),
        "nominal": {name: statistics(result.nominal_errors(part)) for name, part in data.items()},
        "rows": {name: _rows(result, part) for name, part in data.items()},
    }


def _rows(result: Calibration, data: Dataset) -> list[dict[str, Any]]:
    before = 1e3 * result.nominal_errors(data)
    after = 1e3 * result.errors(data)
    rows = zip(data.label, before, after, strict=True)
    return [{"label": label, "nominal_mm": finite(b), "identified_mm": finite(a)} for label, b, a in rows]


def _certificate(result: Calibration) -> dict[str, Any]:
    found = result.certificate
    return {**found._asdict(), "step": finite(found.step), "violation": finite(found.violation)}


def _trust(result: Calibration) -> dict[str, Any] | None:
    """Return what a loss of a script made of the rows; a ready one says it again when it is asked."""
    if defined(result.formulation):
        return None
    if result.kept is not None:
        return _kept(result.kept)
    try:
        trust = result.program.trust(result.z)
    except InputError:  # a loss that no squared one stands for
        return None
    if trust is None:
        return None
    left_out = np.flatnonzero(~trust.keeps(result.program.model, result.z))
    return {"factor": float(np.sqrt(trust.factor)), "left_out": left_out.tolist()}


def _kept(kept: Kept) -> dict[str, Any] | None:
    """Return what an earlier file said of it."""
    if kept.linear is None:
        return None
    return {"factor": float(np.sqrt(kept.factor)), "left_out": list(kept.left_out)}
