"""What a vehicle at rest tells of its IMU: noise, bias, axes, and, tilted by hand, sign and scale of the gyro.

All of it comes from the raw frames: the roll filter would mix what gravity and the gyro say.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, degrees, hypot, sqrt
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from upright.estimators.roll_filter import RollState
from upright.service.commission.evidence import Evidence, Found
from upright.service.control import assembly
from upright.telemetry.candump import CandumpReader
from upright.vehicles import registry
from upright.vehicles.commissioning import CommissioningError, Number
from upright.vehicles.sections import VehicleFile

Array = NDArray[np.float64]
ENDS = 1.0
"""s at each end of a recording during which the vehicle is at rest."""
LEAST_TILT = 0.0175
"""rad (1 deg): a smaller change of the angle says nothing of the gyro."""


@dataclass(frozen=True, slots=True)
class Samples:
    """Of the IMU, in vehicle axes: `time` (n,) s, `force` (n, 3) m/s^2 and `rate` (n, 3) rad/s."""

    time: Array
    force: Array
    rate: Array


@dataclass(frozen=True, slots=True)
class Falling:
    """The angle by which a vehicle falls. `sideways`: about x, and not about y."""

    vehicle: VehicleFile

    @property
    def sideways(self) -> bool:
        return self._of(1.0, 0.0) != 0.0

    @property
    def sides(self) -> tuple[str, str]:
        """The supports at a positive and at a negative angle."""
        return ("right", "left") if self.sideways else ("front", "rear")

    def by_gravity(self, force: Array) -> tuple[float, float]:
        """That angle, and the one across it, rad, of a vehicle at rest that feels `force` (3,) m/s^2."""
        x, y, z = map(float, force)
        roll, pitch = atan2(y, z), atan2(-x, hypot(y, z))
        return self._of(roll, pitch), pitch if self.sideways else roll

    def by_turns(self, turns: Array) -> float:
        """The change of that angle, rad, after `turns` (3,) rad about the axes of the vehicle."""
        return self._of(float(turns[0]), float(turns[1]))

    def _of(self, roll: float, pitch: float) -> float:
        kind = registry.kind_of(self.vehicle, assembly.vehicle_io(self.vehicle))
        return kind.lean(RollState(0, roll, pitch, 0.0, 0.0, (0.0, 0.0, 0.0))).angle


def imu_at_rest(evidence: Evidence) -> Found:
    """Noise, bias and axes of a vehicle at rest.

    White noise is taken from the differences of consecutive samples, so that a slow drift or a bias is none.
    """
    vehicle, section, falling = evidence.vehicle, evidence.vehicle.imu, Falling(evidence.vehicle)
    samples = read_samples(evidence.recording.with_suffix(".log"), vehicle)
    force = np.mean(samples.force, axis=0)
    angle, across = falling.by_gravity(force)
    density = _white(samples.rate) / sqrt(0.5 * vehicle.control.rate)
    noise = _white(samples.force)
    numbers = {
        "gyro_noise_percent": Number(value=100.0 * density / section.filter.angular_rate_density, unit="%"),
        "acceleration_noise_percent": Number(value=100.0 * noise / section.filter.acceleration_std, unit="%"),
        "gyro_bias": Number(value=degrees(float(np.max(np.abs(np.mean(samples.rate, axis=0))))), unit="deg/s"),
        "gravity": Number(value=float(np.linalg.norm(force)), unit="m/s^2"),
        "up": Number(value=float(force[2]), unit="m/s^2"),
        "off_support": Number(value=degrees(abs(abs(angle) - vehicle.support)), unit="deg"),
        "off_level": Number(value=degrees(abs(across)), unit="deg"),
    }
    side = falling.sides[0 if angle >= 0.0 else 1]
    return Found(numbers, [f"By the IMU, the vehicle lies on its {side} support, at {degrees(angle):.2f} deg."])


def tilt(evidence: Evidence) -> Found:
    """The change of the angle while the vehicle was tilted over: by gravity, before and after, and by the gyro."""
    falling = Falling(evidence.vehicle)
    samples = read_samples(evidence.recording.with_suffix(".log"), evidence.vehicle)
    early, late = samples.time < ENDS, samples.time > samples.time[-1] - ENDS
    before, after = (falling.by_gravity(np.mean(samples.force[rows], axis=0))[0] for rows in (early, late))
    bias = np.mean(samples.rate[early], axis=0)
    turned = falling.by_turns(np.trapezoid(samples.rate - bias, samples.time, axis=0))
    tilted = after - before
    words = [
        f"By gravity the angle went from {degrees(before):.2f} to {degrees(after):.2f} deg, by the gyro it changed by"
        f" {degrees(turned):.2f} deg."
    ]
    if abs(tilted) < LEAST_TILT:
        words.append("The vehicle was not tilted: nothing is known of the gyro.")
    numbers = {
        "gyro_scale": Number(value=turned / tilted if abs(tilted) >= LEAST_TILT else None),
        "other_side": Number(value=-after / before if before else None),
    }
    return Found(numbers, words)


def read_samples(log: Path, vehicle: VehicleFile) -> Samples:
    """The IMU's samples in a raw log. Raises CommissioningError if there is less than a second of them."""
    io = assembly.vehicle_io(vehicle)
    samples = [sample for frame in CandumpReader(log) if (sample := io.handle(frame)) is not None]
    if len(samples) < vehicle.control.rate:
        raise CommissioningError(
            f"{log.name} holds {len(samples)} samples of the IMU, less than a second.",
            remedy="Record again; `upright status` shows whether the IMU is heard.",
        )
    return Samples(
        np.array([(each.timestamp_ns - samples[0].timestamp_ns) * 1e-9 for each in samples]),
        np.array([each.acceleration for each in samples]),
        np.array([each.angular_rate for each in samples]),
    )


def _white(values: Array) -> float:
    """Standard deviation of the white noise of the noisiest column."""
    return float(np.max(np.std(np.diff(values, axis=0), axis=0))) / sqrt(2.0)
