"""The report: what it says, that nothing a user wrote becomes markup, and, in a browser, that it works."""

from __future__ import annotations

import re
from base64 import b64decode
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration.acceptance import inconclusive, measured_workspace
from rpim_opt.report import report
from rpim_opt.report.report import page
from rpim_opt.report.summary import headline
from tests.browser import NAMES, PROGRAM, Browser, browser
from tests.simulate import simulated
from tests.test_cli import run

EVIL = ["</script><script>alert(1)</script>", "\"'><img src=x onerror=alert(1)>", "<!--", "]]>", "&lt;b&gt;", "{{7*7}}",
        r"$\frac$c0"]  # fmt: skip


class Reader(HTMLParser):
    """Collects elements with their attributes, and the text outside scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words, self.scripts, self.open = "", [], ""
        self.feed(text)

    def handle_starttag(self, tag, attrs) -> None:
        self.elements.append((tag, dict(attrs)))
        self.open = tag
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag) -> None:
        self.open = ""

    def handle_data(self, data) -> None:
        if self.open == "script":
            self.scripts[-1] += data
        elif self.open != "style":
            self.words += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]

    def charts(self) -> list[str]:
        """Return the SVG of all charts."""
        return [b64decode(str(image["src"]).partition(",")[2]).decode() for image in self.all("img")]


@cache
def result_of(name: str) -> ro.calibration.Calibration:
    instance = ro.load(name)
    result = ro.calibrate(instance.problem, instance.formulation, instance.weight)
    return replace(result, record=replace(instance.record, made="2026-01-02"))


@pytest.fixture(scope="module")
def arm() -> ro.calibration.Calibration:
    return result_of("paper_arm")


@pytest.fixture(scope="module")
def arm_page(arm) -> str:
    return page(arm)


@pytest.fixture(scope="module")
def evil() -> str:
    """The report of a calibration in which every text of a user's is an attempt at markup."""
    problem, _ = simulated(noise=5e-5)
    y = problem.data.blocks[0].y.copy()
    y[:6] += 0.01
    label = (*EVIL, *map(str, range(40 - len(EVIL))))
    data = ro.Dataset.of(problem.data.q, y, 5e-5, label)
    robot = ro.robot.Robot(EVIL[0], problem.robot.mdh, source=EVIL[1])
    result = ro.calibrate(ro.CalibrationProblem(robot, problem.parameters, data), ro.robust, 1.0)
    result = replace(result, formulation=replace(result.formulation, name=EVIL[0]), message=EVIL[1])
    record = ro.data.Record(
        EVIL[0], EVIL[1], data, {EVIL[0]: EVIL[1]}, {EVIL[1]: EVIL[2]}, made=EVIL[0], versions={EVIL[3]: EVIL[4]}
    )
    return page(replace(result, record=record))


def test_the_report_says_the_figures_of_the_result(arm, arm_page) -> None:
    text = " ".join(Reader(arm_page).words.split())
    assert (
        "On 16 validation measurements, not used for identification, "
        "the mean position error falls from 2.649 mm to 0.032 mm" in text
    )
    assert "Unidentifiable: theta6." in text
    assert "T8-6" in text  # left out, with its reason
    assert "validation, position160.03 mm (x, y, z)" in text  # cells: 16 rows, of one covariance
    assert re.search(r"Held-out rows: \d+ % of the coordinates are within", text)
    for digest in arm.record.files.values():
        assert digest in text
    for row in arm.parameter_rows():
        assert f"{row['parameter']} [{row['unit']}]" in text
        assert f"{row['identified']:.4f}" in text
    assert "loss sum_squares of each equation, penalty sum_squares, constraints: none" in text


def test_fewer_equations_than_parameters_stand_in_the_headline() -> None:
    """A fit to them says nothing of other configurations, and its errors of these look like a success."""
    problem = ro.load("position").problem
    few = ro.calibrate(problem.on(problem.data.take(np.arange(10))))
    assert "(no validation data; 30 equations for 34 parameters)" in headline(few)
    assert "equations" not in headline(ro.calibrate(problem))


