"""Estimate of the random force at a joint: RMS and correlation time, each with its standard deviation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from upright.estimators.numbers import with_error


@dataclass(frozen=True, slots=True)
class NarrowBandEstimate:
    """A narrow-band random force at `frequency` (Hz): RMS `std` in `unit`, and `damping` ratio, each with the standard
    deviation of its error."""

    unit: str
    std: float
    std_error: float
    frequency: float
    frequency_error: float
    damping: float
    damping_error: float

    def to_json(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "rms": self.std,
            "rms_std": self.std_error,
            "frequency": self.frequency,
            "frequency_std": self.frequency_error,
            "damping_ratio": self.damping,
            "damping_ratio_std": self.damping_error,
        }

    @classmethod
    def from_json(cls, unit: str, entry: Mapping[str, float] | None) -> NarrowBandEstimate | None:
        """The inverse of `to_json`."""
        return None if entry is None else cls(unit, *entry.values())

    def __str__(self) -> str:
        """`3.00 ± 0.20 N m RMS about 2.100 ± 0.030 Hz, damping ratio 0.050 ± 0.010`."""
        return (
            f"{with_error(self.std, self.std_error, self.unit)} RMS about"
            f" {with_error(self.frequency, self.frequency_error, 'Hz')}, damping ratio"
            f" {with_error(self.damping, self.damping_error)}"
        )


@dataclass(frozen=True, slots=True)
class DisturbanceEstimate:
    """A first-order random force at `joint`, in `unit`: RMS `std` and `correlation_time` (s), each with the standard
    deviation of its error.

    If the record does not show it (`shown` is False), `std` is an upper bound, and its error and the correlation time
    are None. If it is `known`, it was stated in advance and has no error. `narrow_band`: a further force that acts in
    addition.
    """

    joint: str
    unit: str
    std: float
    std_error: float | None
    correlation_time: float | None
    correlation_time_error: float | None
    shown: bool = True
    known: bool = False
    narrow_band: NarrowBandEstimate | None = None

    @classmethod
    def from_json(cls, joint: str, entry: Mapping[str, Any]) -> DisturbanceEstimate:
        """The inverse of `to_json`."""
        rms, time = entry["rms"], entry["correlation_time"]
        known = bool(entry["shown"] and entry["rms_std"] is None)
        unit, narrow = entry["unit"], NarrowBandEstimate.from_json(entry["unit"], entry.get("narrow_band"))
        time_std = entry["correlation_time_std"]
        return cls(joint, unit, rms, entry["rms_std"], time, time_std, entry["shown"], known, narrow)

    def to_json(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "unit": self.unit,
            "rms": self.std,
            "rms_std": self.std_error,
            "correlation_time": self.correlation_time,
            "correlation_time_std": self.correlation_time_error,
            "shown": self.shown,
            **({"narrow_band": self.narrow_band.to_json()} if self.narrow_band else {}),
        }

    def __str__(self) -> str:
        """`8.10 ± 0.41 N m RMS, correlation time 0.310 ± 0.031 s`, and the narrow-band force, if any."""
        return ", and ".join(map(str, self._acting(self._broad)))

    @property
    def acts(self) -> bool:
        """Whether the record shows either force."""
        return self.shown or self.narrow_band is not None

    @property
    def size(self) -> str:
        """`8.10 ± 0.41 N m RMS`, and the narrow-band force, if any."""
        return " and ".join(map(str, self._acting(rms(self))))

    def _acting(self, broad: str) -> list[str | NarrowBandEstimate]:
        if self.narrow_band is None:
            return [broad]
        return [broad, self.narrow_band] if self.shown else [self.narrow_band]

    @property
    def _broad(self) -> str:
        if not self.shown:
            return f"none detected; less than {self.std:.2g} {self.unit} RMS"
        if self.known or self.std_error is None or self.correlation_time_error is None:
            return f"{self.std:.3g} {self.unit} RMS, correlation time {self.correlation_time:.3g} s, not estimated"
        time = with_error(self.correlation_time or 0.0, self.correlation_time_error, "s")
        return f"{rms(self)}, correlation time {time}"


def rms(found: DisturbanceEstimate) -> str:
    """`8.10 ± 0.41 N m RMS`."""
    size = f"{found.std:.3g} {found.unit}" if found.std_error is None else None
    return f"{size or with_error(found.std, found.std_error, found.unit)} RMS"


def in_words(found: Sequence[DisturbanceEstimate]) -> str:
    """A sentence, empty if nothing is known."""
    shown = [each for each in found if each.acts] or list(found)
    if not shown:
        return ""
    where = len(found) > 1
    return "; ".join(f"disturbance{f' at {each.joint}' if where else ''}: {each}" for each in shown)
