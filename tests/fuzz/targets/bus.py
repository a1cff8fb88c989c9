"""The bus: frames of any id, length and time in every state of the control loop, and drives that answer SDO wrongly."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import canopen
from faults.bench import Bench
from hypothesis import strategies as st
from simulated_bus import Harness

from fuzz.target import Refused, Target, Trial
from upright.drivers.canopen_link import CanopenLink
from upright.drivers.cia402 import eds
from upright.drivers.cia402.setup import Supervision, configure
from upright.service.control import assembly
from upright.service.control.cycle.operation import Mode
from upright.telemetry.samples import CanFrame
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import load

# Frames into the control loop

HEAD = struct.Struct("<BIqB")
"""Of a frame in an input: control cycles before it, id with the flags of linux/can.h, ns that its time stamp is late,
length. Its data follow. The first byte of an input chooses the state."""
EXTENDED, REMOTE, ERROR = 0x80000000, 0x40000000, 0x20000000
STATES: tuple[Phase | Mode, ...] = (Mode.DISARMED, Mode.FAULT, *(phase for phase in Phase if phase is not Phase.NONE))
AFTER = 3
"""Control cycles after the last frame."""
LEANING = 0.05
"""rad, about as a vehicle on its support."""


class OpenBench(Bench):
    """Raises what the control loop raises, and passes on to canopen what the daemon passes on."""

    def __init__(self, kind: str) -> None:
        self._frames: list[CanFrame] = []
        super().__init__(load(kind))
        self.link = CanopenLink(Silent())  # type: ignore[arg-type]
        self.loop._unclaimed = lambda frame: self.link.handle(frame) if frame.bus == 0 else None

    def _guarded(self, action: Callable[[], None]) -> None:
        action()

    def bring_to(self, state: Phase | Mode) -> None:
        """A state that the daemon can be in, without the time that it takes to reach it."""
        loop = self.loop
        if loop.mode is Mode.FAULT and state is not Mode.FAULT:
            loop.reset_fault()
            loop.set_up_done()
        if state is Mode.FAULT and loop.mode is not Mode.FAULT:
            loop.stop_now("for a test")
        if isinstance(state, Phase):
            if loop.run is None or loop.mode is not Mode.RUNNING:
                loop.start_experiment(next(iter(self.vehicle.experiments)))
            assert loop.run is not None
            loop.run.phase = state
        self.witness.frames.clear()
        self.witness.events.clear()


class Silent:
    """A bus that carries nothing."""

    def send_threadsafe(self, can_id: int, data: bytes) -> None: ...


def frames_of(data: bytes, now: int) -> Iterator[tuple[int, CanFrame]]:
    """(cycles before it, frame) of an input without its first byte."""
    place = 0
    while place + HEAD.size <= len(data):
        cycles, can_id, late, length = HEAD.unpack_from(data, place)
        place += HEAD.size
        length = min(length % 9, len(data) - place)
        payload = data[place : place + length]
        place += length
        flags = {"extended": bool(can_id & EXTENDED), "remote": bool(can_id & REMOTE), "error": bool(can_id & ERROR)}
        stamp = max(-(2**63), min(2**63 - 1, now + late))
        yield (
            cycles % 4,
            CanFrame(stamp, can_id & (0x1FFFFFFF if can_id & (EXTENDED | ERROR) else 0x7FF), payload, **flags),
        )


def frames_opened(kind: str) -> Callable[[Path], Any]:
    @contextmanager
    def opened(folder: Path) -> Iterator[Trial]:
        bench = OpenBench(kind)

        def trial(data: bytes) -> None:
            bench.bring_to(STATES[(data[0] if data else 0) % len(STATES)])
            for cycles, frame in frames_of(data[1:], bench.plant_side.time_ns):
                bench.advance(cycles * bench.vehicle.period)
                bench._inbox.append(frame)
            bench.advance(AFTER * bench.vehicle.period)
            bench.loop.state()
            bench.loop.interlocks()
            if bench.loop.mode is Mode.FAULT:
                raise Refused(f"a fault: {bench.loop.reason}")

        yield trial

    return opened


def frames(kind: str) -> Callable[[], st.SearchStrategy[bytes]]:
    def inputs() -> st.SearchStrategy[bytes]:
        vehicle = load(kind)
        known = sorted(
            {
                *assembly.vehicle_io(vehicle).can_ids,
                *assembly.imu_config(vehicle).can_ids,
                0,
                0x80,
                0x77F,
                *(
                    code + node
                    for node in (1, 2, 3)
                    for code in (0x80, 0x180, 0x280, 0x200, 0x300, 0x580, 0x600, 0x700)
                ),
            }
        )
        identity = st.one_of(
            st.sampled_from(known),
            st.sampled_from(known),
            st.integers(0, 0x7FF),
            st.integers(0, 0x1FFFFFFF).map(lambda value: value | EXTENDED),
            st.sampled_from([*known, 4, 0x40, 0x1FFFFFFF]).map(lambda value: value | ERROR),
            st.sampled_from(known).map(lambda value: value | REMOTE),
        )
        late = st.one_of(
            st.just(0),
            st.just(0),
            st.integers(-10_000_000, 10_000_000),
            st.sampled_from((10**9, -(10**9), 10**12, 2**62, -(2**62), 2**63 - 1, -(2**63))),
        )
        numbers = st.floats(width=32).map(lambda value: struct.pack("<f", value))
        payload = st.one_of(
            st.binary(max_size=8), st.binary(min_size=8, max_size=8), st.tuples(numbers, numbers).map(b"".join)
        )
        one = st.tuples(st.integers(0, 3), identity, late, payload).map(
            lambda each: HEAD.pack(*each[:3], len(each[3])) + each[3]
        )
        return st.tuples(
            st.integers(0, len(STATES) - 1).map(lambda state: bytes((state,))), st.lists(one, max_size=12)
        ).map(lambda each: each[0] + b"".join(each[1]))

    return inputs


# A drive that answers SDO wrongly


class Distorted(canopen.Network):
    """A network whose answers are distorted as an input says, byte by byte: how, and with what."""

    def __init__(self, harness: Harness, data: bytes) -> None:
        super().__init__()
        self._harness = harness
        self._data = iter(data)
        self._held: list[tuple[int, bytes]] = []

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        seen = len(self._harness.sent)
        self._harness.vehicle.receive(can_id, bytes(data))
        self._harness.vehicle.advance_steps(1)
        answers = [(sent_id, answer) for _, sent_id, answer in self._harness.sent[seen:] if sent_id & 0x780 == 0x580]
        for sent_id, answer in answers:
            for changed in self._distorted(sent_id, answer):
                self.notify(changed[0], bytearray(changed[1]), 1.0)

    def _distorted(self, can_id: int, answer: bytes) -> list[tuple[int, bytes]]:
        held, self._held = self._held, []
        match next(self._data, 0):
            case 1:
                answer = bytes(next(self._data, 0) for _ in range(8))
            case 2:
                answer = answer[: next(self._data, 0) % 9]
            case 3:
                place, mask = next(self._data, 0) % 8, next(self._data, 0)
                answer = bytes(byte ^ mask if at == place else byte for at, byte in enumerate(answer))
            case 4:
                return held
            case 5:
                return [*held, (can_id, answer), (can_id, answer)]
            case 6:
                self._held = [(can_id, answer)]
                return held
            case 7:
                answer = bytes((next(self._data, 0),)) + answer[1:]
            case 8:
                answer = answer + bytes(next(self._data, 0) % 56)
            case 9:
                can_id = 0x580 + next(self._data, 0) % 128
        return [*held, (can_id, answer)]


@contextmanager
def sdo_opened(folder: Path) -> Iterator[Trial]:
    vehicle = load("monocab")
    drive = replace(assembly.drive_config(vehicle, vehicle.drive[0]), sdo_timeout=0.002, mode_timeout=0.02)
    supervision = Supervision(127, 0.04, 0.12, 0.12, vehicle.period)

    def trial(data: bytes) -> None:
        configure(Distorted(Harness(), data), drive, supervision)

    with mock.patch.object(eds, "load", cache(eds.load)):  # the answers are what is wrong here
        yield trial


def sdo() -> st.SearchStrategy[bytes]:
    """Answers that are left as they are, then distorted ones."""
    distortion = st.one_of(
        st.just(b"\0"),
        st.integers(0, 60).map(bytes),
        st.binary(min_size=8, max_size=8).map(lambda data: b"\1" + data),
        st.integers(0, 8).map(lambda length: bytes((2, length))),
        st.tuples(st.integers(0, 7), st.integers(0, 255)).map(lambda each: bytes((3, *each))),
        st.sampled_from((4, 5, 6)).map(lambda how: bytes((how,))),
        st.tuples(st.sampled_from((7, 8, 9)), st.integers(0, 255)).map(bytes),
    )
    return st.one_of(st.lists(distortion, max_size=8).map(b"".join), st.binary(max_size=200))


TARGETS = (
    *(
        Target(
            f"can-{kind}",
            f"CAN frames, {kind}",
            frames_opened(kind),
            frames(kind),
            lambda: [bytes((state,)) for state in range(len(STATES))],
            keeps_state=200,
            short=100,
        )
        for kind in ("monocab", "twsbr", "cube")
    ),
    Target(
        "sdo",
        "SDO answers while a drive is set up",
        sdo_opened,
        sdo,
        lambda: [b"", b"\2\2", b"\1", b"\4" * 20],
        short=40,
    ),
)
