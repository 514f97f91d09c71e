"""Record of a calibration: origin of the data, requirement on the robot, and validation before a final fit."""

from __future__ import annotations

import platform
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import joined, three_digits, version_of
from rpim_opt.data.dataset import Dataset

PACKAGES = ("rpim-opt", "numpy", "scipy", "casadi", "cvxpy-base", "clarabel")
Side = tuple[float, float]
CONFIDENCE = 0.95  # default probability with which a limit has to be kept
UNLIKELY = 0.01  # p-value below which readings contradict stated or predicted values


@dataclass(frozen=True)
class Requirement:
    """A tolerance on the position error, and the region where it applies.

    ``limit`` [m] bounds the distance between the reached position and the model's prediction, with probability
    ``confidence`` at every configuration of the region: the nominal reflector in a ``box``, sides (low, high) along x,
    y, z [m] in the robot's base frame, anywhere by default; ``joints`` within (low, high) [rad or m], by number from 1,
    other joints within the measured ranges; ``measured``: only at the measured configurations there. ``marker`` is the
    reflector, by default the first. InputError for a limit or confidence that nothing can meet, and sides that are not
    (low, high).

    >>> import rpim_opt as ro
    >>> print(ro.data.Requirement(1e-4, box=((0.3, 0.8), (-0.2, 0.2), (0.0, 0.5))).where)
    the box x 300 to 800, y -200 to 200, z 0 to 500 mm of the base frame, joints within the measured ranges
    """

    limit: float
    box: tuple[Side, Side, Side] | None = None
    joints: tuple[tuple[int, Side], ...] = ()
    marker: str = ""
    confidence: float = CONFIDENCE
    measured: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.limit < float("inf"):
            raise InputError("limit", f"{1e3 * self.limit:g} mm", "a number greater than zero")
        if not 0.5 <= self.confidence < 1:
            raise InputError("confidence", f"{self.confidence:g}", "a probability from 0.5 to below 1")
        named = [(f"joint {joint}", side) for joint, side in self.joints]
        named += zip("xyz", self.box, strict=True) if self.box is not None else ()
        for name, (low, high) in named:
            if not low < high:
                raise InputError(name, f"from {low:g} to {high:g}", "two numbers, the smaller one first")

    @property
    def where(self) -> str:
        """The region as text."""
        box = "the measured configurations alone, " if self.measured else ""
        if self.box is not None:
            sides = [f"{axis} {1e3 * a:g} to {1e3 * b:g}" for axis, (a, b) in zip("xyz", self.box, strict=True)]
            box += f"the box {', '.join(sides)} mm of the base frame, "
        if not self.joints:
            return f"{box}joints within the measured ranges"
        limited = ", ".join(str(joint) for joint, _ in self.joints)
        return f"{box}joints {limited} within the stated ranges, others within the measured ones"


