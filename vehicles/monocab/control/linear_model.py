"""The MONOCAB, a cabin on one rail held up by two control moment gyroscopes: its linear model about upright.

Torque balance about the rail head (roll positive right side down, precession positive when its rate gives a positive
roll torque, trim mass positive to the right):

    inertia * roll'' = gravity_stiffness * roll + angular_momentum * precession'
                       + trim_mass * g * trim_position - trim_mass * trim_height * trim_position''

`gravity_stiffness` is positive, so upright is unstable with the pole +sqrt(gravity_stiffness / inertia). Both servo
axes follow their rate setpoint with a lag, `speed_loop_lag` (four times the sum of small time constants); that of the
trim mass may have another one, `trim_speed_loop_lag`.

Source: Griese et al., "Parameter identification related to vertical dynamic of a self-stabilizing monorail vehicle",
equations (1) to (3), with the sign of the gravity term corrected: the torque m g z of the text is negative for a centre
of gravity above the rail, and the stiffness is its magnitude. Speed loops: Kessler, Regelungstechnik 6 (1958) 395.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from math import isfinite, sqrt

import numpy as np

from upright.models.control_design.lqi import StateSpace
from upright.models.gravity import GRAVITY
from upright.telemetry.errors import UprightError


class ParameterError(UprightError):
    """A vehicle parameter is missing or physically impossible. `name` is the parameter."""

    def __init__(self, name: str, message: str) -> None:
        super().__init__(f"parameter {name}: {message}.", remedy=f"correct [parameters] {name} in the vehicle file.")
        self.name = name


@dataclass(frozen=True, slots=True)
class MonocabParameters:
    """The parameters of the linear model of a vehicle, SI units.

    `inertia` kg m^2 is the apparent one (see `apparent_inertia`); `gravity_stiffness` N m/rad; `angular_momentum` N m s
    of both flywheels together; `speed_loop_lag` s; `trim_mass` kg; `trim_height` m above the rail head;
    `trim_speed_loop_lag` s, None if it is the gimbals' `speed_loop_lag`.
    Raises ParameterError if a value is not finite or, except for `trim_height`, not positive.
    """

    inertia: float
    gravity_stiffness: float
    angular_momentum: float
    speed_loop_lag: float
    trim_mass: float
    trim_height: float
    trim_speed_loop_lag: float | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None:
                continue
            if not isfinite(value):
                raise ParameterError(field.name, f"{value} is not a number")
            if value <= 0.0 and field.name != "trim_height":
                raise ParameterError(field.name, f"{value:g} must be positive")

    @classmethod
    def from_values(cls, values: Mapping[str, float]) -> MonocabParameters:
        """From a mapping of names to values; names the model does not have are ignored. Raises ParameterError."""
        for field in fields(cls):
            if field.name not in values and field.default is MISSING:
                raise ParameterError(field.name, "missing")
        return cls(**{field.name: float(values[field.name]) for field in fields(cls) if field.name in values})

    def scaled(self, factors: Mapping[str, float]) -> MonocabParameters:
        """The same with some parameters, by name, times a factor. Raises ParameterError."""
        return replace(self, **{name: factor * float(getattr(self, name)) for name, factor in factors.items()})

    @property
    def trim_lag(self) -> float:
        """s, of the trim mass' speed loop."""
        return self.speed_loop_lag if self.trim_speed_loop_lag is None else self.trim_speed_loop_lag

    @property
    def unstable_pole(self) -> float:
        """The rate, 1/s, at which the vehicle falls over by itself."""
        return sqrt(self.gravity_stiffness / self.inertia)


def reduced_model(parameters: MonocabParameters) -> StateSpace:
    """The model the roll controller is designed on: trim mass at rest, precession angle left out. Equation (2), with
    the speed loop of the full model in place of one lag.

    The precession angle is not controllable independently of the roll angle: with roll at rest the gyroscopes can only
    give the torque that balances a static disturbance.
    """
    full = full_model(parameters)
    kept = [full.states.index(name) for name in full.states if not name.startswith("trim") and name != "precession"]
    place = full.inputs.index("precession_rate_setpoint")
    return StateSpace(
        A=full.A[np.ix_(kept, kept)],
        B=full.B[kept, place : place + 1],
        C=full.C[:1, kept],
        states=tuple(full.states[each] for each in kept),
        inputs=full.inputs[place : place + 1],
        outputs=full.outputs[:1],
        computed=tuple(name for name in full.computed if not name.startswith("trim")),
    )


def full_model(parameters: MonocabParameters) -> StateSpace:
    """The model with trim mass and precession angle. Equation (1), its z_M being minus `trim_height`.

    A bandwidth near that of the speed loops needs more of them than one lag: they are PI loops by the symmetric
    optimum, 1 / (1 + T s + T^2 s^2 / 2 + T^3 s^3 / 8) with T = `speed_loop_lag`, or `trim_speed_loop_lag` of the
    trim mass. No drive reports their accelerations.
    """
    inertia = parameters.inertia
    A, B = np.zeros((10, 10)), np.zeros((10, 2))
    A[0, 1] = 1.0
    A[1, [0, 2, 4, 7]] = (
        parameters.gravity_stiffness / inertia,
        parameters.trim_mass * GRAVITY / inertia,
        -parameters.trim_mass * parameters.trim_height / inertia,
        parameters.angular_momentum / inertia,
    )
    for number, (angle, lag) in enumerate(((2, parameters.trim_lag), (6, parameters.speed_loop_lag))):
        rate, acceleration, jerk = range(angle + 1, angle + 4)
        A[angle, rate] = A[rate, acceleration] = A[acceleration, jerk] = 1.0
        A[jerk, [rate, acceleration, jerk]] = -8.0 / lag**3, -8.0 / lag**2, -4.0 / lag
        B[jerk, number] = 8.0 / lag**3
    C = np.zeros((2, 10))
    C[0, 0] = C[1, 6] = 1.0
    axes = [(f"{axis}_{of}") for axis in ("trim", "precession") for of in ("rate", "acceleration", "jerk")]
    return StateSpace(
        A=A,
        B=B,
        C=C,
        states=("roll", "roll_rate", "trim_position", *axes[:3], "precession", *axes[3:]),
        inputs=("trim_rate_setpoint", "precession_rate_setpoint"),
        outputs=("roll", "precession"),
        computed=tuple(name for name in axes if not name.endswith("rate")),
    )


def apparent_inertia(inertia: float, angular_momentum: float, speed_loop_lag: float, gimbal_inertia: float) -> float:
    """The roll inertia, kg m^2, that appears in the torque balance when the gimbals' speed loop is not ideally stiff.

    Rolling makes the gimbals precess a little against their speed loop, which acts like additional inertia:
    inertia + 8 tau^2 L^2 / gimbal_inertia, tau being a quarter of the speed loop's lag (s) and `gimbal_inertia`
    (kg m^2) that of both gimbals together. Section II of the paper.
    """
    small_time_constant = speed_loop_lag / 4.0
    return inertia + 8.0 * small_time_constant**2 * angular_momentum**2 / gimbal_inertia
