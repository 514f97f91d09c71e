"""Points and planes that are touched and nobody measures: eliminated exactly, whatever the noise."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.bayes import Prior
from rpim_opt.bayes.hyperparameters import Estimator
from rpim_opt.bayes.outliers import clustered, error_ratios
from rpim_opt.data import KnownAngle, KnownDistance, touches, with_known
from rpim_opt.problem import Repeatability
from rpim_opt.problem.contact import Touches, contrasted
from rpim_opt.problem.noise import Equations

SIGMA = 3e-5
NAMES = ("A", "B", "C", "D")


@cache
def socketed() -> ro.CalibrationProblem:
    """Four points, the first two at a known distance, touched 3 to 6 times in no order."""
    instance = ro.load("contact")
    rng = np.random.default_rng(5)
    data = instance.problem.data
    block = data.blocks[0]
    rows = np.flatnonzero(np.isin(block.point[:, 0], NAMES))
    rows = rng.permutation(rows[: 6 * len(NAMES) - 3])
    covariance = SIGMA**2 * np.array([np.diag(rng.uniform(0.5, 2, 3)) for _ in rows])
    plain = touches(block.q[rows, 0], block.point[rows, 0], covariance)
    return instance.problem.on(with_known(plain, [KnownDistance(("A", "B"), 0.25, 1e-5)]))


@cache
def faced() -> ro.CalibrationProblem:
    """The faces of a cube."""
    return ro.load("datum_cube").problem


def near(problem: ro.CalibrationProblem, seed: int = 0) -> np.ndarray:
    return 0.2 * np.random.default_rng(seed).normal(size=len(problem.parameters.free)) * problem.parameters.free.scale


def test_the_jacobian_is_the_derivative() -> None:
    problem = socketed()
    x = near(problem)
    J = problem.jacobian(x)
    numeric = np.column_stack(
        [(problem.residual(x - step) - problem.residual(x + step)) / 2e-7 for step in 1e-7 * np.eye(len(x))]
    )
    assert np.abs(J - numeric).max() < 1e-7 * np.abs(J).max()


def test_a_planes_contrasts_have_the_derivative_of_their_norm() -> None:
    """The gradient of |r|^2 / 2 is exact where a plane fits its touches best: it does not depend on the plane."""
    problem = faced()
    free = [i for i, block in enumerate(problem.data.blocks) if block.measurement.touching]
    only = problem.on(problem.data.take(np.concatenate([problem.data.blocks[i].row for i in free])))
    x = near(only)
    r, J = only.slopes(x)
    slope = -J.T @ r
    numeric = [
        (np.sum(only.residual(x + step) ** 2) - np.sum(only.residual(x - step) ** 2)) / 4e-7
        for step in 1e-7 * np.eye(len(x))
    ]
    assert slope == pytest.approx(np.array(numeric), abs=1e-6 * np.abs(slope).max())


def drawn(data: ro.Dataset, planar: bool, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return a residual -p (m,) of touches near points, or near planes, that are 0.3 m apart, and any Jacobian."""
    rng = np.random.default_rng(seed)
    found = Touches.of(data)
    raw = np.zeros(found.equations)
    for k, index in enumerate(found.rows):
        place = np.array([0.3 * k, 0.1 * k**2, 0.0])
        spread = 1e-3 * rng.normal(size=index.shape)
        if planar:  # nearly parallel: elsewhere a distance depends on where in the plane it is taken
            spread *= 1e-3
            spread += rng.uniform(-0.05, 0.05, index.shape) * (np.arange(3) != k % 3)
        raw[index] = -place - spread
    return raw, rng.normal(size=(found.equations, 5))


def columns(found: Touches, where) -> np.ndarray:
    """Return by what the equations change with the unknowns of every point (3) or plane (height, two tilts)."""
    F = np.zeros((found.equations, 3 * len(where)))
    moves = []
    for k, (thing, index) in enumerate(zip(where, found.rows, strict=True)):
        F[index, 3 * k : 3 * k + 3] = -np.eye(3)
        moves.append((np.eye(3), np.zeros((3, 3))))
        if thing.planar:
            F[index[:, 0], 3 * k : 3 * k + 3] = -thing.places
            F[index[:, 1:], 3 * k : 3 * k + 3] = 0.0
            height = np.column_stack([thing.normal, np.zeros((3, 2))])
            moves[-1] = (height, np.column_stack([np.zeros(3), -thing.across.T]))
    for tie in found.ties:
        first, second = (where[end] for end in tie.ends)
        (c1, n1), (c2, n2) = (moves[end] for end in tie.ends)
        one, other = (slice(3 * end, 3 * end + 3) for end in tie.ends)
        apart = second.centre - first.centre
        if tie.kind == "known_square":
            root = np.sqrt(1 - (first.normal @ second.normal) ** 2)
            F[tie.equations, one] = second.normal @ n1 / root
            F[tie.equations, other] = first.normal @ n2 / root
        elif tie.kind == "known_parallel":
            same = np.sign(first.normal @ second.normal)
            F[tie.equations, one] = -first.across @ n1
            F[tie.equations, other] = same * first.across @ n2
        elif first.planar:
            sign = np.sign(first.normal @ apart)
            F[tie.equations, one] = sign * (apart @ n1 - first.normal @ c1)
            F[tie.equations, other] = sign * first.normal @ c2
        else:
            F[tie.equations, one] = -apart / np.linalg.norm(apart)
            F[tie.equations, other] = apart / np.linalg.norm(apart)
    return F


