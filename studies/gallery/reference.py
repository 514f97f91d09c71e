"""Pages of the reference, made from the code: public names, commands with their options, keys of files."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import rpim_opt

PACKAGE = Path(rpim_opt.__file__).parent
NAMESPACES = ("select", "constraints", "plot", "baselines")
FOLDERS = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.pyi"))
FILES = {
    "problem.toml": ("store/problem_file.py", "ProblemTable", "The problem folder's file ([guide](../robots.md))."),
    "robot.toml": ("robot/formats/tables.py", "_RobotTable", "A robot's table."),
    "result.json": ("store/result_file.py", "Stored", "What `calibrate --out` writes and every other command reads."),
}  # fmt: skip
"""File, the class that reads or writes it, and what it is."""

MEMBERS = {
    "CalibrationProblem": "identify, on, without, measuring, with_parameters, with_model, with_repeatability, "
    "residual, errors, jacobian, linearize, modelled, robot",
}
"""Members of large classes that a user calls; the others serve the loop."""
ATTRIBUTES = (("calibration", "Calibration"), ("calibration", "Prediction"), ("calibration", "Uncertainty"),
              ("calibration", "Verdict"), ("calibration", "Acceptance"))  # fmt: skip
"""Classes whose attributes are listed with those that they inherit."""


def write(folder: Path) -> None:
    """Write all pages into a folder; Sphinx reads only those again that changed."""
    folder.mkdir(exist_ok=True)
    pages = {"commands": commands(), "files": files(), "names": top_level(), "attributes": attributes()}
    pages |= {name: module(name) for name in (*NAMESPACES, *FOLDERS)}
    for name, text in pages.items():
        path = folder / f"{name}.md"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def _table(*rows: tuple[str, ...]) -> str:
    head, *body = rows
    lines = [head, (":--",) * len(head), *body]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


# --- names -----------------------------------------------------------------------------------------------


def _first(value: Any) -> str:
    """Return the first line of a docstring; a constant's is in its source."""
    return (inspect.getdoc(value) or "").partition("\n")[0].replace("`", "")


def _directives(name: str, values: dict[str, Any]) -> Iterator[str]:
    """Yield autodoc's directive of every name: classes with their members, then functions, then the rest."""
    kinds = {
        each: "class" if inspect.isclass(value) else "function" if callable(value) else "data"
        for each, value in values.items()
        if not inspect.ismodule(value)
    }
    for kind in ("class", "function", "data"):
        for each in sorted(kinds):
            if kinds[each] == kind:
                yield f".. auto{kind}:: rpim_opt.{name}.{each}\n" + f"   :members: {MEMBERS.get(each, '')}\n" * (
                    kind == "class"
                )


def module(name: str) -> str:
    """Return the page of a folder, or of a namespace such as ``ro.plot``."""
    value = getattr(rpim_opt, name)
    names = {each: getattr(value, each) for each in value.__all__}
    text = inspect.getdoc(value) or ""
    directives = "\n".join(_directives(name, names))
    return f"# rpim_opt.{name}\n\n```{{eval-rst}}\n{text}\n\n{directives}```\n"


def top_level() -> str:
    """Return the page of the names at the top level, each with a link to its description."""
    homes = {}
    for folder in FOLDERS:
        module = getattr(rpim_opt, folder)
        homes |= {id(getattr(module, each)): folder for each in module.__all__}
    rows = [("name", "what")]
    names: list[str] = vars(rpim_opt)["__all__"]
    for each in names:
        value = getattr(rpim_opt, each)
        rows.append((f"{{py:obj}}`ro.{each} <rpim_opt.{homes[id(value)]}.{each}>`", _first(value)))
    folders = [("namespace", "what")]
    for each in (*NAMESPACES, *FOLDERS):
        folders.append((f"[ro.{each}]({each}.md)", _first(getattr(rpim_opt, each))))
    pages = "\n".join(["```{toctree}", ":hidden:", "", "attributes", *NAMESPACES, *FOLDERS, "```", ""])
    head = "# Public names\n\n`import rpim_opt as ro`. The top level has what most scripts need:"
    rest = "[Attributes of a result](attributes.md). Other names are in namespaces and folders:"
    return f"{head}\n\n{_table(*rows)}\n\n{rest}\n\n{_table(*folders)}\n\n{pages}"


