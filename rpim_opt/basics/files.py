"""Reading of regular files of bounded size, and atomic writing."""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
import tempfile
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

from rpim_opt.basics.exceptions import InputError, choices

LARGEST_TEXT = 2**24
"""Largest description in bytes: a hundred times the largest public ones."""
LARGEST_DATA = 2**30  # bytes that a table or a result may have: some million rows
_DEEP = re.compile(r"(?<![\w\"'.-])(?:[\w\"'-]++\s*+\.\s*+){100}")
"""Dotted keys, which are read in a time that grows with the square of their length."""
_HALF_PAIR = re.compile(r"\\u[dD][89a-fA-F]")
"""Escapes that JSON reads one by one, whether or not two of them make a character."""
ENDING = ".part"  # of folders in which files are prepared


def require_file(path: Path, largest: int = LARGEST_TEXT, endings: Sequence[str] = ()) -> None:
    """Refuse anything but a regular file of at most ``largest`` bytes; a pipe or device may never end."""
    try:
        status = path.stat()
    except FileNotFoundError:
        accepted = "an existing file"
        with suppress(OSError):
            near = sorted(p.name for p in path.parent.iterdir() if p.suffix in endings)
            accepted = choices(path.name, near) if near else accepted
        raise InputError("the file", "nothing", accepted, path) from None
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        raise InputError("the file", str(error), "a readable file", path) from None
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe, a socket or a device"
        raise InputError("the file", kind, "a regular file", path)
    if status.st_size > largest:
        raise InputError("the file", f"{status.st_size} bytes", f"a file of at most {largest} bytes", path)


def read_bytes(path: Path, largest: int = LARGEST_TEXT, endings: Sequence[str] = ()) -> bytes:
    """Return the content of a file; errors as for `require_file`."""
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
    """Return the text of a file; errors as for `require_file`, and for text that is not UTF-8."""
    content = read_bytes(path, largest, endings)
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise InputError("the file", str(error), "a readable UTF-8 text file", path) from None


def inside(folder: Path, name: str, where: str, file: object = None) -> Path:
    """Return the path of a file in a folder; refuse a name in ``file`` that leads out of it, by a link for instance."""
    path = folder / name
    accepted = "the name of a file in the folder"
    try:
        home, place = (Path(os.path.realpath(each)) for each in (folder, path))
    except (OSError, ValueError) as error:
        raise InputError(where, str(error), accepted, file) from None
    if ".." in path.parts[len(folder.parts) :] or Path(name).is_absolute() or home not in place.parents:
        raise InputError(where, f"{name!r}", accepted, file)
    return path


def read_toml(path: Path) -> dict[str, Any]:
    """Return a TOML file's content; errors name line and column."""
    text = read_text(path, endings=[".toml"])
    if _DEEP.search(text):
        raise InputError("the TOML text", "a key of more than a hundred parts", "keys with fewer parts", path)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # integers of thousands of digits; tables that deep
        raise InputError("the TOML text", str(error), "TOML 1.0", path) from None


def read_json(path: Path) -> Any:
    """Return a JSON file's content; errors name line and column."""
    text = read_text(path, LARGEST_DATA, [".json"])
    try:
        return parse_json(text)
    except ValueError as error:
        raise InputError("the JSON text", str(error), "a complete JSON file", path) from None


def parse_json(text: str) -> Any:
    """Return the content of a JSON text; ValueError for invalid or too deep JSON, duplicate keys, lone surrogates."""
    try:
        content = json.loads(text, object_pairs_hook=_unique)
        if _HALF_PAIR.search(text):
            json.dumps(content, ensure_ascii=False).encode()
    except RecursionError as error:
        raise ValueError(str(error)) from None
    return content


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        ((twice, _),) = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"the key '{twice}' twice in one object")
    return members


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal digits."""
    return sha256(read_bytes(path, LARGEST_DATA)).hexdigest()


@contextmanager
def writing(*paths: Path) -> Iterator[None]:
    """Let errors of the operating system name the files to be written instead of temporary ones."""
    try:
        yield
    except OSError as error:
        text = f"cannot be written: {error.strerror or error}"
        raise OSError(error.errno, text, ", ".join(map(str, paths))) from None


def write_text(path: Path, text: str) -> None:
    """Write text atomically: ``path`` holds either the whole new text or its previous content."""
    write_files({path: text.encode("utf-8")})


def write_files(contents: Mapping[Path, bytes]) -> None:
    """Write several files, once the bytes of all are on the disk: all of them, or none.

    A file keeps its mode, a new one has that of the umask; a link stays, and its target is written. A device or pipe
    gets the bytes directly.
    """
    streams = [path for path in contents if path.exists() and not (path.is_file() or path.is_dir())]
    with writing(*contents), ExitStack() as stack, ExitStack() as renames:
        made: dict[Path, Path] = {}
        for path in contents:
            if path in streams:
                continue
            place = Path(os.path.realpath(path))
            if place.is_dir():
                raise IsADirectoryError(21, "it is a folder", str(place))
            place.parent.mkdir(parents=True, exist_ok=True)
            made[place] = Path(stack.enter_context(scratch_folder(place)), "file")
            with made[place].open("xb") as stream:
                _keep_mode(stream.fileno(), place)
                stream.write(contents[path])
                stream.flush()
                os.fsync(stream.fileno())
        for place, file in made.items():
            old = file.with_name("old")
            known = place.exists()
            if known and len(contents) > 1:  # a later one may fail
                try:
                    os.link(place, old)
                except OSError:  # a file system without links
                    shutil.copy2(place, old)
            file.replace(place)
            if len(contents) > 1:
                renames.callback(old.replace, place) if known else renames.callback(place.unlink)
        for path in streams:
            path.write_bytes(contents[path])
        renames.pop_all()  # nothing has to be taken back


def _keep_mode(handle: int, place: Path) -> None:
    """Give a new file the mode and the owner of the file that it replaces."""
    if not place.exists():
        return
    known = place.stat()
    if not os.access(place, os.W_OK):
        raise PermissionError(13, "the existing file is write-protected", str(place))
    if hasattr(os, "fchown"):
        with suppress(OSError):  # only the owner's superuser may give a file away
            os.fchown(handle, known.st_uid, known.st_gid)
        os.fchmod(handle, stat.S_IMODE(known.st_mode))


def scratch_folder(place: Path) -> tempfile.TemporaryDirectory[str]:
    """Return a temporary folder beside ``place`` for files that will be moved there."""
    return tempfile.TemporaryDirectory(ENDING, f".{place.name}.", place.parent, ignore_cleanup_errors=True)


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically: ``path`` holds either the whole new content or its previous content."""
    write_text(path, _json(content))


def json_text(content: Any) -> str:
    """Return any content as JSON: arrays as lists, paths as strings, non-finite numbers as null."""
    from pydantic_core import to_jsonable_python

    return _json(to_jsonable_python(content, inf_nan_mode="null", fallback=lambda value: value.tolist()))


def _json(content: Any) -> str:
    """Return JSON with a row of numbers on one line; no text can be taken for one, since JSON escapes line breaks."""
    text = json.dumps(content, indent=2, allow_nan=False)
    return re.sub(r"\[\n([^][{}\"]*)\n *]", lambda row: f"[{' '.join(row[1].split())}]", text) + "\n"
