"""Every raw file by the command line alone to a calibrated robot, all judged by the same rows that none has seen.

``python -m tests.store.raw_figures`` writes `raw_files.md`.
"""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
from pathlib import Path
from typing import NamedTuple

import pytest
from scipy.spatial.transform import Rotation

from rpim_opt.basics.text import markdown
from rpim_opt.robot import write_robot
from tests.simulate import ARM
from tests.store.raw_files import APART, COUNT, EVERY_Q, EVERY_T, HEAD, NOISE, RAW, beside, cells, text, write
from tests.test_cli import run

TABLE = Path(__file__).with_name("raw_files.md")
CLEAN = "comma"
MOST = 1.1
"""The RMS error after a raw file over that after the clean table is no more than this."""
SHOWN = 36
"""Characters of a file's header in the table, at its beginning and at its end."""


class Judged(NamedTuple):
    """What a raw file led to: RMS errors on the rows apart [mm], the options that it needed, and how it begins."""

    nominal: float
    identified: float
    options: str
    header: str


def judged(shape: str) -> Judged:
    """Carry out `new`, `calibrate` and `validate` with a raw file as it is."""
    make, stated, kind = RAW[shape]
    options = [part for key, value in stated.items() for part in (f"--{key}", value)]
    with tempfile.TemporaryDirectory() as place, pytest.MonkeyPatch.context() as patch:
        folder = Path(place)
        made = make(folder)
        files = made if isinstance(made, list) else [made]
        write_robot(ARM, folder / "robot.toml")
        apart = write(folder, "apart.csv", _rows_apart(kind))
        data = [part for file in files for part in ("--data", str(file))]
        cell, out = str(folder / "cell"), str(folder / "out")
        _done(patch, "new", cell, "--robot", str(folder / "robot.toml"), *data, *options)
        _done(patch, "calibrate", cell, "--out", out)
        found = json.loads(_done(patch, "validate", out, str(apart), "--json"))
        header = " and ".join(_header(file) for file in files)
    return Judged(found["nominal"]["rms_mm"], found["identified"]["rms_mm"], " ".join(options), header)


def _rows_apart(kind: str) -> str:
    T = EVERY_T[COUNT:]
    labels = [[f"V{i + 1}"] for i in range(APART)]
    rows = beside(labels, cells(EVERY_Q[COUNT:], 3), cells(T[:, :3, 3], 4))
    if kind == "position":
        return text([HEAD], rows)
    xyzw = cells(Rotation.from_matrix(T[:, :3, :3]).as_quat())
    return text([[*HEAD, "qx", "qy", "qz", "qw"]], beside(rows, xyzw))


def _done(patch: pytest.MonkeyPatch, *command: str) -> str:
    """Return what a command prints."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = run(patch, *command)
    if code:
        raise AssertionError(f"{' '.join(command)} ended with {code}: {said.getvalue()}")
    return said.getvalue()


def _header(file: Path) -> str:
    """Return how a file begins, for readers of the table."""
    if file.suffix in (".xlsx", ".parquet"):
        return f"a {file.suffix} file"
    content = file.read_bytes()
    encoding = "utf-8-sig"
    if 0 in content[:4]:
        encoding = "utf-16-le"
    elif b"\xdf" in content:
        encoding = "latin-1"
    first = content.decode(encoding).lstrip("\ufeff").splitlines()[0]
    plain = first.replace("\t", "→").replace("|", "¦")
    if len(plain) > 2 * SHOWN:
        plain = f"{plain[:SHOWN]} ... {plain[-SHOWN:]}"
    return f"`{plain}`"


def main() -> None:
    """Write the table of all raw files."""
    found = {shape: judged(shape) for shape in RAW}
    clean = found[CLEAN].identified
    rows = []
    for shape, each in found.items():
        options = each.options and f"`{each.options}`"
        rows.append([shape, each.header, options, f"{each.identified:.4f}", f"{each.identified / clean:.3f}"])
    worst = max(each.identified for each in found.values()) / clean
    drawing = found[CLEAN].nominal
    lines = [
        "# Raw files, each from as it is to a calibrated robot",
        "",
        f"`python -m tests.store.raw_figures` makes {len(RAW)} files of one series of {COUNT} measurements of a "
        f"simulated robot ({NOISE} mm of noise along each axis; RMS error by its drawing {drawing:.4f} mm), and "
        "carries out `rpim-opt new`, `calibrate` and `validate` with each. All are judged by the same "
        f"{APART} configurations that none has seen. The largest RMS error is {worst:.3f} times the clean table's.",
        "",
        markdown(["file", "begins with", "options of `new`", "RMS error [mm]", "over the clean table's"], rows),
    ]
    TABLE.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
