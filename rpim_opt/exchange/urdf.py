"""URDF in, and the corrected origins back into the same file.

A URDF is untrusted input. It goes through expat, which tells where in the file an element stands, so that a corrected
file keeps every other byte; document types, and with them entities and other files, are refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from rpim_opt.exceptions import InputError, choices
from rpim_opt.exchange.chain import (
    Chain,
    Described,
    corrected,
    describe,
    origin_numbers,
    read_bytes,
    require_same_arm,
    spliced,
)
from rpim_opt.files import write_bytes
from rpim_opt.kinematics import frame_numbers, numeric_frame
from rpim_opt.robot import Array, Robot

DEEPEST = 100
"""How deep elements may be nested."""
LARGEST_NUMBER = 1e6
"""Size [m or rad] that no number of an origin or axis reaches."""
KINDS = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": ""}
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
ATTRIBUTE = re.compile(rb"([^\s=/<>\"']+)\s*=\s*(\"[^\"]*\"|'[^']*')")


@dataclass(eq=False)
class _Element:
    tag: str
    attributes: dict[str, str]
    start: int
    children: list[_Element] = field(default_factory=list)


class _Joint:
    """A joint element whose attributes are checked when they are asked for: off the chain nothing needs to be right."""

    def __init__(self, element: _Element, name: str, path: Path):
        self.element, self.name, self.path = element, name, path
        self.parent, self.child = (self._link(which) for which in ("parent", "child"))

    def _link(self, which: str) -> str:
        link = (self._only(which) or _Element("", {}, 0)).attributes.get("link")
        if not link:
            raise self.error(which, "nothing", f'one <{which} link="...">')
        return link

    def error(self, what: str, found: str, accepted: str) -> InputError:
        return InputError(f"joint '{self.name}', {what}", found, accepted, self.path)

    def _only(self, tag: str) -> _Element | None:
        found = [e for e in self.element.children if e.tag == tag]
        if len(found) > 1:
            raise self.error(tag, f"{len(found)} of them", "one")
        return found[0] if found else None

    def numbers(self, tag: str, attribute: str, default: str, count: int) -> Array:
        """Return the numbers of an attribute, its default where it or its element is absent."""
        element = self._only(tag)
        text = (element.attributes if element else {}).get(attribute, default)
        parts = text.split()
        largest = LARGEST_NUMBER if count > 1 else math.inf  # limits may be any number
        if len(parts) != count or not all(NUMBER.fullmatch(p) and abs(float(p)) < largest for p in parts):
            hint = "; expand the file with the command xacro first" if "$" in text else ""
            wanted = "a finite number" if count == 1 else f"{count} finite numbers"
            raise self.error(f"{tag} {attribute}", repr(text[:40]), wanted + hint)
        return np.array([float(p) for p in parts])

    @property
    def kind(self) -> str:
        """``"revolute"``, ``"prismatic"``, or nothing for a fixed joint."""
        kind = self.element.attributes.get("type", "")
        if kind not in KINDS:
            raise self.error("type", f"'{kind}'", f"{', '.join(KINDS)} between base and tip")
        return KINDS[kind]

    @property
    def origin(self) -> Array:
        """Transform (4, 4) from the parent's frame to the joint's."""
        return numeric_frame([*self.numbers("origin", "xyz", "0 0 0", 3), *self.numbers("origin", "rpy", "0 0 0", 3)])

    @property
    def axis(self) -> Array:
        """Unit vector (3,) in the joint's frame."""
        axis = self.numbers("axis", "xyz", "1 0 0", 3)
        length = float(np.linalg.norm(axis))
        if not length > 1e-6:
            raise self.error("axis xyz", f"a vector of length {length:g}", "a unit vector")
        return axis / length

    @property
    def limits(self) -> tuple[float, float]:
        """Lower and upper joint value [rad or m]; infinite where the file leaves them out or makes them equal."""
        lower, upper = (float(self.numbers("limit", which, "0", 1)[0]) for which in ("lower", "upper"))
        if lower > upper:
            raise self.error("limit", f"{lower:g} to {upper:g}", "lower < upper")
        unlimited = lower == upper or self.element.attributes.get("type") == "continuous"
        return (-math.inf, math.inf) if unlimited else (lower, upper)

    def origin_edits(self, data: bytes, T: Array) -> dict[tuple[int, int], str]:
        """Return what to replace in the file so that the origin becomes T, by first and last byte."""
        xyz, rpy = origin_numbers(T, self.origin)
        new = {name: text for name, text in (("xyz", xyz), ("rpy", rpy)) if text is not None}
        element = self._only("origin")
        if element is None:
            at = _tag_end(data, self.element.start)
            text = "".join(f' {name}="{value}"' for name, value in new.items())
            return {(at, at): f"<origin{text}/>"} if new else {}
        tag = (element.start, _tag_end(data, element.start))
        places = {m[1].decode(errors="replace"): (m.start(2) + 1, m.end(2) - 1) for m in ATTRIBUTE.finditer(data, *tag)}
        edits = {places[name]: value for name, value in new.items() if name in places}
        after_name = element.start + len("<origin")
        absent = "".join(f' {name}="{value}"' for name, value in new.items() if name not in places)
        return edits | ({(after_name, after_name): absent} if absent else {})


