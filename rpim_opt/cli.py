"""The command line ``rpim-opt``. Commands import what they need when they run.

Annotations are values here: typer reads each of them twice, and as texts they would be compiled as often.
"""

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from importlib import import_module
from importlib.metadata import entry_points
from inspect import Parameter, signature
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer
from typer import Argument, Option
from typer.core import TyperGroup

import rpim_opt as ro
from rpim_opt.basics.exceptions import InputError, NoSolutionFound, NotDelivered, RpimError
from rpim_opt.basics.files import inside, sha256_of
from rpim_opt.basics.text import progress_bar, table
from rpim_opt.report import console

HELP = """Robot calibration by convex optimization.

From a table of measurements to a corrected robot: new, calibrate, export, report.

Exit codes: 0 done; 1 a limit or gate failed, or a robot is not delivered; 2 invalid input; 3 no solution found; 4
inconclusive: acceptance, or an uncertainty above the nominal robot's error.
"""


OTHERS = "rpim_opt.commands"  # entry points that are commands of other packages
VALUES = {"Path": "PATH", "int": "INTEGER", "float": "NUMBER"}
"""What help calls the values of options, by their types; others are TEXT."""
PLAIN: Any = {"rich_markup_mode": None, "pretty_exceptions_enable": False}


class Commands(TyperGroup):
    """The commands of this package, then those of other packages, which are loaded at first use.

    Arguments and the values of options are in capitals, in place of Python's types.
    """

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the commands; of two with one name that of this package."""
        return list(dict.fromkeys([*super().list_commands(ctx), *sorted(entry_points(group=OTHERS).names)]))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the command of a name; one that cannot be loaded reports that when it is called."""
        others = () if cmd_name in self.commands else entry_points(group=OTHERS, name=cmd_name)
        for each in others:
            alone = typer.Typer(add_completion=False, **PLAIN)
            try:
                _add(alone, cmd_name, each.load())
            except Exception as error:  # code of somebody else may raise anything
                _add(alone, cmd_name, _failing(f"cannot be loaded: {str(error) or type(error).__name__}"))
            self.commands[cmd_name] = typer.main.get_command(alone)
        command: Any = super().get_command(ctx, cmd_name)
        if command is None:
            return None
        annotations = signature(command.callback).parameters
        for param in command.params:
            if param.param_type_name == "argument":
                param.metavar = param.name.upper()
                param.display_type = lambda ctx: ""  # which typer from 0.27 on prints beside it
            elif not param.is_flag and param.name in annotations:
                kind = str(annotations[param.name].annotation).partition(",")[0]
                param.metavar = next((word for name, word in VALUES.items() if name in kind), "TEXT")
        return command


def _add(to: typer.Typer, name: str, function: Callable[..., Any]) -> None:
    """Add a command, which the list of commands shows with the whole first line of its docstring."""
    to.command(name, short_help=(function.__doc__ or "").partition("\n\n")[0])(function)


def _failing(text: str) -> Callable[[], None]:
    def fail() -> None:
        raise RpimError(f"The command {text}.")

    fail.__doc__ = text
    return fail


app = typer.Typer(cls=Commands, no_args_is_help=True, help=HELP, **PLAIN)
# click's, or typer's own copy, depending on typer's version
USAGE: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")
INTERRUPTED = 130


