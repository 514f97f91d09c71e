"""Robot calibration by convex optimization.

Names are imported when they are first used, so that ``import rpim_opt`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rpim_opt.calibration import Calibration as Calibration
    from rpim_opt.calibration import calibrate as calibrate
    from rpim_opt.compensation import Compensation as Compensation
    from rpim_opt.compensation import compensate as compensate
    from rpim_opt.compensation import compensate_file as compensate_file
    from rpim_opt.compensation import read_targets as read_targets
    from rpim_opt.constraints import Box as Box
    from rpim_opt.constraints import at_nominal as at_nominal
    from rpim_opt.constraints import by_kind as by_kind
    from rpim_opt.constraints import by_link as by_link
    from rpim_opt.constraints import differences as differences
    from rpim_opt.constraints import equal as equal
    from rpim_opt.constraints import in_ball as in_ball
    from rpim_opt.constraints import signed as signed
    from rpim_opt.constraints import within_tolerance as within_tolerance
    from rpim_opt.dataset import Dataset as Dataset
    from rpim_opt.dataset import read_data as read_data
    from rpim_opt.design import Design as Design
    from rpim_opt.design import choose as choose
    from rpim_opt.design import random_candidates as random_candidates
    from rpim_opt.exceptions import InputError as InputError
    from rpim_opt.exceptions import NoSolutionFound as NoSolutionFound
    from rpim_opt.exceptions import RpimError as RpimError
    from rpim_opt.exchange.chain import Described as Described
    from rpim_opt.exchange.chain import identified as identified
    from rpim_opt.exchange.chain import without_beta as without_beta
    from rpim_opt.exchange.export import export_urdf as export_urdf
    from rpim_opt.exchange.plain import read_mdh as read_mdh
    from rpim_opt.exchange.plain import write_robodk as write_robodk
    from rpim_opt.exchange.plain import write_robot as write_robot
    from rpim_opt.exchange.universal_robots import read_ur_calibration as read_ur_calibration
    from rpim_opt.exchange.universal_robots import read_ur_kinematics as read_ur_kinematics
    from rpim_opt.exchange.universal_robots import write_ur_calibration as write_ur_calibration
    from rpim_opt.exchange.universal_robots import write_ur_kinematics as write_ur_kinematics
    from rpim_opt.exchange.urdf import read_urdf as read_urdf
    from rpim_opt.exchange.urdf import write_urdf as write_urdf
    from rpim_opt.formulation import Formulation as Formulation
    from rpim_opt.formulation import bounded as bounded
    from rpim_opt.formulation import group_lasso as group_lasso
    from rpim_opt.formulation import huber as huber
    from rpim_opt.formulation import lasso as lasso
    from rpim_opt.formulation import least_squares as least_squares
    from rpim_opt.formulation import minimax as minimax
    from rpim_opt.formulation import robust as robust
    from rpim_opt.formulation import sum_of_norms as sum_of_norms
    from rpim_opt.formulation import tikhonov as tikhonov
    from rpim_opt.frames import hand_eye as hand_eye
    from rpim_opt.frames import register as register
    from rpim_opt.frames import starting_parameters as starting_parameters
    from rpim_opt.frames import tool_from_distances as tool_from_distances
    from rpim_opt.inspection import Inspection as Inspection
    from rpim_opt.inspection import inspect as inspect
    from rpim_opt.instances import Instance as Instance
    from rpim_opt.instances import load as load
    from rpim_opt.instances import robots as robots
    from rpim_opt.kinematics import forward_kinematics as forward_kinematics
    from rpim_opt.measurement import LaserTracker as LaserTracker
    from rpim_opt.measurement import Measurement as Measurement
    from rpim_opt.observability import Observability as Observability
    from rpim_opt.observability import observe as observe
    from rpim_opt.parameters import Parameters as Parameters
    from rpim_opt.parameters import model_parameters as model_parameters
    from rpim_opt.plots import plot_error_axes as plot_error_axes
    from rpim_opt.plots import plot_error_histogram as plot_error_histogram
    from rpim_opt.plots import plot_error_vectors as plot_error_vectors
    from rpim_opt.plots import plot_errors as plot_errors
    from rpim_opt.plots import plot_l_curve as plot_l_curve
    from rpim_opt.plots import plot_parameters as plot_parameters
    from rpim_opt.plots import plot_picard as plot_picard
    from rpim_opt.plots import plot_selection as plot_selection
    from rpim_opt.plots import plot_selectors as plot_selectors
    from rpim_opt.problem import CalibrationProblem as CalibrationProblem
    from rpim_opt.problem import LinearModel as LinearModel
    from rpim_opt.record import Record as Record
    from rpim_opt.report import write_report as write_report
    from rpim_opt.results import load_result as load_result
    from rpim_opt.robot import Robot as Robot
    from rpim_opt.robot import read_robot as read_robot
    from rpim_opt.selection import Selection as Selection
    from rpim_opt.selection import compare as compare
    from rpim_opt.selection import corner as corner
    from rpim_opt.selection import discrepancy as discrepancy
    from rpim_opt.selection import gcv as gcv
    from rpim_opt.selection import k_fold as k_fold
    from rpim_opt.selection import l_curve as l_curve
    from rpim_opt.selection import leave_one_out as leave_one_out
    from rpim_opt.selection import ncp as ncp
    from rpim_opt.selection import quasi_optimality as quasi_optimality
    from rpim_opt.selection import reml as reml
    from rpim_opt.selection import robust_gcv as robust_gcv
    from rpim_opt.selection import two_step as two_step
    from rpim_opt.starting import new_problem as new_problem
    from rpim_opt.streaming import PartitionedProblem as PartitionedProblem
    from rpim_opt.streaming import on_cluster as on_cluster
    from rpim_opt.streaming import partitions as partitions
    from rpim_opt.uncertainty import Uncertainty as Uncertainty
    from rpim_opt.uncertainty import monte_carlo as monte_carlo
    from rpim_opt.validation import Validation as Validation
    from rpim_opt.validation import read_measurements as read_measurements
    from rpim_opt.validation import validate as validate

__version__ = "0.1.0"

_HOME = {
    "calibration": ("Calibration", "calibrate"),
    "compensation": ("Compensation", "compensate", "compensate_file", "read_targets"),
    "dataset": ("Dataset", "read_data"),
    "exceptions": ("InputError", "NoSolutionFound", "RpimError"),
    "constraints": (
        "Box",
        "at_nominal",
        "by_kind",
        "by_link",
        "differences",
        "equal",
        "in_ball",
        "signed",
        "within_tolerance",
    ),
    "formulation": (
        "Formulation",
        "bounded",
        "group_lasso",
        "huber",
        "lasso",
        "least_squares",
        "minimax",
        "robust",
        "sum_of_norms",
        "tikhonov",
    ),
    "exchange.chain": ("Described", "identified", "without_beta"),
    "exchange.export": ("export_urdf",),
    "exchange.plain": ("read_mdh", "write_robodk", "write_robot"),
    "exchange.universal_robots": (
        "read_ur_calibration",
        "read_ur_kinematics",
        "write_ur_calibration",
        "write_ur_kinematics",
    ),
    "exchange.urdf": ("read_urdf", "write_urdf"),
    "inspection": ("Inspection", "inspect"),
    "instances": ("Instance", "load", "robots"),
    "kinematics": ("forward_kinematics",),
    "measurement": ("LaserTracker", "Measurement"),
    "observability": ("Observability", "observe"),
    "parameters": ("Parameters", "model_parameters"),
    "frames": ("hand_eye", "register", "starting_parameters", "tool_from_distances"),
    "problem": ("CalibrationProblem", "LinearModel"),
    "record": ("Record",),
    "report": ("write_report",),
    "results": ("load_result",),
    "robot": ("Robot", "read_robot"),
    "selection": (
        "Selection",
        "compare",
        "corner",
        "discrepancy",
        "gcv",
        "k_fold",
        "l_curve",
        "leave_one_out",
        "ncp",
        "quasi_optimality",
        "reml",
        "robust_gcv",
        "two_step",
    ),
    "starting": ("new_problem",),
    "validation": ("Validation", "read_measurements", "validate"),
    "design": ("Design", "choose", "random_candidates"),
    "plots": (
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
    "streaming": ("PartitionedProblem", "on_cluster", "partitions"),
    "uncertainty": ("Uncertainty", "monte_carlo"),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}
__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'rpim_opt' has no attribute '{name}'")
    value = getattr(import_module(f"rpim_opt.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
