"""The parameters of a calibration: names, nominal values, scales, tolerances, and which are identified."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices, in_file
from rpim_opt.basics.text import Tabled
from rpim_opt.basics.units import SMALLEST, display, fits, quantities, split_unit
from rpim_opt.robot.extensions import moment_names
from rpim_opt.robot.kinematics import FRAME_DIMENSION, numeric_frame, roll_pitch_yaw
from rpim_opt.robot.mdh import MDH, MDH_DIMENSION, Robot
from rpim_opt.robot.terms import JOINT_TERMS, MOMENT_SCALE, Entry, Model

EXPANSION, REFERENCE = "expansion", "reference_temperature"
"""Relative expansion of all lengths per kelvin, and the temperature at which they are nominal."""
JOINT_OFFSET = "joint_offset"  # in tables: every theta
DEFAULT_SCALE = {
    ("length", "length"): 1e-3, ("angle", "angle"): 1e-3,
    ("tool", "length"): 10e-3, ("tool", "angle"): 10e-3,
    ("session", "length"): 1e-4, ("session", "angle"): 1e-4,
    ("base", "length"): 100e-3, ("base", "angle"): 100e-3,
    ("camera", "pixel"): 10.0, ("camera", "ratio"): 1e-3, ("camera", ""): 0.05,
}  # fmt: skip
"""Default prior scales of deviations by (group, dimension) [SI]; terms state their own."""
STEEL = 12e-6  # thermal expansion of steel [1/K]; aluminium has 23e-6
SHOWN = 4  # names in one line
NUMBERS = ("nominal", "scale", "tolerance", "identified")  # fields of `Parameters` that are arrays
_TABLE = re.compile(rf"({'|'.join(MDH)})\d+")
_TERM = re.compile(rf"({'|'.join(term.name for term in JOINT_TERMS)})\d+|moment\d+_\d+[xyz]")


# Names


def own_name(name: str) -> str:
    """Return a parameter's name without the robot: ``a2`` for ``left.a2``."""
    return name.rpartition(".")[2]


def of_joint(name: str) -> bool:
    """Return whether a parameter is of a joint, not of a frame."""
    own = own_name(name)
    return own == EXPANSION or bool(_TABLE.fullmatch(own) or _TERM.fullmatch(own))


def of_term(name: str) -> bool:
    """Return whether a parameter is of a joint's terms, not of the MDH table or of a frame."""
    return _TERM.fullmatch(own_name(name)) is not None


def is_joint_offset(name: str) -> bool:
    """Return whether a parameter is the offset of a revolute joint, which is set at assembly."""
    return re.fullmatch(r"theta\d+", own_name(name)) is not None


def group_of(name: str, dimension: str) -> str:
    """Return the scale group of a parameter: ``tool``, ``session``, ``base``, or its dimension."""
    frame = own_name(name).partition("_")[0]
    if frame in ("tool", "session"):
        return frame
    return dimension if of_joint(name) else "base"


def session_prefix(session: str) -> str:
    """Return the prefix of a session's parameters: ``session_day_1_`` for "day 1"; letters, digits and _ alone."""
    return f"session_{re.sub(r'[^0-9A-Za-z]+', '_', session)}_"


def of_session(name: str) -> bool:
    """Return whether a parameter is a session offset."""
    return own_name(name).startswith("session_")


def frame_of(name: str) -> str:
    """Return the frame prefix of a parameter: ``session_day_1_`` for ``session_day_1_rx``."""
    return own_name(name).rpartition("_")[0] + "_"


def tool_prefix(marker: str) -> str:
    """Return the prefix of a reflector's parameters: ``tool_``, or ``tool_A_`` for marker A."""
    return f"tool_{marker}_" if marker else "tool_"


def reflectors(names: Iterable[str]) -> list[str]:
    """Return the markers whose reflectors are among the parameters; ``""`` for the only one."""
    return [name[5:-2] for name in names if name.startswith("tool_") and name.endswith("_x")]


def known_patterns(names: Sequence[str], pattern: str) -> str:
    """Return the patterns of the known names as text: ``alpha?``, ``moment?_?x``, ``base_x``."""
    return "names, or patterns such as " + choices(pattern, dict.fromkeys(re.sub(r"\d", "?", name) for name in names))


# The table


