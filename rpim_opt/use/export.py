"""What a calibration identified, in other tools' files: all that were asked for or none, and what stays behind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.writing import refused, write_files
from rpim_opt.calibration.result import Calibration
from rpim_opt.robot.chain import Described, placed, same_place
from rpim_opt.robot.parameter_names import reflectors
from rpim_opt.robot.ur_calibration import write_ur_calibration
from rpim_opt.robot.urdf import read_urdf, write_urdf
from rpim_opt.use.identified import identified


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

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> arm = ro.read_urdf("arm.urdf")
    >>> parameters = ro.robot.model_parameters(arm.robot, arm.base, {"": arm.tool}).identify(["d1"])
    >>> data = ro.Dataset.of(np.zeros((1, 1)), np.zeros((1, 3)), 1e-4)
    >>> empty = ro.CalibrationProblem(arm.robot, parameters, data)
    >>> longer = empty.on(ro.Dataset.of(data.q, empty.modelled(np.array([0.001]))[0], 1e-4))
    >>> ro.use.export_urdf(ro.calibrate(longer, weight=0.0), "arm.urdf", "identified.urdf")
    []
    >>> (ro.read_urdf("identified.urdf").robot.mdh - arm.robot.mdh)[0, 3].round(6)  # [m]
    np.float64(0.001)
    """
    found, several = found_by(result, marker)
    drawn = read_urdf(source, root, tip)
    if several and marker is None and tool is None:
        tool = False
    base_place, said_of_base = _frame(result, "base", "root", base, found.base, drawn.base)
    tool_place, said_of_tool = _frame(result, "tool", "tip", tool, found.tool, drawn.tool)
    write_urdf(source, found.robot, target, root, tip, base_place, tool_place)
    return [*said_of_base, *said_of_tool]


def _frame(
    result: Calibration, name: str, what: str, asked: bool | None, place: Array, own: Array
) -> tuple[Array | None, list[str]]:
    """Return a frame (6,) if it is written, and a sentence on it if it was identified."""
    identified = any(each.startswith(f"{name}_") for each in result.problem.parameters.free.names)
    written = asked
    if asked is None:
        written = identified and same_place(place, own)
    if written:
        return place, [f"URDF: its {what} is at the identified {name}, {placed(place)}."]
    if identified:
        where = f"the identified {name} is not there, but at {placed(place)}"
        return None, [f"URDF: its {what} stays where it was; {where}."]
    return None, []


def export_ur_calibration(result: Calibration, source: str | Path, target: str | Path) -> list[str]:
    """Write a ``calibration.conf``; what alpha1 and a1 say is where the controller's Base is, and is left out."""
    found = found_by(result)[0].robot
    nominal = result.problem.robot
    if np.abs(nominal.mdh[0, :2]).max() > 0:
        raise InputError("robot", "alpha1 or a1 that are not zero", "a ready robot of Universal Robots")
    mdh = found.mdh.copy()
    mdh[0, :2] = 0.0
    write_ur_calibration(source, replace(found, mdh=mdh), nominal, target)
    moved = np.array_equal(mdh, found.mdh)
    return [] if moved else ["alpha1 and a1 place axis 1 and are no part of calibration.conf: its Base is on axis 1."]


def found_by(result: Calibration, marker: str | None = None) -> tuple[Described, bool]:
    """Return what was identified with a reflector, by default the first; and whether there are several."""
    markers = reflectors(result.problem.parameters.names)
    return identified(result, markers[0] if marker is None else marker), len(markers) > 1


def write_all(writers: Sequence[tuple[Path, Callable[[Path], Sequence[str] | None]]]) -> list[str]:
    """Write several files, or none of them if one cannot be written; return what their writers say.

    Parameters
    ----------
    writers
        Targets, each with a function that writes to the path it is given.
    """
    _require_different([target for target, _ in writers])
    notes: list[str] = []
    with TemporaryDirectory() as folder:
        scratch = Path(folder)
        made: dict[Path, Path] = {}
        for number, (target, write) in enumerate(writers):
            made[target] = path = scratch / str(number) / target.name
            path.parent.mkdir()
            try:
                notes += write(path) or ()
            except InputError as error:
                file = target if error.file == path else error.file
                raise InputError(error.where, error.found, error.accepted, file) from None
        with refused(", ".join(str(target) for target in made)):
            write_files({target: path.read_bytes() for target, path in made.items()})
    return notes


def _require_different(targets: Sequence[Path]) -> None:
    for target in targets:
        if target.is_dir():
            raise InputError("the file", "a folder", "a name of its own for every file", target)
        if targets.count(target) > 1:
            raise InputError("the file", "two files for it", "a name of its own for every file", target)
