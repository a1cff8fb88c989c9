"""What the model of a cube says about its measurements while it runs: does the wheel turn as its torque makes it, and
does the gyro change by more than anything can accelerate the body?

    wheel_inertia (tilt'' + wheel'') = torque - wheel_friction wheel'

The torque is that of one of the latest setpoints, its scale and the parameters are known within a tenth and twice their
standard deviations, and a part of the largest torque is dry friction, which is an effect to be diagnosed. The rate by
which the wheel has turned outside that is added up (a CUSUM, as for the axes of a MONOCAB).
"""

from __future__ import annotations

from collections import deque

from upright.drivers.vehicle_io import VehicleIo
from upright.estimators.checks.imu_consistency import AVERAGED
from upright.telemetry.samples import Vector3
from upright.vehicles.contract import Lean
from upright.vehicles.cube.axes import WheelMeasurement
from upright.vehicles.cube.file import CubeFile
from upright.vehicles.watch import DEVIATIONS, SCALE, GyroJumps

DRY = 0.05
"""Share of the largest torque that may be dry friction."""
ANSWERS = 4
"""Cycles from the one in which a torque is sent to the last in which a rate is read that it has changed alone: on the
bus, and the filter of the drive's rate."""


class CubeWatch:
    """`wheel_following` (rad/s): how much the wheel has turned otherwise than its torque makes it; `jump` (rad/s) of
    the gyro."""

    averaged = AVERAGED

    __slots__ = (
        "_down",
        "_drive",
        "_dry",
        "_friction",
        "_inertia",
        "_jumps",
        "_rate",
        "_torques",
        "_up",
        "jump",
        "wheel_following",
    )

    def __init__(self, vehicle: CubeFile, io: VehicleIo) -> None:
        parameters, limits, period = vehicle.parameters, vehicle.limits, vehicle.period
        (self._drive,) = io.role("wheel")
        self._dry = DRY * limits.torque
        self._inertia, self._friction = parameters.wheel_inertia, parameters.wheel_friction
        lightest = parameters.inertia.value - DEVIATIONS * parameters.inertia.std
        torque = limits.torque + parameters.gravity_stiffness.value * vehicle.support
        self._jumps = GyroJumps(torque / max(lightest, 0.5 * parameters.inertia.value), period)
        self._torques: deque[float] = deque(maxlen=ANSWERS)
        self.reset()

    def reset(self) -> None:
        """Begin again: an experiment starts."""
        self._jumps.reset()
        self._torques.clear()
        self._rate: float | None = None
        self._up = self._down = 0.0
        self.jump = self.wheel_following = 0.0

    def unexplained(self, contradiction: Vector3) -> Vector3:
        """All of it: the edge does not move."""
        return contradiction

    def update(self, dt: float, lean: Lean, drives: WheelMeasurement) -> None:
        """One cycle, `dt` s after the last one, before its setpoints are sent."""
        self._jumps.update(lean.rate)
        self.jump = self._jumps.jump
        torques, rate = self._torques, drives.rate + lean.rate
        torques.append(self._drive.setpoint)
        before, self._rate = rate if self._rate is None else self._rate, rate
        inertia, friction = self._inertia, self._friction
        lowest, highest = min(torques), max(torques)
        doubt = self._dry + DEVIATIONS * friction.std * abs(drives.rate)
        lowest -= SCALE * abs(lowest) + doubt + friction.value * drives.rate
        highest += SCALE * abs(highest) + doubt - friction.value * drives.rate
        share = dt / inertia.value
        off = DEVIATIONS * inertia.std / inertia.value
        change = rate - before
        self._up = max(0.0, self._up + change - highest * share - off * abs(change))
        self._down = max(0.0, self._down + lowest * share - change - off * abs(change))
        self.wheel_following = max(self._up, self._down)
