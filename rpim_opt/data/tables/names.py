"""Common column names with their unambiguous meaning and reason, and numbered orientation components.

SpatialAnalyzer ``Point Name, X [mm], U(95) X [mm]``; Leica ``Point ID;Std X [mm]``; ROS ``field.name0, field.position0,
field.pose.orientation.w, /joint_states/elbow_joint/position``; Universal Robots' RTDE ``actual_q_0, target_q_0``; KUKA
``A1, X, Y, Z, A, B, C``; FANUC ``J1, X, Y, Z, W, P, R``; ABB ``rax_1, x, y, z, q1, q2, q3, q4``; RoboDK ``J1, X``.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Sequence
from itertools import islice, product
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns, numbers


class Meaning(NamedTuple):
    """Meaning of a column: its quantity, unit and reason, and whether it is measured, commanded or derived."""

    stem: str
    unit: str = ""
    why: str = ""
    kind: str = ""


Meanings = dict[str, Meaning]  # what every column holds, by its name


_WHERE = (
    r"(?:(?:field|pose|transform|point|position|translation|pos|p|t|tvec|coords?|coordinates?|cartesian|cart|tcp)_?)*"
)
_JOINT = "q|j|jt|joint|axis|ax|a|theta|θ|rax|achse|gelenk|axe|eje|giunto|关节|轴|軸"
_SPREAD = r"(?:std|stdev|stddev|std_?dev|sigma|sd)"
NAMES: tuple[tuple[str, ...], ...] = (
    (rf"(to_)?(?:{_JOINT})_?(\d+)(?:_?(?:pos|position|angle|value))?", r"\1q\2"),
    (r"(?:joints?|axes|axis|achsen|gelenke)(?:_(?:angles?|positions?|values?|pos))?_(?:q|j|a|joint|axis)?_?(\d+)",
         r"q\1"),
    (r"(?:field_)?position_?(\d+)", r"q\1", "ROS: JointState.position"),
    (r"第?(\d+)_?(?:軸|轴|축)", r"q\1"),
    (r"(to_)?(?:field_)?(?:tau|torque|effort)_?(\d+)", r"\1tau\2"),
    (rf"{_WHERE}([xyz])(?:_?1|坐标|座標|_?(?:wert|value|coord(?:inate)?|koordinate|achse))?", r"\1"),
    (rf"(?:{_JOINT})_([slurbt])", r"\1"),
    (r"az(?:imuth|imut)?", "azimuth", "azimuth, counterclockwise from x about z"),
    (r"hz|horizontal_?(?:angle|winkel)|hz_?(?:angle|winkel)", "hz", "horizontal angle, clockwise from x"),
    (r"el(?:ev(?:ation)?)?(?:_angle)?", "elevation", "elevation above the horizontal plane"),
    (r"v|zenith(?:_?(?:angle|distance))?|v_?(?:angle|winkel)|vertical_?(?:angle|winkel)|za", "zenith",
         "angle from the vertical axis"),
    (r"(?:(?:field|pose|transform)_)*(?:q|quat|quaternion|orientation|rotation|rot)_?([wxyz])", r"q\1"),
    (r"roll", "rx"),
    (r"pitch", "ry"),
    (r"yaw", "rz"),
    (r"u_?95_?([xyz])|([xyz])_u_?95", r"u95_\1\2", "expanded uncertainty, coverage factor 2"),
    (r"(?:unsicherheit_|uncertainty_)?u_?(?:95(?:_total|_mag|_magnitude)?|k_?=?_?2)", "u95",
         "expanded uncertainty, coverage factor 2"),
    (rf"{_SPREAD}_?([xyz])|([xyz])_{_SPREAD}", r"sigma_\1\2", "standard deviation"),
    (r"(?:slope_?|slant_?)?(?:distance|dist|range)|sd|(?:cable|wire|rope)(?:_length)?", "distance"),
    (r"label|name|id|no|nr|number|index|row|point(?:_(?:id|name|no|nr))?|target(?:_(?:id|name))?|messpunkt|feature"
         r"|punkt(?:_?(?:name|nr))?|pos(?:e|ition)?_?name|nom_du_point|punto|pt|点名|点号|測定点|測点"
         r"|(?:collection_)?group|gruppe", "label"),
    (r"configuration|config|pose|pose_id", "configuration"),
    (r"marker|(?:reflector|reflektor|smr|prism)(?:_(?:id|name|no|nr))?", "marker"),
    (r"anchor(?:_(?:id|name|no|nr))?", "fixture"),
    (r"temp(?:erature|eratur)?", "temperature"),
    (r"session(?:_?(?:id|name|no|nr))?|measurement_session|campaign|messreihe|sitzung", "session"),
    (r"(?:station|set_?up|aufstellung|standpunkt)(?:_?(?:id|name|no|nr|nummer))?", "station"),
)  # fmt: skip
"""Other column names, in lower case with underscores: their meaning, and the reason unless it is usual."""
IN_SI = {
    r"%?field\..*|/.*|(?:pose|transform)\.\w+\.\w|position\[\d\]": "ROS: SI units (REP 103)",
    r"rvec_[xyz]": "OpenCV: radians",
    r"(?:actual|target)_(?:q|TCP_pose)_\d": "Universal Robots' RTDE: SI units",
}
"""Patterns of names with units rad and m, and their origin."""
KINDS = {
    "derived": frozenset({"deviation", "dev", "delta", "diff", "difference", "error", "err", "residual", "velocity",
                          "vel", "speed", "acceleration"}),
    "wanted": frozenset({"nominal", "nom", "target", "soll", "sollwert", "theoretical", "programmed", "commanded",
                         "command", "cmd", "desired", "setpoint", "reference", "ref", "théorique", "nominale",
                         "teorico", "理论"}),
    "measured": frozenset({"measured", "meas", "measurement", "actual", "act", "ist", "tracker", "leica", "observed",
                          "istwert", "messwert", "gemessen", "mesuré", "mesurée", "misurato", "misurata", "medido",
                          "medida", "gemeten", "实测"}),
}  # fmt: skip
"""Words in a name for values that are measured, commanded or computed from others."""
TURNS = (
    (("a", "b", "c"), ("rz", "ry", "rx"), "KUKA: A, B, C turn about z, y, x", ""),
    (("w", "p", "r"), ("rx", "ry", "rz"), "FANUC: W, P, R turn about x, y, z", ""),
    (("o", "a", "t"), ("rx", "ry", "rz"), "Kawasaki: O, A, T", "intrinsic zyz"),
    (("rvec_x", "rvec_y", "rvec_z"), ("rx", "ry", "rz"), "OpenCV: a rotation vector", "vector"),
)
"""Three names that are angles if all are present, and the rotation unless it is roll, pitch, yaw."""
TCP = (("x", "y", "z", "rx", "ry", "rz"), "Universal Robots' RTDE: position and rotation vector", "vector")
TCP_POSES = tuple((tuple(f"{which}_tcp_pose_{i}" for i in range(6)), *TCP) for which in ("target", "actual"))
"""The same for poses computed by a controller: targets, no measurements."""
JOINTS = (
    (("s", "l", "u", "r", "b", "t"), "Yaskawa: S, L, U, R, B, T"),
    (("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3"), "Universal Robots: Base, Shoulder, ..., Wrist 3"),
)
"""Joints from the base, if all are present."""
UR_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
UR_NUMBERS = {f"{name}{end}": i for i, name in enumerate(UR_JOINTS, start=1) for end in ("", "_joint")}
"""Universal Robots' joints, from the base; ROS lists them alphabetically."""
EXTERNAL = re.compile(r"e_?1|ext(?:ernal)?_?(?:axis_?)?1?", re.IGNORECASE)
"""KUKA's external axis, beside which the arm's own joints are counted from 1."""
MOST_PREFIXES = 6  # words before a known name
VALUE = frozenset({"position", "pos", "angle", "value"})
"""Word that may follow the name of a joint."""


