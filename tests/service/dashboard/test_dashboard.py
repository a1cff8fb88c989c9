"""The dashboard in a real browser: a real broker, the daemon with a virtual vehicle, and Debian's Chromium.

The tests form one sequence, in this order, since starting all this takes a while: an experiment is started on the page
and inspected in each view, its numbers are compared with the recording, the missing effect is added, the stop is
pressed, the page is closed. Screenshots go to the folder UPRIGHT_ARTIFACTS, or .pytest_cache/dashboard.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
import paho.mqtt.client as mqtt
import pytest
from paho.mqtt import subscribe
from playwright.sync_api import Browser, Page, expect
from slow_link import SlowLink
from starlette.exceptions import HTTPException
from topology import LEASE, Topology, topology, vehicle_text
from watched import PATIENCE, Watched, chromium

from upright.estimators.parting import partings
from upright.service.dashboard.app import Dashboard, Settings
from upright.telemetry.recording import Recording
from upright.telemetry.storage import load as load_recording
from upright.vehicles import registry
from upright.vehicles.file import load

pytestmark = [pytest.mark.browser, pytest.mark.timeout(180)]

VIEWS = ("live", "commissioning", "identify", "gap", "recordings")
HOSTILE = "<img src=x onerror=window.hacked=1>"
HIDDEN = "viscous_friction"
METHODS = ("prediction_error", "instrumental_variables")


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Topology]:
    folder = tmp_path_factory.mktemp("dashboard")
    still = ("--hide", "disturbance=0")
    with topology(folder, vehicle_text(multisine=14.0, hold=30.0), *still, "--hide", HIDDEN) as made:
        yield made


@pytest.fixture(scope="module")
def screenshots(pytestconfig: pytest.Config) -> Path:
    folder = Path(os.environ.get("UPRIGHT_ARTIFACTS") or pytestconfig.rootpath / ".pytest_cache" / "dashboard")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as launched:
        yield launched


@pytest.fixture(scope="module")
def watched(browser: Browser, parts: Topology) -> Iterator[Watched]:
    context = browser.new_context(viewport={"width": 1280, "height": 900}, color_scheme="light")
    watched = Watched(context, parts.page)
    yield watched
    context.close()
    assert watched.errors == []


def show_experiments(watched: Watched) -> None:
    """They are unfolded below the steps of the commissioning; a vehicle without steps has them alone."""
    watched.show("commissioning")
    folded = watched.page.locator("#all-experiments:not([open]) > summary")
    if folded.count():
        folded.click()


def start(watched: Watched, name: str) -> None:
    show_experiments(watched)
    watched.page.click(f"[data-experiment={name}]:enabled")
    expect(watched.page.locator("#mode")).to_have_text("running")


READ = "id => { const o = document.getElementById(id); return [Number(o.dataset.time), Number(o.dataset.si)]; }"


@pytest.fixture(scope="module")
def experiment(watched: Watched, parts: Topology, screenshots: Path) -> tuple[Recording, list[tuple[float, float]]]:
    """A multisine started on the page: its recording, and the values read off the page meanwhile."""
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
        watched.picture(screenshots / f"{view}-running-light.png")
    show_experiments(watched)
    expect(page.locator("#outcome")).to_contain_text("completed within the limits", timeout=PATIENCE)
    expect(page.locator("#outcome")).to_have_attribute("data-ok", "true")
    name = page.inner_text("#outcome").rpartition("Recording: ")[2].strip()
    return load_recording(parts.recordings / name), read


def test_page_shows_the_recorded_values(
    experiment: tuple[Recording, list[tuple[float, float]]], watched: Watched
) -> None:
    recording, read = experiment
    stamps = recording.timestamp_ns * 1e-9
    for moment, value in read:
        place = int(np.argmin(np.abs(stamps - moment)))
        # The samples of a batch have one common step: they are within a fraction of a cycle of the recorded times.
        assert abs(stamps[place] - moment) < 0.5e-3
        assert value == pytest.approx(recording["roll"][place], rel=1e-6)
    assert np.ptp([value for _, value in read]) > math.radians(0.05)  # it moved
    assert watched.errors == []


def test_estimates_on_the_page_equal_those_of_the_recording(
    experiment: tuple[Recording, list[tuple[float, float]]], watched: Watched
) -> None:
    recording, _ = experiment
    found = json.loads(Path(recording.source).with_suffix(".estimates.json").read_text())["methods"]
    watched.show("identify")
    for name in ("inertia", "gravity_stiffness"):
        shown = float(watched.page.get_attribute(f"[data-parameter={name}]", "data-si") or "nan")
        assert shown == pytest.approx(found["recursive_prediction_error"]["parameters"][name]["value"], rel=1e-9)


def test_courses_of_all_live_methods_are_drawn_with_where_they_part(
    experiment: tuple[Recording, list[tuple[float, float]]], watched: Watched, screenshots: Path
) -> None:
    recording, _ = experiment
    estimates = json.loads(Path(recording.source).with_suffix(".estimates.json").read_text())["methods"]
    page = watched.page
    watched.show("identify")
    figure = page.locator("[data-course=inertia]")
    expect(figure).to_be_visible()
    drawn = set((figure.get_attribute("data-methods") or "").split())
    assert drawn == {method for method, each in estimates.items() if "inertia" in each["parameters"]}
    assert len(drawn) == 4
    for method in drawn:
        expect(figure).to_contain_text(method.replace("_", " "))
    expect(page.locator("#parting li")).to_have_text([str(each) for each in partings(estimates)])
    expect(page.locator("#parting")).to_contain_text("as that of independent estimates")
    watched.picture(screenshots / "identify-methods-light.png")


def test_live_view_shows_model_prediction_cycle_rate_and_bus_load(
    experiment: tuple[Recording, list[tuple[float, float]]], watched: Watched
) -> None:
    watched.show("live")
    # A chart is drawn once it is visible, which takes a frame or two.
    expect(watched.page.locator("#view-live .chart").first).to_contain_text("model, 0.5 s ahead")
    assert watched.page.inner_text("#figure-rate").endswith("of 250 Hz")
    assert float(watched.page.inner_text("#figure-load").split()[0]) > 10.0


@pytest.mark.parametrize("look", ["light", "dark"])
def test_every_chart_is_drawn_when_printing(
    look: Literal["light", "dark"], experiment: tuple[Recording, list[tuple[float, float]]], watched: Watched
) -> None:
    """Printed to a real PDF; charts below the fold have no canvas before and after."""
    page = watched.page
    watched.show("live")
    page.set_viewport_size({"width": 1280, "height": 400})
    page.emulate_media(color_scheme=look)
    canvases = page.locator("#view-live canvas")
    expect(canvases).not_to_have_count(0)
    page.evaluate(PRINTED.replace("COLOURED", COLOURED))
    page.wait_for_timeout(300)
    before, last = canvases.count(), page.locator("#view-live .chart:last-child canvas")
    expect(last).to_have_count(0)
    assert page.pdf().startswith(b"%PDF")
    printed = page.evaluate("window.printed")
    assert len(printed) == page.locator("#view-live .chart").count() > before
    for title, coloured, darkest in printed:
        # On first use on a machine the model may still be compiling: then there are no predictions.
        assert coloured > 100 or title.startswith("Innovation"), f"{title} has no curve"
        # The text of the axes is dark even if the page is in dark mode, since paper is white.
        assert darkest < 60, title
    expect(last).to_have_count(0)
    page.emulate_media(color_scheme="light")
    page.set_viewport_size({"width": 1280, "height": 900})
    assert watched.errors == []


PRINTED = """() => matchMedia("print").addEventListener("change", ({ matches }) => {
  const coloured = COLOURED;
  if (matches) window.printed = [...document.querySelectorAll("#view-live .chart")].map((chart) => {
    const canvas = chart.querySelector("canvas");
    return [chart.querySelector("figcaption").innerText, ...(canvas ? coloured(canvas) : [0, 255])];
  });
}, { once: true })"""
"""For each printed chart: its title, the number of pixels in a curve's colour, and the darkest grey."""


