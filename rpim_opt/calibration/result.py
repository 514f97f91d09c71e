"""The result of a calibration: its settings, numbers and verdict, and their presentation as text."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from rpim_opt.basics.tables import frame_of
from rpim_opt.basics.text import html_table
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.calibration import words
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.calibration.verdict import Verdict, judge, likely_causes, mistakes


@dataclass(frozen=True, eq=False)
class Calibration(Outcome):
    """The result of a calibration.

    Parameters
    ----------
    problem
        The calibration problem, with estimated scales, noise and model extensions.
    formulation
        Loss, penalty and constraints.
    x
        (n,) identified deviations [SI], in the order of ``problem.parameters.free``.
    weight
        The weight of the penalty.
    selection
        The selector's choice with its evidence; None for a number.
    converged
        Whether the loop ended at a solution that the certificate confirms.
    message
        How the loop ended, in a sentence. It is no judgement of the data: that is the `verdict`.
    history
        The iterations, with objective, step and weight.
    program
        The convex program at the last linearization.
    certificate
        Evidence that this is a solution, recomputed from the functions that define it.
    calibrate_again
        `calibrate` with all its arguments except the problem; keywords replace them.
    record
        Origin of the data, for files and reports.
    learned
        Estimated hyperparameters: scales and noise, model extensions, excluded rows; None with a weight.
    mapping
        Signs and zeros of the joints estimated from the data; None if the nominal ones explain them.
    excluded
        The rows excluded as outliers; None without any, for data in blocks and for a result read from a file.
    known
        Values of ``causes``, ``active_bounds``, ``shadow_prices`` and ``squares`` that are not computed: for a result
        read from a file its causes, and those of a script's functions, which a file cannot hold.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> result = ro.calibrate(instance.problem, ro.tikhonov, weight=ro.l_curve)
    >>> for name, errors in (("nominal", result.nominal_errors), ("identified", result.errors)):
    ...     print(f"{name:10} {1e3 * errors(instance.validation).mean():.3f} mm")
    nominal    2.649 mm
    identified 0.032 mm
    >>> print(result.selector, result.verdict)
    l_curve Delivered.
    """

    @cached_property
    @one_blas_thread
    def verdict(self) -> Verdict:
        """Whether this robot is delivered, and the reasons if not; exports, exit codes and reports follow it."""
        return judge(self, mistakes(self.causes))

    @cached_property
    @one_blas_thread
    def causes(self) -> tuple[str, ...]:
        """Likely causes of a poor fit, one sentence each (`likely_causes`)."""
        return tuple(likely_causes(self))

    def weight_sentence(self) -> str:
        """Return a sentence on the weight and its origin."""
        return " ".join(words.weight_lines(self))

    def to_frame(self) -> Any:
        """Return the parameters as a data frame (pandas, or polars if pandas is not installed).

        >>> import rpim_opt as ro
        >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=1.0)
        >>> list(result.to_frame().columns)
        ['parameter', 'unit', 'nominal', 'identified', 'deviation', 'std']
        """
        return frame_of(self.parameter_rows())

    def __str__(self) -> str:
        return "\n".join([words.parameter_table(self), "", *words.sentences(self, self.verdict)])

    def __repr__(self) -> str:
        ending = self.message if self.verdict.delivered else f"Not delivered. {self.verdict.reasons[0]}"
        return f"<Calibration '{self.formulation.name}', {len(self.x)} parameters, weight {self.weight:.4g}: {ending}>"

    def _repr_html_(self) -> str:
        """Return the same as the text for a notebook."""
        title = repr(self).strip("<>")
        return html_table(*words.columns(self), notes=words.sentences(self, self.verdict), title=title)
