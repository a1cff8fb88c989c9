"""The cache of compiled models: compiled code is reused, by other processes too, and damaged files are rebuilt."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from small_model import GAIN, INITIAL, PLANT, SHIFTED, segment

from upright.models.compiler import kernel as kernels
from upright.models.compiler import machine_code
from upright.models.compiler.kernel import LOOPS, Kernel, compile_model
from upright.models.parts import Hold


@pytest.fixture(scope="module")
def plant() -> Kernel:
    return compile_model(PLANT)


@pytest.fixture
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plant: Kernel) -> Path:
    """A cache directory that contains only the loops, for a process that has loaded only these."""
    loops = _files(machine_code.cache_directory(), "loops-")[-1]
    folder = tmp_path / "kernels"
    folder.mkdir()
    (folder / loops.name).write_bytes(loops.read_bytes())
    monkeypatch.setenv("UPRIGHT_CACHE", str(tmp_path))
    monkeypatch.setattr(kernels, "_loaded", {LOOPS: kernels._loaded[LOOPS]})
    return folder


def _files(folder: Path, start: str) -> list[Path]:
    found = [path for path in folder.iterdir() if path.name.startswith(start)]
    return sorted(found, key=lambda path: path.stat().st_mtime)


def _final(kernel: Kernel) -> list[float]:
    return kernel.run(segment(), kernel.vector(SHIFTED), INITIAL, gain=GAIN).final.tolist()


def test_compiled_model_is_found_in_the_cache(plant: Kernel, empty: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    messages: list[str] = []
    assert _final(compile_model(PLANT, progress=messages.append)) == _final(plant)
    assert messages == ["model test-plant: compiling"]
    monkeypatch.setattr(kernels, "_loaded", {LOOPS: kernels._loaded[LOOPS]})
    other = PLANT.change({"m": 5.0})  # values are not part of the compiled code
    again = compile_model(other, progress=messages.append)
    assert len(messages) == 1
    assert again.vector()[0] == 5.0
    assert _final(compile_model(PLANT)) == _final(plant)


@pytest.mark.parametrize("damage", ["cut", "empty", "changed", "foreign"])
def test_damaged_file_is_rebuilt(plant: Kernel, empty: Path, damage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    compile_model(PLANT)
    (path,) = _files(empty, "test-plant")
    good = path.read_bytes()
    middle = len(good) // 2
    bad = {
        "cut": good[:middle],
        "empty": b"",
        "changed": good[:middle] + bytes([good[middle] ^ 1]) + good[middle + 1 :],
        "foreign": b"# what an earlier version kept under this name" * 9,
    }
    path.write_bytes(bad[damage])
    monkeypatch.setattr(kernels, "_loaded", {LOOPS: kernels._loaded[LOOPS]})
    assert _final(compile_model(PLANT)) == _final(plant)
    assert machine_code.recall(path.name) is not None


def _by_others(folder: Path, file: Path, how: str) -> None:
    """Make it possible that others have written the file."""
    stranger = 54321
    match how:
        case "folder of somebody else":
            os.chown(folder, stranger, -1)
        case "file of somebody else":
            os.chown(file, stranger, -1)
        case "folder that all can write":
            folder.chmod(0o777)
        case "folder that a group can write":
            folder.chmod(0o770)
        case "file that all can write":
            file.chmod(0o666)
        case "link":
            file.rename(folder / "elsewhere")
            file.symlink_to(folder / "elsewhere")
        case "pipe":
            file.unlink()
            os.mkfifo(file)


@pytest.mark.parametrize(
    "how",
    [
        "folder of somebody else", "file of somebody else", "folder that all can write",
        "folder that a group can write", "file that all can write", "link", "pipe",
    ],
)  # fmt: skip
def test_code_that_others_could_write_is_not_run(tmp_path: Path, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if "somebody else" in how and os.geteuid():
        pytest.skip("only root can give a file away")
    monkeypatch.setenv("UPRIGHT_CACHE", str(tmp_path))
    planted = machine_code.Assembled(b"code", {"structure": []})
    machine_code.keep("model", planted)
    folder = machine_code.cache_directory()
    assert folder.stat().st_mode & 0o777 == 0o700
    assert machine_code.recall("model") == planted
    _by_others(folder, folder / "model", how)
    assert machine_code.recall("model") is None
    machine_code.keep("model", planted)
    own_folder = how != "folder of somebody else"  # everything else is put right by the next that is kept
    assert (machine_code.recall("model") == planted) == own_folder


def test_models_compile_without_a_writable_cache(plant: Kernel, empty: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (empty / "file").touch()
    monkeypatch.setenv("UPRIGHT_CACHE", str(empty / "file"))  # no user can create a folder inside a file
    assert _final(compile_model(PLANT)) == _final(plant)


def test_fingerprint_depends_on_the_processor(empty: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = kernels.fingerprint(PLANT)
    monkeypatch.setattr(machine_code, "processor", lambda: "another")
    assert kernels.fingerprint(PLANT) != name


def test_fingerprint_depends_on_the_structure_but_not_on_values(plant: Kernel) -> None:
    first, *rest = PLANT.inputs
    for other in (
        replace(PLANT, inputs=(replace(first, hold=Hold.CUBIC), *rest)),
        replace(PLANT, inputs=(replace(first, delays=("push_delay",)), *rest)),
        replace(PLANT, inputs=(replace(first, lag="wind_lag"), *rest)),
        replace(PLANT, outputs=PLANT.outputs[:1]),
        replace(PLANT, base_states=(*PLANT.base_states[:2], replace(PLANT.base_states[2], derivative="-z"))),
    ):
        assert kernels.fingerprint(other) != kernels.fingerprint(PLANT)
    assert kernels.fingerprint(PLANT.change({"m": 2.0})) == kernels.fingerprint(PLANT)


START = """
import json, sys
import numpy as np
from upright.models import library
from upright.models.compiler.kernel import compile_model
from upright.models.segment import Segment
told = []
kernel = compile_model(library.get("monocab_roll"), progress=told.append)
time, inputs = 0.01 * np.arange(9.0), len(kernel.inputs)
data = Segment(time, np.repeat(time[:, None], inputs, axis=1), np.ones((9, inputs)), np.zeros((9, len(kernel.outputs))))
assert kernel.run(data, kernel.vector(), np.zeros(len(kernel.states))).predicted[-1].any()
print(json.dumps([told, sorted({"sympy", "numba"} & set(sys.modules)), len(kernel.code.addresses)]))
"""


def _start() -> subprocess.Popen[str]:
    root = Path(__file__).resolve().parents[2]
    return subprocess.Popen([sys.executable, "-c", START], cwd=root, stdout=subprocess.PIPE, text=True, env=os.environ)


def test_processes_share_the_cache(empty: Path) -> None:
    """Two concurrent processes both compile, undisturbed; a third finds all code and needs neither SymPy nor numba."""
    for process in [_start(), _start()]:
        output, _ = process.communicate(timeout=60)
        assert process.returncode == 0
        assert json.loads(output)[2] == len(kernels.FUNCTIONS)
    assert len(_files(empty, "monocab_roll")) == 1
    assert not [path for path in empty.iterdir() if path.suffix == ".tmp"]
    output, _ = _start().communicate(timeout=60)
    assert json.loads(output) == [[], [], len(kernels.FUNCTIONS)]


ROBOT = """
from upright.models import library
from upright.models.compiler.codegen import generate
print(generate(library.get("twsbr")))
"""


def test_code_does_not_depend_on_the_process() -> None:
    """Sums and products of the robot's equations have many arguments, which hashes of strings must not reorder."""
    first, second = (
        subprocess.run(
            [sys.executable, "-c", ROBOT],
            env={**os.environ, "PYTHONHASHSEED": seed},
            cwd=Path(__file__).parents[2],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    )
    assert len(first) > 10_000
    assert first == second
