"""The control process' end of the observer: starts it, feeds it, hears from it, and never waits for it.

Control cycles and raw frames are gathered into batches by the time they carry and leave with one system call a batch;
where the pipe is full they are dropped and counted. Messages (recording on and off, state, events) keep their place
between the frames and are queued, up to a bound. On SocketCAN a process of its own logs the raw frames from its own
sockets (`service.raw_log`), so that the log goes on when the observer, or this process, is gone.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import select
import socket
import sys
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from service import link
from service.raw_log_process import RawLogProcess
from telemetry.channels import TABLES
from telemetry.samples import CanFrame, Frame

BATCH_NS = 20_000_000
"""Time in the data that one batch of control cycles spans."""

MOST_FRAMES = 32
MOST_CAN_FRAMES = 512
"""Frames of a batch that is sent whatever its time: a clock that was set back must not hold it up."""

MOST_MESSAGES = 256
"""Messages that wait for room in the pipe."""

LONGEST_WAIT = 5.0
"""s that `lossless` waits for room in the pipe."""

ORDERLY_END = 10.0
"""s that the observer gets to end by itself."""


@dataclass(slots=True)
class ObserverStatistics:
    """Counts since the client was made. `dropped` found the pipe full or the observer gone."""

    frames: int = 0
    frames_dropped: int = 0
    can_frames: int = 0
    can_frames_dropped: int = 0
    messages_dropped: int = 0
    exits: int = 0


class ObserverClient:
    """Starts and feeds one observer process. All methods are called in the event loop's thread.

    `hello` is what the observer must know of the vehicle (`service.assembly.observer_hello`). `lossless` is for a
    simulated bus whose time stands still meanwhile: a full pipe is then waited for.
    """

    def __init__(self, hello: dict[str, Any], *, lossless: bool = False) -> None:
        self.estimates: dict[str, Any] = {}
        """Latest results of the running or last recording: method to `Estimate.to_json`."""
        self.report: dict[str, Any] = {}
        """What the observer said last of itself: MQTT connection, what it dropped."""
        self.on_exit: Callable[[int], None] = lambda status: None
        """Called with the exit status when the observer ended without being told to."""
        self._hello = hello
        self._lossless = lossless
        self._statistics = ObserverStatistics()
        self._codec = link.FrameCodec(len(TABLES[hello["kind"]]))
        self._frames: list[Frame] = []
        self._flush_at_ns = 0
        self._can_frames: list[CanFrame] = []
        self._flush_can_at_ns = 0
        self._messages: deque[bytes] = deque()
        self._waiting_for_room = False
        self._latest: dict[str, bytes] = {}
        self._socket: socket.socket | None = None
        self._process: asyncio.subprocess.Process | None = None
        self._watch: asyncio.Task[None] | None = None
        self._raw_log: subprocess.Popen[bytes] | None = None
        self._recording: dict[str, Any] = {}
        self._dropped_before = 0
        self._finished: asyncio.Future[dict[str, Any]] | None = None

    # Life of the processes

    @property
    def alive(self) -> bool:
        """Whether there is an observer to talk to."""
        return self._socket is not None

    async def start(self) -> None:
        """Start the observer and, for SocketCAN, the raw log. Returns before they are up: the pipe holds until then."""
        channels = [address.partition(":")[2] for address in self._hello["raw_log_buses"]]
        if channels and self._raw_log is None:
            self._raw_log = RawLogProcess(channels, self.event)
        await self.restart()

    async def restart(self) -> None:
        """Start the observer if there is none. A recording that the old one had begun is not taken up again."""
        if self._socket is not None:
            return
        own, other = link.pair()
        with other:
            self._process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-m",
                "service.observer",
                str(other.fileno()),
                pass_fds=(other.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,
            )
        self._frames.clear()
        self._can_frames.clear()
        self._messages.clear()
        self._socket = own
        asyncio.get_running_loop().add_reader(own, self._receive)
        self._watch = asyncio.create_task(self._wait_for_exit(self._process), name="watch the observer")
        self._send_json({"type": "hello", **self._hello})
        for packet in self._latest.values():
            self._post(packet)

    async def stop(self) -> None:
        """Let the observer finish its recording, say goodbye to the broker and end; killed after `ORDERLY_END` s."""
        self._flush()
        watch, process, connection = self._watch, self._process, self._socket
        self._watch = None
        if connection is not None and process is not None and watch is not None:
            limit = asyncio.get_running_loop().time() + 1.0
            while self._messages and self.alive and asyncio.get_running_loop().time() < limit:
                await asyncio.sleep(0.01)
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_WR)
            try:
                await asyncio.wait_for(asyncio.shield(watch), ORDERLY_END)
            except TimeoutError:
                process.kill()
                await watch
        if self._raw_log is not None:
            log, self._raw_log = self._raw_log, None
            await log.stop()

    async def _wait_for_exit(self, process: asyncio.subprocess.Process) -> None:
        status = await process.wait()
        self._receive()
        self._disconnect()
        if self._finished is not None and not self._finished.done():
            self._finished.set_result({**self._recording, "reason": "the observer process ended"})
        self._recording = {}
        if self._watch is not None:
            self._statistics.exits += 1
            self.on_exit(status)

    def _disconnect(self) -> None:
        if self._socket is not None:
            loop = asyncio.get_running_loop()
            loop.remove_reader(self._socket)
            loop.remove_writer(self._socket)
            self._waiting_for_room = False
            self._socket.close()
            self._socket = None

    # What control tells the observer

    def offer(self, frame: Frame) -> None:
        """One control cycle."""
        self._frames.append(frame)
        if frame.timestamp_ns >= self._flush_at_ns or len(self._frames) >= MOST_FRAMES:
            self._flush_at_ns = frame.timestamp_ns + BATCH_NS
            self._flush_frames()

    def offer_can(self, frame: CanFrame) -> None:
        """One raw frame, on buses that no second process can listen to. Kept only while a recording runs."""
        if not self._recording:
            return
        self._can_frames.append(frame)
        if frame.timestamp_ns >= self._flush_can_at_ns or len(self._can_frames) >= MOST_CAN_FRAMES:
            self._flush_can_at_ns = frame.timestamp_ns + BATCH_NS
            self._flush_can_frames()

    def start_recording(self, name: str, start_ns: int, metadata: dict[str, str]) -> None:
        """Record and estimate from `start_ns` on. `name` becomes part of the file names."""
        now = datetime.now(UTC)
        safe_name = re.sub(r"[^\w.-]", "_", name)
        folder = Path(self._hello["data"]).absolute()
        stem = folder / f"{now:%Y%m%d-%H%M%S}-{now.microsecond // 1000:03d}_{safe_name}"
        raw_log = folder / f"{stem.name}.log"
        self._recording = {"recording": f"{stem}.arrow", "raw_log": str(raw_log)}
        self._finished = asyncio.get_running_loop().create_future()
        self.estimates = {}
        self._dropped_before = self._statistics.frames_dropped
        if self._raw_log is not None:
            self._raw_log.open(raw_log, start_ns)
        self._send_json({
            "type": "start_recording",
            "stem": str(stem),
            "start_ns": start_ns,
            "metadata": metadata,
            "raw_log": self._raw_log is None,
        })  # fmt: skip

    def stop_recording(self, reason: str, end_ns: int) -> None:
        """Record up to and with `end_ns`, which may be the cycle that is not offered yet; then give the final results."""
        tail_ns = round(0.5e9 / self._hello["rate"])
        if self._raw_log is not None:
            self._raw_log.close(end_ns + tail_ns)
        self._send_json({
            "type": "stop_recording",
            "reason": reason,
            "end_ns": end_ns,
            "raw_end_ns": end_ns + tail_ns,
            "dropped_frames": self._statistics.frames_dropped - self._dropped_before,
        })  # fmt: skip

    async def finished_recording(self, timeout: float = 15.0) -> dict[str, Any]:
        """The running or last recording's summary, once it is on the disk: paths, rows, final estimates.

        What is known of it where it is not finished within `timeout` s; empty where nothing was ever recorded.
        """
        if self._finished is None:
            return {}
        try:
            return await asyncio.wait_for(asyncio.shield(self._finished), timeout)
        except TimeoutError:
            return {**self._recording, "reason": f"not finished within {timeout:g} s", "estimates": self.estimates}

    def publish_state(self, state: dict[str, Any]) -> None:
        """The retained state; the observer that is started next is told it, too."""
        self._latest["state"] = packet = link.pack_json({"type": "state", "state": state})
        self._post(packet)

    def progress(self, task: str, fraction: float, remaining: float) -> None:
        """How far a running task is, 0 to 1, and how many s it still needs."""
        self._send_json({"type": "progress", "task": task, "fraction": fraction, "remaining": remaining})

    def event(self, severity: str, code: str, text: str) -> None:
        """Something happened: severity "info", "warning" or "error", a code for programs, a text for people."""
        self._send_json({"type": "event", "severity": severity, "code": code, "text": text})

    def statistics(self) -> dict[str, Any]:
        """For `upright status`."""
        return {"alive": self.alive, **asdict(self._statistics), **self.report}

    # The pipe

    def _flush(self) -> None:
        if self._frames:
            self._flush_frames()
        if self._can_frames:
            self._flush_can_frames()

    def _flush_frames(self) -> None:
        frames, self._frames = self._frames, []
        if self._send(self._codec.pack(frames)):
            self._statistics.frames += len(frames)
        else:
            self._statistics.frames_dropped += len(frames)

    def _flush_can_frames(self) -> None:
        frames, self._can_frames = self._can_frames, []
        if self._send(link.pack_can(frames)):
            self._statistics.can_frames += len(frames)
        else:
            self._statistics.can_frames_dropped += len(frames)

    def _send_json(self, message: dict[str, Any]) -> None:
        self._post(link.pack_json(message))

    def _post(self, packet: bytes) -> None:
        """A message: after the frames that came before it, queued where there is no room."""
        self._flush()
        if self._send(packet):
            return
        if self._socket is None or len(self._messages) >= MOST_MESSAGES:
            self._statistics.messages_dropped += 1
            return
        self._messages.append(packet)
        if not self._waiting_for_room:
            self._waiting_for_room = True
            asyncio.get_running_loop().add_writer(self._socket, self._send_messages)

    def _send_messages(self) -> bool:
        """Whether no message waits any more."""
        while self._messages and self._socket is not None:
            if not self._try_send(self._messages[0]):
                return False
            self._messages.popleft()
        if self._waiting_for_room and self._socket is not None:
            self._waiting_for_room = False
            asyncio.get_running_loop().remove_writer(self._socket)
        return True

    def _send(self, packet: bytes) -> bool:
        while not (self._send_messages() and self._try_send(packet)):
            if not (self._lossless and self._wait_for_room()):
                return False
        return True

    def _try_send(self, packet: bytes) -> bool:
        if self._socket is None:
            return False
        try:
            self._socket.send(packet)
        except BlockingIOError:
            return False
        except OSError:
            self._disconnect()  # The observer is gone; its exit status follows.
            return False
        return True

    def _wait_for_room(self) -> bool:
        if self._socket is None:
            return False
        poll = select.poll()
        poll.register(self._socket, select.POLLOUT)
        return bool(poll.poll(LONGEST_WAIT * 1000))

    def _receive(self) -> None:
        """Take what the observer sent."""
        while self._socket is not None:
            try:
                packet = self._socket.recv(link.LARGEST)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            if not packet:
                # Its end is closed; the exit status follows.
                asyncio.get_running_loop().remove_reader(self._socket)
                return
            self._handle(link.unpack_json(packet))

    def _handle(self, message: dict[str, Any]) -> None:
        match message.pop("type"):
            case "estimates":
                self.estimates = message["estimates"]
            case "report":
                self.report = message
            case "finished":
                if message["recording"] != self._recording.get("recording"):
                    return  # That of the recording before.
                self.estimates = message["estimates"]
                if self._finished is not None and not self._finished.done():
                    self._finished.set_result({**self._recording, **message})
                self._recording = {}
