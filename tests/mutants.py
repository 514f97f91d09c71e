"""Mutation score of the package: ``python3 dev.py mutants [COUNT] [FOLDER] [FILE...]``.

``python3 dev.py coverage [FOLDER]`` goes before: it writes down which test runs which line. Then mutants are drawn
at random, one change each in the code of the package, or of some of its files; the tests that run the changed line
are tried, the quickest first, until one fails. Each answer is a line of ``FOLDER/mutants.jsonl``; what stands there
is not tried again. Those that no test fails for are printed.
"""

from __future__ import annotations

import ast
import copy
import importlib.abc
import importlib.machinery
import json
import os
import random
import re
import resource
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import coverage
import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "rpim_opt"
SECONDS = 40.0
"""Of tests (as long as they took once) that are run for a mutant."""
PATIENCE = 10 * SECONDS
THIRD = ("numpy", "scipy.linalg", "scipy.optimize", "scipy.sparse.linalg", "scipy.stats", "cvxpy", "clarabel", "casadi",
         "pydantic", "pytest", "_pytest.assertion.rewrite", "threadpoolctl")  # fmt: skip
"""What every test imports: once, before the mutants part."""
COMPARED = {
    ast.Lt: (ast.LtE, ast.Gt), ast.LtE: (ast.Lt, ast.GtE), ast.Gt: (ast.GtE, ast.Lt), ast.GtE: (ast.Gt, ast.LtE),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,),
}  # fmt: skip
COMPUTED = {
    ast.Add: (ast.Sub,), ast.Sub: (ast.Add,), ast.Mult: (ast.Div,), ast.Div: (ast.Mult,), ast.Pow: (ast.Mult,),
    ast.BitAnd: (ast.BitOr,), ast.BitOr: (ast.BitAnd,),
}  # fmt: skip
NAMES = {"minimum": "maximum", "maximum": "minimum", "min": "max", "max": "min", "argmin": "argmax", "argmax": "argmin",
         "any": "all", "all": "any", "zeros": "ones", "ones": "zeros"}  # fmt: skip
PROSE = {"__str__", "__repr__", "_repr_html_", "_short", "content"}
"""Functions whose words are no numerics."""


class Mutant(NamedTuple):
    """One change of one file."""

    file: str
    line: int
    run: range
    """Lines of the statement; those of its function for a default; none for what stands in no function."""
    before: str
    after: str
    source: str


class Place(NamedTuple):
    """A node that can be changed, what may replace it, and the lines that run with it."""

    node: ast.AST
    other: ast.AST
    run: range


def places(tree: ast.Module) -> Iterator[Place]:
    """Yield every change of a file."""
    yield from _within(tree, range(0))


def _within(node: ast.AST, run: range) -> Iterator[Place]:
    parts = list(ast.iter_child_nodes(node))
    if isinstance(node, ast.FunctionDef):
        if node.name in PROSE:
            return
        run = range(node.body[0].lineno, (node.end_lineno or 0) + 1)
        parts = [*node.body, *node.args.defaults, *(d for d in node.args.kw_defaults if d)]
    elif isinstance(node, ast.Raise | ast.Import | ast.ImportFrom | ast.JoinedStr):
        return
    elif isinstance(node, ast.AnnAssign):
        parts = [node.value] if node.value else []
    elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return
    if run and isinstance(node, ast.stmt) and not isinstance(node, ast.FunctionDef):
        end = (node.end_lineno or 0) + 1
        if body := getattr(node, "body", None):
            end = max(body[0].lineno, node.lineno + 1)
        run = range(node.lineno, end)
    for other in _others(node):
        yield Place(node, other, run)
    for part in parts:
        yield from _within(part, run)


def _others(node: ast.AST) -> Iterator[ast.AST]:
    """Yield what could stand in the place of a node."""
    changed = copy.deepcopy(node)
    if isinstance(changed, ast.Compare) and len(changed.ops) == 1:
        for kind in COMPARED.get(type(changed.ops[0]), ()):
            yield ast.Compare(changed.left, [kind()], changed.comparators)
    elif isinstance(changed, ast.BinOp):
        for kind in COMPUTED.get(type(changed.op), ()):
            yield ast.BinOp(changed.left, kind(), changed.right)
    elif isinstance(changed, ast.BoolOp):
        other = ast.And() if isinstance(changed.op, ast.Or) else ast.Or()
        yield ast.BoolOp(other, changed.values)
    elif isinstance(changed, ast.UnaryOp) and isinstance(changed.op, ast.USub | ast.Not | ast.Invert):
        yield changed.operand
    elif isinstance(changed, ast.If | ast.While):
        changed.test = ast.UnaryOp(ast.Not(), changed.test)
        yield changed
    elif isinstance(changed, ast.AugAssign):
        yield ast.Pass()
    elif isinstance(changed, ast.Constant) and type(changed.value) in (int, float):
        yield ast.Constant(
            changed.value + 1 if type(changed.value) is int else 2 * changed.value + (changed.value == 0)
        )
    elif isinstance(changed, ast.Attribute) and changed.attr in NAMES:
        changed.attr = NAMES[changed.attr]
        yield changed
    elif isinstance(changed, ast.Name) and changed.id in NAMES:
        changed.id = NAMES[changed.id]
        yield changed


