"""What real drives do over SDO that CiA 301 allows and a master has to bear: they are busy, slow, and refuse.

Values are of drives in public reports: answers after 0.1 to 0.5 s for some seconds after boot-up, or while a mapping
is stored; a mode that is shown seconds after it was requested; communication objects that cannot be written.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

READ_ONLY = 0x0601_0002
VALUE_NOT_KNOWN = 0x0609_0030
NOT_NOW = 0x0800_0022
"""SDO abort codes: read-only, invalid value, not possible in the present state."""

Key = tuple[int, int]
"""Index and subindex."""


@dataclass(frozen=True, slots=True)
class DriveHabits:
    """How a drive answers; by default at once, to everything. Times in s."""

    answer_time: float = 0.0
    """From a request to its answer."""
    boot_time: float = 0.0
    """After boot-up, during which requests wait."""
    store_time: float = 0.0
    """Longer that it takes to write a PDO parameter."""
    mode_time: float = 0.0
    """From the request of a mode (6060h) to its display (6061h)."""
    not_ready_time: float = 0.0
    """After boot-up, during which it refuses to be written."""
    lost_answer: int = 0
    """Of so many answers one gets lost; 0: none."""
    read_only: Iterable[Key] = ()
    known: Mapping[Key, tuple[int, ...]] = field(default_factory=dict)
    """The only values that it takes for an object, as unsigned numbers."""
    rounded: Mapping[Key, int] = field(default_factory=dict)
    """Objects of which it keeps multiples of this number only, rounded up."""
    initial: Mapping[Key, bytes] = field(default_factory=dict)
    """Values after boot-up in place of those of its EDS."""

    def refusal(self, index: int, subindex: int, value: int, since_boot: float) -> int:
        """The abort code of a write, 0 if it is accepted. `since_boot` in s."""
        if (index, subindex) in self.read_only:
            return READ_ONLY
        if value not in self.known.get((index, subindex), (value,)):
            return VALUE_NOT_KNOWN
        return NOT_NOW if since_boot < self.not_ready_time else 0
