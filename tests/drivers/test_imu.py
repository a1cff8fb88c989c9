"""The LPMS-IG1 driver: encoding and decoding of layouts, incomplete frame sets, and implausible readings."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from upright.drivers.imu.format import ImuFormatError, check_format, recognise_format
from upright.drivers.imu.imu import Imu, ImuHealth
from upright.drivers.imu.layout import (
    ACCELERATION,
    ANGULAR_RATE,
    STANDARD_GRAVITY,
    ImuConfig,
    ImuConfigError,
    encode_frames,
    rotation_of,
)
from upright.telemetry.samples import CanFrame, ImuSample

PERIOD_NS = 4_000_000
CANOPEN = ImuConfig(
    protocol="canopen", base_id=0x18A, precision="float32", slots=(*ACCELERATION, *ANGULAR_RATE), rate=250.0
)
SEQUENTIAL = replace(CANOPEN, protocol="sequential", base_id=0x514, precision="int16")
QUATERNION = ("quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z")


def sample_at(number: int, *, scatter: float = 0.02) -> ImuSample:
    noise = np.random.default_rng(number).normal(0.0, scatter, 6).tolist()
    return ImuSample(
        1_000_000_000 + number * PERIOD_NS,
        (0.3 + noise[0], -0.2 + noise[1], STANDARD_GRAVITY + noise[2]),
        (0.1 + noise[3], 0.2 + noise[4], -0.3 + noise[5]),
    )


def frames_at(number: int, config: ImuConfig = CANOPEN, spacing_ns: int = 120_000) -> list[CanFrame]:
    """The set of sample `number`, its frames `spacing_ns` apart, the last at the sample's time."""
    frames = encode_frames(config, sample_at(number))
    last = len(frames) - 1
    return [
        replace(frame, timestamp_ns=frame.timestamp_ns - (last - place) * spacing_ns)
        for place, frame in enumerate(frames)
    ]


def stream(config: ImuConfig, sets: int = 100) -> list[CanFrame]:
    period_ns = round(1e9 / config.rate)
    return [
        replace(frame, timestamp_ns=frame.timestamp_ns + number * (period_ns - PERIOD_NS))
        for number in range(sets)
        for frame in frames_at(number, config)
    ]


def feed(imu: Imu, frames: list[CanFrame]) -> list[ImuSample]:
    return [sample for frame in frames if (sample := imu.handle(frame)) is not None]


# Layout


def test_float_frames_decode_as_documented() -> None:
    frames = [
        CanFrame(1, 0x18A, struct.pack("<2f", 0.1, -0.2)),
        CanFrame(2, 0x28A, struct.pack("<2f", 0.98, 10.0)),
        CanFrame(3, 0x38A, struct.pack("<2f", -20.0, 30.0)),
    ]
    (sample,) = feed(Imu(CANOPEN), frames)
    assert sample.timestamp_ns == 3
    assert sample.acceleration == pytest.approx((0.980665, -1.96133, 9.610517), rel=1e-6)
    assert sample.angular_rate == pytest.approx(tuple(map(math.radians, (10.0, -20.0, 30.0))), rel=1e-6)


def test_angular_rate_unit_applies_only_to_floats() -> None:
    frames = encode_frames(CANOPEN, sample_at(0))
    (in_degrees,) = feed(Imu(CANOPEN), frames)
    (in_radians,) = feed(Imu(replace(CANOPEN, angular_rate_unit="rad/s", angular_rate_range=1e3)), frames)
    assert in_radians.angular_rate[0] == pytest.approx(math.degrees(in_degrees.angular_rate[0]))
    coarse = replace(SEQUENTIAL, angular_rate_unit="rad/s")
    assert [f.data for f in encode_frames(coarse, sample_at(0))] == [
        f.data for f in encode_frames(SEQUENTIAL, sample_at(0))
    ]


