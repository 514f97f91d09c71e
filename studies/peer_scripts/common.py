"""What all scripts of this folder share: several methods in one process, and how long its imports took."""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

BEGUN = time.perf_counter()


def answer(run: Callable[[Path, str], dict], versions: dict) -> None:
    """Print, as JSON, what every method of the command line finds in the folder that it names.

    Parameters
    ----------
    run
        From the folder and a method to ``seconds``, ``predicted_mm`` (N, 3) and what else is told.
    versions
        Label to version.
    """
    imports = time.perf_counter() - BEGUN
    folder, *methods = sys.argv[1:]
    found = {"imports": imports, "versions": ", ".join(f"{label} {version}" for label, version in versions.items())}
    for method in methods:
        try:
            found[method] = run(Path(folder), method)
        except Exception as error:  # a failure is a result, and the other methods go on
            found[method] = {"failed": f"{type(error).__name__}: {error}"}
    print(json.dumps(found))
