"""Robot calibration by convex optimization.

Names are imported when they are first used, so that ``import rpim_opt`` costs nothing. What most scripts need is here;
the rest is in the folders (``ro.use.compensate``), in ``ro.select``, ``ro.constraints``, ``ro.plot`` and
``ro.baselines``.
"""

from __future__ import annotations

from typing import Any

import lazy_loader

__version__ = "0.1.0"

_attach, _, _names = lazy_loader.attach_stub(__name__, __file__)
_FOLDERS = ("basics", "robot", "data", "problem", "convex", "bayes", "calibration", "store", "use", "report", "study")
_NAMESPACES = (*_FOLDERS, "baselines", "constraints", "plot", "select")
__all__ = sorted(set(_names) - set(_NAMESPACES))


def __getattr__(name: str) -> Any:
    if name in _names:
        return _attach(name)
    # without an object Python adds no guess of its own behind ours
    raise AttributeError(f"module 'rpim_opt' has no attribute '{name}'{_hint(name)}", name=name, obj=None)


def _hint(name: str) -> str:
    """Return the folder that has a name, or the names here that are spelled like it."""
    if name.startswith("_"):  # what others look for in every module
        return ""
    from difflib import get_close_matches

    where = [f"rpim_opt.{folder}.{name}" for folder in _FOLDERS if name in dir(_attach(folder))]
    alike = where or [f"rpim_opt.{each}" for each in get_close_matches(name, __all__)]
    if not alike:
        return ""
    return f"; did you mean {' or '.join(alike)}?"


def __dir__() -> list[str]:
    return sorted([*__all__, *_NAMESPACES])