@pytest.mark.parametrize("padded", [False, True])
def test_integer_frames_decode_as_documented(padded: bool) -> None:
    second = struct.pack("<2h", -200, 300) + (bytes(4) if padded else b"")
    frames = [CanFrame(1, 0x514, struct.pack("<4h", 100, -200, 980, 100)), CanFrame(2, 0x515, second)]
    (sample,) = feed(Imu(SEQUENTIAL), frames)
    assert sample.acceleration == pytest.approx((0.980665, -1.96133, 9.610517))
    assert sample.angular_rate == pytest.approx(tuple(map(math.radians, (10.0, -20.0, 30.0))))


def test_other_slots_are_ignored() -> None:
    slots = (*QUATERNION, "off", *ANGULAR_RATE, *ACCELERATION, "temperature")
    config = replace(SEQUENTIAL, slots=slots, precision="float32")
    assert config.can_ids == tuple(range(0x514, 0x51A))
    (decoded,) = feed(Imu(config), encode_frames(config, sample_at(5)))
    assert decoded.acceleration == pytest.approx(sample_at(5).acceleration, rel=1e-6)
    assert decoded.angular_rate == pytest.approx(sample_at(5).angular_rate, rel=1e-6)


@given(
    order=st.permutations([0, 1, 2]),
    signs=st.tuples(*[st.sampled_from([1, -1])] * 3),
    inverted=st.sampled_from([1, -1]),
    acceleration=st.tuples(*[st.floats(-39.0, 39.0)] * 3),
    angular_rate=st.tuples(*[st.floats(-6.9, 6.9)] * 3),
    precision=st.sampled_from(["float32", "int16"]),
)
def test_every_right_handed_mounting_round_trips(order, signs, inverted, acceleration, angular_rate, precision) -> None:  # type: ignore[no-untyped-def]
    axes = tuple(("+" if sign > 0 else "-") + "xyz"[axis] for axis, sign in zip(order, signs, strict=True))
    matrix = np.zeros((3, 3))
    matrix[range(3), order] = signs
    if np.linalg.det(matrix) < 0:
        with pytest.raises(ImuConfigError, match="left-handed") as caught:
            replace(CANOPEN, axes=axes)
        assert caught.value.key == "axes"
        return
    config = replace(CANOPEN, axes=axes, acceleration_sign=inverted, precision=precision)
    sample = ImuSample(1_000, acceleration, angular_rate)
    (decoded,) = feed(Imu(config), encode_frames(config, sample))
    half_a_step = (STANDARD_GRAVITY / 2000.0, math.radians(0.05)) if precision == "int16" else (1e-5, 1e-5)
    assert decoded.acceleration == pytest.approx(acceleration, abs=half_a_step[0] * 1.01)
    assert decoded.angular_rate == pytest.approx(angular_rate, abs=half_a_step[1] * 1.01)
    assert decoded.timestamp_ns == 1_000


def test_axes_name_the_sensor_axis_along_each_vehicle_axis() -> None:
    # Sensor turned by 90 deg about z: its x points left, its y back.
    config = replace(CANOPEN, axes=("-y", "+x", "+z"))
    frames = encode_frames(CANOPEN, ImuSample(0, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3)))
    (sample,) = feed(Imu(config), frames)
    assert sample.acceleration == pytest.approx((-2.0, 1.0, 3.0))
    assert sample.angular_rate == pytest.approx((-0.2, 0.1, 0.3))


def test_inverted_accelerometer_does_not_affect_the_gyro() -> None:
    frames = encode_frames(CANOPEN, ImuSample(0, (1.0, 2.0, -9.8), (0.1, 0.2, 0.3)))
    (sample,) = feed(Imu(replace(CANOPEN, acceleration_sign=-1)), frames)
    assert sample.acceleration == pytest.approx((-1.0, -2.0, 9.8))
    assert sample.angular_rate == pytest.approx((0.1, 0.2, 0.3))


