"""Held-out rows: comparison with their prediction intervals, and the final fit to all rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy
from scipy.special import fdtrc

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import three_digits
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import held_out_errors
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.pose import pose, position
from rpim_opt.data.record import UNLIKELY, HeldOut
from rpim_opt.problem.causes.rows import common_rows
from rpim_opt.problem.registration.closed_forms import register, transformed
from rpim_opt.robot.parameters import Parameters, of_session, session_prefix

FEWEST = 5  # fewer held-out rows are too few for a judgement
CHANGED = (
    "If the robot changed, recalibrate by `update`, which names the change; otherwise repeat these measurements, or "
    "extend the model."
)
GROSS = 6.0  # factor on the median distance beyond which a row is excluded from a registration


def rows_used(result: Calibration, data: Dataset) -> dict[str, str]:
    """Return the labels of measurements that are copies of identification rows, with the labels of those."""
    return dict(common_rows(result.problem.sample().data, data))


def coverage_text(held: HeldOut) -> str:
    """Return the coverage of the held-out rows' prediction intervals as text; empty if they have none."""
    if held.coverage is None:
        return ""
    share = f"{100 * held.coverage:.0f} % of the coordinates are within their 95 % prediction intervals"
    return share if held.fit is None else f"{share} ({held.fit})"


def registration(free: Parameters, data: Dataset) -> str:
    """Return the prefix of the frame to register rows by: the base, or a session if only sessions are identified."""
    based = any(name.startswith("base_") for name in free.names)
    return "base_" if based or not any(map(of_session, free.names)) else session_prefix(str(data.session[0]))


def displacement(result: Calibration, data: Dataset, held: HeldOut) -> tuple[str, str]:
    """Return sentences on a common displacement of the measurements, by registration: as mistake or as remark.

    It is reported if rows are outside their prediction intervals, or contradict them together. It is a mistake if a
    motion, with its six degrees of freedom, removes more than half of the RMS error of rows outside their intervals; a
    remark, if its part of the squared errors has p-value below 0.01 (Fisher's F). Otherwise both are empty.
    """
    vectors = result.error_vectors(data)
    rows = np.flatnonzero(np.isfinite(vectors).all(axis=1))
    far = bool((held.sigmas > held.allowed)[rows].any())
    if len(rows) < FEWEST or not (far or held.contradiction):
        return "", ""
    try:
        again, motion = registered(result, data)
    except InputError:  # collinear points
        return "", ""
    squares, left = (float(np.sum(each[rows] ** 2)) for each in (vectors, result.error_vectors(again)))
    freedom = 3 * len(rows) - 6
    before, after = np.sqrt(squares / len(rows)), np.sqrt(3 * left / freedom)
    said = (
        f"The measurements are {motion}; registered again, their RMS error is {1e3 * after:.3g} mm instead of "
        f"{1e3 * before:.3g} mm."
    )
    place = registration(result.problem.parameters.free, data)
    again = f" --reset '{place}*'" * (place == "base_")  # a new session has its own registration
    if far and after <= before / 2:
        return (
            f"{said} If the instrument or the base moved, use --register in `validate`, `monitor` and `accept`, or "
            f"recalibrate by `update{again}`; do not add such rows to the problem's folder. If neither "
            "moved, the robot changed, and --register would hide that."
        ), ""
    if fdtrc(6, freedom, (squares - left) / 6 / (left / freedom)) < UNLIKELY:
        return "", f"{said} If the instrument was moved since the calibration, use --register."
    return "", ""


