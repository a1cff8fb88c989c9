"""The data that travel through the system: CAN frames, sensor samples and one `Frame` per control cycle.

Time travels with the data as integer nanoseconds (`timestamp_ns`): the kernel's receive time on a real bus, the
simulated time on a lock-step bus. No consumer ever reads a clock for the time of a sample.
"""

from __future__ import annotations

from dataclasses import dataclass

Vector3 = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class CanFrame:
    """One classical CAN frame as it was on the bus; in the log of another tool also one of CAN FD, with up to 64 bytes.

    `bus` is the index of the bus it came from (0 if there is only one). `can_id` carries no flag bits; they are
    in `extended`, `remote` and `error`. In an error frame `can_id` is the Linux error class (linux/can/error.h).
    """

    timestamp_ns: int
    can_id: int
    data: bytes
    bus: int = 0
    extended: bool = False
    remote: bool = False
    error: bool = False


@dataclass(frozen=True, slots=True)
class ImuSample:
    """One complete set of IMU readings in vehicle axes (ISO 8855: x forward, y left, z up).

    `acceleration` is the specific force in m/s^2 (at rest +9.81 along z), `angular_rate` is in rad/s.
    `timestamp_ns` is the receive time of the set's last frame less the configured sensor latency.
    `accelerometer_stuck`: the acceleration is no measurement.
    """

    timestamp_ns: int
    acceleration: Vector3
    angular_rate: Vector3
    accelerometer_stuck: bool = False


@dataclass(frozen=True, slots=True)
class Frame:
    """One control cycle: the value of every channel of the vehicle, in the order of its channel table, in SI units.

    A value that is not known yet is NaN. `timestamp_ns` is the IMU sample's.
    """

    timestamp_ns: int
    values: tuple[float, ...]
