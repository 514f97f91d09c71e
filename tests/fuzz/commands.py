"""Whole commands with arguments drawn from what fits and from what does not, in a folder with a file of every kind."""

from __future__ import annotations

import io
import json
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from functools import cache
from inspect import signature
from pathlib import Path
from random import Random
from typing import Any

import rpim_opt as ro
from rpim_opt import cli
from rpim_opt.robot.library import find_robot
from rpim_opt.store.problem_file import problems_folder
from tests.fuzz.seeds import CONF, KINEMATICS, TRACKED, URDF, make_cell
from tests.fuzz.trial import Failure, failure, limited

LONGEST = 120.0
"""Seconds that a command may take that was given a problem it can solve, on a machine that does other things, too."""
CODES = (0, 1, 2, 3, 4)
DEFAULTS = {"simulate": ("sim/",), "study": ("results/",)}
"""What commands write where no option says where."""
STUDY = """QUESTION = "Does it run?"
METRICS = {}
def cases(quick): return [{"seed": 1}, {"seed": 2}]
def run(seed): return {"twice": 2.0 * seed}
def report(rows):
    from rpim_opt.study import Report
    return Report("Yes.", {"sum": sum(row["twice"] for row in rows)})
"""
FILES = [
    "result.json", "cell", "cell/problem.toml", "cell/identification.csv", "sim", "robot.toml", "arm.urdf", "arm.csv",
    "kinematics.yaml", "calibration.conf", "targets.csv", "poses.csv", "rows.csv", "table.csv", "mine.py",
    "nothing.csv",
    "empty.csv", "binary.xlsx", "binary.parquet", ".", "..", "", "\x00", "a" * 300, "/dev/null", "out", "/", "ur5e",
    "\udcff",
]  # fmt: skip
TARGETS = ["out/a.csv", "out/deep/b.html", "out", "\x00", "a" * 300 + "/x", "/dev/full", "/proc/x/y", "out/r.toml",
           "out/r.json", "mine.py/x", "out/\udcff"]  # fmt: skip
TEXTS = [
    "", " ", "x", "1", "0", "-1", "nan", "inf", "1e400", "1e308", "deg,mm", "rad,m", "mm", "deg", "label", "row",
    "wxyz",
    "xyzw", "vector", "utf-8", "cp1252", "utf-16", "rot13", "comma", "semicolon", "tab", ".", ",", "position",
    "pose",
    "cable",
    "distance", "plane", "sphere", "revisit", "reml", "l_curve", "gcv", "learned", "0.5", "tikhonov", "bounded",
    "lasso",
    "robust", "robust,tikhonov", "least_squares", "auto", "geometry", "free", "level", "declared", "robot",
    "folder", "0.25",
    "2", "V", "D", "A", "E", "0,0,100,0,90,0", "2.5,0,0,100", "400,0,500", "nan,0,0", "wrist", "base", "tip",
    "hand", "--",
    "-", "é", "\x1b[2J", "\ud800", "9" * 400, "label,q1_deg,q2_deg,x_mm,y_mm,z_mm", "rms_mm", "max_mm,rms_mm",
    "nominal",
    "'tikhonov, reml'", "tcp://127.0.0.1:1",
    "7x5,30mm", "99999x9,1.2.3mm",
]  # fmt: skip
NUMBERS = [
    "0",
    "-1",
    "1",
    "2",
    "3",
    "0.25",
    "0.5",
    "nan",
    "inf",
    "-inf",
    "1e400",
    "1e308",
    "1e-320",
    "x",
    "",
    "007",
    "1_0",
    "٣",
]
KEPT_SMALL = {"candidates": ["0", "1", "30", "-1", "1000001", "x"], "seeds": ["0", "1", "-1", "x"],
"workers": ["0", "1", "-3", "x"],
              "scheduler": ["", "nonsense", "x:y:z"]}  # fmt: skip