def registered(result: Calibration, data: Dataset, mine: np.ndarray | None = None) -> tuple[Dataset, str]:
    """Return measurements after the motion of the instrument that registers them best, and that motion in words.

    Positions, poses and their covariances move; lengths do not, nor do rows that are not ``mine`` (N,). The motion has
    six degrees of freedom, and ignores rows beyond six times the median distance. InputError for rows of the
    identification data (they are in the calibration's frame, and could not be recognized after a motion), for fewer
    than three positions, and for collinear points.
    """
    mine = np.full(len(data), True) if mine is None else mine
    if used := rows_used(result, data):
        raise InputError("measurements", f"{len(used)} of {len(data)} rows are identification rows", "new rows only")
    vectors = result.error_vectors(data)
    measured = np.full_like(vectors, np.nan)
    for block in data.blocks:
        if block.measurement.name in (position.name, pose.name):
            measured[block.row] = block.y[:, :3]
    rows = np.flatnonzero(np.isfinite(measured).all(axis=1) & mine)
    measured = measured[rows]
    predicted = measured - vectors[rows]
    first = register(measured, predicted)
    left = np.linalg.norm(predicted - transformed(first, measured), axis=1)
    kept = left <= GROSS * np.median(left)
    motion = register(measured[kept], predicted[kept])
    turn = scipy.spatial.transform.Rotation.from_matrix(motion[:3, :3])
    blocks = []
    for block in data.blocks:
        if block.measurement.name in (position.name, pose.name):
            places = block.y[:, :3]
            moves = np.hstack([transformed(motion, places) - places, np.tile(turn.as_rotvec(), (len(places), 1))])
            parts = np.kron(np.eye(block.covariance.shape[-1] // 3), motion[:3, :3])
            moves = moves[:, : len(block.measurement.components)] * mine[block.row, None]
            covariance = np.where(mine[block.row, None, None], parts @ block.covariance @ parts.T, block.covariance)
            block = replace(block, y=block.measurement.plus(block.y, moves), covariance=covariance)
        blocks.append(block)
    centre = measured.mean(axis=0)
    shift = 1e3 * float(np.linalg.norm(transformed(motion, centre) - centre))
    text = f"displaced as a whole by {three_digits(shift)} mm and {np.degrees(turn.magnitude()):.3g} degrees"
    return replace(data, blocks=tuple(blocks)), text


def excluded_by_fit(result: Calibration) -> list[str]:
    """Return the labels of held-out rows that the fit to all rows excludes as outliers."""
    held, used = result.record.held_out, set(result.problem.labels)
    return [] if held is None else [label for label in held.label if label not in used]


def refit_all(result: Calibration) -> Calibration:
    """Return the calibration from identification and validation rows together, with the same settings.

    Errors on the held-out rows, which validate the procedure, stay in its record (``held_out``); the parameters come
    from all rows, and no row is left to check them. The held-out rows are the record's. InputError if there are none,
    or if measurements are not in memory.

    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> result = instance.calibrate()
    >>> everything = ro.calibration.refit_all(result)
    >>> f"{1e3 * everything.record.held_out.error.mean():.3f} mm, then {len(everything.problem.data)} rows"
    '0.024 mm, then 80 rows'
    """
    apart = result.record.validation
    if apart is None:
        raise InputError("validation", "no held-out rows", "a calibration with validation data")
    original = result.stated
    if not original.keeps_rows:
        raise InputError("refit_all", "data in blocks", "measurements in memory")
    whole = Dataset.together([original.data, apart], ["identification", "validation"])
    refitted = result.calibrate_again(original.on(whole))
    labels = whole.label[len(original.data) :]
    held = replace(held_out_errors(result, apart, np.isin(labels, refitted.problem.labels)), label=labels)
    record = replace(result.record, validation=None, held_out=held)
    if refitted.learned is not None and result.learned is not None:  # excluded rows stay excluded, and are named
        left_out = (*result.learned.left_out, *refitted.learned.left_out)
        refitted = replace(refitted, learned=replace(refitted.learned, left_out=left_out))
    excluded = [rows for rows in (result.excluded, refitted.excluded) if rows is not None]
    if excluded:
        named = ["identification", "all rows"][: len(excluded)]
        refitted = replace(refitted, excluded=Dataset.together(excluded, named))
    return replace(refitted, record=record)


def sets(result: Calibration) -> dict[str, Dataset]:
    """Return the data sets by name, validation first if present."""
    held = result.record.validation
    return {**({} if held is None else {"validation": held}), "identification": result.problem.data}


def headline_errors(result: Calibration) -> tuple[str, Array, Array]:
    """Return the name of the headline's rows, and their errors (N,) [m], nominal and identified, without outliers."""
    held = result.record.held_out
    if held is not None:
        kept = ~np.isin(held.label, excluded_by_fit(result))
        return "held out", held.nominal[kept], held.error[kept]
    name, data = next(iter(sets(result).items()))
    return name, result.nominal_errors(data), result.errors(data)


def of_positions(result: Calibration) -> bool:
    """Whether positions were measured in all sets, with or without orientations."""
    kinds = {block.measurement.name for data in sets(result).values() for block in data.blocks}
    return kinds <= {"position", "pose"}
