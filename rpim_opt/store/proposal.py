"""What ``identify = "auto"`` means: the parameters that these measurements of this robot can identify."""

from __future__ import annotations

import re

from rpim_opt.data.dataset import Dataset
from rpim_opt.data.models import CAMERAS
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import Parameters

_GEOMETRY = re.compile(r"(alpha|a|d|theta)\d+")
_BASE = re.compile(r"base_.*")
_PLACES = re.compile(r"(tool|anchor|length|plane|sphere|camera)_.*")
_POINTS = re.compile(r"(anchor|length|plane|sphere)_.*|tool_(.*_)?[xyz]")


def proposed(robot: Robot, parameters: Parameters, data: Dataset) -> list[str]:
    """Return the names of the geometry, of Hayati's beta where it is needed, and of what places things."""
    kinds = {block.measurement.name for block in data.blocks}
    identified = [_GEOMETRY]
    turning = {"pose", *CAMERAS}
    if kinds & {"position", *turning}:  # distances do not tell where the robot stands
        identified.append(_BASE)
    identified.append(_PLACES if kinds & turning else _POINTS)  # nothing else sees how a reflector is turned
    from rpim_opt.problem.observability import near_parallel

    geometry, *places = ([name for name in parameters.names if kind.fullmatch(name)] for kind in identified)
    return [*geometry, *near_parallel(robot), *(name for names in places for name in names)]
