"""The MONOCAB as grey-box models: roll alone, reduced, full. Signs and channels as in telemetry.channels, SI units.

    inertia roll'' = gravity_stiffness roll + angular_momentum precession' + trim_mass (g y - trim_height y'') + effects

MONOCAB_ROLL has the measured motion of gimbals and trim mass as its inputs: equation (3), for identification, since
neither the speed loops nor their coupling to roll matter then. MONOCAB_REDUCED is equation (2): the precession rate
follows its setpoint with `speed_loop_lag`. MONOCAB_FULL is (1), with the trim mass and the precession angle.

The roll filter's error is not white: it is the gyro's integrated noise and a slow correction. So each model has it as a
state, `roll_error`, which does not affect the motion, and the remaining bias of the gyro as `rate_error`. The two decay
together, as in a filter with a proportional and an integral gain, whose values here are those in motion, when the
filter trusts the accelerometer less than at rest. Without these states, an error that remains from the rise would be
treated as white, and estimates would scatter by a fifth more than their stated deviation. From sample to sample the
recorded roll equals the integrated roll rate to 1e-6 rad, which is a property of the filter and not of the vehicle:
1e-5 rad are stated as its noise, so that no fit relies on it.
"""

from __future__ import annotations

import math

from upright.models.gravity import GRAVITY
from upright.models.model import Model
from upright.models.parts import Actuator, Filter, Hold, Input, Joint, Output, Parameter, Sensor, State
from upright.vehicles.monocab.gimbals import SPEED_LOOPS

SUPPORT = math.radians(4.0)

_PARAMETERS = (
    Parameter("inertia", "kg m^2", 1450.0, std=200.0, lower=0.0, meaning="about the rail head"),
    Parameter(
        "gravity_stiffness", "N m/rad", 12600.0, std=1800.0, lower=0.0, meaning="mass x g x height of the centre"
    ),
    Parameter(
        "angular_momentum", "N m s", 3300.0, std=15.0, lower=0.0, estimated=False, meaning="of both flywheels together"
    ),
    Parameter("trim_mass", "kg", 500.0, std=5.0, lower=0.0, estimated=False),
    Parameter("trim_height", "m", 0.4, std=0.05, estimated=False, meaning="of the trim mass over the rail head"),
)
_LAG = Parameter("speed_loop_lag", "s", 0.04, std=0.01, lower=1e-3, upper=1.0, meaning="of the closed speed loops")
_FILTER = (
    Parameter(
        "filter_proportional_gain",
        "1/s",
        0.5,
        lower=0.0,
        upper=100.0,
        estimated=False,
        meaning="with which the roll filter's roll follows the accelerometer",
    ),
    Parameter(
        "filter_integral_gain",
        "1/s^2",
        0.1,
        lower=0.0,
        upper=100.0,
        estimated=False,
        meaning="with which the roll filter's gyro bias follows the accelerometer",
    ),
)


def _offset(name: str, meaning: str) -> Parameter:
    return Parameter(name, "s", 0.0, std=0.002, lower=-0.05, upper=0.05, meaning=meaning)


_ROLL = State(
    "roll",
    "rad",
    "roll_rate",
    initial="roll",
    initial_std=1e-3,
    meaning="0 upright, positive right side down",
)
_ROLL_RATE = State(
    "roll_rate", "rad/s", "roll_force / inertia", initial="roll_rate", initial_std=2e-3, process_noise=1e-4
)
_ROLL_ERROR = State(
    "roll_error",
    "rad",
    "rate_error - filter_proportional_gain * roll_error",
    initial_std=1e-3,
    process_noise=1e-4,
    noise_of="roll_rate",
    meaning="error of the roll filter: the gyro's noise integrated, and slow corrections",
)
_RATE_ERROR = State(
    "rate_error",
    "rad/s",
    "-filter_integral_gain * roll_error",
    initial_std=2e-4,
    process_noise=1.3e-5,
    noise_known=True,
    meaning="remaining error of the roll filter's estimate of the gyro bias",
)
_OUTPUTS = (
    Output("roll", "rad", "roll + roll_error", noise=1e-5, noise_known=True),
    Output("roll_rate", "rad/s", "roll_rate + rate_error", noise=4e-4),
)
_IMU = Sensor(
    "imu",
    angle="roll",
    rate="roll_rate",
    angle_scale=0.02,
    rate_scale=0.05,
    # The filter's own gains: the integral one is the bias' variance over the angle's, which is always (1.98e-3 rad)^2.
    filter=Filter(proportional=2.36, integral="2.55e5 * gyro_bias_std ** 2", smoothing=1.0, lever=0.9 / GRAVITY),
)


_BIAS_STD = Input(
    "gyro_bias_std",
    "rad/s",
    usual=6.9e-4,
    meaning="of the gyro's bias, as estimated by the roll filter: how fast it still learns",
)


def _joint(trim_position: str, trim_acceleration: str) -> Joint:
    return Joint(
        name="roll",
        coordinate="roll",
        rate="roll_rate",
        inertia="inertia",
        load=(
            "gravity_stiffness * roll + angular_momentum * precession_rate"
            f" + trim_mass * ({GRAVITY} * {trim_position} - trim_height * {trim_acceleration})"
        ),
        force_unit="N m",
        coordinate_unit="rad",
        force_scale=100.0,
        coordinate_scale=0.02,
        rate_scale=0.05,
        smooth_rate=1e-3,
    )