def test_sections_stand_in_the_order_of_who_signs(arm_page) -> None:
    names = ["Accuracy and uncertainty", "Parameters", "Diagnostics", "Provenance", "Appendix: regularization"]
    page = Reader(arm_page).words
    places = [page.rindex(f"\n{name}\n") if f"\n{name}\n" in page else page.rindex(name) for name in names]
    assert places == sorted(places)


def test_parameters_state_their_flange_frame_and_units_as_they_are_written() -> None:
    own = ("theta[2-6]", "compliance[23]", "moment2_*", "tool_[xyz]")
    problem, _ = simulated(own, 30, 5e-5, 2)
    result = ro.calibrate(problem, ro.tikhonov, 1.0)
    words = Reader(page(result)).words
    assert "compliance2 [mrad/(N m)]" in words
    bends = [i for i, name in enumerate(result.problem.parameters.free.names) if name.startswith("moment2")]
    rows = [result.parameter_rows()[i] for i in bends]
    assert {row["unit"] for row in rows} == {"mrad"}
    assert np.allclose([row["deviation"] for row in rows], 1e3 * result.x[bends])
    assert f"{rows[0]['parameter']} [mrad]" in words
    assert "mrad_per_Nm" not in words
    U = re.search(r"compliance2 \[mrad/\(N m\)\][^±]*±0\.0*(\d+)", words)
    assert U is not None
    assert len(U[1]) >= 2  # digits of it, where four decimals had none
    assert words.count("alpha and a in the last row of a DH sheet follow it") == 1


def test_one_file_that_loads_nothing(arm_page) -> None:
    assert len(arm_page) < 1_500_000
    read = Reader(arm_page)
    for _, attributes in read.elements:
        assert not {"srcset", "style", "onclick", "onload"} & set(attributes)
        assert str(attributes.get("src", "data:")).startswith("data:")
        assert not str(attributes.get("href", "#")).startswith("http")
    assert not read.all("link")
    assert "url(" not in arm_page
    assert "@import" not in arm_page
    (policy,) = [m["content"] for m in read.all("meta") if m.get("http-equiv") == "Content-Security-Policy"]
    assert re.fullmatch(r"default-src 'none'; img-src data:; style-src 'sha256-\S+'", str(policy))


def test_headings_descend_and_figures_have_words(arm_page) -> None:
    read = Reader(arm_page)
    levels = [int(name[1]) for name, _ in read.elements if re.fullmatch("h[1-6]", name)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(b <= a + 1 for a, b in pairwise(levels))
    assert read.all("img")
    assert all(image.get("alt") for image in read.all("img"))
    assert read.all("html")[0]["lang"] == "en"
    names = {heading["id"] for heading in read.all("h2")}
    assert {section["aria-labelledby"] for section in read.all("section")} == names


def test_every_text_of_a_user_stays_text(evil) -> None:
    """Neither markup nor what Matplotlib reads between dollars."""
    read = Reader(evil)
    assert not read.scripts
    assert all(set(image) == {"src", "alt"} for image in read.all("img"))
    assert not read.all("b")
    for label in EVIL:
        assert label in read.words


@pytest.mark.usefixtures("undrawn")
def test_a_report_says_what_a_reader_must_know() -> None:
    stopped = ro.load("position")
    result = ro.calibrate(stopped.problem, ro.tikhonov, 1.0, max_iterations=1)
    text = page(result)
    assert "Not delivered: do not use this robot before the points below are resolved." in text
    assert "40 validation rows repeat" in page(replace(result, record=ro.data.Record(validation=result.problem.data)))
    assert "(no validation data)" in text
    assert "Without validation data" in text


@pytest.mark.parametrize("formulation", [ro.least_squares, ro.minimax], ids=lambda f: f.name)
def test_other_formulations_have_a_report(formulation) -> None:
    problem, _ = simulated(("a?", "theta?", "base_*"), noise=5e-5)
    weight = 0.0 if formulation is ro.least_squares else 1.0
    text = page(ro.calibrate(problem, formulation, weight))
    assert ("No uncertainties or prediction intervals" in text) == (formulation is not ro.least_squares)
    assert ("L-curve: residual norm" in text) == (formulation is not ro.least_squares)


def test_a_stated_prior_is_named_and_not_its_matrices() -> None:
    problem, _ = simulated(("a?", "theta?", "base_*"), noise=5e-5)
    stated = ro.bayes.Prior.known("a2 + a3 = nominal +- 0.01 mm").stated(problem.parameters)
    text = page(ro.calibrate(problem, stated.penalized(ro.tikhonov), 1.0))
    assert "penalty sum_squares, with the stated prior, constraints: none" in text
    assert "0.0, 0.0" not in text


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("cable", "joints", "markers", "scara", "seven_axis")]


