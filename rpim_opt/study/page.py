"""The page of a comparison: what came out, by problem too, what could not be computed, and what made it."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.basics.tables import csv_text
from rpim_opt.basics.writing import refused, write_files
from rpim_opt.report.frame import bullets, data_table, facts, page, section
from rpim_opt.report.markup import Element, tag
from rpim_opt.study.drawing import drawn
from rpim_opt.study.replicate import NUMBERS
from rpim_opt.study.standing import Summary, number

STEPS = (1.02, 1.1, 1.3, 2.0, 5.0)
"""Ratios to the best of a problem between which a cell's shade changes."""
CAPTION = (
    "Left: every replicate's figure over the reference's on the same data, and the geometric mean with its interval "
    "(green or red where that leaves 1 out). Right: the share of replicates on which a method is within a ratio of the "
    "best one; a method without a figure never is."
)


Rows = Sequence[Mapping[str, Any]]
Said = Mapping[str, str]
"""What was asked, or made the rows: names with what is said of them."""


def write_page(folder: Path, rows: Rows, summary: Summary, asked: Said, made: Said) -> Path:
    """Write the page, the replicates and the figure into a folder: all of them, or none; return the page's path."""
    figure = drawn(rows, summary)
    vector = _saved(figure, "svg", {"Date": None})
    files = {
        "index.html": _html(rows, summary, vector, asked, made).encode(),
        "replicates.csv": _csv(rows).encode(),
        "comparison.svg": vector,
        "comparison.png": _saved(figure, "png", None),
    }
    with refused(folder):
        write_files({folder / name: content for name, content in files.items()})
    return folder / "index.html"


def _saved(figure: Any, kind: str, metadata: Any) -> bytes:
    from matplotlib import rc_context

    stream = io.BytesIO()
    with rc_context({"svg.hashsalt": "comparison"}):  # the same file for the same figure
        figure.savefig(stream, format=kind, metadata=metadata, dpi=150)
    return stream.getvalue()


def _csv(rows: Rows) -> str:
    names = list(rows[0])
    cells = [["" if row[name] is None else str(row[name]) for name in names] for row in rows]
    return csv_text(names, cells)


def _html(rows: Rows, summary: Summary, vector: bytes, asked: Said, made: Said) -> str:
    methods = len({row["method"] for row in rows})
    problems = _problems(rows)
    heading = f"{methods} methods on {', '.join(problems)}"
    if len(problems) > 3:
        heading = f"{methods} methods on {len(problems)} problems"
    parts = [
        tag("p", lead(summary), class_="lead"),
        _figure(vector),
        *section("Methods", data_table(_title(summary), summary.header, summary.cells()), *bullets(summary.notes[:3])),
        *_by_problem(rows, summary),
        *_without(rows),
        *section("How it was made", facts([*asked.items(), *made.items()])),
    ]
    kind = f"Comparison of calibrations, {made.get('Made', '')[:10]}"
    return page(f"Comparison: {heading}", kind, heading, parts, images=True)


def lead(summary: Summary) -> str:
    """Return what came out in a sentence or two."""
    best = summary.standings[0]
    if best.method == summary.reference:
        better = [each for each in summary.standings if each.different and (each.ratio or 1) < 1]
        if not better:
            return f"No method is better than {summary.reference} in the geometric mean of {summary.metric}."
    between = ""
    if best.low is not None and best.high is not None:
        between = f" (95 % interval {number(best.low)} to {number(best.high)})"
    sure = ""
    if not best.different:
        sure = " That is no difference that these replicates can tell from none."
    return (
        f"{best.method} has the lowest {summary.metric}: {number(best.ratio)} times that of {summary.reference} in the "
        f"geometric mean{between}.{sure}"
    )


def _title(summary: Summary) -> str:
    return f"{summary.metric} of the rows held out; * where the interval leaves 1 out"


def _figure(vector: bytes) -> Element:
    source = f"data:image/svg+xml;base64,{base64.b64encode(vector).decode()}"
    image = tag("img", src=source, alt="ratios to the reference by method, and performance profiles", class_="drawn")
    return tag("figure", image, tag("figcaption", CAPTION))


def _by_problem(rows: Rows, summary: Summary) -> list[Element]:
    """Return the median of every method on every problem, shaded by how near it is to the best there."""
    of: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        if row.get(summary.metric) is not None:
            of.setdefault((row["method"], row["problem"]), []).append(row[summary.metric])
    medians = {key: float(np.median(values)) for key, values in of.items()}
    best: dict[str, float] = {}
    for (_, problem), value in medians.items():
        best[problem] = min(value, best.get(problem, np.inf))
    body = []
    for method in (each.method for each in summary.standings):
        cells = [_cell(medians.get((method, problem)), best.get(problem)) for problem in _problems(rows)]
        body.append(tag("tr", tag("th", method, scope="row"), *cells))
    head = tag("tr", *(tag("th", name, scope="col") for name in ("method", *_problems(rows))))
    title = f"Median {summary.metric} by problem; darker is farther from the best"
    grid = tag("table", tag("caption", title), tag("thead", head), tag("tbody", *body))
    return section("By problem", tag("div", grid, class_="wide", tabindex="0", role="region", aria_label=title))


def _cell(value: float | None, best: float | None) -> Element:
    if value is None or best is None:
        return tag("td", "-", class_="none")
    shade = int(np.searchsorted(STEPS, value / max(best, np.finfo(float).tiny)))
    return tag("td", number(value), class_=f"shade{shade}")


def _without(rows: Rows) -> list[Element]:
    """Return the replicates without figures, by method and reason."""
    counts: dict[tuple[str, str, str], dict[str, int]] = {}
    for row in rows:
        if row["status"] not in NUMBERS:
            where = counts.setdefault((row["method"], row["status"], row["reason"]), {})
            where[row["problem"]] = where.get(row["problem"], 0) + 1
    if not counts:
        return []
    lines = [
        [method, status, str(sum(where.values())), _where(where, rows), reason]
        for (method, status, reason), where in counts.items()
    ]
    header = ["method", "status", "replicates", "problems", "reason"]
    return section("What could not be computed", data_table("Replicates without a figure", header, lines, prose=True))


def _problems(rows: Rows) -> list[str]:
    return list(dict.fromkeys(row["problem"] for row in rows))


def _where(problems: Mapping[str, int], rows: Rows) -> str:
    if len(problems) == len(_problems(rows)):
        return "all"
    return ", ".join(problems)
