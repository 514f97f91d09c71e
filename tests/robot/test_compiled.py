"""The cache of compiled kernels: what is damaged, somebody else's or stale is never loaded, and never in the way."""

from __future__ import annotations

import os
import shutil
import signal
import stat
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from rpim_opt.robot import abreast as ways
from rpim_opt.robot import compiled as native

COMPILER = shutil.which("cc")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler here")
X = 0.3
"""Where the function is asked; its value there is X**2 + sin X."""


def function() -> ca.Function:
    x = ca.SX.sym("x")
    return ca.Function("hardened", [x], [x**2 + ca.sin(x)])


def rows_of_it() -> tuple[ca.Function, ca.Function]:
    """Return what is compiled of it."""
    way = ways.abreast(function(), 0, ways.VECTOR, apart=True)
    return way.rows, way.angles


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    forget()
    yield tmp_path / "rpim_opt"
    forget()


def asked(rows: int, of: ca.Function) -> None:
    ways.evaluated(of, [], np.full((rows, 1), X))


def test_machine_code_is_loaded_and_made_once_that_pays(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ways, "SOME", 2500)
    monkeypatch.setattr(ways, "MANY", 5000)
    often = function()
    asked(4999, often)
    assert not list(cache.glob("*.so"))
    asked(1, often)
    assert len(list(cache.glob("*.so"))) == 1
    forget()
    again = function()  # another process's
    asked(2499, again)
    assert not ways._machine_code.cache_info().currsize
    asked(1, again)
    assert ways._quickest(again, 0, 0).width == ways.VECTOR  # loaded long before it would be made


def forget() -> None:
    native.compiled.cache_clear()
    native._version.cache_clear()
    ways._machine_code.cache_clear()


def made() -> native.MachineCode | None:
    forget()
    return native.compiled(*rows_of_it())


CODE = "from tests.robot.test_compiled import made; assert made() is not None"


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a cache with the library, which this process has not loaded."""
    folder = tmp_path_factory.mktemp("ready")
    subprocess.run([sys.executable, "-c", CODE], check=True, env={**os.environ, "XDG_CACHE_HOME": str(folder)})
    return folder / "rpim_opt"


@pytest.fixture
def library(cache: Path, ready: Path) -> Path:
    """Return the file of a library in the cache."""
    shutil.copytree(ready, cache)
    return next(cache.glob("*.so"))


def assert_right(kernel: native.MachineCode | None) -> None:
    assert kernel is not None
    found = np.zeros(2)
    kernel(np.zeros(0), np.full((1, 1), X), np.array([found.ctypes.data]), 1, np.array([2.0]))
    assert found.tolist() == [2 * float(function()(X)), 0.0]


def flipped(content: bytes, place: int) -> bytes:
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


DAMAGE = {
    "empty": lambda content: b"",
    "half": lambda content: content[: len(content) // 2],
    "a page short": lambda content: content[:4096],
    "one byte short": lambda content: content[:-1],
    "one byte more": lambda content: content + b"\0",
    "a bit at the start": lambda content: flipped(content, 0),
    "a bit in the code": lambda content: flipped(content, content.index(b"\xc3", 4096)),
    "a bit in the middle": lambda content: flipped(content, len(content) // 2),
    "a bit at the end": lambda content: flipped(content, len(content) - 1),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_library_is_made_anew(library: Path, damage: str) -> None:
    path = library
    whole = path.read_bytes()
    path.write_bytes(DAMAGE[damage](whole))
    assert native.compiled(*rows_of_it(), make=False) is None
    assert_right(made())
    assert path.read_bytes() == whole


@pytest.mark.parametrize("damage", ["missing", "empty", "of another", "a folder", "a pipe"])
def test_a_library_without_its_digest_is_made_anew(library: Path, damage: str) -> None:
    digest = library.with_suffix(".sha256")
    whole = digest.read_bytes()
    digest.unlink()
    if damage == "empty":
        digest.write_bytes(b"")
    elif damage == "of another":
        digest.write_bytes(b"0" * 64)
    elif damage == "a folder":
        digest.mkdir()
    elif damage == "a pipe":
        os.mkfifo(digest)
    kernel = made()
    if damage == "a folder":
        assert kernel is None  # the virtual machine, then
    else:
        assert_right(kernel)
        assert digest.read_bytes() == whole


@pytest.mark.parametrize("what", ["mode", "digest's mode", "owner", "link"])
def test_a_library_that_others_can_write_is_not_loaded(cache: Path, library: Path, what: str) -> None:
    path = library
    if what == "mode":
        path.chmod(0o666)
    elif what == "digest's mode":
        path.with_suffix(".sha256").chmod(0o620)
    elif what == "owner":
        if os.getuid() != 0:
            pytest.skip("only the superuser gives files away")
        os.chown(path, 12345, 12345)
    else:
        path.rename(cache / "elsewhere")
        path.symlink_to(cache / "elsewhere")
    assert native.compiled(*rows_of_it(), make=False) is None
    assert_right(made())
    found = path.lstat()
    assert stat.S_ISREG(found.st_mode)
    assert stat.S_IMODE(found.st_mode) == 0o600
    assert found.st_uid == os.getuid()


def test_a_generous_umask_does_not_compile_every_time(cache: Path) -> None:
    old = os.umask(0o002)
    try:
        assert_right(made())
    finally:
        os.umask(old)
    path = next(cache.glob("*.so"))
    written = path.stat().st_mtime_ns
    assert_right(made())
    assert path.stat().st_mtime_ns == written


KILLED = """
import os, signal
from tests.robot.test_compiled import native, rows_of_it

