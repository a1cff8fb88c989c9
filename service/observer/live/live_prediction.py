"""The model's predictions while the vehicle moves, for display over the measurements.

Every half second of free motion is predicted separately: the model starts from the measured state and is then simulated
without correction, driven by the measured inputs. The innovations, and the gap between the model and the vehicle, are
calculated in addition, with a Kalman gain (service.observer.live.live_gap). The parameters are the nominal ones until
estimates are given.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.estimators.contract import EstimationError
from upright.estimators.fit.problem import Problem
from upright.estimators.identify.run import with_values
from upright.estimators.recursive.frame_chunks import Chunk, FrameChunks
from upright.estimators.recursive.prediction_error import at_rest
from upright.estimators.recursive.predictor import measured_state
from upright.service.observer.live.live_gap import LiveGap, opened
from upright.telemetry.channels import ChannelTable
from upright.telemetry.samples import Frame
from upright.vehicles.registry import nominal_model

Array = NDArray[np.float64]

WINDOW = 0.5
"""Length of a predicted segment, s."""

MOST_POINTS = 60
"""Maximum number of points of a segment: the resolution of a screen."""


class LivePrediction:
    """Predictions of the vehicle's own model. The constructor compiles it, which may take seconds.

    Raises EstimationError for a kind of vehicle that has no model.
    """

    def __init__(
        self,
        kind: str,
        parameters: Mapping[str, float],
        deviations: Mapping[str, float],
        support: float,
        channels: ChannelTable,
        rate: float,
    ) -> None:
        model = with_values(nominal_model(kind), dict(parameters), dict(deviations))
        self._problem: Problem = at_rest(opened(model), 1.0 / rate)
        self._chunks = FrameChunks(model, channels, support=support, rows=25, window=WINDOW)
        self._names = {parameter.name for parameter in model.parameters}
        self._given: dict[str, float] = {}
        self._values: Array = self._problem.kernel.vector()
        self._gap = LiveGap(self._problem)

    def use(self, estimates: Mapping[str, Any]) -> None:
        """Predict with these parameters from now on, as returned by `service.mqtt.payloads.parameters`."""
        given = {
            name: entry["value"]
            for name, entry in estimates.items()
            if name in self._names and entry["value"] is not None and entry["status"] == "ok"
        }
        if given and given != self._given:
            self._given = given
            self._values = self._problem.kernel.vector(given)

    def update(self, frames: Iterable[Frame]) -> Iterator[dict[str, Any]]:
        """The segments that are completed by these cycles, JSON-ready."""
        for frame in frames:
            chunk = self._chunks.update(frame)
            if chunk is not None:
                yield self._segment(chunk, frame)

    def _segment(self, chunk: Chunk, latest: Frame) -> dict[str, Any]:
        segment, rows = chunk.segment, chunk.rows
        initial = measured_state(self._problem, segment.measured[chunk.first])
        alone = self._simulated(chunk, initial)
        gap = self._gap.of(segment, chunk.first, chunk.last, initial, self._values)
        time = segment.time[rows]
        # The latest cycle is the segment's last sample, which relates its time to that of the data.
        begin = latest.timestamp_ns * 1e-9 - float(segment.time[-1] - time[0])
        step = max(1, -(-len(time) // MOST_POINTS))
        names = self._problem.kernel.outputs
        found: dict[str, Any] = {
            "t0": round(begin, 6),
            "dt": float(f"{step * (time[-1] - time[0]) / (len(time) - 1):.6g}"),
            "values": _columns(names, alone, step),
            "innovations": {} if gap is None else _columns(names, gap.innovations, step),
        }
        return found if gap is None else {**found, "gap": gap.to_json(begin, float(time[-1] - time[0]))}

    def _simulated(self, chunk: Chunk, initial: Array) -> Array:
        """The chunk's samples (n, ny), simulated from the state `initial` (nx,) at its first one."""
        kernel, segment = self._problem.kernel, chunk.segment
        predicted = np.empty_like(segment.measured)
        slopes = np.empty((*segment.measured.shape, 0))
        kernel.proceed(
            segment,
            self._values,
            kernel.memory(initial, ()),
            None,
            (),
            predicted,
            slopes,
            first=chunk.first,
            last=chunk.last,
            substeps=self._problem.substeps,
        )
        return predicted[chunk.rows]


def live_prediction(hello: Mapping[str, Any], channels: ChannelTable) -> LivePrediction | None:
    """The prediction for the vehicle in `hello`; None for a kind without a model."""
    given = hello["parameters"]
    values = {name: entry["value"] for name, entry in given.items()}
    deviations = {name: entry["std"] for name, entry in given.items()}
    try:
        return LivePrediction(hello["kind"], values, deviations, hello["support"], channels, hello["rate"])
    except EstimationError:
        return None


def _columns(names: Sequence[str], table: Array, step: int) -> dict[str, list[float | None]]:
    return {
        name: [float(f"{value:.6g}") if np.isfinite(value) else None for value in table[::step, place]]
        for place, name in enumerate(names)
    }
