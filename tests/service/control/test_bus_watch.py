"""Traffic that no driver reads: strangers' frames and error frames are events, once."""

from __future__ import annotations

import pytest

from upright.drivers.bus.error_frames import ErrorClass
from upright.service.control import assembly
from upright.service.control.cycle.bus_watch import MANY, BusWatch
from upright.telemetry.samples import CanFrame
from upright.vehicles.file import load

IO = assembly.vehicle_io(load("monocab"))


class Witness:
    def __init__(self) -> None:
        self.said: list[tuple[str, str, str]] = []
        self.watch = BusWatch(IO, lambda *event: self.said.append(event))


@pytest.fixture
def witness() -> Witness:
    return Witness()


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (CanFrame(0, 0x07E, bytes(8)), "a frame with the id 07Eh and 8 bytes comes from a node that does not belong"),
        (CanFrame(0, 0x18A, bytes(8), extended=True), "0000018Ah"),
        (CanFrame(0, 0x18A, bytes(64)), "a CAN FD frame with the id 18Ah and 64 bytes"),
        (CanFrame(0, 0x581 + 50, bytes(8), 1), "05B3h"[1:]),
    ],
    ids=["unknown", "29 bits", "64 bytes", "other node, second bus"],
)
def test_frame_of_a_stranger_is_reported_once_with_its_id(witness: Witness, frame: CanFrame, words: str) -> None:
    for _ in range(3):
        witness.watch.meet(frame)
    ((severity, code, text),) = witness.said
    assert (severity, code) == ("warning", "foreign_frames")
    assert words in text
    assert ("on bus 2" in text) == (frame.bus == 1)
    assert [each["frames"] for each in witness.watch.statistics()] == [3]


@pytest.mark.parametrize("can_id", [0x581, 0x083, 0x702, 0x70A, 0x58A, 0x7E4, 0x100])
def test_services_of_the_vehicles_own_nodes_are_no_strangers(witness: Witness, can_id: int) -> None:
    witness.watch.meet(CanFrame(0, can_id, bytes(8)))
    assert witness.said == witness.watch.statistics() == []


def test_ids_without_number_are_counted_together(witness: Witness) -> None:
    for can_id in range(0x20000, 0x20000 + 10 * MANY):
        witness.watch.meet(CanFrame(0, can_id, b"", extended=True))
    assert len(witness.said) == len(witness.watch.statistics()) == MANY + 1
    assert witness.watch.statistics()[-1] == {"id": "others", "carries": "nothing of this vehicle", "frames": 9 * MANY}


ERROR = CanFrame(0, ErrorClass.NO_ACKNOWLEDGE, bytes(8), error=True)


def test_error_frames_in_most_cycles_are_reported_once_until_they_are_over(witness: Witness) -> None:
    def cycles(count: int, error: bool) -> None:
        for _ in range(count):
            if error:
                witness.watch.error(ERROR)
                witness.watch.error(ERROR)
            witness.watch.cycle()

    cycles(100, error=True)
    ((_, code, text),) = witness.said
    assert code == "bus_errors"
    assert "no acknowledge" in text
    cycles(1000, error=False)
    cycles(100, error=True)
    assert len(witness.said) == 2


def test_few_error_frames_are_what_a_bus_has(witness: Witness) -> None:
    for number in range(10_000):
        if number % 20 == 0:
            witness.watch.error(ERROR)
        witness.watch.cycle()
    assert witness.said == []
