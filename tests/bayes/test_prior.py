"""A prior says in numbers what it says in words, and its penalty is the density of that."""

from __future__ import annotations

import dataclasses
import pickle

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.bayes import Prior
from rpim_opt.bayes.prior_terms import FIXED, Statement, nested
from rpim_opt.convex.constraint_parser import combination
from rpim_opt.convex.quadratic import quadratic

PROBLEM = ro.load("position").problem
FREE = PROBLEM.parameters.free
n = len(FREE)


def at(*names: str) -> list[int]:
    return [FREE.names.index(name) for name in names]


def distributed(mean: dict[str, float], covariance: list[list[float]] | np.ndarray) -> Prior:
    """The prior that deviations have a mean and covariance [mm, mrad], as that of an earlier result states it."""
    rows = np.linalg.cholesky(np.linalg.inv(covariance)).T
    values = rows @ list(mean.values())
    names = tuple(key.rpartition("_")[0] for key in mean)
    dimensions = tuple("length" if key.endswith("_mm") else "angle" for key in mean)
    statement = Statement(names, dimensions, nested(1e3 * rows), tuple(values.tolist()), whole=True, text="a result")
    return Prior(statements=(statement,))


def some_prior() -> Prior:
    prior = Prior(centre={"d5_mm": 0.3}, scale={"theta?_mrad": 4.0})
    prior &= Prior.known("a2 - 0.5 a3 = nominal + 0.2 +- 0.05 mm")
    return prior & distributed({"d4_mm": 0.4, "alpha4_mrad": 0.1}, [[0.04, 0.01], [0.01, 0.02]])


def density(prior: Prior, x: np.ndarray) -> float:
    """-2 ln of the density that `some_prior` states, up to a constant, written out by hand."""
    scale = np.where(FREE.of_frames, 10.0, 1.0) * FREE.scale
    offsets = [i for i, name in enumerate(FREE.names) if name.startswith("theta")]
    scale[offsets] = 4e-3
    centre = np.zeros(n)
    centre[at("d5")] = 3e-4
    own = ((x - centre) / scale) ** 2
    own[at("d4", "alpha4")] = 0.0
    a2, a3 = x[at("a2", "a3")]
    apart = 1e3 * x[at("d4", "alpha4")] - [0.4, 0.1]
    statement = ((a2 - 0.5 * a3 - 2e-4) / 5e-5) ** 2
    return float(own.sum() + statement + apart @ np.linalg.solve([[0.04, 0.01], [0.01, 0.02]], apart))


def test_a_penalty_is_the_density_that_the_prior_states() -> None:
    prior = some_prior()
    mine = prior.stated(PROBLEM.parameters).penalized(ro.tikhonov)
    program = ro.convex.pose(mine, PROBLEM.linearize(np.zeros(n)))
    rng = np.random.default_rng(1)
    for _ in range(5):
        z = 3 * rng.standard_normal(n)
        wanted = density(prior, z * FREE.scale)
        assert program.value(z)[1] == pytest.approx(wanted, rel=1e-12)
        assert program.penalty_form.value(z) == pytest.approx(wanted, rel=1e-10)


@pytest.mark.parametrize(
    "formulation", [ro.tikhonov, ro.Formulation("by link", penalty=cp.sum_squares, penalty_over=ro.constraints.by_link)]
)
def test_the_declared_quadratic_is_what_the_canonicalization_finds(formulation: ro.Formulation) -> None:
    prior = some_prior()
    penalty = prior.stated(PROBLEM.parameters).penalized(formulation).penalty
    z = cp.Variable(n)
    found = quadratic(penalty(z), z)
    declared = penalty.quadratic
    rng = np.random.default_rng(2)
    for _ in range(5):
        v = rng.standard_normal(n)
        assert declared.value(v) == pytest.approx(found.value(v), rel=1e-8)
    program = ro.convex.pose(prior.stated(PROBLEM.parameters).penalized(formulation), PROBLEM.linearize(np.zeros(n)))
    at_v = ro.convex.pose(ro.Formulation("asked", penalty=lambda y: penalty(y)), PROBLEM.linearize(np.zeros(n)))
    assert program.value(v) == pytest.approx(at_v.value(v), rel=1e-10)


