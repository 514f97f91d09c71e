"""Measurement types: columns and units, symbolic model, start values, noise, and wording.

Every other module of this folder defines one or several similar types; `registry` finds them by ``TYPES``.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from types import MappingProxyType
from typing import Any, NamedTuple

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns
from rpim_opt.basics.text import Brief
from rpim_opt.robot.terms import require_columns

XYZ = {"x": "length", "y": "length", "z": "length"}  # a position's coordinates


class Words(NamedTuple):
    """Wording of a measurement type: target, reference frame, typical noise and mistake, meaning of columns."""

    target: str = "a reflector"
    at_flange: str = "The reflector"
    frame: str = "so the instrument has a frame of its own"
    noise_of: str = "a laser tracker, and a robot that repeats well"
    wrong: str = "the reflector was bumped"
    columns: Mapping[str, str] = MappingProxyType({})


REFLECTOR = Words()


@dataclass(frozen=True, eq=False, repr=False)
class Measurement(Brief):
    """A measurement model: the residual of a row is ``minus(y, model(T, **own))``.

    ``name`` is the name in problem files. ``model(*T, **own)`` returns the modelled values (c, 1). It gets a transform
    T (4 x 4) of the reflector in the instrument's frame for each of the ``points`` of the robot that a row involves (2
    for the distance between two), and the measurement's own ``parameters``, name to dimension; ``anchor_x`` is passed
    as ``x`` of a table ``[anchor]``. ``frames`` are prefixes of parameters that form a frame, six each: the model gets
    one transform instead. It also gets by keyword what it ``depends_on``: ``"q"`` are the model's joint values, (dof,
    1), or of two points (dof, 2), ``"torque"`` the measured joint torques in the same shape, other names columns of the
    data; ``extra`` maps those columns to dimensions, and ``accepted`` is the message if one is missing.

    ``columns`` are those of a data table with the measured values y, name to dimension: ``{"x": "length"}`` is a column
    ``x_mm`` or ``x_m``, ``""`` the dimension of one without unit; without columns it is a constraint with measured
    value zero. ``forms`` maps alternative columns to functions that compute y (N, c); ``prepare`` checks and normalizes
    y (N, c), and raises `RowError` for an invalid row. ``components`` are the residual's, name to dimension, in order;
    by default the columns. Their names are the keys of the noise per axis (``sigma_x_mm``, ``[noise] x_mm``). ``noise``
    has the keys of the noise common to all components of a dimension: ``{"position": "length"}`` is ``[noise]
    position_mm``; by default ``{"distance": "length"}``.

    ``minus`` is measured minus modelled (k, 1), symbolic; ``plus`` its inverse on rows of numbers, ``plus(modelled, e)
    = y`` with ``minus(y, modelled) = e``, for simulations; by default difference and sum. ``start(points, y)`` returns
    start values of own parameters by name, in closed form, from nominal positions (N, 3) in the instrument's frame and
    measured values (N, c). ``metres(*T, **own)`` is the length of a unit of the residual at the measured object [m],
    which converts residuals that are not lengths into errors in millimetres; None for lengths and angles.

    A ``touching`` row states only which point was touched, a ``planar`` one which plane: its equations are differences
    to the other rows of the point, in the robot's own base frame. ``names`` are optional columns of names,
    ``("point",)``, of which a touch has one; ``variants`` maps such a column to the type of tables that have it;
    ``parts`` are types of tables that measure less and can validate this one, such as positions for poses.
    ``registers`` states whether rows register the base in closed form, ``turning`` whether they determine the tool's
    orientation. ``shown_by(tables)`` returns whether the columns of raw tables can only be of this type, before names
    are interpreted; ``words`` describe it in messages.

    A probe that measures heights only; on the nominal robot, residuals of such readings are zero:

    >>> import rpim_opt as ro
    >>> height = ro.data.Measurement("height", model=lambda T: T[2, 3], columns={"z": "length"})
    >>> arm = ro.load("paper_arm").problem
    >>> z = ro.robot.forward_kinematics(arm.robot, arm.data.q)[:, 2, 3]
    >>> probed = arm.on(ro.Dataset.of(arm.data.q, z[:, None], sigma=1e-5, measurement=height))
    >>> bool(abs(probed.residual(0 * arm.parameters.free.nominal)).max() < 1e-12)
    True
    """

    name: str
    model: Callable[..., Any]
    columns: Mapping[str, str]
    components: Mapping[str, str] = field(default_factory=dict)
    noise: Mapping[str, str] = field(default_factory=dict)
    parameters: Mapping[str, str] = field(default_factory=dict)
    frames: tuple[str, ...] = ()
    points: int = 1
    minus: Callable[[Any, Any], Any] = operator.sub
    plus: Callable[[Array, Array], Array] = operator.add
    start: Callable[[Array, Array], Mapping[str, float]] | None = None
    forms: tuple[tuple[Mapping[str, str], Callable[[Array], Array]], ...] = ()
    prepare: Callable[[Array], Array] = lambda y: y
    depends_on: tuple[str, ...] = ()
    extra: Mapping[str, str] = field(default_factory=dict)
    touching: bool = False
    planar: bool = False
    names: tuple[str, ...] = ()
    variants: Mapping[str, Measurement] = field(default_factory=dict)
    parts: tuple[Measurement, ...] = ()
    accepted: Mapping[str, str] = field(default_factory=dict)
    words: Words = REFLECTOR
    shown_by: Callable[[Sequence[Columns]], bool] | None = None
    registers: bool = False
    turning: bool = False
    metres: Callable[..., Any] | None = None

    def _short(self) -> str:
        return f"'{self.name}': {', '.join(self.components)}"

    def stands_in(self, stems: set[str]) -> bool:
        """Whether a table has its columns in any form; for two points, also one of the second (``to_...``)."""
        forms = [self.columns, *(form for form, _ in self.forms)]
        second = self.points < 2 or any(stem.startswith("to_") for stem in stems)
        return second and any(set(form) <= stems for form in forms)

    @property
    def by_camera(self) -> bool:
        """Whether a row is a camera's view of a board point."""
        return "pixel" in self.components.values()

    def __post_init__(self) -> None:
        for dimensions in (self.columns, self.components, self.noise, self.parameters, self.extra):
            require_columns(dimensions, f"measurement {self.name}")
        for name in self.depends_on:
            if name not in ("q", "torque", *self.extra):
                accepted = "'q', 'torque', or a column of its extra"
                raise InputError(f"measurement {self.name}, depends_on", f"'{name}'", accepted)
        if not self.components:
            object.__setattr__(self, "components", self.columns)
        if not self.noise:
            object.__setattr__(self, "noise", {"distance": "length"})

    def __reduce__(self) -> Any:
        """Ready measurements travel to other processes by name, so that they stay the same there."""
        known = _ready(self.name) is self
        return (_ready, (self.name,)) if known else super().__reduce__()


def _ready(name: str) -> Measurement | None:
    return import_module("rpim_opt.data.measurements.registry").READY.get(name)


def of_fixture(parameter: str, fixture: str) -> str:
    """Return the name of an own parameter at one of several fixtures: ``anchor_x`` of A is ``anchor_A_x``."""
    table, _, rest = parameter.partition("_")
    return f"{table}_{fixture}_{rest}" if fixture else parameter


def origin(T: Any) -> Any:
    """Return the position (3, 1) of a transform (4, 4)."""
    return T[:3, 3]
