"""The types of measurements that come with the package: those of every module in this folder."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

from rpim_opt.data.measurements.measurement import Measurement

_names = [each.name for each in iter_modules([str(Path(__file__).parent)])]
_modules = [import_module(f"{__package__}.{name}") for name in _names if name not in ("measurement", "registry")]
MEASUREMENTS: dict[str, Measurement] = {each.name: each for module in _modules for each in module.TYPES}
"""Measurement types that a problem file may name."""
READY = MEASUREMENTS | {each.name: each for module in _modules for each in getattr(module, "UNNAMED", ())}
"""All measurement types of the package."""
