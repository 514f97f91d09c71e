"""Content hashes of arguments: the same for the same, another one for whatever computes otherwise, or a refusal."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any

import casadi as ca
import cvxpy as cp
import numpy as np
import pandas as pd
import pytest
import scipy.sparse
from scipy.interpolate import CubicSpline

import rpim_opt as ro
from rpim_opt.study.replicates import content_hash
from tests import ROOT


class Rule:
    """A selector somebody wrote, with a state and a method."""

    limit = 2.0

    def __init__(self, size: float):
        self.size = size

    def weight(self, problem: object) -> float:
        return self.size * self.limit


class Other(Rule):
    """The same rule, read otherwise."""

    def weight(self, problem: object) -> float:
        return self.size / self.limit


def power(r: float, exponent: float) -> float:
    return r**exponent


def closure(thing: Any) -> Callable[[], Any]:
    return lambda: thing


KINDS: dict[str, Callable[[float], Any]] = {
    "number": lambda k: k,
    "list": lambda k: [1.0, k],
    "table": lambda k: {"a": k},
    "ordered table": lambda k: OrderedDict(a=k),
    "set": lambda k: {"a", "b", str(k)},
    "frozen set": lambda k: frozenset(["a", "b", str(k)]),
    "array": lambda k: np.array([1.0, k]),
    "array of objects": lambda k: np.array(["a", k], dtype=object),
    "masked array": lambda k: np.ma.masked_array([1.0, 2.0], mask=[k > 2.5, False]),
    "random generator": lambda k: np.random.default_rng(int(k)),
    "data frame": lambda k: pd.DataFrame({"a": [1.0, k]}),
    "sparse matrix": lambda k: scipy.sparse.csr_array([[1.0, k]]),
    "spline": lambda k: CubicSpline([0, 1, 2], [0, k, 1]),
    "CasADi matrix": lambda k: ca.DM([k]),
    "object": Rule,
    "method": lambda k: Rule(k).weight,
    "partial": lambda k: partial(power, exponent=k),
    "closure": lambda k: lambda r: k * r,
    "default": lambda k: lambda r, k=k: k * r,
    "np.vectorize": lambda k: np.vectorize(lambda r: k * r),
    "formulation": lambda k: ro.Formulation("mine", loss=lambda r: k * cp.sum_squares(r), penalty=cp.sum_squares),
    "formulation of the package": lambda k: ro.huber(k),
}


@pytest.mark.parametrize("kind", KINDS)
def test_arguments_are_their_content(kind: str) -> None:
    """Some of these were invisible once: figures of another matrix came back."""
    make = KINDS[kind]
    for wrap in (lambda thing: thing, closure):
        one, same, other = (content_hash(wrap(make(k)), "here") for k in (2.0, 2.0, 3.0))
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


@pytest.mark.parametrize(
    ("thing", "name"),
    [
        ((k for k in range(3)), "generator"),
        (Lock(), "lock"),
        (ca.SX.sym("x"), "SX"),
        (memoryview(b"a"), "memoryview"),
    ],
)
def test_what_has_no_content_is_refused_by_its_name(thing: Any, name: str) -> None:
    with pytest.raises(ro.InputError, match=rf"journal: found a [\w.]*{name}, whose content cannot be hashed"):
        content_hash({"inside": closure([thing])}, "journal")


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (np.zeros((2, 3)), np.zeros((3, 2))),
        (np.zeros(2), np.zeros(2, dtype=np.float32)),
        ({1}, frozenset([1])),
        (partial(power, 2.0), partial(power, exponent=2.0)),
        (Rule(1.0).weight, Other(1.0).weight),
        (Rule, Other),
        (ro.reml, ro.gcv),
        (ro.load("pose"), ro.load("position")),
    ],
)
def test_what_is_not_the_same_has_two(one: Any, other: Any) -> None:
    assert content_hash(one, "") != content_hash(other, "")


def test_arrays_of_any_layout_are_the_same() -> None:
    array = np.arange(6.0).reshape(2, 3)
    assert content_hash(array, "") == content_hash(np.asfortranarray(array), "")


def test_use_changes_no_hash() -> None:
    instance = ro.load("position")
    before = content_hash([instance, ro.tikhonov, ro.reml], "")
    instance.calibrate(formulation=ro.tikhonov, weight=ro.reml)
    assert content_hash([instance, ro.tikhonov, ro.reml], "") == before


def test_the_code_of_a_script_is_that_of_its_files(tmp_path: Path) -> None:
    script = "import helper\nfrom rpim_opt.study.replicates import script_code\nprint(sorted(script_code().items()))\n"
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
    assert said[0] == said[1]
    assert len(set(said)) == 3
    for part in ("file mine.py", "file helper.py", "set of arguments of the script"):
        assert part in said[0]
    assert said[0].count("file ") == 2


def test_functions_of_a_session_have_no_file(monkeypatch: pytest.MonkeyPatch) -> None:
    typed = closure(2.0)
    typed.__module__ = "__main__"
    monkeypatch.delattr(sys.modules["__main__"], "__file__", raising=False)
    with pytest.raises(ro.InputError, match=r"journal: found .* of an interactive session"):
        content_hash(typed, "journal")


def test_a_closure_that_holds_nothing_yet_has_a_digest() -> None:
    def made() -> tuple[Any, Any]:
        def loss(r: float) -> float:
            return r * later

        before = content_hash(loss, "")
        later = 2.0
        return before, content_hash(loss, "")

    before, after = made()
    assert before != after


def test_circles_end() -> None:
    loop: list[Any] = [1.0]
    loop.append(loop)
    other: list[Any] = [2.0]
    other.append(other)
    assert content_hash(loop, "") != content_hash(other, "")


def test_a_function_that_calls_itself_ends() -> None:
    def even(n: int) -> bool:
        return n == 0 or not even(n - 1)

    assert content_hash(even, "") == content_hash(even, "")
