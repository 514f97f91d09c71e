"""Every public name says what it computes, with shapes and an example, and every example of a docstring runs."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot

import rpim_opt as ro
from tests import ROOT
from tests.robot.test_exchange import CONF, YAML_PLAIN

mpl.use("agg")
PACKAGE = ROOT / "rpim_opt"
SHAPE = re.compile(r"\(((\w{1,10}|\d)( or \d|[+-]\d)?, ?)+((\w{1,10}|\d)( or \d|[+-]\d)?)?\)")
"""``(N, 3)``, ``(n,)``, ``(n+1, n+1)``, ``(1 or N, k, k)``."""
ARRAY = re.compile(r"\bArray\b|ndarray")

TARGETS = (PACKAGE.parent / "problems/paper_arm/validation.csv").read_text(encoding="utf-8")
URDF = """<robot name="arm"><link name="base"/><link name="arm"/><link name="tip"/>
<joint name="j1" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2"/></joint>
<joint name="flange" type="fixed"><parent link="arm"/><child link="tip"/><origin xyz="0.4 0 0"/></joint></robot>
"""
FILES = {"targets.csv": TARGETS, "arm.urdf": URDF, "kinematics.yaml": YAML_PLAIN, "calibration.conf": CONF}
"""What a user has in the folder, to whom an example reads a file."""

NAMESPACES = ("select", "constraints", "plot", "baselines")
"""Modules that a user sees as ``ro.select``; what they list is public."""
WITHOUT_EXAMPLE = {"problem.parts.on_cluster": "it needs a cluster, which test_streaming.py starts"}


def documented(module: str, node: ast.AST, outer: str = "") -> Iterator[tuple[str, tuple[str, int]]]:
    """Name to docstring and line of everything in a module; that of a constant is the text below it."""
    body = getattr(node, "body", [])
    for statement, below in zip(body, [*body[1:], None], strict=True):
        if isinstance(statement, ast.Assign | ast.AnnAssign) and isinstance(below, ast.Expr):
            target = statement.targets[0] if isinstance(statement, ast.Assign) else statement.target
            if isinstance(below.value, ast.Constant) and isinstance(target, ast.Name):
                yield f"{module}.{outer}{target.id}", (inspect.cleandoc(below.value.value), below.lineno)
        if isinstance(statement, ast.ClassDef | ast.FunctionDef):
            text = ast.get_docstring(statement)
            if text:
                yield f"{module}.{outer}{statement.name}", (text, statement.body[0].lineno)
            yield from documented(module, statement, f"{outer}{statement.name}.")


DOCS: dict[str, tuple[str, int]] = {}
for file in sorted(PACKAGE.rglob("*.py")):
    tree = ast.parse(file.read_text(encoding="utf-8"))
    DOCS |= dict(documented(".".join(file.relative_to(PACKAGE).with_suffix("").parts), tree))
EXAMPLES = [name for name, (text, _) in DOCS.items() if ">>> " in text]


def exported() -> Iterator[tuple[str, Any]]:
    """Every public name: where it is defined, ``robot.mdh.Robot``, and what it is."""
    for stub in sorted(PACKAGE.glob("*/__init__.pyi")):
        folder = importlib.import_module(f"rpim_opt.{stub.parent.name}")
        for node in ast.parse(stub.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    yield f"{stub.parent.name}.{node.module}.{alias.name}", getattr(folder, alias.name)
    for name in NAMESPACES:
        module = getattr(ro, name)
        for member in module.__all__:
            value = getattr(module, member)
            yield f"{value.__module__.removeprefix('rpim_opt.')}.{member}", value


def members(names: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Every public method and property of the public classes."""
    for name, value in names.items():
        if inspect.isclass(value) and not getattr(value, "_is_protocol", False):  # whose members others have
            own = set(getattr(value, "_fields", ()))  # of a NamedTuple
            if is_dataclass(value):
                own = {field.name for field in fields(value)}
            for member, what in vars(value).items():
                if not member.startswith("_") and member not in own:
                    yield f"{name}.{member}", what


NAMES = dict(exported())
MEMBERS = dict(members(NAMES))
PUBLIC = {**NAMES, **MEMBERS}


def doc(name: str) -> str:
    return DOCS.get(name, ("", 0))[0]


def entries(text: str) -> dict[str, str]:
    """Name to text of the parameters that a docstring describes."""
    section = re.search(r"^Parameters\n-+\n(.*?)(?=\n\n?\S[^\n]*\n---|\n>>> |\Z)", text, re.DOTALL | re.MULTILINE)
    found: dict[str, str] = {}
    for head, body in re.findall(r"^(\S.*)\n((?:[ ].*\n?|\n)+)", section[1] if section else "", re.MULTILINE):
        found |= {name.strip(): body for name in head.split(",")}
    return found


def signature(what: Any) -> inspect.Signature | None:
    what = what.func if isinstance(what, cached_property) else what.fget if isinstance(what, property) else what
    what = getattr(what, "__func__", what)
    called = what.__init__ if inspect.isclass(what) else what
    return inspect.signature(what) if inspect.isfunction(called) else None


def test_there_is_something_to_check() -> None:
    assert len(MEMBERS) > 60
    assert len(EXAMPLES) > len(NAMES) > 100


@pytest.mark.parametrize("name", PUBLIC)
def test_a_public_name_describes_parameters_and_shapes(name: str) -> None:
    text, called = doc(name), signature(PUBLIC[name])
    assert text, "no docstring"
    if called is None:
        return
    inherited, described = re.search(r"\b[Aa]rguments( and errors)? as for `", text), entries(text)
    parameters = [p for p in called.parameters.values() if p.name not in ("self", "cls") and p.kind != p.VAR_KEYWORD]
    parameters = [p for p in parameters if not p.name.startswith("_")]
    for p in parameters:
        if not inherited and len(parameters) > 1:
            assert p.name in described, f"parameter {p.name} is not described"
        if not inherited and ARRAY.search(str(p.annotation)):
            assert SHAPE.search(described.get(p.name, text)), f"array {p.name} without shape"
    if not inherited and not inspect.isclass(PUBLIC[name]) and ARRAY.search(str(called.return_annotation)):
        assert SHAPE.search(text), "returned array without shape"


@pytest.mark.parametrize("name", [name for name in PUBLIC if name not in WITHOUT_EXAMPLE])
def test_a_public_name_has_an_example(name: str) -> None:
    """Its own, which uses it unless it is a class; that of a member may stand at its class or at another member."""
    owner, _, last = name.rpartition(".")
    shown = [name] if name in NAMES else [n for n in PUBLIC if n == owner or n.startswith(f"{owner}.")]
    sources = [e.source for n in shown for e in doctest.DocTestParser().get_examples(doc(n))]
    assert sources, "no example"
    if not inspect.isclass(PUBLIC[name]):
        assert any(re.search(rf"\.{last}\b", source) for source in sources), "no example that uses it"


def test_the_top_level_has_nothing_of_its_own() -> None:
    known = {id(value) for value in NAMES.values()}
    for name in ro.__all__:
        assert id(getattr(ro, name)) in known, f"{name} is in no folder's stub"


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_prints_what_it_says(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for file, content in FILES.items():
        Path(file).write_text(content, encoding="utf-8")
    text, line = DOCS[name]
    example = doctest.DocTestParser().get_doctest(text, {"__name__": "__main__"}, name, None, line)
    runner, said = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE), []
    with np.printoptions(precision=8, suppress=False, linewidth=75, legacy=False):  # NumPy's own, whatever others set
        failed = runner.run(example, out=said.append).failed
    pyplot.close("all")
    assert not failed, "".join(said)
