"""The command line ``rpim-opt``. Commands import what they need when they run."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Timer
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rpim_opt.exceptions import NoSolutionFound, RpimError

if TYPE_CHECKING:
    from rpim_opt.calibration import Calibration
    from rpim_opt.dataset import Dataset
    from rpim_opt.instances import Instance

app = typer.Typer(
    add_completion=False, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False,
    help="Robot calibration by convex optimization.",
)  # fmt: skip


@app.callback()
def _commands() -> None:
    """Robot calibration by convex optimization."""


@app.command()
def calibrate(
    problem: Annotated[str, typer.Argument(help="A problem folder, or the name of one that comes with rpim-opt.")],
    variant: Annotated[str | None, typer.Option(help="A [variant.NAME] of the problem file.")] = None,
    select: Annotated[
        str | None, typer.Option(help="How to choose the weight: reml, l_curve, gcv, k_fold, ..., or a number.")
    ] = None,
    formulation: Annotated[
        str | None, typer.Option(help="Instead of the file's: tikhonov, robust, bounded, ...")
    ] = None,
    refit: Annotated[bool, typer.Option(help="Calibrate once more without the rows that it distrusts.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for result.json.")] = None,
) -> None:
    """Calibrate a problem: print the parameters and the errors before and after, write result.json.

    Exit codes: 0 converged, 1 not converged, 2 unusable input, 3 no solution found.
    """
    with _progress() as say:
        from rpim_opt.calibration import calibrate
        from rpim_opt.instances import load, parse_formulation, parse_weight

        say("reading the problem")
        instance = load(problem, variant)
        weight = instance.weight if select is None else parse_weight(select)
        say("choosing the weight")
        result = calibrate(
            instance.problem, instance.formulation if formulation is None else parse_formulation(formulation), weight,
            progress=lambda it: say(f"linearizing: objective {it.objective:.6g}, step {it.step:.1e}"),
        )  # fmt: skip
        result = replace(result, record=instance.record)
        if refit and result.flagged:
            say("calibrating without the distrusted rows")
            print("Refitted without " + ", ".join(flag.label for flag in result.flagged) + ".\n")  # noqa: T201
            result = result.without_flagged()
    print(f"{instance.title}\n{instance.source}\n")  # noqa: T201
    print(describe(instance, result))  # noqa: T201
    if out is not None:
        try:
            result.save(out / "result.json")
        except OSError as error:
            raise RpimError(f"{out / 'result.json'}: cannot be written: {error}.") from None
        print(f"\nWritten: {out / 'result.json'}")  # noqa: T201
    if not result.converged:
        raise typer.Exit(1)


@app.command()
def report(
    result: Annotated[Path, typer.Argument(help="result.json, or the folder it lies in.")],
    out: Annotated[Path | None, typer.Option(help="HTML file; report.html beside the result by default.")] = None,
) -> None:
    """Write a result as one HTML page that works offline, for whoever has to believe it."""
    with _progress() as say:
        from rpim_opt.report import write_report
        from rpim_opt.results import load_result

        say("reading the result")
        loaded = load_result(result)
        say("writing the report")
        out = out or (result if result.is_dir() else result.parent) / "report.html"
        try:
            write_report(loaded, out)
        except OSError as error:
            raise RpimError(f"{out}: cannot be written: {error}.") from None
    print(f"Written: {out}")  # noqa: T201


@app.command()
def inspect(
    problem: Annotated[str, typer.Argument(help="A problem folder, or the name of one that comes with rpim-opt.")],
    variant: Annotated[str | None, typer.Option(help="A [variant.NAME] of the problem file.")] = None,
) -> None:
    """Look at a problem before calibrating: ranges, coverage, repeated rows, likely mistakes, what is identifiable."""
    with _progress() as say:
        from rpim_opt.inspection import inspect
        from rpim_opt.instances import load

        say("reading the problem")
        instance = load(problem, variant)
        say("inspecting")
        found = inspect(instance.problem)
    print(f"{instance.title}\n{instance.source}\n")  # noqa: T201
    print(found)  # noqa: T201


@app.command()
def simulate(
    problem: Annotated[str, typer.Argument(help="A problem folder with a [simulation] table.")],
    seed: Annotated[int | None, typer.Option(help="Instead of the file's.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the tables; the problem's own by default.")] = None,
) -> None:
    """Make the tables of a simulated problem and the truth they come from."""
    from rpim_opt.simulation import write_simulation

    try:
        for path in write_simulation(problem, seed, out):
            print(f"Written: {path}")  # noqa: T201
    except OSError as error:
        raise RpimError(f"{out or problem}: cannot be written: {error}.") from None


@app.command()
def design(
    problem: Annotated[str, typer.Argument(help="A problem folder, or the name of one that comes with rpim-opt.")],
    count: Annotated[int, typer.Option(help="How many configurations to choose.")] = 30,
    criterion: Annotated[str, typer.Option(help="V (predicted positions), D, A or E.")] = "V",
    candidates: Annotated[int, typer.Option(help="How many random candidates within the joint limits.")] = 1000,
    table: Annotated[Path | None, typer.Option(help="A table of candidates instead: q1_deg, ...")] = None,
    seed: Annotated[int, typer.Option(help="Of the random candidates.")] = 0,
    out: Annotated[Path | None, typer.Option(help="CSV file for the chosen configurations.")] = None,
) -> None:
    """Choose the configurations to measure next, from candidates, by optimal design."""
    with _progress() as say:
        from rpim_opt.design import choose, joint_table, random_candidates, read_candidates
        from rpim_opt.files import write_text
        from rpim_opt.instances import load

        say("reading the problem")
        instance = load(problem)
        robot = instance.problem.robot
        q = random_candidates(robot, candidates, seed) if table is None else read_candidates(table, robot)
        found = choose(instance.problem, q, count, criterion, progress=say)
    text = joint_table(robot, q[found.chosen], found.chosen)
    print(found)  # noqa: T201
    if out is None:
        print(text, end="")  # noqa: T201
        return
    try:
        write_text(out, text)
    except OSError as error:
        raise RpimError(f"{out}: cannot be written: {error}.") from None
    print(f"Written: {out}")  # noqa: T201


@app.command()
def study(
    name: Annotated[str, typer.Argument(help="A file of the folder studies, without its ending.")],
    quick: Annotated[bool, typer.Option(help="The small version.")] = False,
    workers: Annotated[int, typer.Option(help="Processes on this machine.")] = 1,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler to compute on.")] = None,
    resume: Annotated[bool, typer.Option(help="Go on where an interrupted run was.")] = False,
    redraw: Annotated[bool, typer.Option(help="Only write the report anew, from the last run's replicates.")] = False,
    gate: Annotated[bool, typer.Option(help="Fail when a metric is worse than studies/baselines.json allows.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for the results.")] = None,
) -> None:
    """Run a study: replicates in parallel, with the time that is left; the results say what made them.

    Exit codes: 0 done, 1 a metric got worse, 2 unusable input.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from rpim_opt.study import regressions, run_study

    columns = (TextColumn(name), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name)
        report, folder = run_study(
            name, quick, workers, scheduler, resume, redraw, out,
            progress=lambda done, every: bar.update(task, completed=done, total=every),
        )  # fmt: skip
    print(report.text)  # noqa: T201
    print(f"\nWritten: {folder}")  # noqa: T201
    worse = regressions(name, quick, report.metrics) if gate else []
    for line in worse:
        print(f"Worse: {line}", file=sys.stderr)  # noqa: T201
    if worse:
        raise typer.Exit(1)


