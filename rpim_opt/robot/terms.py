"""Terms: motions of an arm in addition to its joint values, as functions of its state and named parameters."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from typing import Any, Literal, NamedTuple

import casadi as ca

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import DISPLAY, SMALLEST, UNITS, number, split_unit

Symbol = Any  # ca.SX or a number: CasADi ships no types
SYMBOLS = threading.RLock()
"""CasADi counts its symbols without a lock; reentrant, since a user's function may itself evaluate a problem."""
Place = Literal["joint", "link", "base", "tool"]
_STEM = re.compile(r"(?!base_|tool_)[A-Za-z](\w*[A-Za-z_])?(\{\}\w+)?")
_FRAME = re.compile(r"\w*_r[xyz]")
SIZES: dict[Place, int] = {"joint": 1, "link": 6, "base": 6, "tool": 6}  # how many numbers a term returns
ENDS = ("base", "tool")  # places that exist once in an arm: their parameters have no number
EXPECTED_WAVE = 1e-5  # prior scale of one harmonic of a transmission error before it is estimated [rad]
SOMEWHERE, ROUNDING = 0.5, 1e-12
"""Value [SI] of a term's inputs where its motion is evaluated with all parameters zero, and the tolerance of zero."""
MOMENT_SCALE = 1e-4  # prior standard deviation of a joint's deflection by one component of a link's first moment [rad]


# What a term sees


@dataclass(eq=False)
class Weight:
    """Placeholder for gravity whose quantities are all one symbol; `extensions.Statics` is the real one."""

    payload: Symbol = 0.0  # mass at the flange [kg]

    def torque(self, i: int) -> Symbol:
        """Return the torque of gravity about joint i [Nm]."""
        return self.payload

    def moment(self, i: int, k: int, axis: str) -> Symbol:
        """Return z_i . (R_k e_a x g_hat), without unit."""
        return self.payload

    def down(self, k: int) -> Symbol:
        """Return where gravity points in the frame after joint k, a unit vector (3, 1)."""
        return ca.vertcat(self.payload, self.payload, self.payload)


@dataclass(frozen=True, eq=False)
class Configuration:
    """State of an arm in one configuration."""

    q: Sequence[Symbol]  # joint values of the model [rad or m]
    torque: Sequence[Symbol] | None = None  # measured [Nm]; None: those of gravity are used
    approach: Sequence[Symbol] | None = None  # directions of the last movement, -1, 0 or +1; None if unknown
    weight: Weight = field(default_factory=Weight)  # gravity; none by default
    columns: Mapping[str, Symbol] = field(default_factory=dict)  # further columns of the data by name [SI]


@dataclass(frozen=True, eq=False)
class Joint:
    """Argument of a term: joint ``number`` (from 1) and its link; for the base the first, for the tool the last joint.

    >>> import rpim_opt as ro
    >>> at = ro.robot.Configuration(q=[0.1, 0.5], torque=[3.0, 7.0], approach=[-1, 1], columns={"hours": 8.0})
    >>> elbow = ro.robot.Joint(2, at)
    >>> elbow.q, elbow.every_q, elbow.torque, elbow.approach, elbow.gravity, elbow.column("hours")
    (0.5, [0.1, 0.5], 7.0, 1, 0.0, 8.0)
    """

    number: int
    configuration: Configuration

    @property
    def q(self) -> Symbol:
        """Joint value of the model [rad or m]."""
        return self.configuration.q[self.number - 1]

    @property
    def every_q(self) -> Sequence[Symbol]:
        """Joint values of all joints [rad or m]."""
        return self.configuration.q

    @property
    def torque(self) -> Symbol:
        """Measured torque [Nm] where the data have torques, that of gravity elsewhere."""
        return self.gravity if self.configuration.torque is None else self.configuration.torque[self.number - 1]

    @property
    def gravity(self) -> Symbol:
        """Torque of gravity about the joint [Nm] on the nominal arm, positive the way it turns the joint."""
        return self.configuration.weight.torque(self.number)

    @property
    def down(self) -> Symbol:
        """Where gravity points in the frame after the joint, of the nominal arm: a unit vector (3, 1)."""
        return self.configuration.weight.down(self.number)

    @property
    def payload(self) -> Symbol:
        """Mass at the flange [kg]."""
        return self.configuration.weight.payload

    @property
    def approach(self) -> Symbol:
        """Direction of the joint's last movement, -1, 0 or +1; 0 where it is not known."""
        return 0.0 if self.configuration.approach is None else self.configuration.approach[self.number - 1]

    def moment(self, k: int, axis: str) -> Symbol:
        """Return z_i . (R_k e_a x g_hat), the derivative of the torque by the first moment of link k along ``axis``."""
        return self.configuration.weight.moment(self.number, k, axis)

    def column(self, name: str) -> Symbol:
        """Return a column of the data [SI] by its name, which must be in the term's ``columns``."""
        if name not in self.configuration.columns:
            raise InputError("term", f"column '{name}'", f"columns={{'{name}': ...}} of the term, with its dimension")
        return self.configuration.columns[name]


