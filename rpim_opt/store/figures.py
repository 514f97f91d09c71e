"""What a reader of a result looks for first: sets of measurements and their errors, the weight, the parameters."""

from __future__ import annotations

from typing import Any

from rpim_opt.basics.statistics import statistics
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.held_out import HeldOut
from rpim_opt.data.record import Record


def figures(result: Calibration) -> dict[str, Any]:
    """Return what a reader looks for first: errors [mm], the weight and where it came from, the parameters."""
    validation = result.record.validation
    return {
        "identification": statistics(result.errors()),
        "validation": None if validation is None else statistics(result.errors(validation)),
        "held_out": _held_out(result.record.held_out),
        "weight": result.weight,
        "selector": result.selector,
        "corner": None if result.selection is None else bool(result.selection.interior),
        "formulation": result.formulation.name,
        "converged": result.converged,
        "message": result.message,
        "iterations": len(result.history),
        "flagged": result.doubted,
        "parameters": result.parameter_rows(),
    }


def _held_out(held: HeldOut | None) -> dict[str, Any] | None:
    """Return what rows showed that were kept apart before they were used, and how many were used till then."""
    if held is None:
        return None
    return {"nominal": statistics(held.nominal), "identified": statistics(held.error), "used": held.used}


def sets(identification: Dataset, record: Record) -> dict[str, Dataset]:
    """Return the measurements by name: those of the identification, and those that were kept apart."""
    data = {"identification": identification}
    if record.validation is not None:
        data["validation"] = record.validation
    return data
