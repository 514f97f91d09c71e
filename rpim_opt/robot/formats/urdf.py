"""URDF: reading of a chain between two links, and writing of identified origins with all other bytes unchanged.

A URDF is untrusted input. It is parsed by expat, which reports the place of every element in the file; document types,
and with them entities and other files, are refused, as are xacro macros, which would have to be expanded first.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices, of_file
from rpim_opt.basics.files import read_bytes, write_files
from rpim_opt.basics.units import LARGEST, numeral
from rpim_opt.robot.chain import (
    MOUNT,
    ORIGIN,
    ROUNDING,
    Chain,
    Origin,
    RobotSetup,
    RowOrigins,
    corrected,
    describe,
    origin_numbers,
    origins_term,
    require_same_arm,
    spliced,
)
from rpim_opt.robot.kinematics import frame_numbers, numeric_frame, numeric_link
from rpim_opt.robot.mdh import Gravity, Robot, Vector
from rpim_opt.robot.terms import Model, Term

EXPANDED = "what ROS's command makes of it: xacro arm.urdf.xacro > arm.urdf"
DEEPEST = 100  # how deep elements may be nested
LARGEST_NUMBER = 1e6  # numbers of origins and axes are smaller [m or rad]
TURN = math.tau + 1e-3  # angles of origins [rad] are at most this: degrees usually exceed it
KINDS = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": ""}
ATTRIBUTE = re.compile(rb"([^\s=/<>\"']+)\s*=\s*(\"[^\"]*\"|'[^']*')")
TAG = re.compile(rb"<(?:[^\"'>]|\"[^\"]*\"|'[^']*')*>")  # a tag: quoted values may hold a '>'


@of_file
def read_urdf(path: str | Path, base: str | None = None, tip: str | None = None, origins: bool = False) -> RobotSetup:
    """Return the chain between two links of a URDF file as a robot in modified DH with Hayati's beta.

    ``base @ MDH chain(q) @ tool`` is the transform from link ``base`` to link ``tip``, with q the file's joint values;
    `chain.describe` states the conventions. The chain goes up from the base to the links' common ancestor, through
    reversed joints, and down to the tip: from a camera in the head to a hand, for instance. Fixed joints become part of
    base, links and tool; joint limits are taken over (none for continuous joints, and if missing or equal). Angles are
    roll, pitch, yaw, R = Rz Ry Rx; a missing axis means x (wiki.ros.org/urdf/XML/joint). Gravity points along -z of the
    chain's highest link and acts on the stated masses; no masses are used if joints move the base itself.

    ``base`` and ``tip`` name any two links; by default the root, and the only leaf below the base. InputError for
    document types and entities, links or joints that are missing, duplicate or in a cycle, values that are not finite
    numbers, floating and planar joints between base and tip, no or several candidates for base or tip.

    With ``origins``, the parameters are not those of the table but the origins of the file's joints, six numbers each:
    ``origin_{joint}_x`` to ``_rz``, for fixed joints at the chain's ends ``mount_{joint}_x``. They have the same names
    in every chain with that joint, so that `together` shares them. The table then has a first row without motion, for
    the base link: it starts in that link's own frame, and the file's first joint is number 2 in terms.

    >>> import rpim_opt as ro
    >>> arm = ro.read_urdf("arm.urdf", base="base", tip="tip")
    >>> arm.robot.dof, arm.names, arm.tool[:3]
    (1, ('j1',), array([0.4, 0. , 0. ]))
    >>> ro.read_urdf("arm.urdf", origins=True).robot.model.names(("revolute",) * 2)[:2]
    ('origin_j1_x', 'origin_j1_y')
    """
    urdf = _read(Path(path))
    way = urdf.way(base, tip)
    chain, joint_map, offsets = way.chain, way.joint_map, way.offsets
    if origins:  # a first row that no joint moves
        urdf.prefixes()
        chain = Chain(np.array([np.eye(4), *chain.origins]), np.array([[0.0, 0.0, 1.0], *chain.axes]), chain.tail)
        joint_map, offsets = (np.vstack([0 * numbers[:1], numbers]) for numbers in (joint_map, offsets))
    table, T_base, T_tool, G = describe(chain)
    T_top_base = np.linalg.inv(_product([step.constant for step in way.steps if step.up]))
    robot = Robot(
        name=urdf.name,
        mdh=table + offsets,
        joint_types=(*["revolute"] * origins, *(joint.kind for joint in way.joints)),
        joint_map=joint_map,
        limits=np.array([urdf.joints[name].limits for name in way.names]),
        source=f"{Path(path).name}, {way.steps[0].start} to {way.steps[-1].end}",
        gravity=_masses(urdf, way, table, G).mounted("floor", (T_top_base @ T_base)[:3, :3]),
        model=Model(tuple(_displacements(way, table, G)) if origins else ()),
        joint_names=(*[""] * origins, *(joint.name for joint in way.joints)),
    )
    for name, i in zip(way.names, robot.leading, strict=True):
        joint = way.joints[i - origins]
        if joint.kind != urdf.joints[name].kind:
            found = f"a mimic of joint '{name}' of another kind, which is not between base and tip"
            raise joint.error("mimic", found, "a joint of the same kind, or a joint between base and tip")
    return RobotSetup(robot, frame_numbers(T_base), frame_numbers(T_tool), way.names)


@of_file
def branching_tip(path: Path, base: str | None, tip: str | None) -> str:
    """Return a name for a chain between two links that goes up through moving joints; otherwise an empty text."""
    if path.suffix != ".urdf":
        return ""
    steps = _read(path).steps_between(base, tip)
    up = any(step.up and step.joint.kind for step in steps)
    return re.sub(r"\W", "_", f"to_{steps[-1].end}") if up else ""


@of_file
def remembered_ends(path: str | Path, robot: Robot) -> tuple[str | None, str | None]:
    """Return base and tip link of a robot, by its source as from `read_urdf`; None for both if of another file."""
    ends = re.fullmatch(r".*, (.+) to (.+)", robot.source)
    return (ends[1], ends[2]) if ends and set(ends.groups()) <= set(_read(Path(path)).links) else (None, None)


@of_file
def write_urdf(
    source: str | Path,
    robot: Robot,
    target: str | Path,
    base: str | None = None,
    tip: str | None = None,
    base_frame: Array | None = None,
    tool_frame: Array | None = None,
) -> list[str]:
    """Write a URDF file with the origins of an identified robot, every other byte as in the original.

    ``source`` is the original: its `read_urdf` with the same ``base`` and ``tip`` has to be the robot that was
    calibrated. ``robot`` has the identified parameters (`use.identified`), ``base_frame`` and ``tool_frame`` (6,) are
    identified base and tool, x, y, z [m], roll, pitch, yaw [rad]; by default the original's. Numbers read back exactly.
    Return sentences on joint values that the file counts differently from the controller, and on joint zeros.
    InputError for another robot, and for a tool or last beta if no fixed joint follows the last moving one.
    """
    urdf = _read(Path(source))
    way = urdf.way(base, tip)
    edits: dict[tuple[int, int], str] = {}
    mimics = {name: joint.element.find("mimic") for name, joint in urdf.joints.items()}
    led = {name: mimic.get("joint", "") for name, mimic in mimics.items() if mimic is not None}
    for joint, old, new in zip(way.joints, way.joint_map, robot.joint_map, strict=False):
        # a joint that mimics an independent joint, and that no joint mimics
        alone = joint.name in led and led[joint.name] not in led and joint.name not in led.values()
        if alone and not np.array_equal(old, new):
            old[old != 0] = new[old != 0]  # the multiplier; zeros stay
            edits |= joint.edits(urdf.data, "mimic", {"multiplier": repr(float(old.sum()))})
    notes = require_same_arm(robot, replace(read_urdf(source, base, tip).robot, joint_map=way.joint_map), Path(source))
    origins, tail, size = corrected(way.chain, robot.mdh - way.offsets, base_frame, tool_frame)
    before = [*way.chain.origins, way.chain.tail]
    for between, old, new in zip(way.parts, before, [*origins, tail], strict=True):
        if between:  # one origin takes the whole correction
            taker = _taker(between)
            step = between[taker]
            left = _product([each.constant for each in between[:taker]])
            right = _product([each.constant for each in between[taker + 1 :]])
            T = np.linalg.inv(left) @ new @ np.linalg.inv(right)
            edits |= step.joint.origin_edits(urdf.data, np.linalg.inv(T) if step.up else T, size)
        elif np.abs(new - old).max() > 10 * ROUNDING * size:
            at_tip = new is tail
            step = way.steps[-1 if at_tip else 0]
            what = f"a tool or beta{len(way.joints)}" if at_tip else "a base"
            found = f"{what} that moves link '{step.end if at_tip else step.start}'"
            accepted = f"a link held by a fixed joint, since joint '{step.joint.name}' cannot express it"
            raise InputError("robot", found, f"{accepted}, or no such correction")
    write_files({Path(target): spliced(urdf.data, edits)})
    return notes


@of_file
def write_origins(source: str | Path, deviations: Mapping[str, Array], target: str | Path) -> None:
    """Write a URDF file with displaced origins, every other byte as in the original.

    ``deviations`` maps the parameters' prefix, ``origin_{joint}_``, to (6,) [m, rad]: x, y, z, roll, pitch, yaw along
    and about the axes of the parent link's frame. InputError for a prefix without a joint.
    """
    urdf = _read(Path(source))
    edits: dict[tuple[int, int], str] = {}
    known = urdf.prefixes()
    for prefix, six in deviations.items():
        if prefix not in known:
            raise InputError(f"parameters {prefix}*", "no such joint", choices(prefix, known))
        T = numeric_frame(six) @ known[prefix].origin
        edits |= known[prefix].origin_edits(urdf.data, T, max(float(np.abs(T).max()), 1.0))
    write_files({Path(target): spliced(urdf.data, edits)})


# The way between two links


class _Step(NamedTuple):
    """A joint on the way between two links, passed down the tree or up, where its motion and origin are inverted."""

    joint: _Joint
    up: bool
    start: str
    end: str
    constant: np.ndarray  # its origin as a transform (4, 4): before its motion, after it if passed up


class _Way(NamedTuple):
    """The steps from one link to another, and the n joints that move."""

    steps: Sequence[_Step]
    parts: list[list[_Step]]  # rigid parts: steps before the first motion, between motions and after the last
    chain: Chain
    joints: list[_Joint]
    names: tuple[str, ...]  # of the k independent joints
    joint_map: Array  # (n, k)
    offsets: Array  # (n, 5) of theta and d: a mimic joint is at multiplier times the other's value plus offset


def _taker(part: Sequence[_Step]) -> int:
    """Return which origin of a rigid part takes its correction: of the joint after, before, or a fixed one."""
    return 0 if part and part[0].up and not part[-1].joint.kind else len(part) - 1


def _displacements(way: _Way, table: Array, G: Array) -> Iterator[Term]:
    """Yield the terms of the origins of all joints that move, and of a fixed one where an end has no other."""
    for row, part in enumerate(way.parts, start=1):
        F = numeric_link(beta=-table[row - 1, 4]) @ G[row - 1]
        taker = _taker(part)
        origins = []
        for i, step in enumerate(part):
            before, F = F, F @ step.constant
            if step.joint.kind or i == taker:
                origins.append(Origin(step.joint.prefix, F if step.up else before, step.up))
        if origins:
            yield origins_term(RowOrigins(row, tuple(origins)))


def _product(transforms: Sequence[np.ndarray]) -> Array:
    return functools.reduce(np.matmul, transforms, np.eye(4))


# Elements


class _Placed(ElementTree.Element):
    """An element that knows where it starts in the file [byte]."""

    start = 0


_Element = Any  # _Placed: the stubs of ElementTree know its base alone


class _Joint:
    """A joint element whose attributes are checked when they are needed: off the chain nothing has to be right."""

    def __init__(self, element: _Element, name: str):
        self.element = element
        self.name = name
        self.parent = self._link("parent")
        self.child = self._link("child")

    def _link(self, which: str) -> str:
        element = self._only(which)
        link = element.get("link") if element is not None else None
        if not link:
            raise self.error(which, "nothing", f'one <{which} link="...">')
        return link

    def error(self, what: str, found: str, accepted: str) -> InputError:
        """Return the error that names the joint."""
        return InputError(f"joint '{self.name}', {what}", found, accepted)

    def _only(self, tag: str) -> _Element | None:
        elements = [*self.element.findall(tag), None]
        if len(elements) > 2:
            raise self.error(tag, f"{len(elements) - 1} of them", "one")
        return elements[0]

    def _numbers(self, tag: str, attribute: str, default: str, count: int) -> Array:
        """Return the numbers of an attribute, its default where it or its element is absent."""
        element = self._only(tag)
        text = default if element is None else element.get(attribute, default)
        numbers = _numbers(text, count, LARGEST_NUMBER if count > 1 else math.inf)  # limits may be any number
        if numbers is None:
            wanted = "a finite number" if count == 1 else f"{count} finite numbers"
            if "$" in text:
                wanted += f"; {EXPANDED}"
            raise self.error(f"{tag} {attribute}", repr(text[:40]), wanted)
        return numbers

    @property
    def kind(self) -> str:
        """``"revolute"``, ``"prismatic"``, or nothing for a fixed joint."""
        kind = self.element.get("type", "")
        if kind not in KINDS:
            raise self.error("type", f"'{kind}'", f"{', '.join(KINDS)} between base and tip")
        return KINDS[kind]

    @property
    def prefix(self) -> str:
        """Of the parameters of its origin: ``origin_torso_1_joint_``, of a fixed joint ``mount_..``."""
        return f"{ORIGIN if self.kind else MOUNT}{re.sub(r'[^0-9A-Za-z]+', '_', self.name)}_"

    @property
    def mimic(self) -> tuple[str, float, float] | None:
        """The joint that it follows, the multiplier and the offset [rad or m]; None for one that moves on its own."""
        element = self._only("mimic")
        if element is None:
            return None
        multiplier = float(self._numbers("mimic", "multiplier", "1", 1)[0])
        offset = float(self._numbers("mimic", "offset", "0", 1)[0])
        if not 0 < abs(multiplier) <= LARGEST_NUMBER:
            raise self.error("mimic multiplier", f"{multiplier:g}", "a number that is not zero")
        return element.get("joint", ""), multiplier, offset

    @cached_property
    def origin(self) -> Array:
        """Transform (4, 4) from the parent's frame to the joint's; InputError for angles beyond a turn, in degrees."""
        place, angles = (self._numbers("origin", attribute, "0 0 0", 3) for attribute in ("xyz", "rpy"))
        if np.abs(angles).max() > TURN:
            found = " ".join(f"{angle:g}" for angle in angles)
            raise self.error("origin rpy", f"'{found}' (degrees?)", "radians, a turn at most")
        return numeric_frame([*place, *angles])

    @property
    def axis(self) -> Array:
        """Unit vector (3,) in the joint's frame."""
        axis = self._numbers("axis", "xyz", "1 0 0", 3)
        length = float(np.linalg.norm(axis))
        if not length > 1e-6:
            raise self.error("axis xyz", f"a vector of length {length:g}", "a unit vector")
        return axis / length

    @property
    def limits(self) -> tuple[float, float]:
        """Lower and upper joint value [rad or m]; infinite where the file leaves them out or makes them equal."""
        lower, upper = (float(self._numbers("limit", which, "0", 1)[0]) for which in ("lower", "upper"))
        if lower > upper:
            raise self.error("limit", f"{lower:g} to {upper:g}", "lower < upper")
        far = max(abs(lower), abs(upper)) > LARGEST  # some files state no limit as 1e16
        unlimited = far or lower == upper or self.element.get("type") == "continuous"
        return (-math.inf, math.inf) if unlimited else (lower, upper)

    def origin_edits(self, data: bytes, T: np.ndarray, size: float) -> dict[tuple[int, int], str]:
        """Return what to replace in the file so that the origin becomes T, by first and last byte."""
        texts = zip(("xyz", "rpy"), origin_numbers(T, self.origin, size), strict=True)
        return self.edits(data, "origin", {name: text for name, text in texts if text is not None})

    def edits(self, data: bytes, tag: str, new: dict[str, str]) -> dict[tuple[int, int], str]:
        """Return what to replace in the file so that an element has these attributes; a missing element is added."""
        element = self._only(tag)
        start = self.element.start if element is None else element.start
        end = next(TAG.finditer(data, start)).end()
        edits = {}
        for match in () if element is None else ATTRIBUTE.finditer(data, start, end):
            text = new.pop(match[1].decode(errors="replace"), None)
            if text is not None:
                edits[match.start(2) + 1, match.end(2) - 1] = text
        if new:
            place = end if element is None else start + len(f"<{tag}")
            attributes = "".join(f' {name}="{value}"' for name, value in new.items())
            edits[place, place] = f"<{tag}{attributes}/>" if element is None else attributes
        return edits


