"""Where base, reflectors and fixtures start, and where the data put them on the nominal robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.data.models import of_fixture
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.located import locate
from rpim_opt.problem.meeting import met
from rpim_opt.problem.parts import in_parts
from rpim_opt.problem.placing import NOMINAL_ERROR, Place
from rpim_opt.problem.source import Source
from rpim_opt.problem.views import camera_blocks, posed, starting_camera
from rpim_opt.robot.kinematics import FRAME, forward_kinematics, numeric_frame, roll_pitch_yaw
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.model import model_parameters
from rpim_opt.robot.parameter_names import tool_prefix
from rpim_opt.robot.parameters import Parameters

MISPLACED = 3.0
"""How many scales a frame may be from where it is stated before the statement counts as a mistake."""
MOST_STEPS = 200
"""Steps, taken or refused, after which frames are as good as they get."""
SHORT, ROUNDING = 1e-11, 1e-12
"""Frames are found when a full step is shorter than the first, relative to 1 + |z|; a step is refused when it raises
the objective by more than the second."""


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

    Parameters
    ----------
    robot, data
        The nominal robot and what was measured.
    base
        (6,) the robot's base in the instrument's frame: x, y, z [m], roll, pitch, yaw [rad]; None for registration.
    tools
        Reflectors in the flange frame by marker, (6,) each as the base; ``{"": frame}`` for the only one.
    own
        Values [SI] of the measurements' own parameters by name; a fixture (anchor, plane, sphere) none of whose
        parameters is stated is located from the nominal robot.
    temperature
        At which lengths are as on the drawing [K], where the data state temperatures; their mean by default.
    sessions
        Names of sessions that are not among the data, where these are the first of several parts.

    Raises
    ------
    InputError
        For a marker of the data without a reflector, and data that do not determine what they have to.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> tools = {"": [0.02, 0, 0.06, 0, 0, 0]}
    >>> parameters = ro.problem.starting_parameters(problem.robot, problem.data, base=None, tools=tools)
    >>> parameters.identify(["base_[xyz]"]).free.nominal.round(2)  # [m]; it stands at 1.8, -0.7, 0.35
    array([ 1.8 , -0.7 ,  0.35])
    """
    tools = tools or {"": (0.0,) * 6}
    _require_reflectors(data, tools)
    own = {**(own or {}), **starting_cameras(data, own or {})}
    places = tools
    if base is None:
        base, located, _ = locate(robot, posed(data, own), tools)
        # a board or a camera that is turned otherwise is not in sight
        tools = {**tools, **{block.markers[0]: located[block.markers[0]] for block in camera_blocks(data)}}
        places = {marker: [*located[marker][:3], *tools[marker][3:]] for marker in tools}
    entries: dict[str, tuple[str, float]] = {}
    for block in data.blocks:
        given = _own_values(robot, block, base, places[block.markers[0]], own)
        for name, dimension in block.measurement.parameters.items():
            entries[of_fixture(name, block.fixture)] = (dimension, float(given.get(name, 0.0)))
    reference = _reference(data, temperature)
    named = sorted({*data.sessions, *sessions})
    return model_parameters(robot, base, tools, entries, own_frames(data), named, reference)


def _reference(data: Dataset, stated: float | None) -> float | None:
    """Return the temperature at which lengths are as on the drawing [K]; None where nothing is known of it."""
    if stated is None and len(data.temperatures):
        return float(data.temperatures.mean())
    return stated


def starting_cameras(data: Dataset, own: Mapping[str, float]) -> dict[str, float]:
    """Return focal lengths and centres [px] by name of cameras of which nothing is stated in ``own``."""
    found = {}
    for block in camera_blocks(data):
        names = {name: of_fixture(name, block.fixture) for name in block.measurement.parameters}
        if len(block.row) and not any(full in own for name, full in names.items() if name.startswith("camera_")):
            start = starting_camera(data, block)
            found |= {of_fixture(f"camera_{name}", block.fixture): value for name, value in start.items()}
    return found


