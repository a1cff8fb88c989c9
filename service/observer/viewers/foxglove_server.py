"""The vehicle live in Foxglove, Lichtblick and PlotJuggler: a server of Foxglove's WebSocket protocol (foxglove-sdk).

It listens on this computer only. It shows and never commands: it offers no capability of the protocol, so that clients
can neither publish, nor set parameters, nor call services. Every control cycle is a message of its own, of ROS 2, as
that is the one encoding that all three viewers plot; events are `foxglove.Log`.

Times are ns since 1970, those of the recording. A message has the time of its data twice, as log time and in
`header.stamp`: PlotJuggler plots over the first; Foxglove and Lichtblick have the time of receipt in its place, and
plot over the second if that is chosen.

What a client does not read in time is dropped, the oldest first: at most `BACKLOG` messages wait for each. The server
ends with the process, since its own orderly stop waits for clients that do not read.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from math import nan
from typing import Any

import foxglove
from foxglove.channels import LogChannel
from foxglove.messages import Log, LogLevel, Timestamp

from upright.service.observer.viewers.ros_message import NANOSECONDS, MessageType
from upright.telemetry.channels import ChannelTable
from upright.telemetry.samples import Frame
from upright.vehicles import registry

HOST = "127.0.0.1"

BACKLOG = 2048
"""Messages that wait for one client: 4 s at 500 Hz, less than 1 MB."""

LEVELS = {"info": LogLevel.Info, "warning": LogLevel.Warning, "error": LogLevel.Error}
"""By the severity of an event."""

HEALTH = MessageType(
    "Health",
    {
        "rate": "control cycles per second (Hz); NaN: not known yet",
        "cycles": "control cycles (1)",
        "missed_cycles": "control cycles missed (1)",
        "bus_load": "of the bus with the most (%); NaN: not known yet",
        "bus_dropped": "CAN frames dropped (1)",
        "bus_error_frames": "CAN error frames (1)",
        "nearest_limit": "use of the limit of which most is used (%); NaN: no experiment runs",
    },
)

STATE_TEXTS = ("mode", "experiment", "phase", "code", "reason")
STATE = MessageType("State", {}, dict.fromkeys(STATE_TEXTS, "as in `upright status`"))


class _Topic:
    """A topic with messages of one type."""

    def __init__(self, name: str, type: MessageType, context: foxglove.Context) -> None:
        schema = foxglove.Schema(name=type.name, encoding="ros2msg", data=type.definition.encode())
        self._channel = foxglove.Channel(name, message_encoding="cdr", schema=schema, context=context)
        self._encode = type.encode

    @property
    def watched(self) -> bool:
        """Whether any client has subscribed to it."""
        return self._channel.has_sinks()

    def publish(self, time_ns: int, numbers: Sequence[float], texts: Sequence[str] = ()) -> None:
        self._channel.log(self._encode(time_ns, numbers, texts), log_time=time_ns)


class FoxgloveServer:
    """Serves the vehicle of `hello` at `port` of this computer, until the process ends. Its methods do not wait.

    Raises:
        RuntimeError: the port cannot be had.
    """

    def __init__(self, port: int, hello: Mapping[str, Any]) -> None:
        logging.getLogger("foxglove").setLevel(logging.CRITICAL)  # a client that is refused is no news
        self._context = context = foxglove.Context()  # which the server does not keep
        self._vehicle = _Topic("/vehicle", _vehicle(registry.channels_of(hello["kind"]).of(hello["channels"])), context)
        self._prediction = _Topic("/prediction", _prediction(hello["kind"]), context)
        self._state = _Topic("/state", STATE, context)
        self._health = _Topic("/health", HEALTH, context)
        self._log = LogChannel("/log", context=context)
        self._ahead_ns = time.time_ns() - time.monotonic_ns()
        """Of the data's clock, against the monotonic one, as the latest cycle arrived."""
        self._texts: Sequence[str] = ()
        self._server = foxglove.start_server(  # once all topics are there
            name=f"{hello['vehicle']} (upright {hello['version']})",
            host=HOST,
            port=port,
            capabilities=[],
            context=context,
            message_backlog_size=BACKLOG,
        )

    def cycles(self, frames: Sequence[Frame]) -> None:
        """Show control cycles."""
        self._ahead_ns = frames[-1].timestamp_ns - time.monotonic_ns()
        if self._vehicle.watched:
            for frame in frames:
                self._vehicle.publish(frame.timestamp_ns, frame.values)

    def prediction(self, segment: Mapping[str, Any]) -> None:
        """Show a segment of `service.observer.live.live_prediction`."""
        if not self._prediction.watched:
            return
        pairs = zip(segment["values"].values(), segment["innovations"].values(), strict=True)
        columns = [column for pair in pairs for column in pair]
        begin_ns, step_ns = segment["t0"] * NANOSECONDS, segment["dt"] * NANOSECONDS
        for place, row in enumerate(zip(*columns, strict=True)):
            self._prediction.publish(round(begin_ns + place * step_ns), [_known(value) for value in row])

    def state(self, document: Mapping[str, Any]) -> None:
        """Show a changed state of the daemon."""
        self._texts = [str(document.get(name) or "") for name in STATE_TEXTS]
        self._repeat_state()

    def health(self, report: Mapping[str, Any]) -> None:
        """Show the health of the control process, and the state again, for clients that came after its change."""
        buses, nearest = report["buses"], report["nearest_limit"] or {}
        loads = [bus["load_percent"] for bus in buses if bus["load_percent"] is not None]
        numbers = [
            _known(report["rate"]),
            report["cycles"],
            report["missed_cycles"],
            max(loads, default=nan),
            sum(bus["dropped"] for bus in buses),
            sum(bus["error_frames"] for bus in buses),
            nearest.get("percent", nan),
        ]
        self._health.publish(self._now_ns(), numbers)
        self._repeat_state()

    def event(self, severity: str, code: str, text: str) -> None:
        """Show an event as a line of the log, with its code as the name."""
        time_ns = self._now_ns()
        stamp = Timestamp(*divmod(time_ns, NANOSECONDS))
        self._log.log(Log(timestamp=stamp, level=LEVELS[severity], message=text, name=code), log_time=time_ns)

    def _repeat_state(self) -> None:
        if self._texts:
            self._state.publish(self._now_ns(), (), self._texts)

    def _now_ns(self) -> int:
        """The time of what is no cycle, on the data's clock, which does not follow a step of the computer's."""
        return time.monotonic_ns() + self._ahead_ns


def _vehicle(channels: ChannelTable) -> MessageType:
    """A control cycle of a vehicle with these channels."""
    comments = {channel.name: f"{channel.meaning} ({channel.unit})" for channel in channels}
    return MessageType("Vehicle", comments)


def _prediction(kind: str) -> MessageType:
    """What the model of this kind of vehicle predicts."""
    comments = {}
    for output in registry.nominal_model(kind).outputs:
        comments[output.name] = f"predicted by the model, up to half a second ahead ({output.unit})"
        comments[f"{output.name}_innovation"] = f"measured minus predicted one sample ahead ({output.unit})"
    return MessageType("Prediction", comments)


def _known(value: float | None) -> float:
    return nan if value is None else value