@app.command()
def robots() -> None:
    """List the ready robots that a problem file may name."""
    from rpim_opt.instances import find_robot
    from rpim_opt.instances import robots as names
    from rpim_opt.robot import read_robot
    from rpim_opt.text import table

    ready = {name: read_robot(find_robot(name)) for name in names()}
    print(table(["robot", "name", "joints"], [[k, r.name, str(r.dof)] for k, r in ready.items()]))  # noqa: T201


def describe(instance: Instance, result: Calibration) -> str:
    """Return the tables that a metrologist reads: parameters, errors, the weight and where it came from."""
    import numpy as np

    from rpim_opt.record import statistics
    from rpim_opt.text import table

    errors = []
    for name, data in _data(instance).items():
        published = instance.published.get(name, {})
        for kind, rows in _kinds(data).items():
            which = f"{name}, {kind}" if len(_kinds(instance.problem.data)) > 1 else name
            for method, each in (("nominal", result.nominal_errors(data)), ("identified", result.errors(data))):
                stats = statistics(each[rows])
                figures = [f"{stats[key]:.4f}" for key in ("mean_mm", "rms_mm", "max_mm")]
                errors.append([f"{which}, {method}", str(stats["count"]), *figures])
        if name == "identification" and result.flagged:
            distrusted = {flag.label for flag in result.flagged}
            stats = statistics(result.errors(data)[[label not in distrusted for label in data.label]])
            figures = [f"{stats[key]:.4f}" for key in ("mean_mm", "rms_mm", "max_mm")]
            errors.append(["identification, trusted rows", str(stats["count"]), *figures])
        errors += [[f"  printed: {method}", "", f"{mean:.3f}", "", ""] for method, mean in published.items()]
    fitted = result.problem.parameters.of_frames & result.problem.parameters.identified
    angles = [
        [
            name,
            str(int(np.isfinite(each).sum())),
            *(f"{1e3 * f(each[np.isfinite(each)]):.4f}" for f in (np.mean, _rms, np.max)),
        ]
        for name, data in _data(instance).items()
        if np.isfinite(each := result.errors(data, "angle")).any()
    ]
    model = result.program.model
    lines = [
        result.parameter_table(),
        "",
        table(["error [mm]", "rows", "mean", "RMS", "max"], errors),
        *([table(["orientation error [mrad]", "rows", "mean", "RMS", "max"], angles)] if angles else []),
        *(["Nominal: the drawing's robot, frames fitted."] if fitted.any() else []),
        "",
        result.weight_sentence(),
        f"{model.equations} equations, {len(result.x)} parameters, {model.rank} directions that the data see.",
        *result.remarks(),
    ]
    return "\n".join(lines)


