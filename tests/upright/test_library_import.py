"""`import upright`: what it loads, and what its names are."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

import upright

REPOSITORY = Path(__file__).resolve().parents[2]
HEAVY = ("numpy", "scipy", "sympy", "numba", "pandas", "matplotlib", "pyarrow", "pydantic", "canopen", "can", "rich")


def loaded(code: str) -> set[str]:
    """The heavy modules that are loaded after `code`, in a process of its own."""
    asked = f"{code}; import sys; print(*set({HEAVY}).intersection(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", asked], capture_output=True, text=True, check=True, cwd=REPOSITORY, timeout=60
    )
    return set(done.stdout.split())


def test_import_loads_nothing_heavy() -> None:
    assert loaded("import upright") == set()
    assert loaded("import upright; upright.__version__") == set()


def test_defining_an_effect_loads_what_a_definition_needs() -> None:
    assert loaded("import upright; upright.Effect; upright.Place.JOINT") <= {"numpy"}


def test_a_name_loads_its_module_on_first_use() -> None:
    assert {"numpy", "scipy"} <= loaded("import upright; upright.load")


def test_every_name_of_the_interface_exists_and_is_typed() -> None:
    assert [name for name in upright.__all__ if getattr(upright, name) is None] == []
    assert dir(upright) == upright.__all__
    tree = ast.parse((REPOSITORY / "upright" / "__init__.py").read_text())
    checked = next(each for each in tree.body if isinstance(each, ast.If))
    for_types = {each.module: sorted(alias.name for alias in each.names) for each in checked.body
                 if isinstance(each, ast.ImportFrom)}  # fmt: skip
    assert for_types == {module: sorted(names) for module, names in upright._HOMES.items()}
    assert sorted(["__version__", *(name for names in for_types.values() for name in names)]) == upright.__all__


def test_the_package_says_that_it_is_typed_and_is_in_the_wheel() -> None:
    assert (REPOSITORY / "upright" / "py.typed").exists()
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    assert "upright" in project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert upright.__version__.count(".") == 2


def test_an_unknown_name_is_an_attribute_error() -> None:
    assert not hasattr(upright, "diagnosed")
