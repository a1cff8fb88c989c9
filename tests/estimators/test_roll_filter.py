"""The roll filter on motions with known truth in closed form: rotations about a body-fixed axis with a lever arm."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from upright.estimators.roll_filter import GRAVITY, RollFilter, RollFilterConfig, RollState
from upright.telemetry.samples import ImuSample, Vector3

MONOCAB = RollFilterConfig(
    rate=250.0,
    acceleration_std=0.2,
    angular_rate_density=0.003,
    bias_random_walk=1e-4,
    position=(0.0, 0.0, 0.9),
)
ACCELERATION_NOISE = 0.02
"""m/s^2 per sample."""
ANGULAR_RATE_NOISE = 3.5e-5 * math.sqrt(125.0)
"""rad/s per sample: gyro I of the LPMS-IG1, 3.5e-5 rad/s/sqrt(Hz) over half of 250 Hz."""

Angle = Callable[[float], tuple[float, float, float]]
"""Angle, its rate and its acceleration at a time."""


@dataclass(frozen=True)
class Motion:
    """A rotation by `angle` about the body-fixed `axis`, beginning with the body at `start` (roll, pitch)."""

    angle: Angle
    axis: Vector3 = (1.0, 0.0, 0.0)
    start: tuple[float, float] = (0.0, 0.0)
    position: Vector3 = MONOCAB.position
    bias: Vector3 = (0.0, 0.0, 0.0)
    rate: float = MONOCAB.rate

    def up(self, time: float) -> np.ndarray:
        roll, pitch = self.start
        up = np.array([-math.sin(pitch), math.cos(pitch) * math.sin(roll), math.cos(pitch) * math.cos(roll)])
        axis = np.array(self.axis)
        turned = -self.angle(time)[0]
        return (
            up * math.cos(turned) + cross(axis, up) * math.sin(turned) + axis * (axis @ up) * (1.0 - math.cos(turned))
        )

    def sample(self, time: float, received: float, noise: np.random.Generator | None) -> ImuSample:
        """The readings at `time`, stamped `received`."""
        _, rate, acceleration = self.angle(time)
        axis, arm = np.array(self.axis), np.array(self.position)
        omega = axis * rate
        force = GRAVITY * self.up(time) + cross(axis * acceleration, arm) + cross(omega, cross(omega, arm))
        gyro = omega + self.bias
        if noise is not None:
            force = force + noise.normal(0.0, ACCELERATION_NOISE, 3)
            gyro = gyro + noise.normal(0.0, ANGULAR_RATE_NOISE, 3)
        return ImuSample(round(received * 1e9), tuple(force.tolist()), tuple(gyro.tolist()))

    def samples(self, duration: float, *, seed: int | None = 1, jitter: float = 0.0) -> Iterator[ImuSample]:
        noise = None if seed is None else np.random.default_rng(seed)
        late = np.random.default_rng(7).uniform(0.0, jitter, round(duration * self.rate))
        for number, delay in enumerate(late):
            time = number / self.rate
            yield self.sample(time, time + delay, noise)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The cross product; numpy's is ten times slower for three numbers."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def still(_: float) -> tuple[float, float, float]:
    return 0.0, 0.0, 0.0


def sine(amplitude: float, frequency: float, start: float = 2.0) -> Angle:
    """A sine ramped in over one second from `start` on, at rest before, as the excitations are."""
    omega = 2.0 * math.pi * frequency

    def angle(time: float) -> tuple[float, float, float]:
        t = time - start
        if t < 0.0:
            return 0.0, 0.0, 0.0
        ramp = (0.5 - 0.5 * math.cos(math.pi * t), 0.5 * math.pi * math.sin(math.pi * t))
        share = (*ramp, 0.5 * math.pi**2 * math.cos(math.pi * t)) if t < 1.0 else (1.0, 0.0, 0.0)
        wave = (math.sin(omega * t), omega * math.cos(omega * t), -(omega**2) * math.sin(omega * t))
        return (
            amplitude * share[0] * wave[0],
            amplitude * (share[1] * wave[0] + share[0] * wave[1]),
            amplitude * (share[2] * wave[0] + 2.0 * share[1] * wave[1] + share[0] * wave[2]),
        )

    return angle


def run(samples: Iterator[ImuSample], config: RollFilterConfig = MONOCAB) -> list[RollState]:
    roll_filter = RollFilter(config)
    return [roll_filter.update(sample) for sample in samples]


def roll_error_deg(motion: Motion, states: list[RollState], after: float) -> np.ndarray:
    begin = round(after * motion.rate)
    errors = [
        math.degrees(state.roll - motion.angle(number / motion.rate)[0])
        for number, state in enumerate(states)
        if number >= begin
    ]
    return np.array(errors)


def inclination_error_deg(motion: Motion, state: RollState, time: float) -> float:
    """Angle between the estimated and the true up vector."""
    cosine = math.cos(state.pitch)
    up = np.array([-math.sin(state.pitch), cosine * math.sin(state.roll), cosine * math.cos(state.roll)])
    true = motion.up(time)
    return math.degrees(math.atan2(float(np.linalg.norm(cross(up, true))), float(up @ true)))


def worst_inclination_deg(motion: Motion, states: list[RollState], after: float) -> float:
    times = [number / motion.rate for number in range(len(states))]
    return max(
        inclination_error_deg(motion, state, time) for state, time in zip(states, times, strict=True) if time >= after
    )


@pytest.mark.parametrize(("frequency", "rate"), [(0.1, 250.0), (0.5, 250.0), (3.0, 250.0), (3.0, 100.0), (1.0, 500.0)])
def test_sine_of_one_degree_is_followed_to_a_hundredth_of_a_degree(frequency: float, rate: float) -> None:
    # 0.02 m/s^2 of accelerometer noise through the 1 s low-pass is 0.005 deg at 250 Hz; the bias adds to it early on.
    motion = Motion(sine(math.radians(1.0), frequency), rate=rate)
    error = roll_error_deg(motion, run(motion.samples(18.0), replace(MONOCAB, rate=rate)), after=10.0)
    assert np.sqrt(np.mean(error**2)) < 0.01


def test_lever_arm_causes_no_error_without_noise() -> None:
    # At 3 Hz the lever arm causes 5.6 m/s^2 and gravity only 0.17 m/s^2 of the reading: timing must be exact.
    motion = Motion(sine(math.radians(1.0), 3.0))
    assert np.abs(roll_error_deg(motion, run(motion.samples(10.0, seed=None)), after=0.0)).max() < 2e-3


def test_wrong_lever_arm_causes_an_error() -> None:
    motion = Motion(sine(math.radians(1.0), 1.0), position=(0.0, 0.0, 0.9))
    states = run(motion.samples(10.0, seed=None), replace(MONOCAB, position=(0.0, 0.0, 0.0)))
    assert np.abs(roll_error_deg(motion, states, after=3.0)).max() > 0.1


def test_receive_jitter_of_a_fifth_of_a_period_has_little_effect() -> None:
    motion = Motion(sine(math.radians(1.0), 3.0))
    error = roll_error_deg(motion, run(motion.samples(18.0, jitter=0.2 / motion.rate)), after=10.0)
    assert np.sqrt(np.mean(error**2)) < 0.015


@pytest.mark.parametrize(
    ("roll_deg", "pitch_deg"), [(80.0, 0.0), (-80.0, 10.0), (30.0, 80.0), (-40.0, -80.0), (170.0, 0.0), (-135.0, 45.0)]
)
def test_any_attitude_at_rest_is_estimated(roll_deg: float, pitch_deg: float) -> None:
    motion = Motion(still, start=(math.radians(roll_deg), math.radians(pitch_deg)))
    state = run(motion.samples(5.0))[-1]
    # At 80 deg of pitch roll is six times as sensitive as the up vector.
    assert math.degrees(state.roll) == pytest.approx(roll_deg, abs=0.5)
    assert math.degrees(state.pitch) == pytest.approx(pitch_deg, abs=0.1)
    assert inclination_error_deg(motion, state, 0.0) < 0.05


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, 0.64, 0.48)])
def test_tumbling_through_every_angle_is_followed(axis: Vector3) -> None:
    # A rotation back and forth at up to 6 rad/s, through 90 deg and upside down; only motion shows the yaw bias.
    motion = Motion(sine(math.radians(360.0), 0.15), axis=axis, bias=(0.005, -0.004, 0.003))
    assert worst_inclination_deg(motion, run(motion.samples(16.0)), after=8.0) < 0.3


def test_bias_of_half_a_degree_per_second_is_found_at_standstill() -> None:
    bias = math.radians(0.5)
    motion = Motion(still, start=(math.radians(4.0), 0.0), bias=(bias, -bias, 0.0))
    states = run(motion.samples(15.0))
    errors = [abs(math.degrees(state.roll) - 4.0) for state in states]
    assert max(errors[25:]) < 0.3
    assert max(errors[5 * 250 :]) < 0.05
    assert math.degrees(states[-1].bias[0]) == pytest.approx(0.5, abs=0.01)
    assert math.degrees(states[-1].bias[1]) == pytest.approx(-0.5, abs=0.01)
    assert math.degrees(states[-1].roll_rate) == pytest.approx(0.0, abs=0.1)


def test_vibration_does_not_tilt_the_estimate() -> None:
    roll_filter, noise = RollFilter(MONOCAB), np.random.default_rng(3)
    states = []
    for number, sample in enumerate(Motion(still).samples(12.0)):
        shake = 3.0 * math.sin(2.0 * math.pi * 23.0 * number / 250.0) if number > 1000 else 0.0
        x, y, z = sample.acceleration
        acceleration = (x + shake, y + 0.7 * shake, z + shake + noise.normal(0.0, 0.5))
        states.append(roll_filter.update(replace(sample, acceleration=acceleration)))
    calm = run(Motion(still).samples(12.0))
    # 3 m/s^2 is 17 deg of tilt; the low-pass leaves 0.12 deg of a 23 Hz sine, the filter behind it less.
    assert max(abs(math.degrees(state.roll)) for state in states[1000:]) < 0.1
    assert states[-1].roll_std > 2.0 * calm[-1].roll_std


def test_standard_deviation_covers_the_error() -> None:
    # The gyro density covers scale errors and vibration too: on clean data the std must not be too small.
    motion = Motion(sine(math.radians(1.0), 0.7), bias=(0.004, 0.0, 0.0))
    states = run(motion.samples(20.0, seed=11))
    inside = [
        abs(state.roll - motion.angle(number / 250.0)[0]) < 2.0 * state.roll_std for number, state in enumerate(states)
    ]
    assert np.mean(inside) > 0.95
    assert math.degrees(states[-1].roll_std) < 0.2


def test_roll_is_marked_as_unknown_at_90_degrees_of_pitch() -> None:
    state = run(Motion(still, start=(0.0, math.radians(90.0))).samples(2.0, seed=None))[-1]
    assert state.roll_std > 1.0
    assert math.degrees(state.pitch) == pytest.approx(90.0, abs=0.1)


def test_gap_of_half_a_second_in_a_sine_is_bridged() -> None:
    motion = Motion(sine(math.radians(1.0), 1.0))
    kept = [sample for number, sample in enumerate(motion.samples(20.0)) if not 2500 <= number < 2625]
    states = run(iter(kept))
    true = [math.degrees(motion.angle(sample.timestamp_ns * 1e-9)[0]) for sample in kept]
    errors = [abs(math.degrees(state.roll) - angle) for state, angle in zip(states, true, strict=True)]
    assert max(errors[2500:]) < 3.0
    assert max(errors[2500 + 750 :]) < 0.1
    assert states[2500].roll_std > 2.0 * states[2499].roll_std


def test_long_gap_restarts_the_attitude_and_keeps_the_bias() -> None:
    bias = math.radians(0.5)
    before = list(Motion(still, bias=(bias, 0.0, 0.0)).samples(12.0))
    turned = Motion(still, start=(math.radians(60.0), 0.0), bias=(bias, 0.0, 0.0))
    after = [replace(sample, timestamp_ns=sample.timestamp_ns + 30_000_000_000) for sample in turned.samples(1.0)]
    states = run(iter(before + after))
    assert math.degrees(states[-1].roll) == pytest.approx(60.0, abs=0.1)
    assert math.degrees(states[-1].bias[0]) == pytest.approx(0.5, abs=0.02)


def test_time_stamp_that_does_not_increase_leaves_the_roll_unchanged() -> None:
    motion = Motion(still, start=(0.1, 0.0))
    samples = list(motion.samples(4.0))
    roll_filter = RollFilter(MONOCAB)
    for sample in samples:
        roll_filter.update(sample)
    turning = replace(samples[-1], timestamp_ns=samples[-1].timestamp_ns - 2_000_000_000, angular_rate=(5.0, 0.0, 0.0))
    assert roll_filter.update(turning).roll == pytest.approx(0.1, abs=1e-3)
    assert roll_filter.update(turning).roll == pytest.approx(0.1, abs=1e-3)


def test_start_in_free_fall_waits_for_gravity() -> None:
    roll_filter = RollFilter(MONOCAB)
    falling = roll_filter.update(ImuSample(0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    assert math.isfinite(falling.roll_std)
    samples = Motion(still, start=(0.3, 0.0), position=(0.0, 0.0, 0.0)).samples(5.0)
    states = [roll_filter.update(replace(s, timestamp_ns=s.timestamp_ns + 4_000_000)) for s in samples]
    assert states[-1].roll == pytest.approx(0.3, abs=2e-3)


def test_replay_after_reset_is_identical_bit_for_bit() -> None:
    samples = list(Motion(sine(0.02, 1.0)).samples(4.0))
    roll_filter = RollFilter(MONOCAB)
    first = [roll_filter.update(sample) for sample in samples]
    roll_filter.reset()
    assert [roll_filter.update(sample) for sample in samples] == first


READING = st.tuples(*[st.floats(-40.0, 40.0)] * 3)
RATE = st.tuples(*[st.floats(-7.0, 7.0)] * 3)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(-5_000_000, 1_500_000_000), READING, RATE), min_size=1, max_size=40))
def test_estimate_stays_finite_for_any_readings(readings: list[tuple[int, Vector3, Vector3]]) -> None:
    roll_filter, time_ns = RollFilter(MONOCAB), 0
    for interval_ns, acceleration, angular_rate in readings:
        time_ns += interval_ns
        state = roll_filter.update(ImuSample(time_ns, acceleration, angular_rate))
        assert all(map(math.isfinite, (state.roll, state.pitch, state.roll_rate, *state.bias)))
        assert 0.0 <= state.roll_std <= math.pi


def test_pitching_and_rolling_motions_give_the_same_estimates() -> None:
    """The same motion about y: the same estimates, rates and standard deviations, to the last digits."""
    rolls = Motion(sine(0.05, 0.7), position=(0.0, 0.0, 0.06))
    pitches = replace(rolls, axis=(0.0, 1.0, 0.0))
    config = replace(MONOCAB, position=(0.0, 0.0, 0.06))
    one, other = RollFilter(config), RollFilter(config)
    for rolling, pitching in zip(rolls.samples(6.0, seed=None), pitches.samples(6.0, seed=None), strict=True):
        about_x, about_y = one.update(rolling), other.update(pitching)
        assert about_y.pitch == pytest.approx(about_x.roll, abs=1e-9)
        assert about_y.pitch_rate == pytest.approx(about_x.roll_rate, abs=1e-9)
        assert about_y.pitch_std == pytest.approx(about_x.roll_std, rel=1e-6)
    assert abs(about_y.pitch) > 1e-3, "or it has not moved"
