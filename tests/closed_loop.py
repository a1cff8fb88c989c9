"""The control loop and the virtual vehicle without a bus between them: every frame is handed over at once.

Fast and deterministic, for tests of what the loop decides. The same two meet on real buses in the other tests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from drivers.bus import BusDown
from drivers.cia402.nmt import NmtCommand, command_frame
from service import virtual_vehicle
from service.control_loop import ControlLoop, Mode
from service.notify import Notifier
from service.vehicle_file import VehicleFile, load
from simulation.faults import parse_faults
from simulation.vehicle import VirtualVehicle
from telemetry.samples import CanFrame, Frame


@dataclass
class Witness:
    """Stands where the observer process is: keeps what the loop tells it."""

    ready: bool = True
    frames: list[Frame] = field(default_factory=list)
    recordings: list[tuple[str, int]] = field(default_factory=list)
    ended: list[tuple[str, int]] = field(default_factory=list)
    events: list[tuple[str, str, str]] = field(default_factory=list)

    def offer(self, frame: Frame) -> None:
        self.frames.append(frame)

    def start_recording(self, name: str, start_ns: int, metadata: dict[str, str]) -> None:
        self.recordings.append((name, start_ns))

    def stop_recording(self, reason: str, end_ns: int) -> None:
        self.ended.append((reason, end_ns))

    def event(self, severity: str, code: str, text: str) -> None:
        self.events.append((severity, code, text))


class ClosedLoop:
    """One vehicle under control. `raw` holds every frame that was exchanged, as a bus log would."""

    def __init__(
        self, vehicle: VehicleFile | None = None, *, hide: Sequence[str] = (), faults: Sequence[str] = (), seed: int = 1
    ) -> None:
        self.vehicle = vehicle if vehicle is not None else load("monocab")
        configuration = virtual_vehicle.configuration(self.vehicle, list(hide), seed)
        names = [drive.name for drive in configuration.drives]
        self.plant_side = VirtualVehicle(configuration, self._from_vehicle, parse_faults(faults, names))
        self.witness = Witness()
        self.unclaimed: list[CanFrame] = []
        self.raw: list[CanFrame] = []
        self.late = False
        """While set, what the loop sends does not arrive."""
        self._inbox: list[CanFrame] = []
        self.loop = ControlLoop(
            self.vehicle,
            send=self._to_vehicle,
            observer=self.witness,
            notifier=Notifier(),
            unclaimed=self.unclaimed.append,
            deadline=None,
        )
        self.plant_side.boot()
        self.advance(0.2)
        for drive in self.vehicle.drive:
            self._to_vehicle(0x600 + drive.node, bytes((0x2F, 0x60, 0x60, 0, drive.mode, 0, 0, 0)), 0)  # SDO: 6060h
            self._to_vehicle(*command_frame(NmtCommand.START, drive.node), 0)
        self.loop.set_up_done()
        self.advance(3.0)

    def advance(self, seconds: float) -> None:
        """Let `seconds` of simulated time pass."""
        for _ in range(round(seconds * self.vehicle.control.rate)):
            self.plant_side.begin_cycle()
            self.plant_side.advance_steps(self.plant_side.config.steps_per_ms)
            # What arrived up to now is one wake-up: the IMU set, then the drives' answers to the SYNC.
            while self._inbox:
                frames, self._inbox = self._inbox, []
                self.loop.on_frames(frames)
            self.plant_side.advance_steps(self.plant_side.config.steps_per_period - self.plant_side.config.steps_per_ms)

    def until(self, over: Callable[[], bool], limit: float) -> None:
        """Let time pass until `over()`; AssertionError after `limit` s."""
        for _ in range(round(limit / 0.1)):
            if over():
                return
            self.advance(0.1)
        raise AssertionError(f"not over after {limit} s: {self.loop.state()}")

    def run(self, name: str, limit: float = 150.0) -> None:
        """A whole experiment."""
        assert self.loop.interlocks() == []
        self.loop.start_experiment(name)
        self.until(lambda: self.loop.mode is not Mode.RUNNING, limit)

    def lose_bus(self) -> None:
        self.loop.bus_down(BusDown("test bus", "the interface went down"))

    def _from_vehicle(self, can_id: int, data: bytes, timestamp_ns: int, *, of_imu: bool) -> None:
        frame = CanFrame(timestamp_ns, can_id, bytes(data))
        self._inbox.append(frame)
        self.raw.append(frame)

    def _to_vehicle(self, can_id: int, data: bytes, timestamp_ns: int) -> None:
        if not self.late:
            self.raw.append(CanFrame(timestamp_ns, can_id, data))
            self.plant_side.receive(can_id, data)
