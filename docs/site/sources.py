"""Pages that show files and folders of the repository, for the links of the manual that lead there."""

from __future__ import annotations

import ast
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
LANGUAGES = {".py": "python", ".toml": "toml", ".conf": "ini", ".sh": "bash"}


def page_of(path: Path) -> str:
    """The page of a file or folder, from the root of the site."""
    name = path.relative_to(REPOSITORY).as_posix()
    return f"sources/{name}/index.md" if path.is_dir() else f"sources/{name}.md"


def pages(paths: Iterable[Path]) -> Iterator[tuple[str, Path, str]]:
    """(place in the site, path in the repository, text) of the page of each of `paths`."""
    known = set(paths)
    for path in known:
        # An orphan is in no table of contents, and what it says is not searched: the manual is.
        head = f"---\norphan: true\nnosearch: true\n---\n\n# {path.relative_to(REPOSITORY)}\n\n"
        yield page_of(path), path, head + (_folder(path, known) if path.is_dir() else _file(path))


def _file(path: Path) -> str:
    if path.suffix == ".ipynb":
        return "".join(_cell(cell["cell_type"], "".join(cell["source"])) for cell in _cells(path))
    return _block(LANGUAGES.get(path.suffix, "text"), path.read_text())


def _cells(path: Path) -> list[dict[str, str]]:
    cells: list[dict[str, str]] = json.loads(path.read_text())["cells"]
    return cells


def _cell(kind: str, text: str) -> str:
    # Its own title is below that of the page.
    return _block("python", text) if kind == "code" else f"{text.replace('# ', '## ', 1)}\n\n"


def _block(language: str, text: str) -> str:
    return f"``````{language}\n{text.rstrip()}\n``````\n\n"


def _folder(path: Path, known: set[Path]) -> str:
    """What the folder is, and its files with the first line of what they say about themselves."""
    rows = []
    for each in sorted(path.iterdir()):
        if each.name.startswith(("_", ".")) or (each.is_dir() and not any(each.glob("*.py"))):
            continue
        name = f"`{each.name}/`" if each.is_dir() else f"`{each.name}`"
        if each in known:
            name = f"[{name}]({os.path.relpath(page_of(each), Path(page_of(path)).parent)})"
        rows.append(f"| {name} | {_first(_said(each)).replace('|', '&#124;')} |")
    return "\n".join([_plain(_said(path)), "", "| file | what it is |", "|---|---|", *rows, ""])


def _said(path: Path) -> str:
    """The docstring of a module or package, "" for another file."""
    module = path / "__init__.py" if path.is_dir() else path
    if module.suffix != ".py" or not module.exists():
        return ""
    return ast.get_docstring(ast.parse(module.read_text())) or ""


def _plain(text: str) -> str:
    """A docstring as it is written, without a meaning for what Markdown would take as markup."""
    return _block("text", text) if text else ""


def _first(text: str) -> str:
    return text.split("\n\n")[0].replace("\n", " ").replace("*", "\\*").replace("<", "&lt;").replace("[", "\\[")
