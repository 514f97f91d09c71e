"""The calibration problem: residuals, Jacobians and linearization of measurements in memory."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices, pick
from rpim_opt.basics.text import Tabled, counted
from rpim_opt.data.dataset import Block, Dataset, stops
from rpim_opt.data.measurements.measurement import Measurement, of_fixture
from rpim_opt.data.measurements.pose import position
from rpim_opt.problem.contact import Features, Touches, contrasted, of_rows
from rpim_opt.problem.linear import RANK_TOLERANCE, LinearModel, Reweigh
from rpim_opt.problem.noise import Equations, Repeatability, Stack, equation_numbers
from rpim_opt.problem.row_functions import (
    Functions,
    Kept,
    Structure,
    loads_in,
    loads_of,
    measured_torques,
    needed,
    require_known_masses,
    require_loads,
    require_same_torques,
    row_functions,
)
from rpim_opt.robot.chain import NEAR_PARALLEL, ORIGIN, row_origins
from rpim_opt.robot.kinematics import call_rows
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import (
    Parameters,
    frame_of,
    of_session,
    own_name,
    session_prefix,
    tool_prefix,
    with_terms,
)
from rpim_opt.robot.terms import Curve, Model, transmission

SHIFTED = ("base_x", "base_y", "base_z")  # parameters that move the whole robot
MOST_TURNS = 4  # of a joint's value; larger values are degrees


@dataclass(frozen=True, eq=False, repr=False)
class RobotModel(Tabled):
    """The nominal robots, their parameters and repeatability, common to measurements in memory and in blocks."""

    keeps_rows: ClassVar[bool] = True  # whether `linearize` returns the equations themselves, not their QR factor
    robots: Robot | Mapping[str, Robot]
    parameters: Parameters
    frozen_functions: Kept | None = field(default=None, repr=False, kw_only=True)
    repeatability: Repeatability | None = field(default=None, kw_only=True)
    session: str = field(default="", kw_only=True)  # session in whose frame `measuring` measures; default: their mean

    def sample(self) -> CalibrationProblem:
        """Return rows that suffice to register frames: all of them, or the first of several blocks."""
        raise NotImplementedError

    def identify(self, patterns: Iterable[str]) -> Self:
        """Return the same problem with the parameters identified that match one of the patterns, and no others.

        Patterns are names with ``*``, ``?`` and ``[...]`` as for file names, or ``"auto"``: the geometry of all links,
        Hayati's beta between nearly parallel axes, and the frames that the measurements identify. InputError for a
        pattern without a match.
        """
        p = self.parameters
        return self.with_parameters(p.identify(identifiable(patterns, self.robot, p, self.sample().data)))

    def _short(self) -> str:
        names = ", ".join(f"'{robot.name}'" for robot in self.arms.values())
        return f"of {names}: {self.sample().data._short()}, {counted(len(self.parameters.free), 'parameter')}"

    def _frame_rows(self) -> list[dict[str, Any]]:
        return self.parameters.free._frame_rows()

    @property
    def arms(self) -> Mapping[str, Robot]:
        """The nominal robots by name; ``""`` for the only one."""
        if isinstance(self.robots, Robot):
            return {"": self.robots}
        return self.robots

    @property
    def robot(self) -> Robot:
        """The nominal robot; InputError where there are several."""
        if isinstance(self.robots, Robot):
            return self.robots
        names = ", ".join(self.robots)
        raise InputError(
            "robot", f"{len(self.robots)} in one problem ({names})", f"one: problem.alone('{min(self.robots)}')"
        )

    def with_parameters(self, parameters: Parameters) -> Self:
        """Return the same problem with another table of parameters."""
        return replace(self, parameters=parameters)

    def identifying(self, identified: np.ndarray) -> Self:
        """Return the same problem with other parameters identified, (P,) true or false."""
        return replace(self, parameters=replace(self.parameters, identified=identified))

    def with_repeatability(self, repeatability: Repeatability | None) -> Self:
        """Return the same problem with another repeatability of the robot, or none."""
        return replace(self, repeatability=repeatability)

    def with_model(self, model: Model, identify: Iterable[str] = ("*",)) -> Self:
        """Return the same problem with the terms of a model added to the arm.

        ``identify`` are patterns of the terms' parameters that are identified in addition; all of them by default.
        Functions that read blocks have to read the columns of the terms. InputError for a name that the problem has, a
        pattern that matches none of the new parameters, and data without a column that an identified term needs.

        >>> import rpim_opt as ro
        >>> wave = ro.robot.Term(lambda joint, size: size * joint.q**2, {"bow_mrad": 0.1})
        >>> problem = ro.load("position").problem.with_model(ro.Model([wave]), identify=["bow[23]"])
        >>> problem.parameters.free.names[-2:], problem.parameters.names[-1]
        (('bow2', 'bow3'), 'bow6')
        """
        robot = replace(self.robot, model=Model((*self.robot.model.terms, *model.terms)))
        p = self.parameters
        whole = with_terms(p, model, robot.joint_types)
        added = np.arange(len(whole)) >= len(p)
        if added.any():
            added[len(p) :] = whole.take(np.flatnonzero(added)).identify(identify).identified
        return replace(self, robots=robot, parameters=replace(whole, identified=whole.identified | added))

    def with_transmission(self, curves: Sequence[Curve]) -> Self:
        """Return the problem with the transmission errors of joints (or none), without its previous repeatability."""
        own = [term for term in self.robot.model.terms if not isinstance(term.made_of, Curve)]
        former = {name for curve in self.robot.model.curves for name in transmission(curve).names(curve.joint)}
        p = self.parameters.take(np.flatnonzero([name not in former for name in self.parameters.names]))
        bare = replace(self, robots=replace(self.robot, model=Model(own)), parameters=p, repeatability=None)
        return bare.with_model(Model([transmission(curve) for curve in curves]))

    def frozen(self) -> Self:
        """Return a copy that evaluates every measurement model once, now, and keeps the result.

        A script's measurement type may depend on a variable, an attribute or a file, and `residual` and others evaluate
        it at every call. A calibration has to use the same function from the first iteration to the last.
        """
        if self.frozen_functions is not None:
            return self
        copy = replace(self, frozen_functions={})
        for block in copy.sample().data.blocks:
            copy.sample().functions(block)
        return copy


@dataclass(frozen=True, eq=False, repr=False)
class CalibrationProblem(RobotModel):
    """Measurements, the nominal robot (several by name, see `together`), and the parameters that explain them.

    The unknowns x (n,) are the deviations [SI] of the identified parameters from nominal. Equations have the order of
    the data's blocks. ``frozen_functions`` are those that `frozen` keeps, None if calls evaluate the measurement
    models; ``repeatability`` is the robot's, None for the instrument's noise alone. InputError if nothing is
    identified, or the data do not fit the robot or the parameters.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> problem = instance.problem
    >>> nominal = np.zeros(len(problem.parameters.free))
    >>> problem.residual(nominal).shape, problem.modelled(nominal)[0].shape, problem.jacobian(nominal).shape
    ((27,), (9, 3), (27, 26))
    >>> [round(float(1e3 * p.errors(nominal).mean()), 3) for p in (problem, problem.on(instance.validation))]  # [mm]
    [2.096, 2.649]
    """

    data: Dataset
    _structures: dict[Block, Structure] = field(default_factory=dict, init=False, repr=False)
    _arguments: dict[Block, Array] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.parameters.identified.any():
            raise InputError("key identify", "no parameter", "at least one")
        for block in self.data.blocks:
            if block.robot not in self.arms:
                found = f"rows of robot '{block.robot}'" if block.robot else "rows that name no robot"
                raise InputError("data", found, f"Dataset.of_robots of {choices(block.robot, self.arms)}")
            dof = self.arms[block.robot].dof
            if block.q.shape[2] != dof:
                raise InputError("q", f"{block.q.shape[2]} columns", f"{dof}, one per joint")
            names = self.parameters.of_robot(block.robot).names
            for marker in block.markers:
                if tool_prefix(marker) + "x" not in names:
                    known = sorted({n.split("_")[1] for n in names if n.startswith("tool_") and n.count("_") == 2})
                    found = f"'{marker}'" if marker else "no name of a reflector"
                    of_one = "no names of reflectors: the parameters have one, tool_x to tool_rz"
                    accepted = f"a reflector of {choices(marker, known)}" if known else of_one
                    raise InputError("column marker", found, accepted)
            for name in block.measurement.parameters:
                if of_fixture(name, block.fixture) not in names:
                    where = f"measurement {block.measurement.name}"
                    raise InputError(where, f"no parameter '{of_fixture(name, block.fixture)}'", "a model with it")
        for name, robot in self.arms.items():
            own = [block for block in self.data.blocks if block.robot == name]
            if own:
                require_loads(robot, self.parameters.of_robot(name), own)

    def alone(self, robot: str) -> CalibrationProblem:
        """Return the problem of one of several robots: its parameters, under their own names, and its rows."""
        arm = pick(self.arms, robot, "robot")
        if not robot:
            return self
        p = self.parameters.of_robot(robot)
        others = set(p.terms) - set(arm.model.names(arm.joint_types))  # shared by other robots
        own = np.flatnonzero([name not in others for name in p.names])
        repeatability = self.repeatability
        if repeatability is not None and repeatability.at is not None:
            repeatability = replace(repeatability, at=repeatability.at[self.parameters.places_of(robot)[own]])
        return CalibrationProblem(arm, p.take(own), self.data.of_robot(robot), repeatability=repeatability)

    @property
    def joint_values(self) -> Array:
        """Joint values of the model at every row's first point, (N, dof) [rad or m]; zero for joints that it lacks."""
        values = np.zeros((len(self.data.label), max(len(arm.mdh) for arm in self.arms.values())))
        for block in self.data.blocks:
            M = self.arms[block.robot].joint_map
            values[block.row, : len(M)] = block.q[:, 0] @ M.T
        return values

    def on(self, data: Dataset) -> CalibrationProblem:
        """Return the same problem with other measurements.

        InputError if data and parameters do not fit, or if compliances have measured torques only here.
        """
        if not isinstance(data, Dataset):
            raise InputError("data", f"a {type(data).__name__}", "a Dataset, as of Dataset.of(q, y, sigma)")
        here, there = ({block.robot for block in each.blocks} for each in (self.data, data))
        for name in here & there:
            measured = measured_torques(self.data, name), measured_torques(data, name)
            require_same_torques(self.arms[name], self.parameters.of_robot(name), *measured)
        return replace(self, data=data)

    def measuring(
        self,
        q: Array,
        measurement: Measurement = position,
        marker: str | Sequence[str] | None = None,
        torque: Array | None = None,
        payload: float | Array | None = None,
        columns: Mapping[str, Any] = MappingProxyType({}),
        robot: str = "",
        covariance: float | Array = 1.0,
    ) -> CalibrationProblem:
        """Return the same problem with a reflector measured at joint values q (N, dof) [rad or m], all values zero.

        The reflector is by default that of the first row, or one per row (N,); ``robot`` is one of several. ``torque``
        (N, dof) [Nm], ``payload`` [kg] and further ``columns`` by name [SI], a number or (N,), are the loads and
        conditions. If the data state directions of approach, the column "approach" (N, dof) has -1, 0 or 1, by default
        0, the middle of the backlash. ``covariance`` is as for `Dataset.of`.
        """
        arm = self.alone(robot)
        q = np.atleast_2d(np.asarray(q, dtype=float))
        N = len(q)
        turning = [dimension == "angle" for dimension in arm.robot.joint_dimensions]
        if q.ndim != 2:
            accepted = f"(N, {len(turning)}), one row per configuration: q[:, 0] for a block with q (N, points, dof)"
            raise InputError("q", f"shape {q.shape}", accepted)
        if q.shape[-1] == len(turning) and np.abs(q[:, turning]).max(initial=0.0) > MOST_TURNS * 2 * np.pi:
            found = f"{np.abs(q[:, turning]).max():.6g} rad"
            raise InputError("q", found, f"at most {MOST_TURNS} turns: are these degrees? Use np.radians(q)")
        if payload is not None:
            require_known_masses(arm.robot, arm.parameters, arm.data, np.asarray(payload, dtype=float))
        y = np.zeros((N, len(measurement.columns)))
        y[:, [name == "qw" for name in measurement.columns]] = 1.0
        stated = {name: np.asarray(values, dtype=float) for name, values in columns.items()}
        approach = np.broadcast_to(stated.pop("approach", 0.0), q.shape)
        of_rows = () if marker is None or isinstance(marker, str) else marker
        data = Dataset.of(
            q, y, covariance, measurement=measurement, marker=of_rows,
            torque=None if torque is None else np.reshape(np.asarray(torque, dtype=float), (N, -1)),
            approach=None if all(block.approach is None for block in self.data.blocks) else approach,
            payload=None if payload is None else np.broadcast_to(np.asarray(payload, dtype=float), N),
            columns={name: np.broadcast_to(values, N) for name, values in stated.items()},
            session=[self.session] * N if self.session else (),
        )  # fmt: skip
        first = self.data.blocks[0]
        own = first.markers[:1] if marker is None else (str(marker),)
        fixture = first.fixture if measurement is first.measurement else ""
        blocks = (replace(each, markers=each.markers if len(of_rows) else own) for each in data.blocks)
        return self.on(replace(data, blocks=tuple(replace(each, fixture=fixture, robot=robot) for each in blocks)))

    def without(self, labels: Collection[str]) -> CalibrationProblem:
        """Return the same problem without the rows of these labels."""
        return self.on(self.data.without(labels))

    def sample(self) -> CalibrationProblem:
        """Return rows that suffice to register frames: here all of them."""
        return self

    def rows(self) -> Iterator[CalibrationProblem]:
        """Yield problems that together have all the rows: this one; for measurements in blocks, one per block."""
        yield self

    @property
    def labels(self) -> tuple[str, ...]:
        """N labels of the rows."""
        return self.data.label

    # Arguments and results of the functions of a row

    def functions(self, block: Block) -> Functions:
        """Return the functions of a block's rows."""
        if block not in self._structures:
            p = self.parameters
            absent = (p.nominal == 0) & ~p.identified
            robot = self.arms[block.robot]
            names = p.names
            if block.robot:  # other robots' parameters keep their long names, which no formulation uses
                visible = set(p.places_of(block.robot).tolist())
                names = tuple(own_name(name) if i in visible else f".{name}" for i, name in enumerate(names))
            loads = loads_of(robot, needed(robot, p.of_robot(block.robot)), self.data, block)
            self._structures[block] = Structure(
                robot.joint_types, names, p.identified.tobytes(), absent.tobytes(), block.markers, block.fixture, loads,
                tuple(robot.model.terms), len(self.arms) > 1, self._sessions[block.robot],
            )  # fmt: skip
        kept = {} if self.frozen_functions is None else self.frozen_functions
        return row_functions(self._structures[block], block.measurement, kept)

    @cached_property
    def _sessions(self) -> dict[str, tuple[str, ...]]:
        """The prefixes of the sessions of every robot that shift anything."""
        p = self.parameters
        present = p.take(np.flatnonzero(p.identified | (p.nominal != 0)))
        return {
            robot: tuple(dict.fromkeys(frame_of(name) for name in present.of_robot(robot).names if of_session(name)))
            for robot in self.arms
        }

    def _evaluated(self, block: Block, what: str, x: Array) -> list[Array]:
        """Return the results of one of the functions for rows of a block at x (n,), (N, ...) each."""
        if block not in self._arguments:
            prefixes = self._sessions[block.robot]
            own = np.array([session_prefix(name) for name in block.session_names], dtype=object) if prefixes else None
            shifted = [(own == prefix).astype(float)[:, None] for prefix in prefixes]
            self._arguments[block] = np.hstack([*loads_in(self.arms[block.robot], block), *shifted, block.y])
        function = self.functions(block)[what]
        return call_rows(function, [x, self.parameters.nominal], self._arguments[block])

    def _values(self, block: Block, what: str, x: Array) -> Array:
        return self._evaluated(block, what, x)[0][:, 0]

    def modelled(self, x: Array) -> list[Array]:
        """Return the modelled values at the deviations x (n,) [SI], block by block, (N, c) [SI]."""
        return [self._values(block, "modelled", x) for block in self.data.blocks]

    def residual(self, x: Array) -> Array:
        """Return measured minus modelled at the deviations x (n,) [SI], (m,) [SI]."""
        residual = self._uncentred(x)
        if self.touches is not None:
            residual, _ = self.touches.centred(residual, np.zeros((len(residual), 0)))
        return residual

    def _uncentred(self, x: Array) -> Array:
        """Return the residual (m,) with touched points at the origin."""
        return np.concatenate([self._values(block, "residual", x).ravel() for block in self.data.blocks])

    def slopes(self, x: Array, centred: bool = True) -> tuple[Array, Array]:
        """Return residual (m,) and Jacobian (m, n) at x (n,) [SI]; touched points at the origin if not centred."""
        both = [self._evaluated(block, "jacobian", x) for block in self.data.blocks]
        residual = np.concatenate([r.ravel() for r, _ in both])
        jacobian = np.concatenate([J.reshape(-1, len(x)) for _, J in both])
        if self.touches is None or not centred:
            return residual, jacobian
        return self.touches.centred(residual, jacobian)

    def jacobian(self, x: Array) -> Array:
        """Return the identification Jacobian of the modelled values at x (n,), -d residual / dx, (m, n) [SI]."""
        return self.slopes(x)[1]

    # Errors

    def errors(self, x: Array, dimension: str = "length") -> Array:
        """Return the norm of every row's residual at x (n,) [SI], (N,) [m]: for positions and poses the position error.

        ``dimension`` is ``"length"``, or ``"angle"`` for the norm of angles [rad], of poses the orientation error. Rows
        without such components get NaN. ``"pixel"`` is the image error of cameras [px]; their length is the distance
        between point and line of sight. The length of a touch is its distance from the mean of its point's touches, NaN
        for a single touch. ``"stated length"`` and ``"stated angle"`` refer to known dimensions of touched objects.
        InputError for another dimension.
        """
        if not isinstance(dimension, str) or dimension.removeprefix("stated ") not in ("length", "angle", "pixel"):
            raise InputError("dimension", f"{dimension!r}"[:40], "length, angle, pixel, stated length or stated angle")
        errors = np.full(len(self.data), np.nan)
        whole = self.residual(x)
        for block, index in zip(self.data.blocks, equation_numbers(self.data), strict=True):
            residual = whole[index]
            dimensions = list(block.measurement.components.values())
            if dimension != "pixel":
                dimensions = error_dimensions(block)
                if block.measurement.metres is not None:
                    residual = residual * self._values(block, "metres", x)
            of = [i for i, d in enumerate(dimensions) if d == dimension]
            if of:
                errors[block.row] = np.sqrt(np.sum(residual[:, of] ** 2, axis=1))
        for index in self.touches.rows if self.touches else ():
            if len(index) == 1:  # any robot satisfies it
                errors[self._equations.row[index[0]]] = np.nan
        return errors

    def whitened_errors(self, x: Array) -> tuple[Array, np.ndarray]:
        """Return the whitened norm of every row's residual at x (n,), (N,), and how many equations each has (N,)."""
        norms = np.zeros(len(self.data))
        count = np.zeros(len(self.data), dtype=int)
        residual = self.residual(x)
        for block, index, V in zip(self.data.blocks, equation_numbers(self.data), self.covariances(), strict=True):
            norms[block.row] = np.linalg.norm((_inverse_root(V) @ residual[index][:, :, None])[:, :, 0], axis=1)
            count[block.row] = index.shape[1]
        return norms, count

    def configuration_errors(self, x: Array) -> tuple[Array, np.ndarray]:
        """Return the whitened norms (C,) of configurations' residuals at x (n,), and how many equations each has."""
        which = np.unique(self.groups, return_inverse=True)[1]
        return np.sqrt(np.bincount(which, self.whitened_residual(x) ** 2)), np.bincount(which)

    def whitened_residual(self, x: Array) -> Array:
        """Return the residual at x (n,) [SI] in units of its noise, (m,), in the order of `linearize`'s equations."""
        return self.whitened(self.contrasts(self.residual(x)[:, None]))[:, 0]

    # Linearization

    def linearize(self, x: Array, reweigh: Reweigh | None = None) -> LinearModel:
        """Return the whitened, scaled linear model around x (n,) [SI], its equations weighed by ``reweigh``, if any."""
        scale = self.parameters.free.scale
        residual, jacobian = self.slopes(x)
        both = np.asfortranarray(self.whitened(self.contrasts(np.column_stack([jacobian * scale, residual]))))
        A = both[:, :-1]
        z = x / scale
        kinds = [block.measurement for block in self.data.blocks]
        constrained = any(not kind.columns and not kind.touching for kind in kinds)
        model = LinearModel(A, both[:, -1] + A @ z, self.groups, self.identified, constrained)
        if reweigh is None:
            return model
        weighed, offset = reweigh(model, z)
        return replace(weighed, offset=offset)

    @cached_property
    def identified(self) -> Identified:
        """The identified parameters, with the problem of one row of each kind, which predicts positions."""
        few = replace(self, data=self.data.take([int(block.row[0]) for block in self.data.blocks]))
        table = {each.name: getattr(self.parameters.free, each.name) for each in fields(Parameters)}
        return Identified(**table, problem=few)

    @cached_property
    def _equations(self) -> Equations:
        return Equations.of(self.data)

    @cached_property
    def groups(self) -> np.ndarray:
        """Number of the configuration that every equation belongs to, (m,)."""
        return np.asarray(self.data.configuration[self.owners])

    @cached_property
    def equations(self) -> Equations:
        """The equations of `linearize`, (m,): without those that place the touched points."""
        if self.touches is None:
            return self._equations
        return Equations(*(each[self.touches.kept] for each in self._equations))

    @property
    def owners(self) -> np.ndarray:
        """Number of the row that every equation of `linearize` belongs to, (m,)."""
        return self.equations.row

    # Touched points and planes

    @cached_property
    def touches(self) -> Touches | None:
        """Unmeasured points and planes that rows touched, located by the nominal robot; None where there are none."""
        found = Touches.of(self.data)
        if found is None:
            return None
        nominal = self._uncentred(np.zeros(len(self.parameters.free)))
        return replace(found, where=[each.level for each in found.located(nominal)], spread=found.size(nominal))

    @property
    def touched(self) -> Features:
        """Touched points and planes in the base frame, located by the nominal robot."""
        return () if self.touches is None else self.touches.where

    def contrasts(self, values: Array) -> Array:
        """Return values (m, c) of the equations with the touched points eliminated, (k, c).

        They are what `linearize` whitens, in its order; without touches, the values themselves.
        """
        if self.touches is None:
            return values
        return self.touches.contrasts(values)

    # Noise

    def whitened(self, values: Array) -> Array:
        """Return values (m, c) of the equations in units of their noise."""
        whitened = np.empty_like(values)
        for index, inverse in self._inverses:
            whitened[index] = inverse @ values[index]
        return whitened

    @cached_property
    def _inverses(self) -> list[tuple[np.ndarray, Array]]:
        """The numbers (N, k) of equations that share noise, and L^-1 (N or 1, k, k) of its covariances L L'."""
        repeatability = self.repeatability or Repeatability()
        if self.repeatability is None and self.touches is None:  # every row by itself
            return list(zip(equation_numbers(self.data), map(_inverse_root, self.covariances()), strict=True))
        stacks = self.stacks(joints=repeatability.joint > 0, at=repeatability.at)
        return [(stack.index, _inverse_root(stack.covariance(repeatability))) for stack in stacks]

    def stacks(self, joints: bool = True, at: Array | None = None) -> list[Stack]:
        """Return the equations by configuration, with the components of their noise.

        ``joints`` states whether derivatives by the joints' angles are included; they are taken at values ``at`` (P,)
        of all parameters [SI], None for nominal.
        """
        stacks = self._stacked(self._equations.grouped(self.data.configuration[self._equations.row]), joints, at)
        if self.touches is None:
            return stacks
        return contrasted(self.touches, stacks, stops(self.data.q)[self._equations.row])

    def _stacked(self, groups: Iterable[np.ndarray], joints: bool, at: Array | None) -> list[Stack]:
        """Return groups of equations (N, k) with the components of their noise; arguments as for `stacks`."""
        slopes = self.joint_slopes(at) if joints else None
        shifts = self.place_slopes(at) if self._shared_place else None
        return [self._equations.stack(index, slopes, shifts) for index in groups]

    @cached_property
    def _shared_place(self) -> bool:
        """Whether readings share an error in position: several of a configuration, or a camera's view."""
        if any(block.measurement.metres is not None for block in self.data.blocks):
            return True
        return self.touches is None and len(np.unique(self.data.configuration)) < len(self.data)

    def place_slopes(self, at: Array | None = None) -> Array:
        """Return derivatives (m, 3) of modelled values by the robot's place [SI], at all parameters' values ``at``."""
        places = {name: SHIFTED.index(own_name(name)) for name in self.parameters.names if own_name(name) in SHIFTED}
        return self._slopes_by(places, len(SHIFTED), at)

    def common_errors(self) -> Array:
        """Return the effects (m, c) [SI] of one standard deviation of joints, and of the place if readings share it."""
        known = self.repeatability
        if known is None:
            return np.zeros((len(self._equations.row), 0))
        place = [known.position * self.place_slopes(known.at)] * self._shared_place
        return np.hstack([known.joint * self.joint_slopes(known.at), *place])

    def covariances(self, reading: bool = True) -> list[Array]:
        """Return the covariance of every row's residual, block by block, (N, k, k) or (1, k, k) for all [SI].

        With ``reading``, of a reading; otherwise without the instrument's part, of the robot's repeatability alone.
        """
        repeatability = self.repeatability
        if repeatability is None:
            covariances = [block.covariance * reading for block in self.data.blocks]
        else:
            stacks = self._stacked(equation_numbers(self.data), repeatability.joint > 0, repeatability.at)
            covariances = [stack.covariance(repeatability, reading) for stack in stacks]
        if self.touches is None:
            return covariances
        return of_rows(self.touches, self.data, covariances, reading)

    def _slopes_by(self, columns: Mapping[str, int], width: int, at: Array | None) -> Array:
        """Return derivatives (m, width) of modelled values by parameters, summed in the ``columns`` of these by name.

        They are taken at values ``at`` (P,) of all parameters [SI]; None for nominal.
        """
        p = self.parameters
        chosen = np.array([name in columns for name in p.names])
        slopes = np.zeros((len(self._equations.row), width))
        if chosen.any():
            alone = replace(p, nominal=p.nominal if at is None else at, identified=chosen)
            J = self.with_parameters(alone).slopes(np.zeros(int(chosen.sum())), centred=False)[1]
            np.add.at(slopes.T, [columns[name] for name in p.names if name in columns], J.T)
        return slopes

    def joint_slopes(self, at: Array | None = None, sliding: bool = False) -> Array:
        """Return derivatives (m, dof) of modelled values by joint angles [SI]; by strokes zero, unless ``sliding``.

        They are taken at values ``at`` (P,) of all parameters [SI]; None for nominal.
        """
        joints = {}
        for name, robot in self.arms.items():
            for i, (kind, zero) in enumerate(zip(robot.joint_types, robot.zeros, strict=True)):
                if kind == "revolute" or sliding:
                    joints |= {zero: i, f"{name}.{zero}": i}
        # a joint number of several robots: each row has derivatives by its own robot's
        return self._slopes_by(joints, max(len(robot.mdh) for robot in self.arms.values()), at)


