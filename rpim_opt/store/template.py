"""The text of a new ``problem.toml``: every key with what it means and where it comes from."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.camera import INTRINSICS
from rpim_opt.data.measurements.measurement import Measurement, of_fixture
from rpim_opt.problem.observability import identifiable
from rpim_opt.problem.registration.camera import camera_blocks, posed
from rpim_opt.problem.registration.frames import locate, starting_cameras, starting_parameters
from rpim_opt.robot.chain import Described, placed, same_place
from rpim_opt.robot.kinematics import FRAME, FRAME_DIMENSION
from rpim_opt.robot.mdh import MDH
from rpim_opt.robot.plain import exact, toml

TEMPLATE = """\
# Made by rpim-opt new; look at it, then: rpim-opt inspect, rpim-opt calibrate.
# Names carry units: _mm, _m, _deg, _mrad, _rad. What was guessed says so.

title = {title}
source = ""                     # who measured what, when and with what: result and report repeat it

robot = {robot}
# {drawing}
measurement = {measurement}
# {columns}
identification = "identification.csv"
# {count} rows, from {data}
{validation}
{target}
# What may deviate from the drawing, by name or pattern: alpha, a, theta, d of every joint, Hayati's beta where axes
# are near parallel, base_x ... base_rz, tool_x ... tool_rz. This is what "auto" means for these data.{conditions}
identify = {identify}

formulation = "tikhonov"        # "robust" where rows may be wrong; "bounded" keeps to [tolerance]
model = "auto"                  # adds what geometry lacks (gravity, gears) where the data want it; or "geometry"
# selector = "learned"          # sizes of deviations and noise; or one weight over [scale]: reml, l_curve, ...
{auto}
# Standard deviation of a measured value, for rows that state none (column {sigma}). Guessed: {noise_of}.
# The level itself is found from the data; what counts is how kinds and rows compare.
[noise]
{noise}

# Expected size of deviations (prior standard deviation). Guessed: a machined arm, {thing} measured roughly.
# Single parameters by name: d5_mm, theta3_mrad; joint_offset_mrad for every theta, which is otherwise expected to be
# three times as large, because joint offsets are set at assembly.
[scale]
length_mm = 1.0                 # a, d
angle_mrad = 1.0                # alpha, theta, beta
tool_mm = 10.0
tool_mrad = 10.0
base_mm = {scale}
base_mrad = {scale}

# Largest deviation, for the formulation "bounded" alone.
[tolerance]
length_mm = 5.0
angle_mrad = 10.0
{base}
# {thing_at} in the flange frame: {known}.
{tools}
{camera}{known_of}
# How far the robot may miss where, for a verdict in result and report; who measured, when, with what:
# [acceptance]
# limit_mm = 0.1                # and a box x_mm = [300, 800], y_mm, z_mm of the base frame; else all that was measured
# [record]
# by = ""                       # when, where, instrument, instrument_serial, robot_serial, temperature, notes, ...

# Rows to leave out, label = reason:
# [exclude]
# {label} = "{wrong}"
"""

KNOWN_OF = """
# What a drawing or a certificate knows of what was touched: without a distance, contact does not tell how large the
# robot is. Of planes also [[known_angle]] with deg = 0 (parallel) or 90 (square) and sigma_mrad.
# [[known_distance]]
# between = BETWEEN
# distance_mm = 300.0
# sigma_mm = 0.01
"""
"""What the text says where points were touched."""
SESSIONS = """
# session_* (how the registration differs from session to session) comes with model = "auto" where the data want it."""
"""What it says where rows name their session."""
WARMTH = """
# expansion (all lengths grow with temperature, counted from its mean or from a key temperature_C = 20.0) likewise."""
"""What it says where rows state a temperature."""
TARGET_TEXT = """
# Where the points that the camera sees are on their board: x along its rows, y along its columns. No view tells whether
# it is as large as stated; where it was printed, identify board_stretch_x and board_stretch_y, too.
{target}
"""
"""What it says of a board."""


class Words(NamedTuple):
    """How a kind of measurement is spoken of."""

    thing: str = "a reflector"
    thing_at: str = "The reflector"
    frame: str = "so the instrument has a frame of its own"
    noise_of: str = "a laser tracker, and a robot that repeats well"
    wrong: str = "the reflector was bumped"


