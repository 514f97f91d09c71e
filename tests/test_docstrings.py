"""Every example of a docstring runs and prints what it says."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot

import rpim_opt as ro
from tests import ROOT
from tests.robot.test_exchange import CONF, YAML

mpl.use("agg")
PACKAGE = ROOT / "rpim_opt"
TARGETS = (PACKAGE.parent / "problems/paper_arm/validation.csv").read_text(encoding="utf-8")
URDF = """<robot name="arm"><link name="base"/><link name="arm"/><link name="tip"/>
<joint name="j1" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2"/></joint>
<joint name="flange" type="fixed"><parent link="arm"/><child link="tip"/><origin xyz="0.4 0 0"/></joint></robot>
"""
FILES = {"targets.csv": TARGETS, "arm.urdf": URDF, "kinematics.yaml": YAML, "calibration.conf": CONF}
"""What a user has in the folder, to whom an example reads a file."""

NAMESPACES = ("select", "constraints", "plot", "baselines")
"""Modules that a user sees as ``ro.select``; what they list is public."""


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


NAMES = dict(exported())


def test_there_is_something_to_check() -> None:
    assert len(EXAMPLES) > 100
    assert len(NAMES) > 100


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