def test_latency_is_subtracted_from_the_receive_time_of_the_last_frame() -> None:
    config = replace(CANOPEN, latency=0.003)
    frames = frames_at(0)
    (sample,) = feed(Imu(config), frames)
    assert sample.timestamp_ns == frames[-1].timestamp_ns - 3_000_000
    assert encode_frames(config, sample)[-1].timestamp_ns == frames[-1].timestamp_ns


@pytest.mark.parametrize(
    ("changes", "key", "text"),
    [
        ({"axes": ("+x", "+x", "+z")}, "axes", "twice"),
        ({"axes": ("+x", "+y", "-z")}, "axes", "left-handed"),
        ({"axes": ("x", "+y", "+z")}, "axes", "'x' is not one of"),
        ({"axes": ("+x", "+y")}, "axes", "2 axes"),
        ({"slots": ACCELERATION}, "slots", "angular_rate_x is mapped 0 times"),
        ({"slots": (*ACCELERATION, *ANGULAR_RATE, "acceleration_x")}, "slots", "2 times"),
        ({"slots": (*ACCELERATION, *ANGULAR_RATE, "gyro")}, "slots", "'gyro' is not a channel"),
        ({"slots": (*ACCELERATION, *ANGULAR_RATE, *QUATERNION)}, "slots", "5 frames"),
        ({"slots": (*ACCELERATION, *ANGULAR_RATE, *["off"] * 11), "precision": "int16"}, "slots", "17 slots"),
        ({"base_id": 0x514}, "base_id", "180h plus a node id"),
        ({"base_id": 0x7FE, "protocol": "sequential"}, "base_id", "11-bit"),
    ],
)
def test_invalid_settings_error_names_key_and_remedy(changes: dict[str, object], key: str, text: str) -> None:
    with pytest.raises(ImuConfigError, match=text) as caught:
        replace(CANOPEN, **changes)
    assert caught.value.key == key
    assert str(caught.value).startswith(f"imu.{key}: ")
    assert caught.value.remedy


def test_rotation_of_gives_axis_and_sign() -> None:
    assert rotation_of(("-y", "+x", "+z")) == ((1, -1), (0, 1), (2, 1))


# Sets


def test_complete_sets_are_decoded_and_foreign_frames_are_ignored() -> None:
    imu = Imu(CANOPEN)
    foreign = CanFrame(1_000_000_000, 0x181, bytes(8))
    samples = []
    for number in range(20):
        first, *rest = frames_at(number)
        samples += feed(imu, [first, foreign, *rest])
    assert [sample.timestamp_ns for sample in samples] == [sample_at(number).timestamp_ns for number in range(20)]
    statistics = imu.statistics
    assert (statistics.sets, statistics.incomplete, statistics.duplicates, statistics.gaps) == (20, 0, 0, 0)


@pytest.mark.parametrize(
    ("order", "published", "incomplete", "duplicates"),
    [
        ((0, 1, 2), 1, 0, 0),
        ((0, 2), 0, 1, 0),
        ((1, 2), 0, 1, 0),
        ((0, 1), 0, 1, 0),
        ((0, 2, 1), 0, 1, 0),
        ((2, 1, 0), 0, 2, 0),
        ((0, 1, 1, 2), 1, 0, 1),
        ((0, 1, 0, 2), 1, 0, 1),
        ((0, 1, 2, 1), 1, 0, 1),
        ((0, 0, 1, 1, 2, 2), 1, 0, 3),
        ((0, 1, 2, 0, 1, 2), 1, 0, 3),
        ((0, 0, 1, 2), 1, 0, 1),
        ((0, 1, 2, 2), 1, 0, 1),
        ((), 0, 0, 0),
    ],
)
def test_only_complete_sets_in_order_are_used(
    order: tuple[int, ...], published: int, incomplete: int, duplicates: int
) -> None:
    imu = Imu(CANOPEN)
    assert len(feed(imu, frames_at(0))) == 1
    damaged = frames_at(1)
    found = feed(imu, [damaged[place] for place in order])
    assert [sample.timestamp_ns for sample in found] == [sample_at(1).timestamp_ns] * published
    assert [sample.timestamp_ns for sample in feed(imu, frames_at(2))] == [sample_at(2).timestamp_ns]
    assert (imu.statistics.incomplete, imu.statistics.duplicates) == (incomplete, duplicates)
    assert imu.statistics.sets == 2 + published
    assert imu.statistics.gaps == 1 - published


