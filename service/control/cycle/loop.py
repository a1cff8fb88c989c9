"""The control loop: the processing of a sample, on one screen (`_cycle`).

The IMU frame set is the clock. When its last frame arrives, everything that depends on it is processed at once, in this
order: roll filter, experiment (reference, excitation, controller), safety verdict, setpoint frames, SYNC, heartbeat,
and one `Frame` for the observer. Nothing here waits or reads a clock. A separate deadline timer detects that no frame
set comes any more, and then stops the vehicle. An exception in a cycle stops it, too, and is the only thing that is
logged here.
"""

from __future__ import annotations

import asyncio
import logging
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from itertools import compress
from typing import Any, Protocol

from upright.drivers.bus.bus import BusDown
from upright.drivers.cia301.emergency import of_communication
from upright.drivers.cia301.nmt import NmtCommand, command_frame
from upright.drivers.cia402.drive import Drive
from upright.drivers.foreign import REMEDY, ForeignTraffic
from upright.drivers.vehicle_io import VehicleIo
from upright.estimators.checks.imu_consistency import ImuConsistency
from upright.estimators.roll_filter import RollState
from upright.service.control import assembly
from upright.service.control.cycle.bus_watch import BusWatch
from upright.service.control.cycle.readiness import heartbeat_timeout, interlocks, observation, observe, strangers
from upright.service.control.cycle.rows import row
from upright.service.control.cycle.safety import Safety
from upright.service.control.cycle.sequence import ExperimentRun, plan
from upright.service.control.cycle.stop_check import CYCLES, Stop, StopCheck
from upright.service.control.cycle.timing import Timing
from upright.service.control.notify import Notifier
from upright.telemetry.errors import UprightError
from upright.telemetry.samples import CanFrame, Frame, ImuSample
from upright.vehicles import registry
from upright.vehicles.bounds import OK, Code, Reaction, Verdict
from upright.vehicles.contract import IDLE, QUICK_STOP, Command, Kind, Lean, Measurement, Pilot
from upright.vehicles.experiment.phases import BALANCING, POWERED, UPRIGHT, Phase
from upright.vehicles.sections import ASKED, Asked, VehicleFile

SYNC = 0x080
HEARTBEAT = 0x700
OPERATIONAL = b"\x05"
NEVER_NS = 1 << 62

RECORDING_LEAD_NS = 200_000_000
"""Time from the command to record to the first recorded frame: the raw log needs it to open its file."""

AFTERMATH = 2.0
"""s that a recording continues after a quick stop, to show the final state."""

QUICK_STOP_TIME = 1.0
"""s of quick stop before the drives are disabled."""

WATCHDOG_PERIOD = 0.25
"""s between watchdog pings."""


LOOKS = 4
"""Looks within the longest silence of the IMU: one that lasts is noticed a quarter of it later at the latest."""


def deadline(vehicle: VehicleFile) -> float:
    """s between two looks whether cycles still come: a silence is one after `LOOKS` of them."""
    return (vehicle.limits.missed_cycles + 1) * vehicle.period / LOOKS


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


