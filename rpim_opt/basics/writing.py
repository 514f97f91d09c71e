"""Files that go out: whole and on the disk, or as they were; what a kill left behind is cleaned up."""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from rpim_opt.basics.exceptions import RpimError

try:
    import fcntl
except ImportError:  # Windows: what a kill leaves there stays
    fcntl = None
ENDING = ".part"


@contextmanager
def refused(path: object) -> Iterator[None]:
    """Turn what the system refuses while ``path`` is written into a sentence."""
    try:
        yield
    except OSError as error:
        raise RpimError(f"{path}: cannot be written: {error}.") from None


def write_text(path: Path, text: str) -> None:
    """Write text so that ``path`` holds either the whole new text or what it held before."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, data: bytes) -> None:
    """Write bytes so that ``path`` holds either all of them or what it held before, also after a power failure.

    A file keeps its mode, a new one has that of the umask; a link stays one, and what it leads to is written. A
    device or pipe gets the bytes as they are.
    """
    write_files({path: data})


def write_files(contents: Mapping[Path, bytes]) -> None:
    """Write several files as `write_bytes` does: all of them, or none.

    None is touched before the bytes of all are on the disk; when one cannot be put in its place those before it, and
    folders that were made for them, are taken back.
    """
    streams = {path: data for path, data in contents.items() if _is_stream(path)}
    with undoing() as folders, ExitStack() as stack, undoing() as renames:
        made: dict[Path, Path] = {}
        for path, data in contents.items():
            if path in streams:
                continue
            place = Path(os.path.realpath(path))
            if place.is_dir():
                raise IsADirectoryError(21, "a folder is there", str(place))
            make_folder(place.parent, folders)
            folder = stack.enter_context(scratch_folder(place))
            made[place] = folder / "file"
            _write_through(made[place], data, place)
        for place, file in made.items():
            if len(contents) > 1:
                _keep_old(place, file, renames)
            file.replace(place)
        for path, data in streams.items():
            path.write_bytes(data)
        for folder in {place.parent for place in made}:
            _settle(folder)


@contextmanager
def undoing() -> Iterator[ExitStack]:
    """Collect what takes steps back; it is carried out, the last first, only when what follows fails."""
    with ExitStack() as steps:
        yield steps
        steps.pop_all()


def make_folder(folder: Path, steps: ExitStack) -> None:
    """Make a folder and those above it; the steps take them back while nothing is in them."""
    if folder.is_dir():
        return
    make_folder(folder.parent, steps)
    with suppress(FileExistsError):  # somebody else just made it
        folder.mkdir()
        steps.callback(_remove_empty, folder)


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


def _keep_old(place: Path, file: Path, steps: ExitStack) -> None:
    """Keep what is at a place beside the file that replaces it, for the case that a later one cannot be replaced."""
    old = file.with_name("old")
    try:
        os.link(place, old)
    except FileNotFoundError:
        steps.callback(_take_away, place, file)
        return
    except OSError:  # a file system without links
        shutil.copy2(place, old)
    steps.callback(old.replace, place)


def _take_away(place: Path, file: Path) -> None:
    """Remove a file that was put where none was."""
    if not file.exists():
        place.unlink(missing_ok=True)


def _is_stream(path: Path) -> bool:
    """Whether something is there that cannot be replaced: a pipe, a device."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return not stat.S_ISREG(mode) and not stat.S_ISDIR(mode)


def _write_through(file: Path, data: bytes, place: Path) -> None:
    """Write a new file and wait until it is on the disk; mode and owner are those of the file at ``place``."""
    with file.open("xb") as stream:
        _keep_mode(stream.fileno(), place)
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


def _keep_mode(handle: int, place: Path) -> None:
    try:
        known = place.stat()
    except OSError:
        return
    if not os.access(place, os.W_OK):
        raise PermissionError(13, "the file there is write-protected", str(place))
    if hasattr(os, "fchown"):
        with suppress(OSError):  # only the owner's superuser may give a file away
            os.fchown(handle, known.st_uid, known.st_gid)
        os.fchmod(handle, stat.S_IMODE(known.st_mode))


def _settle(folder: Path) -> None:
    """Wait until a folder's new names are on the disk."""
    with suppress(OSError):  # some file systems do not know that
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextmanager
def scratch_folder(place: Path) -> Iterator[Path]:
    """Make a folder beside ``place`` for what will be moved there, and remove it in the end.

    A kill leaves it, and the next one for the same place removes it: a lock tells which ones somebody still uses.
    """
    for left in place.parent.glob(f".{_literal(place.name)}.*{ENDING}"):
        _remove_left(left)
    with ExitStack() as stack:
        folder = Path(tempfile.mkdtemp(ENDING, f".{place.name}.", place.parent))
        while not _lock(folder, stack):  # somebody took it for one that was left
            folder = Path(tempfile.mkdtemp(ENDING, f".{place.name}.", place.parent))
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        yield folder


def _literal(name: str) -> str:
    """Return a name as a pattern that it alone meets."""
    return "".join(f"[{c}]" if c in "*?[" else c for c in name)


def _lock(folder: Path, stack: ExitStack, unlockable: bool = True) -> bool:
    """Lock a folder until the stack ends; return whether it is there and nobody else has it.

    ``unlockable`` is the answer where locks are not to be had.
    """
    if fcntl is None:
        return unlockable
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW | os.O_DIRECTORY)
    except OSError:
        return False
    stack.callback(os.close, handle)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return unlockable
    return folder.exists() and folder.stat().st_ino == os.fstat(handle).st_ino


def _remove_left(folder: Path) -> None:
    """Remove a folder that a killed process left."""
    with ExitStack() as stack:
        if _lock(folder, stack, unlockable=False):
            shutil.rmtree(folder, ignore_errors=True)
