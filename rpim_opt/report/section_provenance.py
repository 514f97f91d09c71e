"""The report's provenance: whose measurements, which files, what was minimized, by which versions."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Block
from rpim_opt.data.record import Earlier
from rpim_opt.report.frame import data_table, facts, section
from rpim_opt.report.markup import Element, tag
from rpim_opt.report.pieces import sets
from rpim_opt.robot.mdh import Robot
from rpim_opt.store.result_file import definition
from rpim_opt.store.statements import FIELDS


def provenance_section(result: Calibration) -> list[Element]:
    """Return where the measurements come from and what was minimized."""
    record = result.record
    said = {
        "Source": record.source or "not stated",
        "Measurements": "simulated" if record.simulated else "as the source says; not marked as simulated",
        "Robot": "; ".join(_robot(name, robot) for name, robot in result.problem.arms.items()),
        "Formulation": f"{result.formulation.name}: {_formulation(result)}",
        "Made": record.made,
        "Versions": ", ".join(f"{name} {version}" for name, version in record.versions.items()),
    }
    return section(
        "Where the data come from",
        facts(list(said.items())),
        *_tables(result),
        tag(
            "p",
            "All figures on this page were computed from the measurements and parameters of the calibration when "
            "the page was written.",
        ),
    )


def _tables(result: Calibration) -> list[Element]:
    """Return the measurements, the files and the earlier calibrations that a result rests on."""
    record = result.record
    count: Counter[tuple[str, str]] = Counter()
    for name, data in sets(result).items():
        for block in data.blocks:
            what = " ".join(filter(None, [block.measurement.name, *block.markers, block.fixture]))
            count[f"{name}, {what}", _noise(block)] += len(block.row)
    rows = [[what, str(number), noise] for (what, noise), number in count.items()]
    caption = "Measurements and their declared standard deviations"
    tables = [data_table(caption, ["data", "rows", "declared"], rows, prose=True)]
    if record.files:
        files = [[name, digest] for name, digest in record.files.items()]
        tables.append(data_table("Input files", ["file", "SHA-256"], files, prose=True))
    if record.earlier:
        earlier = [[each.title, each.made, str(each.rows), _carried(each), each.digest] for each in record.earlier]
        head = ["calibration", "made", "rows", "changed since", "digest"]
        tables.append(data_table("Carries on", head, earlier, prose=True))
    return tables


def stated_details(result: Calibration) -> list[Element]:
    """Return who measured, when, with what, ..., as somebody stated it; nothing where nobody did."""
    details = result.record.details
    if not details:
        return []
    return [facts([(FIELDS.get(key, key), text) for key, text in details.items()])]


def _carried(each: Earlier) -> str:
    """Return what changed since an earlier calibration, and how far it was trusted."""
    said = [", ".join(each.let_go) or "nothing that readings show"]
    if each.inflate != 1:
        said.append(f"standard deviations times {each.inflate:g}")
    return "; ".join(said)


def _robot(name: str, robot: Robot) -> str:
    """Return a robot in words, with what it is called where there are several."""
    called = f"{name}: {robot.name}" if name else robot.name
    return " - ".join(filter(None, [called, f"{robot.dof} joints", robot.source]))


def _formulation(result: Calibration) -> str:
    """Return what is minimized, in the words of the result's file."""

    def said(term: Any) -> str:
        if isinstance(term, list):
            return f"{term[0]}({', '.join(map(str, term[1:]))})"
        return term or "a function of a script, not in the file"

    parts = definition(result.formulation)
    over = "" if parts["penalty_over"] == "none" else f" over {said(parts['penalty_over'])}"
    text = f"loss {said(parts['loss'])} of each {parts['loss_over']}, penalty {said(parts['penalty'])}{over}"
    bounds = [said(c) for c in parts["constraints"]]
    bounds += [] if parts["largest"] is None else [f"no configuration off by more than {parts['largest']:g} sigmas"]
    return f"{text}, constraints: {', '.join(bounds) or 'none'}"


def _noise(block: Block) -> str:
    """Return the declared standard deviations, by component, as a range where rows differ."""
    spread = np.sqrt(np.einsum("nii->ni", block.covariance))
    said: dict[str, list[str]] = {}
    for i, (name, dimension) in enumerate(block.measurement.components.items()):
        unit, si = {"length": ("mm", 1e-3), "angle": ("mrad", 1e-3)}.get(dimension, ("", 1.0))
        low = spread[:, i].min() / si
        high = spread[:, i].max() / si
        figure = f"{low:.3g}" if high < 1.005 * low else f"{low:.3g} to {high:.3g}"
        said.setdefault(f"{figure} {unit}".strip(), []).append(name)
    return "; ".join(f"{figure} ({', '.join(names)})" for figure, names in said.items())