def own_frames(data: Dataset) -> tuple[str, ...]:
    """Return the prefixes of the frames that measurements have of their own, ``plane_``."""
    blocks = [(block.measurement, block.fixture) for block in data.blocks]
    return tuple(dict.fromkeys(of_fixture(name + "_", fixture) for kind, fixture in blocks for name in kind.frames))


def _require_reflectors(data: Dataset, tools: Mapping[str, Place]) -> None:
    """Refuse rows of a reflector that nobody has stated."""
    for block in data.blocks:
        for marker in set(block.markers) - set(tools):
            where = f"row {data.label[block.row[0]]}, column marker"
            known = ", ".join(f"[tool.{name}]" if name else "[tool]" for name in tools)
            raise InputError(where, f"'{marker}'", f"a reflector with a table of its own; there is {known}")


def _own_values(
    robot: Robot, block: Block, base: Place, tool: Place, stated: Mapping[str, float]
) -> Mapping[str, float]:
    """Return what is stated of a measurement's own parameters, or where the nominal robot puts its fixture."""
    kind = block.measurement
    names = {name: of_fixture(name, block.fixture) for name in kind.parameters}
    given = {name: stated[full] for name, full in names.items() if full in stated}
    if given or not names or kind.start is None:
        return given
    T = numeric_frame(base) @ forward_kinematics(robot, block.q[:, 0]) @ numeric_frame(tool)
    return kind.start(T[:, :3, 3], block.y)


def relocated(problem: Source) -> Source | None:
    """Return the problem with base and reflectors where the data put them, if what is stated contradicts that.

    Compared is what `locate` finds on the nominal robot with identified frames. A frame that is more than three
    scales away, and more than the robot's own errors explain, was not known: its deviations then count from where
    it was found. None when every frame is near enough, or the data do not tell.
    """
    if len(problem.arms) > 1:
        return _each_relocated(problem)
    p = problem.parameters
    nominal = p.nominal.copy()
    for k, place in _located(problem):
        free = p.identified[k]
        if _misplaced(p, k, place):
            nominal[k[free]] = place[free]
    return _moved(problem, nominal)


def _located(problem: Source) -> list[tuple[np.ndarray, Array]]:
    """Return where base and reflectors are in the table and where the data put them, (6,) each; none if they do not."""
    p = problem.parameters
    base = _frame_of(p, "base_")
    if not p.identified[base].all():
        return []
    try:
        data = posed(problem.sample().data, dict(zip(p.names, p.nominal.tolist(), strict=True)))
        at = {block.markers[0]: _frame_of(p, tool_prefix(block.markers[0])) for block in data.blocks}
        found, places, _ = locate(problem.robot, data, {marker: p.nominal[k] for marker, k in at.items()})
    except InputError:
        return []
    return [(base, found), *((k, places[marker]) for marker, k in at.items())]


def _moved(problem: Source, nominal: Array) -> Source | None:
    """Return the problem with other nominal values (P,); None if they are the same."""
    if (nominal == problem.parameters.nominal).all():
        return None
    return problem.with_parameters(replace(problem.parameters, nominal=nominal))


def _frame_of(p: Parameters, prefix: str) -> np.ndarray:
    """Return the places (6,) of a frame in a table."""
    index = {name: i for i, name in enumerate(p.names)}
    return np.array([index[prefix + component] for component in FRAME])


def _misplaced(p: Parameters, k: np.ndarray, place: Array) -> bool:
    """Whether an identified frame at places k (6,) of a table is surely not where it is stated."""
    position, orientation = np.split(p.identified[k], 2)
    if not position.all() or orientation.any() != orientation.all():
        return False
    far = np.abs(_deviation(place, p.nominal[k])) > MISPLACED * (p.scale[k] + NOMINAL_ERROR)
    return bool((far & p.identified[k]).any())


