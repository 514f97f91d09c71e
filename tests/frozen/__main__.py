"""Results of every shipped problem and variant, frozen, so that a redesign can be compared with what stood before.

``python -m tests.frozen write`` calibrates all of them as their files say and writes ``results.json`` here;
``python -m tests.frozen compare`` calibrates again and prints, for each, the largest difference of the deviations in
units of the prior scale, and the relative differences of weight, objective, standard deviations and hyperparameters.
"""

from __future__ import annotations

import json
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

import rpim_opt as ro

ROOT = Path(__file__).parents[2]
FILE = Path(__file__).with_name("results.json")
LIMITS = {"x": 1e-9, "weight": 1e-8, "objective": 1e-8, "std": 1e-7, "expanded": 1e-7, "hyperparameters": 1e-3}
"""Largest differences that are rounding: of x by prior scale, of all else relative."""
CONDITIONAL = ("std", "expanded")  # covariances are conditional on equations and active bounds
INTENDED = {
    "constrained:equal_links": CONDITIONAL,
    "constrained:parallel_axes": CONDITIONAL,
    "constrained:everything": CONDITIONAL,
    "constrained:wrong_tolerance": CONDITIONAL,
    "paper_arm:parallel_axes": CONDITIONAL,
    # beside a limit on movements covariances were not conditional; cones: an interior point is exact to 1e-10 of the
    # objective, not of x
    "constrained:drawing": ("x", *CONDITIONAL),
    "paper_arm:bounded": ("weight",),  # a corner on a grid that hangs on the smallest singular value, 1e-7
    # x counts from where registration puts the base, which is exact to the root of rounding
    "seven_axis": ("x",),
    "tracker": ("x",),
    "scara": ("x",),  # 1.2e-9: derivatives by the noise are summed in another order
    # one of three reflectors places the base, not all of them; and what is refused without a name has other words
    "markers": ("x", "objective", "std", "hyperparameters", "expanded"),
    "constrained:certified_tool": (
        "std",
    ),  # 1.7e-7: the search for hyperparameters ends elsewhere within its tolerance
    # halves of the joints' ranges miss of each other more than chance would: intervals are wider
    "constrained:offsets": ("expanded", "std"),
    "blunders": ("expanded", "std"),
    "distance": ("std", "expanded"),  # the words of a refusal, as of markers
    "datum_cube": ("expanded",),  # 3e-6: what a drawing states of planes is no reading, and no longer counts as one
    # residuals are whitened in one way, which rounds differently: where a search for the weight, or for hyperparameters
    # (to 1e-3), ends follows
    "paper_arm": ("x", "weight", "objective", "std"),
    "paper_arm:tikhonov": ("x", "weight", "objective", "std"),
    "plane": ("x", "objective", "std", "expanded"),
    "position": ("x",),  # 2e-9 on some processors
    "mixed": ("x", "expanded"),  # 6e-9 on some processors; the words of a refusal
    "rank_deficient": ("x",),  # 5e-8: a factor keeps singular values that the formula of them takes for zero
    "sphere": ("x",),  # 4e-9: local variances settle to 1e-8
    "paper_arm:misprints": ("x", "weight", "objective", "std"),  # what a rule sees of a robust loss is decided anew
}
"""What may differ by more, and why."""
REGISTERED = ("camera", "constrained", "constrained:tolerances", "constrained:certified_tool", "far_frames", "joints",
              "mixed", "pose", "position", "rank_deficient", "scara", "seven_axis", "tracker")  # fmt: skip
"""The estimated scale of a registered base no longer says what joint 1 may be off: standard deviations of both are a
third to three times larger, predictions by 1e-4 of theirs at most."""
INTENDED |= {name: (*INTENDED.get(name, ()), *CONDITIONAL) for name in REGISTERED}
SEVERAL = ("cable", "markers", "mixed")  # readings of one configuration: these have a variance of their own
INTENDED |= {name: (*INTENDED.get(name, ()), "hyperparameters") for name in SEVERAL}


def problems() -> list[tuple[str, str | None]]:
    """Return the shipped problems with each of their variants."""
    found: list[tuple[str, str | None]] = []
    for folder in sorted((ROOT / "problems").iterdir()):
        table = tomllib.loads((folder / "problem.toml").read_text())
        found += [(folder.name, None), *((folder.name, variant) for variant in table.get("variant", {}))]
    return found


