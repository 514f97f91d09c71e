"""The command line ``rpim-opt``. Commands import what they need when they run.

Annotations are values here: typer reads each of them twice, and as texts they would be compiled as often.
"""

import atexit
import gc
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from rpim_opt import __version__
from rpim_opt.basics.exceptions import InputError, NoSolutionFound, RpimError
from rpim_opt.report.console import (
    arriving,
    asked_of,
    carried,
    corrected_files,
    fail,
    left_out_line,
    listed_numbers,
    listed_words,
    progress,
    require_positive,
    required,
    show,
    tool_frame,
    written_line,
    written_to,
)

if TYPE_CHECKING:
    from rpim_opt.calibration.result import Calibration
    from rpim_opt.store.instances import Instance

HELP = """Robot calibration by convex optimization.

From a table of measurements to a corrected robot: new, calibrate, export, report.

Exit codes: 0 done; 1 a limit or gate failed, a calibration did not converge, or a mistake is likely; 2 unusable input;
3 no solution found; 4 whether a limit is kept cannot be decided.
"""


class Commands(TyperGroup):
    """The commands with their first lines, which are wrapped and never cut."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands."""
        said = {name: self.commands[name].help or "" for name in self.list_commands(ctx)}
        with formatter.section("Commands"):
            formatter.write_dl([(name, text.partition("\n\n")[0]) for name, text in said.items()])


app = typer.Typer(cls=Commands, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False, help=HELP)
# click's, or typer's own copy, depending on typer's version
USAGE: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")
INTERRUPTED = 130
SPARED = {"OPENBLAS_NUM_THREADS": "1", "PYDANTIC_DISABLE_PLUGINS": "__all__"}
"""What libraries do as they are loaded, and no command uses: threads beside ours, a search for others' plugins."""
YOUNG = 200_000
"""Objects after which Python looks for garbage: loading makes half as many, and a calibration leaves a thousand."""
LONG = ("study", "compare")
"""Commands that run others' programs, and for long: they and Python are left as they are."""
ABORT: Any = (KeyboardInterrupt, typer.Abort)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"rpim-opt {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", help="Say the version and end.", is_eager=True, callback=_version)
    ] = False,
) -> None:
    """Take what stands before a command."""


Problem = Annotated[str, typer.Argument(help="A problem folder, or the name of one that comes with rpim-opt.")]
Variant = Annotated[str | None, typer.Option(help="A [variant.NAME] of the problem file.")]
Result = Annotated[Path, typer.Argument(help="result.json, or the folder it lies in.")]
Units = Annotated[str, typer.Option(help="Units of columns whose names carry none: deg,mm or rad,m.")]
Limit = Annotated[
    float | None,
    typer.Option(help="How far the robot may miss, for acceptance [mm]: exit code 1 if rejected, 4 if undecided."),
]
Box = Annotated[
    str | None, typer.Option(help="Where: x0,x1,y0,y1,z0,z1 [mm] in the base frame; else all that was measured.")
]
Marker = Annotated[str | None, typer.Option(help="Which reflector, where there are several.")]
Json = Annotated[
    bool, typer.Option("--json", help="One JSON document on stdout instead of text, errors as JSON on stderr.")
]


