"""Arrays and the statistics of errors."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rpim_opt.basics.exceptions import InputError

Array = NDArray[np.float64]

TINY = float(np.finfo(float).tiny)  # divisors are no smaller


def finite_numbers(where: str, values: Any, *shapes: tuple[int, ...]) -> Array:
    """Return values as an array; InputError unless they are finite numbers of one of the given shapes."""
    accepted = f"finite numbers of shape {' or '.join(map(str, shapes))}"
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise InputError(where, f"a {type(values).__name__}", accepted) from None
    if array.shape not in shapes:
        raise InputError(where, f"shape {array.shape}", accepted)
    for row in np.argwhere(~np.isfinite(array))[:1, 0]:
        raise InputError(f"{where}, row {row + 1}", f"{array[row].tolist()}", accepted)
    return array


def rms(errors: Array) -> float:
    """Return the root mean square of the finite errors; 0 if there are none."""
    finite = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else 0.0


def statistics(errors: Array, unit: Literal["mm", "mrad"] = "mm") -> dict[str, Any]:
    """Return mean, RMS, 95th percentile, maximum [mm or mrad] and count of errors [m or rad]; None if all are NaN."""
    of = 1e3 * errors[np.isfinite(errors)]
    figures: dict[str, float | None] = dict.fromkeys(("mean", "rms", "p95", "max"))
    if len(of):
        figures = {"mean": of.mean(), "rms": (of**2).mean() ** 0.5, "p95": np.percentile(of, 95), "max": of.max()}
    return {f"{name}_{unit}": v if v is None else float(v) for name, v in figures.items()} | {"count": len(of)}
