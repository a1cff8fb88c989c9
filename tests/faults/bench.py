"""A vehicle under control in lock-step, with places to put faults in and a trace of what really happened.

Frames pass through `received` (from the vehicle) and `sent` (to it), and every control cycle calls `each_cycle`. The
drives are set up by the daemon's own set-up over SDO. The loop's deadline timer runs in simulated time.
"""

from __future__ import annotations

import asyncio
import struct
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import canopen

from upright.drivers.cia301.nmt import NmtCommand, command_frame
from upright.drivers.cia402.setup import DriveReport, Supervision, configure
from upright.drivers.vehicle_io import VehicleIo
from upright.service.control import assembly
from upright.service.control.cycle.loop import deadline
from upright.service.control.cycle.operation import Mode
from upright.service.virtual import run as virtual_run
from upright.service.virtual.passenger import carried
from upright.simulation.bus.drive_node import VirtualDrive
from upright.simulation.bus.power_state import PowerState
from upright.telemetry.errors import UprightError
from upright.telemetry.samples import CanFrame
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import VehicleFile

Received = Callable[[CanFrame], list[CanFrame]]
"""What becomes of a frame from the vehicle: nothing, itself, others."""
Sent = Callable[[int, bytes], list[tuple[int, bytes]]]
"""The same of a frame to the vehicle."""

UNDER_POWER = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE)
MAIN_ROLES = ("gimbal", "wheel")
"""Roles of the drives that hold a vehicle up."""
PAST = 100
"""Cycles of which the IMU's frames and the setpoints are kept."""
ASKED = ("load", "tilt")
"""Events that ask a person for something, and report nothing."""
LOOK_AFTER = 1.0
"""s between two looks of the daemon at its drives."""
TO_DRIVE = 0x600
"""COB-ID of an SDO request, without the node."""


class Moment(NamedTuple):
    """The truth at one control cycle; rad, rad/s, s of simulated time."""

    time: float
    angle: float
    rate: float
    phase: Phase
    mode: Mode
    ending: str
    """Why the run is going to end, "" while it is not."""
    powered: tuple[str, ...]
    """Drives whose power stage moves or holds the axis."""
    frames: int
    """Recorded so far."""
    events: int
    """Reported so far."""


class Timer:
    """The `call_later` of an event loop, in simulated time. `running` makes it the loop that asyncio finds."""

    def __init__(self) -> None:
        self._now = 0.0
        self._due: list[tuple[float, Callable[[], None]]] = []

    def call_later(self, delay: float, callback: Callable[[], None]) -> None:
        self._due.append((self._now + delay, callback))

    @contextmanager
    def running(self) -> Iterator[None]:
        before = asyncio._get_running_loop()
        asyncio._set_running_loop(self)  # type: ignore[arg-type]
        try:
            yield
        finally:
            asyncio._set_running_loop(before)

    def advance(self, seconds: float) -> list[Callable[[], None]]:
        """Let time pass; returns what is due."""
        self._now += seconds
        due = [callback for when, callback in self._due if when <= self._now + 1e-9]
        self._due = [entry for entry in self._due if entry[0] > self._now + 1e-9]
        return due


