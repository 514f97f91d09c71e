"""What people get wrong in tables of measurements, done to simulated ones of real robots."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.robot import read_robot
from rpim_opt.robot.library import READY

NOISE = 5e-5
COUNT = 40
SEEDS = range(2, 12)


def simulated_arm(
    name: str | ro.robot.Robot, seed: int = 1, count: int = COUNT, markers: int = 1
) -> ro.CalibrationProblem:
    """Return measurements of a ready robot with deviations of 0.5 mm and 0.5 mrad, far from the instrument."""
    robot = read_robot(READY / f"{name}.toml") if isinstance(name, str) else name
    rng = np.random.default_rng(seed)
    low, high = np.clip(robot.limits, -2.5, 2.5).T
    q = rng.uniform(low, high, (count, robot.dof))
    names = [""] if markers == 1 else list("ABC"[:markers])
    places = [[0.06, -0.03, 0.09], [-0.08, 0.02, 0.05], [0.01, 0.09, 0.02]]
    tools = {m: [*place, 0.0, 0.0, 0.0] for m, place in zip(names, places, strict=False)}
    base = (1.8, -0.7, 0.35, 0.1, -0.2, 1.1)
    parameters = ro.robot.model_parameters(robot, base, tools)
    reflectors = [f"tool_{m}_[xyz]" if m else "tool_[xyz]" for m in names]
    parameters = parameters.identify(["alpha?", "a?", "theta?", "d?", "base_*", *reflectors])
    parameters = parameters.scaled({"length_mm": 0.5, "angle_mrad": 0.5, "base_mm": 10, "base_mrad": 10, "tool_mm": 1})
    blocks = []
    for k, marker in enumerate(names):
        block = ro.Dataset.of(q, np.zeros((count, 3)), NOISE).blocks[0]
        blocks.append(replace(block, markers=(marker,), row=np.arange(count) + k * count))
    label = tuple(f"P{i + 1}{m}" for m in names for i in range(count))
    data = ro.Dataset(tuple(blocks), label, np.tile(np.arange(count), len(names)))
    problem = ro.CalibrationProblem(robot, parameters, data)
    truth = rng.normal(size=len(parameters.free)) * parameters.free.scale
    y = problem.modelled(truth)
    noisy = [replace(b, y=each + NOISE * rng.normal(size=each.shape)) for b, each in zip(blocks, y, strict=True)]
    return problem.on(replace(data, blocks=tuple(noisy)))


Change = Callable[[ro.CalibrationProblem], ro.CalibrationProblem]


def joints(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def changed(problem: ro.CalibrationProblem) -> ro.CalibrationProblem:
        blocks = tuple(replace(b, q=change(b.q.copy())) for b in problem.data.blocks)
        return problem.on(replace(problem.data, blocks=blocks))

    return changed


def values(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def changed(problem: ro.CalibrationProblem) -> ro.CalibrationProblem:
        blocks = tuple(replace(b, y=change(b.y.copy())) for b in problem.data.blocks)
        return problem.on(replace(problem.data, blocks=blocks))

    return changed


def exchanged(i: int, j: int) -> Change:
    def change(q: np.ndarray) -> np.ndarray:
        q[..., [i, j]] = q[..., [j, i]]
        return q

    return joints(change)


def flipped(*which: int) -> Change:
    def change(q: np.ndarray) -> np.ndarray:
        q[..., list(which)] *= -1
        return q

    return joints(change)


def shifted(i: int, degrees: float) -> Change:
    def change(q: np.ndarray) -> np.ndarray:
        q[..., i] += np.radians(degrees)
        return q

    return joints(change)


def coupled(i: int, j: int, factor: float) -> Change:
    def change(q: np.ndarray) -> np.ndarray:
        q[..., i] += factor * q[..., j]
        return q

    return joints(change)


def twice(problem: ro.CalibrationProblem) -> ro.CalibrationProblem:
    """Write every row a second time."""
    (block,) = problem.data.blocks
    rows = np.arange(2 * COUNT)
    again = replace(block.take(np.tile(np.arange(COUNT), 2), rows), row=rows)
    return problem.on(ro.Dataset((again,), tuple(f"R{i}" for i in rows), rows))


def of_joint(i: int, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change the column (N,) of one joint alone."""

    def changed(q: np.ndarray) -> np.ndarray:
        q[:, 0, i] = change(q[:, 0, i])
        return q

    return joints(changed)


