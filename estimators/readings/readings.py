"""What else the columns of a table may mean: another unit, a turned sign, a wrapped angle, two channels exchanged."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from estimators.data.segments import channels_of, optional_channels
from models.model import Model
from telemetry.errors import RecordingError
from telemetry.recording import Recording
from telemetry.tables.assumed import as_assumed
from telemetry.tables.mapping import Assumption
from telemetry.tables.units import unit_of

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
TURNS = {"": "rad", "deg": "deg"}


@dataclass(frozen=True, slots=True)
class Reading:
    """`channel` taken for `how`; `words` say it. Not `named`: a factor that was fitted."""

    channel: str
    how: Assumption
    words: str
    named: bool = True

    def of(self, recording: Recording) -> Recording | None:
        """`recording`, read so; None if it cannot be, as a time in ns whose steps would be less than one."""
        try:
            return as_assumed(recording, self.channel, self.how)
        except RecordingError:
            return None

    @property
    def option(self) -> str:
        """The option that makes it so."""
        return self.how.text(self.channel)


def readings(model: Model, recording: Recording, settled: Collection[str] = ()) -> Iterator[Reading]:
    """All other readings of the channels that `model` uses, except of those that are `settled`: one thing at a time."""
    units = {**{each.channel: each.unit for each in model.inputs}, **{each.name: each.unit for each in model.outputs}}
    used = [name for name in channels_of(model) if name not in optional_channels(model) and name in recording.values]
    open_ones = [name for name in used if name not in settled]
    if "time" not in settled:
        for unit, words in TIME.items():
            yield Reading("time", Assumption(unit), words)
    for name in open_ones:
        unit = units.get(name, "")
        si = found.si if (found := unit_of(unit)) and found.factor == 1.0 else unit
        for other, words in UNITS.get(si, {}).items():
            yield Reading(name, Assumption(other), words)
        yield Reading(name, Assumption("-1"), "with the opposite sign")
        if si == "rad" and _jumps(recording, name):
            yield Reading(name, Assumption(wrapped=0.0), "wrapped at a turn")
            yield Reading(name, Assumption("deg", wrapped=0.0), "in degrees and wrapped at a turn")
    for one, other in combinations(open_ones, 2):
        yield Reading(one, Assumption(swapped=other), f"exchanged with {other}")


def _jumps(recording: Recording, name: str) -> bool:
    values = recording[name][np.isfinite(recording[name])]
    return len(values) > 1 and float(np.max(np.abs(np.diff(values)))) > JUMP * float(np.ptp(values)) > 0.0
