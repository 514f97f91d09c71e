"""A page of checks over time: each against the interval of a new reading, and their cumulative sum with its limit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.writing import refused, write_text
from rpim_opt.report.chart import Axis, Chart, Dots, Line, Mark
from rpim_opt.report.frame import data_table, page, section
from rpim_opt.report.markup import Element, tag
from rpim_opt.report.pieces import figure
from rpim_opt.report.scales import mm
from rpim_opt.use.monitored import Monitoring

DAY, HOUR = 86400.0, 3600.0


def write_checks(found: Monitoring, path: str | Path, title: str = "") -> None:
    """Write checks over time as one HTML page that works offline: the verdict, two charts, every check.

    Parameters
    ----------
    found
        As `use.monitor` returns it.
    path
        The file; whole or not written at all.
    title
        What was calibrated.

    Examples
    --------
    >>> from pathlib import Path
    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> found = ro.use.monitor(ro.calibrate(instance.problem), instance.validation)
    >>> ro.report.write_checks(found, "checks.html", "Cell 7")
    >>> "No drift in 40 checks." in Path("checks.html").read_text(encoding="utf-8")
    True
    """
    place, axis = _times(found)
    verdict, *rest = str(found).splitlines()
    lead = tag("p", verdict, class_="lead alarm" if found.drifts else "lead")
    figures = [
        figure(_misses(found, place, axis), "Each alone, by what the checks before it leave open."),
        figure(_sums(found, place, axis), "Together (CUSUM)."),
    ]
    parts = [
        *section("Verdict", lead, *(tag("p", line) for line in rest)),
        *section("Over time", tag("div", *figures, class_="figures")),
        *section("Every check", _table(found)),
    ]
    name = title or "Checks"
    write_text(Path(path), page(f"Checks: {name}", "Checks of a calibrated robot", name, parts))


def written_checks(found: Monitoring, out: Path | None, title: str) -> list[Path]:
    """Write the page, or its points where the file is a table; nothing without a file."""
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


def _times(found: Monitoring) -> tuple[Array, Axis]:
    """Return where checks stand on the axis of time, and that axis."""
    count = len(found.label)
    if found.when is None or not np.ptp(found.when) > 0:
        place = np.arange(1, count + 1, dtype=float)
        return place, Axis("check", (1, max(count, 2)))
    span = float(np.ptp(found.when))
    unit, name = 1.0, "seconds"
    if span > 2 * HOUR:
        unit, name = HOUR, "hours"
    if span > 2 * DAY:
        unit, name = DAY, "days"
    place = (found.when - found.when[0]) / unit
    return place, Axis(f"{name} since the first check", (0.0, float(place[-1])))


def _table(found: Monitoring) -> Element:
    """Return every check; figures beyond their limits say so."""
    sigmas = [f"{value:.1f}" for value in found.sigmas]
    for i in found.beyond:
        sigmas[i] = f"beyond {sigmas[i]}"
    sums = [f"{value:.1f}" for value in found.sums]
    if found.alarm is not None:
        sums[found.alarm] = f"alarm {sums[found.alarm]}"
    columns: dict[str, Sequence[str]] = {"check": found.label}
    if found.times:
        columns["time"] = found.times
    columns |= {"error [mm]": [mm(1e3 * error) for error in found.error], "sigmas": sigmas, "sum": sums}
    return data_table("In the order of time", list(columns), list(zip(*columns.values(), strict=True)))


def _misses(found: Monitoring, place: Array, axis: Axis) -> Chart:
    """Return what every check misses, in standard deviations of a new reading, and what one of all may."""
    high = float(max(found.sigmas.max(), found.allowed.max()))
    hints = [
        f"{label}: {sigmas:.1f} standard deviations, {mm(1e3 * error)} mm"
        for label, sigmas, error in zip(found.label, found.sigmas, found.error, strict=True)
    ]
    beyond = np.isin(np.arange(len(place)), found.beyond)
    marks: list[Mark] = [Line(place, found.allowed, "mark", "limit, checks beyond it")]
    for which, role, said in ((~beyond, "after", "check"), (beyond, "mark", "")):
        at = np.flatnonzero(which)
        if len(at):
            marks.append(Dots(place[at], found.sigmas[at], role, said, [hints[i] for i in at]))
    y = Axis("standard deviations", (0.0, 1.05 * high))
    return Chart("What every check misses, and what it may", axis, y, marks)


def _sums(found: Monitoring, place: Array, axis: Axis) -> Chart:
    """Return the cumulative sum, its limit, and where it passes that first."""
    high = float(max(found.sums.max(), found.limit))
    marks: list[Mark] = [
        Line(place, np.full(len(place), found.limit), "mark", "limit, alarm"),
        Line(place, found.sums, "after", "sum"),
    ]
    alarm = found.alarm
    if alarm is not None:
        marks.append(Dots(place[[alarm]], found.sums[[alarm]], "mark", hints=[f"alarm at {found.label[alarm]}"]))
    title = "Cumulative sum of what checks miss, and its limit"
    return Chart(title, axis, Axis("sum", (0.0, 1.05 * high)), marks)