def too_long(y: np.ndarray) -> np.ndarray:
    """Measure to the surface of a reflector of 19 mm radius, from an instrument at the origin."""
    return y * (1 + 0.019 / np.linalg.norm(y, axis=1, keepdims=True))


def rounded(degrees: float) -> Change:
    step = np.radians(degrees)
    return joints(lambda q: (q / step).round() * step)


def rows_set(rows: list[int], value: float) -> Change:
    def change(y: np.ndarray) -> np.ndarray:
        y[rows] = value
        return y

    return values(change)


def rows_exchanged(i: int, j: int) -> Change:
    def change(y: np.ndarray) -> np.ndarray:
        y[[i, j]] = y[[j, i]]
        return y

    return values(change)


def moved_by(far: float, turn: float = 0.0) -> Change:
    """Move the instrument after two thirds of the rows, by metres and radians about z."""

    def change(y: np.ndarray) -> np.ndarray:
        R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        y[2 * COUNT // 3 :] = y[2 * COUNT // 3 :] @ R.T + [far, -far / 2, 0]
        return y

    return values(change)


def both(*changes: Change) -> Change:
    def changed(problem: ro.CalibrationProblem) -> ro.CalibrationProblem:
        for each in changes:
            problem = each(problem)
        return problem

    return changed


def moved_otherwise(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Measure the arm with other joint values than those of the table."""

    def changed(problem: ro.CalibrationProblem) -> ro.CalibrationProblem:
        other = joints(change)(problem)
        (block,), truth = problem.data.blocks, np.random.default_rng(5).normal(size=len(problem.parameters.free))
        y = other.modelled(truth * problem.parameters.free.scale)[0]
        return problem.on(replace(problem.data, blocks=(replace(block, y=y),)))

    return changed


def sum_and_difference(q: np.ndarray) -> np.ndarray:
    """Read the two motors of a differential that moves joints 5 and 6."""
    q[..., [4, 5]] = q[..., [4, 4]] + q[..., [5, 5]] * [1, -1]
    return q


def without_thousands(y: np.ndarray) -> np.ndarray:
    """Read ``1.234,5`` mm as 1.2345, in a frame in which half of x is above a metre."""
    y = y - [np.median(y[:, 0]) - 1, 0, 0]
    return np.where((np.abs(y) >= 1) & (np.arange(3) == 0), 1e-3 * y, y)


def angles_exchanged(y: np.ndarray) -> np.ndarray:
    """Compute positions, seen from 1.5 m away, with azimuths as elevations."""
    ahead = y + np.array([1.5, 0.0, 0.0])
    distance = np.linalg.norm(ahead, axis=1)
    azimuth, elevation = np.arctan2(ahead[:, 1], ahead[:, 0]), np.arcsin(ahead[:, 2] / distance)
    level = np.cos(azimuth) * distance
    return np.column_stack([level * np.cos(elevation), level * np.sin(elevation), np.sin(azimuth) * distance])


def dh_table(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Write another DH table (n, 5)."""

    def changed(problem: ro.CalibrationProblem) -> ro.CalibrationProblem:
        robot = replace(problem.robot, mdh=change(problem.robot.mdh))
        nominal = np.concatenate([robot.mdh.ravel(), problem.parameters.nominal[robot.mdh.size :]])
        return replace(problem, robots=robot, parameters=replace(problem.parameters, nominal=nominal))

    return changed


def pasted_twice(y: np.ndarray) -> np.ndarray:
    """Write the values of eight rows again in the place of others."""
    y[27:35] = y[7:15]
    return y


def deviations(problem: ro.CalibrationProblem) -> ro.CalibrationProblem:
    """Write how far the points are from those of the nominal robot."""
    computed = problem.modelled(np.zeros(len(problem.parameters.free)))[0]
    return values(lambda y: y - computed)(problem)


MAPPED = "Joint mapping estimated from the data"
"""What is said where signs and zeros of joints were found: the calibration is right then."""
BY_TEXT = sorted(range(COUNT), key=lambda i: str(i + 1))
IN_TABLES: dict[str, tuple[Change, str]] = {
    "joints 2 and 3 exchanged": (exchanged(1, 2), "joints 2 and 3 exchanged"),
    "joints 4 and 6 exchanged": (exchanged(3, 5), "joints 4 and 6 exchanged"),
    "joints 1 and 2 exchanged": (exchanged(0, 1), "joints 1 and 2 exchanged"),
    "joint 2 reversed": (flipped(1), MAPPED),
    "joint 3 reversed": (flipped(2), MAPPED),
    "joint 5 reversed": (flipped(4), MAPPED),
    "joint 6 reversed": (flipped(5), MAPPED),
    "joints 3 and 5 reversed": (flipped(2, 4), MAPPED),
    "joint 2 from 90 degrees": (shifted(1, 90), MAPPED),
    "joint 3 from -90 degrees": (shifted(2, -90), MAPPED),
    "joint 5 from 180 degrees": (shifted(4, 180), MAPPED),
    "joint 2 from 90 degrees and joint 3 reversed": (both(shifted(1, 90), flipped(2)), MAPPED),
    "joint 3 coupled to 2": (coupled(2, 1, 1.0), "joint 3 coupled to joint 2 (q3 minus q2)"),
    "joint 3 coupled to 2 the other way": (coupled(2, 1, -1.0), "joint 3 coupled to joint 2 (q3 plus q2)"),
    "joint 3 coupled to half of 2": (coupled(2, 1, 0.5), "q3 minus 0.5 q2"),
    "gon as degrees": (joints(lambda q: q / 0.9), "as gon, not degrees"),
    "centimetres as millimetres": (values(lambda y: y / 10), "in cm, not mm"),
    "a column in centimetres": (values(lambda y: y / [1, 10, 1]), "column y in cm, not mm"),
    "a column in centimetres, joints exchanged": (
        both(values(lambda y: y / [1, 1, 10]), exchanged(3, 5)),
        "joints 4 and 6 exchanged",
    ),
    "joint 6 coupled to an 81st of 5": (coupled(5, 4, 1 / 81), "joint 6 is coupled to joint 5"),
    "a gear of joint 3 that is 1 % off": (joints(lambda q: q * (1 + 0.01 * (np.arange(q.shape[-1]) == 2))), "joint 3"),
    "every row twice": (lambda problem: twice(problem), "repeat others to the last digit"),
    "joint 5 coupled to 4": (coupled(4, 3, 1.0), "joint 5 coupled to joint 4"),
    "degrees as radians": (joints(np.degrees), "degrees, not radians"),
    "radians as degrees": (joints(np.radians), "radians, not degrees"),
    "metres as millimetres": (values(lambda y: y / 1e3), "a thousand times larger: name the columns x_m"),
    "millimetres as metres": (values(lambda y: 1e3 * y), "a thousand times smaller: name the columns x_mm"),
    "inches as millimetres": (values(lambda y: y / 25.4), "in inches"),
    "left-handed": (values(lambda y: y * [1, -1, 1]), "mirrored"),
    "x and y exchanged": (values(lambda y: y[:, [1, 0, 2]]), "mirrored"),
    "values a row too low": (values(lambda y: np.roll(y, 1, axis=0)), "1 row too low"),
    "values a row too high": (values(lambda y: np.roll(y, -1, axis=0)), "1 row too high"),
    "values two rows too low": (values(lambda y: np.roll(y, 2, axis=0)), "2 rows too low"),
    "values from the last to the first": (values(lambda y: y[::-1]), "reverse order"),
    "values sorted as texts": (values(lambda y: y[BY_TEXT]), "sorted as text "),
    "a row of zeros": (rows_set([7], 0.0), "row P8 has 0 for every"),
    "three rows of zeros": (rows_set([7, 8, 20], 0.0), "rows P8, P9, P21 have 0 for every"),
    "two rows exchanged": (rows_exchanged(4, 21), "P5 and P22"),
    "tracker moved by 300 mm": (moved_by(0.3, 0.2), "from about row P2"),
    "tracker moved by 1 mm": (moved_by(1e-3), "from row P2"),
    "joint 5 in radians": (of_joint(4, np.radians), "joint 5 read as radians, not degrees"),
    "joints in turns": (joints(lambda q: q / 360), "as turns, not degrees"),
    "column q1 a row too low": (of_joint(0, lambda q: np.roll(q, 1)), "the values of joint 1 one row too low"),
    "joint 5 frozen": (of_joint(4, lambda q: 0 * q + 0.3), "the values of joint 5 explain nothing"),
    "joint 2 frozen halfway": (
        of_joint(1, lambda q: np.where(np.arange(COUNT) < 20, q, q[20])),
        "wrong values of joint 2",
    ),
    "signs of joint 3 lost": (of_joint(2, np.abs), "values of joint 3"),
    # about the middle: where all y are negative, their signs lost are a mirrored frame, and that is what is named
    "signs of positions lost": (
        values(lambda y: np.abs(y - y.mean(axis=0))),
        "no value of columns x, y and z is negative",
    ),
    "y a copy of x": (values(lambda y: y[:, [0, 0, 2]]), "columns x and y are equal in every row"),
    "z a column of RMS": (
        values(lambda y: np.column_stack([y[:, :2], 2e-5 * np.random.default_rng(3).chisquare(3, len(y))])),
        "the values of coordinate z explain nothing",
    ),
    "x sorted alone": (
        values(lambda y: np.column_stack([np.sort(y[:, 0]), y[:, 1:]])),
        "the values of coordinate x explain nothing",
    ),
    "distances too long": (values(too_long), "check the instrument's zero and the reflector's radius"),
    "joint 2 slipped halfway": (
        of_joint(1, lambda q: q + 0.014 * (np.arange(COUNT) < 20)),
        "consistent with a changed zero of joint 2",
    ),
    "joint 5 shuffled": (of_joint(4, np.random.default_rng(3).permutation), "the values of joint 5 explain nothing"),
    "joint 4 reversed at half its gear": (of_joint(3, lambda q: -q / 2), "the values of joint 4 explain nothing"),
    "joints 2 and 4 slipped halfway": (
        both(
            of_joint(1, lambda q: q + 0.026 * (np.arange(COUNT) < 20)),
            of_joint(3, lambda q: q - 0.035 * (np.arange(COUNT) < 20)),
        ),
        "did several joints slip",
    ),
    "positions rounded to sixteenths of an inch": (
        values(lambda y: (y / 1.5875e-3).round() * 1.5875e-3),
        "measured values are rounded to 1.58",
    ),
    "cylindrical coordinates": (
        values(
            lambda y: np.column_stack(
                [np.hypot(y[:, 0], y[:, 1]), 1e-3 * np.degrees(np.arctan2(y[:, 1], y[:, 0])), y[:, 2]]
            )
        ),
        "cylindrical",
    ),
    "joint 5 stood still": (
        moved_otherwise(lambda q: q * (1, 1, 1, 1, 0, *[1] * (q.shape[-1] - 5))),
        "joint 5 standing",
    ),
    "azimuths and elevations exchanged": (values(lambda y: angles_exchanged(y)), "azimuths and elevations exchanged"),
    "a lens": (
        values(lambda y: y + 0.02 * (y - y.mean(axis=0)) * np.sum((y - y.mean(axis=0)) ** 2, axis=1, keepdims=True)),
        "with the cube of their distance",
    ),
    "columns of a differential": (joints(sum_and_difference), "q5 and q6 that are sum and difference"),
    "thousands read as decimals": (values(without_thousands), "values of column x above 1000 mm read as a thousandth"),
    "the reflector before the last joint": (
        moved_otherwise(lambda q: q * (np.arange(q.shape[-1]) < q.shape[-1] - 1)),
        "the reflector on the link of joint",
    ),
    "the reflector on link 4": (
        moved_otherwise(lambda q: q * (np.arange(q.shape[-1]) < 4)),
        "the reflector on the link of joint 4",
    ),
    "column d a row too low": (
        dh_table(lambda mdh: np.column_stack([mdh[:, :3], np.roll(mdh[:, 3], 1), mdh[:, 4]])),
        "column d one row too low in the DH table",
    ),
    "columns a and d exchanged": (
        dh_table(lambda mdh: mdh[:, [0, 3, 2, 1, 4]]),
        "columns a and d of the DH table exchanged",
    ),
    "columns a and d of a standard table exchanged": (  # a of a row is that of the next one here
        dh_table(
            lambda mdh: np.column_stack(
                [mdh[:, 0], np.append(0, mdh[:-1, 3]), mdh[:, 2], np.append(mdh[1:, 1], 0), mdh[:, 4]]
            )
        ),
        "columns a and d of the standard DH table exchanged",
    ),
    "rows of the DH table exchanged": (
        dh_table(lambda mdh: mdh[[0, 1, 2, 4, 3, *range(5, len(mdh))]]),
        "rows 4 and 5 of the DH table exchanged",
    ),
    "a block pasted twice": (values(pasted_twice), "rows P28 (P8), P29 (P9), P30 (P10)"),
    "signs of x lost": (
        values(lambda y: np.column_stack([np.abs(y[:, 0] - y[:, 0].mean()), y[:, 1:]])),
        "values of coordinate x",
    ),
    "z shuffled": (
        values(lambda y: np.column_stack([y[:, :2], np.random.default_rng(3).permutation(y[:, 2])])),
        "the values of coordinate z explain nothing",
    ),
    "deviations": (deviations, "were deviations exported, not positions"),
    "the floor heaves": (
        values(lambda y: y + 1e-3 * np.outer(np.sin(np.arange(COUNT) / 3.5), [0, 0, 1])),
        "the instrument or the base drifted slowly",
    ),
    "joint 2 creeps": (
        of_joint(1, lambda q: q + 8e-3 * np.linspace(-0.5, 0.5, COUNT)),
        "consistent with a changed zero of joint 2",
    ),
    "the instrument sinks": (
        values(lambda y: y + np.array([0, 0, 2e-3]) * np.linspace(0, 1, COUNT)[:, None] ** 2),
        "the instrument or the base drifted slowly",
    ),
    "joint 3 with backlash": (
        of_joint(2, lambda q: q + 3.5e-3 * np.random.default_rng(4).choice([-1, 1], COUNT)),
        "backlash, joint 3 by 7 mrad",
    ),
    "joint values read on the way": (
        joints(lambda q: q - 2e-3 * np.diff(q, axis=0, prepend=q[:1])),
        "joint values lag behind by 0.2 % of each move",
    ),
    "axes that are not square": (
        values(lambda y: y + 2e-3 * np.outer(y[:, 1], [1, 0, 0])),
        "of column y (the residual RMS falls",
    ),
    "joints rounded to 0.1 degrees": (rounded(0.1), "rounded to 0.1 deg ("),
    "joints rounded to a degree": (rounded(1.0), "rounded to 1 deg ("),
}


def of_two_kinds(q: np.ndarray) -> np.ndarray:
    """Return joint values whose every third row was read with other zeros of all joints."""
    return q + 4e-3 * np.where(np.arange(len(q)) % 3, 0, 1)[:, None] * (-1) ** np.arange(q.shape[1])


def filled_by_controller(problem: ro.CalibrationProblem) -> ro.CalibrationProblem:
    """Fill every third row with the position that the nominal robot computes."""
    computed = problem.modelled(np.zeros(len(problem.parameters.free)))[0]
    return values(lambda y: np.where(np.arange(len(y))[:, None] % 3, y, computed))(problem)


def commanded(problem: ro.CalibrationProblem) -> ro.CalibrationProblem:
    """Write commanded degrees; the joints stop half a milliradian beside them."""
    rng = np.random.default_rng(6)
    whole = joints(lambda q: np.radians(np.degrees(q).round()))(problem)
    reached = joints(lambda q: q + 5e-4 * rng.normal(size=q.shape))(whole)
    return values(lambda y: reached.modelled(np.zeros(len(problem.parameters.free)))[0])(whole)


def of_worn_circles(y: np.ndarray) -> np.ndarray:
    """Return positions by an instrument whose vertical circle has an index error of 5 mrad, and an eccentric one."""
    radius, azimuth = np.linalg.norm(y, axis=1), np.arctan2(y[:, 1], y[:, 0])
    elevation = np.arcsin(y[:, 2] / radius) + 5e-3
    azimuth += 3e-3 * np.sin(azimuth + 0.7)
    flat = radius * np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), radius * np.sin(elevation)])


