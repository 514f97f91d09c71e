"""What commands say on a console: results, what was written, what goes on, and what is wrong."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Timer
from typing import Any, TextIO


def show(text: object, document: dict[str, Any], as_json: bool) -> None:
    """Print one or the other."""
    if as_json:
        from rpim_opt.basics.files import json_text

        text = json_text(document).rstrip("\n")
    _say(str(text), sys.stdout)


def _say(text: str, stream: TextIO) -> None:
    """Print a text in which nothing is a command to a terminal, and know whether it arrived."""
    from rpim_opt.basics.text import visible

    shown = visible(text)
    encoding = getattr(stream, "encoding", None) or "utf-8"
    print(shown.encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)


@contextmanager
def arriving() -> Iterator[None]:
    """End quietly when nobody reads any more, and with a sentence for what the system refuses."""
    try:
        yield
    except BrokenPipeError:
        _close(sys.stdout)
        sys.exit(1)
    except OSError as error:
        if error.filename is not None:  # a name that is too long, a folder that nobody may look into
            fail(f"{error.filename}: {error.strerror}.", 2)
        _close(sys.stdout)
        fail(f"The output cannot be written: {error}.", 2)


def _close(stream: TextIO) -> None:
    """Let go of what a stream still holds; Python would try to write it at the end."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def fail(text: str, code: int) -> None:
    """Say on stderr what is wrong, as JSON where that was asked for, and end."""
    if "--json" in sys.argv:
        from rpim_opt.basics.files import json_text

        text = json_text({"error": text}).rstrip("\n")
    try:
        _say(text, sys.stderr)
    except OSError:  # nobody can be told
        _close(sys.stderr)
    sys.exit(code)


def written_to(path: Path | None, text: str) -> list[Path]:
    """Write a text where a path is given."""
    from rpim_opt.basics.writing import refused, write_text

    if path is None:
        return []
    with refused(path):
        write_text(path, text)
    return [path]


def written_line(path: Path | None) -> str:
    """Return the line that says so."""
    return f"\nWritten: {path}" if path else ""


def left_out_line(columns: Sequence[str]) -> str:
    """Return the line that names columns that were not read."""
    return f"\nColumns that were left out: {', '.join(columns)}." if columns else ""


@contextmanager
def progress() -> Iterator[Callable[[str], None]]:
    """Show what is going on, once it has taken a second, where a person is watching."""
    from rich.console import Console

    console = Console(stderr=True)
    status = console.status("starting")
    timer = Timer(1.0, status.start)
    timer.daemon = True
    if console.is_terminal:
        timer.start()
    try:
        yield lambda text: status.update(text)
    finally:
        timer.cancel()
        status.stop()
