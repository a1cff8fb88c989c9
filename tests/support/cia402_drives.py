"""Drives of tests: configurations, statuswords, and a drive in a state."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

from upright.drivers.cia402.config import DriveConfig
from upright.drivers.cia402.drive import Drive
from upright.drivers.cia402.states import State
from upright.telemetry.samples import CanFrame

GIMBAL = DriveConfig(
    name="gimbal",
    role="gimbal",
    node=1,
    direction=-1,
    axis_per_turn=2 * math.pi / 100,
    mode=2,
    increments_per_turn=65536,
    velocity_unit_rpm=1 / 8192,
    rated_torque=10.0,
    rpdo=(("controlword", "target_velocity", "target_velocity_fine"),),
    tpdo=(("statusword", "velocity_actual", "torque_actual"), ("position_actual",)),
)
COARSE = replace(GIMBAL, rpdo=(("controlword", "target_velocity"),), direction=1)
CYCLIC = replace(GIMBAL, mode=9, rpdo=(("controlword", "target_velocity"),))

WORDS = {
    State.NOT_READY_TO_SWITCH_ON: 0x0200,
    State.SWITCH_ON_DISABLED: 0x0240,
    State.READY_TO_SWITCH_ON: 0x0231,
    State.SWITCHED_ON: 0x0233,
    State.OPERATION_ENABLED: 0x0237,
    State.QUICK_STOP_ACTIVE: 0x0217,
    State.FAULT_REACTION_ACTIVE: 0x021F,
    State.FAULT: 0x0218,
}
"""A statusword of each state, with voltage enabled and remote set as drives do."""

TARGETS = [
    State.SWITCH_ON_DISABLED,
    State.READY_TO_SWITCH_ON,
    State.SWITCHED_ON,
    State.OPERATION_ENABLED,
    State.QUICK_STOP_ACTIVE,
]


def drive_in(state: State, config: DriveConfig = GIMBAL) -> Drive:
    drive = Drive(config)
    report(drive, state)
    return drive


def report(drive: Drive, state: State, timestamp_ns: int = 1) -> None:
    """Feed the drive a TPDO1 with a statusword of `state`."""
    drive.handle(CanFrame(timestamp_ns, 0x181, struct.pack("<Hih", WORDS[state], 0, 0)))


def controlword(drive: Drive, target: State, velocity: float = 0.0) -> int:
    ((_, data),) = drive.command(target, velocity)
    return int.from_bytes(data[:2], "little")
