"""The log of a service: records with fields for systemd's journal, and lines on standard error anywhere else.

The journal's native protocol (https://systemd.io/JOURNAL_NATIVE_PROTOCOL): one datagram a record, of lines FIELD=VALUE.
"""

from __future__ import annotations

import logging
import os
import socket
import struct
import sys
from collections.abc import Mapping
from pathlib import Path

JOURNAL = Path("/run/systemd/journal/socket")

EVENTS = logging.getLogger("upright.events")
"""What happens to the vehicle, for the journal alone: at a terminal, the command that asked for it tells it."""

LEVELS = {"info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}
"""Levels of the log by the severity of an event."""

_PRIORITIES = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
"""Priorities of syslog by the lowest level of the log that has them; 7 below."""


class JournalHandler(logging.Handler):
    """Sends each record to the journal, with `fields` and the record's own: `extra={"fields": {"UPRIGHT_CODE": ...}}`.

    It never waits: a record that the journal has no room for is dropped and counted in `unsent`.
    """

    def __init__(self, fields: Mapping[str, str], journal: Path = JOURNAL) -> None:
        """Raises OSError if nothing listens at `journal`."""
        super().__init__()
        self.unsent = 0
        self._fields = dict(fields)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.connect(str(journal))
        except OSError:
            self._socket.close()
            raise

    def emit(self, record: logging.LogRecord) -> None:
        fields = {
            "MESSAGE": self.format(record),
            "PRIORITY": str(next((priority for level, priority in _PRIORITIES if record.levelno >= level), 7)),
            "SYSLOG_IDENTIFIER": "upright",
            "LOGGER": record.name,
            "CODE_FILE": record.pathname,
            "CODE_LINE": str(record.lineno),
            "CODE_FUNC": record.funcName,
            **self._fields,
            **getattr(record, "fields", {}),
        }
        try:
            self._socket.send(b"".join(_entry(name, value) for name, value in fields.items() if value))
        except OSError:
            self.unsent += 1

    def close(self) -> None:
        self._socket.close()
        super().close()


def _entry(name: str, value: str) -> bytes:
    """One field: a line, or with its length in eight bytes where the value has lines of its own."""
    data = value.encode(errors="replace")
    if b"\n" not in data:
        return b"%s=%s\n" % (name.encode(), data)
    return b"%s\n%s%s\n" % (name.encode(), struct.pack("<Q", len(data)), data)


def in_journal(environment: Mapping[str, str] = os.environ) -> bool:
    """True if standard error is what systemd connected to the journal ($JOURNAL_STREAM: device and inode)."""
    try:
        error = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError, AttributeError):
        return False
    return environment.get("JOURNAL_STREAM") == f"{error.st_dev}:{error.st_ino}"


def log_as(vehicle: str) -> None:
    """Log this process, which serves `vehicle`: to the journal where systemd started it, else to standard error."""
    root = logging.getLogger()
    if in_journal():
        try:
            handler = JournalHandler({"UPRIGHT_VEHICLE": vehicle})
        except OSError as error:
            print(f"upright: no fields in the log: {JOURNAL}: {error.strerror}", file=sys.stderr)
        else:
            root.addHandler(handler)
            EVENTS.setLevel(logging.INFO)
            return
    logging.basicConfig(format="%(name)s: %(message)s")
    EVENTS.disabled = True