def kill(command):
    if "-o" in command:
        os.kill(os.getpid(), signal.SIGKILL)
    return b""

native._run = kill
native.compiled(*rows_of_it())
"""


def test_kills_while_compiling_leave_nothing_in_the_end(cache: Path) -> None:
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", KILLED])
        assert done.returncode == -signal.SIGKILL
    assert len(list(cache.iterdir())) == 1  # the second one removed what the first one had left
    assert_right(made())
    assert sorted(path.suffix for path in cache.iterdir()) == [".sha256", ".so"]


def script(path: Path, text: str | bytes) -> str:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    path.chmod(0o755)
    return str(path)


ODD = {
    "an empty file": b"",
    "no program": b"\x7fELF nonsense",
    "a program without interpreter": b"#!/no/such/interpreter\n",
    "one that makes nothing": b"#!/bin/sh\nexit 0\n",
    "one that makes no library": b'#!/bin/sh\nfor a in "$@"; do case $a in *.so) echo no > "$a";; esac; done\n',
    "one that fails": b"#!/bin/sh\nexit 1\n",
}


@pytest.mark.parametrize("odd", ODD)
def test_an_odd_compiler_leaves_it_to_the_virtual_machine(cache: Path, monkeypatch, tmp_path, odd: str) -> None:
    monkeypatch.setenv("CC", script(tmp_path / "cc", ODD[odd]))
    assert made() is None


@pytest.mark.parametrize("value", ["'open quotation", "   ", "/", "no-such-compiler -O1", "\udcff"])
def test_a_variable_that_names_no_compiler(cache: Path, monkeypatch, value: str) -> None:
    monkeypatch.setenv("CC", value)
    made()


def test_a_compiler_with_options_is_used(cache: Path, monkeypatch) -> None:
    monkeypatch.setenv("CC", f"{COMPILER} -O1 -DUNUSED='1 2'")
    assert_right(made())
    assert len(list(cache.glob("*.so"))) == 1
    monkeypatch.setenv("CC", f"{COMPILER} -O0")
    assert_right(made())
    assert len(list(cache.glob("*.so"))) == 2  # other options make another library


def test_a_compiler_may_speak_any_encoding(cache: Path, monkeypatch, tmp_path) -> None:
    text = b'#!/bin/sh\nprintf "Versi\\363n 1\\n"\nexec ' + str(COMPILER).encode() + b' "$@"\n'
    monkeypatch.setenv("CC", script(tmp_path / "cc", text))
    assert_right(made())


def test_a_compiler_that_waits_for_input_gets_none(cache: Path, monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(native, "PATIENCE", 5)
    text = b"#!/bin/sh\ncat > /dev/null\nexec " + str(COMPILER).encode() + b' "$@"\n'
    monkeypatch.setenv("CC", script(tmp_path / "cc", text))
    assert_right(made())


def test_a_compiler_that_hangs_is_given_up(cache: Path, monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(native, "PATIENCE", 0.2)
    monkeypatch.setenv("CC", script(tmp_path / "cc", b"#!/bin/sh\nexec sleep 30\n"))
    assert made() is None
    assert list(cache.iterdir()) == []


@pytest.mark.parametrize("home", ["relative/cache", ""])
def test_a_cache_folder_that_is_not_absolute_is_ignored(cache: Path, monkeypatch, tmp_path, home: str) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", home)
    assert_right(made())
    assert list((tmp_path / "home" / ".cache" / "rpim_opt").glob("*.so"))
    assert not (tmp_path / "relative").exists()


def test_three_processes_at_once(cache: Path) -> None:
    processes = [subprocess.Popen([sys.executable, "-c", CODE]) for _ in range(3)]
    assert [process.wait() for process in processes] == [0] * 3
    assert sorted(path.suffix for path in cache.iterdir()) == [".sha256", ".so"]