@dataclass(frozen=True, eq=False, repr=False)
class Parameters(Tabled):
    """A table of model parameters, one entry each in every field.

    ``names`` are ``alpha1, a1, theta1, d1, beta1, alpha2, ..., base_x, ..., base_rz, tool_x, ..., tool_rz`` (with
    several reflectors ``tool_A_x, ...``) and the measurement's own; ``dimensions`` are ``length``, ``angle``, ``ratio``
    or ``compliance``. ``nominal`` (P,) are nominal values, ``scale`` (P,) prior standard deviations of the deviations,
    ``tolerance`` (P,) their bounds in a bounded calibration, or infinite, all in SI units; ``identified`` (P,) marks
    the parameters that a calibration changes. ``own_frames`` are prefixes of frames of the measurement, such as
    ``plane_``, ``terms`` the parameters of user-defined terms (`Model`).

    >>> import rpim_opt as ro
    >>> parameters = ro.load("position").problem.parameters
    >>> len(parameters), len(parameters.free)
    (114, 34)
    >>> few = parameters.identify(["d2", "theta2", "ecc_sin2", "tool_rx"]).free
    >>> few.groups, few.periodic, few.of_frames
    (('angle', 'length', 'angle', 'tool'), array([ True, False, False,  True]), array([False, False, False,  True]))

    For several robots, parameters that are not shared have the robot's name as prefix:

    >>> problem = ro.load("position").problem
    >>> both = ro.together(left=problem, right=problem, shared=["tool_*"]).parameters
    >>> both.free.names[0], both.of_robot("left").free.names[0], both.called("left", "tool_x"), len(both)
    ('left.alpha1', 'alpha1', 'tool_x', 222)
    """

    names: tuple[str, ...]
    dimensions: tuple[str, ...]
    nominal: Array
    scale: Array
    tolerance: Array
    identified: np.ndarray
    own_frames: tuple[str, ...] = ()
    terms: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for key in ("dimensions", "nominal", "scale", "tolerance", "identified"):
            count = len(getattr(self, key))
            if count != len(self.names):
                raise InputError(f"parameters, {key}", f"{count} entries", f"{len(self.names)}, one for each name")

    def _short(self) -> str:
        shown = ", ".join([*self.names[:SHOWN], "..."] if len(self) > SHOWN else self.names)
        return f"{shown}: {np.count_nonzero(self.identified)} of {len(self)} identified"

    def rows(self, columns: Mapping[str, Array]) -> list[dict[str, Any]]:
        """Return name, unit, and in it the figures (P,) [SI] of every parameter; None for infinite ones."""
        rows: list[dict[str, Any]] = []
        for i, (name, dimension) in enumerate(zip(self.names, self.dimensions, strict=True)):
            # stated as the deflection of a joint under gravity
            unit, si = ("mrad", 1e-3) if own_name(name).startswith("moment") else display(dimension)
            figures = {column: float(values[i] / si) for column, values in columns.items()}
            known = {column: value if np.isfinite(value) else None for column, value in figures.items()}
            rows.append({"parameter": name, "unit": unit, **known})
        return rows

    def _frame_rows(self) -> list[dict[str, Any]]:
        rows = self.rows({key: getattr(self, key) for key in ("nominal", "scale", "tolerance")})
        return [{**row, "identified": bool(own)} for row, own in zip(rows, self.identified, strict=True)]

    def __len__(self) -> int:
        return len(self.names)

    def take(self, index: np.ndarray) -> Parameters:
        """Return the entries at ``index`` (K,), in that order."""
        texts: dict[str, Any] = {key: tuple(getattr(self, key)[i] for i in index) for key in ("names", "dimensions")}
        texts["terms"] = tuple(filter(set(texts["names"]).__contains__, self.terms))
        return replace(self, **texts, **{key: getattr(self, key)[index] for key in NUMBERS})

    @cached_property
    def free(self) -> Parameters:
        """Return the identified parameters alone, in the order of a calibration's unknowns."""
        return self.take(np.flatnonzero(self.identified))

    def of_robot(self, robot: str) -> Parameters:
        """Return the entries of one of several robots (``""`` for a single one), without the robot's prefix."""
        if not robot:
            return self
        part = self.take(self.places_of(robot))
        return replace(part, names=tuple(map(own_name, part.names)), terms=tuple(map(own_name, part.terms)))

    def called(self, robot: str, own: str) -> str:
        """Return the table's name of a robot's parameter: ``left.a2``, or ``a2`` if shared."""
        called = f"{robot}.{own}"
        return own if not robot or (own in self.names and called not in self.names) else called

    def places_of(self, robot: str) -> np.ndarray:
        """Return the indices (k,) of one robot's parameters, including shared ones."""
        if not robot:
            return np.arange(len(self))
        known = {name for name in self.names if name.startswith(f"{robot}.")}
        shared = {name for name in self.names if "." not in name and f"{robot}.{name}" not in known}
        return np.flatnonzero([name in known or name in shared for name in self.names])

    def frame(self, prefix: str) -> np.ndarray:
        """Return the indices (6,) of a frame's parameters by their prefix, ``base_``: position, roll, pitch, yaw."""
        return np.array([self.names.index(prefix + axis) for axis in FRAME_DIMENSION])

    @cached_property
    def of_frames(self) -> np.ndarray:
        """Which parameters (P,) are of frames (base, reflectors, sessions, ...), not of the robot."""
        return np.array([not of_joint(name) and name not in self.terms for name in self.names])

    @cached_property
    def of_curves(self) -> np.ndarray:
        """Which parameters (P,) are coefficients of transmission errors: hundreds without individual meaning."""
        return np.array([own_name(name).startswith("transmission") for name in self.names], dtype=bool)

    @cached_property
    def placed(self) -> np.ndarray:
        """Which frame parameters (P,) have no informative prior: all except session offsets."""
        return self.of_frames & ~np.array([of_session(name) for name in self.names], dtype=bool)

    @cached_property
    def groups(self) -> tuple[str, ...]:
        """The scale groups (P) of the parameters: ``base``, ``tool``, ``session``, or their dimension."""
        return tuple(
            dimension if name in self.terms else group_of(name, dimension)
            for name, dimension in zip(self.names, self.dimensions, strict=True)
        )

    @cached_property
    def periodic(self) -> np.ndarray:
        """Which parameters (P,) are rotations: alpha, theta and beta of joints, roll, pitch and yaw of frames."""
        frames = "|".join(map(re.escape, ("base_", *self.own_frames)))
        turning = re.compile(rf"(alpha|theta|beta)\d+|({frames}|tool_(.*_)?)r[xyz]")
        return np.array([bool(turning.fullmatch(own_name(name))) for name in self.names])

    def wrapped(self, x: Array) -> Array:
        """Return the deviations x (n,) [SI] of the same robot with every rotation in (-pi, pi]."""
        turns = np.ceil((x - np.pi) / (2 * np.pi))
        return x - 2 * np.pi * np.where(self.periodic, turns, 0.0)

    def identify(self, patterns: str | Iterable[str]) -> Parameters:
        """Return the same table with the parameters identified that match one of the patterns, and no others.

        A pattern is a name with ``*``, ``?`` and ``[...]`` as for file names: ``"a?"``, ``"beta[34]"``. InputError for
        a pattern without a match.

        >>> import rpim_opt as ro
        >>> parameters = ro.load("position").problem.parameters
        >>> parameters.identify(["a[12]", "tool_[xyz]"]).free.names
        ('a1', 'a2', 'tool_x', 'tool_y', 'tool_z')
        """
        chosen = np.zeros(len(self), dtype=bool)
        for pattern in [patterns] if isinstance(patterns, str) else patterns:
            hits = [fits(name, pattern) for name in self.names]
            if not any(hits):
                raise InputError("key identify", f"pattern '{pattern}'", known_patterns(self.names, pattern))
            chosen |= hits
        return replace(self, identified=chosen)

    def values(self, x: Array) -> Array:
        """Return the parameters' values (n,) [SI] at deviations x (n,) [SI], one for every entry of the table.

        The sum of nominal value and deviation, except for roll, pitch and yaw of a frame: their deviation is a rotation
        about the parent's axes (`kinematics.frame`), their values are the angles of the composed rotation.
        """
        result = self.nominal + x
        for angles in self._orientations():
            moved = numeric_frame([0, 0, 0, *x[angles]]) @ numeric_frame([0, 0, 0, *self.nominal[angles]])
            result[angles] = roll_pitch_yaw(moved[:3, :3])
        return result

    def _orientations(self) -> Iterator[list[int]]:
        """Yield where roll, pitch and yaw of every frame stand that has all of them; others cannot be composed."""
        index = {name: i for i, name in enumerate(self.names)}
        for first in [name for name in self.names if name.endswith("_rx")]:
            angles = [first[:-1] + axis for axis in "xyz"]
            if index.keys() >= set(angles):
                yield [index[name] for name in angles]

    def slopes(self) -> Array:
        """Return the derivatives (n, n) of `values` by deviations, at zero.

        The identity, except for roll, pitch and yaw, which rotate a frame about Rz Ry e_x, Rz e_y and e_z.
        """
        result = np.eye(len(self))
        for angles in self._orientations():
            _, pitch, yaw = self.nominal[angles]
            c, s = np.cos(yaw), np.sin(yaw)
            axes = [[c * np.cos(pitch), -s, 0], [s * np.cos(pitch), c, 0], [-np.sin(pitch), 0, 1]]
            result[np.ix_(angles, angles)] = np.linalg.pinv(axes)
        return result

    def values_at(self, x: Array) -> Array:
        """Return the values (P,) [SI] of all parameters at deviations x (n,) [SI] of the identified ones."""
        result = self.nominal.copy()
        result[self.identified] = self.free.values(x)
        return result

    def by_name(self, x: Array) -> dict[str, float]:
        """Return `values_at` by the parameters' names."""
        return dict(zip(self.names, self.values_at(x).tolist(), strict=True))

    def scaled(self, table: Mapping[str, float], file: object = None) -> Parameters:
        """Return the same table with other scales, stated as in a problem file's ``[scale]``.

        Keys are ``length_mm``, ``angle_mrad``, ``tool_mm``, ``base_mrad``, ... for a group, ``joint_offset_mrad`` for
        every theta, or a parameter's name or a pattern with a unit, ``d5_mm``, ``a?_mm``. A name has precedence over a
        pattern, a pattern over a group. InputError (naming ``file``) for unknown keys, missing or wrong units, and
        values that are not positive.

        >>> import rpim_opt as ro
        >>> parameters = ro.load("position").problem.parameters.scaled({"length_mm": 0.2, "a3_mm": 2.0})
        >>> parameters.identify(["a[23]"]).free.scale  # [m]
        array([0.0002, 0.002 ])
        """
        return replace(self, scale=overlay(self, self.scale, table, "table scale", file=file))

    def toleranced(self, table: Mapping[str, float], file: object = None) -> Parameters:
        """Return the same table with other tolerances, as `scaled` does with scales."""
        return replace(self, tolerance=overlay(self, self.tolerance, table, "table tolerance", file=file))


