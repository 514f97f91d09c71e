"""Rows that were kept apart and judged, before the delivered parameters came from them, too."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rpim_opt.basics.arrays import Array


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Errors on rows that a calibration did not see, kept when these rows are used in their turn.

    They validate the procedure: data, model, formulation and weight rule. The parameters that are delivered come from
    all rows.

    Parameters
    ----------
    label
        N labels of the rows that were kept apart.
    used
        How many rows the parameters that were judged came from.
    nominal, error
        (N,) errors before and after [m]; NaN for rows that measure no length.
    sigmas, allowed
        (N,) as of `Validation`: the residual in standard deviations of its prediction, and what of it is allowed; NaN
        where there is no covariance.
    coverage
        Share of the lengths that lay in the 95 % interval of a reading; None without covariance.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> result = ro.calibration.refit_all(instance.calibrate())
    >>> held_out = result.record.held_out
    >>> len(held_out.label), held_out.used, len(result.problem.data)
    (40, 40, 80)
    """

    label: tuple[str, ...]
    used: int
    nominal: Array
    error: Array
    sigmas: Array
    allowed: Array
    coverage: float | None = None

    def sentence(self, rows: int) -> str:
        """Say what validated, and what the parameters come from: so many rows.

        >>> import rpim_opt as ro
        >>> result = ro.calibration.refit_all(ro.load("position").calibrate())
        >>> print(result.record.held_out.sentence(80).partition(":")[0])
        Validated on 40 rows that were kept apart
        """
        missed = f"{1e3 * np.nanmean(self.error):.4f} mm"
        return (
            f"Validated on {len(self.label)} rows that were kept apart: parameters from the {self.used} others missed "
            f"them by {missed} in the mean. The parameters given here come from all {rows}."
        )
