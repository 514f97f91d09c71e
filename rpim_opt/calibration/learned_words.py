"""What was learned from the data, in words."""

from __future__ import annotations

import numpy as np

from rpim_opt.basics.text import joined
from rpim_opt.bayes.hyperparameters import Learned, Size
from rpim_opt.bayes.prior import BASE, SESSIONS
from rpim_opt.robot.family import EXPECTED
from rpim_opt.robot.overlay import is_joint_offset
from rpim_opt.robot.parameter_names import EXPANSION, of_session, own_name

UNITS = {"position": ("mm", 1e3), "orientation": ("mrad", 1e3), "joint": ("mrad", 1e3), "instrument": ("times", 1.0)}
SIZED = {"length": ("mm", 1e-3), "angle": ("mrad", 1e-3)}
"""Unit in which what sessions differ by is said, and its size in SI."""
WORDS = {
    "position": "{} in position",
    "orientation": "{} in orientation",
    "joint": "{} at the joints",
    "instrument": "the instrument {} its declared noise",
}
FAMILIES = {
    "compliance": "gravity bends joints by {}",
    "ecc": "their first harmonics are {}",
    "ecc2": "their second harmonics are {}",
    "bend": "first moments of links bend them by {}",
}
"""What is said of sizes of families, whose unit is a deflection of `EXPECTED` where it is largest."""
MOVED = 10.0
"""Scales of its group beyond which a parameter is said to have left it: 2 in 1000 do under Student's t_3."""
MOST = 5
"""Parameters and rows that are named one by one."""
VAGUE = 0.5
"""Standard deviation of a logarithm from which on only the upper end of a size is said."""
NEGLIGIBLE = 0.1
"""Parts of the scatter below this share of the largest are not worth a word."""


def sentences(learned: Learned, names: tuple[str, ...], z: np.ndarray) -> list[str]:
    """Return what was learned; parameters' names (n,), and deviations z (n,) in units of the local scales."""
    lines = [_sizes(learned), _noise(learned), _sessions(learned, names), _growth(learned, names, z)]
    lines += [_model(learned)] if learned.trials else []
    lines += _unusual(learned, names, z)
    lines += _left_out(learned)
    return [line for line in [*lines, *learned.notes] if line]


def _range(size: Size, factor: float = 1.0) -> str:
    spread = np.exp(min(size.spread, 7.0))
    low = factor * size.value / spread
    high = factor * size.value * spread
    return f"{low:.2g} to {high:.2g}"


def _figure(size: Size, unit: str, factor: float) -> str:
    """Say a size in a unit with its range, or only the upper end where little is known of it."""
    if size.spread > VAGUE:
        return f"at most {factor * size.value * np.exp(size.spread):.2g} {unit}"
    return f"{factor * size.value:.2g} {unit} ({_range(size, factor)})"


def _sizes(learned: Learned) -> str:
    said = []
    much = "{} deviate {} times as much as expected ({})"
    for name, size in learned.sizes.items():
        if name in (*SESSIONS.values(), BASE, EXPANSION):
            continue
        if name in FAMILIES:
            figure = f"{1e3 * EXPECTED * size.value:.2g} mrad ({_range(size, 1e3 * EXPECTED)})"
            said.append(FAMILIES[name].format(figure))
        else:
            said.append(much.format(name, f"{size.value:.2g}", _range(size)))
            much = "{} {} times ({})"
    if not said:
        return ""
    return f"Learned from the data: {joined(said)}."


def _noise(learned: Learned) -> str:
    largest = max((size.value for kind, size in learned.noise.items() if kind != "instrument"), default=0.0)
    said = []
    for kind, size in learned.noise.items():
        figure = _figure(size, *UNITS[kind])
        if kind == "instrument" or size.value > NEGLIGIBLE * largest:
            said.append(WORDS[kind].format(figure))
    if not said:
        return ""
    return f"Beside the instrument's noise the robot scatters by {joined(said)}."


def _sessions(learned: Learned, names: tuple[str, ...]) -> str:
    """Say by how much sessions differ, a coordinate and an axis."""
    said = []
    for dimension, group in SESSIONS.items():
        if group not in learned.sizes:
            continue
        turn = {"length": False, "angle": True}[dimension]
        scale = next(
            s for name, s in zip(names, learned.stated, strict=True)
            if of_session(name) and own_name(name).rpartition("_")[2].startswith("r") == turn
        )  # fmt: skip
        unit, si = SIZED[dimension]
        said.append(_figure(learned.sizes[group], unit, scale / si))
    if not said:
        return ""
    return f"Sessions differ by {joined(said)}."


def _growth(learned: Learned, names: tuple[str, ...], z: np.ndarray) -> str:
    """Say by how much lengths grow."""
    said = []
    for name, stated, value in zip(names, learned.stated, z, strict=True):
        if own_name(name) == EXPANSION and EXPANSION in learned.sizes:
            said.append(f"{1e6 * stated * learned.sizes[EXPANSION].value * value:.3g} um a metre and kelvin")
    if not said:
        return ""
    return f"Lengths grow by {joined(said)}."


def _model(learned: Learned) -> str:
    gains = {family: learned.gain(family) for trial in learned.trials for family in trial.families}
    worth = [f"{family} {gain:.0f}" for family, gain in gains.items() if gain is not None and gain >= 0.5]
    evidence = ""
    if worth:
        evidence = f" (-2 ln L falls by {joined(worth)})"
    if not learned.families:
        return f"Model: geometry alone; no family is worth its parameters{evidence}."
    return f"Model: geometry with {joined(learned.families)}{evidence}."


def _unusual(learned: Learned, names: tuple[str, ...], z: np.ndarray) -> list[str]:
    lines = []
    for name, ratio in learned.unusual(names, z, MOVED)[:MOST]:
        cause = "one that its group does not explain"
        if is_joint_offset(name):
            cause = "an error of assembly or of its zero"
        lines.append(f"{name} moved by {ratio:.0f} times what its group does: {cause}.")
    return lines


def _left_out(learned: Learned) -> list[str]:
    if not learned.left_out:
        return []
    named = [f"{row.label} ({row.ratio:.0f} times the median error)" for row in learned.left_out[:MOST]]
    more = len(learned.left_out) - MOST
    text = f"Left out as blunders: {', '.join(named)}"
    if more > 0:
        text += f" and {more} more"
    return [f"{text}."]
