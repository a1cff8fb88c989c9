"""A virtual vehicle without a bus, and a master that exchanges frames with it in simulated time: for the tests."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from upright.simulation.bus.drive_node import VirtualDrive
from upright.simulation.config import DriveNode, SimulationConfig
from upright.simulation.faults import Fault
from upright.simulation.monocab.truth import PlantTruth
from upright.simulation.vehicle import VirtualVehicle

EDS = Path(__file__).resolve().parents[2] / "drivers" / "eds" / "upright_servo.eds"
GIMBAL_PER_TURN = 2.0 * math.pi / 100.0
MASTER = 127
SHUTDOWN, SWITCH_ON, ENABLE, FAULT_RESET, QUICK_STOP, DISABLE_VOLTAGE = 0x06, 0x07, 0x7F, 0x80, 0x02, 0x00


def drive_nodes(**changes: Any) -> tuple[DriveNode, ...]:
    """Two gimbals and a trim drive as in the MONOCAB's vehicle file, each with these changes."""
    common: dict[str, Any] = {
        "increments_per_turn": 65536,
        "velocity_unit_rpm": 1 / 8192,
        "rated_torque": 10.0,
        "eds": EDS,
    }
    nodes = (
        DriveNode(name="gimbal_left", role="gimbal", node=1, direction=1, axis_per_turn=GIMBAL_PER_TURN, **common),
        DriveNode(name="gimbal_right", role="gimbal", node=2, direction=-1, axis_per_turn=GIMBAL_PER_TURN, **common),
        DriveNode(name="trim", role="trim", node=3, direction=1, axis_per_turn=0.01, **common),
    )
    return tuple(replace(node, **changes) for node in nodes)


class Harness:
    """`sent` holds every frame of the vehicle as (timestamp_ns, can_id, data)."""

    def __init__(self, config: SimulationConfig | None = None, faults: Sequence[Fault] = ()) -> None:
        self.sent: list[tuple[int, int, bytes]] = []
        self.config = config or SimulationConfig(PlantTruth(), drives=drive_nodes())
        self.vehicle = VirtualVehicle(self.config, self._collect, faults)
        self.vehicle.boot()
        self.vehicle.begin_cycle()

    def _collect(self, can_id: int, data: bytes, timestamp_ns: int, *, of_imu: bool) -> None:
        self.sent.append((timestamp_ns, can_id, data))

    @property
    def left(self) -> VirtualDrive:
        return self.vehicle.drives["gimbal_left"]

    @property
    def time(self) -> float:
        return self.vehicle.plant.time

    def frames(self, can_id: int) -> list[bytes]:
        return [data for _, sent_id, data in self.sent if sent_id == can_id]

    def emergencies(self, node: int) -> list[int]:
        """Error codes of the EMCYs of a drive."""
        return [struct.unpack_from("<H", data)[0] for data in self.frames(0x80 + node)]

    def statusword(self, node: int = 1) -> int:
        """The statusword in the last TPDO."""
        return int(struct.unpack_from("<H", self.frames(0x180 + node)[-1])[0])

    def sdo(self, node: int, index: int, subindex: int = 0, value: int | None = None, size: int = 4) -> int:
        """Read, or write `value` of `size` bytes. Returns the value, or minus the abort code."""
        if value is None:
            request = struct.pack("<BHB4x", 0x40, index, subindex)
        else:
            data = value.to_bytes(size, "little", signed=value < 0)
            request = struct.pack("<BHB4s", 0x23 | (4 - size) << 2, index, subindex, data)
        self.vehicle.receive(0x600 + node, request)
        answer = self.frames(0x580 + node)[-1]
        code = int(struct.unpack_from("<I", answer, 4)[0])
        return -code if answer[0] == 0x80 else code

    def nmt(self, command: int, node: int = 0) -> None:
        self.vehicle.receive(0x000, bytes((command, node)))

    def set_up(self, mode: int = 2, timeout_ms: int = 120, reaction: int = 3) -> None:
        """Write what a master writes before it starts the nodes, and start them."""
        for node in (1, 2, 3):
            assert self.sdo(node, 0x6060, 0, mode, 1) >= 0
            assert self.sdo(node, 0x1016, 1, MASTER << 16 | timeout_ms) >= 0
            assert self.sdo(node, 0x6007, 0, reaction, 2) >= 0
        self.nmt(1)

    def cycle(self, controlword: int, rpm: float = 0.0, *, heartbeat: bool = True, rpdo: bool = True) -> None:
        """One control cycle: setpoint to the left motor (mirrored to the right), SYNC, heartbeat, one period."""
        if rpdo:
            for node, sign in ((1, 1), (2, -1), (3, 0)):
                whole, part = divmod(sign * rpm, 1.0)
                self.vehicle.receive(0x200 + node, struct.pack("<Hhh", controlword, int(whole), int(part * 8192)))
        self.vehicle.advance_steps(self.config.steps_per_ms)
        self.vehicle.receive(0x080, b"")
        if heartbeat:
            self.vehicle.receive(0x700 + MASTER, b"\x05")
        self.vehicle.advance_steps(self.config.steps_per_period - self.config.steps_per_ms)
        self.vehicle.begin_cycle()

    def cycles(self, seconds: float, controlword: int, rpm: float = 0.0, **options: bool) -> None:
        for _ in range(round(seconds * self.config.rate)):
            self.cycle(controlword, rpm, **options)

    def enable(self) -> None:
        """Go to Operation enabled by the steps of a master."""
        self.cycles(0.1, DISABLE_VOLTAGE)
        self.cycles(0.05, SHUTDOWN)
        self.cycles(0.05, SWITCH_ON)
        self.cycles(0.1, ENABLE)