@dataclass(frozen=True, eq=False, repr=False)
class Identified(Parameters):
    """The n identified parameters of a linear model, with the problem that positions are predicted from.

    Positions are linearized about the deviations ``at`` (n,) [SI], or nominal; if a region is requested, they are those
    of the configurations that move farthest there.
    """

    problem: CalibrationProblem | None = None
    at: Array | None = None


def around(model: LinearModel, x: Array | None) -> LinearModel:
    """Return a model that predicts positions linearly about x (n,) [SI]."""
    if x is None or not isinstance(model.parameters, Identified):
        return model
    return replace(model, parameters=replace(model.parameters, at=x))


def error_dimensions(block: Block) -> list[str]:
    """Return the dimensions of a block's residual, by component, as errors count: ``length``, ``angle``, ``stated``."""
    dimensions = list(block.measurement.components.values())
    if block.measurement.metres is not None:
        return ["length"] * len(dimensions)
    if block.point is not None and not block.measurement.touching:
        return ["stated " + dimension for dimension in dimensions]
    return dimensions


def _inverse_root(covariance: Array) -> Array:
    """Return L^-1 of covariances L L'."""
    if not np.isfinite(covariance).all():
        raise InputError("covariance", "values that are not finite", "variances in m^2 or rad^2")
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), dtype=float)
    except np.linalg.LinAlgError:
        raise InputError("covariance", "a matrix that is not positive definite", "one that is") from None