# Terms


class Entry(NamedTuple):
    """A parameter of a term; nominal value and scale in SI."""

    name: str
    dimension: str
    scale: float
    nominal: float


@dataclass(frozen=True, eq=False)
class Term:
    """A motion of an arm in addition to its joint values.

    ``moves(joint, *parameters)`` is written in CasADi; it gets a `Joint` and the parameters in the order of ``scales``.
    For ``at="joint"`` it returns an additional joint motion [rad or m]. For ``"link"``, ``"base"`` or ``"tool"`` it
    returns six numbers x, y, z [m], rx, ry, rz [rad]: a displacement, along and about its own axes, of the frame behind
    the link, of the robot's base or of the flange. Small terms of one link add up. With all parameters zero a term must
    not move anything; it is not evaluated then.

    ``scales`` maps parameters, named with their unit, to prior scales: ``{"play_mrad": 0.1}``. Every joint or link has
    its own, ``play2``; ``{}`` in a name stands for the number. ``nominal`` are nominal values with the same keys, zero
    by default. ``joints`` are numbers (from 1) or types (``"revolute"``, ``"prismatic"``) of the joints or links that
    have the term; by default revolute joints, or all links. ``columns`` maps further columns of the data to dimensions:
    ``{"temperature": "temperature"}`` is a column ``temperature_K``, ``{"hours": ""}`` one without unit. ``made_of`` is
    set by this package for terms that can be stored as numbers: `Curve`, `chain.RowOrigins`. InputError for invalid
    names, units, scales, places and dimensions.

    >>> import casadi as ca
    >>> import rpim_opt as ro
    >>> third = ro.robot.Term(lambda joint, size: size * ca.cos(3 * joint.q), {"third_mrad": 0.1})
    >>> third.names(2), float(third.moves(ro.robot.Joint(2, ro.robot.Configuration(q=[0.0, ca.pi / 3])), 2e-4))
    (('third2',), -0.0002)
    """

    moves: Callable[..., Symbol]
    scales: Mapping[str, float]
    at: Place = "joint"
    joints: Sequence[str | int] = ()
    columns: Mapping[str, str] = field(default_factory=dict)
    nominal: Mapping[str, float] = field(default_factory=dict)
    made_of: Any = None

    def __post_init__(self) -> None:
        if self.at not in SIZES:
            raise InputError("term, at", repr(self.at), ", ".join(map(repr, SIZES)))
        require_columns(self.columns, "term")
        for entry in () if self.ready else self.entries:
            where = f"term, scales, parameter '{entry.name}'"
            if not _STEM.fullmatch(entry.name) or _FRAME.fullmatch(entry.name):
                accepted = "letters, digits and _, no digit at the end, nothing like base_, tool_ and _rx of frames"
                raise InputError(where, "a name that parameters cannot have", accepted)
            if self.at in ENDS and "{}" in entry.name:
                accepted = f"none: the {self.at} has one parameter"
                raise InputError(where, "a placeholder for the joint's number", accepted)
            if not entry.scale >= SMALLEST:
                raise InputError(where, f"a scale of {entry.scale:g}", "a number greater than zero")
        if len({entry.name for entry in self.entries}) < len(self.entries):
            raise InputError("term, scales", "one name in two units", "one of them")

    @property
    def ready(self) -> bool:
        """Whether it follows from numbers alone."""
        return self.made_of is not None

    @cached_property
    def entries(self) -> tuple[Entry, ...]:
        """The parameters, in the order in which ``moves`` takes them."""
        unknown = self.nominal.keys() - self.scales.keys()
        if unknown:
            raise InputError("term, nominal", f"'{min(unknown)}'", "a key of its scales")
        entries = []
        for key, scale in self.scales.items():
            where = f"key {key}"
            stem, unit = split_unit(key)
            if unit is None or unit.dimension not in DISPLAY:
                units = [name for name, each in UNITS.items() if each.dimension in DISPLAY]
                accepted = f"a name with one of {', '.join(units)}"
                raise InputError(f"term, scales, {where}", "no unit of the right dimension", accepted)
            nominal = number(self.nominal.get(key, 0.0), f"term, nominal, {where}")
            scale = number(scale, f"term, scales, {where}")
            entries.append(Entry(stem, unit.dimension, scale * unit.si, nominal * unit.si))
        return tuple(entries)

    @property
    def name(self) -> str:
        """The parameters' names without the joint's number."""
        return ", ".join(entry.name.partition("{}")[0] for entry in self.entries) or "without parameters"

    def names(self, i: int) -> tuple[str, ...]:
        """Return the names of joint or link i's parameters; of the base's and the tool's, which have no number."""
        return tuple(entry.name for entry in self.named(i))

    def named(self, i: int) -> list[Entry]:
        """Return the parameters of joint or link i with their names."""
        if self.at in ENDS:
            return list(self.entries)
        stems = [entry.name if "{}" in entry.name or self.ready else entry.name + "{}" for entry in self.entries]
        return [entry._replace(name=stem.format(i)) for entry, stem in zip(self.entries, stems, strict=True)]

    def places(self, joint_types: Sequence[str]) -> tuple[int, ...]:
        """Return the numbers of the joints or links with this term; the first for the base, the last for the tool."""
        if self.at in ENDS:
            return (1 if self.at == "base" else len(joint_types),)
        wanted = tuple(self.joints) or (("revolute",) if self.at == "joint" else ("revolute", "prismatic"))
        unknown = [i for i in wanted if i not in (*range(1, len(joint_types) + 1), "revolute", "prismatic")]
        if unknown:
            accepted = f"numbers from 1 to {len(joint_types)}, 'revolute' or 'prismatic'"
            raise InputError(f"term '{self.name}', joints", f"{unknown[0]!r}", accepted)
        return tuple(i for i, kind in enumerate(joint_types, start=1) if i in wanted or kind in wanted)