def _numbers(text: str, count: int, largest: float = LARGEST_NUMBER) -> Array | None:
    """Return the finite numbers of an attribute; None for other texts, or more or fewer of them."""
    numbers = np.array([numeral(part) for part in text.split()])
    if len(numbers) != count or not (np.abs(numbers) < largest).all():
        return None
    return numbers


@dataclass(frozen=True, eq=False)
class _Urdf:
    """A file's robot: its links and joints by name, and the joint above every link that has one."""

    data: bytes
    name: str
    links: Mapping[str, _Element]
    joints: Mapping[str, _Joint]
    above: Mapping[str, _Joint]

    def prefixes(self) -> dict[str, _Joint]:
        """Return the joints by the prefix of their origins' parameters; InputError where two have the same."""
        known: dict[str, _Joint] = {}
        for joint in self.joints.values():
            other = known.setdefault(joint.prefix, joint)
            if other is not joint:
                found = f"the parameters {joint.prefix}* of joint '{other.name}', too"
                raise joint.error("name", found, "names that differ in letters or digits")
        return known

    def steps_between(self, base: str | None, tip: str | None) -> list[_Step]:
        """Return the steps from link ``base`` to link ``tip``; by default from the root to the only leaf."""
        for link_name in (base, tip):
            if link_name is not None and link_name not in self.links:
                raise InputError(f"link '{link_name}'", "nothing", choices(link_name, self.links))
        if base is None:
            roots = [link for link in self.links if link not in self.above]
            base = _only(roots, "links without a parent", "one of them", "base")
        if tip is None:
            parents = {joint.parent for joint in self.above.values()}
            leaves = [link for link in self.links if link not in parents and link != base] or [base]
            below = [link for link in leaves if any(joint.parent == base for joint in self._to_root(link))] or leaves
            ends = f"links at the end of chains from '{base}'"
            tip = _only(below, ends, "one of them or a link before it (tool0)", "tip")
        up, down = self._to_root(base), self._to_root(tip)
        while up and down and up[-1] is down[-1]:
            up.pop()
            down.pop()
        if (up[-1].parent if up else base) != (down[-1].parent if down else tip):
            raise InputError(f"link '{tip}'", f"no chain from '{base}' to it", "links of one tree")
        upwards = [_Step(joint, True, joint.child, joint.parent, np.linalg.inv(joint.origin)) for joint in up]
        return upwards + [_Step(joint, False, joint.parent, joint.child, joint.origin) for joint in reversed(down)]

    def way(self, base: str | None, tip: str | None) -> _Way:
        steps = self.steps_between(base, tip)
        moving = [step for step in steps if step.joint.kind]
        if not moving:
            raise InputError("the chain", "no joint that moves", "a revolute, continuous or prismatic joint")
        parts: list[list[_Step]] = [[]]
        for step in steps:
            if step.up and step.joint.kind:
                parts.append([step])
                continue
            parts[-1].append(step)
            if step.joint.kind:
                parts.append([])
        *origins, tail = [_product([step.constant for step in part]) for part in parts]
        axes = [-step.joint.axis if step.up else step.joint.axis for step in moving]
        joints = [step.joint for step in moving]
        motions = [self.followed(joint) for joint in joints]
        names = tuple(dict.fromkeys(name for name, _, _ in motions))
        joint_map = np.zeros((len(joints), len(names)))
        offsets = np.zeros((len(joints), 5))
        for i, (joint, (name, multiplier, offset)) in enumerate(zip(joints, motions, strict=True)):
            joint_map[i, names.index(name)] = multiplier
            offsets[i, 2 if joint.kind == "revolute" else 3] = offset
        return _Way(steps, parts, Chain(np.array(origins), np.array(axes), tail), joints, names, joint_map, offsets)

    def _to_root(self, link: str) -> list[_Joint]:
        joints: list[_Joint] = []
        while link in self.above:
            joints.append(self.above[link])
            link = joints[-1].parent
        return joints

    def followed(self, joint: _Joint) -> tuple[str, float, float]:
        """Return the independent joint that a joint follows: its name, and multiplier and offset."""
        factor, offset = 1.0, 0.0
        seen = [joint]
        while (mimic := seen[-1].mimic) is not None:
            name, multiplier, more = mimic
            offset += factor * more
            factor *= multiplier
            if name not in self.joints:
                raise seen[-1].error("mimic", f"no joint '{name}'", choices(name, self.joints))
            if self.joints[name] in seen or not self.joints[name].kind:
                raise seen[-1].error("mimic", f"joint '{name}'", "a joint that moves, and does not follow this one")
            seen.append(self.joints[name])
        return seen[-1].name, factor, offset


