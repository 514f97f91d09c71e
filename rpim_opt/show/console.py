"""What commands say on a console: results, what was written, what goes on, and what is wrong."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Timer
from typing import Any


def show(text: object, document: dict[str, Any], as_json: bool) -> None:
    """Print one or the other."""
    if as_json:
        from rpim_opt.basics.files import json_text

        text = json_text(document).rstrip("\n")
    print(text)  # noqa: T201


def fail(text: str, code: int) -> None:
    """Say on stderr what is wrong, as JSON where that was asked for, and end."""
    if "--json" in sys.argv:
        from rpim_opt.basics.files import json_text

        text = json_text({"error": text}).rstrip("\n")
    print(text, file=sys.stderr)  # noqa: T201
    sys.exit(code)


def written_to(path: Path | None, text: str) -> list[Path]:
    """Write a text where a path is given."""
    from rpim_opt.basics.files import refused, write_text

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