def overlay(
    parameters: Parameters,
    values: Array,
    table: Mapping[str, float],
    where: str,
    signed: bool = False,
    file: object = None,
) -> Array:
    """Return values (P,) [SI], replaced where a table states others (keys as in `Parameters.scaled`).

    A name has precedence over a pattern, a pattern over a group. Errors name ``where`` and ``file``; ``signed`` is
    whether zero and negative values are accepted.
    """
    if not table:
        return values.copy()
    members: dict[str, list[int]] = {}  # parameters by key: groups, joint offsets, patterns of the table, names
    for i, group in enumerate(parameters.groups):
        members.setdefault(group, []).append(i)
    offsets = [i for i, name in enumerate(parameters.names) if is_joint_offset(name)]
    if offsets:
        members[JOINT_OFFSET] = offsets
    for key in filter(re.compile(r"[*?\[]").search, table):
        stem, _ = split_unit(key)
        members[stem] = [i for i, name in enumerate(parameters.names) if fits(name, stem)]
        if not members[stem]:
            accepted = choices(stem, parameters.names)
            raise InputError(f"{where}, key {key}", "a pattern that fits no parameter", accepted, file)
    members |= {name: [i] for i, name in enumerate(parameters.names)}
    order = list(members)
    dimensions = np.array(parameters.dimensions)
    accepted = {stem: tuple(sorted(set(dimensions[index].tolist()))) for stem, index in members.items()}
    result = values.copy()
    with in_file(file):
        sizes = quantities(table, accepted, where)
        for (stem, dimension), value in sorted(sizes.items(), key=lambda item: order.index(item[0][0])):
            if not (value >= SMALLEST or signed):
                found = f"a number greater than zero, from {SMALLEST:g} on"
                raise InputError(f"{where}, key {stem}", f"{value:g}", found)
            index = np.array(members[stem])
            result[index[dimensions[index] == dimension]] = value
    return result


