"""Content hashes of arguments: the same for the same, another one for whatever computes otherwise, or a refusal."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections import OrderedDict, deque
from collections.abc import Callable
from datetime import date, timedelta
from decimal import Decimal
from fractions import Fraction
from functools import lru_cache, partial
from pathlib import Path
from threading import Lock
from types import ModuleType, SimpleNamespace
from typing import Any

import casadi as ca
import cvxpy as cp
import numpy as np
import pandas as pd
import pytest
import scipy.sparse
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.study.content_hash import content_hash
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


class Slots:
    __slots__ = ("size",)

    def __init__(self, size: float):
        self.size = size


def power(r: float, exponent: float) -> float:
    return r**exponent


def cached(k: float) -> Any:
    @lru_cache
    def inner(r: float) -> float:
        return r * k

    return inner


def closure(thing: Any) -> Callable[[], Any]:
    return lambda: thing


def casadi_function(k: float) -> Any:
    x = ca.SX.sym("x")
    return ca.Function("f", [x], [k * x])


def module(folder: Path, text: str) -> ModuleType:
    path = folder / "mine.py"
    path.write_text(text)
    spec = importlib.util.spec_from_file_location("mine", path)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


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
    "rotation": lambda k: Rotation.from_rotvec([0, 0, 1 / k]),
    "CasADi matrix": lambda k: ca.DM([k]),
    "CasADi function": casadi_function,
    "CVXPY constant": lambda k: cp.Constant(np.array([k])),
    "CVXPY parameter": lambda k: cp.Parameter(value=k),
    "CVXPY expression": lambda k: cp.sum_squares(k * cp.Variable(2, nonneg=True)),
    "deque": lambda k: deque([k]),
    "range": lambda k: range(int(k)),
    "decimal": Decimal,
    "fraction": lambda k: Fraction(k),
    "date": lambda k: date(2026, 1, int(k)),
    "time": lambda k: timedelta(k),
    "name space": lambda k: SimpleNamespace(k=k),
    "object with slots": Slots,
    "object": Rule,
    "method": lambda k: Rule(k).weight,
    "partial": lambda k: partial(power, exponent=k),
    "closure": lambda k: lambda r: k * r,
    "default": lambda k: lambda r, k=k: k * r,
    "cached function": cached,
    "np.vectorize": lambda k: np.vectorize(lambda r: k * r),
    "formulation": lambda k: ro.Formulation("mine", loss=lambda r: cp.sum(cp.huber(r, k)), penalty=cp.sum_squares),
    "formulation of the package": lambda k: ro.huber(k),
}


@pytest.mark.parametrize("kind", KINDS)
def test_arguments_are_their_content(kind: str) -> None:
    """Twenty of these were invisible once: figures of another matrix came back."""
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


def test_a_class_is_what_it_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    digests = [content_hash(Rule(1.0), "")]
    monkeypatch.setattr(Rule, "limit", 3.0)
    digests.append(content_hash(Rule(1.0), ""))
    monkeypatch.setattr(Rule, "weight", Other.weight)
    digests.append(content_hash(Rule(1.0), ""))
    assert len(set(digests)) == 3


def test_functions_are_known_by_what_they_do() -> None:
    spaces: list[dict] = [{}, {}, {}]
    for space, body in zip(spaces, ("return a * 2", "return a * 3", "\n    return a * 2"), strict=True):
        exec(f"def inner(a): {body}\ndef outer(a): return inner(a)\n", space)
    first, other, lower = (content_hash(space["outer"], "") for space in spaces)
    assert first != other  # the function that it calls
    assert first == lower  # where it stands


def test_a_module_that_a_script_reads_is_its_file_and_what_is_read_of_it(tmp_path: Path) -> None:
    """Also where it is no module that anybody else may import."""

    def using(mine: ModuleType) -> Callable[[], float]:
        space = {"mine": mine}
        exec("def function(): return mine.FACTOR", space)
        return space["function"]

    one = module(tmp_path, "FACTOR = 2.0\n")
    before = content_hash(using(one), "")
    assert content_hash(using(module(tmp_path, "FACTOR = 2.0\n")), "") == before
    one.FACTOR = 4.0
    assert content_hash(using(one), "") != before
    assert content_hash(using(module(tmp_path, "FACTOR = 3.0\n")), "") != before


def test_a_closure_that_holds_nothing_yet_has_a_digest() -> None:
    def made() -> tuple[Any, Any]:
        def loss(r: float) -> float:
            return r * later

        before = content_hash(loss, "")
        later = 2.0
        return before, content_hash(loss, "")

    before, after = made()
    assert before != after


def test_functions_may_call_many_others() -> None:
    hashes = set()
    for last in ("return x", "return 2 * x"):
        space: dict[str, Any] = {}
        exec("".join(f"def f{k}(x): return f{k + 1}(x)\n" for k in range(300)) + f"def f300(x): {last}", space)
        hashes.add(content_hash(space["f0"], ""))
    assert len(hashes) == 2


def test_circles_end() -> None:
    loop: list[Any] = [1.0]
    loop.append(loop)
    other: list[Any] = [2.0]
    other.append(other)
    assert content_hash(loop, "") != content_hash(other, "")
    space: dict[str, Any] = {}
    exec("def even(n): return n == 0 or odd(n - 1)\ndef odd(n): return n != 0 and even(n - 1)", space)
    assert content_hash(space["even"], "") != content_hash(space["odd"], "")
