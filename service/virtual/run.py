"""Record the virtual vehicle without a bus: control loop and plant exchange every frame directly.

    recording = record("monocab", "multisine", hide=["coulomb_friction"], seed=3)

The same code runs as on a bus: the daemon's control loop with its drivers, roll filter, sequence and safety, with the
virtual vehicle's nodes, in lock-step, some ten times faster than real time. Only the bus and the observer process are
left out. Nothing here reads a clock, so that a seed always gives the same bits.
"""

from __future__ import annotations

import difflib
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

import numpy as np

from upright.drivers.cia301.nmt import NmtCommand, command_frame
from upright.service.control import assembly
from upright.service.control.cycle.loop import ControlLoop
from upright.service.control.cycle.operation import Mode
from upright.service.control.notify import Notifier
from upright.service.virtual import vehicle as virtual_vehicle
from upright.service.virtual.passenger import carried
from upright.simulation.config import SimulationConfig
from upright.simulation.faults import parse_faults
from upright.simulation.vehicle import VirtualVehicle
from upright.telemetry.errors import UprightError
from upright.telemetry.recording import Recording
from upright.telemetry.samples import CanFrame, Frame
from upright.vehicles.experiment.phases import DURATIONS, TIMEOUTS
from upright.vehicles.file import VehicleFile, load

Configure = Callable[[SimulationConfig], SimulationConfig]

BOOT_TIME = 0.2
"""s until the drives answer."""
SETTLING_TIME = 3.0
"""s of SYNCs before the first experiment, until every value is known and the interlocks are released."""
STEP = 0.1
"""s between two checks of the progress of a run."""
MODES_OF_OPERATION = bytes((0x2F, 0x60, 0x60, 0))
"""Start of an SDO download of one byte to 6060h."""


class VirtualRunError(UprightError):
    """A virtual run of `experiment` failed, for `reason`.

    `recording` is the data recorded up to then, None if there are none.
    """

    def __init__(self, experiment: str, reason: str, recording: Recording | None = None, *, remedy: str = "") -> None:
        super().__init__(f"{experiment}: {reason}.", remedy=remedy)
        self.experiment = experiment
        self.reason = reason
        self.recording = recording


@dataclass(slots=True)
class Witness:
    """Replaces the observer process: stores the messages of the loop."""

    ready: bool = True
    obstacle: str = ""
    frames: list[Frame] = field(default_factory=list)
    recordings: list[tuple[str, int]] = field(default_factory=list)
    """Name and start, ns."""
    metadata: list[dict[str, str]] = field(default_factory=list)
    ended: list[tuple[str, int]] = field(default_factory=list)
    """Reason and end, ns."""
    events: list[tuple[str, str, str]] = field(default_factory=list)
    retained: dict[str, dict[str, Any]] = field(default_factory=dict)
    """The newest document of each retained topic."""

    def offer(self, frame: Frame) -> None:
        self.frames.append(frame)

    def start_recording(self, name: str, start_ns: int, metadata: dict[str, str]) -> None:
        self.recordings.append((name, start_ns))
        self.metadata.append(metadata)

    def stop_recording(self, reason: str, end_ns: int) -> None:
        self.ended.append((reason, end_ns))

    def event(self, severity: str, code: str, text: str) -> None:
        self.events.append((severity, code, text))

    def retain(self, topic: str, document: dict[str, Any]) -> None:
        self.retained[topic] = document


