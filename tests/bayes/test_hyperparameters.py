"""Hyperparameters estimated before a fit: scales, noise, model extensions, outliers; the fit is an ordinary one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.bayes.evidence import Evidence, Point
from rpim_opt.bayes.hyperparameters import MOST, Estimator, sampled
from rpim_opt.bayes.outliers import clustered, error_ratios, outlier_candidates, resistant_fit, unexplained
from rpim_opt.data import Dataset

POSITION = ro.load("position").problem


def measured(
    problem: ro.CalibrationProblem, x: Array, seed: int, repeatability: float = 0.0, joint: float = 0.0
) -> ro.CalibrationProblem:
    """Return the problem with positions of a robot that deviates by x, instrument noise and its own repeatability."""
    rng = np.random.default_rng(seed)
    blocks = []
    T = problem.joint_slopes()
    for block, y in zip(problem.data.blocks, problem.modelled(x), strict=True):
        e = np.einsum("nij,nj->ni", np.linalg.cholesky(block.covariance), rng.normal(size=y.shape))
        e = e + repeatability * rng.normal(size=y.shape)
        angles = joint * rng.normal(size=(len(y), T.shape[1]))
        e += np.einsum("nij,nj->ni", T.reshape(*y.shape, -1), angles)
        blocks.append(replace(block, y=y + e))
    return problem.on(replace(problem.data, blocks=tuple(blocks)))


def drawn(seed: int, size: float = 0.5) -> Array:
    """Return deviations as they are expected, frames as the problem has them."""
    free = POSITION.parameters.free
    stated = ro.bayes.Prior().stated(POSITION.parameters)
    z = size * np.random.default_rng(seed).normal(size=len(free)) * stated.scale
    return np.where(stated.heavy, z, 0.1 * z) * free.scale


# --- the fit is an ordinary one ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["position", "pose", "markers", "cable", "mixed", "scara", "paper_arm"])
def test_the_answer_is_tikhonovs_at_weight_1_with_what_was_learned(name: str) -> None:
    result = ro.calibrate(ro.load(name).problem)
    assert result.converged
    plain = ro.calibrate(result.problem, ro.tikhonov, 1.0)
    assert np.abs(plain.z - result.z).max() < 1e-6
    assert result.weight == 1.0
    assert result.selector == "learned"


@pytest.mark.parametrize("formulation", [ro.bounded, ro.lasso, ro.robust], ids=lambda f: f.name)
def test_other_formulations_take_what_was_learned(formulation: ro.Formulation) -> None:
    problem = POSITION.with_parameters(POSITION.parameters.toleranced({"length_mm": 0.3}))
    result = ro.calibrate(problem, formulation)
    assert result.converged
    assert result.learned is not None
    again = ro.calibrate(result.problem, formulation, 1.0)
    assert np.abs(again.z - result.z).max() < 1e-4
    if formulation is ro.bounded:
        lengths = [d == "length" and not f for d, f in zip(problem.parameters.free.dimensions,
                                                         problem.parameters.free.of_frames, strict=True)]  # fmt: skip
        assert np.abs(result.x[lengths]).max() <= 0.3e-3 * (1 + 1e-6)


def test_a_formulation_without_penalty_learns_nothing() -> None:
    problem = POSITION.with_parameters(POSITION.parameters.identify(["tool_[xyz]", "base_*"]))
    result = ro.calibrate(problem, ro.least_squares)
    assert result.learned is None
    assert result.selector == "none"


def test_what_was_stated_comes_back() -> None:
    result = ro.calibrate(POSITION, model="auto")
    stated = result.stated
    assert np.array_equal(stated.parameters.scale, POSITION.parameters.scale)
    assert np.array_equal(stated.parameters.identified, POSITION.parameters.identified)
    assert stated.repeatability is None


def test_refitting_learns_anew_from_the_stated_scales() -> None:
    instance = ro.load("blunders")
    result = ro.calibrate(instance.problem, noise="declared")
    again = result.calibrate_again(result.stated)
    assert np.allclose(again.x, result.x, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize(("word", "value"), [("model", "gravity"), ("noise", "loud")])
def test_unknown_words_are_refused(word: str, value: str) -> None:
    with pytest.raises(ro.InputError, match=f"{word}: found '{value}'"):
        ro.calibrate(POSITION, **{word: value})


def test_a_start_that_is_no_array_is_refused() -> None:
    with pytest.raises(ro.InputError, match=r"start.*: found .*str"):
        ro.calibrate(POSITION, start="here")


def test_data_that_are_no_numbers_are_refused() -> None:
    block = POSITION.data.blocks[0]
    broken = POSITION.on(replace(POSITION.data, blocks=(replace(block, y=np.where(block.y > 1, np.nan, block.y)),)))
    with pytest.raises(ro.InputError, match="non-finite"):
        ro.calibrate(broken)


# --- sizes -------------------------------------------------------------------------------------------------------


def test_sizes_come_out_as_they_were_put_in() -> None:
    logs = []
    base = []
    for seed in range(6):
        result = ro.calibrate(measured(POSITION, drawn(seed), seed, repeatability=8e-5))
        learned = result.learned
        assert learned is not None
        sizes = [learned.scales[name].value / 0.5 for name in ("angles", "lengths", "joint offsets")]
        logs.append([*sizes, learned.noise["position"].value / 8e-5])
        base.append(learned.scales["base"].value)
    # t_3 tails around normal draws: its size comes out somewhat smaller; frames take up some of the lengths
    assert np.exp(np.mean(np.log(logs), axis=0)) == pytest.approx([0.8, 0.6, 0.8, 1.0], rel=0.2)
    # drawn at a twentieth; six deviations pull it so far from one, which is expected
    assert np.exp(np.mean(np.log(base))) == pytest.approx(1.3 / 20, rel=0.2)


def test_repeatability_of_joints_is_told_from_that_of_positions() -> None:
    wide = [measured(POSITION, drawn(seed), seed, joint=2e-4) for seed in range(2)]
    for problem in wide:
        learned = ro.calibrate(problem, model="auto").learned
        assert learned is not None
        assert learned.noise["joint"].value == pytest.approx(2e-4, rel=0.4)
        assert learned.noise["position"].value < 1e-4


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_scales_declared_wrong_by_10_hardly_matter(factor: float) -> None:
    ratio = []
    for seed in range(3):
        x = drawn(seed)
        problem = measured(POSITION, x, seed).without(set(POSITION.labels[12:]))
        p = problem.parameters
        wrong = problem.with_parameters(replace(p, scale=np.where(p.of_frames, 1.0, factor) * p.scale))
        errors = [np.sqrt(np.mean(POSITION.on(each.data).residual(0 * x) ** 2)) for each in (problem, wrong)]
        assert errors[0] == errors[1]
        clean = np.concatenate([y.ravel() for y in POSITION.modelled(x)])
        found = [
            np.concatenate([y.ravel() for y in each.on(POSITION.data).modelled(ro.calibrate(each).x)])
            for each in (problem, wrong)
        ]
        a, b = (np.sqrt(np.mean((each - clean) ** 2)) for each in found)
        ratio.append(b / a)
    assert np.exp(np.mean(np.log(ratio))) < 1.05


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_deviations_are_not_taken_for_repeatability_because_lengths_and_angles_differ(factor: float) -> None:
    """Seven axes, ten configurations: with one size for both all of it was noise, 18 times worse than least squares."""
    arm = ro.study.simulated_arm(seed=1004, count=10, offset=np.radians(1.0 * ((1004 // 3) % 2)))
    p = arm.problem.parameters
    lengths = (np.array(p.dimensions) == "length") & ~p.of_frames
    problem = arm.problem.with_parameters(replace(p, scale=np.where(lengths, factor, 1.0) * p.scale))
    errors = [np.sqrt(np.mean(ro.calibrate(problem, **way).errors(arm.true) ** 2)) for way in ({}, {"weight": 1e-6})]
    assert errors[0] < 0.8 * errors[1]


@pytest.mark.slow
@pytest.mark.parametrize(("count", "most"), [(8, 0.5), (10, 0.75)])
def test_few_configurations_do_for_arms_whose_lengths_and_angles_differ(count: int, most: float) -> None:
    """Errors over those of least squares on 15 arms: 0.36 and 0.64 times; 0.57 and 0.83 with one size for all."""
    ratio = []
    for seed in range(5000, 5015):
        arm = ro.study.simulated_arm(seed, count, offset=np.radians(1.0 * ((seed // 3) % 2)))
        found = [ro.calibrate(arm.problem, **way).errors(arm.true) for way in ({}, {"weight": 1e-6})]
        ratio.append(np.log(np.mean(found[0] ** 2) / np.mean(found[1] ** 2)) / 2)
    assert np.exp(np.mean(ratio)) < most


def test_noise_declared_too_large_is_found_where_it_may_be() -> None:
    problem = measured(POSITION, drawn(0), 0)
    blocks = tuple(replace(b, covariance=100 * b.covariance) for b in problem.data.blocks)
    loud = problem.on(replace(problem.data, blocks=blocks))
    for noise in ("free", "level"):
        learned = ro.calibrate(loud, noise=noise).learned
        assert learned is not None
        assert learned.noise["instrument"].value == pytest.approx(0.1, rel=0.35)
    fixed = ro.calibrate(loud).learned
    assert fixed is not None
    assert "instrument" not in fixed.noise


def test_an_assembly_error_leaves_its_group_and_is_named() -> None:
    x = drawn(3, 0.3)
    free = POSITION.parameters.free
    x[free.names.index("theta3")] = np.radians(1.0)
    result = ro.calibrate(measured(POSITION, x, 3))
    assert result.x[free.names.index("theta3")] == pytest.approx(np.radians(1.0), abs=2e-4)
    assert "theta3 deviates by " in result.weight_sentence()
    assert "assembly or joint-zero error" in result.weight_sentence()


def test_fewer_equations_than_parameters_are_said() -> None:
    few = POSITION.on(POSITION.data.configurations(5, 0))
    result = ro.calibrate(few)
    assert (
        "15 equations for 34 parameters: at least 19 parameter combinations are unidentifiable."
        in result.weight_sentence()
    )


def test_the_best_optimum_is_that_at_its_own_linearization() -> None:
    """Eight simulated lengths, the tool's start a decimetre off: frames move far, and the order of optima changes."""
    problem = ro.load("cable").problem
    p = problem.parameters
    geometry = [not name.startswith(("tool", "anchor", "length")) for name in p.names]
    nominal = p.nominal + 0.1 * (np.array(p.names) == "tool_z")
    scaled = replace(p, nominal=nominal, scale=np.where(geometry, p.scale / 10, p.scale))
    few = problem.with_parameters(scaled).on(problem.data.configurations(8, 5)).frozen()
    estimator = Estimator(ro.bayes.Prior(), ("position",))
    start = np.zeros(len(p.free))
    found = estimator.fit(few, start, None, 6)
    for logs in estimator.evidence(few, start).starts():
        assert found.point.value <= estimator.fit(few, start, logs, 6).point.value + 0.01


