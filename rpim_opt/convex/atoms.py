"""CVXPY's functions and words by name, so that a formulation can be stated before CVXPY is imported."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import cvxpy as cp
else:

    class _Late(ModuleType):
        """CVXPY, imported when something of it is first used."""

        def __getattr__(self, name: str) -> Any:
            if name.startswith("__"):  # what doctest and inspect ask of every module is no use of it
                raise AttributeError(name)
            return getattr(import_module(self.__name__), name)

    cp = _Late("cvxpy")

OPTIMAL, INFEASIBLE, UNBOUNDED = "optimal", "infeasible", "unbounded"
INFEASIBLE_INACCURATE = "infeasible_inaccurate"
"""CVXPY's words for how a program ended; a test holds them against CVXPY."""


@dataclass(frozen=True)
class Atom:
    """A function of CVXPY that means the same whenever it is asked: ``cp.sum_squares``, by its name."""

    name: str

    def __call__(self, v: Any) -> Any:
        """Return CVXPY's expression."""
        return getattr(cp, self.name)(v)

    def __repr__(self) -> str:
        return f"cp.{self.name}"

    @property
    def __name__(self) -> str:
        return self.name


SQUARES, SUM, LARGEST, NORM1, NORM2 = (Atom(name) for name in ("sum_squares", "sum", "max", "norm1", "norm2"))
ATOMS = (SQUARES, SUM, LARGEST, NORM1, NORM2)


def named(function: Callable[..., Any] | None) -> Callable[..., Any] | None:
    """Return the `Atom` that a function of CVXPY is; any other function as it is."""
    module = sys.modules.get("cvxpy")
    if module is None:  # then nobody can have taken a function of it
        return function
    for atom in ATOMS:
        if function is getattr(module, atom.name, None):
            return atom
    return function
