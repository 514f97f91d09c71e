"""Parsers and commands with inputs that nobody would write: accepted and meant, or refused in one sentence."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from random import Random

import pytest

from tests.fuzz import commands
from tests.fuzz.mutation import mutated
from tests.fuzz.parsers import PARSERS
from tests.fuzz.seeds import found, seeds, words
from tests.fuzz.trial import Failure, tried

COUNT = 60
"""Changed inputs a parser, in the suite that always runs."""
MANY = 1000


@pytest.mark.parametrize("name", PARSERS)
def test_what_was_found_before(tmp_path: Path, name: str) -> None:
    for path in found(name):
        answer = tried(name, path.read_bytes(), tmp_path)
        assert isinstance(answer, bool), f"{path.name}: {answer.text}"


@pytest.mark.parametrize("name", PARSERS)
def test_seeds_are_mostly_read(tmp_path: Path, name: str) -> None:
    """Otherwise what is changed were refused for another reason."""
    known = seeds(name)[: len(seeds(name)) - len(found(name))]
    answers = [tried(name, data, tmp_path) for data in known]
    failures = [answer.text for answer in answers if isinstance(answer, Failure)]
    assert not failures
    assert sum(answers) >= 0.4 * len(known)


def try_changed(name: str, folder: Path, count: int, seed: int) -> Counter[str]:
    rng = Random(f"{name} {seed}")
    known = seeds(name)
    vocabulary = words(name)
    answers: Counter[str] = Counter()
    for _ in range(count):
        data = mutated(rng, rng.choice(known), known, vocabulary)
        answer = tried(name, data, folder)
        assert isinstance(answer, bool), f"{data!r}\n{answer.place}\n{answer.text}"
        answers["accepted" if answer else "refused"] += 1
    return answers


@pytest.mark.parametrize("name", PARSERS)
def test_changed_inputs(tmp_path: Path, name: str) -> None:
    try_changed(name, tmp_path, COUNT, 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", PARSERS)
def test_many_changed_inputs(tmp_path: Path, name: str) -> None:
    answers = try_changed(name, tmp_path, MANY, 1)
    if name != "result":  # whose digest knows of nearly every change
        assert answers["accepted"] > 0


def run_commands(folder: Path, count: int, seed: int) -> Counter[int]:
    codes: Counter[int] = Counter()
    with commands.desk(folder / "desk"):
        for _, answer in commands.fuzz(Random(seed), count):
            assert not isinstance(answer, Failure), f"{answer.place}\n{answer.text}"
            codes[answer] += 1
    return codes


def test_commands(tmp_path: Path) -> None:
    codes = run_commands(tmp_path, 25, 0)
    assert codes[0] > 0
    assert codes[2] > 0


@pytest.mark.slow
def test_many_commands(tmp_path: Path) -> None:
    codes = run_commands(tmp_path, 500, 1)
    assert codes[0] > 50