def _only(links: Sequence[str], where: str, accepted: str, which: str) -> str:
    """Return the only one of links; of several one has to be named."""
    if len(links) > 1:
        accepted = f"{accepted}: --urdf-{which}, also a key in problem.toml, or ro.read_urdf(file, {which}=link)"
        raise InputError(where, ", ".join(links), accepted)
    return links[0]


def _read(path: Path) -> _Urdf:
    """Return the tree of links and joints of a file."""
    data = read_bytes(path)
    root = _root_element(data)
    if root.tag != "robot":
        raise InputError("the root element", f"<{root.tag}>", "<robot>, as in URDF")
    for element in root:
        if element.tag.startswith("xacro:"):
            raise InputError(f"element <{element.tag}>", "a xacro file", EXPANDED)
    links = _named(root.findall("link"))
    if not links:
        raise InputError("the robot", "no links", "elements <link> and <joint>")
    joints = {name: _Joint(element, name) for name, element in _named(root.findall("joint")).items()}
    above: dict[str, _Joint] = {}
    for joint in joints.values():
        for which, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in links:
                raise joint.error(which, f"no link '{link}'", choices(link, links))
        if joint.child in above:
            found = f"two parents, by joints '{above[joint.child].name}' and '{joint.name}'"
            raise InputError(f"link '{joint.child}'", found, "one")
        above[joint.child] = joint
    try:
        TopologicalSorter({child: {joint.parent} for child, joint in above.items()}).prepare()
    except CycleError as error:
        raise InputError(f"link '{error.args[1][0]}'", "a cycle of joints", "a tree") from None
    return _Urdf(data, root.get("name") or path.stem, links, joints, above)