def recognize(stem: str, joints: Sequence[str] = ()) -> Meaning:
    """Return the meaning of a column name with its reason, which is empty for unknown names.

    >>> from rpim_opt.data.tables.names import recognize
    >>> [recognize(name).stem for name in ("Measured X", "Joint 3", "quat_w", "Std y", "shoulder_pan_joint")]
    ['x', 'q3', 'qw', 'sigma_y', 'q1']
    """
    path = [part for part in re.split(r"[/.]", stem.strip().strip("%")) if part]
    plain = unicodedata.normalize("NFKC", re.sub(r"\(95\s*%?\)", "95", stem.strip().lower()))
    plain = re.sub(r"[\s.,\-/:\[\]()$]+|(?<=[\u4e00-\u9fff])(?=[xyz]$)", "_", plain).strip("_% ")
    words = plain.split("_")
    kind = next((name for name, signs in KINDS.items() if len(words) > 1 and signs & set(words)), "")
    rest = "_".join([word for word in words if not any(word in signs for signs in KINDS.values())] or words)
    named = path[: max(len(path) - 1, 1)] if len(path) < 2 or path[-1] in VALUE | {"effort"} else []
    for part in named:
        number, why = UR_NUMBERS.get(part, 0), "a joint of Universal Robots"
        if part in joints:
            number, why = joints.index(part) + 1, "a joint of the robot file"
        if number:
            return Meaning(f"tau{number}" if path[-1] == "effort" else f"q{number}", "", why, kind)
    for pattern, meaning, *reason in NAMES:
        match = re.fullmatch(pattern, rest)
        if match:
            known = re.sub(r"(?<=[qu])0+(?=\d)", "", match.expand(meaning))
            return Meaning(known, "", "".join(reason) or "a known name", kind)
    # u(x) is a standard uncertainty, U(x) an expanded one of unknown coverage factor
    match = re.fullmatch(r"u[\s_(]*([xyzXYZ])\)?", stem.strip())
    if match:
        return Meaning(f"sigma_{match[1].lower()}", "", "u: standard uncertainty", kind)
    return Meaning(plain, "", "", kind)


