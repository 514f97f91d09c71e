"""Inputs so long that what is matched by going back and forth would take for ever are refused, or read in no time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from time import process_time

import pytest

import rpim_opt as ro
from rpim_opt.basics.files import parse_json, read_toml
from rpim_opt.basics.tables import read_columns
from rpim_opt.basics.units import fits, split, split_unit
from rpim_opt.convex.constraint_parser import combination, sentence
from rpim_opt.store.new_folder import stated_target

MANY = 19_000
SOON = 3.0
"""Seconds of the processor, on a slow one: each took ten or more before."""


@pytest.mark.parametrize(
    ("read", "text"),
    [
        (combination, "1" * MANY),
        (combination, " " * MANY + "1"),
        (combination, "1." * (MANY // 2)),
        (combination, "a2 + " * MANY),
        (sentence, "a" + "1" * MANY + "|"),
        (sentence, "a2 + " * MANY),
    ],
)
def test_a_statement_that_is_long(read: Callable[[str], object], text: str) -> None:
    began = process_time()
    with pytest.raises(ro.InputError):
        read(text)
    assert process_time() - began < SOON


@pytest.mark.parametrize("name", ["x" + " " * MANY + "]", "(" * MANY + "mm", "x" + "_" * MANY, "x/" * MANY])
def test_a_column_with_a_long_name_has_no_unit(name: str) -> None:
    began = process_time()
    assert split(name)[1] == ""
    assert split_unit(name) == (name, None)
    assert process_time() - began < SOON


def test_a_long_pattern_means_nothing() -> None:
    began = process_time()
    assert not fits("a2", "[" * MANY)
    assert not fits("a2", "*" * MANY)
    with pytest.raises(ro.InputError):
        ro.load("paper_arm").problem.parameters.scaled({"[" * MANY: 1.0})
    assert process_time() - began < SOON


@pytest.mark.parametrize("text", ["a." * MANY + "a = 1", "x = { " + 'a . "b" . ' * MANY + "c = 1 }"])
def test_a_key_of_thousands_of_parts(tmp_path: Path, text: str) -> None:
    path = tmp_path / "problem.toml"
    path.write_text(text)
    began = process_time()
    with pytest.raises(ro.InputError, match="a key of more than a hundred parts"):
        read_toml(path)
    assert process_time() - began < SOON
    path.write_text("a." * 50 + "a = 1")
    assert read_toml(path)["a"]["a"]


def test_half_a_surrogate_pair_is_no_text() -> None:
    assert parse_json(r'{"name": "\ud83e\uddbe, \\ud800"}') == {"name": "\N{MECHANICAL ARM}, \\ud800"}
    for text in (r'{"name": "\ud800"}', r'{"\uDFFF": 1}', r'["\ud83e", "\uddbe"]'):
        with pytest.raises(ValueError, match="surrogates not allowed"):
            parse_json(text)


def test_a_table_whose_mark_stands_there_twice(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_bytes(b"\xef\xbb\xbf" * 3 + b"label,q1_deg\nA,1\n")
    assert list(read_columns(path)) == ["label", "q1_deg"]


@pytest.mark.parametrize("grid", ["9" * 5000 + "x5,30mm", "300x301,30mm", "1x5,30mm", "7x5,1.2.3mm", "\u0667x5,30mm"])
def test_a_grid_that_no_board_has(grid: str) -> None:
    with pytest.raises(ro.InputError):
        stated_target(grid)
