"""Channel tables: the name, unit, sign and meaning of everything that is recorded.

Axes are those of ISO 8855: x forward, y left, z up. Roll is positive when the right side goes down (a right-handed
turn about x); precession is positive when its rate gives a positive roll torque, so the torque balance of the MONOCAB
reads  inertia * roll'' = gravity_stiffness * roll + angular_momentum * precession' + disturbances. The tilt of the
balancing robot is a turn about y: positive when it leans forward; its wheels and voltages are positive forward.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Channel:
    """One recorded quantity. `unit` is SI ("1" for a pure number). `newer`: older recordings lack it."""

    name: str
    unit: str
    meaning: str
    newer: bool = False


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


NOTHING_RUNS = 0
"""Value of the channel `phase` while no experiment runs: nothing holds the vehicle then."""

_SETPOINT_AGE = Channel(
    "setpoint_age",
    "s",
    "how much older than the IMU sample the setpoints of this row are: negative, for they follow when it has arrived",
    newer=True,
)
_DRIVE_AGE = Channel("drive_age", "s", "how much older than the IMU sample the drive values of this row are")
_EXCITATION = Channel(
    "excitation",
    "1",
    "value of the excitation, as what it is added to: rad on the reference, rad/s or V on the controller output",
)
_PHASE = Channel("phase", "1", "phase of the experiment, see vehicles.phases.Phase")

MONOCAB = ChannelTable(
    (
        Channel("roll", "rad", "roll angle of the cabin from the roll filter, 0 upright, positive right side down"),
        Channel("roll_rate", "rad/s", "roll rate: gyro about x less its estimated bias"),
        Channel("roll_std", "rad", "standard deviation of roll as the roll filter sees it"),
        Channel(
            "gyro_bias_std",
            "rad/s",
            "standard deviation of the gyro's bias about x as the roll filter sees it",
            newer=True,
        ),
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
        _SETPOINT_AGE,
        _DRIVE_AGE,
        Channel(
            "roll_reference", "rad", "reference of the roll controller, with the excitation where it is injected there"
        ),
        _EXCITATION,
        _PHASE,
    )
)
"""Channels of the gyro-stabilised monorail vehicle."""

TWSBR = ChannelTable(
    (
        Channel("tilt", "rad", "tilt of the body from the tilt filter, 0 upright, positive forward"),
        Channel("tilt_rate", "rad/s", "tilt rate: gyro about y less its estimated bias"),
        Channel("tilt_std", "rad", "standard deviation of tilt as the tilt filter sees it"),
        Channel(
            "left_wheel_angle",
            "rad",
            "angle of the left wheel against the body, as its encoder counts it, positive forward;"
            " against the floor it has rolled by tilt more",
        ),
        Channel("right_wheel_angle", "rad", "angle of the right wheel against the body, likewise"),
        Channel("left_wheel_rate", "rad/s", "rate of the left wheel against the body as its drive measures it"),
        Channel("right_wheel_rate", "rad/s", "rate of the right wheel against the body as its drive measures it"),
        Channel(
            "left_voltage",
            "V",
            "voltage sent to the left motor's drive in this cycle, as quantised in the PDO; positive drives the wheel"
            " forward",
        ),
        Channel("right_voltage", "V", "voltage sent to the right motor's drive in this cycle, likewise"),
        _SETPOINT_AGE,
        _DRIVE_AGE,
        Channel(
            "tilt_reference", "rad", "reference of the tilt controller, with the excitation where it is injected there"
        ),
        _EXCITATION,
        _PHASE,
    )
)
"""Channels of the two-wheeled balancing robot. A turn to the left is (right - left wheel) radius / distance > 0."""

TABLES: dict[str, ChannelTable] = {"monocab": MONOCAB, "twsbr": TWSBR}
"""Channel table by vehicle kind."""
