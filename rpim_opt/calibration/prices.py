"""What statements of a drawing cost: by how much the misfit would fall if one were loosened."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.constraints import Parsed
from rpim_opt.convex.program import Program

NEAR = 1e-6
"""Part of what deviations of their expected sizes change, within which a statement holds the fit back."""


class Price(NamedTuple):
    """A statement of a drawing at a solution.

    ``slack`` is how far it is from its limit, in ``unit``; ``multiplier`` by how much the misfit (loss + weight
    penalty, as the fit minimizes it) would fall for every ``unit`` by which it is loosened, zero where it holds nothing
    back; ``gain`` what loosening it by ``step`` of this unit would bring, to first order. ``misfit`` is all there is.
    """

    text: str
    unit: str
    slack: float
    multiplier: float
    step: float
    gain: float
    misfit: float

    @property
    def holds(self) -> bool:
        """Whether it holds the fit back."""
        return self.multiplier > 0

    def sentence(self) -> str:
        """Say it.

        >>> from rpim_opt.calibration.prices import Price
        >>> print(Price("|a2| <= 0.1 mm", "mm", 0.0, 120.0, 0.01, 1.2, 30.0).sentence())
        '|a2| <= 0.1 mm' holds the fit back: loosening it by 0.01 mm would lower the misfit by 1.2 of 30.
        """
        if not self.holds:
            return f"'{self.text}' is met with {self.slack:.3g} {self.unit} to spare."
        return (
            f"'{self.text}' holds the fit back: loosening it by {self.step:.3g} {self.unit} would lower the misfit "
            f"by {self.gain:.3g} of {self.misfit:.4g}."
        )


def prices(program: Program, z: Array, weight: float) -> tuple[Price, ...]:
    """Return what the statements among a program's constraints cost at its solution z (n,)."""
    drawn = [constraint for constraint in program.formulation.constraints if isinstance(constraint, Parsed)]
    if not drawn:
        return ()
    duals = dict(zip(map(id, program.formulation.constraints), program.beginning(z).solve(weight).duals, strict=True))
    misfit = program.objective(z, weight)
    return tuple(_price(each, program, z, misfit, duals[id(each)]) for each in drawn)


def _price(drawn: Parsed, program: Program, z: Array, misfit: float, multipliers: Array) -> Price:
    parameters = program.model.parameters
    unit, si = drawn.unit
    slack = drawn.slack(z, parameters)
    scale = drawn.scale(parameters)
    multiplier = drawn.price(multipliers, parameters)
    # an interior point leaves small multipliers where nothing holds
    if slack > NEAR * scale * (1 + float(np.max(np.abs(z)))) or multiplier * scale <= NEAR * max(misfit, NEAR):
        multiplier = 0.0
    gain = min(multiplier * drawn.step, misfit)
    return Price(drawn.text, unit, max(slack, 0.0) / si, multiplier * si, drawn.step / si, gain, misfit)
