"""What a study found: a text with figures, and metrics that must not get worse."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.files import json_text, read_json
from rpim_opt.basics.writing import refused, write_files
from rpim_opt.study.grid import find_study, load_study, name_of


@dataclass(frozen=True)
class Metric:
    """A figure of a study that must not get worse: its direction, and by how much of the baseline it may vary.

    Parameters
    ----------
    better
        ``"lower"`` or ``"higher"``.
    tolerance
        What part of the baseline it may be worse by.

    Examples
    --------
    >>> from rpim_opt.study import Metric
    >>> METRICS = {"mean error [mm]": Metric("lower", 0.1)}  # of a file in the folder studies
    """

    better: str
    tolerance: float


@dataclass(frozen=True)
class Report:
    """What a study found.

    Parameters
    ----------
    text
        Markdown.
    metrics
        Figures that a baseline is compared with, by the names of the study's METRICS.
    figures
        matplotlib figures by name.

    Examples
    --------
    >>> from rpim_opt.study import Report
    >>> Report("The error falls with the root of the number of poses.", {"mean error [mm]": 0.03}).metrics
    {'mean error [mm]': 0.03}
    """

    text: str
    metrics: Mapping[str, float] = field(default_factory=dict)
    figures: Mapping[str, Any] = field(default_factory=dict)


def write(folder: Path, question: str, report: Report, made: str, replicates: Mapping[str, bytes]) -> None:
    """Write ``README.md`` with the figures, ``metrics.json`` and the files of the replicates: all, or none."""
    pictures = [f"![{title}]({title}.svg)\n" for title in report.figures]
    text = "\n".join([f"# {question}", "", report.text.strip(), "", *pictures, made])
    files = dict(replicates)
    for title, figure in report.figures.items():
        files |= _drawn(title, figure)
    files["README.md"] = (text + "\n").encode()
    files["metrics.json"] = json_text(dict(report.metrics)).encode()
    with refused(folder):
        write_files({folder / name: content for name, content in files.items()})


def _drawn(title: str, figure: Any) -> dict[str, bytes]:
    """Return a figure's files by their names."""
    from matplotlib import rc_context

    vector = io.BytesIO()
    pixels = io.BytesIO()
    with rc_context({"svg.hashsalt": title}):  # the same file for the same figure
        figure.savefig(vector, format="svg", metadata={"Date": None})
    figure.savefig(pixels, format="png")
    return {f"{title}.svg": vector.getvalue(), f"{title}.png": pixels.getvalue()}


def regressions(name: str | Path, quick: bool, metrics: Mapping[str, float]) -> list[str]:
    """Return a sentence for every metric that is worse than ``baselines.json`` beside the study allows."""
    file = find_study(name)
    path = file.parent / "baselines.json"
    known: dict[str, dict[str, float]] = {}
    if path.is_file():
        known = read_json(path)
    label = f"{name_of(file)}-quick" if quick else name_of(file)
    if label not in known:
        raise InputError("baseline", f"none for '{label}'", choices(label, known), path)
    rules = load_study(file).METRICS
    worse = []
    for metric, baseline in known[label].items():
        rule = rules[metric]
        value = metrics.get(metric)
        sign = 1 if rule.better == "lower" else -1
        if value is None or not sign * (value - baseline) <= rule.tolerance * abs(baseline):
            bound = f"{rule.better} is better, tolerance {rule.tolerance:.0%}"
            worse.append(f"{metric}: found {value}, baseline {baseline}, {bound}")
    return worse
