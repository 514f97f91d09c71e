"""What the data can tell, against singular values and null spaces computed otherwise."""

from __future__ import annotations

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.problem import observe
from rpim_opt.problem.design import combination
from rpim_opt.problem.problem import near_parallel
from rpim_opt.robot.library import find_robot
from tests.simulate import simulated


def test_indices_are_those_of_the_singular_values() -> None:
    problem, _ = simulated(("a[234]", "theta[234]", "d5"), configurations=15)
    o = observe(problem)
    s = np.linalg.svd(problem.linearize(np.zeros(7)).A, compute_uv=False)
    assert o.singular_values == pytest.approx(s, rel=1e-9)
    assert o.rank == 7
    want = [np.prod(s) ** (1 / 7) / np.sqrt(15), s[-1] / s[0], s[-1], s[-1] ** 2 / s[0], 1 / np.sum(1 / s)]
    assert list(o.indices.values()) == pytest.approx(want, rel=1e-9)
    assert o.condition == pytest.approx(s[0] / s[-1])
    assert o.redundant == o.unidentifiable == ()


def test_a_redundant_combination_changes_nothing_and_base_parameters_say_everything() -> None:
    problem, _ = simulated()
    o, free = observe(problem), problem.parameters.free
    assert o.rank + len(o.redundant) + len(o.unidentifiable) == len(free)
    J = problem.jacobian(np.zeros(len(free)))
    for terms in o.redundant:
        x = np.array([terms.get(name, 0.0) for name in free.names])
        assert np.abs(J @ x).max() < 1e-5 * max(np.abs(J[:, i] * x[i]).max() for i in range(len(x)))
    assert len(o.base) == o.rank
    together = np.array([[terms.get(name, 0.0) for name in free.names] for terms in o.base])
    columns = [free.names.index(next(iter(terms))) for terms in o.base]
    assert np.abs(J[:, columns] @ together - J).max() < 1e-5 * np.abs(J).max()


def test_a_combination_names_all_reflectors_that_it_moves() -> None:
    """Millimetres of a reflector beside a milliradian: small in number, a third of the effect."""
    folder = ro.load("markers").problem
    tools = {"A": [0, -0.015, 0.02, 0, 0, 0], "B": [0, -0.005, 0.035, 0, 0, 0], "C": [0, 0.005, 0.02, 0, 0, 0]}
    parameters = ro.problem.starting_parameters(folder.robot, folder.data, tools=tools)
    problem = ro.CalibrationProblem(folder.robot, parameters.identify("*_?"), folder.data).identify("auto")
    named = [combination(terms) for terms in observe(problem).redundant]
    assert "theta6 - 0.015 tool_A_x - 0.005 tool_B_x + 0.005 tool_C_x" in named, named


def test_names_of_the_redundant_parameters() -> None:
    named = {combination(terms) for terms in observe(ro.load("position").problem).redundant}
    assert {"d6 - tool_z", "d2 - d3"} <= named
    assert combination({"a": 1.0, "b": -0.5, "c": 0.25}) == "a - 0.5 b + 0.25 c"


@pytest.mark.parametrize("seed", range(5))
def test_names_do_not_depend_on_rounding(seed: int) -> None:
    problem, _ = simulated()
    data = problem.data.blocks[0]
    # another order of the measurements is another rounding of everything that follows, and nothing else
    order = np.random.default_rng(seed).permutation(len(data.y))
    other = problem.on(ro.Dataset.of(data.q[order], data.y[order], 5e-5))
    one, two = observe(problem), observe(other)
    assert [*map(combination, one.redundant)] == [*map(combination, two.redundant)]
    assert [*map(combination, one.base)] == [*map(combination, two.base)]


def test_what_no_measurement_sees_is_named() -> None:
    problem, _ = simulated(("a[23]", "tool_r?"))
    o = observe(problem)
    assert set(o.unidentifiable) == {"tool_rx", "tool_ry", "tool_rz"}


def test_the_papers_condition_number_is_that_of_a_singular_matrix() -> None:
    o = observe(ro.load("paper_arm").problem)
    # the paper prints 1.157e21 (Eq. 24): rounding, of a matrix with 20 independent columns of 26
    assert o.rank == 20
    assert o.condition < 1e4


def test_hayatis_parameter_is_proposed_where_axes_are_parallel() -> None:
    assert near_parallel(ro.read_robot(find_robot("ur5e"))) == ("beta2", "beta3")
    assert near_parallel(ro.read_robot(find_robot("irb120"))) == ("beta2",)
    assert near_parallel(ro.read_robot(find_robot("iiwa14"))) == ()
    scara = ro.load("scara").problem.robot
    assert near_parallel(scara) == ("beta1", "beta2", "beta3")  # a slide has a direction, too


def test_tilts_of_a_slide_are_identified_by_default() -> None:
    """Of the axis before a stroke, and of the one behind it: a milliradian is 0.2 mm over the stroke."""
    problem, rng = ro.load("scara").problem.identify("auto"), np.random.default_rng(3)
    names = problem.parameters.free.names
    truth = np.array([1e-3 * rng.normal() if name.startswith(("alpha", "beta")) else 0.0 for name in names])
    (y,) = problem.modelled(truth)
    data = ro.Dataset.of(problem.data.q, y + 2e-5 * rng.normal(size=y.shape), 2e-5)
    result = ro.calibrate(problem.on(data), ro.tikhonov, 1.0)
    assert {"beta2", "beta3"} <= set(names)
    assert result.errors().mean() < 5e-5  # without beta2 and beta3 more is left
