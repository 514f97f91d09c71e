"""The calibration problem and its linearization: where CasADi ends and linear algebra begins."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import get_lapack_funcs

from rpim_opt.compiled import compiled
from rpim_opt.dataset import Block, Dataset
from rpim_opt.exceptions import InputError, choices
from rpim_opt.kinematics import FRAME, call_rows, chain, frame
from rpim_opt.measurement import Measurement, of_fixture
from rpim_opt.parameters import Parameters, tool_prefix
from rpim_opt.phases import phase
from rpim_opt.robot import Array, Robot
from rpim_opt.threads import one_blas_thread

RANK_TOLERANCE = 1e-10
"""Singular values below this part of the largest count as zero: the data do not see those directions."""
SOME, LARGE = 1000, 20_000
"""Rows from which on a compiled function is worth loading, and worth compiling."""
ROWS = 4096
"""Rows that are evaluated and reduced together: as many as a processor's cache holds."""


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
    constrained
        Whether measured values are constraints (a plane, a sphere). A robot shrunk to nothing would meet them, so
        that how well they are met does not tell the noise.
    stands_for
        How many equations A and b were reduced from by a rotation, None where they are the equations themselves.
    offset
        What a loss that these equations majorize has besides |A z - b|^2.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("paper_arm").problem
    >>> model = problem.linearize(np.zeros(len(problem.parameters.free)))
    >>> model.A.shape, model.equations, model.rank, model.triangle.shape
    ((27, 26), 27, 20, (27, 27))
    >>> (model.svd[1][:3] / model.svd[1][0]).round(2)  # largest singular values, relative
    array([1.  , 0.96, 0.8 ])
    >>> float(np.abs(model.with_values(0 * model.b).svd[0]).max())  # no data, no deviations
    0.0
    >>> model.scaled(np.repeat([1.0, 0.0], [15, 12])).rank  # without the last four configurations
    15
    """

    A: Array
    b: Array
    group: np.ndarray
    parameters: Parameters
    constrained: bool = False
    stands_for: int | None = None
    offset: float = 0.0

    @property
    def equations(self) -> int:
        """Number of equations m, those of the data where A and b were reduced from them."""
        return len(self.b) if self.stands_for is None else self.stands_for

    @cached_property
    def svd(self) -> tuple[Array, Array, Array]:
        """U'b (n,), s (n,), V' (n, n) of A = U diag(s) V'; s below `RANK_TOLERANCE` times the largest are zero."""
        n, R = self.A.shape[1], self.triangle
        with phase("reduction"):
            U, s, Vt = np.linalg.svd(R[:n, :n])
        s = np.where(s > RANK_TOLERANCE * s[0], s, 0.0)
        return U.T @ R[:n, n], s, Vt

    @cached_property
    def triangle(self) -> Array:
        """Upper triangle R (n+1, n+1) of [A b] = QR: |A z - b| = |R [z; -1]| for every z."""
        with phase("reduction"):
            return reduced_rows(np.column_stack([self.A, self.b]))

    @property
    def rank(self) -> int:
        """Number of directions in the parameters that the data see."""
        return int(np.count_nonzero(self.svd[1]))

    def with_values(self, b: Array) -> LinearModel:
        """Return the model with other right-hand sides (m,)."""
        return replace(self, b=b)

    def scaled(self, rows: Array) -> LinearModel:
        """Return the model with its equations multiplied by numbers (m,)."""
        return replace(self, A=self.A * rows[:, None], b=self.b * rows)


