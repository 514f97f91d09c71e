"""What a calibration identified, in other tools' files: all that were asked for or none, and what stays behind."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rpim_opt.calibration import Calibration
from rpim_opt.exceptions import InputError, RpimError
from rpim_opt.exchange.chain import Described, identified, placed, same_place
from rpim_opt.exchange.universal_robots import write_ur_calibration
from rpim_opt.exchange.urdf import read_urdf, write_urdf
from rpim_opt.files import write_bytes


def export_urdf(
    result: Calibration,
    source: str | Path,
    target: str | Path,
    root: str | None = None,
    tip: str | None = None,
    base: bool | None = None,
    tool: bool | None = None,
    marker: str | None = None,
) -> list[str]:
    """Write a URDF with the identified robot's origins, and base and tool where they are the file's.

    An identified base or reflector that lies where the file has its root or tip (`chain.same_place`) is the same
    frame, known better, and is written. Elsewhere it is the instrument's or the reflector's own, and the file's frame
    stays as it is.

    Parameters
    ----------
    result
        The calibration.
    source, target
        The original, and where to write.
    root, tip
        Names of the links between which the robot is, as for `read_urdf`.
    base, tool
        Whether to write the base and the tool, instead of that rule.
    marker
        The reflector that is the tip. Of several none is, unless it is named.

    Returns
    -------
    A sentence for each of the two frames that was identified.
    """
    found, several = found_by(result, marker)
    drawn = read_urdf(source, root, tip)
    tool = False if several and marker is None and tool is None else tool
    frames, notes = [], []
    for name, what, asked, place, own in (
        ("base", "root", base, found.base, drawn.base),
        ("tool", "tip", tool, found.tool, drawn.tool),
    ):
        free = [n for n in result.problem.parameters.free.names if n.startswith(f"{name}_")]
        written = bool(free) and same_place(place, own) if asked is None else asked
        frames.append(place if written else None)
        if written:
            notes.append(f"URDF: its {what} is at the identified {name}, {placed(place)}.")
        elif free:
            where = f"the identified {name} is not there, but at {placed(place)}"
            notes.append(f"URDF: its {what} stays where it was; {where}.")
    write_urdf(source, found.robot, target, root, tip, *frames)
    return notes


def export_ur_calibration(result: Calibration, source: str | Path, target: str | Path) -> list[str]:
    """Write a ``calibration.conf``; what alpha1 and a1 say is where the controller's Base is, and is left out."""
    found, nominal = found_by(result)[0].robot, result.problem.robot
    if np.abs(nominal.mdh[0, :2]).max() > 0:
        raise InputError("robot", "alpha1 or a1 that are not zero", "a ready robot of Universal Robots")
    mdh = found.mdh.copy()
    mdh[0, :2] = 0.0
    write_ur_calibration(source, replace(found, mdh=mdh), nominal, target)
    moved = np.array_equal(mdh, found.mdh)
    return [] if moved else ["alpha1 and a1 place axis 1 and are no part of calibration.conf: its Base is on axis 1."]


def found_by(result: Calibration, marker: str | None = None) -> tuple[Described, bool]:
    """Return what was identified with a reflector, by default the first; and whether there are several."""
    names = result.problem.parameters.names
    markers = [n.removesuffix("_x").removeprefix("tool").lstrip("_") for n in names
               if n.startswith("tool_") and n.endswith("_x")]  # fmt: skip
    return identified(result, markers[0] if marker is None else marker), len(markers) > 1


def write_all(writers: Mapping[Path, Callable[[Path], Sequence[str] | None]]) -> list[str]:
    """Write several files, or none of them if one cannot be written; return what their writers say.

    Parameters
    ----------
    writers
        By target: a function that writes to the path it is given.
    """
    notes: list[str] = []
    with TemporaryDirectory() as folder:
        for number, (target, write) in enumerate(writers.items()):
            made = Path(folder) / str(number) / target.name
            made.parent.mkdir()
            try:
                notes += write(made) or ()
            except InputError as error:
                raise (
                    InputError(error.where, error.found, error.accepted, target) if error.file == made else error
                ) from None
        for number, target in enumerate(writers):
            try:
                write_bytes(target, (Path(folder) / str(number) / target.name).read_bytes())
            except OSError as error:
                raise RpimError(f"{target}: cannot be written: {error}.") from None
    return notes