def test_error_over_the_floor_and_the_missing_torque_are_drawn_while_an_experiment_runs(
    experiment: tuple[Recording, list[tuple[float, float]]], watched: Watched, screenshots: Path
) -> None:
    """With the friction hidden the model lacks a torque; the strips keep the last minute of the experiment."""
    page = watched.page
    watched.show("gap")
    error, missing = page.locator("[data-error=roll_rate]"), page.locator("[data-missing=roll]")
    expect(error.locator("figcaption")).to_contain_text("× noise floor")
    expect(missing.locator("figcaption")).to_have_text(re.compile(r"Missing torque at roll: -?[0-9.]+ ± [0-9.]+ N m$"))
    for figure in (error, missing):
        assert float(figure.locator("output").get_attribute("data-si") or "nan") != 0.0
        coloured, _ = figure.locator("canvas").evaluate(COLOURED)
        assert coloured > 100, "it has no curve"
    watched.picture(screenshots / "gap-strips-light.png")
    assert watched.errors == []


COLOURED = """(canvas) => {
  const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let coloured = 0, darkest = 255;
  for (let each = 0; each < pixels.length; each += 4) {
    const [red, green, blue, opaque] = pixels.slice(each, each + 4);
    const most = Math.max(red, green, blue);
    if (opaque > 200 && most - Math.min(red, green, blue) > 60) coloured += 1;
    else if (opaque > 200) darkest = Math.min(darkest, most);
  }
  return [coloured, darkest];
}"""
"""Number of pixels of a canvas in a curve's colour, and the darkest grey."""


