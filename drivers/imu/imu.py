"""The LPMS-IG1 on the bus: complete frame sets, and whether its readings can be trusted.

The device sends no counter, no timestamp and no checksum, so only the host's receive times are available: the first id
opens a set, and the last publishes it if every frame came, in order and within three quarters of a period (frames of
two sets, joined by a loss, lie a whole period apart). Copies of the frames of a set are left out, and the set goes on.
Everything else is dropped and counted. Nothing here reads a clock. Output is in vehicle axes and SI units
(`telemetry.samples.ImuSample`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum

from upright.drivers.imu.layout import ImuConfig, layout_of
from upright.drivers.imu.repeats import Repeats
from upright.telemetry.samples import CanFrame, ImuSample, Vector3

LONGEST_SET = 0.75
"""Periods from the first to the last frame of a set."""

SHORTEST_INTERVAL = 0.25
"""Periods between two sets; the same content in a shorter interval is a copy of the set."""

LONGEST_INTERVAL = 1.5
"""Periods between two sets; a longer interval is a gap."""

FRESH_SETS = {"float32": 500, "int16": 12}
FRESH_AXES = {"float32": 500, "int16": 0}
"""What is known before the first reading, of whole sets and of one axis (drivers.imu.repeats). The noise of 24 bits
shows in every float: the fifth of the same in a row is no measurement. In 16 bits (0.1 deg/s, 1 mg) a gyro at rest may
read the same for ever, and whole sets for less than 25."""

_WAITING = -1
"""In place of the next frame's index: frames are ignored until a first frame opens a set."""


class ImuHealth(Enum):
    """Whether the latest reading may be used."""

    OK = "ok"
    SILENT = "silent"
    STUCK = "stuck"
    OUT_OF_RANGE = "out of range"
    WRONG_LENGTH = "another format"


@dataclass(slots=True)
class ImuStatistics:
    """Counts since the driver was created.

    `sets`: published. Left out: `duplicates` (frames that are copies), `outliers` (single angular rates). Dropped:
    `incomplete` (a frame missing, out of order, or twice with another content), `late` (frames too far apart to be
    of one set), `wrong_length`, `out_of_range` (or not a finite number). `gaps` are intervals above 1.5 periods or
    backwards in time, `stuck` the sets in which a sensor repeated itself implausibly often.
    """

    sets: int = 0
    incomplete: int = 0
    duplicates: int = 0
    late: int = 0
    wrong_length: int = 0
    out_of_range: int = 0
    gaps: int = 0
    stuck: int = 0
    outliers: int = 0