def test_nothing_stated_is_the_formulation_itself() -> None:
    prior = Prior(joint_offset=1.0, frames=1.0)
    stated = prior.stated(PROBLEM.parameters)
    assert stated.plain
    assert stated.penalized(ro.lasso) is ro.lasso
    default = Prior().stated(PROBLEM.parameters)
    assert default.penalized(ro.least_squares) is ro.least_squares


def test_learned_widths_in_the_place_of_the_scales_say_the_same() -> None:
    stated = some_prior().stated(PROBLEM.parameters)
    size = np.geomspace(0.1, 10.0, n) * stated.scale
    inside = stated.inside(size)
    x = np.random.default_rng(3).standard_normal(n) * FREE.scale
    z, other = x / FREE.scale, x / inside.parameters.scale
    assert inside.rows @ other == pytest.approx(stated.rows @ z, rel=1e-12)
    assert inside.centre * inside.parameters.scale == pytest.approx(stated.centre * FREE.scale, rel=1e-12)
    assert (inside.scale == 1).all()


def test_any_penalty_sees_what_is_not_replaced() -> None:
    prior = some_prior()
    stated = prior.stated(PROBLEM.parameters)
    z = np.random.default_rng(4).standard_normal(n)
    y = np.where(stated.replaced, 0.0, (z - stated.centre) / stated.scale)
    rest = np.sum((stated.rows @ z - stated.values) ** 2)
    for formulation, wanted in (
        (ro.lasso, np.abs(y).sum()),
        (ro.group_lasso, sum(np.linalg.norm(D @ y) for D in ro.constraints.by_link(FREE))),
        (ro.Formulation("mine", penalty=lambda v: cp.sum(cp.huber(v))), float(cp.sum(cp.huber(y)).value)),
    ):
        mine = stated.penalized(formulation)
        assert float(mine.penalty(cp.Constant(z)).value) == pytest.approx(wanted + rest, rel=1e-12)


def test_equal_content_is_an_equal_formulation_and_travels() -> None:
    one, other = (p.stated(PROBLEM.parameters).penalized(ro.tikhonov) for p in (some_prior(), some_prior()))
    assert one == other
    assert one.ready
    assert hash(one) == hash(other)
    assert pickle.loads(pickle.dumps(one)) == one
    assert (
        not some_prior()
        .stated(PROBLEM.parameters)
        .penalized(ro.Formulation("mine", penalty=lambda z: cp.norm1(z)))
        .ready
    )


# --- what is believed where nothing is said -------------------------------------------------------------------------


def test_what_is_believed_where_nothing_is_said() -> None:
    parameters = PROBLEM.parameters.identify(["a?", "theta?", "ecc_*", "ratio?", "base_*"])
    stated = Prior().stated(parameters)
    by_name = dict(zip(parameters.free.names, zip(stated.scale, stated.group, stated.heavy, strict=True), strict=True))
    assert by_name["a2"] == (1.0, stated.names.index("lengths"), True)
    assert by_name["theta2"] == (3.0, stated.names.index("joint offsets"), True)
    assert by_name["base_rx"] == (10.0, stated.names.index("base"), False)
    groups = {stated.names[by_name[name][1]] for name in ("ecc_cos3", "ecc_sin3")}
    assert groups == {"ecc"}
    assert not by_name["ecc_cos3"][2]
    assert stated.names[by_name["ratio1"][1]] == "ratio"


def test_groups_have_sizes_of_their_own_and_infinite_tails_are_normal() -> None:
    stated = Prior(groups=("a? d?", ("alpha?",)), tails=np.inf).stated(PROBLEM.parameters)
    names = [stated.names[k] if k >= 0 else "" for k in stated.group]
    assert {name for name, p in zip(names, FREE.names, strict=True) if p[0] in "ad" and p[1].isdigit()} == {"a? d?"}
    assert names[at("alpha2")[0]] == "alpha?"
    assert names[at("theta2")[0]] == "joint offsets"
    assert not stated.heavy.any()


def test_a_stated_width_is_taken_at_its_word() -> None:
    stated = Prior(scale={"joint_offset_mrad": 8.0, "base_mm": 2.0, "theta2_mrad": 1.0}).stated(PROBLEM.parameters)
    wanted = np.array([8e-3, 1e-3, 2e-3])
    assert (stated.scale * FREE.scale)[at("theta1", "theta2", "base_x")] == pytest.approx(wanted, rel=1e-12)
    assert stated.group[at("base_x", "base_rx", "tool_x")].tolist() == [FIXED, stated.names.index("base"), FIXED]