def test_adding_the_missing_effect_at_least_halves_the_error(
    experiment: tuple[Recording, list[tuple[float, float]]], watched: Watched
) -> None:
    page = watched.page
    watched.show("gap")
    page.locator(f"[data-add={HIDDEN}]").first.click()
    after = page.locator("[data-after=roll_rate]")
    expect(after).to_be_visible(timeout=120_000)
    before = float(page.get_attribute("[data-before=roll_rate]", "data-value") or "nan")
    # For such a large effect at least half of the error is removed; the noise floor remains.
    assert float(after.get_attribute("data-value") or "nan") < 0.5 * before
    expect(page.locator("#gap-model")).to_contain_text(HIDDEN)


def test_missing_torque_is_plotted_against_the_roll_rate(
    experiment: tuple[Recording, list[tuple[float, float]]], watched: Watched, screenshots: Path
) -> None:
    page = watched.page
    watched.show("gap")
    page.click("#gap-compare")
    expect(page.locator("#gap-where h3").first).to_be_visible(timeout=120_000)
    # The model without the friction lacks a torque that depends on the roll rate.
    expect(page.locator("#gap-where figure").filter(has_text="by roll_rate").first).to_be_visible()
    watched.picture(screenshots / "gap-filled-light.png")


class Publish(Protocol):
    def __call__(self, topic: str, payload: bytes | str) -> None: ...


@contextmanager
def publishing_as_the_vehicle(parts: Topology) -> Iterator[Publish]:
    """A function that publishes, on a topic of the vehicle, messages that the vehicle itself did not send."""
    vehicle = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
    vehicle.username_pw_set("upright", parts.password("upright"))
    vehicle.connect("127.0.0.1", parts.mqtt)
    vehicle.loop_start()
    yield lambda topic, payload: vehicle.publish(f"upright/monocab/{topic}", payload, qos=1).wait_for_publish(10.0)
    vehicle.loop_stop()
    vehicle.disconnect()


def batches(parts: Topology, count: int) -> list[bytes]:
    """The next `count` batches of telemetry."""
    login = {"username": "dashboard", "password": parts.password("dashboard")}
    received = subscribe.simple(
        "upright/monocab/telemetry", hostname="127.0.0.1", port=parts.mqtt, auth=login, msg_count=count
    )
    return [message.payload for message in (received if count > 1 else [received])]


def ignored(page: Page) -> int:
    return int(page.get_attribute("#ignored", "data-count") or 0)


TIMES = """() => {
  const shown = document.getElementById("value-roll");
  window.times = [];
  window.clock = new MutationObserver(() => window.times.push(Number(shown.dataset.time)));
  window.clock.observe(shown, { attributeFilter: ["data-time"] });
}"""
"""Collects every time stamp that the page shows from now on."""


def test_out_of_order_telemetry_is_counted_and_not_shown(watched: Watched, parts: Topology) -> None:
    page = watched.page
    watched.show("live")
    before = ignored(page)
    page.evaluate(TIMES)
    reordered = 0
    with publishing_as_the_vehicle(parts) as publish:
        for _ in range(5):
            later = batches(parts, 3)
            for batch in (later[1], later[0]):  # in the wrong order, after a later one
                publish("telemetry", batch)
                reordered += 1
    expect(page.locator("#ignored")).to_have_attribute("data-count", str(before + reordered))
    times = page.evaluate("window.clock.disconnect(), window.times")
    assert len(times) > 5
    assert np.all(np.diff(times) >= 0.0)
    expect(page.locator("#link")).to_have_text("live")


