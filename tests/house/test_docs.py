"""The manual compared with the program: the reference covers the whole program, and every link has a target."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from pydantic import BaseModel

import upright
from upright.service.cli import app
from upright.vehicles import registry

REPOSITORY = Path(__file__).resolve().parents[2]
DOCS = REPOSITORY / "docs"
PAGES = [REPOSITORY / "README.md", *sorted(DOCS.rglob("*.md"))]


def _sections(model: type[BaseModel]) -> Iterator[tuple[str, str]]:
    """(section, key) of every key of a vehicle file."""
    for name, field in model.model_fields.items():
        inner = [part for part in (field.annotation, *getattr(field.annotation, "__args__", ())) if part is not None]
        models = [part for part in inner if isinstance(part, type) and issubclass(part, BaseModel)]
        if models:
            yield from _sections(models[0])
        else:
            yield model.__name__, name


def _pages(*names: str) -> str:
    """The text of these pages: the one for all vehicles, and that of one vehicle."""
    return "\n".join((DOCS / name).read_text() for name in names)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_every_link_has_a_target(page: Path) -> None:
    targets = [target.split("#")[0] for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text())]
    missing = [name for name in targets if name and "://" not in name and not (page.parent / name).exists()]
    assert not missing


def test_every_test_that_the_security_page_names_exists() -> None:
    named = set(re.findall(r"\b(test_\w+)`", (DOCS / "explanation" / "security.md").read_text()))
    tests = "\n".join(path.read_text() for path in (REPOSITORY / "tests").rglob("test_*.py"))
    assert len(named) > 20
    assert not {name for name in named if f"def {name}(" not in tests}


@pytest.mark.parametrize("kind", registry.names())
def test_every_key_of_a_vehicle_file_is_explained(kind: str) -> None:
    page = _pages("reference/vehicle-file.md", f"vehicles/{kind}.md")
    internal = {"path", "configuration_hash"}
    # A parameter's value, std and unit are explained together, in one line.
    keys = {key for section, key in _sections(registry.of(kind).file) if section != "ParameterEntry"} - internal
    assert len(keys) > 60
    assert not sorted(key for key in keys if f"`{key}`" not in page)


def _commands() -> Iterator[tuple[str, list[str]]]:
    """(command, its option names), with groups expanded."""
    group = typer.main.get_command(app)

    def walk(command: object, path: str) -> Iterator[tuple[str, list[str]]]:
        inner = getattr(command, "commands", None)
        if inner is None:
            yield path, [option for parameter in command.params for option in parameter.opts if option[:2] == "--"]  # type: ignore[attr-defined]
            return
        for name, below in inner.items():
            yield from walk(below, f"{path} {name}")

    yield from walk(group, "upright")


def test_every_command_and_option_is_explained() -> None:
    page = (DOCS / "reference" / "cli.md").read_text()
    missing = []
    for command, options in _commands():
        section = re.search(rf"^### `{command}\b.*?(?=^##|\Z)", page, re.M | re.S)
        if section is None:
            missing.append(command)
            continue
        missing += [f"{command} {option}" for option in options if option != "--help" and option not in section[0]]
    assert not missing


@pytest.mark.parametrize("kind", registry.names())
def test_every_channel_is_explained_with_its_unit(kind: str) -> None:
    page = _pages("reference/recording.md", f"vehicles/{kind}.md")
    missing = [
        channel for channel in registry.channels_of(kind) if f"| `{channel.name}` | {channel.unit} |" not in page
    ]
    assert not missing


INTERNAL = {"of", "file", "answer", "answers", "fitted", "origin", "revised"}
"""Members of the library's classes of which nothing is stable."""


def test_every_name_of_the_library_is_explained() -> None:
    page = (DOCS / "reference" / "python.md").read_text()
    missing = [name for name in upright.__all__ if f"`{name}" not in page]
    for name in ("Recording", "Model", "Identification", "Comparison", "Diagnosis"):
        section = re.search(rf"^## `{name}`.*?(?=^## |\Z)", page, re.M | re.S)
        assert section is not None, name
        public = {member for member in vars(getattr(upright, name)) if not member.startswith("_")} - INTERNAL
        assert public, name
        missing += [f"{name}.{each}" for each in sorted(public) if not re.search(rf"`[^`|]*\b{each}\b", section[0])]
    assert not missing
