"""What is written is there whole or not at all, whatever happens meanwhile, and nothing is left over."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from rpim_opt.basics import files
from rpim_opt.basics.files import write_files, write_text

OLD = b"old content"
NEW = b"new content, and more of it"


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture
def mask():
    """Set a umask, and set the old one again in the end."""
    old = os.umask(0o022)
    yield os.umask
    os.umask(old)


@pytest.mark.parametrize("wanted", [0o022, 0o077, 0o002])
def test_a_new_file_has_the_mode_that_the_umask_leaves(tmp_path: Path, mask, wanted: int) -> None:
    mask(wanted)
    write_files({tmp_path / "deep" / "new": NEW})
    assert mode(tmp_path / "deep" / "new") == 0o666 & ~wanted
    assert mode(tmp_path / "deep") == 0o777 & ~wanted


@pytest.mark.parametrize("wanted", [0o600, 0o640, 0o755])
def test_a_file_keeps_its_mode(tmp_path: Path, wanted: int) -> None:
    path = tmp_path / "file"
    path.write_bytes(OLD)
    path.chmod(wanted)
    write_files({path: NEW})
    assert mode(path) == wanted
    assert path.read_bytes() == NEW


def test_a_write_protected_file_is_left_alone(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "file"
    path.write_bytes(OLD)
    monkeypatch.setattr(os, "access", lambda *_: False)  # the superuser may write everything
    with pytest.raises(PermissionError, match="write-protected"):
        write_files({path: NEW})
    assert path.read_bytes() == OLD
    assert names(tmp_path) == ["file"]


@pytest.mark.parametrize("there", [True, False])
def test_a_link_stays_one_and_its_target_is_written(tmp_path: Path, there: bool) -> None:
    target = tmp_path / "elsewhere" / "file"
    target.parent.mkdir()
    if there:
        target.write_bytes(OLD)
    link = tmp_path / "link"
    link.symlink_to(target)
    write_files({link: NEW})
    assert link.is_symlink()
    assert target.read_bytes() == NEW
    assert names(tmp_path) == ["elsewhere", "link"]
    assert names(target.parent) == ["file"]


def test_a_device_is_written_and_stays_one(tmp_path: Path) -> None:
    write_text(Path("/dev/null"), "nothing")
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)
    with pytest.raises(OSError, match="No space left"):
        write_text(Path("/dev/full"), "nothing")


FAULTS = ["mkdtemp", "open", "write", "flush", "fchmod", "fsync", "replace", "interrupt"]


def break_at(monkeypatch: pytest.MonkeyPatch, fault: str) -> None:
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    places = {
        "mkdtemp": (files.tempfile, "mkdtemp"),
        "open": (Path, "open"),
        "fchmod": (os, "fchmod"),
        "fsync": (os, "fsync"),
        "replace": (Path, "replace"),
    }
    if fault == "interrupt":
        monkeypatch.setattr(os, "fsync", interrupt)
    elif fault in places:
        monkeypatch.setattr(*places[fault], full)
    else:
        real = Path.open

        def breaking(self, *arguments, **options):
            stream = real(self, *arguments, **options)

            class Breaking:
                def __getattr__(self, name):
                    return full if name == fault else getattr(stream, name)

                def __enter__(self):
                    return self

                def __exit__(self, *_):
                    stream.close()

            return Breaking()

        monkeypatch.setattr(Path, "open", breaking)


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("count", [1, 3])
def test_a_fault_leaves_the_old_files_whole_and_nothing_over(tmp_path, monkeypatch, fault: str, count: int) -> None:
    paths = [tmp_path / f"file{i}" for i in range(count)]
    for path in paths:
        path.write_bytes(OLD)
    with monkeypatch.context() as patch:
        break_at(patch, fault)
        with pytest.raises((OSError, KeyboardInterrupt)):
            write_files(dict.fromkeys(paths, NEW))
    assert [path.read_bytes() for path in paths] == [OLD] * count
    assert names(tmp_path) == [path.name for path in paths]


def test_the_bytes_are_on_the_disk_before_the_name_is_theirs(tmp_path: Path, monkeypatch) -> None:
    order: list[str] = []
    replace = Path.replace
    monkeypatch.setattr(os, "fsync", lambda handle: order.append(os.readlink(f"/proc/self/fd/{handle}")))
    monkeypatch.setattr(Path, "replace", lambda self, target: (order.append("replace"), replace(self, target))[1])
    write_files({tmp_path / "file": NEW})
    assert len(order) == 2
    assert order[0].endswith("/file")
    assert order[1] == "replace"


WRITER = """
import sys
from pathlib import Path
from rpim_opt.basics.files import write_files

for _ in range(150):
    write_files({Path(sys.argv[1]): sys.argv[2].encode() * 5000})
"""


def test_two_processes_at_once_lose_nothing(tmp_path: Path) -> None:
    path = tmp_path / "file"
    writers = [subprocess.Popen([sys.executable, "-c", WRITER, str(path), letter]) for letter in "ab"]
    while any(writer.poll() is None for writer in writers):
        if path.exists():
            assert path.read_bytes() in (b"a" * 5000, b"b" * 5000)
    assert [writer.returncode for writer in writers] == [0, 0]
    assert names(tmp_path) == ["file"]


def test_a_folder_in_the_place_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    with pytest.raises(IsADirectoryError):
        write_files({tmp_path / "a": NEW, tmp_path / "b": NEW})
    assert names(tmp_path) == ["b"]


def test_what_is_taken_back_is_the_old_file_itself_and_never_another_writers(tmp_path: Path, monkeypatch) -> None:
    old, absent = tmp_path / "old", tmp_path / "absent"
    old.write_bytes(OLD)
    (tmp_path / "linked").hardlink_to(old)
    number = old.stat().st_ino
    replace = Path.replace

    def somebody_was_faster(self: Path, target: Path) -> Path:
        if target == absent:
            absent.write_bytes(b"another's")
            raise OSError(13, "Permission denied")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", somebody_was_faster)
    with pytest.raises(OSError, match="Permission denied"):
        write_files({old: NEW, absent: NEW})
    assert (old.read_bytes(), absent.read_bytes()) == (OLD, b"another's")
    assert old.stat().st_ino == number
    assert old.samefile(tmp_path / "linked")
    assert names(tmp_path) == ["absent", "linked", "old"]
