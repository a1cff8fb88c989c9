"""An entry of the fault table: what happens, and how the vehicle has to come out of it.

Measured against the issue's figures: a fault is detected within 100 ms, one that takes away control within 50 ms. It
never leaves a drive on or an axis moving, never ends as `done` with the vehicle on its support, and never lets it hit
the support harder than it does with control switched off.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, StrEnum

from faults.bench import Bench
from upright.vehicles.bounds import Code

DETECTED = 0.1
"""s within which a fault has to be detected."""
CONTROL_LOST = 0.05
"""s within which it has to be if the controller no longer moves the axes, or no longer knows how the vehicle moves."""


class End(Enum):
    """How a run ends."""

    STOPPED = "stopped"
    """At once, with a latched fault: the drives brake and are switched off, the vehicle falls onto its support."""
    IN_ORDER = "ended in order"
    """Lowered onto the support; the reason is stated."""
    HARMLESS = "harmless"
    """Rides through: the experiment takes its course, and ends as done."""
    NEVER = "never ended"


class When(StrEnum):
    """The part of a run in which the fault occurs."""

    REST = "rest"
    ENABLE = "enable"
    RISE = "rise"
    SETTLE = "settle"
    EXCITE = "excite"
    LOWER = "lower"
    AFTERMATH = "aftermath"
    """Just stopped by an operator: the drives brake, the vehicle falls, the recording goes on."""


ALL = tuple(When)
UP = (When.RISE, When.SETTLE, When.EXCITE, When.LOWER)
KINDS = ("monocab", "twsbr", "cube")
MONOCAB = ("monocab",)
MEASURED_FLYWHEELS = "monocab_flywheels"
"""A MONOCAB whose flywheels report their speed, for the faults of these alone."""
VEHICLES = (*KINDS, MEASURED_FLYWHEELS)


class Wanted(StrEnum):
    """Reasons beyond those that IMU, drives and limits have had from the start."""

    GIMBAL_FOLLOWING = "gimbal_following"
    TRIM_FOLLOWING = "trim_following"
    WHEEL_FOLLOWING = "wheel_following"
    HEADING = "heading"
    TORQUE_BALANCE = "torque_balance"
    AXIS_CONTRADICTION = "axis_contradiction"
    IMU_CONTRADICTION = "imu_contradiction"
    GYRO_JUMP = "gyro_jump"
    IMU_TIME = "imu_time"
    FOREIGN_MASTER = "foreign_master"
    FOREIGN_SDO = "foreign_sdo"
    FALLEN = "fallen"
    RECOVERY = "recovery"
    FLYWHEELS = "flywheels"
    DRIVE_WARNING = "drive_warning"
    DRIVE_HEARTBEAT = "drive_heartbeat"
    DRIVE_NO_VOLTAGE = "drive_no_voltage"
    DRIVE_NOT_REMOTE = "drive_not_remote"
    BUS_DOWN = "bus_down"


SQUARE, HOLD, SIDE_LOAD = "square", "hold", "side_load"
EXPERIMENTS = (SQUARE, HOLD)
"""With excitation, and without: a controller that has nothing to do hides an axis that does not follow. The side load
is for the trim mass, which only the full controller moves."""

Clue = Callable[[Bench], Callable[[], bool]]
"""Called when the fault is injected; returns what tells in each cycle whether the fault can be known by now."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault. `what` in an operator's words; `inject` makes it happen on a bench.

    `kinds` are those of VEHICLES that it is for.
    `ends` are the ends that are right and `codes` the reasons: any of them if a run is stopped. An orderly end has one
    of them, too, or its reason in words contains one of `says`, in lower case. The fault has to be detected `within` s
    (None: nothing has to be reported) from `since`, by default from its injection; `why` gives the reason for what is
    not obvious.
    """

    name: str
    what: str
    inject: Callable[[Bench], None]
    ends: tuple[End, ...]
    codes: tuple[str, ...] = ()
    within: float | None = DETECTED
    since: Clue | None = None
    says: tuple[str, ...] = ()
    why: str = ""
    may_lose: str = ""
    kinds: tuple[str, ...] = KINDS
    when: tuple[When, ...] = ALL
    passes: bool = False
    """It is over by itself before the drives are enabled if it occurs at rest."""
    pushes: bool = False
    """It adds energy to the fall, with and without control."""
    locks: str = ""
    """A word that the interlocks contain after the operator has reset the fault: the next run is refused."""
    experiments: tuple[str, ...] = EXPERIMENTS


def stopped(
    name: str,
    what: str,
    inject: Callable[[Bench], None],
    *codes: str,
    within: float = DETECTED,
    since: Clue | None = None,
    why: str = "",
    may_lose: str = "the run; the vehicle falls onto its support",
    kinds: tuple[str, ...] = KINDS,
    when: tuple[When, ...] = ALL,
    passes: bool = False,
    pushes: bool = False,
    locks: str = "",
    or_in_order: bool = False,
) -> Fault:
    """A fault after which the vehicle cannot or must not be held up any longer; `or_in_order`: lowering is as good."""
    ends = (End.STOPPED, End.IN_ORDER) if or_in_order else (End.STOPPED,)
    return Fault(name, what, inject, ends, codes, within, since, (), why, may_lose, kinds, when, passes, pushes, locks)


def in_order(
    name: str,
    what: str,
    inject: Callable[[Bench], None],
    *codes: str,
    says: tuple[str, ...] = (),
    within: float = DETECTED,
    since: Clue | None = None,
    why: str = "",
    may_lose: str = "the rest of the run",
    kinds: tuple[str, ...] = KINDS,
    when: tuple[When, ...] = ALL,
    pushes: bool = False,
    or_harmless: bool = False,
    experiments: tuple[str, ...] = EXPERIMENTS,
) -> Fault:
    """A fault with which the vehicle can still be lowered, and has to be; `or_harmless`: going on is as good."""
    ends = (End.IN_ORDER, End.HARMLESS) if or_harmless else (End.IN_ORDER,)
    return Fault(
        name,
        what,
        inject,
        ends,
        codes,
        within,
        since,
        says,
        why,
        may_lose,
        kinds,
        when,
        pushes=pushes,
        experiments=experiments,
    )


def harmless(
    name: str,
    what: str,
    inject: Callable[[Bench], None],
    *,
    reported: bool = False,
    since: Clue | None = None,
    why: str = "",
    may_lose: str = "",
    kinds: tuple[str, ...] = KINDS,
    when: tuple[When, ...] = ALL,
    or_in_order: bool = False,
    or_stopped: tuple[str, ...] = (),
    pushes: bool = False,
    passes: bool = False,
) -> Fault:
    """A fault that the vehicle rides through; `reported`: an event says so within the time of detection.

    `or_in_order`: lowering is as good, and `or_stopped` are the reasons for which a stop is.
    """
    ends: tuple[End, ...] = (End.HARMLESS,)
    ends += (End.IN_ORDER,) if or_in_order else ()
    ends += (End.STOPPED,) if or_stopped else ()
    within = DETECTED if reported else None
    return Fault(name, what, inject, ends, or_stopped, within, since, (), why, may_lose, kinds, when, passes, pushes)


SILENT_IMU = (Code.IMU_SILENT, Code.IMU_STUCK, Code.IMU_FORMAT, Code.IMU_OUT_OF_RANGE)
"""Any of what can be said of an IMU that sends nothing usable."""
NOT_FOLLOWED = (Wanted.GIMBAL_FOLLOWING, Wanted.TRIM_FOLLOWING, Wanted.WHEEL_FOLLOWING, Wanted.HEADING)
LYING_IMU = (Wanted.IMU_CONTRADICTION, Wanted.GYRO_JUMP)
STRANGER = (Wanted.FOREIGN_MASTER, Wanted.FOREIGN_SDO)
