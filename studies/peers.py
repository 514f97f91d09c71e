"""Compare rpim_opt with pybotics, robotkinecal, figaroh and plain SciPy on the same simulated measurements.

Simulated arms (`ro.study.simulated_arm`): three ready robots in turn with errors in all six directions behind every
link, sizes that differ from arm to arm and from link to link, every other one with a joint that is off by a degree;
base and reflector known to some millimetres; 0.03 mm noise a coordinate; 10, 15, 25, 52 or 200 configurations, 52 with
three errors of 3 mm, or 52 of arms that sag and have eccentric encoders. Judged at 200 others without noise.

All tools have the same data, the same nominal arm with base and reflector as they are known (as URDF or as rows alpha,
a, theta, d), and identify a complete model: geometry, base and reflector. Joint values are those of the model.

Every peer lives in an environment of its own under ``studies/.environments``, made at the first run: their demands on
NumPy exclude each other. Every run is a fresh process.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import subprocess
import sys
import tempfile
import venv
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import gmean

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import RpimError
from rpim_opt.basics.files import write_files, write_json, write_text
from rpim_opt.basics.text import markdown
from rpim_opt.robot.extensions import gravity_torques
from rpim_opt.robot.mdh import Gravity, Robot
from rpim_opt.study import Metric, Report

QUESTION = "Is rpim_opt more accurate than pybotics, robotkinecal, figaroh and SciPy on the same measurements?"
HERE = Path(__file__).resolve().parent
PACKAGES = {
    "pybotics": ("pybotics==3.1.2", (3, 14)),
    "robotkinecal": ("robotkinecal==0.1.0", (3, 13)),
    "figaroh": ("figaroh==1.0.2", (3, 15)),
}
"""What is installed for a peer, and the first Python that it does not support."""
METHODS = {
    "pybotics, documented": "nothing",
    "pybotics, xyz": "nothing",
    "pybotics, xyz, soft_l1": "noise",
    "robotkinecal, documented": "nothing",
    "figaroh, structural": "nothing",
    "figaroh, map_cv": "its own sizes",
    "figaroh, map": "noise, its own sizes",
    "figaroh, map, threshold": "noise, its own sizes",
    "scipy, lm": "nothing",
    "scipy, soft_l1": "noise",
    "rpim_opt, command": "generic sizes",
    "rpim_opt, script": "noise, generic sizes",
    "rpim_opt, reml": "generic sizes",
    "rpim_opt, robust": "generic sizes",
}
"""Tool and setting, and what it is told besides the data and the nominal arm."""
DOCUMENTED = (
    "pybotics, documented",
    "robotkinecal, documented",
    "figaroh, structural",
    "scipy, lm",
    "rpim_opt, command",
)
"""What a user gets who follows a package's own example."""
OURS = "rpim_opt, command"
ROBUST = {"xyz, soft_l1", "soft_l1", "map, threshold", "robust"}
SLOW = {"pybotics, documented", "figaroh, map_cv", "pybotics, xyz, soft_l1"}
"""Left out in the quick version."""
CROSS_VALIDATED = "figaroh, map_cv"
"""Half a minute with 52 configurations, where its own prior without cross-validation does the same; left out there."""
SITUATIONS = {
    "clean10": (10, {}),
    "clean15": (15, {}),
    "clean25": (25, {}),
    "clean52": (52, {}),
    "clean200": (200, {}),
    "blunders52": (52, {"blunders": 3}),
    "physics52": (52, {"physics": 2e-4}),
}
"""Configurations, and what else is wrong."""
SEEDS = 13
QUICK = ("clean10", "clean52", "blunders52")
NOISE = 3e-5
BLUNDER = 3e-3
"""Length of an error [m]."""
DRAWS = 2000
"""Resamplings of the arms, for intervals."""
TEXT = """\
RMS position error at 200 other configurations without noise [mm]: geometric mean and largest over {seeds} simulated
arms, the same for all. `over ours` is the error over that of `rpim_opt, command` on the same arm (geometric mean, with
the 95 % interval over resampled arms; above 1: ours is better) and `better` the arms on which the method is better by
more than 1 %. `told` is what a method knows besides the data and the nominal arm. Seconds: median of the calibration
alone, and with the imports of a fresh process, on a machine that did other work beside. What a peer answers to the
same files is asked once and kept, so that its seconds may be of another day than ours.

`documented`, `structural`, `lm` and `command` are what a user gets who follows a package's example: for ours that is
`rpim-opt new` with the URDF and the table, and `rpim-opt calibrate`. The other rows are the best settings that we
found: residuals by coordinate in the place of distances, `soft_l1` with the noise as its scale, figaroh's priors (1 mm,
2 mrad, 20 mrad of joint offsets) with stated noise, and its threshold for outliers at 1.5 mm (set by hand, knowing the
errors). With ten configurations there are fewer equations than parameters; whoever takes all of them for free then
shows it. pybotics has no parameter for the angle between parallel axes; that is its model, and costs it where the arm
has such axes.

"""
METRICS = {situation: Metric("lower", 0.02) for situation in SITUATIONS}
METRICS |= {f"{situation} over best peer": Metric("lower", 0.05) for situation in SITUATIONS}


