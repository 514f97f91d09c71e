"""What a problem folder may touch: what lies in it, and elsewhere only what the command line names."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rpim_opt.store import problems_folder
from tests.test_cli import edit, run

SECRET = "secret_column\n1\n"


@pytest.fixture
def received(tmp_path: Path) -> Path:
    """Return a simulated problem from somebody else, beside a file that is none of its business."""
    (tmp_path / "secret.csv").write_text(SECRET)
    return Path(shutil.copytree(problems_folder() / "position", tmp_path / "received"))


def everything(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def refused(monkeypatch, capsys, *arguments: str) -> str:
    assert run(monkeypatch, *arguments) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert "Traceback" not in said.err
    assert "secret_column" not in said.err
    assert said.err.strip().endswith(".")
    return said.err


def names_elsewhere(received: Path, how: str) -> str:
    secret = received.parent / "secret.csv"
    if how == "upwards":
        return "../secret.csv"
    if how == "down and up":
        return "tables/../../secret.csv"
    if how == "absolute":
        return str(secret)
    if how == "empty":
        return ""
    if how == "the folder":
        return "."
    if how == "a link to a folder":
        (received / "tables").symlink_to(received.parent)
        return "tables/secret.csv"
    for ending in (".csv", ".toml"):
        (received / f"table{ending}").symlink_to(secret.with_suffix(ending))
    return "table.csv"


HOW = ["upwards", "down and up", "absolute", "empty", "the folder", "a link to a folder", "a link"]


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("key", ["identification", "validation", "robot"])
@pytest.mark.parametrize("command", ["simulate", "inspect", "simulate --out"])
def test_names_that_lead_out_of_the_folder_are_refused(monkeypatch, capsys, received, command, key, how) -> None:
    if (key, how) == ("validation", "empty"):
        pytest.skip("that is how a variant has none")
    name = names_elsewhere(received, how)
    old = f'{key} = "{key}.csv"'
    if key == "robot":
        name = name.replace(".csv", ".toml")
        old = 'robot = "irb120"'
        (received.parent / "secret.toml").write_text('secret_column = "1"\n')
    edit(received / "problem.toml", old, f'{key} = "{name}"')
    before = everything(received.parent)
    verb, *out = command.split()
    arguments = [verb, str(received)]
    if out:
        arguments += [*out, str(received.parent / "out" / "deep")]
    said = refused(monkeypatch, capsys, *arguments)
    assert f"key {key}" in said
    assert everything(received.parent) == before


@pytest.mark.parametrize("how", [*HOW, "a link in a folder"])
@pytest.mark.parametrize("key", ["from", "population"])
def test_priors_come_from_the_folder_alone(monkeypatch, capsys, received, key, how) -> None:
    """Also where an honest result lies elsewhere: what is read there would show in the answer."""
    if (key, how) == ("from", "empty"):
        pytest.skip("that is how a variant has none")
    if how == "a link in a folder":
        (received / "march").mkdir()
        (received / "march" / "result.json").symlink_to(received.parent / "secret.csv")
        name = "march"
    else:
        name = names_elsewhere(received, how)
    value = f'"{name}"'
    if key == "population":
        value = f'["{name}"]'
    with (received / "problem.toml").open("a") as stream:
        stream.write(f"\n[prior]\n{key} = {value}\n")
    said = refused(monkeypatch, capsys, "inspect", str(received))
    assert f"key prior.{key}: found" in said
    assert "the name of a file in the folder; a copy there" in said


@pytest.mark.parametrize("name", ["problem.toml", "robot.toml", "table.xlsx", "noending", "./validation.csv"])
def test_simulated_tables_replace_no_other_file(monkeypatch, capsys, received, name) -> None:
    edit(received / "problem.toml", 'identification = "identification.csv"', f'identification = "{name}"')
    before = everything(received)
    assert "accepted: a" in refused(monkeypatch, capsys, "simulate", str(received))
    assert everything(received) == before


def test_the_truth_is_not_written_through_a_link(monkeypatch, capsys, received) -> None:
    (received / "truth.toml").unlink(missing_ok=True)
    (received / "truth.toml").symlink_to(received.parent / "secret.csv")
    before = everything(received.parent)
    refused(monkeypatch, capsys, "simulate", str(received))
    assert everything(received.parent) == before


def test_a_problem_file_is_not_read_through_a_link(monkeypatch, capsys, received) -> None:
    (received / "problem.toml").unlink()
    (received / "problem.toml").symlink_to(received.parent / "secret.csv")
    refused(monkeypatch, capsys, "inspect", str(received))


def test_published_tables_do_not_tell_what_is_elsewhere(monkeypatch, capsys, received) -> None:
    with (received / "problem.toml").open("a") as stream:
        stream.write('\n[published."../secret.csv"]\nRPIM = 0.4\n')
    assert "table published" in refused(monkeypatch, capsys, "inspect", str(received))


def test_results_and_reports_stay_in_the_folder_that_is_named(monkeypatch, capsys, received) -> None:
    (received / "result.json").symlink_to(received.parent / "secret.csv")
    refused(monkeypatch, capsys, "calibrate", "paper_arm", "--out", str(received))
    (received / "result.json").unlink()
    assert run(monkeypatch, "calibrate", "paper_arm", "--out", str(received)) == 0
    capsys.readouterr()
    (received / "report.html").symlink_to(received.parent / "secret.csv")
    refused(monkeypatch, capsys, "report", str(received))
    assert (received.parent / "secret.csv").read_text() == SECRET


def test_names_in_a_subfolder_are_fine(monkeypatch, capsys, received) -> None:
    (received / "tables").mkdir()
    (received / "identification.csv").rename(received / "tables" / "june.csv")
    edit(received / "problem.toml", 'identification = "identification.csv"', 'identification = "tables/june.csv"')
    assert run(monkeypatch, "inspect", str(received)) == 0
    assert run(monkeypatch, "simulate", str(received)) == 0


@pytest.mark.parametrize("seed", ["-1", "99999999999999999999x"])
def test_seeds_that_are_none(monkeypatch, capsys, received, seed) -> None:
    before = everything(received)
    assert run(monkeypatch, "simulate", str(received), "--seed", seed) == 2
    assert "--seed" in capsys.readouterr().err
    assert everything(received) == before
