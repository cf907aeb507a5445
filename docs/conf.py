"""Sphinx configuration of the site; pages are MyST Markdown."""

import os
import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

import handover_marl

project = "handover_marl"
author = "The handover_marl developers"
project_copyright = author
version = release = handover_marl.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["_build", "**.ipynb_checkpoints", "results/data"]
nitpicky = True
# References to other projects are not checked, so the build needs no network.
nitpick_ignore_regex = [("py:.*", r"(?!handover_marl).*")]
# Types in signatures without a page of their own.
nitpick_ignore_modules = ("envs", "episode", "evaluation", "execution", "learning", "policies")
nitpick_ignore_regex += [("py:class", rf"handover_marl\.({'|'.join(nitpick_ignore_modules)})\..*")]

html_theme = "furo"
html_title = f"handover_marl {release}"
html_theme_options = {"navigation_with_keys": True}
html_static_path = ["_static"]
html_css_files = ["site.css"]
copybutton_exclude = ".linenos, .gp, .go"

myst_enable_extensions = ["deflist"]
myst_heading_anchors = 3

# Every build executes the notebook; a failing cell fails the build.
nb_execution_mode = "force"
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_execution_show_tb = True

autodoc_member_order = "bysource"
maximum_signature_line_length = 88
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
# Docstrings mark names with single backticks.
default_role = "code"

_TABLE = re.compile(r"^\s*\|.*\|\s*$")
_REPOSITORY = Path(__file__).resolve().parents[1]
_SOURCE_LINK = re.compile(r"\]\((?P<path>(?:\.\./)+[\w/]+\.py)\)")
#: Folder of the generated pages that show source files, relative to the site.
_SOURCE_PAGES = "source"


def keep_tables(_app: Sphinx, _what: str, _name: str, _object: Any, _options: Any, lines: list[str]) -> None:
    """Show Markdown tables of docstrings as preformatted text."""
    kept: list[str] = []
    for before, line in zip(["", *lines], lines, strict=False):
        if _TABLE.match(line):
            if not _TABLE.match(before):
                kept += ["::", ""]
            kept.append(f"    {line}")
        else:
            kept.append(line)
    lines[:] = kept


def shorten_defaults(
    _app: Sphinx, _what: str, _name: str, _object: Any, _options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Show a configuration that is a default by its name instead of all its fields."""
    while signature and "WorldConfig(" in signature:
        start = signature.index("WorldConfig(")
        depth, end = 1, start + len("WorldConfig(")
        while depth:
            depth += {"(": 1, ")": -1}.get(signature[end], 0)
            end += 1
        signature = f"{signature[:start]}OFFICIAL_CONFIG{signature[end:]}"
    return signature, returns


def _source_page(page: Path, link: str) -> Path:
    """Return the page that shows a linked source file."""
    source = (page.parent / link).resolve().relative_to(_REPOSITORY)
    return Path(__file__).parent / _SOURCE_PAGES / f"{source.with_suffix('').as_posix().replace('/', '.')}.md"


def write_source_pages(app: Sphinx) -> None:
    """Write a page for every source file that a page links to."""
    for page in Path(app.srcdir).rglob("*.md"):
        for match in _SOURCE_LINK.finditer(page.read_text()):
            source = (page.parent / match["path"]).resolve()
            target = _source_page(page, match["path"])
            target.parent.mkdir(exist_ok=True)
            name = source.relative_to(_REPOSITORY)
            include = os.path.relpath(source, target.parent)
            text = f"---\norphan: true\n---\n# {name}\n\n```{{literalinclude}} {include}\n```\n"
            if not target.exists() or target.read_text() != text:
                target.write_text(text)


def link_source_pages(app: Sphinx, docname: str, source: list[str]) -> None:
    """Replace links to source files by links to the pages that show them."""
    page = Path(app.srcdir) / f"{docname}.md"

    def replace(match: re.Match[str]) -> str:
        return f"]({os.path.relpath(_source_page(page, match['path']), page.parent)})"

    if page.exists():
        source[0] = _SOURCE_LINK.sub(replace, source[0])


def setup(app: Sphinx) -> None:
    """Connect the functions above."""
    app.connect("builder-inited", write_source_pages)
    app.connect("source-read", link_source_pages)
    app.connect("autodoc-process-docstring", keep_tables)
    app.connect("autodoc-process-signature", shorten_defaults)