@pytest.mark.parametrize("name", ["distance", "mixed", "plane", "pose", "rank_deficient", *SLOW])
def test_every_measurement_has_a_report(name: str) -> None:
    read = Reader(page(result_of(name)))
    curves = [path["d"] for chart in read.charts() for path in Reader(chart).all("path")]
    assert curves
    assert not any("nan" in str(d) or "inf" in str(d) for d in curves)
    assert ("Orientation error" in read.words) == (name == "pose")


def test_a_result_of_a_lost_formulation_has_a_report(tmp_path: Path) -> None:
    problem, _ = simulated(noise=5e-5)
    mine = ro.Formulation("mine", penalty=ro.tikhonov.penalty, constraints=(lambda z, p: z[0] <= 9,))
    ro.store.save_result(ro.calibrate(problem, mine, 1.0), tmp_path / "result.json")
    text = page(ro.load_result(tmp_path))
    assert "cannot store functions of a script" in text
    assert "a function of a script, not stored in the file" in text
    assert "Certificate at the solution" in text


def test_the_command(monkeypatch, capsys, arm, arm_page, tmp_path: Path) -> None:
    """A loaded result has the same page, to the last character, but for the digest of its file."""
    ro.store.save_result(arm, tmp_path / "result.json")
    assert run(monkeypatch, "report", str(tmp_path / "result.json"), "--out", str(tmp_path / "b" / "r.html")) == 0
    digest = ro.load_result(tmp_path / "result.json").record.digest
    made = (tmp_path / "b" / "r.html").read_text(encoding="utf-8")
    assert made.replace(f"<div><dt>Digest of the result</dt><dd>{digest}</dd></div>", "") == arm_page
    capsys.readouterr()
    assert run(monkeypatch, "report", str(tmp_path / "nothing.json")) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert "nothing.json, the file: found nothing, accepted: result.json" in said.err
    (tmp_path / "file").write_text("")
    assert run(monkeypatch, "report", str(tmp_path), "--out", str(tmp_path / "file" / "r.html")) == 2
    assert "cannot be written" in capsys.readouterr().err


# --- in a browser ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    if PROGRAM is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is installed")
    with browser() as one:
        yield one


@pytest.fixture
def opened(chromium: Browser, arm_page, tmp_path: Path) -> Browser:
    path = tmp_path / "report.html"
    path.write_text(arm_page, encoding="utf-8")
    chromium.open(path)
    return chromium


def test_nothing_is_fetched_and_nothing_complains(opened: Browser) -> None:
    assert opened.complaints() == []
    assert {url.split(":")[0] for url in opened.requests()} == {"file", "data"}
    widths = opened.run("[...document.querySelectorAll('img')].map(image => image.naturalWidth)")
    assert len(widths) >= 4  # charts that the browser could draw
    assert all(width > 0 for width in widths)


