"""Roll and pitch of the vehicle from its IMU: a Kalman filter that is valid at any angle.

The states are the up vector in the body frame u (3, unit length) and the gyro bias b (3, rad/s). With the measured
angular rate w both equations are linear and time-varying, without a small-angle assumption or a singularity of Euler
angles:

    u' = -(w - b) x u,   b' = white noise
    accelerometer = g u + w' x r + w x (w x r) + linear acceleration

r is the lever arm from the roll axis to the accelerometer. Two consecutive accelerometer readings are averaged and the
two angular rates differenced, so that all terms belong to the same instant, the middle of the interval. The remaining
linear acceleration has zero mean in a non-rotating frame. A low-pass in that frame attenuates it (as VQF does: Laidig
and Seel, Information Fusion 91, 2023), and the measurement covariance grows with the departure of |a| from g.

Axes: ISO 8855, x forward, y left, z up. roll = atan2(u_y, u_z), positive right side down; pitch is positive nose down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from upright.telemetry.samples import ImuSample, Vector3

Matrix3 = tuple[Vector3, Vector3, Vector3]

GRAVITY = 9.80665
"""m/s^2."""

SMOOTHING_TIME = 1.0
"""s, time constant of the accelerometer's low-pass in the non-rotating frame."""

DEPARTURE_TIME = 0.25
"""s over which the departure of |a| from g is averaged."""

INITIAL_TILT_STD = 0.1
"""rad, of the up vector from the first accelerometer reading."""

INITIAL_BIAS_STD = 0.01
"""rad/s, prior standard deviation of the gyro bias."""

LEVER_TIME = 0.1
"""s after a start over which the tangential acceleration is faded in. Its average over an interval is the difference of
the gyro readings at both ends divided by the interval. Over the first few samples this is mostly noise."""

LONGEST_STEP = 1.0
"""s; after a longer gap the up vector is initialised again from the accelerometer. The bias is kept."""


@dataclass(frozen=True, slots=True)
class RollFilterConfig:
    """The filter's assumptions about the sensor.

    `rate` (Hz) is the IMU's sampling rate, `acceleration_std` (m/s^2, per sample) the accelerometer's noise at rest,
    `angular_rate_density` (rad/s/sqrt(Hz)) the gyro's noise with scale and alignment errors included,
    `bias_random_walk` (rad/s/sqrt(s)) the random walk of its bias, `position` (m) the accelerometer's position relative
    to the roll axis.
    """

    rate: float
    acceleration_std: float
    angular_rate_density: float
    bias_random_walk: float
    position: Vector3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class RollState:
    """The estimate at one IMU sample: rad and rad/s. The rates are the gyro about x and about y minus its bias.

    `bias_std` is that of the bias about x. `contradiction` (m/s^2, in the body frame) is what the accelerometer shows
    beyond gravity and the acceleration of its lever arm, which follow from the gyro: vibration and other motion of the
    whole vehicle, or an error of one of the two.

    A vehicle falls about one of the two axes: a monorail rolls, a robot on two wheels pitches.
    """

    timestamp_ns: int
    roll: float
    pitch: float
    roll_rate: float
    roll_std: float
    bias: Vector3
    pitch_rate: float = 0.0
    pitch_std: float = 0.0
    bias_std: float = 0.0
    contradiction: Vector3 = (0.0, 0.0, 0.0)


