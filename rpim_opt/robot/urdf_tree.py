"""The elements of a URDF file: links and joints as a tree, and where in the file their numbers stand.

A URDF is untrusted input. It goes through expat, which tells where in the file an element stands; document types, and
with them entities and other files, are refused.
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

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import LARGEST
from rpim_opt.robot.expanding import urdf_text
from rpim_opt.robot.kinematics import numeric_frame
from rpim_opt.robot.original import origin_numbers

DEEPEST = 100
"""How deep elements may be nested."""


LARGEST_NUMBER = 1e6
"""Size [m or rad] that no number of an origin or axis reaches."""


KINDS = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": ""}


NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


ATTRIBUTE = re.compile(rb"([^\s=/<>\"']+)\s*=\s*(\"[^\"]*\"|'[^']*')")


@dataclass(eq=False)
class Element:
    """An element: where it starts in the file [byte], and what is in it."""

    tag: str
    attributes: dict[str, str]
    start: int
    children: list[Element] = field(default_factory=list)


class Joint:
    """A joint element whose attributes are checked when they are asked for: off the chain nothing needs to be right."""

    def __init__(self, element: Element, name: str, path: Path):
        self.element = element
        self.name = name
        self.path = path
        self.parent = self._link("parent")
        self.child = self._link("child")

    def _link(self, which: str) -> str:
        link = (self._only(which) or Element("", {}, 0)).attributes.get("link")
        if not link:
            raise self.error(which, "nothing", f'one <{which} link="...">')
        return link

    def error(self, what: str, found: str, accepted: str) -> InputError:
        """Return the error that names the joint."""
        return InputError(f"joint '{self.name}', {what}", found, accepted, self.path)

    def _only(self, tag: str) -> Element | None:
        found = [e for e in self.element.children if e.tag == tag]
        if len(found) > 1:
            raise self.error(tag, f"{len(found)} of them", "one")
        return found[0] if found else None

    def numbers(self, tag: str, attribute: str, default: str, count: int) -> Array:
        """Return the numbers of an attribute, its default where it or its element is absent."""
        element = self._only(tag)
        text = default
        if element is not None:
            text = element.attributes.get(attribute, default)
        parts = text.split()
        largest = LARGEST_NUMBER if count > 1 else math.inf  # limits may be any number
        if len(parts) != count or not all(_is_number(part, largest) for part in parts):
            wanted = "a finite number" if count == 1 else f"{count} finite numbers"
            if "$" in text:
                wanted += "; a file with xacro's expressions ends in .xacro"
            raise self.error(f"{tag} {attribute}", repr(text[:40]), wanted)
        return np.array([float(part) for part in parts])

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
        far = max(abs(lower), abs(upper)) > LARGEST  # 1e16 is how some files say that there is none
        unlimited = far or lower == upper or self.element.attributes.get("type") == "continuous"
        return (-math.inf, math.inf) if unlimited else (lower, upper)

    def origin_edits(self, data: bytes, T: Array, size: float) -> dict[tuple[int, int], str]:
        """Return what to replace in the file so that the origin becomes T, by first and last byte.

        ``size`` is the arm's `reach` [m].
        """
        texts = zip(("xyz", "rpy"), origin_numbers(T, self.origin, size), strict=True)
        new = {name: text for name, text in texts if text is not None}
        if not new:
            return {}
        element = self._only("origin")
        if element is None:
            at = _tag_end(data, self.element.start)
            return {(at, at): f"<origin{_attributes(new)}/>"}
        places = _places(data, element.start)
        edits = {places[name]: new.pop(name) for name in list(new) if name in places}
        if new:
            after_name = element.start + len("<origin")
            edits[after_name, after_name] = _attributes(new)
        return edits


def _is_number(text: str, largest: float) -> bool:
    return bool(NUMBER.fullmatch(text)) and abs(float(text)) < largest


def floats(text: str, count: int) -> Array:
    """Return the finite numbers of an attribute.

    Raises
    ------
    ValueError
        For others, or more or fewer of them.
    """
    parts = text.split()
    if len(parts) != count or not all(_is_number(part, LARGEST_NUMBER) for part in parts):
        raise ValueError(text)
    return np.array([float(part) for part in parts])


def _attributes(values: Mapping[str, str]) -> str:
    return "".join(f' {name}="{value}"' for name, value in values.items())


def _places(data: bytes, start: int) -> dict[str, tuple[int, int]]:
    """Return where the values of a tag's attributes begin and end."""
    found = ATTRIBUTE.finditer(data, start, _tag_end(data, start))
    return {match[1].decode(errors="replace"): (match.start(2) + 1, match.end(2) - 1) for match in found}