"""Where a large number is what was asked for, a second process, or waiting for another machine."""
FITTING: dict[str, list[list[str]]] = {
    "new": [["out/cell", "--robot", "robot.toml", "--data", "table.csv"], ["out/c", "--robot", "ur5e", "--data",
    "rows.csv"]],
    "inspect": [["cell"], ["cell", "--json"]],
    "calibrate": [["cell"], ["cell", "--selector", "1"], ["cell", "--out", "out", "--selector", "1"]],
    "report": [["result.json", "--out", "out/r.html"], ["."]],
    "validate": [["result.json", "table.csv"]],
    "export": [["result.json", "--mdh", "out/r.toml"], ["result.json", "--robodk", "out/r.csv"]],
    "compensate": [["result.json", "targets.csv"], ["result.json", "poses.csv", "--position-only"]],
    "simulate": [["sim", "--out", "out"]],
    "design": [["cell", "--count", "3", "--candidates", "20"]],
    "study": [["mine.py", "--out", "out/s"]],
    "compare": [["cell", "--formulations", "tikhonov", "--selector", "1"]],
    "robots": [[]],
}  # fmt: skip


def make_desk(folder: Path) -> None:
    """Make a folder with a file of every kind."""
    cell = folder / "cell"
    make_cell(cell)
    shutil.copy(cell / "robot.toml", folder / "robot.toml")
    shutil.copy(cell / "identification.csv", folder / "table.csv")
    instance = ro.load(cell)
    ro.store.save_result(ro.calibrate(instance.problem, ro.tikhonov, 1.0), folder / "result.json", instance.record)
    shutil.copytree(problems_folder() / "scara", folder / "sim")
    (folder / "arm.urdf").write_text(URDF)
    ro.robot.write_robot(ro.read_robot(find_robot("irb120")), folder / "arm.csv")
    (folder / "kinematics.yaml").write_text(KINEMATICS)
    (folder / "calibration.conf").write_text(CONF)
    (folder / "targets.csv").write_text("label,q1_deg,q2_deg\nA,0,10\nB,1,2\n")
    (folder / "poses.csv").write_text("x_mm,y_mm,z_mm\n100,200,300\n300,0,400\n")
    (folder / "rows.csv").write_text(TRACKED)
    (folder / "mine.py").write_text(STUDY)
    (folder / "empty.csv").write_text("")
    for name in ("binary.xlsx", "binary.parquet"):
        (folder / name).write_bytes(bytes(range(256)) * 4)


@cache
def parameters() -> dict[str, list[Any]]:
    """Return the parameters of every command, as the command line knows them."""
    group: Any = cli._command()
    return {name: list(command.params) for name, command in group.commands.items()}


@cache
def kinds(command: str) -> dict[str, str]:
    """Return the annotations of a command's parameters."""
    return {name: str(each.annotation) for name, each in signature(getattr(cli, command)).parameters.items()}


def drawn(rng: Random) -> list[str]:
    """Draw a command line."""
    command = rng.choice(list(FITTING))
    known = parameters()[command]
    line = [command]
    if rng.random() < 0.55:
        line += rng.choice(FITTING[command])
    else:
        for each in known:
            if each.param_type_name == "argument" and rng.random() < 0.95:
                line.append(_value(rng, command, each))
    options = [each for each in known if each.param_type_name == "option"]
    for each in rng.sample(options, min(len(options), int(rng.expovariate(0.6)))):
        name = rng.choice([*each.opts, *each.secondary_opts])
        line.append(name)
        if not each.is_flag:
            line.append(_value(rng, command, each))
    if command == "design" and "--candidates" not in line:
        line += ["--candidates", "30"]  # a thousand take their time
    if rng.random() < 0.1:
        line.insert(rng.randrange(len(line) + 1), rng.choice([*TEXTS, "--nonsense", "-x", "--out"]))
    return line


def _value(rng: Random, command: str, each: Any) -> str:
    if each.name in KEPT_SMALL:
        return rng.choice(KEPT_SMALL[each.name])
    if each.name in ("out", "mdh", "robodk", "folder"):
        return rng.choice(TARGETS)
    kind = kinds(command)[each.name]
    if "Path" in kind or "Result" in kind or each.name in ("problem", "problems", "robot", "name"):
        return rng.choice(FILES)
    if "int" in kind or "float" in kind:
        return rng.choice(NUMBERS)
    return rng.choice(TEXTS)


