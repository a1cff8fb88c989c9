"""What a vehicle at rest tells of its IMU: noise, bias, axes, and, tilted by hand, sign and scale of the gyro."""

from __future__ import annotations

from math import atan2, degrees, sqrt
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.commission.evidence import Evidence, Found
from service.control import assembly
from service.offline.replay import load
from telemetry.candump import CandumpReader
from vehicles import registry
from vehicles.commissioning import CommissioningError, Number
from vehicles.sections import VehicleFile

Array = NDArray[np.float64]
ENDS = 1.0
"""s at each end of a recording over which an angle at rest is averaged."""
LEAST_TILT = 0.0175
"""rad (1 deg): a smaller change of the angle says nothing of the gyro."""


def imu_at_rest(evidence: Evidence) -> Found:
    """Noise, bias and axes from the raw frames of a recording at rest, in vehicle axes.

    White noise is taken from the differences of consecutive samples, so that a slow drift or a bias is none.
    """
    acceleration, rate = _imu_samples(evidence.recording.with_suffix(".log"), evidence.vehicle)
    section = evidence.vehicle.imu
    force, turning = np.mean(acceleration, axis=0), np.mean(rate, axis=0)
    density = _white(rate) / sqrt(0.5 * evidence.vehicle.control.rate)
    lean, off = _lean(evidence)
    side = {"roll": ("right", "left")}.get(lean, ("front", "rear"))[0 if off >= 0.0 else 1]
    numbers = {
        "gyro_noise_percent": Number(value=100.0 * density / section.filter.angular_rate_density, unit="%"),
        "acceleration_noise_percent": Number(
            value=100.0 * _white(acceleration) / section.filter.acceleration_std, unit="%"
        ),
        "gyro_bias": Number(value=degrees(float(np.max(np.abs(turning)))), unit="deg/s"),
        "gravity": Number(value=float(np.linalg.norm(force)), unit="m/s^2"),
        "up": Number(value=float(force[2]), unit="m/s^2"),
        "off_support": Number(value=degrees(abs(abs(off) - evidence.vehicle.support)), unit="deg"),
        "off_level": Number(value=degrees(_across(lean, force)), unit="deg"),
    }
    return Found(numbers, [f"The IMU says that the vehicle lies on its {side} support, {lean} {degrees(off):.2f} deg."])


def tilt(evidence: Evidence) -> Found:
    """The change of the angle while the vehicle was tilted over: by gravity, before and after, and by the gyro."""
    joint = registry.nominal_model(evidence.vehicle.vehicle.kind).joints[0]
    recording = load(evidence.recording, evidence.vehicle)
    time, angle, rate = recording.time, recording[joint.coordinate], recording[joint.rate]
    before, after = (float(np.mean(angle[each])) for each in (time < ENDS, time > time[-1] - ENDS))
    turned = float(np.trapezoid(rate, time))
    tilted = after - before
    scale = turned / tilted if abs(tilted) > LEAST_TILT else None
    words = [
        f"{joint.coordinate} went from {degrees(before):.2f} to {degrees(after):.2f} deg; the gyro says {degrees(turned):.2f} deg."
    ]
    if scale is None:
        words.append("It was not tilted: nothing is known of the gyro.")
    return Found(
        {"gyro_scale": Number(value=scale), "other_side": Number(value=-after / before if before else None)}, words
    )


def _imu_samples(log: Path, vehicle: VehicleFile) -> tuple[Array, Array]:
    """Accelerations (m/s^2) and angular rates (rad/s) of a raw log, (n, 3) each. Raises CommissioningError."""
    io = assembly.vehicle_io(vehicle)
    samples = [sample for frame in CandumpReader(log) if (sample := io.handle(frame)) is not None]
    if len(samples) < vehicle.control.rate:
        raise CommissioningError(
            f"{log.name} holds {len(samples)} samples of the IMU, less than a second.",
            remedy="Record again; `upright status` shows whether the IMU is heard.",
        )
    return np.array([each.acceleration for each in samples]), np.array([each.angular_rate for each in samples])


def _white(values: Array) -> float:
    """Standard deviation of the white noise of the noisiest column."""
    return float(np.max(np.std(np.diff(values, axis=0), axis=0))) / sqrt(2.0)


def _lean(evidence: Evidence) -> tuple[str, float]:
    """The angle by which the vehicle falls: its name, and its mean at the end of the recording, rad."""
    name = registry.nominal_model(evidence.vehicle.vehicle.kind).joints[0].coordinate
    recording = load(evidence.recording, evidence.vehicle)
    return name, float(np.mean(recording[name][recording.time > recording.time[-1] - ENDS]))


def _across(lean: str, force: Array) -> float:
    """The other angle of the vehicle, rad, which is zero on level ground if the IMU is mounted straight."""
    return abs(atan2(force[0] if lean == "roll" else force[1], force[2]))