def _tag_end(data: bytes, start: int) -> int:
    """Return where the tag that begins at ``start`` is over: quoted values may hold a '>'."""
    match = re.compile(rb"<(?:[^\"'>]|\"[^\"]*\"|'[^']*')*>").match(data, start)
    return match.end() if match else start


@dataclass(frozen=True, eq=False)
class Urdf:
    """A file's robot: its joints by name and by the link below, and its links."""

    path: Path
    data: bytes
    name: str
    joints: Mapping[str, Joint]
    above: Mapping[str, Joint]  # by child link
    links: tuple[str, ...]
    bodies: Mapping[str, Element]

    def path_between(self, base: str | None, tip: str | None) -> list[Joint]:
        """Return the joints from link ``base`` to link ``tip``; by default from the root to the only leaf."""
        for given in (base, tip):
            if given is not None and given not in self.links:
                raise InputError(f"link '{given}'", "nothing", choices(given, self.links), self.path)
        base = base or self._root()
        tip = tip or self._leaf(base)
        chain = self._up(tip, base)
        if chain is None:
            raise InputError(f"link '{tip}'", f"no chain from '{base}' to it", "a link below the base", self.path)
        return chain

    def _root(self) -> str:
        roots = [link for link in self.links if link not in self.above]
        if len(roots) > 1:
            accepted = "one of them: --urdf-base, urdf_base in problem.toml, or the argument base"
            raise InputError("links without a parent", ", ".join(roots), accepted, self.path)
        return roots[0]

    def _leaf(self, base: str) -> str:
        parents = {joint.parent for joint in self.joints.values()}
        leaves = [link for link in self.links if link not in parents and self._up(link, base) is not None]
        if len(leaves) != 1:
            accepted = "one of them: --urdf-tip, urdf_tip in problem.toml, or the argument tip"
            raise InputError(f"links at the end of chains from '{base}'", ", ".join(leaves), accepted, self.path)
        return leaves[0]

    def _up(self, tip: str, base: str) -> list[Joint] | None:
        chain: list[Joint] = []
        while tip != base:
            if tip not in self.above:
                return None
            chain.append(self.above[tip])
            tip = chain[-1].parent
        return chain[::-1]


def read_tree(path: Path) -> Urdf:
    """Return the tree of links and joints of a file."""
    data = urdf_text(path)
    root = _tree(data, path)
    if root.tag != "robot":
        raise InputError("the root element", f"<{root.tag}>", "<robot>, as in URDF", path)
    links, joints = _named(root, path)
    if not links:
        raise InputError("the robot", "no links", "elements <link> and <joint>", path)
    every = {name: Joint(element, name, path) for name, element in joints.items()}
    above = _above(every, links, path)
    _require_tree(links, above, path)
    return Urdf(path, data, root.attributes.get("name") or path.stem, every, above, tuple(links), links)


def _named(root: Element, path: Path) -> tuple[dict[str, Element], dict[str, Element]]:
    """Return links and joints by their names."""
    known: dict[str, dict[str, Element]] = {"link": {}, "joint": {}}
    for element in root.children:
        if element.tag.startswith("xacro:"):
            raise InputError(f"element <{element.tag}>", "xacro in a file .urdf", "URDF, or a file .xacro", path)
        if element.tag not in known:
            continue
        name = element.attributes.get("name", "")
        if not name or name in known[element.tag]:
            found = f"'{name}' twice" if name else "one without a name"
            raise InputError(f"element <{element.tag}>", found, "every one with a name of its own", path)
        known[element.tag][name] = element
    return known["link"], known["joint"]


def _above(joints: Mapping[str, Joint], links: Mapping[str, Element], path: Path) -> dict[str, Joint]:
    """Return the joint above every link that has one."""
    above: dict[str, Joint] = {}
    for joint in joints.values():
        for which, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in links:
                raise joint.error(which, f"no link '{link}'", choices(link, links))
        if joint.child in above:
            found = f"two parents, by joints '{above[joint.child].name}' and '{joint.name}'"
            raise InputError(f"link '{joint.child}'", found, "one", path)
        above[joint.child] = joint
    return above


def _require_tree(links: Mapping[str, Element], above: Mapping[str, Joint], path: Path) -> None:
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


def _tree(data: bytes, path: Path) -> Element:
    """Return the root element."""
    top = Element("", {}, 0)
    stack = [top]

    def start(tag: str, attributes: dict[str, str]) -> None:
        if len(stack) > DEEPEST:
            raise InputError(f"element <{tag}>", f"more than {DEEPEST} levels", "a URDF", path)
        element = Element(tag, attributes, parser.CurrentByteIndex)
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
