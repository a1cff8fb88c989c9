"""The MONOCAB as the shared code sees it: what is measured, recorded and monitored, and its pilot."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from math import degrees, radians
from typing import Any

from upright.drivers.vehicle_io import VehicleIo
from upright.estimators.data.segments import SUPPORT_MARGIN
from upright.estimators.roll_filter import RollState
from upright.models.control_design.lqi import ControlDesignError
from upright.models.control_design.robustness import CheckedDesign
from upright.vehicles.bounds import DEGREES, DEGREES_PER_SECOND, GYRO_JUMP, IMU_CONTRADICTION, Bound, Unit, When
from upright.vehicles.contract import Command, Lean
from upright.vehicles.experiment.excitation import Excitation
from upright.vehicles.monocab.axes import GimbalMeasurement, Gimbals
from upright.vehicles.monocab.control.controller import design
from upright.vehicles.monocab.control.full import full_if_used
from upright.vehicles.monocab.control.roll_design import RollDesign
from upright.vehicles.monocab.file import FULL, MonocabFile
from upright.vehicles.monocab.flywheels import SILENT, SLOW
from upright.vehicles.monocab.handling import GimbalHandling
from upright.vehicles.monocab.watch import MonocabWatch


class MonocabCode(StrEnum):
    """The quantity of a MONOCAB that exceeds its bound, for programs."""

    ROLL = "roll"
    ROLL_RATE = "roll_rate"
    PRECESSION = "precession"
    PRECESSION_RATE = "precession_rate"
    GIMBAL_MISMATCH = "gimbal_mismatch"
    TRIM_POSITION = "trim_position"
    TRIM_RATE = "trim_rate"
    PRECESSION_BUDGET = "precession_budget"
    GIMBAL_FOLLOWING = "gimbal_following"
    TRIM_FOLLOWING = "trim_following"
    FALLEN = "fallen"
    RECOVERY = "recovery"
    TORQUE_BALANCE = "torque_balance"
    FLYWHEELS = "flywheels"


METRES, PERCENT, SECONDS = Unit("m", digits=3), Unit("%", 100.0, digits=0), Unit("s")
GAINED_DEG = 5.0
"""deg/s of roll rate that no torque explains. Chosen, so that the swinging of a flexible cabin (the hidden effect
`flexible_mode`) is no fault; a fall reaches 12 deg/s."""
RECOVERY = 0.7
"""Share of the largest recoverable lean at which an experiment ends in order."""
RATE_MARGIN = 1.5
"""How far the measured rate of an axis may exceed the setpoint's limit: the speed loop overshoots a little."""


def bounds(vehicle: MonocabFile) -> tuple[Bound, ...]:
    """The bounds of roll, gimbals and trim mass."""
    limits = vehicle.limits
    precession, budget = radians(limits.precession_deg), radians(limits.precession_budget_deg)
    return (
        Bound(MonocabCode.ROLL, "roll", "angle", radians(limits.roll_deg), DEGREES, When.ALWAYS),
        Bound(
            MonocabCode.ROLL_RATE, "roll rate", "rate", radians(limits.roll_rate_deg), DEGREES_PER_SECOND, When.ALWAYS
        ),
        Bound(MonocabCode.PRECESSION, "precession angle", "axes.precession", precession, DEGREES),
        Bound(
            MonocabCode.PRECESSION_RATE,
            "precession rate",
            "axes.precession_rate",
            RATE_MARGIN * limits.precession_rate,
            DEGREES_PER_SECOND,
        ),
        Bound(
            MonocabCode.GIMBAL_MISMATCH,
            "difference between the gimbals",
            "axes.gimbal_mismatch",
            radians(limits.gimbal_mismatch_deg),
            DEGREES,
        ),
        Bound(
            MonocabCode.TRIM_POSITION,
            "trim mass position",
            "axes.trim_position",
            limits.trim_position,
            METRES,
        ),
        Bound(
            MonocabCode.TRIM_RATE,
            "trim mass rate",
            "axes.trim_rate",
            RATE_MARGIN * limits.trim_rate,
            Unit("m/s", digits=3),
        ),
        Bound(
            MonocabCode.GIMBAL_FOLLOWING,
            "the gimbals do not follow their setpoint: an error",
            "watched.gimbal_following",
            radians(limits.gimbal_following_deg),
            DEGREES,
        ),
        IMU_CONTRADICTION,
        GYRO_JUMP,
        Bound(
            MonocabCode.FALLEN,
            "the vehicle lies on its support while it is to be upright: roll",
            "angle",
            vehicle.support - SUPPORT_MARGIN,
            DEGREES,
            When.UPRIGHT,
        ),
        Bound(
            MonocabCode.RECOVERY,
            "the precession that is left cannot bring the vehicle back upright: a lean",
            "watched.recovery",
            1.0,
            PERCENT,
            When.UPRIGHT,
        ),
        Bound(
            MonocabCode.RECOVERY,
            "lean and precession leave too little to bring the vehicle back upright",
            "watched.recovery",
            RECOVERY,
            PERCENT,
            When.UPRIGHT,
            advice="make the excitation smaller, or find what pushes the vehicle",
        ),
        Bound(
            MonocabCode.TORQUE_BALANCE,
            "the vehicle rolls as no torque explains",
            "watched.gained",
            radians(GAINED_DEG),
            DEGREES_PER_SECOND,
            When.UPRIGHT,
            advice="check the speed of the flywheels, angular_momentum, and what pushes the vehicle",
        ),
        Bound(
            MonocabCode.TRIM_FOLLOWING,
            "the trim mass does not follow its setpoint",
            "watched.trim_following",
            limits.trim_following,
            Unit("mm", 1e3),
            advice="check that the trim mass moves freely, and its drive",
        ),
        Bound(
            MonocabCode.FLYWHEELS,
            "the flywheels do not keep their speed: angular momentum that is missing",
            "axes.flywheels.missing",
            SLOW,
            PERCENT,
            When.BALANCING,
            advice="check the inverters of the flywheels",
        ),
        Bound(
            MonocabCode.FLYWHEELS,
            "a flywheel does not report its speed any more: the last report is older",
            "axes.flywheels.silence",
            SILENT,
            SECONDS,
            When.BALANCING,
            advice="check its inverter, and its connection to the bus",
        ),
        Bound(
            MonocabCode.PRECESSION_BUDGET,
            "precession budget used up",
            "axes.precession",
            budget,
            DEGREES,
            When.BALANCING,
            advice="a static torque turns the gimbals: balance the vehicle, or make the excitation smaller",
        ),
    )


