"""What a comparison found: its replicates, and the tables, figures and pages that they become."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.tables import frame_of
from rpim_opt.study.journal import Row
from rpim_opt.study.pairs import figures, standings
from rpim_opt.study.replicate import NUMBERS
from rpim_opt.study.standing import Summary, notes_of


@dataclass(frozen=True, eq=False)
class Comparison:
    """Replicates of methods on problems, one row each.

    Parameters
    ----------
    rows
        Plain tables: ``problem``, ``method``, ``formulation``, ``selector``, ``split``, ``fold``, ``count`` and
        ``noise_factor`` (as asked), ``seed``; ``status`` (``ok``, ``not converged``, ``impossible``, ``failed``) with
        its ``reason``; ``configurations`` and ``parameters`` that were fitted, the ``weight``, and the metrics.
    metrics
        Their columns; summaries are of the first.
    drawn
        Problems that every seed draws anew.
    asked
        The axes of the grid, in words.
    made
        What made the rows: script, package, versions and time.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> def arms(seed):
    ...     return ro.study.simulated_arm(seed, count=15)
    >>> found = ro.compare(arms, selectors=["learned", "reml"], seeds=5)
    >>> found
    Comparison: 2 methods on 1 problem, 10 replicates (10 ok)
    >>> found.metric, found.reference(), found.methods, found.problems
    ('rms_mm', 'tikhonov, learned', ('tikhonov, learned', 'tikhonov, reml'), ('arms',))
    >>> best = found.summary().standings[0]
    >>> best.method, len(found.to_frame()), len(found.plot("max_mm").axes)
    ('tikhonov, learned', 10, 2)
    >>> page = found.report("arms_compared")
    >>> page.name, sorted(path.name for path in page.parent.iterdir())
    ('index.html', ['comparison.png', 'comparison.svg', 'index.html', 'replicates.csv'])
    """

    rows: tuple[Row, ...]
    metrics: tuple[str, ...]
    drawn: frozenset[str] = frozenset()
    asked: Mapping[str, str] = field(default_factory=dict)
    made: Mapping[str, str] = field(default_factory=dict)

    @property
    def metric(self) -> str:
        """What summaries are of, unless they are asked for another."""
        return self.metrics[0]

    @property
    def methods(self) -> tuple[str, ...]:
        """The labels of the methods, in the order they were asked."""
        return tuple(dict.fromkeys(row["method"] for row in self.rows))

    @property
    def problems(self) -> tuple[str, ...]:
        """The labels of the problems, in the order they were asked."""
        return tuple(dict.fromkeys(row["problem"] for row in self.rows))

    def to_frame(self) -> Any:
        """Return the rows as a data frame (pandas, or polars where that is missing), one row a replicate."""
        return frame_of(self.rows)

    def summary(self, metric: str | None = None, against: str | None = None) -> Summary:
        """Return the methods in their order, each against a reference on the same replicates.

        Parameters
        ----------
        metric
            A column that is above zero and the less the better; the first metric by default.
        against
            The reference's label; by default the first method that was asked and has figures.

        Raises
        ------
        InputError
            For an unknown metric or method, or where nothing has figures.
        """
        metric = self._metric(metric)
        reference = self.reference(metric, against)
        every = standings(self.rows, metric, reference, self.drawn)
        known = [each for each in every if each.median is not None]
        known.sort(key=lambda each: (each.ratio is None, each.ratio, each.median))
        return Summary(metric, reference, tuple(known), notes_of(self.rows, known, self.drawn, reference))

    def plot(self, metric: str | None = None, against: str | None = None) -> Any:
        """Return a matplotlib figure: every method's errors over the reference's, in pairs, and performance profiles.

        Arguments and errors as for `summary`.
        """
        from rpim_opt.study.drawing import drawn

        return drawn(self.rows, self.summary(metric, against))

    def report(self, folder: str | Path, metric: str | None = None, against: str | None = None) -> Path:
        """Write a page ``index.html`` that needs no network, with ``replicates.csv`` and the figure; return its path.

        Parameters
        ----------
        folder
            Where; it is made.
        metric, against
            As for `summary`.
        """
        from rpim_opt.study.page import write_page

        return write_page(Path(folder), self.rows, self.summary(metric, against), self.asked, self.made)

    def reference(self, metric: str | None = None, against: str | None = None) -> str:
        """Return the label of the method that others are compared with; arguments as for `summary`."""
        of = figures(self.rows, self._metric(metric))
        if against is None:
            known = [method for method, values in of.items() if values]
            if not known:
                first = self.rows[0]
                raise InputError(
                    "comparison", f"no replicate with figures; {first['status']}: {first['reason']}", "one"
                )
            return known[0]
        if against not in of:
            raise InputError("against", f"'{against}'", choices(against, of))
        if not of[against]:
            raise InputError("against", f"'{against}', which has no figures", "a method that has some")
        return against

    def _metric(self, metric: str | None) -> str:
        if metric is None:
            return self.metric
        if metric not in self.metrics:
            raise InputError("metric", f"'{metric}'", choices(metric, self.metrics))
        return metric

    def __repr__(self) -> str:
        """Return one line."""
        counts = Counter(row["status"] for row in self.rows)
        said = ", ".join(f"{count} {status}" for status, count in counts.items())
        what = f"{_counted(len(self.methods), 'method')} on {_counted(len(self.problems), 'problem')}"
        return f"Comparison: {what}, {len(self.rows)} replicates ({said})"

    def __str__(self) -> str:
        """Return that line, and the summary where there is one."""
        if any(row["status"] in NUMBERS for row in self.rows):
            return f"{self!r}\n\n{self.summary()}"
        return repr(self)

    def _repr_html_(self) -> str | None:
        """Return the summary for a notebook."""
        if any(row["status"] in NUMBERS for row in self.rows):
            return f"<p><b>{self!r}</b></p>{self.summary()._repr_html_()}"
        return None


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
