"""Eleven folders, in the order of the data flow: each imports those before it, heavy libraries wait until needed."""

from __future__ import annotations

import ast
import importlib
import os
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from types import ModuleType

import pytest

import rpim_opt as ro
from tests import ROOT

PACKAGE = ROOT / "rpim_opt"
FLOORS: dict[str, set[str]] = {
    # pydantic checks files, rich writes tables of text, threadpoolctl holds linear algebra to one thread
    "basics": {"pydantic", "pydantic_core", "rich", "threadpoolctl"},
    # pydantic: the schema of robot.toml
    "robot": {"casadi", "pydantic"},
    # casadi: what an instrument sees is differentiated; table libraries are loaded by name in basics.tables
    "data": {"casadi"},
    # clarabel: where a problem starts is the optimum of a relaxation, of which the programs above know nothing
    "problem": {"casadi", "clarabel"},
    "convex": {"clarabel", "cvxpy"},
    "bayes": set(),
    # casadi: a reflector's transform is a measurement, too; pandas: a data frame, where one is asked for
    "calibration": {"casadi", "pandas"},
    # cattrs: values as JSON and back; jinja2: the text of a new problem.toml; pydantic: its schema
    "store": {"cattrs", "jinja2", "pydantic"},
    # casadi: compensation differentiates the tool's pose
    "use": {"casadi"},
    # rich: progress on a console; jinja2: pages
    "report": {"jinja2", "markupsafe", "matplotlib", "rich"},
    # cvxpy: expressions are hashed by their content
    "study": {"cvxpy", "distributed", "joblib", "matplotlib", "pyarrow"},
}
"""Third-party packages that a folder may import besides those for all; its place is its floor."""
EVERYWHERE = {"numpy", "scipy"}
TOP: dict[str, set[str]] = {"cli": {"rich", "typer"}, "__main__": set()}
CORE = {
    "calibration",
    "data",
    "dataset",
    "formulation",
    "instance",
    "loss",
    "model",
    "parameters",
    "penalty",
    "problem",
    "program",
    "result",
    "robot",
    "selection",
}
"""What a parameter is called that has a type of ours: there ``Any`` would hide an arrow to a higher floor."""
MODULES = {
    ".".join(file.relative_to(PACKAGE).with_suffix("").parts): file
    for file in sorted(PACKAGE.rglob("*.py"))
    if file.stem != "__init__"
}


@cache
def tree(module: str) -> ast.Module:
    return ast.parse(MODULES[module].read_text(encoding="utf-8"))


@cache
def imported(module: str) -> list[str]:
    """Return the modules that a module imports, also inside functions and for types alone."""
    found = []
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: imports are absolute"
            name = node.module or ""
            # ``from rpim_opt.convex import select`` imports a module, too
            inner = [f"{name}.{alias.name}" for alias in node.names]
            modules = [each for each in inner if each.removeprefix("rpim_opt.") in MODULES]
            found += modules or [name]
    return found


@cache
def ours(module: str) -> set[str]:
    names = [name.partition(".") for name in imported(module)]
    found = {rest for top, _, rest in names if top == "rpim_opt"}
    if module == "cli":  # which may ask the package for its version
        found -= {""}
    return found


def floor(module: str) -> int:
    """Return the place of a module's folder; the command line is above all."""
    folder, _, rest = module.partition(".")
    return list(FLOORS).index(folder) if rest else len(FLOORS)


def test_every_module_belongs_to_a_folder() -> None:
    folders = {module.partition(".")[0] for module in MODULES if "." in module}
    assert folders == set(FLOORS)
    assert {module for module in MODULES if "." not in module} == set(TOP)
    for folder in FLOORS:
        assert (PACKAGE / folder / "__init__.pyi").is_file(), f"{folder} has no stub to be loaded by"


def test_a_module_imports_folders_before_its_own_and_its_folders_packages() -> None:
    for module in MODULES:
        for name in ours(module):
            assert name in MODULES, f"{module} imports rpim_opt.{name}, which is no module"
            assert floor(name) <= floor(module), f"{module} imports {name}, of a higher floor"
        folder, _, rest = module.partition(".")
        allowed = FLOORS[folder] if rest else TOP[folder]
        for name in imported(module):
            top = name.partition(".")[0]
            assert top in sys.stdlib_module_names | EVERYWHERE | allowed | {"rpim_opt"}, f"{module} imports {name}"


def test_no_module_imports_itself_through_others() -> None:
    list(TopologicalSorter({module: ours(module) for module in MODULES}).static_order())  # raises CycleError


def test_no_any_stands_for_a_type_of_ours() -> None:
    for module in MODULES:
        for node in ast.walk(tree(module)):
            if isinstance(node, ast.FunctionDef | ast.Lambda):
                for parameter in [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]:
                    if parameter.arg in CORE and parameter.annotation is not None:
                        name = ast.unparse(parameter.annotation)
                        assert name not in ("Any", "object"), f"{module}, line {node.lineno}: {parameter.arg}: {name}"