def _tag_end(data: bytes, start: int) -> int:
    """Return where the tag that begins at ``start`` is over: quoted values may hold a '>'."""
    match = re.compile(rb"<(?:[^\"'>]|\"[^\"]*\"|'[^']*')*>").match(data, start)
    return match.end() if match else start


@dataclass(frozen=True, eq=False)
class _Urdf:
    path: Path
    data: bytes
    name: str
    joints: Mapping[str, _Joint]
    above: Mapping[str, _Joint]  # by child link
    links: tuple[str, ...]

    def path_between(self, base: str | None, tip: str | None) -> list[_Joint]:
        """Return the joints from link ``base`` to link ``tip``; by default from the root to the only leaf."""
        for given in (base, tip):
            if given is not None and given not in self.links:
                raise InputError(f"link '{given}'", "nothing", choices(given, self.links), self.path)
        roots = [link for link in self.links if link not in self.above]
        if base is None and len(roots) > 1:
            raise InputError(
                "links without a parent",
                ", ".join(roots),
                "one, or the argument base (urdf_base in problem.toml)",
                self.path,
            )
        base = base or roots[0]
        parents = {joint.parent for joint in self.joints.values()}
        if tip is None:
            leaves = [link for link in self.links if link not in parents and self._up(link, base) is not None]
            if len(leaves) != 1:
                found = ", ".join(leaves)
                raise InputError(
                    f"links at the end of chains from '{base}'",
                    found,
                    "one, or the argument tip (urdf_tip in problem.toml)",
                    self.path,
                )
            tip = leaves[0]
        chain = self._up(tip, base)
        if chain is None:
            raise InputError(f"link '{tip}'", f"no chain from '{base}' to it", "a link below the base", self.path)
        return chain

    def _up(self, tip: str, base: str) -> list[_Joint] | None:
        chain: list[_Joint] = []
        while tip != base:
            if tip not in self.above:
                return None
            chain.append(self.above[tip])
            tip = chain[-1].parent
        return chain[::-1]


