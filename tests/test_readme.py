"""Every snippet of the README and of the guides runs, and prints what they say it prints."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

import rpim_opt as ro
from studies.gallery import pages
from tests import ROOT
from tests.test_cli import run
from tests.test_commands import write_cell

mpl.use("Agg")
from matplotlib import image, pyplot

PAGES = {path.stem: path.read_text(encoding="utf-8") for path in pages.pages()}
README = PAGES["README"]
BLOCKS = [(page, snippet) for page, text in PAGES.items() for snippet in pages.snippets(text)]
PYTHON = [(page, program) for page, text in PAGES.items() for program in pages.programs(text)]
SHELL = [(page, snippet.code.splitlines()) for page, snippet in BLOCKS if snippet.language == "sh"]
SLIGHT = 0.01
"""Mean difference of two pictures' values, from 0 to 1: other last digits move a line by less, other data by more."""


def test_there_are_snippets() -> None:
    assert {page for page, *_ in PYTHON} >= {"README", "formulations", "weights", "results"}
    lines = [line for _, block in SHELL for line in block]
    assert any(line.startswith("python3 dev.py run calibrate") for line in lines)
    assert "python3 dev.py test" in lines


@pytest.mark.parametrize(("page", "snippet"), PYTHON, ids=lambda value: getattr(value, "code", value)[:60])
def test_python(page: str, snippet: pages.Snippet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It prints what its page says, and draws the page's pictures."""
    monkeypatch.chdir(tmp_path)
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(snippet.code, page, "exec"), {})
    for line in snippet.printed.splitlines():
        assert line.strip() in out.getvalue()
    for name in set(snippet.saved) & set(pages.shown(PAGES[page])):
        assert difference(Path(name), pages.PICTURES / name) < SLIGHT
    pyplot.close("all")


def difference(one: Path, other: Path) -> float:
    """Return the mean difference of two pictures, of which those of another size have nothing in common."""
    values = [image.imread(path) for path in (one, other)]
    if values[0].shape != values[1].shape:
        return 1.0
    return float(np.abs(values[0] - values[1]).mean())


def test_every_picture_is_made_by_the_code_of_its_page() -> None:
    """`python3 dev.py pictures` makes all of them."""
    made = {name for page, snippet in PYTHON for name in set(snippet.saved) & set(pages.shown(PAGES[page]))}
    assert made == {name for text in PAGES.values() for name in pages.shown(text)}
    assert made == {path.name for path in pages.PICTURES.iterdir()}


def test_another_picture_is_found_out(tmp_path: Path) -> None:
    """The bound of `test_python` is far below what another robot's errors would differ by."""
    instance = ro.load("position")
    for weight in (1.0, 1e5):
        result = ro.calibrate(instance.problem, ro.tikhonov, weight)
        ro.plot.errors(result, instance.validation).figure.savefig(tmp_path / f"{weight:g}.png")
    pyplot.close("all")
    assert difference(tmp_path / "1.png", tmp_path / "100000.png") > SLIGHT


def runs(line: str) -> bool:
    return "rpim-opt" in line.split("#")[0] or "dev.py run" in line


RUNNING = {frozenset(filter(runs, block)): block for _, block in SHELL}
"""Blocks with the same commands run once."""


