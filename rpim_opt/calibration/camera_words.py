"""What a camera's views say of a robot, in words: the reprojection error, and whether positions become better."""

from __future__ import annotations

import numpy as np

from rpim_opt.calibration.result import Calibration
from rpim_opt.problem.registration.camera import camera_blocks


def camera_remarks(result: Calibration) -> list[str]:
    """Return what a reader has to know of a camera's views; nothing where there are none.

    >>> import rpim_opt as ro
    >>> from rpim_opt.calibration.camera_words import camera_remarks
    >>> camera_remarks(ro.load("paper_arm").calibrate())
    []
    >>> said = camera_remarks(ro.load("camera").calibrate(weight=1.0))
    >>> said[1].split(",")[0]
    'Expected position error of the flange over its joint ranges'
    """
    blocks = camera_blocks(result.problem.sample().data)
    if not blocks:
        return []
    before = _rms(result.nominal_errors(dimension="pixel"))
    after = _rms(result.errors(dimension="pixel"))
    remarks = [
        f"Reprojection error (RMS): {before:.3g} px before, {after:.3g} px after; in millimetres it is by how much the "
        "line of sight passes by the point. It says how well views agree, and not how well the robot is known."
    ]
    remarks += _positions(result)
    if not any("stretch" in name for name in result.problem.parameters.free.names):
        remarks.append(
            "No view tells whether the board is as large as stated: by whatever part it is larger, so becomes the "
            "robot (identify board_stretch_x and board_stretch_y where it was printed)."
        )
    return remarks


def _positions(result: Calibration) -> list[str]:
    from rpim_opt.calibration.expected import improvement  # which no other measurement asks for

    found = improvement(result)
    if found is None:
        return ["How well the flange's positions are known this result cannot tell."]
    figures = (
        "Expected position error of the flange over its joint ranges, base and tool placed as fits best: "
        f"{1e3 * found.before:.3g} mm RMS as drawn, {1e3 * found.after:.3g} mm as identified (95 % of it within "
        f"{1e3 * found.within:.3g} mm along any axis)."
    )
    if found.improves:
        return [figures]
    return [
        figures,
        "These views do not improve this robot: use its drawing. Views from farther apart, with the board nearer or "
        "larger, or an instrument that measures positions would.",
    ]


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(errors**2)))
