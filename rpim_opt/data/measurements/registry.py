"""The types of measurements that come with the package: those of every module in this folder."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

from rpim_opt.data.measurements.measurement import Measurement

_FOLDER = str(Path(__file__).parent)
_modules = [import_module(f"{__package__}.{each.name}") for each in iter_modules([_FOLDER])
            if each.name not in ("measurement", "registry")]  # fmt: skip
MEASUREMENTS: dict[str, Measurement] = {each.name: each for module in _modules for each in module.TYPES}
"""What a problem file may name."""
READY: dict[str, Measurement] = {
    **MEASUREMENTS, **{each.name: each for module in _modules for each in getattr(module, "UNNAMED", ())}
}  # fmt: skip
"""All that come with the package."""