def _version(shown: bool) -> None:
    if shown:
        typer.echo(f"rpim-opt {ro.__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[bool, Option("--version", help="Print the version.", is_eager=True, callback=_version)] = False,
) -> None:
    """Hold linear algebra to one thread unless told otherwise: others would compete with those of a command."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _completed(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    return lambda incomplete: [name for name in names() if name.startswith(incomplete)]


Text = str | None
Number = float | None
File = Path | None
Choice = bool | None
SHIPPED = _completed(lambda: sorted(path.parent.name for path in ro.store.problems_folder().glob("*/problem.toml")))
FORMULATIONS = _completed(lambda: import_module("rpim_opt.convex.formulation").FORMULATIONS)
SELECTORS = _completed(lambda: ["learned", *import_module("rpim_opt.convex.select").SELECTORS])
ROBOTS = _completed(lambda: ro.robots())
MODELS = _completed(lambda: ("auto", "geometry"))
COMPONENTS = _completed(lambda: ("robot", "free", "level", "declared"))
Problem = Annotated[str, Argument(help="A problem folder, or the name of a shipped one.", autocompletion=SHIPPED)]
RULES = (
    "learned (estimated prior scales), or one weight by a selection rule (reml, l_curve, gcv, k_fold, ...) or a number."
)
READY = "least_squares, tikhonov, bounded, robust, sum_of_norms, minimax, lasso, group_lasso."
PARTS = "Noise to estimate: robot (repeatability), level (factor on the stated noise), free (both), declared (none)."
Variant = Annotated[Text, Option(help="A [variant.NAME] of the problem file.")]
Result = Annotated[Path, Argument(help="result.json, or its folder.")]
Units = Annotated[str, Option(help="Units of columns whose names carry none: deg,mm or rad,m.")]
Kind = Annotated[Text, Option(help="Measurement type: position, pose, cable, ...; default: guessed, or the result's.")]
Several = "several files are stacked, or joined as by rpim-opt new."
NEAREST = "Join files by nearest time, with this largest difference [s]."
ROTATION = "Meaning of rx, ry, rz: 'extrinsic xyz' (default), 'intrinsic zyx', vector."
Tolerance = Annotated[Number, Option(help="Acceptance limit [mm]: exit code 1 if rejected, 4 if inconclusive.")]
Register = Annotated[bool, Option("--register", help="The instrument was moved: register it again first.")]
Box = Annotated[Text, Option(help="Region x0,x1,y0,y1,z0,z1 [mm] in the robot's base; default: measured joint ranges.")]
Measured = Annotated[Choice, Option("--measured/--region", help="Test measured configurations, or the whole region.")]
Marker = Annotated[Text, Option(help="Name of the reflector, if there are several.")]
UrdfBase = Annotated[Text, Option(help="Base link of the chain; default: the root of the URDF.")]
UrdfTip = Annotated[Text, Option(help="Tip link of the chain, if there are several.")]
Chain = Annotated[
    str, Option(help="Name of a URDF chain to identify by its joint origins; further chains are added to that problem.")
]
Source = Annotated[Text, Option(help="Who measured what, when, with which instrument; default: names of the files.")]
UrKinematics = Annotated[File, Option(help="kinematics.yaml of ROS for a Universal Robot; corrected file to --out.")]
CONF = "calibration.conf copied from a Universal Robot's controller; corrected file to --out."
Convention = Annotated[str, Option(help="Convention of --mdh: modified (Craig), or standard (Paul, Hayati; .csv).")]
TIP = "The reflector is the tip link: write its identified pose."
PERMITTED = "Largest permitted error [mm]: exit code 1 if exceeded; default: the result's limit."
REMAINING = "Largest residual error plus its U (k = 2) [mm]: exit code 1 if exceeded; default: the result's limit."
ORIENTATION = "Correct all orientations, or none; default: all, if standard uncertainties are below corrections."
Workers = Annotated[int, Option(help="Number of parallel processes.")]
Resume = Annotated[Choice, Option(help="Resume an interrupted run, or discard it and start again.")]
Table = Annotated[File, Option(help="CSV file for the rows.")]
Folder = Annotated[File, Option(help="Folder in which to write result.json.")]
Despite = Annotated[bool, Option("--despite-verdict", help="Write a robot that is not delivered, with a note in it.")]
Json = Annotated[bool, Option("--json", help="One JSON document on stdout, errors as JSON on stderr.")]


def _with_code(context: typer.Context, allowed: bool) -> None:
    if allowed:
        context.with_resource(ro.store.allow_code())


Code = Annotated[bool, Option("--allow-code", help="Allow running the folder's Python files.", callback=_with_code)]


# --- how a command is made ---------------------------------------------------------------------------------


class Output(NamedTuple):
    """Output of a command: text and document, exit code, files written, and notes on reading its tables."""

    text: object
    document: dict[str, Any]
    code: int = 0
    written: Sequence[Path] | None = None
    read: Any = None

    def show(self, as_json: bool) -> None:
        """Print the text, or the document as JSON."""
        lines, document = [*filter(None, [str(self.text)])], dict(self.document)
        if self.read is not None:
            lines += self.read.notes
            lines += [f"Ignored columns: {', '.join(self.read.left_out)}."] * bool(self.read.left_out)
            document |= {"left_out": self.read.left_out, "tables": self.read.notes}
        if self.written is not None:
            lines += [f"Written: {file}" for file in self.written]
            document["written"] = self.written
        console.show(document if as_json else "\n".join(lines))


class Tables(NamedTuple):
    """Options of the commands that read tables of measurements or targets."""

    units: Units = ""
    sheet: Annotated[str, Option(help="Excel sheet, by name or number; several as Joints,Points.")] = ""
    columns: Annotated[str, Option(help="Column names of files without a header: label,q1_deg,...")] = ""
    key: Annotated[str, Option(help="Column by which several files are joined; row joins by row number.")] = ""
    within: Annotated[Number, Option("--time-tolerance", help=NEAREST)] = None
    quaternion: Annotated[str, Option(help="Order of a quaternion's numbered components, wxyz or xyzw.")] = ""
    rotation: Annotated[str, Option(help=ROTATION)] = ""
    prefix: Annotated[str, Option(help="Prefix of the robot's joint names, where the table has several robots.")] = ""
    constants: Annotated[str, Option(help="Joints without a column: 'torso_lift [m]=0.15,head_pan [deg]=0'.")] = ""
    encoding: Annotated[str, Option(help="Encoding of text files, if not detected: utf-8, cp1252, utf-16.")] = ""
    separator: Annotated[str, Option(help="Column separator: comma, semicolon, tab, bar, space.")] = ""
    decimal: Annotated[str, Option(help="Decimal mark, a comma or a point.")] = ""

    @property
    def options(self) -> "ro.data.TableOptions":
        """The options as functions take them."""
        stated = self._asdict()
        stated["columns"] = tuple(map(str.strip, self.columns.split(","))) if self.columns else ()
        return ro.data.TableOptions(**{**stated, "constants": tuple(console.listed_words(self.constants))})


TABLES = Tables()
CODES = {"accepted": 0, "rejected": 1, "inconclusive": 4}  # exit codes of an acceptance test
FAILURES = {NoSolutionFound: 3, NotDelivered: 1}  # exit codes of errors; of any other one of ours 2
PASSED = ("tables", "as_json")  # parameters of commands that are no options by themselves
CODELESS = ("new", "iso9283", "study", "robots")  # commands that read no folder of a calibration, which may name code


def command(function: Callable[..., Output]) -> Callable[..., Output]:
    """Add a command: its output is printed, as text or with --json as a document, and decides the exit code.

    A parameter ``tables`` stands for the options of `Tables`, ``as_json`` for --json; a command that runs a folder's
    code takes --allow-code.
    """
    own = signature(function).parameters
    added: dict[str, tuple[Any, Any]] = {}
    if "tables" in own:
        added = {name: (kind, Tables._field_defaults[name]) for name, kind in Tables.__annotations__.items()}
    if function.__name__ not in CODELESS:
        added["allow_code"] = Code, False
    added["as_json"] = Json, False
    options = [each.replace(kind=Parameter.KEYWORD_ONLY) for each in own.values() if each.name not in PASSED]
    for name, (kind, default) in added.items():
        options.append(Parameter(name, Parameter.KEYWORD_ONLY, annotation=kind, default=default))

    @wraps(function)
    def run(as_json: bool, allow_code: bool = False, **values: Any) -> None:
        if "as_json" in own:
            values["as_json"] = as_json
        if "tables" in own:
            values["tables"] = Tables(**{name: values.pop(name) for name in Tables._fields})
        answer = function(**values)
        answer.show(as_json)
        if answer.code:
            raise typer.Exit(answer.code)

    vars(run)["__signature__"] = signature(run).replace(parameters=options)
    _add(app, function.__name__, run)
    return function


@command
def new(
    folder: Annotated[Path, Argument(help="Problem folder to create, or with --chain to extend.")],
    robot: Annotated[str, Option(help="A ready robot (see rpim-opt robots), or a robot file.", autocompletion=ROBOTS)],
    data: Annotated[list[Path], Option(help="Joint and measured values: text, Excel, Parquet; stacked or joined.")],
    tables: Tables = TABLES,
    dry_run: Annotated[bool, Option("--dry-run", help="Check everything and write nothing.")] = False,
    measurement: Kind = None,
    validation: Annotated[list[Path] | None, Option(help="A table for validation; several are joined.")] = None,
    hold_out: Annotated[Number, Option(help="Fraction of the configurations to hold out instead: 0.25.")] = None,
    seed: Annotated[int, Option(min=0, help="Seed of the held-out configurations.")] = 0,
    urdf_base: UrdfBase = None,
    urdf_tip: UrdfTip = None,
    chain: Chain = "",
    dh: Annotated[str, Option(help="Convention of a DH table: modified (Craig) or standard (Paul, Hayati).")] = "",
    target: Annotated[str, Option(help="Board of a camera: a table with point, x_mm, y_mm, or 7x5,30mm.")] = "",
    as_json: bool = False,
) -> Output:
    """Make a problem folder from a table and a robot, with comments on all keys and reasons for all guesses."""
    with console.progress():
        made = ro.store.new_problem(
            folder, robot, data, measurement=measurement, options=tables.options, validation=validation,
            hold_out=hold_out, seed=seed, urdf_base=urdf_base, urdf_tip=urdf_tip, chain=chain, target=target, dh=dh,
            understood=None if as_json else lambda found: console.show(f"{found}\n"), dry_run=dry_run,
        )  # fmt: skip
    document = made.understood.content()
    document["notes"] += made.notes
    return Output(made, {"written": [made.folder] * (not dry_run), **document})


@command
def inspect(problem: Problem, variant: Variant = None) -> Output:
    """Check the input before calibrating: joint ranges, repeated rows, likely causes of errors, identifiability.

    Exit code 1 if the robot of a quick fit would not be delivered.
    """
    with console.progress() as say:
        say("reading the problem")
        instance = ro.load(problem, variant)
        say("inspecting, with a quick fit")
        whole = instance.problem
        apart = instance.validation
        validation = {} if apart is None else {name: apart.of_robot(name) for name in {*apart.robot}}
        prior = instance.prior if len(whole.arms) == 1 else None  # names of one robot's parameters may be others'
        parts = {name: ro.calibration.inspect(whole.alone(name), validation.get(name), prior) for name in whole.arms}
        heads = {name: f"Robot {name}\n\n" * bool(name) for name in parts}
        texts = [f"\n\n{heads[name]}{part}" for name, part in parts.items()]
        if len(parts) > 1:
            texts.append(f"\n\nAll robots together: {ro.problem.observe(whole)}")
    documents = {name: part.content() for name, part in parts.items()}
    about = {"title": instance.record.title, "source": instance.record.source}
    document = {**about, **documents.get("", documents)}  # of a single robot without a name
    text = "".join(["\n".join(filter(None, about.values())), *texts])
    refused = any(part.fit is not None and not part.fit.verdict.delivered for part in parts.values())
    return Output(text, document, int(refused))


@command
def calibrate(
    problem: Problem,
    variant: Variant = None,
    selector: Annotated[Text, Option(help=RULES, autocompletion=SELECTORS)] = None,
    model: Annotated[
        Text, Option(help="auto: extensions from the data; geometry: none.", autocompletion=MODELS)
    ] = None,
    formulation: Annotated[Text, Option(help=READY, autocompletion=FORMULATIONS)] = None,
    noise: Annotated[Text, Option(help=PARTS, autocompletion=COMPONENTS)] = None,
    drop_outliers: Annotated[
        bool, Option("--drop-outliers", help="Calibrate again without the rows that are flagged as outliers.")
    ] = False,
    use_validation: Annotated[Choice, Option(help="Refit to all rows; default: if new --hold-out was used.")] = None,
    limit: Tolerance = None,
    box: Box = None,
    measured: Measured = None,
    out: Folder = None,
) -> Output:
    """Calibrate a problem: print the parameters and the errors before and after, with --out write result.json.

    Exit code 1 if the robot is not delivered or the acceptance test rejects it; 4 if that is inconclusive: the test,
    or without a limit the median U of measured positions, which is above the error of the nominal robot.
    """
    with console.progress() as say:
        from rpim_opt.report.summary import describe, summary
        from rpim_opt.store.problem_file import named_weight

        say("reading the problem")
        instance = ro.load(problem, variant)
        requirement = console.requirement_of(limit, box, measured, instance.record.requirement)
        instance = replace(instance, record=replace(instance.record, requirement=requirement))
        words = {"model": model, "noise": noise, "formulation": formulation}
        changes: dict[str, Any] = {key: word for key, word in words.items() if word}
        if selector:
            changes["weight"] = named_weight(selector)
        say("estimating the prior's scales, or choosing the weight")
        changes["progress"] = lambda it: say(f"linearizing: objective {it.objective:.6g}, step {it.step:.1e}")
        result = instance.calibrate(**changes)
        without = [flag.label for flag in result.flagged if drop_outliers and flag.label not in result.clustered]
        if without:
            say("calibrating without outliers")
            result = result.without_flagged()
        if use_validation or (use_validation is None and instance.held_out and result.verdict.delivered):
            say("calibrating from all rows")
            result = ro.calibration.refit_all(result)
        say("computing the summary")
        document = summary(result, instance.published)
    text = describe(result, document)
    if without:
        text = f"Refitted without {', '.join(without)}.\n\n{text}"
    elif drop_outliers:
        text = f"No flagged row to drop: nothing was refitted.\n\n{text}"
    code = CODES[document["conclusion"]] if result.verdict.delivered else 1
    return Output(text, {**document, "refitted_without": without}, code, _saved(result, out))


@command
def report(
    result: Result,
    out: Annotated[File, Option(help="HTML file; report.html beside the result by default.")] = None,
    data: Annotated[list[Path] | None, Option(help=f"New measurements for validation; {Several}")] = None,
    tables: Tables = TABLES,
    measurement: Kind = None,
    register: Register = False,
) -> Output:
    """Write the calibration report: one self-contained HTML page, ready to be signed.

    With --data it has a section of their validation, with the acceptance test by them where the result has a limit
    (calibrate --limit): it is the page's verdict then, in the place of the test by rows that were held out.
    """
    with _loaded(result) as (loaded, say):
        _require_data(register, data)
        new, read = {}, None
        if data:
            read = ro.use.read_measurements(loaded, data, measurement, tables.options)
            names = ", ".join(f"{file.name} (SHA-256 {sha256_of(file)[:12]})" for file in data)
            new = {names: ro.use.validate(loaded, read.data, register)}
        say("writing the report")
        if out is None:
            folder = result if result.is_dir() else result.parent
            out = inside(folder, "report.html", "the file", folder)
        ro.report.write_report(loaded, out, new=new)
    return Output("", {}, written=[out], read=read)


@command
def validate(
    result: Result,
    data: Annotated[list[Path], Argument(help=f"New measurements; {Several}")],
    tables: Tables = TABLES,
    measurement: Kind = None,
    limit: Annotated[Number, Option(help=PERMITTED)] = None,
    register: Register = False,
    out: Table = None,
) -> Output:
    """Validate a result on new measurements, and list rows outside their prediction intervals.

    In the table of --out, sigmas is a row's error over its predicted standard deviation; the largest of all rows
    exceeds allowed_sigmas with probability 0.01.

    Exit code 1 if the calibration is not delivered, an error is above the limit, the errors are significantly larger
    than those of the nominal robot (mean difference of their squares above three standard errors), or an input mistake
    is likely, a moved instrument or base among them; 4 if none of these, but together the rows contradict the
    calibration (chi-squared by their predicted covariance, p-value below 0.01), as where the robot changed.
    """
    console.require_positive("--limit", limit)
    with _loaded(result) as (loaded, _):
        read = ro.use.read_measurements(loaded, data, measurement, tables.options)
        validation = ro.use.validate(loaded, read.data, register)
    if limit is None and loaded.record.requirement is not None:
        limit = 1e3 * loaded.record.requirement.limit
    text, within = _against(limit, "error", validation.largest)
    document = {**validation.content(), "limit_mm": limit, "within_limit": within}
    code = int(within is False or bool(validation.failure) or not loaded.verdict.delivered)
    if not code and validation.contradiction:
        code = CODES["inconclusive"]
    written = console.written_to(out, validation.csv())
    return Output("\n".join([str(validation), *text]), document, code, written, read)


@command
def accept(
    result: Result,
    limit: Tolerance = None,
    box: Box = None,
    measured: Measured = None,
    data: Annotated[list[Path] | None, Option(help=f"New measurements, instead of the result's; {Several}")] = None,
    tables: Tables = TABLES,
    measurement: Kind = None,
    register: Register = False,
) -> Output:
    """Test the calibrated robot against a tolerance, by its expanded uncertainty over a region.

    Exit code 0 if it is accepted, 1 if it is rejected, 4 if inconclusive, with what is missing.
    """
    with _loaded(result) as (loaded, say):
        _require_data(register, data)
        options = loaded, data, measurement, tables.options, register
        read = ro.use.read_measurements(*options) if data else None
        say("searching for the maximum uncertainty")
        requirement = console.requirement_of(limit, box, measured, loaded.record.requirement)
        placed = ro.use.in_session(loaded)
        acceptance = ro.calibration.accept(placed, requirement, read and read.data)
    text = "\n".join([str(acceptance), *ro.use.session_notes(placed)])
    document = {**acceptance.content(), "session": placed.problem.session or None}
    return Output(text, document, CODES[acceptance.verdict], read=read)


@command
def iso9283(
    table: Annotated[Path, Argument(help="Repeated approaches: pose, x_mm, y_mm, z_mm; command_x_mm, ...")],
    units: Units = "",
    limit: Annotated[Number, Option(help="Largest permitted pose accuracy AP_p [mm]; exit code 1 if exceeded.")] = None,
    repeatability: Annotated[Number, Option(help="Largest permitted RP_l [mm]; exit code 1 if exceeded.")] = None,
    out: Table = None,
) -> Output:
    """Compute pose accuracy AP and repeatability RP from repeated approaches, as ISO 9283 defines them."""
    console.require_positive("--limit", limit)
    console.require_positive("--repeatability", repeatability)
    performance = ro.use.read_approaches(table, units)
    if limit is not None and performance.accuracy is None:
        raise InputError("--limit", "a table without commands", "command_x_mm, command_y_mm, command_z_mm in it")
    accuracy, within = _against(limit, "AP_p", performance.accuracy or 0.0)
    repeated, also_kept = _against(repeatability, "RP_l", performance.repeatability)
    checked = [each for each in (within, also_kept) if each is not None]
    limits = {"limit_mm": limit, "repeatability_limit_mm": repeatability}
    document = {**performance.content(), **limits, "within_limits": all(checked) if checked else None}
    written = console.written_to(out, performance.csv())
    return Output("\n".join([str(performance), *accuracy, *repeated]), document, int(not all(checked)), written)


@command
def update(
    result: Result,
    data: Annotated[list[Path], Argument(help=f"New measurements, in the same instrument's frame; {Several}")],
    tables: Tables = TABLES,
    measurement: Kind = None,
    prior_inflation: Annotated[float, Option(help="Factor on the previous standard deviations.")] = 1.0,
    reset: Annotated[str, Option(help="Parameters without a prior: 'base_*' after the instrument was moved.")] = "",
    source: Source = None,
    out: Folder = None,
) -> Output:
    """Recalibrate with the previous result as prior, and report which parameters changed.

    Exit code 1 if errors on the new measurements stay unexplained, or the robot is not delivered.
    """
    with _loaded(result) as (loaded, say):
        read = ro.use.read_measurements(loaded, data, measurement, tables.options)
        named = source or ", ".join(file.name for file in data)
        released = reset.replace(",", " ").split()
        recalibration = ro.use.update(
            loaded, read.data, prior_inflation=prior_inflation, reset=released, source=named, progress=say
        )
        updated = recalibration.result
        updated = replace(updated, record=replace(updated.record, files={file.name: sha256_of(file) for file in data}))
    code = int(not updated.verdict.delivered)
    return Output(recalibration, recalibration.content(), code, _saved(updated, out), read)


@command
def monitor(
    result: Result,
    checks: Annotated[list[Path], Argument(help=f"Readings; a column time, timestamp or date orders them; {Several}")],
    tables: Tables = TABLES,
    measurement: Kind = None,
    register: Register = False,
    out: Annotated[File, Option(help="Control chart over time as .html, or its points as .csv.")] = None,
) -> Output:
    """Detect drift in check readings over time, by their prediction intervals and a CUSUM chart.

    Exit code 1 if the robot drifts, or a reading is wrong.
    """
    with _loaded(result) as (loaded, _):
        read = ro.use.read_measurements(loaded, checks, measurement, tables.options)
        monitoring = ro.use.monitor(loaded, read.data, read.when, read.clock[1], register)
        written = [*filter(None, [out])]
        for file in written:
            ro.report.write_checks(monitoring, file, loaded.record.title)
    return Output(monitoring, monitoring.content(), int(monitoring.drifts), written, read)


@command
def export(
    result: Result,
    urdf: Annotated[File, Option(help="URDF of the nominal robot; corrected origins go to --out.")] = None,
    ur_kinematics: UrKinematics = None,
    ur_calibration: Annotated[File, Option(help=CONF)] = None,
    camera_info: Annotated[File, Option(help="A camera's YAML of ROS; its intrinsics go to --out.")] = None,
    mdh: Annotated[File, Option(help="DH table to write: .csv, .json or .toml, in the convention of --dh.")] = None,
    dh: Convention = "modified",
    robodk: Annotated[File, Option(help="CSV file to write: RoboDK's four numbers per joint (modified DH).")] = None,
    corrections: Annotated[
        File, Option(help="CSV file for transmission errors, if any, to subtract from commands.")
    ] = None,
    out: Annotated[File, Option(help="File to write, or folder if there are several sources.")] = None,
    urdf_base: UrdfBase = None,
    urdf_tip: UrdfTip = None,
    tip_measured: Annotated[bool, Option("--tip-measured", help=TIP)] = False,
    marker: Marker = None,
    robot: Annotated[str, Option(help="Robot to export, of several in one calibration.")] = "",
    despite_verdict: Despite = False,
) -> Output:
    """Export the identified robot to files of other tools: all of them are written, or none.

    Exit code 1 if the robot is not delivered, or rejected by its acceptance test, and nothing is written; 4 if
    `calibrate` ends inconclusive, or the limit is met by the whole model alone, not by the geometry of files.
    """
    with _loaded(result) as (loaded, _):
        exported = ro.use.export_files(
            loaded, out, urdf=urdf, ur_kinematics=ur_kinematics, ur_calibration=ur_calibration, camera_info=camera_info,
            mdh=mdh, dh=dh, robodk=robodk, corrections=corrections, root=urdf_base, tip=urdf_tip,
            tip_measured=tip_measured, marker=marker, robot=robot, despite_verdict=despite_verdict,
        )  # fmt: skip
    code = CODES["inconclusive"] * exported.inconclusive
    return Output("\n".join(exported.notes), {"notes": exported.notes}, code, exported.files)


@command
def compensate(
    result: Result,
    targets: Annotated[
        Path, Argument(help="Joint values q1_deg, ... and/or poses in the robot's base x_mm, ..., qw, ...")
    ],
    tables: Tables = TABLES,
    orientation: Annotated[Choice, Option("--orientation/--position-only", help=ORIENTATION)] = None,
    tool: Annotated[Text, Option(help="TCP in the DH table's flange frame [mm, deg]: x,y,z,roll,pitch,yaw.")] = None,
    marker: Marker = None,
    base: Annotated[bool, Option("--base", help="Correct for deviations of the base as well.")] = False,
    payload: Annotated[Text, Option(help="Mass at the flange [kg], or mass and centre: kg,x,y,z [mm].")] = None,
    largest: Annotated[float, Option(help="Largest permitted correction of a joint [rad or m].")] = 0.2,
    limit: Annotated[Number, Option(help=REMAINING)] = None,
    out: Table = None,
    despite_verdict: Despite = False,
) -> Output:
    """Correct joint commands so that the calibrated robot reaches the poses of the nominal one.

    The commands are columns q1_deg, ... of the table, in degrees (of prismatic joints q1_mm, ... in mm), whatever the
    units of the targets.

    Exit code 1 if the robot is not delivered, or a command misses its target: unreachable, or error and uncertainty
    above the limit (without a limit: error above twice its standard uncertainty).
    """
    console.require_positive("--limit", limit)
    mass, centre = console.payload_of(payload)
    with _loaded(result) as (loaded, say):
        at = console.tool_frame(tool)
        read, understood = ro.use.read_targets(loaded, targets, tables.options, at, marker or "")
        say("compensating")
        compensation = ro.use.compensate(
            loaded, read.q, read.poses, torque=read.torque, label=read.label, orientation=orientation,
            tool=at, marker=marker or "", base=base, largest=largest,
            payload=read.payload if mass is None else mass, payload_centre=centre, despite_verdict=despite_verdict,
            limit=limit and 1e-3 * limit,
        )  # fmt: skip
        compensation = replace(compensation, texts=understood.texts)
    code = int(bool(compensation.missed))
    return _with_table(compensation, compensation.csv(), out, compensation.content(), code=code, read=understood)


@command
def simulate(
    problem: Annotated[str, Argument(help="A problem folder with a [simulation] table.")],
    seed: Annotated[int | None, Option(min=0, help="Seed in place of the file's.")] = None,
    out: Annotated[File, Option(help="Folder for the tables; the problem's own by default.")] = None,
) -> Output:
    """Simulate the tables of a problem, and write its true parameters."""
    from rpim_opt.store.simulation import write_simulation

    return Output("", {}, written=write_simulation(problem, seed, out))


@command
def design(
    problem: Problem,
    count: Annotated[int, Option(help="How many configurations to choose.")] = 30,
    criterion: Annotated[str, Option(help="Criterion: V (variance of positions), D (determinant), A (trace).")] = "V",
    candidates: Annotated[
        int, Option(min=1, max=1_000_000, help="Number of random candidates within joint limits.")
    ] = 1000,
    table: Annotated[File, Option(help="Table of candidates to use instead: q1_deg, ...")] = None,
    point: Annotated[Text, Option(help="For touches: the point x,y,z [mm] in the robot's base frame.")] = None,
    seed: Annotated[int, Option(min=0, help="Seed of the random candidates.")] = 0,
    augment: Annotated[bool, Option("--augment", help="Add to the measured configurations, in their ranges.")] = False,
    out: Table = None,
) -> Output:
    """Choose the next configurations to measure by optimal design."""
    with console.progress() as say:
        import numpy as np

        from rpim_opt.basics.tables import columns_csv, read_columns
        from rpim_opt.calibration.diagnosis import measured_ranges
        from rpim_opt.problem.design import joint_cells, read_candidates
        from rpim_opt.problem.workspace import touched_place

        say("reading the problem")
        posed = ro.load(problem).problem
        where, label = "", None
        if table is not None:
            q, label = read_candidates(table, posed.robot), read_columns(table).get("label")
        elif posed.data.blocks[0].measurement.touching:
            place = console.touched_point(point) or touched_place(posed)
            q = ro.problem.configurations_at(posed, np.tile(place, (candidates, 1)), seed)
        else:
            limits = posed.robot.limits
            if augment:
                limits = measured_ranges(posed)[posed.data.blocks[0].robot].T
                where = "\nCandidates are within the measured joint ranges (use --table for others)."
            q = ro.problem.random_candidates(replace(posed.robot, limits=limits), candidates, seed)
        say(f"choosing {count} of {len(q)} candidates")
        chosen = ro.problem.choose(posed, q, count, criterion, measured=posed.data if augment else None)
    if augment:
        where += "\nThen calibrate all tables together (`new FOLDER --data OLD --data NEW`); `update` keeps the model."
    columns = joint_cells(posed.robot, q[chosen.chosen], chosen.chosen)
    if label is not None:
        columns["label"] = [str(label[k]) for k in chosen.chosen]
    document = {"criterion": criterion, "value": chosen.value, "bound": chosen.bound, "gap": chosen.gap}
    return _with_table(f"{chosen}{where}", columns_csv(columns), out, {**document, "configurations": columns})


@command
def study(
    name: Annotated[str, Argument(help="A file mine.py, a folder with study.py, or a study of the checkout.")],
    quick: Annotated[bool, Option("--quick", help="Run the reduced version.")] = False,
    workers: Workers = 1,
    resume: Resume = None,
    redraw: Annotated[bool, Option("--redraw", help="Only rewrite the report, from stored replicates.")] = False,
    gate: Annotated[bool, Option("--gate", help="Fail when a metric is worse than its baselines.json allows.")] = False,
    out: Annotated[File, Option(help="Folder for the results.")] = None,
) -> Output:
    """Run a study: replicates in parallel, resumable, with provenance in the results.

    With --gate exit code 1 if a metric got worse.
    """
    from rpim_opt.study.studies import regressions, run_study

    with progress_bar(name) as say:
        report, folder = run_study(name, quick, workers, resume, redraw, out, progress=say)
    worse = regressions(name, quick, report.metrics) if gate else []
    document = {"report": report.text, "metrics": report.metrics, "worse": worse}
    text = "\n".join([f"{report.text}\n", *(f"Worse: {line}" for line in worse)])
    return Output(text, document, int(bool(worse)), [folder])


@command
def compare(
    problems: Annotated[list[str], Argument(help="Problem folders, a folder of them, or shipped problems.")],
    formulations: Annotated[str, Option(help="tikhonov,robust,...; folder: each problem's own.")] = "tikhonov",
    selector: Annotated[str, Option(help="learned,reml,l_curve,1.0,...: rules and weights.")] = "learned",
    methods: Annotated[str, Option(help="Baselines: nominal,levenberg_marquardt,...")] = "",
    splits: Annotated[str, Option(help="Held-out data: folder, a fraction (0.25), or a number of folds.")] = "folder",
    seeds: Annotated[int, Option(min=1, help="Number of random draws of held-out rows.")] = 1,
    workers: Workers = 1,
    resume: Resume = None,
    out: Annotated[File, Option(help="Folder for the summary, the replicates and the figure.")] = None,
) -> Output:
    """Compare formulations, selectors and baselines on problems, in pairs, on held-out configurations.

    With --out every replicate is stored when it is finished, and README.md with the figure at the end.
    """
    journal = out and out / "replicates.jsonl"
    words, numbers = console.listed_words, console.listed_numbers
    comparison = ro.compare(
        problems, words(formulations), numbers(selector), methods=words(methods), splits=numbers(splits),
        seeds=seeds, workers=workers, journal=journal, resume=resume,
    )  # fmt: skip
    summary = comparison.summary()
    written: list[Path] = []
    if out is not None and journal is not None:
        written = [comparison.report(out)]
        journal.unlink()
    document = {"replicates": comparison.rows, "made": comparison.made, "notes": summary.notes}
    return Output(f"{comparison!r}\n\n{summary}", document, written=written)


@command
def robots() -> Output:
    """List the ready robots that a problem file may name."""
    ready = {name: ro.read_robot(name) for name in ro.robots()}
    rows = [{"robot": name, "name": robot.name, "joints": robot.dof} for name, robot in ready.items()]
    text = table(["robot", "name", "joints"], [[str(cell) for cell in row.values()] for row in rows])
    return Output(text, {"robots": rows})


# --- what several commands do ------------------------------------------------------------------------------


@contextmanager
def _loaded(result: Path) -> Iterator[tuple["ro.calibration.Calibration", Callable[[str], None]]]:
    """Load a result, and show what goes on while the command works with it."""
    with console.progress() as say:
        say("reading the result")
        yield ro.load_result(result), say


def _require_data(register: bool, data: list[Path] | None) -> None:
    if register and not data:
        raise InputError("--register", "no --data", "new measurements to register")


def _saved(result: "ro.calibration.Calibration", out: Path | None) -> list[Path]:
    """Write a result's file where a folder is given."""
    if out is None:
        return []
    file = inside(out, "result.json", "the file", out)
    ro.store.save_result(ro.use.in_session(result), file)  # with the acceptance that is printed
    return [file]


