"""The text of a new ``problem.toml``: every key with what it means and where it comes from."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.camera import INTRINSICS
from rpim_opt.data.measurements.measurement import Measurement, Words, of_fixture
from rpim_opt.problem.observability import identifiable
from rpim_opt.problem.registration.camera import camera_blocks, posed
from rpim_opt.problem.registration.frames import locate, starting_cameras, starting_parameters
from rpim_opt.robot.chain import Described, placed, same_place
from rpim_opt.robot.formats.tables import exact, toml
from rpim_opt.robot.kinematics import FRAME, FRAME_DIMENSION
from rpim_opt.robot.mdh import MDH

TEMPLATE = Path(__file__).with_name("problem.toml.jinja")


def problem_text(
    arm: Described, kind: Measurement, rows: Dataset, noise: Mapping[str, float], said: Mapping[str, str]
) -> tuple[str, list[str]]:
    """Return the text of ``problem.toml``, and what was guessed in sentences."""
    from jinja2 import Environment

    markers = sorted({marker for block in rows.blocks for marker in block.markers})
    tools = dict.fromkeys(markers, arm.tool)
    words = kind.words
    base, how = _base(arm, rows, tools, words)
    parameters = starting_parameters(arm.robot, rows, base, tools)
    touched = [str(name) for block in rows.blocks if block.touched is not None for name in block.touched[:, 0]]
    template = Environment(trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, autoescape=False)
    text = template.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        **said,
        title=toml(arm.robot.name),
        measurement=toml(kind.name),
        identify=toml(_patterns(identifiable(arm.robot, parameters, rows), arm.robot.dof)),
        noise=list(noise.items()),
        sigma=f"sigma_{next(iter(noise)).rpartition('_')[2]}",
        base="" if base is None else _frame(base),
        how=how,
        known="where the file has its tip" if arm.tool.any() else "not known, and identified from the flange's origin",
        markers=[_subtable(marker) for marker in markers],
        tool=_frame(arm.tool),
        cameras=_cameras(rows),
        touched=toml(list(dict.fromkeys(touched))[:2]) if kind.touching else "",
        sessions=rows.sessions,
        temperatures=len(rows.temperatures),
        label=_key(rows.label[0]),
        words=words,
    )
    return text, [how]


def _cameras(rows: Dataset) -> list[tuple[str, str]]:
    """Return the names of the cameras' tables, and what their views show of each."""
    found = starting_cameras(rows, {})
    cameras = []
    for fixture in sorted({block.fixture for block in camera_blocks(rows)}):
        values = {name: found[of_fixture(f"camera_{name}", fixture)] for name in ("fx", "fy", "cx", "cy")}
        cameras.append((_subtable(fixture), "\n".join(f"{name}_px = {value:.1f}" for name, value in values.items())))
    return cameras


def _base(arm: Described, rows: Dataset, tools: Mapping[str, Array], words: Words) -> tuple[Array | None, str]:
    """Return the base to state, None for registration, and why."""
    rows = posed(rows, starting_cameras(rows, {}))
    if not any(block.measurement.registers for block in rows.blocks):
        return arm.base, "The base is as the robot's file has it: these measurements do not depend on it."
    found, _, verdict = locate(arm.robot, rows, tools)
    if same_place(found, arm.base):
        offset = 1e3 * np.linalg.norm(found[:3] - arm.base[:3])
        how = f"Guessed: the data put the base {offset:.1f} mm from the robot's own, so they are in its frame."
        return arm.base, how
    how = f"Guessed: the data put the base at {placed(found)}, {words.frame} ({verdict})."
    return None, how


def _patterns(names: Sequence[str], dof: int) -> list[str]:
    """Return names with those of all joints, or of a whole frame, as patterns."""
    left = list(names)
    patterns = []
    for pattern, members in _groups(names, dof).items():
        if set(members) <= set(left):
            left = [name for name in left if name not in members]
            patterns.append(pattern)
    return [*patterns, *left]


def _groups(names: Sequence[str], dof: int) -> dict[str, list[str]]:
    """Return what patterns stand for: one column of all joints, a whole frame, a frame's place."""
    groups: dict[str, list[str]] = {}
    if dof < 10:  # a question mark stands for one digit
        groups = {f"{column}?": [f"{column}{i}" for i in range(1, dof + 1)] for column in MDH}
    for prefix in dict.fromkeys(name[: name.rindex("_") + 1] for name in names if "_" in name):
        groups[f"{prefix}*"] = [prefix + c for c in FRAME]
        groups[f"{prefix}[xyz]"] = [prefix + c for c in FRAME[:3]]
    groups["camera_*"] = [f"camera_{name}" for name in INTRINSICS]
    return groups


def _frame(place: Array) -> str:
    lines = []
    for name, value in zip(FRAME, place, strict=True):
        unit, (number,) = exact(FRAME_DIMENSION[name], [value])
        lines.append(f"{name}_{unit} = {number + 0.0!r}")
    return "\n".join(lines)


def _key(text: str) -> str:
    """Return a TOML key."""
    return text if re.fullmatch(r"[\w-]+", text, re.ASCII) else toml(text)


def _subtable(name: str) -> str:
    return f".{_key(name)}" if name else ""
