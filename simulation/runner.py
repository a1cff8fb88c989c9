"""Runs a virtual vehicle on a bus: one thread, in real time or in lock-step with its master.

Real time: IMU sets leave on an absolute schedule of the monotonic clock; a vehicle that falls behind catches up set by
set, and beyond `MOST_BEHIND` cycles it skips some. Both are counted and reported.
Lock-step: the set of simulated time t_k leaves with that time in its messages; the vehicle then waits for the SYNC,
which is assumed to come at t_k + 1 ms, and moves on by exactly one period. As long as no SYNC comes (set-up, or a
master that went away), simulated time passes at real-time pace.
"""

from __future__ import annotations

import logging
import random
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import monotonic

import can

from upright.simulation.bus.port import BusPort, PortStatistics, Received
from upright.simulation.config import SimulationConfig
from upright.simulation.faults import Fault
from upright.simulation.physics.load import Action
from upright.simulation.vehicle import SYNC_ID, VirtualVehicle

MOST_BEHIND = 10
"""Cycles that are caught up with; further ones are skipped."""
QUIET = 0.03
"""s without a SYNC after which all answers of a master that has just become cyclic have arrived."""
MASTER_TIMEOUT = 2.0
"""s of waiting for a SYNC after which a lock-step master counts as gone."""
STOP_INTERVAL = 0.1
"""s, longest wait between two checks of the stop event."""
DRAIN_INTERVAL = 250
"""Cycles after which a separate IMU bus, on which nothing is expected, is emptied."""

log = logging.getLogger(__name__)


def nothing() -> Action | None:
    """No load."""
    return None


@dataclass(slots=True)
class RunStatistics:
    """How a run went. A cycle is late when it began more than half a period after its time."""

    cycles: int = 0
    late_cycles: int = 0
    skipped_cycles: int = 0
    syncs: int = 0
    drives: PortStatistics | None = None
    imu: PortStatistics | None = None


def run(
    config: SimulationConfig,
    bus: can.BusABC,
    *,
    imu_bus: can.BusABC | None = None,
    lock_step: bool = False,
    stop: threading.Event | None = None,
    faults: Sequence[Fault] = (),
    load: Callable[[], Action | None] = nothing,
) -> RunStatistics:
    """Run the vehicle until `stop` is set (for ever without one). `imu_bus` None: the IMU is on `bus` too. `load()` is
    asked every cycle what is on the vehicle.

    For lock-step the bus must keep the time of messages (python-can's virtual bus with preserve_timestamps=True).

    Raises:
        UnknownEffectError, SimulationError: `config` cannot be simulated.
    """
    return Runner(config, bus, imu_bus=imu_bus, lock_step=lock_step, stop=stop, faults=faults, load=load).run()


class Runner:
    """One run; `vehicle` and `statistics` may be read while it goes on. `patience`: s of waiting for a SYNC after which
    a lock-step master counts as gone."""

    def __init__(
        self,
        config: SimulationConfig,
        bus: can.BusABC,
        *,
        imu_bus: can.BusABC | None = None,
        lock_step: bool = False,
        stop: threading.Event | None = None,
        faults: Sequence[Fault] = (),
        load: Callable[[], Action | None] = nothing,
        patience: float = MASTER_TIMEOUT,
    ) -> None:
        self.vehicle = VirtualVehicle(config, self._send, faults)
        self._load = load
        self._patience = patience
        self.statistics = RunStatistics()
        self._port = BusPort(bus)
        self._imu_port = BusPort(imu_bus) if imu_bus is not None else self._port
        self.statistics.drives = self._port.statistics
        self.statistics.imu = self._imu_port.statistics
        self._stop = stop or threading.Event()
        self._period = 1.0 / config.rate
        self._step = config.step
        self._steps = config.steps_per_period
        self._lock_step = lock_step
        self._jitter = 0.0 if lock_step else config.imu.send_jitter
        self._random = random.Random(config.seed)
        self._master_is_cyclic = False
        self._began = 0.0
        self._done = 0

    def run(self) -> RunStatistics:
        """Run until stopped."""
        self.vehicle.boot()
        self._began = monotonic()
        self.vehicle.begin_cycle()
        while not self._stop.is_set():
            if self._lock_step and self._master_is_cyclic:
                self._wait_for_sync()
            else:
                self._wait_for_time()
            if self._imu_port is not self._port and self.statistics.cycles % DRAIN_INTERVAL == 0:
                self._imu_port.receive(0.0)
        return self.statistics

    def _send(self, can_id: int, data: bytes, timestamp_ns: int, *, of_imu: bool) -> None:
        (self._imu_port if of_imu else self._port).send(can_id, data, timestamp_ns)

    def _wait_for_time(self) -> None:
        """One control cycle in real time: serve the bus until the next IMU instant."""
        due = self._began + self._period
        late_by = abs(self._random.gauss(0.0, self._jitter)) if self._jitter else 0.0
        now = monotonic()
        while now < due + late_by:
            frames = self._port.receive(due + late_by - now)
            if frames:
                self._serve(frames)
                if self._lock_step and self._master_is_cyclic:
                    self._settle()
                    self._finish_cycle()
                    return
            now = monotonic()
        behind = now - due
        if behind > 0.5 * self._period:
            self.statistics.late_cycles += 1
        if behind > MOST_BEHIND * self._period:
            skipped = int(behind / self._period)
            self.statistics.skipped_cycles += skipped
            log.warning("the virtual vehicle is %.0f ms behind: its time stands still for that long", behind * 1e3)
            due += skipped * self._period
        self._began = due
        self._finish_cycle()

    def _serve(self, frames: Received) -> None:
        for can_id, data in frames:
            if can_id == SYNC_ID:
                self._advance_to(self._sync_step())
                self._note_sync()
            self.vehicle.receive(can_id, data)

    def _sync_step(self) -> int:
        """The step of the cycle at which a SYNC that has just been read arrived."""
        if self._lock_step:
            return self.vehicle.config.steps_per_ms
        return min(self._steps, int((monotonic() - self._began) / self._step))

    def _settle(self) -> None:
        """Let a lock-step master that lags behind answer every set it has received, so that set and answer match."""
        quiet_since = monotonic()
        while monotonic() - quiet_since < QUIET and not self._stop.is_set():
            frames = self._port.receive(QUIET)
            if any(can_id == SYNC_ID for can_id, _ in frames):
                quiet_since = monotonic()
            for can_id, data in frames:
                self.vehicle.receive(can_id, data)

    def _wait_for_sync(self) -> None:
        """One control cycle in lock-step."""
        waited = 0.0
        synced = False
        while not synced:
            frames = self._port.receive(STOP_INTERVAL)
            for can_id, data in frames:
                if can_id == SYNC_ID:
                    synced = True
                    self._advance_to(self._sync_step())
                    self._note_sync()
                self.vehicle.receive(can_id, data)
            if self._stop.is_set():
                return
            waited = 0.0 if frames else waited + STOP_INTERVAL
            if waited >= self._patience:
                self._master_is_cyclic = False
                self._began = monotonic()
                return
        self._finish_cycle()

    def _note_sync(self) -> None:
        self.statistics.syncs += 1
        self._master_is_cyclic = True

    def _advance_to(self, step: int) -> None:
        """Move the mechanics on to this step of the cycle, if they are not there yet."""
        if step > self._done:
            self.vehicle.advance_steps(step - self._done)
            self._done = step

    def _finish_cycle(self) -> None:
        self._advance_to(self._steps)
        self._done = 0
        self.statistics.cycles += 1
        self.vehicle.carry(self._load())
        self.vehicle.begin_cycle()
