"""Sphinx's configuration. `build.py` runs it on the pages that `pages.py` gathers; `make docs` does both."""

from __future__ import annotations

import re
from importlib.metadata import version as _version
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

project = "upright"
author = "The upright developers"
copyright = author
version = release = _version("upright")

extensions = ["myst_parser", "sphinx.ext.autodoc"]
root_doc = "index"
nitpicky = True
nitpick_ignore_regex = [(r"py:.*", r"(?!upright\.\w+$).*")]  # others, and what is below `upright`, have no pages
highlight_language = "none"  # a block without a language is an equation, or what a terminal shows
suppress_warnings = ["misc.highlighting_failure"]  # a shortened document is no JSON

myst_heading_anchors = 4  # as deep as links go; the anchors are GitHub's
myst_links_external_new_tab = False

default_role = "code"  # docstrings have one backtick around a name
smartquotes = False  # quotes in docstrings are those of a program
add_module_names = False
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88

html_theme = "furo"
html_title = f"upright {version}"
html_static_path = [str(Path(__file__).parent / "static")]
html_css_files = ["upright.css"]
html_theme_options: dict[str, Any] = {"top_of_page_buttons": []}
html_show_sourcelink = False
html_show_copyright = False
html_show_search_summary = False  # the search would fetch the pages that it found, which a browser forbids for files
html_copy_source = False


def _paragraphs(_app: Sphinx, _what: str, _name: str, _of: object, _options: object, lines: list[str]) -> None:
    """Errors have a paragraph of their own, which is a line of its own in a docstring."""
    lines[:] = re.sub(r"(?m)^(?=Raises )", "\n", "\n".join(lines)).split("\n")


def _public(
    _app: Sphinx, _what: str, _name: str, _of: object, _options: object, takes: str | None, returns: str | None
) -> object:
    """A function takes the class of the layer below, of which the library's own is one: the page names that."""
    return takes and (takes.replace("upright.telemetry.recording.Recording", "upright.Recording"), returns)


_navigation: dict[int, str] = {}
"""By depth of folders, the navigation of a page that is not in it."""


def _once(_app: Sphinx, page: str, _template: str, context: dict[str, Any], _document: object) -> None:
    """Most pages are sources, all with the same navigation, which takes longer to make than all else of the page."""
    if page.startswith("sources/"):
        make, depth = context["toctree"], page.count("/")

        def toctree(**options: object) -> str:
            if depth not in _navigation:
                _navigation[depth] = make(**options)
            return _navigation[depth]

        context["toctree"] = toctree


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("html-page-context", _once, priority=100)  # before the theme makes use of it
    app.connect("autodoc-process-docstring", _paragraphs)
    app.connect("autodoc-process-signature", _public)
