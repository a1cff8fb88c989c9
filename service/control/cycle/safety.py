"""The safety verdict: the only place that decides whether a run may continue, and how it ends if not.

`Safety.judge(observation)` checks one control cycle and returns a `Verdict`: `OK`, or a machine-readable code, the
reason as text with numbers and units, and the reaction.

    END_EXPERIMENT   in order: the excitation stops, the controller lowers the vehicle onto a support
    STOP_NOW         quick stop of every drive: the vehicle falls onto its supports
    CUT_OFF          the same, and NMT stop and no heartbeat any more: somebody else commands the drives

If the vehicle is still controllable, the run ends in order. If it is not (no angle, no drive, a limit reached), it
stops now, since a quick stop causes a fall of a few degrees at most. The worst is checked first: a later check may
depend on the earlier ones.

    always           no second master, IMU alive and sane, the angles of the fall finite and within bounds
    armed            drives answer and follow the bus, no emergency, no restart, every axis and the setpoint within
                     bounds, cycles in time
    should_run       every drive is in Operation enabled, and has voltage
    balancing        budgets left, observer alive
    upright          not fallen
    armed, last      what only ends a run in order: an accelerometer that repeats itself, a drive that warns or sends no
                     heartbeat any more, position and rate contradict each other, heavy losses of frames, somebody else
                     who reads or changes the set-up of the drives

An emergency of a drive that goes on is a warning, unless it says that the drive misses its master: a fault shows in the
statusword within a cycle, and then stops the run.

IMU and drives are the same for every vehicle. All other checks are data: `Bound`s, which each kind of vehicle derives
from its limits (the module `kind` of its folder). Every comparison is written so that a NaN fails it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite
from operator import attrgetter
from typing import Any

from upright.drivers.cia301.emergency import of_communication
from upright.drivers.imu.imu import ImuHealth
from upright.estimators.checks.axis_consistency import AxisConsistency
from upright.estimators.checks.loss_test import THRESHOLD, LossTest
from upright.vehicles.bounds import OK, Bound, Code, Reaction, Verdict, When, end, stop


@dataclass(slots=True)
class DriveObservation:
    """One drive in this cycle: `age` s of its latest values, `state` as text, `emergency` as text or "" with its code.

    `heartbeat_age` in s, 0 before the first one; `voltage` and `remote` as in the statusword; `emergencies` is how
    many it has sent, `answered_ns` the time of the oldest of its values, `statuswords` how many have come; `losses`
    tests how many answers did not come. `slip` is by how many turns of the motor its position and its rate contradict
    each other, by the sums of `axis`.
    """

    name: str
    age: float = 0.0
    enabled: bool = False
    faulty: bool = False
    state: str = ""
    emergency: str = ""
    emergency_code: int = 0
    restarted: bool = False
    voltage: bool = True
    remote: bool = True
    heartbeat_age: float = 0.0
    emergencies: int = 0
    answered_ns: int = 0
    statuswords: int = 0
    losses: LossTest = field(default_factory=LossTest)
    axis: AxisConsistency = field(default_factory=AxisConsistency)
    slip: float = 0.0


@dataclass(slots=True)
class Observation:
    """The input of the verdict. One object, updated every cycle.

    `imu_age` s since the previous IMU sample, or since the last one if none came; `imu_text` is the explanation by the
    IMU driver, `accelerometer_stuck` its finding that only the gyro measures; `imu_frozen` sets came without advance
    of their time; `imu_losses` tests how many did not come; `late_cycles` consecutive cycles came too late to command
    the drives; `answers_due`: SYNC was sent in time for an answer before this cycle; `angle` (rad) and `rate` (rad/s)
    are those of the fall; `setpoint` is the next one for the drives; `axes` are their measurements, in the terms of the
    kind of vehicle, and `watched` what its model says about them; `contradiction` is that of accelerometer and gyro, in
    standard deviations; `foreign_command` and `foreign_request` say what somebody else sends with our ids, "" if nobody
    does. See the module docstring for `armed`, `should_run`, `balancing` and `upright`.
    """

    drives: tuple[DriveObservation, ...] = ()
    armed: bool = False
    should_run: bool = False
    balancing: bool = False
    upright: bool = False
    imu_age: float = 0.0
    imu_health: ImuHealth = ImuHealth.OK
    imu_text: str = ""
    accelerometer_stuck: bool = False
    imu_frozen: int = 0
    imu_losses: LossTest = field(default_factory=LossTest)
    angle: float = 0.0
    rate: float = 0.0
    setpoint: float = 0.0
    axes: Any = None
    watched: Any = None
    contradiction: float = 0.0
    late_cycles: int = 0
    answers_due: bool = True
    foreign_command: str = ""
    foreign_request: str = ""
    observer_alive: bool = True

    def begin(self) -> None:
        """An experiment starts: what was lost before does not count."""
        self.imu_losses.reset()
        for drive in self.drives:
            drive.losses.reset()
            drive.axis.reset()


_IMU_CODES = {
    ImuHealth.SILENT: Code.IMU_SILENT,
    ImuHealth.STUCK: Code.IMU_STUCK,
    ImuHealth.OUT_OF_RANGE: Code.IMU_OUT_OF_RANGE,
    ImuHealth.WRONG_LENGTH: Code.IMU_FORMAT,
}

SLIP = 0.1
"""Turns of the motor: more than the resolution and the filter of a drive make."""
LOSSES = "the bus loses frames; check termination, plugs, bit rate and load"

_Check = tuple[Callable[[Observation], float], float, Bound]


class Safety:
    """Checks the cycles of a vehicle against its `bounds`, in their order.

    IMU, drives and loop may miss `missed_cycles` consecutive cycles of `period` s, a drive's heartbeat may be
    `heartbeat_timeout` s old. `longest_silence`: the same in s, for a drive or the IMU.
    """

    def __init__(
        self, bounds: Sequence[Bound], *, missed_cycles: int, period: float, heartbeat_timeout: float = inf
    ) -> None:
        self.heartbeat_timeout = heartbeat_timeout
        self.missed_cycles = missed_cycles
        self.period = period
        # Half a period of tolerance: `missed_cycles` whole periods without an answer, jitter included.
        self.longest_silence = (missed_cycles + 0.5) * period
        self._stopping = _by_phase(bound for bound in bounds if not bound.advice)
        self._ending = _by_phase(bound for bound in bounds if bound.advice)

    def nearest(self, seen: Observation) -> tuple[Bound, float] | None:
        """The bound, of those that are enforced now, of whose limit most is used, and that share; None if nothing is
        known yet."""
        upright = seen.balancing and seen.upright
        enforced = {When.ALWAYS: True, When.ARMED: seen.armed, When.BALANCING: seen.balancing, When.UPRIGHT: upright}
        found: tuple[Bound, float] | None = None
        for when, now in enforced.items():
            for read, limit, bound in (*self._stopping[when], *self._ending[when]) if now else ():
                share = abs(read(seen)) / limit
                if isfinite(share) and (found is None or share > found[1]):
                    found = bound, share
        return found

    def judge(self, seen: Observation) -> Verdict:
        """The verdict on one cycle; `OK` itself if no check fails. What stops comes before all that ends in order: an
        experiment that is being ended must be stopped, too, if it has to be."""
        if seen.foreign_command:
            return Verdict(Code.FOREIGN_MASTER, Reaction.CUT_OFF, seen.foreign_command)
        if not seen.imu_age <= self.longest_silence:
            return stop(
                Code.IMU_SILENT,
                f"no complete IMU frame set for {seen.imu_age * 1e3:.1f} ms, longer than {self.missed_cycles} cycles "
                f"of {self.period * 1e3:g} ms",
            )
        if seen.imu_health is not ImuHealth.OK:
            return stop(_IMU_CODES[seen.imu_health], seen.imu_text or f"the IMU is not usable: {seen.imu_health.value}")
        if seen.imu_frozen > self.missed_cycles:
            return stop(
                Code.IMU_TIME,
                f"{seen.imu_frozen + 1} IMU frame sets in a row have the same time stamp: the driver of the interface "
                "stamps no frames, or a clock stands still",
            )
        stopping, ending = self._stopping, self._ending
        if verdict := _beyond(stopping[When.ALWAYS], seen):
            return verdict
        if not seen.armed:
            return OK
        concern = None
        for drive in seen.drives:
            if (
                not drive.age <= self.longest_silence
                or drive.restarted
                or not drive.remote
                or (seen.should_run and not (drive.enabled and drive.voltage))
                or (drive.emergency and (drive.faulty or of_communication(drive.emergency_code)))
            ):
                return self._drive_fault(drive)
            if (
                drive.emergency
                or not drive.heartbeat_age <= self.heartbeat_timeout
                or drive.losses.log_ratio > THRESHOLD
                or not drive.slip <= SLIP
            ):
                concern = drive
        if verdict := _beyond(stopping[When.ARMED], seen):
            return verdict
        if seen.late_cycles >= self.missed_cycles:
            return stop(
                Code.DEADLINE,
                f"{seen.late_cycles} control cycles in a row were late for their {self.period * 1e3:g} ms",
            )
        upright = seen.balancing and seen.upright
        if upright and (verdict := _beyond(stopping[When.UPRIGHT], seen)):
            return verdict
        if seen.balancing and (verdict := _beyond(stopping[When.BALANCING], seen)):
            return verdict
        if verdict := _beyond(ending[When.ARMED], seen):
            return verdict
        if upright and (verdict := _beyond(ending[When.UPRIGHT], seen)):
            return verdict
        if seen.balancing and (verdict := _beyond(ending[When.BALANCING], seen)):
            return verdict
        if seen.balancing and not seen.observer_alive:
            return end(Code.OBSERVER_GONE, "the observer process ended: nothing is recorded any more")
        if seen.accelerometer_stuck:
            return end(Code.IMU_STUCK, seen.imu_text)
        if concern is not None:
            return self._drive_concern(concern)
        if seen.imu_losses.log_ratio > THRESHOLD:
            return end(
                Code.IMU_LOSSES,
                "every second frame set of the IMU is missing, or more: the IMU sends at another rate than "
                f"control.rate, {1.0 / self.period:g} Hz, or {LOSSES}",
            )
        if seen.foreign_request:
            return end(Code.FOREIGN_SDO, seen.foreign_request)
        return OK

    def _drive_fault(self, drive: DriveObservation) -> Verdict:
        if drive.emergency:
            return stop(Code.DRIVE_EMERGENCY, f"drive {drive.name} reports: {drive.emergency}")
        if drive.restarted:
            return stop(Code.DRIVE_RESTARTED, f"drive {drive.name} restarted by itself: its configuration is lost")
        if not drive.age <= self.longest_silence:
            return stop(
                Code.DRIVE_SILENT,
                f"drive {drive.name} has not answered for {drive.age * 1e3:.1f} ms, longer than "
                f"{self.missed_cycles} cycles of {self.period * 1e3:g} ms",
            )
        if not drive.remote:
            return stop(
                Code.DRIVE_NOT_REMOTE,
                f"drive {drive.name} does not follow the bus any more (statusword bit 9, remote, is 0): give the "
                "control back to CANopen, in the drive or in the tool that has taken it",
            )
        if drive.enabled:
            return stop(
                Code.DRIVE_NO_VOLTAGE,
                f"drive {drive.name} has no torque: it says Operation enabled, but its voltage is off (statusword bit "
                "4 is 0); check its supply, its fuse and safe torque off",
            )
        return stop(Code.DRIVE_NOT_ENABLED, f"drive {drive.name} left Operation enabled: it is in {drive.state}")

    def _drive_concern(self, drive: DriveObservation) -> Verdict:
        if drive.emergency:
            return end(Code.DRIVE_WARNING, f"drive {drive.name} warns: {drive.emergency}")
        if not drive.slip <= SLIP:
            return end(
                Code.AXIS_CONTRADICTION,
                f"position and rate of drive {drive.name} differ by {drive.slip:.2f} turns of the motor: "
                "check encoder and units",
            )
        if drive.losses.log_ratio > THRESHOLD:
            return end(Code.DRIVE_LOSSES, f"every second answer of drive {drive.name} is missing, or more: {LOSSES}")
        return end(
            Code.DRIVE_HEARTBEAT,
            f"drive {drive.name} has sent no heartbeat for {drive.heartbeat_age * 1e3:.0f} ms, though its values still "
            "come: it may have lost its set-up (1017h)",
        )


def _by_phase(bounds: Iterable[Bound]) -> dict[When, tuple[_Check, ...]]:
    checks: dict[When, list[_Check]] = {when: [] for when in When}
    for bound in bounds:
        checks[bound.when].append((attrgetter(bound.of), bound.limit, bound))
    return {when: tuple(each) for when, each in checks.items()}


def _beyond(checks: tuple[_Check, ...], seen: Observation) -> Verdict | None:
    """The verdict on the first of `checks` that fails."""
    for read, limit, bound in checks:
        if not -limit <= read(seen) <= limit:
            return bound.verdict(read(seen))
    return None
