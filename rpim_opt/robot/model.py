"""Every parameter of a model: of the joints, the base, the reflectors and the measurement."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.robot.family import bend_names
from rpim_opt.robot.joint_terms import BEND_SCALE, JOINT_TERMS
from rpim_opt.robot.kinematics import FRAME_DIMENSION
from rpim_opt.robot.mdh import MDH, Robot
from rpim_opt.robot.open_model import Model, entries_of
from rpim_opt.robot.parameter_names import EXPANSION, MDH_DIMENSION, REFERENCE, group_of, session_prefix, tool_prefix
from rpim_opt.robot.parameters import Parameters

Entry = tuple[str, str, float, float]
"""Name, dimension, nominal value and usual size of its deviation [SI]."""
DEFAULT_SCALE = {
    ("length", "length"): 1e-3,
    ("angle", "angle"): 1e-3,
    ("tool", "length"): 10e-3,
    ("tool", "angle"): 10e-3,
    ("session", "length"): 1e-4,
    ("session", "angle"): 1e-4,
    ("base", "length"): 100e-3,
    ("base", "angle"): 100e-3,
    ("camera", "pixel"): 10.0,
    ("camera", "ratio"): 1e-3,
    ("camera", ""): 0.05,
}
"""Expected size of deviations by (group, dimension), in SI, where a problem states none; terms state their own."""


STEEL = 12e-6
"""By how much steel grows [1/K]; aluminium by 23e-6."""


def model_parameters(
    robot: Robot,
    base: Sequence[float] | Array = (0.0,) * 6,
    tools: Mapping[str, Sequence[float] | Array] | None = None,
    own: Mapping[str, tuple[str, float]] | None = None,
    own_frames: tuple[str, ...] = (),
    sessions: Iterable[str] = (),
    temperature: float | None = None,
) -> Parameters:
    """Return every parameter of a model, none of them identified yet, with `DEFAULT_SCALE` and without tolerances.

    Parameters
    ----------
    robot
        Gives the MDH parameters' nominal values.
    base
        (6,) the robot's base in the instrument's frame: x, y, z [m], roll, pitch, yaw [rad].
    tools
        Reflectors in the flange frame by marker, (6,) each as the base; ``{"": frame}`` for the only one.
    own
        Further parameters, those of the measurement: name to (dimension, nominal value [SI]).
    own_frames
        Prefixes of those that are frames, ``plane_``.
    sessions
        Names of sessions, by which the robot's base is shifted and turned besides.
    temperature
        At which the robot's lengths are as on the drawing [K], where temperatures are known: they grow by
        ``expansion`` a kelvin.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> robot = ro.load("paper_arm").problem.robot
    >>> parameters = ro.robot.model_parameters(robot, tools={"A": (0, 0, 0.06, 0, 0, 0)})
    >>> parameters.identify(["d1", "tool_A_z"]).free.nominal
    array([0.099927, 0.06    ])
    """
    entries = list(_of_joints(robot))
    entries += _of_frame("base_", base)
    if not tools:
        tools = {"": (0.0,) * 6}
    for marker, tool in tools.items():
        entries += _of_frame(tool_prefix(marker), tool)
    for prefix in dict.fromkeys(map(session_prefix, sessions)):
        entries += _of_frame(prefix, (0.0,) * 6)
    if temperature is not None:
        entries.append((EXPANSION, "ratio per temperature", 0.0, STEEL))
        entries.append((REFERENCE, "temperature", temperature, 1.0))
    if own is not None:
        entries += [(name, dimension, value, _usual(name, dimension)) for name, (dimension, value) in own.items()]
    names, dimensions, nominal, scale = zip(*entries, strict=True)
    parameters = Parameters(
        names,
        dimensions,
        np.array(nominal, dtype=float),
        np.array(scale),
        np.full(len(names), np.inf),
        np.zeros(len(names), dtype=bool),
        own_frames,
    )
    return with_terms(parameters, robot.model, robot.joint_types)


def with_terms(parameters: Parameters, model: Model, joint_types: Sequence[str]) -> Parameters:
    """Return a table with the parameters of a model's terms behind its own, none of them identified yet.

    Raises
    ------
    InputError
        For a name that the table has.
    """
    entries = dict(entries_of(model, joint_types))
    for name in entries:
        if name in parameters.names:
            raise InputError("model, terms", f"parameter '{name}', which the model has", "a name of its own")
    if not entries:
        return parameters
    count = len(entries)
    return replace(
        parameters,
        names=(*parameters.names, *entries),
        dimensions=(*parameters.dimensions, *(entry.dimension for entry in entries.values())),
        nominal=np.append(parameters.nominal, [entry.nominal for entry in entries.values()]),
        scale=np.append(parameters.scale, [entry.scale for entry in entries.values()]),
        tolerance=np.append(parameters.tolerance, np.full(count, np.inf)),
        identified=np.append(parameters.identified, np.zeros(count, dtype=bool)),
        terms=(*parameters.terms, *entries),
    )


def _usual(name: str, dimension: str) -> float:
    # own dimensions of a measurement have no usual size: their unit's
    group = group_of(name, dimension)
    if name.startswith(("camera_", "board_")):
        group = "camera"
    return DEFAULT_SCALE.get((group, dimension), 1.0)


def _of_joints(robot: Robot) -> Iterator[Entry]:
    """Yield the table's parameters row by row, then what the joints have besides, zero on the drawing."""
    for i, row in enumerate(robot.mdh, start=1):
        for column, value in zip(MDH, row, strict=True):
            name = f"{column}{i}"
            dimension = MDH_DIMENSION[column]
            yield name, dimension, value, _usual(name, dimension)
    for i in range(1, robot.dof + 1):
        for term in JOINT_TERMS:
            if i in term.places(robot.joint_types):
                for name, entry in zip(term.names(i), term.entries, strict=True):
                    yield name, entry.dimension, entry.nominal, entry.scale
    for name in bend_names(robot):
        yield name, "angle", 0.0, BEND_SCALE


def _of_frame(prefix: str, place: Sequence[float] | Array) -> Iterator[Entry]:
    for (axis, dimension), value in zip(FRAME_DIMENSION.items(), place, strict=True):
        name = prefix + axis
        yield name, dimension, value, _usual(name, dimension)