@app.command()
def new(
    folder: Annotated[Path, typer.Argument(help="The problem folder to make; none that is there already.")],
    robot: Annotated[
        str, typer.Option(help="A ready robot (rpim-opt robots), or a file .urdf, .xacro, .toml, .json, .csv.")
    ],
    data: Annotated[
        list[Path], typer.Option(help="Joint and measured values: text, Excel, Parquet; several are stacked or joined.")
    ],
    units: Units = "",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what the tables mean, and write nothing.")] = False,
    sheet: Annotated[str, typer.Option(help="Excel sheet, by name or number.")] = "",
    columns: Annotated[str, typer.Option(help="Names of the columns, where there is no header: label,q1_deg,...")] = "",
    key: Annotated[str, typer.Option(help="Column that joins several files, or row for the number of the row.")] = "",
    within: Annotated[
        float | None, typer.Option(help="Join files by the nearest time, so many seconds apart at most.")
    ] = None,
    quaternion: Annotated[str, typer.Option(help="Order of numbered components, wxyz or xyzw.")] = "",
    rotation: Annotated[str, typer.Option(help="vector, where rx, ry, rz are a rotation vector.")] = "",
    encoding: Annotated[str, typer.Option(help="Of text files, if not found: utf-8, cp1252, utf-16.")] = "",
    separator: Annotated[str, typer.Option(help="comma, semicolon, tab, bar, space.")] = "",
    decimal: Annotated[str, typer.Option(help="Decimal mark, a comma or a point.")] = "",
    measurement: Annotated[
        str | None,
        typer.Option(
            help="position, pose, cable, distance, plane, sphere, eye_in_hand, ...; guessed from the columns."
        ),
    ] = None,
    validation: Annotated[Path | None, typer.Option(help="A table to keep apart for validation.")] = None,
    hold_out: Annotated[
        float | None, typer.Option(help="Part of the configurations to keep apart instead, 0.25.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the configurations that are kept apart.")] = 0,
    urdf_base: Annotated[str | None, typer.Option(help="Link where the robot starts, if not the root.")] = None,
    urdf_tip: Annotated[str | None, typer.Option(help="Link where it ends, if there are several.")] = None,
    target: Annotated[
        str, typer.Option(help="What a camera sees: a table with point, x_mm, y_mm, or a grid such as 7x5,30mm.")
    ] = "",
    as_json: Json = False,
) -> None:
    """Make a problem folder from a table and a robot: every key with a comment, and what was guessed from what."""
    with progress():
        from rpim_opt.basics.writing import refused
        from rpim_opt.store.raw import understand_tables
        from rpim_opt.store.starting import new_problem

        asked = asked_of(
            units, sheet=sheet, columns=columns, key=key, quaternion=quaternion, rotation=rotation, encoding=encoding,
            separator=separator, decimal=decimal, within=within,
        )  # fmt: skip
        if dry_run:
            found = understand_tables(robot, data, measurement, asked, urdf_base, urdf_tip)
            show(found, found.content(), as_json)
            return
        with refused(folder):
            made = new_problem(
                folder, robot, data, measurement=measurement, asked=asked, validation=validation, hold_out=hold_out,
                seed=seed, urdf_base=urdf_base, urdf_tip=urdf_tip, target=target,
                understood=None if as_json else lambda found: show(f"{found}\n", {}, as_json),
            )  # fmt: skip
    document = {"written": [made.folder], "rows": made.rows, "notes": made.notes, **made.understood.content()}
    show(made, {**document, "notes": made.notes}, as_json)


@app.command()
def inspect(problem: Problem, variant: Variant = None, as_json: Json = False) -> None:
    """Look at a problem before calibrating: ranges, coverage, repeated rows, likely mistakes, what is identifiable."""
    with progress() as say:
        from rpim_opt.calibration.lack_of_fit import foreseen
        from rpim_opt.problem.inspection import inspect
        from rpim_opt.store.instances import load

        say("reading the problem")
        instance = load(problem, variant)
        say("inspecting")
        found = inspect(instance.problem, instance.validation)
        say("looking at what a quick fit leaves")
        lacking = foreseen(instance.problem)
    document = {"title": instance.title, "source": instance.source, **found.content(), "lack_of_fit": None}
    head = "\n".join(filter(None, [instance.title, instance.source]))
    text = f"{head}\n\n{found}"
    if lacking is not None:
        document["lack_of_fit"] = lacking.content()
        text += f"\n\nA quick fit of {lacking.configurations} configurations. {lacking}"
    show(text, document, as_json)


