"""What an instrument sees: measurement models, symbolic in CasADi."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.shown import Brief
from rpim_opt.data.projection import (
    INTRINSICS,
    STRETCH,
    TARGET,
    beside_the_robot,
    metres_beside_the_robot,
    metres_on_the_flange,
    on_the_flange,
)
from rpim_opt.data.rotations import (
    from_angles,
    from_matrices,
    quaternion,
    rotation_between,
    turned,
    unit_quaternions,
)
from rpim_opt.data.starts import anchor_start, plane_start, sphere_start
from rpim_opt.robot.kinematics import FRAME_DIMENSION
from rpim_opt.robot.terms import require_columns


def _difference(y: Any, modelled: Any) -> Any:
    return y - modelled


def _sum(modelled: Array, error: Array) -> Array:
    return modelled + error


@dataclass(frozen=True, eq=False, repr=False)
class Measurement(Brief):
    """A measurement model: the residual of a row is ``minus(y, model(T, **own))``.

    Parameters
    ----------
    name
        What a problem file calls it.
    model
        ``model(*T, **own)``: the modelled values (c, 1), from the transform T (4 x 4) of the reflector in the
        instrument's frame, one for each point, and the measurement's own parameters by name.
    columns
        The columns of a data table that hold the measured values y, name to dimension: ``{"x": "length"}``
        stands for a column ``x_mm`` or ``x_m``; dimension ``""`` for one without unit. None for a constraint,
        whose measured value is zero.
    components
        The components of the residual, name to dimension, in order; the columns by default. Their names are
        the keys of the noise per axis (``sigma_x_mm``, ``[noise] x_mm``).
    noise
        The keys of the noise common to all components of a dimension: ``{"position": "length"}`` stands for
        ``[noise] position_mm``; ``{"distance": "length"}`` by default.
    parameters
        The measurement's own parameters, name to dimension; ``anchor_x`` is given as ``x`` of a table ``[anchor]``.
    frames
        The prefixes of those parameters that are frames, six each: the model gets one transform instead.
    points
        How many points of the robot a row involves: 2 for the distance between two.
    minus, plus
        Measured minus modelled (k, 1), symbolic; and its inverse on rows of numbers, ``plus(modelled, e) = y``
        with ``minus(y, modelled) = e``, for simulations. Difference and sum by default.
    start
        ``start(points, y)``: own parameters by name from nominal positions (N, 3) in the instrument's frame and
        measured values (N, c), in closed form.
    forms
        Other columns in which a table may state the values, each with the function to y (N, c).
    prepare
        Checks and normalizes y (N, c); raises `RowError` for a row that is wrong.
    sees
        What the model gets besides, by keyword: ``"q"`` for the joint values of the model, (dof, 1), of two points
        (dof, 2); ``"torque"`` for the measured joint torques in the same shape; and columns of the data by name.
    extra
        Those columns, name to dimension.
    touching
        Whether a row says no more than which point was touched: its equations are differences to the other rows of
        the point, in the robot's own base frame.
    planar
        Whether what was touched is a plane.
    metres
        ``metres(*T, **own)``: how long a unit of the residual is at the thing that was measured [m], for residuals that
        are no lengths: errors in millimetres are the residual times it. None for lengths and angles.

    Examples
    --------
    A probe that reads heights alone. On the nominal robot, residuals of such readings are zero.

    >>> import rpim_opt as ro
    >>> height = ro.data.Measurement("height", model=lambda T: T[2, 3], columns={"z": "length"})
    >>> arm = ro.load("paper_arm").problem
    >>> z = ro.robot.forward_kinematics(arm.robot, arm.data.q)[:, 2, 3]
    >>> probed = arm.on(ro.Dataset.of(arm.data.q, z[:, None], sigma=1e-5, measurement=height))
    >>> bool(abs(probed.residual(0 * arm.parameters.free.nominal)).max() < 1e-12)
    True

    The same probe on a column that grows with its temperature, which a column ``temperature_K`` of the data states:

    >>> def grown(T, growth, temperature):
    ...     return T[2, 3] - growth * temperature
    >>> warm = ro.data.Measurement(
    ...     "warm height",
    ...     grown,
    ...     {"z": "length"},
    ...     parameters={"growth": "length per temperature"},
    ...     sees=("temperature",),
    ...     extra={"temperature": "temperature"},
    ... )
    >>> data = ro.Dataset.of(arm.data.q, z[:, None], 1e-5, measurement=warm, columns={"temperature": [3.0] * 9})
    >>> parameters = ro.problem.starting_parameters(arm.robot, data).identify(["d2", "growth"])
    >>> ro.CalibrationProblem(arm.robot, parameters, data).jacobian([0, 0])[0].round(9)  # [m/m], [m/(m/K)]
    array([ 0., -3.])
    """

    name: str
    model: Callable[..., Any]
    columns: Mapping[str, str]
    components: Mapping[str, str] = field(default_factory=dict)
    noise: Mapping[str, str] = field(default_factory=dict)
    parameters: Mapping[str, str] = field(default_factory=dict)
    frames: tuple[str, ...] = ()
    points: int = 1
    minus: Callable[[Any, Any], Any] = _difference
    plus: Callable[[Array, Array], Array] = _sum
    start: Callable[[Array, Array], Mapping[str, float]] | None = None
    forms: tuple[tuple[Mapping[str, str], Callable[[Array], Array]], ...] = ()
    prepare: Callable[[Array], Array] = lambda y: y
    sees: tuple[str, ...] = ()
    extra: Mapping[str, str] = field(default_factory=dict)
    touching: bool = False
    planar: bool = False
    metres: Callable[..., Any] | None = None

    def _short(self) -> str:
        return f"'{self.name}': {', '.join(self.components)}"

    @property
    def by_camera(self) -> bool:
        """Whether a row is where a camera sees a point of a board.

        >>> from rpim_opt.data.models import eye_in_hand, position
        >>> eye_in_hand.by_camera, position.by_camera
        (True, False)
        """
        return "pixel" in self.components.values()

    def __post_init__(self) -> None:
        require_columns(self.extra, f"measurement {self.name}")
        for name in self.sees:
            if name not in ("q", "torque", *self.extra):
                accepted = "'q', 'torque', or a column of its extra"
                raise InputError(f"measurement {self.name}, sees", f"'{name}'", accepted)
        if not self.components:
            object.__setattr__(self, "components", self.columns)
        if not self.noise:
            object.__setattr__(self, "noise", {"distance": "length"})

    def __reduce__(self) -> Any:
        """Ready measurements travel to other processes by name, so that they stay the same there."""
        known = READY.get(self.name) is self
        return (_ready, (self.name,)) if known else super().__reduce__()


def _ready(name: str) -> Measurement:
    return READY[name]


def of_fixture(parameter: str, fixture: str) -> str:
    """Return the name of an own parameter at one of several fixtures: ``anchor_x`` of A is ``anchor_A_x``."""
    table, _, rest = parameter.partition("_")
    return f"{table}_{fixture}_{rest}" if fixture else parameter


_XYZ = {"x": "length", "y": "length", "z": "length"}
_TURN = {"rx": "angle", "ry": "angle", "rz": "angle"}
_MATRIX = {f"r{i}{j}": "" for i in (1, 2, 3) for j in (1, 2, 3)}
_DISTANCE = {"distance": "length"}


def _origin(T: Any) -> Any:
    return T[:3, 3]


position = Measurement("position", _origin, _XYZ, noise={"position": "length"})
"""A reflector's position in the instrument's frame: r = y - p."""

pose = Measurement(
    "pose",
    model=lambda T: ca.vertcat(_origin(T), quaternion(T)),
    columns=_XYZ | {"qw": "", "qx": "", "qy": "", "qz": ""},
    components=_XYZ | _TURN,
    noise={"position": "length", "orientation": "angle"},
    minus=lambda y, m: ca.vertcat(y[:3] - m[:3], rotation_between(y[3:], m[3:])),
    plus=turned,
    forms=((_XYZ | _TURN, from_angles), (_XYZ | _MATRIX, from_matrices)),
    prepare=unit_quaternions,
)
"""Position and orientation in the instrument's frame: r = (y - p, log(R_measured R')), about the instrument's axes."""

