"""No code outside of a vehicle's own folders names it: a further vehicle takes further folders, and nothing else."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from upright.vehicles import registry

REPOSITORY = Path(__file__).resolve().parents[2]
PACKAGES = ("telemetry", "models", "drivers", "estimators", "diagnosis", "vehicles", "simulation", "service")
ABOUT_ONE = "service/hidden_effects"
"""The benchmark of hidden effects is about the MONOCAB."""
DEFAULTS = ("service/cli", "service/virtual/run.py")
"""If a command or a script does not name a vehicle, it is a MONOCAB."""


def _words(path: Path) -> Iterator[tuple[int, str]]:
    """The strings and the modules in the code of a file, with their lines; its comments and docstrings may name a
    vehicle as an example."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    docstrings = {id(each.value) for each in ast.walk(tree) if isinstance(each, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.lineno, node.value
        elif isinstance(node, ast.ImportFrom):
            yield node.lineno, f"{node.module}."
        elif isinstance(node, ast.Import):
            yield from ((node.lineno, f"{each.name}.") for each in node.names)


def _named(kind: str, elsewhere: tuple[str, ...]) -> list[str]:
    own = {f"vehicles/{kind}", f"simulation/{kind}"}
    found = []
    for path in sorted(each for package in PACKAGES for each in (REPOSITORY / package).rglob("*.py")):
        name = path.relative_to(REPOSITORY).as_posix()
        if name.startswith((*own, *elsewhere)):
            continue
        modules = (f"upright.vehicles.{kind}.", f"upright.simulation.{kind}.")
        found += [f"{name}:{line}" for line, word in _words(path) if word == kind or word.startswith(modules)]
    return found


@pytest.mark.parametrize("kind", [each for each in registry.names() if each != "monocab"])
def test_vehicle_is_named_only_in_its_own_folders(kind: str) -> None:
    assert not _named(kind, ())


def test_monocab_is_named_elsewhere_only_as_a_default_or_in_its_benchmark() -> None:
    assert not _named("monocab", (ABOUT_ONE, *DEFAULTS))


@pytest.mark.parametrize("kind", registry.names())
def test_each_vehicle_has_the_same_modules_and_a_page(kind: str) -> None:
    for module in ("channels", "file", "kind", "model", "predicted", "recorded_loop", "vehicle", "views"):
        assert (REPOSITORY / "vehicles" / kind / f"{module}.py").is_file(), module
    for module in ("truth", "hidden", "plant", "kind"):
        assert (REPOSITORY / "simulation" / kind / f"{module}.py").is_file(), module
    assert f"({kind}.md)" in (REPOSITORY / "docs" / "vehicles" / "README.md").read_text()
