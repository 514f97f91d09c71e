"""Checks of a calibrated robot over time, and whether it drifts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import fdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.calibration.causes import misread
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.tables.joining import seconds, time_column
from rpim_opt.use.carried import Carried
from rpim_opt.use.cusum import cumulative, limit
from rpim_opt.use.drifts import likeliest
from rpim_opt.use.innovations import innovations
from rpim_opt.use.monitored import RARE, Monitoring
from rpim_opt.use.validation import read_table

TESTS = 3
"""Questions that checks are asked: each alone, their sum, and every parameter. Each may err by a third of `RARE`."""


class Checks(NamedTuple):
    """Checks that were read: rows, their times (N,) [s] or None, the times as they stand there, columns left out."""

    data: Dataset
    when: Array | None
    times: tuple[str, ...]
    left_out: tuple[str, ...]


def monitor(result: Calibration, data: Dataset, when: Array | None = None, times: tuple[str, ...] = ()) -> Monitoring:
    """Compare checks over time with what a calibration predicts: each alone, and what they miss together.

    A check is judged by the interval of a new reading, with what the calibration and all checks before it leave open;
    what they miss is summed up (Page's CUSUM); and every parameter and frame is tried as one that moved, at once before
    some check or steadily. A robot that does not drift is accused with probability `RARE` in all.

    Parameters
    ----------
    result
        The calibration, with a squared penalty or none; perhaps of `load_result`.
    data
        Check readings in the instrument's frame of the calibration.
    when
        (N,) their times [s]; by default they are in the order of time.
    times
        N texts that say so; numbers of the checks by default.

    Raises
    ------
    InputError
        For times that are not one a check; a result that has no covariance (lasso).

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> found = ro.use.monitor(ro.calibrate(instance.problem), instance.validation)
    >>> found.drifts, found.drift, len(found.sums)
    (False, None, 40)
    """
    count = len(data)
    if when is not None:
        when = np.asarray(when, dtype=float)
        if when.shape != (count,) or not np.isfinite(when).all():
            raise InputError("monitor, when", f"shape {when.shape}", f"{count} finite times [s], one a check")
        order = np.argsort(when, kind="stable")
        data = data.take(order)
        when = when[order]
        if times:
            times = tuple(times[i] for i in order)
    carried = Carried(result)
    problem = carried.problem(replace(data, configuration=_visits(data, when)))
    sizes = np.zeros(count, dtype=int)
    for block in data.blocks:
        sizes[block.row] = len(block.measurement.components)
    rare = RARE / TESTS
    found = innovations(result, problem, rare / count)
    return Monitoring(
        label=data.label,
        times=times,
        when=when,
        error=result.errors(data),
        sigmas=found.sigmas,
        allowed=np.sqrt(sizes * fdtri(sizes, max(result.freedom, 1.0), 1 - rare / count)),
        sums=cumulative(found.deviate),
        limit=limit(count, rare),
        drift=likeliest(carried, problem, rare),
        mistake=misread(result, data),
    )


def _visits(data: Dataset, when: Array | None) -> np.ndarray:
    """Return a number (N,) for every visit to a configuration: a place that is checked again and again is many."""
    changed = np.diff(data.configuration, prepend=data.configuration[0]) != 0
    visit = np.cumsum(changed)
    if when is not None:
        visit = np.unique(when, return_inverse=True)[1]
    return np.unique(np.stack([visit, data.configuration]), axis=1, return_inverse=True)[1].ravel()


def read_checks(result: Calibration, source: Any, measurement: str | None = None, units: str = "") -> Checks:
    """Return check readings of a table with their times, where a column is called time, timestamp or date.

    Parameters
    ----------
    result, source, measurement, units
        As for `read_measurements`.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, ro.l_curve)
    >>> table = {"date": ["2026-03-01", "2026-04-01"], **{f"joint_{i}": [0.0, 10.0] for i in range(1, 7)}}
    >>> table |= {"x": [826.6, 810.0], "y": [98.0, 240.0], "z": [107.0, 254.0]}
    >>> checks = ro.use.read_checks(result, table, units="deg,mm")
    >>> checks.times, float(checks.when[1] - checks.when[0]) / 86400
    (('2026-03-01', '2026-04-01'), 31.0)
    """
    found = read_table(result, source, measurement, units)
    name = time_column(found.raw)
    if name is None:
        return Checks(found.data, None, (), found.left_out)
    cells = list(found.raw[name])
    try:
        when = seconds(name, cells)
    except InputError as error:
        raise error.within(source if isinstance(source, str | Path) else None) from None
    left_out = tuple(each for each in found.left_out if each != name)
    return Checks(found.data, when, tuple(str(cell) for cell in cells), left_out)