# Parameters of a model


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

    ``base`` (6,) is the robot's base in the instrument's frame: x, y, z [m], roll, pitch, yaw [rad]; ``tools`` are the
    reflectors' frames (6,) in the flange frame by marker, ``{"": frame}`` for a single one. ``own`` maps the
    measurement's parameters to (dimension, nominal value [SI]), ``own_frames`` are prefixes of those that are frames,
    ``plane_``. Each of the ``sessions`` adds a session offset (shift and rotation of the base). If a ``temperature``
    [K] is given, lengths are nominal there and grow by ``expansion`` per kelvin.

    >>> import rpim_opt as ro
    >>> robot = ro.load("paper_arm").problem.robot
    >>> parameters = ro.robot.model_parameters(robot, tools={"A": (0, 0, 0.06, 0, 0, 0)})
    >>> parameters.identify(["d1", "tool_A_z"]).free.nominal
    array([0.099927, 0.06    ])
    """
    frames = {"base_": base}
    frames |= {tool_prefix(marker): tool for marker, tool in (tools or {"": (0.0,) * 6}).items()}
    frames |= dict.fromkeys(map(session_prefix, sessions), (0.0,) * 6)
    entries = []
    for i, row in enumerate(robot.mdh, start=1):
        for (column, dimension), value in zip(MDH_DIMENSION.items(), row, strict=True):
            entries.append(_usual(f"{column}{i}", dimension, value))
    for i in range(1, len(robot.mdh) + 1):
        for term in JOINT_TERMS:
            entries += term.named(i) if i in term.places(robot.joint_types) else []
    entries += [Entry(name, "angle", MOMENT_SCALE, 0.0) for name in moment_names(robot)]
    for prefix, place in frames.items():
        for (axis, dimension), value in zip(FRAME_DIMENSION.items(), place, strict=True):
            entries.append(_usual(prefix + axis, dimension, value))
    if temperature is not None:
        entries.append(Entry(EXPANSION, "ratio per temperature", STEEL, 0.0))
        entries.append(Entry(REFERENCE, "temperature", 1.0, temperature))
    entries += [_usual(name, dimension, value) for name, (dimension, value) in (own or {}).items()]
    return with_terms(_table(entries, own_frames=own_frames), robot.model, robot.joint_types)


def with_terms(parameters: Parameters, model: Model, joint_types: Sequence[str]) -> Parameters:
    """Return the table with the parameters of a model's terms appended, none of them identified yet."""
    entries = model.entries(joint_types)
    own = tuple(entry.name for entry in entries)
    for name in own:
        if name in parameters.names:
            raise InputError("model, terms", f"parameter '{name}', which the model has", "a unique name")
    return concatenated([parameters, _table(entries, terms=own)]) if own else parameters


