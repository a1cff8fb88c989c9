"""A command that acts more weakly or strongly than it should: near zero, in one direction, or everywhere."""

from __future__ import annotations

from upright.models.effect import Effect, EffectParameter, Family
from upright.models.parts import Place

INPUT_DEADBAND = Effect(
    name="input_deadband",
    family=Family.GAIN,
    title="small commands that have no effect",
    place=Place.ACTUATOR,
    equation="u_acting = sgn(u) max(|u| - width, 0)",
    parameters=(
        EffectParameter(
            "width",
            "{command}",
            "largest command that has no effect",
            amplitude=True,
            scale="command_scale / 20",
            lower="0",
            upper="3 * command_scale",
            starts=("command_scale / 100", "command_scale / 20", "command_scale / 5"),
        ),
    ),
    command="max(command - width, 0) + min(command + width, 0)",
    signature="The residual torque has a constant magnitude and is opposite to the command; a balanced vehicle hunts "
    "slowly.",
    confused_with=(
        "backlash",
        "input_gain",
    ),
    separated_by="The same excitation at two amplitudes: a dead band takes a fixed amount from the command, a gain "
    "error a fixed share.",
    source="Tao, Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities (1996)",
)

INPUT_ASYMMETRY = Effect(
    name="input_asymmetry",
    family=Family.GAIN,
    title="command that acts more strongly in one direction than in the other",
    place=Place.ACTUATOR,
    equation="u_acting = u + asymmetry |u|",
    parameters=(
        EffectParameter(
            "asymmetry",
            "1",
            "share by which positive commands act more strongly, and negative ones more weakly",
            amplitude=True,
            scale="0.1",
            lower="-0.9",
            upper="0.9",
        ),
    ),
    command="command + asymmetry * abs(command)",
    signature="The residual torque follows the command's magnitude, not its sign: excitation makes the actuator drift "
    "to one side.",
    confused_with=("input_gain",),
    separated_by="Sufficiently strong excitation of both signs: a gain error is the same in both directions.",
    source="piecewise linear actuator; Tao, Kokotovic (1996)",
)

INPUT_GAIN = Effect(
    name="input_gain",
    family=Family.GAIN,
    title="command with a gain error",
    place=Place.ACTUATOR,
    equation="u_acting = (1 + gain) u",
    parameters=(
        EffectParameter(
            "gain", "1", "relative error of the gain", amplitude=True, scale="0.1", lower="-0.9", upper="5"
        ),
    ),
    command="command * (1 + gain)",
    signature="The residual torque is proportional to the command, at every amplitude and frequency.",
    confused_with=("input_deadband", "input_asymmetry", "gimbal_angle_coupling", "sensor_scale"),
    separated_by="A measured motion of the actuator, or one known force: without such a reference, inertia and "
    "stiffness absorb it.",
    source="Ljung, System Identification (1999), section 4.6: identifiability",
)
