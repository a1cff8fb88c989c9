"""The commissioning on the dashboard: the command lines of its jobs, and their output."""

from __future__ import annotations

import asyncio
import json
import sys
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from flywheels import with_flywheels
from served import TOKEN, served
from starlette.exceptions import HTTPException

from upright.service.dashboard import jobs
from upright.service.dashboard.app import Dashboard, Settings
from upright.service.dashboard.recordings import UnknownRecording
from upright.vehicles import commissioning
from upright.vehicles.commissioning import CommissioningError, Steps
from upright.vehicles.file import VehicleFile, load

RECORDING = "20260101_tilt.arrow"
STEPS = Steps.model_validate({
    "step": [
        {"id": "wiring", "title": "Wiring", "why": "w", "why_now": "n", "evaluate": "wiring"},
        {"id": "gyro", "title": "Gyro", "why": "w", "why_now": "n", "evaluate": "gyro", "experiment": "tilt"},
    ]
})  # fmt: skip


@pytest.fixture
def dashboard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Dashboard:
    monkeypatch.setattr(commissioning, "steps_of", lambda kind: STEPS)
    (tmp_path / RECORDING).touch()
    return Dashboard(
        Settings(load("monocab"), tmp_path, "ws://127.0.0.1:9001", socket=tmp_path / "upright.sock", token=TOKEN)
    )


def get(address: str, body: bytes | None = None) -> tuple[int, str, str]:
    """Status, content security policy and text of the answer; with a `body` to a POST."""
    request = urllib.request.Request(address, body, {"x-upright-token": TOKEN})
    try:
        with urllib.request.urlopen(request, timeout=20.0) as answer:
            return answer.status, answer.headers["content-security-policy"], answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, "", error.read().decode()


def words(dashboard: Dashboard, kind: str, **document: object) -> list[str]:
    return dashboard._words(kind, {"kind": kind, **document})


def test_command_lines_of_the_steps(dashboard: Dashboard, tmp_path: Path) -> None:
    daemon = ["--vehicle", load("monocab").path, "--socket", str(tmp_path / "upright.sock")]
    recording = ["--recording", str(tmp_path / RECORDING)]
    assert words(dashboard, "commission", step="wiring") == ["commission", "--step", "wiring", "--yes", *daemon]
    assert words(dashboard, "commission", step="gyro", recording=RECORDING) == [
        "commission", "--step", "gyro", *recording, "--yes", *daemon,
    ]  # fmt: skip
    assert words(dashboard, "begin") == ["commission", "--begin", *daemon]
    assert words(dashboard, "skip", step="gyro", reason=" --yes\n is no option here ") == [
        "commission", "--skip", "gyro", "--reason=--yes is no option here", *daemon,
    ]  # fmt: skip


def test_socket_is_left_to_the_command_without_a_setting(dashboard: Dashboard, tmp_path: Path) -> None:
    usual = Dashboard(Settings(load("monocab"), tmp_path, "ws://127.0.0.1:9001"))
    assert "--socket" not in words(usual, "begin")


@pytest.mark.parametrize("step", ["moon", "", None, "--yes", "../gyro", ["gyro"], {"id": "gyro"}])
@pytest.mark.parametrize("kind", ["commission", "skip"])
def test_unknown_steps_are_refused(dashboard: Dashboard, kind: str, step: object) -> None:
    with pytest.raises(CommissioningError, match="there is no step"):
        words(dashboard, kind, step=step, reason="not today", recording=RECORDING)


@pytest.mark.parametrize("reason", [None, "", "no", "  a  \n", 12345, "x" * 501, "a\0b c", "\ud800abc", "red \x1b[31m"])
def test_step_is_skipped_with_a_reason_only(dashboard: Dashboard, reason: object) -> None:
    with pytest.raises(HTTPException):
        words(dashboard, "skip", step="gyro", reason=reason)


