"""Arguments of a formulation's functions: deviations by name, and predicted positions affine in z."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.text import joined
from rpim_opt.basics.units import fits
from rpim_opt.convex.expressions import cp
from rpim_opt.problem.problem import CalibrationProblem, Identified
from rpim_opt.problem.workspace import markers, predicted
from rpim_opt.robot.parameters import Parameters


def places(names: Sequence[str], pattern: str, where: str, kind: str = "parameters") -> list[int]:
    """Return the indices of the names that match a pattern (``*``, ``?``, ``[...]``); at least one must."""
    indices = [i for i, name in enumerate(names) if fits(name, pattern)]
    if not indices:
        raise InputError(where, f"'{pattern}'", f"{kind}: {choices(pattern, names)}")
    return indices


def index_of(names: Sequence[str], key: Any, where: str) -> Any:
    """Return the index of a name, the indices that a pattern or a list of them matches, or another index unchanged."""
    if isinstance(key, list | tuple) and key and all(isinstance(each, str) for each in key):
        return [index for each in key for index in places(names, each, where)]
    if not isinstance(key, str):
        return key
    if key in names:
        return list(names).index(key)
    return places(names, key, where)


class Deviations:
    """x = S z, deviations [SI] by name: ``x["a2"]`` in metres, ``x["alpha?"]`` in radians, ``x["*"]`` all of them.

    >>> import rpim_opt as ro
    >>> def shorter(z, p):
    ...     return p.x["a2"] <= -0.1e-3  # [m]
    >>> stated = ro.Formulation("a shorter link", penalty=ro.tikhonov.penalty, constraints=(shorter,))
    >>> result = ro.calibrate(ro.load("paper_arm").problem, stated, weight=1e-3)
    >>> print(f"{1e3 * dict(zip(result.problem.parameters.free.names, result.x))['a2']:.3f} mm")
    -0.100 mm
    """

    def __init__(self, z: cp.Expression, parameters: Parameters):
        self._z = z
        self._parameters = parameters

    def __getitem__(self, key: Any) -> Any:
        index = index_of(self._parameters.names, key, "x")
        return cp.multiply(self._parameters.scale[index], self._z[index])

    def __len__(self) -> int:
        return len(self._parameters)


@dataclass(frozen=True, eq=False, repr=False)
class Arguments(Identified):
    """The identified parameters as the argument of a constraint function, with z (n,) and quantities affine in it.

    Other arguments as for `Parameters`; ``nonlinear`` records the linearized positions that a function used.
    """

    z: Any = None
    nonlinear: list[str] = field(default_factory=list)

    @property
    def x(self) -> Deviations:
        """Deviations [SI] by name, as expressions of z."""
        return Deviations(self.z, self)

    def positions(
        self, q: Array, marker: str | None = None, torque: Array | None = None, robot: str = ""
    ) -> cp.Expression:
        """Return predicted positions (N, 3) [m] in the instrument's frame, affine in z.

        They are linearized; the calibration repeats until linearization and solution agree. q (N, dof) are joint values
        of the controller [rad or m]; ``marker`` is the reflector (InputError if there are several and none is given);
        ``torque`` (N, dof) are joint torques [Nm], needed if compliance is identified from measured ones; ``robot`` is
        one of several.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> home = np.zeros((1, 6))  # joint values [rad]
        >>> level = lambda z, p: p.positions(home)[0, 2] == 0.1975  # [m]
        >>> stated = ro.Formulation("level", penalty=ro.tikhonov.penalty, constraints=(level,))
        >>> result = ro.calibrate(ro.load("paper_arm").problem, stated, weight=1e-3)
        >>> print(f"{result.forward(home)[0, 2, 3]:.4f} m")
        0.1975 m
        """
        problem = problem_of(self)
        known = markers(problem.alone(robot))
        if marker is None and len(known) > 1:
            raise InputError("positions", f"no marker, of {len(known)} reflectors", f"marker = one of {joined(known)}")
        prediction = predicted(problem, q, known[0] if marker is None else marker, torque, self.at, robot)
        count = len(prediction.position)
        flat = (prediction.slope * self.scale).reshape(3 * count, -1)
        return cp.reshape(flat @ self.z, (count, 3), order="C") + prediction.position


def problem_of(p: Arguments) -> CalibrationProblem:
    """Return the problem that predicts positions for some parameters; InputError if there is none."""
    if p.problem is None:
        found = "parameters without a problem"
        raise InputError("positions", found, "parameters of a problem's linear model (`CalibrationProblem`)")
    p.nonlinear.append("positions")
    return p.problem


def arguments_of(z: Any, parameters: Parameters) -> Arguments:
    """Return the argument of constraint functions: the parameters with z (n,), and the problem of a linear model.

    >>> import rpim_opt as ro
    >>> parameters = ro.load("paper_arm").problem.parameters.free
    >>> len(ro.convex.arguments_of(ro.convex.Unknown(parameters.names), parameters).x)
    26
    """
    if isinstance(parameters, Arguments):
        return replace(parameters, z=z)
    return Arguments(**{each.name: getattr(parameters, each.name) for each in fields(parameters)}, z=z)