def test_malformed_and_hostile_messages_are_counted_and_run_no_script(watched: Watched, parts: Topology) -> None:
    page = watched.page
    watched.show("live")
    before = ignored(page)
    bad: list[tuple[str, bytes | str]] = [
        ("telemetry", batches(parts, 1)[0]),  # a second time
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
    with publishing_as_the_vehicle(parts) as publish:
        for topic, payload in bad:
            publish(topic, payload)
        publish("event", json.dumps({"severity": "info", "code": "x", "text": HOSTILE}))
    expect(page.locator("#events")).to_contain_text(HOSTILE, timeout=PATIENCE)
    expect(page.locator("#ignored")).to_have_attribute("data-count", str(before + len(bad)))
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


def test_html_in_a_vehicle_name_is_shown_as_text(browser: Browser, parts: Topology) -> None:
    """A vehicle file refuses such a name. If the server reports one anyway, the page shows it as text."""
    context = browser.new_context()
    named = Watched(context, parts.page, vehicle=HOSTILE)
    expect(named.page.locator("#vehicle")).to_have_text(HOSTILE)
    assert HOSTILE in named.page.title()
    assert named.page.evaluate("window.hacked") is None
    assert named.errors == []
    context.close()


@pytest.fixture(scope="module")
def asked(experiment: tuple[Recording, list[tuple[float, float]]], watched: Watched) -> None:
    """Starts the slow diagnosis and identification, which continue while other tests run."""
    page = watched.page
    watched.show("gap")
    page.click("#gap-diagnose")
    watched.show("identify")
    page.select_option("#identify-recording", Path(experiment[0].source).name)
    page.click("#view-identify summary")
    for method in METHODS:
        page.check(f"[name=method][value={method}]")
    page.click("#identify-run")


@pytest.mark.usefixtures("asked")
def test_every_control_is_reached_by_tab_with_a_visible_focus(watched: Watched) -> None:
    page = watched.page
    for view in VIEWS:
        watched.show(view)
        page.evaluate("document.activeElement.blur(); getSelection().removeAllRanges()")
        reached: set[int] = set()
        count = page.evaluate(FOCUSED)[1]
        for _ in range(4 * count + 20):
            page.keyboard.press("Tab")
            place, there, outline = page.evaluate(FOCUSED)
            if there != count:  # a recording appeared or disappeared: the controls have new numbers
                reached, count = set(), there
            if place >= 0:
                assert outline >= 2.0, f"{view}: {place} has no visible focus"
                reached.add(place)
            if len(reached) == count:
                break
        assert reached == set(range(count)), f"{view}: {count} controls"
    # The tabs are a single tab stop; the arrow keys move between them.
    page.focus("#tab-live")
    for view in (*VIEWS[1:], VIEWS[0]):
        page.keyboard.press("ArrowRight")
        expect(page.locator(f"#view-{view}")).to_be_visible()
        expect(page.locator(f"#tab-{view}")).to_be_focused()


FOCUSED = """() => {
  const all = [...document.querySelectorAll("button, a[href], select, input, summary")]
    .filter((each) => each.tabIndex >= 0 && !each.disabled && each.checkVisibility());
  const focused = document.activeElement, style = getComputedStyle(focused);
  return [all.indexOf(focused), all.length, style.outlineStyle === "none" ? 0 : parseFloat(style.outlineWidth)];
}"""
"""Index of the control with the focus (-1: none), number of controls, and width of the outline, px."""


def test_escape_ends_the_experiment_and_disables_the_drives(watched: Watched, parts: Topology) -> None:
    start(watched, "hold")
    while {drive["state"] for drive in parts.status()["drives"]} != {"Operation enabled"}:
        watched.page.wait_for_timeout(100)
    watched.show("recordings")
    watched.page.keyboard.press("Escape")
    status = parts.until("mode", "disarmed", limit=20.0)
    assert status["reason"].startswith("an operator requested the end (mqtt dashboard/page-")
    assert {drive["state"] for drive in status["drives"]} == {"Switch on disabled"}
    expect(watched.page.locator("#mode")).to_have_text("disarmed")
    # The experiment ended in order, but is not accepted.
    expect(watched.page.locator("#outcome")).to_have_attribute("data-ok", "early")
    expect(watched.page.locator("#outcome")).to_contain_text("ended early: an operator requested the end")
    assert watched.errors == []


def test_fault_is_shown_and_reset(watched: Watched, parts: Topology) -> None:
    page = watched.page
    parts.until("interlocks", [])
    start(watched, "hold")
    parts.ask("stop", now=True)
    expect(page.locator("#mode")).to_have_text("fault")
    expect(page.locator("[data-experiment=hold]")).to_be_disabled()
    watched.show("live")
    expect(page.locator("#interlocks")).to_contain_text("an operator requested an immediate stop")
    show_experiments(watched)
    page.focus("#reset")
    page.keyboard.press("Enter")
    expect(page.locator("#mode")).to_have_text("disarmed")
    expect(page.locator("#reset")).to_be_hidden()


@pytest.fixture(scope="module")
def report(watched: Watched) -> str:
    """The recording for which a report is requested; the report is written while other tests run."""
    watched.show("recordings")
    button = watched.page.locator("[data-report$=_hold\\.arrow]").first
    button.click()
    return button.get_attribute("data-report") or ""


@pytest.mark.usefixtures("report")
def test_killed_browser_ends_its_experiment(browser: Browser, parts: Topology) -> None:
    before = renderers(browser)
    context = browser.new_context()
    other = Watched(context, parts.page)
    parts.until("interlocks", [])
    start(other, "hold")
    holder = parts.status()["lease"]["holder"]
    for process in renderers(browser) - before:
        os.kill(process, signal.SIGKILL)
    status = parts.until("mode", "disarmed", limit=20.0)
    assert status["reason"] == f"{holder} has not renewed the lease for {1e3 * LEASE:.0f} ms"
    context.close()


def renderers(browser: Browser) -> set[int]:
    """Process ids of the renderers of the pages."""
    processes = browser.new_browser_cdp_session().send("SystemInfo.getProcessInfo")["processInfo"]
    return {each["id"] for each in processes if each["type"] == "renderer"}


def test_wrong_password_asks_for_login_and_closing_the_page_ends_its_experiment(
    browser: Browser, parts: Topology, screenshots: Path
) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 700})
    other = Watched(context, parts.page, "user or password refused", password="guess")
    page = other.page
    expect(page.locator("#login")).to_contain_text("The broker refused this user or password.")
    page.screenshot(path=screenshots / "login-phone.png")
    page.fill("#login [name=password]", "another guess")
    page.keyboard.press("Enter")
    expect(page.locator("#link")).to_have_text("user or password refused")
    expect(page.locator("#login [name=password]")).to_have_value("")
    expect(page.locator("#stop")).to_be_disabled()
    page.fill("#login [name=user]", "dashboard")
    page.fill("#login [name=password]", parts.password("dashboard"))
    page.click("#login button")
    expect(page.locator("#link")).to_have_text("live")
    expect(page.locator("#login")).to_be_hidden()
    assert other.errors == []
    parts.until("interlocks", [])
    start(other, "hold")
    holder = parts.status()["lease"]["holder"]
    context.close()
    status = parts.until("mode", "disarmed", limit=20.0)
    assert status["reason"] in (
        f"{holder} released the lease",
        f"{holder} has not renewed the lease for {1e3 * LEASE:.0f} ms",
    )


