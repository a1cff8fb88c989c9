"""sd_notify against a real datagram socket in place of systemd's."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from upright.service.control.notify import Notifier, NotifyError


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    """A service manager's socket, and its name as given in $NOTIFY_SOCKET."""
    name = f"@upright-test-{os.getpid()}" if request.param == "abstract" else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(name.replace("@", "\0", 1))
        listener.setblocking(False)
        yield listener, name


def test_service_manager_receives_all_notifications_in_order(manager: tuple[socket.socket, str]) -> None:
    listener, name = manager
    notifier = Notifier.from_environment({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "2000000"})
    assert notifier.watchdog_timeout == 2.0
    notifier.ready("disarmed, bus vcan0")
    notifier.watchdog()
    notifier.status("balancing")
    notifier.stopping("asked to stop")
    notifier.close()
    assert [listener.recv(256) for _ in range(4)] == [
        b"READY=1\nSTATUS=disarmed, bus vcan0",
        b"WATCHDOG=1",
        b"STATUS=balancing",
        b"STOPPING=1\nSTATUS=asked to stop",
    ]
    with pytest.raises(BlockingIOError):
        listener.recv(256)
    assert notifier.unsent == 0


def test_without_a_service_manager_nothing_is_sent() -> None:
    notifier = Notifier.from_environment({})
    assert notifier.watchdog_timeout is None
    notifier.ready("disarmed")
    notifier.watchdog()
    notifier.close()
    assert notifier.unsent == 0


def test_watchdog_of_another_process_is_ignored() -> None:
    assert Notifier.from_environment({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}).watchdog_timeout is None
    ours = {"WATCHDOG_USEC": "500000", "WATCHDOG_PID": str(os.getpid())}
    assert Notifier.from_environment(ours).watchdog_timeout == 0.5


def test_unreachable_manager_is_reported_with_a_remedy(tmp_path: Path) -> None:
    with pytest.raises(NotifyError, match="cannot reach the service manager") as caught:
        Notifier(str(tmp_path / "gone"))
    assert "systemctl start upright" in caught.value.remedy


def test_full_queue_never_blocks_and_unsent_messages_are_counted(manager: tuple[socket.socket, str]) -> None:
    listener, name = manager
    notifier = Notifier(name)
    queue_limit = 5_000  # far beyond net.unix.max_dgram_qlen (10 by default, 512 under systemd)
    for _ in range(queue_limit):
        notifier.watchdog()
    assert 0 < notifier.unsent < queue_limit
    received = 0
    while notifier.unsent + received < queue_limit:
        assert listener.recv(64) == b"WATCHDOG=1"
        received += 1
    notifier.watchdog()
    assert listener.recv(64) == b"WATCHDOG=1"
    notifier.close()


def test_lost_manager_raises_nothing_and_unsent_messages_are_counted(tmp_path: Path) -> None:
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(address)
        notifier = Notifier(address)
    notifier.watchdog()
    notifier.status("still balancing")
    assert notifier.unsent == 2
    notifier.close()
