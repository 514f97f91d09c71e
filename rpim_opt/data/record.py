"""Where measurements come from, when they were used, and by which versions."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from typing import NamedTuple

from rpim_opt.data.dataset import Dataset
from rpim_opt.data.held_out import HeldOut
from rpim_opt.data.requirement import Requirement

PACKAGES = ("rpim-opt", "numpy", "scipy", "casadi", "cvxpy-base", "clarabel")


class Earlier(NamedTuple):
    """The calibration that another one carries on, and how.

    Its title, when it was made, the digest of its file and its number of rows; the least and the largest value of every
    joint that it measured [rad or m], by robot; the factor on its standard deviations; parameters that were let go, and
    rows of the new data that were left out.
    """

    title: str
    made: str
    digest: str
    rows: int
    ranges: Mapping[str, list[list[float]]]
    inflate: float = 1.0
    let_go: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Record:
    """Where a calibration's data come from, and what was kept apart.

    Parameters
    ----------
    title, source
        What was calibrated, and where every figure comes from.
    validation
        Measurements that no step of the calibration saw.
    files
        SHA-256 of the input files, by name.
    excluded
        Rows that were left out, label to reason.
    simulated
        Whether the measurements are simulated.
    made
        When, UTC (ISO 8601).
    versions
        Of the packages that made it, by name.
    details
        Who measured, when, with which instrument, ... as somebody stated it, by name.
    requirement
        What the robot is accepted by; None where nobody demanded anything.
    held_out
        Rows that were kept apart and judged before they were used; None where validation data are still unused.
    earlier
        The calibrations that this one carries on (`use.update`), the last one last.
    digest
        Of the file that it was read from; empty where there is none.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> record = ro.data.Record("Cell 7", source="Tracker campaign of May", excluded={"P17": "reflector bumped"})
    >>> record.made, sorted(record.dated().versions)[:3]
    ('', ['casadi', 'clarabel', 'cvxpy-base'])
    """

    title: str = ""
    source: str = ""
    validation: Dataset | None = None
    files: Mapping[str, str] = field(default_factory=dict)
    excluded: Mapping[str, str] = field(default_factory=dict)
    simulated: bool = False
    made: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    details: Mapping[str, str] = field(default_factory=dict)
    requirement: Requirement | None = None
    held_out: HeldOut | None = None
    earlier: tuple[Earlier, ...] = ()
    digest: str = ""

    def dated(self) -> Record:
        """Return the record with today's date and versions, unless it has some."""
        if self.made:
            return self
        versions = {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}
        return replace(self, made=datetime.now(UTC).isoformat(timespec="seconds"), versions=versions)