class ControlLoop:
    """Holds the vehicle's state between cycles. The buses call `on_frames`, the daemon calls everything else.

    `send(can_id, data, timestamp_ns)` sends a frame on the drives' bus; `unclaimed` gets the frames that belong to no
    driver (SDO answers); every `deadline` s a timer looks whether cycles still come, None on a lock-step bus.
    """

    def __init__(
        self,
        vehicle: VehicleFile,
        *,
        send: Callable[[int, bytes, int], None],
        observer: Observer,
        notifier: Notifier,
        unclaimed: Callable[[CanFrame], None],
        deadline: float | None,
    ) -> None:
        self.vehicle = vehicle
        self.io: VehicleIo = assembly.vehicle_io(vehicle)
        self.foreign = ForeignTraffic(self.io.drives, vehicle.control.master_node)
        """What somebody else sends with the ids of this service."""
        self.io.watch(self.foreign.can_ids, self.foreign.handle)
        self.bus_watch = BusWatch(self.io, observer.event)
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
        self.cycles = 0
        self.missed_cycles = 0
        self.timing = Timing(vehicle.period)
        self.lean: Lean | None = None
        self.drives: Measurement = self.kind.measure()
        self.on_change: Callable[[], None] = lambda: None
        self.heard: list[CanFrame] | None = None
        """All frames, while the set-up checks the bus."""
        self._filter = assembly.roll_filter(vehicle)
        self._pilot = self.kind.pilot()
        noise, averaged = vehicle.imu.filter.acceleration_std, self.kind.watch.averaged
        self._consistency = ImuConsistency(float(vehicle.control.rate), noise, averaged)
        self._safety = Safety(
            self.kind.bounds,
            missed_cycles=vehicle.limits.missed_cycles,
            period=vehicle.period,
            heartbeat_timeout=heartbeat_timeout(vehicle),
        )
        self._seen = observation(self.io)
        self._seen.watched = self.kind.watch
        self._send = send
        self._observer = observer
        self._notifier = notifier
        self._unclaimed = unclaimed
        self._period = vehicle.period
        self._half_period_ns = round(0.5e9 * vehicle.period)
        self._heartbeat_id = HEARTBEAT + vehicle.control.master_node
        self._heartbeat_period_ns = round(vehicle.control.heartbeat_period * 1e9)
        self._heartbeat_ns = 0
        self._watchdog_cycles = max(1, int(WATCHDOG_PERIOD * vehicle.control.rate))
        self._deadline = deadline
        self._cycles_at_deadline = -1
        self._waited = self._silence = 0.0
        self._to_acknowledge: set[Drive] = set()
        self._reset_at_ns = NEVER_NS
        self._recording = False
        self._aftermath = 0.0
        self._quick_stop_left = 0.0
        self._last_ns = 0
        self._late_cycles = 0
        self._answers_due = False
        self._phase = Phase.NONE
        self._asked: Asked | None = None
        self._failure_logged = False
        self._end_code = ""
        self._stop_check = StopCheck(
            self.io.drives,
            period=vehicle.period,
            timeout=vehicle.control.heartbeat_timeout + CYCLES * vehicle.period,
        )

    # The path of a sample

    def on_frames(self, frames: list[CanFrame]) -> None:
        """Process the frames of one wake-up, in the order of their timestamps."""
        if self.heard is not None:
            self.heard.extend(frames)
        handle = self.io.handle
        # More than one frame set at once means that this process was delayed. Only the last set is answered on the bus.
        waiting = self.io.imu.ends(frames) if len(frames) > 4 else 1
        for frame in frames:
            sample = None
            try:
                if frame.timestamp_ns >= self._reset_at_ns:
                    self._begin_recording()
                sample = handle(frame)
                if sample is not None:
                    waiting -= 1
                    self._cycle(sample, late=waiting > 0)
                elif frame.error:
                    self.bus_watch.error(frame)
                else:
                    if not self.io.knows(frame):
                        self.bus_watch.meet(frame)
                    self._unclaimed(frame)
            except Exception as error:  # whatever it is, the vehicle is stopped in order and the process lives on
                self._fail(error, answer=sample is not None)

    def _cycle(self, sample: ImuSample, *, late: bool) -> None:
        """One control cycle, from the sample to the setpoints on the bus and the frame for the observer."""
        now_ns = sample.timestamp_ns
        elapsed = (now_ns - self._last_ns) * 1e-9
        self._last_ns = now_ns
        attitude = self._filter.update(sample)
        lean = self.lean = self.kind.lean(attitude)
        drives = self.drives = self.kind.measure()
        # Time that went back must not upset the controller, and a longer gap ends the run.
        dt = min(max(elapsed, 0.5 * self._period), self._safety.longest_silence) if elapsed > 0.0 else self._period
        command = self._decide(dt, lean, drives)
        self._late_cycles = self._late_cycles + 1 if late else 0
        verdict = self._judge(attitude, elapsed, dt, lean, drives, command)
        if verdict is not OK:
            command = self._react(verdict, command)
        self._report()
        if not late:
            self._transmit(command, now_ns)
        self._answers_due = not late
        if drives.timestamp_ns:
            self._observer.offer(row(self.kind, attitude, drives, command, self._phase))
        if self.cycles:
            self.timing.interval.add(elapsed)
        self.cycles += 1
        if elapsed > 1.5 * self._period:
            self.missed_cycles += 1
        if self.cycles % self._watchdog_cycles == 0:
            self._notifier.watchdog()

    def sent(self, turnaround: float) -> None:
        """The setpoints of the last cycle were given to the bus `turnaround` s after its sample. Answers to a late SYNC
        come after the next sample: the bus has not lost them."""
        self.timing.turnaround.add(turnaround)
        if turnaround > 0.5 * self._period:
            self._answers_due = False

    def _decide(self, dt: float, lean: Lean, drives: Measurement) -> Command:
        """The command for the drives: follow the experiment, complete a quick stop, or idle."""
        run = self.run
        if run is None:
            return self._after_run(dt)
        command = run.step(dt, lean, drives, self.io.state)
        if run.phase is not self._phase:
            self._phase = run.phase
            self.on_change()
        if run.asked is not self._asked:
            self._announce(run.asked)
        if run.done:
            if not run.leaves_drives_alone:
                self._stop_check.begin(self._last_ns, 0.0)
            self._finish_run(Mode.DISARMED, self._end_code, run.failure or run.end_reason)
        return command

    def _judge(
        self, attitude: RollState, elapsed: float, dt: float, lean: Lean, drives: Measurement, command: Command
    ) -> Verdict:
        seen, run, watch, now_ns = self._seen, self.run, self.kind.watch, attitude.timestamp_ns
        period = self._period
        seen.answers_due = self._answers_due
        observe(seen, self.io, now_ns, drives, period=period, missed=round(elapsed / period) - 1)
        watch.update(dt, lean, drives)
        at_rest = run is not None and run.phase is Phase.REST
        seen.contradiction = self._consistency.update(watch.unexplained(attitude.contradiction), at_rest=at_rest)
        seen.imu_age = elapsed
        seen.angle = lean.angle
        seen.rate = lean.rate
        seen.setpoint = command.setpoint
        seen.late_cycles = self._late_cycles
        self._observe_strangers()
        # After a silence of the service the drives stop by themselves: that is what the experiment wants to see.
        watched = run is not None and not run.leaves_drives_alone
        seen.armed = watched and run is not None and run.phase > Phase.REST
        seen.should_run = watched and run is not None and run.phase in POWERED
        seen.balancing = run is not None and run.phase in BALANCING
        seen.upright = run is not None and run.phase in UPRIGHT
        return self._safety.judge(seen)

    def _observe_strangers(self) -> None:
        seen, foreign, run = self._seen, self.foreign, self.run
        command, request = (foreign.command, foreign.request) if run is not None else (None, None)
        seen.foreign_command = f"{command.text}; {REMEDY}" if command is not None else ""
        seen.foreign_request = f"{request.text}; {REMEDY}" if request is not None else ""

    def _react(self, verdict: Verdict, command: Command) -> Command:
        if self.run is None:
            return command
        if verdict.reaction is Reaction.END_EXPERIMENT:
            self.end_experiment(verdict.text, verdict.code.value)
            return command
        if verdict.reaction is Reaction.CUT_OFF:
            self.cut_off = True
            self._heartbeat_ns = 0
        # A drive that does not answer may not hear SYNC, without which a quick stop has no effect: NMT stop needs none.
        # While the IMU was silent, no SYNC was sent, and no answer was due.
        due = self._safety.longest_silence - self._period + self._seen.imu_age
        silent = [not entry.age <= due for entry in self._seen.drives]
        self._stop_nodes(compress(self.io.drives, silent), self._last_ns)
        self.stop_now(verdict.text, verdict.code.value)
        return QUICK_STOP

    def _report(self) -> None:
        """What is not judged, but has to be known: warnings in the statuswords, and trouble on the bus."""
        for drive in self.io.drives:
            if advice := drive.new_advice():
                self._observer.event("warning", Code.DRIVE_WARNING, f"drive {drive.config.name}: {', '.join(advice)}")
        self.bus_watch.cycle()

    def _transmit(self, command: Command, now_ns: int) -> None:
        send = self._send
        if self.run is not None and self.run.silent:
            send(SYNC, b"", now_ns)
            return
        for can_id, data in self.io.command(command.target, command.setpoint, command.others):
            send(can_id, data, now_ns)
        send(SYNC, b"", now_ns)
        # Half a period early where the next cycle would be late; a time that went back is no reason to wait.
        if not 0 <= now_ns + self._half_period_ns - self._heartbeat_ns < self._heartbeat_period_ns:
            self._heartbeat_ns = now_ns
            self._send_heartbeat(now_ns)

    def _send_heartbeat(self, now_ns: int) -> None:
        """The heartbeat, unless a drive is to miss it. Drives that somebody else commands get NMT stop in its place."""
        if self.cut_off:
            self._stop_nodes(self.io.drives, now_ns)
        elif not self._stop_check.withheld:
            self._send(self._heartbeat_id, OPERATIONAL, now_ns)

    def _stop_nodes(self, drives: Iterable[Drive], now_ns: int) -> None:
        for drive in drives:
            self._send(*command_frame(NmtCommand.STOP, drive.config.node), now_ns)

    def _after_run(self, dt: float) -> Command:
        """The command without an experiment: complete a quick stop and its recording, else keep the drives off."""
        if self._recording:
            self._aftermath -= dt
            if self._aftermath <= 0.0:
                self._end_recording()
        self._verify_stop(dt)
        if self._quick_stop_left > 0.0:
            self._quick_stop_left -= dt
            return QUICK_STOP
        return IDLE

    def _verify_stop(self, dt: float) -> None:
        """Check that the drives have stopped; if one has not, say so before anything else."""
        check = self._stop_check
        if check.over or check.step(dt) is not Stop.FAILED:
            return
        enabled = check.enabled()
        if not enabled:
            silent = ", ".join(drive.config.name for drive in check.unconfirmed())
            text = f"not confirmed to be off, check by hand: {silent}"
            self._observer.event("error", Code.DRIVE_UNCONFIRMED, text)
            if self.fault is not None and self.mode is Mode.FAULT:
                self._latch(self.fault.code, f"{self.fault.text}; {text}")
            return
        self._stop_nodes(enabled, self._last_ns)
        names = " and ".join(f"{drive.config.name} (node {drive.config.node})" for drive in enabled)
        text = (
            f"STILL ENABLED: drive {names}, although quick stop, disable voltage and NMT stop were sent and the "
            "heartbeat was withheld; switch off its power by hand"
        )
        self._observer.event("error", Code.DRIVE_STILL_ENABLED, text)
        before = self.fault if self.mode is Mode.FAULT else None
        self._latch(Code.DRIVE_STILL_ENABLED, f"{text}. Stopped because: {before.text}" if before else text)

    def _latch(self, code: str, text: str) -> None:
        """Enter the mode FAULT, or say more of the fault that is latched."""
        if self.fault is not None and self.mode is Mode.FAULT:
            self.fault.code, self.fault.text = code, text
        else:
            self.fault = Fault(code, text)
        self._enter(Mode.FAULT, code, text)

    def _fail(self, error: Exception, *, answer: bool) -> None:
        """An exception on the path of a sample: a latched fault, logged once. If the cycle ended with it, `answer` the
        sample as `_after_run` does; if that fails as well, take the drives out of operation by NMT."""
        if not self._failure_logged:
            self._failure_logged = True
            logging.getLogger(__name__).critical("a control cycle failed", exc_info=error)
        try:
            if self.run is not None or self.mode is not Mode.FAULT:
                self.stop_now(_in_words(error), Code.INTERNAL_ERROR)
            if answer:
                self._transmit(self._after_run(self._period), self._last_ns)
        except Exception:
            self.cut_off = True
            self._send_heartbeat(self._last_ns)

    # Outside the path of a sample: commands, deadlines, loss and return of the bus

    def start(self) -> None:
        """Start the deadline timer; call it in a running event loop."""
        if self._deadline is not None:
            asyncio.get_running_loop().call_later(self._deadline, self._check_deadline)

    def start_experiment(self, name: str, client: str = "") -> ExperimentRun:
        """Start an experiment and its recording, which names `client`. Only without `obstacles(name)`."""
        self.foreign.forget()
        self._end_code = "done"
        run = self.run = ExperimentRun(name, plan(self.vehicle, name, self._pilot, self.kind.angle))
        self._phase = run.phase
        self.kind.watch.reset()
        self._seen.begin()
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

    def nearest_limit(self) -> dict[str, Any] | None:
        """The limit of which most is used, and how much; None without an experiment."""
        found = self._safety.nearest(self._seen) if self.run is not None else None
        return None if found is None else {"code": found[0].code.value, "percent": round(100.0 * found[1], 1)}

    @property
    def stopping(self) -> bool:
        """Whether the drives still have to confirm that they are off."""
        return not self._stop_check.over

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

    def _begin_recording(self) -> None:
        """Discard all earlier measurements at the agreed time, so that the raw log is sufficient for a replay."""
        self.io.reset(self._reset_at_ns)
        self._filter.reset()
        self._consistency.reset()
        self._reset_at_ns = NEVER_NS

    def _end_recording(self) -> None:
        self._recording = False
        self._reset_at_ns = NEVER_NS
        self._observer.stop_recording(self.reason, self._last_ns)

    def _check_deadline(self) -> None:
        """If no cycle comes for too long, the IMU is silent: stop a run, and keep the drives supplied."""
        assert self._deadline is not None
        asyncio.get_running_loop().call_later(self._deadline, self._check_deadline)
        try:
            self._watch_silence(self._deadline)
        except Exception as error:
            self._fail(error, answer=True)

    def _watch_silence(self, passed: float) -> None:
        if self.cycles != self._cycles_at_deadline:
            self._cycles_at_deadline = self.cycles
            self._waited = self._silence = 0.0
            return
        self._waited += passed
        if self._waited <= self._safety.longest_silence:
            return
        self._silence = self._waited
        if self.run is not None:
            self._seen.imu_age = self._silence
            self._seen.imu_health = self.io.imu.health(self._last_ns)
            self._seen.imu_text = self.io.imu.fault_text
            verdict = self._safety.judge(self._seen)
            self.stop_now(verdict.text, verdict.code.value)
        if self._recording:
            self._end_recording()
        self._verify_stop(passed)
        if self._silence < QUICK_STOP_TIME:
            self._transmit(QUICK_STOP if self._quick_stop_left > 0.0 else IDLE, self._last_ns)
        elif self.mode is not Mode.RUNNING:
            self._quick_stop_left = 0.0
            self._transmit(IDLE, self._last_ns)
            self._send_heartbeat(self._last_ns)
            self._notifier.watchdog()


def _in_words(error: Exception) -> str:
    """An exception as the reason of a fault: what it is, and where it was raised."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    return (
        f"internal error in the control cycle: {type(error).__name__}: {error} "
        f"({place.filename.rpartition('/')[2]}, line {place.lineno}); the log has the traceback, please report it"
    )


def _told(asked: Asked | None) -> dict[str, dict[str, Any] | None]:
    """What a person has been asked to do, for the state, by its key; None for all that is not asked."""
    told = asked.model_dump(exclude={"after"}) if asked is not None else None
    return {key: told if isinstance(asked, kind) else None for key, kind in ASKED.items()}
