"""Which tests are run when: ``smoke`` for every commit, by default all but ``slow``."""

from __future__ import annotations

import os
import signal
import sys
from collections import defaultdict
from typing import Any

import pytest

from tests.durations import cases

os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
"""Modules are compiled once, not in each of the processes that tests start."""
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # as a shell starts jobs in the background, and these programs
    signal.signal(signal.SIGINT, signal.default_int_handler)
SMOKE = (
    "tests/test_architecture.py",
    "tests/test_cli.py",
    "tests/test_locked.py",
    "tests/basics/",
    "tests/data/test_dataset.py",
    "tests/data/test_measurement.py",
    "tests/data/test_tables.py",
    "tests/robot/test_exchange.py",
    "tests/problem/test_refused.py",
    "tests/convex/test_quadratic.py",
    "tests/convex/test_constraints.py",
    "tests/bayes/test_prior.py",
    "tests/calibration/test_spread.py",
    "tests/store/test_folder.py",
    "tests/use/test_iso9283.py",
)
"""Files of which each holds a folder's foundations; together they take less than half a minute."""
SNIPPETS = ("tests/test_docstrings.py", "tests/test_readme.py")
"""Files that run the examples of docstrings, README and guides."""
DEFAULT = {
    "tests/convex/test_mechanism.py::test_storage_decides_nothing": ("reml-robust", "l_curve-sum_of_norms"),
    "tests/calibration/test_conditional.py::test_widths_are_those_of_repeated_measurements": ("box",),
    "tests/calibration/test_threads.py::test_two_threads_calibrate_with_one_formulation": ("CVaR + squares",),
    "tests/calibration/test_contact.py::test_errors_of_touches_are_told_point_by_point": ("contact",),
    "tests/calibration/test_camera.py::test_new_makes_a_folder_from_corners": ("on the flange",),
    "tests/problem/test_camera.py::test_mistakes_are_found_in_views": ("sign",),
    "tests/problem/test_design.py::test_a_design_is_near_the_best_and_better_than_chance": ("D",),
    "tests/problem/test_blocks.py::test_no_digit_depends_on_the_number_of_cores": ("9000",),
    "tests/study/test_comparison.py::test_intervals_of_other_problems_cover_as_they_say": ("5",),
    "tests/report/test_report.py::test_every_measurement_has_a_report": ("mixed",),
    "tests/report/test_report.py::test_the_verdict_is_the_first_thing_on_the_page": ("7e-05-Inconclusive",),
    "tests/calibration/test_causes.py::test_rows_of_reflectors_that_no_column_names_are_told_apart": ("rows0",),
    "tests/calibration/test_contact.py::test_real_sockets_at_the_place_held_back": ("panda3_sockets-0.21",),
    "tests/calibration/test_convergence.py::test_a_huber_loss_far_from_its_data_is_not_called_infeasible": (
        "1.0-10000.0",
        "1000.0-1000.0",
    ),
    "tests/problem/test_inspection.py::test_likely_mistakes_are_named": (
        "lengths in an unknown unit",
        "a frame flipped",
    ),
    "tests/problem/test_inspection.py::test_good_data_raise_no_suspicion": ("pose", "cable", "mixed", "scara"),
    "tests/store/test_problems.py::test_ten_configurations_of_real_data_beat_least_squares": ("ur5_jacobi",),
    "tests/store/test_problems.py::test_the_tables_come_from_the_seed": ("sphere", "datum_cube"),
    "tests/store/test_results.py::test_ready_made_formulations_can_be_solved_again": ("own numbers", "lasso"),
    "tests/study/test_comparison.py::test_a_journal_of_other_arguments_is_not_resumed": ("change0-set of methods",),
}
"""Cases that the default suite takes of a test whose every case is long; the others are slow."""


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give reports captions alone where a chart stands: charts, which other tests draw, take most of the time."""
    from rpim_opt.report.page import Figure

    def figure(draw: Any, title: str, caption: str = "", height: float = 0.0) -> Figure:
        return Figure("data:,", title, caption)

    monkeypatch.setattr("rpim_opt.report.report.figure", figure)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: Any, log: Any) -> Any:
    """Leave most tests of a module to one worker, which makes their fixtures once."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark each test by the lists above, by `cases.toml`, and those that run what texts show."""
    of_test: dict[str, list[pytest.Item]] = defaultdict(list)
    for item in items:
        test, _, case = item.nodeid.partition("[")
        case = case.removesuffix("]")
        if item.nodeid.startswith(SNIPPETS):
            item.add_marker(pytest.mark.slow)
            item.add_marker(pytest.mark.snippet)
        elif case not in DEFAULT.get(test, (case,)):
            item.add_marker(pytest.mark.slow)
        else:
            of_test[test].append(item)
    for test, count in cases().items():
        known = of_test.get(test, [])
        taken = {i * len(known) // count for i in range(count)}
        for i, item in enumerate(known):
            if i not in taken:
                item.add_marker(pytest.mark.slow)
                item.add_marker(pytest.mark.long)
    for item in items:
        if item.nodeid.startswith(SMOKE) and item.get_closest_marker("slow") is None:
            item.add_marker(pytest.mark.smoke)