def test_a_known_combination_holds() -> None:
    names = POSITION.parameters.free.names
    known = ro.bayes.Prior.known("a2 + a3 = nominal + 0.4 +- 0.0001 mm")
    result = ro.calibrate(POSITION, prior=known)
    total = result.x[names.index("a2")] + result.x[names.index("a3")]
    assert 1e3 * total == pytest.approx(0.4, abs=1e-3)
    assert result.learned is not None
    assert result.converged


def test_what_other_arms_say_is_left_out_where_the_evidence_is_against_it() -> None:
    x = drawn(0)
    few = measured(POSITION, x, 0).without(set(POSITION.labels[12:]))
    free = POSITION.parameters.free
    robot = ~free.of_frames

    def told(deviations: Array) -> ro.bayes.Prior:
        unit = {"length": ("_m", 1.0), "angle": ("_rad", 1.0)}
        names = [name + unit[d][0] for name, d in zip(free.names, free.dimensions, strict=True)]
        centre = {name: float(v) for name, v, own in zip(names, deviations, robot, strict=True) if own}
        width = {name: 0.2 * float(v) for name, v, own in zip(names, free.scale, robot, strict=True) if own}
        return ro.bayes.Prior(centre=centre, scale=width, optional=tuple(centre))

    right, wrong = (ro.calibrate(few, prior=told(each)) for each in (x, -3 * x))
    plain = ro.calibrate(few)
    assert right.learned is not None
    assert wrong.learned is not None
    assert "The population prior" not in right.weight_sentence()
    assert "The population prior is not used" in wrong.weight_sentence()
    assert np.abs(wrong.x - plain.x).max() < 1e-7
    errors = [
        np.sqrt(np.mean((POSITION.on(POSITION.data).errors(r.x) - POSITION.errors(x)) ** 2)) for r in (right, plain)
    ]
    assert errors[0] < errors[1]


