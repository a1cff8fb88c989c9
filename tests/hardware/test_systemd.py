"""The unit file under a real systemd: readiness, watchdog, restart, stop, with the daemon on real SocketCAN.

Runs in the throw-away guest, where the unit is installed as the manual says. A drop-in sets the differences: the
checkout instead of /opt/upright, vcan0 instead of can0, and no private /home and /tmp, since the checkout and its
Python may lie in either. All other hardening, and the user upright, are as shipped.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from service.control import api
from service.control.loop import Mode

pytestmark = [pytest.mark.systemd, pytest.mark.timeout(90)]

REPOSITORY = Path(__file__).resolve().parents[2]
UPRIGHT = Path(sys.executable).parent / "upright"
SOCKET = Path("/run/upright/monocab.sock")
VEHICLE = Path("/etc/upright/vehicle.toml")
SLOWER = {"rate": 100, "heartbeat_period": 0.1, "heartbeat_timeout": 0.5, "missed_cycles": 20}
"""Keys of the vehicle file that differ in the guest, which has one CPU for everything, where starting Python takes
seconds. These tests are about the unit, not the timing."""

DROP_IN = f"""
[Service]
ExecStart=
ExecStart={UPRIGHT} serve ${{VEHICLE}} --bus socketcan:vcan0
ProtectHome=no
PrivateTmp=no
ReadWritePaths=/tmp
"""


def _run(*command: str | Path) -> str:
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}{_journal()}"
    return done.stdout.strip()


def _journal() -> str:
    return subprocess.run(
        ["journalctl", "--unit=upright", "--no-pager", "--lines=60"], capture_output=True, text=True, timeout=60
    ).stdout


def _show(name: str) -> str:
    return _run("systemctl", "show", "--value", "--property", name, "upright")


def _status() -> dict[str, Any] | None:
    """The status that the daemon reports; None while it cannot be reached."""
    try:
        return list(api.call([SOCKET], {"verb": "status"}))[-1]["status"]  # type: ignore[no-any-return]
    except api.ApiError:
        return None


def _wait(what: str, met: Callable[[], bool], seconds: float) -> None:
    limit = time.monotonic() + seconds
    while not met():
        assert time.monotonic() < limit, f"not within {seconds} s: {what}; {_status()}\n{_journal()}"
        time.sleep(0.1)


def _wait_for_mode(mode: Mode, seconds: float = 30.0) -> dict[str, Any]:
    _wait(f"mode {mode}", lambda: (_status() or {}).get("mode") == mode, seconds)
    status = _status()
    assert status is not None
    return status


@pytest.fixture(scope="module", autouse=True)
def installed() -> None:
    """Installs user, environment file and unit."""
    for place in (Path(sys.base_prefix), REPOSITORY):  # The user upright must reach the interpreter and the checkout.
        for folder in place.parents:
            if not folder.stat().st_mode & 0o001:
                folder.chmod(folder.stat().st_mode | 0o011)
    units, systemd = Path("/etc/systemd/system"), REPOSITORY / "systemd"
    _run("install", "-D", "-m", "644", systemd / "upright.sysusers", "/etc/sysusers.d/upright.conf")
    _run("systemd-sysusers")
    _run("install", "-D", "-m", "644", systemd / "upright.env", "/etc/upright/upright.env")
    vehicle = (REPOSITORY / "vehicles" / "monocab" / "vehicle.toml").read_text()
    for key, value in SLOWER.items():
        vehicle, changed = re.subn(rf"^{key} = \S+", f"{key} = {value}", vehicle, count=1, flags=re.MULTILINE)
        assert changed, key
    VEHICLE.write_text(vehicle)
    _run("install", "-m", "644", systemd / "upright.service", units)
    (units / "upright.service.d").mkdir(exist_ok=True)
    (units / "upright.service.d" / "guest.conf").write_text(DROP_IN)
    _run("systemctl", "daemon-reload")


@pytest.fixture
def silent_service() -> Iterator[None]:
    """The started service, on a bus with no other node."""
    _run("systemctl", "reset-failed")
    _run("systemctl", "start", "upright")
    yield
    _run("systemctl", "stop", "upright")


@pytest.fixture
def service(silent_service: None) -> Iterator[dict[str, Any]]:
    """The status of the service once it has set up the drives of a virtual vehicle."""
    _run("systemd-run", "--unit=vehicle", "--quiet", UPRIGHT, "simulate", VEHICLE, "--bus", "socketcan:vcan0")
    yield _wait_for_mode(Mode.DISARMED)
    _run("systemctl", "stop", "vehicle")


def _start_experiment() -> list[str]:
    """Start an experiment and wait until the drives are enabled. Its final text is added to the list when it ends."""
    ends: list[str] = []
    _wait(
        "nothing keeps an experiment from starting",
        lambda: not (_status() or {"interlocks": ["no answer"]})["interlocks"],
        30.0,
    )

    def follow() -> None:
        try:
            ends.append(list(api.call([SOCKET], {"verb": "experiment", "name": "hold"}, timeout=None))[-1]["text"])
        except api.ApiError as error:
            ends.append(str(error))

    threading.Thread(target=follow, daemon=True).start()
    _wait("the drives are enabled", lambda: _drive_states(_status()) == {"Operation enabled"} or bool(ends), 20.0)
    assert not ends
    return ends


def _drive_states(status: dict[str, Any] | None) -> set[str]:
    return {drive["state"] for drive in (status or {}).get("drives", [])}


def test_unit_file_passes_systemd_analyze() -> None:
    assert _run("systemd-analyze", "verify", "upright.service") == ""


def test_service_is_ready_disarmed_and_not_root(service: dict[str, Any]) -> None:
    assert _show("ActiveState") == "active"
    assert "Operation enabled" not in _drive_states(service)
    user = Path(f"/proc/{_show('MainPID')}").stat().st_uid
    assert user == int(_run("id", "--user", "upright")) != 0
    answer = json.loads(_run(UPRIGHT, "status", "--json", "--socket", SOCKET))
    assert answer["mode"] == "disarmed"


def test_daemon_killed_with_the_drives_enabled_restarts_disarmed(service: dict[str, Any]) -> None:
    ends = _start_experiment()
    killed = _show("MainPID")
    _run("systemctl", "kill", "--signal=KILL", "--kill-whom=main", "upright")
    _wait("systemd restarts it", lambda: _show("NRestarts") == "1" and _show("MainPID") not in ("0", killed), 20.0)
    assert "the daemon ended" in ends[0]
    status = _wait_for_mode(Mode.DISARMED)
    assert "Operation enabled" not in _drive_states(status)
    assert status["experiment"] is None


def test_hung_daemon_is_restarted_by_the_watchdog(service: dict[str, Any]) -> None:
    _run("systemctl", "kill", "--signal=STOP", "--kill-whom=main", "upright")
    _wait("the watchdog restarts it", lambda: _show("NRestarts") == "1", 20.0)
    assert "Watchdog timeout" in _journal()
    _wait_for_mode(Mode.DISARMED)


def test_daemon_is_not_restarted_while_the_vehicle_is_switched_off(silent_service: None) -> None:
    watchdog_periods = 2.5
    time.sleep(watchdog_periods * 2.0)
    assert (_show("NRestarts"), _show("ActiveState")) == ("0", "active")
    assert (_status() or {})["mode"] != Mode.RUNNING


def test_daemon_stopped_during_an_experiment_exits_cleanly_and_keeps_the_recording(service: dict[str, Any]) -> None:
    _start_experiment()
    _run("systemctl", "stop", "upright")
    assert (_show("Result"), _show("ExecMainStatus"), _show("ActiveState")) == ("success", "0", "inactive")
    assert not SOCKET.exists()
    assert list(Path("/var/lib/upright").glob("*.arrow")), "the recording of the interrupted experiment is kept"


@pytest.fixture
def drop_ins() -> Iterator[None]:
    """The shipped drop-ins, with the processor that the guest has, and time to start on it beside all else."""
    folder = Path("/etc/systemd/system/upright.service.d")
    shipped = REPOSITORY / "systemd" / "upright.service.d"
    texts = {name: (shipped / name).read_text() for name in ("realtime.conf", "cpu.conf", "metrics.conf")}
    texts["cpu.conf"] = texts["cpu.conf"].replace("CPUAffinity=3", "CPUAffinity=0").replace("CPUS=0-2", "CPUS=0")
    texts["guest-more.conf"] = f"[Service]\nTimeoutStartSec=90\nEnvironment=PYTHONPATH={REPOSITORY}\n"
    for name, text in texts.items():
        (folder / name).write_text(text)
    _run("systemctl", "daemon-reload")
    yield
    for name in texts:
        (folder / name).unlink()
    _run("systemctl", "daemon-reload")


@pytest.mark.timeout(240)
def test_drop_ins_give_priority_and_locked_memory_to_the_control_process_alone(
    drop_ins: None, silent_service: None
) -> None:
    assert _run("systemd-analyze", "verify", "upright.service") == ""
    control = int(_show("MainPID"))
    helpers = [int(pid) for pid in _run("pgrep", "--parent", str(control)).split()]
    assert len(helpers) == 2, "the observer and the raw log"
    policies = {pid: os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK for pid in (control, *helpers)}
    assert policies == {control: os.SCHED_FIFO, **dict.fromkeys(helpers, os.SCHED_OTHER)}
    locked = {pid: re.search(r"VmLck:\s+(\d+)", Path(f"/proc/{pid}/status").read_text()) for pid in policies}
    assert all(locked.values())
    kilobytes = {pid: int(found[1]) for pid, found in locked.items() if found}
    assert kilobytes[control] > 20_000, _journal()
    assert not any(kilobytes[pid] for pid in helpers)
    assert "not locked" not in _journal()

    done = subprocess.run([UPRIGHT, "doctor", VEHICLE, "--json"], capture_output=True, text=True, timeout=60)
    found = {each["check"]: each["status"] for each in json.loads(done.stdout)["checks"]}
    assert {name: found[name] for name in ("realtime", "memory", "unit", "permissions")} == dict.fromkeys(
        ("realtime", "memory", "unit", "permissions"), "ok"
    ), done.stdout
    with urllib.request.urlopen("http://127.0.0.1:9464/metrics", timeout=10) as answer:
        assert b'upright_cycle_turnaround_seconds_bucket{le="+Inf"}' in answer.read()