class Imu:
    """Turns the IMU's frames into samples and monitors them.

    `frozen` is the number of sets in a row whose time has not advanced. `fault_text` says what was wrong with the last
    set that was dropped for its content, or which sensor repeats itself, with the remedy. `accelerometer_stuck`: the
    accelerometer repeats itself, and the gyro does not.
    """

    def __init__(self, config: ImuConfig) -> None:
        self.config = config
        self.can_ids = config.can_ids
        self.statistics = ImuStatistics()
        self.fault_text = ""
        self.frozen = 0
        self._layout = layout_of(config)
        self._places = {can_id: place for place, can_id in enumerate(self.can_ids)}
        self._latency_ns = round(config.latency * 1e9)
        self._longest_set_ns = round(LONGEST_SET / config.rate * 1e9)
        self._shortest_interval_ns = round(SHORTEST_INTERVAL / config.rate * 1e9)
        self._longest_interval_ns = round(LONGEST_INTERVAL / config.rate * 1e9)
        self._sets = Repeats(FRESH_SETS[config.precision])
        self._axes = [Repeats(FRESH_AXES[config.precision]) for _ in range(6)]
        self._payloads = [b""] * config.frames
        self._next = _WAITING
        self._first_ns = 0
        self._ended_ns = 0
        self._start_ns = 0
        self._sample: ImuSample | None = None
        self._held = False
        self._content = ImuHealth.OK
        self.accelerometer_stuck = False

    def handle(self, frame: CanFrame) -> ImuSample | None:
        """Take one data frame; returns the sample if it completed a set. Frames with other ids are ignored."""
        place = self._places.get(frame.can_id)
        if place is None or frame.timestamp_ns < self._start_ns:
            return None
        came = place < self._next or self._next == 0 < place  # in this set, or in the one that is complete
        if came and frame.data == self._payloads[place] and frame.timestamp_ns - self._first_ns <= self._longest_set_ns:
            self.statistics.duplicates += 1
            return None
        if place == 0:
            if self._next > 0:
                self.statistics.incomplete += 1
            self._first_ns = frame.timestamp_ns
        elif place != self._next:
            if self._next != _WAITING:
                self.statistics.incomplete += 1
                self._next = _WAITING
            return None
        if len(frame.data) not in self._layout.lengths[place]:
            self._refuse_length(frame, place)
            return None
        self._payloads[place] = frame.data
        if place + 1 < len(self._payloads):
            self._next = place + 1
            return None
        self._next = 0
        self._ended_ns = frame.timestamp_ns
        if frame.timestamp_ns - self._first_ns > self._longest_set_ns:
            self.statistics.late += 1
            return None
        return self._publish(frame.timestamp_ns)

    def ends(self, frames: Iterable[CanFrame]) -> int:
        """How many sets end among `frames`, which are to be handled next. A copy of a last frame is none."""
        count, data, received_ns = 0, self._payloads[-1], self._ended_ns
        for frame in frames:
            if frame.can_id == self.can_ids[-1]:
                count += frame.data != data or frame.timestamp_ns - received_ns > self._longest_set_ns
                data, received_ns = frame.data, frame.timestamp_ns
        return count

    def _publish(self, received_ns: int) -> ImuSample | None:
        acceleration, angular_rate = self._layout.decode(b"".join(self._payloads))
        ax, ay, az = acceleration
        wx, wy, wz = angular_rate
        a, w = self.config.acceleration_range, self.config.angular_rate_range
        # Written so that NaN fails the check.
        if not (
            -a <= ax <= a and -a <= ay <= a and -a <= az <= a and -w <= wx <= w and -w <= wy <= w and -w <= wz <= w
        ):
            self.statistics.out_of_range += 1
            self._content = ImuHealth.OUT_OF_RANGE
            self.fault_text = (
                f"IMU reading beyond its range: acceleration ({ax:.4g}, {ay:.4g}, {az:.4g}) m/s^2, "
                f"angular rate ({wx:.4g}, {wy:.4g}, {wz:.4g}) rad/s. Remedy: if the vehicle did not move like this, "
                "check imu.precision, imu.slots and imu.angular_rate_unit against the device."
            )
            return None
        last = self._sample
        if last is not None:
            angular_rate = self._plausible(angular_rate, last.angular_rate)
        sample = ImuSample(received_ns - self._latency_ns, acceleration, angular_rate)
        self._content = ImuHealth.OK
        if last is not None:
            interval_ns = sample.timestamp_ns - last.timestamp_ns
            same = angular_rate == last.angular_rate and acceleration == last.acceleration
            if same and 0 <= interval_ns < self._shortest_interval_ns:
                self.statistics.duplicates += len(self._payloads)
                return None
            self.frozen = self.frozen + 1 if interval_ns == 0 else 0
            if not 0 < interval_ns <= self._longest_interval_ns:
                self.statistics.gaps += 1
            self._sets.update(same)
            readings, before = (*angular_rate, *acceleration), (*last.angular_rate, *last.acceleration)
            repeated = False
            for axis, reading, earlier in zip(self._axes, readings, before, strict=True):
                axis.update(reading == earlier)
                repeated = repeated or reading == earlier
            self.accelerometer_stuck = repeated and self._repeats()
            if self.accelerometer_stuck:
                sample = replace(sample, accelerometer_stuck=True)
        self.statistics.sets += 1
        self._sample = sample
        return sample

    def _repeats(self) -> bool:
        """Whether the accelerometer is stuck, and the gyro is not; that makes the whole set no measurement."""
        stuck = [axis.stuck for axis in self._axes]
        gyro, whole = any(stuck[:3]), self._sets.stuck
        if not (any(stuck) or whole):
            return False
        what = "the IMU" if whole else f"the {'gyro' if gyro else 'accelerometer'} of the IMU"
        self.statistics.stuck += 1
        self.fault_text = (
            f"{what} repeats its last value. Remedy: switch the IMU off and on, switch off a threshold or automatic "
            "zero of its gyro, and check imu.precision against the device."
        )
        if gyro or whole:
            self._content = ImuHealth.STUCK
        return not (gyro or whole)

    def _plausible(self, rate: Vector3, before: Vector3) -> Vector3:
        """The angular rate, or the one before if it has changed by more than anything can make it. The next one is
        taken as it is: one wrong reading is left out, and a change that stays is not."""
        most = self.config.angular_rate_change
        wild = not self._held and any(abs(now - then) > most for now, then in zip(rate, before, strict=True))
        self._held = wild
        if not wild:
            return rate
        self.statistics.outliers += 1
        return before

    def _refuse_length(self, frame: CanFrame, place: int) -> None:
        self._next = _WAITING
        self.statistics.wrong_length += 1
        self._content = ImuHealth.WRONG_LENGTH
        expected = " or ".join(str(length) for length in self._layout.lengths[place])
        self.fault_text = (
            f"IMU frame {frame.can_id:03X}h has {len(frame.data)} data bytes, not {expected}. Remedy: the IMU streams "
            f"another format; set imu.precision, imu.slots and imu.base_id to what the device sends."
        )

    def age_ns(self, now_ns: int) -> int | None:
        """How old the latest reading is at `now_ns`; None before the first."""
        return None if self._sample is None else now_ns - self._sample.timestamp_ns

    def health(self, now_ns: int) -> ImuHealth:
        """Whether the latest reading may be used at `now_ns`. More than 1.5 periods without one is SILENT, unless
        frames arrive but are rejected for their content."""
        if self._content is not ImuHealth.OK:
            return self._content
        if self._sample is None or now_ns - self._sample.timestamp_ns > self._longest_interval_ns + self._latency_ns:
            return ImuHealth.SILENT
        return ImuHealth.OK

    def reset(self, start_ns: int = 0) -> None:
        """Start again: sets whose first frame came before `start_ns` do not count. Statistics go on.

        The set being received survives if it began at `start_ns` or later, so that a replay from there is the same.
        """
        if self._next != _WAITING and self._first_ns < start_ns:
            self._next = _WAITING
        self._start_ns = start_ns
        self._sample = None
        self._held = False
        for repeats in (self._sets, *self._axes):
            repeats.begin()
        self.frozen = 0
        self._content = ImuHealth.OK
        self.accelerometer_stuck = False
        self.fault_text = ""
