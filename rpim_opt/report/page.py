"""HTML pages that work offline: blocks, tables and figures, and the page of checks over time."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import refused, write_text
from rpim_opt.report.chart import Chart, Picture
from rpim_opt.report.charts import checks_charts, mm
from rpim_opt.use.monitoring import Monitoring

TEMPLATES = Path(__file__).resolve().parent / "templates"
Block = tuple[str, Any]
"""Kind and content of a part of a page: a macro of ``templates/parts.html`` and its argument."""


class Table(NamedTuple):
    """Caption, header and rows of texts, or of texts with a class; with ``prose`` the last column is running text."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[Any]]
    prose: bool = False


class Figure(NamedTuple):
    """A chart as SVG with its legend and its caption."""

    svg: Markup
    legend: Sequence[tuple[str, str]]
    caption: str


def figure(chart: Chart | Picture, caption: str = "", *above: Markup) -> Figure:
    """Return a figure, its caption ended by the chart's note; elements ``above`` are drawn on top of it."""
    picture = chart if isinstance(chart, Picture) else Picture(chart)
    text = " ".join(filter(None, [caption, picture.chart.note]))
    return Figure(picture.svg(*above), picture.chart.legend, text)


def coded(text: str) -> Markup:
    """Return a text with what stands between backticks as code."""
    parts = [Markup("<code>{}</code>" if i % 2 else "{}").format(part) for i, part in enumerate(text.split("`"))]
    return Markup("").join(parts)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False}
    environment.filters["coded"] = coded
    return environment


def render(
    title: str, kind: str, heading: str, top: Iterable[Block], sections: Iterable[tuple[str, Iterable[Block]]],
    script: str = "", data: Mapping[str, Any] | None = None, images: bool = False,
) -> str:  # fmt: skip
    """Return a page as HTML: all texts are escaped, its own style and script alone may run, nothing is loaded.

    The script is a file of the templates that reads ``data``; ``images`` may stand in the page as data.
    """
    style = (TEMPLATES / "page.css").read_text(encoding="utf-8")
    code = (TEMPLATES / script).read_text(encoding="utf-8") if script else ""
    policy = f"default-src 'none'; style-src {_digest(style)}"
    if script:
        policy += f"; script-src {_digest(code)}"
    if images:
        policy += "; img-src data:"
    return _environment().get_template("page.html").render(
        title=title, kind=kind, heading=heading, top=top, sections=sections, data=data,
        policy=policy, style=Markup(style), script=Markup(code),
    )  # fmt: skip


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(sha256(text.encode()).digest()).decode()}'"


# --- checks over time --------------------------------------------------------------------------------------


def write_checks(found: Monitoring, path: str | Path, title: str = "") -> None:
    """Write checks over time, as `use.monitor` returns them, as one HTML page that works offline.

    The page has the verdict, two charts and every check; ``title`` names the robot or cell. The file is written whole
    or not at all.

    >>> from pathlib import Path
    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> found = ro.use.monitor(ro.calibrate(instance.problem), instance.validation)
    >>> ro.report.write_checks(found, "checks.html", "Cell 7")
    >>> "No drift in 40 checks." in Path("checks.html").read_text(encoding="utf-8")
    True
    """
    verdict, *details = str(found).splitlines()
    heading = title or "Checks"
    sections: list[tuple[str, list[Block]]] = [
        ("Verdict", [("lead", {"text": verdict, "alarm": found.drifts}), *(("text", [line]) for line in details)]),
        ("Over time", [("figures", [figure(chart) for chart in checks_charts(found)])]),
        ("Every check", [("table", _checks(found))]),
    ]
    text = render(f"Checks: {heading}", "Checks of a calibrated robot", heading, [], sections)
    write_text(Path(path), text)


def _checks(found: Monitoring) -> Table:
    """Return every check; values beyond their limits are marked."""
    sigmas = [f"{value:.1f}" for value in found.sigmas]
    for i in found.beyond:
        sigmas[i] = f"beyond {sigmas[i]}"
    sums = [f"{value:.1f}" for value in found.sums]
    if found.alarm is not None:
        sums[found.alarm] = f"alarm {sums[found.alarm]}"
    columns: dict[str, Sequence[str]] = {"check": found.label}
    if found.times:
        columns["time"] = found.times
    errors = [mm(1e3 * error) for error in found.error]
    columns |= {"error [mm]": errors, "standard deviations": sigmas, "cumulative sum": sums}
    return Table("In the order of time", list(columns), list(zip(*columns.values(), strict=True)))


def written_checks(found: Monitoring, out: Path | None, title: str) -> list[Path]:
    """Write checks as a page (``.html``) or as a table (``.csv``), and return the files written."""
    if out is None:
        return []
    if out.suffix.lower() not in (".html", ".csv"):
        raise InputError("--out", f"'{out.name}'", "a name that ends in .html or .csv")
    with refused(out):
        if out.suffix.lower() == ".csv":
            write_text(out, found.csv())
        else:
            write_checks(found, out, title)
    return [out]
