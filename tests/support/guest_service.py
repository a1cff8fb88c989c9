"""The service upright under the guest's systemd: how tests install, ask and wait for it."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from upright.service.control.clients import api
from upright.service.control.cycle.operation import Mode

REPOSITORY = Path(__file__).resolve().parents[2]
UPRIGHT = Path(sys.executable).parent / "upright"
SOCKET = Path("/run/upright/monocab.sock")
VEHICLE = Path("/etc/upright/vehicle.toml")


def run(*command: str | Path, seconds: float = 60.0) -> str:
    """The output of a command, which has to succeed in this time."""
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=seconds)
    assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}{journal()}"
    return done.stdout.strip()


def journal() -> str:
    """The last lines of the service in the journal."""
    return subprocess.run(
        ["journalctl", "--unit=upright", "--no-pager", "--lines=60"], capture_output=True, text=True, timeout=60
    ).stdout


def show(name: str) -> str:
    """A property of the unit."""
    return run("systemctl", "show", "--value", "--property", name, "upright")


def status() -> dict[str, Any] | None:
    """The status that the daemon reports; None while it cannot be reached."""
    try:
        return list(api.call([SOCKET], {"verb": "status"}))[-1]["status"]  # type: ignore[no-any-return]
    except api.ApiError:
        return None


def wait(what: str, met: Callable[[], bool], seconds: float) -> None:
    """Wait until `what` is met, at most for `seconds`."""
    limit = time.monotonic() + seconds
    while not met():
        assert time.monotonic() < limit, f"not within {seconds} s: {what}; {status()}\n{journal()}"
        time.sleep(0.1)


def wait_for_mode(mode: Mode, seconds: float = 30.0) -> dict[str, Any]:
    """The status of the daemon once it is in this mode."""
    wait(f"mode {mode}", lambda: (status() or {}).get("mode") == mode, seconds)
    found = status()
    assert found is not None
    return found


def records(*matches: str) -> list[dict[str, Any]]:
    """The journal's records with these fields, FIELD=VALUE."""
    run("journalctl", "--sync")  # what was sent just now, too
    lines = run("journalctl", "--output=json", "--no-pager", *matches).splitlines()
    return [json.loads(line) for line in lines]


def drop_in(upright: Path, modules: Path) -> str:
    """What differs from the shipped unit: whose `upright`, Python's further `modules`, the bus, and no private /home
    and /tmp, since the checkout and its Python may lie in either."""
    return f"""
[Service]
Environment=PYTHONPATH={modules}
ExecStart=
ExecStart={upright} serve ${{VEHICLE}} --bus socketcan:vcan0
ProtectHome=no
PrivateTmp=no
ReadWritePaths=/tmp
"""


def write_vehicle() -> None:
    """Write the vehicle file of the service, as shipped."""
    VEHICLE.write_text((REPOSITORY / "vehicles" / "monocab" / "vehicle.toml").read_text())


def open_to_the_service() -> None:
    """Let the user upright reach the interpreter and the checkout."""
    for place in (Path(sys.base_prefix), REPOSITORY):
        for folder in place.parents:
            if not folder.stat().st_mode & 0o001:
                folder.chmod(folder.stat().st_mode | 0o011)


def start_vehicle() -> None:
    """Start a virtual vehicle on the service's bus, until `systemctl stop vehicle`."""
    checkout = f"--setenv=PYTHONPATH={REPOSITORY}"
    run("systemd-run", "--unit=vehicle", "--quiet", checkout, UPRIGHT, "simulate", VEHICLE, "--bus", "socketcan:vcan0")


def start_experiment() -> list[str]:
    """Start an experiment and wait until the drives are enabled. Its final text is added to the list when it ends."""
    ends: list[str] = []
    wait(
        "nothing keeps an experiment from starting",
        lambda: not (status() or {"interlocks": ["no answer"]})["interlocks"],
        30.0,
    )

    def follow() -> None:
        try:
            ends.append(list(api.call([SOCKET], {"verb": "experiment", "name": "hold"}, timeout=None))[-1]["text"])
        except api.ApiError as error:
            ends.append(str(error))

    threading.Thread(target=follow, daemon=True).start()
    wait("the drives are enabled", lambda: drive_states(status()) == {"Operation enabled"} or bool(ends), 20.0)
    assert not ends
    return ends


def drive_states(document: dict[str, Any] | None) -> set[str]:
    """The states of the drives in a status."""
    return {drive["state"] for drive in (document or {}).get("drives", [])}
