"""Tables that would take for ever or all memory are refused in a moment, and pipes and devices are not read."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import openpyxl
import pyarrow as pa
import pytest
from pyarrow import parquet

import rpim_opt as ro
from rpim_opt.data.tables.formats.registry import read_raw
from tests.data.test_tables import ARM2, GOOD, HEAD, NOISE

PATIENCE = 10.0
"""Seconds: what is refused in time takes less than one on a quiet machine; what is not takes minutes or hours."""


def refused(path: Path) -> str:
    began = time.perf_counter()
    with pytest.raises(ro.InputError) as error:
        ro.read_data(path, ARM2, NOISE)
    assert time.perf_counter() - began < PATIENCE
    message = str(error.value)
    assert "\n" not in message
    assert len(message) < 1000
    return message


WIDE = 100_000
CSV = {
    "100,000 columns": ",".join(f"c{i}" for i in range(WIDE)) + "\n" + ",".join("1" * WIDE) + "\n",
    "100,000 columns of one name": ",".join(["c"] * WIDE) + "\n",
    "100,000 columns by semicolons": ";".join(f"c{i}" for i in range(WIDE)) + "\n" + ";".join("1" * WIDE) + "\n",
    "100,000 columns with decimal commas": ";".join(["1,5"] * WIDE) + "\n" + ";".join(["1,5"] * WIDE) + "\n",
    "a row of 100,000 cells": f"{GOOD}c{',1' * WIDE}\n",
    "a cell of a million characters": f"{HEAD}\n{'a' * 10**6},1,2,3,4,5\n",
    "a name of a million characters": f"{'a' * 10**6},{HEAD}\n",
    "a number of 100,000 digits": f"{HEAD}\na,{'1' * 10**5},2,3,4,5\n",
}


@pytest.mark.parametrize("case", CSV)
def test_wide_and_long_texts(tmp_path: Path, case: str) -> None:
    path = tmp_path / "data.csv"
    path.write_text(CSV[case])
    refused(path)


PROGRAMS = {
    "data.dtx": "<Value " * WIDE,
    "data.src": "PTP{" * WIDE,
    "data.dat": "POS a={" * WIDE,
    "data.html": "<tr>" + "<td " * WIDE,
    "data.jbi": f"///POSTYPE ANGLE\nC1=1{' ' * WIDE}x\n",
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_programs_whose_targets_do_not_end(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text(PROGRAMS[name])
    began = time.perf_counter()
    with pytest.raises(ro.InputError):
        read_raw(path)
    assert time.perf_counter() - began < PATIENCE


@pytest.mark.parametrize("kind", ["fifo", "/dev/zero", "/dev/full", "folder", "socket-like", "nothing"])
@pytest.mark.parametrize("name", ["data.csv", "data.parquet", "data.xlsx"])
def test_what_is_no_file_is_not_read(tmp_path: Path, kind: str, name: str) -> None:
    path = tmp_path / name
    if kind == "fifo":
        os.mkfifo(path)
    elif kind.startswith("/dev"):
        path.symlink_to(kind)
    elif kind == "folder":
        path.mkdir()
    elif kind == "socket-like":
        path.symlink_to("/dev/tty")
    assert "the file: found" in refused(path)


def test_a_file_that_is_larger_than_any_table(tmp_path: Path) -> None:
    path = tmp_path / "data.csv"
    with path.open("wb") as stream:
        stream.truncate(2**31)
    assert "found 2147483648 bytes" in refused(path)


def workbook(path: Path, sheet: str, dimension: str = "A1:F3") -> Path:
    """Write a workbook with a sheet's XML of one's own."""
    book = openpyxl.Workbook()
    stream = io.BytesIO()
    book.save(stream)
    head = (
        f'<worksheet xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"><dimension ref="{dimension}"/>'
    )
    with zipfile.ZipFile(stream) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as new:
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename == "xl/worksheets/sheet1.xml":
                content = f"{head}<sheetData>{sheet}</sheetData></worksheet>".encode()
            new.writestr(entry.filename, content)
    return path


def cells(*texts: str) -> str:
    return "".join(f'<c t="inlineStr"><is><t>{text}</t></is></c>' for text in texts)


def rows(text: str) -> str:
    return "".join(f"<row>{cells(*line.split(','))}</row>" for line in text.strip().splitlines())


def test_the_workbook_of_these_tests_is_read(tmp_path: Path) -> None:
    data = ro.read_data(workbook(tmp_path / "data.xlsx", rows(GOOD)), ARM2, NOISE)
    assert data.label == ("a", "b")
    wide = workbook(tmp_path / "wide.xlsx", rows(GOOD), "A1:XFD1048576")
    assert np.array_equal(ro.read_data(wide, ARM2, NOISE).q, data.q)


SHEETS = {
    "a row far below": f'{rows(GOOD)}<row r="999999999">{cells("c")}</row>',
    "a cell far to the right": f'<row r="1"><c r="A1"><v>1</v></c><c r="XFD1"><v>1</v></c></row>{rows(GOOD)}',
    "a cell far to the right below": f'{rows(GOOD)}<row r="4"><c r="A4"><v>1</v></c><c r="XFD4"><v>1</v></c></row>',
    "many columns": f"<row>{'<c><v>1</v></c>' * WIDE}</row>",
}


@pytest.mark.parametrize("case", SHEETS)
def test_sheets_that_are_larger_than_they_look(tmp_path: Path, case: str) -> None:
    refused(workbook(tmp_path / "data.xlsx", SHEETS[case], "A1:XFD1048576"))


@pytest.mark.slow
def test_an_archive_that_unpacks_to_300_megabytes(tmp_path: Path) -> None:
    path = workbook(tmp_path / "data.xlsx", rows(GOOD) + " " * 300_000_000)
    assert path.stat().st_size < 2_000_000
    assert "bytes unpacked" in refused(path)


def test_an_archive_that_lies_about_its_size(tmp_path: Path) -> None:
    path = workbook(tmp_path / "data.xlsx", rows(GOOD) + " " * 3_000_000)
    with zipfile.ZipFile(path) as archive:
        size = archive.getinfo("xl/worksheets/sheet1.xml").file_size
    content = path.read_bytes()
    assert content.count(size.to_bytes(4, "little")) >= 1
    path.write_bytes(content.replace(size.to_bytes(4, "little"), (1000).to_bytes(4, "little")))
    refused(path)


def test_entities_that_unfold_to_gigabytes(tmp_path: Path) -> None:
    path = workbook(tmp_path / "data.xlsx", "")
    names = [f"<!ENTITY e{i} '{f'&e{i - 1};' * 10}'>" for i in range(1, 12)]
    bomb = f"<!DOCTYPE w [<!ENTITY e0 'ten letters'>{''.join(names)}]>"
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("xl/worksheets/sheet1.xml", f"{bomb}<worksheet>&e11;</worksheet>")
    refused(path)


@pytest.fixture(scope="module")
def packed() -> bytes:
    columns = {name: ["a", "b"] if name == "label" else [1.0, 2.0] for name in HEAD.split(",")}
    stream = io.BytesIO()
    parquet.write_table(pa.table(columns), stream)
    return stream.getvalue()


def test_parquet_cut_anywhere(tmp_path: Path, packed: bytes) -> None:
    path = tmp_path / "data.parquet"
    for length in [0, 1, 3, 4, 7, 8, 11, 12, *range(20, len(packed), 97), len(packed) - 8, len(packed) - 1]:
        path.write_bytes(packed[:length])
        refused(path)


def test_parquet_with_bytes_changed(tmp_path: Path, packed: bytes) -> None:
    path = tmp_path / "data.parquet"
    rng = np.random.default_rng(0)
    outcomes = set()
    for _ in range(300):
        content = bytearray(packed)
        content[rng.integers(len(content))] = rng.integers(256)
        path.write_bytes(content)
        try:
            ro.read_data(path, ARM2, NOISE)
            outcomes.add("read")
        except ro.InputError as error:
            outcomes.add("refused" if "\n" not in str(error) else "in several lines")
    assert outcomes == {"read", "refused"}


def test_parquet_of_few_bytes_and_a_billion_rows(tmp_path: Path) -> None:
    path = tmp_path / "data.parquet"
    table = pa.table({"label": pa.nulls(2**27, pa.int8()), "q1_rad": pa.nulls(2**27, pa.int8())})
    parquet.write_table(table, path, compression="zstd")
    assert path.stat().st_size < 2_000_000
    assert "at most 134217728 cells" in refused(path)


def test_parquet_with_thousands_of_columns(tmp_path: Path) -> None:
    path = tmp_path / "data.parquet"
    parquet.write_table(pa.table({f"c{i}": [1.0] for i in range(3000)}), path)
    assert "3000 columns" in refused(path)


def peak_of(script: str) -> int:
    """Return the largest resident memory [bytes] of a process beyond that of one that only loads the package."""
    measured = "import resource; print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    sizes = []
    for body in ("", script):
        code = f"import rpim_opt as ro, pyarrow.parquet, pyarrow.compute\n{body}\n{measured}"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        sizes.append(1024 * int(done.stdout.split()[-1]))
    return sizes[1] - sizes[0]


def test_one_text_in_three_million_rows_is_refused_before_it_is_repeated(tmp_path: Path) -> None:
    path = tmp_path / "data.parquet"
    texts = pa.DictionaryArray.from_arrays(pa.array(np.zeros(3_000_000, np.int32)), ["x" * 3600])
    parquet.write_table(pa.table({"label": texts}), path)
    assert path.stat().st_size < 2_000_000
    assert "bytes of text" in refused(path)
    script = f"try: ro.read_data({str(path)!r}, ro.load('position').problem.robot)\nexcept ro.InputError: pass"
    assert peak_of(script) < 2**28


def test_a_hole_of_a_text_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "raw.csv"
    path.write_text("a,b\n1,2\n")
    with path.open("r+b") as stream:
        stream.truncate(900_000_000)
    script = (
        "from pathlib import Path\nfrom rpim_opt.basics.layout import read_table\n"
        f"try: read_table(Path({str(path)!r}))\nexcept ro.InputError as error: assert 'zero' in str(error)"
    )
    assert peak_of(script) < 2**26