def _named(elements: Sequence[_Element]) -> dict[str, _Element]:
    known: dict[str, _Element] = {}
    for element in elements:
        name = element.get("name", "")
        if not name or name in known:
            found = f"'{name}' twice" if name else "one without a name"
            raise InputError(f"element <{element.tag}>", found, "every one with a unique name")
        known[name] = element
    return known


def _root_element(data: bytes) -> _Element:
    top = _Placed("")
    stack = [top]

    def start(tag: str, attributes: dict[str, str]) -> None:
        if len(stack) > DEEPEST:
            raise InputError(f"element <{tag}>", f"more than {DEEPEST} levels", "a URDF")
        element = _Placed(tag, attributes)
        element.start = parser.CurrentByteIndex
        stack[-1].append(element)
        stack.append(element)

    def doctype(*_: Any) -> None:
        raise InputError("the document type", "<!DOCTYPE ...>", "a URDF without a document type and entities")

    if b"\0" in data:
        raise InputError("the file", "zero bytes, as in UTF-16", "UTF-8 text")
    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: stack.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        where = f"line {error.lineno}, column {error.offset + 1}"
        raise InputError(where, expat.errors.messages[error.code], "well-formed XML") from None
    except (LookupError, ValueError) as error:
        raise InputError("the XML declaration", str(error), "UTF-8 text") from None
    return top[0]