@pytest.mark.parametrize("recording", [f"../{RECORDING}", "/etc/passwd", f"./{RECORDING}", "", "x.arrow", ["x"], 3])
def test_only_listed_recordings_are_evaluated(dashboard: Dashboard, recording: object) -> None:
    with pytest.raises(UnknownRecording):
        words(dashboard, "commission", step="gyro", recording=recording)


def test_job_never_runs_an_experiment(dashboard: Dashboard) -> None:
    """Without a recording the command would run the step's experiment, with nobody at the page to hold its lease."""
    with pytest.raises(HTTPException):
        words(dashboard, "commission", step="gyro")
    with pytest.raises(HTTPException):
        words(dashboard, "commission", step="wiring", recording=RECORDING)


def test_vehicle_without_steps_refuses_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(kind: str) -> Steps:
        raise CommissioningError(f"there are no steps for a {kind}.", remedy="Write them.")

    monkeypatch.setattr(commissioning, "steps_of", none)
    with served(Dashboard(Settings(load("monocab"), tmp_path, "ws://127.0.0.1:9001", token=TOKEN))) as address:
        status, _, answer = get(f"{address}api/jobs", b'{"kind": "begin"}')
    assert status == 422
    assert "there are no steps" in json.loads(answer)["error"]


def test_files_of_a_step_are_served_without_scripts(dashboard: Dashboard, tmp_path: Path) -> None:
    folder = tmp_path / "commissioning"
    folder.mkdir()
    (folder / "report.html").write_text("<p>Accepted</p>")
    (folder / "gyro.toml").write_text("sign = 1")
    (tmp_path / "secret.html").touch()
    with served(dashboard) as address:
        status, policy, answer = get(f"{address}commissioning/report.html")
        assert (status, answer) == (200, "<p>Accepted</p>")
        assert policy.startswith("sandbox; default-src 'none'")
        for name in ("gyro.toml", "other.html", "..%2fsecret.html", "%2e%2e/secret.html"):
            assert get(f"{address}commissioning/{name}")[0] == 404, name


LINES = """
import json, sys
print(json.dumps({"type": "event", "text": "reading"}))
print(json.dumps({"type": "progress", "fraction": 0.5}))
"""
RESULT = LINES + 'print(json.dumps({"type": "result", "exit_code": 1, "text": "not accepted"})); sys.exit(1)'
CRASH = LINES + "sys.stdout.flush(); raise RuntimeError('out of memory')"


@pytest.mark.parametrize(
    ("script", "state", "result"),
    [
        (RESULT, "done", {"type": "result", "exit_code": 1, "text": "not accepted"}),
        (CRASH, "failed", None),
        (LINES.replace('print(json.dumps({"type": "progress", "fraction": 0.5}))', "sys.exit(1)"), "failed", None),
        ('print(\'{\\n  "verdict": "adequate"\\n}\')', "done", {"verdict": "adequate"}),
        ("print('no JSON')", "failed", None),
        ("", "failed", None),
    ],
    ids=["lines", "crash", "one event only", "one document", "text", "nothing"],
)
async def test_result_of_a_job(script: str, state: str, result: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jobs, "UPRIGHT", (sys.executable, "-c", script))
    run = jobs.Jobs()
    job = run.start("commission", ["commission"])
    while job.state in ("waiting", "running"):
        await asyncio.sleep(0.02)
    assert (job.state, job.result) == (state, result)
    assert job.error == ("RuntimeError: out of memory" if script == CRASH else job.error)
    await run.close()


def test_angular_momentum_is_drawn_where_it_is_measured(tmp_path: Path) -> None:
    def charts(vehicle: VehicleFile) -> list[str]:
        with served(Dashboard(Settings(vehicle, tmp_path, "ws://127.0.0.1:9001", token=TOKEN))) as address:
            return [each["id"] for each in json.loads(get(f"{address}api/config")[2])["charts"]]

    assert "angular_momentum" in charts(with_flywheels(tmp_path))
    assert "angular_momentum" not in charts(load("monocab"))
