"""Fuzz for as long as it is let: ``python -m tests.fuzz SECONDS FOLDER [PARSER...]``; failures go to the folder.

``python -m tests.fuzz sum FOLDER...`` counts what was tried in all of them, commands included, as a table.

Where atheris is installed, an input that reaches a branch that none has reached is kept, and changed further
(libFuzzer; half of the changes are those of `mutation`). Without it the changes are of the seeds alone. One process
per parser, one after the other: libFuzzer ends its own.
"""

from __future__ import annotations

import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from time import monotonic

LARGEST_GROWTH = 500_000
"""Kilobytes that one input may make the process grow."""
EACH = 60.0


def main(arguments: list[str]) -> int:
    """Fuzz parsers in turn, a minute each, until the time is over."""
    if arguments[0] == "sum":
        sys.stdout.write(summed([Path(folder) for folder in arguments[1:]]) + "\n")
        return 0
    if arguments[0] == "one":
        return one(arguments[1], float(arguments[2]), Path(arguments[3]), int(arguments[4]))
    from tests.fuzz.parsers import PARSERS

    end = monotonic() + float(arguments[0])
    folder = Path(arguments[1])
    folder.mkdir(parents=True, exist_ok=True)
    turn = 0
    while monotonic() < end:
        for name in arguments[2:] or PARSERS:
            seconds = min(EACH, end - monotonic())
            if seconds > 1:
                command = [sys.executable, "-m", "tests.fuzz", "one", name, str(seconds), str(folder), str(turn)]
                subprocess.run(command, check=False, stderr=subprocess.DEVNULL)
        turn += 1
    return 0


def one(name: str, seconds: float, folder: Path, turn: int) -> int:
    """Fuzz one parser, and write down how many inputs were tried, accepted, and what failed."""
    guided = find_spec("atheris") is not None
    if guided:
        import atheris

        with atheris.instrument_imports(include=["rpim_opt"], enable_loader_override=False):
            import tests.fuzz.parsers  # noqa: F401
    from tests.fuzz.mutation import mutated
    from tests.fuzz.seeds import seeds, words
    from tests.fuzz.trial import tried

    warnings.simplefilter("error")
    rng = random.Random(f"{name} {turn} {os.getpid()}")
    counts = {"parser": name, "guided": guided, "tried": 0, "accepted": 0, "failed": 0}
    known = seeds(name)
    vocabulary = words(name)
    end = monotonic() + seconds
    with tempfile.TemporaryDirectory(dir=_memory()) as place:
        scratch = Path(place) / "scratch"
        scratch.mkdir()
        said = folder / f"{name}-{turn}.json"

        def step(data: bytes) -> None:
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            found = tried(name, data, scratch)
            counts["tried"] += 1
            grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
            if grown > LARGEST_GROWTH:
                _keep(folder, name, "memory", f"{grown} kB", data)
            if found is True:
                counts["accepted"] += 1
            elif found is not False:
                counts["failed"] += 1
                _keep(folder, name, found.place, found.text, data)
            if counts["tried"] % 256 == 0:
                said.write_text(json.dumps(counts))
                if monotonic() > end:
                    os._exit(0)  # libFuzzer has no other end

        for data in known:
            step(data)
        if not guided:
            while monotonic() < end:
                step(mutated(rng, rng.choice(known), known, vocabulary))
            return 0
        corpus = folder / f"reached-{name}"
        corpus.mkdir(exist_ok=True)
        for number, data in enumerate(known):
            (corpus / f"seed{number}").write_bytes(data)

        def change(data: bytes, largest: int, seed: int) -> bytes:
            if rng.random() < 0.5:
                return atheris.Mutate(data, largest)
            return mutated(rng, data, known, vocabulary)[:largest]

        options = ["fuzz", str(corpus), "-max_len=20000", "-timeout=60", "-rss_limit_mb=0", "-verbosity=0", "-reload=0"]
        atheris.Setup([*options, f"-seed={turn + 1}"], step, custom_mutator=change)
        atheris.Fuzz()
    return 0


def summed(folders: list[Path]) -> str:
    """Return what was tried of every parser, and how commands ended, as Markdown."""
    from rpim_opt.basics.text import markdown

    parsers: dict[str, Counter[str]] = {}
    codes: Counter[str] = Counter()
    for file in sorted(file for folder in folders for file in folder.glob("*-*.json")):
        counts = json.loads(file.read_text())
        name = counts.pop("parser", None)
        if name is None:
            codes.update(counts)
            continue
        numbers = {key: counts[key] for key in ("tried", "accepted", "failed")}
        parsers.setdefault(name, Counter()).update(numbers)
    parsers["all"] = sum(parsers.values(), Counter())
    rows = [[name, *(f"{each[key]:,}" for key in ("tried", "accepted", "failed"))] for name, each in parsers.items()]
    ended = [[code, f"{count:,}"] for code, count in sorted(codes.items())]
    ended.append(["all", f"{codes.total():,}"])
    return markdown(["parser", "tried", "accepted", "failed"], rows) + "\n\n" + markdown(["code", "commands"], ended)


def _memory() -> str | None:
    return "/dev/shm" if os.path.isdir("/dev/shm") else None


def _keep(folder: Path, name: str, place: str, text: str, data: bytes) -> None:
    """Keep the shortest input that fails in a place."""
    file = folder / f"failed-{name}-{sha256(place.encode()).hexdigest()[:10]}"
    if not file.exists() or len(data) < file.stat().st_size:
        file.write_bytes(data)
        file.with_suffix(".txt").write_text(f"{place}\n{text}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
