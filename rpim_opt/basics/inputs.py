"""Files that come in: ordinary ones of a size that can be, and for a folder's own names only what lies in it."""

from __future__ import annotations

import os
import stat
from collections.abc import Sequence
from pathlib import Path

from rpim_opt.basics.exceptions import InputError, choices

LARGEST_TEXT = 2**24
"""Bytes that a description may have: a hundred times what the largest public ones need."""
LARGEST_DATA = 2**30
"""Bytes that a table or a result may have: some million rows."""


def require_file(path: Path, largest: int = LARGEST_TEXT, endings: Sequence[str] = ()) -> None:
    """Refuse what is no ordinary file of at most ``largest`` bytes; a pipe or device would be read for ever.

    Raises
    ------
    InputError
        Saying what is there instead, or what the folder holds with one of the ``endings``.
    """
    try:
        found = path.stat()
    except FileNotFoundError:
        accepted = "a file there"
        near = _near(path, endings)
        if near:
            accepted = choices(path.name, near)
        raise InputError("the file", "nothing", accepted, path) from None
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        raise InputError("the file", str(error), "a readable file", path) from None
    if not stat.S_ISREG(found.st_mode):
        raise InputError("the file", _kind(found.st_mode), "an ordinary file", path)
    if found.st_size > largest:
        raise InputError("the file", f"{found.st_size} bytes", f"a file of at most {largest} bytes", path)


def _near(path: Path, endings: Sequence[str]) -> list[str]:
    try:
        return sorted(p.name for p in path.parent.iterdir() if p.suffix in endings)
    except OSError:
        return []


def _kind(mode: int) -> str:
    if stat.S_ISDIR(mode):
        return "a folder"
    return "a pipe, a socket or a device"


def read_bytes(path: Path, largest: int = LARGEST_TEXT, endings: Sequence[str] = ()) -> bytes:
    """Return a file's content; errors as `require_file` has them."""
    require_file(path, largest, endings)
    try:
        with path.open("rb") as stream:
            content = stream.read(largest + 1)
    except OSError as error:
        raise InputError("the file", str(error), "a readable file", path) from None
    if len(content) > largest:  # grown since, or a file of the system that states no size
        raise InputError("the file", f"more than {largest} bytes", f"a file of at most {largest} bytes", path)
    return content


def read_text(path: Path, largest: int = LARGEST_TEXT, endings: Sequence[str] = ()) -> str:
    """Return a file's text; errors as `require_file` has them, and for what is no UTF-8."""
    content = read_bytes(path, largest, endings)
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise InputError("the file", str(error), "a readable UTF-8 text file", path) from None


def inside(folder: Path, name: str, where: str, file: object = None) -> Path:
    """Return the path of a file that a folder names, which must lie in that folder.

    A folder may come from somebody else: what it names elsewhere is neither read nor written, be it by an absolute
    path, by ``..`` or by a link.

    Raises
    ------
    InputError
        With ``where`` and ``file`` as the place of the name.

    Examples
    --------
    >>> from pathlib import Path
    >>> import rpim_opt as ro
    >>> from rpim_opt.basics.inputs import inside
    >>> inside(Path("cell"), "tables/june.csv", "key identification").name
    'june.csv'
    >>> try:
    ...     inside(Path("cell"), "../june.csv", "key identification")
    ... except ro.InputError as error:
    ...     print(error)
    key identification: found '../june.csv', accepted: the name of a file in the folder.
    """
    path = folder / name
    accepted = "the name of a file in the folder"
    try:
        home = Path(os.path.realpath(folder))
        place = Path(os.path.realpath(path))
        parts = Path(name).parts
        lies_in = place != home and place.is_relative_to(home)
    except (OSError, ValueError) as error:
        raise InputError(where, str(error), accepted, file) from None
    if not parts or ".." in parts or Path(name).is_absolute() or not lies_in:
        raise InputError(where, f"{name!r}", accepted, file)
    return path
