"""The phases of an experiment, the same for every vehicle, as recorded in channel `phase`."""

from __future__ import annotations

from enum import IntEnum

from upright.telemetry.channels import IDLE


class Phase(IntEnum):
    """The phase that an experiment is in; recorded in channel `phase`."""

    NONE = IDLE
    REST = 1
    ENABLE = 2
    CENTRE = 3
    RISE = 4
    SETTLE = 5
    EXCITE = 6
    FADE = 7
    LOWER = 8
    CENTRE_BACK = 9
    DISABLE = 10
    MOVE = 11
    """In place of all that is off the support, in an experiment that stays on it."""

    @property
    def text(self) -> str:
        """The phase in words."""
        return _TEXTS[self]


_TEXTS = {
    Phase.NONE: "nothing runs",
    Phase.REST: "at rest: the roll filter settles",
    Phase.ENABLE: "enabling the drives",
    Phase.CENTRE: "on the support: bringing the drives to the middle",
    Phase.RISE: "rising from the support",
    Phase.SETTLE: "upright: settling",
    Phase.EXCITE: "exciting",
    Phase.FADE: "excitation over: settling",
    Phase.LOWER: "lowering onto the support",
    Phase.CENTRE_BACK: "on the support: bringing the drives back",
    Phase.DISABLE: "disabling the drives",
    Phase.MOVE: "on the support: moving the drives",
}

DURATIONS = {Phase.REST: 4.0, Phase.SETTLE: 3.0, Phase.FADE: 1.5}
"""s, of the phases with a fixed duration."""

TIMEOUTS = {Phase.ENABLE: 5.0, Phase.CENTRE: 30.0, Phase.LOWER: 12.0, Phase.CENTRE_BACK: 30.0, Phase.DISABLE: 3.0}
"""s after which a phase that should have ended counts as failed. ENABLE covers a drive's pause before re-enabling."""

POWERED = frozenset(set(Phase) - {Phase.NONE, Phase.REST, Phase.ENABLE, Phase.DISABLE})
"""Phases in which every drive must be in Operation enabled."""

BALANCING = frozenset({Phase.RISE, Phase.SETTLE, Phase.EXCITE, Phase.FADE, Phase.LOWER})
"""Phases off the support."""


UPRIGHT = frozenset({Phase.SETTLE, Phase.EXCITE, Phase.FADE})
"""Phases in which the vehicle is to stay up."""
