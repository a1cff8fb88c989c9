"""Channel tables: the name, unit, sign and meaning of everything that is recorded.

Axes are those of ISO 8855: x forward, y left, z up. Roll is positive when the right side goes down (a right-handed
turn about x); precession is positive when its rate gives a positive roll torque, so the torque balance of the MONOCAB
reads  inertia * roll'' = gravity_stiffness * roll + angular_momentum * precession' + disturbances.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Channel:
    """One recorded quantity. `unit` is SI ("1" for a pure number)."""

    name: str
    unit: str
    meaning: str


class ChannelTable(tuple[Channel, ...]):
    """The ordered channels of a vehicle; `table.index_of(name)` is the place of a channel in `Frame.values`."""

    __slots__ = ()

    def index_of(self, name: str) -> int:
        """The place of channel `name`. Raises KeyError that lists the names there are."""
        for place, channel in enumerate(self):
            if channel.name == name:
                return place
        raise KeyError(f"no channel {name!r}; there are {', '.join(self.names)}")

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(channel.name for channel in self)


MONOCAB = ChannelTable(
    (
        Channel("roll", "rad", "roll angle of the cabin from the roll filter, 0 upright, positive right side down"),
        Channel("roll_rate", "rad/s", "roll rate: gyro about x less its estimated bias"),
        Channel("roll_std", "rad", "standard deviation of roll as the roll filter sees it"),
        Channel("pitch", "rad", "pitch angle from the roll filter, positive nose down"),
        Channel("precession", "rad", "mean angle of the gimbals, 0 in the middle"),
        Channel("precession_rate", "rad/s", "mean rate of the gimbals as the drives measure it"),
        Channel(
            "precession_rate_setpoint", "rad/s", "rate sent to the gimbal drives in this cycle, as quantised in the PDO"
        ),
        Channel(
            "trim_position",
            "m",
            "trim mass, 0 in the middle, positive to the right, where its weight gives a positive roll torque",
        ),
        Channel("trim_rate", "m/s", "trim mass rate as the drive measures it"),
        Channel("trim_rate_setpoint", "m/s", "rate sent to the trim drive in this cycle, as quantised in the PDO"),
        Channel("drive_age", "s", "how much older than the IMU sample the drive values of this row are"),
        Channel(
            "roll_reference", "rad", "reference of the roll controller, with the excitation where it is injected there"
        ),
        Channel(
            "excitation", "1", "value of the excitation: rad on the roll reference, rad/s on the controller output"
        ),
        Channel("phase", "1", "phase of the experiment, see service.sequence.Phase"),
    )
)
"""Channels of the gyro-stabilised monorail vehicle."""

TABLES: dict[str, ChannelTable] = {"monocab": MONOCAB}
"""Channel table by vehicle kind."""
