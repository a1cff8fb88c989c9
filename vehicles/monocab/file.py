"""Content of the vehicle file of a MONOCAB beyond the sections that all vehicles share."""

from __future__ import annotations

from collections.abc import Mapping
from math import tau
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from upright.drivers.observed_speed import Layout, SpeedConfig
from upright.vehicles.sections import (
    CONTROLLER_OUTPUT,
    REST,
    CanId,
    ControllerSection,
    LimitsSection,
    NotNegative,
    ParameterEntry,
    ParametersSection,
    Positive,
    Role,
    Section,
    VehicleFile,
    up_to,
)

ROLL_REFERENCE, TRIM_RATE = "roll_reference", "trim_rate"
"""Injection points of its own: the reference of the roll angle, rad, and the rate of the trim mass, m/s."""
REDUCED, FULL = "reduced", "full"
"""The controllers: of the roll angle by the gimbals alone, and with the trim mass, which brings the gimbals back."""


class MonocabLimits(LimitsSection):
    """Limits of roll, gimbals and trim mass."""

    roll_deg: Annotated[float, up_to(15.0, "a vehicle that leans further has left the rail")]
    roll_rate_deg: Annotated[
        float, up_to(90.0, "an impact on the supports at this rate breaks them; a fall has 12 deg/s")
    ]
    precession_deg: Annotated[float, up_to(89.0, "it must be below 90, where the gyro has no roll torque left")]
    precession_budget_deg: Annotated[float, up_to(89.0, "it must be below 90, where the gyro has no roll torque left")]
    precession_rate: Annotated[
        float, up_to(5.0, "the gyroscopic torque at a higher rate is beyond the gimbals' bearings")
    ]
    precession_acceleration: Annotated[float, up_to(500.0, "no gimbal drive follows it")]
    gimbal_mismatch_deg: Annotated[float, up_to(20.0, "gimbals that differ by more twist the frame")]
    trim_position: Annotated[float, up_to(2.0, "the vehicle is not wider")]
    trim_rate: Annotated[float, up_to(2.0, "a trim mass at a higher rate breaks its end stops")]
    trim_acceleration: Annotated[float, up_to(20.0, "no trim drive follows it")] = 0.5
    """m/s^2, of the setpoint."""
    load_torque: Annotated[float, up_to(5000.0, "no trim mass balances it, and slow flywheels would not be found")] = (
        600.0
    )
    """N m, the largest load on the vehicle that is no fault: a person who sits down is 550 N m."""
    gimbal_following_deg: Annotated[
        float, up_to(5.0, "a gimbal that stands still would be found after the vehicle has fallen")
    ] = 0.1
    """deg by which a gimbal may move otherwise than any likely speed loop would move it (see `watch`): the play of a
    planetary gear, 6 minutes of arc [assumed]."""
    trim_following: Annotated[float, up_to(0.1, "a trim mass that runs away would be found at its end stop")] = 0.002
    """m, the same of the trim mass."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.support_deg >= self.roll_deg:
            raise ValueError("support_deg must be below roll_deg, or resting on a support would be a fault")
        if self.precession_budget_deg >= self.precession_deg:
            raise ValueError(
                "precession_budget_deg must be below precession_deg, or a run cannot end in an orderly way"
            )
        return self


class MonocabCad(ParametersSection):
    """The roll motion's parameters; see `vehicles.monocab.control.linear_model`."""

    UNITS: ClassVar[Mapping[str, str]] = {
        "inertia": "kg m^2",
        "gravity_stiffness": "N m/rad",
        "angular_momentum": "N m s",
        "speed_loop_lag": "s",
        "trim_mass": "kg",
        "trim_height": "m",
        "gimbal_inertia": "kg m^2",
        "trim_speed_loop_lag": "s",
    }

    inertia: ParameterEntry
    gravity_stiffness: ParameterEntry
    angular_momentum: ParameterEntry
    speed_loop_lag: ParameterEntry
    trim_mass: ParameterEntry
    trim_height: ParameterEntry
    gimbal_inertia: ParameterEntry | None = None
    """Of both gimbals with their rotors, about the precession axes; for the apparent inertia only."""
    trim_speed_loop_lag: ParameterEntry | None = None
    """Of the trim mass, if it is not the gimbals' `speed_loop_lag`."""