def prepare(quick: bool) -> None:
    """Install the peers, each into its own environment; an existing folder already is left alone."""
    for peer, (requirement, below) in PACKAGES.items():
        install(peer, [requirement], below)


def install(name: str, requirements: Sequence[str], below: tuple[int, int]) -> None:
    """Install packages into an environment of their own, unless they are there."""
    folder = HERE / ".environments" / name
    stated = " ".join(requirements)
    if (folder / "complete").is_file() and (folder / "complete").read_text() == stated:
        return
    interpreter = _interpreter(below)
    if interpreter is None:
        raise RpimError(f"{stated} needs a Python below {below[0]}.{below[1]}, and none was found.")
    print(f"Installing {stated} ...", file=sys.stderr, flush=True)
    if interpreter == sys.executable:
        venv.create(folder, with_pip=True, clear=True)
    else:
        subprocess.run([interpreter, "-m", "venv", "--clear", folder], check=True)
    pip = [folder / "bin" / "python", "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    subprocess.run([*pip, *requirements], check=True)
    write_text(folder / "complete", stated)


def _interpreter(below: tuple[int, int]) -> str | None:
    """Return this Python, or another one on the path if this one is too new."""
    if sys.version_info < below:
        return sys.executable
    names = (f"python3.{minor}" for minor in range(below[1] - 1, 10, -1))
    return next((path for path in map(shutil.which, names) if path), None)


def cases(quick: bool) -> list[dict[str, Any]]:
    """Return every tool with every situation and arm; quick: one arm, three situations."""
    seeds = range(SEEDS)
    situations = tuple(SITUATIONS)
    if quick:
        seeds = range(1)
        situations = QUICK
    tools = dict.fromkeys(method.partition(", ")[0] for method in METHODS)
    return [
        {"tool": tool, "situation": situation, "seed": seed, "quick": quick}
        for situation in situations
        for seed in seeds
        for tool in tools
    ]


def asked(tool: str, situation: str, quick: bool) -> list[str]:
    """Return the settings of a tool that a situation asks for: robust ones where there are errors to resist."""
    found = []
    for method in METHODS:
        name, _, setting = method.partition(", ")
        robust = setting in ROBUST and situation != "blunders52"
        slow = method in SLOW and quick
        slow |= method == CROSS_VALIDATED and SITUATIONS[situation][0] > 25
        if name == tool and not robust and not slow:
            found.append(setting)
    return found


def run(tool: str, situation: str, seed: int, quick: bool, anew: bool = False) -> dict[str, Any]:
    """Return position errors at other configurations [mm], largest corrections and seconds of a tool's settings.

    What a peer answers to the same files is asked once and kept; ``anew`` asks it now, for seconds of today.
    """
    settings = asked(tool, situation, quick)
    script = HERE / "peer_scripts" / f"run_{tool}.py"
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        true = write_problem(folder, situation, seed)
        if tool not in PACKAGES:
            return _answered(sys.executable, script, folder, settings, true)
        kept = HERE / ".environments" / tool / "answers" / _digest(tool, script, folder, settings)
        found = _kept(kept)
        if found is None or anew:
            program = str(HERE / ".environments" / tool / "bin" / "python")
            found = _answered(program, script, folder, settings, true)
            text = json.dumps(found).encode()
            kept.parent.mkdir(exist_ok=True)
            write_files({kept: hashlib.sha256(text).hexdigest().encode() + b"\n" + text})
        return found


def _kept(path: Path) -> dict[str, Any] | None:
    """Return an answer that was kept below the digest of its text, or nothing where none is whole."""
    if not path.is_file():
        return None
    digest, _, text = path.read_bytes().partition(b"\n")
    if hashlib.sha256(text).hexdigest().encode() != digest:
        return None
    return json.loads(text)


def _digest(tool: str, script: Path, folder: Path, settings: list[str]) -> str:
    """Return what a peer's answer depends on: its package, our scripts for it, the problem's files and the settings."""
    parts = [PACKAGES[tool][0].encode(), script.read_bytes(), script.with_name("common.py").read_bytes()]
    parts += [json.dumps(settings).encode()]
    parts += [path.name.encode() + b"\0" + path.read_bytes() for path in sorted(folder.iterdir())]
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()


def _answered(program: str, script: Path, folder: Path, settings: list[str], true: Array) -> dict[str, Any]:
    """Return what a tool says of a problem, with its errors from where the arm truly is (200, 3) [mm]."""
    command = [program, str(script), str(folder), *settings]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        said = done.stderr.strip().rpartition("\n")[2]  # nothing, of a process that was killed
        raise RpimError(f"{script.name} ended with {done.returncode}: {said}")
    answers = json.loads(done.stdout.strip().splitlines()[-1])
    found = {"imports": answers.pop("imports"), "versions": answers.pop("versions")}
    for setting, answer in answers.items():
        if "predicted_mm" in answer:
            error = np.linalg.norm(np.array(answer.pop("predicted_mm")) - true, axis=1)
            answer |= {"rms_mm": float(np.sqrt(np.mean(error**2))), "max_mm": float(error.max())}
        found |= {f"{setting}: {key}": value for key, value in answer.items()}
    return found


def by_method(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for every method from the rows of tools."""
    found = []
    for row in rows:
        case = {key: row[key] for key in ("situation", "seed", "imports", "versions")}
        for setting in asked(row["tool"], row["situation"], row["quick"]):
            own = {key: row.get(f"{setting}: {key}") for key in ("rms_mm", "seconds", "largest_mm", "largest_mrad")}
            found.append(case | {"method": f"{row['tool']}, {setting}"} | own)
    return found


def bent(size: float, seed: int, robot: Robot, q: Array) -> Array:
    """Return joint values (N, dof) [rad] at those of the encoders, which no geometry holds, of up to a size [rad].

    Joints sag under the weight of all that they carry, and their encoders are off by a third of the size times the
    cosine of their angle. Links weigh what they please: each as much as the one behind it or more.
    """
    rng = np.random.default_rng([seed, 5])
    masses = np.asarray(np.cumprod(rng.uniform(1.0, 2.0, robot.dof))[::-1], dtype=float).tolist()
    phase = rng.uniform(0, 2 * np.pi, robot.dof)
    compliance = rng.uniform(0.3, 1.0, robot.dof)
    alpha, a, _, d, _ = robot.mdh.T
    halves = np.column_stack([a, -d * np.sin(alpha), d * np.cos(alpha)]) / 2  # of the way to the next joint
    centres = [(x, y, z) for x, y, z in halves[1:].tolist()] + [(0.0, 0.0, 0.0)]
    heavy = replace(robot, gravity=Gravity(masses=tuple(masses), centres=tuple(centres)))
    largest = np.abs(gravity_torques(heavy, rng.uniform(-np.pi, np.pi, (200, robot.dof)))).max(axis=0)
    sag = compliance * gravity_torques(heavy, q) / np.maximum(largest, 1e-9 * largest.max())
    off = size * (sag + np.cos(q @ robot.joint_map.T + phase) / 3)
    return np.asarray(q + off @ np.linalg.inv(robot.joint_map).T)


def write_problem(folder: Path, situation: str, seed: int) -> Array:
    """Write one problem as every tool reads it, and return where the arm is at other configurations (200, 3) [mm].

    Tables in m and rad with nine decimals, the arm as URDF, and as rows alpha, a, theta, d with base and reflector.
    """
    count, more = SITUATIONS[situation]
    offset = np.radians((seed // 3) % 2)
    arm = ro.study.simulated_arm(seed, count, NOISE, offset, partial(bent, more.get("physics", 0.0), seed))
    problem = arm.problem
    turned = problem.robot.joint_map.T
    points = problem.data.blocks[0].y.copy()
    rng = np.random.default_rng([seed, 6])
    rows = rng.choice(count, more.get("blunders", 0), replace=False)
    direction = rng.normal(size=(len(rows), 3))
    points[rows] += BLUNDER * direction / np.linalg.norm(direction, axis=1)[:, None]
    true = arm.true.blocks[0].y
    head = "x1,y1,z1," + ",".join(f"joint_{i + 1}" for i in range(problem.robot.dof))
    for name, columns in (("calib", (points, problem.data.q @ turned)), ("valid", (true, arm.true.q @ turned))):
        np.savetxt(folder / f"{name}.csv", np.hstack(columns), delimiter=",", comments="", fmt="%.9f", header=head)
    table = problem.robot.mdh[:, :4]
    nominal = dict(zip(problem.parameters.names, problem.parameters.nominal, strict=True))
    base = [float(nominal[f"base_{key}"]) for key in ("x", "y", "z", "rx", "ry", "rz")]
    reflector = [float(nominal[f"tool_{key}"]) for key in "xyz"]
    parallel = [name for name in problem.parameters.free.names if name.startswith("beta")]
    known = {"alpha_a_theta_d": table.tolist(), "base": base, "tool": reflector, "parallel": parallel, "noise": NOISE}
    write_json(folder / "robot.json", known)
    write_text(folder / "robot.urdf", _urdf(table, base, reflector))
    return 1e3 * true


def _urdf(rows: Array, base: list[float], reflector: list[float]) -> str:
    """Return the nominal arm as URDF: its root is the instrument, the reflector is the frame ``smr``."""
    inertia = " ".join(f'i{a}="{0.01 * (a[0] == a[1])}"' for a in ("xx", "xy", "xz", "yy", "yz", "zz"))
    body = f'<inertial><origin xyz="0 0 0" rpy="0 0 0"/><mass value="1"/><inertia {inertia}/></inertial>'
    text = ['<robot name="arm">', '<link name="instrument"/>', f'<link name="base_link">{body}</link>']
    text.append(_fixed("base", "instrument", "base_link", base))
    parent = "base_link"
    for i, (alpha, a, theta, d) in enumerate(rows, start=1):
        place = f"{a:.12g} {-math.sin(alpha) * d:.12g} {math.cos(alpha) * d:.12g}"
        rpy = " ".join(f"{v:.16g}" for v in _roll_pitch_yaw(alpha, theta))
        text.append(
            f'<link name="link_{i}">{body}</link><joint name="joint_{i}" type="revolute"><parent link="{parent}"/>'
            f'<child link="link_{i}"/><origin xyz="{place}" rpy="{rpy}"/><axis xyz="0 0 1"/>'
            '<limit lower="-6.28" upper="6.28" effort="100" velocity="3"/></joint>'
        )
        parent = f"link_{i}"
    text.append('<link name="smr"/>')
    text.append(_fixed("smr_joint", parent, "smr", [*reflector, 0.0, 0.0, 0.0]))
    return "\n".join([*text, "</robot>"])


def _roll_pitch_yaw(alpha: float, theta: float) -> Array:
    """Return the angles of Rot(x, alpha) Rot(z, theta) about fixed axes."""
    turn = Rotation.from_euler("x", alpha) * Rotation.from_euler("z", theta)
    with warnings.catch_warnings():  # of gimbal lock, where one of many answers is as good as any
        warnings.simplefilter("ignore", UserWarning)
        return turn.as_euler("xyz")


def _fixed(name: str, parent: str, child: str, place: list[float]) -> str:
    xyz = " ".join(f"{v:.12g}" for v in place[:3])
    rpy = " ".join(f"{v:.16g}" for v in place[3:])
    return (
        f'<joint name="{name}" type="fixed"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/></joint>'
    )


def report(rows: list[dict[str, Any]]) -> Report:
    """Return a table for every situation, the arms that every tool wins, and a figure."""
    rows = by_method(rows)
    situations = [name for name in SITUATIONS if any(row["situation"] == name for row in rows)]
    seeds = sorted({row["seed"] for row in rows})
    parts = [TEXT.format(seeds=len(seeds)), _overview(rows, situations)]
    metrics = {}
    for situation in situations:
        errors = _errors(rows, situation, seeds)
        ours = errors[OURS]
        peers = {method: e for method, e in errors.items() if not method.startswith("rpim_opt")}
        best = min(peers, key=lambda method: gmean(peers[method]))
        metrics[situation] = gmean(ours)
        metrics[f"{situation} over best peer"] = gmean(ours) / gmean(peers[best])
        parts.append(f"## {situation}\n\n{_table(rows, situation, errors)}\n\n{_winners(errors)}\n")
    versions = sorted({row["versions"] for row in rows if row.get("versions")})
    text = "\n".join(parts) + f"\nVersions: {'; '.join(versions)}."
    return Report(text, metrics, {"peers": _figure(rows, situations, seeds)})


def _errors(rows: list[dict[str, Any]], situation: str, seeds: list[int]) -> dict[str, Array]:
    """Return RMS errors by arm [mm] for every method, infinite where it failed."""
    found = {}
    for row in rows:
        if row["situation"] == situation:
            value = row.get("rms_mm")
            usable = value is not None and np.isfinite(value)
            found.setdefault(row["method"], np.full(len(seeds), np.inf))[seeds.index(row["seed"])] = (
                value if usable else np.inf
            )
    return {method: found[method] for method in METHODS if method in found}


def _interval(ratios: Array) -> tuple[float, float]:
    """Return the 95 % interval of the geometric mean, by resampling arms."""
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, len(ratios), (DRAWS, len(ratios)))
    low, high = np.exp(np.quantile(np.mean(np.log(ratios[drawn]), axis=1), [0.025, 0.975]))
    return float(low), float(high)


def _overview(rows: list[dict[str, Any]], situations: list[str]) -> str:
    """Return the geometric means of all methods in all situations."""
    seeds = sorted({row["seed"] for row in rows})
    table = {situation: _errors(rows, situation, seeds) for situation in situations}
    lines = []
    for method, told in METHODS.items():
        cells = []
        for situation in situations:
            errors = table[situation].get(method)
            cells.append("-" if errors is None else _said(errors))
        lines.append([_bold(method), told, *cells])
    return markdown(["method", "told", *situations], lines) + "\n"


def _said(errors: Array) -> str:
    failed = int(np.sum(~np.isfinite(errors)))
    if failed:
        return f"failed {failed} of {len(errors)}"
    return f"{gmean(errors):.3f}"


def _bold(method: str) -> str:
    if method.startswith("rpim_opt"):
        return f"**{method}**"
    return method


def _table(rows: list[dict[str, Any]], situation: str, errors: dict[str, Array]) -> str:
    lines = []
    ours = errors[OURS]
    for method, values in errors.items():
        own = [row for row in rows if (row["situation"], row["method"]) == (situation, method)]
        good = np.isfinite(values)
        over = "-"
        if method != OURS and good.all() and len(values) > 1:
            low, high = _interval(values / ours)
            over = f"{gmean(values / ours):.2f} ({low:.2f} to {high:.2f})"
        elif method != OURS and good.all():
            over = f"{gmean(values / ours):.2f}"
        changes = []
        for unit in ("mm", "mrad"):
            sizes = [row[f"largest_{unit}"] for row in own if row.get(f"largest_{unit}") is not None]
            changes += [f"{max(sizes):.3g} {unit}"] if sizes else []
        largest = "-"
        if good.all():
            largest = f"{values.max():.3f}"
        lines.append(
            [
                _bold(method),
                _said(values),
                largest,
                over,
                f"{int(np.sum(values < 0.99 * ours))} of {len(values)}",
                ", ".join(changes) or "-",
                _median([row["seconds"] for row in own]),
                _median([row["imports"] + row["seconds"] for row in own if row["seconds"]]),
            ]
        )
    head = ["method", "mean", "largest", "over ours", "better", "largest correction", "seconds", "with imports"]
    return markdown(head, lines)


def _median(values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    return f"{np.median(known):.2g}"


def _winners(errors: dict[str, Array]) -> str:
    """Return how many arms every tool wins, by what its users get and by its best setting."""
    parts = []
    for what, methods in (("as documented", DOCUMENTED), ("at the best setting of each", tuple(METHODS))):
        tools = {}
        for method in methods:
            if method in errors:
                tool = method.partition(",")[0]
                tools.setdefault(tool, []).append(method)
        best = {tool: min(names, key=lambda name: gmean(errors[name])) for tool, names in tools.items()}
        least = np.argmin([errors[name] for name in best.values()], axis=0)
        counts = [f"{name} {int(np.sum(least == k))}" for k, name in enumerate(best.values())]
        parts.append(f"Arms on which each is the best, {what}: {'; '.join(counts)}.")
    return " ".join(parts)


def _figure(rows: list[dict[str, Any]], situations: list[str], seeds: list[int]) -> Any:
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    names = list(METHODS)[::-1]
    columns = min(len(situations), 4)  # more would be too small to read beside a text
    lines = -(-len(situations) // columns)
    size = (2.2 + 2.1 * columns, lines * (0.3 * len(names) + 1.2))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(lines, columns, sharey=True, squeeze=False).ravel()
    for unused in axes[len(situations) :]:
        unused.remove()
    for ax, situation in zip(axes, situations, strict=False):
        errors = _errors(rows, situation, seeds)
        for y, method in enumerate(names):
            values = errors.get(method, np.zeros(0))
            values = values[np.isfinite(values)]
            color = "C3" if method.startswith("rpim_opt") else "C0"
            ax.semilogx(values, [y] * len(values), "o", ms=3, alpha=0.35, color=color, mew=0)
            if len(values):
                ax.semilogx([gmean(values)], [y], "|", ms=11, mew=2, color=color)
        ax.set_title(situation, fontsize=10)
        ax.xaxis.set_major_locator(LogLocator(subs=(1,)))
        ax.xaxis.set_major_formatter(ScalarFormatter())
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.set_xlabel("RMS error [mm]", fontsize=8)
        ax.tick_params(axis="x", labelsize=7)
        ax.grid(axis="x", alpha=0.3)
        ax.set_yticks(range(len(names)), names, fontsize=8)
    return figure
