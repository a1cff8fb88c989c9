"""The daemon: opens the buses, sets up the drives, runs the control loop, answers the control socket.

It starts disarmed, and after any fault it stays disarmed until a user runs `upright reset`. Everything here is slow and
may block. The real-time part is `service.control.cycle.loop`, which the buses call.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from upright.drivers.bus.bus import Bus, BusDown, BusError, BusGroup
from upright.drivers.bus.lock import BusLock, lock_buses
from upright.drivers.bus.socketcan import start_clock
from upright.drivers.canopen_link import CanopenLink
from upright.drivers.cia301.nmt import NmtCommand, command_frame
from upright.drivers.cia402.config import DriveConfig
from upright.drivers.cia402.setup import DriveReport, Supervision, configure
from upright.drivers.imu.format import check_format
from upright.service.control import assembly, realtime
from upright.service.control.clients.commands import Commands
from upright.service.control.clients.mqtt_replies import MqttReplies
from upright.service.control.clients.server import ApiServer
from upright.service.control.cycle.loop import ControlLoop, deadline
from upright.service.control.cycle.operation import QUICK_STOP_TIME, Mode
from upright.service.control.cycle.readiness import drive_states
from upright.service.control.health import HealthReports
from upright.service.control.notify import Notifier
from upright.service.observer.client import ObserverClient
from upright.service.turns import Turns
from upright.telemetry.errors import UprightError
from upright.telemetry.samples import CanFrame
from upright.vehicles.file import VehicleFile

RECONNECT_PERIOD = 0.5
"""s between attempts to reopen a bus that went down, or to set up drives that did not answer."""

LISTENING = 1.0
"""s of bus traffic from which the format of the IMU is checked."""

ORDERLY_END = 20.0
"""Time limit, s, for an experiment to lower the vehicle when the daemon shall end."""


STATUS_AGE = 0.1
"""s that a status is given again while the state does not change: many may ask."""

CONFIRMATION = 3.0
"""Time limit, s, for the drives to confirm that they are off; without this process they stop by their watchdogs."""


@dataclass(frozen=True, slots=True)
class Places:
    """The daemon's interfaces: one or two bus addresses, the folder of the recordings, the control socket, and ports of
    this computer for metrics and for Foxglove (0: none)."""

    drives_bus: str
    imu_bus: str
    data: Path
    socket: Path
    metrics_port: int = 0
    foxglove_port: int = 0


class Daemon:
    """One vehicle, served until `stop()`.

    `lock_step` is for a simulated bus whose time is not the wall clock's: there is no wall-clock deadline then.
    If it is `alone` in its process, garbage collection and memory of the process are set up for it
    (`service.control.realtime`).
    """

    def __init__(self, vehicle: VehicleFile, places: Places, *, lock_step: bool = False, alone: bool = False) -> None:
        self.vehicle = vehicle
        self.places = places
        self._lock_step = lock_step
        self._alone = alone
        self._log = logging.getLogger(__name__)
        self._notifier = Notifier.from_environment()
        self._stopping = asyncio.Event()
        self._bus_down = asyncio.Event()
        self._buses: BusGroup | None = None
        self._link: CanopenLink | None = None
        self.reports: list[DriveReport] = []
        self._published: dict[str, Any] = {}
        self._last_status: dict[str, Any] = {}
        self._status_until = 0.0
        self._clock = start_clock()
        self._clock_steps = 0
        ports = (places.metrics_port, places.foxglove_port)
        hello = assembly.observer_hello(vehicle, places.data, self._raw_log_buses(), *ports)
        hello["clock_base_ns"] = self._clock.base_ns
        self._turns = Turns()
        self.observer = ObserverClient(hello, lossless=lock_step, turns=self._turns)
        self.loop = ControlLoop(
            vehicle,
            send=self._send,
            observer=self.observer,
            notifier=self._notifier,
            unclaimed=self._on_unclaimed_frame,
            deadline=None if lock_step else deadline(vehicle),
        )
        self.commands = Commands(vehicle, self.loop, self.observer, self.status, places.data)
        self._replies = MqttReplies(self.commands, self.observer.reply)
        self.observer.on_command = self._replies.take
        self._health = HealthReports(vehicle)
        self._api = ApiServer(places.socket, self.commands.answer, self.commands.sign, self._turns)

    def stop(self) -> None:
        """End in order: a running experiment first lowers the vehicle."""
        self._stopping.set()

    async def run(self) -> None:
        """Serve until stopped.

        Raises:
            BusError: a bus could not be opened at the start, or another daemon serves it.
            ApiError: the control socket could not be opened.
        """
        locks = lock_buses((self.places.drives_bus, self.places.imu_bus))
        try:
            await self._serve(locks)
        finally:
            for lock in locks:
                lock.close()

    async def _serve(self, locks: list[BusLock]) -> None:
        self._open_buses()
        for lock in locks:
            lock.start()
        self.observer.on_exit = self._on_observer_exit
        self.observer.on_obstacle = lambda text: self.loop.end_experiment(text.rstrip("."), "recording")
        self.loop.on_change = self._publish_state
        try:
            await self.observer.start()
            self._publish_state()
            await self._api.start()
            self.loop.start()
            self._settle()
            keeper = asyncio.create_task(self._keep_vehicle_ready(), name="keep vehicle ready")
            self._notifier.ready(f"serving {self.vehicle.vehicle.id} on {self.places.drives_bus}, disarmed")
            stopping = asyncio.create_task(self._stopping.wait(), name="wait for stop")
            await asyncio.wait({keeper, stopping}, return_when=asyncio.FIRST_COMPLETED)
            self._notifier.stopping("ending in order")
            await self._end_in_order()
            keeper.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await keeper  # Raises its exception, if it failed, now that the vehicle is down.
        finally:
            await self._api.close()
            await self.observer.stop()
            self._close_buses()

    # Buses and drives

    def _open_buses(self) -> None:
        vehicle, places = self.vehicle, self.places
        one_bus = places.imu_bus == places.drives_bus
        bitrate, clock = vehicle.bus.bitrate, self._clock
        drives = Bus.open(places.drives_bus, index=0, bitrate=bitrate, clock=clock)
        try:
            buses = [drives] if one_bus else [drives, Bus.open(places.imu_bus, index=1, bitrate=bitrate, clock=clock)]
        except BusError:
            drives.close()
            raise
        if not self._raw_log_buses():
            for bus in buses:
                bus.tap = self.observer.offer_can
        self._link = CanopenLink(drives)
        self._buses = BusGroup(buses)
        self._buses.start(self._on_frames, self._on_bus_down)

    def _close_buses(self) -> None:
        if self._link is not None:
            self._link.close()
            self._link = None
        if self._buses is not None:
            self._buses.close()
            self._buses = None

    def _on_frames(self, frames: list[CanFrame]) -> None:
        """The loop's work on the frames of one wake-up, and how long it took; then the clients have their turns."""
        loop, began_ns = self.loop, time.monotonic_ns()
        cycles = loop.cycles
        loop.on_frames(frames)
        if loop.cycles != cycles:
            ended_ns = time.monotonic_ns()
            loop.timing.processing.add((ended_ns - began_ns) * 1e-9)
            if not self._lock_step:
                loop.sent((ended_ns + self._clock.base_ns - loop.last_ns) * 1e-9)
            self._turns.take()

    def _send(self, can_id: int, data: bytes, timestamp_ns: int) -> None:
        if self._buses is not None:
            self._buses.send(0, can_id, data, timestamp_ns)

    def _on_unclaimed_frame(self, frame: CanFrame) -> None:
        if self._link is not None and frame.bus == 0:
            self._link.handle(frame)

    def _on_bus_down(self, down: BusDown) -> None:
        self.loop.bus_down(down)
        self._bus_down.set()

    def _raw_log_buses(self) -> list[str]:
        """Buses that a separate process can log through a second socket."""
        addresses = dict.fromkeys((self.places.drives_bus, self.places.imu_bus))
        return [address for address in addresses if address.startswith("socketcan:")]

    async def _keep_vehicle_ready(self) -> None:
        """Set up the drives, and repeat it whenever a bus has come back or a drive has restarted."""
        while True:
            if self._bus_down.is_set():
                await self._reopen_buses()
            if not self.observer.complete:
                await self.observer.restart()
            if self.loop.needs_set_up and not self.loop.cut_off:
                try:
                    await self._check_imu()
                    await self._set_up_drives()
                except UprightError as error:
                    self.loop.set_up_failed(str(error))
                except Exception as error:  # what a node answers must not end the daemon
                    self._log.exception("the set-up failed")
                    self.loop.set_up_failed(f"internal error: {type(error).__name__}: {error}; the log has more")
                else:
                    self.loop.set_up_done({report.name: report.error_code for report in self.reports})
            self.loop.look_after_drives()
            self._report_clock()
            self._publish_state()
            self._publish_health()
            self._collect_garbage()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._bus_down.wait(), RECONNECT_PERIOD)

    async def _reopen_buses(self) -> None:
        self._close_buses()
        while True:
            self._bus_down.clear()
            try:
                self._open_buses()
            except BusError as error:
                self.loop.set_up_failed(str(error))
                self._collect_garbage()
                await asyncio.sleep(RECONNECT_PERIOD)
            else:
                return

    async def _check_imu(self) -> None:
        """Check the frames of the IMU while the vehicle is at rest. Raises ImuFormatError."""
        heard: list[CanFrame] = []
        self.loop.heard = heard
        await asyncio.sleep(LISTENING)
        self.loop.heard = None
        place = 0 if self.places.imu_bus == self.places.drives_bus else 1
        check_format(self.loop.io.imu.config, [frame for frame in heard if frame.bus == place])

    async def _set_up_drives(self) -> None:
        link, control = self._link, self.vehicle.control
        if link is None:
            raise BusError("the bus is down.", bus=self.places.drives_bus)
        supervision = Supervision(
            master_node=control.master_node,
            heartbeat_period=control.heartbeat_period,
            heartbeat_timeout=control.heartbeat_timeout,
            rpdo_timeout=self.vehicle.setpoint_timeout,
            cycle_period=self.vehicle.period,
        )
        before = {report.name: report for report in self.reports}

        async def set_up(config: DriveConfig) -> DriveReport:
            report = await asyncio.to_thread(configure, link.network, config, supervision, before.get(config.name))
            self._send(*command_frame(NmtCommand.START, config.node), 0)
            for warning in report.warnings:
                self.observer.event("warning", "drive_set_up", f"{report.name}: {warning}")
            return report

        # Side by side, as a slow drive needs seconds; of those that fail the first one is named, when all have ended.
        found = await asyncio.gather(*[set_up(drive.config) for drive in self.loop.io.drives], return_exceptions=True)
        for failure in found:
            if isinstance(failure, BaseException):
                raise failure
        self.reports = [report for report in found if isinstance(report, DriveReport)]

    def _settle(self) -> None:
        """Set up this process for its loop, if it has no other work. Refused memory is an event, not a failure."""
        trouble = realtime.settle(lock=not self._lock_step) if self._alone else ""
        if trouble:
            self._log.warning("%s", trouble)
            self.observer.event("warning", "memory_not_locked", trouble)

    def _collect_garbage(self) -> None:
        """Between two cycles, since nothing else does."""
        if self._alone:
            realtime.collect(running=self.loop.mode is Mode.RUNNING)

    def _report_clock(self) -> None:
        if self._clock.steps != self._clock_steps:
            self._clock_steps = self._clock.steps
            step = self._clock.last_step_ns * 1e-9
            text = f"the computer's clock was set by {step:+.3f} s: the time of the data goes on as before"
            self.observer.event("warning", "clock_step", text)

    def _on_observer_exit(self, status: int) -> None:
        text = f"the observer process ended with status {status}, and is started again"
        self._log.error("%s", text, extra={"fields": {"UPRIGHT_CODE": "observer"}})
        self.loop.observer_gone()

    def _publish_state(self) -> None:
        """Send a changed state to the observer, which publishes it by MQTT."""
        self._status_until = 0.0
        lease = self.commands.lease
        held = lease.holder if lease is not None and self.loop.mode is Mode.RUNNING else None
        state = {**self.loop.state(), "held_by": held, "commands": self.vehicle.mqtt.commands}
        if state != self._published:
            self._published = state
            self.observer.retain("state", state)
            self._notifier.status(f"{self.loop.mode}: {self.loop.reason or self.loop.code}".replace("\n", " "))

    def _publish_health(self) -> None:
        """Send the health of this process to the observer."""
        buses = self._buses.statistics() if self._buses is not None else []
        report = self._health.report(time.monotonic(), self.loop.cycles, self.loop.missed_cycles, buses)
        self.observer.health({**report, "nearest_limit": self.loop.nearest_limit()})
        if self.places.metrics_port:
            self.observer.figures(self._figures(buses))

    def _figures(self, buses: list[dict[str, Any]]) -> dict[str, Any]:
        """What `service.observer.viewers.metrics` makes its text of."""
        return {
            "modes": list(Mode),
            "mode": self.loop.mode,
            "cycles": self.loop.cycles,
            "missed_cycles": self.loop.missed_cycles,
            "clock_steps": self._clock.steps,
            "observer_dropped": self.observer.statistics()["frames_dropped"],
            "buses": buses,
            "timing": self.loop.timing.to_json(),
        }

    async def _end_in_order(self) -> None:
        self.loop.end_experiment("the daemon is being stopped")
        limit = time.monotonic() + ORDERLY_END
        while self.loop.mode is Mode.RUNNING and time.monotonic() < limit:
            await asyncio.sleep(0.02)
        if self.loop.mode is Mode.RUNNING:
            self.loop.stop_now("the daemon is being stopped, and the vehicle was not down in time")
            await asyncio.sleep(QUICK_STOP_TIME)
        limit = time.monotonic() + CONFIRMATION
        while self.loop.stopping and time.monotonic() < limit:
            await asyncio.sleep(0.02)

    def status(self) -> dict[str, Any]:
        """The document of `upright status --json`, the same one as before for STATUS_AGE or until the state changes."""
        now = time.monotonic()
        if now >= self._status_until:
            self._last_status, self._status_until = self._status(), now + STATUS_AGE
        return self._last_status

    def _status(self) -> dict[str, Any]:
        buses = self._buses.statistics() if self._buses is not None else []
        return {
            **self.loop.state(),
            "buses": buses,
            "drives": drive_states(self.loop.io),
            "drive_reports": [{**asdict(report), "state": report.state.value} for report in self.reports],
            "cycles": self.loop.cycles,
            "missed_cycles": self.loop.missed_cycles,
            "nearest_limit": self.loop.nearest_limit(),
            "timing": self.loop.timing.to_json(),
            "clock": self._clock.status(),
            "foreign": self.loop.foreign.statistics() + self.loop.bus_watch.statistics(),
            "observer": self.observer.statistics(),
            "estimates": self.observer.estimates,
            "diagnosis": self.observer.diagnosis,
            "clients": self._api.statistics(),
            "lease": self.commands.held(),
            "design": self.commands.adopted.to_json(),
            "socket": str(self.places.socket),
            "data": str(self.places.data),
        }
