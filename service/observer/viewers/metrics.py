"""Figures of the service for Prometheus, as text on http://127.0.0.1:PORT/metrics.

Control sends its figures to the observer twice a second; whoever scrapes asks the observer, so that nobody takes the
control loop's time. A thread serves one request after another, to this computer only; a client has `PATIENCE` s.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from http.server import BaseHTTPRequestHandler
from itertools import accumulate
from socketserver import TCPServer
from typing import Any

HOST = "127.0.0.1"
LOCAL = (HOST, "localhost")
"""Names by which a scraper may ask: a page from elsewhere, whose name was bound to this address, has another."""
TEXT_FORMAT = "text/plain; version=0.0.4; charset=utf-8"
PATIENCE = 2.0
"""s that a client may take for its request or for reading the answer."""

TIMES = {
    "interval": "Time from one IMU frame set to the next.",
    "processing": "Time in which the control process answers a frame set.",
    "turnaround": "Time from receiving a frame set until its setpoints have been given to the bus.",
}
BUS_COUNTS = {
    "received": "CAN frames received.",
    "sent": "CAN frames sent.",
    "receive_dropped": "CAN frames that the kernel dropped.",
    "transmit_dropped": "CAN frames that found no place in the transmit queue.",
    "error_frames": "CAN error frames.",
}


class Metrics:
    """The latest figures of control, and their text. `report` and `text` may be called by different threads."""

    def __init__(self, vehicle: str, version: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._vehicle = vehicle
        self._version = version
        self._clock = clock
        self._latest: tuple[float, Mapping[str, Any]] | None = None

    def report(self, figures: Mapping[str, Any]) -> None:
        """Take the figures of control."""
        self._latest = self._clock(), figures

    def text(self) -> str:
        """All metrics in the text format; without figures of control only what is known before."""
        lines = [*_info({"vehicle": self._vehicle, "version": self._version})]
        if self._latest is not None:
            at, figures = self._latest
            lines += _one("upright_report_age_seconds", "gauge", "Age of the other figures.", self._clock() - at)
            lines += _of_control(figures)
        return "\n".join(lines) + "\n"


def _info(labels: Mapping[str, str]) -> Iterator[str]:
    yield from _head("upright_info", "gauge", "Vehicle and version of the service.")
    yield f"upright_info{_labels(labels)} 1"


def _of_control(figures: Mapping[str, Any]) -> Iterator[str]:
    yield from _head("upright_mode", "gauge", "Mode of the daemon: 1 for the present one.")
    for mode in figures["modes"]:
        yield f"upright_mode{_labels({'mode': mode})} {int(mode == figures['mode'])}"
    yield from _one("upright_cycles_total", "counter", "Control cycles.", figures["cycles"])
    yield from _one("upright_missed_cycles_total", "counter", "Control cycles missed.", figures["missed_cycles"])
    yield from _one("upright_clock_steps_total", "counter", "Steps of the computer's clock.", figures["clock_steps"])
    dropped = "Control cycles that the observer did not get."
    yield from _one("upright_observer_dropped_cycles_total", "counter", dropped, figures["observer_dropped"])
    for name, meaning in BUS_COUNTS.items():
        yield from _head(f"upright_bus_{name}_total", "counter", meaning)
        for bus in figures["buses"]:
            yield f"upright_bus_{name}_total{_labels({'bus': bus['address']})} {bus[name]}"
    for name, meaning in TIMES.items():
        yield from _histogram(f"upright_cycle_{name}_seconds", meaning, figures["timing"][name])


def _histogram(name: str, meaning: str, found: Mapping[str, Any]) -> Iterator[str]:
    yield from _head(name, "histogram", meaning)
    counts = list(accumulate(found["counts"]))
    for bound, count in zip([*map(_number, found["bounds"]), "+Inf"], counts, strict=True):
        yield f"{name}_bucket{_labels({'le': bound})} {count}"
    yield f"{name}_sum {_number(found['sum'])}"
    yield f"{name}_count {counts[-1]}"
    largest = f"{name.removesuffix('_seconds')}_largest_seconds"
    yield from _one(largest, "gauge", f"Largest: {meaning}", found["largest"])


def _one(name: str, kind: str, meaning: str, value: float) -> Iterator[str]:
    yield from _head(name, kind, meaning)
    yield f"{name} {_number(value)}"


def _head(name: str, kind: str, meaning: str) -> Iterator[str]:
    yield f"# HELP {name} {meaning}"
    yield f"# TYPE {name} {kind}"


def _labels(labels: Mapping[str, str]) -> str:
    def escaped(value: str) -> str:
        return value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")

    return "{" + ",".join(f'{name}="{escaped(value)}"' for name, value in labels.items()) + "}"


def _number(value: float) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)


class _Handler(BaseHTTPRequestHandler):
    timeout = PATIENCE
    server_version, sys_version = "upright", ""

    def do_GET(self) -> None:
        assert isinstance(self.server, MetricsServer)
        if self.headers.get("Host", "").partition(":")[0] not in LOCAL:
            self.send_error(403)
            return
        if self.path != "/metrics":
            self.send_error(404)
            return
        content = self.server.text().encode()
        self.send_response(200)
        self.send_header("Content-Type", TEXT_FORMAT)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *arguments: object) -> None:
        """Scrapes are not logged."""


class MetricsServer(TCPServer):
    """Serves `text()` at `port` of this computer from a thread, until the process ends. Raises OSError."""

    allow_reuse_address = True

    def __init__(self, port: int, text: Callable[[], str]) -> None:
        super().__init__((HOST, port), _Handler)
        self.text = text
        threading.Thread(target=self.serve_forever, name="metrics", daemon=True).start()

    def handle_error(self, request: object, client_address: object) -> None:
        """A client that has gone is no news."""
