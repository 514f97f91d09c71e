"""Start values of base frame, reflectors and fixtures, and their registration on the nominal robot."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rpim_opt.basics.arrays import Array, rms
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import three_digits
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.measurement import of_fixture
from rpim_opt.problem.blocks import Source, in_parts
from rpim_opt.problem.problem import CalibrationProblem, identifiable
from rpim_opt.problem.registration.camera import camera_blocks, starting_camera, with_poses
from rpim_opt.problem.registration.certified import UNKNOWN, certified_hand_eye
from rpim_opt.problem.registration.closed_forms import (
    NOMINAL_ERROR,
    TOOL_ERROR,
    Place,
    proper,
    register,
    rigid,
    transformed,
    transforms,
)
from rpim_opt.problem.registration.points import UNEXPLAINED, Points, fit_points
from rpim_opt.robot.chain import RobotSetup
from rpim_opt.robot.kinematics import forward_kinematics, frame_numbers, numeric_frame, roll_pitch_yaw
from rpim_opt.robot.library import find_robot, read_arm
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import Parameters, model_parameters, tool_prefix

SETTLED = 6  # rows of a session that determine base and reflector well enough for comparing others
ENOUGH = 2000  # most rows of a measurement used to register frames


def locate(robot: Robot, data: Dataset, tools: Mapping[str, Place]) -> tuple[Array, dict[str, Array], str]:
    """Return the base (6,), the reflectors (6,) by marker [m, rad], and a sentence on the method.

    They are registered from positions and poses on the nominal robot by `certified_hand_eye`: with several reflectors
    from the one with the most poses, or positions, from which the others follow. If that does not determine the
    rotations, all positions are fitted, reflectors near their stated places. Of `sessions_apart` the largest counts.
    """
    if sessions_apart(robot, data, tools):
        data = largest_session(data)
    parts = []
    for block in data.blocks:
        if block.measurement.name not in ("position", "pose"):
            continue
        rows = np.unique(np.linspace(0, len(block.row) - 1, min(len(block.row), ENOUGH)).round().astype(int))
        some = block.take(rows, rows)
        T = transforms(some.y) if block.measurement.name == "pose" else rigid(np.full((3, 3), np.nan), some.y)
        variance = np.zeros((len(rows), 2))  # of positions and orientations
        for k, part in enumerate((slice(3), slice(3, None))):
            variance[:, k] = np.trace(some.covariance[:, part, part], axis1=1, axis2=2) / 3
        parts.append((some.q[:, 0], T, np.full(len(rows), block.markers[0]), variance))
    if not parts:
        raise InputError("key base", '"auto" without positions or poses', "a table [base]")
    q, measured, marker, variance = (np.concatenate(each) for each in zip(*parts, strict=True))
    flange = forward_kinematics(robot, q)
    y = measured[:, :3, 3]
    turned = ~np.isnan(measured[:, 0, 0])
    sigma = np.sqrt(variance + NOMINAL_ERROR**2)  # of instrument and nominal robot together
    places = {name: np.array(place, dtype=float) for name, place in tools.items()}
    count = Counter(marker[turned].tolist() or marker.tolist())
    first = count.most_common(1)[0][0]
    own = marker == first
    try:
        certain: Any = {"sigma": tuple(sigma[own].T), "expected": places[first], "spread": TOOL_ERROR}
        start = certified_hand_eye(flange[own], measured[own], **certain)
        if start.uncertainty > UNKNOWN or (len(count) > 1 and not start.certified):
            raise InputError("the data", start.reason, "rotations about two axes")
    except InputError as error:
        how = f"registration of positions: {error.found}"
        names = list(places)
        number = np.array([names.index(name) for name in marker.tolist()])
        nominal = np.array([place[:3] for place in places.values()])
        # refuses points on a line
        register(transformed(flange, nominal[number]), y)
        points = Points(robot, q, y, number, nominal, None, np.arange(len(q)))
        fit = fit_points(points)
        base = fit.base
        for place, fitted in zip(places.values(), fit.tools, strict=True):
            place[:3] = fitted
    else:
        how = f"optimum of the registration {'' if start.certified else 'not '}certified: {start.reason}"
        base = start.base
        places[first][:3] = start.tool[:3, 3]
        for other in places.keys() - {first}:  # where their positions fit best, seen from the base
            own = marker == other
            back: Any = np.linalg.inv(base @ flange[own])
            precision = sigma[own, 0] ** -2
            total = places[other][:3] * TOOL_ERROR**-2 + precision @ transformed(back, y[own])
            places[other][:3] = total / (TOOL_ERROR**-2 + precision.sum())
    for name in np.unique(marker[turned]).tolist():  # with the orientation of the poses
        own = turned & (marker == name)
        turn = (base @ flange[own])[:, :3, :3].transpose(0, 2, 1) @ measured[own, :3, :3]
        places[name] = frame_numbers(rigid(proper(turn.sum(axis=0)), places[name][:3]))
    missed = transformed(base @ flange, np.array([places[name][:3] for name in marker.tolist()])) - y
    error = float(np.sqrt(np.mean(np.sum(missed**2, axis=1))))
    fits = "RMS error of the nominal robot"
    if error > UNEXPLAINED * np.linalg.norm(y.std(axis=0)):
        fits = "the nominal robot does not explain the data, RMS error"
    return frame_numbers(base), places, f"{fits} {three_digits(1e3 * error)} mm; {how}"


def largest_session(data: Dataset) -> Dataset:
    """Return the rows of the session with the most rows."""
    names = data.session
    return data.take(np.flatnonzero(names == Counter(names.tolist()).most_common(1)[0][0]))


def sessions_apart(robot: Robot, data: Dataset, tools: Mapping[str, Place]) -> dict[str, float]:
    """Return the session with the most rows, and those with another place of instrument or base; none without sessions.

    The nominal robot is registered to the first one, with reflectors starting at ``tools``; the value of a session is
    the RMS distance [m] of its points from this registration. A session is apart if that is several times the error of
    a nominal robot, or of the session's own registration.
    """
    here = largest_session(data)
    blocks = [block for block in data.blocks if block.measurement.name in ("position", "pose")]
    if not blocks or len(here) not in range(SETTLED, len(data)):
        return {}
    try:
        base, places, _ = locate(robot, here, tools)
    except InputError:  # undetermined rotations
        return {}
    session, y, modelled = (np.concatenate(each) for each in zip(*(
        (b.session_names, b.y[:, :3], transformed(forward_kinematics(robot, b.q[:, 0]), places[b.markers[0]][:3]))
        for b in blocks
    ), strict=True))  # fmt: skip
    modelled = transformed(numeric_frame(base), modelled)
    off = {str(here.session[0]): 0.0}
    for name in set(session) - set(off):
        own, there = y[session == name], modelled[session == name]
        with suppress(InputError):  # too few, or collinear
            error, alone = there - own, transformed(register(there, own), there) - own
            far, left = (rms(np.linalg.norm(each, axis=1)) for each in (error, alone))
            if far > MISPLACED * max(NOMINAL_ERROR, left):
                off[name] = far
    return off if len(off) > 1 else {}


APART = 0.1
"""Largest distance [m] between nominal robots at a point that both touched; beyond, it is another point."""


def shared_bases(problem: CalibrationProblem) -> dict[str, Array]:
    """Return bases (6,) by robot for nominal robots that touched the same points as earlier robots.

    The first robot that touched something keeps its stated base, as does one whose base is not identified, or that an
    instrument measured. Each other base minimizes the distances of the robot's touches from those of the robots so far.
    """
    known: dict[str, Array] = {}
    bases = {}
    for robot in problem.arms:
        alone = problem.alone(robot)
        things = zip(alone.touches.names, alone.touched, strict=True) if alone.touches else ()
        places = {str(name): thing.centre for name, thing in things if not thing.planar}  # in the robot's base frame
        if not places:
            continue
        p = alone.parameters
        k = p.frame("base_")
        base = numeric_frame(p.nominal[k])
        common = {name: place for name, place in places.items() if name in known}
        free = p.identified[k].all() and all(block.touched is not None for block in alone.data.blocks)
        if free:
            with suppress(InputError):  # too few, or collinear
                base = register(np.array(list(common.values())), np.array([known[name] for name in common]))
                bases[robot] = frame_numbers(base)
        for name, place in places.items():
            there = transformed(base, place)
            distance = float(np.linalg.norm(there - known.setdefault(name, there)))
            if (robot in bases or not free) and distance > APART:  # too few touches do not contradict a free base
                what = f"touches of '{name}' that are {distance:.2g} m from those of another robot"
                accepted = f"at most {APART:g} m: state or identify its base, or give another point another name"
                raise InputError(f"together, problem '{robot}'", what, accepted)
    return bases


MISPLACED = 3.0  # deviation of a frame from its statement, in scales, that counts as a mistake


def problem_from(
    robot: Robot | RobotSetup | str | Path,
    data: Dataset,
    identify: Iterable[str] = "auto",
    base: ArrayLike | Literal["auto"] = "auto",
    tool: ArrayLike | Mapping[str, ArrayLike] | None = None,
) -> CalibrationProblem:
    """Return the problem of a robot and its measurements, base and tool located in closed form.

    The ``robot`` is the nominal one, a result of `read_urdf`, a robot's file, or the name of a ready robot;
    ``identify`` are patterns of names, or ``"auto"``, as for `CalibrationProblem.identify`. ``base`` is the start of
    the base in the instrument's frame: (6,) x, y, z [m], roll, pitch, yaw [rad], R = Rz Ry Rx, or a transform (4, 4);
    ``"auto"`` registers it, zero if the measurements do not depend on it. ``tool``, (6,) or (4, 4), is the start of the
    reflector in the frame behind the last joint's modified-DH row, by default the URDF's tip, or zero; for several
    reflectors (``marker``) the start of all, or of each by name, ``{"A": ..., "B": ...}``. A start that the data
    contradict is replaced by registration. InputError for data with another number of joints, data that do not
    determine the base, or a pattern without a match.

    >>> import rpim_opt as ro
    >>> arm = ro.load("position").problem
    >>> problem = ro.problem_from(arm.robot, arm.data, tool=[0.02, 0, 0.06, 0, 0, 0])
    >>> len(problem.parameters.free), problem.parameters.free.nominal[-9:-6].round(2)
    (34, array([ 1.8 , -0.7 ,  0.35]))
    """
    if isinstance(robot, str | Path):
        robot = read_arm(find_robot(str(robot)))
    if isinstance(robot, RobotSetup):
        tool = robot.tool if tool is None else tool
        robot = robot.robot
    if not isinstance(robot, Robot):
        accepted = "a Robot, such as ro.robot.Robot('arm', mdh), a file, or the name of a ready robot"
        raise InputError("robot", type(robot).__name__, accepted)
    if not isinstance(data, Dataset):
        accepted = "a Dataset: ro.read_data(table, robot, {'position_mm': 0.03}), or ro.load(folder) of rpim-opt new"
        raise InputError("data", f"{data!r}" if isinstance(data, str | Path) else type(data).__name__, accepted)
    joints = {block.q.shape[-1] for block in data.blocks}
    if joints - {robot.joint_map.shape[1]}:
        found = f"{', '.join(map(str, sorted(joints)))} joint values per row"
        raise InputError("the data", found, f"{robot.joint_map.shape[1]}, those of '{robot.name}'")
    if isinstance(tool, Mapping):
        starts = {marker: _frame(frame, f"tool '{marker}'") for marker, frame in tool.items()}
    else:
        start = np.zeros(6) if tool is None else _frame(tool, "tool")
        starts = dict.fromkeys(sorted({marker for block in data.blocks for marker in block.markers}), start)
    placed = None if isinstance(base, str) and base == "auto" else _frame(base, "base")
    if placed is None and not any(block.measurement.registers for block in data.blocks):
        placed = np.zeros(6)  # lengths between two points do not depend on it
    parameters = starting_parameters(robot, data, placed, starts)
    problem = CalibrationProblem(robot, parameters.identify(identifiable(identify, robot, parameters, data)), data)
    found = relocated(problem)
    return found if isinstance(found, CalibrationProblem) else problem


def _frame(value: Any, name: str) -> Array:
    """Return the six numbers of a frame that is stated by them or by its transform."""
    accepted = "six finite numbers x, y, z [m], roll, pitch, yaw [rad], or a transform (4, 4)"
    numbers = np.zeros(0)
    with suppress(TypeError, ValueError):
        numbers = np.asarray(value, dtype=float)
    if numbers.shape not in ((6,), (4, 4)) or not np.isfinite(numbers).all():
        raise InputError(name, f"{value!r}", accepted)
    return numbers if numbers.ndim == 1 else np.array(frame_numbers(numbers))


FIXTURE, REFLECTOR = 1.0, 0.1
"""Possible error [m, rad] of a fixture and of a reflector after the first registration."""
TRIMMED, STEPS, GROSS = 3, 30, 5.0
"""Repetitions of a fit of fixtures, its steps, and the error in medians beyond which a row is then left out."""


def starting_parameters(
    robot: Robot,
    data: Dataset,
    base: Place | None = (0.0,) * 6,
    tools: Mapping[str, Place] | None = None,
    own: Mapping[str, float] | None = None,
    temperature: float | None = None,
    sessions: Sequence[str] = (),
) -> Parameters:
    """Return the model's parameters with closed-form values for what is not stated; none identified yet.

    ``base`` (6,) is the robot's base in the instrument's frame: x, y, z [m], roll, pitch, yaw [rad]; None registers it.
    ``tools`` are the reflectors' frames (6,) in the flange frame by marker; ``{"": frame}`` for a single one. ``own``
    are values [SI] of the measurements' own parameters by name; a fixture (anchor, plane, sphere) without any stated
    parameter is located with the nominal robot. Lengths are nominal at ``temperature`` [K], if the data state
    temperatures, by default their mean. ``sessions`` are those that further parts of the data add.

    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> tools = {"": [0.02, 0, 0.06, 0, 0, 0]}
    >>> parameters = ro.problem.starting_parameters(problem.robot, problem.data, base=None, tools=tools)
    >>> parameters.identify(["base_[xyz]"]).free.nominal.round(2)  # [m]; it stands at 1.8, -0.7, 0.35
    array([ 1.8 , -0.7 ,  0.35])
    """
    tools = tools or {"": (0.0,) * 6}
    for block in data.blocks:
        for marker in set(block.markers) - set(tools):
            where = f"row {data.label[block.row[0]]}, column marker"
            known = ", ".join(f"'{name}'" if name else "one without a name" for name in tools)
            raise InputError(where, f"'{marker}'", f"a reflector whose start is stated ([tool.{marker}]): {known}")
    own = {**(own or {}), **starting_cameras(data, own or {})}
    places = tools
    if base is None:
        base, located, _ = locate(robot, with_poses(data, own), tools)
        # a board or camera with another orientation is not visible
        tools = {**tools, **{block.markers[0]: located[block.markers[0]] for block in camera_blocks(data)}}
        places = {marker: [*located[marker][:3], *tools[marker][3:]] for marker in tools}
    values: dict[str, tuple[str, float]] = {}  # dimension and value [SI] of the measurements' own parameters
    fixtures: set[str] = set()  # those that the nominal robot locates
    for block in data.blocks:
        kind = block.measurement
        names = {name: of_fixture(name, block.fixture) for name in kind.parameters}
        start: Mapping[str, float] = {name: own[full] for name, full in names.items() if full in own}
        if names and not start and kind.start is not None:
            tool = numeric_frame(places[block.markers[0]])
            T = numeric_frame(base) @ forward_kinematics(robot, block.q[:, 0]) @ tool
            start = kind.start(T[:, :3, 3], block.y)
            fixtures |= {names[name] for name in start}
        values |= {full: (kind.parameters[name], float(start.get(name, 0.0))) for name, full in names.items()}
    if temperature is None and len(data.temperatures):
        temperature = float(data.temperatures.mean())
    named = sorted({*data.sessions, *sessions})
    frames = dict.fromkeys(of_fixture(f"{name}_", b.fixture) for b in data.blocks for name in b.measurement.frames)
    parameters = model_parameters(robot, base, tools, values, tuple(frames), named, temperature)
    return _with_fitted(robot, data, parameters, fixtures) if fixtures else parameters


def _with_fitted(robot: Robot, data: Dataset, parameters: Parameters, fixtures: Collection[str]) -> Parameters:
    """Return parameters with fixtures at the least-squares fit of the nominal robot, with reflectors fitted, too.

    A start with known reflectors has larger errors, of metres for a long cable's anchor. Gross outliers are left out;
    if the data do not determine a fit, fixtures stay in place.
    """
    fitted = np.isin(parameters.names, list(fixtures))
    markers = {marker for block in data.blocks for marker in block.markers}
    reflectors = np.isin(parameters.names, [tool_prefix(marker) + c for marker in markers for c in "xyz"])
    scale = np.where(fitted, FIXTURE, np.where(reflectors, REFLECTOR, parameters.scale))
    free = replace(parameters, identified=fitted | reflectors, scale=scale)
    problem = whole = CalibrationProblem(robot, free, data)
    x = np.zeros(len(free.free))
    for _ in range(TRIMMED):
        try:
            x = ridge_deviations(problem, STEPS)
            error = np.nan_to_num(whole.errors(x))
            kept = np.flatnonzero(error <= GROSS * np.median(error))
            if len(kept) == len(problem.data):
                break
            problem = whole.on(data.take(kept))
        except InputError:
            return parameters
    nominal = parameters.nominal.copy()
    nominal[fitted] += x[fitted[free.identified]]
    return replace(parameters, nominal=nominal)


def starting_cameras(data: Dataset, own: Mapping[str, float]) -> dict[str, float]:
    """Return focal lengths and centres [px] by name of cameras without entries in ``own``."""
    values = {}
    for block in camera_blocks(data):
        names = {name: of_fixture(name, block.fixture) for name in block.measurement.parameters}
        if len(block.row) and not any(full in own for name, full in names.items() if name.startswith("camera_")):
            start = starting_camera(data, block)
            values |= {of_fixture(f"camera_{name}", block.fixture): value for name, value in start.items()}
    return values


def relocated(problem: Source) -> Source | None:
    """Return the problem with base and reflectors registered to the data, if the stated ones contradict them."""
    p = problem.parameters
    nominal = p.nominal.copy()
    if len(problem.arms) > 1:  # each robot by itself; the first one determines a shared frame
        for name in problem.arms:
            alone = relocated(problem.sample().alone(name))
            if alone is not None:
                k = p.places_of(name)
                nominal[k] = np.where(nominal[k] == p.nominal[k], alone.parameters.nominal, nominal[k])
        for name, place in shared_bases(problem.sample()).items():
            own = p.of_robot(name)
            base = own.frame("base_")
            if _misplaced(own, base, place):
                nominal[p.places_of(name)[base]] = place
    else:
        base = p.frame("base_")
        if not p.identified[base].all():
            return None
        try:
            data = with_poses(problem.sample().data, dict(zip(p.names, p.nominal.tolist(), strict=True)))
            at = {block.markers[0]: p.frame(tool_prefix(block.markers[0])) for block in data.blocks}
            there, located, _ = locate(problem.robot, data, {marker: p.nominal[k] for marker, k in at.items()})
        except InputError:
            return None
        for k, place in [(base, there), *((k, located[marker]) for marker, k in at.items())]:
            if _misplaced(p, k, place):
                free = p.identified[k]
                nominal[k[free]] = place[free]
    if (nominal == p.nominal).all():
        return None
    return problem.with_parameters(replace(p, nominal=nominal))


def _misplaced(p: Parameters, k: np.ndarray, place: Array) -> bool:
    """Whether an identified frame at places k (6,) of a table is further than so many scales from its statement."""
    position, orientation = np.split(p.identified[k], 2)
    if not position.all() or orientation.any() != orientation.all():
        return False
    T, T0 = numeric_frame(place), numeric_frame(p.nominal[k])
    # the deviation from the nominal frame (`kinematics.frame`)
    deviation = np.concatenate([T[:3, 3] - T0[:3, 3], roll_pitch_yaw(T[:3, :3] @ T0[:3, :3].T)])
    far = np.abs(deviation) > MISPLACED * (p.scale[k] + NOMINAL_ERROR)
    return bool((far & p.identified[k]).any())


def fitted_frames(problem: Source) -> tuple[Source, Array]:
    """Return the problem that identifies frames only, and its solution.

    ::

        minimize    |Sigma^-1/2 r(S z)|^2 + |z|^2

    over the identified parameters of base, sessions, reflectors, anchors and other frames, in units of their scales,
    for the nominal robot. Return the problem of the frames (other parameters nominal; frames stated far off start from
    their registration) and the deviations (f,) [SI]; a problem without frames is returned as it is.

    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> fitted, x = ro.problem.fitted_frames(instance.problem)
    >>> len(x), f"{1e3 * fitted.on(instance.validation).errors(x).mean():.2f} mm"
    (9, '1.13 mm')
    """
    p = problem.parameters
    frames = p.of_frames & p.identified
    if not frames.any():
        return problem, np.zeros(len(p.free))
    alone = problem.identifying(frames)
    alone = relocated(alone) or alone
    return alone, ridge_deviations(alone)


def ridge_deviations(alone: Source, steps: int = 200, prior: tuple[Array, Array] | None = None) -> Array:
    """Return the deviations (n,) [SI] that minimize |A z - b|^2 + |z|^2, from nominal: a squared penalty at weight 1.

    With a ``prior`` L (k, n) and c (k,) it is |A z - b|^2 + |L z - c|^2, started at the prior's minimum. The method is
    Levenberg-Marquardt on the QR factor of a linearization, for any number of data.
    """
    source = in_parts(alone.frozen())
    scale = alone.parameters.free.scale
    L, c = prior or (np.eye(len(scale)), np.zeros(len(scale)))
    start = np.linalg.lstsq(L, c, rcond=None)[0] if prior else c
    at: list[Array] = []  # last linearization and its factor: derivatives are evaluated at the same points as residuals

    def qr_factor(z: Array) -> Array:
        if not at or not np.array_equal(at[0], z):
            at[:] = z.copy(), source.linearize(scale * z).qr_factor
        return at[1]

    def residual(z: Array) -> Array:
        return np.concatenate([qr_factor(z) @ [*z, -1.0], L @ z - c])

    def slopes(z: Array) -> Array:
        return np.vstack([qr_factor(z)[:, :-1], L])

    options: Any = {"jac": slopes, "x_scale": "jac", "xtol": 1e-11, "ftol": 1e-15, "gtol": 1e-15}
    z = scipy.optimize.least_squares(residual, start, method="lm", max_nfev=steps, **options).x
    z = z - np.linalg.lstsq(slopes(z), residual(z), rcond=None)[0]  # where the sum of squares no longer changes
    return np.asarray(scale * z, dtype=float)
