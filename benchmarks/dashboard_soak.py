"""Four hours of telemetry as fast as the page accepts them; then the page's memory and frame rate."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from dashboard_parts import broker, browser, opened, server
from dashboard_story import Publisher, Story
from playwright.sync_api import Browser, Page

from upright.vehicles.file import load

HOURS = 4.0
AHEAD = 20.0
"""s of data by which the page may be behind. With more, the broker would drop messages."""
SETTLED = 20.0
"""s in a view before it is measured: by then the garbage of the previous view is collected."""
VIEWS = ("live", "commissioning", "identify", "gap", "recordings")

PICTURES = """seconds => new Promise((resolve) => {
  const begin = performance.now(); let count = 0, last = begin, longest = 0;
  requestAnimationFrame(function each(now) {
    count += 1; longest = Math.max(longest, now - last); last = now;
    if (now - begin < 1000 * seconds) requestAnimationFrame(each);
    else resolve([1000 * count / (now - begin), longest]);
  });
})"""
"""Frames per second, and the longest time between two of them, ms."""


def soak(hours: float) -> None:
    vehicle = load("monocab")
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        plain, websocket, _ = stack.enter_context(broker(folder))
        address = stack.enter_context(server(vehicle, folder, websocket))
        chromium = stack.enter_context(browser())
        publisher = Publisher(vehicle, plain, time.time())
        stack.callback(publisher.close)
        story = publisher.story
        began, reported = time.monotonic(), 0.0
        print(f"{'':24}{'resident':>12}{'collected':>12}{'unshared':>12}{'heap':>12}   frames/s, longest gap")
        blank = chromium.new_context().new_page()
        report("an empty page", chromium, blank, lambda: None)
        blank.context.close()
        # The data's time runs faster than the wall clock. The page would conclude that the link cannot keep up.
        page = opened(chromium, address, "Date.now = () => 0")
        publisher.steady(5.0)
        report("at the beginning", chromium, page, lambda: publisher.steady(10.0))
        lasted = time.monotonic()
        while story.time < 3600.0 * hours:
            hurry(publisher, page, 5.0)
            if story.time - reported > 3600.0:
                reported = story.time
                pace = story.time / (time.monotonic() - lasted)
                report(
                    f"in hour {reported / 3600.0:.0f}, {pace:.0f} x",
                    chromium,
                    page,
                    lambda: hurry(publisher, page, 8.0),
                )
        publisher.steady(SETTLED)
        for view in VIEWS:
            page.click(f"#tab-{view}")
            report(f"afterwards, {view}", chromium, page, lambda: publisher.steady(SETTLED))
        page.click("#tab-live")
        publisher.steady(2.0)
        page.wait_for_timeout(1000)
        assert story.time - shown(page, story) < 0.2, "the page has lost the end of the data"
        counted = page.get_attribute("#ignored", "data-count")
        lasted = time.monotonic() - began
        print(f"{story.time / 3600.0:.2f} h of data in {lasted:.0f} s; messages ignored by the page: {counted or 0}")


def shown(page: Page, story: Story) -> float:
    """s of the story that the page has drawn."""
    time_shown = page.evaluate("document.querySelector('[id^=value-]').dataset.time ?? null")
    return 0.0 if time_shown is None else float(time_shown) - story.begin_ns * 1e-9


def hurry(publisher: Publisher, page: Page, seconds: float) -> None:
    """Publish the story as fast as the page accepts it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        publisher.burst(50)
        limit = time.monotonic() + 30.0
        while publisher.story.time - shown(page, publisher.story) > AHEAD:
            assert time.monotonic() < limit, "the page has lost data"
            time.sleep(0.02)


def report(what: str, browser: Browser, page: Page, meanwhile: Callable[[], None]) -> None:
    """Print a line about the page while `meanwhile` runs, for 6 s at least: as it is, and after a collection."""
    page.evaluate(f"() => {{ window.pictures = ({PICTURES})(5.0); }}")
    meanwhile()
    rate, gap = page.evaluate("window.pictures")
    resident, _ = renderer_memory(browser)
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.collectGarbage")
    heap = session.send("Runtime.getHeapUsage")["usedSize"] / 1e6
    session.detach()
    figures = (resident, *renderer_memory(browser), heap)
    print(f"{what:24}{''.join(f'{each:9.0f} MB' for each in figures)}   {rate:.0f}, {gap:.0f} ms", flush=True)


def renderer_memory(browser: Browser) -> tuple[float, float]:
    """Resident and unshared memory of the largest renderer, which is that of the page, MB."""
    processes = browser.new_browser_cdp_session().send("SystemInfo.getProcessInfo")["processInfo"]
    found = []
    for process in processes:
        if process["type"] == "renderer":
            lines = Path(f"/proc/{process['id']}/smaps_rollup").read_text().splitlines()
            kept = {line.split(":")[0]: int(line.split()[1]) / 1024 for line in lines[1:]}
            found.append((kept["Rss"], kept["Private_Clean"] + kept["Private_Dirty"]))
    return max(found)
