"""The pages of the site: those of docs/ as they stand, and beside them those that are generated.

A link that leaves docs/, to a source file or a folder, gets a page that shows it: the site has no link into nowhere.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import api
import commands
import gallery
import schemas
import sources

REPOSITORY = Path(__file__).resolve().parents[2]
DOCS = REPOSITORY / "docs"
MADE: dict[str, Callable[[], str]] = {
    "reference/gallery.md": gallery.index,
    "reference/commands.md": commands.markdown,
    "reference/api.md": api.markdown,
    "reference/vehicle-file-schema.md": schemas.vehicle_file,
}
"""Pages that are generated whole."""
ELSEWHERE = {"README.md": "readme.md", "CHANGELOG.md": "changelog.md"}
"""Pages outside docs/, and where the site has them."""
SECTIONS = {
    "Tutorial": "tutorial/",
    "How-to": "how-to/",
    "Explanation": "explanation/",
    "Reference": "reference/",
    "Vehicles": "vehicles/",
    "Measurements": "measurements/",
}
"""Headings of the navigation, and the folders below them."""
BEYOND = ["journey", "decisions", "README <readme>", "changelog"]
"""What the navigation has last."""

_LINK = re.compile(r"(?<=\]\()([^)\s#]+)(?=[#)])")


def gather(source: Path) -> None:
    """Write all pages into the new folder `source`."""
    shutil.copytree(DOCS, source, ignore=shutil.ignore_patterns("site", "*.py", "__pycache__"))
    made = {name: markdown() for name, markdown in MADE.items()}
    for name, text in (made | schemas.topics() | gallery.pictures()).items():
        (source / name).parent.mkdir(exist_ok=True)
        (source / name).write_text(text)
    for written, name in ELSEWHERE.items():
        shutil.copy(REPOSITORY / written, source / name)
    effects = source / "reference" / "effects.md"
    effects.write_text(gallery.illustrated(effects.read_text()))
    shown: set[Path] = set()
    home = {name: REPOSITORY / written for written, name in ELSEWHERE.items()}
    for page in sorted(source.rglob("*.md")):
        name = page.relative_to(source).as_posix()
        page.write_text(_linked(page.read_text(), name, home.get(name, DOCS / name), shown))
    for name, path, text in sources.pages(shown):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        notebook = path.suffix == ".ipynb"  # which has links of its own; a program is shown as it is
        (source / name).write_text(_linked(text, name, path, set()) if notebook else text)
    index = source / "index.md"
    index.write_text(index.read_text() + _navigation(source, index.read_text()))


def _linked(text: str, name: str, written: Path, shown: set[Path]) -> str:
    """`text` with its links as the site has them: `name` is its page there, `written` where it is in the repository.

    Adds to `shown` the files and folders for which a page has to be made.
    """

    def target(match: re.Match[str]) -> str:
        if "://" in match[0]:
            return match[0]
        path = Path(os.path.normpath(written.parent / match[0]))
        found = _place(path, shown)
        return match[0] if found is None else os.path.relpath(found, Path(name).parent)

    return _LINK.sub(target, text)


def _place(path: Path, shown: set[Path]) -> str | None:
    """Where the site has a file of the repository; None for what Sphinx itself looks up."""
    if not path.is_relative_to(REPOSITORY):
        return None
    name = path.relative_to(REPOSITORY).as_posix()
    if name in ELSEWHERE:
        return ELSEWHERE[name]
    if name.endswith(".schema.json"):
        return name.removeprefix("docs/").replace(".schema.json", ".md")
    if path.is_relative_to(DOCS):
        return path.relative_to(DOCS).as_posix()
    if not path.exists():
        return None
    shown.add(path)
    return sources.page_of(path)


def _navigation(source: Path, index: str) -> str:
    """Hidden tables of contents: by section, the pages in the order in which the index first names them."""
    order = [match[0].removesuffix(".md") for match in _LINK.finditer(index)]
    pages = [page.relative_to(source).as_posix().removesuffix(".md") for page in source.rglob("*.md")]
    pages.sort(key=lambda page: (order.index(page) if page in order else len(order), page))
    trees = [
        (caption, [page for page in pages if page.startswith(folder) and not page.startswith("reference/mqtt/")])
        for caption, folder in SECTIONS.items()
    ]
    return "".join(_tree(caption, entries) for caption, entries in [*trees, ("Beyond", BEYOND)])


def _tree(caption: str, entries: list[str]) -> str:
    options = [":hidden:", ":titlesonly:", ":maxdepth: 1", f":caption: {caption}"]
    return "\n".join(["", "```{toctree}", *options, "", *entries, "```", ""])
