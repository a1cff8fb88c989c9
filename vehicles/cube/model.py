"""The reaction-wheel cube as a grey-box model. Channels and signs as in `channels`, SI units.

    inertia tilt''                = gravity_stiffness sin(tilt) - edge_friction tilt' - motor
    wheel_inertia (tilt'' + wheel'') = motor,        motor = torque - wheel_friction wheel'

`inertia` is that of the body about the edge with the wheel's mass at its axle, I_b + m_w l^2, and `gravity_stiffness`
is (m_b l_b + m_w l) g, in the symbols of table I of the paper: its lengths and masses are not identifiable one by one.
The torque is known from its command, which fixes the scale of all parameters.

Effects act at two joints: `tilt` (the body on its edge) and `wheel` (between wheel and body). A joint's inertia is the
effective one for a torque there while everything else is free to move.
Source: Gajamohan, Merz, Thommen, D'Andrea, The Cubli: a cube that can jump up and balance, IROS 2012, section III.
"""

from __future__ import annotations

import math

from upright.models.gravity import GRAVITY
from upright.models.model import Model
from upright.models.parts import Actuator, Disturbance, Hold, Input, Joint, Output, Parameter, Sensor, State

COUNT = 2.0 * math.pi / 8192.0
"""rad of the wheel per encoder count."""
PERIOD = 4e-3
"""s from sample to sample."""

_PARAMETERS = (
    Parameter("inertia", "kg m^2", 4.81e-3, std=0.5e-3, lower=0.0, meaning="of the body about its edge, I_b + m_w l^2"),
    Parameter(
        "gravity_stiffness", "N m/rad", 0.478, std=0.012, lower=0.0, meaning="weights x heights, (m_b l_b + m_w l) g"
    ),
    Parameter("wheel_inertia", "kg m^2", 0.57e-3, std=0.05e-3, lower=0.0, meaning="about its axle, I_w"),
    Parameter("edge_friction", "N m s/rad", 1.02e-3, std=0.5e-3, lower=0.0, meaning="viscous, edge on table, C_b"),
    Parameter("wheel_friction", "N m s/rad", 0.05e-3, std=0.03e-3, lower=0.0, meaning="viscous, bearings, C_w"),
    Parameter(
        "rate_lag",
        "s",
        0.002,
        std=0.001,
        lower=2e-4,
        upper=0.02,
        estimated=False,
        meaning="of the wheel's rate as its drive reports it, a filtered difference of the counts",
    ),
    Parameter(
        "torque_offset",
        "s",
        0.0,
        std=0.001,
        # Three deviations: an answer comes within its sample; a later one is not a property of the bus but a delay.
        lower=-0.003,
        upper=0.003,
        meaning="how much later than its sample a torque begins to act",
    ),
)

# The tilt filter's own (estimators.roll_filter): densities of gyro and accelerometer as the vehicle file states them.
_GYRO, _ACCELEROMETER = 0.001**2, 0.2**2 / (250.0 * GRAVITY**2)

_DEFINITIONS = {
    "motor": "torque - wheel_friction * wheel_rate",
    "tilt_load": "gravity_stiffness * sin(tilt) - edge_friction * tilt_rate - motor",
    "wheel_mobility": "1 / wheel_inertia + 1 / inertia",
    "wheel_acceleration": "motor / wheel_inertia - tilt_load / inertia",
    "wheel_load": "wheel_acceleration / wheel_mobility",
    # The filter's gains, from its variance of the tilt; the integral one follows from the Riccati equation.
    "filter_proportional": f"tilt_std ** 2 / {_ACCELEROMETER}",
    "filter_integral": f"max(0, 0.5 * (filter_proportional ** 2 - {_GYRO / _ACCELEROMETER})"
    f" + tilt_std * tilt_std_slope / {_ACCELEROMETER})",
}
# Contribution of effects: those at the wheel have their reaction on the body.
_ON_WHEEL = "(wheel_force - wheel_load)"
_TILT = f"(tilt_force - {_ON_WHEEL}) / inertia"
_WHEEL = f"wheel_acceleration + {_ON_WHEEL} * wheel_mobility - (tilt_force - tilt_load) / inertia"

