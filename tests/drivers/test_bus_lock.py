"""The lock on a bus: one holder, named to the others, released with its process whatever ends it."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from uuid import uuid4

import pytest

from upright.drivers.bus.errors import BusError
from upright.drivers.bus.lock import BusLock, lock_buses

HOLD = """
import sys
from upright.drivers.bus.lock import BusLock
lock = BusLock(sys.argv[-1])
print(flush=True)
sys.stdin.read()
"""


@pytest.fixture
def address() -> str:
    return f"socketcan:test-{uuid4().hex}"


def test_second_holder_is_refused_and_told_of_the_first(address: str) -> None:
    command = [sys.executable, "-c", HOLD, "serve", "monocab", "--bus", address]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as first:
        assert first.stdout is not None
        first.stdout.readline()
        for _ in range(20):  # however often it is asked, and never answers
            with pytest.raises(BusError) as refused:
                BusLock(address)
            assert f"{address} is already served by " in str(refused.value)
        assert refused.value.bus == address
        assert refused.value.remedy
        first.kill()
        first.wait()
    BusLock(address).close()


def test_holder_is_named_with_its_command(address: str) -> None:
    command = [sys.executable, "-c", HOLD, "serve", "monocab", "--bus", address]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as first:
        assert first.stdout is not None
        first.stdout.readline()
        with pytest.raises(BusError, match=rf"process {first.pid} \(upright serve monocab --bus {address}\)"):
            BusLock(address)
        first.kill()


def test_either_all_buses_are_locked_or_none(address: str) -> None:
    taken = BusLock(address)
    with pytest.raises(BusError, match="this process"):
        lock_buses([f"{address}-other", address])
    BusLock(f"{address}-other").close()
    taken.close()


def test_bus_within_a_process_needs_no_lock(address: str) -> None:
    assert lock_buses(["virtual:demo", "virtual:demo"]) == []
    (lock,) = lock_buses([address, address])
    lock.close()


async def test_holder_lets_go_of_those_who_ask(address: str) -> None:
    lock = BusLock(address)
    lock.start()
    for _ in range(30):
        with pytest.raises(BusError, match=f"process {os.getpid()}|this process"):
            BusLock(address)
        await asyncio.sleep(0.001)
    lock.close()
