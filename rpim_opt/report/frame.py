"""HTML pages that work offline: their own style and script alone may run, and nothing can be loaded."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

from rpim_opt.report.markup import Element, html, table, tag

STYLE = Path(__file__).resolve().parent / "templates" / "page.css"


def page(
    title: str,
    kind: str,
    heading: str,
    parts: Sequence[Element],
    script: str = "",
    data: str = "",
    images: bool = False,
) -> str:
    """Return a page as HTML.

    Parameters
    ----------
    title, kind, heading
        Of the window, above the heading, and the heading.
    parts
        What stands below.
    script, data
        What runs, and JSON that it reads; neither by default.
    images
        Whether it holds images of its own, as data.
    """
    style = STYLE.read_text(encoding="utf-8")
    policy = f"default-src 'none'; style-src {_hash(style)}"
    inside = []
    if script:
        policy += f"; script-src {_hash(script)}"
        embedded = data.replace("<", "\\u003c")  # no text can end the script element
        inside = [tag("script", embedded, id="data", type="application/json"), tag("script", script)]
    if images:
        policy += "; img-src data:"
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=policy),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("title", title),
        tag("style", style),
    )
    main = tag("main", tag("header", tag("p", kind, class_="kind"), tag("h1", heading)), *parts)
    return "<!doctype html>\n" + html(tag("html", head, tag("body", main, *inside), lang="en")) + "\n"


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(sha256(text.encode()).digest()).decode()}'"


def section(name: str, *content: Element | str) -> list[Element]:
    """Return a section with its heading."""
    key = name.lower().replace(" ", "-")
    return [tag("section", tag("h2", name, id=key), *content, aria_labelledby=key)]


def data_table(caption: str, header: Sequence[str], rows: Sequence[Sequence[str]], prose: bool = False) -> Element:
    """Return a table that scrolls by itself where it is too wide; with ``prose`` its last column is running text."""
    grid = table(header, rows)
    grid.insert(0, tag("caption", caption))
    return tag("div", grid, class_="wide prose" if prose else "wide", tabindex="0", role="region", aria_label=caption)


def bullets(lines: Sequence[str], class_: str = "") -> list[Element]:
    """Return a list, or nothing where it would be empty."""
    if not lines:
        return []
    return [tag("ul", *(tag("li", line) for line in lines), class_=class_)]


def facts(said: Sequence[tuple[str, str]]) -> Element:
    """Return names with what is said of them."""
    return tag("dl", *(tag("div", tag("dt", key), tag("dd", value)) for key, value in said), class_="facts")
