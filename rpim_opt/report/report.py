"""A report that somebody else can check: one HTML page that works offline, with figures, evidence and provenance."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from rpim_opt.basics.writing import write_text
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.report.frame import page as whole
from rpim_opt.report.section_acceptance import acceptance_section, verdict
from rpim_opt.report.section_errors import errors_section
from rpim_opt.report.section_evidence import convergence_section, distrusted_section, identifiability_section
from rpim_opt.report.section_parameters import parameters_section
from rpim_opt.report.section_provenance import provenance_section, stated_details
from rpim_opt.report.section_reach import reach_section
from rpim_opt.report.section_space import space_section
from rpim_opt.report.section_summary import summary_section
from rpim_opt.report.section_weight import weight_section
from rpim_opt.report.summary import acceptance

HERE = Path(__file__).resolve().parent


def write_report(calibration: Calibration, path: str | Path, validation: Dataset | None = None) -> None:
    """Write a report of a calibration: one HTML file that needs no network.

    For whoever has to believe the result: whether it is accepted where something is demanded, a summary in one sentence
    and three figures, how far off the robot may be where; then errors before and after, in space too, how the weight
    was chosen, the parameters with intervals and the tolerances that were kept, what the data cannot tell apart,
    distrusted rows, convergence, and where the data come from. Every text of a user's file is shown as text.

    Parameters
    ----------
    calibration
        As `calibrate` or `load_result` return it.
    path
        The file; whole or not written at all.
    validation
        Measurements that no step of the calibration saw; those of the calibration's record by default.

    Raises
    ------
    InputError
        For validation data that do not belong to the problem, or measurements without a length.

    Examples
    --------
    >>> from pathlib import Path
    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> result = ro.calibrate(instance.problem, ro.tikhonov, weight=ro.l_curve)
    >>> ro.report.write_report(result, "report.html", instance.validation)
    >>> "0.032" in Path("report.html").read_text(encoding="utf-8")
    True
    """
    record = calibration.record.dated()
    record = record if validation is None else replace(record, validation=validation)
    write_text(Path(path), page(replace(calibration, record=record)))


def page(result: Calibration) -> str:
    """Return the report as HTML; only its own style and script may run, and nothing can be loaded."""
    data: dict[str, Any] = {}
    title = result.record.title or " and ".join(robot.name for robot in result.problem.arms.values())
    accepted = acceptance(result)
    parts = [
        *verdict(accepted),
        *summary_section(result),
        *stated_details(result),
        *acceptance_section(result, accepted),
        *reach_section(result),
        *errors_section(result),
        *space_section(result, data),
        *weight_section(result, data),
        *parameters_section(result),
        *identifiability_section(result),
        *distrusted_section(result),
        *convergence_section(result),
        *provenance_section(result),
    ]
    script = (HERE / "report.js").read_text(encoding="utf-8")
    embedded = json.dumps(data, allow_nan=False)
    kind = f"Robot calibration, {result.record.made[:10]}"
    return whole(f"Calibration: {title}", kind, title, parts, script, embedded)
