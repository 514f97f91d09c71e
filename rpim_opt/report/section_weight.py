"""The report's weight: the L-curve with every selector's choice, and what each would have given."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, NoSolutionFound
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.atoms import SQUARES
from rpim_opt.convex.program import Estimate, Program, pose
from rpim_opt.convex.select import compare
from rpim_opt.convex.selection import Selection, weight_grid
from rpim_opt.report.charts_weight import l_curve_chart
from rpim_opt.report.frame import data_table, section
from rpim_opt.report.markup import Element, tag
from rpim_opt.report.pieces import figure, sets
from rpim_opt.report.scales import mm
from rpim_opt.report.svg import Picture

TITLE = "Weight of the penalty"
WHY = {"learned": "largest evidence of all sizes"}
"""Of choices that are not of one weight; others without a note were given."""
MANY = 600
"""Equations beyond which a loss that is no square is drawn by the squares that it trusts, which have a formula: on
paper the two curves are one, and a hundred robust fits of two thousand rows take minutes."""


class Path(NamedTuple):
    """Solutions over the weight (k,): roots of loss and penalty, and mean errors [mm] on some measurements."""

    weight: Array
    residual: Array
    solution: Array
    error: list[float]
    of: str

    def at(self, weight: float) -> int:
        """Return which solution is the one at a weight."""
        return int(np.argmin(np.abs(np.log(self.weight / weight))))


def weight_section(result: Calibration, embedded: dict[str, Any]) -> list[Element]:
    """Return how the weight was chosen; what the page's slider needs goes into ``embedded``."""
    said = tag("p", result.weight_sentence())
    if result.record.earlier:  # weight 1 joins two sets of data: no other weight means anything
        return section("What was known before", said)
    formulation = result.formulation
    if formulation.penalty is None or not formulation.solvable or result.weight <= 0:
        return section(TITLE, said)
    given = Selection(result.weight, "given", np.array([]), np.array([]), True)
    program, by_squares = _drawn(result)
    chosen = {result.selector: result.selection or given}
    if not _slow(program):
        chosen = {**compare(program), **chosen}
    path = _path(result, program, chosen)
    places = {name: path.at(choice.weight) for name, choice in chosen.items() if choice.weight > 0}
    k = places[result.selector]
    points = {name: (path.residual[i], path.solution[i]) for name, i in places.items()}
    picture = Picture(l_curve_chart(path.residual, path.solution, points, result.selector))
    x = picture.x(path.residual)
    y = picture.y(path.solution)
    embedded["curve"] = {
        "weight": path.weight.tolist(),
        "residual": path.residual.tolist(),
        "solution": path.solution.tolist(),
        "error": path.error,
        "of": path.of,
        "takers": _takers(places),
        "chosen": k,
        "x": x.tolist(),
        "y": y.tolist(),
    }
    slider = tag("input", type="range", id="weight", min=0, max=len(path.weight) - 1, value=k)
    drawn = figure(
        picture,
        "Each point is the solution at one weight: little penalty above left, much below right." + by_squares,
        tag("circle", id="cursor", r=9, class_="cursor", cx=f"{x[k]:g}", cy=f"{y[k]:g}"),
    )
    label = tag("label", "Weight", slider)
    side = tag("div", label, tag("output", id="weight-says", for_="weight"), class_="side")
    table = data_table(
        "What each selector takes, from the identification data alone",
        ["selector", "weight", f"mean error, {path.of} [mm]", "why"],
        _choices(path, chosen, places, result.selector),
        prose=True,
    )
    return section(TITLE, said, tag("div", drawn, side, class_="figures"), table)


def _slow(program: Program) -> bool:
    """Whether many programs of this kind take longer than anybody waits for a report."""
    return not program.quadratic and program.model.equations > MANY


def _drawn(result: Calibration) -> tuple[Program, str]:
    """Return the program whose path is drawn, and a sentence where it is that of squares instead of the loss."""
    program = result.program
    if program.loss_form is not None or not _slow(program):
        return program, ""
    try:
        trusted = result.linear
    except InputError:  # a loss that rests on a few equations
        return program, ""
    squares = replace(result.formulation, loss=SQUARES, loss_over="equation", largest=float("inf"))
    return pose(squares, trusted), " The curve is that of the squares which the loss trusts at the chosen weight."


def _path(result: Calibration, program: Program, chosen: Mapping[str, Selection]) -> Path:
    """Solve over a grid of weights and at those that were chosen."""
    count = 80
    if not program.closed_form:
        count = 30
    if _slow(program):
        count = 10
    grid = weight_grid(program, count)
    estimates: list[Estimate] = []
    for weight in np.unique([*grid, *(choice.weight for choice in chosen.values() if choice.weight > 0)]):
        with contextlib.suppress(NoSolutionFound):  # far from the chosen weight a solver may fail
            estimates += program.path([weight])
    name, data = next(iter(sets(result).items()))
    problem = result.problem.on(data)
    scale = result.problem.parameters.free.scale
    return Path(
        np.array([estimate.weight for estimate in estimates]),
        np.sqrt([estimate.loss for estimate in estimates]),
        np.sqrt([estimate.penalty for estimate in estimates]),
        [1e3 * float(np.nanmean(problem.errors(scale * estimate.z))) for estimate in estimates],
        name,
    )


def _takers(places: Mapping[str, int]) -> dict[str, str]:
    """Return who takes which solution."""
    takers: dict[int, list[str]] = {}
    for rule, place in places.items():
        takers.setdefault(place, []).append("the chosen weight" if rule == "given" else rule)
    return {str(place): ", ".join(names) for place, names in takers.items()}


def _choices(path: Path, chosen: Mapping[str, Selection], places: Mapping[str, int], selector: str) -> list[list[str]]:
    rows = []
    for rule, choice in sorted(chosen.items(), key=lambda item: item[1].weight):
        name = f"{rule} (chosen)" if rule == selector else rule
        mean = mm(path.error[places[rule]]) if rule in places else ""
        rows.append([name, f"{choice.weight:.3g}", mean, choice.note or WHY.get(rule, "given")])
    return rows
