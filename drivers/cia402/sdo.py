"""The object dictionary of one drive over SDO (CiA 301), with errors that name node, object and remedy.

Blocking: must run in a thread of its own. Two threads must not use one node at the same time. canopen does the
transfers.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager

import canopen

from drivers.cia402.config import DriveConfig
from drivers.cia402.objects import ObjectEntry
from telemetry.errors import UprightError

ATTEMPTS = 3
"""Requests that are sent before a node counts as silent (0.3 s each)."""

LONGEST = 64
"""Bytes of an entry after which a node that always has one more segment is taken to be faulty."""

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


def milliseconds(seconds: float) -> int:
    """A time as CANopen objects hold it, in ms: rounded up, at least 1."""
    return max(1, math.ceil(seconds * 1000.0 - 1e-6))


class SdoDialogue:
    """Reads and writes entries of one drive. Collects what it lacks (`warnings`) and what was written (`changes`)."""

    def __init__(self, node: canopen.RemoteNode, config: DriveConfig) -> None:
        self.config = config
        self.warnings: list[str] = []
        self.changes: list[str] = []
        self._sdo = node.sdo
        self._sdo.MAX_RETRIES = ATTEMPTS
        self._answered = False

    def read(self, entry: ObjectEntry) -> int:
        """The value of `entry`.

        Raises:
            MissingNode, MissingObject: no answer, no such object.
            DriveSetupError: the drive refuses, or the object has another type.
        """
        data = b""
        with self._transfer(entry, "reading"), self._sdo.open(entry.index, entry.subindex, buffering=0) as stream:
            size: int | None = stream.size
            while len(data) <= LONGEST and (segment := stream.read(7)):
                data += segment
        self._answered = True
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
        with self._transfer(entry, f"writing {value:#x}"):
            self._sdo.download(entry.index, entry.subindex, entry.pack(value))

    def set(self, entry: ObjectEntry, value: int) -> None:
        """Make `entry` have `value`: written only if it differs, and read back.

        Raises:
            DriveSetupError: as `read`, or the drive keeps another value.
        """
        before = self.read(entry)
        if before == value:
            return
        self.write(entry, value)
        found = self.read(entry)
        if found != value:
            raise DriveSetupError(
                self.config,
                f"is still {found:#x} after {value:#x} was written",
                entry=entry,
                remedy="The drive does not take this value; change it in the vehicle file or in the drive.",
            )
        self.changes.append(f"{entry}: {before:#x} -> {value:#x}")

    def set_where_present(self, entry: ObjectEntry, value: int, *, without: str) -> bool:
        """As `set`; if the drive lacks `entry`, warn of the consequence (`without`) and return False."""
        try:
            self.set(entry, value)
        except MissingObject:
            self.warnings.append(f"no {entry}: {without}")
            return False
        return True

    def refuse(self, message: str, *, entry: ObjectEntry | None = None, remedy: str) -> DriveSetupError:
        """The error to raise for a problem with this drive."""
        return DriveSetupError(self.config, message, entry=entry, remedy=remedy)

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
        kind = MissingObject if error.code in NO_SUCH_OBJECT else DriveSetupError
        text = canopen.SdoAbortedError.CODES.get(error.code, "unknown reason")
        return kind(
            self.config,
            f"the drive refuses {doing}: {text} (SDO abort {error.code:08X}h)",
            entry=entry,
            remedy="Compare the drive's manual with the vehicle file; a drive may refuse writes while it is enabled.",
        )

    def _silent(self, entry: ObjectEntry, error: Exception) -> DriveSetupError:
        if self._answered:
            return DriveSetupError(
                self.config,
                f"the node answered before, but no longer does ({error})",
                entry=entry,
                remedy="Check the cable, and that no other SDO client is on the bus.",
            )
        return MissingNode(
            self.config,
            "nothing answers under this node id",
            remedy="Check the drive's power, the cable and its termination, the bit rate, and the node id set in it.",
        )
