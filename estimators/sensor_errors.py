"""The random errors of a fit's sensors beside white noise, with their standard deviations (models.sensor_error)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from estimators.disturbance import Found, NarrowBandEstimate, with_error
from models.sensor_error import at_outputs

if TYPE_CHECKING:
    from estimators.methods.prediction_error import Fit


@dataclass(frozen=True, slots=True)
class SensorError:
    """A random error of the output `channel`, in `unit`: RMS `std` and `correlation_time` (s), each with the standard
    deviation of its error, or one of a `narrow_band`, whose numbers these are then not."""

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
        """The same in another `unit`, of which there are `factor` in one."""
        narrow = self.narrow_band
        if narrow is not None:
            narrow = replace(narrow, unit=unit, std=factor * narrow.std, std_error=factor * narrow.std_error)
        return replace(self, unit=unit, std=factor * self.std, std_error=factor * self.std_error, narrow_band=narrow)

    def __str__(self) -> str:
        """`0.0030 ± 0.0001 rad/s RMS, correlation time 0.050 ± 0.004 s`."""
        if self.narrow_band is not None:
            return str(self.narrow_band)
        time = with_error(self.correlation_time, self.correlation_time_error)
        return f"{with_error(self.std, self.std_error)} {self.unit} RMS, correlation time {time} s"


def sensor_errors(fitted: Fit) -> tuple[SensorError, ...]:
    """Of each output that has one, in the model's order."""
    found = Found.of(fitted)
    return tuple(_told(found, output.name, output.unit, place) for output, place in at_outputs(found.model))


def _told(found: Found, channel: str, unit: str, place: int) -> SensorError:
    if found.model.base_states[place].frequency:
        return SensorError(channel, unit, narrow_band=found.narrow_band(place, unit))
    std, error, time, time_error = found.first_order(place)
    return SensorError(channel, unit, std, std * error, time, time * time_error)
