"""Statements in words: what they mean, and what is refused."""

from __future__ import annotations

import pytest

from rpim_opt.basics import InputError
from rpim_opt.convex.constraint_parser import Sentence, Sum, sentence


@pytest.mark.parametrize(
    ("text", "meaning"),
    [
        ("a2 = 3 mm", Sentence("equal", (Sum(("a2",), (1.0,), -0.003),), 0.0, "mm")),
        ("a2 = a3", Sentence("equal", (Sum(("a2", "a3"), (1.0, -1.0)),))),
        ("a2 == 3 +- 0 mm", Sentence("equal", (Sum(("a2",), (1.0,), -0.003),), 0.0, "mm")),
        ("a2+a3=3±0.5mm", Sentence("within", (Sum(("a2", "a3"), (1.0, 1.0), -0.003),), 0.0005, "mm")),
        ("a2 = 1 m +- 0.5 mm", Sentence("within", (Sum(("a2",), (1.0,), -1.0),), 0.0005, "mm")),
        ("d5 = nominal +- 0.5 mm", Sentence("within", (Sum(("d5",), (1.0,), 0.0, -1),), 0.0005, "mm")),
        ("d5 +- 0.5 mm", Sentence("within", (Sum(("d5",), (1.0,), 0.0, -1),), 0.0005, "mm")),
        ("|a2 - 0.5 a3| <= 0.5 mm", Sentence("within", (Sum(("a2", "a3"), (1.0, -0.5)),), 0.0005, "mm")),
        ("0.5 mm >= |-a2 + 0.5*a3|", Sentence("within", (Sum(("a2", "a3"), (-1.0, 0.5)),), 0.0005, "mm")),
        ("|a? - nominal| ≤ 0.5 mm", Sentence("within", (Sum(("a?",), (1.0,), 0.0, -1),), 0.0005, "mm")),
        ("ratio2 <= 5 ppm", Sentence("most", (Sum(("ratio2",), (1.0,), -5e-6),), 0.0, "ppm")),
        ("a2 >= 1e0 mm", Sentence("most", (Sum(("a2",), (-1.0,), 0.001),), 0.0, "mm")),
        ("a2 <= a3 + 1 mm", Sentence("most", (Sum(("a2", "a3"), (1.0, -1.0), -0.001),), 0.0, "mm")),
        ("a2 >= nominal", Sentence("most", (Sum(("a2",), (-1.0,), 0.0, 1),))),
        (
            "1 <= a2 <= 2 mm",
            Sentence("most", (Sum(("a2",), (-1.0,), 0.001), Sum(("a2",), (1.0,), -0.002)), 0.0, "mm"),
        ),
        (
            "norm(tool_x - 1 mm, tool_y) <= 2 um",
            Sentence("norm", (Sum(("tool_x",), (1.0,), -0.001), Sum(("tool_y",), (1.0,))), 2e-6, "um"),
        ),
        ("norm(base_[xyz]) <= 2 mm", Sentence("norm", (Sum(("base_[xyz]",), (1.0,)),), 0.002, "mm")),
        ("|a1, a2| <= 2 mm", Sentence("norm", (Sum(("a1",), (1.0,)), Sum(("a2",), (1.0,))), 0.002, "mm")),
        ("move at most 2 mm", Sentence("move", (), 0.002, "mm", ("workspace",))),
        ("move at most 2 mm:", Sentence("move", (), 0.002, "mm", ("workspace",))),
        (" move at most 2 mm : ", Sentence("move", (), 0.002, "mm", ("workspace",))),
        ("move at most 2 mm: here, there", Sentence("move", (), 0.002, "mm", ("here", "there"))),
    ],
)
def test_a_statement_means_what_it_says(text: str, meaning: Sentence) -> None:
    found = sentence(text)
    assert (found.kind, found.unit, found.places) == (meaning.kind, meaning.unit, meaning.places)
    assert found.limit == pytest.approx(meaning.limit, rel=1e-15)
    for one, other in zip(found.sums, meaning.sums, strict=True):
        assert (one.names, one.factors, one.nominal) == (other.names, other.factors, other.nominal)
        assert one.constant == pytest.approx(other.constant, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "the end where a parameter"),
        ("a2", "no =, <= or >="),
        ("a2 = 1", "no unit"),
        ("a2 = 1 kg", "unit 'kg'"),
        ("a2 = 1 mm +- 2 deg", "units mm and deg"),
        ("a2 = 1 mm +- -2 mm", "a negative tolerance"),
        ("a2 <= 3 mm +- 1 mm", "a tolerance without ="),
        ("a2 = 1 mm <= 3 mm", "= and <="),
        ("1 mm <= a2 >= 3 mm", "<= and >="),
        ("|a2| >= 1 mm", "not convex"),
        ("|a2| = 1 mm", "not convex"),
        ("1 mm <= norm(a2, a3)", "not convex"),
        ("|a2| <= |a3|", "not convex"),
        ("|a2| <= a3", "parameters where a number"),
        ("|a2| <= 0 mm", "a limit of 0"),
        ("|a2 <= 1 mm", "no closing |"),
        ("norm a2 <= 1 mm", "norm without ("),
        ("norm(a2, a3 <= 1 mm", "no closing )"),
        ("a2 + a2 = 1 mm", "'a2' twice"),
        ("a2 + nominal = 1 mm", "nominal, which has no meaning here"),
        ("a2 - nominal = nominal", "nominal on both sides"),
        ("2 nominal <= a2", "2 nominal"),
        ("1 mm <= 3 mm", "no parameter"),
        ("a2 <= 1e400 mm", "1e400"),
        ("a2 <= 3 mm; import os", "'; import os'"),
        ("__import__('os')", "'os')'"),
        ("(a2) <= 1 mm", "'(' where"),
        ("a2 a3 <= 1 mm", "'a3 <= 1 mm'"),
        ("move at most 3 deg", "a movement in deg"),
        ("move at most 0 mm", "a movement of 0"),
        ("move at most a2", "parameters where a number"),
        (3, "3"),
    ],
)
def test_anything_else_is_refused(text: str, found: str) -> None:
    with pytest.raises(InputError) as error:
        sentence(text)
    assert found in error.value.found
    assert error.value.where == "key stated" or str(text) in error.value.where


def test_a_reflectors_name_may_have_a_hyphen() -> None:
    found = sentence("tool_SMR-A_x - tool_SMR-B_x = 30 +- 0.1 mm")
    assert found.sums[0].names == ("tool_SMR-A_x", "tool_SMR-B_x")
    assert sentence("tool_x-tool_y <= 1 mm").sums[0].names == ("tool_x", "tool_y")
