"""The dashboard in a real browser: a real broker, the daemon with a virtual vehicle, and Debian's Chromium.

One story in several tests, in order, since starting all this takes a while: an experiment is started on the page and
looked at in each view, its numbers are compared with the recording, the missing effect is added, the stop is pressed,
the page is closed. Screenshots go to .pytest_cache/dashboard.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import paho.mqtt.client as mqtt
import pytest
from playwright.sync_api import Browser, BrowserContext, Page, expect, sync_playwright
from topology import LEASE, Topology, topology, vehicle_text

from telemetry.recording import Recording

pytestmark = pytest.mark.timeout(180)

VIEWS = ("live", "experiments", "identify", "gap", "recordings")
HOSTILE = "<img src=x onerror=window.hacked=1>"
HIDDEN = "viscous_friction"
PATIENCE = 60_000
"""ms, on a machine that is busy with other tests."""


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Topology]:
    folder = tmp_path_factory.mktemp("dashboard")
    with topology(folder, vehicle_text(multisine=14.0, hold=30.0), "--hide", HIDDEN) as made:
        yield made


@pytest.fixture(scope="module")
def screenshots(pytestconfig: pytest.Config) -> Path:
    folder = pytestconfig.rootpath / ".pytest_cache" / "dashboard"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    executable = shutil.which("chromium")
    if executable is None:
        pytest.skip("no chromium here: apt-get install chromium")
    sandbox = ["--no-sandbox"] if os.geteuid() == 0 else []  # as root it has none
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=sandbox)
        yield browser
        browser.close()


class Watched:
    """A page, and what went wrong on it: console errors, exceptions, requests that leave this machine."""

    def __init__(self, context: BrowserContext, address: str) -> None:
        self.wrong: list[str] = []
        self.page: Page = context.new_page()
        self.page.set_default_timeout(PATIENCE)
        self.page.on("console", lambda said: self.wrong.append(said.text) if said.type == "error" else None)
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("request", lambda request: self._is_local(request.url))
        self.page.on("websocket", lambda socket: self._is_local(socket.url))
        self.page.goto(address)
        expect(self.page.locator("#link")).to_have_text("live", timeout=PATIENCE)

    def _is_local(self, url: str) -> None:
        if urlsplit(url).hostname not in ("localhost", "127.0.0.1"):
            self.wrong.append(f"request to {url}")

    def show(self, view: str) -> None:
        self.page.click(f"#tab-{view}")
        expect(self.page.locator(f"#view-{view}")).to_be_visible()


@pytest.fixture(scope="module")
def watched(browser: Browser, parts: Topology) -> Iterator[Watched]:
    context = browser.new_context(viewport={"width": 1280, "height": 900}, color_scheme="light")
    watched = Watched(context, parts.page)
    yield watched
    context.close()
    assert watched.wrong == []


def start(watched: Watched, name: str) -> None:
    watched.show("experiments")
    watched.page.click(f"[data-experiment={name}]:enabled")
    expect(watched.page.locator("#mode")).to_have_text("running")


READ = "id => { const o = document.getElementById(id); return [Number(o.dataset.time), Number(o.dataset.si)]; }"


@pytest.fixture(scope="module")
def experiment(watched: Watched, parts: Topology, screenshots: Path) -> tuple[Recording, list[tuple[float, float]]]:
    """A multisine started on the page; what was read off the page meanwhile, and the recording of it."""
    page = watched.page
    start(watched, "multisine")
    parts.until("phase", "excite")
    watched.show("live")
    read: list[tuple[float, float]] = []
    while len(read) < 12:
        moment, value = page.evaluate(READ, "value-roll")
        if not read or moment > read[-1][0]:
            read.append((moment, value))
        page.wait_for_timeout(100)
    for view in VIEWS:
        watched.show(view)
        page.wait_for_timeout(500)
        page.screenshot(path=screenshots / f"{view}-running-light.png", full_page=True)
    watched.show("experiments")
    expect(page.locator("#outcome")).to_contain_text("did what it should", timeout=PATIENCE)
    name = page.inner_text("#outcome").rpartition("Recording: ")[2].strip()
    return Recording.load(parts.recordings / name), read


def test_what_the_page_shows_is_what_was_recorded(
    experiment: tuple[Recording, list[tuple[float, float]]], watched: Watched
) -> None:
    recording, read = experiment
    stamps = recording.timestamp_ns * 1e-9
    for moment, value in read:
        place = int(np.argmin(np.abs(stamps - moment)))
        # A batch has a common step: its rows are within a fraction of a cycle of where they are recorded.
        assert abs(stamps[place] - moment) < 0.5e-3
        assert value == pytest.approx(recording["roll"][place], rel=1e-6)
    assert np.ptp([value for _, value in read]) > math.radians(0.05)  # it moved
    assert watched.wrong == []


def test_the_estimates_on_the_page_are_the_recordings(
    experiment: tuple[Recording, list[tuple[float, float]]], watched: Watched
) -> None:
    recording, _ = experiment
    found = json.loads(Path(recording.source).with_suffix(".estimates.json").read_text())["methods"]
    watched.show("identify")
    for name in ("inertia", "gravity_stiffness"):
        shown = float(watched.page.get_attribute(f"[data-parameter={name}]", "data-si") or "nan")
        assert shown == pytest.approx(found["recursive_prediction_error"]["parameters"][name]["value"], rel=1e-9)


def test_the_model_is_drawn_over_the_measurement(
    experiment: tuple[Recording, list[tuple[float, float]]], watched: Watched
) -> None:
    watched.show("live")
    legend = watched.page.locator("#view-live .chart").first.inner_text()
    assert "model, 0.5 s ahead" in legend
    assert watched.page.inner_text("#figure-rate").endswith("of 250 Hz")
    assert float(watched.page.inner_text("#figure-load").split()[0]) > 10.0


def test_add_makes_the_error_fall(experiment: tuple[Recording, list[tuple[float, float]]], watched: Watched) -> None:
    page = watched.page
    watched.show("gap")
    page.locator(f"[data-add={HIDDEN}]").first.click()
    after = page.locator("[data-after=roll_rate]")
    expect(after).to_be_visible(timeout=120_000)
    before = float(page.get_attribute("[data-before=roll_rate]", "data-value") or "nan")
    # Of an effect that stands out by far at least half of the error goes; the noise floor is what stays.
    assert float(after.get_attribute("data-value") or "nan") < 0.5 * before
    expect(page.locator("#gap-model")).to_contain_text(HIDDEN)


def test_where_the_model_fails_is_drawn(
    experiment: tuple[Recording, list[tuple[float, float]]], watched: Watched, screenshots: Path
) -> None:
    page = watched.page
    watched.show("gap")
    page.click("#gap-compare")
    expect(page.locator("#gap-where h3").first).to_be_visible(timeout=120_000)
    # The model without the friction lacks a torque that goes by the roll rate.
    expect(page.locator("#gap-where figure").filter(has_text="by roll_rate").first).to_be_visible()
    page.screenshot(path=screenshots / "gap-filled-light.png", full_page=True)


def test_hostile_messages_are_counted_and_nothing_runs(watched: Watched, parts: Topology) -> None:
    page = watched.page
    watched.show("live")
    before = int(page.get_attribute("#ignored", "data-count") or 0)
    vehicle = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
    vehicle.username_pw_set("upright", parts.password("upright"))
    vehicle.connect("127.0.0.1", parts.mqtt)
    vehicle.loop_start()

    def tell(topic: str, payload: bytes | str) -> None:
        vehicle.publish(f"upright/monocab/{topic}", payload, qos=1).wait_for_publish(10.0)

    bad = [
        ("event", "no json"),
        ("event", "[1, 2]"),
        ("event", '{"severity": 1}'),
        ("state", '{"mode": 3}'),
        ("telemetry", '{"t0": 1, "dt": 0.004, "roll": ["x"]}'),
        ("telemetry", '{"t0": 1e999, "dt": 0.004, "roll": [1]}'),
        ("diagnosis", '{"verdict": "adequate", "findings": [7]}'),
        ("parameters", '{"inertia": 3}'),
        ("event", b"\xff\xfe"),
        ("telemetry", json.dumps({"t0": 1.0, "dt": 0.004, "roll": [0.0] * 50_000})),
    ]
    for topic, payload in bad:
        tell(topic, payload)
    tell("event", json.dumps({"severity": "info", "code": "x", "text": HOSTILE}))
    expect(page.locator("#events")).to_contain_text(HOSTILE, timeout=PATIENCE)
    expect(page.locator("#ignored")).to_have_attribute("data-count", str(before + len(bad)))
    vehicle.loop_stop()
    vehicle.disconnect()
    hostile = parts.recordings / f"{HOSTILE}.arrow"
    shutil.copy(next(parts.recordings.glob("*_multisine.arrow")), hostile)
    watched.show("recordings")
    page.locator("[data-open]", has_text="Open").first.wait_for()
    page.get_by_role("row").filter(has_text=HOSTILE).get_by_role("button", name="Open").click()
    expect(page.locator("#recording")).to_contain_text(HOSTILE)
    assert page.evaluate("window.hacked") is None
    assert page.locator("#events img, #recording img, #recordings img").count() == 0
    hostile.unlink()
    expect(page.locator("#link")).to_have_text("live", timeout=PATIENCE)


def test_stop_stops_the_drives_from_the_keyboard(watched: Watched, parts: Topology) -> None:
    start(watched, "hold")
    parts.until("phase", "excite")
    powered = {drive["state"] for drive in parts.status()["drives"]}
    assert powered == {"Operation enabled"}
    watched.show("recordings")
    watched.page.keyboard.press("Escape")
    status = parts.until("mode", "disarmed", limit=20.0)
    assert status["reason"] == "an operator asked for the end"
    assert {drive["state"] for drive in status["drives"]} == {"Switch on disabled"}
    expect(watched.page.locator("#mode")).to_have_text("disarmed")
    assert watched.wrong == []


def test_a_page_that_is_closed_ends_its_experiment(browser: Browser, parts: Topology) -> None:
    context = browser.new_context()
    other = Watched(context, parts.page)
    parts.until("interlocks", [])
    start(other, "hold")
    holder = parts.until("phase", "settle")["lease"]["holder"]
    context.close()
    status = parts.until("mode", "disarmed", limit=20.0)
    assert status["reason"] in (f"{holder} let go", f"{holder} has given no sign for {1e3 * LEASE:.0f} ms")


@pytest.mark.parametrize(("look", "scheme", "width"), [("dark", "dark", 1280), ("phone", "light", 390)])
def test_each_view_in(look: str, scheme: str, width: int, browser: Browser, parts: Topology, screenshots: Path) -> None:
    context = browser.new_context(
        viewport={"width": width, "height": 844}, color_scheme="dark" if scheme == "dark" else "light"
    )
    watched = Watched(context, parts.page)
    page = watched.page
    page.wait_for_timeout(1500)
    for view in VIEWS:
        watched.show(view)
        if view == "recordings":
            page.locator("[data-open]").first.click()
            expect(page.locator("#recording h3")).to_be_visible()
        page.wait_for_timeout(300)
        page.screenshot(path=screenshots / f"{view}-{look}.png", full_page=True)
        wide = page.evaluate("document.documentElement.scrollWidth")
        assert wide <= width, f"{view} is {wide} px wide"
    context.close()
    assert watched.wrong == []


def test_it_says_what_is_stale_and_comes_back(watched: Watched, parts: Topology) -> None:
    """A broker that hangs, and one that is killed and started again."""
    link, before = watched.page.locator("#link"), list(watched.wrong)
    broker = int((parts.folder / "mosquitto.pid").read_text())
    os.kill(broker, signal.SIGSTOP)
    try:
        expect(link).to_contain_text("stale: last heard", timeout=PATIENCE)
    finally:
        os.kill(broker, signal.SIGCONT)
    expect(link).to_have_text("live", timeout=PATIENCE)
    os.kill(broker, signal.SIGKILL)
    expect(link).to_have_text("no connection to the broker", timeout=PATIENCE)
    expect(watched.page.locator("#stop")).to_be_disabled()
    expect(link).to_have_text("live", timeout=PATIENCE)
    # While there is no broker the browser itself reports each attempt as an error.
    assert all("WebSocket connection" in said for said in watched.wrong[len(before) :])
    watched.wrong[:] = before