def figures(name: str, variant: str | None) -> dict[str, Any]:
    """Return the figures of one calibration."""
    instance = ro.load(ROOT / "problems" / name, variant=variant)
    result = instance.calibrate()
    free = result.problem.parameters.free
    names = list(free.names)
    told: dict[str, Any] = {
        "names": names,
        "x": result.x.tolist(),
        "scale": instance.problem.parameters.free.scale.tolist(),
        "weight": result.weight,
        "objective": result.history[-1].objective if result.history else None,
        "converged": result.converged,
        "rms_mm": None,
    }
    try:
        told["std"] = np.sqrt(np.diag(result.covariance)).tolist()
    except ro.basics.RpimError as error:
        told["std"] = str(error)[:60]
    if instance.validation is not None:
        errors = result.errors(instance.validation)
        told["rms_mm"] = float(1e3 * np.sqrt(np.mean(errors**2)))
    if instance.validation is not None:
        try:
            told["expanded"] = result.predict(instance.validation.q[:5], confidence=0.95).expanded.tolist()
        except ro.basics.RpimError as error:
            told["expanded"] = str(error)[:60]
    learned = result.learned
    if learned is not None:
        sizes = {**learned.scales, **{f"noise {k}": v for k, v in learned.noise.items()}}
        told["hyperparameters"] = {key: list(value) for key, value in sizes.items()}
    return told


def _relative(new: Any, old: Any) -> float:
    if isinstance(old, str) or isinstance(new, str) or old is None or new is None:
        return 0.0 if new == old else float("inf")
    a, b = np.asarray(new, float), np.asarray(old, float)
    if a.shape != b.shape:
        return float("inf")
    size = np.maximum(np.abs(b), 1e-12 * np.max(np.abs(b), initial=1e-300))
    return float(np.max(np.abs(a - b) / size, initial=0.0))


def differences(new: dict[str, Any], old: dict[str, Any]) -> dict[str, float]:
    """Return by how much two results differ."""
    inf = float("inf")
    same = new["names"] == old["names"]
    scale = np.asarray(old["scale"])
    if same and len(scale) != len(old["x"]):  # model extensions were added: deviations against their own size
        scale = np.maximum(np.abs(old["x"]), 1e-9)
    told = {
        "x": float(np.max(np.abs(np.subtract(new["x"], old["x"])) / scale)) if same else inf,
        "weight": _relative(new["weight"], old["weight"]),
        "objective": _relative(new["objective"], old["objective"]),
        "std": _relative(new["std"], old["std"]) if same else inf,
        "expanded": _relative(new.get("expanded"), old.get("expanded")),
        "hyperparameters": 0.0,
    }
    a, b = new.get("hyperparameters", {}), old.get("hyperparameters", {})
    if a.keys() != b.keys():
        told["hyperparameters"] = inf
    elif b:  # of the sizes; their standard errors follow from them
        told["hyperparameters"] = max(_relative(a[key][0], b[key][0]) for key in b)
    return told


def main(what: str, *chosen: str) -> int:
    """Write or compare; ``chosen`` are names of problems."""
    new = {}
    for name, variant in problems():
        if chosen and name not in chosen:
            continue
        key = f"{name}:{variant}" if variant else name
        new[key] = figures(name, variant)
        if what == "write":
            print(key, flush=True)
    if what == "write":
        FILE.write_text(json.dumps(new, indent=1) + "\n")
        return 0
    old = json.loads(FILE.read_text())
    beyond = 0
    for key, told in new.items():
        by = differences(told, old[key])
        # by as much as learned hyperparameters move, what rests on them may
        limits = {
            k: limit if k == "hyperparameters" else max(limit, by["hyperparameters"]) for k, limit in LIMITS.items()
        }
        over = [k for k, limit in limits.items() if not by[k] <= limit and k not in INTENDED.get(key, ())]
        beyond += bool(over)
        text = "  ".join(f"{k} {v:.1e}" for k, v in by.items())
        print(f"{key:28} {text}  rms {old[key]['rms_mm']} -> {told['rms_mm']}  {' '.join(over)}", flush=True)
    print(f"{len(new)} compared, {beyond} beyond the limits")
    return int(beyond > 0)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