def test_many_configurations_are_sampled() -> None:
    block = POSITION.data.blocks[0]
    times = MOST // len(POSITION.data) + 1
    q = np.tile(block.q[:, 0], (times, 1)) + np.random.default_rng(0).uniform(-0.3, 0.3, (times * len(block.q), 6))
    many = POSITION.on(ro.Dataset.of(q, np.zeros((len(q), 3)), 3e-5))
    assert len(sampled(many).data) == MOST
    assert len(sampled(POSITION).data) == len(POSITION.data)


# --- extensions ----------------------------------------------------------------------------------------------------


def bent(seed: int, size: float) -> ro.CalibrationProblem:
    """Return a robot whose joints bend under gravity, and whose problem identifies its geometry alone."""
    p = POSITION.parameters
    truth = POSITION.with_parameters(p.identify([*p.free.names, "compliance?"]))
    x = np.zeros(len(truth.parameters.free))
    names = truth.parameters.free.names
    x[[names.index(name) for name in p.free.names]] = drawn(seed)
    x[[i for i, name in enumerate(names) if name.startswith("compliance")]] = size
    return POSITION.on(measured(truth, x, seed).data)


@pytest.mark.slow
def test_gravity_is_found_where_it_bends_and_nowhere_else() -> None:
    for seed in range(3):
        heavy = ro.calibrate(bent(seed, 8e-6), model="auto")
        light = ro.calibrate(bent(seed, 0.0), model="auto")
        assert heavy.learned is not None
        assert light.learned is not None
        assert "gravity" in heavy.learned.extensions
        gain = heavy.learned.gain("gravity")
        assert gain is not None
        assert gain > 20
        assert light.learned.extensions == ()
        assert "geometry with gravity" in heavy.weight_sentence()
        assert "Model: the data support no extension" in light.weight_sentence()
        plain = ro.calibrate(bent(seed, 8e-6))
        assert plain.learned is not None
        assert plain.learned.trials == ()
        assert heavy.errors().mean() < 0.7 * plain.errors().mean()