@pytest.mark.parametrize("dark", [False, True])
def test_narrow_windows_and_dark_ones(chromium: Browser, evil: str, tmp_path: Path, dark: bool) -> None:
    path = tmp_path / "report.html"
    path.write_text(evil, encoding="utf-8")
    chromium.open(path, width=400, dark=dark)
    assert chromium.complaints() == []
    assert {url.split(":")[0] for url in chromium.requests()} == {"file", "data"}
    assert chromium.run("document.documentElement.scrollWidth") <= 400
    paper, ink = chromium.run("(s => [s.backgroundColor, s.color])(getComputedStyle(document.body))")
    lightness = [sum(map(int, re.findall(r"\d+", color)[:3])) for color in (paper, ink)]
    assert (lightness[0] < lightness[1]) == dark


def test_it_prints(opened: Browser, tmp_path: Path) -> None:
    opened.print(tmp_path / "report.pdf")
    pages = (tmp_path / "report.pdf").read_bytes().count(b"/Type /Page\n")
    assert 3 <= pages <= 12


@pytest.mark.usefixtures("undrawn")
def test_many_flagged_rows_are_not_all_named(monkeypatch) -> None:
    blunders = ro.load("blunders")
    result = replace(ro.calibrate(blunders.problem, ro.robust, weight=1.0), record=blunders.record)
    monkeypatch.setattr(report, "MOST_FLAGGED", 2)
    text = page(result)
    assert "and 3 more" in text
    assert "The measurements are simulated." in text
    assert "Outliers: c" in text
    assert "huber(2.0) of each configuration" in text
    named = [flag.label for flag in result.flagged]
    assert f">{named[1]}<" in text


def required(result: ro.calibration.Calibration, limit: float) -> ro.calibration.Calibration:
    record = replace(result.record, requirement=ro.data.Requirement(limit), details={"by": "A. <b>Person</b>"})
    return replace(result, record=record)


@pytest.mark.parametrize(("limit", "verdict"), [(1e-3, "Accepted"), (7e-5, "Inconclusive")])
def test_the_verdict_is_the_first_thing_on_the_page(limit: float, verdict: str) -> None:
    read = Reader(page(required(result_of("position"), limit)))
    words = " ".join(read.words.split())
    said = "limit 0.07 mm with 95 % confidence at every configuration of the region. Missing: more measurements. U is"
    if verdict == "Accepted":
        said = "expanded uncertainty of the position that the reflector reaches (U, 95 %) at most"
    assert 0 <= words.index(f"{verdict}: {said}") < words.index("Mean error, nominal")
    assert words.count("Missing: more measurements.") == (verdict != "Accepted")
    assert "A. <b>Person</b>" in words
    assert not read.all("b")
    assert re.search(r"The maximum U is at joints (-?[\d.]+ deg, ){5}-?[\d.]+ deg\.", words)
    assert ("[mm], above the limit in red" in "".join(read.charts())) == (verdict != "Accepted")


@pytest.mark.usefixtures("undrawn")
def test_new_measurements_verify_a_result_and_are_held_against_its_limit() -> None:
    result, later = ro.calibrate(ro.load("position").problem), ro.load("position").validation
    assert "Without validation data" in page(result)
    new = {"later.csv": ro.use.validate(result, later)}
    assert "Without validation data" not in page(result, new)
    text = " ".join(Reader(page(required(result, 1e-3), new)).words.split())
    assert "Accepted" in text[: text.index("Validation on new measurements")]  # though no rows were held out
    assert "Acceptance test by later.csv" in text
    lead = f"On {len(later)} new measurements, not used for identification, the mean position error falls from"
    assert lead in text
    errors = new["later.csv"].error
    assert re.search(rf"Maximum error, identified\s*{1e3 * errors.max():.3f} mm\s*of {len(later)} rows", text)
    assert f"New measurements: {len(later)} rows" in text[: text.index("Error [mm]")]
    off = replace(later, blocks=tuple(replace(block, y=block.y + 5e-3) for block in later.blocks))
    new["off.csv"] = ro.use.validate(result, off)
    text = " ".join(Reader(page(required(result, 1e-3), new)).words.split())
    assert "Accepted" not in text[: text.index("Validation on new measurements")]
    assert "Acceptance test by off.csv" in text
    assert "New measurements: 40 rows" in text