def mutant(file: str, number: int) -> Mutant:
    """Return one of a file's mutants."""
    text = (ROOT / "rpim_opt" / file).read_text(encoding="utf-8")
    tree = ast.parse(text)
    node, other, run = list(places(tree))[number]
    line = getattr(node, "lineno", 0)
    before = text.splitlines()[line - 1].strip()
    after = ast.unparse(ast.fix_missing_locations(ast.copy_location(other, node))).split("\n")[0]

    class Put(ast.NodeTransformer):
        def visit(self, each: ast.AST) -> Any:
            return other if each is node else self.generic_visit(each)

    source = ast.unparse(ast.fix_missing_locations(Put().visit(tree)))
    return Mutant(file, line, run, before, after, source)


def drawn(count: int, files: Sequence[str] = (), seed: int = 34) -> list[tuple[str, int]]:
    """Draw lines at random, each as likely, and one place of each; the first of many are those of few."""
    files = files or sorted(str(file.relative_to(PACKAGE)) for file in PACKAGE.rglob("*.py"))
    lines: dict[tuple[str, int], list[int]] = {}
    for file in files:
        for number, place in enumerate(places(_tree(file))):
            lines.setdefault((file, getattr(place.node, "lineno", 0)), []).append(number)
    order = list(lines)
    chance = random.Random(seed)
    chance.shuffle(order)
    return [(line[0], chance.choice(lines[line])) for line in order][:count]


def _tree(file: str) -> ast.Module:
    return ast.parse((ROOT / "rpim_opt" / file).read_text(encoding="utf-8"))


class Contexts:
    """A plugin of pytest that tells coverage whose lines run, and writes down how long each test took.

    What a fixture of several tests runs counts for each of them.
    """

    def __init__(self, target: Path):
        self.target = target
        self.found: dict[str, dict[str, Any]] = {}
        self.item = ""

    def _switch(self, context: str) -> None:
        if measured := coverage.Coverage.current():
            measured.switch_context(context)

    def pytest_runtest_protocol(self, item: Any) -> None:
        self.item = item.nodeid
        self._switch(item.nodeid)
        shared = {
            _fixture(kinds[-1])
            for kinds in item._fixtureinfo.name2fixturedefs.values()
            if kinds[-1].scope != "function"
        }
        item.user_properties.append(("contexts", [item.nodeid, *sorted(shared)]))

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Any:
        if fixturedef.scope == "function":
            return (yield)
        self._switch(_fixture(fixturedef))
        try:
            return (yield)
        finally:
            self._switch(self.item)

    def pytest_runtest_logreport(self, report: Any) -> None:
        entry = self.found.setdefault(report.nodeid, {"seconds": 0.0})
        entry["seconds"] += report.duration
        entry |= report.user_properties
        if report.failed:
            entry["contexts"] = []  # what fails without a change says nothing about one

    def pytest_sessionfinish(self, session: Any) -> None:
        if not hasattr(session.config, "workerinput"):
            self.target.write_text(json.dumps(self.found))


def _fixture(kind: Any) -> str:
    return f"{kind.baseid}::{kind.argname}"


def pytest_configure(config: Any) -> None:
    """Take part where a place for the times is named."""
    target = os.environ.get("MUTANTS_TESTS")
    if target:
        config.pluginmanager.register(Contexts(Path(target)))


