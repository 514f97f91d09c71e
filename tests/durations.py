"""Choice of the default suite: which cases of long tests it runs, by the processor time of each test.

``python -m tests.durations`` runs everything but the cases that `conftest.py` calls slow, and writes `cases.toml` anew.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import tomllib
from collections import defaultdict
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path

import pytest

FILE = Path(__file__).with_name("cases.toml")
MOST, LONGEST = 0.5, 0.9
"""Processor time [s] of all cases of a test, and of a test without cases, that the default suite spends."""
HEAD = """\
# Number of cases that the default suite runs of a test that takes long, spread over all of them; the others are slow.
# Made by `python -m tests.durations`, from processor times of the tests.
"""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, bool | None, bool | None]:
    """Append the processor time of a test to a file."""
    begin = os.times()
    done = yield
    seconds = sum(os.times()[:4]) - sum(begin[:4])
    with open(os.environ["DURATIONS"], "a", encoding="utf-8") as file:
        file.write(json.dumps([item.nodeid, seconds]) + "\n")
    return done


def chosen(seconds: Mapping[str, Sequence[float]]) -> dict[str, int]:
    """Return how many cases the default suite runs of tests that take longer than it may, by test."""
    found = {}
    for test, cases in seconds.items():
        total = sum(cases)
        if total > (MOST if len(cases) > 1 else LONGEST):
            found[test] = max(int(MOST * len(cases) / total), int(len(cases) > 1 and min(cases) <= LONGEST))
    return found


def main() -> None:
    """Measure the tests that are not slow, and write the file."""
    seconds: dict[str, list[float]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "durations.jsonl"
        which = "not slow or long"
        command = [sys.executable, "-m", "pytest", "-p", "tests.durations", "-n", "2", "-m", which]
        subprocess.run(command, env={**os.environ, "DURATIONS": str(log)}, check=False)
        for line in log.read_text(encoding="utf-8").splitlines():
            test, spent = json.loads(line)
            seconds[test.partition("[")[0]].append(spent)
    lines = [f'"{test}" = {count}\n' for test, count in sorted(chosen(seconds).items())]
    FILE.write_text(HEAD + "".join(lines), encoding="utf-8")


def cases() -> dict[str, int]:
    """Return the content of the file."""
    return tomllib.loads(FILE.read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
