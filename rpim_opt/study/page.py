"""Page of a comparison: ranking, figures by problem, what could not be computed, and what made it."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.basics.tables import csv_text
from rpim_opt.basics.writing import refused, write_files
from rpim_opt.report.frame import bullets, data_table, facts, page, section
from rpim_opt.report.markup import Element, tag
from rpim_opt.study.figures import comparison_figure, picture
from rpim_opt.study.ranking import Rows, Summary, number, without_figures

SHADES = (1.02, 1.1, 1.3, 2.0, 5.0)
"""Ratios to the best of a problem between which a cell's shade changes."""
CAPTION = (
    "Left: every replicate's figure over the reference's on the same data, and the geometric mean with its interval "
    "(green or red where that leaves 1 out). Right: the share of replicates on which a method is within a ratio of the "
    "best one; a method without a figure never is."
)


def write_page(
    folder: Path, rows: Rows, summary: Summary, axes: Mapping[str, str], provenance: Mapping[str, str]
) -> Path:
    """Write the page, the replicates and the figure into a folder: all of them, or none; return the page's path."""
    figure = comparison_figure(rows, summary)
    vector = picture(figure, "comparison", "svg")
    names = list(rows[0])
    cells = [["" if row[name] is None else str(row[name]) for name in names] for row in rows]
    files = {
        "index.html": _html(rows, summary, vector, axes, provenance).encode(),
        "replicates.csv": csv_text(names, cells).encode(),
        "comparison.svg": vector,
        "comparison.png": picture(figure, "comparison", "png"),
    }
    with refused(folder):
        write_files({folder / name: content for name, content in files.items()})
    return folder / "index.html"


def _html(rows: Rows, summary: Summary, vector: bytes, axes: Mapping[str, str], provenance: Mapping[str, str]) -> str:
    problems = list(dict.fromkeys(row["problem"] for row in rows))
    where = ", ".join(problems) if len(problems) <= 3 else f"{len(problems)} problems"
    heading = f"{len({row['method'] for row in rows})} methods on {where}"
    title = f"{summary.metric} of the rows held out; * where the interval leaves 1 out"
    source = f"data:image/svg+xml;base64,{base64.b64encode(vector).decode()}"
    image = tag("img", src=source, alt="ratios to the reference by method, and performance profiles", class_="drawn")
    parts = [
        tag("p", headline(summary), class_="lead"),
        tag("figure", image, tag("figcaption", CAPTION)),
        *section("Methods", data_table(title, summary.header, summary.cells()), *bullets(summary.notes[:3])),
        *_by_problem(rows, summary, problems),
        *_without(rows, problems),
        *section("How it was made", facts([*axes.items(), *provenance.items()])),
    ]
    kind = f"Comparison of calibrations, {provenance.get('Made', '')[:10]}"
    return page(f"Comparison: {heading}", kind, heading, parts, images=True)


def headline(summary: Summary) -> str:
    """Return which method is best in a sentence or two."""
    best = summary.standings[0]
    if best.method == summary.reference:
        better = [each for each in summary.standings if each.different and (each.ratio or 1) < 1]
        if not better:
            return f"No method is better than {summary.reference} in the geometric mean of {summary.metric}."
    between = ""
    if best.low is not None and best.high is not None:
        between = f" (95 % interval {number(best.low)} to {number(best.high)})"
    chance = "" if best.different else " That is no difference that these replicates can tell from none."
    return (
        f"{best.method} has the lowest {summary.metric}: {number(best.ratio)} times that of {summary.reference} in the "
        f"geometric mean{between}.{chance}"
    )


def _by_problem(rows: Rows, summary: Summary, problems: list[str]) -> list[Element]:
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
        cells = [_cell(medians.get((method, problem)), best.get(problem)) for problem in problems]
        body.append(tag("tr", tag("th", method, scope="row"), *cells))
    head = tag("tr", *(tag("th", name, scope="col") for name in ("method", *problems)))
    title = f"Median {summary.metric} by problem; darker is farther from the best"
    grid = tag("table", tag("caption", title), tag("thead", head), tag("tbody", *body))
    return section("By problem", tag("div", grid, class_="wide", tabindex="0", role="region", aria_label=title))


def _cell(value: float | None, best: float | None) -> Element:
    if value is None or best is None:
        return tag("td", "-", class_="none")
    shade = int(np.searchsorted(SHADES, value / max(best, np.finfo(float).tiny)))
    return tag("td", number(value), class_=f"shade{shade}")


def _without(rows: Rows, problems: list[str]) -> list[Element]:
    """Return the replicates without figures, by method and reason."""
    lines: list[Any] = []
    for (method, status, reason), missing in without_figures(rows).items():
        where = Counter(missing)
        names = "all" if len(where) == len(problems) else ", ".join(where)
        lines.append([method, status, str(len(missing)), names, reason])
    if not lines:
        return []
    header = ["method", "status", "replicates", "problems", "reason"]
    return section("What could not be computed", data_table("Replicates without a figure", header, lines, prose=True))
