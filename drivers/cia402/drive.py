"""One drive at run time: its frames in, its state and motion in SI; target state and setpoint in, its frames out.

Synchronous, no I/O, no clock. Every value has the receive time of its frame. The drive sends its TPDOs after each
SYNC and applies our RPDOs at the next one, so the values read here were sampled at the previous SYNC.
Sign: position, velocity and torque are positive in the axis' positive direction (`config.direction`).
"""

from __future__ import annotations

from collections.abc import Callable

from upright.drivers.cia301 import emergency as emcy
from upright.drivers.cia301 import nmt
from upright.drivers.cia301.emergency import Emergency
from upright.drivers.cia301.nmt import NmtState
from upright.drivers.cia402 import states
from upright.drivers.cia402.config import DriveConfig
from upright.drivers.cia402.modes import FINE_UNITS_PER_RPM
from upright.drivers.cia402.pdo import PdoCodec
from upright.drivers.cia402.states import FaultReset, FaultResetOutcome, State
from upright.telemetry.samples import CanFrame

NAN = float("nan")


class Drive:
    """A drive of CiA 402 in one of `modes.MODES`: its setpoint is a velocity (axis unit/s), a torque (N m) or a
    voltage (V).

    It is never re-enabled automatically: a drive that leaves Operation enabled uncommanded, or has a fault under the
    target Operation enabled, is `tripped`. It is then held in quick stop until the fault has been reset
    (`request_fault_reset`) and the target has been lowered and raised again. A drive that `restarted` has lost its
    set-up, and is held in the same way until it has been set up again (`configured`).

    Attributes, for others to read:
        state, statusword: as reported last; UNKNOWN and None before; statusword_count: of all.
        position, velocity, torque: rad or m, rad/s or m/s, N m at the motor; NaN before the first value.
        setpoint: axis unit/s, N m or V, as the drive resolves it from the frame that was sent (in replay: read) last.
        controlword: as sent (in replay: read) last.
        *_timestamp_ns: receive time of the frame that contained the value, 0 before the first; of the heartbeat, since
            the drive has booted.
        nmt_state: of the last heartbeat, None before.
        mode_display: 6061h if it is mapped, else None.
        emergency: the active EMCY, None if there is none or it was cleared; last_emergency, emergency_count: of all.
        tripped, trip_reason, restarted: see above.
        wrong_length, last_wrong_length: number of frames ignored for their wrong length; the last one in words.
        clipped: number of setpoints that were limited to the range of their object.
    """

    def __init__(self, config: DriveConfig) -> None:
        self.config = config
        self.state = State.UNKNOWN
        self.statusword: int | None = None
        self.statusword_timestamp_ns = 0
        self.statusword_count = 0
        self.heartbeat_timestamp_ns = 0
        self.nmt_state: NmtState | None = None
        self.mode_display: int | None = None
        self.controlword = states.DISABLE_VOLTAGE
        self.emergency: Emergency | None = None
        self.last_emergency: Emergency | None = None
        self.emergency_count = 0
        self.tripped = False
        self.trip_reason = ""
        self.restarted = False
        self.wrong_length = 0
        self.last_wrong_length = ""
        self.clipped = 0
        self._reset: FaultReset | None = None
        self._configured = False
        self._advice = self._advised = 0

        self._position_unit = config.direction * config.axis_per_turn / config.increments_per_turn
        self._velocity_unit = config.velocity_unit
        self._rpm_unit = config.direction * config.axis_per_turn / 60.0
        self._torque_unit = config.torque_unit
        self._setpoint_unit = config.setpoint_unit
        self._enable_bits = config.operation.enable_bits
        self._split = FINE_UNITS_PER_RPM if config.has_fine_part else 1
        operation = config.operation
        bits = 8 * operation.target.size
        self._lowest = -(1 << bits - 1) * self._split - self._split // 2
        self._highest = (1 << bits - 1) * self._split - self._split // 2 - 1

        takes: dict[str, Callable[[int, int], None]] = {
            "statusword": self._take_statusword,
            "position_actual": self._take_position,
            "velocity_actual": self._take_velocity,
            "velocity_actual_rpm": self._take_velocity_rpm,
            "torque_actual": self._take_torque,
            "mode_display": self._take_mode_display,
        }
        self._tpdos = {
            cob_id: (codec, tuple(takes[name] for name in codec.names)) for cob_id, codec in config.tpdo_codecs.items()
        }
        places = {"controlword": 0, operation.target.name: 1, operation.fine: 2}
        self._rpdos: dict[int, tuple[PdoCodec, tuple[int, ...]]] = {
            cob_id: (codec, tuple(places[name] for name in codec.names)) for cob_id, codec in config.rpdo_codecs.items()
        }
        self._handlers: dict[int, Callable[[CanFrame], None]] = {
            **dict.fromkeys(self._tpdos, self._handle_tpdo),
            **dict.fromkeys(self._rpdos, self._handle_rpdo),
            nmt.EMERGENCY_COB_ID + config.node: self._handle_emergency,
            nmt.HEARTBEAT_COB_ID + config.node: self._handle_heartbeat,
        }
        self.reset()

    def reset(self) -> None:
        """Forget the measured values and the setpoint, for a recording that starts here; the state machine goes on."""
        self.position = self.velocity = self.torque = NAN
        self.position_timestamp_ns = self.velocity_timestamp_ns = self.torque_timestamp_ns = 0
        self.setpoint = 0.0
        self._sent = [self.controlword, 0, 0]

    def configured(self) -> None:
        """The drive has been set up: a boot-up from here on is unexpected, an earlier one is ignored."""
        self._configured = True
        self.restarted = False

    def acknowledge(self) -> bool:
        """The cause is removed: reset a fault, or clear an emergency that outlived it. False while that cannot be done.

        As after any fault reset, the drive stays off until the target has been lowered and raised again.
        """
        if self.statusword is None:
            return False
        if self.state is not State.FAULT_REACTION_ACTIVE and not self.request_fault_reset():
            self.emergency = None
        return self.state is not State.FAULT_REACTION_ACTIVE

    def new_advice(self) -> tuple[str, ...]:
        """The warnings in the statusword that have not been returned since they were there last, by name."""
        fresh = self._advice & ~self._advised
        if not fresh:
            return ()
        self._advised |= fresh
        return states.flags(fresh)

    def forget_advice(self) -> None:
        """The warnings that have not come since the last call are over: if they come again, they are new."""
        self._advised, self._advice = self._advice, 0

    @property
    def advice(self) -> tuple[str, ...]:
        """The warnings in the last statusword, by name."""
        return states.flags((self.statusword or 0) & states.ADVISORY)

    @property
    def can_ids(self) -> tuple[int, ...]:
        """CAN ids that `handle` understands: TPDOs, EMCY, heartbeat, and the RPDOs for replay."""
        return tuple(self._handlers)

    @property
    def timestamp_ns(self) -> int:
        """Receive time of the older of position and velocity, 0 while one is not known."""
        return min(self.position_timestamp_ns, self.velocity_timestamp_ns)

    @property
    def fault_reset(self) -> FaultResetOutcome | None:
        """Progress of the last requested fault reset; None if there was none."""
        return self._reset.outcome if self._reset is not None else None

    @property
    def condition(self) -> str:
        """State and problems, in words."""
        words = ["no statusword yet"]
        if self.statusword is not None:
            words = [self.state.value, *states.flags(self.statusword)]
        if self.emergency is not None:
            words.append(self.emergency.text)
        if self.tripped:
            words.append(f"tripped: {self.trip_reason}")
        if self.restarted:
            words.append("restarted, must be set up again")
        return f"{self.config.name} (node {self.config.node}): " + ", ".join(words)

    # Frames out

    def command(self, target: State, setpoint: float) -> tuple[tuple[int, bytes], ...]:
        """The RPDOs of one cycle as (COB-ID, data): one step towards `target`, with `setpoint` (axis unit/s, N m or V).

        The setpoint is sent only to a drive that reports Operation enabled and is to stay there; else it is 0.

        Raises:
            ValueError: `target` is not a state that a master can command.
        """
        word = self._next_controlword(target)
        enabled = word & states.ENABLE_OPERATION == states.ENABLE_OPERATION and self.state is State.OPERATION_ENABLED
        units = self._quantise(setpoint) if enabled else 0
        coarse, fine = divmod(units + self._split // 2, self._split)
        self._sent = sent = [word, coarse, fine - self._split // 2]
        self._remember_sent()
        return tuple(
            (cob_id, codec.pack(*[sent[place] for place in places])) for cob_id, (codec, places) in self._rpdos.items()
        )

    def request_fault_reset(self, patience: int = states.FAULT_RESET_PATIENCE) -> bool:
        """Begin a fault reset; it runs over the next cycles, see `fault_reset`. False if the drive has no fault.

        The drive ends in Switch on disabled and stays there until the target has been lowered and raised again.
        """
        if self.state is not State.FAULT:
            return False
        if not self.tripped:
            self._trip("fault reset")
        self._reset = FaultReset(patience)
        return True

    def _next_controlword(self, target: State) -> int:
        state = self.state
        faulty = state is State.FAULT or state is State.FAULT_REACTION_ACTIVE
        if target is State.OPERATION_ENABLED:
            if faulty and not self.tripped:
                self._trip(f"{state.value} while it was to be enabled")
        elif self.tripped and not faulty:
            self.tripped = False
        if self._reset is not None and self._reset.outcome is FaultResetOutcome.PENDING:
            word = self._reset.controlword(state)
            if self._reset.outcome is FaultResetOutcome.PENDING:
                return word
            if self._reset.outcome is FaultResetOutcome.DONE:
                self.emergency = None
        if self.statusword is None:
            return states.DISABLE_VOLTAGE
        if target is State.OPERATION_ENABLED and (self.tripped or self.restarted):
            target = State.QUICK_STOP_ACTIVE
        word = states.controlword_towards(state, target)
        return word | self._enable_bits if word == states.ENABLE_OPERATION else word

    def _trip(self, reason: str) -> None:
        self.tripped = True
        self.trip_reason = reason

    def _quantise(self, setpoint: float) -> int:
        """Axis unit/s, N m or V to units of the target's object, limited to its range.

        The setpoint is first rounded to the drive's resolution, so that the recorded setpoint is what the drive does.
        """
        units = self.config.resolved(setpoint) / self._setpoint_unit
        if self._lowest <= units <= self._highest:
            return round(units)
        self.clipped += 1
        if units > 0:
            return self._highest
        return self._lowest if units < 0 else 0  # not a number: stand still

    def _remember_sent(self) -> None:
        """Update controlword and setpoint from the integers of our own frames, sent or replayed."""
        word, coarse, fine = self._sent
        self.controlword = word
        sent = (coarse * self._split + fine) * self._setpoint_unit
        self.setpoint = self.config.resolved(sent) + 0.0  # never -0.0

    # Frames in

    def handle(self, frame: CanFrame) -> None:
        """Take one frame; those of others are ignored. Never raises for the content of a frame."""
        handler = self._handlers.get(frame.can_id)
        if handler is not None:
            handler(frame)

    def _handle_tpdo(self, frame: CanFrame) -> None:
        codec, takes = self._tpdos[frame.can_id]
        if len(frame.data) != codec.size:
            self._refuse(frame, codec.size)
            return
        timestamp_ns = frame.timestamp_ns
        for take, raw in zip(takes, codec.unpack(frame.data), strict=True):
            take(raw, timestamp_ns)

    def _take_statusword(self, raw: int, timestamp_ns: int) -> None:
        before = self.state
        self.statusword = raw
        self.statusword_timestamp_ns = timestamp_ns
        self.statusword_count += 1
        self.state = state = states.classify(raw)
        self._advice |= raw & states.ADVISORY
        # Enable operation is sent only after Switched on was seen, so any way back from there is uncommanded.
        commanded = self.controlword & states.ENABLE_OPERATION == states.ENABLE_OPERATION
        fell = before is State.OPERATION_ENABLED or state is not State.SWITCHED_ON
        if commanded and fell and state is not State.OPERATION_ENABLED:
            self._trip(f"left Operation enabled by itself for {state.value} (statusword {raw:04X}h)")

    def _take_position(self, raw: int, timestamp_ns: int) -> None:
        self.position = raw * self._position_unit
        self.position_timestamp_ns = timestamp_ns

    def _take_velocity(self, raw: int, timestamp_ns: int) -> None:
        self.velocity = raw * self._velocity_unit
        self.velocity_timestamp_ns = timestamp_ns

    def _take_velocity_rpm(self, raw: int, timestamp_ns: int) -> None:
        self.velocity = raw * self._rpm_unit
        self.velocity_timestamp_ns = timestamp_ns

    def _take_torque(self, raw: int, timestamp_ns: int) -> None:
        self.torque = raw * self._torque_unit
        self.torque_timestamp_ns = timestamp_ns

    def _take_mode_display(self, raw: int, timestamp_ns: int) -> None:
        self.mode_display = raw

    def _handle_rpdo(self, frame: CanFrame) -> None:
        codec, places = self._rpdos[frame.can_id]
        if len(frame.data) != codec.size:
            self._refuse(frame, codec.size)
            return
        for place, raw in zip(places, codec.unpack(frame.data), strict=True):
            self._sent[place] = raw
        self._remember_sent()

    def _handle_emergency(self, frame: CanFrame) -> None:
        if len(frame.data) != emcy.LENGTH:
            self._refuse(frame, emcy.LENGTH)
            return
        emergency = emcy.decode(frame.timestamp_ns, frame.data)
        if emergency.cleared:
            self.emergency = None
            return
        self.emergency = self.last_emergency = emergency
        self.emergency_count += 1

    def _handle_heartbeat(self, frame: CanFrame) -> None:
        if len(frame.data) != 1:
            self._refuse(frame, 1)
            return
        self.heartbeat_timestamp_ns = frame.timestamp_ns
        self.nmt_state = nmt.NMT_STATES.get(frame.data[0] & 0x7F)  # bit 7 is the toggle bit of node guarding
        if self.nmt_state is NmtState.BOOT_UP:
            self.heartbeat_timestamp_ns = 0
        if self.nmt_state is NmtState.BOOT_UP and (self._configured or self.statusword is not None):
            self.restarted = True
            self._configured = False
            self.statusword = None
            self.state = State.UNKNOWN

    def _refuse(self, frame: CanFrame, size: int) -> None:
        self.wrong_length += 1
        self.last_wrong_length = (
            f"{self.config.name} (node {self.config.node}): frame {frame.can_id:03X}h has {len(frame.data)} bytes, "
            f"not {size}; the mapping or the format of the node is not the configured one"
        )