class Fit(NamedTuple):
    """Chi-squared of readings about their predictions, its number of equations, and its p-value."""

    squares: float
    equations: int
    probability: float

    @classmethod
    def of(cls, squares: float, equations: int, dof: float) -> Fit:
        """Return the fit by Fisher's F, with predictions whose noise has ``dof`` degrees of freedom."""
        return cls(squares, equations, float(fdtrc(equations, max(dof, 1.0), squares / equations)))

    @property
    def likely(self) -> bool:
        """Whether the errors are consistent with chance."""
        return self.probability >= UNLIKELY

    def __str__(self) -> str:
        squares = f"chi-squared {three_digits(self.squares)}"
        return f"{squares}, {self.equations} degrees of freedom, p-value {self.probability:.2g}"


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Errors of a calibration on N rows that it did not use.

    A record keeps them when a final fit also uses these rows: they then validate the procedure, while the delivered
    parameters come from all rows.

    ``used`` is the number of rows behind the parameters; ``nominal`` and ``error`` (N,) are errors before and after
    [m], NaN for rows that measure no length, ``angle`` (N,) those of orientations after [rad], NaN for rows that are
    not poses. ``sigmas`` (N,) are |S^-1/2 r| of a row's residual r, with S = J C J' + the covariance of a reading (of
    the instrument, as stated for the row, and repeatability) and C the calibration's covariance; ``allowed`` (N,) are
    limits by Fisher's F, exceeded by any of the N with probability 0.01. Both are NaN if the calibration has no
    covariance, or none in a direction that the row depends on. ``coverage`` is the share of lengths in the 95 %
    interval of a reading, ``fit`` the agreement of all equations with their joint prediction, S of all rows; both
    disregard rows that a final fit excludes, and are None without covariance.
    """

    label: tuple[str, ...]
    used: int
    nominal: Array
    error: Array
    angle: Array
    sigmas: Array
    allowed: Array
    coverage: float | None = None
    fit: Fit | None = None

    @property
    def contradiction(self) -> str:
        """A sentence if the rows contradict the calibration, by more than chance explains; otherwise empty."""
        if self.fit is None or self.fit.likely:
            return ""
        return f"Together the rows contradict the calibration: {self.fit}."


class Earlier(NamedTuple):
    """The earlier calibration that served as the prior.

    Its title, date, file digest and number of rows; smallest and largest measured value of every joint [rad or m], by
    robot; the factor on its standard deviations; released parameters; excluded rows of the new data; sentences on
    parameters that these leave undetermined, and on unexplained rows.
    """

    title: str
    made: str
    digest: str
    rows: int
    ranges: Mapping[str, list[list[float]]]
    prior_inflation: float = 1.0
    released: tuple[str, ...] = ()
    excluded: tuple[str, ...] = ()
    unresolved: tuple[str, ...] = ()

    @property
    def changed(self) -> str:
        """The released parameters as a text, coefficients of a joint's transmission error as ``transmission2_*``."""
        names = dict.fromkeys(re.sub(r"(transmission\d+_)\w+$", r"\1*", name) for name in self.released)
        return joined(list(names)) if names else "no detectable change"


@dataclass(frozen=True, eq=False)
class Record:
    """Where a calibration's data come from, and what was held out.

    ``title`` and ``source`` name what was calibrated and the origin of its data. ``validation`` are measurements that
    no step of the calibration used, ``files`` the SHA-256 of the input files by name, ``excluded`` maps labels of
    excluded rows to reasons; ``simulated`` states whether the measurements are, ``noise_assumed`` whether their noise
    is a guess. ``made`` is the time (UTC, ISO 8601), ``versions`` those of packages. ``details`` state who measured,
    when and with which instrument, in free text.

    ``requirement`` is the tolerance to be met, if any; ``held_out`` are rows judged before a final fit used them, None
    while validation data are unused; ``earlier`` are the calibrations that this one continues (`use.update`), latest
    last; ``digest`` is that of the file that the record was read from. Later tables are read with the options
    ``reading`` (`TableOptions.stated`); ``terms`` are those of a Python file in the problem's folder, ``mine:droop``;
    ``known`` are stated parameter values in the prior. D D' of ``opened`` (n, k) is the covariance [SI] of what an
    update left where it was.

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
    noise_assumed: bool = False
    made: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    details: Mapping[str, str] = field(default_factory=dict)
    requirement: Requirement | None = None
    held_out: HeldOut | None = None
    earlier: tuple[Earlier, ...] = ()
    digest: str = ""
    reading: Mapping[str, str] = field(default_factory=dict)
    terms: tuple[str, ...] = ()
    known: tuple[str, ...] = ()
    opened: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def identity(self) -> str:
        """Title, robot, date and digest, by which a file names the calibration that it follows from."""
        serial, made = self.details.get("robot_serial"), self.dated().made[:10]
        named = {"": self.title, "robot serial number ": serial, "calibrated ": made, "digest ": self.digest[:12]}
        return ", ".join(word + text for word, text in named.items() if text)

    def dated(self) -> Record:
        """Return the record with today's date and versions, unless it has some."""
        if self.made:
            return self
        versions = {"python": platform.python_version(), **{name: version_of(name) for name in PACKAGES}}
        return replace(self, made=datetime.now(UTC).isoformat(timespec="seconds"), versions=versions)