def run(line: list[str]) -> Failure | int:
    """Run a command line in the current folder, and return its exit code, or how it fails."""
    out = io.StringIO()
    err = io.StringIO()
    before = listing()
    try:
        with _arguments(line), redirect_stdout(out), redirect_stderr(err), limited(LONGEST):
            cli.main()
    except SystemExit as stop:
        code = int(stop.code or 0)
    except BaseException as error:
        return replace_place(failure(error), line)
    else:
        return Failure("no exit", "main returned")
    return _oddity(line, code, out.getvalue(), err.getvalue(), before) or code


def replace_place(found: Failure, line: list[str]) -> Failure:
    """Return a failure with its command line."""
    return found._replace(text=f"{line}\n{found.text}")


def _oddity(line: list[str], code: int, out: str, err: str, before: dict[str, tuple[int, int]]) -> Failure | None:
    """Return what is wrong with how a command ended."""
    said = f"{line}\n{code}\n{out[-500:]}\n{err[-1500:]}"
    if code not in CODES:
        return Failure(f"code {code} of {line[0]}", said)
    if "Traceback" in err or "\x1b" in out:
        return Failure(f"what {line[0]} says", said)
    if code in (2, 3) and not err.strip():
        return Failure(f"nothing said by {line[0]}", said)
    if "output cannot be written" in err:
        return Failure(f"an input taken for an output by {line[0]}", said)
    changed = {name for name, state in listing().items() if before.get(name) != state}
    places = ("out", "report.html", "--", *DEFAULTS.get(line[0], ()))
    allowed = {name for name in changed if name.startswith(places)}
    left = {name for name in changed if ".part" in name}
    if changed - allowed or left:
        return Failure(f"{line[0]} wrote {sorted(changed - allowed | left)[:3]}", said)
    return None


def listing() -> dict[str, tuple[int, int]]:
    """Return size and time of every file in the current folder."""
    return {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in Path().rglob("*") if path.is_file()}


@contextmanager
def _arguments(line: list[str]) -> Iterator[None]:
    before = sys.argv
    sys.argv = ["rpim-opt", *line]
    try:
        yield
    finally:
        sys.argv = before


@contextmanager
def desk(folder: Path) -> Iterator[None]:
    """Make the folder and go there."""
    before = Path.cwd()
    make_desk(folder)
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def tidy() -> None:
    """Remove what a command may write, also where an option stood for the value of another."""
    for path in (Path("out"), Path("report.html"), *Path().glob("--*")):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def fuzz(rng: Random, count: int) -> Iterator[tuple[list[str], Failure | int]]:
    """Run command lines, and yield each with its exit code or how it failed."""
    for _ in range(count):
        line = drawn(rng)
        yield line, run(line)
        tidy()


def main(arguments: list[str]) -> int:
    """Run as many commands as asked: ``python -m tests.fuzz.commands COUNT SEED FOLDER``."""
    import tempfile
    import warnings
    from collections import Counter

    count, seed = map(int, arguments[:2])
    target = Path(arguments[2]).resolve()
    target.mkdir(parents=True, exist_ok=True)
    codes: Counter[str] = Counter()
    seen: Counter[str] = Counter()
    warnings.simplefilter("error")
    with tempfile.TemporaryDirectory() as place, desk(Path(place) / "desk"):
        for _, found in fuzz(Random(seed), count):
            codes["failed" if isinstance(found, Failure) else str(found)] += 1
            if isinstance(found, Failure):
                seen[found.place] += 1
                if seen[found.place] <= 3:
                    with (target / "failed.txt").open("a") as stream:
                        stream.write(f"{found.place}\n{found.text}\n{'-' * 20}\n")
            if codes.total() % 50 == 0:
                (target / f"commands-{seed}.json").write_text(json.dumps(codes))
        (target / f"commands-{seed}.json").write_text(json.dumps(codes))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