def test_what_repeats_from_row_to_row_is_no_extension() -> None:
    """A smooth error that no extension describes makes rows alike: gains of -2 ln L then count for less."""
    arm = ro.study.simulated_arm(17, 50, 3e-5).problem
    q = arm.data.q
    rng = np.random.default_rng([17, 7])
    bend = 1e-3 * np.sin(0.3 * q @ rng.normal(size=(q.shape[1], 3)) + rng.uniform(0, 2 * np.pi, 3))
    learned = ro.calibrate(arm.on(Dataset.of(q, arm.data.blocks[0].y + bend, 3e-5)), model="auto").learned
    assert learned is not None
    assert learned.trials[0].extensions == ()
    gain = learned.gain("first harmonic")
    assert gain is not None
    assert gain > 6  # as one in 300 arms whose rows are independent


def test_a_weight_takes_the_extensions_alone() -> None:
    result = ro.calibrate(bent(0, 8e-6), ro.tikhonov, "reml", model="auto")
    assert result.learned is None
    assert result.problem.repeatability is None
    assert any(name.startswith("compliance") for name in result.problem.parameters.free.names)
    geometry = ~np.isin(result.problem.parameters.names, ["compliance2", "compliance3", "compliance4", "compliance5"])
    assert np.array_equal(result.problem.parameters.scale[geometry], POSITION.parameters.scale[geometry])