def read_urdf(path: str | Path, base: str | None = None, tip: str | None = None) -> Described:
    """Return a serial chain of a URDF file as a robot in modified DH with Hayati's beta.

    ``base @ MDH chain(q) @ tool`` is the transform from link ``base`` to link ``tip``, with q the file's joint values;
    `chain.describe` states the conventions. Fixed joints are part of base, links and tool; limits are carried over
    (continuous joints, and limits that are left out or equal, have none). Angles are roll, pitch, yaw, R = Rz Ry Rx,
    and an axis that is left out is x (wiki.ros.org/urdf/XML/joint).

    Parameters
    ----------
    path
        An expanded URDF file; xacro files have to be expanded first.
    base, tip
        Names of links; the root, and the only leaf below the base.

    Raises
    ------
    InputError
        Naming the file, the element, what was found and what is accepted: no URDF, document types and entities, links
        or joints that are missing, twice or in a cycle, values that are no finite numbers, floating and planar joints
        or mimic joints between base and tip, no or several candidates for base or tip.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> arm = ro.read_urdf("arm.urdf", base="base", tip="tip")
    >>> arm.robot.dof, arm.names, arm.tool[:3]
    (1, ('j1',), array([0.4, 0. , 0. ]))
    """
    urdf = _parse(Path(path))
    every, joints, chain = _chain(urdf, base, tip)
    table, T_base, T_tool, _ = describe(chain)
    robot = Robot(
        name=urdf.name,
        mdh=table,
        joint_types=tuple(joint.kind for joint in joints),
        limits=np.array([joint.limits for joint in joints]),
        source=f"{urdf.path.name}, {every[0].parent} to {every[-1].child}",
    )
    return Described(robot, frame_numbers(T_base), frame_numbers(T_tool), tuple(joint.name for joint in joints))


def write_urdf(
    source: str | Path,
    robot: Robot,
    target: str | Path,
    base: str | None = None,
    tip: str | None = None,
    base_frame: Array | None = None,
    tool_frame: Array | None = None,
) -> None:
    """Write a URDF file with the origins that an identified robot has, every other byte as in the original.

    An origin that does not change stays as it is written. Numbers are written so that they read back exactly.

    Parameters
    ----------
    source
        The original. Its `read_urdf` with the same base and tip has to be the robot whose parameters were identified.
    robot
        The robot with identified parameters, `Calibration.robot` or `chain.identified`, which refuses what
        a URDF cannot express.
    target
        Where to write; may be ``source``.
    base, tip
        Names of links, as for `read_urdf`.
    base_frame, tool_frame
        (6,) identified base and tool, x, y, z [m], roll, pitch, yaw [rad]; those of the original where not given.

    Raises
    ------
    InputError
        As `read_urdf`, and for another robot, couplings, or a tool or last beta for which the chain has no fixed
        joint after its last moving one.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import rpim_opt as ro
    >>> robot = ro.read_urdf("arm.urdf").robot
    >>> longer = replace(robot, mdh=robot.mdh + [0, 0, 0, 0.001, 0])  # as if identified: d1 is 1 mm longer
    >>> ro.write_urdf("arm.urdf", longer, "identified.urdf")
    >>> robot.mdh[:, 3], ro.read_urdf("identified.urdf").robot.mdh[:, 3]  # [m]
    (array([0.3]), array([0.301]))
    """
    urdf = _parse(Path(source))
    every, joints, chain = _chain(urdf, base, tip)
    table, T_base, T_tool, G = describe(chain)
    require_same_arm(robot, table, tuple(joint.kind for joint in joints), urdf.path)
    T_base = T_base if base_frame is None else numeric_frame(base_frame)
    T_tool = T_tool if tool_frame is None else numeric_frame(tool_frame)
    origins, tail = corrected(G, robot.mdh, T_base, T_tool)
    edits: dict[tuple[int, int], str] = {}
    before, place = np.eye(4), 0
    for joint in every:
        if joint.kind:  # the fixed joints before it stay, this one takes the whole correction
            edits |= joint.origin_edits(urdf.data, np.linalg.inv(before) @ origins[place])
            before, place = np.eye(4), place + 1
        else:
            before = before @ joint.origin
    if np.abs(tail - chain.tail).max() > 1e-13:
        if every[-1].kind:
            what = f"a tool or beta{len(joints)} that moves the tip '{every[-1].child}'"
            accepted = f"a tip that a fixed joint holds, as joint '{joints[-1].name}' cannot express it, or no tool"
            raise InputError("robot", what, accepted, urdf.path)
        rest = np.linalg.inv(before @ np.linalg.inv(every[-1].origin))
        edits |= every[-1].origin_edits(urdf.data, rest @ tail)
    write_bytes(Path(target), spliced(urdf.data, edits))


