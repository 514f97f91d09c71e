"""The calibration problem and its linearization: where CasADi ends and linear algebra begins."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from rpim_opt.dataset import Dataset
from rpim_opt.exceptions import InputError
from rpim_opt.kinematics import FRAME, call_rows, chain, frame
from rpim_opt.measurement import Measurement, position
from rpim_opt.parameters import Parameters
from rpim_opt.robot import Array, Robot

RANK_TOLERANCE = 1e-10
"""Singular values below this part of the largest count as zero: the data do not see those directions."""


@dataclass(frozen=True, eq=False)
class LinearModel:
    """A calibration linearized around some deviation: A z ~ b, everything dimensionless.

    Parameters
    ----------
    A
        (m, n) = Sigma^-1/2 J S, the whitened identification Jacobian in units of the scales.
    b
        (m,) = Sigma^-1/2 r + A z_k, so that z is the *total* deviation in units of the scales.
    group
        (m,) number of the configuration that an equation belongs to.
    parameters
        The n identified parameters.
    """

    A: Array
    b: Array
    group: np.ndarray
    parameters: Parameters

    @cached_property
    def svd(self) -> tuple[Array, Array, Array]:
        """U'b (n,), s (n,), V' (n, n) of A = U diag(s) V'; singular values below rounding are zero."""
        n = self.A.shape[1]
        R = self.triangle
        U, s, Vt = np.linalg.svd(R[:n, :n])
        s = np.where(s > RANK_TOLERANCE * s[0], s, 0.0)
        return U.T @ R[:n, n], s, Vt

    @cached_property
    def triangle(self) -> Array:
        """Upper triangle R (n+1, n+1) of [A b] = QR: |A z - b| = |R [z; -1]| for every z."""
        n = self.A.shape[1]
        R = np.linalg.qr(np.column_stack([self.A, self.b]), mode="r")
        return np.vstack([R, np.zeros((n + 1 - len(R), n + 1))])

    @property
    def rank(self) -> int:
        """Number of directions in the parameters that the data see."""
        return int(np.count_nonzero(self.svd[1]))

    def without(self, group: int) -> LinearModel:
        """Return the model that has not seen one configuration: its rows are zero, the shape stays."""
        keep = self.group != group
        return LinearModel(self.A * keep[:, None], self.b * keep, self.group, self.parameters)


@dataclass(frozen=True, eq=False)
class CalibrationProblem:
    """What was measured on which robot, and which parameters are to explain it.

    The unknowns x (n,) are the deviations [SI] of the identified parameters from nominal.

    Parameters
    ----------
    robot
        The nominal robot.
    parameters
        All parameters of the model, some of them identified.
    data
        The measurements.
    measurement
        What the instrument sees.
    """

    robot: Robot
    parameters: Parameters
    data: Dataset
    measurement: Measurement = position

    def __post_init__(self) -> None:
        if not self.parameters.identified.any():
            raise InputError("key identify", "no parameter", "at least one")
        if self.data.q.shape[1] != self.robot.dof:
            raise InputError("q", f"{self.data.q.shape[1]} columns", f"{self.robot.dof}, one a joint")

    def on(self, data: Dataset) -> CalibrationProblem:
        """Return the same problem with other measurements."""
        return CalibrationProblem(self.robot, self.parameters, data, self.measurement)

    def residual(self, x: Array) -> Array:
        """Return measured minus modelled, (m,) [SI]."""
        return self._evaluate("residual", x)[0].ravel()

    def errors(self, x: Array) -> Array:
        """Return the norm of every row's residual, (N,) [m]: for positions the position error."""
        return np.sqrt(np.sum(self._evaluate("residual", x)[0][:, 0] ** 2, axis=1))

    def jacobian(self, x: Array) -> Array:
        """Return the identification Jacobian of the modelled values, -d residual / dx, (m, n) [SI]."""
        return self._evaluate("jacobian", x)[1].reshape(-1, len(x))

    def linearize(self, x: Array) -> LinearModel:
        """Return the whitened, scaled linear model around the deviations x (n,) [SI]."""
        residual, jacobian = self._evaluate("jacobian", x)
        scale = self.parameters.free.scale
        r = self._whitening @ residual.transpose(0, 2, 1)
        A = (self._whitening @ jacobian).reshape(-1, len(x)) * scale
        group = np.repeat(self.data.configuration, residual.shape[2])
        return LinearModel(A, r.ravel() + A @ (x / scale), group, self.parameters.free)

    @cached_property
    def _whitening(self) -> Array:
        """L^-1 with covariance = L L'."""
        try:
            return np.asarray(np.linalg.inv(np.linalg.cholesky(self.data.covariance)), dtype=float)
        except np.linalg.LinAlgError:
            raise InputError("covariance", "a matrix that is not positive definite", "one that is") from None

    def _evaluate(self, what: str, x: Array) -> list[Array]:
        p = self.parameters
        absent = (p.nominal == 0) & ~p.identified
        functions = _functions(
            self.robot.joint_types, p.names, p.identified.tobytes(), absent.tobytes(), self.measurement
        )
        return call_rows(functions[what], [x, p.nominal], self._rows)

    @cached_property
    def _rows(self) -> Array:
        """Joint values of the model and measured values, side by side."""
        return np.hstack([self.data.q @ self.robot.joint_map.T, self.data.y])


@lru_cache(maxsize=64)
def _functions(
    joint_types: tuple[str, ...],
    names: tuple[str, ...],
    identified: bytes,
    absent: bytes,
    measurement: Measurement,
) -> dict[str, ca.Function]:
    """Build residual and Jacobian of one row; one structure is built once and serves every problem of it."""
    dof, free = len(joint_types), np.frombuffer(identified, dtype=bool)
    x, nominal = ca.SX.sym("x", int(free.sum())), ca.SX.sym("nominal", len(names))
    row = ca.SX.sym("row", dof + len(measurement.columns))
    zero = dict(zip(names, np.frombuffer(absent, dtype=bool), strict=True))
    start = {name: ca.SX(0) if zero[name] else nominal[i] for i, name in enumerate(names)}
    deviation = dict.fromkeys(names, ca.SX(0))
    deviation.update({names[i]: x[k] for k, i in enumerate(np.flatnonzero(free))})

    def place(prefix: str) -> ca.SX:
        return frame([start[prefix + c] for c in FRAME], [deviation[prefix + c] for c in FRAME])

    def value(name: str) -> ca.SX:
        return start[name] + deviation[name] if name in start else ca.SX(0)

    flange = chain(joint_types, ca.vertsplit(row[:dof]), (0,) * dof, value)
    T = place("base_") @ flange @ place("tool_")
    own = {name: value(name) for name in measurement.parameters}
    residual = ca.densify(measurement.residual(row[dof:], T, **own))
    transposed = ca.densify(-ca.jacobian(residual, x).T)
    return {
        "residual": ca.Function("residual", [x, nominal, row], [residual]),
        "jacobian": ca.Function("jacobian", [x, nominal, row], [residual, transposed]),
    }
