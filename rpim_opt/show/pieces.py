"""What the sections of a report are made of: headings, tables, figures, lists, and the data that they speak of."""

from __future__ import annotations

from collections.abc import Sequence

from rpim_opt.basics.markup import Element, table, tag
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.show.svg import Chart


def section(name: str, *content: Element | str) -> list[Element]:
    """Return a section with its heading."""
    key = name.lower().replace(" ", "-")
    return [tag("section", tag("h2", name, id=key), *content, aria_labelledby=key)]


def data_table(caption: str, header: Sequence[str], rows: Sequence[Sequence[str]], prose: bool = False) -> Element:
    """Return a table that scrolls by itself where it is too wide; with ``prose`` its last column is running text."""
    grid = table(header, rows)
    grid.insert(0, tag("caption", caption))
    return tag("div", grid, class_="wide prose" if prose else "wide", tabindex="0", role="region", aria_label=caption)


def figure(chart: Chart, caption: str, *legend: tuple[str, str]) -> Element:
    """Return a chart with its legend, class of the key and text, and its caption."""
    keys = [tag("span", tag("i", class_=f"key {name}"), text) for name, text in legend]
    head = [tag("div", *keys, class_="legend")] if keys else []
    return tag("figure", *head, chart.element(), tag("figcaption", caption))


def bullets(lines: Sequence[str], class_: str = "") -> list[Element]:
    """Return a list, or nothing where it would be empty."""
    if not lines:
        return []
    return [tag("ul", *(tag("li", line) for line in lines), class_=class_)]


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