def _each_relocated(problem: Source) -> Source | None:
    """Return the problem of several robots, each relocated; of a frame that they share the first one's word counts."""
    p = problem.parameters
    nominal = p.nominal.copy()
    for name in problem.arms:
        found = relocated(problem.sample().alone(name))
        if found is not None:
            places = p.places_of(name)
            untouched = nominal[places] == p.nominal[places]
            nominal[places] = np.where(untouched, found.parameters.nominal, nominal[places])
    for name, place in met(problem.sample()).items():
        own = p.of_robot(name)
        base = _frame_of(own, "base_")
        if _misplaced(own, base, place):
            nominal[p.places_of(name)[base]] = place
    return _moved(problem, nominal)


def fitted_frames(problem: Source) -> tuple[Source, Array]:
    """Return the problem that identifies frames alone, and its solution: what the data say before calibration.

    ::

        minimize    |Sigma^-1/2 r(S z)|^2 + |z|^2

    over the identified parameters of base, reflectors, anchors and the like, in units of their scales; the robot is as
    its drawing says. By Marquardt's damped Gauss-Newton steps.

    Parameters
    ----------
    problem
        In memory or in parts. One that identifies no frame comes back as it is, at nominal.

    Returns
    -------
    The problem of the frames (all other parameters nominal; where frames were stated far off, counted from where the
    data put them, `relocated`), and the deviations (f,) [SI].

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> fitted, x = ro.problem.fitted_frames(instance.problem)
    >>> len(x), f"{1e3 * fitted.on(instance.validation).errors(x).mean():.2f} mm"
    (9, '1.13 mm')
    """
    p = problem.parameters
    frames = p.placed & p.identified
    if not frames.any():
        return problem, np.zeros(len(p.free))
    alone = problem.identifying(frames)
    alone = relocated(alone) or alone
    return alone, settled(alone)


def settled(alone: Source) -> Array:
    """Return the deviations (f,) [SI] of a problem that identifies frames alone, about where they are stated."""
    source = in_parts(alone.frozen())
    scale = alone.parameters.free.scale
    z = np.zeros(len(scale))
    model = source.linearize(scale * z)
    damping = 0.0
    for _ in range(MOST_STEPS):
        step = _damped_step(model, z, damping)
        candidate = source.linearize(scale * (z + step))
        if _objective(candidate, z + step) > _objective(model, z) * (1 + ROUNDING):
            damping = max(4 * damping, 1e-3)
            continue
        z = z + step
        model = candidate
        if damping == 0 and np.linalg.norm(step) <= SHORT * (1 + np.linalg.norm(z)):
            break
        damping = damping / 8 if damping > 1e-6 else 0.0
    return scale * z


def _damped_step(model: LinearModel, z: Array, damping: float) -> Array:
    """Return s that minimizes |A (z + s) - b|^2 + |z + s|^2 + damping |D s|^2, D the sizes of the columns."""
    R = model.triangle
    n = len(z)
    A = np.vstack([R[:, :n], np.eye(n)])
    b = np.concatenate([R[:, n] - R[:, :n] @ z, -z])
    size = np.sqrt(damping) * np.linalg.norm(A, axis=0)
    step = np.linalg.lstsq(np.vstack([A, np.diag(size)]), np.concatenate([b, np.zeros(n)]), rcond=None)[0]
    return np.asarray(step, dtype=float)


def _objective(model: LinearModel, z: Array) -> float:
    return float(np.sum((model.A @ z - model.b) ** 2) + np.sum(z**2))


def _deviation(place: Place, nominal: Array) -> Array:
    """Return the deviation (6,) that takes a nominal frame to a place (`kinematics.frame`)."""
    T, T0 = numeric_frame(place), numeric_frame(nominal)
    return np.concatenate([T[:3, 3] - T0[:3, 3], roll_pitch_yaw(T[:3, :3] @ T0[:3, :3].T)])
