"""What the dashboard costs: its memory after hours, its pictures a second, its delay, and what it does to the loop.

    OPENBLAS_NUM_THREADS=1 .venv/bin/python benchmarks/dashboard.py [soak] [latency] [browsers]

Real parts throughout: Debian's mosquitto, the shipped page in Debian's Chromium, and the daemon with a virtual vehicle.

soak      four hours of telemetry, parameters, diagnoses and events, as fast as the page takes them; then at the real
          rate: memory of the page (JavaScript heap after a collection; resident and unshared memory of its renderer)
          and pictures a second in each view
latency   from the time stamp of a sample to the frame of the browser after the one that drew it, at rest and in an
          experiment that the page holds; how long its signs of life stayed away at most
browsers  from the last frame of an IMU set to the first setpoint on the bus, with 0, 1 and 10 pages attached, and with
          10 bare websocket clients, which use none of the processor time that ten browsers on this machine do; in
          alternating order, each as a ratio to the block without anybody right before or after it
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from math import cos, pi, sin
from pathlib import Path
from typing import Any

import can
import numpy as np
import paho.mqtt.client as mqtt
import uvicorn
from playwright.sync_api import Browser, Page, expect, sync_playwright

from drivers.bus_address import connect
from service.api import ApiError, call
from service.assembly import imu_config
from service.dashboard.app import Dashboard, Settings
from service.mqtt_payloads import TelemetryBatches
from service.vehicle_file import load
from service.vehicle_sections import VehicleFile
from telemetry.channels import MONOCAB
from telemetry.samples import Frame

HOURS = 4.0
AHEAD = 20.0
"""s of data that the page may be behind what is sent; of more the broker would drop some."""
BUS = "udp_multicast:239.74.163.91"
BLOCK = 15.0
"""s of one measurement of the loop."""
ROUNDS = 3
UPRIGHT = [sys.executable, "-c", "from service.cli import main; main()"]
VIEWS = ("live", "experiments", "identify", "gap", "recordings")

PICTURES = """seconds => new Promise((resolve) => {
  const begin = performance.now(); let count = 0, last = begin, longest = 0;
  requestAnimationFrame(function each(now) {
    count += 1; longest = Math.max(longest, now - last); last = now;
    if (now - begin < 1000 * seconds) requestAnimationFrame(each);
    else resolve([1000 * count / (now - begin), longest]);
  });
})"""
"""Pictures a second, and the longest time between two of them, ms."""

DELAYS = """seconds => new Promise((resolve) => {
  const output = document.querySelector("[id^=value-]"), delays = [], begin = performance.now();
  let seen = output.dataset.time, drawn = null;
  requestAnimationFrame(function each(now) {
    if (drawn !== null) { delays.push(Date.now() - 1000 * drawn); drawn = null; }
    if (output.dataset.time !== seen) { seen = output.dataset.time; drawn = Number(seen); }
    if (now - begin < 1000 * seconds) requestAnimationFrame(each); else resolve(delays);
  });
})"""
"""ms from the newest sample of a picture to the beginning of the picture after it: by then it is on the screen."""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def broker(folder: Path) -> Iterator[tuple[int, int]]:
    """mosquitto as it is shipped, but for passwords and limits; its ports for MQTT and websockets."""
    plain, websocket = free_port(), free_port()
    (folder / "mosquitto.conf").write_text(
        f"allow_anonymous true\nlistener {plain} 127.0.0.1\nlistener {websocket} 127.0.0.1\nprotocol websockets\n"
        "max_queued_messages 0\nset_tcp_nodelay true\nlog_type error\nuser root\n"
    )
    command = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin") or "mosquitto"
    with subprocess.Popen([command, "-c", folder / "mosquitto.conf"]) as process:
        time.sleep(1.0)
        try:
            yield plain, websocket
        finally:
            process.terminate()


@contextmanager
def server(vehicle: VehicleFile, folder: Path, websocket: int) -> Iterator[str]:
    """The dashboard's server in a thread; the page's address."""
    place = socket.create_server(("127.0.0.1", 0))
    application = Dashboard(Settings(vehicle, folder, f"ws://127.0.0.1:{websocket}")).app
    running = uvicorn.Server(uvicorn.Config(application, log_level="warning", access_log=False))
    thread = threading.Thread(target=running.run, kwargs={"sockets": [place]})
    thread.start()
    try:
        yield f"http://localhost:{place.getsockname()[1]}/"
    finally:
        running.should_exit = True
        thread.join()
        place.close()


@contextmanager
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        made = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"] if os.geteuid() == 0 else []
        )
        try:
            yield made
        finally:
            made.close()


def opened(browser: Browser, address: str, script: str = "") -> Page:
    page = browser.new_context(viewport={"width": 1280, "height": 900}).new_page()
    page.add_init_script(script)
    page.goto(address)
    return page


def live(page: Page) -> None:
    expect(page.locator("#link")).to_have_text("live", timeout=60_000)


# soak


class Story:
    """A vehicle that is excited for hours: what it publishes, in the format of the service, by the data's own time."""

    def __init__(self, vehicle: VehicleFile, begin: float) -> None:
        self.rate = vehicle.control.rate
        self.begin_ns, self.cycles, self.batches = round(begin * 1e9), 0, 0
        self._cutter = TelemetryBatches(MONOCAB.names, self.rate, vehicle.mqtt.telemetry_rate)
        self._units = {name: getattr(vehicle.parameters, name) for name in vehicle.parameters.values}
        noise = np.random.default_rng(1).normal(0.0, 1e-4, (997, len(MONOCAB)))
        self._noise = [tuple(row) for row in noise.tolist()]

    @property
    def time(self) -> float:
        """s since the beginning."""
        return self.cycles / self.rate

    def next(self) -> Iterator[tuple[str, bytes]]:
        """The next 50 ms: topics and payloads."""
        period_ns, frames = 1e9 / self.rate, []
        for _ in range(round(self.rate / 20)):
            phase = 2.0 * pi * 0.7 * self.time
            noise = self._noise[self.cycles % len(self._noise)]
            values = tuple(0.02 * sin(phase + place) + each for place, each in enumerate(noise))
            frames.append(Frame(self.begin_ns + round(self.cycles * period_ns), values))
            self.cycles += 1
        self.batches += 1
        if self.batches % 10 == 0:
            buses = [{"address": "can0", "load_percent": 40.0, "dropped": 0, "error_frames": 0}]
            self._cutter.health({"cycles": self.cycles, "missed_cycles": 0, "rate": self.rate, "buses": buses})
            curve = [0.02 * cos(0.1 * row) for row in range(60)]
            columns = {"roll": curve, "roll_rate": curve}
            begin = frames[-1].timestamp_ns * 1e-9 - 0.5
            self._cutter.prediction({"t0": begin, "dt": 0.008, "values": columns, "innovations": columns})
        for payload in self._cutter.add(frames):
            yield "telemetry", payload
        if self.batches % 5 == 0:
            yield "parameters", json.dumps(self._parameters()).encode()
            yield "progress", json.dumps({"task": "multisine", "fraction": 0.5, "remaining": 100.0}).encode()
        if self.batches % 20 == 0:
            yield "diagnosis", json.dumps(self._diagnosis()).encode()
        if self.batches % 200 == 0:
            text = f"missing effect: something new after {self.time:.0f} s"
            yield "event", json.dumps({"severity": "warning", "code": "missing_effect", "text": text}).encode()

    def _parameters(self) -> dict[str, Any]:
        return {
            name: {"value": entry.value * (1.0 + 0.01 * sin(self.time)), "std": 0.01 * entry.value, "unit": entry.unit,
                   "status": "ok", "method": "recursive_prediction_error", "coverage_percent": 100.0, "reason": ""}
            for name, entry in self._units.items()
        }  # fmt: skip

    def _diagnosis(self) -> dict[str, Any]:
        size = {"viscous_friction.coefficient": {"value": 1000.0 + sin(self.time), "std": 20.0, "unit": "N m s/rad"}}
        finding = {"effect": "viscous_friction", "parameters": size, "probability": 0.99, "explanation": "friction"}
        return {"adequate": False, "verdict": "missing_effect", "findings": [finding], "seconds": round(self.time)}