def test_slow_link_is_reported_builds_no_backlog_and_lets_a_stop_through(
    browser: Browser, watched: Watched, parts: Topology, screenshots: Path
) -> None:
    link = SlowLink(parts.websocket, rate=20e3, delay=0.3)
    # The page's content security policy only allows connections to its own broker.
    context = browser.new_context(bypass_csp=True)
    slow = Watched(context, parts.page, None, websocket=f"ws://127.0.0.1:{link.port}")
    expect(slow.page.locator("#link")).to_contain_text("late: data are up to", timeout=PATIENCE)
    parts.until("interlocks", [])
    start(watched, "hold")
    ages = [slow.page.evaluate(AGE) for _ in range(25) if slow.page.wait_for_timeout(100) is None]
    slow.page.screenshot(path=screenshots / "live-slow.png")
    # Three times as much is sent as gets through: with a backlog the page would be ten or more seconds late by now.
    assert max(ages) < 7.0, ages
    slow.page.click("#stop")
    status = parts.until("mode", "disarmed", limit=20.0)
    assert status["reason"].startswith("an operator requested the end (mqtt dashboard/page-")
    assert slow.errors == []
    context.close()
    link.close()


AGE = "() => Date.now() / 1000 - Number(document.querySelector('[id^=value-]').dataset.time)"
"""Age of the displayed values, s."""


