"""A chart as a description: two axes, and what stands between them. `svg` draws it on a page, `on_axes` on paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rpim_opt.basics.arrays import Array

ROOM = 0.04
"""Between an axis's ends and its first and last values, as a part of its length."""


@dataclass(frozen=True)
class Axis:
    """From values to places: linear, logarithmic, logarithmic to both sides of zero, or a place for each name.

    Parameters
    ----------
    label
        What is drawn, with its unit; empty where names speak for themselves.
    ends
        The least and the largest value that have to be seen; what lies beyond stands at the edge.
    log
        Whether equal factors are equally far apart.
    linear_to
        Up to this size values of both signs are linear, beyond it logarithmic; zero: no such axis.
    names
        They stand at 1, 2, ...
    """

    label: str
    ends: tuple[float, float] = (0.0, 1.0)
    log: bool = False
    linear_to: float = 0.0
    names: Sequence[str] = ()

    def scaled(self, values: ArrayLike) -> Array:
        """Return values as lengths on paper."""
        v = np.asarray(values, dtype=float)
        if self.log:
            return np.log10(np.maximum(v, np.finfo(float).tiny))
        if not self.linear_to:
            return v
        # as matplotlib's: the linear part is as long as a decade
        size = np.maximum(np.abs(v) / self.linear_to, 1e-300)
        return np.where(size <= 1, v / self.linear_to, np.sign(v) * (1 + 0.9 * np.log10(size)))

    @property
    def limits(self) -> tuple[float, float]:
        """The values at the axis's ends, with room for what is drawn at the outermost ones."""
        if self.names:
            return 0.5, len(self.names) + 0.5
        low, high = map(float, self.ends)
        if self.log:
            room = (high / low) ** ROOM if high > low else 2.0
            return low / room, high * room
        if self.linear_to:
            return self._beyond(low, -1), self._beyond(high, 1)
        room = ROOM * (high - low) or 0.5
        if low == 0:  # counts stand on zero
            return 0.0, high + room
        return low - room, high + room

    def _beyond(self, end: float, sign: int) -> float:
        outwards = max(sign * end, self.linear_to)
        return sign * 1.5 * outwards


Role = str
"""What something drawn stands for, which decides its colour: ``before``, ``after``, ``mark``, ``other``, ``ink``,
``zero``, ``level0`` to ``level4``, these with `` over`` where they are above a limit."""

Values = NDArray[np.floating[Any]] | Sequence[float]


@dataclass(frozen=True)
class Line:
    """A line through points (k,)."""

    x: Values
    y: Values
    role: Role
    label: str = ""
    dashed: bool = False


@dataclass(frozen=True)
class Segments:
    """Straight pieces from ``(x[i, 0], y[i, 0])`` to ``(x[i, 1], y[i, 1])``, both (k, 2)."""

    x: NDArray[np.floating[Any]]
    y: NDArray[np.floating[Any]]
    role: Role
    label: str = ""


@dataclass(frozen=True)
class Dots:
    """Points (k,), each with a text that a page shows when it is pointed at.

    ``each`` says that every point is one of its own, which a legend on paper names. Hollow ones are drawn as outlines.
    """

    x: Values
    y: Values
    role: Role
    label: str = ""
    hints: Sequence[str] = ()
    each: bool = False
    size: Literal["small", "middle", "large"] = "middle"
    hollow: bool = False


@dataclass(frozen=True)
class Bars:
    """Bars from the chart's floor to ``top`` (k,), between two values of x."""

    left: Values
    right: Values
    top: Values
    role: Role
    label: str = ""
    hints: Sequence[str] = ()


@dataclass(frozen=True)
class Cells:
    """Rectangles of one shade: their lower left corners (k, 2), and the size (2,) of all."""

    corners: NDArray[np.floating[Any]]
    size: tuple[float, float]
    role: Role
    label: str = ""
    hints: Sequence[str] = ()


Mark = Line | Segments | Dots | Bars | Cells


@dataclass(frozen=True)
class Chart:
    """Two axes, and what is drawn on them from the lowest to the topmost.

    Parameters
    ----------
    title
        What it shows, in a few words.
    x, y
        The axes; names of y go from above to below.
    marks
        What is drawn.
    note
        What has to be said of what is drawn, a sentence; empty: nothing.
    height
        On a page that is 420 wide.
    alike
        Whether a length is as long on either axis.
    """

    title: str
    x: Axis
    y: Axis
    marks: Sequence[Mark]
    note: str = ""
    height: int = 270
    alike: bool = False

    @property
    def legend(self) -> list[tuple[Role, str]]:
        """What colours stand for, each once."""
        return list(dict.fromkeys((mark.role, mark.label) for mark in self.marks if mark.label))
