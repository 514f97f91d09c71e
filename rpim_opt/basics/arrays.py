"""Arrays and the statistics of errors."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def statistics(errors: Array, unit: Literal["mm", "mrad"] = "mm") -> dict[str, Any]:
    """Return mean, RMS, maximum [mm or mrad] and count of errors [m or rad]; None if all are NaN."""
    of = 1e3 * errors[np.isfinite(errors)]
    if not len(of):
        return {f"mean_{unit}": None, f"rms_{unit}": None, f"max_{unit}": None, "count": 0}
    rms = float((of**2).mean() ** 0.5)
    return {f"mean_{unit}": float(of.mean()), f"rms_{unit}": rms, f"max_{unit}": float(of.max()), "count": len(of)}
