"""Every snippet of the README and of the guides runs, and prints what they say it prints."""

from __future__ import annotations

import contextlib
import io
import json
import re
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.problem import blocks as parts
from rpim_opt.robot import kinematics
from rpim_opt.study import studies
from studies.gallery import pages
from tests import ROOT
from tests.test_cli import run
from tests.test_commands import write_cell

mpl.use("Agg")
from matplotlib import image, pyplot

PAGES = {path.stem: path.read_text(encoding="utf-8") for path in pages.pages()}
README = PAGES["README"]
PEERS = PAGES["projects"]
STUDIES = (ROOT / "studies" / "README.md").read_text(encoding="utf-8")
BLOCKS = [(page, snippet) for page, text in PAGES.items() for snippet in pages.snippets(text)]
PYTHON = [(page, program) for page, text in PAGES.items() for program in pages.programs(text)]
SLIGHT = 0.01
"""Mean difference of two pictures' values, from 0 to 1: other last digits move a line by less, other data by more."""


def test_there_are_snippets() -> None:
    assert {page for page, *_ in PYTHON} >= {"README", "formulations", "weights", "results"}
    lines = [line for _, snippet in BLOCKS if snippet.language == "sh" for line in snippet.code.splitlines()]
    assert any(line.startswith("python3 dev.py run calibrate") for line in lines)
    assert "python3 dev.py test" in lines


