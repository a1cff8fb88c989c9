"""A page in a real browser whose errors are collected, for tests of the dashboard."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, Route, expect, sync_playwright

PATIENCE = 60_000
"""Timeout on a machine that is busy with other tests, ms."""


@contextmanager
def chromium() -> Iterator[Browser]:
    """Debian's Chromium, until the block ends."""
    executable = shutil.which("chromium")
    if executable is None:
        pytest.skip("no chromium here: apt-get install chromium")
    sandbox = ["--no-sandbox"] if os.geteuid() == 0 else []  # there is no sandbox as root
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=sandbox)
        yield browser
        browser.close()


class Watched:
    """A page and its errors: console errors, exceptions, requests that leave this machine."""

    def __init__(self, context: BrowserContext, address: str, link: str | None = "live", **config: object) -> None:
        """`link` is the connection state that the page reaches; `config` replaces entries of the server's answer."""
        self.errors: list[str] = []
        self.page: Page = context.new_page()
        self.page.set_default_timeout(PATIENCE)
        self.page.on("console", lambda message: self.errors.append(message.text) if message.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self._check_local(request.url))
        self.page.on("websocket", lambda socket: self._check_local(socket.url))
        if config:
            self.page.route("**/api/config", lambda route: self._change_config(route, config))
        self.page.goto(address)
        if link is not None:
            expect(self.page.locator("#link")).to_have_text(link, timeout=PATIENCE)

    def _change_config(self, route: Route, config: dict[str, object]) -> None:
        answer = route.fetch()
        route.fulfill(response=answer, json={**answer.json(), **config})

    def _check_local(self, url: str) -> None:
        if urlsplit(url).hostname not in ("localhost", "127.0.0.1"):
            self.errors.append(f"request to {url}")

    def picture(self, path: Path) -> None:
        """Take a picture of the whole page, in a window of its full height: charts off the screen are not drawn."""
        size = self.page.viewport_size
        assert size is not None
        height, drawn = size["height"], 0
        while height != drawn:  # charts that become visible may make it higher
            drawn, height = height, self.page.evaluate("document.documentElement.scrollHeight")
            self.page.set_viewport_size({"width": size["width"], "height": height})
            self.page.wait_for_timeout(400)
        self.page.screenshot(path=path)
        self.page.set_viewport_size(size)

    def show(self, view: str) -> None:
        self.page.click(f"#tab-{view}")
        expect(self.page.locator(f"#view-{view}")).to_be_visible()
