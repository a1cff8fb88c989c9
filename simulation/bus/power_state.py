"""The power state machine inside a CiA 402 servo drive (CiA 402-2, figure "state machine"), seen from the drive.

A controlword requests a command; if the state allows it, the transition happens after the time that a real power
stage takes. A fault is left only by a rising edge of bit 7, into Switch on disabled.
"""

from __future__ import annotations

from enum import Enum, IntEnum


class PowerState(IntEnum):
    """The value is the state's pattern in bits 0 to 3, 5 and 6 of the statusword."""

    NOT_READY_TO_SWITCH_ON = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class Command(Enum):
    """The command in the low bits of a controlword."""

    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch on"
    ENABLE_OPERATION = "enable operation"
    QUICK_STOP = "quick stop"
    DISABLE_VOLTAGE = "disable voltage"


def command_of(controlword: int) -> Command:
    """The command in bits 0 to 3."""
    if not controlword & 0x02:
        return Command.DISABLE_VOLTAGE
    if not controlword & 0x04:
        return Command.QUICK_STOP
    if not controlword & 0x01:
        return Command.SHUTDOWN
    return Command.ENABLE_OPERATION if controlword & 0x08 else Command.SWITCH_ON


_S, _C = PowerState, Command
TRANSITIONS: dict[tuple[PowerState, Command], tuple[PowerState, float]] = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): (_S.READY_TO_SWITCH_ON, 0.002),
    (_S.READY_TO_SWITCH_ON, _C.SWITCH_ON): (_S.SWITCHED_ON, 0.010),
    (_S.READY_TO_SWITCH_ON, _C.ENABLE_OPERATION): (_S.SWITCHED_ON, 0.010),
    (_S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE): (_S.SWITCH_ON_DISABLED, 0.0),
    (_S.READY_TO_SWITCH_ON, _C.QUICK_STOP): (_S.SWITCH_ON_DISABLED, 0.0),
    (_S.SWITCHED_ON, _C.ENABLE_OPERATION): (_S.OPERATION_ENABLED, 0.030),
    (_S.SWITCHED_ON, _C.SHUTDOWN): (_S.READY_TO_SWITCH_ON, 0.002),
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): (_S.SWITCH_ON_DISABLED, 0.0),
    (_S.SWITCHED_ON, _C.QUICK_STOP): (_S.SWITCH_ON_DISABLED, 0.0),
    (_S.OPERATION_ENABLED, _C.SWITCH_ON): (_S.SWITCHED_ON, 0.002),
    (_S.OPERATION_ENABLED, _C.SHUTDOWN): (_S.READY_TO_SWITCH_ON, 0.0),
    (_S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): (_S.SWITCH_ON_DISABLED, 0.0),
    (_S.OPERATION_ENABLED, _C.QUICK_STOP): (_S.QUICK_STOP_ACTIVE, 0.0),
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): (_S.SWITCH_ON_DISABLED, 0.0),
}
"""State and command to next state and time, s. From Quick stop active see `PowerStateMachine.stay_in_stop`."""

SELF_TEST = 0.05
"""s from power-on until Switch on disabled."""
STOP_TIMEOUT = 2.0
"""s after which a stopping drive gives up waiting for standstill."""
FAULT_RESET = 0x80


class PowerStateMachine:
    """`state` follows the controlwords written to `controlword`; call `update` whenever time has passed."""

    def __init__(self) -> None:
        self.state = PowerState.NOT_READY_TO_SWITCH_ON
        self.controlword = 0
        self.stay_in_stop = False
        """Quick stop option 5 or 6: remain in Quick stop active, from where operation can be enabled again."""
        self.ramp_before_disable = True
        """Disable operation option 1: come to a standstill before leaving Operation enabled for Switched on."""
        self.ramp_before_shutdown = False
        """Shutdown option 1: the same on the way to Ready to switch on."""
        self._since = 0.0
        self._pending: tuple[PowerState, float] | None = None

    @property
    def stopping(self) -> bool:
        """The axis is to be brought to a standstill under power."""
        return self.state in (PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE) or (
            self.state is PowerState.OPERATION_ENABLED and self._pending is not None
        )

    def restart(self, now: float) -> None:
        """Power-on."""
        self.controlword = 0
        self._enter(PowerState.NOT_READY_TO_SWITCH_ON, now)

    def write(self, controlword: int, now: float) -> bool:
        """Take a controlword; returns whether it has reset a fault (a rising edge of bit 7 in Fault)."""
        edge = controlword & FAULT_RESET and not self.controlword & FAULT_RESET
        self.controlword = controlword
        if edge and self.state is PowerState.FAULT:
            self._enter(PowerState.SWITCH_ON_DISABLED, now)
            return True
        return False

    def fail(self, now: float, *, under_power: bool) -> None:
        """Go to Fault, through a stop under power if the stage is on and the reaction is to stop."""
        if self.state in (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE):
            return
        moving = self.state in (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE)
        self._enter(PowerState.FAULT_REACTION_ACTIVE if moving and under_power else PowerState.FAULT, now)

    def update(self, now: float, *, standstill: bool) -> None:
        """Let time pass."""
        state = self.state
        stopped = standstill or now - self._since > STOP_TIMEOUT
        if state is PowerState.FAULT:
            return
        if state is PowerState.NOT_READY_TO_SWITCH_ON:
            if now - self._since >= SELF_TEST:
                self._enter(PowerState.SWITCH_ON_DISABLED, now)
            return
        if state is PowerState.FAULT_REACTION_ACTIVE:
            if stopped:
                self._enter(PowerState.FAULT, now)
            return
        command = command_of(self.controlword)
        if state is PowerState.QUICK_STOP_ACTIVE and not self.stay_in_stop and stopped:
            self._enter(PowerState.SWITCH_ON_DISABLED, now)
            return
        if state is PowerState.QUICK_STOP_ACTIVE and self.stay_in_stop and command is Command.ENABLE_OPERATION:
            self._enter(PowerState.OPERATION_ENABLED, now)
            return
        self._transit(command, now, standstill)

    def _transit(self, command: Command, now: float, standstill: bool) -> None:
        found = TRANSITIONS.get((self.state, command))
        if found is None:
            self._pending = None
            return
        target, delay = found
        if self._pending is None or self._pending[0] is not target:
            self._pending = (target, now + delay)
        due = self._pending[1]
        ramping = self.state is PowerState.OPERATION_ENABLED and (
            (target is PowerState.SWITCHED_ON and self.ramp_before_disable)
            or (target is PowerState.READY_TO_SWITCH_ON and self.ramp_before_shutdown)
        )
        if ramping and not standstill and now - due < STOP_TIMEOUT:
            return
        if now >= due:
            self._enter(target, now)

    def _enter(self, state: PowerState, now: float) -> None:
        self.state = state
        self._since = now
        self._pending = None