def test_a_robot_is_delivered_where_nothing_is_demanded(arm_page) -> None:
    read = Reader(arm_page)
    assert "Delivered: the fit gives no reason" in " ".join(read.words.split()).replace(" :", ":")
    assert "Expanded uncertainty in the workspace" in read.words
    assert "Uncertainty budget of the position reached" in read.words
    assert "repeatability of the robot" in read.words


@pytest.mark.usefixtures("undrawn")
def test_both_figures_are_said_where_all_rows_were_used() -> None:
    result = ro.calibration.refit_all(result_of("position"))
    words = " ".join(Reader(page(result)).words.split())
    assert "On 40 measurements that were held out the mean position error falls from" in words
    assert "with parameters from 40 rows; the delivered parameters are from all 80." in words
    assert "held out, from 40 rows, identified" in words


@pytest.mark.usefixtures("undrawn")
def test_orientation_errors_of_held_out_poses_are_shown() -> None:
    result = ro.calibration.refit_all(result_of("pose"))
    words = re.sub("<[^>]+>", " ", page(result)).partition("Orientation error [mrad]")[2].split()
    figures = words[words.index("identified", words.index("held")) :][1:6]  # rows, mean, RMS, 95th percentile, max
    assert figures[0] == "40"
    assert float(figures[-1]) == pytest.approx(1e3 * result.record.held_out.angle.max(), abs=1e-4)


@pytest.mark.slow
def test_only_tolerances_that_were_kept_are_shown() -> None:
    instance = ro.load("constrained", "wrong_tolerance")
    assert np.isfinite(instance.problem.parameters.free.tolerance).any()
    kept = ro.calibrate(instance.problem, ro.bounded, 1.0)
    loose = ro.calibrate(instance.problem, ro.tikhonov, 1.0)
    assert "tolerance" in Reader(page(kept)).words
    words = Reader(page(loose)).words
    said = "Deviations beyond the tolerance ([tolerance]): a5. Only formulation 'bounded' enforces tolerances."
    assert said in words
    assert "tolerance" not in words.replace(said, "")  # no column of them


@pytest.mark.usefixtures("undrawn")
def test_a_robot_less_certain_than_the_nominal_one_errs_is_not_called_delivered() -> None:
    problem = ro.load("position").problem
    first = ro.calibrate(problem.on(problem.data.take(np.arange(32))))
    found = ro.use.update(first, problem.data.take(np.arange(32, 40)), reset=["*"])  # 8 readings, 33 parameters
    text = Reader(page(found.result)).words
    assert "Inconclusive" in text
    assert "is above the error of the nominal robot" in text
    assert "Delivered" not in text
    assert inconclusive(first, measured_workspace(first)) == ""


@pytest.mark.parametrize(("repeats", "said"), [(1, "more than industrial robots of this size"), (2, "")])
def test_readings_that_scatter_as_no_industrial_robot_does_are_inconclusive(repeats: int, said: str) -> None:
    """As of a loose reflector; repeated ones show that the robot is so."""
    problem = ro.load("position").problem
    q, y = (np.repeat(values, repeats, axis=0) for values in (problem.data.q, problem.data.blocks[0].y))
    loose = y + 4e-4 * np.random.default_rng(3).normal(size=y.shape)
    result = ro.calibrate(problem.on(ro.Dataset.of(q, loose, 5e-5)))
    assert result.verdict.delivered
    assert said in result.verdict.caution
    assert bool(inconclusive(result, measured_workspace(result))) == bool(said)


@pytest.mark.usefixtures("undrawn")
def test_outliers_that_were_excluded_automatically_are_in_the_table(tmp_path) -> None:
    result = ro.calibrate(ro.load("blunders").problem)
    assert result.learned.left_out
    ro.report.write_report(result, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count("excluded outlier, ") == len(result.learned.left_out)
    first = Reader(page).words.partition("Accuracy and uncertainty")[0]  # who signs reads the first page
    assert f"Excluded outliers: {len(result.learned.left_out)} rows, " in first
    assert all(row.label in first for row in result.learned.left_out)
    assert "No row is flagged or excluded" not in page
