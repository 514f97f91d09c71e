"""What checks over time say: whether the robot drifts, since when, and what moved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.tables import csv_text
from rpim_opt.basics.text import listed
from rpim_opt.basics.units import display
from rpim_opt.use.cusum import since
from rpim_opt.use.drifts import Drift

RARE = 0.01
"""Probability that a robot that does not drift is said to."""


@dataclass(frozen=True, eq=False)
class Monitoring:
    """Checks of a robot in the order of time, against what its calibration predicts.

    Parameters
    ----------
    label, times
        Names of the N checks, and their times as the table states them; empty without.
    when
        (N,) times [s]; None without.
    error
        (N,) errors against the calibration [m].
    sigmas, allowed
        (N,) what a check misses beyond the calibration and the checks before it, in standard deviations of a new
        reading, and what one of all N passes rarely.
    sums, limit
        (N,) their cumulative sum (`cusum.cumulative`), and what it passes rarely.
    drift
        The change that explains them best; None where chance does.
    mistake
        Another reading of the checks that fits far better, in a sentence; empty where there is none.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> found = ro.use.monitor(ro.calibrate(instance.problem), instance.validation)
    >>> found.alarm, found.beyond, str(found).splitlines()[0]
    (None, (), 'No drift in 40 checks.')
    """

    label: tuple[str, ...]
    times: tuple[str, ...]
    when: Array | None
    error: Array
    sigmas: Array
    allowed: Array
    sums: Array
    limit: float
    drift: Drift | None = None
    mistake: str = ""

    @property
    def beyond(self) -> tuple[int, ...]:
        """Checks that miss their prediction by more than a new reading may."""
        return tuple(int(i) for i in np.flatnonzero(self.sigmas > self.allowed))

    @property
    def alarm(self) -> int | None:
        """The first check at which the sum passes its limit; None where it does not."""
        passed = np.flatnonzero(self.sums > self.limit)
        if not len(passed):
            return None
        return int(passed[0])

    @property
    def drifts(self) -> bool:
        """Whether the robot is not where its calibration says: one check, their sum, or a parameter says so.

        >>> import rpim_opt as ro
        >>> instance = ro.load("position")
        >>> ro.use.monitor(ro.calibrate(instance.problem), instance.validation).drifts
        False
        """
        return bool(self.beyond) or self.alarm is not None or self.drift is not None

    def content(self) -> dict[str, Any]:
        """Return the figures, and the chart's points [mm].

        >>> import rpim_opt as ro
        >>> instance = ro.load("position")
        >>> found = ro.use.monitor(ro.calibrate(instance.problem), instance.validation).content()
        >>> found["drifts"], found["checks"], list(found["rows"][0])
        (False, 40, ['label', 'error_mm', 'sigmas', 'allowed_sigmas', 'sum'])
        """
        alarm = None
        began = None
        moved = None
        if self.alarm is not None:
            alarm = self.label[self.alarm]
            began = self.label[since(self.sums, self.alarm)]
        if self.drift is not None:
            moved = {**self.drift.content(), "label": self.label[self.drift.first]}
        return {
            "drifts": self.drifts,
            "checks": len(self.label),
            "beyond": [self.label[i] for i in self.beyond],
            "alarm": alarm,
            "since": began,
            "limit": self.limit,
            "moved": moved,
            "mistake": self.mistake,
            "rows": self._rows(),
        }

    def csv(self) -> str:
        """Return the chart's points as CSV.

        >>> import rpim_opt as ro
        >>> instance = ro.load("position")
        >>> ro.use.monitor(ro.calibrate(instance.problem), instance.validation).csv().splitlines()[0]
        'label,error_mm,sigmas,allowed_sigmas,sum'
        """
        rows = self._rows()
        return csv_text(list(rows[0]), [[str(cell) for cell in row.values()] for row in rows])

    def __str__(self) -> str:
        """Return the verdict in words."""
        count = f"{len(self.label)} checks"
        worst = int(np.argmax(self.sigmas / self.allowed))
        figures = (
            f"Largest miss: {self._named(worst)}, {self.sigmas[worst]:.1f} standard deviations of a new reading "
            f"({self.allowed[worst]:.1f} allowed), {1e3 * self.error[worst]:.3f} mm. "
            f"Largest sum: {self.sums.max():.1f} ({self.limit:.1f} allowed)."
        )
        if not self.drifts:
            return f"No drift in {count}.\n{figures}"
        return "\n".join([f"The robot is not where its calibration says, in {count}.", *self._alarms(), figures])

    def _alarms(self) -> list[str]:
        lines = []
        if self.beyond:
            named = [f"{self._named(i)}, {1e3 * self.error[i]:.3f} mm" for i in self.beyond]
            lines.append(f"Beyond the interval of a new reading: {listed(named, between='; ')}.")
        alarm = self.alarm
        if alarm is not None:
            began = since(self.sums, alarm)
            lines.append(f"What checks miss adds up: alarm at {self._named(alarm)}, since {self._named(began)}.")
        if self.drift is None:
            lines.append("No parameter and no frame explains it alone.")
        else:
            lines.append(self._moved(self.drift))
        if self.mistake:
            lines.append(self.mistake)
        return lines

    def _moved(self, drift: Drift) -> str:
        text = f"Best explained by {drift.cause.kind} {drift.cause.name}"
        if drift.change is not None and drift.std is not None:
            unit, si = display(drift.dimension)
            text += f", {drift.change / si:+.3g} {unit} (standard deviation {drift.std / si:.2g})"
        course = f"at once before {self._named(drift.first)}"
        if drift.steady:
            course = "steadily from the first to the last check"
        if not drift.steady and drift.first == 0:
            course = "before the first check"
        evidence = f"chi-squared falls by {drift.cause.gain:.1f}, by chance with probability {drift.cause.chance:.2g}"
        return f"{text}, {course}: {evidence}."

    def _named(self, i: int) -> str:
        if self.times:
            return f"{self.label[i]} ({self.times[i]})"
        return f"'{self.label[i]}'"

    def _rows(self) -> list[dict[str, Any]]:
        rows = []
        for i, label in enumerate(self.label):
            row: dict[str, Any] = {"label": label}
            if self.times:
                row["time"] = self.times[i]
            figures = {"error_mm": 1e3 * self.error[i], "sigmas": self.sigmas[i], "allowed_sigmas": self.allowed[i]}
            row |= {key: round(float(value), 6) for key, value in figures.items()}
            rows.append({**row, "sum": round(float(self.sums[i]), 6)})
        return rows
