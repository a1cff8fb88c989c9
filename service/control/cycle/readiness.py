"""The observation for the safety verdict of each cycle, and the interlocks before a run."""

from __future__ import annotations

from math import degrees
from typing import Any

from upright.drivers.cia402.drive import Drive
from upright.drivers.cia402.states import REMOTE, VOLTAGE_ENABLED, State
from upright.drivers.foreign import REMEDY, ForeignTraffic
from upright.drivers.imu.imu import ImuHealth
from upright.drivers.vehicle_io import VehicleIo
from upright.service.control.cycle.safety import DriveObservation, Observation
from upright.service.control.cycle.sequence import AT_REST_ANGLE, AT_REST_RATE
from upright.vehicles.contract import Kind, Lean, Measurement
from upright.vehicles.sections import VehicleFile

FAULTY = (State.FAULT, State.FAULT_REACTION_ACTIVE)


def observation(io: VehicleIo) -> Observation:
    """An observation of this vehicle, to be updated every cycle."""
    return Observation(drives=tuple(DriveObservation(drive.config.name) for drive in io.drives))


def observe(
    seen: Observation, io: VehicleIo, now_ns: int, measured: Measurement, *, period: float, missed: int
) -> None:
    """Update the observation with the drivers' state at `now_ns`; `missed` sets of the IMU, one every `period` s,
    should have come before; -1 if this one came at the time of the last (estimators.checks.loss_test)."""
    seen.imu_losses.came(missed)
    for drive, entry in zip(io.drives, seen.drives, strict=True):
        answered_ns = min(drive.timestamp_ns, drive.statusword_timestamp_ns)
        if answered_ns != entry.answered_ns:
            elapsed = (answered_ns - entry.answered_ns) * 1e-9
            slip = entry.axis.update(elapsed, period, drive.position, drive.velocity)
            entry.slip = slip / drive.config.axis_per_turn
            entry.answered_ns = answered_ns
            entry.losses.came()
            for _ in range(drive.statusword_count - entry.statuswords - 1):
                entry.losses.came(-1)
        elif seen.answers_due:
            entry.losses.lost()
        entry.statuswords = drive.statusword_count
        entry.age = (now_ns - answered_ns) * 1e-9
        entry.enabled = drive.state is State.OPERATION_ENABLED
        entry.faulty = drive.state in FAULTY
        entry.restarted = drive.restarted
        if not entry.enabled:
            entry.state = drive.condition
        # One that was over within the cycle counts, too.
        emergency = drive.emergency
        if emergency is None and drive.emergency_count != entry.emergencies:
            emergency = drive.last_emergency
        entry.emergencies = drive.emergency_count
        entry.emergency = emergency.text if emergency is not None else ""
        entry.emergency_code = emergency.code if emergency is not None else 0
        word = drive.statusword
        entry.voltage = word is None or word & VOLTAGE_ENABLED != 0
        entry.remote = word is None or word & REMOTE != 0
        entry.heartbeat_age = heartbeat_age(drive, now_ns)
    seen.imu_health = io.imu.health(now_ns)
    seen.imu_text = io.imu.fault_text
    seen.accelerometer_stuck = io.imu.accelerometer_stuck
    seen.imu_frozen = io.imu.frozen
    seen.axes = measured


def heartbeat_age(drive: Drive, now_ns: int) -> float:
    """s since the last heartbeat of `drive`, 0 before the first one."""
    return (now_ns - drive.heartbeat_timestamp_ns) * 1e-9 if drive.heartbeat_timestamp_ns else 0.0


def heartbeat_timeout(vehicle: VehicleFile) -> float:
    """s that the last heartbeat of a drive may be old: the consumer time of the drives, and half a period of jitter."""
    return vehicle.control.heartbeat_timeout + 0.5 * vehicle.control.heartbeat_period


def interlocks(
    vehicle: VehicleFile,
    kind: Kind[Any],
    io: VehicleIo,
    lean: Lean | None,
    measured: Measurement,
    now_ns: int,
    silence: float,
) -> list[str]:
    """The reasons that prevent a run, each as a sentence with the remedy."""
    found = []
    if lean is None or silence > 0.0:
        found.append(
            f"No IMU frames on {vehicle.bus.imu}: check its supply, bit rate and imu.base_id."
            if not io.imu.fault_text
            else io.imu.fault_text
        )
    elif io.imu.health(now_ns) is not ImuHealth.OK or io.imu.accelerometer_stuck:
        found.append(io.imu.fault_text or f"The IMU is not usable: {io.imu.health(now_ns).value}.")
    elif abs(abs(lean.angle) - vehicle.support) > AT_REST_ANGLE or abs(lean.rate) > AT_REST_RATE:
        found.append(
            f"The vehicle does not rest on a support: {kind.angle} {degrees(lean.angle):.2f} deg, supports at "
            f"±{vehicle.limits.support_deg:g} deg. Set it down, or check imu.axes and limits.support_deg."
        )
    for drive in io.drives:
        if drive.state in FAULTY or drive.emergency is not None:
            found.append(f"Drive {drive.condition}. Remove its cause, then run `upright reset`.")
        elif measured.timestamp_ns == 0 or (now_ns - drive.timestamp_ns) * 1e-9 > 10 * vehicle.period:
            found.append(f"Drive {drive.last_wrong_length or drive.condition + ': no answer'}.")
        elif heartbeat_age(drive, now_ns) > heartbeat_timeout(vehicle):
            found.append(f"Drive {drive.condition}: no heartbeat. Switch it off and on, so that it is set up again.")
    return found + kind.interlocks(measured)


def strangers(foreign: ForeignTraffic, now_ns: int) -> list[str]:
    """Who else sends what only this service may send, each as a sentence with the remedy."""
    return [f"{each.text[:1].upper()}{each.text[1:]}: {REMEDY}." for each in foreign.active(now_ns)]


def drive_states(io: VehicleIo) -> list[dict[str, Any]]:
    """State, fault and warnings of each drive, for display."""
    return [
        {
            "name": drive.config.name,
            "state": drive.state.value,
            "fault": drive.emergency.text if drive.emergency is not None else drive.last_wrong_length,
            "warnings": list(drive.advice),
        }
        for drive in io.drives
    ]
