"""The virtual vehicle in simulated time: mechanics, drives and IMU wired together, without a bus and without a clock.

A control cycle is  begin_cycle() at t_k: the IMU set leaves;  receive(...) of what the master sends, the SYNC last;
advance_steps(...) to t_k+1. `simulation.runner` paces this by a bus. Frames leave through `send`, with their time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from upright.simulation.bus.drive_node import VirtualDrive
from upright.simulation.bus.imu_node import VirtualImu
from upright.simulation.bus.machine import Machine
from upright.simulation.bus.object_dictionary import SimulationError
from upright.simulation.bus.speed_reports import SpeedReports
from upright.simulation.config import DriveNode, SimulationConfig
from upright.simulation.faults import FAULTS, Fault
from upright.simulation.kinds import machine
from upright.simulation.physics.load import Action

SYNC_ID = 0x080
START_NS = 1_000_000_000_000
"""Simulated time at the start, ns: at 1000 s a float of seconds still resolves a nanosecond."""
IMU_HEARTBEAT = 1.0
"""s between heartbeats of the IMU."""
OPERATIONAL = b"\x05"


class SendFrame(Protocol):
    """Sends a frame on the bus of the drives, or on that of the IMU."""

    def __call__(self, can_id: int, data: bytes, timestamp_ns: int, *, of_imu: bool) -> None: ...


class ImuStream:
    """The frame sets that the IMU sends, with the faults that it can have."""

    def __init__(self, imu: VirtualImu, plant: Machine) -> None:
        self.imu = imu
        self.silent = False
        self.stuck = False
        self.wrong_format = False
        self.short = False
        self.incomplete = False
        self._plant = plant
        self._payloads: list[bytes] = []
        self._heartbeat_due = 0.0

    def recover(self) -> None:
        """End a silence."""
        self.silent = False

    def frames(self) -> list[tuple[int, bytes]]:
        """The frames that the IMU sends now: a set, and its heartbeat when that is due."""
        measured = self.imu.measure(self._plant)
        if self.silent:
            return []
        if not (self.stuck and self._payloads):
            other = "float32" if self.imu.config.precision == "int16" else "int16"
            self._payloads = self.imu.encode(*measured, precision=other if self.wrong_format else None)
        payloads = self._payloads[:-1] if self.incomplete else self._payloads
        frames = [(self.imu.can_id(i), data[:-1] if self.short else data) for i, data in enumerate(payloads)]
        heartbeat_id = self.imu.heartbeat_id
        if heartbeat_id is not None and self._plant.time >= self._heartbeat_due:
            self._heartbeat_due = self._plant.time + IMU_HEARTBEAT
            frames.append((heartbeat_id, OPERATIONAL))
        return frames


class VirtualVehicle:
    """The vehicle that `config` describes, at rest.

    Raises:
        UnknownEffectError: a hidden effect that does not exist.
        SimulationError: drives that such a vehicle does not have, or an EDS that cannot be used.
    """

    def __init__(self, config: SimulationConfig, send: SendFrame, faults: Sequence[Fault] = ()) -> None:
        self.config = config
        self.plant = machine(config)
        self.imu = VirtualImu(
            config.imu,
            rate=config.rate,
            seed=config.seed,
            gravity=config.plant.gravity,
            sizes=config.sizes,
            falling_axis=self.plant.falling_axis,
        )
        self.imu_stream = ImuStream(self.imu, self.plant)
        if config.speeds and len(config.speeds) != len(self.plant.speeds):
            raise SimulationError(
                f"{len(config.speeds)} flywheels report their speed, and {self.plant.name} has"
                f" {len(self.plant.speeds)}.",
                remedy="Give a [[flywheel]] section for each of them, or for none.",
            )
        self.speed_reports = SpeedReports(config.speeds)
        self.synchronised = False
        """A SYNC has been seen."""
        self._send = send
        self._check_drives(config.drives)
        self.drives: dict[str, VirtualDrive] = {}
        for node in config.drives:
            number = sum(drive.config.role == node.role for drive in self.drives.values())
            application = self.plant.application(node, number)
            self.drives[node.name] = VirtualDrive(node, application, self._send_from_drive, lambda: self.plant.time)
        self._drives = tuple(self.drives.values())
        self._faults = list(faults)
        self._agenda: list[tuple[float, Callable[[], None]]] = []
        self._load: Action | None = None

    @property
    def time_ns(self) -> int:
        """Simulated time, ns."""
        return START_NS + self.plant.steps * 1_000_000 // self.config.steps_per_ms

    def boot(self) -> None:
        """Switch everything on."""
        for drive in self._drives:
            drive.boot()
        self._start_faults(lambda fault: fault.seconds == 0.0)

    def begin_cycle(self) -> None:
        """At an IMU instant: update the nodes' timers, then send the IMU's set."""
        now = self.plant.time
        if self._faults and self.synchronised:
            self._start_faults(lambda fault: self.plant.event_clock >= fault.seconds)
        if self._agenda:
            due = [action for when, action in self._agenda if now >= when]
            self._agenda = [entry for entry in self._agenda if now < entry[0]]
            for action in due:
                action()
        for drive in self._drives:
            drive.tick()
        timestamp_ns = self.time_ns
        for can_id, data in self.speed_reports.frames(now, self.plant.speeds):
            self._send(can_id, data, timestamp_ns, of_imu=False)
        for can_id, data in self.imu_stream.frames():
            self._send(can_id, data, timestamp_ns, of_imu=True)

    def receive(self, can_id: int, data: bytes) -> bool:
        """Take a frame from the bus of the drives; returns whether it was the SYNC."""
        is_sync = can_id == SYNC_ID
        if is_sync and not self.synchronised:
            self.synchronised = True
            self.plant.event_origin = self.plant.time
            self.plant.restart_disturbance()
            self.imu.reseed()
        for drive in self._drives:
            drive.receive(can_id, data)
        return is_sync

    def advance_steps(self, steps: int) -> None:
        """Advance the mechanics."""
        self.plant.advance(steps)

    def carry(self, load: Action | None) -> None:
        """Undergo `load` from now on, or nothing."""
        if load != self._load:
            self._load = load
            self.plant.undergo(load)

    def later(self, delay: float, action: Callable[[], None]) -> None:
        """Run `action` `delay` s from now, at the next control cycle then."""
        self._agenda.append((self.plant.time + delay, action))

    def _start_faults(self, due: Callable[[Fault], bool]) -> None:
        for fault in [fault for fault in self._faults if due(fault)]:
            self._faults.remove(fault)
            FAULTS[fault.name].inject(self, fault.drive or "")

    def _send_from_drive(self, can_id: int, data: bytes) -> None:
        self._send(can_id, data, self.time_ns, of_imu=False)

    def _check_drives(self, nodes: Sequence[DriveNode]) -> None:
        for role in sorted({node.role for node in nodes}):
            found, count = sum(node.role == role for node in nodes), self.plant.roles.get(role, 0)
            if found > count:
                raise SimulationError(
                    f"the vehicle has {found} {role} drives, {self.plant.name} has {count}.",
                    remedy="Correct the roles in the vehicle file.",
                )
        for key in ("name", "node"):
            values = [getattr(node, key) for node in nodes]
            if len(set(values)) != len(values):
                raise SimulationError(
                    f"two drives have the same {key} among {', '.join(map(str, values))}.",
                    remedy="Give each drive its own in the vehicle file.",
                )
