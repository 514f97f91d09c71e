"""The report's evidence: what the data can tell, which rows stand out, how the loop came to rest."""

from __future__ import annotations

from rpim_opt.basics.exceptions import RpimError
from rpim_opt.calibration.result import Calibration
from rpim_opt.problem.observability import combination, observe
from rpim_opt.report.charts_weight import picard_chart
from rpim_opt.report.frame import bullets, data_table, section
from rpim_opt.report.markup import Element, tag
from rpim_opt.report.pieces import figure
from rpim_opt.report.scales import mm

DIRECTIONS = "At the solution: the penalty holds directions below the line; data near 1 are noise (Picard's condition)."


def identifiability_section(result: Calibration) -> list[Element]:
    """Return what the data can tell apart at nominal, and along which directions at the solution."""
    found = observe(result.problem)
    n = len(found.names)
    text = f"{found.configurations} configurations, {result.program.model.equations} equations for {n} parameters, "
    text += f"of which the data determine {found.rank} combinations at nominal."
    told = [f"No measurement changes along {combination(each)} [mm, mrad]." for each in found.redundant]
    if result.record.earlier:
        text += " Of the others the calibrations that this one carries on say what they can."
        told = []
    elif found.rank < n:
        text += " What follows cannot be told apart: the penalty shares it out, and predictions do not depend on it."
    if found.unseen:
        told.insert(0, f"No measurement depends on {', '.join(found.unseen)}.")
    indices = ", ".join(f"{name} {value:.3g}" for name, value in found.indices.items())
    condition = f"Condition number of these: {found.condition:.3g}. Observability indices: {indices}."
    return section(
        "What the data can tell",
        tag("p", text),
        *bullets(told),
        tag("p", condition),
        tag("div", figure(picard_chart(result.program, result.penalty_weight), DIRECTIONS), class_="figures"),
    )


MOST = 200
"""Distrusted rows that are named, the worst first: nobody reads on."""


def distrusted_section(result: Calibration) -> list[Element]:
    """Return the rows that stand out, and those that were left out."""
    flagged = result.flagged
    rows = [[f.label, f"{f.sigmas:.1f}", mm(f.error_mm), "distrusted, in the data"] for f in flagged[:MOST]]
    if len(flagged) > MOST:
        rows.append([f"and {len(flagged) - MOST} more", "", "", "distrusted, in the data; result.json names them"])
    rows += [[label, "", "", f"left out: {reason}"] for label, reason in result.record.excluded.items()]
    if not rows:
        text = "No row stands out beyond what one good set of data in a hundred would show, and none was left out."
        return section("Distrusted rows", tag("p", text))
    head = ["row", "residual [sigmas]", "error [mm]", "what became of it"]
    return section("Distrusted rows", data_table("Rows that stand out or were left out", head, rows, prose=True))


def convergence_section(result: Calibration) -> list[Element]:
    """Return how the loop came to rest, and the evidence that it is a solution."""
    rows = [
        [str(k), f"{it.objective:.8g}", f"{it.step:.2e}", f"{it.weight:.4g}"]
        for k, it in enumerate(result.history, start=1)
    ]
    try:
        c = result.certificate
        lines = [] if c.gradient is None else [f"gradient of the nonlinear problem {c.gradient:.1e} of that at nominal"]
        lines += [
            f"step that the convex program would still take {c.step:.1e}",
            f"constraints missed by {c.violation:.1e}",
        ]
        said = f"Checked anew at the solution: {', '.join(lines)} (in units of the scales)."
    except RpimError as error:
        said = f"The solution cannot be checked anew. {error}"
    return section(
        "Convergence", tag("p", f"{result.message} {said}"),
        data_table("Passes of the loop", ["pass", "objective", "step [scales]", "weight"], rows),
    )  # fmt: skip
