"""The observer process: recorder, online estimators, live diagnosis, MQTT and viewers, fed by the control process.

    python -m upright.service.observer.process SOCKET_FD

Its pipe delivers `hello` first (`service.control.assembly.observer_hello`), then cycles and orders. When the pipe ends,
whether control closed it or died, the process finishes a running recording, publishes `offline`, and exits. The
recorder and the estimators get exactly the same cycles, those from a recording's agreed start to its end, so that a
replay of the recording gives the same numbers. The process runs at a lower priority than control and never makes it
wait. MQTT has a thread of its own (`service.mqtt.thread`), at control's priority, since it forwards commands.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from upright.service.beside import beside
from upright.service.journal import EVENTS, LEVELS, log_as
from upright.service.mqtt.client import GOODBYE_TIME, MqttConfig, MqttConfigError
from upright.service.mqtt.home_assistant import discovery
from upright.service.mqtt.payloads import TelemetryBatches, methods, parameters
from upright.service.mqtt.thread import MqttThread
from upright.service.observer import link
from upright.service.observer.cpus import leave_to_control
from upright.service.observer.live.live_prediction import LivePrediction, live_prediction
from upright.service.observer.live.news import News
from upright.service.observer.live.online_estimators import EstimatorBank, online_estimators
from upright.service.observer.recording.recorder import Recorder
from upright.service.observer.recording.storage_check import obstacle
from upright.telemetry.errors import UprightError
from upright.telemetry.samples import CanFrame, Frame
from upright.vehicles import registry

if TYPE_CHECKING:
    from upright.service.observer.viewers.foxglove_server import FoxgloveServer
    from upright.service.observer.viewers.metrics import Metrics

NICENESS = 5

SWITCH_INTERVAL = 1e-3
"""s after which a computing thread yields to MQTT's: a command needs several such switches."""

WRITE_PERIOD = 1.0
"""s between two writes of batches to the disk."""

PROBE_TURNS = 4
"""Turns of `WRITE_PERIOD` between two attempts to write in the folder of the recordings; each turn if it failed."""

ESTIMATE_PERIOD = 0.25
"""s between two sets of estimates."""

LAST_DATA = 0.5
"""Time limit for the last samples of a recording after the order to stop it, s."""

LATE_ESTIMATES = 5.0
"""Time limit at the end of a recording for estimators that are still being compiled, s."""

PACKETS_A_TURN = 32
"""Number of packets that are handled before other tasks run."""

RAW_BUSES = ("can0", "can1")
"""Names of in-process buses in a raw log."""


