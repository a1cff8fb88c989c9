"""The reaction-wheel cube as the shared code sees it: what is measured, recorded and monitored, and its pilot."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from math import radians
from typing import Any

from upright.drivers.vehicle_io import VehicleIo
from upright.estimators.roll_filter import RollState
from upright.models.control_design.robustness import CheckedDesign
from upright.vehicles.bounds import DEGREES, DEGREES_PER_SECOND, GYRO_JUMP, IMU_CONTRADICTION, Bound, Unit, When
from upright.vehicles.contract import Command, Lean
from upright.vehicles.cube.axes import Wheel, WheelMeasurement
from upright.vehicles.cube.controller import WheelController, design
from upright.vehicles.cube.file import CubeFile
from upright.vehicles.cube.handling import CubeHandling
from upright.vehicles.cube.watch import CubeWatch
from upright.vehicles.experiment.excitation import Excitation

NEWTON_METRES, RADIANS_PER_SECOND = Unit("N m", digits=3), Unit("rad/s", digits=0)

FOLLOWING = 0.005
"""Share of the wheel's largest rate by which it may have turned otherwise: a cogging motor is no fault."""


class CubeCode(StrEnum):
    """The quantity of a cube that exceeds its bound, for programs."""

    TILT = "tilt"
    TILT_RATE = "tilt_rate"
    SETPOINT = "setpoint"
    WHEEL_RATE = "wheel_rate"
    WHEEL_FOLLOWING = "wheel_following"
    FALLEN = "fallen"
    WHEEL_RATE_BUDGET = "wheel_rate_budget"


def bounds(vehicle: CubeFile) -> tuple[Bound, ...]:
    """The bounds of tilt, wheel and torque."""
    limits = vehicle.limits
    tilt, rate, upright = (radians(each) for each in (limits.tilt_deg, limits.tilt_rate_deg, limits.upright_deg))
    return (
        Bound(CubeCode.TILT, "tilt", "angle", tilt, DEGREES, When.ALWAYS),
        Bound(CubeCode.TILT_RATE, "tilt rate", "rate", rate, DEGREES_PER_SECOND, When.ALWAYS),
        Bound(CubeCode.SETPOINT, "torque", "setpoint", limits.torque, NEWTON_METRES),
        Bound(CubeCode.WHEEL_RATE, "rate of the wheel", "axes.rate", limits.wheel_rate, RADIANS_PER_SECOND),
        Bound(
            CubeCode.WHEEL_FOLLOWING,
            "the wheel does not turn as its torque makes it: a difference",
            "watched.wheel_following",
            FOLLOWING * limits.wheel_rate,
            RADIANS_PER_SECOND,
            When.UPRIGHT,
        ),
        replace(IMU_CONTRADICTION, when=When.UPRIGHT),  # it comes down onto its support hard
        GYRO_JUMP,
        Bound(CubeCode.FALLEN, "tilt while balancing", "angle", upright, DEGREES, When.UPRIGHT),
        Bound(
            CubeCode.WHEEL_RATE_BUDGET,
            "wheel rate budget used up",
            "axes.rate",
            limits.wheel_rate_budget,
            RADIANS_PER_SECOND,
            When.BALANCING,
            advice="a static torque spins up the wheel: balance the body, or make the excitation smaller or faster",
        ),
    )


@dataclass(frozen=True, slots=True)
class CubePilot:
    """The LQI of a vehicle file, as designed."""

    vehicle: CubeFile
    design: CheckedDesign

    def handling(self, excitation: Excitation, controller: str | None) -> CubeHandling:
        vehicle = self.vehicle
        return CubeHandling(
            WheelController(self.design.gains, vehicle.limits.torque),
            support=vehicle.support,
            inertia=vehicle.parameters.inertia.value,
            gravity_stiffness=vehicle.parameters.gravity_stiffness.value,
        )

    def findings(self) -> dict[str, Any]:
        return self.design.findings()

    def words(self) -> list[str]:
        return self.design.words()


class Cube:
    """One reaction-wheel cube: its vehicle file and its drivers."""

    angle = "tilt"

    def __init__(self, vehicle: CubeFile, io: VehicleIo) -> None:
        self.bounds = bounds(vehicle)
        self.watch = CubeWatch(vehicle, io)
        self._vehicle = vehicle
        self._setpoint_age = -vehicle.imu.latency
        self._wheel = Wheel(io)
        self.measure = self._wheel.measure

    def lean(self, attitude: RollState) -> Lean:
        return Lean(attitude.pitch, attitude.pitch_rate)

    def values(
        self, attitude: RollState, drives: WheelMeasurement, command: Command, phase: float
    ) -> tuple[float, ...]:
        return (
            attitude.pitch,
            attitude.pitch_rate,
            attitude.pitch_std,
            drives.angle,
            drives.rate,
            self._wheel.torque,
            self._setpoint_age,
            (attitude.timestamp_ns - drives.timestamp_ns) * 1e-9,
            command.excitation,
            phase,
        )

    def interlocks(self, drives: WheelMeasurement) -> list[str]:
        return []

    def obstacles(self, drives: WheelMeasurement) -> list[str]:
        return []

    def pilot(self) -> CubePilot:
        return CubePilot(self._vehicle, design(self._vehicle))
