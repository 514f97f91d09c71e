"""What a calibration identified, as a robot, its base and its tool."""

from __future__ import annotations

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.calibration.result import Calibration
from rpim_opt.robot.chain import Described
from rpim_opt.robot.kinematics import FRAME
from rpim_opt.robot.parameter_names import of_term, tool_prefix

SHOWN = 6
"""Parameters that are named before the rest is counted."""


def identified(result: Calibration, marker: str = "") -> Described:
    """Return what a calibration identified: the robot, its base in the instrument's frame, and a reflector as tool.

    Parameters
    ----------
    result
        The calibration.
    marker
        Which reflector; the only one by default.

    Raises
    ------
    InputError
        Naming the identified parameters that no description of a robot holds: ratios, harmonics, backlash, what
        gravity does (compliances, bends), terms of a user's own; for a marker that is not known.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> arm = ro.use.identified(ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml))
    >>> arm.base.round(2), (1e3 * arm.tool[:3]).round(1)  # [m, rad], [mm]
    (array([ 1.8 , -0.7 ,  0.35,  0.02, -0.04,  1.9 ]), array([18.8, -3.7, 61. ]))
    """
    p = result.problem.parameters
    values = p.nominal.copy()
    values[p.identified] = p.free.values(result.x)
    of = dict(zip(p.names, values, strict=True))
    extras = [name for name, value in of.items() if value and (of_term(name) or name in p.terms)]
    if extras:
        found = ", ".join(extras[:SHOWN])
        if len(extras) > SHOWN:
            found += f" and {len(extras) - SHOWN} more"
        accepted = "MDH parameters, base and tool: files hold nothing else; `compensate` corrects commands for them"
        raise InputError("the calibration", found, accepted)
    prefix = tool_prefix(marker)
    if prefix + "x" not in of:
        raise InputError("marker", f"'{marker}'", "a reflector of the calibration")
    base = np.array([of["base_" + c] for c in FRAME])
    tool = np.array([of[prefix + c] for c in FRAME])
    return Described(result.robot, base, tool)
