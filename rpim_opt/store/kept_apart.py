"""Which rows of a new problem folder identify, and which are kept apart for validation."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.models import Measurement
from rpim_opt.data.tables.reading import read_data
from rpim_opt.robot.chain import Described
from rpim_opt.store.raw import Understanding, understand_of
from rpim_opt.store.seen_target import SeenTarget


class Reading(NamedTuple):
    """How tables are read."""

    arm: Described
    kind: Measurement
    noise: Mapping[str, float]
    seen: SeenTarget

    def rows(self, file: str | Path, columns: Columns) -> Dataset:
        """Return the rows of a table; errors name its file."""
        try:
            return read_data(self.seen.under(columns), self.arm.robot, self.noise, self.kind)
        except InputError as error:
            raise error.within(file) from None


class Parts(NamedTuple):
    """Tables by file, the rows that identify, what the problem says of validation, and what is to be told."""

    tables: Mapping[str, Columns]
    rows: Dataset
    said: str
    notes: tuple[str, ...]


def whole_table(reading: Reading, found: Understanding) -> Parts:
    """Return all rows as those that identify."""
    rows = reading.rows(found.file, found.columns)
    columns = found.columns
    if "label" not in columns:  # a row keeps its number where others are held out
        columns = {"label": rows.label, **columns}
    said = '# validation = "validation.csv"   # a table that no choice may see; none was given'
    return Parts({"identification.csv": columns}, rows, said, found.sentences)


def beside(reading: Reading, found: Understanding, validation: str | Path) -> Parts:
    """Return all rows, and those of a table of its own for validation."""
    whole = whole_table(reading, found)
    other = understand_of(reading.arm, [validation], reading.kind.name, found.asked)
    reading.rows(validation, other.columns)
    return Parts(
        tables={**whole.tables, "validation.csv": other.columns},
        rows=whole.rows,
        said=f'validation = "validation.csv"\n# from {Path(validation).name}; no choice sees it',
        notes=(*whole.notes, *other.sentences),
    )


def held_out(reading: Reading, found: Understanding, share: float, seed: int) -> Parts:
    """Return the rows without a share of the configurations, at least one, which is kept apart."""
    whole = whole_table(reading, found)
    known = len(np.unique(whole.rows.configuration))
    if not 0 < share < 1 or known < 2:
        raise InputError("--hold-out", f"{share:g} of {known} configurations", "a part between 0 and 1 of two or more")
    drawn = whole.rows.configurations(min(max(round(share * known), 1), known - 1), seed)
    held = np.isin(whole.rows.configuration, drawn.configuration)
    columns = whole.tables["identification.csv"]
    return Parts(
        tables={"identification.csv": _taken(columns, ~held), "validation.csv": _taken(columns, held)},
        rows=whole.rows.take(np.flatnonzero(~held)),
        said=f'validation = "validation.csv"\n# configurations drawn with seed {seed}; no choice sees them',
        notes=whole.notes,
    )


def _taken(columns: Columns, rows: np.ndarray) -> Columns:
    return {name: [cells[i] for i in np.flatnonzero(rows).tolist()] for name, cells in columns.items()}
