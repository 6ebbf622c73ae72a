"""Sphinx configuration: ``make docs`` builds the site in ``docs/_build/html``."""

import re
from pathlib import Path

import gyrostab
from gyrostab.cli import app

project = "gyrostab"
author = "The gyrostab developers"
release = gyrostab.__version__
root_doc = "index"
default_role = "py:obj"  # names in docstrings become links

extensions = [
    "myst_nb",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build", "Thumbs.db", ".DS_Store"]

# Markdown and notebooks
myst_heading_anchors = 4
nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_merge_streams = True

# API reference
autosummary_generate = True
templates_path = ["_templates"]
autodoc_typehints = "none"
autodoc_preserve_defaults = True
toc_object_entries_show_parents = "hide"
napoleon_google_docstring = False
napoleon_use_param = False
napoleon_use_rtype = False
intersphinx_mapping = {}  # the build needs no network

smartquotes_action = "qe"  # quotes and ellipses; two hyphens begin an option

html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme = "pydata_sphinx_theme"
html_title = "gyrostab"
html_show_sourcelink = False
html_theme_options = {
    "navigation_depth": 2,
    "show_toc_level": 2,
    "header_links_before_dropdown": 6,
    "secondary_sidebar_items": ["page-toc"],
}

# Command line reference, from the help texts, in the order of the help; asterisks in examples are
# literal.
commands = app.generate_docs(output_format="rst").replace(" -m sphinx ", " ")
commands = re.sub(r"^Example: (.*?) *$", r"Example: ``\1``", commands, flags=re.MULTILINE)
commands = re.sub(r"^\.\. contents::.*\n(   .*\n)*", "", commands, flags=re.MULTILINE)
head, *sections = re.split(r"^(?=\.\. _cyclopts-gyrostab-)", commands, flags=re.MULTILINE)
order = re.findall(r"^``-*([\w-]+)``$", head, flags=re.MULTILINE)
sections.sort(key=lambda section: order.index(section.split(":")[0].split("gyrostab-")[1]))
Path(__file__).with_name("reference").joinpath("commands.rst").write_text(
    "\n\n".join(part.rstrip() for part in (head, *sections)), encoding="utf-8"
)