CAMERA = Words(
    frame="in the frame of the board", noise_of="corners found to a fifth of a pixel", wrong="a wrong corner"
)
WORDS = {
    "eye_in_hand": CAMERA._replace(thing="a camera", thing_at="The camera (z forwards, x right, y down in the image)"),
    "eye_to_hand": CAMERA._replace(thing="a board", thing_at="The board", frame="in the frame of the camera"),
    "revisit": Words(
        thing="a tip",
        thing_at="The tip that touches, a ball's middle,",
        noise_of="a good robot, a tight fit",
        wrong="the tip slipped",
    ),
}
"""Of what is on the flange, where it is no reflector."""


def problem_text(
    arm: Described, kind: Measurement, rows: Dataset, noise: Mapping[str, float], said: Mapping[str, str]
) -> tuple[str, list[str]]:
    """Return the text of ``problem.toml``, and what was guessed in sentences."""
    markers = sorted({marker for block in rows.blocks for marker in block.markers})
    tools = dict.fromkeys(markers, arm.tool)
    words = WORDS.get(kind.name, Words())
    base, how = _base(arm, rows, tools, words)
    parameters = starting_parameters(arm.robot, rows, base, tools)
    seen = camera_blocks(rows)
    text = TEMPLATE.format(
        **{**said, "target": TARGET_TEXT.format(target=said["target"]) if seen else ""},
        title=toml(arm.robot.name),
        measurement=toml(kind.name),
        identify=toml(_patterns(identifiable(arm.robot, parameters, rows), arm.robot.dof)),
        auto=f'base = "auto"\n# {how}\n' if base is None else "",
        noise="\n".join(f"{key} = {value}" for key, value in noise.items()),
        scale="100.0" if base is None else "1.0",
        base=_base_table(base, how),
        known="where the file has its tip" if arm.tool.any() else "not known, and identified from the flange's origin",
        tools="\n".join(_tool_tables(markers, arm.tool)),
        label=_key(rows.label[0]),
        conditions=SESSIONS * bool(rows.sessions) + WARMTH * bool(len(rows.temperatures)),
        known_of=KNOWN_OF.replace("BETWEEN", _two_things(rows)) * kind.touching,
        camera=_camera_tables(rows) if seen else "",
        sigma=f"sigma_{next(iter(noise)).rpartition('_')[2]}",
        thing=words.thing,
        thing_at=words.thing_at,
        noise_of=words.noise_of,
        wrong=words.wrong,
    )
    return text, [how]


def _two_things(rows: Dataset) -> str:
    """Return the first two points or planes that rows touched, as a list."""
    names = [str(name) for block in rows.blocks if block.touched is not None for name in block.touched[:, 0]]
    return toml(list(dict.fromkeys(names))[:2])


def _base_table(base: Array | None, how: str) -> str:
    if base is None:
        return ""
    about = "# The robot's base in the instrument's frame; rx, ry, rz are roll, pitch, yaw (R = Rz Ry Rx)."
    return "\n".join(["", about, f"# {how}", "[base]", *_frame(base), ""])


def _camera_tables(rows: Dataset) -> str:
    """Return the tables that state the cameras, with what their views show."""
    found = starting_cameras(rows, {})
    lines = [
        "# The camera: focal lengths and centre as the views show them, distortion k1 k2 p1 p2 k3 as OpenCV has it.",
        "# Where they are known, state them and leave camera_* out of identify.",
    ]
    for fixture in sorted({block.fixture for block in camera_blocks(rows)}):
        lines.append(f"[camera.{_key(fixture)}]" if fixture else "[camera]")
        values = [(name, found[of_fixture(f"camera_{name}", fixture)]) for name in ("fx", "fy", "cx", "cy")]
        lines += [f"{name}_px = {value:.1f}" for name, value in values]
    return "\n".join(["", *lines, ""])


def _tool_tables(markers: Sequence[str], place: Array) -> list[str]:
    lines = []
    for marker in markers:
        lines.append(f"[tool.{_key(marker)}]" if marker else "[tool]")
        lines += _frame(place)
    return lines


def _base(arm: Described, rows: Dataset, tools: Mapping[str, Array], words: Words) -> tuple[Array | None, str]:
    """Return the base to state, None for registration, and why."""
    rows = posed(rows, starting_cameras(rows, {}))
    if not {block.measurement.name for block in rows.blocks} & {"position", "pose"}:
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


def _frame(place: Array) -> list[str]:
    lines = []
    for name, value in zip(FRAME, place, strict=True):
        unit, (number,) = exact(FRAME_DIMENSION[name], [value])
        lines.append(f"{name}_{unit} = {number + 0.0!r}")
    return lines


def _key(text: str) -> str:
    """Return a TOML key."""
    return text if re.fullmatch(r"[\w-]+", text, re.ASCII) else toml(text)
