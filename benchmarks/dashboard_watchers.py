"""Measure how watching pages affect the control loop: attached to its broker, or to one unrelated to it.

Users watch from machines of their own. Here the browsers and their server have one core, and the daemon, its broker and
the vehicle another. The control group removes the influence of the resources that both still share (memory, caches, the
clock of the cores): the same number of pages, drawing the same on the same core, attached to a broker on that core to
which another process publishes the data of a vehicle. They have nothing to do with the daemon and its broker.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import can
import numpy as np
from dashboard_parts import UPRIGHT, broker, browser, daemon, live, opened, server, until
from dashboard_story import Publisher
from scipy.stats import t as student

from upright.drivers.bus.address import connect
from upright.service.control.assembly import imu_config
from upright.vehicles.file import load
from upright.vehicles.sections import VehicleFile

BUS = "udp_multicast:239.74.163.91"
PAGES = 10
BLOCK = 6.0
"""s of one measurement."""
ROUNDS = 8
KINDS = ("nobody", "1 page", f"{PAGES} pages", f"{PAGES} elsewhere")
COMPARED = ((KINDS[1], KINDS[0]), (KINDS[2], KINDS[0]), (KINDS[3], KINDS[0]), (KINDS[2], KINDS[3]))


@contextmanager
def on(core: int) -> Iterator[None]:
    """Processes and threads that are started within this context stay on this core."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextmanager
def as_hardware() -> Iterator[None]:
    """Processes started within this context have real-time priority: an IMU and drives do not wait for the PC."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
    except PermissionError:
        print("the vehicle has no real-time priority (run as root): its delays are counted as the daemon's")
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


class Turnaround:
    """Times from the last frame of an IMU set to the first frame that control sends, by the kernel's time stamps."""

    def __init__(self, vehicle: VehicleFile) -> None:
        self.trigger = imu_config(vehicle).can_ids[-1]
        self.reply = 0x080  # SYNC, which follows the setpoints
        self._bus = connect(BUS, None, [self.trigger, self.reply])

    def close(self) -> None:
        self._bus.shutdown()

    def measure(self, seconds: float) -> tuple[list[float], int]:
        """The time of each cycle, ms, and how many were not answered before the next one."""
        found, open_since, missed = [], 0.0, 0
        begin, end = time.time(), time.monotonic() + seconds
        while time.monotonic() < end:
            message: can.Message | None = self._bus.recv(0.5)
            if message is None or message.timestamp < begin:  # an old frame from the receive queue
                continue
            if message.arbitration_id == self.trigger:
                missed += open_since > 0.0
                open_since = message.timestamp
            elif open_since:
                found.append(1e3 * (message.timestamp - open_since))
                open_since = 0.0
        return found, missed


@dataclass(frozen=True, slots=True)
class Block:
    """One measurement: median and 99 % quantile of the turnaround, ms; cycles that the loop missed, %; processor time
    of daemon and broker, s/s."""

    median: float
    slow: float
    missed: float
    used: dict[str, float]