def require_columns(columns: Mapping[str, str], where: str) -> None:
    """Refuse columns of an unknown dimension."""
    for name, dimension in columns.items():
        if dimension not in ("", *DISPLAY):
            raise InputError(f"{where}, column {name}", repr(dimension), f"'' (no unit), {', '.join(DISPLAY)}")


def term_motion(term: Term, joint: Joint, value: Callable[[str], Symbol]) -> ca.SX | None:
    """Return the motion of a term, (1, 1) or (6, 1); None if its parameters are all zero."""
    own = [value(name) for name in term.names(joint.number)]
    # building an effect may need the whole chain: skipped without its parameter
    if own and all(each == 0 if isinstance(each, float) else ca.SX(each).is_zero() for each in own):
        return None
    try:
        moves = term.moves(joint, *own)
    except (AttributeError, TypeError, RuntimeError) as error:  # a Python `if` of a symbol raises RuntimeError
        accepted = f"moves({', '.join([term.at, *(entry.name for entry in term.entries)])}) using only what `Joint` has"
        accepted += " and functions of CasADi (ca.if_else)"
        raise InputError(f"term '{term.name}'", f"{type(error).__name__}: {error}", accepted) from error
    if isinstance(moves, list | tuple):
        moves = ca.vertcat(*moves)
    moves = ca.SX(moves)
    if moves.numel() != SIZES[term.at]:
        accepted = f"{SIZES[term.at]}, as a term of a {term.at} returns"
        raise InputError(f"term '{term.name}'", f"{moves.numel()} numbers", accepted)
    return ca.vec(moves)


