"""One input tried: accepted, refused in one sentence, or a failure."""

from __future__ import annotations

import signal
import traceback
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from time import process_time
from types import FrameType
from typing import NamedTuple

from rpim_opt.basics.exceptions import RpimError
from tests.fuzz.parsers import PARSERS

LONGEST = 5.0
"""Seconds of the processor that an input may take."""
PATIENCE = 60.0
"""Seconds after which it is broken off, on a machine that does other things, too."""
LONGEST_SENTENCE = 5000


class Failure(NamedTuple):
    """An input that was neither accepted nor refused as it should be."""

    place: str
    text: str


class Hang(BaseException):
    """An input took too long."""


def _late(number: int, frame: FrameType | None) -> None:
    raise Hang("took too long")


@contextmanager
def limited(seconds: float):
    """Break off what takes longer; on systems without alarms nothing is."""
    if not hasattr(signal, "setitimer"):
        yield
        return
    if signal.getsignal(signal.SIGALRM) is not _late:
        signal.signal(signal.SIGALRM, _late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def tried(name: str, data: bytes, folder: Path) -> Failure | bool:
    """Return whether a parser accepts an input, or how it fails."""
    return attempt(lambda: PARSERS[name](data, folder))


def attempt(what: Callable[[], object]) -> Failure | bool:
    """Return whether something is done without an error, or refused; or how it fails."""
    began = process_time()
    accepted = True
    try:
        with limited(PATIENCE):
            what()
    except RpimError as error:
        text = str(error)
        if "\n" in text or len(text) > LONGEST_SENTENCE:
            return Failure(f"sentence of {type(error).__name__}: {error.args}"[:200], text)
        accepted = False
    except (Exception, Hang) as error:
        return failure(error)
    if process_time() - began > LONGEST:
        return Failure("slow", f"{process_time() - began:.1f} s")
    return accepted


def failure(error: BaseException) -> Failure:
    """Return what failed where: its last line of ours names it."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "rpim_opt/" in frame.filename or "fuzz/parsers" in frame.filename]
    last = ours[-1] if ours else frames[-1]
    place = f"{type(error).__name__} {Path(last.filename).name}:{last.name}:{last.lineno}"
    return Failure(place, "".join(traceback.format_exception(error))[-4000:])
