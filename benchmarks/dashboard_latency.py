"""Measure the time from a sample to the screen."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from dashboard_parts import broker, browser, daemon, live, opened, server, until
from playwright.sync_api import Page

from upright.vehicles.file import load

DELAYS = """seconds => new Promise((resolve) => {
  const output = document.querySelector("[id^=value-]"), delays = [], begin = performance.now();
  let seen = output.dataset.time, drawn = null;
  requestAnimationFrame(function each(now) {
    if (drawn !== null) { delays.push(Date.now() - 1000 * drawn); drawn = null; }
    if (output.dataset.time !== seen) { seen = output.dataset.time; drawn = Number(seen); }
    if (now - begin < 1000 * seconds) requestAnimationFrame(each); else resolve(delays);
  });
})"""
"""ms from the newest sample of a frame to the beginning of the next frame: by then it is on the screen."""


def latency() -> None:
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        plain, websocket, _ = stack.enter_context(broker(folder))
        shipped = Path(load("monocab").path).read_text()
        file = folder / "monocab.toml"
        file.write_text(shipped.replace("[mqtt]\n", "[mqtt]\ncommands = true\n", 1))
        options = ("--virtual", "--mqtt", f"127.0.0.1:{plain}")
        place, _ = stack.enter_context(daemon(folder, *options, vehicle=str(file)))
        address = stack.enter_context(server(load(str(file)), folder, websocket))
        page = opened(stack.enter_context(browser()), address)
        live(page)
        page.wait_for_timeout(3000)
        print_delays("at rest", page)
        page.click("#tab-commissioning")
        folded = page.locator("#all-experiments:not([open]) > summary")
        if folded.count():
            folded.click()
        page.click("[data-experiment=multisine]:enabled")
        page.click("#tab-live")
        until(place, lambda status: status["phase"] == "excite")
        print_delays("multisine, with live estimates", page)
        status = until(place, lambda status: status["mode"] == "disarmed")
        silence, words = status["lease"]["longest_silence"], status["reason"] or "ended as planned"
        print(f"its lease of 300 ms: {words}; longest silence {1e3 * silence:.0f} ms")


def print_delays(what: str, page: Page) -> None:
    delays = page.evaluate(DELAYS, 15.0)
    p50, p90, p99 = np.quantile(delays, (0.5, 0.9, 0.99))
    own = page.get_attribute("#latency", "data-ms")
    print(
        f"{what:32} median {p50:.0f} ms, 90 % {p90:.0f} ms, 99 % {p99:.0f} ms of {len(delays)}; the page says {own} ms"
    )
