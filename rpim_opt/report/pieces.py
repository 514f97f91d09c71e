"""What the sections of a report are made of: headings, tables, figures, lists, and the data that they speak of."""

from __future__ import annotations

from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.report.chart import Chart
from rpim_opt.report.markup import Element, tag
from rpim_opt.report.svg import Picture


def figure(picture: Picture | Chart, caption: str = "", *above: Element) -> Element:
    """Return a chart with its legend and its caption, which its note ends; more may be drawn above it."""
    drawn = picture if isinstance(picture, Picture) else Picture(picture)
    keys = [tag("span", tag("i", class_=f"key {role}"), text) for role, text in drawn.chart.legend]
    head = [tag("div", *keys, class_="legend")] if keys else []
    said = " ".join(filter(None, [caption, drawn.chart.note]))
    return tag("figure", *head, drawn.element(*above), tag("figcaption", said))


def sets(result: Calibration) -> dict[str, Dataset]:
    """Return the data by name, those that the calibration did not see first."""
    data = {"identification": result.problem.data}
    if result.record.validation is None:
        return data
    return {"validation": result.record.validation, **data}


def repeated(result: Calibration) -> int:
    """Return how many validation rows were measured where an identification row was too."""
    if result.record.validation is None:
        return 0
    known = {q.tobytes() for q in result.problem.data.q}
    return sum(q.tobytes() in known for q in result.record.validation.q)


def quantity(result: Calibration) -> str:
    """Say what the errors are of."""
    kinds = {block.measurement.name for data in sets(result).values() for block in data.blocks}
    return "position error" if kinds <= {"position", "pose"} else "error"