cable = Measurement(
    "cable",
    model=lambda T, anchor_x, anchor_y, anchor_z, length_0: (
        ca.norm_2(_origin(T) - ca.vertcat(anchor_x, anchor_y, anchor_z)) + length_0
    ),
    columns=_DISTANCE,
    parameters={"anchor_x": "length", "anchor_y": "length", "anchor_z": "length", "length_0": "length"},
    start=anchor_start,
)
"""Distance to a fixed anchor a (draw-wire, cable): r = y - |p - a| - l, with l the reading at zero distance."""

distance = Measurement("distance", lambda T1, T2: ca.norm_2(_origin(T2) - _origin(T1)), _DISTANCE, points=2)
"""Distance between two points, of two configurations or two reflectors (paper, Eq. 21; ballbar): r = y - |p2 - p1|."""

plane = Measurement(
    "plane",
    model=lambda T, plane: ca.dot(plane[:3, 2], _origin(T) - plane[:3, 3]),
    columns={},
    components=_DISTANCE,
    parameters={f"plane_{c}": d for c, d in FRAME_DIMENSION.items()},
    frames=("plane",),
    start=plane_start,
)
"""A point on a plane, given as a frame whose x and y axes span it: r = -n'(p - o) with its z axis n and origin o."""

sphere = Measurement(
    "sphere",
    model=lambda T, sphere_x, sphere_y, sphere_z, sphere_r: (
        ca.norm_2(_origin(T) - ca.vertcat(sphere_x, sphere_y, sphere_z)) - sphere_r
    ),
    columns={},
    components=_DISTANCE,
    parameters={"sphere_x": "length", "sphere_y": "length", "sphere_z": "length", "sphere_r": "length"},
    start=sphere_start,
)
"""A point on a sphere of radius R about c: r = R - |p - c|."""

