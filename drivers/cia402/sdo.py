"""The object dictionary of one drive over SDO (CiA 301), with errors that name node, object and remedy.

Blocking: must run in a thread of its own. Two threads must not use one node at the same time. canopen does the
transfers, over a client that matches answers to questions (`sdo_client`).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import canopen

from upright.drivers.cia301.sdo_client import WALL, Clock, PatientClient
from upright.drivers.cia402.config import DriveConfig
from upright.drivers.cia402.objects import ObjectEntry
from upright.telemetry.errors import UprightError

T = TypeVar("T")

LONGEST = 64
"""Bytes of an entry after which a node that always has one more segment is taken to be faulty."""

BUSY = 0x08000022
"""SDO abort code of a drive that cannot do it in its present state, as while it boots or stores."""

BUSY_PAUSE = 0.05
"""s before a busy drive is asked again."""

ALL_BITS = (1 << 64) - 1

NO_SUCH_OBJECT = frozenset({0x06020000, 0x06090011})
"""SDO abort codes for an index or a subindex that does not exist."""


class DriveSetupError(UprightError):
    """A drive that cannot be set up.

    Attributes: drive, node, entry (None if no object is concerned), reason (the message without drive and node).
    """

    def __init__(self, config: DriveConfig, message: str, *, entry: ObjectEntry | None = None, remedy: str) -> None:
        self.reason = f"{entry}: {message}" if entry else message
        super().__init__(f"drive {config.name!r} (node {config.node}): {self.reason}", remedy=remedy)
        self.drive = config.name
        self.node = config.node
        self.entry = entry


class MissingNode(DriveSetupError):
    """Nothing answers under the node id."""


class MissingObject(DriveSetupError):
    """The drive does not have the object."""


class Refused(DriveSetupError):
    """The drive answers that it does not do it, or does not do it. `code` is the SDO abort code, 0 if there is none."""

    code = 0


def milliseconds(seconds: float) -> int:
    """A time as CANopen objects hold it, in ms: rounded up, at least 1."""
    return max(1, math.ceil(seconds * 1000.0 - 1e-6))


class SdoDialogue:
    """Reads and writes entries of one drive. Collects what it lacks (`warnings`) and what was written (`changes`)."""

    def __init__(self, network: canopen.Network, config: DriveConfig, clock: Clock = WALL) -> None:
        self.config = config
        self.clock = clock
        self.warnings: list[str] = []
        self.changes: list[str] = []
        self._sdo = PatientClient(network, config.node, config.sdo_timeout, clock)
        self._answered = False

    def close(self) -> None:
        """Hear no more of the drive."""
        self._sdo.close()

    def read(self, entry: ObjectEntry) -> int:
        """The value of `entry`.

        Raises:
            MissingNode, MissingObject: no answer, no such object.
            DriveSetupError: the drive refuses, or the object has another type.
        """
        size, data = self._when_ready(lambda: self._upload(entry))
        if size is None and len(data) <= LONGEST:
            data = data[: entry.size]  # expedited without a size: four bytes, of which only the first are valid
        try:
            return entry.unpack(data)
        except struct.error as error:
            raise DriveSetupError(
                self.config,
                f"has {len(data)} bytes in the drive, not {entry.size}",
                entry=entry,
                remedy="The EDS or the object index is not that of this drive; use the maker's.",
            ) from error

    def find(self, entry: ObjectEntry) -> int | None:
        """As `read`; None if the drive does not have the object."""
        try:
            return self.read(entry)
        except MissingObject:
            return None

    def write(self, entry: ObjectEntry, value: int) -> None:
        """Write `entry` without reading it first. Raises as `read`."""
        self._when_ready(lambda: self._download(entry, value))

    def set(self, entry: ObjectEntry, value: int, *, bits: int = ALL_BITS) -> None:
        """Make `entry` have `value`: written only if it differs in one of the `bits` that matter, and read back.

        Raises:
            Refused: the drive does not take the value, or keeps another.
            DriveSetupError: as `read`.
        """
        before = self.read(entry)
        if (before ^ value) & bits == 0:
            return
        self.write(entry, value)
        found = self.read(entry)
        if (found ^ value) & bits:
            raise Refused(
                self.config,
                f"is still {found:#x} after {value:#x} was written",
                entry=entry,
                remedy="The drive does not take this value; change it in the vehicle file or in the drive.",
            )
        self.changes.append(f"{entry}: {before:#x} -> {value:#x}")

    def set_where_present(self, entry: ObjectEntry, value: int, *, without: str, bits: int = ALL_BITS) -> bool:
        """As `set`; if the drive lacks `entry`, warn of the consequence (`without`) and return False."""
        try:
            self.set(entry, value, bits=bits)
        except MissingObject:
            self.warnings.append(f"no {entry}: {without}")
            return False
        return True

    def set_if_accepted(self, entry: ObjectEntry, value: int, *, without: str, bits: int = ALL_BITS) -> bool:
        """As `set_where_present`, for what the vehicle can do without: a refusal is a warning as well."""
        try:
            return self.set_where_present(entry, value, without=without, bits=bits)
        except Refused as error:
            self.warnings.append(f"{error.reason}: {without}")
            return False

    def set_time(self, entry: ObjectEntry, value: int, *, without: str) -> bool:
        """As `set_if_accepted`, for a time in the lower 16 bits of `value`, in ms, that a drive may round.

        A time that is not the one asked for, but between half and twice of it, is a warning.
        """
        try:
            return self.set_where_present(entry, value, without=without)
        except Refused as error:
            found, reason = self.read(entry), error.reason
        wanted, kept = value & 0xFFFF, found & 0xFFFF
        if found >> 16 == value >> 16 and wanted <= 2 * kept <= 4 * wanted:
            self.warnings.append(f"{entry}: the drive has {kept} ms in place of {wanted} ms")
            return True
        self.warnings.append(f"{reason}: {without}")
        return False

    def refuse(self, message: str, *, entry: ObjectEntry | None = None, remedy: str) -> DriveSetupError:
        """The error to raise for a problem with this drive."""
        return DriveSetupError(self.config, message, entry=entry, remedy=remedy)

    def _upload(self, entry: ObjectEntry) -> tuple[int | None, bytes]:
        """The size that the drive states, and the bytes."""
        data = b""
        with self._transfer(entry, "reading"), self._sdo.open(entry.index, entry.subindex, buffering=0) as stream:  # type: ignore[no-untyped-call]
            size: int | None = stream.size
            while len(data) <= LONGEST and (segment := stream.read(7)):
                data += segment
        self._answered = True
        return size, data

    def _download(self, entry: ObjectEntry, value: int) -> None:
        with self._transfer(entry, f"writing {value:#x}"):
            self._sdo.download(entry.index, entry.subindex, entry.pack(value))
        self._answered = True

    def _when_ready(self, transfer: Callable[[], T]) -> T:
        """The result of a transfer, which is tried again for the time of an answer if the drive is not ready for it."""
        deadline = self.clock.now() + self.config.sdo_timeout
        while True:
            try:
                return transfer()
            except Refused as error:
                if error.code != BUSY or self.clock.now() > deadline:
                    raise
            self.clock.sleep(BUSY_PAUSE)

    @contextmanager
    def _transfer(self, entry: ObjectEntry, doing: str) -> Iterator[None]:
        """Every way in which a transfer can fail, as a DriveSetupError."""
        try:
            yield
        except canopen.SdoAbortedError as error:
            raise self._aborted(entry, doing, error) from error
        except canopen.SdoCommunicationError as error:
            raise self._silent(entry, error) from error
        except UprightError:
            raise
        except Exception as error:  # canopen takes an answer for well-formed, and fails in many ways where it is not
            raise DriveSetupError(
                self.config,
                f"the answer to {doing} is not one of CiA 301 ({type(error).__name__}: {error})",
                entry=entry,
                remedy="Check that no other node has this node id, and that its SDO answers have eight bytes.",
            ) from error

    def _aborted(self, entry: ObjectEntry, doing: str, error: canopen.SdoAbortedError) -> DriveSetupError:
        self._answered = True
        kind = MissingObject if error.code in NO_SUCH_OBJECT else Refused
        text = canopen.SdoAbortedError.CODES.get(error.code, "unknown reason")
        refused = kind(
            self.config,
            f"the drive refuses {doing}: {text} (SDO abort {error.code:08X}h)",
            entry=entry,
            remedy="Compare the drive's manual with the vehicle file; a drive may refuse writes while it is enabled.",
        )
        if isinstance(refused, Refused):
            refused.code = error.code
        return refused

    def _silent(self, entry: ObjectEntry, error: Exception) -> DriveSetupError:
        if self._sdo.strays:
            return DriveSetupError(
                self.config,
                f"the node does not answer the question, but sends {len(self._sdo.strays)} other SDO answers (the last "
                f"is {self._sdo.strays[-1].hex(' ') or 'empty'})",
                entry=entry,
                remedy="Check that no other node has this node id, and that no other SDO client asks this drive.",
            )
        if self._answered:
            return DriveSetupError(
                self.config,
                f"the node answered before, but no longer does ({error})",
                entry=entry,
                remedy="Check the cable, and that no other SDO client is on the bus; if the drive is busy for longer "
                f"than {self.config.sdo_timeout:g} s, as while it stores a mapping, write sdo_timeout in its section.",
            )
        return MissingNode(
            self.config,
            "nothing answers under this node id",
            remedy="Check the drive's power, the cable and its termination, the bit rate, and the node id set in it.",
        )