STATE = {
    "vehicle": "monocab", "mode": "running", "experiment": "multisine", "phase": "excite", "code": "", "reason": "",
    "interlocks": [], "faults": [], "version": "", "since": 0.0, "commands": True, "held_by": "nobody",
}  # fmt: skip


def soak(hours: float) -> None:
    vehicle = load("monocab")
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        plain, websocket = stack.enter_context(broker(folder))
        address = stack.enter_context(server(vehicle, folder, websocket))
        chromium = stack.enter_context(browser())
        client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        client.max_queued_messages_set(0)
        client.connect("127.0.0.1", plain)
        client.loop_start()

        def tell(topic: str, payload: bytes, *, retain: bool = False) -> mqtt.MQTTMessageInfo:
            return client.publish(f"upright/monocab/{topic}", payload, retain=retain)

        tell("status", b"online", retain=True)
        tell("state", json.dumps(STATE).encode(), retain=True)
        story = Story(vehicle, time.time())
        began, told = time.monotonic(), 0.0
        print(f"{'':24}{'heap':>9}{'resident':>10}{'unshared':>10}   pictures/s, longest gap")
        blank = chromium.new_context().new_page()
        say("an empty page", chromium, blank, lambda: None)
        blank.context.close()
        # Time goes faster in the data than on the wall, which the page would take for a link that cannot keep up.
        page = opened(chromium, address, "Date.now = () => 0")
        steady(story, tell, 5.0)
        say("at the beginning", chromium, page, lambda: steady(story, tell, 10.0))
        lasted = time.monotonic()
        while story.time < 3600.0 * hours:
            hurry(story, tell, page, 5.0)
            if story.time - told > 3600.0:
                told = story.time
                pace = story.time / (time.monotonic() - lasted)
                say(f"in hour {told / 3600.0:.0f}, {pace:.0f} x", chromium, page, lambda: hurry(story, tell, page, 8.0))
        steady(story, tell, 5.0)
        for view in VIEWS:
            page.click(f"#tab-{view}")
            say(f"afterwards, {view}", chromium, page, lambda: steady(story, tell, 8.0))
        page.click("#tab-live")
        steady(story, tell, 2.0)
        page.wait_for_timeout(1000)
        assert story.time - shown(page, story) < 0.2, "the page has lost the end"
        counted = page.get_attribute("#ignored", "data-count")
        lasted = time.monotonic() - began
        print(f"{story.time / 3600.0:.2f} h of data in {lasted:.0f} s; messages ignored by the page: {counted or 0}")
        client.loop_stop()


