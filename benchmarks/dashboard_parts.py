"""The parts for the measurements of the dashboard: mosquitto, the page's server, Chromium, the daemon."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import uvicorn
from playwright.sync_api import Browser, Page, expect, sync_playwright

from upright.service.control.clients.api import ApiError, call
from upright.service.dashboard.app import Dashboard, Settings
from upright.service.dashboard.guard import LIMITS
from upright.vehicles.sections import VehicleFile

UPRIGHT = [sys.executable, "-c", "from upright.service.cli import main; main()"]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def broker(folder: Path) -> Iterator[tuple[int, int, int]]:
    """mosquitto as shipped, without passwords and limits: its ports for MQTT and websockets, and its process."""
    plain, websocket = free_port(), free_port()
    (folder / "mosquitto.conf").write_text(
        f"allow_anonymous true\nlistener {plain} 127.0.0.1\nlistener {websocket} 127.0.0.1\nprotocol websockets\n"
        "max_queued_messages 0\nset_tcp_nodelay true\nlog_type error\nuser root\n"
    )
    command = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin") or "mosquitto"
    with subprocess.Popen([command, "-c", folder / "mosquitto.conf"]) as process:
        time.sleep(1.0)
        try:
            yield plain, websocket, process.pid
        finally:
            process.terminate()


@contextmanager
def server(vehicle: VehicleFile, folder: Path, websocket: int) -> Iterator[str]:
    """The dashboard's server in a thread: the page's address."""
    place = socket.create_server(("127.0.0.1", 0))
    application = Dashboard(Settings(vehicle, folder, f"ws://127.0.0.1:{websocket}")).app
    running = uvicorn.Server(uvicorn.Config(application, **LIMITS))
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
    """Debian's Chromium, headless."""
    with sync_playwright() as playwright:
        made = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"] if os.geteuid() == 0 else []
        )
        try:
            yield made
        finally:
            made.close()


def opened(browser: Browser, address: str, script: str = "") -> Page:
    """The page in a browser context of its own, like that of another user."""
    page = browser.new_context(viewport={"width": 1280, "height": 900}).new_page()
    page.add_init_script(script)
    page.goto(address)
    return page


def live(page: Page) -> None:
    """Wait until the page receives data of the vehicle, even if late because the machine is busy."""
    expect(page.locator("#link")).to_have_text(re.compile("^(live|late)"), timeout=60_000)


@contextmanager
def daemon(folder: Path, *options: str, vehicle: str = "monocab") -> Iterator[tuple[Path, int]]:
    """`upright serve`, once it is ready: its socket and process."""
    place = folder / "s.sock"
    words = [*UPRIGHT, "serve", vehicle, "--data", str(folder), "--socket", str(place), *options]
    with subprocess.Popen(words, stderr=subprocess.DEVNULL) as process:
        try:
            until(place, lambda status: status["mode"] == "disarmed" and not status["interlocks"])
            yield place, process.pid
        finally:
            process.terminate()


def until(place: Path, what: Callable[[dict[str, Any]], bool], limit: float = 90.0) -> dict[str, Any]:
    """The daemon's status, once `what` returns True for it."""
    end = time.monotonic() + limit
    while time.monotonic() < end:
        with suppress(ApiError):
            status: dict[str, Any] = list(call([place], {"verb": "status"}))[-1]["status"]
            if what(status):
                return status
        time.sleep(0.1)
    raise TimeoutError("the daemon did not get ready")