@pytest.mark.parametrize(("page", "program"), PYTHON, ids=lambda value: getattr(value, "code", str(value))[:60])
def test_python(page: str, program: list[pages.Snippet], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It prints all of what its page shows and nothing else, and draws the page's pictures."""
    monkeypatch.chdir(tmp_path)
    if any("export.csv" in each.code or "arm.urdf" in each.code for each in program):
        pages.readers_files(tmp_path, write_cell)
    space: dict[str, Any] = {}
    for snippet in program:
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            exec(compile(snippet.code, page, "exec"), space)
        assert pages.alike(out.getvalue(), snippet.printed), out.getvalue()
        for name in set(snippet.saved) & set(pages.shown(PAGES[page])):
            assert difference(Path(name), pages.PICTURES / name) < SLIGHT
    pyplot.close("all")


def test_an_output_that_is_cut_or_of_other_numbers_is_found_out() -> None:
    said = "mean 0.024 mm, k = 1.98 after 2 steps"
    assert pages.alike("mean  0.025 mm, k = 1.98\nafter 2 steps", said)
    for printed in (f"{said} more", said[:-6], said.replace("0.024", "0.034"), said.replace("mm", "m")):
        assert not pages.alike(printed, said)


def difference(one: Path, other: Path) -> float:
    """Return the mean difference of two pictures, of which those of another size have nothing in common."""
    values = [image.imread(path) for path in (one, other)]
    if values[0].shape != values[1].shape:
        return 1.0
    return float(np.abs(values[0] - values[1]).mean())


def test_every_picture_is_made_by_the_code_of_its_page() -> None:
    """`python3 dev.py pages` makes all of them."""
    made = {name for page, snippet in BLOCKS for name in set(snippet.saved) & set(pages.shown(PAGES[page]))}
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


SHELL: dict[str, list[pages.Snippet]] = {}
for _page, _snippet in BLOCKS:
    if _snippet.language == "sh" and pages.commands(_snippet):
        SHELL.setdefault(_page, []).append(_snippet)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("page", SHELL)
def test_commands(page: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The commands of a page, one after the other in one folder, print all of what it shows."""
    pages.readers_files(tmp_path, write_cell)
    monkeypatch.chdir(tmp_path)
    for snippet in SHELL[page]:
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            for words in pages.commands(snippet):
                assert run(monkeypatch, *words) == 0
        assert not snippet.printed or pages.alike(out.getvalue(), snippet.printed), out.getvalue()


def rows_of(study: str) -> list[dict[str, Any]]:
    """Return the replicates of a study's result."""
    from pyarrow import parquet

    return parquet.read_table(ROOT / "studies" / "results" / study / "replicates.parquet").to_pylist()


def test_the_main_table_is_the_studys() -> None:
    peers = studies.load_study(studies.find_study("peers"))
    rows = peers.by_method(rows_of("peers"))
    table = PEERS.split("## Beside other tools")[1].replace("**", "")
    head = next(line for line in table.splitlines() if line.startswith("| RMS error"))
    counts = [int(count) for count in re.findall(r"\| (\d+)", head)]
    assert counts == [count for count, _ in peers.SITUATIONS.values()]
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


OURS = "rpim_opt, command"
STRUCTURAL = "figaroh, structural"
MAP = "figaroh, map"
AS_WELL = 0.03
"""How far geometric means of errors may be apart, relative to each other, where a text says that both do as well."""


def errors_of_peers(situation: str) -> dict[str, Array]:
    """Return RMS errors of the same arms [mm] for every method, infinite where it failed."""
    peers = studies.load_study(studies.find_study("peers"))
    rows = sorted(peers.by_method(rows_of("peers")), key=lambda row: row["seed"])
    found: dict[str, list[float]] = {}
    for row in rows:
        if row["situation"] == situation:
            error = row["rms_mm"]
            found.setdefault(row["method"], []).append(np.inf if error is None else error)
    return {method: np.array(errors) for method, errors in found.items()}


def times(one: Array, other: Array) -> float:
    """Return the geometric mean of the errors' ratios."""
    return float(np.exp(np.mean(np.log(one / other))))


def complete(errors: dict[str, Array]) -> set[str]:
    """Return the complete models of others that are fitted by coordinates: pybotics has no parallel axes' angle."""
    return {method for method in errors if not method.startswith(("pybotics", "rpim_opt"))}


def test_the_accuracy_table_of_the_readme_is_the_studys() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    methods = {"least squares (SciPy)": "scipy, lm", "`rpim-opt calibrate`": OURS}
    situations = ("clean10", "clean25", "clean52", "blunders52", "physics52")
    errors = [errors_of_peers(situation) for situation in situations]
    assert f"{len(errors[0][OURS])} simulated arms" in text
    for name, method in methods.items():
        figures = " | ".join(f"{np.exp(np.mean(np.log(each[method]))):.3f}" for each in errors)
        assert f"| {name} | {figures} |" in text


def test_where_others_do_as_well_is_the_studys() -> None:
    said = (
        "From 15 configurations on, where nothing is wrong with data or arm, every complete model fitted by coordinates"
    )
    assert f"{said} does as well (figaroh's `structural` from 52 on)" in PEERS
    for situation in ("clean15", "clean25"):
        errors = errors_of_peers(situation)
        well = {method for method in complete(errors) if abs(times(errors[method], errors[OURS]) - 1) < AS_WELL}
        assert {"robotkinecal, documented", MAP, "scipy, lm"} <= well
        assert complete(errors) - well == {STRUCTURAL}
    errors = errors_of_peers("clean10")
    assert abs(times(errors[MAP], errors[OURS]) - 1) < AS_WELL
    assert "figaroh's priors, given the noise, do as well with ten" in PEERS
    told = studies.load_study(studies.find_study("peers")).METHODS
    assert "noise" in told[MAP]
    assert "noise" not in told[OURS]


def test_by_how_much_others_are_better_is_the_studys() -> None:
    better = []
    for situation in ("clean52", "clean200"):
        errors = errors_of_peers(situation)
        for method in complete(errors):
            better.append(100 * (1 - times(errors[method], errors[OURS])))
            of_arms = 1 - errors[method] / errors[OURS]
            (most,) = of_arms[of_arms > 0.2]  # on one arm
            assert round(1 / most) == 3  # by a third
            assert f"on one arm of {len(of_arms)} by a third" in PEERS
    assert f"with 52 or more even {min(better):.0f} to {max(better):.0f} % better than the command" in PEERS


def test_where_the_difference_is_is_the_studys() -> None:
    """Few data, gross errors and sag, with the figures that the list of studies has of them."""
    assert "The difference is few data, gross errors and sag." in PEERS
    few, some, clean, blunders, sag = map(errors_of_peers, ("clean10", "clean25", "clean52", "blunders52", "physics52"))
    least_squares = times(few["scipy, lm"], few[OURS])
    assert least_squares > 1.2
    said = "our command and figaroh's priors with the noise stated are equally good ({} and {} mm)"
    assert said.format(*(f"{times(few[method], np.ones(1)):.3f}" for method in (OURS, MAP))) in STUDIES
    assert f"least squares has {least_squares:.2f} times our error" in STUDIES
    assert f"figaroh's `structural` ({times(some[STRUCTURAL], some[OURS]):.2f} times our error)" in STUDIES
    better = 100 * (1 - times(clean["scipy, lm"], clean[OURS]))
    assert f"plain least squares is {better:.0f} % better than our command" in STUDIES
    cost = [
        100 * (times(blunders[method], clean[before]) - 1)
        for method, before in ((OURS, OURS), ("figaroh, map, threshold", MAP))
    ]
    said = "Three blunders cost our command {:.0f} %, and figaroh {:.0f} % with a threshold set by hand"
    assert said.format(*cost) in STUDIES
    others = [times(errors, np.ones(1)) for method, errors in sag.items() if method != OURS]
    ours = times(sag[OURS], np.ones(1))
    assert min(others) > 2 * ours
    assert times(blunders["scipy, lm"], blunders[OURS]) > 2
    assert f"{ours:.3f} mm against {min(others):.3f} or more without gravity" in STUDIES


def test_figures_of_benchmarks_in_texts_are_the_studys() -> None:
    metrics = json.loads((ROOT / "studies" / "results" / "benchmarks" / "metrics.json").read_text())
    assert f"{1 / metrics['over SciPy']:.2g} times as fast as SciPy" in STUDIES
    over = [value for name, value in metrics.items() if name.endswith("over ours")]
    assert len(over) == 5
    said = " to ".join(f"{float(f'{end(over):.1g}'):.0f}" for end in (min, max))
    assert f"{said} times as fast as the peers" in STUDIES
    rows = rows_of("benchmarks")
    by_count = {row["count"]: row for row in rows if row["part"] in ("rows", "cluster")}
    each = {count: 1e6 * row["seconds"] / row["passes"] / count for count, row in by_count.items()}
    million = 10**6
    assert f"A million configurations took {each[million]:.1f} us each and iteration" in STUDIES
    assert f"ten million on a Dask cluster of two processes {each[10 * million]:.1f} us" in STUDIES
    megabytes = {count: row["peak_mb"] for count, row in by_count.items()}
    assert "in the memory of a hundred thousand" in STUDIES
    assert megabytes[million] < 1.1 * megabytes[million // 10]
    said = f"took {each[million]:.1f} microseconds each and iteration, in {megabytes[million]:.0f} MB"
    assert f"A million configurations {said}" in PAGES["large_data"]


def test_figures_of_large_data_are_the_codes() -> None:
    assert f"From {parts.KEPT:,} equations on only the QR factor R" in PAGES["large_data"]
    assert f"Kinematics are evaluated on {kinematics.WIDTH} rows at once" in PAGES["large_data"]


AUTO = "learned, model auto"


def test_the_table_of_real_arms_is_the_studys() -> None:
    rows = rows_of("real_data")
    lines = re.findall(r"^\| (10|20|all) \| (.*) %? \|$", README, flags=re.MULTILINE)
    assert len(lines) == 3
    for count, cells in lines:
        own = [row for row in rows if str(row["count"] or "all") == count]
        stated = [cell.strip(" %") for cell in cells.split("|")]
        ours = np.array([row[AUTO] for row in own])
        for other, figure in zip(("least squares", "reml"), stated, strict=False):
            ratios = ours / [row[other] for row in own]
            assert f"{np.exp(np.mean(np.log(ratios))):.2f}" == figure, (count, other)
        assert f"{max(row[AUTO] / row['reml'] for row in own):.2f}" == stated[2]
        assert f"{100 * np.mean([row[f'{AUTO}, covers'] for row in own]):.0f}" == stated[3]


def over(rows: list[dict[str, Any]], one: str, other: str) -> str:
    """Return the geometric mean of the ratios of two columns as a text says it."""
    return f"{np.exp(np.mean([np.log(row[one] / row[other]) for row in rows])):.2f}"


def test_figures_of_real_arms_in_texts_are_the_studys() -> None:
    rows = rows_of("real_data")
    counts = (10, 20, None)
    geometry = [over([row for row in rows if (row["count"] or None) == count], "learned", "reml") for count in counts]
    said = "with geometry alone the ratios to REML are {} (10), {} (20) and {} (all)"
    assert said.format(*geometry) in README
    ten = [row for row in rows if row["count"] == 10]
    auto = [over(ten, AUTO, other) for other in ("least squares", "reml")]
    said = "with ten configurations the default has {} times the error of least squares and {} times that of REML"
    assert said.format(*auto) in PAGES["weights"]
    of_counts = [[row for row in rows if (row["count"] or None) == count] for count in (None, 20, 10)]
    squares, reml = ([over(own, AUTO, other) for own in of_counts] for other in ("least squares", "reml"))
    said = (
        "has {} times the error of least squares with all configurations, {} with twenty and {} with ten; {}, {} and {}"
    )
    assert f"{said.format(*squares, *reml)} of that of one weight by REML" in STUDIES
    assert f"Of the held-out readings {100 * np.mean([row[f'{AUTO}, covers'] for row in rows]):.0f} % are" in STUDIES
    others = [row[AUTO] / row["reml"] for row in rows if "cable" not in row["name"]]
    assert f"none exceeds {max(others):.2f}" in README


def test_figures_of_simulated_arms_in_texts_are_the_studys() -> None:
    rows = rows_of("noise_and_poses")
    unknown = [row for row in rows if row["truth"] == "unknown"]
    of_counts = {n: [row for row in unknown if row["count"] == n] for n in (8, 10, 15, 25, 52)}
    learned, reml = (
        {n: over(own, rule, "least_squares") for n, own in of_counts.items()} for rule in ("learned", "reml")
    )
    said = f"{learned[8]}, {learned[10]}, {learned[15]} and"
    of = "times the error of least squares with 8, 10, 15 and"
    assert f"{said} {learned[52]} {of} 52 configurations" in PAGES["weights"]
    assert f"(REML {reml[8]}, {reml[10]}, {reml[15]} and {reml[52]})" in PAGES["weights"]
    rest = f"(REML {reml[8]}, {reml[10]}, {reml[15]}, {reml[25]}), and {learned[52]} with 52"
    assert f"{said} {learned[25]} {of} 25 configurations {rest}" in STUDIES
    covers = [100 * np.mean([row["learned_covers"] for row in own]) for own in of_counts.values()]
    assert f"its intervals cover {min(covers):.0f} to {max(covers):.0f} % of readings" in STUDIES
    ten, eight = (
        {rule: max(row[rule] / row["least_squares"] for row in of_counts[n]) for rule in ("learned", "reml")}
        for n in (10, 8)
    )
    said = f"{ten['reml']:.0f} times that of least squares, that of the default {ten['learned']:.0f} times"
    assert f"{said}, and with eight configurations {eight['learned']:.0f} times" in PAGES["limitations"]
    said = f"{ten['learned']:.1f} times worse than least squares, {eight['learned']:.1f} times with eight"
    assert f"{said} (REML {ten['reml']:.0f} and {eight['reml']:.0f})" in STUDIES


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
    said = "the default has {:.2f} to {:.2f} times the least possible mean error, REML {:.2f} to {:.2f}"
    bounds = [end(few[rule]) for rule in ("learned", "reml") for end in (min, max)]
    assert said.format(*bounds) in PAGES["weights"]
    many = max(value for cell in cells if cell[1] >= 20 for value in found[cell].values())
    assert f"from twenty configurations on both have at most {many:.2f}" in PAGES["weights"]


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
        if "://" in name or name.startswith("reference/"):  # which the site makes
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
