"""CasADi functions as machine code: generated C, compiled once by the system's compiler, kept in a cache."""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import shutil
import stat
import subprocess
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

import casadi as ca

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.inputs import LARGEST_DATA, read_bytes
from rpim_opt.basics.writing import scratch_folder, write_files

FLAGS = ("-O3", "-march=native", "-ffp-contract=off", "-fPIC", "-shared")
"""No product is fused with a sum, so that machine code has the virtual machine's last bits."""
SWITCH = "RPIM_OPT_COMPILE"
"""Environment variable; 0 leaves everything to CasADi's virtual machine."""
PATIENCE = 120
"""Seconds that a compiler gets."""
OTHERS = stat.S_IWGRP | stat.S_IWOTH


@lru_cache(maxsize=256)
def compiled(function: ca.Function, make: bool = True) -> ca.Function | None:
    """Return the function as machine code, a few times as fast as CasADi's virtual machine; None where that fails.

    Without ``make`` only a library that was made before is taken.

    The library's name is a digest of its source, of the compiler and of the processor, so that a stale one is never
    taken, and the digest of its content stands beside it, so that a damaged one is made anew. A folder or a library
    that others may write to is not used.
    """
    compiler = _compiler()
    folder = _cache()
    if os.environ.get(SWITCH) == "0" or compiler is None or folder is None:
        return None
    generator = ca.CodeGenerator(function.name())
    generator.add(function)
    source = generator.dump()
    made_of = "\0".join([source, *compiler, _version(compiler), *FLAGS, _processor(compiler), version("casadi")])
    library = (
        folder / f"{function.name()}-{hashlib.sha256(made_of.encode(errors='surrogateescape')).hexdigest()[:32]}.so"
    )
    if not _is_whole(library) and not (make and _make(library, source, compiler)):
        return None
    try:
        return ca.external(function.name(), str(library))
    except RuntimeError:
        return None


def _compiler() -> tuple[str, ...] | None:
    """Return the command of the compiler, with the options that the variable CC may have; None where there is none."""
    try:
        command, *options = shlex.split(os.environ.get("CC") or "cc")
    except ValueError:  # an open quotation, or nothing
        return None
    found = shutil.which(command)
    if found is None:
        return None
    return (found, *options)


@lru_cache
def _version(compiler: tuple[str, ...]) -> str:
    try:
        return _run([*compiler, "--version"]).decode(errors="replace")
    except (OSError, subprocess.SubprocessError):
        return ""


@lru_cache
def _processor(compiler: tuple[str, ...]) -> str:
    """Return what the compiler knows of this processor: homes may be shared by machines with other ones."""
    try:
        said = _run([*compiler, *FLAGS[:2], "-dM", "-E", "-x", "c", os.devnull]).decode(errors="replace")
    except (OSError, subprocess.SubprocessError):
        said = ""
    return platform.machine() + said


def _run(command: list[str]) -> bytes:
    done = subprocess.run(command, check=True, stdin=subprocess.DEVNULL, capture_output=True, timeout=PATIENCE)
    return done.stdout


def _make(library: Path, source: str, compiler: tuple[str, ...]) -> bool:
    """Compile a library, and write it with the digest of its content; return whether that went well."""
    try:
        with scratch_folder(library.parent / "making") as scratch:
            text = scratch / "function.c"
            made = scratch / "function.so"
            text.write_text(source, encoding="utf-8")
            _run([*compiler, *FLAGS, str(text), "-o", str(made), "-lm"])
            content = read_bytes(made, LARGEST_DATA)
            files = {library: content, _digest_file(library): _digest(content)}
            for file in files:
                if os.path.lexists(file) and not _is_ours(file):
                    file.unlink()
            write_files(files)
            for file in files:
                file.chmod(0o600)  # whatever the umask lets others do
    except (OSError, subprocess.SubprocessError, InputError):
        return False
    return _is_whole(library)


def _digest_file(library: Path) -> Path:
    return library.with_suffix(".sha256")


def _digest(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()


def _is_whole(library: Path) -> bool:
    """Whether a library is there as it was made, and nobody else may write to it."""
    try:
        if not (_is_ours(library) and _is_ours(_digest_file(library))):
            return False
        return _digest(read_bytes(library, LARGEST_DATA)) == read_bytes(_digest_file(library))
    except (OSError, InputError):
        return False


def _is_ours(path: Path) -> bool:
    found = path.lstat()
    return stat.S_ISREG(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & OTHERS


def _cache() -> Path | None:
    """Return the user's cache folder, if it is the user's alone."""
    if not hasattr(os, "getuid"):
        return None
    stated = Path(os.environ.get("XDG_CACHE_HOME") or "")
    try:
        if not stated.is_absolute():  # as the specification of these folders has it
            stated = Path.home() / ".cache"
        folder = stated / "rpim_opt"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
    except (OSError, ValueError, RuntimeError):  # RuntimeError: a user without a home
        return None
    if found.st_uid != os.getuid() or found.st_mode & OTHERS:
        return None
    return folder