def test_model_with_the_added_effect_is_adequate_and_undo_removes_the_effect(asked: None, watched: Watched) -> None:
    page = watched.page
    watched.show("gap")
    # With the added friction, nothing is missing.
    expect(page.locator("#gap-ranked")).to_contain_text("The model is adequate", timeout=120_000)
    expect(page.locator("#gap-ranked")).to_contain_text("Next experiment: ")
    disturbance = page.locator("#gap-ranked [data-text=disturbance]")
    expect(disturbance).to_contain_text("The best possible prediction 0.5 s ahead has ")
    expect(disturbance).to_contain_text("deg RMS in roll")
    page.click("#gap-undo")
    expect(page.locator("#gap-model")).to_contain_text("nothing", timeout=PATIENCE)


def test_methods_are_compared_side_by_side(asked: None, watched: Watched) -> None:
    watched.show("identify")
    inertia = watched.page.locator("#methods table").filter(has_text="inertia").first
    expect(inertia).to_be_visible(timeout=120_000)
    assert inertia.locator("tbody tr").count() == len(METHODS)
    choice = watched.page.locator("#methods-choice")
    expect(choice).to_contain_text("Recommended method: ")
    expect(choice).to_contain_text("it is sound here")
    expect(choice).to_contain_text("Why not the others")
    expect(choice).to_contain_text("Disturbance estimated by prediction_error: ")
    for method in METHODS:
        row = inertia.get_by_role("row").filter(has=watched.page.get_by_role("rowheader", name=method, exact=True))
        # Without the friction, a model of the roll motion has a wrong inertia, but not an arbitrary one.
        assert float(row.locator("output").get_attribute("data-si") or "nan") == pytest.approx(1650.0, rel=0.1)


def test_report_is_written_for_the_recording(report: str, watched: Watched) -> None:
    page = watched.page
    watched.show("recordings")
    link = page.locator("#view-recordings a", has_text=".html")
    link.wait_for(timeout=120_000)
    answer = page.request.get(page.url.partition("#")[0] + (link.get_attribute("href") or ""))
    assert answer.ok
    assert report.removesuffix(".arrow") in answer.text()


@pytest.mark.parametrize(("look", "width"), [("dark", 1280), ("phone", 390)])
def test_every_view_fits_the_width_in_dark_mode_and_on_a_phone(
    look: str, width: int, watched: Watched, screenshots: Path
) -> None:
    page = watched.page
    page.emulate_media(color_scheme="dark" if look == "dark" else "light")
    page.set_viewport_size({"width": width, "height": 844})
    for view in VIEWS:
        watched.show(view)
        if view == "recordings":
            page.locator("[data-open]").first.click()
            expect(page.locator("#recording h3")).to_be_visible()
        watched.picture(screenshots / f"{view}-{look}.png")
        wide = page.evaluate("document.documentElement.scrollWidth")
        assert wide <= width, f"{view} is {wide} px wide"
    assert watched.errors == []


def test_stale_and_lost_broker_connections_are_shown_and_recover(watched: Watched, parts: Topology) -> None:
    """A broker that hangs, and one that is killed and started again."""
    link, before = watched.page.locator("#link"), list(watched.errors)
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
    assert all("WebSocket connection" in message for message in watched.errors[len(before) :])
    watched.errors[:] = before


@pytest.mark.parametrize("kind", registry.names())
def test_every_limit_and_amplitude_has_a_unit(kind: str) -> None:
    found = registry.of(kind)
    limits = found.file.model_fields["limits"].annotation
    assert set(limits.model_fields) <= found.views.limits.keys()  # type: ignore[union-attr]
    assert found.views.amplitude


def test_effect_is_added_at_its_place_and_unknown_places_are_refused(tmp_path: Path) -> None:
    """A slope is a torque at the robot's wheels, not at its body. Places that the model does not have are refused."""
    (tmp_path / "square.arrow").touch()
    dashboard = Dashboard(Settings(load("twsbr"), tmp_path, "ws://127.0.0.1:9001"))
    asked = {"effect": "static_torque@travel", "recordings": ["square.arrow"]}
    words = dashboard._words("add", asked)
    assert words[:6] == ["model", "add", "twsbr", "static_torque", "--at", "travel"]
    for invalid in ("static_torque@moon", "static_torque@motors", "static_torque@../travel", "slope@travel"):
        with pytest.raises(HTTPException):
            dashboard._words("add", {**asked, "effect": invalid})
