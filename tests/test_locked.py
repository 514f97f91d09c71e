"""What is downloaded to run or to build the package is pinned, by version and by hash."""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from tests import ROOT

Locked = Mapping[str, tuple[str, frozenset[str]]]


def locked(name: str) -> Locked:
    """Return version and hashes of every package of a file, by its name."""
    text = (ROOT / name).read_text(encoding="utf-8").replace("\\\n", " ")
    found = {}
    for line in text.splitlines():
        requirement, *hashes = line.split("--hash=sha256:")
        parsed = Requirement(requirement.strip())
        (pin,) = parsed.specifier
        assert pin.operator == "==", line
        digests = frozenset(digest.strip() for digest in hashes)
        assert digests, line
        assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in digests)
        found[canonicalize_name(parsed.name)] = (pin.version, digests)
    return found


def project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_every_requirement_is_locked_at_a_version_that_it_accepts() -> None:
    known = locked("constraints.txt")
    stated = project()["project"]
    extras = [each for group in stated["optional-dependencies"].values() for each in group]
    for text in [*stated["dependencies"], *extras, *project()["build-system"]["requires"]]:
        requirement = Requirement(text)
        assert Version(known[canonicalize_name(requirement.name)][0]) in requirement.specifier, text


def test_an_installation_without_tools_is_part_of_the_tested_one() -> None:
    known = locked("constraints.txt")
    plain = locked("requirements.txt")
    for name, pinned in plain.items():
        assert known[name] == pinned
    stated = {canonicalize_name(Requirement(each).name) for each in project()["project"]["dependencies"]}
    assert stated <= set(plain)
    assert not {"pytest", "ruff", "hatchling", "distributed"} & set(plain)


def test_notebooks_run_with_what_was_tested() -> None:
    known = locked("constraints.txt")
    there = locked("studies/gallery/notebooks.txt")
    for name in set(known) & set(there):
        assert known[name] == there[name]
    for text in [*project()["project"]["dependencies"], *project()["dependency-groups"]["notebooks"]]:
        requirement = Requirement(text)
        assert Version(there[canonicalize_name(requirement.name)][0]) in requirement.specifier, text


def test_the_build_backend_has_a_bound() -> None:
    for text in project()["build-system"]["requires"]:
        assert any(part.operator in ("<", "==", "~=") for part in Requirement(text).specifier), text


def test_what_runs_here_is_what_is_locked() -> None:
    if not Path(sys.prefix, "requirements.sha256").is_file():
        pytest.skip("dev.py did not make this environment, so it has other versions than the locked ones")
    for name, (wanted, _) in locked("requirements.txt").items():
        try:
            assert version(name) == wanted, name
        except PackageNotFoundError:  # of another system or another Python
            continue
