"""What somebody demands of a robot: how far it may miss, and where."""

from __future__ import annotations

from dataclasses import dataclass

from rpim_opt.basics.exceptions import InputError

Side = tuple[float, float]
CONFIDENCE = 0.95
"""Probability with which a limit is to be kept, where nobody states another."""


@dataclass(frozen=True)
class Requirement:
    """A limit on how far the robot may miss, and the region where it has to be kept.

    Parameters
    ----------
    limit
        Of the distance between the position that is reached and the one that the model says [m].
    box
        Sides (low, high) along x, y, z [m] in the robot's base frame, where the nominal reflector is to be; anywhere by
        default.
    joints
        Sides (low, high) of joints [rad or m], by their number from 1; of the others what was measured.
    marker
        The reflector; the only one, or the first, by default.
    confidence
        Probability with which the limit is to be kept at every configuration of the region.

    Raises
    ------
    InputError
        For a limit or a confidence that nothing can keep, and sides that are not (low, high).

    Examples
    --------
    >>> import rpim_opt as ro
    >>> print(ro.data.Requirement(1e-4, box=((0.3, 0.8), (-0.2, 0.2), (0.0, 0.5))).where)
    the box x 300 to 800, y -200 to 200, z 0 to 500 mm of the base frame, joints within the measured ranges
    """

    limit: float
    box: tuple[Side, Side, Side] | None = None
    joints: tuple[tuple[int, Side], ...] = ()
    marker: str = ""
    confidence: float = CONFIDENCE

    def __post_init__(self) -> None:
        if not 0 < self.limit < float("inf"):
            raise InputError("limit", f"{1e3 * self.limit:g} mm", "a number greater than zero")
        if not 0.5 <= self.confidence < 1:
            raise InputError("confidence", f"{self.confidence:g}", "a probability from 0.5 to below 1")
        named = [(f"joint {joint}", side) for joint, side in self.joints]
        if self.box is not None:
            named += list(zip("xyz", self.box, strict=True))
        for name, (low, high) in named:
            if not low < high:
                raise InputError(name, f"from {low:g} to {high:g}", "two numbers, the smaller one first")

    @property
    def where(self) -> str:
        """The region in words."""
        said: list[str] = []
        if self.box is not None:
            sides = [f"{axis} {1e3 * a:g} to {1e3 * b:g}" for axis, (a, b) in zip("xyz", self.box, strict=True)]
            said.append(f"the box {', '.join(sides)} mm of the base frame")
        if not self.joints:
            return ", ".join([*said, "joints within the measured ranges"])
        stated = ", ".join(str(joint) for joint, _ in self.joints)
        return ", ".join([*said, f"joints {stated} within the stated ranges, others within the measured ones"])
