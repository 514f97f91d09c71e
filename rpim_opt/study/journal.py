"""What a study keeps: replicates as they are finished, all of them in the end, and what made them."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import parse_json
from rpim_opt.basics.inputs import LARGEST_DATA, read_bytes, require_file
from rpim_opt.basics.writing import refused

Row = dict[str, Any]
"""A case with what was found."""


class Journal:
    """A file with one line a finished replicate, written at once: what was computed is not lost.

    Its first line says which code computes; only that code goes on with it. Without a path nothing is written. What an
    interrupted run left there is gone on with where ``resume`` is true, is dropped where it is false, and is refused
    where it is None: nobody has said what is to become of it.
    """

    def __init__(
        self, path: Path | None, cases: Sequence[Mapping[str, Any]], code: Mapping[str, str], resume: bool | None
    ):
        self.path = path
        self.code = dict(code)
        self.cases = [(json.dumps(case, sort_keys=True), case) for case in cases]
        self.done: dict[str, Row] = {}
        before = None
        if path is not None and (path.exists() or path.is_symlink()):
            before = path
        if before is not None and resume is None:
            require_nothing_computed(before)
        if before is not None and resume:
            self.done = self._finished(before)
        else:
            self.close()
            self._write({"code": self.code})

    def _finished(self, path: Path) -> dict[str, Row]:
        """Return the replicates of an interrupted run; a line cut off by its end is left out, and taken away."""
        content = read_bytes(path, LARGEST_DATA)
        whole = content.rfind(b"\n") + 1
        if whole < len(content):
            with refused(path):
                os.truncate(path, whole)
        lines = [self._entry(line, number) for number, line in enumerate(content[:whole].splitlines(), start=1)]
        if not lines:
            self._write({"code": self.code})
            return {}
        self._require_same_code(lines[0])
        known = {key for key, _ in self.cases}
        done: dict[str, Row] = {}
        for number, entry in enumerate(lines[1:], start=2):
            case = entry.get("case")
            found = entry.get("found")
            if not isinstance(case, dict) or not isinstance(found, dict):
                raise self._odd(number, "no case with what was found")
            key = json.dumps(case, sort_keys=True)
            if key in known:
                done[key] = found
        return done

    def _entry(self, line: bytes, number: int) -> dict[str, Any]:
        try:
            entry = parse_json(line.decode())
        except ValueError as error:
            raise self._odd(number, str(error)) from None
        if not isinstance(entry, dict):
            raise self._odd(number, "no table")
        return entry

    def _require_same_code(self, head: dict[str, Any]) -> None:
        code = head.get("code")
        if not isinstance(code, dict):
            raise self._odd(1, "nothing on the code that computed")
        for part, now in self.code.items():
            if code.get(part) != now:
                raise InputError(
                    "resume", f"replicates of another {part}", "the code that began, or no resume", self.path
                )

    def _odd(self, number: int, found: str) -> InputError:
        return InputError(f"line {number}", found, "the lines of an interrupted run, or no resume", self.path)

    @property
    def waiting(self) -> list[tuple[str, Mapping[str, Any]]]:
        """The cases that are left to compute, with their keys."""
        return [(key, case) for key, case in self.cases if key not in self.done]

    @property
    def rows(self) -> list[Row]:
        """Every case with what was found, in the order of the cases."""
        return [{**case, **self.done[key]} for key, case in self.cases]

    def add(self, key: str, found: Row) -> None:
        """Write a replicate down."""
        self._write({"case": json.loads(key), "found": found})
        self.done[key] = found

    def _write(self, entry: Mapping[str, Any]) -> None:
        if self.path is None:
            return
        with refused(self.path), self.path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(entry) + "\n")
            stream.flush()
            os.fsync(stream.fileno())

    def close(self) -> None:
        """Remove the file: everything is where it belongs."""
        if self.path is None:
            return
        with refused(self.path):
            self.path.unlink(missing_ok=True)


def require_nothing_computed(path: Path) -> None:
    """Refuse to drop what an interrupted run has computed."""
    count = read_bytes(path, LARGEST_DATA).count(b"\n") - 1  # the first line is on the code
    if count > 0:
        accepted = "resume, to go on with them, or no-resume, to begin anew"
        raise InputError("resume", f"{count} replicates of an interrupted run", accepted, path)


def table_of(rows: Sequence[Row], made: str) -> bytes:
    """Return the replicates as a Parquet file, with what made them."""
    import pyarrow as pa
    from pyarrow import parquet

    columns = list(dict.fromkeys(key for row in rows for key in row))
    table = pa.table({key: [row.get(key) for row in rows] for key in columns})
    stream = io.BytesIO()
    parquet.write_table(table.replace_schema_metadata({"made": made}), stream)
    return stream.getvalue()


def kept(path: Path) -> tuple[list[Row], str]:
    """Return the replicates of an earlier run, without what a replicate does not have, and what made them."""
    from pyarrow import parquet

    if not path.exists():
        raise InputError("redraw", "no replicates", "a study that was run before", path)
    require_file(path, LARGEST_DATA)
    try:
        table = parquet.read_table(path)
        made = (table.schema.metadata or {}).get(b"made", b"").decode()
    except (OSError, ValueError) as error:
        raise InputError("redraw", str(error), "the replicates of a study", path) from None
    return [{key: value for key, value in row.items() if value is not None} for row in table.to_pylist()], made
