"""Four hours of telemetry as fast as the page takes them, and what the page weighs and draws after them."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from dashboard_parts import broker, browser, opened, server
from dashboard_story import Story, Teller
from playwright.sync_api import Browser, Page

from vehicles.file import load

HOURS = 4.0
AHEAD = 20.0
"""s of data that the page may be behind what is sent; of more the broker would drop some."""
SETTLED = 20.0
"""s in a view before it is looked at: what the view before has left is collected by then."""
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


def soak(hours: float) -> None:
    vehicle = load("monocab")
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        plain, websocket, _ = stack.enter_context(broker(folder))
        address = stack.enter_context(server(vehicle, folder, websocket))
        chromium = stack.enter_context(browser())
        teller = Teller(vehicle, plain, time.time())
        stack.callback(teller.close)
        story = teller.story
        began, told = time.monotonic(), 0.0
        print(f"{'':24}{'resident':>12}{'collected':>12}{'unshared':>12}{'heap':>12}   pictures/s, longest gap")
        blank = chromium.new_context().new_page()
        say("an empty page", chromium, blank, lambda: None)
        blank.context.close()
        # Time goes faster in the data than on the wall, which the page would take for a link that cannot keep up.
        page = opened(chromium, address, "Date.now = () => 0")
        teller.steady(5.0)
        say("at the beginning", chromium, page, lambda: teller.steady(10.0))
        lasted = time.monotonic()
        while story.time < 3600.0 * hours:
            hurry(teller, page, 5.0)
            if story.time - told > 3600.0:
                told = story.time
                pace = story.time / (time.monotonic() - lasted)
                say(f"in hour {told / 3600.0:.0f}, {pace:.0f} x", chromium, page, lambda: hurry(teller, page, 8.0))
        teller.steady(SETTLED)
        for view in VIEWS:
            page.click(f"#tab-{view}")
            say(f"afterwards, {view}", chromium, page, lambda: teller.steady(SETTLED))
        page.click("#tab-live")
        teller.steady(2.0)
        page.wait_for_timeout(1000)
        assert story.time - shown(page, story) < 0.2, "the page has lost the end"
        counted = page.get_attribute("#ignored", "data-count")
        lasted = time.monotonic() - began
        print(f"{story.time / 3600.0:.2f} h of data in {lasted:.0f} s; messages ignored by the page: {counted or 0}")


def shown(page: Page, story: Story) -> float:
    """s of the story that the page has drawn."""
    time_shown = page.evaluate("document.querySelector('[id^=value-]').dataset.time ?? null")
    return 0.0 if time_shown is None else float(time_shown) - story.begin_ns * 1e-9


def hurry(teller: Teller, page: Page, seconds: float) -> None:
    """The story as fast as the page takes it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        teller.burst(50)
        limit = time.monotonic() + 30.0
        while teller.story.time - shown(page, teller.story) > AHEAD:
            assert time.monotonic() < limit, "the page has lost some of it"
            time.sleep(0.02)


def say(what: str, browser: Browser, page: Page, meanwhile: Callable[[], None]) -> None:
    """A line about the page while `meanwhile` runs, for 6 s at least: as it is then, and after a collection."""
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
    """Resident and unshared memory of the largest renderer, MB: that of the page."""
    processes = browser.new_browser_cdp_session().send("SystemInfo.getProcessInfo")["processInfo"]
    found = []
    for process in processes:
        if process["type"] == "renderer":
            lines = Path(f"/proc/{process['id']}/smaps_rollup").read_text().splitlines()
            kept = {line.split(":")[0]: int(line.split()[1]) / 1024 for line in lines[1:]}
            found.append((kept["Rss"], kept["Private_Clean"] + kept["Private_Dirty"]))
    return max(found)
