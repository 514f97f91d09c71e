"""Figures on matplotlib axes, for papers and notebooks: each draws on ``ax`` or on new axes, and returns them."""

from __future__ import annotations

from rpim_opt.show.plot_result import error_axes, error_histogram, error_vectors, errors, parameters
from rpim_opt.show.plot_weight import l_curve, picard, selection, selectors

__all__ = [
    "error_axes",
    "error_histogram",
    "error_vectors",
    "errors",
    "l_curve",
    "parameters",
    "picard",
    "selection",
    "selectors",
]
