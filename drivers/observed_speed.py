"""The speed of a wheel as its own inverter reports it on the bus: it is read, and never commanded.

Flywheels are often driven by inverters that nobody else may switch. Their process data are broadcast all the same; one
value of one frame is enough to know how fast the wheel turns.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from math import nan
from typing import Literal

from upright.telemetry.samples import CanFrame

LAYOUTS = {"int16": "<h", "int32": "<i"}
"""Little-endian, as in CANopen (CiA 301, 7.1.4.5)."""
Layout = Literal["int16", "int32"]


@dataclass(frozen=True, slots=True)
class SpeedConfig:
    """Where the speed is: `can_id` of the frame, `start_byte` in it, and its `layout`. `unit`: rad/s of one count, with
    the sign that makes the speed positive as it should turn."""

    name: str
    can_id: int
    start_byte: int
    layout: Layout
    unit: float

    @property
    def size(self) -> int:
        """Bytes of the frame up to the end of the value."""
        return self.start_byte + struct.calcsize(LAYOUTS[self.layout])


class ObservedSpeed:
    """`speed`: rad/s as last reported, at `timestamp_ns`. Before the first report it is not known (NaN), and
    `timestamp_ns` is the time from which reports count."""

    __slots__ = ("_size", "_value", "config", "speed", "timestamp_ns", "wrong_lengths")

    def __init__(self, config: SpeedConfig) -> None:
        self.config = config
        self._value = struct.Struct(LAYOUTS[config.layout])
        self._size = config.size
        self.wrong_lengths = 0
        """Frames too short to hold the value: another device has this id, or the mapping has changed."""
        self.reset(0)

    def reset(self, start_ns: int) -> None:
        """Forget what was reported: only frames from `start_ns` on count."""
        self.speed = nan
        self.timestamp_ns = start_ns

    def handle(self, frame: CanFrame) -> None:
        """Take a frame with `config.can_id`. One that is too short is counted, and says nothing."""
        if len(frame.data) < self._size:
            self.wrong_lengths += 1
            return
        (count,) = self._value.unpack_from(frame.data, self.config.start_byte)
        self.speed = count * self.config.unit
        self.timestamp_ns = frame.timestamp_ns
