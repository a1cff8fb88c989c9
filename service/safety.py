"""The safety verdict: the one place that decides whether a run may go on, and how it ends if not.

`Safety.judge(observation)` looks at one control cycle and answers with a `Verdict`: `OK`, or a code a program can
read, the reason in words with numbers and units, and the reaction.

    END_EXPERIMENT   in order: the excitation stops, the controller lowers the vehicle onto a support
    STOP_NOW         quick stop of every drive: the vehicle falls onto its supports

What can still be controlled ends in order; what cannot (no roll angle, no drive, no room left) stops now, since a
quick stop leaves a fall of a few degrees at most. The worst is judged first: a later check may rest on the earlier.

    always           IMU alive and sane, roll and roll rate finite and within limits
    armed            drives answer, no emergency, no restart, gimbals and trim mass within limits, cycles in time
    should_run       every drive is in Operation enabled
    balancing        precession budget left, observer alive

Every comparison is written so that a NaN fails it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, StrEnum
from math import degrees, isfinite, radians

from drivers.imu import ImuHealth
from service.vehicle_file import VehicleFile

RATE_MARGIN = 1.5
"""How far the measured precession rate may exceed the setpoint's limit: the speed loop overshoots a little."""


class Reaction(Enum):
    """What a verdict asks for."""

    CONTINUE = "continue"
    END_EXPERIMENT = "end the experiment in order"
    STOP_NOW = "quick stop"


