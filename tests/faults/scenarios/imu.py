"""Faults of the IMU: its frames, its readings, its time stamps and its mount. Readings are in g and deg/s."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from math import cos, inf, nan, pi, radians, sin

from faults import clues
from faults.bench import Bench
from faults.fault import CONTROL_LOST, LYING_IMU, SILENT_IMU, Fault, Wanted, harmless, in_order, stopped
from upright.drivers.bus.frame_clock import FrameClock
from upright.telemetry.samples import CanFrame
from upright.vehicles.bounds import Code

G = 9.80665
Change = Callable[[Bench, list[float]], list[float]]
LIES = (*LYING_IMU, Code.IMU_STUCK, Code.IMU_OUT_OF_RANGE)


def flag(name: str) -> Callable[[Bench], None]:
    """A fault that the virtual IMU has of its own."""
    return lambda bench: setattr(bench.plant_side.imu_stream, name, True)


def reading(change: Change) -> Callable[[Bench], None]:
    """Change the values of each set."""
    return lambda bench: bench.change_imu(lambda values: change(bench, values))


def gyro(change: Callable[[float], float]) -> Callable[[Bench], None]:
    """Change the rate about the axis that the vehicle falls about."""

    def changed(bench: Bench, values: list[float]) -> list[float]:
        values[bench.gyro] = change(values[bench.gyro])
        return values

    return reading(changed)


def lateral(change: Callable[[float], float]) -> Callable[[Bench], None]:
    """Change the acceleration that shows how far the vehicle leans."""

    def changed(bench: Bench, values: list[float]) -> list[float]:
        values[bench.lateral] = change(values[bench.lateral])
        return values

    return reading(changed)


def frozen(channels: Callable[[Bench], slice]) -> Callable[[Bench], None]:
    """Repeat the first values of these channels."""

    def inject(bench: Bench) -> None:
        kept: list[float] = []

        def change(values: list[float]) -> list[float]:
            where = channels(bench)
            if not kept:
                kept.extend(values[where])
            values[where] = kept
            return values

        bench.change_imu(change)

    return inject


def spike(channel: Callable[[Bench], int], height: float) -> Callable[[Bench], None]:
    """One sample every second is off by `height`."""

    def inject(bench: Bench) -> None:
        count, every = 0, bench.vehicle.control.rate

        def change(values: list[float]) -> list[float]:
            nonlocal count
            if count % every == 0:
                values[channel(bench)] += height
            count += 1
            return values

        bench.change_imu(change)

    return inject


def ramp(slope: float) -> Callable[[Bench], None]:
    """The gyro's offset grows by `slope` deg/s per second."""

    def inject(bench: Bench) -> None:
        begin = bench.truth.time

        def change(values: list[float]) -> list[float]:
            values[bench.gyro] += slope * (bench.truth.time - begin)
            return values

        bench.change_imu(change)

    return inject


def gap(sets: int) -> Callable[[Bench], None]:
    """`sets` consecutive sets are missing."""

    def inject(bench: Bench) -> None:
        left = sets

        def change(values: list[float]) -> list[float] | None:
            nonlocal left
            left -= 1
            return values if left < 0 else None

        bench.change_imu(change)

    return inject


def slower(factor: int) -> Callable[[Bench], None]:
    """Only one set of `factor` is sent."""

    def inject(bench: Bench) -> None:
        count = 0

        def change(values: list[float]) -> list[float] | None:
            nonlocal count
            count += 1
            return values if count % factor == 0 else None

        bench.change_imu(change)

    return inject


def late(delay: float) -> Callable[[Bench], None]:
    """The readings are `delay` s old."""

    def inject(bench: Bench) -> None:
        count = len(bench.imu_ids)
        oldest = -count * (1 + round(delay * bench.vehicle.control.rate))

        def change(values: list[float]) -> list[float]:
            return list(struct.unpack("<6f", b"".join(bench.imu_frames[oldest + place] for place in range(count))))

        bench.change_imu(change)

    return inject


def whole_sets(change: Callable[[list[CanFrame]], list[CanFrame]]) -> Callable[[Bench], None]:
    """Change the order or number of the frames of each set."""

    def inject(bench: Bench) -> None:
        ids, waiting = bench.io.imu.can_ids, list[CanFrame]()

        def through(frame: CanFrame) -> list[CanFrame]:
            if frame.can_id not in ids:
                return [frame]
            waiting.append(frame)
            if frame.can_id != ids[-1]:
                return []
            frames = change(list(waiting))
            waiting.clear()
            return frames

        bench.received.append(through)

    return inject


