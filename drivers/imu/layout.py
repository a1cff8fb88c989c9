"""How an LPMS-IG1 packs its readings into CAN frames, and the inverse.

The device streams up to 16 channel slots. 16-bit precision puts four int16 into a frame (acceleration in g/1000,
angular rate in deg/s/10), 32-bit precision two float32 (acceleration in g, angular rate in deg/s or rad/s as set in
the device); both little-endian. CANopen mode sends them with the ids 180h, 280h, 380h, 480h + node id, sequential mode
with consecutive ids from a base. Two vendor documents disagree by one on that base, so the vehicle file states it.

Sensor axes become vehicle axes (ISO 8855: x forward, y left, z up) by a permutation with signs. Accelerations are
specific forces: at rest +g along the axis that points up, or -g on devices with the opposite sign.
"""

from __future__ import annotations

import functools
import math
import struct
from dataclasses import dataclass
from typing import Literal

from upright.telemetry.errors import UprightError
from upright.telemetry.samples import CanFrame, ImuSample, Vector3

STANDARD_GRAVITY = 9.80665
"""m/s^2 per g, the device's unit of acceleration."""

ACCELERATION = ("acceleration_x", "acceleration_y", "acceleration_z")
ANGULAR_RATE = ("angular_rate_x", "angular_rate_y", "angular_rate_z")
OTHER_SLOTS = (
    "off",
    "magnetic_x",
    "magnetic_y",
    "magnetic_z",
    "quaternion_w",
    "quaternion_x",
    "quaternion_y",
    "quaternion_z",
    "euler_x",
    "euler_y",
    "euler_z",
    "linear_acceleration_x",
    "linear_acceleration_y",
    "linear_acceleration_z",
    "pressure",
    "temperature",
)
"""Slots that may be mapped and are ignored."""

MAXIMUM_SLOTS = 16
CANOPEN_SPACING = 0x100
CANOPEN_FRAMES = 4
VALUES_PER_FRAME = {"int16": 4, "float32": 2}
_VALUE_CODE = {"int16": "h", "float32": "f"}


class ImuConfigError(UprightError):
    """An `[imu]` section that no device can have. `key` is the key below `imu` that is wrong."""

    def __init__(self, key: str, message: str, *, remedy: str) -> None:
        super().__init__(f"imu.{key}: {message}", remedy=remedy)
        self.key = key