revisit = Measurement(
    "revisit",
    model=_origin,
    columns={},
    components=_XYZ,
    noise={"position": "length"},
    touching=True,
)
"""A touch of a point that nobody measured: r_i = c - p_i, with c the mean of the positions of all touches of it."""

revisit_plane = replace(revisit, name="revisit_plane", planar=True)
"""A touch of a plane that nobody measured: r_i = n'(c - p_i), with n and c those of the plane that fits best."""

known_distance = Measurement("known_distance", lambda T1, T2: ca.norm_2(_origin(T2) - _origin(T1)), _DISTANCE, points=2)
"""The distance that a drawing states between two touched points or parallel planes: r = y - |c2 - c1|."""

known_square = Measurement(
    "known_square", lambda T1, T2: 0 * T1[0, 0], {"angle": "angle"}, noise={"angle": "angle"}, points=2
)
"""Two touched planes are at right angles: r = -asin(n1'n2)."""

known_parallel = Measurement(
    "known_parallel",
    model=lambda T1, T2: 0 * T1[:2, 0],
    columns={"angle": "angle"},
    components={"tilt_1": "angle", "tilt_2": "angle"},
    noise={"angle": "angle"},
    points=2,
)
"""Two touched planes are parallel: r = -(t1'n2, t2'n2), with two directions t in the first."""

eye_in_hand = Measurement(
    "eye_in_hand",
    model=on_the_flange,
    columns={"u": "pixel", "v": "pixel"},
    noise={"pixel": "pixel"},
    parameters={f"camera_{name}": d for name, d in INTRINSICS.items()}
    | {f"board_{name}": d for name, d in STRETCH.items()},
    sees=tuple(TARGET),
    extra=TARGET,
    metres=metres_on_the_flange,
)
"""A point of a board that stands in the cell, seen by a camera on the flange: r = (u, v) - pixels(T^-1 p), T the camera
in the board's frame, which is the instrument's."""

eye_to_hand = replace(eye_in_hand, name="eye_to_hand", model=beside_the_robot, metres=metres_beside_the_robot)
"""A point of a board on the flange, seen by a camera beside the robot: r = (u, v) - pixels(T p), T the board in the
camera's frame, which is the instrument's."""

CAMERAS = {m.name: m for m in (eye_in_hand, eye_to_hand)}
"""Measurements by a camera."""
MEASUREMENTS = {m.name: m for m in (position, pose, cable, distance, plane, sphere, revisit, *CAMERAS.values())}
"""What a problem file may name."""
KNOWN = (known_distance, known_square, known_parallel)
"""What a drawing knows of things that were touched: no measurements, though they have equations."""
READY = {**MEASUREMENTS, **{m.name: m for m in (revisit_plane, *KNOWN)}}
"""All that come with the package."""
