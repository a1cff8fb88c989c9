"""The operation of a vehicle: the mode that it is in, the experiment that runs, and what can be asked of it.

The daemon and its clients come in here; no sample does (`cycle.loop`). Nothing here waits or reads a clock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol

from upright.drivers.bus.bus import BusDown
from upright.drivers.cia301.emergency import of_communication
from upright.drivers.cia402.drive import Drive
from upright.drivers.foreign import ForeignTraffic
from upright.drivers.vehicle_io import VehicleIo
from upright.service.control import assembly
from upright.service.control.cycle.readiness import interlocks, strangers
from upright.service.control.cycle.sequence import ExperimentRun, plan
from upright.service.control.cycle.stop_check import CYCLES, StopCheck
from upright.telemetry.errors import UprightError
from upright.telemetry.samples import Frame
from upright.vehicles import registry
from upright.vehicles.contract import Kind, Lean, Measurement, Pilot
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.sections import ASKED, Asked, VehicleFile

RECORDING_LEAD_NS = 200_000_000
"""Time from the command to record to the first recorded frame: the raw log needs it to open its file."""

NEVER_NS = 1 << 62

AFTERMATH = 2.0
"""s that a recording continues after a quick stop, to show the final state."""

QUICK_STOP_TIME = 1.0
"""s of quick stop before the drives are disabled."""


class Mode(StrEnum):
    """State of the daemon."""

    STARTING = "starting"
    DISARMED = "disarmed"
    RUNNING = "running"
    FAULT = "fault"


@dataclass(slots=True)
class Fault:
    """The latched fault. What is found out about it later, as that a drive is still enabled, is put in front."""

    code: str
    text: str


class Observer(Protocol):
    """The interface of the loop to the observer process; no call waits."""

    @property
    def ready(self) -> bool: ...
    @property
    def obstacle(self) -> str: ...
    def offer(self, frame: Frame) -> None: ...
    def start_recording(self, name: str, start_ns: int, metadata: dict[str, str]) -> None: ...
    def stop_recording(self, reason: str, end_ns: int) -> None: ...
    def event(self, severity: str, code: str, text: str) -> None: ...


class Operation:
    """Holds the vehicle's state between cycles, and changes it as it is asked to.

    `on_change` is called after each change of what `state` shows.
    """

    def __init__(self, vehicle: VehicleFile, observer: Observer) -> None:
        self.vehicle = vehicle
        self.io: VehicleIo = assembly.vehicle_io(vehicle)
        self.foreign = ForeignTraffic(self.io.drives, vehicle.control.master_node)
        """What somebody else sends with the ids of this service."""
        self.cut_off = False
        """Whether the drives have been taken out of operation, until the next reset: somebody else commands them."""
        self.kind: Kind[Any] = registry.kind_of(vehicle, self.io)
        self.mode = Mode.STARTING
        self.code = "starting"
        self.reason = "setting up the drives"
        self.since_ns = 0
        self.needs_set_up = True
        self.fault: Fault | None = None
        """The last fault; latched while the mode is FAULT."""
        self.run: ExperimentRun | None = None
        self.lean: Lean | None = None
        self.drives: Measurement = self.kind.measure()
        self.on_change: Callable[[], None] = lambda: None
        self._observer = observer
        self._pilot = self.kind.pilot()
        self._phase = Phase.NONE
        self._asked: Asked | None = None
        self._end_code = ""
        self._to_acknowledge: set[Drive] = set()
        self._reset_at_ns = NEVER_NS
        self._recording = False
        self._aftermath = 0.0
        self._quick_stop_left = 0.0
        self._last_ns = 0
        self._silence = 0.0
        self._failure_logged = False
        """Whether the exception of a cycle is in the log, since the last reset."""
        self._stop_check = StopCheck(
            self.io.drives,
            period=vehicle.period,
            timeout=vehicle.control.heartbeat_timeout + CYCLES * vehicle.period,
        )

    # Experiments

    def start_experiment(self, name: str, client: str = "") -> ExperimentRun:
        """Start an experiment and its recording, which names `client`. Only without `obstacles(name)`."""
        self.foreign.forget()
        self._end_code = "done"
        run = self.run = ExperimentRun(name, plan(self.vehicle, name, self._pilot, self.kind.angle))
        self._phase = run.phase
        self.kind.watch.reset()
        self._reset_at_ns = self._last_ns + RECORDING_LEAD_NS
        if self._recording:
            self._end_recording()
        self._recording = True
        metadata = assembly.recording_metadata(self.vehicle, name) | ({"started_by": client} if client else {})
        self._observer.start_recording(name, self._reset_at_ns, metadata)
        if client:
            self._observer.event("info", "started", f"{client} started {name}")
        self._enter(Mode.RUNNING, "running", f"experiment {name}")
        return run

    def end_experiment(self, reason: str, code: str = "end") -> None:
        """End the running experiment in order: the vehicle is lowered onto a support."""
        if self.run is not None and not self.run.end_reason:
            self.run.end(reason)
            self._end_code = code
            self._observer.event("warning", code, reason)

    def stop_now(self, reason: str, code: str = "operator") -> None:
        """Quick stop: the drives brake, then are disabled; the vehicle falls onto its supports. Latches a fault."""
        self._quick_stop_left = QUICK_STOP_TIME
        self._aftermath = AFTERMATH
        self._stop_check.begin(self._last_ns, QUICK_STOP_TIME)
        self.fault = Fault(code, reason)
        self._finish_run(Mode.FAULT, code, reason)
        self._observer.event("error", code, reason)

    @property
    def last_ns(self) -> int:
        """Time of the latest sample."""
        return self._last_ns

    @property
    def _now_ns(self) -> int:
        """Time of the latest sample, and what has passed since then without one."""
        return self._last_ns + round(self._silence * 1e9)

    @property
    def asked(self) -> Asked | None:
        """What a person has been asked to do to the vehicle."""
        return self._asked

    @property
    def stopping(self) -> bool:
        """Whether the drives still have to confirm that they are off."""
        return not self._stop_check.over

    # What prevents an experiment

    def obstacles(self, name: str) -> list[str]:
        """The reasons that prevent the experiment of this name: the interlocks, or what keeps the vehicle down."""
        return self.interlocks() or (self.stays_down() if self.vehicle.experiments[name].gets_up else [])

    def stays_down(self) -> list[str]:
        """The reasons that prevent an experiment in which the vehicle gets up, where others can be started."""
        return self.kind.obstacles(self.drives) if self.mode is Mode.DISARMED else []

    def interlocks(self) -> list[str]:
        """The reasons that prevent every experiment, as sentences; empty if there are none."""
        match self.mode:
            case Mode.RUNNING:
                return [f"{self.reason} is running."]
            case Mode.FAULT:
                return [f"A fault is latched: {self.reason}. Remove its cause, then run `upright reset`."]
            case Mode.STARTING:
                return [f"Not ready: {self.reason}."]
            case Mode.DISARMED if self._stop_check.withheld:
                return ["The drives are being stopped by a missing heartbeat: one has not confirmed that it is off."]
            case Mode.DISARMED if self.needs_set_up:
                return ["The drives are being set up."]
            case Mode.DISARMED if not self._observer.ready:
                return ["The observer process is not ready: nothing would be recorded."]
            case Mode.DISARMED if self._observer.obstacle:
                return [self._observer.obstacle]
            case Mode.DISARMED:
                return strangers(self.foreign, self._now_ns) + interlocks(
                    self.vehicle, self.kind, self.io, self.lean, self.drives, self._last_ns, self._silence
                )

    # Controllers

    def designed(self, vehicle: VehicleFile) -> Pilot[Any]:
        """The pilot with the controllers of `vehicle`, which differs from this one in its parameters only. It takes a
        tenth of a second, and may run in another thread.

        Raises ControlDesignError if there is no controller for an experiment that has one now.
        """
        pilot = registry.kind_of(vehicle, self.io).pilot()
        for name in vehicle.experiments:
            if self._can_run(name):
                plan(vehicle, name, pilot, self.kind.angle)
        return pilot

    def _can_run(self, name: str) -> bool:
        try:
            plan(self.vehicle, name, self._pilot, self.kind.angle)
        except UprightError:
            return False
        return True

    def adopt(self, vehicle: VehicleFile, pilot: Pilot[Any]) -> str:
        """Use the `pilot` of `vehicle` from the next experiment on. Returns the reason if refused, or ""."""
        if self.mode is Mode.RUNNING:
            return f"{self.reason} is running; `upright stop` ends it."
        self.vehicle, self._pilot = vehicle, pilot
        return ""

    # Drives, buses and the observer

    def reset_fault(self) -> str:
        """Acknowledge a fault: set up the drives again and reset their faults. Returns the reason if refused, or ""."""
        if self.mode is Mode.RUNNING:
            return f"{self.reason} is running; `upright stop` ends it."
        if self.cut_off and (others := strangers(self.foreign, self._now_ns)):
            return " ".join(others)
        self.cut_off = False
        self._enter(Mode.STARTING, "starting", "setting up the drives")
        self._to_acknowledge.update(self.io.drives)
        self._failure_logged = False
        self.needs_set_up = True
        return ""

    def set_up_done(self, error_codes: Mapping[str, int | None] | None = None) -> None:
        """The drives are configured and in NMT operational; `error_codes` are their errors before (603Fh, by name).

        The fault of a drive that only missed its master is reset without asking: every stop of the daemon causes it.
        """
        self.needs_set_up = False
        self._stop_check.settle()  # it has found the drives to be off, or has switched them off
        for drive in self.io.drives:
            drive.configured()
            code = (error_codes or {}).get(drive.config.name) or (drive.emergency.code if drive.emergency else 0)
            if of_communication(code):
                self._to_acknowledge.add(drive)
        if self.mode is Mode.STARTING:
            self._enter(Mode.DISARMED, "disarmed", "")

    def set_up_failed(self, reason: str) -> None:
        """A drive or a bus is missing; the daemon tries again."""
        if self.mode in (Mode.STARTING, Mode.DISARMED) and reason != self.reason:
            self._enter(Mode.STARTING, "set_up", reason)
            self._observer.event("error", "set_up", reason)

    def look_after_drives(self) -> None:
        """Called periodically: detect drives that need a new set-up, and acknowledge faults when their state is known.

        A drive that missed its master has left NMT operational; a restarted drive has lost its configuration.
        """
        if self.mode in (Mode.STARTING, Mode.DISARMED):
            for drive in self.io.drives:
                if drive.restarted or (drive.emergency and of_communication(drive.emergency.code)):
                    self.needs_set_up = True
        for drive in self.io.drives:
            drive.forget_advice()
        self._to_acknowledge = {drive for drive in self._to_acknowledge if not drive.acknowledge()}

    def bus_down(self, down: BusDown) -> None:
        """The bus is down: nothing can be sent, and the drives stop by themselves when the heartbeat is missing."""
        self.needs_set_up = True
        if self.run is not None:
            self.stop_now(str(down), "bus_down")
        elif self.mode is not Mode.FAULT:
            self._enter(Mode.STARTING, "bus_down", str(down))

    def observer_gone(self) -> None:
        """The observer process has ended: an experiment that is not recorded is ended."""
        self.end_experiment("the observer process ended: nothing is recorded any more")

    # State

    def state(self) -> dict[str, Any]:
        """The state for MQTT (`state`) and `upright status`."""
        run = self.run
        return {
            "vehicle": self.vehicle.vehicle.id,
            "mode": self.mode.value,
            "experiment": run.name if run is not None else None,
            "phase": self._phase.name.lower(),
            **_told(self._asked),
            "code": self.code,
            "reason": self.reason,
            "interlocks": self.interlocks(),
            "stays_down": self.stays_down(),
            "faults": [{"code": self.code, "text": self.reason}] if self.mode is Mode.FAULT else [],
            "version": assembly.version(),
            "since": self.since_ns * 1e-9,
        }

    def _latch(self, code: str, text: str) -> None:
        """Enter the mode FAULT, or say more of the fault that is latched."""
        if self.fault is not None and self.mode is Mode.FAULT:
            self.fault.code, self.fault.text = code, text
        else:
            self.fault = Fault(code, text)
        self._enter(Mode.FAULT, code, text)

    def _enter(self, mode: Mode, code: str, reason: str) -> None:
        self.mode, self.code, self.reason = mode, code, reason
        self.since_ns = self._last_ns
        self.on_change()

    def _finish_run(self, mode: Mode, code: str, reason: str) -> None:
        self.run = None
        self._phase = Phase.NONE
        self._asked = None
        self._enter(mode, code, reason)
        if self._recording and mode is not Mode.FAULT:
            self._end_recording()

    def _announce(self, asked: Asked | None) -> None:
        """Ask a person for something: people see it on every screen, and a virtual vehicle undergoes it."""
        self._asked = asked
        if asked is not None:
            code = next(key for key, kind in ASKED.items() if isinstance(asked, kind))
            self._observer.event("info", code, asked.announcement)
        self.on_change()

    def _end_recording(self) -> None:
        self._recording = False
        self._reset_at_ns = NEVER_NS
        self._observer.stop_recording(self.reason, self._last_ns)


def _told(asked: Asked | None) -> dict[str, dict[str, Any] | None]:
    """What a person has been asked to do, for the state, by its key; None for all that is not asked."""
    told = asked.model_dump(exclude={"after"}) if asked is not None else None
    return {key: told if isinstance(asked, kind) else None for key, kind in ASKED.items()}
