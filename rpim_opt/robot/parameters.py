"""The parameters of a calibration: names, nominal values, expected sizes, tolerances, and which are identified."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.patterns import fits
from rpim_opt.basics.shown import Tabled
from rpim_opt.basics.units import display
from rpim_opt.robot.kinematics import numeric_frame, roll_pitch_yaw
from rpim_opt.robot.overlay import Overlay
from rpim_opt.robot.parameter_names import group_of, known_patterns, of_joint, of_session, own_name

SHOWN = 4
"""Names in one line."""


@dataclass(frozen=True, eq=False, repr=False)
class Parameters(Tabled):
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
    own_frames
        Prefixes of the frames of measurements, ``plane_``: their rotations are angles as those of base and tool are.
    terms
        Names of the parameters of a user's own terms (`Model`), which are the robot's as those of the table are.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> parameters = ro.load("position").problem.parameters
    >>> len(parameters), len(parameters.free), parameters.dimension_of("tool_x")
    (114, 34, 'length')
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
    own_frames: tuple[str, ...] = ()
    terms: tuple[str, ...] = ()

    def _short(self) -> str:
        shown = ", ".join([*self.names[:SHOWN], "..."] if len(self) > SHOWN else self.names)
        return f"{shown}: {np.count_nonzero(self.identified)} of {len(self)} identified"

    def _frame_rows(self) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        for i, (name, dimension) in enumerate(zip(self.names, self.dimensions, strict=True)):
            unit, si = display(dimension)
            row = {
                "parameter": name,
                "unit": unit,
                "nominal": float(self.nominal[i] / si),
                "scale": float(self.scale[i] / si),
                "tolerance": None,
                "identified": bool(self.identified[i]),
            }
            if np.isfinite(self.tolerance[i]):
                row["tolerance"] = float(self.tolerance[i] / si)
            rows.append(row)
        return rows

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
            self.own_frames,
            self.terms,
        )

    @cached_property
    def free(self) -> Parameters:
        """Return the identified parameters alone, in the order of a calibration's unknowns."""
        return self.take(np.flatnonzero(self.identified))

    def of_robot(self, robot: str) -> Parameters:
        """Return what one of several robots has of the table, called as the robot itself calls it.

        Parameters
        ----------
        robot
            Its name; ``""`` for the only one.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> both = ro.together(left=problem, right=problem, shared=["tool_*"]).parameters
        >>> both.free.names[0], both.of_robot("left").free.names[0], "tool_x" in both.of_robot("right").names
        ('left.alpha1', 'alpha1', True)
        """
        if not robot:
            return self
        found = self.take(self.places_of(robot))
        terms = tuple(own_name(name) for name in self.terms if name in found.names)
        return replace(found, names=tuple(map(own_name, found.names)), terms=terms)

    def called(self, robot: str, own: str) -> str:
        """Return what the table calls a parameter of one of several robots: ``left.a2``, or ``a2`` if shared.

        Parameters
        ----------
        robot
            Its name; ``""`` for the only one.
        own
            What the robot itself calls the parameter.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> both = ro.together(left=problem, right=problem, shared=["tool_*"]).parameters
        >>> both.called("left", "a2"), both.called("left", "tool_x")
        ('left.a2', 'tool_x')
        """
        if own in self.names or not robot:
            return own
        return f"{robot}.{own}"

    def places_of(self, robot: str) -> np.ndarray:
        """Return where the parameters of one of several robots stand (k,), those that it shares among them.

        Parameters
        ----------
        robot
            Its name; ``""`` for the only one.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> both = ro.together(left=problem, right=problem, shared=["tool_*"]).parameters
        >>> len(both), len(both.places_of("right"))
        (222, 114)
        """
        if not robot:
            return np.arange(len(self))
        shared_or_own = ("", robot)
        return np.flatnonzero([name.rpartition(".")[0] in shared_or_own for name in self.names])

    @property
    def of_frames(self) -> np.ndarray:
        """(P,) which parameters place something (base, reflectors, sessions, ...) and are not the robot's own."""
        return np.array([not of_joint(name) and name not in self.terms for name in self.names])

    @property
    def placed(self) -> np.ndarray:
        """(P,) which of these may be anywhere: all but the shifts of sessions, which are as small as their sizes.

        >>> import rpim_opt as ro
        >>> parameters = ro.load("position").problem.parameters
        >>> bool((parameters.placed == parameters.of_frames).all())  # nobody named a session
        True
        """
        return self.of_frames & ~np.array([of_session(name) for name in self.names], dtype=bool)

    @property
    def groups(self) -> tuple[str, ...]:
        """The P groups whose scales they have: ``base``, ``tool``, ``session``, or their dimension.

        >>> import rpim_opt as ro
        >>> ro.load("position").problem.parameters.identify(["d2", "ecc_sin2", "tool_x"]).free.groups
        ('length', 'angle', 'tool')
        """
        return tuple(
            dimension if name in self.terms else group_of(name, dimension)
            for name, dimension in zip(self.names, self.dimensions, strict=True)
        )

    @cached_property
    def periodic(self) -> np.ndarray:
        """(P,) which parameters are rotations: after a full turn they describe the same robot at the same place.

        Those are alpha, theta and beta of the joints, and roll, pitch and yaw of frames. Ratios, compliances and
        eccentricities are none, and of a measurement's own parameters only those of its frames.

        >>> import rpim_opt as ro
        >>> parameters = ro.load("position").problem.parameters.identify(["d2", "theta2", "ecc_sin2", "tool_rx"])
        >>> parameters.free.periodic
        array([ True, False, False,  True])
        """
        frames = "|".join(map(re.escape, ("base_", *self.own_frames)))
        turning = re.compile(rf"(alpha|theta|beta)\d+|({frames}|tool_(.*_)?)r[xyz]")
        return np.array([bool(turning.fullmatch(own_name(name))) for name in self.names])

    def wrapped(self, x: Array) -> Array:
        """Return the deviations of the same robot with every rotation in (-pi, pi]; others stay as they are.

        Parameters
        ----------
        x
            (n,) deviations [SI], one for every entry of the table: of a calibration's unknowns it is ``free``.

        Examples
        --------
        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> free = ro.load("position").problem.parameters.identify(["a2", "theta2"]).free
        >>> free.wrapped(np.array([4.0, 4.0])).round(3)  # [m], [rad]
        array([ 4.   , -2.283])
        """
        turns = np.ceil((x - np.pi) / (2 * np.pi))
        return x - 2 * np.pi * np.where(self.periodic, turns, 0.0)

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
            hits = [fits(name, pattern) for name in self.names]
            if not any(hits):
                raise InputError("key identify", f"pattern '{pattern}'", known_patterns(self.names, pattern))
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
        for first in [name for name in self.names if name.endswith("_rx")]:
            angles = [first[:-1] + axis for axis in "xyz"]
            # a frame of which a table holds but some angles cannot be composed
            if index.keys() >= set(angles):
                triple = [index[name] for name in angles]
                moved = numeric_frame([0, 0, 0, *x[triple]]) @ numeric_frame([0, 0, 0, *self.nominal[triple]])
                result[triple] = roll_pitch_yaw(moved[:3, :3])
        return result

    def scaled(self, table: Mapping[str, float], file: object = None) -> Parameters:
        """Return the same table with other scales, given as in a problem file's ``[scale]``.

        Parameters
        ----------
        table
            Keys: ``length_mm``, ``angle_mrad``, ``tool_mm``, ``base_mrad``, ... for a group, ``joint_offset_mrad`` for
            every theta, or a pattern or a parameter's name with a unit, ``a?_mm``, ``d5_mm``. A name goes before a
            pattern, a pattern before a group.
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
        return self._with(scale=self._overlaid(self.scale, table, "scale", file))

    def toleranced(self, table: Mapping[str, float], file: object = None) -> Parameters:
        """Return the same table with other tolerances, given as in a problem file's ``[tolerance]``.

        Arguments and errors as for `scaled`.

        >>> import rpim_opt as ro
        >>> parameters = ro.load("position").problem.parameters.toleranced({"length_mm": 0.5})
        >>> parameters.identify(["alpha2", "a2"]).free.tolerance  # [rad], [m]
        array([   inf, 0.0005])
        """
        return self._with(tolerance=self._overlaid(self.tolerance, table, "tolerance", file))

    def _with(self, **changes: np.ndarray) -> Parameters:
        return replace(self, **changes)

    def _overlaid(self, values: Array, table: Mapping[str, float], where: str, file: object) -> Array:
        try:
            return Overlay(self.names, self.dimensions, self.groups).on(values, table, f"table {where}")
        except InputError as error:
            raise error.within(file) from None