# --- blunders ----------------------------------------------------------------------------------------------------


def spoiled(problem: ro.CalibrationProblem, rows: list[int], size: float) -> ro.CalibrationProblem:
    block = problem.data.blocks[0]
    y = block.y.copy()
    direction = np.random.default_rng(1).normal(size=(len(rows), 3))
    y[np.searchsorted(block.row, rows)] += size * direction / np.linalg.norm(direction, axis=1)[:, None]
    return problem.on(replace(problem.data, blocks=(replace(block, y=y),)))


def test_blunders_are_left_out_and_named_and_no_good_row_with_them() -> None:
    clean = measured(POSITION, drawn(0), 0)
    problem = spoiled(clean, [4, 17], 3e-3)
    result = ro.calibrate(problem)
    assert result.learned is not None
    wrong = {POSITION.data.label[i] for i in (4, 17)}
    assert {row.label for row in result.learned.left_out} == wrong
    assert wrong <= set(result.outliers)
    assert "Excluded outliers: " in result.weight_sentence()
    oracle = ro.calibrate(clean.without(wrong))
    assert np.abs(result.x - oracle.x).max() < 1e-6
    assert ro.calibrate(clean).learned.left_out == ()  # type: ignore[union-attr]


def test_a_rows_ratio_is_as_rare_for_every_kind() -> None:
    mixed = ro.load("pose").problem
    ratio = error_ratios(mixed, ro.calibrate(mixed, weight=1.0).x)
    assert ratio.max() < 6
    assert 0.5 < np.median(ratio) < 1.6


def test_a_fit_that_swallows_its_data_suspects_nobody() -> None:
    few = spoiled(POSITION.on(POSITION.data.take(range(8))), [2], 3e-3)
    x = ro.calibrate(few, weight=1e-6).x
    scale = few.parameters.free.scale
    assert outlier_candidates(few, x, scale, spare=0.1) == {}


def test_a_resistant_fit_is_not_pulled() -> None:
    clean = measured(POSITION, drawn(0), 0)
    wrong = spoiled(clean, [3, 9, 21], 5e-3)
    scale = 3 * POSITION.parameters.free.scale
    pulled = ro.calibrate(wrong, weight=1.0)
    fit = resistant_fit(wrong, pulled.x, scale)
    good = np.delete(np.arange(len(POSITION.data)), [3, 9, 21])
    assert np.median(clean.errors(fit)[good]) < 2 * np.median(clean.errors(ro.calibrate(clean, weight=1.0).x))
    assert set(np.argsort(-wrong.errors(fit))[:3]) == {3, 9, 21}


def test_neighbours_that_err_alike_are_physics() -> None:
    problem = POSITION
    q = problem.data.q.copy()
    q[1:5] = q[0] + 0.01 * np.arange(1, 5)[:, None]
    block = problem.data.blocks[0]
    order = block.row
    moved = problem.on(replace(problem.data, blocks=(replace(block, q=q[order][:, None]),)))
    x = np.zeros(len(problem.parameters.free))
    y = moved.modelled(x)[0]
    y[np.isin(order, range(5))] += [3e-3, 0, 0]
    lone = np.flatnonzero(order == 20)
    y[lone] += [0, 3e-3, 0]
    odd = moved.on(replace(moved.data, blocks=(replace(moved.data.blocks[0], y=y),)))
    assert clustered(odd, x, np.array([0, 1, 2, 3, 4, 20])).tolist() == [True] * 5 + [False]


