"""Turnaround while clients of the control socket misbehave, compared with that of the quiet times between, in one run.

    tests/guest/vcan-guest .venv/bin/python benchmarks/clients.py
    .venv/bin/python benchmarks/clients.py --work

A virtual MONOCAB runs an experiment on SocketCAN, in real time, and one terminal holds the lease. Quiet and hostile
windows alternate, so that what the computer does otherwise is in both. The turnaround is the time from the last frame
of an IMU set to the first setpoint, by time stamps of the kernel (see turnaround.py). At the end, a stop has to get
through while all of them hammer. Exit code 1 if the experiment did not last until then.

With --work the CPU time is measured that the control process spends from one cycle to the next on everything but the
cycle, whatever else the computer does. The vehicle is in the same process then, and waits for it.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from hostile_client import KINDS
from turnaround import Monitor, answered, running
from vehicle_at import at_rate

from upright.drivers.bus.bus import BusError
from upright.service.control.clients.api import ApiError, call
from upright.service.control.cycle.operation import Mode
from upright.service.control.daemon import Daemon, Places
from upright.service.virtual.serving import virtual_vehicle_beside
from upright.telemetry.samples import CanFrame
from upright.vehicles.file import load

HERE = Path(__file__).resolve().parent
UPRIGHT = [sys.executable, "-c", "from upright.service.cli import main; main()"]
FIRST, SECOND = (["chrt", "--reset-on-fork", "--fifo", priority] for priority in ("20", "10"))
"""As systemd/upright.service.d/realtime.conf gives the daemon; the vehicle comes first, as a real one does not wait."""
READER = 5
"""Real-time priority of this process, which only reads, five times a second: it must not starve beside the clients."""
TRIGGER, REPLY = 0x38A, 0x201
READY_TIME = 300.0
"""s for the daemon to start, set up the drives and lift the vehicle."""
SETTLE_TIME = 0.5
"""s from the start of the clients to the beginning of a window."""
PHASES = {"rest": "rest", "hold": "excite"}
"""Experiments, and the phase in which they stay."""
HAMMERS = 4
"""Processes of each kind."""


@contextmanager
def hostile(kind: str, path: Path) -> Iterator[None]:
    """Four processes of this kind of client, or one of each of `all`."""
    kinds = list(KINDS) if kind == "all" else [kind] * HAMMERS
    command = [sys.executable, "-I", "-S", str(HERE / "hostile_client.py")]
    made = [subprocess.Popen([*command, each, str(path)], stdout=subprocess.PIPE) for each in kinds]
    try:
        for process in made:
            assert process.stdout is not None
            process.stdout.readline()  # it has begun
        yield
    finally:
        for process in made:
            process.kill()
        for process in made:
            process.communicate()


# --- The measurement


@dataclass
class Window:
    """What was measured while clients of one kind were there, and in the quiet windows before each of theirs."""

    kind: str
    times: list[np.ndarray] = field(default_factory=list)
    """Turnaround in s."""
    missed: int = 0
    quiet: list[np.ndarray] = field(default_factory=list)
    quiet_missed: int = 0

    def row(self) -> dict[str, Any]:
        found: dict[str, Any] = {"kind": self.kind}
        for name, windows, missed in (("with", self.times, self.missed), ("without", self.quiet, self.quiet_missed)):
            times = np.concatenate(windows)
            found[name] = {
                "cycles": times.size + missed,
                "missed": missed,
                **{key: float(np.quantile(times, q)) for key, q in (("p50", 0.5), ("p99", 0.99), ("p999", 0.999))},
            }
        found["ratios"] = {key: found["with"][key] / found["without"][key] for key in ("p50", "p99", "p999")}
        return found


@dataclass(frozen=True)
class Outcome:
    """What became of the experiment meanwhile. Times in s."""

    lasted: bool
    stop_took: float
    longest_silence: float
    """Of the terminal that holds the lease, as the daemon heard it."""
    text: str


def ask(path: Path, verb: str, **arguments: Any) -> dict[str, Any]:
    return list(call([path], {"verb": verb, **arguments}, timeout=60.0))[-1]


def until(path: Path, what: Callable[[dict[str, Any]], bool]) -> None:
    limit = time.monotonic() + READY_TIME
    status: dict[str, Any] = {}
    while time.monotonic() < limit:
        with suppress(ApiError):
            status = ask(path, "status")["status"]
            if what(status):
                return
        time.sleep(0.3)
    log = path.with_name("serve.log").read_text(errors="replace")[-2000:]
    raise SystemExit(f"not ready: {status.get('reason')} {status.get('interlocks')}\n{log}")


def measure(
    experiment: str, kinds: list[str], rounds: int, seconds: float, path: Path, monitor: Monitor
) -> tuple[list[dict[str, Any]], Outcome]:
    """Quiet and hostile windows in turn, while an experiment runs."""
    found = {kind: Window(kind) for kind in kinds}
    with running([*UPRIGHT, "experiment", experiment, "--socket", str(path)], path.with_name("experiment.log")):
        until(path, lambda status: status["phase"] == PHASES[experiment])
        monitor.discard()
        for _ in range(rounds):
            for kind, window in found.items():
                monitor.discard()  # what came while processes began and ended
                times, missed = answered(*monitor.read(seconds))
                window.quiet.append(times)
                window.quiet_missed += missed
                with hostile(kind, path):
                    monitor.discard()  # what came while processes began and ended
                    times, missed = answered(*monitor.read(seconds))
                window.times.append(times)
                window.missed += missed
        status = ask(path, "status")["status"]
        lasted = status["phase"] == PHASES[experiment]
        with hostile("all", path):
            time.sleep(SETTLE_TIME)
            began = time.monotonic()
            answer = ask(path, "stop")
            took = time.monotonic() - began
        silence = (status["lease"] or {}).get("longest_silence", float("nan"))
        text = answer["text"] if lasted else status["reason"]
    return [window.row() for window in found.values()], Outcome(lasted, took, silence, text)


async def between_cycles(kinds: list[str], rounds: int, seconds: float, folder: Path) -> dict[str, np.ndarray]:
    """CPU time (n,) in s of the event loop's thread from one cycle to the next, without the cycle, by kind of client.
    Quiet and hostile windows alternate."""
    vehicle, bus = load("monocab"), "virtual:benchmark-clients"
    found: dict[str, list[float]] = {kind: [] for kind in ("none", *kinds, "")}
    now, spent, mark, cycle = "", 0.0, time.thread_time(), False
    with virtual_vehicle_beside(vehicle, ["disturbance=0"], 1, bus):
        daemon = Daemon(vehicle, Places(bus, bus, folder, folder / "s.sock"), lock_step=True)
        take, on_frames = daemon._turns.take, daemon._on_frames

        def turn() -> None:
            nonlocal mark
            if cycle:  # else it is a turn by the timer, which counts as a whole
                mark = time.thread_time()
            take()

        def counted(frames: list[CanFrame]) -> None:
            nonlocal spent, mark, cycle
            spent += time.thread_time() - mark
            cycles, cycle = daemon.loop.cycles, True
            on_frames(frames)
            cycle = False
            if daemon.loop.cycles == cycles:
                mark = time.thread_time()
            else:
                found[now].append(spent)
                spent = 0.0

        daemon._turns.take, daemon._on_frames = turn, counted  # type: ignore[method-assign]
        serving = asyncio.create_task(daemon.run())
        while daemon.loop.mode is not Mode.DISARMED or daemon.loop.interlocks():
            await asyncio.sleep(0.1)
        for _ in range(rounds):
            for kind in kinds:
                now = "none"
                await asyncio.sleep(seconds)
                now = ""
                with ExitStack() as clients:
                    await asyncio.to_thread(clients.enter_context, hostile(kind, folder / "s.sock"))
                    await asyncio.sleep(SETTLE_TIME)
                    now = kind
                    await asyncio.sleep(seconds)
                    now = ""
        daemon.stop()
        await serving
    return {kind: np.array(times) for kind, times in found.items() if kind}


def print_work(found: dict[str, np.ndarray]) -> None:
    print(f"{'us of CPU a cycle':20}{'cycles':>8}{'p50':>8}{'p99':>8}{'p99.9':>8}{'longest':>9}")
    for kind, times in found.items():
        quantiles = "".join(f"{1e6 * np.quantile(times, q):8.0f}" for q in (0.5, 0.99, 0.999))
        print(f"{kind:20}{times.size:8}{quantiles}{1e6 * times.max():9.0f}")


def vehicle_file(rate: float, experiment: str) -> str:
    """The shipped vehicle at another rate, with an experiment of an hour, for a client that shares the guest's
    processor."""
    before, section = at_rate(rate).split(f"[experiments.{experiment}]")
    assert "duration = 20.0" in section.split("[experiments")[0]
    text = f"{before}[experiments.{experiment}]{section.replace('duration = 20.0', 'duration = 3600.0', 1)}"
    return text.replace("heartbeat_timeout =", "lease = 2.0\nheartbeat_timeout =")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--bus", default="socketcan:vcan0", help="IFACE:CHANNEL")
    parser.add_argument("--experiment", choices=PHASES, default="rest", help="hold, on a computer that keeps real time")
    parser.add_argument("--rate", type=float, default=250.0, help="Hz")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=8.0, help="of each window")
    parser.add_argument("--kind", action="append", choices=[*KINDS, "all"], help="may be repeated (each, and all)")
    parser.add_argument("--work", action="store_true", help="CPU time between two cycles, without a bus")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    kinds = options.kind or [*KINDS, "all"]
    if options.work:
        with tempfile.TemporaryDirectory() as folder:
            print_work(asyncio.run(between_cycles(kinds, options.rounds, options.seconds, Path(folder))))
        return 0
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(READER))
    with ExitStack() as stack:
        work = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        try:
            monitor = Monitor(options.bus, TRIGGER, REPLY)
        except BusError as error:
            print(f"{error}\nOr run this in tests/guest/vcan-guest.", file=sys.stderr)
            return 1
        stack.callback(monitor.close)
        file, path = work / "monocab.toml", work / "s.sock"
        file.write_text(vehicle_file(options.rate, options.experiment))
        bus = ["--bus", options.bus, "--socket", str(path)]
        simulate = [*FIRST, *UPRIGHT, "simulate", str(file), *bus, "--hide", "disturbance=0"]
        serve = [*SECOND, *UPRIGHT, "serve", str(file), *bus, "--data", str(work)]
        stack.enter_context(running(simulate, work / "simulate.log"))
        stack.enter_context(running(serve, work / "serve.log"))
        until(path, lambda status: status["mode"] == "disarmed" and not status["interlocks"])
        rows, outcome = measure(options.experiment, kinds, options.rounds, options.seconds, path, monitor)
        clients = ask(path, "status")["status"].get("clients")
    if options.json:
        print(json.dumps({"rows": rows, "outcome": asdict(outcome), "clients": clients}))
        return 0 if outcome.lasted else 1
    print(f"{'us':12}{'p50':>14}{'p99':>16}{'p99.9':>16}{'missed':>20}   ratio p50   p99   p99.9")
    for row in rows:
        one, two = row["without"], row["with"]
        times = "".join(f"{1e6 * one[key]:8.0f}{1e6 * two[key]:8.0f}" for key in ("p50", "p99", "p999"))
        missed = f"{one['missed']}, {two['missed']} of {two['cycles']}"
        ratios = "".join(f"{row['ratios'][key]:8.2f}" for key in ("p50", "p99", "p999"))
        print(f"{row['kind']:10}{times}{missed:>22}  {ratios}")
    print(f"\nThe experiment {'lasted' if outcome.lasted else 'DID NOT LAST'}; its end: {outcome.text}.")
    print(
        f"Longest silence of its terminal: {outcome.longest_silence:.2f} s. While all clients hammered, it took a stop"
    )
    print(f"{outcome.stop_took:.1f} s to bring the vehicle onto its support. Connections: {clients}")
    return 0 if outcome.lasted else 1


if __name__ == "__main__":
    sys.exit(main())
