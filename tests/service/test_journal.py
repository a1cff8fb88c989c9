"""The log's records, as the journal's native protocol has them, on a real datagram socket."""

from __future__ import annotations

import logging
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from upright.service.journal import JournalHandler, in_journal


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[tuple[Path, socket.socket]]:
    """The journal's place."""
    path = tmp_path / "socket"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(str(path))
        server.setblocking(False)
        yield path, server


def entries(datagram: bytes) -> dict[str, str]:
    """The fields of a datagram, read as the protocol's page says."""
    fields: dict[str, str] = {}
    while datagram:
        line, _, datagram = datagram.partition(b"\n")
        name, is_line, value = line.partition(b"=")
        if not is_line:
            (length,) = struct.unpack("<Q", datagram[:8])
            value, datagram = datagram[8 : 8 + length], datagram[8 + length + 1 :]
        fields[name.decode()] = value.decode()
    return fields


@pytest.fixture
def logger(journal: tuple[Path, socket.socket]) -> Iterator[logging.Logger]:
    handler = JournalHandler({"UPRIGHT_VEHICLE": "monocab"}, journal[0])
    logger = logging.Logger("upright.of_a_test")  # known to nobody else
    logger.addHandler(handler)
    yield logger
    handler.close()


def test_a_record_has_its_place_and_its_fields(journal: tuple[Path, socket.socket], logger: logging.Logger) -> None:
    logger.warning("%s is warm", "left", extra={"fields": {"UPRIGHT_CODE": "drive_warning", "UPRIGHT_EXPERIMENT": ""}})
    fields = entries(journal[1].recv(65536))
    assert fields.pop("CODE_FILE") == __file__
    assert int(fields.pop("CODE_LINE")) > 0
    assert fields == {
        "MESSAGE": "left is warm",
        "PRIORITY": "4",
        "SYSLOG_IDENTIFIER": "upright",
        "LOGGER": "upright.of_a_test",
        "CODE_FUNC": "test_a_record_has_its_place_and_its_fields",
        "UPRIGHT_VEHICLE": "monocab",
        "UPRIGHT_CODE": "drive_warning",
    }


def test_a_traceback_is_one_record_and_no_line_of_it_can_be_taken_for_a_field(
    journal: tuple[Path, socket.socket], logger: logging.Logger
) -> None:
    try:
        raise ValueError("one\nUPRIGHT_VEHICLE=another")
    except ValueError as error:
        logger.critical("a control cycle failed", exc_info=error)
    fields = entries(journal[1].recv(65536))
    assert (fields["PRIORITY"], fields["UPRIGHT_VEHICLE"]) == ("2", "monocab")
    assert fields["MESSAGE"].startswith("a control cycle failed\nTraceback")
    assert fields["MESSAGE"].endswith("UPRIGHT_VEHICLE=another")


def test_a_journal_that_does_not_read_holds_nobody_up(
    journal: tuple[Path, socket.socket], logger: logging.Logger
) -> None:
    for _ in range(10_000):
        logger.error("again")
    handler = logger.handlers[0]
    assert isinstance(handler, JournalHandler)
    assert handler.unsent > 0


def test_standard_error_is_the_journal_only_if_it_is_what_systemd_connected() -> None:
    assert not in_journal({})
    assert not in_journal({"JOURNAL_STREAM": "1:2"})
    answer = "import os, sys; from upright.service.journal import in_journal; s = os.fstat(2)\n"
    answer += "sys.exit(not in_journal({'JOURNAL_STREAM': f'{s.st_dev}:{s.st_ino}'}))"
    subprocess.run([sys.executable, "-c", answer], check=True, timeout=30, env={**os.environ})
