"""From when on a fault can be known at all: before it has a consequence that somebody measures, it cannot be.

Each clue gets the bench at the injection and returns a test for every cycle thereafter.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from math import degrees, radians
from typing import Any

from faults.bench import Bench
from faults.fault import DETECTED
from upright.simulation.bus.drive_node import VirtualDrive
from upright.simulation.bus.objects import POSITION_ACTUAL, VELOCITY_ACTUAL
from upright.telemetry.samples import CanFrame

RATE = {"gimbal": 0.05, "trim": 0.005}
"""rad/s and m/s by which the rate of an axis has to be wrong."""
TRIM = 0.002
"""m by which the trim mass has to be elsewhere: the motion of the vehicle shakes it, but does not carry it away."""
SHARE = 0.05
"""The same for drives without a speed loop: the share of the largest setpoint."""
WHEEL = 0.02
"""Share of the largest rate by which the reported rate of a wheel has to be wrong; a position, by that of a tenth of a
second."""
GYRO = 1.0
"""deg/s by which a gyro has to be wrong: a hundredth of that is its noise, and the model predicts the roll motion of
the next 50 ms to a tenth."""
MOMENTUM = 0.9
"""Share of the angular momentum below which flywheels count as running down: the identified value is within 1 %, but
nothing tells it apart from a disturbance at once."""
STEPS = 10
"""Of integration in a control period."""
LYING = 0.95
"""Share of the support's angle beyond which the vehicle lies on it."""


class SpeedLoop:
    """A healthy speed loop by the symmetric optimum, 1 / (1 + 4 T s + 8 T^2 s^2 + 8 T^3 s^3) with T s."""

    def __init__(self, time_constant: float) -> None:
        self._constant = time_constant
        self._state = [0.0, 0.0, 0.0]

    def rate(self, setpoint: float, seconds: float) -> float:
        """Its rate after `seconds` more of this setpoint."""
        constant, step = self._constant, seconds / STEPS
        rate, slope, bend = self._state
        for _ in range(STEPS):
            jerk = (setpoint - rate - 4.0 * constant * slope - 8.0 * constant**2 * bend) / (8.0 * constant**3)
            bend += step * jerk
            slope += step * bend
            rate += step * slope
        self._state = [rate, slope, bend]
        return rate


def follows(bench: Bench, drive: VirtualDrive) -> Callable[[], float]:
    """By how much an axis misses what a healthy one would do with the daemon's setpoints, in its tolerances."""
    driver = next(each for each in bench.io.drives if each.config.name == drive.config.name)
    axis: Any = drive.servo.axis  # type: ignore[attr-defined]
    limits: Any = bench.vehicle.limits
    period = bench.vehicle.period
    role = drive.config.role
    if role in RATE:
        loop = SpeedLoop(bench.lags(drive) / 4.0)
        place = bench.io.drives.index(driver)
        for setpoints in tuple(bench.setpoints)[:-1]:  # the last one acts until the first test
            loop.rate(setpoints[place], period)
        if role == "gimbal":
            return lambda: float(abs(loop.rate(driver.setpoint, period) - axis.rate)) / RATE[role]
        healthy = axis.position

        def elsewhere() -> float:
            nonlocal healthy
            healthy += loop.rate(driver.setpoint, period) * period
            return float(abs(healthy - axis.position)) / TRIM

        return elsewhere
    torque = hasattr(limits, "torque")
    tolerance = SHARE * (limits.torque if torque else limits.voltage)
    return lambda: float(abs(driver.setpoint - (axis.torque if torque else axis.demand)) / tolerance)


def not_followed(bench: Bench) -> Callable[[], bool]:
    """An axis that holds the vehicle up does not do what its setpoint wants."""
    missed = [follows(bench, drive) for drive in bench.main]

    def test() -> bool:
        return bench.loop.run is not None and max([each() for each in missed]) > 1.0

    return test


def trim_not_followed(bench: Bench) -> Callable[[], bool]:
    """The trim mass does not do what its setpoint wants."""
    missed = [follows(bench, drive) for drive in bench.of_role("trim")]
    return lambda: max([each() for each in missed]) > 1.0


def axis_lies(bench: Bench) -> Callable[[], bool]:
    """Position or rate that the daemon holds of a drive are not those that its encoder had at the last SYNC."""
    pairs = [(driver, bench.drives[driver.config.name]) for driver in bench.io.drives]
    limits: Any = bench.vehicle.limits

    def test() -> bool:
        for driver, drive in pairs:
            config, image = drive.config, drive.servo.image
            tolerance = RATE.get(config.role) or WHEEL * limits.wheel_rate
            per_turn = config.direction * config.axis_per_turn
            position = image[POSITION_ACTUAL] * per_turn / config.increments_per_turn
            rate = image[VELOCITY_ACTUAL] * per_turn / 60.0 * config.velocity_unit_rpm
            if abs(driver.velocity - rate) > tolerance or abs(driver.position - position) > DETECTED * tolerance:
                return True
        return False

    return test


def gyro_lies(bench: Bench) -> Callable[[], bool]:
    """The gyro's reading, after all faults, is not the rate at which the vehicle falls."""
    ids, gyro = bench.io.imu.can_ids, bench.gyro
    said: list[float] = []

    def listen(frame: CanFrame) -> list[CanFrame]:
        if frame.can_id == ids[gyro // 2] and len(frame.data) == 8:
            said[:] = [struct.unpack("<2f", frame.data)[gyro % 2]]
        return [frame]

    bench.received.append(listen)
    return lambda: bool(said) and not abs(said[0] - degrees(bench.leans[1])) <= GYRO


def flywheels_weak(bench: Bench) -> Callable[[], bool]:
    """The flywheels have lost a tenth of their angular momentum."""
    gimbals = bench.truth.gimbals
    before = sum(gimbal.momentum for gimbal in gimbals)
    return lambda: bool(sum(gimbal.momentum for gimbal in gimbals) < MOMENTUM * before)


def budget_used_up(bench: Bench) -> Callable[[], bool]:
    """The gimbals have turned as far as an experiment may turn them, or the vehicle lies on a support."""
    limits: Any = bench.vehicle.limits
    budget = radians(limits.precession_budget_deg)
    return lambda: abs(bench.truth.precession) > budget or abs(bench.leans[0]) > LYING * bench.support


def awake(bench: Bench) -> Callable[[], bool]:
    """The daemon gets the processor again: it cannot detect anything before."""
    return lambda: not bench.held


def warned(bench: Bench) -> Callable[[], bool]:
    """A drive warns in its statusword."""
    return lambda: any(drive.servo.warning for drive in bench.drives.values())


def heartbeat_overdue(bench: Bench) -> Callable[[], bool]:
    """A heartbeat is overdue for as long as the drives allow the master's own to be."""
    last, timeout = bench.truth.time, bench.vehicle.control.heartbeat_timeout
    return lambda: bool(bench.truth.time - last > timeout)


def lies_still(bench: Bench) -> Callable[[], bool]:
    """The vehicle has come to rest somewhere while it is being lowered, for half a second."""
    still = 0.0

    def test() -> bool:
        nonlocal still
        run = bench.loop.run
        lowering = run is not None and run.phase.name == "LOWER"
        still = still + bench.vehicle.period if lowering and abs(bench.leans[1]) < 0.002 else 0.0
        return still > 0.5

    return test
