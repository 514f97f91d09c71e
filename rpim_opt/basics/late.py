"""Libraries that are imported when something of them is first used: a command pays for what it computes alone."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any


class Late(ModuleType):
    """Stands for a module until an attribute of it is asked for, which imports it.

    Parameters
    ----------
    name
        As ``import`` takes it: ``scipy.optimize``.

    Examples
    --------
    >>> from rpim_opt.basics.late import Late
    >>> fractions = Late("fractions")  # nothing is imported yet
    >>> fractions.Fraction(1, 3) + fractions.Fraction(1, 6)
    Fraction(1, 2)
    """

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # what doctest and inspect ask of every module is no use of it
            raise AttributeError(name)
        value = getattr(import_module(self.__name__), name)
        setattr(self, name, value)
        return value


if TYPE_CHECKING:
    from scipy import optimize, sparse, spatial
    from scipy.spatial import transform
else:
    # SciPy's linear algebra and special functions come cheap; these bring half of SciPy along
    optimize = Late("scipy.optimize")
    sparse = Late("scipy.sparse")
    spatial = Late("scipy.spatial")
    transform = Late("scipy.spatial.transform")
