"""What errors mean where points or planes were touched, in words."""

from __future__ import annotations

from rpim_opt.problem.problem import CalibrationProblem


def contact_remarks(problem: CalibrationProblem) -> list[str]:
    """Return what a reader of errors has to know of touches; nothing where there are none.

    >>> import rpim_opt as ro
    >>> from rpim_opt.calibration.contact_words import contact_remarks
    >>> contact_remarks(ro.load("paper_arm").problem)
    []
    >>> contact_remarks(ro.load("contact").problem)[0][:58]
    'Error of a touch: the distance of the tool from the mean o'
    """
    if problem.touches is None:
        return []
    nearest = []
    if not all(problem.touches.planar):
        nearest.append("the mean of all touches of its point")
    if any(problem.touches.planar):
        nearest.append("the plane that fits all touches of it best")
    said = f"Error of a touch: the distance of the tool from {', or '.join(nearest)}, as the model has them"
    remarks = [f"{said}. Where these are nobody measured: it is how well the robot repeats itself from all sides."]
    if not any(tie.kind == "known_distance" for tie in problem.touches.ties):
        remarks.append("No distance is known: how large the robot is rests on its drawing alone.")
    return remarks