def _lower_priority() -> None:
    """Give this thread the lowest priority."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 19)


class Observer:
    """One observer at the pipe `connection`, for the vehicle described in `hello`. Create it in a running loop."""

    def __init__(self, connection: socket.socket, hello: Mapping[str, Any]) -> None:
        self._connection = connection
        self._channels = registry.channels_of(hello["kind"]).of(hello["channels"])
        self._codec = link.FrameCodec(len(self._channels))
        given = hello["parameters"]
        values = {name: entry["value"] for name, entry in given.items()}
        deviations = {name: entry["std"] for name, entry in given.items()}
        self._new_bank = partial(online_estimators, hello["kind"], values, deviations, hello["support"], self._channels)
        self._estimators = self._new_bank()
        self._compiled = asyncio.Event()
        self._news = News()
        self._published: Mapping[str, Any] | None = None
        self._recorder: Recorder | None = None
        self._experiment = ""
        self._state: dict[str, Any] = {}
        self._end: dict[str, str] = {}
        self._end_timer: asyncio.TimerHandle | None = None
        self._writing = asyncio.Lock()
        self._storing: set[asyncio.Task[None]] = set()
        self._trouble = ""
        self._data = Path(hello["data"]).absolute()
        self._obstacle = ""
        self._telemetry = TelemetryBatches(self._channels.names, hello["rate"], hello["mqtt"]["telemetry_rate"])
        self._new_prediction = partial(live_prediction, hello, self._channels)
        self._prediction: LivePrediction | None = None
        self._metrics: Metrics | None = None
        self._foxglove: FoxgloveServer | None = None
        self._mqtt: MqttThread | None = None
        try:
            config = MqttConfig.of(hello["mqtt"], hello["vehicle"])
            if config is not None:
                units = {name: entry["unit"] for name, entry in given.items()}
                announced = discovery(config.topic, hello["vehicle"], hello["version"], units)
                self._mqtt = MqttThread(config, self._forward, announced if hello["mqtt"]["home_assistant"] else ())
        except MqttConfigError as error:
            self._report_error("mqtt", str(error))
        if hello["metrics_port"]:
            self._serve_metrics(hello)

    def serve_foxglove(self, hello: Mapping[str, Any]) -> None:
        """Show the vehicle to viewers. The threads of the server get the priority of the calling one."""
        try:
            from upright.service.observer.viewers.foxglove_server import FoxgloveServer  # its package is an extra

            self._foxglove = FoxgloveServer(hello["foxglove_port"], hello)
        except ImportError as error:
            self._report_error("foxglove", f"nothing is shown in Foxglove: {error}; pip install 'upright[foxglove]'")
        except RuntimeError as error:
            place = f"port {hello['foxglove_port']} of this computer"
            text = f"nothing is shown in Foxglove at {place}: {error}; give another one with --foxglove PORT"
            self._report_error("foxglove", text)

    async def run(self) -> None:
        """Run until the pipe ends, or until an error outside of MQTT; in both cases the recording is completed."""
        reading = asyncio.create_task(self._read(), name="read")
        tasks = [
            reading,
            asyncio.create_task(self._write_regularly(), name="write"),
            asyncio.create_task(self._estimate_regularly(), name="estimate"),
        ]
        compiling = asyncio.create_task(self._compile(), name="compile")
        mqtt = asyncio.create_task(self._run_mqtt(self._mqtt), name="mqtt") if self._mqtt is not None else None
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        failures = [task.exception() for task in tasks if task.done()]
        self._end = self._end or {"end_reason": "the control process ended"}
        self._close_recording()
        await asyncio.gather(*self._storing)
        if self._mqtt is not None and mqtt is not None:
            self._mqtt.close()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(mqtt, GOODBYE_TIME)
        for task in (*tasks, compiling):
            task.cancel()
        for failure in failures:
            if failure is not None:
                raise failure

    # Packets from the pipe

    async def _read(self) -> None:
        packets = 0
        while packet := await link.receive_soon(self._connection):
            self._handle(packet)
            packets += 1
            if packets % PACKETS_A_TURN == 0:
                await asyncio.sleep(0)

    def _handle(self, packet: bytes) -> None:
        match packet[:1]:
            case link.FRAMES:
                self._take(self._codec.unpack(packet))
            case link.CAN_FRAMES:
                self._take_can(link.unpack_can(packet))
            case _:
                self._execute(link.unpack_json(packet))

    def _take(self, frames: list[Frame]) -> None:
        if self._recorder is not None:
            self._estimators.update(self._recorder.add(frames))
            if self._recorder.complete:
                self._close_recording()
        if self._foxglove is not None:
            self._foxglove.cycles(frames)
        self._predict(frames)
        if self._mqtt is not None:
            for batch in self._telemetry.add(frames):
                self._mqtt.telemetry(batch)

    def _predict(self, frames: list[Frame]) -> None:
        if self._prediction is None:
            return
        try:
            for segment in self._prediction.update(frames):
                self._telemetry.prediction(segment)
                if self._foxglove is not None:
                    self._foxglove.prediction(segment)
        except (ArithmeticError, ValueError) as error:
            self._prediction = None
            self._report_error("prediction", f"nothing is predicted any more: {type(error).__name__}: {error}")

    def _take_can(self, frames: list[CanFrame]) -> None:
        if self._recorder is not None:
            self._recorder.add_can(frames)
            if self._recorder.complete:
                self._close_recording()

    def _execute(self, message: dict[str, Any]) -> None:
        match message.pop("type"):
            case "start_recording":
                self._start_recording(message)
            case "stop_recording":
                self._stop_recording(message)
            case "retain":
                self._retain(message["topic"], message["document"])
            case "event":
                self._event(**message)
            case "progress" if self._mqtt is not None:
                self._mqtt.publish("progress", message)
            case "health":
                self._telemetry.health(message["health"])
                if self._foxglove is not None:
                    self._foxglove.health(message["health"])
            case "figures" if self._metrics is not None:
                self._metrics.report(message["figures"])
            case "reply" if self._mqtt is not None:
                self._mqtt.reply(message["client"], message["reply"])

    # Recording

    def _start_recording(self, order: dict[str, Any]) -> None:
        self._end = self._end or {"end_reason": "another recording began"}
        self._close_recording()
        self._estimators, self._news = self._new_bank(), News()
        self._estimators.of_recording(order["metadata"])
        if self._compiled.is_set():
            self._estimators.join()
        raw_buses = RAW_BUSES if order["raw_log"] else ()
        stem = Path(order["stem"])
        self._experiment = order["metadata"].get("experiment", "")
        try:
            self._recorder = Recorder(stem, self._channels, order["start_ns"], order["metadata"], raw_buses)
        except OSError as error:
            self._report_error("recorder", f"nothing is recorded: {error}")
            self._send(
                {
                    "type": "finished",
                    "recording": f"{stem}.arrow",
                    "failure": str(error),
                    "estimates": {},
                    "diagnosis": None,
                }
            )

    def _stop_recording(self, order: dict[str, Any]) -> None:
        """Close the recording when its last samples have arrived, or after a time limit."""
        recorder = self._recorder
        if recorder is None or self._end:
            return
        recorder.end_ns, recorder.raw_end_ns = order["end_ns"], order["raw_end_ns"]
        self._end = {"end_reason": order["reason"], "dropped_frames": str(order["dropped_frames"])}
        if recorder.complete:
            self._close_recording()
        else:
            self._end_timer = asyncio.get_running_loop().call_later(LAST_DATA, self._close_recording)

    def _close_recording(self) -> None:
        """Get the final results, and write the rest of the file."""
        recorder, self._recorder, self._experiment = self._recorder, None, ""
        end, self._end = self._end, {}
        if self._end_timer is not None:
            self._end_timer.cancel()
            self._end_timer = None
        if recorder is None:
            return
        storing = asyncio.create_task(self._store(recorder, end, self._estimators), name=f"store {recorder.path.name}")
        self._storing.add(storing)
        storing.add_done_callback(self._storing.discard)

    async def _store(self, recorder: Recorder, end: dict[str, str], estimators: EstimatorBank) -> None:
        failure = ""
        if not estimators.complete:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._compiled.wait(), LATE_ESTIMATES)
                estimators.join()
        estimates = estimators.results()
        diagnosis = estimators.diagnosis()
        self._publish(estimates, diagnosis)
        async with self._writing:
            try:
                await asyncio.to_thread(recorder.finish, end, estimates, diagnosis)
            except OSError as error:
                failure = f"the recording could not be completed: {error}"
                self._report_error("recorder", failure)
        self._send({
            "type": "finished",
            "recording": str(recorder.path),
            "rows": recorder.rows,
            "failure": failure,
            "estimates": estimates,
            "diagnosis": diagnosis,
        })  # fmt: skip

    async def _write_regularly(self) -> None:
        for turn in itertools.count():
            await asyncio.sleep(WRITE_PERIOD)
            recorder = self._recorder
            if turn % PROBE_TURNS == 0 or self._obstacle:
                self._obstacle = await asyncio.to_thread(obstacle, self._data)
            if recorder is not None:
                async with self._writing:
                    try:
                        await asyncio.to_thread(recorder.write, recorder.take())
                    except OSError as error:
                        self._obstacle = f"Nothing is recorded any more: {recorder.path}: {error.strerror}."
                        self._report_error("recorder", f"{recorder.path}: {error}")
            self._send({
                "type": "report",
                "mqtt": self._mqtt.summary() if self._mqtt else None,
                "trouble": self._trouble,
                "obstacle": self._obstacle,
            })  # fmt: skip

    # Results

    async def _compile(self) -> None:
        """Compile once in a thread, after which estimators are created immediately. The process does not wait for it to
        exit. Its thread has the lowest priority, so that it delays neither the control process nor others."""

        def work() -> LivePrediction | None:
            _lower_priority()
            self._new_bank().join()
            with contextlib.suppress(ArithmeticError, ValueError, UprightError):  # estimation works without it
                return self._new_prediction() if self._watched else None
            return None

        self._prediction = await beside(work, "compile")
        self._compiled.set()
        self._estimators.join()

    async def _estimate_regularly(self) -> None:
        while True:
            await asyncio.sleep(ESTIMATE_PERIOD)
            if self._recorder is not None:
                estimates, diagnosis = self._estimators.results(), self._estimators.diagnosis()
                self._send({"type": "estimates", "estimates": estimates, "diagnosis": diagnosis})
                self._publish(estimates, diagnosis)

    async def _run_mqtt(self, mqtt: MqttThread) -> None:
        """Await the thread of MQTT. No failure there may end a recording."""
        try:
            await mqtt.ended
        except Exception as error:
            self._mqtt = None
            self._report_error("mqtt", f"nothing is published any more: {type(error).__name__}: {error}")

    def _publish(self, estimates: Mapping[str, Any], diagnosis: Mapping[str, Any] | None) -> None:
        if not self._watched:
            return
        if estimates:
            found = parameters(estimates)
            if self._mqtt is not None:
                self._mqtt.retain("parameters", found)
                self._mqtt.retain("methods", methods(estimates))
            if self._prediction is not None:
                self._prediction.use(found)
        if diagnosis is not None and diagnosis != self._published:
            self._published = diagnosis
            if self._mqtt is not None:
                self._mqtt.retain("diagnosis", diagnosis)
            for text in self._news.of(diagnosis):
                self._event("warning", "missing_effect", text)

    @property
    def _watched(self) -> bool:
        """Whether anybody may look at results while they come."""
        return self._mqtt is not None or self._foxglove is not None

    def _serve_metrics(self, hello: Mapping[str, Any]) -> None:
        from upright.service.observer.viewers.metrics import (  # an HTTP server, which most do not need
            Metrics,
            MetricsServer,
        )

        self._metrics = Metrics(hello["vehicle"], hello["version"])
        try:
            MetricsServer(hello["metrics_port"], self._metrics.text)
        except OSError as error:
            place = f"port {hello['metrics_port']} of this computer"
            text = f"no metrics at {place}: {error.strerror}; give another one with --metrics PORT"
            self._report_error("metrics", text)

    def _report_error(self, code: str, text: str) -> None:
        """Report an error to the log, the broker and, with the next report, to control."""
        if EVENTS.disabled:  # as at a terminal
            logging.getLogger(__name__).error("%s", text)
        self._trouble = text
        self._event("error", code, text)

    def _retain(self, topic: str, document: dict[str, Any]) -> None:
        """Publish the latest `document` of a topic; a new state of the daemon is also reported to the journal."""
        names = ("mode", "code", "reason")
        state = {name: document.get(name, "") for name in names} if topic == "state" else self._state
        if state != self._state:
            self._state = state
            fields = {"UPRIGHT_CODE": state["code"], "UPRIGHT_EXPERIMENT": document.get("experiment") or ""}
            EVENTS.info("%s: %s", state["mode"], state["reason"] or state["code"], extra={"fields": fields})
        if self._mqtt is not None:
            self._mqtt.retain(topic, document)
        if self._foxglove is not None and topic == "state":
            self._foxglove.state(document)

    def _event(self, severity: str, code: str, text: str) -> None:
        """Report an event to the journal and the broker."""
        fields = {"UPRIGHT_CODE": code, "UPRIGHT_EXPERIMENT": self._experiment}
        EVENTS.log(LEVELS[severity], "%s", text, extra={"fields": fields})
        if self._mqtt is not None:
            self._mqtt.publish("event", {"severity": severity, "code": code, "text": text})
        if self._foxglove is not None:
            self._foxglove.event(severity, code, text)

    def _forward(self, command: dict[str, Any]) -> bool:
        """Called in the thread of MQTT: packets are atomic, so that two threads may send at the same time."""
        return self._send({"type": "command", **command})

    def _send(self, message: dict[str, Any]) -> bool:
        """Send to control; False if it has ended or does not read. Later messages contain newer data."""
        try:
            self._connection.send(link.pack_json(message))
        except OSError:
            return False
        return True


async def observe(connection: socket.socket) -> None:
    """Serve the control process behind `connection`."""
    if packet := await link.receive_soon(connection):
        hello = link.unpack_json(packet)
        log_as(hello["vehicle"])
        observer = Observer(connection, hello)
        os.nice(NICENESS)  # of this thread and later ones, but not of MQTT's, which forwards commands
        if hello["foxglove_port"]:
            observer.serve_foxglove(hello)
        await observer.run()


def _offer_memory() -> None:
    """Let the kernel end this process before the control process where memory runs out."""
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("500")


def main(descriptor: int) -> None:
    # Only the end of the pipe ends this process: a stopped service first ends its experiment, which shall be recorded.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    leave_to_control()
    sys.setswitchinterval(SWITCH_INTERVAL)
    _offer_memory()
    with socket.socket(fileno=descriptor) as connection:
        connection.setblocking(False)
        asyncio.run(observe(connection))


if __name__ == "__main__":
    main(int(sys.argv[1]))