SMALL = "calibrate paper_arm"
ELSEWHERE = {
    "rpim_opt.calibration.leverage",
    "rpim_opt.convex.infeasible",
    "rpim_opt.bayes.population",
    "rpim_opt.convex.constraint_parser",
    "rpim_opt.robot.formats.urdf",
    "cattrs",
}
"""What a plain calibration has no use of: cameras, a drawing's words, a result file."""
HEAVY = {"cvxpy", "clarabel", "scipy.stats"}
"""Libraries that a calibration without cones does not use; SciPy's optimizers estimate hyperparameters."""
LINEAR = {"numpy", "scipy", "casadi", "cvxpy", "pydantic"}
UNUSED = {
    "": LINEAR,
    "--version": LINEAR,
    "--help": LINEAR,
    "calibrate --help": LINEAR - {"pydantic"},
    "robots": {"cvxpy", "clarabel", "scipy.stats", "scipy.optimize", "scipy.sparse"},
    # closed forms: CVXPY is there when ``program.problem`` is asked for
    SMALL: {*HEAVY, *ELSEWHERE},
    f"{SMALL} --selector learned": {*HEAVY, *ELSEWHERE},
    "inspect paper_arm": HEAVY,
}
"""What a command may not import: tables, plots and workers besides these, always. Each may what those before it may."""


def test_a_command_imports_what_it_uses() -> None:
    """One after the other in one process; the first is ``import rpim_opt`` alone."""
    script = f"""
import sys
import rpim_opt
for command, unused in {UNUSED}.items():
    if command:
        from rpim_opt.cli import app
        try:
            app(command.split(), standalone_mode=False)
        except SystemExit:
            pass
    loaded = {{*unused, "pandas", "matplotlib", "joblib", "distributed", "pyarrow"}} & set(sys.modules)
    assert not loaded, (command, loaded)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("stated", "threads"), [(None, 1), ("2", 2)])
def test_a_command_loads_linear_algebra_with_one_thread_unless_told(stated: str | None, threads: int) -> None:
    script = (
        "import sys\nfrom rpim_opt.cli import main\n"
        "sys.argv = ['rpim-opt', 'robots']\ntry:\n    main()\nexcept SystemExit:\n    pass\n"
        "from threadpoolctl import threadpool_info\n"
        "found = {each['num_threads'] for each in threadpool_info() if each['internal_api'] == 'openblas'}\n"
        f"assert found <= {{1, {threads}}}, found\n"
        f"import os\nassert os.environ['OPENBLAS_NUM_THREADS'] == '{threads}'"
    )
    environment = {key: value for key, value in os.environ.items() if key != "OPENBLAS_NUM_THREADS"}
    if stated is not None:
        environment["OPENBLAS_NUM_THREADS"] = stated
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_program_is_there_when_it_is_asked_for_though_a_formula_solved_it() -> None:
    script = """
import sys
import numpy as np
import rpim_opt as ro
problem = ro.load("paper_arm").problem
program = ro.convex.pose(ro.bounded, problem.linearize(np.zeros(26)))
formula = program.solve(1e-3)
assert "cvxpy" not in sys.modules
written = program.problem(1e-3)
value = written.solve(solver="CLARABEL")
assert abs(value / formula.objective - 1) < 1e-6, (value, formula.objective)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_top_level_is_small_and_hides_no_module() -> None:
    assert len(ro.__all__) <= 44
    for name in ro.__all__:
        assert not isinstance(getattr(ro, name), ModuleType), f"the module {name} hides what it is named after"


def test_what_the_stubs_promise_is_there() -> None:
    for folder in FLOORS:
        module = importlib.import_module(f"rpim_opt.{folder}")
        for name in module.__all__:
            assert getattr(module, name) is not None


TOP_LEVEL = {"README.md", "pyproject.toml", "rpim_opt", "problems", "tests", "studies", "dev.py"}
"""What the repository is made of."""
DEMANDED = {
    ".ci", ".github", ".gitignore", "LICENSE", "CHANGELOG.md", "CITATION.cff", "constraints.txt", "requirements.txt"
}  # fmt: skip
"""What tools look for at the top level: continuous integration, hosts, Git, package indexes, pip."""


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="no repository says what belongs to it")
def test_nothing_strays_to_the_top_level() -> None:
    names = subprocess.run(["git", "-C", ROOT, "ls-files"], capture_output=True, text=True, check=True).stdout
    assert {name.partition("/")[0] for name in names.splitlines()} == TOP_LEVEL | DEMANDED


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("compensate", "; did you mean rpim_opt.use.compensate?"),
        ("callibrate", "; did you mean rpim_opt.calibrate?"),
        ("quaternions_of_dragons", ""),
    ],
)
def test_a_name_that_is_not_at_the_top_says_where_it_is(name: str, advice: str) -> None:
    with pytest.raises(AttributeError) as caught:
        getattr(ro, name)
    assert str(caught.value) == f"module 'rpim_opt' has no attribute '{name}'{advice}"
    assert caught.value.obj is None  # else Python's own guess follows


def test_every_module_says_what_it_is_for() -> None:
    for module in MODULES:
        first = (ast.get_docstring(tree(module)) or "").partition("\n")[0]
        assert first.endswith((".", "?")), f"{module}: its first line states its responsibility"