# Masses


def _masses(urdf: _Urdf, way: _Way, table: Array, G: Array) -> Gravity:
    """Return the mass that each row of the table carries, up to the next row, and its centre in the table's frames.

    Links off the chain and beyond its tip, such as a gripper's, count with their joints at zero; those that cannot be
    read there are left out. No masses are returned if no moving link has one, or if joints move the base itself.
    """
    if any(step.up and step.joint.kind for step in way.steps):
        return Gravity()
    first = len(table) - len(way.chain.axes)  # rows without motion
    frames = {way.steps[0].start: (first, np.eye(4))}  # row that carries a link (from 1; 0: none), and its pose
    for step in way.steps:
        i, T = frames[step.start]
        frames[step.end] = (i + 1, np.eye(4)) if step.joint.kind else (i, T @ step.constant)
    masses = np.zeros(len(table))
    moments = np.zeros((len(table), 3))
    for name, body in urdf.links.items():
        place = np.eye(4)  # pose of the link in the chain link that carries it
        carrier = name
        try:
            while carrier not in frames and carrier in urdf.above:
                joint = urdf.above[carrier]
                place = joint.origin @ place
                carrier = joint.parent
            attributes = {each.tag: each.attrib for inertial in body.findall("inertial")[:1] for each in inertial}
            mass = _numbers(attributes.get("mass", {}).get("value", "0"), 1)
            centre = _numbers(attributes.get("origin", {}).get("xyz", "0 0 0"), 3)
            if mass is None or centre is None or mass[0] < 0:
                shown = f"mass {attributes.get('mass')}, origin {attributes.get('origin')}"
                accepted = "a mass that is not negative, and three finite numbers"
                raise InputError(f"link '{name}', inertial", shown[:80], accepted)
        except InputError:
            if name in frames:
                raise
            continue
        i, T = frames.get(carrier, (0, place))
        if i:
            masses[i - 1] += mass[0]
            moments[i - 1] += mass[0] * (T @ place @ [*centre, 1])[:3]
    if not masses.any():
        return Gravity()
    centres: list[Vector] = []
    for moment, mass, row, g in zip(moments, masses, table, G, strict=True):
        T = numeric_link(beta=-row[4]) @ g
        x, y, z = (T[:3, :3] @ (moment / (mass or 1.0)) + T[:3, 3]).tolist()
        centres.append((x, y, z))
    return Gravity(masses=tuple(masses.tolist()), centres=tuple(centres))
