"""Predicting the MONOCAB's roll from its measured state a short time ahead, and the attainable accuracy.

    inertia * roll'' = gravity_stiffness * roll + torque(t),
    torque = angular_momentum * precession' + trim torque + static_torque

is solved in closed form from every measured (roll, roll_rate) on, with the measured precession rate as the input,
linear between samples. The plant is unstable, so an initial error grows as cosh(pole * time): predictions reach half a
second, not the whole record. `noise` propagates the sensors' errors: white noise of the gyro, estimated from fourth
differences of the roll rate, and the roll filter's slow error, estimated from roll minus the integrated rate.
SI units, signs as in telemetry.channels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from upright.estimators.contract import EstimationError
from upright.models.gravity import GRAVITY
from upright.telemetry.recording import Recording
from upright.vehicles.monocab.identification.balance_rows import FilterConfig

Array = NDArray[np.float64]

SETTLED = 2.0
"""s after which the roll filter's error is uncorrelated with its earlier value."""


@dataclass(frozen=True, slots=True)
class FreeMotion:
    """A segment of a recording in which the vehicle was free, all signals at the IMU's instants, shape (n,).

    `torque_inputs` are precession rate (rad/s), trim position (m) and trim acceleration (m/s^2).
    """

    time: Array
    roll: Array
    roll_rate: Array
    precession: Array
    torque_inputs: tuple[Array, Array, Array]

    def torque(self, parameters: Mapping[str, float]) -> Array:
        """The known roll torque, N m: gyroscopes, trim mass and, if it is a parameter, `static_torque.torque`."""
        rate, position, acceleration = self.torque_inputs
        mass = parameters["trim_mass"]
        trim = mass * (GRAVITY * position - parameters["trim_height"] * acceleration)
        torque: Array = parameters["angular_momentum"] * rate + trim + parameters.get("static_torque.torque", 0.0)
        return torque


@dataclass(frozen=True, slots=True)
class Noise:
    """Errors of the sensors: `roll_rate_std` (rad/s, white), `roll_std` (rad, slow error of the roll filter)."""

    roll_rate_std: float
    roll_std: float


@dataclass(frozen=True, slots=True)
class Prediction:
    """Measured and predicted roll and roll rate after windows of `horizon` s, shape (m,), and their noise floor."""

    horizon: float
    time: Array
    measured: Mapping[str, Array]
    predicted: Mapping[str, Array]
    floor: Mapping[str, float]

    def rmse(self, channel: str) -> float:
        """Root mean square prediction error of "roll" or "roll_rate"."""
        return float(np.sqrt(np.mean((self.measured[channel] - self.predicted[channel]) ** 2)))

    def fit_percent(self, channel: str) -> float:
        """100 % minus the prediction error over the channel's own motion about its mean, both RMS."""
        return float(100.0 * (1.0 - self.rmse(channel) / max(float(np.std(self.measured[channel])), 1e-300)))


def free_motion(recording: Recording, support: float, config: FilterConfig | None = None) -> list[FreeMotion]:
    """The segments of `recording` in which the vehicle was free of its supports (at `support` rad), none under 0.1 s.

    Drive signals are interpolated from the instants at which the drives were sampled, `drive_age` before each sample.
    Raises RecordingError if a channel is missing.
    """
    config = config or FilterConfig()
    names = ("roll", "roll_rate", "precession", "precession_rate", "trim_position", "trim_rate", "drive_age")
    recording.require(*names)
    values, time = recording.values, recording.time
    known = np.all([np.isfinite(values[name]) for name in names], axis=0)
    free = known & (np.abs(np.where(known, values["roll"], 0.0)) < support - config.support_margin)
    follows = np.zeros(len(time), dtype=bool)
    spacing = np.diff(time)
    follows[1:] = free[1:] & free[:-1] & (spacing > 0.0) & (spacing < config.longest_gap)
    starts = np.flatnonzero(free & ~follows)
    ends = np.flatnonzero(free & ~np.append(follows[1:], False)) + 1
    segments = []
    for start, end in zip(starts, ends, strict=True):
        if time[end - 1] - time[start] < 0.1:
            continue
        part = slice(start, end)
        sampled = time[part] - values["drive_age"][part]
        drive = {n: np.interp(time[part], sampled, values[n][part]) for n in names[2:6]}
        segments.append(
            FreeMotion(
                time=time[part],
                roll=values["roll"][part],
                roll_rate=values["roll_rate"][part],
                precession=drive["precession"],
                torque_inputs=(
                    drive["precession_rate"],
                    drive["trim_position"],
                    np.gradient(drive["trim_rate"], time[part]),
                ),
            )
        )
    return segments


