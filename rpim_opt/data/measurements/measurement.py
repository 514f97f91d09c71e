"""Measurement types: columns and units, symbolic model, start values, noise, and wording.

Every other module of this folder has one or several that are alike, which `registry` finds by its ``TYPES``.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
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

    ``name`` is what a problem file calls it. ``model(*T, **own)`` are the modelled values (c, 1), from the transform T
    (4 x 4) of the reflector in the instrument's frame, one for each of the ``points`` of the robot that a row involves
    (2 for the distance between two), and the measurement's own ``parameters``, name to dimension; ``anchor_x`` is given
    as ``x`` of a table ``[anchor]``. ``frames`` are the prefixes of those that are frames, six each: the model gets one
    transform instead. It also gets what it ``depends_on``, by keyword: ``"q"`` for the model's joint values, (dof, 1),
    of two points (dof, 2), ``"torque"`` for the measured joint torques in the same shape, and columns of the data by
    name; ``extra`` has those columns, name to dimension, and ``accepted`` the text of the message where one is missing.

    ``columns`` of a data table hold the measured values y, name to dimension: ``{"x": "length"}`` stands for a column
    ``x_mm`` or ``x_m``; dimension ``""`` for one without unit; empty for a constraint, whose measured value is zero.
    ``forms`` are other columns in which a table may state the values, each with the function to y (N, c); ``prepare``
    checks and normalizes y (N, c), and raises `RowError` for a row that is wrong. ``components`` are those of the
    residual, name to dimension, in order; the columns by default. Their names are the keys of the noise per axis
    (``sigma_x_mm``, ``[noise] x_mm``). ``noise`` has the keys of the noise common to all components of a dimension:
    ``{"position": "length"}`` stands for ``[noise] position_mm``; ``{"distance": "length"}`` by default.

    ``minus`` is measured minus modelled (k, 1), symbolic; ``plus`` its inverse on rows of numbers,
    ``plus(modelled, e) = y`` with ``minus(y, modelled) = e``, for simulations; difference and sum by default.
    ``start(points, y)`` are own parameters by name from nominal positions (N, 3) in the instrument's frame and measured
    values (N, c), in closed form. ``metres(*T, **own)`` is how long a unit of the residual is at the thing that was
    measured [m], for residuals that are no lengths: errors in millimetres are the residual times it. None for lengths
    and angles.

    A ``touching`` row states only which point was touched, a ``planar`` one which plane: its equations are
    differences to the other rows of the point, in the robot's own base frame. ``names`` are columns of names that a
    table of it may have besides, ``("point",)``, of which a touch has one; ``variants`` the type that it is where a
    table has a column of that name; ``parts`` types of tables that state less and can validate it: positions of poses.
    ``registers`` and ``turning`` say whether the base can be registered by rows in closed form, and whether rows tell
    how the tool is turned.
    ``shown_by(tables)`` is whether the columns of raw tables can only be of this type, before names are understood;
    ``words`` are how readers hear of it.

    A probe that reads heights alone. On the nominal robot, residuals of such readings are zero.

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

    def stands_in(self, stems: AbstractSet[str]) -> bool:
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
