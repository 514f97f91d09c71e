"""How far a long computation is, with the time that is left, where a person is watching."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

Told = Callable[[int, int], None]
"""Told how many of how many are done."""


@contextmanager
def shown(name: str, wanted: bool | Told = True) -> Iterator[Told]:
    """Give what is told how many of how many are done.

    Parameters
    ----------
    name
        What stands before the bar.
    wanted
        Whether there is a bar on stderr, if that is a terminal or a notebook with widgets; or a function to be told.
    """
    if callable(wanted):
        yield wanted
        return
    console = Console(stderr=True)
    columns = (TextColumn(name), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    drawable = console.is_jupyter and find_spec("ipywidgets") is not None  # which rich asks for, with a warning
    visible = wanted and (console.is_terminal or drawable)
    with Progress(*columns, console=console, transient=True, disable=not visible) as bar:
        task = bar.add_task(name, total=None)
        yield lambda done, every: bar.update(task, completed=done, total=every)
