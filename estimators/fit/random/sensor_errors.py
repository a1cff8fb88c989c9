"""The random errors of the sensors in a fit, other than white noise of outputs, with their standard deviations: drift
or vibration of an output (models.random.sensor_error), and white noise of a measured input
(models.random.input_noise)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from upright.estimators.disturbance_estimate import NarrowBandEstimate
from upright.estimators.fit.random.disturbance import Found
from upright.estimators.fit.random.input_noise import input_noise
from upright.estimators.numbers import with_error
from upright.models.random.input_noise import SHARE, noisy_inputs
from upright.models.random.sensor_error import at_outputs

if TYPE_CHECKING:
    from upright.estimators.fit.maximum_likelihood import Fit


@dataclass(frozen=True, slots=True)
class SensorError:
    """A random error of the output `channel`, in `unit`: RMS `std` and `correlation_time` (s), each with the standard
    deviation of its error, or, if `narrow_band` is given, the narrow-band error that it describes."""

    channel: str
    unit: str
    std: float = 0.0
    std_error: float = 0.0
    correlation_time: float = 0.0
    correlation_time_error: float = 0.0
    narrow_band: NarrowBandEstimate | None = None

    def to_json(self) -> dict[str, Any]:
        """JSON-ready."""
        if self.narrow_band is not None:
            return {"unit": self.unit, **self.narrow_band.to_json()}
        return {
            "unit": self.unit,
            "rms": self.std,
            "rms_std": self.std_error,
            "correlation_time": self.correlation_time,
            "correlation_time_std": self.correlation_time_error,
        }

    def scaled(self, unit: str, factor: float) -> SensorError:
        """The same in another `unit`; `factor` converts the values."""
        narrow = self.narrow_band
        if narrow is not None:
            narrow = replace(narrow, unit=unit, std=factor * narrow.std, std_error=factor * narrow.std_error)
        return replace(self, unit=unit, std=factor * self.std, std_error=factor * self.std_error, narrow_band=narrow)

    def __str__(self) -> str:
        """`3.00 ± 0.10 mrad/s RMS, correlation time 0.0500 ± 0.0040 s`."""
        if self.narrow_band is not None:
            return str(self.narrow_band)
        time = with_error(self.correlation_time, self.correlation_time_error, "s")
        return f"{with_error(self.std, self.std_error, self.unit)} RMS, correlation time {time}"


@dataclass(frozen=True, slots=True)
class InputError:
    """White noise of the measured input `channel`, with RMS `std` in `unit`. `idle` is the share of it that does not
    act on the vehicle, with the standard deviation of its error."""

    channel: str
    unit: str
    std: float
    idle: float
    idle_error: float

    def to_json(self) -> dict[str, Any]:
        """JSON-ready."""
        return {"unit": self.unit, "rms": self.std, "idle_share": self.idle, "idle_share_std": self.idle_error}

    def scaled(self, unit: str, factor: float) -> InputError:
        """The same in another `unit`; `factor` converts the values."""
        return replace(self, unit=unit, std=factor * self.std)

    def __str__(self) -> str:
        """`0.0030 N m RMS of white noise, of which 99.0 ± 1.1 % does not act`."""
        idle = with_error(100.0 * self.idle, 100.0 * self.idle_error, "%")
        return f"{self.std:.2g} {self.unit} RMS of white noise, of which {idle} does not act"


def sensor_errors(fitted: Fit) -> tuple[SensorError | InputError, ...]:
    """The error of each output and each input that has one, in the model's order."""
    found = Found.of(fitted)
    outputs = [_of_output(found, output.name, output.unit, place) for output, place in at_outputs(found.model)]
    return (*outputs, *_of_inputs(found))


def _of_inputs(found: Found) -> Iterator[InputError]:
    task = found.noise.problem
    units = {each.name: each.unit for each in found.model.inputs}
    for name in noisy_inputs(found.model):
        place = task.kernel.index(f"{SHARE}{name}")
        column = task.free.index(place)
        noise = input_noise(task, name)
        std = 0.0 if noise is None else noise.std
        yield InputError(
            name, units[name], std, float(found.values[place]), math.sqrt(found.covariance[column, column])
        )


def _of_output(found: Found, channel: str, unit: str, place: int) -> SensorError:
    if found.model.base_states[place].frequency:
        return SensorError(channel, unit, narrow_band=found.narrow_band(place, unit))
    std, error, time, time_error = found.first_order(place)
    return SensorError(channel, unit, std, std * error, time, time * time_error)
