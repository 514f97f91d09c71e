"""Options of commands that others do not try."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.test_cli import run


def test_times_are_told_on_demand(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    assert run(monkeypatch, "calibrate", "paper_arm", "--profile") == 0
    said = capsys.readouterr().out
    assert "solve" in said
    assert run(monkeypatch, "calibrate", "paper_arm") == 0
    assert len(capsys.readouterr().out) < len(said)


def test_what_is_measured_already_counts_in_a_design(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    asked = ["design", "position", "--count", "4", "--candidates", "20", "--criterion", "D", "--json"]
    values = []
    for more in ([], ["--augment"]):
        assert run(monkeypatch, *asked, *more) == 0
        values.append(json.loads(capsys.readouterr().out))
    assert values[0] != values[1]


def test_touches_are_designed_at_a_point(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    asked = ["design", "contact", "--count", "3", "--candidates", "8", "--criterion", "D", "--point", "500,0,300"]
    assert run(monkeypatch, *asked) == 0
    assert "3 of 8 configurations, D-optimal" in capsys.readouterr().out
    assert run(monkeypatch, *asked[:-1], "here") == 2
    assert "x,y,z [mm]" in capsys.readouterr().err