@pytest.mark.parametrize("block", [b for each, b in RUNNING.items() if each], ids=lambda block: block[0][:40])
def test_commands(block: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    write_cell(tmp_path)  # what the reader has: arm.urdf and measured.csv, and later new.csv and checks.csv
    header, *later = (tmp_path / "later.csv").read_text().splitlines(keepends=True)
    (tmp_path / "new.csv").write_text("".join([header, *later[:8]]))
    (tmp_path / "checks.csv").write_text("".join([header, *later[8:32]]))
    monkeypatch.chdir(tmp_path)
    for line in filter(runs, block):
        words = shlex.split(line.split("#")[0])
        words = words[3:] if words[0] == "python3" else words[1:]
        named = [w.removeprefix("problems/") for w in words]
        with contextlib.redirect_stdout(io.StringIO()):
            assert run(monkeypatch, *named) == 0


def test_the_main_table_is_the_studys() -> None:
    from pyarrow import parquet

    from rpim_opt.study import grid

    peers = grid.load_study(grid.find_study("peers"))
    path = ROOT / "studies" / "results" / "peers" / "replicates.parquet"
    rows = peers.by_method(parquet.read_table(path).to_pylist())
    table = README.split("## Beside other tools")[1].replace("**", "")
    lines = re.findall(r"^\| (\w+, \w.*?) \| (.*) \|$", table, flags=re.MULTILINE)
    assert len(lines) >= 8
    for method, cells in lines:
        for situation, figure in zip(peers.SITUATIONS, cells.split("|"), strict=True):
            own = [row for row in rows if (row["method"], row["situation"]) == (method, situation)]
            errors = [row["rms_mm"] for row in own if row["rms_mm"] is not None]
            said = "-"
            if len(errors) < len(own):
                said = f"failed {len(own) - len(errors)} of {len(own)}"
            elif own:
                assert len(own) == peers.SEEDS
                said = f"{np.exp(np.mean(np.log(errors))):.3f}"
            assert figure.strip() == said, (method, situation)


def test_the_table_of_real_arms_is_the_studys() -> None:
    from pyarrow import parquet

    path = ROOT / "studies" / "results" / "real_data" / "replicates.parquet"
    rows = parquet.read_table(path).to_pylist()
    lines = re.findall(r"^\| (10|20|all) \| (.*) %? \|$", README, flags=re.MULTILINE)
    assert len(lines) == 3
    for count, cells in lines:
        own = [row for row in rows if str(row["count"] or "all") == count]
        stated = [cell.strip(" %") for cell in cells.split("|")]
        ours = np.array([row["learned, model auto"] for row in own])
        for other, figure in zip(("least squares", "reml"), stated, strict=False):
            ratios = ours / [row[other] for row in own]
            assert f"{np.exp(np.mean(np.log(ratios))):.2f}" == figure, (count, other)
        assert f"{max(row['learned, model auto'] / row['reml'] for row in own):.2f}" == stated[2]
        assert f"{100 * np.mean([row['learned, model auto, covers'] for row in own]):.0f}" == stated[3]


def rows_of(study: str) -> list[dict[str, Any]]:
    """Return the replicates of a study's result."""
    from pyarrow import parquet

    return parquet.read_table(ROOT / "studies" / "results" / study / "replicates.parquet").to_pylist()


def over(rows: list[dict[str, Any]], one: str, other: str) -> str:
    """Return the geometric mean of the ratios of two columns as a text says it."""
    return f"{np.exp(np.mean([np.log(row[one] / row[other]) for row in rows])):.2f}"


def test_figures_of_real_arms_in_texts_are_the_studys() -> None:
    rows = rows_of("real_data")
    counts = (10, 20, None)
    geometry = [over([row for row in rows if (row["count"] or None) == count], "learned", "reml") for count in counts]
    said = "geometry alone has {} and {} of REML's error with 10 and 20 configurations, and {} with all"
    assert said.format(*geometry) in README
    ten = [row for row in rows if row["count"] == 10]
    auto = [over(ten, "learned, model auto", other) for other in ("least squares", "reml")]
    said = "{} times the error of least squares with ten configurations, and {} times that of REML"
    assert said.format(*auto) in PAGES["weights"]
    others = [row["learned, model auto"] / row["reml"] for row in rows if "cable" not in row["name"]]
    assert f"none is above {max(others):.2f}" in README


def test_figures_of_simulated_arms_in_texts_are_the_studys() -> None:
    rows = rows_of("noise_and_poses")
    unknown = [row for row in rows if row["truth"] == "unknown"]
    ratios = {
        rule: [over([row for row in unknown if row["count"] == n], rule, "least_squares") for n in (8, 10, 15, 52)]
        for rule in ("learned", "reml")
    }
    said = "{}, {}, {} and {} times the error of least squares with 8, 10, 15 and 52 configurations".format
    assert said(*ratios["learned"]) in PAGES["weights"]
    assert "(REML {}, {}, {} and {})".format(*ratios["reml"]) in PAGES["weights"]
    worst = max(row["learned"] / row["least_squares"] for row in unknown if row["count"] == 10)
    assert f"{worst:.0f} times worse" in PAGES["limitations"]


def test_figures_of_one_size_in_texts_are_the_studys() -> None:
    rows = [row for row in rows_of("noise_and_poses") if row["truth"] is None]
    cells = sorted({(row["noise_mm"], row["count"]) for row in rows})
    assert len(cells) == 24
    found = {
        cell: {
            rule: np.sqrt(np.mean([row[rule] for row in own]) / np.mean([row["bound"] for row in own]))  # of squares
            for rule in ("learned", "reml")
        }
        for cell in cells
        if (own := [row for row in rows if (row["noise_mm"], row["count"]) == cell])
    }
    few = {rule: [found[cell][rule] for cell in cells if cell[1] == 8] for rule in ("learned", "reml")}
    said = (
        "{:.2f} to {:.2f} times the error that is possible in the mean with eight configurations, REML {:.2f} to {:.2f}"
    )
    bounds = [end(few[rule]) for rule in ("learned", "reml") for end in (min, max)]
    assert said.format(*bounds) in PAGES["weights"]
    many = max(value for cell in cells if cell[1] >= 20 for value in found[cell].values())
    assert f"both have at most {many:.2f}" in PAGES["weights"]


def test_least_squares_with_many_clean_configurations_is_as_good_as_said() -> None:
    metrics = json.loads((ROOT / "studies" / "results" / "peers" / "metrics.json").read_text())
    better = 100 * (1 - 1 / metrics["clean52 over best peer"])
    assert f"{better:.0f} % better" in PAGES["limitations"]


LINKED = ["README.md", ".github/CONTRIBUTING.md", *(f"studies/gallery/{page}.md" for page in PAGES if page != "README")]


@pytest.mark.parametrize("page", [Path(name) for name in LINKED])
def test_every_link_leads_somewhere(page: Path) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)\s]+)\)", text)
    for target in targets:
        name, _, anchor = target.partition("#")
        if "://" in name:
            continue
        there = (ROOT / page.parent / name) if name else ROOT / page
        assert there.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.+)$", there.read_text(encoding="utf-8"), flags=re.MULTILINE)
            assert anchor in {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}, (
                target
            )


def test_every_name_that_texts_say_is_there() -> None:
    said = [*PAGES.values(), *(path.read_text(encoding="utf-8") for path in sorted((ROOT / "studies").glob("*.py")))]
    names = {name for text in said for name in re.findall(r"\bro\.(\w+(?:\.\w+)?)", text)}
    assert len(names) > 40
    for name in sorted(names):
        first, _, second = name.partition(".")
        value = getattr(ro, first)
        assert not second or hasattr(value, second), f"ro.{name}"
