"""Network management of CANopen (CiA 301): the states in a node's heartbeat and the commands of the master."""

from __future__ import annotations

from enum import Enum

COMMAND_COB_ID = 0x000
EMERGENCY_COB_ID = 0x080
HEARTBEAT_COB_ID = 0x700


class NmtState(Enum):
    """What a heartbeat (700h + node) carries."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class NmtCommand(Enum):
    """A command of the master to a node."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


NMT_STATES = {state.value: state for state in NmtState}
"""Heartbeat byte to state."""


def command_frame(command: NmtCommand, node: int) -> tuple[int, bytes]:
    """The frame of a command as (COB-ID, data); node 0 is all nodes."""
    return COMMAND_COB_ID, bytes((command.value, node))


def heartbeat_frame(node: int, state: NmtState = NmtState.OPERATIONAL) -> tuple[int, bytes]:
    """The heartbeat of `node` as (COB-ID, data); the master sends its own from the control loop."""
    return HEARTBEAT_COB_ID + node, bytes((state.value,))
