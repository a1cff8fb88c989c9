"""The two-wheeled balancing robot as a grey-box model. Channels and signs as in telemetry.channels, SI units.

    M rates' = motors - friction + gravity,  derived from the energies in tests/support/twsbr_derivation.py

A wheel's angle is relative to the body, as its encoder counts it; relative to the floor the wheel rolls by this angle
plus the tilt, which is the paper's theta. With the mean rolling angle (`travel`) and the wheels' difference (`turn`) as
coordinates the mass matrix decouples into a 2 x 2 block and a scalar, and its inverse can be written down. The armature
current is taken as settled, since its time constant L/R is about 5 microseconds; so L does not appear in the equations.

Effects act at three joints: `tilt` (the body alone: a centre of mass off the vertical through the axle is its
`static_torque`), `travel` (between the wheels and the floor: a slope of angle a is a `static_torque` of
-(body_mass + 2 wheel_mass) g wheel_radius sin(a)) and `wheels` (between the wheels and the body: friction of the
gears). A torque is that of both wheels together, and `motors` has the commands of both: one controller gives both the
same voltage, and an effect in only one of them makes the robot turn, which no effect of the model explains.
A joint's inertia is the effective one for a torque there while everything else is free to move.
"""

from __future__ import annotations

import math

from upright.models.gravity import GRAVITY
from upright.models.model import Model
from upright.models.parts import Actuator, Disturbance, Hold, Input, Joint, Output, Parameter, Sensor, State

COUNT = 2.0 * math.pi / 700.0
"""rad of a wheel per encoder count."""
PERIOD = 5e-3
"""s from sample to sample."""


def _number(name: str, unit: str, value: float, bounds: tuple[float, float], meaning: str, *, known: bool) -> Parameter:
    """A parameter of the paper: value of Table 1, bounds of Table 2. The paper states no accuracy of a value, so the
    bounds are interpreted as two standard deviations to either side of the middle."""
    lower, upper = bounds
    return Parameter(name, unit, value, (upper - lower) / 4.0, lower, upper, estimated=not known, meaning=meaning)


_PARAMETERS = (
    _number("wheel_radius", "m", 0.0325, (0.03, 0.04), "r", known=True),
    _number("wheel_mass", "kg", 0.053, (0.04, 0.06), "m_w, of one; a solid disc", known=True),
    _number("com_height", "m", 0.045, (0.0, 0.2), "l, of the body's centre of mass over the axle", known=False),
    _number("body_mass", "kg", 0.8, (0.3, 1.5), "m_b, without the wheels", known=True),
    _number("wheel_distance", "m", 0.165, (0.15, 0.17), "d, from wheel to wheel", known=True),
    _number("yaw_inertia", "kg m^2", 5.518e-3, (5e-5, 0.02), "J_J, of the body about its upright axis", known=True),
    _number("tilt_inertia", "kg m^2", 1.35e-3, (1e-5, 0.1), "J_K, of the body about its centre of mass", known=False),
    Parameter(
        "gear_ratio", "1", 43.8, lower=1.0, estimated=False, meaning="n, turns of the rotor per turn of the wheel"
    ),
    _number("rotor_inertia", "kg m^2", 2.74e-6, (2e-7, 3e-3), "J_r, of one motor before its gear", known=False),
    _number("armature_resistance", "ohm", 4.019, (1.0, 20.0), "R", known=False),
    _number("armature_inductance", "H", 2.22e-5, (2e-7, 2e-3), "L, in no equation: the current is settled", known=True),
    _number("motor_constant", "N m/A", 5.443e-3, (5e-5, 0.5), "K_T = K_E, torque and back-EMF", known=False),
    _number("motor_friction", "N m s/rad", 7.27e-6, (7e-7, 7e-3), "b, viscous, between wheel and body", known=True),
    _number("wheel_friction", "N m s/rad", 5.4e-4, (5e-6, 0.05), "f_v, viscous, between wheel and floor", known=False),
    Parameter(
        "voltage_offset",
        "s",
        0.0,
        std=0.001,
        # Three deviations: an answer comes within its sample; a later one is not a property of the bus but a delay.
        lower=-0.003,
        upper=0.003,
        meaning="how much later than its sample a voltage begins to act",
    ),
)

