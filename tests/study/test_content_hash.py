"""Content hashes of arguments: the same for the same, another one for whatever computes otherwise, or a refusal."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd
import pytest
import scipy.sparse
from scipy.interpolate import CubicSpline

import rpim_opt as ro
from rpim_opt.study.studies import content_hash
from tests import ROOT


class Rule:
    """A selector somebody wrote, with a state and a method."""

    limit = 2.0

    def __init__(self, size: float):
        self.size = size

    def weight(self, problem: object) -> float:
        return self.size * self.limit


def power(r: float, exponent: float) -> float:
    return r**exponent


KINDS: dict[str, Callable[[float], Any]] = {
    "number": lambda k: k,
    "table": lambda k: {"a": [1.0, k]},
    "set": lambda k: {"a", "b", str(k)},
    "array": lambda k: np.array([1.0, k]),
    "random generator": lambda k: np.random.default_rng(int(k)),
    "data frame": lambda k: pd.DataFrame({"a": [1.0, k]}),
    "sparse matrix": lambda k: scipy.sparse.csr_array([[1.0, k]]),
    "spline": lambda k: CubicSpline([0, 1, 2], [0, k, 1]),
    "CasADi matrix": lambda k: ca.DM([k]),
    "object": Rule,
    "method": lambda k: Rule(k).weight,
    "partial": lambda k: partial(power, exponent=k),
    "formulation of the package": lambda k: ro.Formulation("mine", loss=ro.huber(k)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_arguments_are_their_content(kind: str) -> None:
    """Some of these were invisible once: figures of another matrix came back."""
    make = KINDS[kind]
    one, same, other = (content_hash([make(k)], "here") for k in (2.0, 2.0, 3.0))
    assert one == same
    assert one != other


@pytest.mark.slow
def test_other_processes_have_the_same_hashes() -> None:
    script = (
        "from tests.study.test_content_hash import KINDS, content_hash\nimport rpim_opt as ro\n"
        "for make in KINDS.values():\n    print(content_hash(make(2.0), ''))\n"
        "print(content_hash(ro.load('pose'), ''))\n"
    )
    done = [
        subprocess.run(
            [sys.executable, "-c", script], cwd=ROOT, env={**os.environ, "PYTHONHASHSEED": seed}, text=True,
            capture_output=True, check=True,
        ).stdout.split()
        for seed in ("1", "2")
    ]  # fmt: skip
    assert len(done[0]) == len(KINDS) + 1
    assert done[0] == done[1]


@pytest.mark.parametrize("thing", [(k for k in range(3)), lambda problem: 1.0, memoryview(b"a")])
def test_what_cannot_be_pickled_is_refused(thing: Any) -> None:
    with pytest.raises(ro.InputError, match="journal: found something that cannot be pickled") as refused:
        content_hash({"inside": [thing]}, "journal")
    assert "while hashing" not in str(refused.value)


def test_use_changes_no_hash() -> None:
    instance = ro.load("position")
    before = content_hash([instance, ro.tikhonov, ro.reml], "")
    instance.calibrate(formulation=ro.tikhonov, weight=ro.reml)
    assert content_hash([instance, ro.tikhonov, ro.reml], "") == before


def test_the_code_of_a_script_is_that_of_its_files(tmp_path: Path) -> None:
    script = "import helper\nfrom rpim_opt.study.studies import script_code\nprint(sorted(script_code().items()))\n"
    (tmp_path / "mine.py").write_text(script)
    said = []
    for helper, arguments in (("", []), ("", []), ("K = 2", []), ("", ["3"])):
        (tmp_path / "helper.py").write_text(helper)
        command = [sys.executable, "mine.py", *arguments]
        done = subprocess.run(
            command,
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            text=True,
            capture_output=True,
            check=True,
        )
        said.append(done.stdout)
    assert said[0] == said[1] == said[3]  # workers and the like may change between two halves of a run
    assert said[0] != said[2]
    for part in ("file mine.py", "file helper.py"):
        assert part in said[0]
    assert said[0].count("file ") == 2


def test_functions_of_a_session_have_no_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(power, "__module__", "__main__")
    monkeypatch.setattr(sys.modules["__main__"], "power", power, raising=False)
    monkeypatch.delattr(sys.modules["__main__"], "__file__", raising=False)
    with pytest.raises(ro.InputError, match="journal: found a function of an interactive session"):
        content_hash(power, "journal")
