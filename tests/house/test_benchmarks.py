"""Benchmarks that nothing runs stop working: each is imported, and the self-contained ones run in a short form."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from thorough import of_many

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
PROGRAMS = sorted(path.name for path in FOLDER.glob("*.py"))
SHORT = {
    "beside_disturbance.py": ("--effects", "static_torque", "--times", "0", "--duration", "12", "--jobs", "1"),
    "commissioning.py": ("--defects", "--only", "upside"),
    "designed_multisine.py": ("--runs", "2", "--records", "0", "--processes", "1"),
    "dialects.py": ("--only", "sheets"),
    "disturbance_intervals.py": ("--records", "2", "--duration", "12"),
    "false_alarms.py": ("--runs", "1", "--experiment", "multisine", "--processes", "1"),
    "fleet.py": ("--short", "10", "--whole", "5", "--rounds", "1"),
    "frame_loss.py": ("--hours", "1"),
    "importing.py": ("--runs", "1"),
    "live_estimators.py": ("parting", "--seeds", "1", "--situation", "nothing"),
    "live_viewers.py": ("--rounds", "2", "--seconds", "1"),
    "monte_carlo.py": ("--runs", "2", "--duration", "15", "--method", "least_squares", "--processes", "1"),
    "passes.py": ("--vehicle", "monocab", "--seconds", "12"),
    "robot.py": ("--limit", "2"),
    "robot_estimates.py": ("--runs", "1", "--processes", "1"),
}
"""Options of the self-contained ones."""
LONGER = {
    "diagnosing.py": (),
    "fitting.py": (),
    "free_decays.py": ("encoder",),
    "live_diagnosis.py": ("--clean", "1"),
    "measured_verdicts.py": ("emps",),
    "others_recordings.py": ("--effect", "viscous_friction", "--processes", "1"),
    "others_robot.py": ("--effect", "static_torque@travel", "--processes", "1"),
    "robot_diagnosis.py": ("--case", "dead zone", "--effect", "input_deadband", "--named", "--processes", "1"),
    "side_load.py": ("--hide", "viscous_friction"),
    "robot_next_experiment.py": ("--case", "dry or viscous, after a short doublet"),
}
"""Options of those that take minutes. The others measure a browser, a bus or another build, which a person starts."""


@pytest.mark.parametrize("program", [each for each in PROGRAMS if each != "echo.py"])
def test_each_benchmark_can_be_imported(program: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With all of its imports, without its main part. echo.py, a program of turnaround.py, has no other part."""
    monkeypatch.syspath_prepend(str(FOLDER))
    assert runpy.run_path(str(FOLDER / program))["__doc__"]


@pytest.mark.patient
@pytest.mark.parametrize("program", of_many([*SHORT, *LONGER], *SHORT))
def test_self_contained_benchmark_runs(program: str) -> None:
    command = [sys.executable, str(FOLDER / program), *{**SHORT, **LONGER}[program]]
    done = subprocess.run(command, capture_output=True, text=True, cwd=FOLDER.parent)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.strip()


@pytest.mark.patient
def test_recorded_decisions_are_replayed_without_a_difference(tmp_path: Path) -> None:
    program, table = str(FOLDER / "decisions.py"), tmp_path / "table.jsonl.xz"
    for arguments in (
        ("record", str(table), "--only", "swing encoder", "--processes", "1"),
        ("replay", str(table)),
        ("summary", str(table)),
        ("diff", str(table), str(table)),
    ):
        done = subprocess.run(
            [sys.executable, program, *arguments], capture_output=True, text=True, cwd=FOLDER.parent, check=True
        )
        if arguments[0] == "replay":
            assert done.stdout.strip().startswith("0 of ")
