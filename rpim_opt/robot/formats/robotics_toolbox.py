"""Links of a script for the Robotics Toolbox, as a DH table in rad and m; base and tool are left out.

Read are MATLAB's ``L(1) = Link([theta d a alpha sigma offset], 'modified')``, ``Revolute(...)``, ``PrismaticMDH(...)``,
``Link('d', 0.4, 'a', 0.025, 'alpha', -pi/2)``, and Python's ``RevoluteDH(d=0.4, a=0.025, alpha=-pi/2)``,
``PrismaticMDH(...)``, ``DHLink(...)``: standard convention unless called modified. The joint's own variable (theta or
d) is not read; its zero is given by the offset.
"""

from __future__ import annotations

import re
from pathlib import Path

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.layout import RawTable
from rpim_opt.basics.tables import decoded

LINK = re.compile(r"\b(?:DH)?(Link|Revolute|Prismatic)(?:(MDH)|DH)?\s*\(((?:[^()]|\([^()]*\))*)\)")
NAMED = re.compile(r"\b(\w+)(?:'\s*,|\s*=)\s*([^\s,'][^,']*)")
MODIFIED = re.compile(r"'modified'|\bmdh\s*=\s*(True|1)\b")
ORDER = ("theta", "d", "a", "alpha", "sigma", "offset")
HEADERS = {"theta": "theta [rad]", "d": "d [m]", "a": "a [m]", "alpha": "alpha [rad]", "sigma": "type",
           "convention": "convention"}  # fmt: skip


def read_links(path: Path) -> RawTable:
    """Return the table of a script's links, in their order."""
    text = re.sub(r"\.\.\.[^\n]*\n|[%#][^\n]*|\b(?:np|numpy|math)\.", "", decoded(path)[0]).replace('"', "'")
    text = re.sub(r"\b(?:deg2rad|radians)\(([^()]*)\)", r"\1*pi/180", text)
    columns: dict[str, list[str]] = {header: [] for header in HEADERS.values()}
    for kind, craig, inside in LINK.findall(text):
        vector = re.match(r"\s*\[([^\]]*)\]", inside)
        stated = dict(NAMED.findall(inside))
        if vector:
            stated = dict(zip(ORDER, re.split(r"[\s,]+", vector[1].strip()), strict=False))
        if stated.keys().isdisjoint(ORDER) or (not vector and {"theta", "d"} <= stated.keys()):
            accepted = "numbers, Link([0 0.4 0.025 -pi/2]), or names: theta of a joint that slides, d of one that turns"
            raise InputError("a link", f"'{inside.strip()[:40]}'", accepted)
        slides = kind == "Prismatic" or "'prismatic'" in inside or (not vector and "theta" in stated)
        values = {**dict.fromkeys(ORDER, "0"), "sigma": f"{slides:d}", **stated}
        values["theta" if values["sigma"].strip() == "0" else "d"] = values["offset"]
        values["convention"] = "modified" if craig or MODIFIED.search(inside) else "standard"
        for name, header in HEADERS.items():
            columns[header].append(values[name].strip())
    if not columns["convention"]:
        accepted = "L(1) = Link([theta d a alpha], 'modified'), ..., or RevoluteMDH(d=0.4, alpha=pi/2), ..."
        raise InputError("the file", "no link of the Robotics Toolbox", accepted)
    return RawTable(columns)
