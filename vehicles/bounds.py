"""Safety monitoring of a vehicle beyond IMU and drives, and the content of a verdict: bounds as data, codes,
reactions."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, StrEnum
from math import degrees, isfinite, radians


class Reaction(Enum):
    """The reaction that a verdict requires."""

    CONTINUE = "continue"
    END_EXPERIMENT = "end the experiment in order"
    STOP_NOW = "quick stop"
    CUT_OFF = "quick stop, and the drives taken out of operation over every other path"


class Code(StrEnum):
    """The reason, for programs. These are common to all vehicles; each kind has further codes of its own."""

    OK = "ok"
    IMU_SILENT = "imu_silent"
    IMU_STUCK = "imu_stuck"
    IMU_OUT_OF_RANGE = "imu_out_of_range"
    IMU_FORMAT = "imu_format"
    IMU_CONTRADICTION = "imu_contradiction"
    GYRO_JUMP = "gyro_jump"
    IMU_TIME = "imu_time"
    IMU_LOSSES = "imu_losses"
    NOT_FINITE = "not_finite"
    DRIVE_SILENT = "drive_silent"
    DRIVE_LOSSES = "drive_losses"
    AXIS_CONTRADICTION = "axis_contradiction"
    DRIVE_EMERGENCY = "drive_emergency"
    DRIVE_RESTARTED = "drive_restarted"
    DRIVE_NOT_ENABLED = "drive_not_enabled"
    DRIVE_NO_VOLTAGE = "drive_no_voltage"
    DRIVE_NOT_REMOTE = "drive_not_remote"
    DRIVE_WARNING = "drive_warning"
    DRIVE_HEARTBEAT = "drive_heartbeat"
    DRIVE_STILL_ENABLED = "drive_still_enabled"
    DRIVE_UNCONFIRMED = "drive_unconfirmed"
    DEADLINE = "deadline"
    FOREIGN_MASTER = "foreign_master"
    FOREIGN_SDO = "foreign_sdo"
    FOREIGN_FRAMES = "foreign_frames"
    BUS_ERRORS = "bus_errors"
    OBSERVER_GONE = "observer_gone"
    INTERNAL_ERROR = "internal_error"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on one cycle."""

    code: StrEnum
    """A `Code`, or a code of the vehicle's kind."""
    reaction: Reaction
    text: str


OK = Verdict(Code.OK, Reaction.CONTINUE, "")
"""No bound is violated: always this very object."""


class When(Enum):
    """The part of a run in which a bound is enforced; each is within the one before."""

    ALWAYS = "always"
    ARMED = "armed"
    BALANCING = "balancing"
    UPRIGHT = "upright"


@dataclass(frozen=True, slots=True)
class Unit:
    """The unit in which people read a quantity: `per_si` of it make one SI unit."""

    name: str
    per_si: float = 1.0
    digits: int = 2


DEGREES = Unit("deg", degrees(1.0))
DEGREES_PER_SECOND = Unit("deg/s", degrees(1.0))
DEVIATIONS = Unit("standard deviations", digits=1)

CONTRADICTION = 6.0
"""Standard deviations by which accelerometer and gyro may contradict each other (estimators.checks.imu_consistency).
Vibration as strong as stated is beyond it once in 2,200 h: 2e-9 of the 2.2e5 independent means of three axes in an
hour."""


@dataclass(frozen=True, slots=True)
class Bound:
    """A quantity of an `Observation` (a dotted name, as in "axes.precession") that must stay within +-`limit` (SI).

    If a bound with `advice` is exceeded, the experiment ends in an orderly way, which leaves time to follow it; if any
    other bound is exceeded, the vehicle is stopped. `what` exceeds it, in words: with advice, a whole statement.
    """

    code: StrEnum
    what: str
    of: str
    limit: float
    unit: Unit
    when: When = When.ARMED
    advice: str = ""

    def verdict(self, value: float) -> Verdict:
        """The verdict on a `value` (SI) that is not within the bound."""
        if not isfinite(value):
            return stop(Code.NOT_FINITE, f"{self.what} is {value}, not a number")
        unit, limit = self.unit, self.limit * self.unit.per_si
        if self.advice:
            text = f"{self.what}: {value * unit.per_si:.1f} of {limit:g} {unit.name}; {self.advice}"
            return Verdict(self.code, Reaction.END_EXPERIMENT, text)
        return stop(
            self.code,
            f"{self.what} of {value * unit.per_si:.{unit.digits}f} {unit.name} is beyond the limit of "
            f"{limit:.{unit.digits}f} {unit.name}",
        )


def stop(code: StrEnum, text: str) -> Verdict:
    return Verdict(code, Reaction.STOP_NOW, text)


def end(code: StrEnum, text: str) -> Verdict:
    return Verdict(code, Reaction.END_EXPERIMENT, text)


IMU_CONTRADICTION = Bound(
    Code.IMU_CONTRADICTION,
    "accelerometer and gyro contradict each other: a difference",
    "contradiction",
    CONTRADICTION,
    DEVIATIONS,
    When.BALANCING,
)
GYRO_JUMP = Bound(
    Code.GYRO_JUMP,
    "the gyro jumps as nothing can make the vehicle turn: a change",
    "watched.jump",
    radians(1.0),
    DEGREES_PER_SECOND,
    When.UPRIGHT,
)
"""For kinds whose watch has a `jump` (vehicles.watch.GyroJumps)."""