class RollFilter:
    """Pass every IMU sample to `update`, which returns the state at that sample. While the accelerometer is stuck, the
    gyro carries the angle.

    The state is a pure function of the samples since `reset`: replaying them gives the same numbers bit for bit.
    """

    def __init__(self, config: RollFilterConfig) -> None:
        self.config = config
        self._period = 1.0 / config.rate
        self._identity = np.eye(3)
        self._measures_up = np.hstack((np.eye(3), np.zeros((3, 3))))
        self._noise = np.diag([config.angular_rate_density**2] * 3 + [config.bias_random_walk**2] * 3)
        self._transition = np.eye(6)
        self._measured = np.zeros((3, 1))
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next sample restarts the filter."""
        from filterpy.kalman import KalmanFilter  # half a second of imports, which a filter alone needs

        self._kalman = KalmanFilter(dim_x=6, dim_z=3)
        self._kalman.inv = _inverse
        self._kalman.P = np.diag([INITIAL_TILT_STD**2] * 3 + [INITIAL_BIAS_STD**2] * 3)
        self._last: ImuSample | None = None
        self._up: Vector3 = (0.0, 0.0, 1.0)
        self._bias: Vector3 = (0.0, 0.0, 0.0)
        self._contradiction: Vector3 = (0.0, 0.0, 0.0)
        self._start_smoothing((0.0, 0.0, 0.0))

    def update(self, sample: ImuSample) -> RollState:
        """The state at `sample`. A sample that is not later than the previous one adds its reading, but no motion."""
        last = self._last
        self._last = sample
        step = 0.0 if last is None else (sample.timestamp_ns - last.timestamp_ns) * 1e-9
        if last is None or step > LONGEST_STEP:
            self._start(sample)
        else:
            self._step(last, sample, max(step, 0.0))
        return self._state(sample)

    def _start(self, sample: ImuSample) -> None:
        """Up vector and its covariance from one accelerometer reading."""
        acceleration = _minus(sample.acceleration, self._centripetal(sample.angular_rate))
        self._start_smoothing(acceleration)
        norm = math.hypot(*acceleration)
        if norm > 0.1 * GRAVITY:
            self._up = (acceleration[0] / norm, acceleration[1] / norm, acceleration[2] / norm)
        kalman = self._kalman
        kalman.x[:3, 0] = self._up
        kalman.P[:3, :] = 0.0
        kalman.P[:, :3] = 0.0
        kalman.P[:3, :3] = self._identity * INITIAL_TILT_STD**2

    def _start_smoothing(self, acceleration: Vector3) -> None:
        self._smoothed = acceleration
        self._departure = 0.0
        self._readings = 1

    def _step(self, last: ImuSample, sample: ImuSample, step: float) -> None:
        """Predict the state over `step` seconds and correct it with the readings at both ends."""
        vx, vy, vz = last.angular_rate
        wx, wy, wz = sample.angular_rate
        rate = (0.5 * (vx + wx), 0.5 * (vy + wy), 0.5 * (vz + wz))
        turn = _turn(rate, step)

        # IMU samples are a whole number of periods apart, whatever the jitter of their receive times.
        elapsed = self._period * max(1, round(step / self._period))
        change = (wx - vx, wy - vy, wz - vz)
        before = _apply(turn, last.acceleration)
        share = min(1.0, self._readings * self._period / LEVER_TIME)
        lever = self._lever(rate, (share * change[0], share * change[1], share * change[2]), elapsed)
        now = sample.acceleration
        reading = (
            0.5 * (before[0] + now[0]) - lever[0],
            0.5 * (before[1] + now[1]) - lever[1],
            0.5 * (before[2] + now[2]) - lever[2],
        )
        if sample.accelerometer_stuck:
            ux, uy, uz = _apply(turn, self._up)
            reading = (GRAVITY * ux, GRAVITY * uy, GRAVITY * uz)
        variance = self._smooth(turn, reading, step)

        self._predict(turn, step, change)
        self._correct(variance)
        ux, uy, uz = self._up
        self._contradiction = (reading[0] - GRAVITY * ux, reading[1] - GRAVITY * uy, reading[2] - GRAVITY * uz)

    def _lever(self, rate: Vector3, change: Vector3, elapsed: float) -> Vector3:
        """Tangential and centripetal acceleration at the lever arm."""
        rx, ry, rz = self.config.position
        ax, ay, az = change[0] / elapsed, change[1] / elapsed, change[2] / elapsed
        cx, cy, cz = self._centripetal(rate)
        return (ay * rz - az * ry + cx, az * rx - ax * rz + cy, ax * ry - ay * rx + cz)

    def _centripetal(self, rate: Vector3) -> Vector3:
        """w x (w x r) = w (w . r) - r (w . w)."""
        rx, ry, rz = self.config.position
        wx, wy, wz = rate
        along = wx * rx + wy * ry + wz * rz
        square = wx * wx + wy * wy + wz * wz
        return (wx * along - rx * square, wy * along - ry * square, wz * along - rz * square)

    def _smooth(self, turn: Matrix3, reading: Vector3, step: float) -> float:
        """Low-pass `reading` in the non-rotating frame; returns its variance (m^2/s^4)."""
        self._readings += 1
        gain = max(1.0 - math.exp(-step / SMOOTHING_TIME), 1.0 / self._readings)
        bx, by, bz = self._bias
        x, y, z = self._smoothed
        px, py, pz = _apply(turn, self._smoothed)
        px += step * (by * z - bz * y)
        py += step * (bz * x - bx * z)
        pz += step * (bx * y - by * x)
        self._smoothed = (px + gain * (reading[0] - px), py + gain * (reading[1] - py), pz + gain * (reading[2] - pz))

        gain = max(1.0 - math.exp(-step / DEPARTURE_TIME), 1.0 / self._readings)
        self._departure += gain * ((math.hypot(*reading) - GRAVITY) ** 2 - self._departure)
        return self.config.acceleration_std**2 + self._departure

    def _predict(self, turn: Matrix3, step: float, change: Vector3) -> None:
        (a, b, c), (d, e, f), (g, h, i) = turn
        px, py, pz = self._up
        ux, uy, uz = _apply(turn, self._up)
        # b x u over the step, with u at its middle.
        x, y, z = 0.5 * step * (px + ux), 0.5 * step * (py + uy), 0.5 * step * (pz + uz)
        self._transition[:3] = ((a, b, c, 0.0, z, -y), (d, e, f, -z, 0.0, x), (g, h, i, y, -x, 0.0))
        noise = self._noise * step
        lost = step - 1.5 * self._period
        if lost > 0.0:
            # Across lost samples the rate is known no better than it changed.
            noise[:3, :3] += self._identity * (0.5 * lost * math.hypot(*change)) ** 2
        self._kalman.predict(F=self._transition, Q=noise)

    def _correct(self, variance: float) -> None:
        x, y, z = self._smoothed
        self._measured[:, 0] = (x / GRAVITY, y / GRAVITY, z / GRAVITY)
        kalman = self._kalman
        kalman.update(self._measured, R=self._identity * (variance / GRAVITY**2), H=self._measures_up)
        ux, uy, uz, bx, by, bz = kalman.x[:, 0].tolist()
        norm = math.sqrt(ux * ux + uy * uy + uz * uz)
        self._up = (ux / norm, uy / norm, uz / norm)
        self._bias = (bx, by, bz)
        kalman.x[:3, 0] = self._up

    def _state(self, sample: ImuSample) -> RollState:
        ux, uy, uz = self._up
        covariance = self._kalman.P
        lateral = uy * uy + uz * uz
        variance = (
            uz * uz * float(covariance[1, 1])
            - 2.0 * uy * uz * float(covariance[1, 2])
            + uy * uy * float(covariance[2, 2])
        )
        # At 90 deg of pitch, roll is undefined.
        std = min(math.sqrt(max(variance, 0.0)) / lateral, math.pi) if lateral > 1e-9 else math.pi
        # The error of pitch is the error of the up vector within the plane of pitch, perpendicular to the vector.
        across = math.sqrt(lateral)
        along = ux / across if lateral > 1e-9 else 0.0
        gy, gz = uy * along, uz * along
        pitch_variance = (
            lateral * float(covariance[0, 0])
            - 2.0 * across * (gy * float(covariance[0, 1]) + gz * float(covariance[0, 2]))
            + gy * gy * float(covariance[1, 1])
            + 2.0 * gy * gz * float(covariance[1, 2])
            + gz * gz * float(covariance[2, 2])
        )
        return RollState(
            timestamp_ns=sample.timestamp_ns,
            roll=math.atan2(uy, uz),
            pitch=math.atan2(-ux, across),
            roll_rate=sample.angular_rate[0] - self._bias[0],
            roll_std=std,
            bias=self._bias,
            pitch_rate=sample.angular_rate[1] - self._bias[1],
            pitch_std=math.sqrt(max(pitch_variance, 0.0)),
            bias_std=math.sqrt(max(float(covariance[3, 3]), 0.0)),
            contradiction=self._contradiction,
        )


def _turn(rate: Vector3, step: float) -> Matrix3:
    """exp(-[w dt]x): rotation of a vector at rest, seen from the body frame (Rodrigues)."""
    x, y, z = -rate[0] * step, -rate[1] * step, -rate[2] * step
    square = x * x + y * y + z * z
    if square < 1e-8:
        s, c = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        angle = math.sqrt(square)
        s, c = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    xy, xz, yz = c * x * y, c * x * z, c * y * z
    return (
        (1.0 - c * (y * y + z * z), xy - s * z, xz + s * y),
        (xy + s * z, 1.0 - c * (x * x + z * z), yz - s * x),
        (xz - s * y, yz + s * x, 1.0 - c * (x * x + y * y)),
    )


def _inverse(matrix: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Inverse of the symmetric innovation covariance by cofactors: LAPACK takes three times as long for 3 x 3."""
    (a, b, c), (_, d, e), (_, _, f) = matrix.tolist()
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    s = 1.0 / (a * p + b * q + c * r)
    t, u, v = s * (a * f - c * c), s * (b * c - a * e), s * (a * d - b * b)
    return np.array(((s * p, s * q, s * r), (s * q, t, u), (s * r, u, v)))


def _apply(matrix: Matrix3, vector: Vector3) -> Vector3:
    (a, b, c), (d, e, f), (g, h, i) = matrix
    x, y, z = vector
    return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)


def _minus(a: Vector3, b: Vector3) -> Vector3:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])