class Code(StrEnum):
    """Why, for programs."""

    OK = "ok"
    IMU_SILENT = "imu_silent"
    IMU_STUCK = "imu_stuck"
    IMU_OUT_OF_RANGE = "imu_out_of_range"
    IMU_FORMAT = "imu_format"
    NOT_FINITE = "not_finite"
    ROLL = "roll"
    ROLL_RATE = "roll_rate"
    DRIVE_SILENT = "drive_silent"
    DRIVE_EMERGENCY = "drive_emergency"
    DRIVE_RESTARTED = "drive_restarted"
    DRIVE_NOT_ENABLED = "drive_not_enabled"
    PRECESSION = "precession"
    PRECESSION_RATE = "precession_rate"
    GIMBAL_MISMATCH = "gimbal_mismatch"
    TRIM_POSITION = "trim_position"
    DEADLINE = "deadline"
    PRECESSION_BUDGET = "precession_budget"
    OBSERVER_GONE = "observer_gone"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The answer for one cycle."""

    code: Code
    reaction: Reaction
    text: str


OK = Verdict(Code.OK, Reaction.CONTINUE, "")
"""All is well: always this very object."""


@dataclass(frozen=True, slots=True)
class SafetyLimits:
    """SI units; `missed_cycles` consecutive cycles of `period` s are what an IMU, a drive or the loop may miss."""

    roll: float
    roll_rate: float
    precession: float
    precession_budget: float
    precession_rate: float
    gimbal_mismatch: float
    trim_position: float
    missed_cycles: int
    period: float

    @classmethod
    def of(cls, vehicle: VehicleFile) -> SafetyLimits:
        """Those of a vehicle file."""
        limits = vehicle.limits
        return cls(
            roll=radians(limits.roll_deg),
            roll_rate=radians(limits.roll_rate_deg),
            precession=radians(limits.precession_deg),
            precession_budget=radians(limits.precession_budget_deg),
            precession_rate=RATE_MARGIN * limits.precession_rate,
            gimbal_mismatch=radians(limits.gimbal_mismatch_deg),
            trim_position=limits.trim_position,
            missed_cycles=limits.missed_cycles,
            period=vehicle.period,
        )


@dataclass(slots=True)
class DriveObservation:
    """One drive as this cycle sees it: `age` s of its latest values, `state` in words, `emergency` in words or ""."""

    name: str
    age: float = 0.0
    enabled: bool = False
    state: str = ""
    emergency: str = ""
    restarted: bool = False


@dataclass(slots=True)
class Observation:
    """What is judged. One object, refilled every cycle.

    `imu_age` s since the IMU sample before this one, or since the last one where none came; `imu_text` is the IMU
    driver's own explanation; `late_cycles` in a row that came too late to command the drives. Angles in rad, rates in
    rad/s, `trim_position` in m. See the module docstring for `armed`, `should_run` and `balancing`.
    """

    drives: tuple[DriveObservation, ...] = ()
    armed: bool = False
    should_run: bool = False
    balancing: bool = False
    imu_age: float = 0.0
    imu_health: ImuHealth = ImuHealth.OK
    imu_text: str = ""
    roll: float = 0.0
    roll_rate: float = 0.0
    precession: float = 0.0
    precession_rate: float = 0.0
    gimbal_mismatch: float = 0.0
    trim_position: float = 0.0
    late_cycles: int = 0
    observer_alive: bool = True


_IMU_CODES = {
    ImuHealth.SILENT: Code.IMU_SILENT,
    ImuHealth.STUCK: Code.IMU_STUCK,
    ImuHealth.OUT_OF_RANGE: Code.IMU_OUT_OF_RANGE,
    ImuHealth.WRONG_LENGTH: Code.IMU_FORMAT,
}


@dataclass(frozen=True, slots=True)
class Safety:
    """Judges the cycles of a vehicle with these limits."""

    limits: SafetyLimits
    _longest_silence: float = field(init=False)

    def __post_init__(self) -> None:
        # Half a period of tolerance: `missed_cycles` whole periods without an answer, jitter included.
        object.__setattr__(self, "_longest_silence", (self.limits.missed_cycles + 0.5) * self.limits.period)

    def judge(self, seen: Observation) -> Verdict:
        """The verdict on one cycle; `OK` itself, without any allocation, when all is well."""
        limits = self.limits
        if not seen.imu_age <= self._longest_silence:
            return _stop(
                Code.IMU_SILENT,
                f"no complete IMU frame set for {seen.imu_age * 1e3:.1f} ms, longer than {limits.missed_cycles} cycles "
                f"of {limits.period * 1e3:g} ms",
            )
        if seen.imu_health is not ImuHealth.OK:
            return _stop(
                _IMU_CODES[seen.imu_health], seen.imu_text or f"the IMU is not usable: {seen.imu_health.value}"
            )
        if not -limits.roll <= seen.roll <= limits.roll:
            return _beyond(Code.ROLL, "roll", seen.roll, limits.roll)
        if not -limits.roll_rate <= seen.roll_rate <= limits.roll_rate:
            return _beyond(Code.ROLL_RATE, "roll rate", seen.roll_rate, limits.roll_rate, "deg/s")
        if not seen.armed:
            return OK
        for drive in seen.drives:
            if (
                not drive.age <= self._longest_silence
                or drive.emergency
                or drive.restarted
                or (seen.should_run and not drive.enabled)
            ):
                return self._drive_fault(drive)
        if not -limits.precession <= seen.precession <= limits.precession:
            return _beyond(Code.PRECESSION, "precession angle", seen.precession, limits.precession)
        if not -limits.precession_rate <= seen.precession_rate <= limits.precession_rate:
            return _beyond(
                Code.PRECESSION_RATE, "precession rate", seen.precession_rate, limits.precession_rate, "deg/s"
            )
        if not seen.gimbal_mismatch <= limits.gimbal_mismatch:
            return _beyond(
                Code.GIMBAL_MISMATCH, "difference between the gimbals", seen.gimbal_mismatch, limits.gimbal_mismatch
            )
        if not -limits.trim_position <= seen.trim_position <= limits.trim_position:
            text = f"trim mass at {seen.trim_position:.3f} m is beyond the limit of {limits.trim_position:g} m"
            return _stop(Code.TRIM_POSITION if isfinite(seen.trim_position) else Code.NOT_FINITE, text)
        if seen.late_cycles >= limits.missed_cycles:
            return _stop(
                Code.DEADLINE,
                f"{seen.late_cycles} control cycles in a row were late for their {limits.period * 1e3:g} ms",
            )
        if not seen.balancing:
            return OK
        if not -limits.precession_budget <= seen.precession <= limits.precession_budget:
            return Verdict(
                Code.PRECESSION_BUDGET,
                Reaction.END_EXPERIMENT,
                f"precession budget used up: {degrees(seen.precession):.1f} of "
                f"{degrees(limits.precession_budget):g} deg; a static torque turns the gimbals: balance the vehicle, "
                "or make the excitation smaller",
            )
        if not seen.observer_alive:
            return Verdict(
                Code.OBSERVER_GONE, Reaction.END_EXPERIMENT, "the observer process ended: nothing is recorded any more"
            )
        return OK

    def budget_used(self, precession: float) -> float:
        """Share of the precession budget in use at this angle (rad): 0 in the middle, 1 where the experiment ends."""
        return abs(precession) / self.limits.precession_budget

    def _drive_fault(self, drive: DriveObservation) -> Verdict:
        if drive.emergency:
            return _stop(Code.DRIVE_EMERGENCY, f"drive {drive.name} reports: {drive.emergency}")
        if drive.restarted:
            return _stop(Code.DRIVE_RESTARTED, f"drive {drive.name} restarted by itself: its set-up is lost")
        if not drive.age <= self._longest_silence:
            return _stop(
                Code.DRIVE_SILENT,
                f"drive {drive.name} has not answered for {drive.age * 1e3:.1f} ms, longer than "
                f"{self.limits.missed_cycles} cycles of {self.limits.period * 1e3:g} ms",
            )
        return _stop(Code.DRIVE_NOT_ENABLED, f"drive {drive.name} left Operation enabled: it is in {drive.state}")


def _stop(code: Code, text: str) -> Verdict:
    return Verdict(code, Reaction.STOP_NOW, text)


def _beyond(code: Code, what: str, value: float, limit: float, unit: str = "deg") -> Verdict:
    """`value` and `limit` in rad or rad/s, said in degrees."""
    if not isfinite(value):
        return _stop(Code.NOT_FINITE, f"{what} is {value}, not a number")
    return _stop(code, f"{what} of {degrees(value):.2f} {unit} is beyond the limit of {degrees(limit):.2f} {unit}")
