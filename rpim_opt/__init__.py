"""Robot calibration by convex optimization.

Names are imported when they are first used, so that ``import rpim_opt`` costs nothing. What most scripts need is here;
the rest is in the folders (``ro.use.compensate``), in ``ro.select``, ``ro.constraints``, ``ro.plot`` and
``ro.baselines``.
"""

from __future__ import annotations

from typing import Any

import lazy_loader

__version__ = "0.1.0"

_attach, _, _names = lazy_loader.attach_stub(__name__, __file__)
_FOLDERS = ("basics", "robot", "data", "problem", "convex", "calibration", "store", "use", "study", "show")
_NAMESPACES = (*_FOLDERS, "baselines", "constraints", "plot", "select")
__all__ = sorted(set(_names) - set(_NAMESPACES))
_MOVED = {
    "basics": ("RpimError",),
    "calibration": ("Calibration", "Uncertainty", "monte_carlo"),
    "constraints": ("Box", "at_nominal", "by_kind", "by_link", "differences", "equal", "signed"),
    "data": ("LaserTracker", "Measurement", "Record"),
    "plot": (
        "plot_error_axes",
        "plot_error_histogram",
        "plot_error_vectors",
        "plot_errors",
        "plot_l_curve",
        "plot_parameters",
        "plot_picard",
        "plot_selection",
        "plot_selectors",
    ),
    "problem": (
        "Design",
        "Inspection",
        "LinearModel",
        "Observability",
        "PartitionedProblem",
        "choose",
        "hand_eye",
        "inspect",
        "observe",
        "on_cluster",
        "partitions",
        "random_candidates",
        "register",
        "starting_parameters",
        "tool_from_distances",
    ),
    "robot": (
        "Described",
        "Parameters",
        "Robot",
        "forward_kinematics",
        "model_parameters",
        "without_beta",
        "write_robodk",
        "write_robot",
        "write_ur_calibration",
        "write_ur_kinematics",
        "write_urdf",
    ),
    "select": ("Selection",),
    "show": ("write_report",),
    "store": ("Instance", "new_problem"),
    "study": ("Metric", "Report"),
    "use": ("Compensation", "Validation", "compensate", "compensate_file", "export_urdf", "identified", "validate"),
}
"""Names that stood here in version 0.1, by where they are now; ``plot_errors`` is ``plot.errors``."""


def __getattr__(name: str) -> Any:
    if name in _names:
        return _attach(name)
    for place, names in _MOVED.items():
        if name in names:
            raise AttributeError(f"rpim_opt.{name} is now rpim_opt.{place}.{name.removeprefix('plot_')}")
    raise AttributeError(f"module 'rpim_opt' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*__all__, *_NAMESPACES])
