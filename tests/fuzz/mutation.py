"""Changed inputs: seeds with tokens put in, pieces cut, doubled, moved and swapped, and bytes that nobody writes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from random import Random

NUMBERS = [
    b"0", b"-1", b"1", b"2", b"7", b"-0.0", b"1e400", b"-1e400", b"1e308", b"-1e308", b"1e300", b"1e20", b"1e16",
    b"1e-320",
    b"nan", b"inf", b"-inf", b"true", b"false", b"null", b"0x10", b"1_000", b"9" * 400, b"0." + b"0" * 400 + b"1",
    b"1,5", b"1.5.5", b"+-1", b"2147483648", b"9223372036854775808", b"18446744073709551616", b"1e", b"1e999999999",
]  # fmt: skip
SIGNS = [
    b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"\xed\xa0\x80", b"\r", b"\n", b"\t", b" ", b'"', b"'", b"\\", b"[",
    b"]",
    b"{",
    b"}", b"[[", b"]]", b"=", b",", b";", b"|", b":", b"#", b"<", b">", b"</", b"/>", b"&", b"&#0;", b"*", b"?",
    b"[!", b"..",
    b"/", b"\xe2\x80\xae", b"\x1b[2J", b"\xc2\xb5", b"\xc2\xb0", b"\xc3\x9f", b"\xe2\x89\xa4", b"+-", b"()", b"''",
    b'""',
    b'"""', b"%s", b"%n", b"\xf0\x9f\x98\x80", b"\xd9\xa1\xd9\xa2", b"\xc2\xb2",
]  # fmt: skip
UNITS = [
    b"_mm",
    b"_m",
    b"_deg",
    b"_rad",
    b"_mrad",
    b"_kg",
    b"_Nm",
    b" mm",
    b" deg",
    b" [mm]",
    b"_um",
    b"_ppm",
    b"_arcsec",
]
LONGEST = 20_000
BETWEEN = re.compile(rb"[ =,\"'\[\]{}()<>:;\n\t|_]")


def mutated(rng: Random, seed: bytes, others: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    """Return an input a few changes away from a seed."""
    data = seed
    longest = max(LONGEST, 2 * len(seed))
    for _ in range(1 + min(int(rng.expovariate(0.6)), 12)):
        data = _changed(rng, data, others, words)[:longest]
    return data


def _changed(rng: Random, data: bytes, others: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    kind = rng.randrange(10)
    if kind < 3:
        return _token(rng, data, words)
    if kind < 4:
        return _bytes(rng, data)
    if kind < 7:
        return _lines(rng, data, others)
    if kind < 9:
        return _spans(rng, data, words)
    return _spliced(rng, data, rng.choice(others))


def _place(rng: Random, data: bytes) -> tuple[int, int]:
    start = rng.randrange(len(data) + 1)
    length = int(rng.expovariate(0.2))
    return start, min(start + length, len(data))


def _token(rng: Random, data: bytes, words: Sequence[bytes]) -> bytes:
    token = rng.choice(rng.choice((NUMBERS, SIGNS, UNITS, words)))
    if rng.random() < 0.01:  # what is matched by going back and forth takes for ever
        token *= LONGEST // len(token)
    start, end = _place(rng, data)
    if rng.random() < 0.5:
        end = start
    return data[:start] + token + data[end:]


def _bytes(rng: Random, data: bytes) -> bytes:
    if not data:
        return bytes([rng.randrange(256)])
    changed = bytearray(data)
    place = rng.randrange(len(changed))
    changed[place] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _lines(rng: Random, data: bytes, others: Sequence[bytes]) -> bytes:
    lines = data.split(b"\n")
    place = rng.randrange(len(lines))
    other = rng.randrange(len(lines))
    kind = rng.randrange(5)
    if kind == 0:
        del lines[place]
    elif kind == 1:
        lines.insert(place, lines[other])
    elif kind == 2:
        lines[place], lines[other] = lines[other], lines[place]
    elif kind == 3:
        lines.insert(place, rng.choice(rng.choice(others).split(b"\n")))
    else:
        lines[place:place] = [lines[other]] * rng.choice((2, 20, 200))
    return b"\n".join(lines)


def _spans(rng: Random, data: bytes, words: Sequence[bytes]) -> bytes:
    """Change what lies between signs: a number, a name, a text."""
    ends = [0, *(found.start() for found in BETWEEN.finditer(data)), len(data)]
    i = rng.randrange(len(ends) - 1)
    start = min(ends[i] + (i > 0), ends[i + 1])
    middle = data[start : ends[i + 1]]
    kind = rng.randrange(4)
    if kind == 0:
        middle = rng.choice(NUMBERS)
    elif kind == 1:
        middle = rng.choice(words)
    elif kind == 2:
        j = rng.randrange(len(ends) - 1)
        middle = data[min(ends[j] + (j > 0), ends[j + 1]) : ends[j + 1]]
    else:
        middle = middle * rng.choice((0, 2, 50))
    return data[:start] + middle + data[ends[i + 1] :]


def _spliced(rng: Random, data: bytes, other: bytes) -> bytes:
    start, _ = _place(rng, data)
    begin, _ = _place(rng, other)
    return data[:start] + other[begin:]