# The tilt filter's own (estimators.roll_filter): densities of gyro and accelerometer as the vehicle file states them.
_GYRO, _ACCELEROMETER = 0.001**2, 0.2**2 / (200.0 * GRAVITY**2)
_LEVEL_NOISE = 2e-4
"""rad/sqrt(s), of the accelerometer's direction: data sheets state 400 ug/sqrt(Hz) (MPU-6050) and 0.015 m/s^2 per
sample, 1.1e-4 (IG1). Without it the mean of the tilt counts as known better than it is, and its error as a torque."""
_SMOOTHING = 1.0
"""s, of the filter's low pass of the accelerometer."""

_DEFINITIONS = {
    "reflected_inertia": "gear_ratio ** 2 * rotor_inertia",
    "back_emf": "motor_constant * gear_ratio",
    "motor_gain": "back_emf / armature_resistance",
    "heading_gain": "wheel_radius / wheel_distance",
    "lean": "body_mass * com_height * sin(tilt)",
    "travel_rate": "0.5 * (left_wheel_rate + right_wheel_rate) + tilt_rate",
    # The tilt filter's gains, from its variance of the tilt: that of the bias follows from the Riccati equation, in
    # which the variance P of the tilt obeys P' = gyro + 2 integral accelerometer - P^2 / accelerometer.
    "filter_proportional": f"tilt_std ** 2 / {_ACCELEROMETER}",
    "filter_integral": f"max(0, 0.5 * (filter_proportional ** 2 - {_GYRO / _ACCELEROMETER})"
    f" + tilt_std * tilt_std_slope / {_ACCELEROMETER})",
    # The accelerometer shows forward acceleration as a backward lean: low-passed, as the change of speed.
    "level": f"level_error - wheel_radius / {GRAVITY * _SMOOTHING} * travel_rate",
    "turn_rate": "right_wheel_rate - left_wheel_rate",
    # Inertias against the mean rolling angle, the tilt, both together, and the wheels' difference.
    "travel_mass": "(3 * wheel_mass + body_mass) * wheel_radius ** 2 + 2 * reflected_inertia",
    "tilt_mass": "body_mass * com_height ** 2 + tilt_inertia + 2 * reflected_inertia",
    "shared_mass": "body_mass * com_height * wheel_radius * cos(tilt) - 2 * reflected_inertia",
    "turn_mass": "1.5 * wheel_mass * wheel_radius ** 2 + reflected_inertia"
    " + 2 * heading_gain ** 2 * (yaw_inertia + lean * com_height * sin(tilt))",
    "determinant": "travel_mass * tilt_mass - shared_mass ** 2",
    # Torques of the motors minus the gears' friction, then the total torques.
    "left_torque": "motor_gain * (left_voltage - back_emf * left_wheel_rate) - motor_friction * left_wheel_rate",
    "right_torque": "motor_gain * (right_voltage - back_emf * right_wheel_rate) - motor_friction * right_wheel_rate",
    "travel_torque": "left_torque + right_torque - 2 * wheel_friction * travel_rate"
    " + lean * wheel_radius * (tilt_rate ** 2 + (heading_gain * turn_rate) ** 2)",
    "tilt_torque": f"lean * ({GRAVITY} + com_height * cos(tilt) * (heading_gain * turn_rate) ** 2)"
    " - left_torque - right_torque",
    "turn_torque": "right_torque - left_torque - wheel_friction * turn_rate - 2 * lean * heading_gain ** 2 * turn_rate"
    " * (2 * com_height * cos(tilt) * tilt_rate + wheel_radius * travel_rate)",
    "travel_acceleration": "(tilt_mass * travel_torque - shared_mass * tilt_torque) / determinant",
    "tilt_acceleration": "(travel_mass * tilt_torque - shared_mass * travel_torque) / determinant",
    # Acceleration of the wheels' mean angle relative to the body by a torque of 1 N m between both and the body.
    "wheels_mobility": "(travel_mass + tilt_mass + 2 * shared_mass) / determinant",
    "tilt_load": "tilt_acceleration * determinant / travel_mass",
    "wheels_load": "(travel_acceleration - tilt_acceleration) / wheels_mobility",
    "travel_load": "travel_acceleration * determinant / tilt_mass",
}
_MEAN_RATE = "0.5 * (left_wheel_rate + right_wheel_rate)"

