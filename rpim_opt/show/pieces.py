"""What the sections of a report are made of: headings, tables, figures, lists, and the data that they speak of."""

from __future__ import annotations

from rpim_opt.basics.markup import Element, tag
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.show.svg import Chart


def figure(chart: Chart, caption: str, *legend: tuple[str, str]) -> Element:
    """Return a chart with its legend, class of the key and text, and its caption."""
    keys = [tag("span", tag("i", class_=f"key {name}"), text) for name, text in legend]
    head = [tag("div", *keys, class_="legend")] if keys else []
    return tag("figure", *head, chart.element(), tag("figcaption", caption))


def mm(value: float) -> str:
    """Return a length given in mm with the digits that matter."""
    if value < 10:
        return f"{value:.3f}"
    return f"{value:.2f}" if value < 100 else f"{value:.0f}"


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


BEFORE_AFTER = (("before", "before"), ("after", "after"))