def test_places_that_nobody_measured_have_no_size() -> None:
    parameters = ro.load("cable").problem.parameters
    stated = Prior().stated(parameters)
    anchor = np.array([name.startswith("anchor") for name in parameters.free.names])
    assert anchor.any()
    assert (stated.group[anchor] == FIXED).all()
    assert (stated.scale[anchor] == 10.0).all()


# --- statements -----------------------------------------------------------------------------------------------------


def test_values_of_parameters_count_from_nominal() -> None:
    nominal = FREE.nominal[at("a2", "a3")].sum()
    text = f"a2 + a3 = {1e3 * nominal + 0.3:.6f} +- 0.05 mm"
    by_value = Prior.known(text).stated(PROBLEM.parameters)
    by_deviation = Prior.known("a3 + a2 = nominal + 0.3 +- 0.05 mm").stated(PROBLEM.parameters)
    assert by_value.values == pytest.approx(by_deviation.values, rel=1e-6)
    assert (by_value.rows == by_deviation.rows).all()


def test_the_angle_of_a_turned_frame_is_its_own_and_no_turn_about_the_parents_axes() -> None:
    """Roll and pitch of a base that is turned by 163 degrees about z: both as stated, to the second order."""
    p = PROBLEM.parameters
    nominal = np.where(np.array(p.names) == "base_rz", np.radians(163.0), p.nominal)
    turned = dataclasses.replace(p, nominal=nominal)
    angles = {axis: 1e3 * nominal[p.names.index(f"base_{axis}")] for axis in ("rx", "ry", "rz")}
    stated = [("base_rx", angles["rx"] + 1.2), ("base_ry", angles["ry"] - 0.7), ("base_rz", angles["rz"] + 0.4)]
    known = Prior()
    for name, value in stated:
        known &= Prior.known(f"{name} = {value:.6f} +- 0.01 mrad")
    prior = known.stated(turned)
    x = np.linalg.lstsq(prior.rows, prior.values, rcond=None)[0] * turned.free.scale
    values = dict(zip(turned.free.names, 1e3 * turned.free.values(x), strict=True))
    assert {name: values[name] for name, _ in stated} == pytest.approx(dict(stated), abs=2e-2)


def test_what_is_not_identified_is_nominal_in_a_combination_and_unknown_in_a_distribution() -> None:
    parameters = PROBLEM.parameters.identify(["a2", "theta2"])
    known = Prior.known("a2 + a3 +- 0.1 mm").stated(parameters)
    assert known.rows == pytest.approx(np.array([[parameters.free.scale[0] / 1e-4, 0.0]]))
    covariance = np.array([[4.0, 1.9], [1.9, 1.0]])
    mean = {"a2_mm": 0.5, "a3_mm": -0.2}
    stated = distributed(mean, covariance).stated(parameters)
    sd = 1e-3 / np.linalg.norm(stated.rows[:, 0]) * parameters.free.scale[0] / 1e-3
    assert sd == pytest.approx(2e-3, rel=1e-9)
    assert stated.rows[:, 0] @ stated.values / np.sum(stated.rows**2) == pytest.approx(
        0.5e-3 / parameters.free.scale[0], rel=1e-9
    )
    assert stated.replaced.tolist() == [True, False]