def _require_still(term: Term, moves: ca.SX, symbols: ca.SX) -> None:
    """Refuse a term that moves with all its parameters zero, of which ``symbols`` are the symbols."""
    still = ca.substitute(moves, symbols, ca.SX.zeros(symbols.numel()))
    seen = ca.symvar(still)
    left = float(ca.norm_inf(ca.Function("still", seen, [still]).call([ca.DM(SOMEWHERE)] * len(seen))[0]))
    if left > ROUNDING:
        found = f"a motion of {left:.2g} rad or m with all parameters zero"
        raise InputError(f"term '{term.name}'", found, "none: its constant part belongs to the nominal robot")


class Curve(NamedTuple):
    """Where the transmission error of a joint is a Fourier series: `transmission` is the term."""

    joint: int  # from 1
    centre: float  # angle [rad] about which the series is centred
    period: float  # [rad]
    harmonics: int

    @property
    def waves(self) -> int:
        """Number of harmonics of a turn that are longer than the period."""
        return max(math.ceil(math.tau / self.period - 1e-9) - 1, 0)


@lru_cache(256)
def transmission(curve: Curve) -> Term:
    """Return the transmission error of a joint, its additional rotation [rad] as a function of its angle q.

    ::

        f(q) = sum_k c_k cos(u_k) + s_k sin(u_k)
        u_k = k (q - centre)                                                                for k <= waves
        u_k = (k - waves) 2 pi clip(q - centre, -period / 2, period / 2) / period           for harmonics more

    Parameters ``transmission{joint}_c{k}`` and ``..._s{k}``. The period exceeds the measured range, and beyond it only
    the waves continue, which are longer.

    >>> import math
    >>> import rpim_opt as ro
    >>> term = ro.robot.transmission(ro.robot.Curve(joint=2, centre=0.0, period=math.pi, harmonics=2))
    >>> term.names(2)[:3]
    ('transmission2_c1', 'transmission2_c2', 'transmission2_c3')
    >>> float(term.moves(ro.robot.Joint(2, ro.robot.Configuration(q=[0.0, 0.1])), 0, 0, 0, 0, 0, 1e-3))  # sin(4 q)
    0.00038941834...
    """
    keys = [f"transmission{{}}_{wave}{k}_rad" for wave in "cs" for k in range(1, curve.waves + curve.harmonics + 1)]
    return Term(partial(_series, curve), dict.fromkeys(keys, EXPECTED_WAVE), joints=(curve.joint,), made_of=curve)


def _series(curve: Curve, joint: Joint, *sizes: Symbol) -> Symbol:
    half = curve.period / 2
    moved = joint.q - curve.centre
    repeated = math.pi / half * ca.fmin(ca.fmax(moved, -half), half)
    angles = ca.vertcat(moved * ca.DM(range(1, curve.waves + 1)), repeated * ca.DM(range(1, curve.harmonics + 1)))
    cosines, sines = sizes[: len(sizes) // 2], sizes[len(sizes) // 2 :]
    return ca.dot(ca.vertcat(*cosines), ca.cos(angles)) + ca.dot(ca.vertcat(*sines), ca.sin(angles))


# Models


@dataclass(frozen=True, eq=False)
class Model:
    """The kinematic model of an arm: the product of its links, with user-defined terms.

    ``terms`` move joints, links, the base or the tool in addition to the built-in terms (``ratio``, ``ecc_cos``, ...,
    ``compliance``, ``backlash``, ``bend``); two parameters of one name, or one column in two dimensions, are refused.

    A tool that drifts with the column ``hours`` of the data:

    >>> import rpim_opt as ro
    >>> drift = lambda tool, rate: [0, 0, rate * tool.column("hours"), 0, 0, 0]
    >>> model = ro.Model([ro.robot.Term(drift, {"drift_mm": 0.1}, at="tool", columns={"hours": ""})])
    >>> model.columns, model.names(("revolute", "revolute"))
    ({'hours': ''}, ('drift',))
    """

    terms: Sequence[Term] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "terms", tuple(self.terms))
        own = [term for term in self.terms if not isinstance(term.made_of, Curve)]  # curves exist once per joint
        stems = [entry.name for term in own for entry in term.entries]
        for stem in stems:
            if stems.count(stem) > 1:
                raise InputError("model, terms", f"parameter '{stem}' twice", "a unique name for every parameter")
        for name, dimension in (item for term in self.terms for item in term.columns.items()):
            if self.columns[name] != dimension:
                raise InputError("model, terms", f"column '{name}' in two dimensions", "one of them")

    @cached_property
    def columns(self) -> Mapping[str, str]:
        """Further columns of the data that its terms depend on, name to dimension."""
        return {name: dimension for term in self.terms for name, dimension in term.columns.items()}

    @property
    def curves(self) -> tuple[Curve, ...]:
        """The transmission errors of joints among its terms."""
        return tuple(term.made_of for term in self.terms if isinstance(term.made_of, Curve))

    def names(self, joint_types: Sequence[str]) -> tuple[str, ...]:
        """Return the names of all its parameters on an arm with these joints."""
        return tuple(entry.name for entry in self.entries(joint_types))

    def entries(self, joint_types: Sequence[str]) -> list[Entry]:
        """Return all its parameters on an arm with these joints."""
        return [entry for term in self.terms for i in term.places(joint_types) for entry in term.named(i)]