def test_a_suspect_that_the_model_explains_comes_back() -> None:
    result = ro.calibrate(POSITION)
    labels = {POSITION.data.label[0]: 7.0, POSITION.data.label[1]: 8.0}
    wrong = spoiled(POSITION, [1], 3e-3)
    kept = unexplained(wrong.with_repeatability(result.problem.repeatability), result.x, result.covariance, labels)
    assert kept == {POSITION.data.label[1]: 8.0}


# --- how sure it is ----------------------------------------------------------------------------------------------


def test_the_covariance_knows_how_deviations_follow_sizes_and_what_tails_leave_open() -> None:
    """Kass and Steffey's J Cov(ln sizes) J', J by differences of another step; the rest is wider than Tikhonov's."""
    few = POSITION.on(POSITION.data.configurations(12, 1))
    result = ro.calibrate(few)
    learned = result.learned
    assert learned is not None
    estimator = Estimator(ro.bayes.Prior(), tuple(learned.noise))
    fit = estimator.fit(
        few, result.x, np.log([s.value for s in (*learned.scales.values(), *learned.noise.values())]), 1
    )
    evidence, logs = fit.evidence, fit.point.logs
    step = 0.01
    ends = [[evidence.at(logs + side * e).z for side in (-1, 1)] for e in step * np.eye(len(logs))]
    J = np.array([(ahead - behind) / (2 * step) for behind, ahead in ends]).T
    J = J * (POSITION.parameters.free.scale * fit.stated.scale)[:, None]
    followed, tails = np.split(learned.drift, [len(logs)], axis=1)
    own = np.diag(J @ learned.covariance @ J.T)
    assert np.sum(followed**2, axis=1) == pytest.approx(own, rel=0.1, abs=0.02 * np.diag(result.covariance).min())

    plain = replace(ro.calibrate(result.problem, ro.tikhonov, 1.0).fit_covariance, level=1.0)
    added = np.diag(result.covariance - plain.covariance)
    assert added == pytest.approx(np.sum(followed**2, axis=1) + np.sum(tails**2, axis=1), rel=1e-3, abs=1e-12)
    assert np.median(np.sqrt(np.diag(result.covariance) / np.diag(plain.covariance))) > 1.02


# --- the search --------------------------------------------------------------------------------------------------


def test_the_marginal_likelihood_is_evaluated_once_at_every_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where an optimum was found: its local variances are those of the search."""
    places: list[bytes] = []
    at = Evidence.at

    def counted(self: Evidence, logs: Array, *near: Point) -> Point:
        places.append(logs.tobytes() + self.data.y.tobytes() + self.data.X.tobytes())
        return at(self, logs, *near)

    monkeypatch.setattr(Evidence, "at", counted)
    result = ro.calibrate(POSITION, model="auto")
    assert result.learned is not None
    assert len(places) == len(set(places)) > 5


def test_sizes_agree_with_the_deviations_that_they_lead_to() -> None:
    estimator = Estimator(ro.bayes.Prior(), ("position",))
    fit = estimator.fit(POSITION, np.zeros(len(POSITION.parameters.free)), None, 8)
    again = estimator.fit(POSITION, fit.x, fit.point.logs, 1)
    assert np.abs(again.point.logs - fit.point.logs).max() < 0.02
    assert np.abs(again.x - fit.x).max() < 1e-5
    assert 0 < fit.spare < 1
    assert np.linalg.eigvalsh(fit.covariance / np.outer(*2 * [fit.laid.parameters.free.scale])).min() > 0


def test_a_reading_repeatability_as_surely_as_its_noise_is_known() -> None:
    """V = tr(X C X' + R) goes with the square of the noise, but for what the prior holds: var(ln V) = 4 var(ln s)."""
    problem = measured(POSITION, drawn(3), 3, repeatability=3e-4)
    learned = ro.calibrate(problem).learned
    assert learned is not None
    names = list(learned.scales)
    by_noise = 2 * learned.covariance[len(names), len(names)] ** 0.5
    assert learned.noise_dof == pytest.approx(2 / by_noise**2, rel=0.1)
