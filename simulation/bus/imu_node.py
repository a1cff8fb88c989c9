"""The LPMS-IG1 on the vehicle: the errors of its sensors, and the CAN frames it streams. The plant gives its motion.

Frames carry g and deg/s or rad/s as 32-bit floats, or g / 1000 and 0.1 deg/s as 16-bit integers, little-endian.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Mapping

import numpy as np

from upright.simulation.bus.machine import Machine, Motion
from upright.simulation.config import ImuNode
from upright.telemetry.samples import Vector3

STANDARD_GRAVITY = 9.80665
NOISE_BLOCK = 512
VALUES_PER_FRAME = {"float32": 2, "int16": 4}
KINDS = ("acceleration", "angular_rate")


class SensorPath:
    """Lag and delay of everything the IMU reports, on samples `period` apart."""

    def __init__(self, lag: float, delay: float, period: float) -> None:
        self._gain = -math.expm1(-period / lag) if lag > 0.0 else 1.0
        self._period = period
        self._whole, self._part = divmod(max(0.0, delay) / period, 1.0)
        self._past: deque[Motion] = deque(maxlen=int(self._whole) + 2)
        self._state: Motion | None = None

    def pass_on(self, motion: Motion) -> Motion:
        """The motion that the sensor sees now; `motion` is the vehicle's actual one."""
        if self._state is None:
            self._state = motion
            self._past.extend([motion] * (self._past.maxlen or 0))
        gain = self._gain
        self._state = tuple([a + gain * (x - a) for a, x in zip(self._state, motion, strict=True)])
        self._past.append(self._state)
        return _between(self._past[0], self._past[1], 1.0 - self._part, self._period)


def _between(one: Motion, other: Motion, share: float, period: float) -> Motion:
    """The motion at `share` of the `period` (s) from `one` to `other`. Angle and rate, whose slope is the next value,
    are interpolated by Hermite cubics, since straight lines would attenuate fast motion; the rest is linear."""
    if share >= 1.0:
        return other
    rest = 1.0 - share
    smooth = share * share * (3.0 - 2.0 * share)
    begin, end = period * share * rest * rest, -period * share * share * rest
    curves = [
        one[place] + smooth * (other[place] - one[place]) + begin * one[place + 1] + end * other[place + 1]
        for place in range(2)
    ]
    return (*curves, *[x + share * (y - x) for x, y in zip(one[2:], other[2:], strict=True)])


class VirtualImu:
    """`measure` makes one noisy sample in vehicle axes; `encode` its frames."""

    def __init__(
        self,
        config: ImuNode,
        *,
        rate: int,
        seed: int,
        gravity: float,
        sizes: Mapping[str, float],
        falling_axis: int = 0,
    ) -> None:
        """`falling_axis`: axis of the gyro whose hidden errors are among `sizes`, see `Machine`."""
        self.config = config
        self._rate = rate
        self._seed = seed
        self._gravity = gravity
        self._axis = falling_axis
        self._offset = sizes.get("sensor_offset", 0.0)
        self._scale = 1.0 + sizes.get("sensor_scale", 0.0)
        self._further_bias = sizes.get("gyro_bias", 0.0)
        late = config.latency + sizes.get("sensor_delay", 0.0)
        self._path = SensorPath(sizes.get("sensor_lag", 0.0), late, 1.0 / rate)
        self._rate_std = config.angular_rate_density * math.sqrt(rate / 2.0)
        self._walk = config.bias_random_walk / math.sqrt(rate)
        self._mounting = tuple((axis[0] == "-", "xyz".index(axis[1])) for axis in config.axes)
        self.reseed()

    def reseed(self) -> None:
        """Restart the noise, as at the start: what follows depends on the seed alone."""
        self._random = np.random.default_rng(self._seed)
        self._noise: list[list[float]] = []
        self._bias = list(self.config.angular_rate_bias)
        self._bias[self._axis] += self._further_bias

    def measure(self, plant: Machine) -> tuple[Vector3, Vector3]:
        """Acceleration (m/s^2) and angular rate (rad/s) in vehicle axes, with noise and quantisation."""
        angle, *others = self._path.pass_on(plant.motion())
        force, rates = plant.felt((angle + self._offset, *others), self.config.position, self._gravity)
        if not self._noise:
            self._noise = self._random.standard_normal((NOISE_BLOCK, 9)).tolist()
        ax, ay, az, wx, wy, wz, bx, by, bz = self._noise.pop()
        std, rate_std, walk, bias = self.config.acceleration_std, self._rate_std, self._walk, self._bias
        bias[0] += walk * bx
        bias[1] += walk * by
        bias[2] += walk * bz
        scales = [1.0, 1.0, 1.0]
        scales[self._axis] = self._scale
        acceleration = (force[0] + std * ax, force[1] + std * ay, force[2] + std * az)
        angular_rate = (
            scales[0] * rates[0] + bias[0] + rate_std * wx,
            scales[1] * rates[1] + bias[1] + rate_std * wy,
            scales[2] * rates[2] + bias[2] + rate_std * wz,
        )
        if self.config.precision == "int16":
            return _rounded(acceleration, STANDARD_GRAVITY / 1000.0), _rounded(angular_rate, math.radians(0.1))
        return acceleration, angular_rate

    def encode(self, acceleration: Vector3, angular_rate: Vector3, precision: str | None = None) -> list[bytes]:
        """The payloads of a frame set, in order; `precision` overrides the configured one."""
        config = self.config
        precision = precision or config.precision
        integers = precision == "int16"
        rate_unit = math.radians(1.0) if integers or config.angular_rate_unit == "deg/s" else 1.0
        values = {}
        for kind, vector, unit in (
            ("acceleration", acceleration, STANDARD_GRAVITY * config.acceleration_sign),
            ("angular_rate", angular_rate, rate_unit),
        ):
            for (negative, sensor_axis), value in zip(self._mounting, vector, strict=True):
                values[f"{kind}_{'xyz'[sensor_axis]}"] = (-value if negative else value) / unit
        numbers = [values.get(slot, 0.0) for slot in config.slots]
        if integers:
            factors = [10.0 if slot.startswith("angular_rate") else 1000.0 for slot in config.slots]
            counts = [max(-32768, min(32767, round(x * f))) for x, f in zip(numbers, factors, strict=True)]
            packed = struct.pack(f"<{len(counts)}h", *counts)
        else:
            packed = struct.pack(f"<{len(numbers)}f", *numbers)
        return [packed[start : start + 8] for start in range(0, len(packed), 8)]

    def can_id(self, place: int) -> int:
        """CAN id of the frame at `place` in its set."""
        return self.config.base_id + place * (0x100 if self.config.protocol == "canopen" else 1)

    @property
    def heartbeat_id(self) -> int | None:
        """CAN id of the device's heartbeat, which it has in CANopen mode only."""
        return 0x700 + self.config.base_id - 0x180 if self.config.protocol == "canopen" else None


def _rounded(vector: Vector3, unit: float) -> Vector3:
    x, y, z = vector
    return (round(x / unit) * unit, round(y / unit) * unit, round(z / unit) * unit)
