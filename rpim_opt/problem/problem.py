"""The calibration problem: residuals, Jacobians and linearization of measurements in memory."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.text import Tabled, counted
from rpim_opt.basics.threads import phase
from rpim_opt.data.dataset import Block, Dataset, whole_configurations
from rpim_opt.data.measurements.measurement import of_fixture
from rpim_opt.problem.identified import Identified, identifiable, identified_of
from rpim_opt.problem.linear import LinearModel, Reweigh, beneath, from_triangle, reduced_models, rotated
from rpim_opt.problem.row_functions import Evaluation, Kept, measured_torques, require_loads, require_same_torques
from rpim_opt.problem.scatter import Scatter, Stack, joint_slopes, shifts, stacked
from rpim_opt.problem.touches import Things, Touches, contrasted, of_rows
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameter_names import tool_prefix
from rpim_opt.robot.parameters import Parameters, with_terms
from rpim_opt.robot.terms import Curve, Model, Transmission, transmission


@dataclass(frozen=True, eq=False, repr=False)
class CalibrationProblem(Tabled):
    """What was measured on which robot, and which parameters are to explain it.

    The unknowns x (n,) are the deviations [SI] of the identified parameters from nominal. Equations stand
    in the order of the data's blocks.

    Parameters
    ----------
    robots
        The nominal robot; or several by name, as `together` has them.
    parameters
        All parameters of the model, some of them identified.
    data
        The measurements, of one type or several.
    asked
        The functions that `frozen` keeps; None where every call asks the measurement models anew.
    scatter
        The robot's repeatability; None for the instrument's noise alone.

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
    >>> problem.labels[:2], problem.without({"T2-1"}).labels[0], problem.keeps_rows, list(problem.arms)
    (('T2-1', 'T2-2'), 'T2-2', True, [''])
    >>> [len(part.data) for part in problem.rows()], problem.sample() is problem
    ([9], True)
    >>> norms, count = problem.whitened_errors(nominal)  # 2 mm off, and 0.03 mm of noise
    >>> norms[:3].round(1), count[:3], len(problem.whitened_residual(nominal))
    (array([72.9, 68.5, 54.5]), array([3, 3, 3]), 27)
    >>> norms, count = problem.configuration_errors(nominal)
    >>> norms.shape, count[:2], problem.owners[:4], problem.groups.shape
    ((9,), array([3, 3]), array([0, 0, 0, 1]), (27,))
    >>> problem.scattered(ro.problem.Scatter(position=1e-4)).scatter.position, problem.joint_values.shape
    (0.0001, (9, 6))
    >>> problem.identifying(problem.parameters.of_frames).parameters.free.names[:2]
    ('base_x', 'base_y')
    >>> len(problem.with_parameters(problem.parameters.identify(["a?"])).parameters.free)
    6
    >>> [stack.index.shape for stack in problem.stacks()], [V.shape for V in problem.covariances()]
    ([(9, 3)], [(1, 3, 3)])
    >>> [part.shape for part in problem.slopes(nominal)], problem.contrasts(np.eye(27)).shape, problem.touches
    ([(27,), (27, 26)], (27, 27), None)
    >>> both = ro.together(left=problem, right=problem, shared=["tool_*"])
    >>> len(both.data), len(both.alone("left").data), len(ro.load("contact").problem.touched)
    (18, 9, 10)
    >>> problem.triangle(nominal, 5).A.shape
    (27, 26)
    """

    robots: Robot | Mapping[str, Robot]
    parameters: Parameters
    data: Dataset
    asked: Kept | None = field(default=None, repr=False)
    scatter: Scatter | None = None

    def identify(self, patterns: Iterable[str]) -> CalibrationProblem:
        """Return the same problem with just the parameters identified that match one of the patterns.

        Parameters
        ----------
        patterns
            Names with ``*``, ``?`` and ``[...]`` as in file names, or ``"auto"``: the geometry of all links, Hayati's
            beta between nearly parallel axes, and the frames that the measurements can tell.

        Raises
        ------
        InputError
            For a pattern that matches no parameter.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> [len(problem.identify(each).parameters.free) for each in ("auto", ["theta?", "tool_[xyz]"])]
        [34, 9]
        """
        p = self.parameters
        return self.with_parameters(p.identify(identifiable(patterns, self.robot, p, self.data)))

    def _short(self) -> str:
        names = ", ".join(f"'{robot.name}'" for robot in self.arms.values())
        return f"of {names}: {self.data._short()}, {counted(len(self.parameters.free), 'parameter')}"

    def _frame_rows(self) -> list[dict[str, Any]]:
        """Return the identified parameters."""
        return self.parameters.free._frame_rows()

    def __post_init__(self) -> None:
        p = self.parameters
        if not p.identified.any():
            raise InputError("key identify", "no parameter", "at least one")
        for block in self.data.blocks:
            if block.robot not in self.arms:
                found = f"rows of robot '{block.robot}'" if block.robot else "rows that name no robot"
                raise InputError("data", found, f"Dataset.of_robots of {choices(block.robot, self.arms)}")
            self._require_fit(block)
        for name, robot in self.arms.items():
            if name in self._present:
                require_loads(robot, p.of_robot(name), self._rows_of(name))

    def _require_fit(self, block: Block) -> None:
        """Refuse rows whose joints, reflectors or fixtures their robot does not have."""
        dof = self.arms[block.robot].dof
        if block.q.shape[2] != dof:
            raise InputError("q", f"{block.q.shape[2]} columns", f"{dof}, one a joint")
        names = self.parameters.of_robot(block.robot).names
        for marker in block.markers:
            if tool_prefix(marker) + "x" not in names:
                known = sorted({n.split("_")[1] for n in names if n.startswith("tool_") and n.count("_") == 2})
                raise InputError("column marker", f"'{marker}'", "a reflector of " + choices(marker, known))
        for name in block.measurement.parameters:
            if of_fixture(name, block.fixture) not in names:
                where = f"measurement {block.measurement.name}"
                raise InputError(where, f"no parameter '{of_fixture(name, block.fixture)}'", "a model with it")

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

    def alone(self, robot: str) -> CalibrationProblem:
        """Return the problem of one of several robots: its parameters, as itself calls them, and its rows."""
        if robot not in self.arms:
            raise InputError("robot", f"'{robot}'", choices(robot, self.arms))
        if not robot:
            return self
        scatter = self.scatter
        if scatter is not None and scatter.at is not None:
            scatter = replace(scatter, at=scatter.at[self.parameters.places_of(robot)])
        data = self.data.of_robot(robot)
        return CalibrationProblem(self.arms[robot], self.parameters.of_robot(robot), data, scatter=scatter)

    @property
    def joint_values(self) -> Array:
        """Joint values of the model at every row's first point, (N, dof) [rad or m]; zero for joints that it lacks."""
        found = np.zeros(self.data.q.shape)
        for block in self.data.blocks:
            M = self.arms[block.robot].joint_map
            found[block.row, : len(M)] = block.q[:, 0] @ M.T
        return found

    @cached_property
    def _present(self) -> frozenset[str]:
        return frozenset(block.robot for block in self.data.blocks)

    def _rows_of(self, robot: str) -> Dataset:
        if self._present == {robot}:
            return self.data
        return replace(self.data, blocks=tuple(block for block in self.data.blocks if block.robot == robot))

    def on(self, data: Dataset) -> CalibrationProblem:
        """Return the same problem with other measurements.

        Raises
        ------
        InputError
            When data and parameters do not fit, or compliances have measured torques here and not there.
        """
        theirs = {block.robot for block in data.blocks}
        for name in theirs & self._present:
            p = self.parameters.of_robot(name)
            require_same_torques(self.arms[name], p, self._rows_of(name), measured_torques(data, name))
        return replace(self, data=data)

    def with_parameters(self, parameters: Parameters) -> CalibrationProblem:
        """Return the same problem with another table of parameters."""
        return replace(self, parameters=parameters)

    def with_model(self, model: Model, identify: Iterable[str] = ("*",)) -> CalibrationProblem:
        """Return the same problem on an arm that moves by the terms of a model, too.

        Parameters
        ----------
        model
            The terms, beside those that the robot has.
        identify
            Patterns of the terms' parameters that are identified besides what is; all of them by default.

        Raises
        ------
        InputError
            For a name that the problem has, a pattern that matches none of the new ones, and data without a column
            that an identified term sees.

        Examples
        --------
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

    def with_transmission(self, curves: Sequence[Curve]) -> CalibrationProblem:
        """Return the same problem with these transmission errors of joints identified, and no others.

        The robot's scatter, which was learned without them, is left out.

        Parameters
        ----------
        curves
            One a joint; none for a robot without.
        """
        own = [term for term in self.robot.model.terms if not isinstance(term, Transmission)]
        former = {name for curve in self.robot.model.curves for name in transmission(curve).names(curve.joint)}
        p = self.parameters.take(np.array([i for i, name in enumerate(self.parameters.names) if name not in former]))
        p = replace(p, terms=tuple(name for name in p.terms if name not in former))
        robot = replace(self.robot, model=Model(own))
        bare = replace(self, robots=robot, parameters=p, scatter=None)
        if not curves:
            return bare
        return bare.with_model(Model([transmission(curve) for curve in curves]))

    def scattered(self, scatter: Scatter | None) -> CalibrationProblem:
        """Return the same problem with other noise of the robot's own, or none."""
        return replace(self, scatter=scatter)

    def identifying(self, identified: np.ndarray) -> CalibrationProblem:
        """Return the same problem with other parameters identified, (P,) true or false."""
        return self.with_parameters(replace(self.parameters, identified=identified))

    def sample(self) -> CalibrationProblem:
        """Return rows enough to place frames by: here all of them, of measurements in parts the first part."""
        return self

    def rows(self) -> Iterator[CalibrationProblem]:
        """Yield problems that together have all the rows: here this one, of measurements in parts one a part."""
        yield self

    @property
    def keeps_rows(self) -> bool:
        """Whether `linearize` returns the equations themselves, and not their triangle."""
        return True

    @property
    def labels(self) -> tuple[str, ...]:
        """N labels of the rows."""
        return self.data.label

    def without(self, labels: Collection[str]) -> CalibrationProblem:
        """Return the same problem without the rows of these labels."""
        return self.on(self.data.without(labels))

    def frozen(self) -> CalibrationProblem:
        """Return a copy that asks every measurement once, now, and keeps the answer.

        A measurement of a script may read a variable, an attribute, a file: `residual` and its like ask it anew at
        every call. Within a calibration one answer has to serve from the first pass to the last.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> reading = {"zero": 0.0}
        >>> height = ro.data.Measurement("height", lambda T: T[2, 3] + reading["zero"], {"z": "length"})
        >>> arm = ro.load("paper_arm").problem
        >>> problem = arm.on(ro.Dataset.of(arm.data.q, np.zeros((9, 1)), sigma=1e-5, measurement=height))
        >>> kept, x = problem.frozen(), np.zeros(len(arm.parameters.free))
        >>> before = problem.residual(x)
        >>> reading["zero"] = 1.0
        >>> bool(np.allclose(kept.residual(x), before)), bool(np.allclose(problem.residual(x), before - 1))
        (True, True)
        """
        if self.asked is not None:
            return self
        copy = replace(self, asked=Kept())
        for block in copy.data.blocks:
            copy._rows.functions(block)
        return copy

    @cached_property
    def _rows(self) -> Evaluation:
        return Evaluation(self.arms, self.parameters, self.data, self.asked)

    def residual(self, x: Array) -> Array:
        """Return measured minus modelled at the deviations x (n,) [SI], (m,) [SI]."""
        residual = np.concatenate([self._rows.values(block, "residual", x).ravel() for block in self.data.blocks])
        if self.touches is not None:
            residual, _ = self.touches.centred(residual, size=self._size)
        return residual

    @cached_property
    def touches(self) -> Touches | None:
        """Points and planes that rows touched and nobody measured; None where there are none."""
        return Touches.of(self.data)

    def _residuals(self, x: Array) -> Iterator[tuple[Block, Array]]:
        """Yield every block with its residual (N, c) [SI]."""
        start = 0
        residual = self.residual(x)
        for block in self.data.blocks:
            each = len(block.measurement.components)
            end = start + each * len(block.row)
            yield block, residual[start:end].reshape(-1, each)
            start = end

    def modelled(self, x: Array) -> list[Array]:
        """Return what the instrument would read at the deviations x (n,) [SI], block by block, (N, c) [SI]."""
        return [self._rows.values(block, "modelled", x) for block in self.data.blocks]

    def errors(self, x: Array, dimension: str = "length") -> Array:
        """Return the norm of every row's residual, (N,) [m]: for positions and poses the position error.

        Parameters
        ----------
        x
            (n,) deviations [SI].
        dimension
            ``"length"``, or ``"angle"`` for the norm of the angles [rad], for poses the orientation error. Rows without
            such components get NaN. ``"pixel"``: what cameras are off [px]; their length is by how much the line of
            sight passes by the point. For touches the length is the distance from the mean of their point's touches,
            NaN for the only touch of a point. ``"stated length"`` and ``"stated angle"``: of what is known of them,
            which is no measurement.

        Examples
        --------
        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("pose").problem
        >>> nominal = np.zeros(len(problem.parameters.free))
        >>> [f"{1e3 * problem.errors(nominal, dimension).mean():.2f}" for dimension in ("length", "angle")]  # mm, mrad
        ['15.00', '7.07']
        """
        errors = np.full(len(self.data), np.nan)
        for block, residual in self._residuals(x):
            dimensions = list(block.measurement.components.values())
            if dimension != "pixel":
                dimensions = error_dimensions(block)
                if block.measurement.metres is not None:
                    residual = residual * self._rows.values(block, "metres", x)
            of = [i for i, d in enumerate(dimensions) if d == dimension]
            if of:
                errors[block.row] = np.sqrt(np.sum(residual[:, of] ** 2, axis=1))
        if self.touches is not None:
            errors[self._rows.owners[self.touches.alone]] = np.nan
        return errors

    def whitened_errors(self, x: Array) -> tuple[Array, np.ndarray]:
        """Return the whitened norm of every row's residual at x (n,), (N,), and how many equations each has (N,)."""
        norms = np.zeros(len(self.data))
        count = np.zeros(len(self.data), dtype=int)
        for (block, residual), whitening in zip(self._residuals(x), self._whitening, strict=True):
            r = (whitening @ residual[:, :, None])[:, :, 0]
            norms[block.row] = np.sqrt(np.sum(r**2, axis=1))
            count[block.row] = r.shape[1]
        return norms, count

    def configuration_errors(self, x: Array) -> tuple[Array, np.ndarray]:
        """Return the whitened norms (C,) of configurations' residuals at x (n,), and how many equations each has."""
        which = np.unique(self.groups, return_inverse=True)[1]
        squares = np.bincount(which, self.whitened_residual(x) ** 2)
        return np.sqrt(squares), np.bincount(which)

    def whitened_residual(self, x: Array) -> Array:
        """Return the residual at x (n,) [SI] in units of its noise, (m,), in the order of `linearize`'s equations."""
        if self.scatter is not None or self.touches is not None:
            return self._whitened(self.contrasts(self.residual(x)[:, None]))[:, 0]
        parts = []
        for block, whitening in zip(self.data.blocks, self._whitening, strict=True):
            parts.append((whitening @ self._rows.values(block, "residual", x)[:, :, None]).ravel())
        return np.concatenate(parts)

    def jacobian(self, x: Array) -> Array:
        """Return the identification Jacobian of the modelled values at x (n,), -d residual / dx, (m, n) [SI]."""
        return self.slopes(x)[1]

    def linearize(self, x: Array, reweigh: Reweigh | None = None) -> LinearModel:
        """Return the whitened, scaled linear model around the deviations x (n,) [SI].

        Parameters
        ----------
        x
            (n,) deviations [SI].
        reweigh
            What weighs the equations by their residuals there, or None.
        """
        if self.scatter is not None or self.touches is not None:
            model = next(self._by_configurations(x, len(self.data)))
        else:
            parts = [self._block(x, i) for i in range(len(self.data.blocks))]
            A, r = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
            model = self._model(A, r + A @ (x / self.parameters.free.scale), self.groups)
        if reweigh is None:
            return model
        weighed, offset = reweigh(model, x / self.parameters.free.scale)
        return replace(weighed, offset=offset)

    def _block(self, x: Array, i: int) -> tuple[Array, Array]:
        """Return whitened, scaled A (m, n) and r (m,) of a block."""
        block = self.data.blocks[i]
        columns = np.empty((len(x) + 1, len(block.row), len(block.measurement.components)))
        self._write(x, i, slice(0, len(block.row)), columns.transpose(0, 2, 1))
        return columns[:-1].reshape(len(x), -1).T, columns[-1].ravel()

    def triangle(self, x: Array, most: int) -> LinearModel:
        """Return the model of `linearize` as its QR factor: n + 1 rows, the same |A z - b|. Arguments as for `errors`.

        Rows are evaluated where they are reduced, ``most`` together, so that memory does not grow with their number.
        """
        if self.scatter is not None or self.touches is not None:
            return reduced_models(self._by_configurations(x, most))
        R, equations, n = None, 0, len(x) + 1
        spans = [
            (i, slice(start, min(start + most, len(block.row))))
            for i, block in enumerate(self.data.blocks)
            for start in range(0, len(block.row), most)
        ]
        for i, part in spans:
            each = len(self.data.blocks[i].measurement.components)
            stacked, rows = beneath(R, n, each * (part.stop - part.start))
            self._write(x, i, part, rows.T.reshape(n, each, -1))
            equations += len(rows)
            with phase("reduction"):
                R = rotated(stacked)
        if R is None:
            raise InputError("data", "no row", "at least one")
        R[:, -1] += R[:, :-1] @ (x / self.parameters.free.scale)  # of [A r] that of [A b], b = r + A z
        return from_triangle(self._model(R[:, :-1], R[:, -1], np.zeros(n, dtype=int)), R, equations)

    def _model(self, A: Array, b: Array, group: np.ndarray) -> LinearModel:
        kinds = [block.measurement for block in self.data.blocks]
        constrained = any(not kind.columns and not kind.touching for kind in kinds)
        return LinearModel(A, b, group, self._identified, constrained)

    @cached_property
    def _identified(self) -> Identified:
        only = self.robots if isinstance(self.robots, Robot) else None
        return identified_of(only, self.parameters, self.data)

    def _write(self, x: Array, i: int, part: slice, found: Array) -> None:
        """Write the whitened, scaled [A r] of N rows of a block into ``found`` (n + 1, k, N); b = r + A z."""
        block, whitening, factors = self.data.blocks[i], self._whitening[i], self._factors[i]
        if factors is not None:
            self._rows.write(block, x, part, found, factors)
            return
        L = whitening if len(whitening) == 1 else whitening[part]
        residual, jacobian = self._rows.of(block, "jacobian", x, part)
        _weigh(L, jacobian.transpose(1, 2, 0), self.parameters.free.scale, found[:-1])
        _weigh(L, residual.transpose(2, 1, 0), np.ones(1), found[-1:])

    def _by_configurations(self, x: Array, most: int) -> Iterator[LinearModel]:
        """Yield the linear model by whole configurations, whose rows share the robot's repeatability."""
        scale = self.parameters.free.scale
        parts = [np.arange(len(self.data))]
        if len(self.data) > most:
            parts = whole_configurations(self.data, most)
        for rows in parts:
            problem = self
            if len(rows) < len(self.data):
                problem = self.on(self.data.take(rows))
            residual, jacobian = problem.slopes(x)
            both = problem._whitened(problem.contrasts(np.column_stack([jacobian * scale, residual])))
            A, r = np.ascontiguousarray(both[:, :-1]), both[:, -1]
            yield self._model(A, r + A @ (x / scale), problem.groups)

    def slopes(self, x: Array) -> tuple[Array, Array]:
        """Return residual (m,) and Jacobian (m, n) at x (n,) [SI], evaluated together."""
        both = [self._rows.of(block, "jacobian", x) for block in self.data.blocks]
        residual = np.concatenate([r.ravel() for r, _ in both])
        jacobian = np.concatenate([J.reshape(-1, len(x)) for _, J in both])
        if self.touches is None:
            return residual, jacobian
        return self.touches.centred(residual, jacobian, self._size)

    def contrasts(self, values: Array) -> Array:
        """Return what values of the rows' equations (m, c) say without the points that were touched, (k, c).

        They are what `linearize` whitens, in its order; the values themselves where no row touches a point.
        """
        if self.touches is None:
            return values
        return self.touches.contrasts(values, self.touched)

    def _whitened(self, values: Array) -> Array:
        """Return values (m, c) of the equations in units of their noise, configuration by configuration."""
        found = np.empty_like(values)
        for stack, inverse in self._inverses:
            found[stack.index] = inverse @ values[stack.index]
        return found

    @cached_property
    def _inverses(self) -> list[tuple[Stack, Array]]:
        """L^-1 of the covariances L L' of whole configurations."""
        scatter = self.scatter or Scatter()
        stacks = self.stacks(joints=scatter.joint > 0, at=scatter.at)
        return [(stack, _whitening(stack.covariance(scatter))) for stack in stacks]

    def stacks(self, joints: bool = True, at: Array | None = None) -> list[Stack]:
        """Return the equations by configuration, with what divides their noise.

        Parameters
        ----------
        joints
            Whether the slopes by the joints' angles are wanted.
        at
            (P,) values of all parameters at which they are taken [SI]; None for nominal.
        """
        slopes = joint_slopes(self._rows, at) if joints else None
        found = stacked(self.data, slopes, shifts(self._rows, at))
        if self.touches is None:
            return found
        stop = np.unique(self.data.q, axis=0, return_inverse=True)[1].ravel()
        return contrasted(self.touches, found, self.touched, stop[self._rows.owners])

    @cached_property
    def _size(self) -> float:
        """How far the nominal robot's touches spread [m]."""
        if self.touches is None:
            return 0.0
        return self.touches.size(self._untouched)

    @cached_property
    def _untouched(self) -> Array:
        """The residual (m,) of the nominal robot [SI] with touched points at the origin."""
        x = np.zeros(len(self.parameters.free))
        return np.concatenate([self._rows.values(block, "residual", x).ravel() for block in self.data.blocks])

    @cached_property
    def touched(self) -> Things:
        """Where the nominal robot puts the points and planes that were touched, in its base frame."""
        if self.touches is None:
            return ()
        return [thing.level for thing in self.touches.located(self._untouched)]

    @cached_property
    def groups(self) -> np.ndarray:
        """Number of the configuration that every equation belongs to, (m,)."""
        return np.asarray(self.data.configuration[self.owners])

    @cached_property
    def owners(self) -> np.ndarray:
        """Number of the row that every equation of `linearize` belongs to, (m,)."""
        if self.touches is None:
            return self._rows.owners
        return self._rows.owners[self.touches.kept(self.touched)]

    @cached_property
    def _whitening(self) -> list[Array]:
        """L^-1 with a row's covariance = L L', for every block."""
        if not all(np.isfinite(block.covariance).all() for block in self.data.blocks):
            raise InputError("covariance", "values that are not finite", "variances in m^2 or rad^2")
        return [_whitening(covariance) for covariance in self.covariances()]

    @cached_property
    def _factors(self) -> list[Array | None]:
        """By what the numbers of a block's residual (k,) and Jacobian (k, n) are multiplied to be whitened and scaled.

        None where that takes more: components that are correlated, or rows that are not alike.
        """
        found: list[Array | None] = []
        for whitening in self._whitening:
            diagonal = np.diagonal(whitening[0])
            factors = None
            if len(whitening) == 1 and np.count_nonzero(whitening) == len(diagonal):
                factors = np.concatenate([diagonal, np.outer(diagonal, self.parameters.free.scale).ravel()])
            found.append(factors)
        return found

    def covariances(self, reading: bool = True) -> list[Array]:
        """Return the covariance of every row's residual, block by block, (N, k, k) or (1, k, k) for all [SI].

        Parameters
        ----------
        reading
            Of a reading; otherwise without the instrument's part: the robot's own scatter.

        """
        found = self._of_rows(reading)
        if self.touches is None:
            return found
        return of_rows(self.touches, self.data, found, self.touched, reading)

    def _of_rows(self, reading: bool) -> list[Array]:
        """Return the covariances of the rows, each touch's by itself."""
        scatter = self.scatter
        if scatter is None:
            return [block.covariance * reading for block in self.data.blocks]
        slopes = joint_slopes(self._rows, scatter.at) if scatter.joint > 0 else None
        # each row as a configuration of its own
        alone = replace(self.data, configuration=np.arange(len(self.data)))
        count = len(self._rows.owners)
        found = {}
        for stack in stacked(alone, slopes, shifts(self._rows, scatter.at)):
            place = np.full(count, -1)
            place[stack.index[:, 0]] = np.arange(len(stack.index))
            found[stack.index.shape[1]] = (place, stack.covariance(scatter, reading))
        blocks = []
        begin = 0
        for block in self.data.blocks:
            k = len(block.measurement.components)
            place, covariance = found[k]
            blocks.append(covariance[place[begin + k * np.arange(len(block.row))]])
            begin += k * len(block.row)
        return blocks