def _gimbals(command: str) -> Actuator:
    return Actuator(
        name="gimbals",
        command=command,
        joint="roll",
        rate="precession_rate",
        angle="precession",
        gain="angular_momentum",
        command_scale=0.1,
        angle_scale=0.3,
    )


MONOCAB_ROLL = Model(
    name="monocab_roll",
    title="MONOCAB, roll alone: the measured motion of gimbals and trim mass is its input",
    source="Griese et al., equation (3)",
    base_states=(_ROLL, _ROLL_RATE, _ROLL_ERROR, _RATE_ERROR),
    inputs=(
        Input("precession_rate", "rad/s", age="drive_age", delays=("drive_offset",)),
        Input("precession", "rad", age="drive_age", delays=("drive_offset",)),
        Input("trim_position", "m", age="drive_age", delays=("drive_offset",)),
        Input("trim_rate", "m/s", age="drive_age", delays=("drive_offset",)),
        _BIAS_STD,
    ),
    outputs=_OUTPUTS,
    base_parameters=(
        *_PARAMETERS,
        _offset("drive_offset", "how much later than their time stamps the drives' values were valid"),
        *_FILTER,
    ),
    joints=(_joint("trim_position", "trim_rate_slope"),),
    actuators=(_gimbals("precession_rate"),),
    sensors=(_IMU,),
)

MONOCAB_REDUCED = Model(
    name="monocab_reduced",
    title="MONOCAB, reduced: the gimbals follow their rate setpoint with a lag, the trim mass is measured",
    source="Griese et al., equation (2)",
    base_states=(
        _ROLL,
        _ROLL_RATE,
        State(
            "precession_rate",
            "rad/s",
            "(precession_rate_setpoint - precession_rate) / speed_loop_lag",
            initial="precession_rate",
            initial_std=1e-2,
            process_noise=1e-2,
        ),
        _ROLL_ERROR,
        _RATE_ERROR,
    ),
    inputs=(
        Input("precession_rate_setpoint", "rad/s", Hold.ZERO_ORDER, age="setpoint_age", delays=("setpoint_offset",)),
        Input("precession", "rad", age="drive_age"),
        Input("trim_position", "m", age="drive_age"),
        Input("trim_rate", "m/s", age="drive_age"),
        _BIAS_STD,
    ),
    outputs=(*_OUTPUTS, Output("precession_rate", "rad/s", "precession_rate", noise=1e-5, age="drive_age")),
    base_parameters=(
        *_PARAMETERS,
        _LAG,
        _offset("setpoint_offset", "how much later than its sample a setpoint begins to act"),
        *_FILTER,
    ),
    joints=(_joint("trim_position", "trim_rate_slope"),),
    actuators=(_gimbals("precession_rate_setpoint"),),
    sensors=(_IMU,),
)

_TRIM_ACCELERATION = "(trim_rate_setpoint - trim_rate) / speed_loop_lag"

MONOCAB_FULL = Model(
    name="monocab_full",
    title="MONOCAB, full: gimbals and trim mass follow their rate setpoints",
    source="Griese et al., equation (1); its z_M is minus trim_height",
    base_states=(
        _ROLL,
        _ROLL_RATE,
        State("trim_position", "m", "trim_rate", initial="trim_position", initial_std=1e-3),
        State("trim_rate", "m/s", _TRIM_ACCELERATION, initial="trim_rate", initial_std=1e-2, process_noise=1e-2),
        State("precession", "rad", "precession_rate", initial="precession", initial_std=1e-3),
        State(
            "precession_rate",
            "rad/s",
            "(precession_rate_setpoint - precession_rate) / speed_loop_lag",
            initial="precession_rate",
            initial_std=1e-2,
            process_noise=1e-2,
        ),
        _ROLL_ERROR,
        _RATE_ERROR,
    ),
    inputs=(
        Input("trim_rate_setpoint", "m/s", Hold.ZERO_ORDER, age="setpoint_age", delays=("setpoint_offset",)),
        Input("precession_rate_setpoint", "rad/s", Hold.ZERO_ORDER, age="setpoint_age", delays=("setpoint_offset",)),
        _BIAS_STD,
    ),
    outputs=(
        *_OUTPUTS,
        Output("precession", "rad", "precession", noise=1e-5, age="drive_age"),
        Output("precession_rate", "rad/s", "precession_rate", noise=1e-5, age="drive_age"),
        Output("trim_position", "m", "trim_position", noise=1e-5, age="drive_age"),
        Output("trim_rate", "m/s", "trim_rate", noise=1e-5, age="drive_age"),
    ),
    base_parameters=(
        *_PARAMETERS,
        _LAG,
        _offset("setpoint_offset", "how much later than its sample a setpoint begins to act"),
        *_FILTER,
    ),
    joints=(_joint("trim_position", _TRIM_ACCELERATION),),
    actuators=(_gimbals("precession_rate_setpoint"),),
    sensors=(_IMU,),
)

MODELS = (MONOCAB_ROLL, MONOCAB_REDUCED, MONOCAB_FULL, *SPEED_LOOPS)