def test_frame_twice_with_another_content_breaks_its_set() -> None:
    imu = Imu(CANOPEN)
    first, second, third = frames_at(0)
    other = CanFrame(second.timestamp_ns, second.can_id, bytes(reversed(second.data)))
    assert feed(imu, [first, second, other, third]) == []
    assert (imu.statistics.incomplete, imu.statistics.duplicates) == (1, 0)


def test_copies_are_no_further_sets_of_a_backlog() -> None:
    imu = Imu(CANOPEN)
    backlog = [frame for number in range(3) for frame in frames_at(number)]
    doubled = [frame for frame in backlog for _ in range(2)]
    assert imu.ends(backlog) == imu.ends(doubled) == 3
    feed(imu, doubled[:-1])
    assert imu.ends(doubled[-1:]) == 0


def test_frames_of_two_sets_are_not_joined() -> None:
    imu = Imu(CANOPEN)
    mixed = [frames_at(0)[0], *frames_at(1)[1:]]
    assert feed(imu, mixed) == []
    assert imu.statistics.late == 1
    assert len(feed(imu, frames_at(2))) == 1


def test_start_in_the_middle_of_a_set_is_not_counted_as_incomplete() -> None:
    imu = Imu(CANOPEN)
    feed(imu, frames_at(0)[1:])
    assert len(feed(imu, frames_at(1))) == 1
    assert imu.statistics.incomplete == 0


@pytest.mark.parametrize("length", [0, 4, 6, 7])
def test_wrong_length_fault_names_id_lengths_and_key(length: int) -> None:
    imu = Imu(CANOPEN)
    first, second, third = frames_at(0)
    assert feed(imu, [first, replace(second, data=second.data[:length]), third]) == []
    assert imu.statistics.wrong_length == 1
    assert imu.statistics.incomplete == 0
    assert imu.health(third.timestamp_ns) is ImuHealth.WRONG_LENGTH
    assert f"28Ah has {length} data bytes, not 8" in imu.fault_text
    assert "imu.precision" in imu.fault_text
    (sample,) = feed(imu, frames_at(1))
    assert imu.health(sample.timestamp_ns) is ImuHealth.OK


# Health


