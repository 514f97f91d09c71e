"""The documentation site: README, guides and studies as they stand, and a reference made from the code.

``python3 dev.py docs [FOLDER]`` runs Sphinx with this file. The source folder is the checkout, so that links between
pages are those that a reader follows in the checkout too.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from docutils.nodes import SkipNode
from docutils.utils.math.latex2mathml import tex2mathml

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parents[1])]

project = "rpim_opt"
html_title = "rpim_opt"
root_doc = "studies/gallery/index"
include_patterns = [
    *("README.md", "CHANGELOG.md", ".github/*.md"),
    *("studies/README.md", "studies/gallery/**.md", "studies/results/*/README.md"),
    "tests/store/raw_files.md",
]
exclude_patterns = [".venv", ".git", "rpim_opt", "problems", "measured", "docs", "studies/.environments"]
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["deflist", "dollarmath"]
myst_heading_anchors = 4
smartquotes = False  # options and arguments in prose are copied: two dashes stay two dashes
html_theme = "furo"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_show_copyright = False
html_show_sphinx = False
html_show_sourcelink = False
pygments_style = "friendly"
default_role = "py:obj"
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
napoleon_google_docstring = False
napoleon_use_rtype = False


def inline(translator: Any, node: Any) -> None:
    """Write a formula within a line as MathML, which browsers show without a script or a network."""
    translator.body.append(tex2mathml(node.astext()))
    raise SkipNode


def displayed(translator: Any, node: Any) -> None:
    """Write a displayed formula as MathML."""
    translator.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise SkipNode


def escaped(app: object, what: str, name: str, of: object, options: object, lines: list[str]) -> None:
    """Escape norms |z| and trailing underscores in a docstring, which reStructuredText takes for references."""
    for i, line in enumerate(lines):
        if not line.lstrip().startswith((">>>", "...")):
            parts = re.split(r"(`+[^`]*`+)", line)
            parts[::2] = [re.sub(r"\||_(?=\W|$)", r"\\\g<0>", part) for part in parts[::2]]
            lines[i] = "".join(parts)


def readable(
    app: object, what: str, name: str, of: object, options: object, signature: str | None, result: str | None
) -> tuple[str | None, str | None]:
    """Write arrays by their name, and defaults that are made anew as dots: with these Sphinx parses no signature."""
    if signature is not None:
        signature = re.sub(r"~?numpy\.ndarray\[tuple\[.*?\], ~?numpy\.dtype\[~?numpy\.float64\]\]", "Array", signature)
        signature = signature.replace("<factory>", "...")
    return signature, result


def setup(app: Any) -> None:
    """Register what the pages need beside Sphinx's own, and write the reference."""
    import reference  # found through the path above

    app.add_html_math_renderer("mathml", inline_renderers=(inline, None), block_renderers=(displayed, None))
    app.connect("autodoc-process-docstring", escaped)
    app.connect("autodoc-process-signature", readable)
    reference.write(HERE / "reference")