def _table(entries: Sequence[Entry], **kept: tuple[str, ...]) -> Parameters:
    """Return a table of entries, none of them identified and without tolerances."""
    names, dimensions, scale, nominal = zip(*entries, strict=True)
    none = np.zeros(len(names), dtype=bool)
    return Parameters(names, dimensions, np.array(nominal), np.array(scale), np.full(len(names), np.inf), none, **kept)


def concatenated(tables: Sequence[Parameters]) -> Parameters:
    """Return tables one after the other."""

    def joined(key: str) -> tuple[Any, ...]:
        return tuple(chain.from_iterable(getattr(table, key) for table in tables))

    fields: dict[str, Any] = {key: joined(key) for key in ("names", "dimensions")}
    fields |= {key: tuple(dict.fromkeys(joined(key))) for key in ("own_frames", "terms")}
    fields |= {key: np.array(joined(key)) for key in NUMBERS}
    return Parameters(**fields)


def _usual(name: str, dimension: str, nominal: float) -> Entry:
    """Return an entry with the usual scale of its group; own dimensions of a measurement have that of their unit."""
    group = "camera" if name.startswith(("camera_", "board_")) else group_of(name, dimension)
    return Entry(name, dimension, DEFAULT_SCALE.get((group, dimension), 1.0), nominal)