class Flywheel(Section):
    """A flywheel whose own inverter reports its speed on the bus of the drives. It is read, and never commanded."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,32}$")]
    can_id: CanId
    """Of the frame with its speed, usually a TPDO of its inverter."""
    start_byte: Annotated[int, Field(ge=0, le=7)] = 0
    """Where the speed is in that frame; little-endian."""
    layout: Layout = "int32"
    velocity_unit_rpm: Positive
    """rpm of the flywheel per count."""
    direction: Literal[1, -1]
    """+1 if a positive count is the direction in which this flywheel has to turn."""
    inertia: ParameterEntry
    """kg m^2, about its axis of rotation."""

    @model_validator(mode="after")
    def _fits_into_a_frame(self) -> Self:
        if self.speed.size > 8:
            raise ValueError(f"{self.name}: an {self.layout} from byte {self.start_byte} on is not within 8 bytes")
        if self.inertia.unit != "kg m^2" or self.inertia.value <= 0.0:
            raise ValueError(f"{self.name}: the inertia is in kg m^2, and above 0")
        return self

    @property
    def speed(self) -> SpeedConfig:
        """How its speed is read."""
        unit = self.direction * self.velocity_unit_rpm * tau / 60.0
        return SpeedConfig(self.name, self.can_id, self.start_byte, self.layout, unit)


class MonocabController(ControllerSection):
    """Weights of the LQI design, and the lean that brings the gimbals back; see `control.controller`."""

    roll_weight: Positive
    roll_rate_weight: NotNegative
    integral_weight: Positive
    effort_weight: Positive
    precession_return_time: NotNegative
    precession_return_limit_deg: NotNegative


class MonocabFullController(ControllerSection):
    """Weights of the full LQI design, over roll, trim mass and precession; see `control.full`."""

    roll_weight: Positive = 5.0e2
    """1/rad^2."""
    roll_rate_weight: NotNegative = 0.0
    """s^2/rad^2; a larger one damps more."""
    roll_integral_weight: Positive = 2.5e5
    """1/(rad s)^2; with a larger one a load deflects the vehicle less."""
    precession_weight: NotNegative = 1.0
    """1/rad^2; with a larger one the gimbals turn less."""
    precession_integral_weight: Positive = 3.0
    """1/(rad s)^2; with a larger one the gimbals come back to the middle sooner."""
    trim_rate_weight: NotNegative = 0.0
    """s^2/m^2; with a larger one the trim mass moves more slowly."""
    trim_effort_weight: Positive = 30.0
    """s^2/m^2, on the trim rate setpoint."""
    effort_weight: Positive = 1.0
    """s^2/rad^2, on the precession rate setpoint; a larger one reduces the bandwidth."""


class MonocabFile(VehicleFile):
    """A monorail vehicle that two or more gimbals hold up, with or without a trim mass."""

    ROLES: ClassVar[Mapping[str, Role]] = {"gimbal": Role(1, 16), "trim": Role(0, 1, follows=1, linear=True)}
    INJECTION_POINTS: ClassVar[tuple[str, ...]] = (ROLL_REFERENCE, REST, CONTROLLER_OUTPUT, TRIM_RATE)
    CONTROLLERS: ClassVar[tuple[str, ...]] = (REDUCED, FULL)

    limits: MonocabLimits
    parameters: MonocabCad
    controller: MonocabController
    full_controller: MonocabFullController = MonocabFullController()
    flywheel: Annotated[list[Flywheel], Field(default_factory=list)]
    """The flywheels whose speed is on the bus: all of them or none, since together they are the angular momentum."""

    @model_validator(mode="after")
    def _flywheels_can_be_observed(self) -> Self:
        if any(each.spin is not None for each in self.experiments.values()) and not self.flywheel:
            raise ValueError("an experiment with spin observes the flywheels: add a [[flywheel]] section for each")
        if len({each.name for each in self.flywheel}) != len(self.flywheel):
            raise ValueError("flywheel: two flywheels have the same name")
        return self

    @property
    def observed(self) -> tuple[SpeedConfig, ...]:
        return tuple(each.speed for each in self.flywheel)

    @property
    def flywheel_speed(self) -> float:
        """rad/s at which the flywheels together have the file's angular momentum."""
        return self.parameters.angular_momentum.value / sum(each.inertia.value for each in self.flywheel)

    @model_validator(mode="after")
    def _full_controller_has_a_trim_mass(self) -> Self:
        if self.full_experiments and not any(drive.role == "trim" for drive in self.drive):
            name = self.full_experiments[0]
            raise ValueError(f'experiments.{name}: controller = "{FULL}" needs a trim mass: add its drive')
        return self

    @property
    def largest_on_support(self) -> float:
        """rad/s of precession: half the torque that would lift the vehicle off its support."""
        values = self.parameters.values
        return 0.5 * values["gravity_stiffness"] * self.support / values["angular_momentum"]

    @property
    def full_experiments(self) -> list[str]:
        """Names of the experiments that the full controller balances."""
        return [name for name, each in self.experiments.items() if each.controller == FULL]