@app.command()
def calibrate(
    problem: Problem,
    variant: Variant = None,
    select: Annotated[
        str | None,
        typer.Option(
            help="Sizes that are learned (learned), or one weight: reml, l_curve, gcv, k_fold, ..., a number."
        ),
    ] = None,
    model: Annotated[
        str | None, typer.Option(help="auto: families that the evidence wants (gravity, gears); geometry: none.")
    ] = None,
    formulation: Annotated[
        str | None,
        typer.Option(
            help="Instead of the file's: least_squares, tikhonov, bounded, robust, sum_of_norms, minimax, lasso, "
            "group_lasso."
        ),
    ] = None,
    noise: Annotated[
        str | None,
        typer.Option(help="What of the noise is learned: robot (beside the instrument's), free, level, declared."),
    ] = None,
    refit: Annotated[bool, typer.Option(help="Calibrate once more without the rows that it distrusts.")] = False,
    refit_all: Annotated[
        bool, typer.Option("--refit-all", help="Validate, then calibrate once more from all rows, both figures said.")
    ] = False,
    limit: Limit = None,
    box: Box = None,
    out: Annotated[Path | None, typer.Option(help="Folder for result.json.")] = None,
    profile: Annotated[bool, typer.Option(help="Say where the time went.")] = False,
    as_json: Json = False,
) -> None:
    """Calibrate a problem: print the parameters and the errors before and after, with --out write result.json.

    Exit code 1 if it did not converge, a likely mistake is named, or a limit is not kept; 4 where that cannot be
    decided.
    """
    with progress() as say:
        from rpim_opt.basics.phases import clock
        from rpim_opt.calibration.causes import named
        from rpim_opt.report.summary import describe, describe_times, summary
        from rpim_opt.store.instances import load

        say("reading the problem")
        instance = load(problem, variant)
        instance = replace(instance, requirement=required(limit, box, instance.requirement))
        with clock() as running:
            result = _calibrated(instance, select, formulation, {"model": model, "noise": noise}, say)
            times = dict(running.rows())
        without: list[str] = []
        if refit:
            without = [flag.label for flag in result.flagged if flag.label not in result.kept_together]
        if without:
            say("calibrating without the distrusted rows")
            result = result.without_flagged()
        if refit_all:
            from rpim_opt.calibration.refit import refit_all as refitted

            say("calibrating from all rows")
            result = refitted(result)
        say("summing up")
        found = summary(result, instance.published)
    text = describe(result, found)
    if without:
        text = f"Refitted without {', '.join(without)}.\n\n{text}"
    if profile:
        text = f"{text}\n\n{describe_times(times)}"
        found = {**found, "seconds": times}
    written = _saved(result, out)
    for file in written:
        text += f"\n\nWritten: {file}"
    show(text, {**found, "refitted_without": without, "written": written}, as_json)
    if named(found["likely_causes"]) or not result.converged:
        raise typer.Exit(1)
    _end_by(found["acceptance"])


def _end_by(acceptance: dict[str, Any] | None) -> None:
    """End with the exit code of a verdict, unless it accepts or there is none."""
    if acceptance is not None and acceptance["verdict"] != "accepted":
        raise typer.Exit({"rejected": 1, "undecided": 4}[acceptance["verdict"]])


def _calibrated(
    instance: "Instance",
    select: str | None,
    formulation: str | None,
    words: dict[str, str | None],
    say: Callable[[str], None],
) -> "Calibration":
    """Calibrate as a problem's file says, or as the options say instead."""
    from rpim_opt.store.named import named_formulation, named_weight

    changes: dict[str, Any] = {key: word for key, word in words.items() if word}
    if select:
        changes["weight"] = named_weight(select)
    if formulation:
        changes["formulation"] = named_formulation(formulation)
    say("learning sizes" if changes.get("weight", instance.weight) is None else "choosing the weight")
    try:
        return instance.calibrate(
            **changes, progress=lambda it: say(f"linearizing: objective {it.objective:.6g}, step {it.step:.1e}")
        )
    except NoSolutionFound as error:
        raise _with_causes(error, instance) from None


def _with_causes(error: NoSolutionFound, instance: "Instance") -> NoSolutionFound:
    """Return the error of a program without solution; where data are likely read wrongly, it says how."""
    from rpim_opt.calibration.asking import calibrate
    from rpim_opt.calibration.causes import likely_causes, named
    from rpim_opt.convex.formulation import tikhonov

    if error.conflict is not None:
        return error
    causes = likely_causes(calibrate(instance.problem, tikhonov, weight=1.0))
    if not named(causes):
        return error
    return NoSolutionFound(error.formulation, error.weight, error.status, advice=" ".join(causes).rstrip("."))


def _saved(result: "Calibration", out: Path | None) -> list[Path]:
    """Write a result's file where a folder is given."""
    if out is None:
        return []
    from rpim_opt.basics.inputs import inside
    from rpim_opt.basics.writing import refused
    from rpim_opt.store.result_file import save_result

    file = inside(out, "result.json", "the file", out)
    with refused(file):
        save_result(result, file)
    return [file]


@app.command()
def report(
    result: Result,
    out: Annotated[Path | None, typer.Option(help="HTML file; report.html beside the result by default.")] = None,
    as_json: Json = False,
) -> None:
    """Write a result as one HTML page that works offline, for whoever has to believe it."""
    with progress() as say:
        from rpim_opt.basics.inputs import inside
        from rpim_opt.basics.writing import refused
        from rpim_opt.report.report import write_report
        from rpim_opt.store.result_file import load_result

        say("reading the result")
        loaded = load_result(result)
        say("writing the report")
        if out is None:
            folder = result if result.is_dir() else result.parent
            out = inside(folder, "report.html", "the file", folder)
        with refused(out):
            write_report(loaded, out)
    show(f"Written: {out}", {"written": [out]}, as_json)


