"""Channels: the name, unit, sign and meaning of everything that is recorded, and those that every vehicle has.

Axes are those of ISO 8855: x forward, y left, z up. The channels that a vehicle has besides the common ones are in its
folder (`vehicles.monocab.channels`).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

STEEPEST = 1.6
"""rad (92 deg): no vehicle leans further."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One recorded quantity. `unit` is SI ("1" for a pure number). `newer`: older recordings lack it. `leans`: a lean
    angle of the vehicle, which is beyond STEEPEST only if it was recorded in another unit. `part`: what it belongs to,
    if a vehicle may do without; all channels of that part are then at rest. `only_with`: a section of the vehicle file
    without which it is not recorded."""

    name: str
    unit: str
    meaning: str
    newer: bool = False
    leans: bool = False
    part: str = ""
    only_with: str = ""


class ChannelTable(tuple[Channel, ...]):
    """The ordered channels of a vehicle; `table.index_of(name)` is the index of a channel in `Frame.values`."""

    __slots__ = ()

    def index_of(self, name: str) -> int:
        """The index of channel `name`. Raises KeyError, which lists the available names."""
        for place, channel in enumerate(self):
            if channel.name == name:
                return place
        raise KeyError(f"no channel {name!r}; there are {', '.join(self.names)}")

    def of(self, names: Collection[str]) -> ChannelTable:
        """Those of the channels that are among `names`, in the order of this table."""
        return ChannelTable(channel for channel in self if channel.name in names)

    @property
    def lean(self) -> str:
        """The angle in which the vehicle falls: its first lean angle; "" if there is none."""
        return next((channel.name for channel in self if channel.leans), "")

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(channel.name for channel in self)


IDLE = 0
"""Value of the channel `phase` while no experiment runs: nothing holds the vehicle then."""

SETPOINT_AGE = Channel(
    "setpoint_age",
    "s",
    "age of the setpoints relative to the IMU sample: negative, since they follow when it has arrived",
    newer=True,
)
DRIVE_AGE = Channel("drive_age", "s", "age of the drive values relative to the IMU sample")
EXCITATION = Channel(
    "excitation",
    "1",
    "value of the excitation, in the unit of what it is added to: rad on the reference, rad/s or V on the controller "
    "output",
)
PHASE = Channel("phase", "1", "phase of the experiment, see vehicles.experiment.phases.Phase")

COMMON = (SETPOINT_AGE, DRIVE_AGE, EXCITATION, PHASE)
"""The channels that the service records of every vehicle."""