def test_age_and_silence_depend_on_the_time_passed_in() -> None:
    imu = Imu(CANOPEN)
    assert imu.age_ns(5) is None
    assert imu.health(5) is ImuHealth.SILENT
    (sample,) = feed(imu, frames_at(0))
    now_ns = sample.timestamp_ns
    assert imu.age_ns(now_ns + 17) == 17
    assert imu.health(now_ns + PERIOD_NS * 3 // 2) is ImuHealth.OK
    assert imu.health(now_ns + PERIOD_NS * 3 // 2 + 1) is ImuHealth.SILENT


def test_latency_does_not_count_as_silence() -> None:
    imu = Imu(replace(CANOPEN, latency=0.02))
    (sample,) = feed(imu, frames_at(0))
    assert imu.age_ns(sample.timestamp_ns + 20_000_000) == 20_000_000
    assert imu.health(sample.timestamp_ns + 20_000_000 + PERIOD_NS) is ImuHealth.OK


@pytest.mark.parametrize(("interval", "gaps"), [(1.0, 0), (1.4, 0), (1.6, 1), (5.0, 1), (-1.0, 1), (0.0, 1)])
def test_intervals_beyond_jitter_count_as_gaps(interval: float, gaps: int) -> None:
    imu = Imu(CANOPEN)
    feed(imu, frames_at(0))
    shift_ns = round((interval - 1.0) * PERIOD_NS)
    feed(imu, [replace(frame, timestamp_ns=frame.timestamp_ns + shift_ns) for frame in frames_at(1)])
    assert imu.statistics.sets == 2
    assert imu.statistics.gaps == gaps


@pytest.mark.parametrize(("config", "limit"), [(CANOPEN, 5), (SEQUENTIAL, 25)])
def test_repeated_samples_are_stuck_until_they_change(config: ImuConfig, limit: int) -> None:
    imu = Imu(config)
    health = []
    for number in range(limit + 2):
        frozen = encode_frames(config, replace(sample_at(0), timestamp_ns=sample_at(number).timestamp_ns))
        (sample,) = feed(imu, frozen)
        health.append(imu.health(sample.timestamp_ns))
    assert health == [ImuHealth.OK] * (limit - 1) + [ImuHealth.STUCK] * 3
    assert imu.statistics.stuck == 3
    (sample,) = feed(imu, frames_at(limit + 2, config))
    assert imu.health(sample.timestamp_ns) is ImuHealth.OK


def test_a_gyro_of_24_bits_that_repeats_itself_is_stuck() -> None:
    imu = Imu(CANOPEN)
    for number in range(40):
        x, _, z = sample_at(number).angular_rate
        feed(imu, encode_frames(CANOPEN, replace(sample_at(number), angular_rate=(x, 0.0, z))))
        if number == 3:
            assert imu.statistics.stuck == 0
    assert imu.statistics.stuck == 36
    assert imu.health(sample_at(39).timestamp_ns) is ImuHealth.STUCK
    assert not imu.accelerometer_stuck
    assert "the gyro of the IMU repeats its last value" in imu.fault_text


def test_an_accelerometer_that_repeats_itself_leaves_the_gyro_usable() -> None:
    imu = Imu(CANOPEN)
    seen = []
    for number in range(12):
        stuck = replace(sample_at(number), acceleration=sample_at(0).acceleration)
        seen += feed(imu, encode_frames(CANOPEN, stuck if number < 8 else sample_at(number)))
    assert [each.accelerometer_stuck for each in seen] == [False] * 4 + [True] * 4 + [False] * 4
    assert imu.health(seen[-1].timestamp_ns) is ImuHealth.OK
    assert not imu.accelerometer_stuck


def test_a_dead_gyro_stays_stuck_when_a_recording_begins() -> None:
    """Otherwise a gyro that has been dead for a minute would be usual, and the vehicle could rise with it."""
    imu = Imu(CANOPEN)
    for number in range(15_000):
        feed(imu, encode_frames(CANOPEN, replace(sample_at(number), angular_rate=(0.0, 0.01, 0.02))))
    assert imu.health(sample_at(14_999).timestamp_ns) is ImuHealth.STUCK
    imu.reset()
    for number in range(15_000, 15_005):
        (sample,) = feed(imu, encode_frames(CANOPEN, replace(sample_at(number), angular_rate=(0.0, 0.01, 0.02))))
    assert imu.health(sample.timestamp_ns) is ImuHealth.STUCK


def test_a_sensor_of_16_bits_that_stops_after_it_moved_is_stuck() -> None:
    imu = Imu(SEQUENTIAL)
    turning = np.random.default_rng(7).normal(0.0, 0.02, (500, 3)).tolist()
    for number in range(560):
        rate = tuple(turning[min(number, 499)])
        feed(imu, encode_frames(SEQUENTIAL, replace(sample_at(number), angular_rate=rate)))
        if number == 499:
            assert imu.statistics.stuck == 0
    assert imu.statistics.stuck > 40


def rates_seen(readings: list[float], config: ImuConfig) -> tuple[list[float], int]:
    """The rates about x that are published for these, and how many were left out."""
    imu, seen = Imu(config), []
    for number, reading in enumerate(readings):
        sample = replace(sample_at(number), angular_rate=(reading, 0.0, 0.0))
        seen += [each.angular_rate[0] for each in feed(imu, encode_frames(config, sample))]
    return seen, imu.statistics.outliers


def test_a_single_wrong_rate_is_left_out_and_a_change_that_stays_is_taken() -> None:
    config = replace(CANOPEN, angular_rate_change=0.05)
    seen, outliers = rates_seen([0.01, 0.02, 5.0, 0.03, 0.02], config)
    assert (seen, outliers) == (pytest.approx([0.01, 0.02, 0.02, 0.03, 0.02]), 1)
    seen, outliers = rates_seen([0.01, 0.5, 0.51, 0.52], config)
    assert (seen, outliers) == (pytest.approx([0.01, 0.01, 0.51, 0.52]), 1)
    # Without a limit, every reading within the range is taken.
    assert rates_seen([0.01, 5.0, 0.01], CANOPEN) == (pytest.approx([0.01, 5.0, 0.01]), 0)


def test_sixteen_bit_sensor_at_rest_is_not_stuck() -> None:
    # 60 s of a gyro that always reads 0 at 0.1 deg/s resolution, and 4 mm/s^2 accelerometer noise at 10 mm/s^2.
    noise = np.random.default_rng(5).normal(0.0, 0.004, (15_000, 3)).tolist()
    imu = Imu(SEQUENTIAL)
    for number, (x, y, z) in enumerate(noise):
        sample = ImuSample(number * PERIOD_NS, (x, y, STANDARD_GRAVITY + z), (0.0, 0.0, 0.0))
        feed(imu, encode_frames(SEQUENTIAL, sample))
    assert imu.statistics.sets == 15_000
    assert imu.statistics.stuck == 0


@pytest.mark.parametrize(
    "reading",
    [
        (math.nan, 0.0, 1.0, 0.0, 0.0, 0.0),
        (0.0, math.inf, 1.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, -4.1, 0.0, 0.0, 0.0),
        (0.0, 0.0, 1.0, 0.0, 401.0, 0.0),
        (0.0, 0.0, 1.0, 0.0, 0.0, math.nan),
    ],
)
def test_readings_beyond_their_range_are_dropped(reading: tuple[float, ...]) -> None:
    imu = Imu(CANOPEN)
    feed(imu, frames_at(0))
    frames = [
        replace(frame, data=struct.pack("<2f", *reading[2 * place : 2 * place + 2]))
        for place, frame in enumerate(frames_at(1))
    ]
    assert feed(imu, frames) == []
    assert imu.statistics.out_of_range == 1
    assert imu.health(frames[-1].timestamp_ns) is ImuHealth.OUT_OF_RANGE
    assert "beyond its range" in imu.fault_text
    assert imu.age_ns(frames[-1].timestamp_ns) == PERIOD_NS


# Replay


def test_reset_uses_the_first_set_that_begins_after_the_start_time() -> None:
    """Live and replay agree on the sets, whichever frame the reset falls on."""
    log = [frame for number in range(6) for frame in frames_at(number)]
    for place, frame in enumerate(log):
        start_ns = frame.timestamp_ns
        live = Imu(CANOPEN)
        feed(live, log[:place])
        live.reset(start_ns)
        replayed = Imu(CANOPEN)
        replayed.reset(start_ns)
        found = feed(live, log[place:])
        assert found == feed(replayed, log)
        assert len(found) == 6 - -(-place // 3)


def test_reset_keeps_an_open_set_that_began_after_the_start() -> None:
    first, second, third = frames_at(0)
    live = Imu(CANOPEN)
    feed(live, [first, second])
    live.reset(first.timestamp_ns)
    assert len(feed(live, [third])) == 1


def test_reset_clears_readings_and_health_but_keeps_the_counts() -> None:
    imu = Imu(CANOPEN)
    for number in range(10):
        feed(imu, encode_frames(CANOPEN, replace(sample_at(0), timestamp_ns=sample_at(number).timestamp_ns)))
    imu.reset()
    assert imu.age_ns(0) is None
    assert imu.health(0) is ImuHealth.SILENT
    assert imu.statistics.sets == 10
    (sample,) = feed(imu, frames_at(100))
    assert imu.health(sample.timestamp_ns) is ImuHealth.OK
    assert imu.statistics.gaps == 0


# Another format

DRIVES = [
    CanFrame(1_000_000_000 + number * PERIOD_NS, 0x180 + node, struct.pack("<HiH", 0x27, 100 * number, 3))
    for number in range(100)
    for node in (1, 2, 3)
]
FORMATS = [
    CANOPEN,
    replace(CANOPEN, precision="int16"),
    replace(CANOPEN, slots=(*ACCELERATION, *ANGULAR_RATE, "temperature", "pressure")),
    SEQUENTIAL,
    replace(SEQUENTIAL, precision="float32"),
    replace(SEQUENTIAL, precision="float32", slots=(*ACCELERATION, *ANGULAR_RATE, *QUATERNION)),
    replace(SEQUENTIAL, base_id=0x515),
    replace(CANOPEN, rate=100.0),
]


@pytest.mark.parametrize("sent", FORMATS)
def test_imu_format_is_recognised_among_drive_frames(sent: ImuConfig) -> None:
    found = recognise_format(DRIVES + stream(sent)[1:])
    assert found is not None
    assert (found.protocol, found.can_ids, found.precision) == (sent.protocol, sent.can_ids, sent.precision)
    assert found.rate == pytest.approx(sent.rate, rel=0.02)


@pytest.mark.parametrize("expected", FORMATS)
@pytest.mark.parametrize("sent", FORMATS)
def test_each_format_passes_only_its_own_check(sent: ImuConfig, expected: ImuConfig) -> None:
    frames = DRIVES + stream(sent)[1:]
    if sent == expected:
        check_format(expected, frames)
        return
    with pytest.raises(ImuFormatError) as caught:
        check_format(expected, frames)
    for changed, remedy in (
        (sent.protocol != expected.protocol, f'imu.protocol = "{sent.protocol}"'),
        (sent.base_id != expected.base_id, f"imu.base_id = 0x{sent.base_id:X}"),
        (sent.precision != expected.precision, f'imu.precision = "{sent.precision}"'),
        (sent.frames != expected.frames, "imu.slots"),
        (sent.rate != expected.rate, "control.rate"),
    ):
        assert (remedy in caught.value.remedy) is changed


def test_error_states_the_expected_and_the_found_format() -> None:
    with pytest.raises(ImuFormatError) as caught:
        check_format(CANOPEN, stream(SEQUENTIAL))
    assert caught.value.expected == "canopen ids 18Ah, 28Ah, 38Ah in float32 at 250 Hz"
    assert caught.value.found == "sequential ids 514h, 515h in int16 at 250 Hz"


def test_swapped_slots_are_detected_by_gravity() -> None:
    swapped = replace(CANOPEN, slots=(*ANGULAR_RATE, *ACCELERATION))
    check_format(swapped, stream(swapped))
    with pytest.raises(ImuFormatError, match=r"imu\.slots"):
        check_format(swapped, stream(CANOPEN))


@pytest.mark.parametrize(("frames", "found"), [([], "silence"), (DRIVES, "no IMU among ids 181h, 182h, 183h")])
def test_missing_imu_error_states_what_was_received(frames: list[CanFrame], found: str) -> None:
    with pytest.raises(ImuFormatError) as caught:
        check_format(CANOPEN, frames)
    assert caught.value.found == found
    assert "bit rate" in caught.value.remedy