class Dependencies(NamedTuple):
    """Inputs of terms from a row: torques, gravity, first moments of links, directions of approach, columns."""

    torques: bool = False
    gravity: bool = False
    moments: bool = False
    approach: bool = False
    columns: frozenset[str] = frozenset()


def dependencies(model: Model, joint_types: Sequence[str], used: Callable[[str], bool]) -> Dependencies:
    """Return the inputs of all terms without parameters, or with a parameter for which ``used(name)`` is true."""
    dof = len(joint_types)
    with SYMBOLS:
        q, torque, approach = (ca.SX.sym(name, dof) for name in ("q", "torque", "approach"))
        gravity = Weight(ca.SX.sym("gravity"))
        columns = {name: ca.SX.sym(name) for name in model.columns}
        moves = ca.SX(0, 1)
        for term in model.terms:
            if isinstance(term.made_of, Curve):
                continue  # depends on its own joint's angle alone, and is long to write down
            seen = {name: columns[name] for name in term.columns}
            configuration = Configuration(ca.vertsplit(q), ca.vertsplit(torque), ca.vertsplit(approach), gravity, seen)
            for i in term.places(joint_types):
                names = term.names(i)
                if not names or any(map(used, names)):
                    symbols = ca.SX.sym("symbols", len(names))
                    value = dict(zip(names, ca.vertsplit(symbols), strict=True)).__getitem__
                    more = term_motion(term, Joint(i, configuration), value)
                    if more is not None and names:
                        _require_still(term, more, symbols)
                    moves = ca.vertcat(moves, ca.SX(0, 1) if more is None else more)
        return Dependencies(
            torques=ca.depends_on(moves, torque),
            gravity=ca.depends_on(moves, gravity.payload),
            approach=ca.depends_on(moves, approach),
            columns=frozenset(name for name, symbol in columns.items() if ca.depends_on(moves, symbol)),
        )


# Terms of every arm

JOINT_TERMS = (
    Term(lambda joint, ratio: ratio * joint.q, {"ratio_ppm": 1000}, joints=("revolute", "prismatic")),
    Term(lambda joint, size: size * ca.cos(joint.q), {"ecc_cos_rad": 1e-3}),
    Term(lambda joint, size: size * ca.sin(joint.q), {"ecc_sin_rad": 1e-3}),
    Term(lambda joint, size: size * ca.cos(2 * joint.q), {"ecc2_cos_rad": 1e-4}),
    Term(lambda joint, size: size * ca.sin(2 * joint.q), {"ecc2_sin_rad": 1e-4}),
    Term(lambda joint, compliance: compliance * joint.torque, {"compliance_rad_per_Nm": 1e-5}),
    Term(lambda joint, half: half * joint.approach, {"backlash_rad": 1e-4}),
)
"""Terms of every joint; all parameters are zero in a nominal robot."""


@lru_cache
def terms_of(dof: int) -> tuple[Term, ...]:
    """Return all terms of an arm: `JOINT_TERMS`, and those of the first moments of links, ``moment{i}_{k}{axis}``."""
    moments = [
        Term(
            lambda joint, size, k=k, axis=axis: size * joint.moment(k, axis),
            {f"moment{{}}_{k}{axis}_rad": MOMENT_SCALE},
        )
        for k in range(1, dof + 1)
        for axis in "xyz"
    ]
    return (*JOINT_TERMS, *moments)
