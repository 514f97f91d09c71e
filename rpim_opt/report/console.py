"""Terminal input and output of the command line: parsing of options, printing, errors and exit codes."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from math import radians
from pathlib import Path
from shutil import get_terminal_size
from textwrap import TextWrapper
from typing import TYPE_CHECKING, Any, TextIO

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import json_text, write_text
from rpim_opt.basics.text import visible
from rpim_opt.basics.units import LARGEST

if TYPE_CHECKING:
    from rpim_opt.data.record import Requirement


def show(text: str | dict[str, Any], stream: TextIO | None = None) -> None:
    """Print a text without control characters, or a document; a closed pipe does not change the exit code."""
    stream = stream or sys.stdout
    lines = visible(text if isinstance(text, str) else json_text(text).rstrip("\n")).split("\n")
    if stream and stream.isatty():  # break sentences at words; rows of tables, with wider gaps, stay lines
        wrapper = TextWrapper(get_terminal_size().columns, break_long_words=False, break_on_hyphens=False)
        lines = [line if "  " in line else wrapper.fill(line) for line in lines]
    encoding = getattr(stream, "encoding", None) or "utf-8"
    try:
        print("\n".join(lines).encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)
    except BrokenPipeError:
        _close(stream or sys.stdout)


def fail(text: str, code: int) -> None:
    """Print an error on stderr, as JSON with ``--json``, and end with an exit code."""
    try:
        show({"error": text} if "--json" in sys.argv else text, sys.stderr)
    except OSError:  # the reader has closed it
        _close(sys.stderr)
    sys.exit(code)


@contextmanager
def output_errors() -> Iterator[None]:
    """Exit with a sentence for errors of the operating system."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:  # a name that is too long, or a folder without permission
            fail(f"{error.filename}: {error.strerror}.", 2)
        _close(sys.stdout)
        fail(f"The output cannot be written: {error}.", 2)


def _close(stream: TextIO) -> None:
    """Drop what a stream still holds; Python would try to write it at exit."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


@contextmanager
def progress() -> Iterator[Callable[[str], None]]:
    """Show the current step, on an interactive terminal only."""
    from rich.console import Console
    from rich.live import Live
    from rich.spinner import Spinner

    console = Console(stderr=True)
    step = Spinner("dots", "starting", style="status.spinner")
    # what is printed meanwhile into a file or a pipe is not for the terminal
    with Live(step, console=console, transient=True, refresh_per_second=12.5, redirect_stdout=sys.stdout.isatty()):
        yield lambda text: step.update(text=text)


def written_to(path: Path | None, text: str) -> list[Path]:
    """Write a table if a path is given, and return the paths written; refuse a controller's format."""
    if path is None:
        return []
    if path.suffix.lower() not in ("", ".csv", ".txt"):
        raise InputError("--out", f"'{path}'", "a table, .csv: no program of a controller is written")
    write_text(path, text)
    return [path]


def require_positive(where: str, value: float | None) -> None:
    """Raise InputError for a limit that is not positive."""
    if value is not None and not value > 0:
        raise InputError(where, f"{value:g}", "a number greater than zero [mm]")


def _numbers(option: str, text: str, counts: tuple[int, ...], accepted: str, least: float = -LARGEST) -> list[float]:
    """Return the numbers of ``1,2,3``; InputError for another count of them, or one that is out of range."""
    values: list[float] = []
    with suppress(ValueError):
        values = [float(part) for part in text.split(",")]
    if len(values) not in counts or not all(abs(value) < LARGEST for value in values) or values[0] < least:
        raise InputError(option, f"'{text}'", accepted)
    return values


def tool_frame(text: str | None) -> list[float] | None:
    """Return the tool frame [m, rad] of ``--tool``."""
    if text is None:
        return None
    values = _numbers("--tool", text, (6,), "six numbers: x,y,z [mm], roll,pitch,yaw [deg]")
    return [*(1e-3 * v for v in values[:3]), *(radians(v) for v in values[3:])]


def touched_point(text: str | None) -> list[float] | None:
    """Return the point [m] of ``--point``."""
    accepted = "x,y,z [mm] in the robot's base frame"
    return None if text is None else [1e-3 * v for v in _numbers("--point", text, (3,), accepted)]


def payload_of(text: str | None) -> tuple[float | None, list[float] | None]:
    """Return mass [kg] and centre of mass [m], or None, of ``--payload``."""
    if text is None:
        return None, None
    mass, *centre = _numbers("--payload", text, (1, 4), "a mass [kg], or mass and centre: kg,x,y,z [mm]", least=0.0)
    return mass, [1e-3 * v for v in centre] or None


def requirement_of(
    limit: float | None, box: str | None, measured: bool | None, stated: Requirement | None
) -> Requirement | None:
    """Return the requirement of ``--limit`` [mm], ``--box`` and ``--measured``, which override the stated one's."""
    from rpim_opt.data.record import Requirement

    require_positive("--limit", limit)
    if limit is None and stated is None:
        if box is not None:
            raise InputError("--box", "no limit", "--limit with it [mm]")
        return None
    changes: dict[str, Any] = {}
    if limit is not None:
        changes["limit"] = 1e-3 * limit
    if box is not None:
        ends = [1e-3 * end for end in _numbers("--box", box, (6,), "six numbers: x0,x1,y0,y1,z0,z1 [mm]")]
        changes["box"] = tuple(zip(ends[::2], ends[1::2], strict=True))
    if measured is not None:
        changes["measured"] = measured
    return replace(stated or Requirement(limit=1.0), **changes)


def listed_words(text: str) -> list[str]:
    """Return the words of ``tikhonov,robust``."""
    return [word.strip() for word in text.split(",") if word.strip()]


def listed_numbers(text: str) -> list[str | int | float]:
    """Return the words of ``learned,1.0``, those that are numbers as numbers."""

    def value(word: str) -> str | int | float:
        try:
            number = float(word)
        except ValueError:
            return word
        return int(number) if number.is_integer() else number

    return [value(word) for word in listed_words(text)]
