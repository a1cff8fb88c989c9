"""The balancing robot as the shared code sees it: what is measured, recorded and monitored, and its pilot."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from math import radians
from typing import Any

from upright.drivers.vehicle_io import VehicleIo
from upright.estimators.roll_filter import RollState
from upright.vehicles.bounds import DEGREES, DEGREES_PER_SECOND, IMU_CONTRADICTION, Bound, Unit, When
from upright.vehicles.contract import Command, Lean
from upright.vehicles.experiment.excitation import Excitation
from upright.vehicles.twsbr.axes import WheelMeasurement, Wheels
from upright.vehicles.twsbr.controller import TiltController
from upright.vehicles.twsbr.file import TwsbrFile
from upright.vehicles.twsbr.handling import WheelHandling
from upright.vehicles.twsbr.watch import TwsbrWatch


class TwsbrCode(StrEnum):
    """The quantity of a balancing robot that exceeds its bound, for programs."""

    TILT = "tilt"
    TILT_RATE = "tilt_rate"
    SETPOINT = "setpoint"
    WHEEL_RATE = "wheel_rate"
    FALLEN = "fallen"
    TRAVEL = "travel"
    TRAVEL_BUDGET = "travel_budget"
    HEADING = "heading"


VOLTS, METRES, RADIANS_PER_SECOND = Unit("V"), Unit("m", digits=3), Unit("rad/s", digits=1)


def bounds(vehicle: TwsbrFile) -> tuple[Bound, ...]:
    """The bounds of tilt, wheels and voltage."""
    limits = vehicle.limits
    tilt, rate, upright = (radians(each) for each in (limits.tilt_deg, limits.tilt_rate_deg, limits.upright_deg))
    spin = limits.wheel_rate
    return (
        Bound(TwsbrCode.TILT, "tilt", "angle", tilt, DEGREES, When.ALWAYS),
        Bound(TwsbrCode.TILT_RATE, "tilt rate", "rate", rate, DEGREES_PER_SECOND, When.ALWAYS),
        Bound(TwsbrCode.SETPOINT, "voltage", "setpoint", limits.voltage, VOLTS),
        Bound(TwsbrCode.WHEEL_RATE, "rate of the left wheel", "axes.left_rate", spin, RADIANS_PER_SECOND),
        Bound(TwsbrCode.WHEEL_RATE, "rate of the right wheel", "axes.right_rate", spin, RADIANS_PER_SECOND),
        replace(IMU_CONTRADICTION, when=When.UPRIGHT),  # it comes down onto its support hard
        Bound(TwsbrCode.FALLEN, "tilt while balancing", "angle", upright, DEGREES, When.UPRIGHT),
        Bound(TwsbrCode.TRAVEL, "travel", "axes.travel", limits.travel, METRES, When.BALANCING),
        Bound(
            TwsbrCode.TRAVEL_BUDGET,
            "travel budget used up",
            "axes.travel",
            limits.travel_budget,
            METRES,
            When.BALANCING,
            advice="only the tilt is held: balance the body, or make the excitation smaller or shorter",
        ),
        Bound(
            TwsbrCode.HEADING,
            "the robot turns, though both motors get the same voltage",
            "axes.heading",
            radians(limits.heading_deg),
            DEGREES,
            When.BALANCING,
            advice="check the motors, their cables and gears, and that both wheels grip",
        ),
    )


@dataclass(frozen=True, slots=True)
class WheelPilot:
    """The PID of a vehicle file. Its gains were tuned on the robot, so there is nothing to design."""

    vehicle: TwsbrFile
    wheels: Wheels

    def handling(self, excitation: Excitation, controller: str | None) -> WheelHandling:
        vehicle = self.vehicle
        return WheelHandling(
            TiltController.of(vehicle),
            self.wheels,
            support=vehicle.support,
            radius=vehicle.parameters.wheel_radius.value,
            on_reference=excitation.on_reference,
        )

    def findings(self) -> dict[str, Any]:
        return self.vehicle.controller.model_dump()

    def words(self) -> list[str]:
        section = self.vehicle.controller
        return [
            f"controller: {section.proportional_gain:g} V/deg, {section.integral_gain:g} V/(deg s), "
            f"{section.derivative_gain:g} V s/deg, at most {self.vehicle.limits.voltage:g} V"
        ]


class Twsbr:
    """One two-wheeled balancing robot: its vehicle file and its drivers."""

    angle = "tilt"

    def __init__(self, vehicle: TwsbrFile, io: VehicleIo) -> None:
        self.bounds = bounds(vehicle)
        self.watch = TwsbrWatch(vehicle.parameters.wheel_radius.value)
        self._vehicle = vehicle
        self._setpoint_age = -vehicle.imu.latency
        self._wheels = Wheels(io, vehicle.parameters.wheel_radius.value, vehicle.parameters.wheel_distance.value)
        self.measure = self._wheels.measure

    def lean(self, attitude: RollState) -> Lean:
        return Lean(attitude.pitch, attitude.pitch_rate)

    def values(
        self, attitude: RollState, drives: WheelMeasurement, command: Command, phase: float
    ) -> tuple[float, ...]:
        return (
            attitude.pitch,
            attitude.pitch_rate,
            attitude.pitch_std,
            drives.left_angle,
            drives.right_angle,
            drives.left_rate,
            drives.right_rate,
            self._wheels.left_voltage,
            self._wheels.right_voltage,
            self._setpoint_age,
            (attitude.timestamp_ns - drives.timestamp_ns) * 1e-9,
            command.reference,
            command.excitation,
            phase,
        )

    def interlocks(self, drives: WheelMeasurement) -> list[str]:
        return []

    def obstacles(self, drives: WheelMeasurement) -> list[str]:
        return []

    def pilot(self) -> WheelPilot:
        return WheelPilot(self._vehicle, self._wheels)
