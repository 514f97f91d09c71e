"""Names that a pattern means: ``d?``, ``theta[23]``, ``tool_*``."""

from __future__ import annotations

from fnmatch import fnmatchcase

LONGEST = 200
"""Characters of a pattern: longer ones, which nobody writes, would take for ever to be understood."""


def fits(name: str, pattern: str) -> bool:
    """Return whether a pattern means a name; one that is too long means none.

    >>> from rpim_opt.basics.patterns import fits
    >>> fits("d2", "d?"), fits("theta2", "theta[13]"), fits("a", "*" * 1000)
    (True, False, False)
    """
    return len(pattern) <= LONGEST and fnmatchcase(name, pattern)
