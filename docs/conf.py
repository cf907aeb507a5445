"""How the site is built: Sphinx with MyST, so that the pages read as Markdown elsewhere, too."""

import re
from typing import Any

from sphinx.application import Sphinx

import handover_marl

project = "handover_marl"
author = "The handover_marl developers"
project_copyright = author
version = release = handover_marl.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
]
exclude_patterns = ["_build", "**.ipynb_checkpoints"]
nitpicky = True
# Sites of other projects are not asked, so that the build needs no network; of ours everything is checked.
nitpick_ignore_regex = [("py:.*", r"(?!handover_marl).*")]
# Named in signatures, and not for use.
nitpick_ignore = [
    ("py:class", "handover_marl.benchmarking.agreement.Agreement"),
    ("py:class", "handover_marl.benchmarking.crossplay.CrossPlay"),
    ("py:class", "handover_marl.envs.constructors.EnvOptions"),
    ("py:class", "handover_marl.envs.fleet.Fleet"),
    ("py:class", "handover_marl.envs.wrapper.ParallelWrapper"),
    ("py:class", "handover_marl.episode.sight.SightConfig"),
    ("py:class", "handover_marl.policies.reference.PolicyReference"),
    ("py:class", "handover_marl.pools.pool_config.PoolConfig"),
]

html_theme = "furo"
html_title = f"handover_marl {release}"
html_theme_options = {"navigation_with_keys": True}
html_static_path: list[str] = []
copybutton_exclude = ".linenos, .gp, .go"

myst_enable_extensions = ["deflist"]
myst_heading_anchors = 3

# The tutorial is run with every build, and a cell that fails fails the build.
nb_execution_mode = "force"
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_execution_show_tb = True

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
# Docstrings mark names as Markdown does.
default_role = "code"

_TABLE = re.compile(r"^\s*\|.*\|\s*$")


def tables_as_they_are(_app: Sphinx, _what: str, _name: str, _object: Any, _options: Any, lines: list[str]) -> None:
    """Show Markdown tables in docstrings as preformatted text, which reStructuredText would take for substitutions."""
    kept: list[str] = []
    for before, line in zip(["", *lines], lines, strict=False):
        if _TABLE.match(line):
            if not _TABLE.match(before):
                kept += ["::", ""]
            kept.append(f"    {line}")
        else:
            kept.append(line)
    lines[:] = kept


def setup(app: Sphinx) -> None:
    """Connect what is above."""
    app.connect("autodoc-process-docstring", tables_as_they_are)