def _chain(urdf: _Urdf, base: str | None, tip: str | None) -> tuple[list[_Joint], list[_Joint], Chain]:
    """Return all joints between two links, those of them that move, and their geometry."""
    every, joints, origins, T = urdf.path_between(base, tip), [], [], np.eye(4)
    for joint in every:
        T = T @ joint.origin
        if joint.kind:
            mimic = [e.attributes.get("joint", "") for e in joint.element.children if e.tag == "mimic"]
            if mimic:
                raise joint.error("mimic", f"motion that follows joint '{mimic[0]}'", "joints that move on their own")
            joints.append(joint)
            origins.append(T)
            T = np.eye(4)
    if not joints:
        raise InputError("the chain", "no joint that moves", "a revolute, continuous or prismatic joint", urdf.path)
    return every, joints, Chain(np.array(origins), np.array([joint.axis for joint in joints]), T)


def _parse(path: Path) -> _Urdf:
    data = read_bytes(path)
    root = _tree(data, path)
    if root.tag != "robot":
        raise InputError("the root element", f"<{root.tag}>", "<robot>, as in URDF", path)
    links, joints = {}, {}
    for element in root.children:
        if element.tag.startswith("xacro:"):
            raise InputError(f"element <{element.tag}>", "a xacro file", "URDF: expand it with the command xacro", path)
        if element.tag not in ("link", "joint"):
            continue
        known = links if element.tag == "link" else joints
        name = element.attributes.get("name", "")
        if not name or name in known:
            found = f"'{name}' twice" if name else "one without a name"
            raise InputError(f"element <{element.tag}>", found, "every one with a name of its own", path)
        known[name] = element
    if not links:
        raise InputError("the robot", "no links", "elements <link> and <joint>", path)
    every = {name: _Joint(element, name, path) for name, element in joints.items()}
    above: dict[str, _Joint] = {}
    for joint in every.values():
        for which, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in links:
                raise joint.error(which, f"no link '{link}'", choices(link, links))
        if joint.child in above:
            found = f"two parents, by joints '{above[joint.child].name}' and '{joint.name}'"
            raise InputError(f"link '{joint.child}'", found, "one", path)
        above[joint.child] = joint
    grounded: set[str] = set()
    for link in links:
        trail: list[str] = []
        at = link
        while at in above and at not in grounded:
            if at in trail:
                raise InputError(f"link '{at}'", "a cycle of joints", "a tree", path)
            trail.append(at)
            at = above[at].parent
        grounded.update(trail)
    return _Urdf(path, data, root.attributes.get("name") or path.stem, every, above, tuple(links))


def _tree(data: bytes, path: Path) -> _Element:
    """Return the root element."""
    top = _Element("", {}, 0)
    stack = [top]

    def start(tag: str, attributes: dict[str, str]) -> None:
        if len(stack) > DEEPEST:
            raise InputError(f"element <{tag}>", f"more than {DEEPEST} levels", "a URDF", path)
        element = _Element(tag, attributes, parser.CurrentByteIndex)
        stack[-1].children.append(element)
        stack.append(element)

    def doctype(*_: Any) -> None:
        raise InputError("the document type", "<!DOCTYPE ...>", "a URDF without one, and without entities", path)

    if b"\0" in data:
        raise InputError("the file", "zero bytes, as in UTF-16", "UTF-8 text", path)
    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: stack.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        where = f"line {error.lineno}, column {error.offset + 1}"
        raise InputError(where, expat.errors.messages[error.code], "well-formed XML", path) from None
    except (LookupError, ValueError) as error:
        raise InputError("the XML declaration", str(error), "UTF-8 text", path) from None
    return top.children[0]