def endings(stem: str) -> Iterator[tuple[str, str]]:
    """Yield the possible prefixes of a name, and the rest: ``robot1_joint_2`` is ``joint_2`` of ``robot1``."""
    for match in islice(re.finditer(r"[\s._/:\-]+", stem), MOST_PREFIXES):
        yield stem[: match.end()], stem[match.end() :]


ORDERS, NUMBERED = ("wxyz", "xyzw"), "numbered "
"""Orders of quaternions, and the prefix of an order found by a check: it holds for numbered columns only."""
QUATERNION = re.compile(r"(q|quat|quaternion|orientation|orient|rot|rotation)[_ ]?\[?([0-4])\]?")
ENTRY = re.compile(r"(?:m|t|h|r(?=\D*\d\D*\d)|mat|matrix|tf|pose)[_ \[(]*(\d)[_ ,\]\[]*(\d?)[\])]?")
SHAPES = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
"""Rows and columns of a matrix, by its number of entries."""
EULER = re.compile(r"(?:extrinsic|intrinsic) ([xyz])(?!\1)([xyz])(?!\2)[xyz]")
"""Three rotations about fixed axes (extrinsic), or about axes that rotate with the body (intrinsic)."""
ROUNDED = 1e-6  # the last row of a matrix is 0 0 0 1 within this


