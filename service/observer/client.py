"""The client of the observer in the control process: starts it, exchanges messages with it, and never waits for it.

On SocketCAN a separate process logs the raw frames with its own sockets (`service.observer.recording.raw_log`). It is
started here, too, so that the log continues if the observer, or this process, ends.
"""

from __future__ import annotations

import asyncio
import re
import sys
from asyncio.subprocess import DEVNULL, Process
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from upright.service.observer import link
from upright.service.observer.pipe import ObserverPipe, PipeStatistics
from upright.service.observer.recording.raw_log_client import RawLogProcess
from upright.service.turns import Turns
from upright.telemetry.samples import CanFrame, Frame

ORDERS = ("start_recording", "stop_recording")
"""Messages that must not be lost."""
ORDERLY_END = 20.0
"""Time limit for the observer to end by itself, s: one that still compiles on a busy processor reads late what is in
its pipe, and then completes the recording."""


class ObserverClient:
    """Starts and feeds one observer process. All methods are called in the event loop's thread.

    `hello` has the data about the vehicle for the observer (`service.control.assembly.observer_hello`). `lossless` is
    for a simulated bus whose time can stand still: the client then waits while the pipe is full. The observer's
    messages are read in `turns`.
    """

    def __init__(self, hello: dict[str, Any], *, lossless: bool = False, turns: Turns | None = None) -> None:
        self.estimates: dict[str, Any] = {}
        """Latest results of the running or last recording: `Estimate.to_json` by method."""
        self.diagnosis: dict[str, Any] | None = None
        """The live diagnosis of the running or last recording, as `diagnose --json`."""
        self.on_exit: Callable[[int], None] = lambda status: None
        """Called with the exit status if the observer ended unexpectedly."""
        self.on_obstacle: Callable[[str], None] = lambda text: None
        """Called with the reason if a recording that runs cannot be written."""
        self.on_command: Callable[[dict[str, Any]], None] = lambda command: None
        """Called with a command received by MQTT: verb, client, id, arguments."""
        self._hello = hello
        self._lossless = lossless
        self._turns = turns or Turns()
        self._counts = PipeStatistics()
        self._pipe: ObserverPipe | None = None
        self._process: Process | None = None
        self._watch: asyncio.Task[None] | None = None
        self._stopping = False
        self._raw_log: RawLogProcess | None = None
        self._kept: dict[str, bytes] = {}
        """The last message of each retained topic, for an observer that is started later."""
        self._report: dict[str, Any] = {}
        self._recording: dict[str, Any] = {}
        self._open = False
        """Whether a recording has been started and not been stopped."""
        self._dropped_before = 0
        self._finished: asyncio.Future[dict[str, Any]] | None = None

    # Life of the processes

    @property
    def alive(self) -> bool:
        """Whether there is a connected observer."""
        return self._pipe is not None and self._pipe.is_open

    @property
    def ready(self) -> bool:
        """Whether the observer has reported that it is up."""
        return self.alive and bool(self._report)

    @property
    def obstacle(self) -> str:
        """Why a recording would not be complete, as a sentence with the remedy; "" if it would."""
        if self._raw_log is not None and not self._raw_log.alive:
            return "Raw frames would not be recorded: their process ended. It is started again; wait for a second."
        return str(self._report.get("obstacle", ""))

    @property
    def complete(self) -> bool:
        """Whether all processes run."""
        return self.alive and (self._raw_log is None or self._raw_log.alive)

    @property
    def pid(self) -> int | None:
        """Process id of the observer."""
        return self._process.pid if self._process is not None else None

    async def start(self) -> None:
        """Start the observer and, for SocketCAN, the raw log. Returns before they are up: the pipe holds until then."""
        await self.restart()

    async def restart(self) -> None:
        """Start what does not run. A recording that an old observer had started is not resumed; a new raw log begins
        with the next recording."""
        buses = [address.partition(":")[2] for address in self._hello["raw_log_buses"]]
        if buses and not self._recording and (self._raw_log is None or not self._raw_log.alive):
            if self._raw_log is not None:
                await self._raw_log.stop()
            self._raw_log = RawLogProcess(buses, self.event, self._hello.get("clock_base_ns"))
        if self.alive:
            return
        self._report = {}
        own, other = link.pair()
        command = [sys.executable, "-P", "-m", "upright.service.observer.process", str(other.fileno())]
        with other:
            self._process = await asyncio.create_subprocess_exec(
                *command, pass_fds=(other.fileno(),), stdin=DEVNULL, stdout=DEVNULL, start_new_session=True
            )
        channels = len(self._hello["channels"])
        pipe = self._pipe = ObserverPipe(
            own, channels, self._counts, self._handle, lossless=self._lossless, turns=self._turns
        )
        self._watch = asyncio.create_task(self._wait_for_exit(self._process, pipe), name="watch the observer")
        pipe.post(link.pack_json({"type": "hello", **self._hello}))
        for message in self._kept.values():
            pipe.post(message)

    async def stop(self) -> None:
        """Let the observer finish its recording, disconnect from the broker and end; killed after `ORDERLY_END` s."""
        self._stopping = True
        if self._pipe is not None and self._process is not None and self._watch is not None:
            await self._pipe.end(1.0)
            try:
                await asyncio.wait_for(asyncio.shield(self._watch), ORDERLY_END)
            except TimeoutError:
                self._process.kill()
                await self._watch
        if self._raw_log is not None:
            await self._raw_log.stop()

    async def _wait_for_exit(self, process: Process, pipe: ObserverPipe) -> None:
        status = await process.wait()
        pipe.receive()
        pipe.close()
        if self._finished is not None and not self._finished.done():
            self._finished.set_result(self._unfinished("the observer process ended"))
        self._recording = {}
        self._open = False
        if not self._stopping:
            self._counts.exits += 1
            self.on_exit(status)

    # Messages from control to the observer

    def offer(self, frame: Frame) -> None:
        """Send one control cycle."""
        if self._pipe is not None:
            self._pipe.offer(frame)

    def offer_can(self, frame: CanFrame) -> None:
        """Send one raw frame, for buses that a second process cannot listen to. Only while a recording runs."""
        if self._recording and self._pipe is not None:
            self._pipe.offer_can(frame)

    def start_recording(self, name: str, start_ns: int, metadata: dict[str, str]) -> None:
        """Record and estimate from `start_ns` on. `name` becomes part of the file names."""
        if self._finished is not None and not self._finished.done():
            self._finished.set_result(self._unfinished("another recording began"))
        now = datetime.now(UTC)
        safe_name = re.sub(r"[^\w.-]", "_", name)
        folder = Path(self._hello["data"]).absolute()
        stem = folder / f"{now:%Y%m%d-%H%M%S}-{now.microsecond // 1000:03d}_{safe_name}"
        raw_log = Path(f"{stem}.log")
        self._recording = {"recording": f"{stem}.arrow", "raw_log": str(raw_log)}
        self._finished = asyncio.get_running_loop().create_future()
        self.estimates, self.diagnosis = {}, None
        self._dropped_before = self._counts.frames_dropped
        self._open = True
        if self._raw_log is not None:
            self._raw_log.open(raw_log, start_ns)
        self._post(
            "start_recording", stem=str(stem), start_ns=start_ns, metadata=metadata, raw_log=self._raw_log is None
        )

    def stop_recording(self, reason: str, end_ns: int) -> None:
        """Record up to and including the cycle of `end_ns`, which may not be offered yet; then await the results."""
        # The raw log shall contain the setpoints of the last cycle, but not the next complete IMU frame set.
        self._open = False
        raw_end_ns = end_ns + round(0.5e9 / self._hello["rate"])
        if self._raw_log is not None:
            self._raw_log.close(raw_end_ns)
        if self._pipe is not None:
            self._pipe.flush()
        dropped = self._counts.frames_dropped - self._dropped_before
        self._post("stop_recording", reason=reason, end_ns=end_ns, raw_end_ns=raw_end_ns, dropped_frames=dropped)

    async def finished_recording(self, timeout: float = 15.0) -> dict[str, Any]:
        """The running or last recording, once it is on the disk: recording, raw_log (paths), rows, failure, estimates,
        diagnosis.

        If it is not finished within `timeout` s, `failure` says so; empty if nothing was ever recorded.
        """
        if self._finished is None:
            return {}
        raw_log = self._raw_log
        try:
            summary = await asyncio.wait_for(asyncio.shield(self._finished), timeout)
        except TimeoutError:
            summary = self._unfinished(f"not finished within {timeout:g} s")
        if raw_log is not None and raw_log.failure and not summary["failure"]:
            return {**summary, "failure": raw_log.failure}
        return summary

    def retain(self, topic: str, document: dict[str, Any]) -> None:
        """Send a document to be retained by the broker; an observer that is started later gets it, too."""
        message = self._kept[topic] = link.pack_json({"type": "retain", "topic": topic, "document": document})
        if self._pipe is not None:
            self._pipe.post(message)

    def progress(self, task: str, fraction: float, remaining: float) -> None:
        """Send the progress of a running task, 0 to 1, and its remaining time, s."""
        self._post("progress", task=task, fraction=fraction, remaining=remaining)

    def event(self, severity: str, code: str, text: str) -> None:
        """Send an event: severity "info", "warning" or "error", a code for programs, a text for users."""
        self._post("event", severity=severity, code=code, text=text)

    def health(self, report: dict[str, Any]) -> None:
        """Send the health of the control process, which is published with the telemetry."""
        self._post("health", health=report)

    def figures(self, figures: dict[str, Any]) -> None:
        """Send the figures for whoever scrapes metrics."""
        self._post("figures", figures=figures)

    def reply(self, client: str, reply: dict[str, Any]) -> None:
        """Send the answer to a command received by MQTT."""
        self._post("reply", client=client, reply=reply)

    def statistics(self) -> dict[str, Any]:
        """For `upright status`: counts of the pipe, and the last report of the observer."""
        return {"alive": self.alive, **asdict(self._counts), **self._report}

    def _post(self, type: str, **message: Any) -> None:
        if self._pipe is not None:
            self._pipe.post(link.pack_json({"type": type, **message}), order=type in ORDERS)

    # Messages from the observer to control

    def _handle(self, message: dict[str, Any]) -> None:
        match message.pop("type"):
            case "estimates":
                self.estimates, self.diagnosis = message["estimates"], message["diagnosis"]
            case "report":
                self._report = message
                if self._open and message.get("obstacle"):
                    self.on_obstacle(message["obstacle"])
            case "command":
                self.on_command(message)
            case "finished" if message["recording"] == self._recording.get("recording"):
                self.estimates, self.diagnosis = message["estimates"], message["diagnosis"]
                if self._open and message["failure"]:
                    self.on_obstacle(f"Nothing is recorded: {message['failure']}.")
                self._open = False
                if self._finished is not None and not self._finished.done():
                    self._finished.set_result({**self._recording, **message})
                self._recording = {}

    def _unfinished(self, failure: str) -> dict[str, Any]:
        return {**self._recording, "failure": failure, "estimates": self.estimates, "diagnosis": self.diagnosis}