def error_dimensions(block: Block) -> list[str]:
    """Return what the components of a block's residual count as in errors: ``length``, ``angle``, ``stated``."""
    dimensions = list(block.measurement.components.values())
    if block.measurement.metres is not None:
        return ["length"] * len(dimensions)
    if block.point is not None and not block.measurement.touching:
        return ["stated " + dimension for dimension in dimensions]
    return dimensions


def _whitening(covariance: Array) -> Array:
    """Return L^-1 of covariances L L'."""
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), dtype=float)
    except np.linalg.LinAlgError:
        raise InputError("covariance", "a matrix that is not positive definite", "one that is") from None


def _weigh(L: Array, values: Array, scale: Array, found: Array) -> None:
    """Write L (N or 1, k, k) times values (k, c, N) of every row times scales (c,) into ``found`` (c, k, N)."""
    nonzero = np.any(L, axis=0).tolist()
    for i, terms in enumerate(nonzero):
        first, *others = [j for j, there in enumerate(terms) if there]  # a triangle's diagonal has no zero
        np.multiply(values[first], _factors(L[:, i, first], scale), out=found[:, i])
        for j in others:
            found[:, i] += values[j] * _factors(L[:, i, j], scale)


def _factors(entries: Array, scale: Array) -> Array:
    return scale[:, None] * entries