@dataclass(frozen=True, eq=False)
class CalibrationProblem:
    """What was measured on which robot, and which parameters are to explain it.

    The unknowns x (n,) are the deviations [SI] of the identified parameters from nominal. Equations stand
    in the order of the data's blocks.

    Parameters
    ----------
    robot
        The nominal robot.
    parameters
        All parameters of the model, some of them identified.
    data
        The measurements, of one kind or several.

    Raises
    ------
    InputError
        When nothing is identified, or the data do not fit the robot or the parameters.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> problem = instance.problem
    >>> nominal = np.zeros(len(problem.parameters.free))
    >>> problem.residual(nominal).shape, problem.modelled(nominal)[0].shape, problem.jacobian(nominal).shape
    ((27,), (9, 3), (27, 26))
    >>> len(problem.linearize(nominal).b)
    27
    >>> [round(float(1e3 * p.errors(nominal).mean()), 3) for p in (problem, problem.on(instance.validation))]  # [mm]
    [2.096, 2.649]
    """

    robot: Robot
    parameters: Parameters
    data: Dataset

    def __post_init__(self) -> None:
        p = self.parameters
        if not p.identified.any():
            raise InputError("key identify", "no parameter", "at least one")
        for block in self.data.blocks:
            if block.q.shape[2] != self.robot.dof:
                raise InputError("q", f"{block.q.shape[2]} columns", f"{self.robot.dof}, one a joint")
            for marker in block.markers:
                if tool_prefix(marker) + "x" not in p.names:
                    known = sorted({n.split("_")[1] for n in p.names if n.startswith("tool_") and n.count("_") == 2})
                    raise InputError("column marker", f"'{marker}'", "a reflector of " + choices(marker, known))
            for name in block.measurement.parameters:
                if of_fixture(name, block.fixture) not in p.names:
                    where = f"measurement {block.measurement.name}"
                    raise InputError(where, f"no parameter '{of_fixture(name, block.fixture)}'", "a model with it")
        compliant = [n for n, used in zip(p.names, p.identified, strict=True) if used and n.startswith("compliance")]
        if compliant and not any(block.torque is not None for block in self.data.blocks):
            raise InputError(
                "key identify", f"'{compliant[0]}' without joint torques", "columns tau1_Nm, ... in the data"
            )

    def on(self, data: Dataset) -> CalibrationProblem:
        """Return the same problem with other measurements."""
        return CalibrationProblem(self.robot, self.parameters, data)

    def identifying(self, identified: np.ndarray) -> CalibrationProblem:
        """Return the same problem with other parameters identified, (P,) true or false.

        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> problem.identifying(problem.parameters.of_frames).parameters.free.names[:4]
        ('base_x', 'base_y', 'base_z', 'base_rx')
        """
        return CalibrationProblem(self.robot, replace(self.parameters, identified=identified), self.data)

    @property
    def complete(self) -> bool:
        """Whether ``data`` are all the measurements, as everywhere but in a `PartitionedProblem`.

        >>> import rpim_opt as ro
        >>> ro.load("paper_arm").problem.complete
        True
        """
        return True

    def for_loss(self, formulation: Any) -> tuple[CalibrationProblem, Any]:
        """Return the problem and the formulation that `calibrate` solves: these, unless the data come in parts.

        >>> import rpim_opt as ro
        >>> problem = ro.load("paper_arm").problem
        >>> problem.for_loss(ro.tikhonov) == (problem, ro.tikhonov)
        True
        """
        return self, formulation

    def residual(self, x: Array) -> Array:
        """Return measured minus modelled at the deviations x (n,) [SI], (m,) [SI]."""
        return np.concatenate([self._evaluate(block, "residual", x)[0].ravel() for block in self.data.blocks])

    def modelled(self, x: Array) -> list[Array]:
        """Return what the instrument would read at the deviations x (n,) [SI], block by block, (N, c) [SI]."""
        return [self._evaluate(block, "modelled", x)[0][:, 0] for block in self.data.blocks]

    def errors(self, x: Array, dimension: str = "length") -> Array:
        """Return the norm of every row's residual, (N,) [m]: for positions and poses the position error.

        Parameters
        ----------
        x
            (n,) deviations [SI].
        dimension
            ``"length"``, or ``"angle"`` for the norm of the angles [rad], for poses the orientation error. Rows without
            such components get NaN.

        Examples
        --------
        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("pose").problem
        >>> nominal = np.zeros(len(problem.parameters.free))
        >>> [f"{1e3 * problem.errors(nominal, dimension).mean():.2f}" for dimension in ("length", "angle")]  # mm, mrad
        ['15.01', '7.09']
        """
        errors = np.full(len(self.data), np.nan)
        for block in self.data.blocks:
            of = [i for i, d in enumerate(block.measurement.components.values()) if d == dimension]
            if of:
                residual = self._evaluate(block, "residual", x)[0][:, 0, of]
                errors[block.row] = np.sqrt(np.sum(residual**2, axis=1))
        return errors

    def whitened_errors(self, x: Array) -> tuple[Array, np.ndarray]:
        """Return the whitened norm of every row's residual at x (n,), (N,), and how many equations each has (N,).

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("paper_arm").problem  # 2 mm off at nominal, and 0.03 mm of noise declared
        >>> norms, count = problem.whitened_errors(np.zeros(len(problem.parameters.free)))
        >>> norms[:3].round(1), count[:3]
        (array([72.9, 68.5, 54.5]), array([3, 3, 3]))
        """
        norms, count = np.zeros(len(self.data)), np.zeros(len(self.data), dtype=int)
        for block, whitening in zip(self.data.blocks, self._whitening, strict=True):
            r = (whitening @ self._evaluate(block, "residual", x)[0].transpose(0, 2, 1))[:, :, 0]
            norms[block.row], count[block.row] = np.sqrt(np.sum(r**2, axis=1)), r.shape[1]
        return norms, count

    def jacobian(self, x: Array) -> Array:
        """Return the identification Jacobian of the modelled values at x (n,), -d residual / dx, (m, n) [SI]."""
        parts = [self._evaluate(block, "jacobian", x)[1] for block in self.data.blocks]
        return np.concatenate([part.reshape(-1, len(x)) for part in parts])

    def linearize(self, x: Array) -> LinearModel:
        """Return the whitened, scaled linear model around the deviations x (n,) [SI]."""
        parts = [self._equations(i, x, slice(None)) for i in range(len(self.data.blocks))]
        A, b = (np.concatenate([part[k] for part in parts]) for k in range(2))
        group = [
            np.repeat(self.data.configuration[block.row], len(block.measurement.components))
            for block in self.data.blocks
        ]
        return LinearModel(A, b, np.concatenate(group), self.parameters.free, self._constrained)

    @one_blas_thread
    def reduced(self, x: Array) -> LinearModel:
        """Return the model of `linearize` at x (n,) as its triangle: n + 1 equations, the same |A z - b| for every z.

        Rows are evaluated, whitened and rotated into the triangle `ROWS` at a time, so that memory does not grow with
        their number.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> model = problem.reduced(np.zeros(len(problem.parameters.free)))
        >>> model.A.shape, model.equations
        ((35, 34), 120)
        """
        R, count = np.zeros((0, len(x) + 1)), 0
        for i, block in enumerate(self.data.blocks):
            for start in range(0, len(block.row), ROWS):
                A, b = self._equations(i, x, slice(start, start + ROWS))
                count += len(b)
                with phase("reduction"):
                    R = reduced_rows(np.column_stack([A, b]), R)
        return self.from_triangle(R, count)

    def from_triangle(self, R: Array, count: int) -> LinearModel:
        """Return a linear model whose triangle is known.

        Parameters
        ----------
        R
            (n+1, n+1) of [A b] = QR.
        count
            How many equations A and b had.

        Examples
        --------
        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> model = problem.linearize(np.zeros(len(problem.parameters.free)))
        >>> small = problem.from_triangle(model.triangle, model.equations)
        >>> bool(np.allclose(small.svd[1], model.svd[1])), len(small.b), small.equations
        (True, 35, 120)
        """
        return LinearModel(
            R[:, :-1], R[:, -1], np.zeros(len(R), dtype=int), self.parameters.free, self._constrained, count
        )

    @property
    def _constrained(self) -> bool:
        return any(not block.measurement.columns for block in self.data.blocks)

    def _equations(self, i: int, x: Array, part: slice) -> tuple[Array, Array]:
        """Return whitened, scaled A and b of some rows of a block."""
        block, whitening, scale = self.data.blocks[i], self._whitening[i], self.parameters.free.scale
        residual, jacobian = self._evaluate(block, "jacobian", x, part)
        L = whitening if len(whitening) == 1 else whitening[part]
        if len(L) == 1 and np.count_nonzero(L - np.diag(np.diagonal(L[0]))) == 0:  # independent, the same for all rows
            each = np.diagonal(L[0])
            r, A = (residual[:, 0] * each).ravel(), (jacobian * each[:, None]).reshape(-1, len(x))
        else:
            r = (L @ residual.transpose(0, 2, 1)).ravel()
            A = (L @ jacobian).reshape(-1, len(x))
        A *= scale
        return A, r + A @ (x / scale)

    @cached_property
    def _whitening(self) -> list[Array]:
        """L^-1 with covariance = L L', for every block."""
        try:
            factors = [np.linalg.cholesky(block.covariance) for block in self.data.blocks]
            return [np.asarray(np.linalg.inv(L), dtype=float) for L in factors]
        except np.linalg.LinAlgError:
            raise InputError("covariance", "a matrix that is not positive definite", "one that is") from None

    def _evaluate(self, block: Block, what: str, x: Array, part: slice = slice(None)) -> list[Array]:
        p = self.parameters
        absent = (p.nominal == 0) & ~p.identified
        function = _functions(
            self.robot.joint_types, p.names, p.identified.tobytes(), absent.tobytes(),
            block.measurement, block.markers, block.fixture, block.torque is not None,
        )[what]  # fmt: skip
        if len(block.row) >= SOME:
            function = compiled(function, make=len(block.row) >= LARGE) or function
        with phase("evaluation"):
            return call_rows(function, [x, p.nominal], self._rows(block, part))

    def _rows(self, block: Block, part: slice) -> Array:
        """Return joint values of the model, torques, and measured values, side by side."""
        if part == slice(None):
            if id(block) not in self._kept:
                self._kept[id(block)] = self._stacked(block, part)
            return self._kept[id(block)]
        return self._stacked(block, part)

    @cached_property
    def _kept(self) -> dict[int, Array]:
        return {}

    def _stacked(self, block: Block, part: slice) -> Array:
        M, y = self.robot.joint_map, block.y[part]
        parts = [(block.q[part] @ M.T).reshape(len(y), -1)]
        if block.torque is not None:  # virtual work: tau_model = M^-T tau
            parts.append((block.torque[part] @ np.linalg.inv(M)).reshape(len(y), -1))
        return np.hstack([*parts, y])


