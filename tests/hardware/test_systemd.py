"""The unit file under a real systemd: readiness, watchdog, restart, stop, with the daemon on real SocketCAN.

Runs in the throw-away guest with a time of its own, where the unit is installed as the manual says, with the vehicle
file as shipped. A drop-in sets the differences: the checkout instead of /opt/upright, vcan0 instead of can0, and no
private /home and /tmp, since the checkout and its Python may lie in either. All other hardening, and the user upright,
are as shipped.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from guest_service import (
    REPOSITORY,
    SOCKET,
    UPRIGHT,
    VEHICLE,
    drive_states,
    drop_in,
    journal,
    open_to_the_service,
    records,
    run,
    show,
    start_experiment,
    start_vehicle,
    status,
    wait,
    wait_for_mode,
    write_vehicle,
)

from upright.service.control.cycle.operation import Mode

pytestmark = [pytest.mark.systemd, pytest.mark.timeout(90)]


@pytest.fixture(scope="module", autouse=True)
def installed() -> None:
    """Installs user, environment file and unit."""
    open_to_the_service()
    units, systemd = Path("/etc/systemd/system"), REPOSITORY / "systemd"
    run("install", "-D", "-m", "644", systemd / "upright.sysusers", "/etc/sysusers.d/upright.conf")
    run("systemd-sysusers")
    run("install", "-D", "-m", "644", systemd / "upright.env", "/etc/upright/upright.env")
    write_vehicle()
    run("install", "-m", "644", systemd / "upright.service", units)
    (units / "upright.service.d").mkdir(exist_ok=True)
    (units / "upright.service.d" / "guest.conf").write_text(drop_in(UPRIGHT, REPOSITORY))
    run("systemctl", "daemon-reload")


@pytest.fixture
def silent_service() -> Iterator[None]:
    """The started service, on a bus with no other node."""
    run("systemctl", "reset-failed")
    run("systemctl", "start", "upright")
    yield
    run("systemctl", "stop", "upright")


@pytest.fixture
def service(silent_service: None) -> Iterator[dict[str, Any]]:
    """The status of the service once it has set up the drives of a virtual vehicle."""
    start_vehicle()
    yield wait_for_mode(Mode.DISARMED)
    run("systemctl", "stop", "vehicle")


def test_unit_file_passes_systemd_analyze(tmp_path: Path) -> None:
    assert run("systemd-analyze", "verify", "upright.service") == ""
    shipped = (
        tmp_path / "shipped.service"
    )  # by another name, so without the guest's drop-in, which opens /home and /tmp
    shipped.write_text((REPOSITORY / "systemd" / "upright.service").read_text())
    tenths = 15
    run("systemd-analyze", "security", "--offline=true", f"--threshold={tenths}", "--no-pager", shipped)


def test_realtime_drop_in_needs_nothing_else() -> None:
    """systemd sets the priority before it forbids the process to do so itself."""
    policy = (REPOSITORY / "systemd" / "upright.service.d" / "realtime.conf").read_text().split()
    properties = [f"--property={line}" for line in policy if line.startswith("CPUScheduling")]
    common = [
        "systemd-run",
        "--quiet",
        "--wait",
        "--pipe",
        "--property=User=upright",
        "--property=RestrictRealtime=yes",
    ]
    assert "SCHED_FIFO" in run(*common, *properties, "chrt", "--pid", "0")
    refused = subprocess.run([*common, "chrt", "--fifo", "1", "true"], capture_output=True, text=True, timeout=30)
    assert "Operation not permitted" in refused.stderr


def test_service_is_ready_disarmed_and_not_root(service: dict[str, Any]) -> None:
    assert show("ActiveState") == "active"
    assert "Operation enabled" not in drive_states(service)
    main = Path(f"/proc/{show('MainPID')}")
    assert main.stat().st_uid == int(run("id", "--user", "upright")) != 0
    answer = json.loads(run(UPRIGHT, "status", "--json", "--socket", SOCKET))
    assert answer["mode"] == "disarmed"
    observer = Path("/proc") / run("pgrep", "--full", "upright.service.observer.process")
    assert [int((process / "oom_score_adj").read_text()) for process in (main, observer)] == [-900, 500]


def test_interface_that_goes_down_and_comes_back(service: dict[str, Any]) -> None:
    process = show("MainPID")
    run("ip", "link", "set", "vcan0", "down")
    try:
        wait("the daemon says so", lambda: bool((status() or {"interlocks": []})["interlocks"]), 10.0)
    finally:
        run("ip", "link", "set", "vcan0", "up")
    run("systemctl", "restart", "vehicle")  # whose own socket is gone
    wait_for_mode(Mode.DISARMED)
    assert (show("MainPID"), show("NRestarts")) == (process, "0")


def test_daemon_killed_with_the_drives_enabled_restarts_disarmed(service: dict[str, Any]) -> None:
    ends = start_experiment()
    killed = show("MainPID")
    run("systemctl", "kill", "--signal=KILL", "--kill-whom=main", "upright")
    wait("systemd restarts it", lambda: show("NRestarts") == "1" and show("MainPID") not in ("0", killed), 20.0)
    assert "the daemon ended" in ends[0]
    found = wait_for_mode(Mode.DISARMED)
    assert "Operation enabled" not in drive_states(found)
    assert found["experiment"] is None


def test_hung_daemon_is_restarted_by_the_watchdog(service: dict[str, Any]) -> None:
    run("systemctl", "kill", "--signal=STOP", "--kill-whom=main", "upright")
    wait("the watchdog restarts it", lambda: show("NRestarts") == "1", 20.0)
    assert "Watchdog timeout" in journal()
    wait_for_mode(Mode.DISARMED)


def test_daemon_is_not_restarted_while_the_vehicle_is_switched_off(silent_service: None) -> None:
    watchdog_periods = 2.5
    time.sleep(watchdog_periods * 2.0)
    assert (show("NRestarts"), show("ActiveState")) == ("0", "active")
    assert (status() or {})["mode"] != Mode.RUNNING


def test_daemon_stopped_during_an_experiment_exits_cleanly_and_keeps_the_recording(service: dict[str, Any]) -> None:
    invocation = show("InvocationID")
    start_experiment()
    assert show("StatusText") == "running: experiment hold"
    run("systemctl", "stop", "upright")
    assert (show("Result"), show("ExecMainStatus"), show("ActiveState")) == ("success", "0", "inactive")
    assert not SOCKET.exists()
    assert list(Path("/var/lib/upright").glob("*.arrow")), "the recording of the interrupted experiment is kept"
    ended = records(f"_SYSTEMD_INVOCATION_ID={invocation}", "UPRIGHT_EXPERIMENT=hold", "UPRIGHT_CODE=end")
    fields = ("MESSAGE", "PRIORITY", "UPRIGHT_VEHICLE", "SYSLOG_IDENTIFIER", "CODE_FUNC")
    assert [tuple(record[field] for field in fields) for record in ended] == [
        ("the daemon is being stopped", "4", "monocab", "upright", "_event")
    ], journal()


@pytest.fixture
def drop_ins() -> Iterator[None]:
    """The shipped drop-ins, with the processor that the guest has, and time to start on it beside all else."""
    folder = Path("/etc/systemd/system/upright.service.d")
    shipped = REPOSITORY / "systemd" / "upright.service.d"
    texts = {name: (shipped / name).read_text() for name in ("realtime.conf", "cpu.conf", "metrics.conf")}
    texts["cpu.conf"] = texts["cpu.conf"].replace("CPUAffinity=3", "CPUAffinity=0").replace("CPUS=0-2", "CPUS=0")
    texts["guest-more.conf"] = f"[Service]\nEnvironment=PYTHONPATH={REPOSITORY}\n"
    for name, text in texts.items():
        (folder / name).write_text(text)
    run("systemctl", "daemon-reload")
    yield
    for name in texts:
        (folder / name).unlink()
    run("systemctl", "daemon-reload")


@pytest.mark.timeout(240)
def test_drop_ins_give_priority_and_locked_memory_to_the_control_process_alone(
    drop_ins: None, silent_service: None
) -> None:
    assert run("systemd-analyze", "verify", "upright.service") == ""
    control = int(show("MainPID"))
    helpers = [int(pid) for pid in run("pgrep", "--parent", str(control)).split()]
    assert len(helpers) == 2, "the observer and the raw log"
    policies = {pid: os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK for pid in (control, *helpers)}
    assert policies == {control: os.SCHED_FIFO, **dict.fromkeys(helpers, os.SCHED_OTHER)}
    locked = {pid: re.search(r"VmLck:\s+(\d+)", Path(f"/proc/{pid}/status").read_text()) for pid in policies}
    assert all(locked.values())
    kilobytes = {pid: int(found[1]) for pid, found in locked.items() if found}
    assert kilobytes[control] > 20_000, journal()
    assert not any(kilobytes[pid] for pid in helpers)
    assert "not locked" not in journal()

    done = subprocess.run([UPRIGHT, "doctor", VEHICLE, "--json"], capture_output=True, text=True, timeout=60)
    found = {each["check"]: each["status"] for each in json.loads(done.stdout)["checks"]}
    assert {name: found[name] for name in ("realtime", "memory", "unit", "permissions")} == dict.fromkeys(
        ("realtime", "memory", "unit", "permissions"), "ok"
    ), done.stdout
    wait("the metrics have the turnaround", lambda: b'turnaround_seconds_bucket{le="+Inf"}' in metrics(), 10.0)


def metrics() -> bytes:
    """The page that a Prometheus reads."""
    with urllib.request.urlopen("http://127.0.0.1:9464/metrics", timeout=10) as answer:
        return bytes(answer.read())
