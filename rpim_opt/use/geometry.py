"""The best geometry alone, for files that hold nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rpim_opt.basics.text import joined
from rpim_opt.calibration.asking import calibrate
from rpim_opt.calibration.result import Calibration


def geometry_alone(result: Calibration) -> tuple[Calibration, list[str]]:
    """Return the calibration without the families that the evidence added, and what that costs in a sentence.

    A file of a robot holds its geometry and nothing that bends it. The geometry of a calibration that knows of gravity
    is not the best one where gravity is left out: the same measurements are calibrated anew.

    Parameters
    ----------
    result
        The calibration. One without such families comes back as it is.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, model="auto")  # no family was added
    >>> ro.use.geometry_alone(result) == (result, [])
    True
    """
    if result.learned is None or not result.learned.added:
        return result, []
    alone = replace(calibrate(result.stated, result.formulation), record=result.record)
    data = result.record.validation
    where = "validation" if data is not None else "identification"
    whole, left = (float(1e3 * np.sqrt(np.nanmean(each.errors(data) ** 2))) for each in (result, alone))
    said = (
        f"Files hold no {joined(result.learned.families)}: written is the geometry that the same measurements give "
        f"without, which leaves {left:.3f} mm RMS on the {where} rows where the whole model leaves {whole:.3f} mm."
    )
    return alone, [said]
