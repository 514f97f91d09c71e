"""Where the time of a calibration goes."""

from __future__ import annotations

import rpim_opt as ro
from rpim_opt.basics.threads import clock


def test_phases_add_up() -> None:
    problem = ro.load("paper_arm").problem
    with clock() as running:
        ro.calibrate(problem, ro.bounded, ro.reml)
    seconds = dict(running.rows())
    assert all(seconds[phase] > 0 for phase in ("evaluation", "reduction", "solve", "selection"))
    assert seconds["other"] > 0
    before = dict(seconds)
    ro.calibrate(problem, ro.bounded, ro.reml)  # outside: nothing is counted
    assert dict(running.seconds) == {k: v for k, v in before.items() if k != "other"}
