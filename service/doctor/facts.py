"""What is known of the computer that a vehicle is run from. Pure data; what could not be found out says why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

UNLIMITED = -1
"""Of a limit: there is none."""


@dataclass(frozen=True, slots=True)
class NotKnown:
    """What could not be found out, and why."""

    why: str


@dataclass(frozen=True, slots=True)
class Kernel:
    """The kernel: its release, what it says of preemption (uname -v), and why it cannot open CAN sockets ("")."""

    release: str
    version: str
    no_can: str = ""


@dataclass(frozen=True, slots=True)
class CanLink:
    """A CAN interface as `ip -details link` shows it. `bitrate` is in bit/s; it and `restart_ms` are None if
    the interface has none, as a `virtual` one."""

    name: str
    up: bool
    queue: int
    virtual: bool = False
    state: str = ""
    bitrate: int | None = None
    restart_ms: int | None = None


@dataclass(frozen=True, slots=True)
class Vehicle:
    """What its file says: CAN interfaces, bit/s, frames a cycle to the drives, cycles that may be missed, bytes of
    recording a second. `other_buses` are those that are no CAN interfaces of the kernel."""

    id: str
    interfaces: tuple[str, ...]
    other_buses: tuple[str, ...]
    bitrate: int
    frames_a_cycle: int
    missed_cycles: int
    bytes_a_second: float


@dataclass(frozen=True, slots=True)
class Process:
    """The running daemon: its scheduling policy and priority, kB of locked memory, and its version."""

    pid: int
    policy: str
    priority: int
    locked_kb: int | None
    version: str


@dataclass(frozen=True, slots=True)
class Unit:
    """The systemd unit `upright`. `policy` and `priority` are those it gives, `memlock` in bytes (UNLIMITED)."""

    installed: bool
    active: str = ""
    restarts: int = 0
    reload_needed: bool = False
    policy: str = ""
    priority: int = 0
    memlock: int = 0


@dataclass(frozen=True, slots=True)
class Clock:
    """The wall clock: whether something synchronises it, its greatest error, s, and the kernel's clock source."""

    synchronised: bool
    error: float
    source: str


@dataclass(frozen=True, slots=True)
class Broker:
    """The MQTT broker of the vehicle file; `trouble` is why it cannot be used, "" if it can."""

    address: str
    trouble: str = ""


@dataclass(frozen=True, slots=True)
class Software:
    """This software, its Python, and which of the packages it requires are missing or of another version."""

    version: str
    python: str
    wrong: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Disk:
    """The folder of the recordings: bytes free, and why nothing can be recorded there ("")."""

    folder: str
    free: int
    obstacle: str = ""


@dataclass(frozen=True, slots=True)
class Access:
    """Who asks, and what is refused to them, as (path, why, group that may)."""

    user: str
    refused: tuple[tuple[str, str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Limits:
    """RLIMIT_RTPRIO and RLIMIT_MEMLOCK (bytes, UNLIMITED) of the one who asks."""

    rtprio: int
    memlock: int


_NOT_ASKED = NotKnown("not asked")


@dataclass(frozen=True, slots=True)
class Facts:
    """Everything that is checked."""

    kernel: Kernel | NotKnown = _NOT_ASKED
    vehicle: Vehicle | NotKnown = _NOT_ASKED
    links: tuple[CanLink, ...] | NotKnown = _NOT_ASKED
    """Those of the vehicle that exist; all of the computer if no vehicle is known."""
    access: Access | NotKnown = _NOT_ASKED
    clock: Clock | NotKnown = _NOT_ASKED
    governors: Mapping[str, int] | NotKnown = _NOT_ASKED
    """How many processors have which frequency governor."""
    limits: Limits | NotKnown = _NOT_ASKED
    daemon: Process | NotKnown = _NOT_ASKED
    unit: Unit | NotKnown = _NOT_ASKED
    softirq: str | NotKnown = _NOT_ASKED
    """Scheduling policy of ksoftirqd, which delivers frames."""
    receive_buffer: int | NotKnown = _NOT_ASKED
    """net.core.rmem_max, bytes."""
    broker: Broker | NotKnown = _NOT_ASKED
    software: Software | NotKnown = _NOT_ASKED
    disk: Disk | NotKnown = _NOT_ASKED
    notes: tuple[str, ...] = field(default=())
    """Mistakes of the vehicle file, as sentences."""