def frames_twice(bench: Bench) -> None:
    ids = bench.io.imu.can_ids
    bench.received.append(lambda frame: [frame, frame] if frame.can_id in ids else [frame])


def stamps(change: Callable[[int, int], int]) -> Callable[[Bench], None]:
    """Change the receive times of all frames: `change` gets them, and the one at the injection, in ns."""

    def inject(bench: Bench) -> None:
        begin = bench.plant_side.time_ns
        bench.received.append(
            lambda frame: [CanFrame(change(frame.timestamp_ns, begin), frame.can_id, frame.data, error=frame.error)]
        )

    return inject


def wall_clock(off: Callable[[int], int]) -> Callable[[Bench], None]:
    """The kernel stamps frames by a clock that is `off(ns since the injection)` ns; they are read through the time base
    of the service, as from a socket."""

    def inject(bench: Bench) -> None:
        begin = bench.plant_side.time_ns
        clock = FrameClock(0)
        clock.read(begin, begin)

        def through(frame: CanFrame) -> list[CanFrame]:
            now = bench.plant_side.time_ns
            clock.read(now + off(now - begin), now)
            stamp = frame.timestamp_ns + off(frame.timestamp_ns - begin)
            stamp = clock.convert(stamp) if clock.stepping else stamp + clock.shift_ns
            return [CanFrame(stamp, frame.can_id, frame.data, error=frame.error)]

        bench.received.append(through)

    return inject


def jittering(deviation: float) -> Callable[[Bench], None]:
    """The frames of each set get a time stamp that is off by a random time, s."""

    def inject(bench: Bench) -> None:
        draw, first = random.Random(1), bench.io.imu.can_ids[0]
        shift = 0

        def through(frame: CanFrame) -> list[CanFrame]:
            nonlocal shift
            if frame.can_id == first:
                shift = round(draw.gauss(0.0, deviation) * 1e9)
            return [CanFrame(frame.timestamp_ns + shift, frame.can_id, frame.data, error=frame.error)]

        bench.received.append(through)

    return inject


def loose(amplitude: float, frequency: float) -> Callable[[Bench], None]:
    """The IMU rocks on its mount by `amplitude` deg, `frequency` times a second."""

    def inject(bench: Bench) -> None:
        begin, turns = bench.truth.time, 2.0 * pi * frequency

        def change(values: list[float]) -> list[float]:
            time = bench.truth.time - begin
            tilt = radians(amplitude) * sin(turns * time)
            values[bench.gyro] += amplitude * turns * cos(turns * time)
            # Positive about x leans gravity to +y, about y to -x: `VirtualImu` and the plants' `felt`.
            values[bench.lateral] += (1.0 if bench.truth.falling_axis == 0 else -1.0) * sin(tilt)
            return values

        bench.change_imu(change)

    return inject


def exchanged(bench: Bench) -> None:
    """Acceleration and angular rate change places."""
    bench.change_imu(lambda values: values[3:] + values[:3])


def turned(bench: Bench) -> None:
    """x and y change places, as if the device had been turned by a quarter."""
    bench.change_imu(lambda v: [v[1], v[0], v[2], v[4], v[3], v[5]])


def _offset(step: float) -> Fault:
    return stopped(
        f"gyro_offset_{step:g}",
        f"the gyro's offset jumps by {step:g} deg/s",
        gyro(lambda rate: rate + step),
        *LIES,
        within=CONTROL_LOST,
        why="a jump of the rate in one sample is an angular acceleration that no torque on the vehicle makes",
        or_in_order=True,
    )


ACCELERATIONS = slice(0, 3)

