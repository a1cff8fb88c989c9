"""What else the columns of a table may mean: another unit, a turned sign, a wrapped angle, two channels exchanged."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from upright.estimators.data.segments import channels_of, optional_channels
from upright.models.model import Model
from upright.telemetry.errors import RecordingError
from upright.telemetry.recording import Recording
from upright.telemetry.tables.assumed import as_assumed
from upright.telemetry.tables.mapping import Assumption
from upright.telemetry.tables.units import unit_of

TIME = {"ms": "in milliseconds", "us": "in microseconds", "ns": "in nanoseconds", "min": "in minutes", "d": "in days"}
UNITS = {
    "rad": {"deg": "in degrees", "rev": "in revolutions", "mrad": "in milliradians"},
    "rad/s": {"deg/s": "in degrees per second", "rpm": "in revolutions per minute", "rps": "in revolutions per second"},
    "m": {"mm": "in millimetres", "cm": "in centimetres"},
    "m/s": {"mm/s": "in millimetres per second", "cm/s": "in centimetres per second", "km/h": "in km/h"},
    "m/s^2": {"g": "in g"},
    "V": {"mV": "in millivolts"},
    "A": {"mA": "in milliamperes"},
    "N m": {"mNm": "in millinewton metres", "Ncm": "in newton centimetres"},
    "N": {"mN": "in millinewtons", "kN": "in kilonewtons"},
}
"""By the unit that a model needs: the units that tables have instead."""
JUMP = 0.5
"""Share of a channel's range beyond which a step from sample to sample is a jump, as of an angle that is wrapped."""


@dataclass(frozen=True, slots=True)
class Reading:
    """Some channels taken for what `changes` say; `words` say it. Not `named`: by a factor that was fitted."""

    changes: tuple[tuple[str, Assumption], ...]
    words: str
    named: bool = True

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(channel for channel, _ in self.changes)

    def of(self, recording: Recording) -> Recording | None:
        """`recording`, read so; None if it cannot be, as a time in ns whose steps would be less than one."""
        try:
            for channel, how in self.changes:
                recording = as_assumed(recording, channel, how)
        except RecordingError:
            return None
        return recording

    @property
    def stated(self) -> dict[str, list[str]]:
        """What its user states of each channel."""
        return {channel: how.texts for channel, how in self.changes}


def one(channel: str, how: Assumption, words: str, *, named: bool = True) -> Reading:
    """A reading of a single channel."""
    return Reading(((channel, how),), f"{channel} {words}", named)


def readings(model: Model, recording: Recording, settled: Collection[str] = ()) -> Iterator[Reading]:
    """All other readings of the channels that `model` uses, except of those that are `settled`: one thing at a time.

    An angle and its rate are one thing, too: an axis that is turned, or all that is in degrees.
    """
    units = {**{each.channel: each.unit for each in model.inputs}, **{each.name: each.unit for each in model.outputs}}
    used = [name for name in channels_of(model) if name not in optional_channels(model) and name in recording.values]
    moving = [name for name in used if name not in settled and np.nanstd(recording[name]) > 0.0]
    si = {name: _si(units.get(name, "")) for name in moving}
    if "time" not in settled:
        for unit, words in TIME.items():
            yield one("time", Assumption(unit), words)
    for name in moving:
        for other, words in UNITS.get(si[name], {}).items():
            yield one(name, Assumption(other), words)
        yield one(name, Assumption("-1"), "with the opposite sign")
        if si[name] == "rad" and _jumps(recording, name):
            yield one(name, Assumption(wrapped=0.0), "wrapped at a turn")
            yield one(name, Assumption("deg", wrapped=0.0), "in degrees and wrapped at a turn")
    for angle, rate in _pairs(model):
        if angle in si and rate in si:
            turned = tuple((name, Assumption("-1")) for name in (angle, rate))
            yield Reading(turned, f"{angle} and {rate} with the opposite sign")
            yield from _in_degrees((angle, rate), si, f"{angle} and {rate} in degrees")
    yield from _in_degrees(moving, si, "all angles and rates in degrees")
    for this, other in combinations(moving, 2):
        yield one(this, Assumption(swapped=other), f"exchanged with {other}")


def _si(unit: str) -> str:
    """The spelling of a unit in UNITS, if it is one of them."""
    return found.si if (found := unit_of(unit)) and found.factor == 1.0 else unit


def _pairs(model: Model) -> list[tuple[str, str]]:
    """The angles and rates of sensors and of actuators."""
    found = [(each.angle, each.rate) for each in model.sensors] + [(each.angle, each.rate) for each in model.actuators]
    return list(dict.fromkeys(found))


def _in_degrees(names: Sequence[str], si: Mapping[str, str], words: str) -> Iterator[Reading]:
    units = {"rad": "deg", "rad/s": "deg/s"}
    changes = tuple((name, Assumption(units[si[name]])) for name in names if si[name] in units)
    if len(changes) > 1:
        yield Reading(changes, words)


def _jumps(recording: Recording, name: str) -> bool:
    values = recording[name][np.isfinite(recording[name])]
    return len(values) > 1 and float(np.max(np.abs(np.diff(values)))) > JUMP * float(np.ptp(values)) > 0.0