def of_zenith_angles(y: np.ndarray) -> np.ndarray:
    """Return positions from zenith angles that were taken for elevations, of an instrument at half the arm's height."""
    low = y - [0.0, 0.0, np.median(y[:, 2])]
    radius, azimuth = np.linalg.norm(low, axis=1), np.arctan2(low[:, 1], low[:, 0])
    elevation = np.arccos(low[:, 2] / radius)
    flat = radius * np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), radius * np.sin(elevation)])


def to_zenith(y: np.ndarray) -> np.ndarray:
    """Return azimuth and zenith angle [gon], read as millimetres, and distance."""
    radius, azimuth = np.linalg.norm(y, axis=1), np.arctan2(y[:, 1], y[:, 0])
    return np.column_stack([azimuth / np.pi * 0.2, np.arccos(y[:, 2] / radius) / np.pi * 0.2, radius])


def grown(problem: ro.CalibrationProblem) -> ro.CalibrationProblem:
    """Measure an arm whose lengths grow by 0.1 % from the first row to the last."""
    free = problem.parameters.free
    of_arm = (np.array(free.dimensions) == "length") & ~free.of_frames
    nominal = problem.parameters.nominal[problem.parameters.identified]
    growth = (problem.jacobian(np.zeros(len(free))) @ np.where(of_arm, nominal, 0.0)).reshape(COUNT, 3)
    return values(lambda y: y + 1e-3 * np.linspace(0, 1, COUNT)[:, None] * growth)(problem)


