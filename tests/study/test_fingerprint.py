"""Digests of what a comparison was given: the same for the same, another one for whatever computes otherwise."""

from __future__ import annotations

import importlib.util
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from rpim_opt.study.fingerprint import fingerprint


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


def module(folder: Path, text: str) -> ModuleType:
    path = folder / "mine.py"
    path.write_text(text)
    spec = importlib.util.spec_from_file_location("mine", path)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


SAME: dict[str, tuple[Any, Any]] = {
    "sets in any order": ({"b", "a", "c"}, {"c", "b", "a"}),
    "frozen sets": (frozenset([3, 1]), frozenset([1, 3])),
    "partial functions": (partial(power, exponent=2.0), partial(power, exponent=2.0)),
    "methods of objects that are alike": (Rule(1.0).weight, Rule(1.0).weight),
    "objects that are alike": (Rule(1.0), Rule(1.0)),
    "arrays of objects": (np.array(["a", None], dtype=object), np.array(["a", None], dtype=object)),
    "arrays of any layout": (np.arange(6.0).reshape(2, 3), np.asfortranarray(np.arange(6.0).reshape(2, 3))),
}
OTHER: dict[str, tuple[Any, Any]] = {
    "sets": ({"a", "b"}, {"a", "c"}),
    "a set and a frozen one": ({1}, frozenset([1])),
    "partial functions with another exponent": (partial(power, exponent=2.0), partial(power, exponent=3.0)),
    "partial functions with a place for a name": (partial(power, 2.0), partial(power, exponent=2.0)),
    "methods of other objects": (Rule(1.0).weight, Rule(2.0).weight),
    "methods of another class": (Rule(1.0).weight, Other(1.0).weight),
    "objects": (Rule(1.0), Rule(2.0)),
    "classes": (Rule, Other),
    "arrays of objects": (np.array(["a", None], dtype=object), np.array(["a", 1], dtype=object)),
    "arrays of another shape": (np.zeros((2, 3)), np.zeros((3, 2))),
    "arrays of another precision": (np.zeros(2), np.zeros(2, dtype=np.float32)),
}


@pytest.mark.parametrize("what", SAME)
def test_the_same_has_one_digest(what: str) -> None:
    one, other = SAME[what]
    assert fingerprint(one) == fingerprint(other)


@pytest.mark.parametrize("what", OTHER)
def test_what_is_not_the_same_has_two(what: str) -> None:
    one, other = OTHER[what]
    assert fingerprint(one) != fingerprint(other)


def test_a_class_is_what_it_computes(monkeypatch: pytest.MonkeyPatch) -> None:
    digests = [fingerprint(Rule(1.0))]
    monkeypatch.setattr(Rule, "limit", 3.0)
    digests.append(fingerprint(Rule(1.0)))
    monkeypatch.setattr(Rule, "weight", Other.weight)
    digests.append(fingerprint(Rule(1.0)))
    assert len(set(digests)) == 3


def test_a_module_that_a_script_reads_is_its_file(tmp_path: Path) -> None:
    """Also where it is no module that anybody else may import."""
    one = module(tmp_path, "FACTOR = 2.0\n")
    before = fingerprint(one)
    assert fingerprint(module(tmp_path, "FACTOR = 2.0\n")) == before
    assert fingerprint(module(tmp_path, "FACTOR = 3.0\n")) != before


def test_a_closure_that_holds_nothing_yet_has_a_digest() -> None:
    def made() -> tuple[Any, Any]:
        def loss(r: float) -> float:
            return r * later

        before = fingerprint(loss)
        later = 2.0
        return before, fingerprint(loss)

    before, after = made()
    assert before != after


def test_circles_end() -> None:
    loop: list[Any] = [1.0]
    loop.append(loop)
    other: list[Any] = [2.0]
    other.append(other)
    assert fingerprint(loop) != fingerprint(other)
