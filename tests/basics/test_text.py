"""Tables are texts wherever they are made."""

from __future__ import annotations

import pytest

from rpim_opt.basics.text import table


def test_a_table_is_a_text_in_a_notebook_too(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = table(["name", "mm"], [["a2", "1.5"]])
    assert "a2" in plain
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)  # there rich shows what it is to print
    assert table(["name", "mm"], [["a2", "1.5"]]) == plain
