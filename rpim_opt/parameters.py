"""The parameters of a calibration: names, nominal values, expected sizes, tolerances, and which are identified."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property

import casadi as ca
import numpy as np

from rpim_opt.exceptions import InputError, choices
from rpim_opt.kinematics import FRAME_DIMENSION, JOINT_EXTRAS, roll_pitch_yaw, rotation_rpy
from rpim_opt.robot import MDH, Array, Robot
from rpim_opt.units import quantities, split_unit

DEFAULT_SCALE = {
    ("length", "length"): 1e-3,
    ("angle", "angle"): 1e-3,
    ("ratio", "ratio"): 1e-3,
    ("compliance", "compliance"): 1e-5,
    ("tool", "length"): 10e-3,
    ("tool", "angle"): 10e-3,
    ("base", "length"): 100e-3,
    ("base", "angle"): 100e-3,
}
"""Expected size of deviations by (group, dimension), in SI, where a problem states none."""

_ON_THE_ROBOT = re.compile(rf"({'|'.join((*MDH, *JOINT_EXTRAS))})\d+")
MDH_DIMENSION = {"alpha": "angle", "a": "length", "theta": "angle", "d": "length", "beta": "angle"}


@dataclass(frozen=True, eq=False)
class Parameters:
    """A table of model parameters, one entry each in every field.

    Parameters
    ----------
    names
        ``alpha1, a1, theta1, d1, beta1, alpha2, ..., base_x, ..., base_rz, tool_x, ..., tool_rz``
        and those of the measurement; with several reflectors ``tool_A_x, ...``.
    dimensions
        ``length``, ``angle``, ``ratio`` or ``compliance``.
    nominal
        (P,) where the deviations count from [SI].
    scale
        (P,) expected size of a deviation, its prior standard deviation [SI].
    tolerance
        (P,) largest deviation that a bounded calibration allows [SI]; infinite where there is none.
    identified
        (P,) which parameters a calibration may change.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> parameters = ro.load("position").problem.parameters
    >>> len(parameters), len(parameters.free), parameters.dimension_of("tool_x")
    (66, 34, 'length')
    >>> parameters.take(np.array([0, 5])).names
    ('alpha1', 'alpha2')
    >>> [name for name, places in zip(parameters.names, parameters.of_frames) if places][:4]
    ['base_x', 'base_y', 'base_z', 'base_rx']
    """

    names: tuple[str, ...]
    dimensions: tuple[str, ...]
    nominal: Array
    scale: Array
    tolerance: Array
    identified: np.ndarray

    def __len__(self) -> int:
        return len(self.names)

    def take(self, index: np.ndarray) -> Parameters:
        """Return the entries at ``index`` (K,), in that order."""
        return Parameters(
            tuple(self.names[i] for i in index),
            tuple(self.dimensions[i] for i in index),
            self.nominal[index],
            self.scale[index],
            self.tolerance[index],
            self.identified[index],
        )

    @cached_property
    def free(self) -> Parameters:
        """Return the identified parameters alone, in the order of a calibration's unknowns."""
        return self.take(np.flatnonzero(self.identified))

    @property
    def of_frames(self) -> np.ndarray:
        """(P,) which parameters place something (base, reflectors, anchors, ...) and are not the robot's own."""
        return np.array([not _ON_THE_ROBOT.fullmatch(name) for name in self.names])

    def dimension_of(self, name: str) -> str:
        """Return the dimension of a parameter: ``length``, ``angle``, ``ratio`` or ``compliance``."""
        return self.dimensions[self.names.index(name)]

    def identify(self, patterns: Iterable[str]) -> Parameters:
        """Return the same table with just the parameters identified that match one of the patterns.

        A pattern is a name with ``*``, ``?`` and ``[...]`` as in file names: ``"a?"``, ``"beta[34]"``.

        Raises
        ------
        InputError
            For a pattern that matches no parameter.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> parameters = ro.load("position").problem.parameters
        >>> parameters.identify(["a[12]", "tool_[xyz]"]).free.names
        ('a1', 'a2', 'tool_x', 'tool_y', 'tool_z')
        """
        chosen = np.zeros(len(self), dtype=bool)
        for pattern in patterns:
            hits = [fnmatchcase(name, pattern) for name in self.names]
            if not any(hits):
                raise InputError("key identify", f"pattern '{pattern}'", _summary(self.names, pattern))
            chosen |= hits
        return self._with(identified=chosen)

    def values(self, x: Array) -> Array:
        """Return the parameters' values (n,) [SI] at deviations x (n,) [SI], one for every entry of the table.

        A sum, except for the roll, pitch and yaw of a frame, whose deviation is a rotation about the
        parent's axes (`kinematics.frame`): there the angles of the composed rotation.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> frame = ro.load("position").problem.parameters.identify(["base_r?"]).free
        >>> frame.nominal.round(3), frame.values(np.array([0.1, 0, 0])).round(3)
        (array([ 0.02 , -0.035,  1.901]), array([-0.012, -0.129,  1.904]))
        """
        result = self.nominal + x
        index = {name: i for i, name in enumerate(self.names)}
        for name in [n for n in self.names if n.endswith("_rx")]:
            triple = [index[name[:-1] + axis] for axis in "xyz" if name[:-1] + axis in index]
            if len(triple) == 3:
                R = ca.DM(rotation_rpy(*x[triple]) @ rotation_rpy(*self.nominal[triple])).full()
                result[triple] = roll_pitch_yaw(R)
        return result

    def scaled(self, table: Mapping[str, float], file: object = None) -> Parameters:
        """Return the same table with other scales, given as in a problem file's ``[scale]``.

        Parameters
        ----------
        table
            Keys: ``length_mm``, ``angle_mrad``, ``tool_mm``, ``base_mrad``, ... for a group, or a pattern or a
            parameter's name with a unit, ``a?_mm``, ``d5_mm``. A name goes before a pattern, a pattern before a group.
        file
            What an error names as the place of the table.

        Raises
        ------
        InputError
            For unknown keys, missing or wrong units, and values that are not greater than zero.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> parameters = ro.load("position").problem.parameters.scaled({"length_mm": 0.2, "a3_mm": 2.0})
        >>> parameters.identify(["a[23]"]).free.scale  # [m]
        array([0.0002, 0.002 ])
        """
        return self._with(scale=self._overlay(self.scale, table, "scale", file))

    def toleranced(self, table: Mapping[str, float], file: object = None) -> Parameters:
        """Return the same table with other tolerances, given as in a problem file's ``[tolerance]``.

        Arguments and errors as for `scaled`.

        >>> import rpim_opt as ro
        >>> parameters = ro.load("position").problem.parameters.toleranced({"length_mm": 0.5})
        >>> parameters.identify(["alpha2", "a2"]).free.tolerance  # [rad], [m]
        array([   inf, 0.0005])
        """
        return self._with(tolerance=self._overlay(self.tolerance, table, "tolerance", file))

    def _with(self, **changes: np.ndarray) -> Parameters:
        return Parameters(**{**{f: getattr(self, f) for f in self.__dataclass_fields__}, **changes})

    def _overlay(self, values: Array, table: Mapping[str, float], where: str, file: object) -> Array:
        groups = [group_of(name, dim) for name, dim in zip(self.names, self.dimensions, strict=True)]
        stems: dict[str, set[str]] = {}
        for name, group, dimension in zip(self.names, groups, self.dimensions, strict=True):
            stems.setdefault(group, set()).add(dimension)
            stems.setdefault(name, set()).add(dimension)
        patterns = {split_unit(key)[0] for key in table if re.search(r"[*?\[]", key)}
        for stem in patterns:
            dims = {d for n, d in zip(self.names, self.dimensions, strict=True) if fnmatchcase(n, stem)}
            stems.setdefault(stem, set()).update(dims)
        try:
            given = quantities(table, {stem: tuple(sorted(dims)) for stem, dims in stems.items()}, f"table {where}")
        except InputError as error:
            raise error.within(file) from None
        result = values.copy()
        general_first = sorted(given.items(), key=lambda item: (item[0][0] in self.names, item[0][0] in patterns))
        for (stem, dimension), value in general_first:
            if not value > 0:
                raise InputError(f"table {where}, key {stem}", f"{value:g}", "a number greater than zero", file)
            for i, name in enumerate(self.names):
                if self.dimensions[i] == dimension and (stem == groups[i] or fnmatchcase(name, stem)):
                    result[i] = value
        return result


