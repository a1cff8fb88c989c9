"""`import upright`: what it loads, and what its names are."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import upright

REPOSITORY = Path(__file__).resolve().parents[2]
FOLDERS = sorted(each.name for each in (REPOSITORY / "upright").iterdir() if each.is_symlink())
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


def test_what_draws_is_loaded_by_a_plot_alone() -> None:
    assert "matplotlib" not in loaded("import upright; upright.diagnose, upright.compare, upright.identify")


def test_every_name_of_the_interface_exists_and_is_typed() -> None:
    assert [name for name in upright.__all__ if getattr(upright, name) is None] == []
    assert dir(upright) == upright.__all__
    tree = ast.parse((REPOSITORY / "upright" / "__init__.py").read_text())
    checked = next(each for each in tree.body if isinstance(each, ast.If))
    for_types = {each.module: sorted(alias.name for alias in each.names) for each in checked.body
                 if isinstance(each, ast.ImportFrom)}  # fmt: skip
    assert for_types == {module: sorted(names) for module, names in upright._HOMES.items()}
    assert sorted(["__version__", *(name for names in for_types.values() for name in names)]) == upright.__all__


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a wheel as pip unpacks it."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", folder]
    subprocess.run(command, cwd=REPOSITORY, check=True, capture_output=True, timeout=60)
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as wheel:
        wheel.extractall(folder / "site")
    return folder / "site"


def test_wheel_installs_one_typed_package(installed: Path) -> None:
    assert sorted(each.name for each in installed.iterdir()) == ["upright", f"upright-{upright.__version__}.dist-info"]
    assert (installed / "upright" / "py.typed").exists()
    assert not [path for path in installed.rglob("*") if path.is_symlink()]


def test_nothing_of_the_users_is_shadowed_nor_taken_for_upright(installed: Path, tmp_path: Path) -> None:
    """A user's modules have the names of upright's folders, and are found whichever of the two comes first."""
    for name in FOLDERS:
        (tmp_path / f"{name}.py").write_text("MINE = True\n")
    code = (
        f"import upright, {', '.join(FOLDERS)}; upright.load, upright.diagnose; from upright.service.cli import main; "
        f"print(upright.__file__, all(each.MINE for each in ({', '.join(FOLDERS)})))"
    )
    for places in ((installed, tmp_path), (tmp_path, installed)):
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, places))}
        done = subprocess.run(
            [sys.executable, "-P", "-c", code],
            env=environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout.split() == [str(installed / "upright" / "__init__.py"), "True"]


def test_an_unknown_name_is_an_attribute_error() -> None:
    assert not hasattr(upright, "diagnosed")
