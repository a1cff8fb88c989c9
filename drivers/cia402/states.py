"""The power drive system state machine of CiA 402 (IEC 61800-7-201), as pure functions over data.

A drive reports its state in the statusword (6041h), and the controlword (6040h) leads it from state to state. Nothing
here keeps time or does I/O. Transition numbers in comments are those of CiA 402.
"""

from __future__ import annotations

from enum import Enum


class State(Enum):
    """The CiA 402 states; UNKNOWN: the statusword matches none, or has not been received."""

    NOT_READY_TO_SWITCH_ON = "Not ready to switch on"
    SWITCH_ON_DISABLED = "Switch on disabled"
    READY_TO_SWITCH_ON = "Ready to switch on"
    SWITCHED_ON = "Switched on"
    OPERATION_ENABLED = "Operation enabled"
    QUICK_STOP_ACTIVE = "Quick stop active"
    FAULT_REACTION_ACTIVE = "Fault reaction active"
    FAULT = "Fault"
    UNKNOWN = "Unknown"


PATTERNS: tuple[tuple[int, int, State], ...] = (
    (0x4F, 0x00, State.NOT_READY_TO_SWITCH_ON),
    (0x4F, 0x40, State.SWITCH_ON_DISABLED),
    (0x6F, 0x21, State.READY_TO_SWITCH_ON),
    (0x6F, 0x23, State.SWITCHED_ON),
    (0x6F, 0x27, State.OPERATION_ENABLED),
    (0x6F, 0x07, State.QUICK_STOP_ACTIVE),
    (0x4F, 0x0F, State.FAULT_REACTION_ACTIVE),
    (0x4F, 0x08, State.FAULT),
)
"""Mask, value, state: the drive is in the state for which `statusword & mask == value`."""

_STATE_BITS = 0x6F
_BY_BITS = tuple(
    next((state for mask, value, state in PATTERNS if bits & mask == value), State.UNKNOWN)
    for bits in range(_STATE_BITS + 1)
)

VOLTAGE_ENABLED, WARNING, REMOTE, INTERNAL_LIMIT = 0x0010, 0x0080, 0x0200, 0x0800
"""Bits of the statusword: without the first there is no torque in any state, without the third the drive does not
follow the controlword; the other two announce something while the drive goes on."""
ADVISORY = WARNING | INTERNAL_LIMIT

FLAGS: tuple[tuple[int, str], ...] = (
    (4, "voltage enabled"),
    (7, "warning"),
    (9, "remote"),
    (10, "target reached"),
    (11, "internal limit active"),
)
"""Bits of the statusword that are not part of the state."""


def classify(statusword: int) -> State:
    """The state that `statusword` reports; UNKNOWN if its bits match none. Defined for all 65,536 words."""
    return _BY_BITS[statusword & _STATE_BITS]


def flags(statusword: int) -> tuple[str, ...]:
    """Names of the other bits that are set in `statusword`."""
    return tuple(name for bit, name in FLAGS if statusword >> bit & 1)


DISABLE_VOLTAGE = 0x0000
QUICK_STOP = 0x0002
SHUTDOWN = 0x0006
SWITCH_ON = 0x0007
ENABLE_OPERATION = 0x000F
FAULT_RESET = 0x0080
RAMP_BITS = 0x0070
"""Bits 4 to 6 in velocity mode (2): enable, unlock and reference ramp. Full run value 007Fh; with ENABLE_OPERATION."""

_FROM_BELOW = {
    State.SWITCH_ON_DISABLED: SHUTDOWN,  # 2
    State.READY_TO_SWITCH_ON: SWITCH_ON,  # 3
    State.SWITCHED_ON: ENABLE_OPERATION,  # 4
    State.OPERATION_ENABLED: ENABLE_OPERATION,
}
# Transition 16 (quick stop active straight to operation enabled) is optional in the standard and left out: after a
# quick stop a drive is switched off (12) before it may run again.
TOWARDS: dict[State, dict[State, int]] = {
    State.SWITCH_ON_DISABLED: {},  # 7, 9, 10, 12
    State.READY_TO_SWITCH_ON: dict.fromkeys(_FROM_BELOW, SHUTDOWN),  # 2, 6, 8
    State.SWITCHED_ON: {**dict.fromkeys(_FROM_BELOW, SWITCH_ON), State.SWITCH_ON_DISABLED: SHUTDOWN},  # 2, 3, 5
    State.OPERATION_ENABLED: _FROM_BELOW,
    State.QUICK_STOP_ACTIVE: dict.fromkeys(State, QUICK_STOP),  # 7, 10, 11; no effect elsewhere
}
"""Controlword by target, then present state; DISABLE_VOLTAGE for a state that is not listed."""

FAULT_RESET_PATIENCE = 250
"""Cycles within which a drive must leave Fault after the edge: 1 s at 250 Hz."""

FAULTY = frozenset({State.FAULT, State.FAULT_REACTION_ACTIVE})


def controlword_towards(state: State, target: State) -> int:
    """The controlword that leads one transition from `state` towards `target`, or holds it there.

    This function never leads a drive out of a fault, see `FaultReset`. A drive in Switch on disabled stays there
    under the target QUICK_STOP_ACTIVE, so that a quick stop that ends by itself (605Ah = 0 to 2) ends for good.

    Raises:
        ValueError: `target` is not a state that a master can command.
    """
    try:
        return TOWARDS[target].get(state, DISABLE_VOLTAGE)
    except KeyError:
        raise ValueError(f"no controlword leads to {target.value!r}") from None


class FaultResetOutcome(Enum):
    """How a fault reset went."""

    PENDING = "pending"
    DONE = "done"
    NOT_RESET = "not reset"


class FaultReset:
    """One fault reset (transition 15): bit 7 low for a cycle, then high until the fault is gone or patience runs out.

    It leads at most to Switch on disabled. `patience` is in calls of `controlword`.
    """

    __slots__ = ("_left", "_rising", "outcome")

    def __init__(self, patience: int) -> None:
        self.outcome = FaultResetOutcome.PENDING
        self._left = patience
        self._rising = False

    def controlword(self, state: State) -> int:
        """The word of this cycle, from the state that the drive reported last."""
        if self.outcome is FaultResetOutcome.PENDING:
            if state not in FAULTY:
                self.outcome = FaultResetOutcome.DONE
            elif self._left <= 0:
                self.outcome = FaultResetOutcome.NOT_RESET
            elif self._rising:
                self._left -= 1
                return FAULT_RESET
            else:
                self._rising = True
        return DISABLE_VOLTAGE
