"""Readers with inputs that nobody would write: accepted and meant, or refused in one sentence, in a moment."""

from __future__ import annotations

import os
from pathlib import Path
from time import process_time

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rpim_opt.basics import RpimError
from tests.fuzz.parsers import PARSERS
from tests.fuzz.seeds import found, seeds, words

EXAMPLES = int(os.environ.get("FUZZ", "60"))
"""Changed inputs a reader."""
LONGEST = 5.0
"""Seconds of the processor that an input may take."""
LONGEST_SENTENCE = 5000
LARGEST = 20_000
"""Bytes; what is matched by going back and forth takes for ever with as many."""
NUMBERS = [
    b"0", b"-1", b"1", b"7", b"-0.0", b"1e400", b"-1e308", b"1e20", b"1e-320", b"nan", b"-inf", b"true", b"null",
    b"0x10", b"1_000", b"9" * 400, b"0." + b"0" * 400 + b"1", b"1,5", b"1.5.5", b"+-1", b"18446744073709551616", b"1e",
]  # fmt: skip
SIGNS = [
    b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"\xed\xa0\x80", b"\r", b"\n", b"\t", b'"', b"'", b"\\", b"[", b"]", b"{",
    b"}", b"=", b",", b";", b"|", b":", b"#", b"<", b"/>", b"&#0;", b"*", b"?", b"[!", b"..", b"/", b"\xe2\x80\xae",
    b"\x1b[2J", b"\xc2\xb5", b"\xe2\x89\xa4", b"+-", b"()", b'"""', b"\xf0\x9f\x98\x80", b"\xd9\xa1\xd9\xa2",
]  # fmt: skip
UNITS = [b"_mm", b"_deg", b"_mrad", b"_kg", b"_Nm", b" mm", b" [mm]", b"_ppm"]


@st.composite
def changed(draw: st.DrawFn, name: str) -> bytes:
    """Draw an input a few changes away from one that a reader accepts."""
    known = seeds(name)
    data = draw(st.sampled_from(known))
    largest = max(LARGEST, 2 * len(data))
    token = st.sampled_from([*NUMBERS, *SIGNS, *UNITS, *words(name)]) | st.binary(min_size=1, max_size=3)
    for _ in range(draw(st.integers(1, 3))):
        kind = draw(st.sampled_from(["token", "word", "lines", "other"]))
        place = draw(st.sampled_from(range(len(data) + 1)))
        if kind == "token":
            new = draw(token) * draw(st.sampled_from([*[1] * 30, LARGEST // 10]))
            data = data[:place] + new + data[place + draw(st.integers(0, 6)) :]
        elif kind == "word":
            end = next((i for i in range(place, len(data)) if data[i : i + 1] in b" =,\"'[]{}()<>:;\n\t|_"), len(data))
            data = data[:place] + draw(token) * draw(st.integers(0, 2)) + data[end:]
        elif kind == "lines":
            lines = data.split(b"\n")
            at = draw(st.sampled_from(range(len(lines))))
            lines[at : at + draw(st.integers(0, 2))] = [draw(st.sampled_from(lines))] * draw(
                st.sampled_from([0, 1, 2, 20])
            )
            data = b"\n".join(lines)
        else:
            other = draw(st.sampled_from(known))
            data = data[:place] + other[draw(st.sampled_from(range(len(other) + 1))) :]
    return data[:largest]


def accepts(name: str, data: bytes, folder: Path) -> bool:
    """Return whether a reader accepts an input; fail where it does neither that nor refuse it in a sentence."""
    began = process_time()
    refusal = ""
    try:
        PARSERS[name](data, folder)
    except RpimError as error:
        refusal = str(error)
    assert "\n" not in refusal
    assert len(refusal) <= LONGEST_SENTENCE
    assert process_time() - began < LONGEST
    return not refusal


@pytest.mark.parametrize("name", PARSERS)
def test_inputs_that_once_failed(tmp_path: Path, name: str) -> None:
    for path in found(name):
        accepts(name, path.read_bytes(), tmp_path)


@pytest.mark.parametrize("name", PARSERS)
def test_seeds_are_mostly_read(tmp_path: Path, name: str) -> None:
    """Otherwise what is changed were refused for another reason."""
    known = seeds(name)[: len(seeds(name)) - len(found(name))]
    assert sum(accepts(name, data, tmp_path) for data in known) >= 0.4 * len(known)


@pytest.mark.parametrize("name", PARSERS)
def test_changed_inputs(tmp_path: Path, name: str) -> None:
    @settings(
        max_examples=EXAMPLES,
        derandomize="FUZZ" not in os.environ,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(data=changed(name))
    def check(data: bytes) -> None:
        accepts(name, data, tmp_path)

    check()