@dataclass(frozen=True, slots=True)
class GimbalPilot:
    """The LQI of a vehicle file as designed: the reduced one, and the full one, None if no experiment uses it, or why
    there is none."""

    vehicle: MonocabFile
    design: RollDesign
    full: CheckedDesign | ControlDesignError | None

    def handling(self, excitation: Excitation, controller: str | None) -> GimbalHandling:
        full = self.full
        if isinstance(full, ControlDesignError):
            if controller == FULL:
                raise full
            full = None
        return GimbalHandling.of(self.vehicle, self.design, full, excitation, controller)

    def findings(self) -> dict[str, Any]:
        full = self.full
        if isinstance(full, ControlDesignError):
            return self.design.findings() | {FULL: {"error": str(full)}}
        return self.design.findings() | ({FULL: full.findings()} if full else {})

    def words(self) -> list[str]:
        full = self.full
        if isinstance(full, ControlDesignError):
            return [*self.design.words(), f"no {FULL} controller: {full}"]
        return self.design.words() + (full.words(FULL) if full else [])


class Monocab:
    """One MONOCAB: its vehicle file and its drivers."""

    angle = "roll"

    def __init__(self, vehicle: MonocabFile, io: VehicleIo) -> None:
        self.bounds = bounds(vehicle)
        self.watch = MonocabWatch(vehicle, io)
        self._vehicle = vehicle
        self._setpoint_age = -vehicle.imu.latency
        self._flywheels = bool(vehicle.flywheel)
        self._gimbals = Gimbals(vehicle, io)
        self.measure = self._gimbals.measure

    def lean(self, attitude: RollState) -> Lean:
        return Lean(attitude.roll, attitude.roll_rate)

    def values(
        self, attitude: RollState, drives: GimbalMeasurement, command: Command, phase: float
    ) -> tuple[float, ...]:
        gimbals = self._gimbals
        return (
            attitude.roll,
            attitude.roll_rate,
            attitude.roll_std,
            attitude.bias_std,
            attitude.pitch,
            drives.precession,
            drives.precession_rate,
            gimbals.precession_rate_setpoint,
            drives.trim_position,
            drives.trim_rate,
            gimbals.trim_rate_setpoint,
            *((drives.flywheels.angular_momentum,) if self._flywheels else ()),
            self._setpoint_age,
            (attitude.timestamp_ns - drives.timestamp_ns) * 1e-9,
            command.reference,
            command.excitation,
            phase,
        )

    def interlocks(self, drives: GimbalMeasurement) -> list[str]:
        mismatch = degrees(drives.gimbal_mismatch)
        if mismatch > 0.5 * self._vehicle.limits.gimbal_mismatch_deg:
            return [f"The gimbals differ by {mismatch:.1f} deg: turn them to the same angle."]
        return []

    def obstacles(self, drives: GimbalMeasurement) -> list[str]:
        return self._gimbals.flywheels.obstacles(drives.flywheels)

    def pilot(self) -> GimbalPilot:
        vehicle = self._vehicle
        return GimbalPilot(vehicle, design(vehicle), full_if_used(vehicle))