def _data(instance: Instance) -> dict[str, Dataset]:
    sets = {"identification": instance.problem.data}
    return {**sets, "validation": instance.validation} if instance.validation else sets


def _kinds(data: Dataset) -> dict[str, list[int]]:
    """Return the rows of every kind of measurement."""
    kinds: dict[str, list[int]] = {}
    for block in data.blocks:
        kinds.setdefault(block.measurement.name, []).extend(block.row.tolist())
    return kinds


def _rms(values: Any) -> float:
    return float((values**2).mean() ** 0.5)


@contextmanager
def _progress() -> Iterator[Callable[[str], None]]:
    """Show what is going on, once it has taken a second, where a person is watching."""
    from rich.console import Console

    console = Console(stderr=True)
    status = console.status("starting")
    timer = Timer(1.0, status.start)
    timer.daemon = True
    if console.is_terminal:
        timer.start()
    try:
        yield lambda text: status.update(text)
    finally:
        timer.cancel()
        status.stop()


def main() -> None:
    """Run the command line; what a user can mend is one sentence, never a traceback."""
    try:
        app()
    except NoSolutionFound as error:
        print(error, file=sys.stderr)  # noqa: T201
        sys.exit(3)
    except RpimError as error:
        print(error, file=sys.stderr)  # noqa: T201
        sys.exit(2)