def processor_time(root: int) -> float:
    """CPU time of a process and its descendants, s."""
    parents, used = {}, {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            try:
                fields = (folder / "stat").read_text().rpartition(")")[2].split()
            except OSError:  # it has ended
                continue
            parents[int(folder.name)] = int(fields[1])
            used[int(folder.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    family = {root}
    while more := {process for process, parent in parents.items() if parent in family} - family:
        family |= more
    return sum(used.get(process, 0.0) for process in family)


def publish_story(port: int) -> None:
    """Publish the data that the pages elsewhere show, in real time; run in a process of its own."""
    publisher = Publisher(load("monocab"), port, time.time())
    while True:
        publisher.steady(60.0)


def watchers(rounds: int) -> None:
    vehicle = load("monocab")
    ours, theirs = sorted(os.sched_getaffinity(0))[:2]
    print(f"daemon, broker and vehicle on core {ours}, browsers and the broker elsewhere on core {theirs}")
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder, other = Path(name), Path(name) / "elsewhere"
        other.mkdir()
        with on(theirs):
            far_plain, far_websocket, _ = stack.enter_context(broker(other))
            elsewhere = stack.enter_context(server(vehicle, other, far_websocket))
            words = [sys.executable, str(Path(__file__).with_name("dashboard.py")), "story", str(far_plain)]
            stack.callback(stack.enter_context(subprocess.Popen(words)).terminate)
            chromium = stack.enter_context(browser())
        with on(ours):
            plain, websocket, broker_process = stack.enter_context(broker(folder))
            words = [*UPRIGHT, "simulate", "monocab", "--bus", BUS]
            with as_hardware():
                vehicle_process = stack.enter_context(subprocess.Popen(words, stderr=subprocess.DEVNULL))
            stack.callback(vehicle_process.terminate)
            place, daemon_process = stack.enter_context(daemon(folder, "--bus", BUS, "--mqtt", f"127.0.0.1:{plain}"))
            here = stack.enter_context(server(vehicle, folder, websocket))
        processes = {"daemon": daemon_process, "broker": broker_process}
        turnaround = Turnaround(vehicle)
        stack.callback(turnaround.close)
        pages = [opened(chromium, "about:blank") for _ in range(PAGES)]

        def attach(kind: str) -> None:
            wanted = {KINDS[1]: [here], KINDS[2]: [here] * PAGES, KINDS[3]: [elsewhere] * PAGES}.get(kind, [])
            for number, page in enumerate(pages):
                page.goto(wanted[number] if number < len(wanted) else "about:blank", wait_until="commit")
            for page in pages[: len(wanted)]:
                live(page)
            time.sleep(1.0)

        def block(kind: str) -> Block:
            attach(kind)
            missed = until(place, lambda status: True)["missed_cycles"]
            before = {what: processor_time(root) for what, root in processes.items()}
            times, unanswered = turnaround.measure(BLOCK)
            used = {what: (processor_time(root) - before[what]) / BLOCK for what, root in processes.items()}
            missed = until(place, lambda status: True)["missed_cycles"] - missed
            median, slow = np.quantile(times, (0.5, 0.99))
            busy = ", ".join(f"{what} {100.0 * each:.1f} %" for what, each in used.items())
            print(
                f"{kind:13} median {median:.3f} ms, 99 % {slow:.2f} ms, longest {max(times):.1f} ms, "
                f"{unanswered} unanswered, {missed} missed by the loop's own count; of a core: {busy}",
                flush=True,
            )
            return Block(float(median), float(slow), 100.0 * missed / (BLOCK * vehicle.control.rate), used)

        # Each round has an order of its own, so that a drift does not look like a difference; the seed is arbitrary.
        orders = np.random.default_rng(1)
        blocks = [{kind: block(kind) for kind in orders.permutation(KINDS).tolist()} for _ in range(rounds)]
    compare(blocks)


def compare(rounds: list[dict[str, Block]]) -> None:
    """Print the differences within a round, with the 95 % interval of Student's distribution over the rounds: the
    geometric mean of the ratios of times, and the difference of missed cycles, since those may be zero."""
    for what, beside in COMPARED:
        for name, label in (("median", "median"), ("slow", "99 %")):
            ratios = np.log([getattr(each[what], name) / getattr(each[beside], name) for each in rounds])
            low, centre, high = np.exp(interval(ratios))
            print(f"{what:13} over {beside:13} {label:6}: {centre:.2f} x, 95 % interval {low:.2f} to {high:.2f}")
        low, centre, high = interval(np.array([each[what].missed - each[beside].missed for each in rounds]))
        print(f"{what:13} minus {beside:13} missed: {centre:+.2f} % of the cycles, {low:+.2f} to {high:+.2f}")
    for process in rounds[0][KINDS[0]].used:
        used = {kind: 100.0 * float(np.mean([each[kind].used[process] for each in rounds])) for kind in KINDS}
        print(f"{process}, % of a core:", ", ".join(f"{kind} {each:.1f}" for kind, each in used.items()))


def interval(values: np.ndarray) -> tuple[float, float, float]:
    """Low end, mean and high end of the mean's 95 % interval."""
    middle = float(values.mean())
    reach = float(student.ppf(0.975, len(values) - 1) * values.std(ddof=1)) / len(values) ** 0.5
    return middle - reach, middle, middle + reach
