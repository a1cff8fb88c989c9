"""Content of the vehicle file of a reaction-wheel cube beyond the sections that all vehicles share."""

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


class CubeLimits(LimitsSection):
    """Limits of tilt, wheel and torque. `support_deg` is the tilt at which the cube lies on a support."""

    tilt_deg: Annotated[float, up_to(60.0, "a cube that leans further lies beside its supports")]
    tilt_rate_deg: Annotated[float, up_to(600.0, "an impact at this rate breaks a cube")]
    upright_deg: Annotated[float, up_to(45.0, "a cube that leans further has fallen")]
    """A cube that leans further while it is balanced has fallen."""
    wheel_rate: Annotated[float, up_to(1500.0, "a wheel that turns faster may burst")]
    """rad/s of the wheel relative to the body."""
    wheel_rate_budget: Annotated[float, up_to(1500.0, "a wheel that turns faster may burst")]
    """rad/s, at which an experiment ends in an orderly way."""
    torque: Annotated[float, up_to(5.0, "a larger torque throws the cube over")]
    """N m at the wheel: that of the drive's current limit."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.support_deg >= self.tilt_deg:
            raise ValueError("support_deg must be below tilt_deg, or lying on a support would be a fault")
        if self.upright_deg >= self.support_deg:
            raise ValueError("upright_deg must be below support_deg, or a fallen cube would not be noticed")
        if self.wheel_rate_budget >= self.wheel_rate:
            raise ValueError("wheel_rate_budget must be below wheel_rate, or a run cannot end in an orderly way")
        return self


class CubeCad(ParametersSection):
    """The parameters of `model`, from table I of the paper."""

    UNITS: ClassVar[Mapping[str, str]] = {
        "inertia": "kg m^2",
        "gravity_stiffness": "N m/rad",
        "wheel_inertia": "kg m^2",
        "edge_friction": "N m s/rad",
        "wheel_friction": "N m s/rad",
    }

    inertia: ParameterEntry
    gravity_stiffness: ParameterEntry
    wheel_inertia: ParameterEntry
    edge_friction: ParameterEntry
    wheel_friction: ParameterEntry


class CubeController(ControllerSection):
    """Weights of the LQI on tilt, its rate and the wheel's; its integral is the wheel's angle. See `controller`."""

    tilt_weight: Positive
    tilt_rate_weight: NotNegative
    wheel_rate_weight: NotNegative
    integral_weight: Positive
    effort_weight: Positive


class CubeFile(VehicleFile):
    """A body on an edge, with one wheel by which it holds itself up."""

    ROLES: ClassVar[Mapping[str, Role]] = {"wheel": Role(1, 1)}
    INJECTION_POINTS: ClassVar[tuple[str, ...]] = (CONTROLLER_OUTPUT,)

    limits: CubeLimits
    parameters: CubeCad
    controller: CubeController