_geqrf: Any = get_lapack_funcs("geqrf", dtype=float)


def reduced_rows(rows: Array, R: Array | None = None) -> Array:
    """Return the upper triangle (n+1, n+1) of R over ``rows`` (m, n+1), by Householder's QR."""
    n = rows.shape[1]
    above = 0 if R is None else len(R)
    stacked = np.empty((max(above + len(rows), n), n), order="F")
    stacked[:above] = 0 if R is None else R
    stacked[above : above + len(rows)] = rows
    stacked[above + len(rows) :] = 0.0
    factors = _geqrf(stacked, lwork=64 * n, overwrite_a=1)[0]
    return np.triu(factors[:n])


@lru_cache(maxsize=256)
def _functions(
    joint_types: tuple[str, ...],
    names: tuple[str, ...],
    identified: bytes,
    absent: bytes,
    measurement: Measurement,
    markers: tuple[str, ...],
    fixture: str,
    torques: bool,
) -> dict[str, ca.Function]:
    """Build residual and Jacobian of one row; one structure is built once and serves every problem of it."""
    dof, points, free = len(joint_types), len(markers), np.frombuffer(identified, dtype=bool)
    x, nominal = ca.SX.sym("x", int(free.sum())), ca.SX.sym("nominal", len(names))
    q = ca.SX.sym("q", dof * points)
    tau = ca.SX.sym("tau", dof * points if torques else 0)
    y = ca.SX.sym("y", len(measurement.columns))
    row = ca.vertcat(q, tau, y)
    zero = dict(zip(names, np.frombuffer(absent, dtype=bool), strict=True))
    start = {name: ca.SX(0) if zero[name] else nominal[i] for i, name in enumerate(names)}
    deviation = dict.fromkeys(names, ca.SX(0))
    deviation.update({names[i]: x[k] for k, i in enumerate(np.flatnonzero(free))})

    def place(prefix: str) -> ca.SX:
        return frame([start[prefix + c] for c in FRAME], [deviation[prefix + c] for c in FRAME])

    def value(name: str) -> ca.SX:
        return start[name] + deviation[name] if name in start else ca.SX(0)

    def reflector(point: int, marker: str) -> ca.SX:
        at = slice(point * dof, (point + 1) * dof)
        torque = ca.vertsplit(tau[at]) if torques else (0,) * dof
        return place("base_") @ chain(joint_types, ca.vertsplit(q[at]), torque, value) @ place(tool_prefix(marker))

    transforms = [reflector(point, marker) for point, marker in enumerate(markers)]
    own: dict[str, ca.SX] = {name: place(of_fixture(name + "_", fixture)) for name in measurement.frames}
    for name in measurement.parameters:
        if not name.startswith(tuple(f"{prefix}_" for prefix in measurement.frames)):
            own[name] = value(of_fixture(name, fixture))
    modelled = ca.densify(measurement.model(*transforms, **own))
    residual = ca.densify(measurement.minus(y if measurement.columns else 0, modelled))
    if residual.numel() != len(measurement.components):
        found = f"{residual.numel()} components of the residual"
        raise InputError(f"measurement {measurement.name}", found, f"{len(measurement.components)} as it declares")
    transposed = ca.densify(-ca.jacobian(residual, x).T)
    return {
        "residual": ca.Function("residual", [x, nominal, row], [residual]),
        "jacobian": ca.Function("jacobian", [x, nominal, row], [residual, transposed]),
        "modelled": ca.Function("modelled", [x, nominal, row], [modelled]),
    }