FAULTS: tuple[Fault, ...] = (
    stopped("imu_silent", "the IMU stops sending", flag("silent"), Code.IMU_SILENT, within=CONTROL_LOST),
    *(harmless(f"imu_gap_{sets}", f"{sets} sets of the IMU are missing", gap(sets), passes=True) for sets in (1, 3, 6)),
    harmless(
        "imu_gap_7",
        "7 sets of the IMU are missing",
        gap(7),
        or_stopped=(Code.IMU_SILENT,),
        passes=True,
        why="as many as limits.missed_cycles allows: on the edge",
    ),
    *(
        stopped(
            f"imu_gap_{sets}",
            f"{sets} sets of the IMU are missing",
            gap(sets),
            Code.IMU_SILENT,
            within=CONTROL_LOST,
            passes=True,
        )
        for sets in (8, 12)
    ),
    stopped("imu_stuck", "the IMU repeats its last set", flag("stuck"), Code.IMU_STUCK, within=CONTROL_LOST),
    stopped(
        "gyro_frozen",
        "the gyro of the falling axis repeats its last value, the rest is alive",
        frozen(lambda bench: slice(bench.gyro, bench.gyro + 1)),
        *LIES,
        within=CONTROL_LOST,
        why="24 bits of a gyro are never the same for ten samples: it shows before the vehicle moves",
    ),
    stopped("gyro_dead", "the gyro of the falling axis reads 0", gyro(lambda rate: 0.0), *LIES, within=CONTROL_LOST),
    stopped(
        "gyro_all_zero",
        "all gyros read 0, the accelerometers are alive",
        reading(lambda bench, values: values[:3] + [0.0] * 3),
        *LIES,
        within=CONTROL_LOST,
    ),
    in_order(
        "accelerometer_frozen",
        "the accelerometers repeat their last values, the gyros are alive",
        frozen(lambda bench: ACCELERATIONS),
        *LYING_IMU,
        says=("accel",),
        why="the gyro and the gimbals carry the angle for as long as lowering takes",
    ),
    in_order(
        "accelerometer_zero",
        "the accelerometers read 0, the gyros are alive",
        reading(lambda bench, values: [0.0] * 3 + values[3:]),
        *LYING_IMU,
        says=("accel",),
    ),
    harmless(
        "gyro_offset_0.5", "the gyro's offset jumps by 0.5 deg/s", gyro(lambda rate: rate + 0.5), or_in_order=True
    ),
    *(_offset(step) for step in (2.0, 5.0, 10.0, 30.0)),
    in_order(
        "gyro_drift",
        "the gyro's offset grows by 0.5 deg/s every second",
        ramp(0.5),
        *LYING_IMU,
        says=("gyro", "imu"),
        since=clues.gyro_lies,
        why="known once it is off by 1 deg/s; the accelerometer corrects less than that, so that it can be lowered",
    ),
    stopped(
        "gyro_saturated",
        "the gyro is at its rail of 400 deg/s",
        gyro(lambda rate: 400.0),
        *LIES,
        "roll_rate",
        "tilt_rate",
        within=CONTROL_LOST,
    ),
    *(
        harmless(
            f"gyro_spike_{height:g}",
            f"one sample of the gyro every second is off by {height:g} deg/s",
            spike(lambda bench: bench.gyro, height),
            why="the model bridges one sample; bits that tip over are no reason to drop half a tonne",
        )
        for height in (30.0, 300.0)
    ),
    in_order(
        "accelerometer_saturated",
        "the lateral accelerometer is at its rail of 4 g",
        lateral(lambda value: 39.19 / G),
        *LYING_IMU,
        says=("accel", "imu"),
        why="the gyro and the gimbals carry the angle for as long as lowering takes",
    ),
    in_order(
        "accelerometer_offset",
        "the lateral accelerometer is off by 1 m/s^2 from now on",
        lateral(lambda value: value + 1.0 / G),
        *LYING_IMU,
        says=("accel", "imu"),
        why="6 deg of apparent angle within one sample, of which the gyro knows nothing",
    ),
    harmless(
        "accelerometer_spike",
        "one sample of the lateral accelerometer every second is off by 3 g",
        spike(lambda bench: bench.lateral, 3.0),
    ),
    *(
        stopped(
            f"gyro_{name}",
            f"the gyro reads {value:g}",
            gyro(lambda rate, value=value: value),  # type: ignore[misc]
            *SILENT_IMU,
            *LYING_IMU,
            within=CONTROL_LOST,
        )
        for name, value in (("nan", nan), ("inf", inf), ("denormal", 1e-42), ("huge", 3e38))
    ),
    stopped(
        "imu_slots_exchanged",
        "acceleration and angular rate change places while it runs",
        exchanged,
        *SILENT_IMU,
        *LYING_IMU,
        within=CONTROL_LOST,
    ),
    stopped(
        "imu_turned",
        "x and y of the IMU change places while it runs",
        turned,
        *LIES,
        within=CONTROL_LOST,
        since=clues.gyro_lies,
        why="at a standstill all gyros read the same",
    ),
    stopped(
        "gyro_reversed",
        "the gyro's sign turns while it runs",
        gyro(lambda rate: -rate),
        *LIES,
        within=CONTROL_LOST,
        since=clues.gyro_lies,
        why="at a standstill both signs are the same reading",
    ),
    stopped(
        "gyro_in_radians",
        "the gyro sends rad/s in place of deg/s",
        gyro(radians),
        *LIES,
        within=CONTROL_LOST,
        since=clues.gyro_lies,
        why="at a standstill both units are the same reading",
    ),
    stopped(
        "imu_other_precision",
        "the IMU streams in its other precision",
        flag("wrong_format"),
        *SILENT_IMU,
        within=CONTROL_LOST,
    ),
    stopped(
        "imu_short_frames", "the IMU's frames lack their last byte", flag("short"), *SILENT_IMU, within=CONTROL_LOST
    ),
    stopped(
        "imu_lost_frame",
        "the last frame of each IMU set is missing",
        flag("incomplete"),
        *SILENT_IMU,
        within=CONTROL_LOST,
    ),
    stopped(
        "imu_reversed_sets",
        "the frames of each IMU set come in reverse order",
        whole_sets(lambda frames: frames[::-1]),
        *SILENT_IMU,
        within=CONTROL_LOST,
        why="a node sends in the order of its sets; a set that does not is none, and nobody knows which is which",
    ),
    harmless("imu_frames_twice", "every IMU frame comes twice", frames_twice, why="the second one is dropped"),
    harmless(
        "imu_sets_twice",
        "every IMU set comes twice",
        whole_sets(lambda frames: frames + frames),
        why="the second one is dropped",
    ),
    *(
        harmless(f"imu_late_{delay}ms", f"the IMU's readings are {delay} ms old, unannounced", late(delay * 1e-3))
        for delay in (4, 8, 20)
    ),
    harmless(
        "imu_late_40ms",
        "the IMU's readings are 40 ms old, unannounced",
        late(0.04),
        or_in_order=True,
        why="as long as the drives' own lag: half of the margin",
    ),
    stopped(
        "imu_late_80ms",
        "the IMU's readings are 80 ms old, unannounced",
        late(0.08),
        *LYING_IMU,
        since=clues.gyro_lies,
        or_in_order=True,
        why="at a standstill an old reading is the same as a new one",
    ),
    harmless(
        "imu_rate_half",
        "the IMU sends at half its rate",
        slower(2),
        or_in_order=True,
        why="half of the cycles are missed: slower, but it holds",
    ),
    stopped(
        "imu_rate_third",
        "the IMU sends at a third of its rate",
        slower(3),
        Code.IMU_LOSSES,
        Code.IMU_SILENT,
        or_in_order=True,
        why="the device has lost its settings; the controller was not designed for this rate",
    ),
    stopped(
        "imu_rate_quarter",
        "the IMU sends at a quarter of its rate",
        slower(4),
        Code.IMU_LOSSES,
        Code.IMU_SILENT,
        or_in_order=True,
    ),
    *(
        harmless(
            f"clock_{name}",
            f"the clock of the time stamps steps by {text}",
            wall_clock(lambda since, step=step: step),  # type: ignore[misc]
            why="a clock that somebody sets is an event, and nothing else; the daemon reports it, not the loop",
        )
        for name, text, step in (
            ("forward_20ms", "+20 ms", 20_000_000),
            ("forward_1s", "+1 s", 1_000_000_000),
            ("forward_1h", "+1 h", 3_600_000_000_000),
            ("back_20ms", "-20 ms", -20_000_000),
            ("back_1s", "-1 s", -1_000_000_000),
            ("back_1h", "-1 h", -3_600_000_000_000),
        )
    ),
    harmless(
        "clock_slewed",
        "the clock of the time stamps runs fast by 500 ppm",
        wall_clock(lambda since: since * 500 // 1_000_000),
        why="what time synchronisation does all day",
    ),
    harmless("stamps_jitter", "the time stamps are off by 2 ms at random", jittering(0.002)),
    harmless(
        "stamps_zero",
        "the time stamps are all 0: a driver without any",
        stamps(lambda time, begin: 0),
        reported=True,
        or_in_order=True,
        why="the samples still come every period; only their time is unknown",
    ),
    harmless(
        "stamps_frozen",
        "the time stamps stand still",
        stamps(lambda time, begin: begin),
        reported=True,
        or_in_order=True,
        or_stopped=(Wanted.IMU_TIME, Code.IMU_SILENT),
        why="the samples still come every period; only their time is unknown",
    ),
    stopped(
        "imu_loose",
        "the IMU is loose on its mount and rocks by 0.5 deg, 12 times a second",
        loose(0.5, 12.0),
        *LYING_IMU,
        or_in_order=True,
        why="38 deg/s that neither gimbals nor gravity make; off at once, or lowered by what the model knows",
    ),
)
