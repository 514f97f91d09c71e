"""The report's view of the errors in space, which the page's script turns."""

from __future__ import annotations

from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.calibration.result import Calibration
from rpim_opt.report.frame import section
from rpim_opt.report.markup import Element, tag
from rpim_opt.report.pieces import sets
from rpim_opt.report.scales import magnification, mm

MOST = 2000
"""Points that are drawn at most."""
VIEWS = (("30,20", "oblique"), ("0,90", "from above"), ("0,0", "along y"), ("90,0", "along x"))
"""Azimuth and elevation [deg], and what they are called."""


def space_section(result: Calibration, embedded: dict[str, Any]) -> list[Element]:
    """Return the view of measured positions with their errors; what the script draws goes into ``embedded``."""
    P, before, after, labels = _positions(result)
    if not len(P):
        return []
    drawn = np.linspace(0, len(P) - 1, min(len(P), MOST)).astype(int)
    embedded["space"] = {
        "points": P[drawn].round(6).tolist(),
        "labels": [labels[i] for i in drawn],
        "before": _lines(P[drawn], before[drawn]),
        "after": _lines(P[drawn], after[drawn]),
    }
    ends = zip("xyz", P.min(axis=0), P.max(axis=0), strict=True)
    span = ", ".join(f"{axis} {low:z.2f} to {high:z.2f} m" for axis, low, high in ends)
    what = "measured positions in the instrument's frame"
    if result.problem.sample().touches is not None:
        what = "touches"
    text = (
        f"{len(P)} {what}, {span}; a line from each shows which way and how far it lies off the model. "
        "Turn with the mouse, a finger or the arrow keys."
    )
    if len(drawn) < len(P):
        text += f" {len(drawn)} of them are drawn."
    said = f"Measured positions in space with their error vectors: {len(P)} points, {span}. Arrow keys turn the view."
    return section(
        "Errors in space",
        tag("p", text),
        tag("div", *_choices(), *_views(), class_="controls"),
        tag("svg", viewBox="0 0 600 420", id="space", tabindex="0", role="application", aria_label=said),
        tag("p", "The figure needs the page's script.", id="space-says", aria_live="polite", class_="says"),
    )


def _positions(result: Calibration) -> tuple[Array, Array, Array, list[str]]:
    """Return measured positions (N, 3) [m], their errors before and after (N, 3) [m], and what they are called."""
    points = []
    before = []
    after = []
    labels: list[str] = []
    for name, data in sets(result).items():
        vectors = result.error_vectors(data, nominal=True)
        seen = np.isfinite(vectors).all(axis=1)
        points.append(result.measured_positions(data)[seen])
        before.append(vectors[seen])
        after.append(result.error_vectors(data)[seen])
        labels += [f"{data.label[i]} ({name})" for i in np.flatnonzero(seen)]
    return np.vstack(points), np.vstack(before), np.vstack(after), labels


def _choices() -> list[Element]:
    before = tag("input", type="radio", name="when", value="before")
    after = tag("input", type="radio", name="when", value="after", checked="")
    return [tag("label", before, "before"), tag("label", after, "after")]


def _views() -> list[Element]:
    return [tag("button", text, type="button", data_view=view) for view, text in VIEWS]


def _lines(points: Array, vectors: Array) -> dict[str, Any]:
    """Return errors [m] as lines to draw [m]: enlarged, those of blunders cut so that the others can be seen."""
    length = np.linalg.norm(vectors, axis=1)
    longest = 3 * float(np.percentile(length, 90))
    cut = vectors * np.minimum(1.0, longest / np.maximum(length, 1e-12))[:, None]
    times = magnification(points, cut)
    beyond = int(np.count_nonzero(length > longest))
    note = f"enlarged {times:,.0f} times"
    if beyond:
        note += f", {beyond} beyond {mm(1e3 * longest)} mm cut"
    return {"lines": (times * cut).round(5).tolist(), "errors": (1e3 * length).round(6).tolist(), "note": note}