class SdoNetwork(canopen.Network):
    """canopen's view of the bench's bus: a request is answered before `send_message` returns."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self._bench = bench

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._bench.to_vehicle(can_id, bytes(data))
        self._bench.deliver_answers(self)


class Bench(virtual_run.ClosedLoop):
    """One vehicle under control. `held` keeps frames and timers from the daemon, as a busy machine does."""

    def __init__(self, vehicle: VehicleFile, *, seed: int = 1) -> None:
        self.received: list[Received] = []
        self.sent: list[Sent] = []
        self.each_cycle: list[Callable[[], None]] = []
        self.held = False
        self.trace: list[Moment] = []
        self.watching = False
        self.exceptions: list[str] = []
        self.set_up_error = ""
        """Why the last set-up of the drives was refused."""
        self._reports: dict[str, DriveReport] = {}
        self._timer = Timer()
        self._backlog: list[CanFrame] = []
        self.imu_frames: deque[bytes] = deque(maxlen=3 * PAST)
        """The data of the latest frames that the IMU sent, before any fault."""
        self._look_after_in = LOOK_AFTER
        self.setpoints: deque[tuple[float, ...]] = deque(maxlen=PAST)
        """Of the drives, in the order of the vehicle file, in axis units."""
        self.imu_ids = assembly.imu_config(vehicle).can_ids
        super().__init__(vehicle, seed=seed)
        self.network = SdoNetwork(self)
        self.loop._deadline = deadline(vehicle)  # lock-step has none, the daemon has
        with self._timer.running():
            self.loop.start()
        self.set_up_drives()
        self.advance(0.5)

    # Time

    def advance(self, seconds: float) -> None:
        for _ in range(round(seconds * self.vehicle.control.rate)):
            self._control_cycle()

    def _control_cycle(self) -> None:
        plant, answer = self.plant_side, self.plant_side.config.steps_per_ms
        plant.begin_cycle()
        for action in tuple(self.each_cycle):
            action()
        plant.advance_steps(answer)
        self._wake_up()
        plant.carry(carried(self.loop.asked))
        plant.advance_steps(plant.config.steps_per_period - answer)
        due = self._timer.advance(self.vehicle.period)
        if self.held:
            for callback in due:
                self._timer.call_later(0.0, callback)
        else:
            with self._timer.running():
                for callback in due:
                    self._guarded(callback)
        self.setpoints.append(tuple(drive.setpoint for drive in self.io.drives))
        self._look_after_in -= self.vehicle.period
        if self._look_after_in <= 0.0 and not self.held:
            self._look_after_in = LOOK_AFTER
            self.loop.look_after_drives()
        if self.watching:
            self.trace.append(self._moment())

    def _wake_up(self) -> None:
        while self._inbox:
            frames, self._inbox = self._inbox, []
            if self.held:
                self._backlog += frames
                return
            frames, self._backlog = self._backlog + frames, []
            self._guarded(lambda frames=frames: self.loop.on_frames(frames))  # type: ignore[misc]

    def _guarded(self, action: Callable[[], None]) -> None:
        """An event loop logs what its callbacks raise, and goes on."""
        try:
            action()
        except Exception as error:  # whatever it is, the campaign reports it
            self.exceptions.append(f"{type(error).__name__}: {error}")

    # Frames

    def _from_vehicle(self, can_id: int, data: bytes, timestamp_ns: int, *, of_imu: bool) -> None:
        frames = [CanFrame(timestamp_ns, can_id, bytes(data))]
        if of_imu and can_id in self.imu_ids:
            self.imu_frames.append(bytes(data))
        for change in self.received:
            frames = [after for frame in frames for after in change(frame)]
        self._inbox += frames

    def _to_vehicle(self, can_id: int, data: bytes, timestamp_ns: int) -> None:
        frames = [(can_id, bytes(data))]
        for change in self.sent:
            frames = [after for frame in frames for after in change(*frame)]
        for frame in frames:
            self.to_vehicle(*frame)

    def to_vehicle(self, can_id: int, data: bytes) -> None:
        """A frame that only the vehicle receives."""
        self.plant_side.receive(can_id, data)

    def to_daemon(self, can_id: int, data: bytes, *, error: bool = False, extended: bool = False) -> None:
        """A frame that only the daemon receives."""
        self._inbox.append(CanFrame(self.plant_side.time_ns, can_id, bytes(data), error=error, extended=extended))

    def from_stranger(self, can_id: int, data: bytes) -> None:
        """A frame of another node, which everybody receives."""
        self.to_vehicle(can_id, data)
        self.to_daemon(can_id, data)

    def deliver_answers(self, network: canopen.Network) -> None:
        """Pass the answers that wait in the inbox to canopen; the other frames stay for the loop."""
        waiting, self._inbox = self._inbox, []
        for frame in waiting:
            if frame.can_id & 0x780 == 0x580:
                network.notify(frame.can_id, bytearray(frame.data), frame.timestamp_ns * 1e-9)
            else:
                self._inbox.append(frame)

    # What the daemon does outside the loop

    def set_up_drives(self) -> None:
        """As the daemon does: over SDO, then NMT start. What refuses it is in `set_up_error`."""
        control = self.vehicle.control
        supervision = Supervision(
            master_node=control.master_node,
            heartbeat_period=control.heartbeat_period,
            heartbeat_timeout=control.heartbeat_timeout,
            rpdo_timeout=self.vehicle.setpoint_timeout,
            cycle_period=self.vehicle.period,
        )
        self.set_up_error = ""
        codes = {}
        try:
            for drive in self.io.drives:
                report = configure(self.network, drive.config, supervision, self._reports.get(drive.config.name))
                self._reports[report.name] = report
                self._to_vehicle(*command_frame(NmtCommand.START, drive.config.node), 0)
                codes[report.name] = report.error_code
        except UprightError as error:
            self.set_up_error = str(error)
            self.loop.set_up_failed(str(error))
        else:
            self.loop.set_up_done(codes)

    def reset(self) -> None:
        """As an operator does after a fault: `upright reset`, and the daemon sets up the drives again."""
        self.loop.reset_fault()
        self.set_up_drives()
        self.advance(1.0)

    # Parts of the vehicle

    @property
    def io(self) -> VehicleIo:
        return self.loop.io

    @property
    def truth(self) -> Any:
        """The plant; which it is depends on the kind of vehicle."""
        return self.plant_side.plant

    @property
    def drives(self) -> dict[str, VirtualDrive]:
        return self.plant_side.drives

    @property
    def main(self) -> list[VirtualDrive]:
        """The drives that hold the vehicle up."""
        return self.of_role(*MAIN_ROLES)

    def of_role(self, *roles: str) -> list[VirtualDrive]:
        return [drive for drive in self.drives.values() if drive.config.role in roles]

    @property
    def gyro(self) -> int:
        """Place among the IMU's values of the rate about the axis that the vehicle falls about."""
        return list(self.vehicle.imu.slots).index(f"angular_rate_{'xyz'[self.truth.falling_axis]}")

    @property
    def lateral(self) -> int:
        """Place among the IMU's values of the acceleration that shows how far the vehicle leans."""
        return list(self.vehicle.imu.slots).index(f"acceleration_{'yxz'[self.truth.falling_axis]}")

    def lags(self, drive: VirtualDrive) -> float:
        """s, of a healthy axis behind its setpoint, as the vehicle file says."""
        name = {"gimbal": "speed_loop_lag", "trim": "trim_speed_loop_lag"}.get(drive.config.role)
        return float(getattr(self.vehicle.parameters, name).value) if name else 0.0

    # IMU

    def change_imu(self, change: Callable[[list[float]], list[float] | None]) -> None:
        """Change the values of each IMU set, in g and deg/s; None leaves the set out."""
        ids = self.io.imu.can_ids
        waiting: list[CanFrame] = []

        def through(frame: CanFrame) -> list[CanFrame]:
            if frame.can_id not in ids or len(frame.data) != 8:
                return [frame]
            if frame.can_id == ids[0]:
                waiting.clear()
            waiting.append(frame)
            if frame.can_id != ids[-1] or len(waiting) != len(ids):
                return []
            values = change([value for each in waiting for value in struct.unpack("<2f", each.data)])
            if values is None:
                return []
            return [
                CanFrame(each.timestamp_ns, each.can_id, struct.pack("<2f", *values[2 * place : 2 * place + 2]))
                for place, each in enumerate(waiting)
            ]

        self.received.append(through)

    # Trace

    @property
    def support(self) -> float:
        return float(self.vehicle.support)

    @property
    def leans(self) -> tuple[float, float]:
        """True angle (rad) and rate (rad/s) of the fall."""
        angle, rate, *_ = self.truth.motion()
        return angle, rate

    def _moment(self) -> Moment:
        run, (angle, rate) = self.loop.run, self.leans
        return Moment(
            self.truth.time,
            angle,
            rate,
            run.phase if run is not None else Phase.NONE,
            self.loop.mode,
            (run.end_reason or run.failure) if run is not None else "",
            tuple(name for name, drive in self.drives.items() if drive.state in UNDER_POWER),
            len(self.witness.frames),
            sum(code not in ASKED for _, code, _ in self.witness.events),
        )


def moving(drive: VirtualDrive) -> bool:
    """Whether an axis with a brake moves, or one without turns under power."""
    if drive.config.role in ("gimbal", "trim"):
        return bool(abs(drive.servo.axis.rate) > 0.002)  # type: ignore[attr-defined]
    return drive.state in UNDER_POWER
