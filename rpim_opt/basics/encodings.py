"""Bytes become text: which encoding a file is in, and how that is known."""

from __future__ import annotations

import codecs
from typing import NamedTuple

from rpim_opt.basics.exceptions import InputError

MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # begins as the mark of UTF-16 does
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
"""What a file begins with whose encoding says so itself."""
SAMPLE = 4096
"""Bytes from which UTF-16 without a mark is recognised."""


class Decoded(NamedTuple):
    """A text, the name of its encoding, and why it is that one."""

    text: str
    encoding: str
    why: str


def decoded(data: bytes, encoding: str = "") -> Decoded:
    """Return bytes as text.

    A byte order mark decides; else zeros in every other byte (UTF-16), else whether the bytes are UTF-8, which other
    encodings practically never are; else Windows-1252, which has Latin-1's letters.

    Parameters
    ----------
    data
        The content of a file.
    encoding
        What it is in, where that is known.

    Raises
    ------
    InputError
        For bytes that are no text in that encoding.

    Examples
    --------
    >>> from rpim_opt.basics.encodings import decoded
    >>> decoded("J1 [°]".encode("latin-1"))
    Decoded(text='J1 [°]', encoding='cp1252', why='not UTF-8')
    >>> decoded("J1 [°]".encode("utf-16"))[1:]
    ('utf-16', 'byte order mark')
    """
    name, why = encoding, "as stated"
    if not encoding:
        name, why = _recognised(data)
    try:
        text = data.decode(name)
    except (ValueError, LookupError) as error:  # of the text, or of the encoding's name
        raise InputError("the text", str(error), "an encoding that fits: --encoding utf-8, cp1252, utf-16") from None
    if "\x00" in text:
        raise InputError("the text", "bytes that are zero", "a text file, not a binary one")
    return Decoded(text, name, why)


def _recognised(data: bytes) -> tuple[str, str]:
    for mark, name in MARKS:
        if data.startswith(mark):
            return name, "byte order mark"
    sample = data[:SAMPLE]
    if len(sample) > 3:
        for first, name in ((1, "utf-16-le"), (0, "utf-16-be")):
            zeros = sample[first::2].count(0)
            if zeros > 0.6 * len(sample) / 2 and sample[1 - first :: 2].count(0) == 0:
                return name, "every other byte is zero"
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252", "not UTF-8"
    return "utf-8", "valid UTF-8"