def seen_from_the_reflector(problem: ro.CalibrationProblem) -> ro.CalibrationProblem:
    """Measure where the instrument is in a frame that turns with the nominal flange."""
    R = ro.robot.forward_kinematics(problem.robot, problem.data.q)[:, :3, :3]
    base = Rotation.from_euler("xyz", problem.parameters.nominal[problem.parameters.frame("base_")][3:]).as_matrix()
    return values(lambda y: -np.einsum("nji,nj->ni", base @ R, y))(problem)


def of_two_sides(q: np.ndarray) -> np.ndarray:
    """Return joint values of which the first two are on either side of their play of 2 mrad."""
    return q + 1e-3 * np.random.default_rng(4).choice([-1, 1], q.shape) * (np.arange(q.shape[1]) < 2)


def tenths(q: np.ndarray) -> np.ndarray:
    return np.radians(np.degrees(q).round(1))


def from_horizontal(q: np.ndarray) -> np.ndarray:
    """Return the values of a controller that counts joint 3 as FANUC's do, downwards, and joints 4 and 6 reversed."""
    counted = q.copy()
    counted[:, 2] = -q[:, 1] - q[:, 2]
    counted[:, [3, 5]] *= -1
    return counted


def of_joint_rows(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change the joint values (N, dof) of all rows."""
    return joints(lambda q: change(q[:, 0])[:, None])


IN_TABLES |= {
    "every third row with other zeros": (of_joint_rows(of_two_kinds), "fit other parameters than the rest"),
    "every third row computed": (filled_by_controller, "were they computed, not measured?"),
    "joints 1 to 3 rounded": (
        of_joint_rows(lambda q: np.where(np.arange(q.shape[1]) < 3, tenths(q), q)),
        "(q1, q2, q3)",
    ),
    "an arm that warms up": (grown, "the arm grows from row to row, by 0."),
    "play in two joints": (of_joint_rows(of_two_sides), "backlash, joint 1 by "),
    "a reading missed, a later one taken twice": (
        values(lambda y: np.concatenate([y[:12], y[13:24], y[23:]])),
        "fit the joint values of the next row",
    ),
    "commanded degrees": (commanded, "these are commanded joint values"),
    "worn circles of the instrument": (values(of_worn_circles), "angles of the instrument at the origin"),
    "a filter of the instrument": (
        values(lambda y: np.vstack([y[:1], 0.998 * y[1:] + 0.002 * y[:-1]])),
        "measured positions lag behind by 0.2 % of each move",
    ),
    "joint 3 from the horizontal, and three joints reversed": (
        of_joint_rows(from_horizontal),
        "joint 3 coupled to joint 2 and joint",
    ),
    "mirrored, and joint 1 reversed": (
        both(values(lambda y: y * [1, -1, 1]), flipped(0)),
        "left-handed measured frame with joint 1 reversed",
    ),
    "inches, joint 2 from 90 degrees and joint 3 reversed": (
        both(values(lambda y: y / 25.4), shifted(1, 90), flipped(2)),
        "measured lengths in inches, not mm and ",
    ),
    "zenith angles under the name of elevations": (values(of_zenith_angles), "elevations and zenith angles exchanged"),
    "zenith angles in gon": (values(to_zenith), "azimuth, zenith angle and distance in gon"),
    "the distance before the angles": (
        values(lambda y: np.roll(to_zenith(y), 1, axis=1)),
        "distance, azimuth, zenith angle in gon: convert the angles to azimuth and elevation in degrees, and name the "
        "columns distance_mm, azimuth_deg, elevation_deg",
    ),
    "joint 2 moved by a thousandth of 1": (coupled(1, 0, 1e-3), "no gear has so small a ratio: check bearings"),
    "the last joint half a turn off in rows": (
        of_joint_rows(
            lambda q: q + np.pi * np.outer(np.arange(len(q)) % 3 == 1, np.arange(q.shape[1]) == q.shape[1] - 1)
        ),
        "the reflector of every row in a column `marker` of the raw table (rpim-opt new), or correct joint ",
    ),
}
ROBOTS = ("ur5e", "irb120", "iiwa7")
OTHER = {"ur5e": "ur10e", "irb120": "irb140", "iiwa7": "fr3"}


def calibrated(problem: ro.CalibrationProblem) -> ro.calibration.Calibration:
    return ro.calibrate(problem, ro.tikhonov, weight=ro.reml)


def another_robot(robot: str) -> ro.calibration.Calibration:
    return calibrated(simulated_arm(robot).on(simulated_arm(OTHER[robot]).data))


def reflectors_exchanged(problem: ro.CalibrationProblem) -> ro.CalibrationProblem:
    """Exchange the values of two reflectors in three rows."""
    first, second = problem.data.blocks
    a, b = first.y.copy(), second.y.copy()
    rows = [5, 11, 30]
    a[rows], b[rows] = second.y[rows], first.y[rows]
    return problem.on(replace(problem.data, blocks=(replace(first, y=a), replace(second, y=b))))


def validated(result: ro.calibration.Calibration, rows: ro.Dataset) -> ro.calibration.Calibration:
    return replace(result, record=replace(result.record, validation=rows))


def rows_on_both_sides(robot: str) -> ro.calibration.Calibration:
    result = calibrated(simulated_arm(robot))
    return validated(result, result.problem.data.take([3, 9]))


Wrong = Callable[[str], ro.calibration.Calibration]
LONGER = dict.fromkeys(("every third row with other zeros", "every third row computed"), 60)
"""Rows of tables that are told by two calibrations, each with all parameters: 40 of a seventh joint are too few."""
MISTAKES: dict[str, tuple[Wrong, str]] = {
    name: (
        lambda robot, change=change, name=name: calibrated(change(simulated_arm(robot, count=LONGER.get(name, COUNT)))),
        expected,
    )
    for name, (change, expected) in IN_TABLES.items()
}
MISTAKES |= {
    "another robot": (another_robot, "the ready robot {other}"),
    "two reflectors exchanged in three rows": (
        lambda robot: calibrated(reflectors_exchanged(simulated_arm(robot, markers=2))),
        "fit another reflector",
    ),
    "two rows calibrated with and kept apart": (rows_on_both_sides, "2 of 2 rows of the validation set"),
}
"""Calibrations of a robot with a mistake in them, and what names it."""


def likely(robot: str, mistake: str) -> tuple[list[str], bool]:
    """Return what is said of a mistake, and whether that names it."""
    wrong, expected = MISTAKES[mistake]
    result = wrong(robot)
    causes = ro.calibration.likely_causes(result)
    return causes, any(expected.format(other=OTHER[robot]) in text for text in [*causes, result.message])


def good(robot: str, seed: int) -> list[str]:
    """Return what is said of good data, which should be nothing."""
    return ro.calibration.likely_causes(calibrated(simulated_arm(robot, seed)))