def attributes() -> str:
    """Return the page of everything that a result and its predictions have, inherited members included."""
    text = "# Attributes of a result\n\nIn alphabetical order; with `()` it is a method."
    for folder, name in ATTRIBUTES:
        owner = getattr(getattr(rpim_opt, folder), name)
        fields = _fields(owner)
        rows = [("attribute", "what")]
        for each in sorted(each for each in dir(owner) if not each.startswith("_")):
            value = inspect.getattr_static(owner, each, None)
            called = "()" if inspect.isfunction(value) or isinstance(value, classmethod) else ""
            if name != "Prediction" or each not in ("count", "index"):  # of any tuple
                rows.append((f"`{each}{called}`", fields.get(each) or _first(value)))
        rows += [(f"`{each}`", what) for each, what in fields.items() if not hasattr(owner, each)]
        head, *body = rows
        body.sort(key=lambda row: row[0].strip("`()"))
        text += f"\n\n## {{py:obj}}`{name} <rpim_opt.{folder}.{name}>`\n\n{_table(head, *body)}"
    return text + "\n"


def _fields(owner: type) -> dict[str, str]:
    """Return what the section Parameters of a class's docstring says of every field."""
    section = (inspect.getdoc(owner) or "").partition("Parameters\n----------\n")[2].partition("\n\n")[0]
    found: dict[str, str] = {}
    names: list[str] = []
    for line in section.splitlines():
        if not line.startswith(" "):
            names = line.split(", ")
        for name in names if line.startswith(" ") else ():
            found[name] = f"{found.get(name, '')} {line.strip()}".strip()
    return found


# --- commands ---------------------------------------------------------------------------------------------


def commands() -> str:
    """Return the page of every command with its arguments and options."""
    import typer

    from rpim_opt.cli import app

    group: Any = typer.main.get_command(app)
    text = "# Commands\n\n" + inspect.cleandoc(group.help)
    for name in sorted(group.commands):
        command = group.get_command(None, name)
        arguments = [each for each in command.params if each.param_type_name == "argument"]
        usage = " ".join(
            ["rpim-opt", name, *(each.metavar + "..." * (each.nargs == -1) for each in arguments), "[OPTIONS]"]
        )
        rows = [("argument or option", "what", "default")]
        own = [each for each in command.params if each.name != "help"]
        rows += [(_spelled(each), each.help or "", _default(each)) for each in own]
        text += f"\n\n## {name}\n\n{inspect.cleandoc(command.help)}\n\n```text\n{usage}\n```\n\n{_table(*rows)}"
    return text + "\n"


def _spelled(param: Any) -> str:
    flags = " / ".join([*param.opts, *param.secondary_opts])
    if param.param_type_name == "argument":
        return f"`{param.metavar}`"
    return f"`{flags}`" if param.is_flag else f"`{flags} {param.metavar}`"


def _default(param: Any) -> str:
    if param.required:
        return "required"
    return "" if param.default in (None, "", False, ()) or callable(param.default) else f"`{param.default}`"


# --- keys of files ----------------------------------------------------------------------------------------


def files() -> str:
    """Return the page of the keys of every file."""
    text = "# Files\n\nA key that holds a quantity ends in its unit: `a_mm`, `theta_deg`. Unknown keys are refused."
    for name, (source, owner, what) in FILES.items():
        code = (PACKAGE / source).read_text(encoding="utf-8")
        classes = {node.name: node for node in ast.parse(code).body if isinstance(node, ast.ClassDef)}
        rows = _keys(classes[owner], code.splitlines())
        text += f"\n\n## {name}\n\n{what}\n\n{_table(('key', 'value', 'what'), *rows)}"
    return text + "\n"


def _keys(owner: ast.ClassDef, lines: list[str]) -> Iterator[tuple[str, str, str]]:
    """Yield key, type and description (a comment behind it, or the text below) of every field of a class."""
    for field, below in zip(owner.body, [*owner.body[1:], None], strict=True):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            text = lines[(field.end_lineno or field.lineno) - 1].partition("  # ")[2]
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                text = " ".join(str(below.value.value).split())
            yield f"`{field.target.id}`", f"`{ast.unparse(field.annotation)}`", text
