"""Builds the manual as a site that is read from disk: `python docs/site/build.py FOLDER`, or `make docs`.

Every warning is an error: a link without a target, an anchor that no heading has, a docstring that cannot be read.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from pages import gather
from sphinx.cmd.build import build_main

HERE = Path(__file__).resolve().parent


def build(target: Path) -> int:
    """Write the site into the folder `target`, and return Sphinx's exit code."""
    with tempfile.TemporaryDirectory(prefix="upright-docs-") as folder:
        source = Path(folder) / "docs"
        gather(source)
        return sphinx(source, target)


def sphinx(source: Path, target: Path) -> int:
    """Make a site of the pages in `source`. Everything is made anew: nothing remains of a page that is gone."""
    strict = ["--fail-on-warning", "--keep-going", "--quiet"]
    with tempfile.TemporaryDirectory(prefix="upright-doctrees-") as read:
        return build_main([*strict, "-b", "html", "-c", str(HERE), "-d", read, str(source), str(target)])


if __name__ == "__main__":
    sys.exit(build(Path(sys.argv[1])))
