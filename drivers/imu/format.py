"""What an IMU streams, recognised from its frames: for set-up, before any reading is trusted.

The ids alone determine protocol and number of frames. The precision follows from the content: the acceleration at rest
must be close to 1 g, and decoded in the wrong precision it is not. Of the sequences of ids that hold such an
acceleration the longest is the IMU's, so TPDOs of drives with neighbouring ids are not mistaken for one.
"""

from __future__ import annotations

import math
import struct
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from statistics import median

from upright.drivers.imu.imu import Imu
from upright.drivers.imu.layout import CANOPEN_FRAMES, CANOPEN_SPACING, STANDARD_GRAVITY, VALUES_PER_FRAME, ImuConfig
from upright.telemetry.errors import UprightError
from upright.telemetry.samples import CanFrame

LEAST_SETS = 10
"""Sets that are needed to recognise a format."""

RATE_TOLERANCE = 0.2
"""How far the rate seen on the bus may be from the configured one; the device's own rates are a factor 2 apart."""

LONGEST_SEQUENTIAL = 8
"""Frames of a full sequential set in 32-bit precision."""

_AT_REST = (0.8, 1.2)
"""Norm of the acceleration at rest, in g."""

Streams = dict[int, list[CanFrame]]


class ImuFormatError(UprightError):
    """The IMU is silent or streams something other than the vehicle file states: `found` instead of `expected`."""

    def __init__(self, expected: str, found: str, *, remedy: str) -> None:
        super().__init__(f"IMU: expected {expected}; found {found}.", remedy=remedy)
        self.expected = expected
        self.found = found


@dataclass(frozen=True, slots=True)
class ImuFormat:
    """A stream: protocol, ids in order, precision and rate (Hz)."""

    protocol: str
    can_ids: tuple[int, ...]
    precision: str
    rate: float

    def __str__(self) -> str:
        ids = ", ".join(f"{can_id:03X}h" for can_id in self.can_ids)
        return f"{self.protocol} ids {ids} in {self.precision} at {self.rate:.0f} Hz"


def recognise_format(frames: Sequence[CanFrame]) -> ImuFormat | None:
    """The IMU stream in a piece of bus traffic (a second or so at rest); None if there is none.

    The first three slots must carry the acceleration, as they do in the device's default mapping.
    """
    streams = _streams(frames)
    found = [
        ImuFormat(protocol, run, precision, _rate(streams[run[0]]))
        for protocol, run in map(partial(_run, streams), streams)
        for precision in VALUES_PER_FRAME
        if _holds_gravity([streams[can_id] for can_id in run], precision)
    ]
    return max(found, key=lambda candidate: len(candidate.can_ids), default=None)


def check_format(config: ImuConfig, frames: Sequence[CanFrame]) -> None:
    """Compare a piece of bus traffic (a second or so at rest) with what `config` says the IMU streams.

    Raises:
        ImuFormatError: silent, other ids, another precision or another rate; the remedy names the keys to change.
    """
    streams = _streams(frames)
    rate = _rate(streams[config.base_id]) if config.base_id in streams else 0.0
    rate_fits = abs(rate / config.rate - 1.0) <= RATE_TOLERANCE
    if rate_fits and not _neighbours(config, streams) and _reads_gravity(config, frames):
        return
    wanted = ImuFormat(config.protocol, config.can_ids, config.precision, config.rate)
    found = recognise_format(frames)
    if found is None:
        seen = f"no IMU among ids {', '.join(f'{can_id:03X}h' for can_id in sorted(streams))}" if streams else "silence"
        raise ImuFormatError(
            str(wanted),
            seen,
            remedy="Check the IMU's power, cable, bit rate and stream mode, that the vehicle is at rest, and that the "
            "first slots mapped in the device are the accelerations.",
        )
    keys = []
    if found.protocol != wanted.protocol:
        keys.append(f'imu.protocol = "{found.protocol}"')
    if found.can_ids[0] != wanted.can_ids[0]:
        keys.append(f"imu.base_id = 0x{found.can_ids[0]:X}")
    if found.precision != wanted.precision:
        keys.append(f'imu.precision = "{found.precision}"')
    if abs(found.rate / wanted.rate - 1.0) > RATE_TOLERANCE:
        keys.append(f"control.rate to about {found.rate:.0f}")
    if len(found.can_ids) != len(wanted.can_ids) or not keys:
        keys.append("imu.slots to the channels mapped in the device, in their order")
    raise ImuFormatError(
        str(wanted), str(found), remedy=f"If the device is set up as it should be, set {'; '.join(keys)}."
    )


def _streams(frames: Sequence[CanFrame]) -> Streams:
    """Frames by id, of the ids that came often enough."""
    streams: Streams = defaultdict(list)
    for frame in frames:
        if not (frame.error or frame.remote or frame.extended):
            streams[frame.can_id].append(frame)
    return {can_id: stream for can_id, stream in streams.items() if len(stream) >= LEAST_SETS}


def _as_often(streams: Streams, can_id: int, other: int) -> bool:
    """Whether `other` came as often as `can_id`, give or take a set at either end."""
    return other in streams and abs(len(streams[other]) - len(streams[can_id])) <= 2


def _run(streams: Streams, first: int) -> tuple[str, tuple[int, ...]]:
    """The ids from `first` on that came equally often, and the protocol that has this spacing."""
    canopen = 0x181 <= first <= 0x1FF
    spacing, longest = (CANOPEN_SPACING, CANOPEN_FRAMES) if canopen else (1, LONGEST_SEQUENTIAL)
    run = [first]
    while len(run) < longest and _as_often(streams, first, run[-1] + spacing):
        run.append(run[-1] + spacing)
    return ("canopen" if canopen else "sequential"), tuple(run)


def _neighbours(config: ImuConfig, streams: Streams) -> bool:
    """Whether the device's set is longer than the configured one, or begins before it: the id off by one."""
    if config.protocol == "canopen":
        longer = config.frames < CANOPEN_FRAMES
        return longer and _as_often(streams, config.base_id, config.can_ids[-1] + CANOPEN_SPACING)
    return any(_as_often(streams, config.base_id, can_id) for can_id in (config.base_id - 1, config.can_ids[-1] + 1))


def _reads_gravity(config: ImuConfig, frames: Sequence[CanFrame]) -> bool:
    """Whether the configured driver decodes these frames to samples with the acceleration of a vehicle at rest."""
    imu = Imu(config)
    samples = [sample for frame in frames if (sample := imu.handle(frame)) is not None]
    norms = [math.hypot(*sample.acceleration) / STANDARD_GRAVITY for sample in samples]
    return len(norms) >= LEAST_SETS and _AT_REST[0] < median(norms) < _AT_REST[1]


def _holds_gravity(streams: list[list[CanFrame]], precision: str) -> bool:
    """Whether the first three values, read in this precision, have the norm of gravity at rest."""
    code, unit = ("<3h", 0.001) if precision == "int16" else ("<3f", 1.0)
    sets = zip(*streams, strict=False)
    payloads = [payload for frames in sets if len(payload := b"".join(frame.data for frame in frames)) >= 12]
    norms = [unit * math.hypot(*struct.unpack_from(code, payload)) for payload in payloads]
    norms = [norm for norm in norms if math.isfinite(norm)]
    return len(norms) >= LEAST_SETS and _AT_REST[0] < median(norms) < _AT_REST[1]


def _rate(stream: list[CanFrame]) -> float:
    """Mean rate, Hz."""
    span_ns = stream[-1].timestamp_ns - stream[0].timestamp_ns
    return (len(stream) - 1) * 1e9 / span_ns if span_ns > 0 else 0.0