def near_parallel(robot: Robot) -> tuple[str, ...]:
    """Return the Hayati parameters that a robot needs: ``beta{i}`` if the axes of joints i and i+1 are near parallel.

    Parallel axes, of rotation or translation, have no unique common normal: a small tilt then changes d and theta
    without bound, while a rotation about y after joint i describes it (Hayati 1983). None if the origins of a URDF's
    joints are identified.
    """
    if row_origins(robot.model.terms):
        return ()
    parallel = np.abs(np.sin(robot.mdh[1:, 0])) < np.sin(NEAR_PARALLEL)
    return tuple(f"beta{i}" for i in np.flatnonzero(parallel) + 1)


def identifiable(patterns: Iterable[str], robot: Robot, parameters: Parameters, data: Dataset) -> Iterable[str]:
    """Return patterns of parameters; ``"auto"``: geometry, beta where it is needed, frames, own parameters of types."""
    if patterns != "auto":
        return patterns
    kinds = [block.measurement for block in data.blocks]
    own = {
        of_fixture(name, block.fixture)
        for block in data.blocks
        for name in block.measurement.parameters
        if not (block.measurement.by_camera and name.startswith("board_"))  # the size of a board is that in its file
    }
    geometry = re.compile(f"{ORIGIN}.*" if row_origins(robot.model.terms) else r"(alpha|a|d|theta)\d+")
    tools = re.compile(r"tool_.*" if any(kind.turning for kind in kinds) else r"tool_(.*_)?[xyz]")
    names = [name for name in parameters.names if geometry.fullmatch(name)]
    names += near_parallel(robot)
    frames = [name for name in parameters.names if name.startswith("base_") or tools.fullmatch(name)]
    # distances do not depend on the base, and a fixture is located relative to it; for a user's type its effect decides
    if not any(kind.registers or kind.points > 1 or kind.start or kind.touching for kind in kinds):
        problem = CalibrationProblem(robot, parameters.identify(["base_*", "tool_*"]), data)
        slopes = np.abs(problem.linearize(np.zeros(len(problem.parameters.free))).A).max(axis=0)
        frames = np.array(problem.parameters.free.names)[slopes > RANK_TOLERANCE * slopes.max()].tolist()
    elif not any(kind.registers for kind in kinds):
        frames = [name for name in frames if not name.startswith("base_")]
    return names + frames + [name for name in parameters.names if name in own]
