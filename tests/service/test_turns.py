"""Turns: whoever has something to say is served, a bounded number in each turn, and the log never waits."""

from __future__ import annotations

import logging
import socket
import threading
from contextlib import ExitStack
from types import SimpleNamespace

import pytest

from upright.service import bounded_log, turns
from upright.service.bounded_log import MOST_A_SECOND, MOST_WAITING
from upright.service.turns import MOST_A_TURN, READ, Turns


@pytest.fixture(autouse=True)
def by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """No turns by the timer."""
    monkeypatch.setattr(turns, "PERIOD", 1e6)


async def test_turn_serves_a_bounded_number_in_rotation() -> None:
    served: list[int] = []
    made = Turns()
    with ExitStack() as stack:
        for number in range(10 * MOST_A_TURN):
            near, far = (stack.enter_context(end) for end in socket.socketpair())
            far.send(b"always something to say")
            made.watch(near.fileno(), READ, lambda events, number=number: served.append(number))
        for turn in range(1, 21):
            made.take()
            assert len(served) == turn * MOST_A_TURN
        assert sorted(served) == sorted(2 * [*range(10 * MOST_A_TURN)]), "each one twice, none more often"


async def test_turn_does_one_piece_of_queued_work() -> None:
    done: list[int] = []
    made = Turns()
    near, far = socket.socketpair()
    with near, far:
        made.watch(near.fileno(), READ, lambda events: None)
        for number in range(3):
            made.queue(lambda number=number: done.append(number))
        made.take()
        assert done == [0]
        made.take()
        made.take()
        made.take()
        assert done == [0, 1, 2]


async def test_one_that_is_forgotten_in_a_turn_is_not_served_in_it() -> None:
    made, served = Turns(), []
    with ExitStack() as stack:
        ends = [stack.enter_context(end) for _ in range(2) for end in socket.socketpair()]
        for near, other in ((ends[0], ends[2]), (ends[2], ends[0])):

            def serve(events: int, other: socket.socket = other) -> None:
                served.append(other)
                made.forget(other.fileno())

            made.watch(near.fileno(), READ, serve)
        ends[1].send(b"x")
        ends[3].send(b"x")
        made.take()
    assert len(served) == 1


class Stuck(logging.Handler):
    """A log that nobody reads, until it is released."""

    def __init__(self) -> None:
        super().__init__()
        self.released = threading.Event()
        self.written: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.released.wait(20.0)
        self.written.append(record.getMessage())


def test_log_that_nobody_reads_drops_records_and_says_so_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded_log, "MOST_A_SECOND", 1_000_000)
    stuck = Stuck()
    with bounded_log.bounded_log(stuck) as handler:
        for number in range(3 * MOST_WAITING):
            logging.getLogger("upright").error("record %d", number)  # would block here
        assert 2 * MOST_WAITING - 2 <= handler.dropped <= 2 * MOST_WAITING
        stuck.released.set()
    assert stuck.written[0] == "record 0"
    assert any("were dropped" in text for text in stuck.written)
    assert len(stuck.written) <= MOST_WAITING + 4


def test_log_takes_a_bounded_number_of_records_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded_log, "time", SimpleNamespace(monotonic=lambda: 100.5))
    stuck = Stuck()
    stuck.released.set()
    with bounded_log.bounded_log(stuck):
        for _ in range(10 * MOST_A_SECOND):
            logging.getLogger("upright").error("the same every cycle")
    assert stuck.written.count("the same every cycle") == MOST_A_SECOND
    assert any(text.startswith(f"{9 * MOST_A_SECOND} records of the log were dropped") for text in stuck.written)
