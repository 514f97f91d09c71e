"""A validated calibration, once more from all rows: what was kept apart has checked the procedure, and is used."""

from __future__ import annotations

from dataclasses import replace

from rpim_opt.basics.exceptions import InputError
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.unseen import judged
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.record import HeldOut


def refit_all(result: Calibration, validation: Dataset | None = None) -> Calibration:
    """Return the calibration from identification and validation rows together, asked as this one was.

    Errors on the rows that were kept apart, which validate the procedure, stay in its record (``held_out``); the
    parameters that are delivered come from all rows. No row is left that checks these alone.

    Parameters
    ----------
    result
        The calibration that was validated.
    validation
        The rows that were kept apart; those of its record by default.

    Raises
    ------
    InputError
        Where no rows were kept apart, or measurements are not in memory.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> result = instance.calibrate()
    >>> everything = ro.calibration.refit_all(result)
    >>> f"{1e3 * everything.record.held_out.error.mean():.3f} mm, then {len(everything.problem.data)} rows"
    '0.024 mm, then 80 rows'
    """
    apart = validation
    if apart is None:
        apart = result.record.validation
    if apart is None:
        raise InputError("validation", "no rows that were kept apart", "a calibration with validation data")
    if not result.stated.keeps_rows:
        raise InputError("refit_all", "measurements in parts", "measurements in memory")
    stated = result.stated
    whole = Dataset.together([stated.data, apart], ["identification", "validation"])
    held_out = HeldOut(
        whole.label[len(stated.data) :],
        len(stated.data),
        result.nominal_errors(apart),
        result.errors(apart),
        *judged(result, apart),
    )
    record = replace(result.record, validation=None, held_out=held_out)
    return replace(result.asked(stated.on(whole)), record=record)