@app.command()
def validate(
    result: Result,
    data: Annotated[Path, typer.Argument(help="New measurements, in the same instrument's frame.")],
    units: Units = "",
    measurement: Annotated[str | None, typer.Option(help="Which of the result's kinds, if there are several.")] = None,
    limit: Annotated[float | None, typer.Option(help="Largest error that is allowed [mm]; exit code 1 above.")] = None,
    out: Annotated[Path | None, typer.Option(help="CSV file for the errors, row by row.")] = None,
    as_json: Json = False,
) -> None:
    """Compare a result with new measurements; rows beyond what the prediction's uncertainty allows are named.

    Exit code 1 if an error is above the limit, or a mistake in the measurements is likely.
    """
    with progress() as say:
        from rpim_opt.store.result_file import load_result
        from rpim_opt.use.validation import read_measurements, validate

        require_positive("--limit", limit)
        say("reading the result")
        loaded = load_result(result)
        rows, left_out = read_measurements(loaded, data, measurement, units)
        found = validate(loaded, rows)
    text = str(found) + left_out_line(left_out)
    document = {**found.content(), "left_out": left_out, "limit_mm": limit, "written": written_to(out, found.csv())}
    failed = limit is not None and 1e3 * found.largest > limit
    if limit is not None:
        text += f"\nThe largest error is {1e3 * found.largest:.4f} mm, {'above' if failed else 'within'} {limit:g} mm."
    show(text + written_line(out), {**document, "within_limit": None if limit is None else not failed}, as_json)
    if failed or found.mistake:
        raise typer.Exit(1)


@app.command()
def accept(
    result: Result,
    limit: Limit = None,
    box: Box = None,
    data: Annotated[Path | None, typer.Option(help="New measurements that check it, instead of those it has.")] = None,
    units: Units = "",
    measurement: Annotated[str | None, typer.Option(help="Which of the result's kinds, if there are several.")] = None,
    as_json: Json = False,
) -> None:
    """Say whether the calibrated robot keeps a limit wherever it will go, by the bound of what it may miss by.

    Exit code 0 if it is accepted, 1 if it is rejected, 4 where that cannot be decided: then it says what is lacking.
    """
    with progress() as say:
        from rpim_opt.calibration.acceptance import accept
        from rpim_opt.store.result_file import load_result
        from rpim_opt.use.validation import read_measurements

        say("reading the result")
        loaded = load_result(result)
        rows = None
        left_out: tuple[str, ...] = ()
        if data is not None:
            rows, left_out = read_measurements(loaded, data, measurement, units)
        say("looking for the largest bound")
        found = accept(loaded, required(limit, box, loaded.record.requirement), rows)
    document = {**found.content(), "left_out": left_out}
    show(str(found) + left_out_line(left_out), document, as_json)
    _end_by(document)


