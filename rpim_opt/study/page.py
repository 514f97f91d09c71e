"""Page of a comparison: ranking, figures by problem, what could not be computed, and what made it."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rpim_opt.basics.files import refused, write_files
from rpim_opt.basics.tables import csv_text
from rpim_opt.report.page import Table, render
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
    return render(
        "comparison.html",
        images=True,
        title=f"Comparison: {heading}",
        kind=f"Comparison of calibrations, {provenance.get('Made', '')[:10]}",
        heading=heading,
        lead=headline(summary),
        image=f"data:image/svg+xml;base64,{base64.b64encode(vector).decode()}",
        caption=CAPTION,
        methods=Table(title, summary.header, summary.cells()),
        notes=summary.notes[:3],
        metric=summary.metric,
        problems=problems,
        medians=_medians(rows, summary, problems),
        missing=_missing(rows, problems),
        made=[*axes.items(), *provenance.items()],
    )


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


def _medians(rows: Rows, summary: Summary, problems: list[str]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return text and class of every method's median on every problem: the class is how near it is to the best."""
    of: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        if row.get(summary.metric) is not None:
            of.setdefault((row["method"], row["problem"]), []).append(row[summary.metric])
    medians = {key: float(np.median(values)) for key, values in of.items()}
    best: dict[str, float] = {}
    for (_, problem), value in medians.items():
        best[problem] = min(value, best.get(problem, np.inf))
    table = []
    for method in (each.method for each in summary.standings):
        cells = []
        for problem in problems:
            value = medians.get((method, problem))
            if value is None:
                cells.append(("-", "none"))
            else:
                shade = int(np.searchsorted(SHADES, value / max(best[problem], np.finfo(float).tiny)))
                cells.append((number(value), f"shade{shade}"))
        table.append((method, cells))
    return table


def _missing(rows: Rows, problems: list[str]) -> Table:
    """Return the replicates without figures, by method and reason."""
    lines: list[list[str]] = []
    for (method, status, reason), missing in without_figures(rows).items():
        where = Counter(missing)
        names = "all" if len(where) == len(problems) else ", ".join(where)
        lines.append([method, status, str(len(missing)), names, reason])
    header = ["method", "status", "replicates", "problems", "reason"]
    return Table("Replicates without a figure", header, lines, prose=True)
