"""The notebook of the manual, run in a kernel of its own."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

nbformat = pytest.importorskip("nbformat")
pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

REPOSITORY = Path(__file__).resolve().parents[2]
NOTEBOOK = REPOSITORY / "examples" / "missing_effect.ipynb"


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """What its cells show, by MIME type."""
    folder = tmp_path_factory.mktemp("notebook")
    (folder / "examples").mkdir()
    (folder / "tests").mkdir()
    (folder / "tests" / "golden").symlink_to(REPOSITORY / "tests" / "golden")
    copy = Path(shutil.copy(NOTEBOOK, folder / "examples"))
    path = os.pathsep.join(filter(None, (str(REPOSITORY), os.environ.get("PYTHONPATH", ""))))
    done = subprocess.run(
        [sys.executable, "-m", "jupyter", "execute", "--inplace", copy.name],
        cwd=copy.parent,
        env={**os.environ, "PYTHONPATH": path, "PYTHONWARNINGS": "default"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert (copy.parent / "repaired.toml").is_file()
    cells = [cell for cell in nbformat.read(copy, 4).cells if cell.cell_type == "code"]
    messages = [each["text"] for cell in cells for each in cell.outputs if each.get("name") == "stderr"]
    assert messages == []
    shown = []
    for cell in cells:
        data: dict[str, Any] = {}
        for each in cell.outputs:
            data |= each.get("data", {"text/plain": each.get("text", "")})
        shown.append(data)
    return shown


@pytest.mark.patient
def test_the_notebook_tells_the_whole_loop(outputs: list[dict[str, Any]]) -> None:
    measured, parameters, before, missing, explained, identified, falls, picture, kept = outputs
    for each in (measured, picture):
        assert each["image/png"]
    for each in (parameters, before, missing, identified, falls):
        assert "<" in each["text/html"]
    assert "fails" in before["text/html"]
    assert "coulomb_friction" in missing["text/html"]
    assert "coulomb_friction" in explained["text/plain"]
    assert "Recommended method" in identified["text/html"]
    assert "True" in falls["text/html"]
    assert "coulomb_friction" in kept["text/plain"]


def test_the_notebook_is_kept_without_its_outputs() -> None:
    cells = [cell for cell in nbformat.read(NOTEBOOK, 4).cells if cell.cell_type == "code"]
    assert all(cell.outputs == [] and cell.execution_count is None for cell in cells)
