"""A bar with the time left where a person is watching, silence elsewhere, and a function of one's own instead."""

from __future__ import annotations

import pytest

from rpim_opt.basics.text import progress_bar


def test_a_function_is_told() -> None:
    told: list[tuple[int, int]] = []
    with progress_bar("work", lambda done, every: told.append((done, every))) as say:
        say(0, 2)
        say(2, 2)
    assert told == [(0, 2), (2, 2)]


def test_nobody_watches_a_file(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar("work") as say:
        say(1, 2)
    assert capsys.readouterr().err.strip() == ""


def test_a_person_sees_how_far_it_is(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes the stream for a terminal
    monkeypatch.setenv("TERM", "xterm")
    with progress_bar("work") as say:
        say(1, 2)
    said = capsys.readouterr().err
    assert "work" in said
    assert "1/2" in said
    with progress_bar("work", False) as say:
        say(1, 2)
    assert capsys.readouterr().err.strip() == ""
