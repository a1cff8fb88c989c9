"""How an experiment went: how far each channel went while the vehicle was up, and where it was in the end."""

from __future__ import annotations

from math import degrees

import numpy as np

from upright.service.commission.evidence import Evidence, Found
from upright.service.offline.inputs.replay import load
from upright.vehicles.commissioning import Number
from upright.vehicles.experiment.phases import Phase

END = 2.0
"""s at the end of the excitation over which a channel is averaged."""
TURN = {"rad": ("deg", degrees(1.0)), "rad/s": ("deg/s", degrees(1.0))}


def course(evidence: Evidence) -> Found:
    """For each channel `largest_NAME`, the largest magnitude during the excitation, and `final_NAME`, its mean at the
    end of it; angles in degrees."""
    recording = load(evidence.recording, evidence.vehicle)
    excited = recording["phase"] == Phase.EXCITE
    numbers = {}
    for channel in recording.channels:
        values = recording[channel.name][excited]
        if not len(values) or not np.isfinite(values).all():
            continue
        unit, factor = TURN.get(channel.unit, (channel.unit, 1.0))
        final = values[recording.time[excited] > recording.time[excited][-1] - END]
        numbers[f"largest_{channel.name}"] = Number(value=factor * float(np.max(np.abs(values))), unit=unit)
        numbers[f"final_{channel.name}"] = Number(value=factor * float(np.mean(final)), unit=unit)
    duration = recording.time[excited]
    numbers["seconds"] = Number(value=float(np.ptp(duration)) if len(duration) else 0.0, unit="s")
    return Found(numbers)
