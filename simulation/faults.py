"""Faults that a virtual vehicle can have while it runs: NAME@SECONDS, or NAME:DRIVE@SECONDS for those of a drive.

Seconds count from the first SYNC that the vehicle sees, so that they do not depend on how long set-up takes; with
0 the fault is there from the start.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from upright.simulation.bus.drive_node import VirtualDrive
from upright.simulation.bus.machine import Machine
from upright.telemetry.errors import UprightError

OVERCURRENT, CURRENT_ERROR = 0x2310, 0x02
GAP = 0.04
"""s that an IMU gap lasts."""
RESTART = 0.5
"""s that a drive takes to boot again after its supply failed."""


class UnknownFaultError(UprightError):
    """A fault that does not exist, or is not written NAME@SECONDS. `fault` is the argument given."""

    def __init__(self, fault: str, message: str, *, remedy: str) -> None:
        super().__init__(message, remedy=remedy)
        self.fault = fault


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault and when it occurs (s after the first SYNC)."""

    name: str
    seconds: float
    drive: str | None = None


class Stream(Protocol):
    """The frame sets of an IMU, which may stop."""

    silent: bool

    def recover(self) -> None:
        """End a silence."""
        ...


class Faulty(Protocol):
    """A vehicle into which faults can be injected."""

    @property
    def imu_stream(self) -> Stream: ...
    @property
    def drives(self) -> Mapping[str, VirtualDrive]: ...
    @property
    def plant(self) -> Machine: ...

    def later(self, seconds: float, action: Callable[[], None]) -> None:
        """Run `action` after `seconds` s."""
        ...


@dataclass(frozen=True, slots=True)
class FaultKind:
    """A kind of fault; `inject` makes it happen."""

    meaning: str
    of_drive: bool
    inject: Callable[[Faulty, str], None]


def _imu_gap(vehicle: Faulty, drive: str) -> None:
    vehicle.imu_stream.silent = True
    vehicle.later(GAP, vehicle.imu_stream.recover)


def _drive_restart(vehicle: Faulty, name: str) -> None:
    drive = vehicle.drives[name]
    drive.connected = False
    drive.servo.restart(vehicle.plant.time)
    vehicle.later(RESTART, lambda: _reconnect(vehicle, name))


def _reconnect(vehicle: Faulty, name: str) -> None:
    vehicle.drives[name].connected = True
    vehicle.drives[name].boot()


def _imu(flag: str) -> Callable[[Faulty, str], None]:
    return lambda vehicle, _: setattr(vehicle.imu_stream, flag, True)


def _drive(flag: str) -> Callable[[Faulty, str], None]:
    return lambda vehicle, name: setattr(vehicle.drives[name], flag, False)


def _overcurrent(vehicle: Faulty, name: str) -> None:
    vehicle.drives[name].fail(OVERCURRENT, CURRENT_ERROR)


FAULTS: dict[str, FaultKind] = {
    "imu_silent": FaultKind("the IMU stops sending", False, _imu("silent")),
    "imu_gap": FaultKind("the IMU pauses for 40 ms", False, _imu_gap),
    "imu_stuck": FaultKind("the IMU repeats its last values", False, _imu("stuck")),
    "imu_wrong_format": FaultKind("the IMU streams in its other precision", False, _imu("wrong_format")),
    "imu_short_frames": FaultKind("the IMU's frames lack their last byte", False, _imu("short")),
    "imu_lost_frame": FaultKind("the last frame of each IMU set is missing", False, _imu("incomplete")),
    "drive_fault": FaultKind("overcurrent: EMCY 2310h, Fault, brake", True, _overcurrent),
    "drive_silent": FaultKind("the drive's bus cable is unplugged", True, _drive("connected")),
    "drive_restart": FaultKind("the drive's supply fails; it boots again", True, _drive_restart),
    "drive_heartbeat_lost": FaultKind("the drive stops sending its heartbeat", True, _drive("heartbeat_enabled")),
}
"""Every fault by name."""


def parse_faults(arguments: Iterable[str], drives: Sequence[str]) -> tuple[Fault, ...]:
    """`["imu_gap@5", "drive_fault:trim@8"]` as faults; `drives` are the drives' names. Raises UnknownFaultError."""
    return tuple(_parse(argument, drives) for argument in arguments)


def _parse(argument: str, drives: Sequence[str]) -> Fault:
    what, _, seconds = argument.partition("@")
    name, _, drive = what.partition(":")
    if name not in FAULTS:
        raise UnknownFaultError(argument, f"there is no fault {name!r}.", remedy=f"Use one of: {', '.join(FAULTS)}.")
    try:
        when = float(seconds)
    except ValueError:
        when = -1.0
    if not 0.0 <= when < float("inf"):
        raise UnknownFaultError(
            argument,
            f"{argument!r} does not say when {name} occurs.",
            remedy=f"Write {what}@5 for 5 s after the start.",
        )
    if FAULTS[name].of_drive != bool(drive) or (drive and drive not in drives):
        example = (
            f"{name}:{drives[0] if drives else 'NAME'}@{seconds}" if FAULTS[name].of_drive else f"{name}@{seconds}"
        )
        raise UnknownFaultError(
            argument,
            f"{what!r} names no drive of this vehicle."
            if FAULTS[name].of_drive
            else f"{name} is not a fault of a drive.",
            remedy=f"Write {example}; the drives are {', '.join(drives) or 'none'}.",
        )
    return Fault(name, when, drive or None)
