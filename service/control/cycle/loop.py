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
from collections.abc import Callable, Iterable
from itertools import compress
from typing import Any

from upright.drivers.cia301.nmt import NmtCommand, command_frame
from upright.drivers.cia402.drive import Drive
from upright.drivers.foreign import REMEDY
from upright.estimators.checks.imu_consistency import ImuConsistency
from upright.estimators.roll_filter import RollState
from upright.service.control import assembly
from upright.service.control.cycle.bus_watch import BusWatch
from upright.service.control.cycle.operation import NEVER_NS, QUICK_STOP_TIME, Mode, Observer, Operation
from upright.service.control.cycle.readiness import heartbeat_timeout, observation, observe
from upright.service.control.cycle.rows import row
from upright.service.control.cycle.safety import Safety
from upright.service.control.cycle.sequence import ExperimentRun
from upright.service.control.cycle.stop_check import Stop
from upright.service.control.cycle.timing import Timing
from upright.service.control.notify import Notifier
from upright.telemetry.samples import CanFrame, ImuSample
from upright.vehicles.bounds import OK, Code, Reaction, Verdict
from upright.vehicles.contract import IDLE, QUICK_STOP, Command, Lean, Measurement
from upright.vehicles.experiment.phases import BALANCING, POWERED, UPRIGHT, Phase
from upright.vehicles.sections import VehicleFile

SYNC = 0x080
HEARTBEAT = 0x700
OPERATIONAL = b"\x05"

WATCHDOG_PERIOD = 0.25
"""s between watchdog pings."""


LOOKS = 4
"""Looks within the longest silence of the IMU: one that lasts is noticed a quarter of it later at the latest."""


def deadline(vehicle: VehicleFile) -> float:
    """s between two looks whether cycles still come: a silence is one after `LOOKS` of them."""
    return (vehicle.limits.missed_cycles + 1) * vehicle.period / LOOKS


class ControlLoop(Operation):
    """The operation of a vehicle, and the path of its samples. The buses call `on_frames`.

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
        super().__init__(vehicle, observer)
        self.io.watch(self.foreign.can_ids, self.foreign.handle)
        self.bus_watch = BusWatch(self.io, observer.event)
        self.cycles = 0
        self.missed_cycles = 0
        self.timing = Timing(vehicle.period)
        self.heard: list[CanFrame] | None = None
        """All frames, while the set-up checks the bus."""
        self._filter = assembly.roll_filter(vehicle)
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
        self._waited = 0.0
        self._late_cycles = 0
        self._answers_due = False

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

    # Beside the path of a sample

    def start_experiment(self, name: str, client: str = "") -> ExperimentRun:
        """Start an experiment as `Operation` does; the safety verdict forgets the one before."""
        self._seen.begin()
        return super().start_experiment(name, client)

    def start(self) -> None:
        """Start the deadline timer; call it in a running event loop."""
        if self._deadline is not None:
            asyncio.get_running_loop().call_later(self._deadline, self._check_deadline)

    def nearest_limit(self) -> dict[str, Any] | None:
        """The limit of which most is used, and how much; None without an experiment."""
        found = self._safety.nearest(self._seen) if self.run is not None else None
        return None if found is None else {"code": found[0].code.value, "percent": round(100.0 * found[1], 1)}

    def _begin_recording(self) -> None:
        """Discard all earlier measurements at the agreed time, so that the raw log is sufficient for a replay."""
        self.io.reset(self._reset_at_ns)
        self._filter.reset()
        self._consistency.reset()
        self._reset_at_ns = NEVER_NS

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
