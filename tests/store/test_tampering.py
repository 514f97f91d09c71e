"""A result file that was changed is refused by its digest, and by the errors of its rows."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.store.result_file import digest


@pytest.fixture(scope="module")
def text(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("result") / "result.json"
    instance = ro.load("paper_arm")
    result = ro.calibrate(instance.problem, ro.bounded, ro.l_curve)
    ro.store.save_result(replace(result, record=instance.record), path)
    return path.read_text()


def leaves(content: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the place of every value."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield from leaves(value, (*at, key))
    elif isinstance(content, list):
        for i, value in enumerate(content):
            yield from leaves(value, (*at, i))
    else:
        yield at


def changed(value: Any) -> Any:
    """Return another value of the same kind, the nearest one of a number."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + 1
    if isinstance(value, float):
        return float(np.nextafter(value, np.inf))
    if isinstance(value, str):
        return value + " "
    return 1.0


def put(content: Any, at: tuple[Any, ...], value: Any) -> Any:
    edited = copy.deepcopy(content)
    part = edited
    for key in at[:-1]:
        part = part[key]
    part[at[-1]] = value
    return edited


def load(tmp_path: Path, content: Any) -> ro.calibration.Calibration:
    path = tmp_path / "r.json"
    path.write_text(json.dumps(content))
    return ro.load_result(path)


def said(tmp_path: Path, content: Any) -> str:
    with pytest.raises(ro.InputError) as error:
        load(tmp_path, content)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_every_single_change_is_seen(tmp_path: Path, text: str) -> None:
    content = json.loads(text)
    places = list(leaves(content))
    assert len(places) > 1000
    drawn = np.random.default_rng(0).permutation(len(places))[:120]
    for i in drawn:
        at = places[i]
        value = content
        for key in at:
            value = value[key]
        assert said(tmp_path, put(content, at, changed(value))), at


NAMED = {
    "converged": (("converged",), False),
    "message": (("message",), "Converged."),
    "weight": (("weight",), 1e-3),
    "a covariance": (("data", "identification", "blocks", 0, "covariance", 0, 0, 0), 1e-12),
    "a nominal parameter": (("model", "nominal", 4), 0.1070000001),
    "whether a parameter is identified": (("model", "identified", 8), False),
    "a digest of an input file": (("record", "files", "identification.csv"), "0" * 64),
    "why a row is left out": (("record", "excluded", "T8-7"), "bumped"),
    "whether it is simulated": (("record", "simulated"), True),
    "when it was made": (("record", "made"), "2020-01-01T00:00:00+00:00"),
    "the certificate": (("certificate", "decrease"), 1e-15),
    "a held parameter": (("active_bounds",), [{"name": "d5", "bound": 0.0, "multiplier": 0.0, "gain": 0.0}]),
    "the nominal figures": (("nominal", "validation", "mean_mm"), 9.9),
    "the validation's figures": (("validation", "mean_mm"), 0.001),
    "the identification's figures": (("identification", "max_mm"), 0.001),
    "the table of parameters": (("parameters", 0, "std"), 1e-6),
    "a title": (("title",), "Another arm"),
    "a version": (("record", "versions", "clarabel"), "9.9"),
    "a figure of 400 digits": (("validation", "mean_mm"), 10**400),
    "a note of one's own": (("note",), "hello"),
    "the weight's curve": (("selection", "score", 3), 0.5),
}


@pytest.mark.parametrize("what", NAMED)
def test_what_was_changed_by_hand_is_refused(tmp_path: Path, text: str, what: str) -> None:
    at, value = NAMED[what]
    assert "accepted" in said(tmp_path, put(json.loads(text), at, value))


def test_errors_that_do_not_follow_from_the_data_are_refused(tmp_path: Path, text: str) -> None:
    edited = json.loads(text)
    edited["rows"]["validation"][0]["identified_mm"] += 1e-3
    edited["digest"] = digest(edited)
    assert "key rows.validation, row" in said(tmp_path, edited)


@pytest.mark.parametrize("key", ["dimensions", "nominal", "scale", "tolerance", "identified"])
def test_a_column_of_the_model_that_is_too_short_is_named(tmp_path: Path, text: str, key: str) -> None:
    content = json.loads(text)
    edited = put(content, ("model", key), content["model"][key][:-1])
    assert f", {key}: found" in said(tmp_path, edited | {"digest": digest(edited)})


def test_rows_that_are_none_or_twice_there_are_refused(tmp_path: Path, text: str) -> None:
    for row in (0, -1, 99):
        edited = put(json.loads(text), ("data", "identification", "blocks", 0, "row", 2), row)
        assert "key data.identification: found rows" in said(tmp_path, edited | {"digest": digest(edited)})


def test_a_file_may_be_laid_out_anew(tmp_path: Path, text: str) -> None:
    content = json.loads(text)
    turned = {key: content[key] for key in reversed(content)}
    assert np.array_equal(load(tmp_path, turned).x, content["x"])


def test_a_file_without_a_digest_is_refused(tmp_path: Path, text: str) -> None:
    content = json.loads(text)
    del content["digest"]
    assert "key digest: found nothing" in said(tmp_path, content)
    assert "key digest" in said(tmp_path, content | {"digest": 3})
