"""CasADi functions as machine code: generated C, compiled once by the system's compiler, kept in a cache."""

from __future__ import annotations

import ctypes
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
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.inputs import LARGEST_DATA, read_bytes
from rpim_opt.basics.room import room
from rpim_opt.basics.writing import scratch_folder, write_files

FLAGS = (
    "-O2", "-march=native", "-ftree-vectorize", "-ffp-contract=off", "-fPIC", "-shared",
    "-fvisibility=hidden", "-DCASADI_SYMBOL_EXPORT=",
)  # fmt: skip
"""No product is fused with a sum, so that machine code has the virtual machine's last bits. Nobody sees CasADi's own
functions, so that they may be inlined. -O3 unrolls the loops over rows, which takes longer."""
SWITCH = "RPIM_OPT_COMPILE"
"""Environment variable; 0 leaves everything to CasADi's virtual machine."""
PATIENCE = 120
"""Seconds that a compiler gets."""
OTHERS = stat.S_IWGRP | stat.S_IWOTH


ROWS = """
__attribute__((visibility("default")))
void rows(const double* common, const double* table, long long N, double* work, double* const* found, long long step,
          const double* factor) {{
  const casadi_real* arg[{sz_arg}];
  casadi_real* res[{sz_res}];
  casadi_int iw[{sz_iw} + 1];
  double *given = work, *turns = given + {inputs}*{width}, *sines = turns + {angles}*{width};
  double *cosines = sines + {angles}*{width}, *numbers = cosines + {angles}*{width};
  double *own = numbers + {numbers}*{width};
  for (long long start = 0; start < N; start += {width}) {{
    const int there = N - start < {width} ? (int)(N - start) : {width};
    const double* first = table + start*{inputs};
    for (int k = 0; k < {inputs}; ++k)
      for (int i = 0; i < {width}; ++i) given[k*{width} + i] = first[(i < there ? i : there - 1)*{inputs} + k];
    arg[0] = common;
    arg[1] = given;
    res[0] = turns;
    angles(arg, res, iw, own, 0);
    for (int i = 0; i < {angles}*{width}; ++i) {{
      const double angle = turns[i];
      sines[i] = sin(angle);
      cosines[i] = cos(angle);
    }}
    arg[0] = common;
    arg[1] = given;
    for (int k = 0; k < {angles}; ++k) {{
      arg[2 + k] = sines + k*{width};
      arg[2 + {angles} + k] = cosines + k*{width};
    }}
    res[0] = numbers;
    {name}(arg, res, iw, own, 0);
    for (int k = 0; k < {numbers}; ++k) {{
      const double* from = numbers + k*{width};
      double* into = found[k] + start*step;
      if (step == 1 && there == {width})
        for (int i = 0; i < {width}; ++i) into[i] = factor[k]*from[i];
      else
        for (int i = 0; i < there; ++i) into[i*step] = factor[k]*from[i];
    }}
  }}
}}
"""
"""C of what evaluates a function of some rows abreast at any number of them; the last one stands for those missing.

A sine and a cosine of one angle, side by side, are one call of C's library, which takes two thirds of the time."""


class MachineCode:
    """A function (common, rows (width, k), sines, cosines) -> numbers (width, n), evaluated at any number of rows.

    Parameters
    ----------
    function, angles
        As `compiled` has them.
    library
        What was made of it.

    Raises
    ------
    OSError
        Where the file is no library.
    """

    def __init__(self, function: ca.Function, angles: ca.Function, library: Path):
        self._rows = ctypes.CDLL(str(library)).rows
        self._rows.restype = None
        address = ctypes.c_void_p
        self._rows.argtypes = [address, address, ctypes.c_longlong, address, address, ctypes.c_longlong, address]
        self._size = function.nnz_in(1) + 3 * angles.nnz_out(0) + function.nnz_out(0)
        self._size += max(function.sz_w(), angles.sz_w())

    def __call__(self, common: Array, rows: Array, places: np.ndarray, step: int, factors: Array) -> None:
        """Write a function's numbers of rows (N, k), times factors (n,).

        Parameters
        ----------
        common, rows
            Its inputs, both dense.
        places
            (n,) addresses of every number of the first row.
        step
            How many numbers later in memory that of the next row stands.
        factors
            (n,) of every number.
        """
        work = room("machine code", self._size)
        given = [each.ctypes.data for each in (common, rows, work, places, factors)]
        self._rows(given[0], given[1], len(rows), given[2], given[3], step, given[4])


@lru_cache(maxsize=256)
def compiled(function: ca.Function, angles: ca.Function, make: bool = True) -> MachineCode | None:
    """Return a function of rows abreast as machine code, a few times as fast as CasADi's virtual machine, or None.

    It takes shared numbers, rows (width, k), and every sine and every cosine (width,) of the ``angles`` (width, t) of
    the same inputs.

    Without ``make`` only a library that was made before is taken; None, too, where it cannot be made.

    The library's name is a digest of its source, of the compiler and of the processor, so that a stale one is never
    taken, and the digest of its content stands beside it, so that a damaged one is made anew. A folder or a library
    that others may write to is not used.
    """
    compiler = _compiler()
    folder = _cache()
    if os.environ.get(SWITCH) == "0" or compiler is None or folder is None:
        return None
    generator = ca.CodeGenerator(function.name())
    generator.add(angles)
    generator.add(function)
    source = generator.dump() + _driver(function, angles)
    made_of = "\0".join([source, *compiler, _version(compiler), *FLAGS, _processor(compiler), version("casadi")])
    library = (
        folder / f"{function.name()}-{hashlib.sha256(made_of.encode(errors='surrogateescape')).hexdigest()[:32]}.so"
    )
    if not _is_whole(library) and not (make and _make(library, source, compiler)):
        return None
    try:
        return MachineCode(function, angles, library)
    except (OSError, AttributeError):
        return None


def _driver(function: ca.Function, angles: ca.Function) -> str:
    width, inputs = function.size_in(1)
    both = (function, angles)
    return ROWS.format(
        name=function.name(), width=width, inputs=inputs, numbers=function.size2_out(0), angles=angles.size2_out(0),
        sz_arg=max(of.sz_arg() for of in both), sz_res=max(of.sz_res() for of in both),
        sz_iw=max(of.sz_iw() for of in both),
    )  # fmt: skip


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
