"""The study of `long_study`, so short that a suite can wait for it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.study.long_study import different, long_study


def test_what_differs_is_named(tmp_path: Path) -> None:
    for name, content in (("one", "a"), ("other", "b")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "same").write_text("x")
        (tmp_path / name / "another").write_text(content)
        (tmp_path / name / f"only {name}").write_text("x")
    assert different(tmp_path / "one", tmp_path / "other") == ["another", "only one", "only other"]


@pytest.mark.slow
def test_results_do_not_depend_on_kills(tmp_path: Path) -> None:
    found = long_study(tmp_path, 60, 1.0, 3)
    assert found["different"] == []
    assert {"README.md", "metrics.json", "replicates.parquet"} <= set(found["files"])