@app.command()
def iso9283(
    table: Annotated[Path, typer.Argument(help="Repeated approaches: pose, x_mm, y_mm, z_mm; command_x_mm, ...")],
    units: Units = "",
    limit: Annotated[float | None, typer.Option(help="Largest AP_p that is allowed [mm]; exit code 1 above.")] = None,
    repeatability: Annotated[
        float | None, typer.Option(help="Largest RP_l that is allowed [mm]; exit code 1 above.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="CSV file for the figures, pose by pose.")] = None,
    as_json: Json = False,
) -> None:
    """Compute pose accuracy AP and repeatability RP from repeated approaches, as ISO 9283 defines them."""
    from rpim_opt.use.approaches import read_approaches

    require_positive("--limit", limit)
    require_positive("--repeatability", repeatability)
    found = read_approaches(table, units)
    if limit is not None and found.accuracy is None:
        raise InputError("--limit", "a table without commands", "command_x_mm, command_y_mm, command_z_mm in it")
    checks = [("AP_p", found.accuracy, limit), ("RP_l", found.repeatability, repeatability)]
    over = [(name, value, most) for name, value, most in checks if value is not None and most is not None]
    lines = [
        f"The largest {n} is {1e3 * v:.4f} mm, {'above' if 1e3 * v > m else 'within'} {m:g} mm." for n, v, m in over
    ]
    within = all(1e3 * value <= most for _, value, most in over)
    document = {**found.content(), "limit_mm": limit, "repeatability_limit_mm": repeatability,
                "within_limits": within if over else None, "written": written_to(out, found.csv())}  # fmt: skip
    show("\n".join([str(found), *lines]) + written_line(out), document, as_json)
    if not within:
        raise typer.Exit(1)


@app.command()
def update(
    result: Result,
    data: Annotated[Path, typer.Argument(help="New measurements of the same robot, in the same instrument's frame.")],
    units: Units = "",
    measurement: Annotated[str | None, typer.Option(help="Which of the result's kinds, if there are several.")] = None,
    inflate: Annotated[
        float, typer.Option(help="Factor on the earlier standard deviations, where all may have drifted.")
    ] = 1.0,
    anew: Annotated[
        str, typer.Option(help="Parameters that were set up anew: 'base_*' of another place of the instrument.")
    ] = "",
    out: Annotated[Path | None, typer.Option(help="Folder for the new result.json.")] = None,
    as_json: Json = False,
) -> None:
    """Carry a result on with new measurements: it is their prior; say whether the robot changed, and what did.

    Exit code 1 if nothing explains what they miss, or it did not converge.
    """
    with progress() as say:
        from rpim_opt.basics.files import sha256_of
        from rpim_opt.store.result_file import load_result
        from rpim_opt.use.updating import update
        from rpim_opt.use.validation import read_measurements

        say("reading the result")
        loaded = load_result(result)
        rows, left_out = read_measurements(loaded, data, measurement, units)
        found = update(loaded, rows, inflate=inflate, anew=anew.replace(",", " ").split(), progress=say)
        updated = found.result
        updated = replace(updated, record=replace(updated.record, files={data.name: sha256_of(data)}))
    written = _saved(updated, out)
    text = str(found) + left_out_line(left_out) + "".join(written_line(file) for file in written)
    show(text, {**found.content(), "left_out": left_out, "written": written}, as_json)
    if not (found.explained and updated.converged):
        raise typer.Exit(1)


@app.command()
def monitor(
    result: Result,
    checks: Annotated[Path, typer.Argument(help="Check readings; a column time, timestamp or date orders them.")],
    units: Units = "",
    measurement: Annotated[str | None, typer.Option(help="Which of the result's kinds, if there are several.")] = None,
    out: Annotated[Path | None, typer.Option(help="The chart over time: .html, or its points as .csv.")] = None,
    as_json: Json = False,
) -> None:
    """Look for drift in check readings over time, each and together against the interval of a new reading.

    Exit code 1 if the robot is not where its calibration says.
    """
    with progress() as say:
        from rpim_opt.report.checks_page import written_checks
        from rpim_opt.store.result_file import load_result
        from rpim_opt.use.monitoring import monitor, read_checks

        say("reading the result")
        loaded = load_result(result)
        read = read_checks(loaded, checks, measurement, units)
        found = monitor(loaded, read.data, read.when, read.times)
        written = written_checks(found, out, loaded.record.title)
    text = str(found) + left_out_line(read.left_out) + "".join(written_line(file) for file in written)
    show(text, {**found.content(), "left_out": read.left_out, "written": written}, as_json)
    if found.drifts:
        raise typer.Exit(1)


@app.command()
def export(
    result: Result,
    urdf: Annotated[Path | None, typer.Option(help="URDF of the nominal robot; corrected origins go to --out.")] = None,
    ur_kinematics: Annotated[
        Path | None, typer.Option(help="kinematics.yaml of ROS for a Universal Robot; corrected to --out.")
    ] = None,
    ur_calibration: Annotated[
        Path | None, typer.Option(help="calibration.conf of a Universal Robot; corrected to --out.")
    ] = None,
    mdh: Annotated[Path | None, typer.Option(help="MDH table to write: .csv, .json or .toml.")] = None,
    robodk: Annotated[Path | None, typer.Option(help="CSV file to write with RoboDK's four numbers a joint.")] = None,
    out: Annotated[Path | None, typer.Option(help="File to write; of several sources the folder for them.")] = None,
    urdf_base: Annotated[str | None, typer.Option(help="Link where the robot starts, if not the root.")] = None,
    urdf_tip: Annotated[str | None, typer.Option(help="Link where it ends, if there are several.")] = None,
    base: Annotated[
        bool | None,
        typer.Option(help="Make the URDF's root the instrument's frame; by default if the identified base is near."),
    ] = None,
    tool: Annotated[bool | None, typer.Option(help="Make its tip the reflector; by default if it is near.")] = None,
    marker: Marker = None,
    as_json: Json = False,
) -> None:
    """Write the identified robot for other tools: all files that are asked for, or none."""
    with progress() as say:
        from rpim_opt.robot.plain import write_robodk, write_robot
        from rpim_opt.robot.ur_kinematics import write_ur_kinematics
        from rpim_opt.store.result_file import load_result
        from rpim_opt.use.export import export_ur_calibration, export_urdf, found_by, write_all
        from rpim_opt.use.geometry import geometry_alone

        say("reading the result")
        loaded, without = geometry_alone(load_result(result))
        robot = found_by(loaded, marker)[0].robot
        options = {"root": urdf_base, "tip": urdf_tip, "base": base, "tool": tool, "marker": marker}
        corrected: list[tuple[Path | None, Callable[[Path], Any]]] = [
            (urdf, lambda target: export_urdf(loaded, urdf or "", target, **options)),
            (ur_kinematics, lambda target: write_ur_kinematics(ur_kinematics or "", robot, target)),
            (ur_calibration, lambda target: export_ur_calibration(loaded, ur_calibration or "", target)),
        ]
        plain = [(mdh, partial(write_robot, robot)), (robodk, partial(write_robodk, robot))]
        writers = [*corrected_files(corrected, out), *((target, write) for target, write in plain if target)]
        if not writers:
            accepted = "--urdf, --ur-kinematics, --ur-calibration, --mdh, --robodk, one or several"
            raise InputError("export", "nothing to write", accepted)
        notes = [*without, *write_all(writers)]
    written = [target for target, _ in writers]
    text = "\n".join([*notes, *(f"Written: {target}" for target in written)])
    show(text, {"written": written, "notes": notes}, as_json)


@app.command()
def compensate(
    result: Result,
    targets: Annotated[Path, typer.Argument(help="Joint values q1_deg, ... and/or poses x_mm, ..., qw, ...")],
    units: Units = "",
    position_only: Annotated[bool, typer.Option(help="Let orientations go.")] = False,
    tool: Annotated[
        str | None, typer.Option(help="Tool instead of the reflector: x,y,z [mm], roll,pitch,yaw [deg].")
    ] = None,
    marker: Marker = None,
    base: Annotated[bool, typer.Option(help="Correct for the base, too.")] = False,
    payload: Annotated[
        str | None, typer.Option(help="Mass at the flange [kg], or mass and centre: kg,x,y,z [mm].")
    ] = None,
    largest: Annotated[float, typer.Option(help="Largest correction of a joint [rad or m].")] = 0.2,
    limit: Annotated[float | None, typer.Option(help="Error that may be left [mm]; exit code 1 above.")] = None,
    out: Annotated[Path | None, typer.Option(help="CSV file for the corrected commands.")] = None,
    as_json: Json = False,
) -> None:
    """Correct joint commands so that the real robot goes where the nominal one would."""
    with progress() as say:
        from rpim_opt.data.models import pose
        from rpim_opt.data.tables.layout import read_raw
        from rpim_opt.data.tables.naming import rename
        from rpim_opt.data.tables.units import parse_units
        from rpim_opt.store.result_file import load_result
        from rpim_opt.use.compensation import compensate
        from rpim_opt.use.targets import read_targets

        require_positive("--limit", limit)
        mass, centre = carried(payload)
        say("reading the result")
        loaded = load_result(result)
        robot = loaded.problem.robot
        try:
            raw = read_raw(targets)
            named = rename(raw.columns, robot, pose, parse_units(units), heads=raw.heads)
            read = read_targets(named.columns, robot)
        except InputError as error:
            raise error.within(targets) from None
        say("compensating")
        found = compensate(
            loaded, read.q, read.poses, torque=read.torque, label=read.label, orientation=not position_only,
            tool=tool_frame(tool), marker=marker or "", base=base, largest=largest,
            payload=read.payload if mass is None else mass, payload_centre=centre,
        )  # fmt: skip
    document = {**found.content(), "left_out": named.left_out, "limit_mm": limit}
    document["written"] = written_to(out, found.csv())
    text = str(found) + left_out_line(named.left_out) + _written_or_shown(out, found.csv())
    show(text, document, as_json)
    if limit is not None and 1e3 * found.position_error.max() > limit:
        raise typer.Exit(1)


@app.command()
def simulate(
    problem: Annotated[str, typer.Argument(help="A problem folder with a [simulation] table.")],
    seed: Annotated[int | None, typer.Option(min=0, help="Instead of the file's.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the tables; the problem's own by default.")] = None,
    as_json: Json = False,
) -> None:
    """Make the tables of a simulated problem and the truth they come from."""
    from rpim_opt.basics.writing import refused
    from rpim_opt.store.simulation import write_simulation

    with refused(out or problem):
        written = write_simulation(problem, seed, out)
    show("\n".join(f"Written: {path}" for path in written), {"written": written}, as_json)


@app.command()
def design(
    problem: Problem,
    count: Annotated[int, typer.Option(help="How many configurations to choose.")] = 30,
    criterion: Annotated[str, typer.Option(help="V (predicted positions), D, A or E.")] = "V",
    candidates: Annotated[
        int, typer.Option(min=1, max=1_000_000, help="How many random candidates within the joint limits.")
    ] = 1000,
    table: Annotated[Path | None, typer.Option(help="A table of candidates instead: q1_deg, ...")] = None,
    point: Annotated[
        str | None,
        typer.Option(
            help="Of a robot that touches points: x,y,z [mm] of one in its base frame; else among the data's."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the random candidates.")] = 0,
    beside: Annotated[
        bool, typer.Option("--next", help="Count what is measured already: which help most besides.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="CSV file for the chosen configurations.")] = None,
    as_json: Json = False,
) -> None:
    """Choose the configurations to measure next, from candidates, by optimal design."""
    with progress() as say:
        from rpim_opt.basics.tables import csv_text
        from rpim_opt.problem.design import choose, joint_cells, random_candidates, read_candidates
        from rpim_opt.problem.postures import postures_at, touched_place
        from rpim_opt.store.instances import load

        say("reading the problem")
        instance = load(problem)
        robot = instance.problem.robot
        if table is not None:
            q = read_candidates(table, robot)
        elif instance.problem.data.blocks[0].measurement.touching:
            q = postures_at(instance.problem, touched_place(instance.problem, point)[None].repeat(candidates, 0), seed)
        else:
            q = random_candidates(robot, candidates, seed)
        measured = None
        if beside:
            measured = instance.problem.data
        found = choose(instance.problem, q, count, criterion, progress=say, measured=measured)
    columns = joint_cells(robot, q[found.chosen], found.chosen)
    text = csv_text(columns, zip(*columns.values(), strict=True))
    document = {"criterion": criterion, "value": found.value, "bound": found.bound, "gap": found.gap,
                "configurations": columns, "written": written_to(out, text)}  # fmt: skip
    show(str(found) + _written_or_shown(out, text), document, as_json)


@app.command()
def study(
    name: Annotated[
        str, typer.Argument(help="A file mine.py, a folder with study.py, or a study of the checkout by its name.")
    ],
    quick: Annotated[bool, typer.Option(help="The small version.")] = False,
    workers: Annotated[int, typer.Option(help="Processes on this machine.")] = 1,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler to compute on.")] = None,
    resume: Annotated[
        bool | None, typer.Option(help="Go on where an interrupted run was, or begin anew in spite of it.")
    ] = None,
    redraw: Annotated[bool, typer.Option(help="Only write the report anew, from the last run's replicates.")] = False,
    gate: Annotated[bool, typer.Option(help="Fail when a metric is worse than its baselines.json allows.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for the results.")] = None,
    as_json: Json = False,
) -> None:
    """Run a study: replicates in parallel, with the time that is left; the results say what made them.

    With --gate exit code 1 if a metric got worse.
    """
    from rpim_opt.basics.progress import shown
    from rpim_opt.study.report import regressions
    from rpim_opt.study.runner import run_study

    with shown(name, not as_json) as say:
        report, folder = run_study(name, quick, workers, scheduler, resume, redraw, out, progress=say)
    worse: list[str] = []
    if gate:
        worse = regressions(name, quick, report.metrics)
    text = f"{report.text}\n\nWritten: {folder}"
    show(text, {"report": report.text, "metrics": report.metrics, "worse": worse, "written": [folder]}, as_json)
    if worse:
        fail("\n".join(f"Worse: {line}" for line in worse), 1)


@app.command()
def compare(
    problems: Annotated[
        list[str], typer.Argument(help="Problem folders, names that come with rpim-opt, a folder of problem folders.")
    ],
    formulations: Annotated[
        str, typer.Option(help="tikhonov,robust,...: ready ones, or folder for each folder's own.")
    ] = "tikhonov",
    selectors: Annotated[str, typer.Option(help="learned,reml,l_curve,1.0,...: rules and weights.")] = "learned",
    methods: Annotated[str, typer.Option(help="Baselines: nominal,levenberg_marquardt,...")] = "",
    splits: Annotated[
        str, typer.Option(help="What is held out: folder, a part (0.25), a number of folds (5); or several.")
    ] = "folder",
    counts: Annotated[str, typer.Option(help="Numbers of configurations to identify from: 10,25; all without.")] = "",
    noise: Annotated[str, typer.Option(help="Factors on the noise of the data to fit: 1,3.")] = "1",
    seeds: Annotated[int, typer.Option(min=1, help="How many draws of what is drawn.")] = 1,
    metrics: Annotated[str, typer.Option(help="The first one is summed up: rms_mm,max_mm,...")] = "",
    against: Annotated[str | None, typer.Option(help="Method that others are compared with: 'tikhonov, reml'.")] = None,
    workers: Annotated[int, typer.Option(help="Processes on this machine.")] = 1,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler to compute on.")] = None,
    resume: Annotated[
        bool | None,
        typer.Option(help="Go on where an interrupted run with the same --out was, or begin anew in spite of it."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the page, the replicates and the figure.")] = None,
    as_json: Json = False,
) -> None:
    """Compare formulations, selectors and baselines on problems, in pairs, on configurations that they did not see.

    With --out every replicate is written down when it is finished, and a page index.html in the end.
    """
    from rpim_opt.study.comparing import compare
    from rpim_opt.study.metrics import USUAL

    journal = None if out is None else out / "replicates.jsonl"
    found = compare(
        problems, listed_words(formulations), listed_numbers(selectors), methods=listed_words(methods),
        splits=listed_numbers(splits), counts=listed_numbers(counts) or None, noise=listed_numbers(noise), seeds=seeds,
        metrics=listed_words(metrics) or USUAL, workers=workers, scheduler=scheduler, journal=journal, resume=resume,
        progress=not as_json,
    )  # fmt: skip
    summary = found.summary(against=against)
    written: list[Path] = []
    if out is not None and journal is not None:
        written = [found.report(out, against=against)]
        journal.unlink()
    text = "\n".join([repr(found), "", str(summary), *(f"\nWritten: {path}" for path in written)])
    show(text, {"replicates": found.rows, "made": found.made, "notes": summary.notes, "written": written}, as_json)


@app.command()
def robots(as_json: Json = False) -> None:
    """List the ready robots that a problem file may name."""
    from rpim_opt.basics.text import table
    from rpim_opt.robot.library import find_robot
    from rpim_opt.robot.library import robots as names
    from rpim_opt.robot.mdh import read_robot

    ready = {name: read_robot(find_robot(name)) for name in names()}
    rows = [{"robot": name, "name": robot.name, "joints": robot.dof} for name, robot in ready.items()]
    text = table(["robot", "name", "joints"], [[str(cell) for cell in row.values()] for row in rows])
    show(text, {"robots": rows}, as_json)


def _written_or_shown(out: Path | None, text: str) -> str:
    """Return the line that says where a table is, or the table."""
    return written_line(out) or "\n" + text.rstrip("\n")


def main() -> None:
    """Run the command line; what a user can mend is one sentence, never a traceback."""
    if not set(LONG).intersection(sys.argv[1:2]):
        for name, value in SPARED.items():
            os.environ.setdefault(name, value)
        gc.set_threshold(YOUNG)
    atexit.register(gc.freeze)  # what ends with the process is not searched for garbage once more
    with arriving():
        _run()


@cache
def _command() -> Any:
    """Return what typer makes of the commands above."""
    return typer.main.get_command(app)


def _run() -> None:
    try:
        code = _command()(standalone_mode=False)
        if code == INTERRUPTED:  # typer's own answer to Ctrl-C in some versions, without a word
            fail("Interrupted.", INTERRUPTED)
        sys.exit(code)
    except USAGE as error:
        if "--json" not in sys.argv:
            error.show()
            sys.exit(error.exit_code)
        fail(error.format_message(), error.exit_code)
    except ABORT:
        fail("Interrupted.", INTERRUPTED)
    except NoSolutionFound as error:
        fail(str(error), 3)
    except RpimError as error:
        fail(str(error), 2)