POINTS = with_known(
    touches(np.zeros((11, 6)), [*"AAABBBBCCCD"], SIGMA),
    [KnownDistance(("A", "B"), 0.3, 1e-4), KnownDistance(("B", "C"), 0.4, 1e-4), KnownDistance(("C", "D"), 0.5, 1e-4)],
)
PLANES = with_known(
    touches(np.zeros((21, 6)), [*"AAAAABBBBBBCCCCCDDDDD"], SIGMA, planes=True),
    [
        KnownAngle(("A", "B"), parallel=False, sigma=1e-3),
        KnownAngle(("A", "D"), parallel=True, sigma=1e-3),
        KnownDistance(("A", "D"), 0.9, 1e-4),
        KnownAngle(("B", "C"), parallel=False, sigma=1e-3),
    ],
)


@pytest.mark.parametrize("data", [POINTS, PLANES], ids=["points", "planes"])
@pytest.mark.parametrize("joints", [False, True])
def test_elimination_is_a_fit_with_the_points_as_unknowns(data: ro.Dataset, joints: bool) -> None:
    """The same normal equations, at any noise: of instrument, position and joints."""
    found = Touches.of(data)
    raw, J = drawn(data, found.planar[0])
    where = found.located(raw)
    found = replace(found, where=where)
    rng = np.random.default_rng(1)
    blocks = [
        replace(b, covariance=b.covariance * rng.uniform(0.3, 3, (len(b.row), 1, 1))) if b.measurement.touching else b
        for b in data.blocks
    ]
    data = replace(data, blocks=tuple(blocks))
    slopes = rng.normal(size=(found.equations, 6)) if joints else None
    repeatability = Repeatability(position=4e-5, joint=2e-5 * joints)
    of = Equations.of(data)
    whole = [of.stack(index, slopes) for index in of.grouped(data.configuration[of.row])]
    stacks = contrasted(found, whole, np.arange(found.equations) // 3)
    left, moved = found.centred(raw, J)
    r, A = (found.contrasts(v.reshape(found.equations, -1)) for v in (left, moved))
    H, h, square, count = 0.0, 0.0, 0.0, 0
    for stack in stacks:
        for index, V in zip(stack.index, stack.covariance(repeatability), strict=True):
            H = H + A[index].T @ np.linalg.solve(V, A[index])
            h = h + A[index].T @ np.linalg.solve(V, r[index])
            square += float((r[index].T @ np.linalg.solve(V, r[index]))[0, 0])
            count += len(index)
    # the same with unknowns: what a touch shows, its noise, and what is stated
    tied = np.concatenate([tie.equations for tie in found.ties])
    shown = np.setdiff1d(np.arange(found.equations), tied)
    show = np.eye(found.equations)
    X = J.copy()
    X[tied] = 0.0
    V = np.zeros((found.equations, found.equations))
    start = 0
    for block in data.blocks:
        k = len(block.measurement.components)
        for i in range(len(block.row)):
            index = slice(start, start + k)
            V[index, index] = block.covariance[min(i, len(block.covariance) - 1)]
            if block.measurement.touching:
                V[index, index] += repeatability.position**2 * np.eye(3)
                if joints:
                    V[index, index] += repeatability.joint**2 * slopes[index] @ slopes[index].T
            start += k
    if found.planar[0]:
        for thing, index in zip(where, found.rows, strict=True):
            show[index] = thing.observed(show[index])
        shown = np.concatenate([index[:, 0] for index in found.rows])
    used = np.concatenate([shown, tied])
    X = (show @ X)[used]
    W = (show @ V @ show.T)[np.ix_(used, used)]
    F = columns(found, where)[used]
    e = left[used]
    P = np.linalg.inv(W)
    P = P - P @ F @ np.linalg.solve(F.T @ P @ F, F.T @ P)
    assert count == len(used) - F.shape[1]
    exact = {False: 1e-8, True: 1e-4}[found.planar[0]]
    assert pytest.approx(X.T @ P @ X, rel=10 * exact, abs=exact * np.abs(H).max()) == H
    assert h[:, 0] == pytest.approx(X.T @ P @ e, rel=10 * exact, abs=exact * np.abs(h).max())
    assert square == pytest.approx(e @ P @ e, rel=10 * exact)


def test_rows_may_stand_in_any_order() -> None:
    problem = ro.load("contact").problem
    order = np.random.default_rng(0).permutation(len(problem.data))
    x = near(problem)
    one, other = (each.linearize(x) for each in (problem, problem.on(problem.data.take(order))))
    assert one.qr_factor.T @ one.qr_factor == pytest.approx(other.qr_factor.T @ other.qr_factor, rel=1e-8, abs=1e-3)


def test_a_robot_that_shrinks_leaves_as_much() -> None:
    """All lengths, of robot and tool, times a tenth: touches that spread by a tenth, and count ten times."""
    problem = ro.load("contact").problem
    kept = [i for i, block in enumerate(problem.data.blocks) if block.measurement.touching]
    alone = problem.on(problem.data.take(problem.data.blocks[kept[0]].row))
    free = alone.parameters.free
    shrunk = np.where(np.array(free.dimensions) == "length", -0.9 * free.nominal, 0.0)
    assert alone.residual(shrunk) == pytest.approx(alone.residual(0 * shrunk), rel=1e-9)


def test_what_is_known_joins_points() -> None:
    assert POINTS.configuration.tolist() == [0] * 14
    q = np.arange(24.0).reshape(4, 6) / 10
    assert touches(q, ["A", "B", "A", "B"], SIGMA).configuration.tolist() == [0, 1, 0, 1]


def test_a_fold_has_all_of_a_point() -> None:
    model = ro.load("contact").problem.linearize(near(ro.load("contact").problem))
    assert len(np.unique(model.group)) == 8  # ten points, twice two of them joined
    assert {int(n) for n in np.bincount(model.group)} == {15, 31}


def test_in_parts_as_in_memory() -> None:
    problem = ro.load("contact").problem
    rows = [np.flatnonzero(np.isin(problem.data.configuration, some)) for some in (range(4), range(4, 8))]
    x = near(problem)
    halves = [problem.on(problem.data.take(some)) for some in rows]
    spread = [half.touches.size(half.slopes(0 * x, centred=False)[0]) for half in halves if half.touches]
    parts = [lambda some=some: problem.data.take(some) for some in rows]
    whole = ro.problem.PartitionedProblem(problem.robot, problem.parameters, parts[0](), parts)
    model = whole.linearize(x)
    assert model.equations == problem.linearize(x).equations
    # touches of a part count in units of that part's spread, which the deviations change by some 1e-3
    assert np.ptp(spread) > 0
    assert np.linalg.norm(model.qr_factor) == pytest.approx(np.linalg.norm(problem.linearize(x).qr_factor), rel=0.01)


def test_covariances_of_rows_are_those_of_what_they_are_off_their_mean() -> None:
    problem = socketed()
    noisy = np.random.default_rng(3)
    found = problem.covariances()
    block = problem.data.blocks[0]
    draws = []
    factors = np.linalg.cholesky(block.covariance)
    for _ in range(4000):
        e = (factors @ noisy.normal(size=(len(block.row), 3, 1)))[:, :, 0]
        for name in NAMES:
            mine = block.point[:, 0] == name
            e[mine] -= e[mine].mean(axis=0)
        draws.append(e)
    spread = np.var(draws, axis=0)
    assert np.einsum("nkk->nk", found[0]) == pytest.approx(spread, rel=0.15)
    d = found[1][0, 0, 0]
    assert 1e-5**2 < d < 1e-5**2 + (2 * SIGMA) ** 2


def test_errors_are_distances_from_the_mean_of_a_points_touches() -> None:
    instance = ro.load("contact")
    x = near(instance.problem)
    problem = instance.problem.on(instance.validation)
    errors = problem.errors(x)
    p = problem.modelled(x)[0]
    names = problem.data.blocks[0].point[:, 0]
    for name in dict.fromkeys(names.tolist()):
        mine = p[names == name]
        off = np.linalg.norm(mine - mine.mean(axis=0), axis=1)
        assert errors[: len(names)][names == name] == pytest.approx(off, rel=0.01)  # in units of the spread: 1e-3
    assert np.isnan(errors[len(names) :]).all()
    assert np.isfinite(problem.errors(x, "stated length")[len(names) :]).all()


@pytest.mark.parametrize("name", ["contact", "datum_cube"])
def test_evidence_does_not_see_the_points(name: str) -> None:
    """Slopes of -2 ln L by the logarithms of sizes are those of its differences."""
    problem = ro.load(name).problem
    x = near(problem)
    evidence = Estimator(Prior(), ("position", "joint")).evidence(problem, x)
    logs = evidence.centre + 0.3
    ahead = [evidence.at(logs + step).value for step in 1e-5 * np.eye(len(logs))]
    behind = [evidence.at(logs - step).value for step in 1e-5 * np.eye(len(logs))]
    numeric = (np.array(ahead) - behind) / 2e-5
    assert evidence.at(logs).gradient == pytest.approx(numeric, rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("formulation", [ro.tikhonov, ro.least_squares, ro.robust, ro.lasso])
def test_every_formulation_works_on_touches(formulation: ro.Formulation) -> None:
    instance = ro.load("contact")
    result = ro.calibrate(instance.problem, formulation, weight=0.1)
    before = np.nanmean(result.nominal_errors(instance.validation))
    assert np.nanmean(result.errors(instance.validation)) < 0.05 * before


@pytest.mark.parametrize("selector", ["reml", "l_curve", "gcv", "leave_one_out", "discrepancy"])
def test_every_selector_works_on_touches(selector: str) -> None:
    instance = ro.load("contact")
    result = ro.calibrate(instance.problem, ro.tikhonov, weight=selector)
    assert np.nanmean(result.errors(instance.validation)) < 5e-5


def test_a_result_survives_its_file(tmp_path: Path) -> None:
    result = replace(ro.load("contact").calibrate(weight=1.0), record=ro.load("contact").record)
    ro.store.save_result(result, tmp_path / "result.json")
    again = ro.store.load_result(tmp_path / "result.json")
    assert again.x == pytest.approx(result.x, abs=0)
    assert again.problem.data.blocks[0].point.tolist() == result.problem.data.blocks[0].point.tolist()
    assert np.array_equal(again.errors(), result.errors(), equal_nan=True)


def test_touches_of_a_point_are_neighbours_of_each_other() -> None:
    """Three that err alike in similar configurations are no blunders; one that errs alone is."""
    problem = socketed()
    assert problem.touches is not None
    q = problem.data.blocks[0].q.copy()
    labels = problem.labels
    q[2] += 0.02
    alone = problem.on(replace(problem.data, blocks=(replace(problem.data.blocks[0], q=q), *problem.data.blocks[1:])))
    x = np.zeros(len(problem.parameters.free))
    assert error_ratios(alone, x)[2] > 2 * error_ratios(problem, x)[2]
    assert not clustered(alone, x, np.array([2])).any()
    assert len(labels) == 22


@pytest.mark.slow
def test_a_configurations_step_is_arithmetic() -> None:
    problem = ro.load("datum_cube").problem
    place = np.array([[0.5, 0.1, 0.3], [0.6, -0.2, 0.2]])
    q = ro.problem.configurations_at(problem, place, seed=3)
    again = ro.problem.configurations_at(problem, place, seed=3)
    assert np.array_equal(q, again)
    low, high = problem.robot.limits.T
    assert ((q >= low) & (q <= high)).all()
    with pytest.raises(ro.InputError, match="out of reach"):
        ro.problem.configurations_at(problem, [[5.0, 0, 0]])


@pytest.mark.slow
def test_designed_configurations_tell_more_than_drawn_ones() -> None:
    problem = ro.load("contact").problem
    q = ro.problem.configurations_at(problem, np.tile([0.6, 0.1, 0.2], (40, 1)))
    design = ro.problem.choose(problem, q, 6, "D")

    def information(rows: np.ndarray) -> float:
        data = touches(q[rows], ["A"] * len(rows), 3e-5)
        A = problem.on(data).linearize(np.zeros(len(problem.parameters.free))).A
        return float(np.linalg.slogdet(np.eye(A.shape[1]) + A.T @ A)[1])

    rng = np.random.default_rng(0)
    drawn = [information(rng.choice(40, 6, replace=False)) for _ in range(30)]
    assert information(design.chosen) > max(drawn)


def test_inspect_says_what_touches_show() -> None:
    said = " ".join(ro.calibration.inspect(ro.load("contact").problem).contact)
    assert "Touches do not identify the base frame" in said
    assert ro.calibration.inspect(ro.load("paper_arm").problem).contact == ()


@pytest.mark.parametrize(
    ("known", "said"),
    [
        (KnownDistance(("A", "Z"), 0.3, 1e-5), "'Z'"),
        (KnownAngle(("A", "B"), parallel=True, sigma=1e-5), "two planes"),
    ],
)
def test_what_cannot_be_known_is_refused(known, said: str) -> None:
    with pytest.raises(ro.InputError, match=said):
        with_known(touches(np.zeros((4, 6)), [*"AABB"], SIGMA), [known])


def test_pairwise_names_of_ties_are_unique() -> None:
    assert len(set(PLANES.label)) == len(PLANES)
    assert all(one != other for one, other in pairwise(PLANES.label))