CUBE = Model(
    name="cube",
    title="cube on its edge: body and reaction wheel",
    source="Gajamohan et al., section III",
    settling=3.0,
    base_states=(
        State("tilt", "rad", "tilt_rate", initial="tilt", initial_std=5e-3, meaning="0 upright, forward +"),
        State("tilt_rate", "rad/s", _TILT, initial="tilt_rate", initial_std=2e-2, process_noise=1e-2),
        State(
            "wheel_angle",
            "rad",
            "wheel_rate",
            initial="wheel_angle",
            initial_std=COUNT,
            meaning="relative to the body, positive forward",
        ),
        State("wheel_rate", "rad/s", _WHEEL, initial="wheel_rate", initial_std=2.0, process_noise=0.1),
        State(
            "tilt_error",
            "rad",
            "rate_error - filter_proportional * tilt_error",
            initial_std=5e-3,
            process_noise=1e-4,
            noise_known=True,
            noise_of="tilt_rate",
            error_of="tilt",
            meaning="error of the tilt filter: the gyro's noise integrated, and slow corrections",
        ),
        State(
            "rate_error",
            "rad/s",
            "-filter_integral * tilt_error",
            initial_std=2e-4,
            process_noise=1.3e-5,
            noise_known=True,
            error_of="tilt",
            meaning="remaining error of the tilt filter's estimate of the gyro bias",
        ),
    ),
    inputs=(
        Input("torque", "N m", Hold.ZERO_ORDER, age="setpoint_age", delays=("torque_offset",)),
        Input("tilt_std", "rad", usual=1.3e-3, meaning="of the tilt, as estimated by the tilt filter"),
    ),
    outputs=(
        # The tilt filter integrates the gyro by trapezoids: if the torque jumps within a period, at the share s of it,
        # they add an error of s (1 - s) / 2 of its square times the jump of the acceleration.
        Output(
            "tilt",
            "rad",
            f"tilt + tilt_error + 0.5 * torque_offset * ({PERIOD} - torque_offset) * {_TILT}",
            noise=1e-5,
            noise_known=True,
        ),
        Output("tilt_rate", "rad/s", "tilt_rate + rate_error", noise=1e-3),
        # It moves by many counts per sample, so that the quantisation error is practically white.
        Output("wheel_angle", "rad", "wheel_angle", noise=COUNT / 12**0.5, noise_known=True, age="drive_age"),
        # A filtered difference of the same counts: it lags and contains no information beyond the angle's, so that
        # its noise is stated far too large.
        Output(
            "wheel_rate",
            "rad/s",
            f"wheel_rate - rate_lag * ({_WHEEL})",
            noise=1.0,
            noise_known=True,
            age="drive_age",
        ),
    ),
    base_parameters=_PARAMETERS,
    joints=(
        Joint(
            name="tilt",
            coordinate="tilt",
            rate="tilt_rate",
            inertia="inertia",
            load="tilt_load",
            force_unit="N m",
            coordinate_unit="rad",
            force_scale=0.05,
            coordinate_scale=0.05,
            rate_scale=0.5,
            smooth_rate=0.01,
            # A draught in a room, as the start of the estimation (docs/explanation/disturbance.md).
            disturbance=Disturbance(std=4e-4, correlation_time=0.3),
        ),
        Joint(
            name="wheel",
            coordinate="wheel_angle",
            rate="wheel_rate",
            inertia="1 / wheel_mobility",
            load="wheel_load",
            force_unit="N m",
            coordinate_unit="rad",
            force_scale=0.05,
            coordinate_scale=3.0,
            rate_scale=20.0,
            smooth_rate=0.1,
            disturbance=None,
        ),
    ),
    actuators=(Actuator(name="motor", command="torque", joint="wheel", rate_unit="N m", command_scale=0.05),),
    sensors=(
        Sensor("imu", angle="tilt", rate="tilt_rate", angle_scale=0.05, rate_scale=0.5),
        Sensor(
            "encoder",
            angle="wheel_angle",
            rate="wheel_rate",
            actuator="motor",
            angle_scale=3.0,
            rate_scale=20.0,
        ),
    ),
    definitions=_DEFINITIONS,
)

MODELS = (CUBE,)
