"""The channels that models need of a table, so that it is read for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from upright.models.model import Model
from upright.models.parts import Hold
from upright.service.control import assembly
from upright.telemetry.tables.wanted import Wanted
from upright.vehicles.file import VehicleFile


def wanted(models: Sequence[Model], vehicle: VehicleFile | None = None) -> tuple[Wanted, ...]:
    """The channels of `models`, and those that are recorded of `vehicle`."""
    found: dict[str, Wanted] = {}
    for model in models:
        for driven in model.inputs:
            found[driven.channel] = Wanted(driven.channel, driven.unit, held=driven.hold is Hold.ZERO_ORDER)
    for model in models:
        for shown in model.outputs:
            found[shown.name] = Wanted(shown.name, shown.unit, measured=True)
    for channel in assembly.channels(vehicle) if vehicle else ():
        known = found.get(channel.name, Wanted(channel.name))
        found[channel.name] = replace(known, unit=channel.unit, part=channel.part)
    return tuple(found.values())
