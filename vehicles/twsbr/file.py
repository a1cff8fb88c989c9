"""Content of the vehicle file of a two-wheeled balancing robot beyond the sections that all vehicles share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Self

from pydantic import model_validator

from upright.vehicles.sections import (
    CONTROLLER_OUTPUT,
    ControllerSection,
    LimitsSection,
    NotNegative,
    ParameterEntry,
    ParametersSection,
    Positive,
    Role,
    VehicleFile,
    up_to,
)


class TwsbrLimits(LimitsSection):
    """Limits of tilt, wheels and voltage. `support_deg` is the tilt at which the robot lies on a bumper."""

    tilt_deg: Annotated[float, up_to(60.0, "a robot that leans further lies beside its supports")]
    tilt_rate_deg: Annotated[float, up_to(600.0, "an impact at this rate breaks a robot")]
    upright_deg: Annotated[float, up_to(45.0, "a robot that leans further has fallen")]
    """A robot that leans further while it is balanced has fallen."""
    wheel_rate: Annotated[float, up_to(200.0, "a robot that drives so fast is a danger to people")]
    """rad/s of each wheel relative to the body."""
    voltage: Annotated[float, up_to(60.0, "a higher voltage is a danger to people (IEC 61140)")]
    """V at a motor: that of the supply."""
    travel: Annotated[float, up_to(100.0, "nobody sees the end of such a test stand")]
    """m from where it got up: the edge of the test stand."""
    travel_budget: Annotated[float, up_to(100.0, "nobody sees the end of such a test stand")]
    """m from where it got up, at which an experiment ends in an orderly way."""
    heading_deg: Annotated[float, up_to(180.0, "a robot that turns round drives where nobody expects it")] = 20.0
    """deg from where it got up, at which an experiment ends in an orderly way: both motors get the same voltage."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.support_deg >= self.tilt_deg:
            raise ValueError("support_deg must be below tilt_deg, or lying on a bumper would be a fault")
        if self.upright_deg >= self.support_deg:
            raise ValueError("upright_deg must be below support_deg, or a fallen robot would not be noticed")
        if self.travel_budget >= self.travel:
            raise ValueError("travel_budget must be below travel, or a run cannot end in an orderly way")
        return self


class TwsbrCad(ParametersSection):
    """The parameters of `vehicles.twsbr.model`, the source paper's table 1."""

    UNITS: ClassVar[Mapping[str, str]] = {
        "wheel_radius": "m",
        "wheel_mass": "kg",
        "com_height": "m",
        "body_mass": "kg",
        "wheel_distance": "m",
        "yaw_inertia": "kg m^2",
        "tilt_inertia": "kg m^2",
        "gear_ratio": "1",
        "rotor_inertia": "kg m^2",
        "armature_resistance": "ohm",
        "armature_inductance": "H",
        "motor_constant": "N m/A",
        "motor_friction": "N m s/rad",
        "wheel_friction": "N m s/rad",
    }

    wheel_radius: ParameterEntry
    wheel_mass: ParameterEntry
    com_height: ParameterEntry
    body_mass: ParameterEntry
    wheel_distance: ParameterEntry
    yaw_inertia: ParameterEntry
    tilt_inertia: ParameterEntry
    gear_ratio: ParameterEntry
    rotor_inertia: ParameterEntry
    armature_resistance: ParameterEntry
    armature_inductance: ParameterEntry
    motor_constant: ParameterEntry
    motor_friction: ParameterEntry
    wheel_friction: ParameterEntry


class TwsbrController(ControllerSection):
    """Gains of the PID on the tilt in degrees, and the lean that brings the wheels back; see `controller`."""

    proportional_gain: Positive
    """V/deg."""
    integral_gain: NotNegative
    """V/(deg s)."""
    derivative_gain: NotNegative
    """V s/deg."""
    wheel_return_time: NotNegative
    """s in which the wheels come back to where the robot got up; 0: off, as in the paper."""
    wheel_return_limit_deg: NotNegative
    """Of the lean that brings them back."""


class TwsbrFile(VehicleFile):
    """A body on two wheels, each with a motor of its own."""

    ROLES: ClassVar[Mapping[str, Role]] = {"wheel": Role(2, 2)}
    INJECTION_POINTS: ClassVar[tuple[str, ...]] = ("tilt_reference", CONTROLLER_OUTPUT)

    limits: TwsbrLimits
    parameters: TwsbrCad
    controller: TwsbrController
