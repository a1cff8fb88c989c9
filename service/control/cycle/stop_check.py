"""The verification of a stop: the drives are off when each of them says so, not when they were told to be.

After a quick stop, or an experiment that ended, every drive has to report in its statusword that it is not enabled.
While one does not, the heartbeat is withheld for as long as the drives wait for it (1016h), so that one that ignores
its controlword is stopped by its own watchdog. The drives that did confirm get a communication fault by that, which the
next set-up resets. Pure: time passes by `step`.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

from upright.drivers.cia301.nmt import NmtState
from upright.drivers.cia402.drive import Drive
from upright.drivers.cia402.states import State

CYCLES = 5
"""Control cycles after the quick stop within which a drive has to confirm."""

REACTION = 1.0
"""s, after the heartbeat was withheld, that a drive may take to brake and to say that it is off."""

OFF = frozenset(
    {State.NOT_READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON}
    | {State.SWITCHED_ON, State.FAULT}
)
"""States without torque."""


class Stop(Enum):
    """How far a stop has come."""

    VERIFIED = "every drive has confirmed, or nothing was stopped"
    WAITING = "the drives stop"
    WITHHELD = "the heartbeat is withheld, for a drive that has not confirmed"
    BRAKING = "the heartbeat was withheld, and a drive that reacted to it still brakes"
    FAILED = "a drive has not confirmed"


class StopCheck:
    """Checks the stops of `drives`, whose heartbeat timeout is `timeout` s, with control cycles of `period` s."""

    def __init__(self, drives: Sequence[Drive], *, period: float, timeout: float) -> None:
        self.stage = Stop.VERIFIED
        self._drives = tuple(drives)
        self._grace = CYCLES * period
        self._fresh_ns = round(CYCLES * period * 1e9)
        self._timeout = timeout
        self._left = 0.0
        self._began_ns = self._now_ns = 0

    @property
    def withheld(self) -> bool:
        """Whether the heartbeat must not be sent now."""
        return self.stage is Stop.WITHHELD

    @property
    def over(self) -> bool:
        return self.stage is Stop.VERIFIED or self.stage is Stop.FAILED

    def begin(self, now_ns: int, braking: float) -> None:
        """The drives are stopped from `now_ns` on; they have `braking` s until they are to switch off."""
        self.stage = Stop.WAITING
        self._began_ns = self._now_ns = now_ns
        self._left = braking + self._grace

    def settle(self) -> None:
        """The drives have been found to be off in another way, as by their set-up."""
        self.stage = Stop.VERIFIED

    def step(self, dt: float) -> Stop:
        """Let `dt` s pass. Returns the stage, FAILED as soon as it is certain."""
        if self.over:
            return self.stage
        self._left -= dt
        self._now_ns += round(dt * 1e9)
        if not self.unconfirmed():
            self.stage = Stop.VERIFIED
        elif self._left <= 0.0:
            if self.stage is Stop.WAITING:
                self.stage, self._left = Stop.WITHHELD, self._timeout
            elif self.stage is Stop.WITHHELD and not self.enabled():
                self.stage, self._left = Stop.BRAKING, REACTION
            else:
                self.stage = Stop.FAILED
        return self.stage

    def unconfirmed(self) -> list[Drive]:
        """The drives that have not confirmed to be off since the stop began."""
        return [drive for drive in self._drives if not self._is_off(drive)]

    def enabled(self) -> list[Drive]:
        """The drives that still say that they are enabled. One that says nothing any more is only `unconfirmed`."""
        since_ns = max(self._began_ns, self._now_ns - self._fresh_ns)
        return [
            drive
            for drive in self._drives
            if drive.statusword_timestamp_ns > since_ns and drive.state is State.OPERATION_ENABLED
        ]

    def _is_off(self, drive: Drive) -> bool:
        if drive.restarted:
            return True  # it has booted since, and boots with its power off
        if drive.heartbeat_timestamp_ns > self._began_ns and drive.nmt_state is NmtState.STOPPED:
            return drive.state is not State.OPERATION_ENABLED  # sends no statusword any more
        return drive.statusword_timestamp_ns > self._began_ns and drive.state in OFF