class ClosedLoop:
    """One vehicle under control, with its drives set up. `log` gets every exchanged frame, like a bus log.

    Raises:
        UnknownEffectError: a hidden effect does not exist.
        UnknownFaultError: a fault does not exist.
    """

    def __init__(
        self,
        vehicle: VehicleFile,
        *,
        hide: Sequence[str] = (),
        faults: Sequence[str] = (),
        seed: int = 1,
        log: Callable[[CanFrame], None] | None = None,
        unclaimed: Callable[[CanFrame], None] = lambda frame: None,
        configure: Configure = lambda configuration: configuration,
    ) -> None:
        self.vehicle = vehicle
        configuration = configure(virtual_vehicle.configuration(vehicle, list(hide), seed))
        names = [drive.name for drive in configuration.drives]
        self.plant_side = VirtualVehicle(configuration, self._from_vehicle, parse_faults(faults, names))
        self.witness = Witness()
        self._log = log
        self._inbox: list[CanFrame] = []
        self.loop = ControlLoop(
            vehicle,
            send=self._to_vehicle,
            observer=self.witness,
            notifier=Notifier(),
            unclaimed=unclaimed,
            deadline=None,
        )
        self.plant_side.boot()
        self.advance(BOOT_TIME)
        for drive in vehicle.drive:
            self._to_vehicle(0x600 + drive.node, MODES_OF_OPERATION + struct.pack("<i", drive.mode), 0)
            self._to_vehicle(*command_frame(NmtCommand.START, drive.node), 0)
        self.loop.set_up_done()
        self.advance(SETTLING_TIME)

    def advance(self, seconds: float) -> None:
        """Let `seconds` of simulated time pass."""
        plant, on_frames = self.plant_side, self.loop.on_frames
        answer = plant.config.steps_per_ms
        rest = plant.config.steps_per_period - answer
        for _ in range(round(seconds * self.vehicle.control.rate)):
            plant.begin_cycle()
            plant.advance_steps(answer)
            # The frames up to now are one wake-up: the IMU set, then the drives' answers to the SYNC.
            while self._inbox:
                frames, self._inbox = self._inbox, []
                on_frames(frames)
            plant.carry(carried(self.loop.asked))
            plant.advance_steps(rest)

    def until(self, over: Callable[[], bool], limit: float) -> None:
        """Let time pass until `over()`. Raises VirtualRunError after `limit` s."""
        for _ in range(round(limit / STEP)):
            if over():
                return
            self.advance(STEP)
        raise VirtualRunError(self.loop.reason or "virtual run", f"not finished after {limit:g} s: {self.loop.state()}")

    def run(self, name: str, limit: float = 150.0, progress: Callable[[float], None] | None = None) -> None:
        """Run a whole experiment. `progress` gets the share that is done, 0 to 1.

        Raises VirtualRunError if an interlock prevents it, or if it is not finished after `limit` s.
        """
        interlocks = self.loop.obstacles(name)
        if interlocks:
            raise VirtualRunError(name, " ".join(interlocks).rstrip("."))
        run = self.loop.start_experiment(name)

        def over() -> bool:
            if progress is not None:
                progress(1.0 if run.done else run.fraction)
            return self.loop.mode is not Mode.RUNNING

        self.until(over, limit)

    def recording(self, source: str) -> Recording:
        """The last recording, as the recorder would write it. Only after an experiment has ended."""
        (_, start_ns), metadata = self.witness.recordings[-1], self.witness.metadata[-1]
        reason, end_ns = self.witness.ended[-1]
        frames = [frame for frame in self.witness.frames if start_ns <= frame.timestamp_ns <= end_ns]
        channels = assembly.channels(self.vehicle)
        table = np.array([frame.values for frame in frames], dtype=np.float64).T
        return Recording(
            channels=channels,
            timestamp_ns=np.array([frame.timestamp_ns for frame in frames], dtype=np.int64),
            values=dict(zip(channels.names, np.ascontiguousarray(table), strict=True)),
            metadata={**metadata, "start_ns": str(start_ns), "end_reason": reason, "dropped_frames": "0"},
            source=source,
        )

    def _from_vehicle(self, can_id: int, data: bytes, timestamp_ns: int, *, of_imu: bool) -> None:
        frame = CanFrame(timestamp_ns, can_id, bytes(data))
        self._inbox.append(frame)
        if self._log is not None:
            self._log(frame)

    def _to_vehicle(self, can_id: int, data: bytes, timestamp_ns: int) -> None:
        if self._log is not None:
            self._log(CanFrame(timestamp_ns, can_id, data))
        self.plant_side.receive(can_id, data)


def record(
    vehicle: str | VehicleFile = "monocab",
    experiment: str = "multisine",
    *,
    hide: Sequence[str] = (),
    seed: int = 1,
    duration: float | None = None,
    configure: Configure = lambda configuration: configuration,
    progress: Callable[[float], None] | None = None,
) -> Recording:
    """Run an experiment of the vehicle file on the virtual vehicle, from rest to rest, and return its recording.

    `hide` names effects that the virtual vehicle has and the models lack, with their level, as in "input_delay=2", and
    its random torque, as in "disturbance=8,0.3"; by default there is none. `seed` is that of the sensors' noise and of
    the disturbance; the same seed gives the same bits. `duration` (s) replaces that of the experiment. `configure` may
    change the virtual vehicle, for example the noise of its IMU. `progress` gets the share that is done, 0 to 1.

    Raises:
        VehicleFileError: the vehicle file cannot be used.
        UnknownEffectError: there is no such hidden effect.
        ExcitationError: the experiment's signal does not fit into `duration`.
        VirtualRunError: there is no such experiment, or it failed, with the reason.
    """
    file = _with_duration(load(vehicle) if isinstance(vehicle, str) else vehicle, experiment, duration)
    closed = ClosedLoop(file, hide=hide, seed=seed, configure=configure)
    limit = file.experiments[experiment].duration + sum(DURATIONS.values()) + sum(TIMEOUTS.values())
    closed.run(experiment, limit, progress)
    if closed.loop.mode is Mode.FAULT:
        closed.until(lambda: len(closed.witness.ended) == len(closed.witness.recordings), limit=10.0)
    hidden = f" with {', '.join(hide)}" if hide else ""
    recording = closed.recording(f"virtual {file.vehicle.id}{hidden}, {experiment}, seed {seed}")
    if closed.loop.mode is Mode.FAULT or closed.loop.reason:
        raise VirtualRunError(
            experiment,
            closed.loop.reason.rstrip("."),
            recording,
            remedy=f"Try without {', '.join(hide)}, or at a lower level." if hide else "",
        )
    return recording


def _with_duration(vehicle: VehicleFile, experiment: str, duration: float | None) -> VehicleFile:
    """The vehicle with the duration of the experiment changed. Raises VirtualRunError."""
    if experiment not in vehicle.experiments:
        near = difflib.get_close_matches(experiment, vehicle.experiments, n=1)
        raise VirtualRunError(
            experiment,
            f"the vehicle {vehicle.vehicle.id} has no such experiment",
            remedy=f"Did you mean {near[0]!r}?" if near else f"Use one of: {', '.join(vehicle.experiments)}.",
        )
    if duration is None:
        return vehicle
    if not (isfinite(duration) and duration > 0.0):
        raise VirtualRunError(experiment, f"cannot last {duration:g} s", remedy="Give a positive duration, s.")
    section = vehicle.experiments[experiment].model_copy(update={"duration": float(duration)})
    return vehicle.model_copy(update={"experiments": {**vehicle.experiments, experiment: section}})
