"""A ready formulation or selector may be named wherever an object is taken, and a wrong name lists the right ones."""

from __future__ import annotations

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.convex.formulation import FORMULATIONS, formulation_of
from rpim_opt.convex.select import LEARNED, SELECTORS, weight_of

PROBLEM = ro.load("position").problem


@pytest.mark.parametrize("name", FORMULATIONS)
def test_every_ready_formulation_has_its_name(name: str) -> None:
    assert formulation_of(name) is FORMULATIONS[name]
    assert formulation_of(FORMULATIONS[name]) is FORMULATIONS[name]
    assert getattr(ro, name) is FORMULATIONS[name]


def test_a_weight_is_what_its_name_stands_for() -> None:
    for name, rule in SELECTORS.items():
        assert weight_of(name) is rule
    assert weight_of(LEARNED) is None
    assert weight_of(None) is None
    assert weight_of(2.5) == 2.5


def test_calibrate_and_pose_take_names() -> None:
    named = ro.calibrate(PROBLEM, "robust", "reml")
    given = ro.calibrate(PROBLEM, ro.robust, ro.reml)
    np.testing.assert_array_equal(named.x, given.x)
    learned = ro.calibrate(PROBLEM, weight="learned")
    np.testing.assert_array_equal(learned.x, ro.calibrate(PROBLEM).x)
    model = PROBLEM.linearize(np.zeros(len(PROBLEM.parameters.free)))
    assert ro.convex.pose("lasso", model).formulation is ro.lasso


def test_wrong_names_list_the_right_ones() -> None:
    with pytest.raises(ro.InputError, match=r"formulation: found 'robsut'.*group_lasso \(did you mean robust\?\)"):
        ro.calibrate(PROBLEM, "robsut", "reml")
    with pytest.raises(ro.InputError, match=r"weight: found 'relm', accepted: a number, a selector, learned, reml,"):
        ro.calibrate(PROBLEM, "robust", "relm")
    with pytest.raises(ro.InputError, match="formulation: found a int, accepted: a Formulation, or the name of"):
        ro.calibrate(PROBLEM, 3)  # type: ignore[arg-type]