def _with_table(found: object, rows: str, out: Path | None, document: dict[str, Any], **more: Any) -> Output:
    """Return what was found, with its table where no file takes it."""
    text = [str(found), *[rows.rstrip()] * (not out)]
    return Output("\n".join(text), document, written=console.written_to(out, rows), **more)


def _against(limit: float | None, name: str, value: float) -> tuple[list[str], bool | None]:
    """Return a sentence on a figure [m] and its limit [mm], and whether it is kept; nothing where there is none."""
    if limit is None:
        return [], None
    kept = 1e3 * value <= limit
    return [f"Largest {name}: {1e3 * value:.4f} mm, {'within' if kept else 'above'} the limit of {limit:g} mm."], kept


def main() -> None:
    """Run the command line; an error that a user can correct is one sentence, not a traceback."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `one_blas_thread`, before any BLAS is loaded
    with console.output_errors():
        try:
            code = app(standalone_mode=False)
            if code == INTERRUPTED:  # typer's own answer to Ctrl-C, without a word
                console.fail("Interrupted.", INTERRUPTED)
            sys.exit(code)
        except USAGE as error:
            if "--json" not in sys.argv:
                error.show()
                sys.exit(error.exit_code)
            console.fail(error.format_message(), error.exit_code)
        except RpimError as error:
            text = getattr(error, "command", str(error))
            console.fail(text, next((code for kind, code in FAILURES.items() if isinstance(error, kind)), 2))
