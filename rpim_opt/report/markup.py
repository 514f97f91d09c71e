"""HTML and SVG as trees: text becomes text and never markup, whatever it says."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree

Element = ElementTree.Element


def tag(name: str, /, *children: str | Element, **attributes: object) -> Element:
    """Return an element; ``class_`` stands for ``class``, ``aria_label`` for ``aria-label``.

    >>> from rpim_opt.report.markup import html, tag
    >>> html(tag("p", "a < b ", tag("b", "c"), class_="note"))
    '<p class="note">a &lt; b <b>c</b></p>'
    """
    element = Element(name, {key.strip("_").replace("_", "-"): str(value) for key, value in attributes.items()})
    last: Element | None = None
    for child in children:
        if isinstance(child, Element):
            element.append(child)
            last = child
        elif last is None:
            element.text = (element.text or "") + child
        else:
            last.tail = (last.tail or "") + child
    return element


def html(element: Element) -> str:
    """Return an element as HTML."""
    return ElementTree.tostring(element, encoding="unicode", method="html")


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> Element:
    """Return a table; its first column heads the rows."""
    head = tag("tr", *(tag("th", name, scope="col") for name in header))
    body = [tag("tr", tag("th", row[0], scope="row"), *(tag("td", cell) for cell in row[1:])) for row in rows]
    return tag("table", tag("thead", head), tag("tbody", *body))