# Contribution of effects.
_ON_TILT = "(tilt_force - tilt_load - wheels_force + wheels_load)"
_ON_TRAVEL = "(travel_force - travel_load + wheels_force - wheels_load)"
_TILT = f"tilt_acceleration + (travel_mass * {_ON_TILT} - shared_mass * {_ON_TRAVEL}) / determinant"


def _wheel(sign: str) -> str:
    """A wheel's acceleration relative to the body."""
    return (
        f"travel_acceleration - tilt_acceleration {sign} 0.5 * turn_torque / turn_mass"
        f" + ((tilt_mass + shared_mass) * {_ON_TRAVEL} - (travel_mass + shared_mass) * {_ON_TILT}) / determinant"
    )


def _joint(name: str, coordinate: str, rate: str, inertia: str, load: str) -> Joint:
    """A joint that moves with the wheels."""
    return Joint(
        name=name,
        coordinate=coordinate,
        rate=rate,
        inertia=inertia,
        load=load,
        force_unit="N m",
        coordinate_unit="rad",
        force_scale=0.05,
        coordinate_scale=3.0,
        rate_scale=7.5,
        # Wheels reverse at 10 rad/s^2 and more, and a gear that sticks must not creep: passing through 0.1 rad/s would
        # take 10 ms, in which the gyro sees the whole effect of dry friction.
        smooth_rate=0.01,
        disturbance=None,
    )


_MOTORS = Actuator(
    name="motors",
    command="left_voltage",
    also=("right_voltage",),
    joint="wheels",
    # How far the rotors are below their no-load speed: times the gain, this is the torque of both motors.
    rate=f"0.5 * (left_voltage + right_voltage) / (motor_constant * gear_ratio) - {_MEAN_RATE}",
    gain="2 * (motor_constant * gear_ratio) ** 2 / armature_resistance",
    inertia="2 * gear_ratio ** 2 * rotor_inertia",
    rate_unit="V",
    command_scale=5.0,
    angle_scale=1.0,
)


def _encoder(side: str) -> Sensor:
    return Sensor(
        f"{side}_encoder",
        angle=f"{side}_wheel_angle",
        rate=f"{side}_wheel_rate",
        actuator="motors",
        angle_scale=3.0,
        rate_scale=10.0,
    )


def _wheel_states(side: str, sign: str) -> tuple[State, State]:
    angle, rate = f"{side}_wheel_angle", f"{side}_wheel_rate"
    return (
        State(angle, "rad", rate, initial=angle, initial_std=COUNT, meaning="relative to the body, positive forward"),
        State(rate, "rad/s", _wheel(sign), initial=rate, initial_std=1.0, process_noise=0.1),
    )