def test_the_parser_reads_numbers_signs_and_units() -> None:
    said = combination("- 2*a2 + .5 a3 -1e-1d4=  -12.5mm ± 50 um")
    assert said.sums[0].names == ("a2", "a3", "d4")
    assert said.sums[0].factors == (-2.0, 0.5, -0.1)
    assert said.sums[0].constant == pytest.approx(0.0125)
    assert said.limit == pytest.approx(5e-5)
    assert combination("theta2 = nominal - 0.1 +- 0.05 deg").sums[0].constant == pytest.approx(np.radians(0.1))


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("", "''"),
        ("a2 a3 +- 1 mm", "'a3'"),
        ("a2 + a2 +- 1 mm", "'a2' twice"),
        ("a2 - 1e400 a3 +- 1 mm", "1e400"),
        ("a2 = 1e400 +- 1 mm", "1e400"),
        ("a2 +- 1e-320 mm", "a standard deviation of"),
        ("a2 * a3 +- 1 mm", "'* a3'"),
        ("(a2 + a3) +- 1 mm", "'(a2 + a3)'"),
        ("a2.__class__() +- 1 mm", "'()'"),
        ("a? +- 1 mm", "'? '"),
        ("a2 = 3 mm", "no standard deviation"),
        ("a2 +- 1", "no unit"),
        ("a2 +- 0 mm", "a positive standard deviation"),
        ("a2 +- -1 mm", "a negative tolerance"),
        ("a2 +- 1 lightyears", "a number with a unit"),
        ("a2 = 3 deg +- 1 mm", "units deg and mm"),
        ("a2 +- 1 N m", "'1 N m'"),
        ("a2", "no standard deviation"),
        ("a2 - 5 mm +- 1 mm", "a number without ="),
        ("a2 - nominal +- 1 mm", "nominal on both sides"),
        ("a2 +- 0.1 mm + 0.05 mm", "+ 0.05 mm"),
    ],
)
def test_the_parser_refuses_what_is_no_statement(text: str, names: str) -> None:
    with pytest.raises(ro.InputError) as error:
        Prior.known(text)
    assert names.strip("' ") in str(error.value)


@pytest.mark.parametrize(
    ("prior", "says"),
    [
        (Prior.known("a2 + a33 +- 1 mm"), "'a33'"),
        (Prior.known("a2 = b +- 1 mm"), "'b'"),
        (Prior.known("a2 + theta3 +- 1 mm"), "'theta3'"),
        (Prior.known("a2 + a3 = 0 +- 0.05 mm"), "off nominal"),
        (distributed({"a22_mm": 0.0}, [[1.0]]), "'a22'"),
        (distributed({"a2_mrad": 0.0}, [[1.0]]), "a unit of angle for 'a2'"),
        (Prior(scale={"thta?_mrad": 1.0}), "thta"),
        (Prior(scale={"theta?_mm": 1.0}), "theta?_mm"),
        (Prior(scale={"theta?_mrad": 0.0}), "greater than zero"),
        (Prior(groups=("b?",)), "'b?'"),
    ],
)
def test_a_prior_that_does_not_fit_the_robot_is_refused(prior: Prior, says: str) -> None:
    with pytest.raises(ro.InputError) as error:
        prior.stated(PROBLEM.parameters)
    assert says in str(error.value)


def test_priors_together_say_both_or_contradict() -> None:
    both = Prior(tails=5.0) & Prior(centre={"d5_mm": 1.0}) & Prior.known("a2 +- 1 mm") & Prior.known("a3 +- 1 mm")
    assert (both.tails, both.centre, len(both.statements)) == (5.0, {"d5_mm": 1.0}, 2)
    with pytest.raises(ro.InputError, match=r"tails: found 5\.0 and 4\.0"):
        _ = both & Prior(tails=4.0)
    with pytest.raises(ro.InputError, match="'d5_mm' as 1 and 2"):
        _ = both & Prior(centre={"d5_mm": 2.0})


def test_a_known_value_that_the_data_contradict_is_named() -> None:
    problem = ro.load("position").problem
    nominal = 1e3 * problem.parameters.nominal[problem.parameters.names.index("tool_x")]
    for text, apart in (("tool_x = nominal + 8 +- 0.5 mm", True), ("tool_x = nominal - 1 +- 0.5 mm", False)):
        causes = ro.calibrate(problem, prior=Prior.known(text)).causes
        said = f"The data contradict prior '{text}' (nominal: {nominal:.5g} mm), by "
        assert (said in "".join(causes)) == apart


def test_a_known_value_counts_without_penalty_and_weight() -> None:
    known = Prior.known("a2 = nominal + 0.3 +- 0.0001 mm")
    two = PROBLEM.identifying(np.isin(PROBLEM.parameters.names, ("a2", "d4")))
    result = ro.calibrate(two, ro.least_squares, prior=known)
    assert 1e3 * result.x[result.problem.parameters.free.names.index("a2")] == pytest.approx(0.3, abs=0.001)
