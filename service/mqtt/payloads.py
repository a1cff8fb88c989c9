"""The payloads of MQTT messages: telemetry in batches and parameters, as JSON documents.

telemetry   {"t0": s, "dt": s, CHANNEL: [value, ...], ...}    sample i was measured at t0 + i * dt
            some batches also have "health" (of the control process) and "predictions" (of the model)
parameters  {NAME: {"value", "std", "unit", "status", "method", "coverage_percent", "reason"}}
            beside the vehicle's own, disturbance.JOINT.rms and disturbance.JOINT.correlation_time
            (models.random.disturbance)
methods     {"estimates": {METHOD: {NAME: {"value", "std", "unit", "status"}}}, "parting": [{"parameter", "methods",
            "sigmas", "text"}]}: all live methods, and where two of them part (estimators.parting)
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from math import isfinite
from typing import Any

from upright.estimators.contract import Status
from upright.estimators.parting import partings
from upright.telemetry.samples import Frame

LONGEST_STEP = 1.5
"""Maximum periods between samples of a batch; after a gap a new batch begins, since its samples share one `dt`."""


MOST_PREDICTIONS = 8
"""Maximum number of segments in one batch."""


class TelemetryBatches:
    """Groups control cycles of channels `names`, `rate` per second, into `batch_rate` batches per s of data time."""

    def __init__(self, names: Sequence[str], rate: float, batch_rate: float) -> None:
        self._names = tuple(names)
        self._period_ns = 1e9 / rate
        self._span_ns = round(1e9 / batch_rate)
        self._gathered: list[Frame] = []
        self._health: dict[str, Any] | None = None
        self._predictions: list[dict[str, Any]] = []
        self._last_ns = 0
        self._longest_ns = 0

    def health(self, report: Mapping[str, Any]) -> None:
        """Add the report to the next batch, with the longest time between two cycles since the previous report."""
        self._health = {**report, "longest_step": round(self._longest_ns * 1e-9, 6) if self._longest_ns else None}
        self._longest_ns = 0

    def prediction(self, segment: dict[str, Any]) -> None:
        """Add the segment to the next batch."""
        self._predictions.append(segment)
        del self._predictions[:-MOST_PREDICTIONS]

    def add(self, frames: Sequence[Frame]) -> Iterator[bytes]:
        """The batches that are completed by these cycles, each a JSON document."""
        for frame in frames:
            self._longest_ns = max(self._longest_ns, frame.timestamp_ns - self._last_ns) if self._last_ns else 0
            self._last_ns = frame.timestamp_ns
            gathered = self._gathered
            if gathered:
                step_ns = frame.timestamp_ns - gathered[-1].timestamp_ns
                full = frame.timestamp_ns - gathered[0].timestamp_ns >= self._span_ns
                if full or not 0 < step_ns <= LONGEST_STEP * self._period_ns:
                    yield self._document(gathered)
                    gathered = self._gathered = []
            gathered.append(frame)

    def _document(self, frames: list[Frame]) -> bytes:
        first, last = frames[0].timestamp_ns, frames[-1].timestamp_ns
        step_ns = (last - first) / (len(frames) - 1) if len(frames) > 1 else self._period_ns
        columns = zip(*(frame.values for frame in frames), strict=True)
        arrays = (f'"{name}":[{_numbers(column)}]' for name, column in zip(self._names, columns, strict=True))
        beside = ""
        if self._health is not None:
            beside = f',"health":{json.dumps(self._health, separators=(",", ":"))}'
            self._health = None
        if self._predictions:
            beside += f',"predictions":{json.dumps(self._predictions, separators=(",", ":"))}'
            self._predictions = []
        return f'{{"t0":{first * 1e-9:.6f},"dt":{step_ns * 1e-9:.6g},{",".join(arrays)}{beside}}}'.encode()


def _numbers(values: Sequence[float]) -> str:
    """Numbers with seven digits, as in a 32-bit float; unknown values are null."""
    return ",".join([f"{value:.7g}" if isfinite(value) else "null" for value in values])


def parameters(estimates: Mapping[str, Any]) -> dict[str, Any]:
    """One entry per parameter from the results of several methods: that of the last method with a value."""
    chosen: dict[str, Any] = {}
    for method, estimate in estimates.items():
        for name, entry in estimate["parameters"].items():
            if name not in chosen or entry["value"] is not None:
                keys = ("value", "std", "unit", "status", "coverage_percent", "reason")
                chosen[name] = {**{key: entry[key] for key in keys}, "method": method}
        for joint, found in estimate.get("disturbance", {}).items():
            for name, entry in _disturbance(joint, found).items():
                chosen[name] = {**entry, "method": method}
    return chosen


def methods(estimates: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of every method with results, and where methods part."""
    shown = {}
    for method, estimate in estimates.items():
        entries = dict(estimate["parameters"])
        for joint, found in estimate.get("disturbance", {}).items():
            entries |= _disturbance(joint, found)
        keys = ("value", "std", "unit", "status")
        shown[method] = {name: {key: entry[key] for key in keys} for name, entry in entries.items()}
    return {"estimates": shown, "parting": [each.to_json() for each in partings(estimates)]}


def _disturbance(joint: str, found: Mapping[str, Any]) -> dict[str, Any]:
    """The random disturbance at `joint`, as estimated by estimators.fit.random.disturbance, as parameters."""
    shown, unit = found["shown"], found["unit"]
    reason = "" if shown else f"no disturbance shows: less than {found['rms']:.2g} {unit} RMS"
    common = {
        "status": Status.OK.value if shown else Status.TOO_LITTLE_EXCITATION.value,
        "coverage_percent": 100.0 if shown else 0.0,
        "reason": reason,
    }
    rms = {"value": found["rms"] if shown else None, "std": found["rms_std"], "unit": unit}
    time = {"value": found["correlation_time"], "std": found["correlation_time_std"], "unit": "s"}
    return {
        f"disturbance.{joint}.rms": {**rms, **common},
        f"disturbance.{joint}.correlation_time": {**time, **common},
    }