def sensor_noise(segments: Sequence[FreeMotion]) -> Noise:
    """Noise of roll and roll rate, estimated from the record itself.

    Fourth differences of a white signal have 70 times its variance, while motion below a tenth of the sampling rate
    almost vanishes in them. Roll minus the integrated rate changes only by the roll filter's error.
    Raises EstimationError if no segment is long enough.
    """
    differences = [np.diff(segment.roll_rate, 4) for segment in segments if len(segment.time) > 20]
    if not differences:
        raise EstimationError("recording", "the vehicle was never free of its supports", remedy="record it upright.")
    rate_std = 1.4826 * float(np.median(np.abs(np.concatenate(differences)))) / np.sqrt(70.0)
    return Noise(float(rate_std), roll_drift(segments, SETTLED) / float(np.sqrt(2.0)))


def roll_drift(segments: Sequence[FreeMotion], span: float) -> float:
    """RMS by which roll and the integrated roll rate diverge within `span` s (half a segment if that is less)."""
    drifts = []
    for segment in segments:
        turned = cumulative_trapezoid(segment.roll_rate, segment.time, initial=0.0)
        error = segment.roll - turned
        ahead = np.searchsorted(segment.time, segment.time + min(span, 0.5 * (segment.time[-1] - segment.time[0])))
        inside = ahead < len(segment.time)
        drifts.append(error[ahead[inside]] - error[inside])
    return float(np.std(np.concatenate(drifts)))


def predict(
    segments: Sequence[FreeMotion], parameters: Mapping[str, float], horizon: float, noise: Noise
) -> Prediction | None:
    """Predictions `horizon` s ahead from every sample of `segments` that is followed by that much free motion.

    None if no segment is that long. Raises EstimationError if inertia or gravity stiffness is not positive.
    """
    for name in ("inertia", "gravity_stiffness"):
        if not parameters.get(name, 0.0) > 0.0:
            raise EstimationError(f"parameter {name}", "must be given and positive", remedy="correct it in the model.")
    inertia = parameters["inertia"]
    pole = float(np.sqrt(parameters["gravity_stiffness"] / inertia))
    collected: list[tuple[Array, ...]] = []
    for segment in segments:
        spacing = np.diff(segment.time)
        steps = round(horizon / float(np.median(spacing)))
        count = len(segment.time) - steps
        if count <= 0 or steps == 0:
            continue
        push = segment.torque(parameters) / inertia
        turned = pole * spacing
        sinh, cosh1 = np.sinh(turned), 2.0 * np.sinh(0.5 * turned) ** 2
        slope = np.diff(push) / spacing
        roll_push = push[:-1] * cosh1 / pole**2 + slope * (sinh - turned) / pole**3
        rate_push = push[:-1] * sinh / pole + slope * cosh1 / pole**2
        roll, rate = segment.roll[:count].copy(), segment.roll_rate[:count].copy()
        for step in range(steps):
            at = slice(step, step + count)
            cosh = 1.0 + cosh1[at]
            roll, rate = (
                cosh * roll + sinh[at] / pole * rate + roll_push[at],
                pole * sinh[at] * roll + cosh * rate + rate_push[at],
            )
        collected.append((segment.time[steps:], segment.roll[steps:], segment.roll_rate[steps:], roll, rate))
    if not collected:
        return None
    time, *columns = (np.concatenate(part) for part in zip(*collected, strict=True))
    growth, shift = np.cosh(pole * horizon), np.sinh(pole * horizon)
    roll_parts = ((growth - 1.0) * noise.roll_std, roll_drift(segments, horizon), shift / pole * noise.roll_rate_std)
    rate_parts = (pole * shift * noise.roll_std, np.hypot(growth, 1.0) * noise.roll_rate_std)
    return Prediction(
        horizon=horizon,
        time=time,
        measured={"roll": columns[0], "roll_rate": columns[1]},
        predicted={"roll": columns[2], "roll_rate": columns[3]},
        floor={"roll": float(np.linalg.norm(roll_parts)), "roll_rate": float(np.linalg.norm(rate_parts))},
    )