@dataclass(frozen=True, slots=True)
class ImuConfig:
    """The settings of the device, and how it is mounted.

    `base_id` is the CAN id of the first frame of a set, `slots` what the mapped channels carry in order, `rate` the
    stream rate (Hz), `axes` the sensor axis along the vehicle's x, y and z. `acceleration_range` (m/s^2) and
    `angular_rate_range` (rad/s) bound plausible values, `angular_rate_change` (rad/s) that of a rate from one set
    to the next; `latency` (s) is the time from the measurement to the last frame of its set. `angular_rate_unit`
    applies to float32 only: 16-bit frames are always in deg/s/10.

    Raises:
        ImuConfigError: on construction, naming the key.
    """

    protocol: Literal["canopen", "sequential"]
    base_id: int
    precision: Literal["float32", "int16"]
    slots: tuple[str, ...]
    rate: float
    axes: tuple[str, str, str] = ("+x", "+y", "+z")
    acceleration_sign: Literal[1, -1] = 1
    angular_rate_unit: Literal["deg/s", "rad/s"] = "deg/s"
    acceleration_range: float = 39.2
    angular_rate_range: float = math.radians(400.0)
    latency: float = 0.0
    angular_rate_change: float = math.inf

    def __post_init__(self) -> None:
        _check_slots(self)
        _check_ids(self)
        rotation_of(self.axes)

    @property
    def frames(self) -> int:
        """How many CAN frames a set has."""
        return -(-len(self.slots) // VALUES_PER_FRAME[self.precision])

    @property
    def can_ids(self) -> tuple[int, ...]:
        """The ids of a set, in the order they are sent."""
        spacing = CANOPEN_SPACING if self.protocol == "canopen" else 1
        return tuple(self.base_id + place * spacing for place in range(self.frames))


@dataclass(frozen=True, slots=True)
class FrameLayout:
    """Decoder of one frame set: which value of the set is which vehicle axis, and its factor to SI.

    `lengths` gives, per frame, the valid data lengths: a last frame with free places may be truncated or padded.
    """

    values: struct.Struct
    acceleration: tuple[tuple[int, float], ...]
    angular_rate: tuple[tuple[int, float], ...]
    lengths: tuple[tuple[int, ...], ...]

    def decode(self, data: bytes) -> tuple[Vector3, Vector3]:
        """Acceleration (m/s^2) and angular rate (rad/s) in vehicle axes, of the set's joined payloads."""
        values = self.values.unpack_from(data)
        (xi, xf), (yi, yf), (zi, zf) = self.acceleration
        acceleration = (values[xi] * xf, values[yi] * yf, values[zi] * zf)
        (xi, xf), (yi, yf), (zi, zf) = self.angular_rate
        return acceleration, (values[xi] * xf, values[yi] * yf, values[zi] * zf)


@functools.cache
def layout_of(config: ImuConfig) -> FrameLayout:
    """The layout that `config` describes."""
    size = struct.calcsize(f"<{_VALUE_CODE[config.precision]}")
    per_frame = VALUES_PER_FRAME[config.precision]
    acceleration_unit, angular_rate_unit = _units(config)
    mounting = rotation_of(config.axes)
    lengths: list[tuple[int, ...]] = [(8,)] * config.frames
    left_over = len(config.slots) % per_frame
    if left_over:
        lengths[-1] = (left_over * size, 8)
    return FrameLayout(
        values=struct.Struct(f"<{len(config.slots)}{_VALUE_CODE[config.precision]}"),
        acceleration=tuple(
            (config.slots.index(ACCELERATION[axis]), sign * config.acceleration_sign * acceleration_unit)
            for axis, sign in mounting
        ),
        angular_rate=tuple(
            (config.slots.index(ANGULAR_RATE[axis]), sign * angular_rate_unit) for axis, sign in mounting
        ),
        lengths=tuple(lengths),
    )


def encode_frames(config: ImuConfig, sample: ImuSample) -> list[CanFrame]:
    """The frame set that a device with the settings `config` sends for `sample`: the inverse of decoding.

    All frames carry the receive time from which the sample's time follows. 16-bit values saturate as the device's do;
    slots other than acceleration and angular rate are zero.
    """
    layout = layout_of(config)
    values = [0.0] * len(config.slots)
    for (place, unit), value in zip(layout.acceleration, sample.acceleration, strict=True):
        values[place] = value / unit
    for (place, unit), value in zip(layout.angular_rate, sample.angular_rate, strict=True):
        values[place] = value / unit
    if config.precision == "int16":
        data = layout.values.pack(*(max(-32768, min(32767, round(value))) for value in values))
    else:
        data = layout.values.pack(*values)
    received_ns = sample.timestamp_ns + round(config.latency * 1e9)
    return [
        CanFrame(received_ns, can_id, data[8 * place : 8 * place + 8]) for place, can_id in enumerate(config.can_ids)
    ]


def rotation_of(axes: tuple[str, str, str]) -> tuple[tuple[int, int], ...]:
    """Sensor axis (0 to 2) and sign of each vehicle axis.

    Raises:
        ImuConfigError: an unknown axis name, an axis named twice, or a left-handed frame (a mirror, not a mounting).
    """
    remedy = 'Name the sensor axis along the vehicle\'s x, y and z, as in ["+x", "+y", "+z"] or ["-y", "+x", "+z"].'
    if len(axes) != 3:
        raise ImuConfigError("axes", f"{len(axes)} axes given, there are three", remedy=remedy)
    mounting = []
    for name in axes:
        if len(name) != 2 or name[0] not in "+-" or name[1] not in "xyz":
            raise ImuConfigError("axes", f"{name!r} is not one of +x, -x, +y, -y, +z, -z", remedy=remedy)
        mounting.append(("xyz".index(name[1]), 1 if name[0] == "+" else -1))
    order = [axis for axis, _ in mounting]
    if sorted(order) != [0, 1, 2]:
        raise ImuConfigError("axes", f"{', '.join(axes)} names a sensor axis twice", remedy=remedy)
    cyclic = order in ([0, 1, 2], [1, 2, 0], [2, 0, 1])
    handedness = (1 if cyclic else -1) * math.prod(sign for _, sign in mounting)
    if handedness < 0:
        raise ImuConfigError(
            "axes",
            f"{', '.join(axes)} is left-handed: no way of mounting the sensor gives it",
            remedy="Flip the sign of one of them, or swap two; check with the vehicle level and tilted by hand.",
        )
    return tuple(mounting)


def _units(config: ImuConfig) -> tuple[float, float]:
    """m/s^2 and rad/s per unit of the payload."""
    if config.precision == "int16":
        return STANDARD_GRAVITY / 1000.0, math.radians(0.1)
    return STANDARD_GRAVITY, math.radians(1.0) if config.angular_rate_unit == "deg/s" else 1.0


def _check_slots(config: ImuConfig) -> None:
    known = (*ACCELERATION, *ANGULAR_RATE, *OTHER_SLOTS)
    for name in config.slots:
        if name not in known:
            raise ImuConfigError("slots", f"{name!r} is not a channel of the IMU", remedy=f"Use {', '.join(known)}.")
    for name in (*ACCELERATION, *ANGULAR_RATE):
        if config.slots.count(name) != 1:
            raise ImuConfigError(
                "slots",
                f"{name} is mapped {config.slots.count(name)} times",
                remedy="Map each acceleration and angular rate once, in the device and here.",
            )
    if len(config.slots) > MAXIMUM_SLOTS:
        raise ImuConfigError(
            "slots", f"{len(config.slots)} slots, the device has {MAXIMUM_SLOTS}", remedy="Map fewer channels."
        )


def _check_ids(config: ImuConfig) -> None:
    if config.protocol == "canopen":
        if config.frames > CANOPEN_FRAMES:
            raise ImuConfigError(
                "slots",
                f"{len(config.slots)} {config.precision} slots need {config.frames} frames, CANopen mode has "
                f"{CANOPEN_FRAMES}",
                remedy='Map fewer channels, or use precision "int16" or protocol "sequential", in the device and here.',
            )
        if not 0x181 <= config.base_id <= 0x1FF:
            raise ImuConfigError(
                "base_id",
                f"{config.base_id:#x} is not 180h plus a node id from 1 to 127",
                remedy="Give the id of the first frame, as in 0x18A for node 10.",
            )
    elif not 1 <= config.base_id <= 0x800 - config.frames:
        raise ImuConfigError(
            "base_id",
            f"{config.base_id:#x} and the {config.frames - 1} ids after it are not all 11-bit CAN ids",
            remedy="Give the id of the first frame, as in 0x514.",
        )
