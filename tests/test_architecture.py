"""Imports point one way, and heavy ones wait until they are needed."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

PACKAGE = Path(__file__).parents[1] / "rpim_opt"
NUMERIC = {"numpy", "scipy"}
ORDER = {
    "exceptions": set(),
    "units": set(),
    "files": {"pydantic", "pydantic_core"},
    "robot": {"pydantic"},
    "phases": set(),
    "threads": {"threadpoolctl"},
    "kinematics": {"casadi"},
    "compiled": {"casadi"},
    "parameters": {"casadi"},
    "measurement": {"casadi"},
    "tables": set(),
    "dataset": set(),
    "problem": {"casadi"},
    "observability": set(),
    "frames": set(),
    "constraints": {"cvxpy"},
    "conic": {"clarabel", "cvxpy"},
    "formulation": {"cvxpy"},
    "streaming": {"cvxpy"},
    "selection": {"cvxpy"},
    "text": {"rich"},
    "markup": set(),
    "record": {"cvxpy", "pydantic"},
    "calibration": {"cvxpy", "casadi"},
    "summary": set(),
    "uncertainty": set(),
    "naming": set(),
    "validation": set(),
    "results": set(),
    "baselines": set(),
    "design": set(),
    "compensation": {"casadi"},
    "plots": {"matplotlib"},
    "svg": set(),
    "report": set(),
    "inspection": set(),
    "exchange.chain": {"casadi"},
    "exchange.urdf": set(),
    "exchange.universal_robots": set(),
    "exchange.plain": set(),
    "exchange.export": set(),
    "instances": {"pydantic", "cvxpy"},
    "starting": set(),
    "simulation": {"pydantic"},
    "study": {"distributed", "joblib", "matplotlib", "pyarrow"},
    "cli": {"typer", "rich"},
}


def imported(module: str) -> set[str]:
    tree = ast.parse((PACKAGE / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8"))
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    return names


def test_every_module_has_its_place() -> None:
    files = [p.relative_to(PACKAGE).with_suffix("") for p in PACKAGE.rglob("*.py") if p.stem != "__init__"]
    assert {".".join(f.parts) for f in files} == set(ORDER)


@pytest.mark.parametrize("module", ORDER)
def test_a_module_imports_only_modules_above_it(module: str) -> None:
    above = set(list(ORDER)[: list(ORDER).index(module)])
    for name in imported(module):
        top, _, rest = name.partition(".")
        if top == "rpim_opt":
            assert rest in above, f"{module} imports {name}, which is not above it"
        else:
            assert top in sys.stdlib_module_names | NUMERIC | ORDER[module], f"{module} imports {name}"


@pytest.mark.parametrize(
    "code", ["import rpim_opt", "from rpim_opt.cli import app; app(['--help'], standalone_mode=False)"]
)
def test_heavy_libraries_wait_until_they_are_used(code: str) -> None:
    heavy = "{'cvxpy', 'casadi', 'numpy', 'scipy', 'pydantic'}"
    script = f"{code}\nimport sys\nloaded = {heavy} & set(sys.modules)\nassert not loaded, loaded"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_public_names_exist() -> None:
    import rpim_opt as ro

    for name in ro.__all__:
        assert not isinstance(getattr(ro, name), ModuleType), f"the module {name} hides what it is named after"
    with pytest.raises(AttributeError, match="no attribute 'callibrate'"):
        ro.callibrate  # noqa: B018