class Loader(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module from another source."""

    def __init__(self, mutant: Mutant):
        self.name = "rpim_opt." + mutant.file.removesuffix(".py").replace("/", ".")
        self.file = str(ROOT / "rpim_opt" / mutant.file)
        self.source = mutant.source

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> Any:
        if fullname != self.name:
            return None
        return importlib.machinery.ModuleSpec(fullname, self, origin=self.file)

    def create_module(self, spec: Any) -> None:
        return None

    def exec_module(self, module: Any) -> None:
        module.__file__ = self.file
        exec(compile(self.source, self.file, "exec"), module.__dict__)


def survives(mutant: Mutant, tests: list[str]) -> str:
    """Return ``survives``, ``killed``, or ``timeout``: tests of a mutant in a process of its own."""
    child = os.fork()
    if not child:
        _test(mutant, tests)
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done and os.WIFSIGNALED(status):
            return "timeout"
        if done:
            return "survives" if os.WEXITSTATUS(status) == 0 else "killed"
        time.sleep(0.05)
    os.kill(child, 9)
    os.waitpid(child, 0)
    return "timeout"


def _test(mutant: Mutant, tests: list[str]) -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (int(4 * SECONDS), int(4 * SECONDS)))
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)
    sys.meta_path.insert(0, Loader(mutant))
    code = 1
    try:
        code = int(pytest.main(["-x", "-p", "no:cacheprovider", "-p", "no:xdist", *tests]))
    finally:
        os._exit(code)


class Known:
    """Which tests run a line, and how long they take."""

    def __init__(self, folder: Path):
        self.lines = coverage.CoverageData(str(folder / "coverage"))
        self.lines.read()
        self.tests: dict[str, dict[str, Any]] = json.loads((folder / "tests.json").read_text())
        self.imports: dict[str, set[str]] = {}

    def chosen(self, mutant: Mutant) -> list[str]:
        """Return the tests that run a changed line, then those of files that import the module, quickest first.

        What a function keeps for its next callers (``lru_cache``) runs for one test and decides about others, too: of
        such lines the second ones know.
        """
        by_line = self.lines.contexts_by_lineno(str(ROOT / "rpim_opt" / mutant.file))
        lines = mutant.run or by_line
        contexts = {context for line in lines for context in by_line.get(line, ()) if context}
        found = []
        for test, entry in self.tests.items():
            runs = not contexts.isdisjoint(entry.get("contexts", ()))
            if runs or (entry.get("contexts") and mutant.file in self._imported(test.partition("::")[0])):
                found.append((not runs, entry["seconds"], test))
        taken = []
        total = 0.0
        for _, seconds, test in sorted(found):
            total += seconds
            if taken and total > SECONDS:
                break
            taken.append(test)
        return taken

    def _imported(self, file: str) -> set[str]:
        """Return the files of the package that a file of tests imports by name."""
        if file not in self.imports:
            text = (ROOT / file).read_text(encoding="utf-8")
            names = re.findall(r"^from rpim_opt\.(\S+) import", text, re.MULTILINE)
            self.imports[file] = {f"{name.replace('.', '/')}.py" for name in names}
        return self.imports[file]


def _fails_unchanged(file: str, number: int, known: Known) -> bool:
    same = mutant(file, number)._replace(source=(ROOT / "rpim_opt" / file).read_text(encoding="utf-8"))
    tests = known.chosen(same)
    return bool(tests) and survives(same, tests) != "survives"


def main(arguments: list[str]) -> int:
    """Draw mutants, run their tests, and say how many were found."""
    count, folder, *files = [*arguments, *("300", "measured")[len(arguments) :]]
    folder = Path(folder).resolve()
    sys.path.insert(0, str(ROOT))
    known = Known(folder)
    journal = folder / "mutants.jsonl"
    journal.touch()
    rows = [json.loads(line) for line in journal.read_text().splitlines()]
    answers = {(row["file"], row["number"]): row["answer"] for row in rows}
    for name in THIRD:
        __import__(name)
    places_drawn = drawn(int(count), files)
    if _fails_unchanged(*places_drawn[0], known):
        print("the tests fail without a change, too")
        return 2
    for file, number in places_drawn:
        if (file, number) in answers:
            continue
        tried = mutant(file, number)
        tests = known.chosen(tried)
        answer = "untested"
        if tests:
            answer = survives(tried, tests)
        answers[file, number] = answer
        row = {"file": file, "number": number, "answer": answer, "tests": len(tests), "line": tried.line}
        row |= {"before": tried.before, "after": tried.after}
        with journal.open("a") as lines:
            lines.write(json.dumps(row) + "\n")
        if answer in ("survives", "untested"):
            print(f"{answer}: {file}:{tried.line}: {tried.before}  ->  {tried.after}", flush=True)
    counts = Counter(answers[place] for place in places_drawn)
    found = counts["killed"] + counts["timeout"]
    print(f"{found} of {len(places_drawn)} mutants are found ({found / len(places_drawn):.1%}); {dict(counts)}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