def shown(page: Page, story: Story) -> float:
    """s of the story that the page has drawn."""
    time_shown = page.evaluate("document.querySelector('[id^=value-]').dataset.time ?? null")
    return 0.0 if time_shown is None else float(time_shown) - story.begin_ns * 1e-9


def steady(story: Story, tell: Any, seconds: float) -> None:
    """The story at the pace of the wall's clock."""
    begin, first = time.monotonic(), story.time
    while story.time - first < seconds:
        for message in story.next():
            tell(*message)
        time.sleep(max(0.0, begin + story.time - first - time.monotonic()))


def hurry(story: Story, tell: Any, page: Page, seconds: float) -> None:
    """The story as fast as the page takes it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for _ in range(50):
            for message in story.next():
                last = tell(*message)
        last.wait_for_publish(60.0)
        limit = time.monotonic() + 30.0
        while story.time - shown(page, story) > AHEAD:
            assert time.monotonic() < limit, "the page has lost some of it"
            time.sleep(0.02)


def say(what: str, browser: Browser, page: Page, meanwhile: Any) -> None:
    """A line about the page while `meanwhile` runs, for 6 s at least."""
    page.evaluate(f"() => {{ window.pictures = ({PICTURES})(5.0); }}")
    meanwhile()
    rate, gap = page.evaluate("window.pictures")
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.collectGarbage")
    heap = session.send("Runtime.getHeapUsage")["usedSize"] / 1e6
    session.detach()
    resident, unshared = renderer_memory(browser)
    print(f"{what:24}{heap:6.1f} MB{resident:7.0f} MB{unshared:7.0f} MB   {rate:.0f}, {gap:.0f} ms", flush=True)


def renderer_memory(browser: Browser) -> tuple[float, float]:
    """Resident and unshared memory of the largest renderer, MB: that of the page."""
    processes = browser.new_browser_cdp_session().send("SystemInfo.getProcessInfo")["processInfo"]
    found = []
    for process in processes:
        if process["type"] == "renderer":
            lines = Path(f"/proc/{process['id']}/smaps_rollup").read_text().splitlines()
            kept = {line.split(":")[0]: int(line.split()[1]) / 1024 for line in lines[1:]}
            found.append((kept["Rss"], kept["Private_Clean"] + kept["Private_Dirty"]))
    return max(found)


# latency


def latency() -> None:
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        plain, websocket = stack.enter_context(broker(folder))
        shipped = Path(load("monocab").path).read_text()
        file = folder / "monocab.toml"
        file.write_text(shipped.replace("[mqtt]\n", "[mqtt]\ncommands = true\n", 1))
        options = ("--virtual", "--mqtt", f"127.0.0.1:{plain}")
        place = stack.enter_context(daemon(folder, *options, vehicle=str(file)))
        address = stack.enter_context(server(load(str(file)), folder, websocket))
        page = opened(stack.enter_context(browser()), address)
        live(page)
        page.wait_for_timeout(3000)
        tell_delays("at rest", page)
        page.click("#tab-experiments")
        page.click("[data-experiment=multisine]:enabled")
        page.click("#tab-live")
        until(place, lambda status: status["phase"] == "excite")
        tell_delays("multisine, with live estimates", page)
        status = until(place, lambda status: status["mode"] == "disarmed")
        silence, words = status["lease"]["longest_silence"], status["reason"] or "ended as planned"
        print(f"its lease of 300 ms: {words}; longest silence {1e3 * silence:.0f} ms")


def tell_delays(what: str, page: Page) -> None:
    delays = page.evaluate(DELAYS, 15.0)
    p50, p90, p99 = np.quantile(delays, (0.5, 0.9, 0.99))
    own = page.get_attribute("#latency", "data-ms")
    print(
        f"{what:32} median {p50:.0f} ms, 90 % {p90:.0f} ms, 99 % {p99:.0f} ms of {len(delays)}; the page says {own} ms"
    )


@contextmanager
def daemon(folder: Path, *options: str, vehicle: str = "monocab") -> Iterator[Path]:
    """`upright serve`, once it is ready; its socket."""
    place = folder / "s.sock"
    words = [*UPRIGHT, "serve", vehicle, "--data", str(folder), "--socket", str(place), *options]
    with subprocess.Popen(words, stderr=subprocess.DEVNULL) as process:
        try:
            until(place, lambda status: status["mode"] == "disarmed" and not status["interlocks"])
            yield place
        finally:
            process.terminate()


def until(place: Path, what: Any, limit: float = 90.0) -> dict[str, Any]:
    end = time.monotonic() + limit
    while time.monotonic() < end:
        with suppress(ApiError):
            status: dict[str, Any] = list(call([place], {"verb": "status"}))[-1]["status"]
            if what(status):
                return status
        time.sleep(0.1)
    raise TimeoutError("the daemon did not get ready")


# browsers


class Turnaround:
    """Times from the last frame of an IMU set to the first frame that control sends, both as the kernel stamps them."""

    def __init__(self, vehicle: VehicleFile) -> None:
        self.trigger = imu_config(vehicle).can_ids[-1]
        self.reply = 0x080  # SYNC, which follows the setpoints
        self._bus = connect(BUS, None, [self.trigger, self.reply])

    def close(self) -> None:
        self._bus.shutdown()

    def measure(self, seconds: float) -> tuple[list[float], int]:
        """ms of each cycle, and how many were not answered before the next one."""
        while self._bus.recv(0.0) is not None:
            pass
        found, open_since, missed = [], 0.0, 0
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            message: can.Message | None = self._bus.recv(0.5)
            if message is None:
                continue
            if message.arbitration_id == self.trigger:
                missed += open_since > 0.0
                open_since = message.timestamp
            elif open_since:
                found.append(1e3 * (message.timestamp - open_since))
                open_since = 0.0
        return found, missed


def bare_clients(websocket: int) -> None:
    """Ten clients that take all topics and do nothing with them; for a process of its own."""
    for _ in range(10):
        client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, transport="websockets")
        client.on_connect = lambda client, *_: client.subscribe("upright/#", 1)
        client.connect("127.0.0.1", websocket)
        client.loop_start()
    sys.stdin.read()


def browsers(rounds: int) -> None:
    vehicle = load("monocab")
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        plain, websocket = stack.enter_context(broker(folder))
        words = [*UPRIGHT, "simulate", "monocab", "--bus", BUS]
        simulator = stack.enter_context(subprocess.Popen(words, stderr=subprocess.DEVNULL))
        stack.callback(simulator.terminate)
        place = stack.enter_context(daemon(folder, "--bus", BUS, "--mqtt", f"127.0.0.1:{plain}"))
        address = stack.enter_context(server(vehicle, folder, websocket))
        chromium = stack.enter_context(browser())
        turnaround = Turnaround(vehicle)
        stack.callback(turnaround.close)
        blocks: list[tuple[str, float, float, int, float]] = []

        def block(what: str) -> None:
            before = until(place, lambda status: True)["missed_cycles"]
            busy = processor_time()
            times, unanswered = turnaround.measure(BLOCK)
            used = 100.0 * (processor_time() - busy) / BLOCK
            missed = until(place, lambda status: True)["missed_cycles"] - before
            p50, p99 = np.quantile(times, (0.5, 0.99))
            blocks.append((what, float(p50), float(p99), unanswered, used))
            print(
                f"{what:12} p50 {p50:.3f} ms, p99 {p99:.2f} ms, longest {max(times):.1f} ms, {unanswered} unanswered, "
                f"{missed} missed by the loop's own count, machine busy {used:.0f} of {100 * (os.cpu_count() or 1)} %",
                flush=True,
            )

        def attached(what: str) -> None:
            with ExitStack() as guests:
                if what == "10 clients":
                    words = [sys.executable, __file__, "bare", str(websocket)]
                    process = guests.enter_context(subprocess.Popen(words, stdin=subprocess.PIPE))
                    guests.callback(process.terminate)
                    time.sleep(4.0)
                elif what != "nobody":
                    pages = [opened(chromium, address) for _ in range(int(what.split()[0]))]
                    for page in pages:
                        guests.callback(page.context.close)
                        live(page)
                    time.sleep(3.0)
                block(what)
            time.sleep(2.0)

        for number in range(rounds):
            order = ["1 page", "10 clients", "10 pages"]
            attached("nobody")
            for what in order if number % 2 == 0 else reversed(order):
                attached(what)
                attached("nobody")
        compare(blocks)


def compare(blocks: list[tuple[str, float, float, int, float]]) -> None:
    """Each kind of block over the mean of its two neighbours without anybody; and those over each other."""
    ratios: dict[str, list[tuple[float, float]]] = {}
    for place in range(1, len(blocks) - 1):
        what, p50, p99, *_ = blocks[place]
        before, after = blocks[place - 1], blocks[place + 1]
        if what != "nobody":
            ratios.setdefault(what, []).append(
                (p50 / (0.5 * (before[1] + after[1])), p99 / (0.5 * (before[2] + after[2])))
            )
            ratios.setdefault("nobody, next over before", []).append((after[1] / before[1], after[2] / before[2]))
    for what, found in ratios.items():
        for name, values in zip(("p50", "p99"), zip(*found, strict=True), strict=True):
            spread = f"{min(values):.2f} to {max(values):.2f}"
            print(f"{what:26} {name}: {statistics.median(values):.2f} x ({spread}, {len(values)} blocks)")


def processor_time() -> float:
    """s that all processors were busy since the start of the machine."""
    fields = [int(each) for each in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
    return (sum(fields) - fields[3] - fields[4]) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    wanted = sys.argv[1:] or ["soak", "latency", "browsers"]
    if wanted[0] == "bare":
        bare_clients(int(wanted[1]))
    if "soak" in wanted:
        soak(float(os.environ.get("HOURS", HOURS)))
    if "latency" in wanted:
        latency()
    if "browsers" in wanted:
        browsers(int(os.environ.get("ROUNDS", ROUNDS)))