def numbered(read: Meanings, table: Columns, dof: int, order: str) -> None:
    """Name the numbered columns of quaternions and matrices; with a stated order, also other quaternion columns."""
    order, of_all = order.removeprefix(NUMBERED), order in ORDERS
    if order not in ("", *ORDERS):
        raise InputError("--quaternion", f"'{order}'", " or ".join(ORDERS))
    columns = quaternion_columns(read, dof)
    if of_all and not columns:
        columns = [name for name, each in read.items() if each.stem in ("qw", "qx", "qy", "qz")]
    order = order or ORDERS[0]
    for i, (name, letter) in enumerate(zip(columns, order, strict=False), start=1):
        read[name] = read[name]._replace(stem=f"q{letter}", why=f"component {i} of a quaternion, order {order}")
    stems = {reading.stem for reading in read.values()}
    if {"qx", "qy", "qz"} <= stems and "qw" not in stems:
        zeroth = [name for name in read if re.fullmatch(r"q_?0", name.strip().lower())]
        read.update({name: read[name]._replace(stem="qw", why="beside qx, qy, qz") for name in zeroth})
    places = _entries(read)
    why = "a matrix, row by row"
    if len(places) == 16:
        matrices = np.empty((len(next(iter(table.values()))), 4, 4))
        for name, (i, j) in places.items():
            matrices[:, i, j] = numbers(table[name], name)
        row, column = (np.abs(part - [0, 0, 0, 1]).max() < ROUNDED for part in (matrices[:, 3], matrices[:, :, 3]))
        if not row and not column:
            raise InputError("the matrices", "neither a last row nor a last column 0 0 0 1", "4 x 4 transforms")
        why = "a matrix, row by row: its last row is 0 0 0 1"
        if not row:
            places = {name: (j, i) for name, (i, j) in places.items()}
            why = "a matrix, column by column: its last column is 0 0 0 1"
    for name, (i, j) in places.items():
        stem = "the last row of a matrix" if i == 3 else f"r{i + 1}{j + 1}"
        if j == 3 and i < 3:
            stem = "xyz"[i]
        read[name] = read[name]._replace(stem=stem, why=why)


def _entries(read: Meanings) -> dict[str, tuple[int, int]]:
    """Return the columns of a matrix with their row and column from 0; empty if there is none."""
    digits: dict[str, str] = {}
    for name in read:
        match = ENTRY.fullmatch(re.sub(r"[_ ](mm|m)$", "", name.partition("[mm]")[0].strip().lower()))
        if match:
            digits[name] = match[1] + match[2]
    pairs = {name: (int(two[0]), int(two[1])) for name, two in digits.items() if len(two) == 2}
    first = min((i for i, _ in pairs.values()), default=0)
    places = {name: (i - first, j - first) for name, (i, j) in pairs.items()}
    if len(pairs) in SHAPES and set(places.values()) == set(product(*map(range, SHAPES[len(pairs)]))):
        return places
    ordered = sorted(digits, key=lambda name: int(digits[name]))
    if len(ordered) not in (12, 16) or int(digits[ordered[-1]]) - int(digits[ordered[0]]) != len(ordered) - 1:
        return {}
    return {name: divmod(k, 4) for k, name in enumerate(ordered)}


def quaternion_columns(read: Meanings, dof: int) -> list[str]:
    """Return the four numbered columns of a quaternion, in order; ``q0 ... q3`` where these cannot be joints."""
    components: dict[str, dict[int, str]] = {}
    for name in read:
        match = QUATERNION.fullmatch(name.strip().lower())
        if match:
            components.setdefault(match[1], {})[int(match[2])] = name
    for prefix, columns in components.items():
        if sorted(columns) in ([0, 1, 2, 3], [1, 2, 3, 4]):
            others = {each.stem for name, each in read.items() if name not in columns.values()}
            own = dof - any(map(EXTERNAL.fullmatch, others))
            counted = any(all(f"q{i + first}" in others for i in range(own)) for first in (0, 1))
            joints = dof == len(columns) or any(re.fullmatch(r"q\d+", stem) for stem in others)
            if prefix != "q" or counted or ({"x", "y", "z"} <= others and not joints):  # these are in another file
                return [columns[i] for i in sorted(columns)]
    return []
