"""The MONOCAB's gimbals alone: from the rate setpoint to the precession rate that their drives report.

Effects on the path of the command (delay, lag, dead band, gain) are visible here, and those of the vehicle are not, so
that each of the two can be judged separately. Three speed loops, all with the lag T = speed_loop_lag behind a ramp:

    MONOCAB_GIMBALS               PI by the symmetric optimum, 1 / (1 + T s + T^2 s^2 / 2 + T^3 s^3 / 8)
    MONOCAB_GIMBALS_LAG           one lag, 1 / (1 + T s)
    MONOCAB_GIMBALS_SECOND_ORDER  underdamped, 1 / (1 + T s + (T s / 2 D)^2)

A vehicle that rolls turns its gimbals: the reaction is angular momentum x roll rate over the gimbals' inertia. The roll
rate is a state that the gyro measures, not an input: the controller responds to the gyro's noise, so that noise
mistaken for motion would be attributed to the setpoint, whose gain came out 5 % too small. The roll motion is described
by roll_gain, roll_stiffness and a randomly drifting acceleration, so that it is independent of the vehicle's unknowns.
Gyro and drives are not sampled at the same instant: if the vehicle swings at 5 Hz, 1.6 ms between them are 5 % of its
rate.

Drives in a velocity mode follow their setpoint by a ramp (6048h and 604Ah of CiA 402). `ramp_share` is the share of a
ramp of 30 rad/s^2, 0 for none; a steeper ramp has a proportionally smaller share, as long as a step is completed within
its sample.
Source: Kessler, Regelungstechnik 6 (1958) 395 and 432; Leonhard, Control of Electrical Drives (2001), section 4.
"""

from __future__ import annotations

from upright.models.model import Model
from upright.models.parts import Actuator, Hold, Input, Output, Parameter, State

COMMAND = "precession_rate_setpoint"
_ACTING = f"({COMMAND} + ramp_share * setpoint_shortfall)"
_REACTION = "gimbal_reaction * roll_rate"
_ROLLS = "roll_gain * precession_rate + roll_acceleration"
_UNDER_LOAD = f"servo_acceleration - {_REACTION} - gimbal_drag * precession_rate"

_PARAMETERS = (
    Parameter(
        "speed_loop_lag", "s", 0.04, std=0.01, scale=0.04, lower=2e-3, upper=1.0, meaning="of the closed speed loops"
    ),
    Parameter(
        "gimbal_reaction",
        "1/s",
        60.0,
        std=60.0,
        meaning="angular momentum over the gimbals' inertia; 0 if it does not affect the drives",
    ),
    Parameter("roll_gain", "1/s", 2.2, std=0.4, meaning="angular momentum over the vehicle's inertia"),
    Parameter(
        "roll_stiffness",
        "1/s^2",
        0.0,
        std=10.0,
        estimated=False,
        meaning="gravity stiffness over the vehicle's inertia",
    ),
    Parameter(
        "gyro_offset",
        "s",
        0.0,
        std=0.005,
        lower=-0.02,
        upper=0.02,
        estimated=False,
        meaning="how much later than its sample, or earlier than the drives, the gyro is read",
    ),
    Parameter("ramp_share", "1", 0.0, std=1.0, lower=-1.0, upper=3.0, meaning="of a ramp of 30 rad/s^2 in the drives"),
    Parameter(
        "setpoint_offset",
        "s",
        0.0,
        std=0.002,
        lower=-0.006,
        upper=0.006,
        meaning="how much later than its sample a setpoint begins to act: no more than the cycles of bus and drive",
    ),
)
_ROLL = (
    State(
        "roll_rate",
        "rad/s",
        _ROLLS,
        initial="roll_rate",
        initial_std=2e-3,
    ),
    State(
        "roll_acceleration",
        "rad/s^2",
        "roll_stiffness * roll_rate",
        initial_std=0.3,
        process_noise=0.2,
        meaning="without the gyroscopic torque",
    ),
)


def _rate(derivative: str) -> State:
    return State(
        "precession_rate",
        "rad/s",
        derivative,
        initial="precession_rate",
        initial_std=1e-3,
        process_noise=1e-3,
    )


def _model(name: str, title: str, servo: tuple[State, ...], *more: Parameter) -> Model:
    return Model(
        name=name,
        title=f"MONOCAB, gimbals alone: {title}",
        source="the speed loops of the servo inverters",
        base_states=(*servo, *_ROLL),
        inputs=(
            Input(COMMAND, "rad/s", Hold.ZERO_ORDER, age="setpoint_age", delays=("setpoint_offset",)),
            Input(
                "setpoint_shortfall",
                "rad/s",
                Hold.ZERO_ORDER,
                age="setpoint_age",
                delays=("setpoint_offset",),
                ramp_of=COMMAND,
                ramp=30.0,
                meaning="by which the drives' ramp lags behind the setpoint",
            ),
        ),
        outputs=(
            Output("roll_rate", "rad/s", f"roll_rate - gyro_offset * ({_ROLLS})", noise=4e-4),
            Output("precession_rate", "rad/s", "precession_rate", noise=1e-4, age="drive_age"),
        ),
        base_parameters=(*_PARAMETERS, *more),
        actuators=(Actuator(name="gimbals", command=COMMAND, joint="", command_scale=0.1, lag="speed_loop_lag"),),
    )


MONOCAB_GIMBALS = _model(
    "monocab_gimbals",
    "PI speed loop by the symmetric optimum",
    (
        _rate(_UNDER_LOAD),
        State(
            "servo_acceleration",
            "rad/s^2",
            "(2 * speed_error / speed_loop_lag - servo_acceleration) * 4 / (torque_lag * speed_loop_lag)",
            initial_std=10.0,
            meaning="torque of the motors over the gimbals' inertia",
        ),
        State(
            "speed_error",
            "rad/s",
            f"({_ACTING} - precession_rate) / speed_loop_lag - ({_UNDER_LOAD})",
            initial_std=0.3,
            process_noise=0.25,
            meaning="prefiltered setpoint minus rate, and its integral over speed_loop_lag",
        ),
    ),
    Parameter("gimbal_drag", "1/s", 0.5, std=0.5, meaning="of bearings, chains and gears, over the gimbals' inertia"),
    Parameter(
        "torque_lag",
        "1",
        1.0,
        std=0.05,
        lower=0.5,
        upper=1.5,
        estimated=False,
        meaning="of current loop, filters and sampling, in quarters of speed_loop_lag; 1 by the symmetric optimum",
    ),
)

MONOCAB_GIMBALS_LAG = _model(
    "monocab_gimbals_lag",
    "one lag",
    (_rate(f"({_ACTING} - precession_rate) / speed_loop_lag - {_REACTION}"),),
)

MONOCAB_GIMBALS_SECOND_ORDER = _model(
    "monocab_gimbals_second_order",
    "underdamped of second order",
    (
        _rate(f"servo_acceleration - {_REACTION}"),
        State(
            "servo_acceleration",
            "rad/s^2",
            f"(({_ACTING} - precession_rate) / speed_loop_lag - servo_acceleration)"
            " * 4 * damping_ratio ** 2 / speed_loop_lag",
            initial_std=10.0,
            process_noise=1.0,
            meaning="of the gimbals, without the reaction",
        ),
    ),
    Parameter("damping_ratio", "1", 0.7, std=0.2, lower=0.2, upper=0.9, meaning="of the closed speed loops"),
)

SPEED_LOOPS = (MONOCAB_GIMBALS, MONOCAB_GIMBALS_LAG, MONOCAB_GIMBALS_SECOND_ORDER)