def group_of(name: str, dimension: str) -> str:
    """Return the group whose scale a parameter has: ``tool``, ``base``, or its dimension.

    What a measurement adds of its own (an anchor, a plane) is placed like the instrument: ``base``.
    """
    if name.startswith(("tool_", "tool.")):
        return "tool"
    return dimension if _ON_THE_ROBOT.fullmatch(name) else "base"


def tool_prefix(marker: str) -> str:
    """Return the prefix of a reflector's parameters: ``tool_``, or ``tool_A_`` for marker A."""
    return f"tool_{marker}_" if marker else "tool_"


def reflectors(names: Iterable[str]) -> list[str]:
    """Return the markers whose reflectors are among the parameters; ``""`` for the only one."""
    return [name[5:-2] for name in names if name.startswith("tool_") and name.endswith("_x")]


def model_parameters(
    robot: Robot,
    base: Sequence[float] | Array = (0.0,) * 6,
    tools: Mapping[str, Sequence[float] | Array] | None = None,
    own: Mapping[str, tuple[str, float]] | None = None,
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

    Examples
    --------
    >>> import rpim_opt as ro
    >>> robot = ro.load("paper_arm").problem.robot
    >>> parameters = ro.model_parameters(robot, tools={"A": (0, 0, 0.06, 0, 0, 0)})
    >>> parameters.identify(["d1", "tool_A_z"]).free.nominal
    array([0.099927, 0.06    ])
    """
    entries: list[tuple[str, str, float]] = []
    for i in range(robot.dof):
        entries += [(f"{c}{i + 1}", MDH_DIMENSION[c], robot.mdh[i, j]) for j, c in enumerate(MDH)]
    for i, kind in enumerate(robot.joint_types, start=1):
        extras = JOINT_EXTRAS if kind == "revolute" else {"ratio": "ratio"}
        entries += [(f"{extra}{i}", dimension, 0.0) for extra, dimension in extras.items()]
    places: dict[str, Sequence[float] | Array] = {"base_": base}
    for marker, tool in (tools or {"": (0.0,) * 6}).items():
        places[tool_prefix(marker)] = tool
    for prefix, place in places.items():
        entries += [(prefix + c, FRAME_DIMENSION[c], v) for c, v in zip(FRAME_DIMENSION, place, strict=True)]
    entries += [(name, dimension, value) for name, (dimension, value) in (own or {}).items()]
    names, dimensions, nominal = zip(*entries, strict=True)
    scale = [DEFAULT_SCALE.get((group_of(n, d), d), 1.0) for n, d, _ in entries]
    return Parameters(
        names,
        dimensions,
        np.array(nominal, dtype=float),
        np.array(scale),
        np.full(len(names), np.inf),
        np.zeros(len(names), dtype=bool),
    )


def _summary(names: Sequence[str], pattern: str) -> str:
    """List the known names, runs of a joint parameter shortened: ``alpha1..6``."""
    runs: dict[str, list[int]] = {}
    others = []
    for name in names:
        match = re.fullmatch(r"([a-z_]*[a-z])(\d+)", name)
        if match:
            runs.setdefault(match[1], []).append(int(match[2]))
        else:
            others.append(name)
    known = [f"{stem}{min(n)}..{max(n)}" for stem, n in runs.items()]
    hint = choices(pattern, names)
    close = hint[hint.rfind(" (did") :] if " (did" in hint else ""
    return "names or patterns of " + ", ".join(known + others) + close