TWSBR = Model(
    name="twsbr",
    title="two-wheeled balancing robot: body, two wheels, two geared DC motors",
    source="Hassan, Moustafa, Moness, equations (1) to (22); corrections in tests/support/twsbr_derivation.py",
    settling=3.0,
    base_states=(
        State(
            "tilt", "rad", "tilt_rate", initial="tilt", initial_std=5e-3, meaning="of the body, 0 upright, forward +"
        ),
        State("tilt_rate", "rad/s", _TILT, initial="tilt_rate", initial_std=2e-2, process_noise=1e-2),
        *_wheel_states("left", "-"),
        *_wheel_states("right", "+"),
        State(
            "tilt_error",
            "rad",
            "rate_error - filter_proportional * (tilt_error - level)",
            initial_std=5e-3,
            process_noise=1e-4,
            noise_known=True,
            noise_of="tilt_rate",
            error_of="tilt",
            meaning="error of the tilt filter: the gyro's noise integrated, and slow corrections",
        ),
        State(
            "level_error",
            "rad",
            f"-level / {_SMOOTHING}",
            initial=f"{0.0325 / (GRAVITY * _SMOOTHING)} * (0.5 * (left_wheel_rate + right_wheel_rate) + tilt_rate)",
            initial_std=2e-2,
            process_noise=_LEVEL_NOISE,
            noise_known=True,
            error_of="tilt",
            meaning="error of the accelerometer's direction, and the speed that caused it",
        ),
        State(
            "rate_error",
            "rad/s",
            "-filter_integral * (tilt_error - level)",
            initial_std=2e-4,
            process_noise=1.3e-5,
            noise_known=True,
            error_of="tilt",
            meaning="remaining error of the tilt filter's estimate of the gyro bias",
        ),
    ),
    inputs=(
        *(
            Input(f"{side}_voltage", "V", Hold.ZERO_ORDER, age="setpoint_age", delays=("voltage_offset",))
            for side in ("left", "right")
        ),
        Input("tilt_std", "rad", usual=1.3e-3, meaning="of the tilt, as estimated by the tilt filter"),
    ),
    outputs=(
        # The tilt filter integrates the gyro by trapezoids: they add a twelfth of the square of a sampling period times
        # the acceleration to the tilt, which is more than the filter's noise when the voltage jumps.
        Output(
            "tilt", "rad", f"tilt + tilt_error + {PERIOD**2 / 12.0} * tilt_acceleration", noise=1e-5, noise_known=True
        ),
        Output("tilt_rate", "rad/s", "tilt_rate + rate_error", noise=1e-3),
        *(
            output
            for side in ("left", "right")
            for output in (
                Output(
                    f"{side}_wheel_angle",
                    "rad",
                    f"{side}_wheel_angle",
                    noise=COUNT / 12**0.5,
                    counted=True,
                    age="drive_age",
                ),
                # From the encoder's last two edges: it lags by as much as they are apart, which is not white noise,
                # and contains no information beyond the angle's.
                Output(
                    f"{side}_wheel_rate",
                    "rad/s",
                    f"{side}_wheel_rate",
                    noise=0.5,
                    noise_known=True,
                    counted=True,
                    age="drive_age",
                ),
            )
        ),
    ),
    base_parameters=_PARAMETERS,
    joints=(
        Joint(
            name="tilt",
            coordinate="tilt",
            rate="tilt_rate",
            inertia="determinant / travel_mass",
            load="tilt_load",
            force_unit="N m",
            coordinate_unit="rad",
            force_scale=0.05,
            coordinate_scale=0.1,
            rate_scale=1.0,
            smooth_rate=0.02,
            # A draught in a room, as the start of the estimation (docs/explanation/disturbance.md).
            disturbance=Disturbance(std=5e-4, correlation_time=0.3),
        ),
        _joint(
            "travel",
            "0.5 * (left_wheel_angle + right_wheel_angle) + tilt",
            "travel_rate",
            "determinant / tilt_mass",
            "travel_load",
        ),
        _joint(
            "wheels",
            "0.5 * (left_wheel_angle + right_wheel_angle)",
            _MEAN_RATE,
            "1 / wheels_mobility",
            "wheels_load",
        ),
    ),
    actuators=(_MOTORS,),
    sensors=(
        Sensor("imu", angle="tilt", rate="tilt_rate", angle_scale=0.1, rate_scale=1.0),
        _encoder("left"),
        _encoder("right"),
    ),
    definitions=_DEFINITIONS,
)

MODELS = (TWSBR,)

_GAIN = "(motor_constant * gear_ratio / armature_resistance)"

IDENTIFIABLE_NEAR_UPRIGHT = {
    "moment of the body": f"body_mass * com_height / {_GAIN}",
    "inertia of travel": "((3 * wheel_mass + body_mass) * wheel_radius ** 2 + 2 * gear_ratio ** 2 * rotor_inertia)"
    f" / {_GAIN}",
    "inertia of tilt": f"(body_mass * com_height ** 2 + tilt_inertia + 2 * gear_ratio ** 2 * rotor_inertia) / {_GAIN}",
    "inertia that both share": "(body_mass * com_height * wheel_radius - 2 * gear_ratio ** 2 * rotor_inertia)"
    f" / {_GAIN}",
    "friction of the wheels": f"wheel_friction / {_GAIN}",
    "damping by the motors": f"motor_friction / {_GAIN} + motor_constant * gear_ratio",
}
"""What is identifiable if both motors get the same voltage and the body stays near upright: these combinations, all per
unit of motor gain (N m/V), and no others. So six of the paper's 14 numbers are estimated here, and those that
its Table 2 states most accurately are fixed. estimators.identify.structural finds both."""

IDENTIFIABLE_AT_LARGE_TILT = {"radius of the wheels": "wheel_radius"}
"""Identifiable in addition if the body leans far enough for the cosine of the tilt to have an effect."""

IDENTIFIABLE_IN_TURNS = {
    "height of the centre of mass": "com_height",
    "distance of the wheels": "wheel_distance",
    "inertia of yaw": f"yaw_inertia / {_GAIN}",
}
"""Identifiable in addition in fast turns at a large tilt."""
