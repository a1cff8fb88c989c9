"""Soak: experiments one after the other on the virtual vehicle in real time, for an hour; printed as one table.

    tests/guest/vcan-guest .venv/bin/python benchmarks/soak.py --minutes 60
    .venv/bin/python benchmarks/soak.py --minutes 60 --virtual

Daemon, observer, raw log and virtual vehicle run on SocketCAN as they do in service. After each experiment, at rest,
the memory of each process is read (RssAnon: what it has allocated itself). The turnaround of the control loop and the
heartbeats are taken from the kernel's time stamps at a third socket. Nothing may grow: of each column, the slope of a
straight line over the run is compared with its own uncertainty. Exit code 1 if something grows, a heartbeat is missed
or an experiment fails. With --virtual the vehicle is in the daemon's process and waits for it, so that this runs beside
other work: it shows memory and descriptors only.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from clients import FIRST, READER, REPLY, SECOND, TRIGGER, UPRIGHT, ask, until
from scipy.stats import t as student
from turnaround import answered, listening, running

from upright.drivers.bus.bus import BusError
from upright.drivers.cia301.nmt import HEARTBEAT_COB_ID
from upright.vehicles.file import load

EXPERIMENTS = ("doublet", "step", "multisine", "hold", "square")
WARM_UP = 1.0 / 3.0
"""Share of the runs at the beginning whose growth counts for nothing: each process meets everything once."""
CHANCE = 1e-4
"""Probability that noise alone makes a slope that counts."""
ARENA = 1.05
"""MB: Python takes memory from the system in arenas of 1 MiB. Less than one in the whole run is no growth."""
LEAST = 6
"""Experiments, whatever the time: fewer have no slope."""
READ_PERIOD = 0.2


@dataclass(frozen=True)
class Run:
    """One experiment. Memory in MB by process; times in s."""

    at: float
    name: str
    exit_code: int
    code: str
    memory: dict[str, float]
    descriptors: dict[str, int]
    p50: float
    p99: float
    cycles: int
    missed: int
    longest_heartbeat: float
    frames_dropped: int


@dataclass(frozen=True)
class Trend:
    """The slope of a quantity over the runs after the warm-up, per hour, and its standard deviation. These runs take
    `hours`, and count as `freedom` and two independent ones."""

    quantity: str
    mean: float
    slope: float
    deviation: float
    hours: float
    freedom: float
    resolution: float

    @property
    def grows(self) -> bool:
        """Whether the slope is neither chance (Student's t) nor below the resolution of the quantity."""
        chance = float(student.isf(CHANCE, self.freedom)) * self.deviation
        return self.slope > chance and self.slope * self.hours > self.resolution


def trend(quantity: str, at: Sequence[float], values: Sequence[float], resolution: float = 0.0) -> Trend:
    """The least-squares line of `values` at times `at`, s. Values that depend on those before count as fewer (Santer et
    al., J. Geophys. Res. 105, 2000)."""
    skip = round(WARM_UP * len(at))
    time, value = np.asarray(at[skip:]) / 3600.0, np.asarray(values[skip:], dtype=float)
    offset = time - time.mean()
    slope = float(offset @ value / (offset @ offset))
    rest = value - value.mean() - slope * offset
    spread = float(rest @ rest)
    correlation = max(float(rest[1:] @ rest[:-1]) / spread, 0.0) if spread > 0.0 else 0.0
    freedom = max(time.size * (1.0 - correlation) / (1.0 + correlation) - 2.0, 1.0)
    deviation = (spread / freedom / float(offset @ offset)) ** 0.5
    return Trend(quantity, float(value.mean()), slope, deviation, float(np.ptp(time)), freedom, resolution)


class Witness:
    """A third socket on the bus: IMU sets, setpoints and heartbeats with the kernel's time stamps."""

    def __init__(self, bus: str, master: int) -> None:
        self._heartbeat = HEARTBEAT_COB_ID + master
        self._bus = listening(bus, [TRIGGER, REPLY, self._heartbeat])
        self.stamps: dict[int, list[int]] = {TRIGGER: [], REPLY: [], self._heartbeat: []}

    def discard(self) -> None:
        """Forget what came until now, and what was lost of it, which the kernel says with the next frame."""
        for _ in range(2):
            while self._bus.drain():
                pass
            time.sleep(READ_PERIOD)

    def read(self) -> None:
        dropped = self._bus.statistics.receive_dropped
        while frames := self._bus.drain():
            for frame in frames:
                self.stamps[frame.can_id].append(frame.timestamp_ns)
        if self._bus.statistics.receive_dropped > dropped:
            raise SystemExit("the witness itself was too slow: the kernel dropped frames for it")

    def take(self) -> tuple[np.ndarray, float]:
        """Turnaround (n,) in s, and the longest time between two heartbeats, since the last call."""
        self.read()
        times, _ = answered(self.stamps[TRIGGER], self.stamps[REPLY])
        beats = self.stamps[self._heartbeat]
        longest = float(np.diff(beats).max()) * 1e-9 if len(beats) > 1 else float("nan")
        for each in self.stamps.values():
            del each[:-1]
        return times, longest

    def close(self) -> None:
        self._bus.close()


def processes(daemon: int, vehicle: int | None) -> dict[str, int]:
    """Process ids by name: the daemon and what it has started, and the virtual vehicle if it has its own."""
    found = {"control": daemon} if vehicle is None else {"control": daemon, "vehicle": vehicle}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has just ended
            parent = int(folder.joinpath("stat").read_text().rpartition(")")[2].split()[1])
            if parent == daemon:
                command = folder.joinpath("cmdline").read_text()
                found["raw log" if "raw_log" in command else "observer"] = int(folder.name)
    return found


def memory(process: int) -> float:
    """MB that the process has allocated itself."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon")) / 1024.0


class Soak:
    """Runs experiments in turn on a daemon and a vehicle that are ready, and keeps what was measured."""

    def __init__(self, path: Path, witness: Witness | None, daemon: int, vehicle: int | None) -> None:
        self.runs: list[Run] = []
        self._path = path
        self._witness = witness
        self._processes = processes(daemon, vehicle)
        self._began = time.monotonic()
        self._missed = self._status()["missed_cycles"]
        if witness is not None:
            witness.discard()

    def run(self, name: str) -> Run:
        """One experiment, from rest to rest."""
        cycles = self._status()["cycles"]
        with ThreadPoolExecutor(1) as pool:
            answer = self._wait(pool.submit(ask, self._path, "experiment", name=name))
        while (status := self._status())["interlocks"]:
            if status["mode"] == "fault":
                ask(self._path, "reset")
            self._pause()
        nothing = (np.array([np.nan]), np.nan)
        times, heartbeat = self._witness.take() if self._witness is not None else nothing
        status = self._status()
        missed, self._missed = status["missed_cycles"] - self._missed, status["missed_cycles"]
        ids = self._processes
        run = Run(
            at=time.monotonic() - self._began,
            name=name,
            exit_code=answer["exit_code"],
            code=answer["code"],
            memory={each: memory(ids[each]) for each in ids},
            descriptors={each: len(os.listdir(f"/proc/{ids[each]}/fd")) for each in ids},
            p50=float(np.quantile(times, 0.5)),
            p99=float(np.quantile(times, 0.99)),
            cycles=status["cycles"] - cycles,
            missed=missed,
            longest_heartbeat=heartbeat,
            frames_dropped=status["observer"]["frames_dropped"] + status["observer"]["can_frames_dropped"],
        )
        self.runs.append(run)
        return run

    def trends(self) -> list[Trend]:
        """Of each quantity that must not grow."""
        at = [run.at for run in self.runs]
        found = [trend(f"{each}, MB", at, [run.memory[each] for run in self.runs], ARENA) for each in self._processes]
        found += [trend(f"{each}, files", at, [run.descriptors[each] for run in self.runs]) for each in self._processes]
        if self._witness is None:
            return found
        found.append(trend("turnaround p50, us", at, [1e6 * run.p50 for run in self.runs]))
        found.append(trend("turnaround p99, us", at, [1e6 * run.p99 for run in self.runs]))
        found.append(trend("missed cycles, %", at, [100.0 * run.missed / run.cycles for run in self.runs]))
        return found

    def _wait(self, answer: Future[dict[str, Any]]) -> dict[str, Any]:
        while not answer.done():
            self._pause()
        return answer.result()

    def _pause(self) -> None:
        time.sleep(READ_PERIOD)
        if self._witness is not None:
            self._witness.read()

    def _status(self) -> dict[str, Any]:
        status: dict[str, Any] = ask(self._path, "status")["status"]
        return status


def vehicle_file(names: Sequence[str], duration: float) -> str:
    """The shipped MONOCAB with experiments of at most `duration` s, for a computer that is not real-time: a delay of
    it shall be a missed cycle in the table, and not end the soak."""
    vehicle = load("monocab")
    text = Path(vehicle.path).read_text()
    for name in names:
        before, section = text.split(f"[experiments.{name}]")
        shipped = vehicle.experiments[name].duration
        short = section.replace(f"duration = {shipped}", f"duration = {min(shipped, duration)}", 1)
        text = f"{before}[experiments.{name}]{short}"
    for old, new in (
        ("missed_cycles = 7 ", "missed_cycles = 50 "),
        ("heartbeat_timeout = 0.12", "lease = 2.0\nheartbeat_timeout = 0.6"),
    ):
        assert old in text
        text = text.replace(old, new)
    return text


def report(soak: Soak, trends: list[Trend], timeout: float) -> list[str]:
    """Print the tables; return what is not as it has to be."""
    print(f"\n{'':26}{'mean':>10}{'slope per hour':>18}{'±':>10}   over the last two thirds of the runs")
    for each in trends:
        print(f"{each.quantity:26}{each.mean:10.2f}{each.slope:18.3f}{each.deviation:10.3f}{'   GROWS' * each.grows}")
    beats = max(run.longest_heartbeat for run in soak.runs)
    cycles, missed = sum(run.cycles for run in soak.runs), sum(run.missed for run in soak.runs)
    dropped = soak.runs[-1].frames_dropped
    print(f"\n{len(soak.runs)} experiments in {soak.runs[-1].at / 60.0:.1f} min, {cycles} cycles, {missed} missed.")
    if np.isfinite(beats):
        print(f"Longest time between two heartbeats: {1e3 * beats:.0f} ms; the drives wait for {1e3 * timeout:.0f} ms.")
    wrong = [f"{each.quantity} grows" for each in trends if each.grows]
    wrong += [f"{run.name} ended with {run.code}" for run in soak.runs if run.exit_code != 0]
    wrong += [f"a heartbeat was missed: {beats:.3f} s"] if beats >= timeout else []
    wrong += [f"{dropped} frames for the observer were dropped"] if dropped else []
    return wrong


def begun(stack: ExitStack, options: argparse.Namespace, file: Path, path: Path) -> Soak:
    """The soak of a daemon and a vehicle that are ready, until the end of `stack`. Raises BusError."""
    place = ["--data", str(path.parent), "--socket", str(path)]
    witness, vehicle = None, None
    if options.virtual:
        serve = [*UPRIGHT, "serve", str(file), "--virtual", *place]
    else:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(READER))
        witness = Witness(options.bus, load(str(file)).control.master_node)
        stack.callback(witness.close)
        simulate = [*FIRST, *UPRIGHT, "simulate", str(file), "--bus", options.bus, "--socket", str(path)]
        serve = [*SECOND, *UPRIGHT, "serve", str(file), "--bus", options.bus, *place]
        vehicle = stack.enter_context(running(simulate, path.with_name("simulate.log"))).pid
    daemon = stack.enter_context(running(serve, path.with_name("serve.log")))
    until(path, lambda status: status["mode"] == "disarmed" and not status["interlocks"])
    return Soak(path, witness, daemon.pid, vehicle)


def show(run: Run) -> None:
    """One line of the table."""
    used = ", ".join(f"{name} {size:.1f}" for name, size in run.memory.items())
    times = f"{1e6 * run.p50:.0f}, {1e6 * run.p99:.0f}"
    missed = f"{run.missed} of {run.cycles}"
    beat = f"{1e3 * run.longest_heartbeat:.0f}"
    what = f"{run.at / 60.0:5.1f}  {run.name:11}{run.code or 'done':9}"
    print(f"{what}{times:>14}{missed:>14}{beat:>14}   {used}", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--bus", default="socketcan:vcan0", help="IFACE:CHANNEL")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--experiment", action="append", help=f"may be repeated ({', '.join(EXPERIMENTS)})")
    parser.add_argument("--duration", type=float, default=30.0, help="s of each experiment at most")
    parser.add_argument("--virtual", action="store_true", help="the vehicle in the daemon's process, in lock-step")
    parser.add_argument("--json", type=Path, help="write what was measured to this file")
    options = parser.parse_args()
    names = options.experiment or EXPERIMENTS
    with ExitStack() as stack:
        work = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        file, path = work / "monocab.toml", work / "s.sock"
        file.write_text(vehicle_file(names, options.duration))
        control = load(str(file)).control
        try:
            soak = begun(stack, options, file, path)
        except BusError as error:
            print(f"{error}\nOr run this in tests/guest/vcan-guest, or with --virtual.", file=sys.stderr)
            return 1
        print(f"{'min':>5}  {'experiment':11}{'end':9}{'p50, p99 us':>14}{'missed':>14}{'heartbeat ms':>14}   MB")
        for name in cycle(names):
            show(soak.run(name))
            for recording in work.glob(f"*_{name}.*"):  # else the soak fills the disk
                recording.unlink()
            if soak.runs[-1].at > 60.0 * options.minutes and len(soak.runs) >= LEAST:
                break
        trends = soak.trends()
        wrong = report(soak, trends, control.heartbeat_timeout)
    if options.json:
        options.json.write_text(json.dumps({"runs": [asdict(run) for run in soak.runs],
                                            "trends": [asdict(each) for each in trends], "wrong": wrong}))  # fmt: skip
    print("".join(f"WRONG: {each}\n" for each in wrong) or "Nothing grows, and nothing was missed.")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
