"""The messages of a vehicle that is excited for hours, in the format of the service, with time stamps of the data."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from math import cos, pi, sin
from typing import Any

import numpy as np
import paho.mqtt.client as mqtt

from upright.service.mqtt.payloads import TelemetryBatches
from upright.telemetry.samples import Frame
from upright.vehicles.monocab.channels import CHANNELS as MONOCAB
from upright.vehicles.sections import VehicleFile

STATE = {
    "vehicle": "monocab", "mode": "running", "experiment": "multisine", "phase": "excite", "code": "", "reason": "",
    "interlocks": [], "faults": [], "version": "", "since": 0.0, "commands": True, "held_by": "nobody",
}  # fmt: skip


class Story:
    """The messages of a vehicle that is excited for hours, in the format of the service."""

    def __init__(self, vehicle: VehicleFile, begin: float) -> None:
        self.rate = vehicle.control.rate
        self.begin_ns, self.cycles, self.batches = round(begin * 1e9), 0, 0
        self._cutter = TelemetryBatches(MONOCAB.names, self.rate, vehicle.mqtt.telemetry_rate)
        self._units = {name: getattr(vehicle.parameters, name) for name in vehicle.parameters.values}
        noise = np.random.default_rng(1).normal(0.0, 1e-4, (997, len(MONOCAB)))
        self._noise = [tuple(row) for row in noise.tolist()]

    @property
    def time(self) -> float:
        """s since the beginning."""
        return self.cycles / self.rate

    def next(self) -> Iterator[tuple[str, bytes]]:
        """Topics and payloads of the next 50 ms."""
        period_ns, frames = 1e9 / self.rate, []
        for _ in range(round(self.rate / 20)):
            phase = 2.0 * pi * 0.7 * self.time
            noise = self._noise[self.cycles % len(self._noise)]
            values = tuple(0.02 * sin(phase + place) + each for place, each in enumerate(noise))
            frames.append(Frame(self.begin_ns + round(self.cycles * period_ns), values))
            self.cycles += 1
        self.batches += 1
        if self.batches % 10 == 0:
            buses = [{"address": "can0", "load_percent": 40.0, "dropped": 0, "error_frames": 0}]
            self._cutter.health({"cycles": self.cycles, "missed_cycles": 0, "rate": self.rate, "buses": buses})
            curve = [0.02 * cos(0.1 * row) for row in range(60)]
            columns = {"roll": curve, "roll_rate": curve}
            begin = frames[-1].timestamp_ns * 1e-9 - 0.5
            self._cutter.prediction({"t0": begin, "dt": 0.008, "values": columns, "innovations": columns})
        for payload in self._cutter.add(frames):
            yield "telemetry", payload
        if self.batches % 5 == 0:
            yield "parameters", json.dumps(self._parameters()).encode()
            yield "methods", json.dumps(self._methods()).encode()
            yield "progress", json.dumps({"task": "multisine", "fraction": 0.5, "remaining": 100.0}).encode()
        if self.batches % 20 == 0:
            yield "diagnosis", json.dumps(self._diagnosis()).encode()
        if self.batches % 200 == 0:
            text = f"missing effect: something new after {self.time:.0f} s"
            yield "event", json.dumps({"severity": "warning", "code": "missing_effect", "text": text}).encode()

    def _parameters(self) -> dict[str, Any]:
        return {
            name: {"value": entry.value * (1.0 + 0.01 * sin(self.time)), "std": 0.01 * entry.value, "unit": entry.unit,
                   "status": "ok", "method": "recursive_prediction_error", "coverage_percent": 100.0, "reason": ""}
            for name, entry in self._units.items()
        }  # fmt: skip

    def _methods(self) -> dict[str, Any]:
        methods = ("recursive_output_error", "recursive_least_squares", "recursive_prediction_error")
        found = {name: dict(list(entry.items())[:4]) for name, entry in self._parameters().items()}
        return {"estimates": dict.fromkeys(methods, found), "parting": []}

    def _diagnosis(self) -> dict[str, Any]:
        size = {"viscous_friction.coefficient": {"value": 1000.0 + sin(self.time), "std": 20.0, "unit": "N m s/rad"}}
        finding = {"effect": "viscous_friction", "parameters": size, "probability": 0.99, "explanation": "friction"}
        return {"adequate": False, "verdict": "missing_effect", "findings": [finding], "seconds": round(self.time)}


class Publisher:
    """A client that publishes the story of the vehicle at a broker on this machine."""

    def __init__(self, vehicle: VehicleFile, port: int, begin: float) -> None:
        self.story = Story(vehicle, begin)
        self._topic = f"{vehicle.mqtt.base}/{vehicle.vehicle.id}"
        self._client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        self._client.max_queued_messages_set(0)
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        self._publish("status", b"online", retain=True)
        self._publish("state", json.dumps(STATE).encode(), retain=True)

    def close(self) -> None:
        self._client.loop_stop()

    def steady(self, seconds: float) -> None:
        """Publish `seconds` of the story in real time."""
        begin, first = time.monotonic(), self.story.time
        while self.story.time - first < seconds:
            for message in self.story.next():
                self._publish(*message)
            time.sleep(max(0.0, begin + self.story.time - first - time.monotonic()))

    def burst(self, batches: int) -> None:
        """Publish so many batches at once; return when they are sent."""
        for _ in range(batches):
            for message in self.story.next():
                last = self._publish(*message)
        last.wait_for_publish(60.0)

    def _publish(self, topic: str, payload: bytes, *, retain: bool = False) -> mqtt.MQTTMessageInfo:
        return self._client.publish(f"{self._topic}/{topic}", payload, retain=retain)
