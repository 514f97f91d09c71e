"""Self-contained HTML pages: blocks, tables and figures, and the page of checks over time."""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import write_text
from rpim_opt.report import plot
from rpim_opt.use.monitoring import Monitoring

TEMPLATES = Path(__file__).resolve().parent / "templates"
Block = tuple[str, Any]  # kind and content of a part of a page: a macro of ``templates/parts.html``, its argument


class Table(NamedTuple):
    """Caption, header and rows of texts; with ``prose`` the last column is running text."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    prose: bool = False


class Figure(NamedTuple):
    """A chart as the source of an image, its alternative text, and its caption."""

    source: str
    title: str
    caption: str


WIDTH, HEIGHT = 420.0, 270.0  # of a chart [px]; the page scales it
INKED = ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color")
STYLE = {
    **dict.fromkeys(INKED, plot.COLORS["ink"]),
    "axes.spines.right": False, "axes.spines.top": False, "axes.grid": True, "grid.color": "#dfe3e8",
    "axes.axisbelow": True, "svg.fonttype": "none", "font.size": 12.5, "text.parse_math": False,
}  # fmt: skip


def figure(draw: Callable[..., Any], title: str, caption: str = "", height: float = HEIGHT) -> Figure:
    """Return a figure drawn by ``draw`` on matplotlib axes ``ax``, as an SVG image whose unit is a pixel."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure as Drawing

    stream = io.BytesIO()
    style: Any = {**STYLE, "svg.hashsalt": title}
    with rc_context(style):
        drawing = Drawing(figsize=(WIDTH / 72, height / 72), dpi=72, layout="constrained")
        draw(ax=drawing.add_subplot())
        drawing.savefig(stream, format="svg", dpi=200, metadata={"Date": None})
    content = base64.b64encode(stream.getvalue()).decode()
    return Figure(f"data:image/svg+xml;base64,{content}", title, caption)


def coded(text: str) -> Markup:
    """Return a text with backticks converted to code elements."""
    parts = [Markup("<code>{}</code>" if i % 2 else "{}").format(part) for i, part in enumerate(text.split("`"))]
    return Markup("").join(parts)


LAYOUT = {"trim_blocks": True, "lstrip_blocks": True, "autoescape": True, "undefined": StrictUndefined}
ENVIRONMENT = Environment(loader=FileSystemLoader(TEMPLATES), **LAYOUT)
ENVIRONMENT.filters["coded"] = coded


def render(
    title: str, kind: str, heading: str, top: Iterable[Block], sections: Iterable[tuple[str, Iterable[Block]]]
) -> str:
    """Return a page as HTML, with escaped texts, inline style and pictures, without scripts or external resources."""
    style = (TEMPLATES / "page.css").read_text(encoding="utf-8")
    digest = base64.b64encode(sha256(style.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'"
    return ENVIRONMENT.get_template("page.html").render(
        title=title, kind=kind, heading=heading, top=top, sections=sections, policy=policy, style=Markup(style),
    )  # fmt: skip


COLUMNS = {"label": "check", "error_mm": "error [mm]", "sigmas": "standard deviations", "allowed_sigmas": "allowed"}
"""Column names of the page of checks."""


def write_checks(found: Monitoring, path: str | Path, title: str = "") -> None:
    """Write checks over time, as returned by `use.monitor`: an HTML page that works offline, or a table (``.csv``).

    The page has the verdict, two charts and every check; ``title`` names the robot or cell. The file is written whole
    or not at all. InputError for a name that ends in neither ``.html`` nor ``.csv``.

    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> ro.report.write_checks(ro.use.monitor(ro.calibrate(instance.problem), instance.validation), "checks.html")
    """
    path = Path(path)
    if path.suffix.lower() not in (".html", ".csv"):
        raise InputError("the file", f"'{path.name}'", "a name that ends in .html or .csv")
    if path.suffix.lower() == ".csv":
        write_text(path, found.csv())
        return
    verdict, *details = str(found).splitlines()
    header, *rows = csv.reader(found.csv().splitlines())
    table = Table("In chronological order", [COLUMNS.get(name, name) for name in header], rows)
    charts = [figure(partial(plot.checks, found), "Residual of every check and its limit", "Individual checks.")]
    title_of_sum = "Cumulative sum of the checks and its limit"
    charts.append(figure(partial(plot.checks, found, sums=True), title_of_sum, "Cumulative sum of the checks (CUSUM)."))
    sections: list[tuple[str, list[Block]]] = [
        ("Verdict", [("lead", {"text": verdict, "alarm": found.drifts}), *(("text", [line]) for line in details)]),
        ("Over time", [("figures", charts)]),
        ("Every check", [("table", table)]),
    ]
    heading = title or "Checks"
    write_text(path, render(f"Checks: {heading}", "Checks of a calibrated robot", heading, [], sections))
