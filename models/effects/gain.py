"""A command that acts weaker or stronger than it should: near zero, in one direction, or all over."""

from __future__ import annotations

from models.effect import Effect, EffectParameter, Family
from models.parts import Place

INPUT_DEADBAND = Effect(
    name="input_deadband",
    family=Family.GAIN,
    title="small commands that do nothing",
    place=Place.ACTUATOR,
    equation="u_acting = sgn(u) max(|u| - width, 0)",
    parameters=(
        EffectParameter(
            "width",
            "{command}",
            "largest command that does nothing",
            amplitude=True,
            scale="command_scale / 20",
            lower="0",
            upper="3 * command_scale",
            starts=("command_scale / 100", "command_scale / 20", "command_scale / 5"),
        ),
    ),
    command="max(command - width, 0) + min(command + width, 0)",
    signature="The missing torque has a fixed size against the sign of the command; a balanced vehicle hunts slowly.",
    confused_with=(
        "backlash",
        "input_gain",
    ),
    separated_by="The same excitation at two amplitudes: a dead band costs a fixed size, a gain error a fixed share.",
    source="Tao, Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities (1996)",
)

INPUT_ASYMMETRY = Effect(
    name="input_asymmetry",
    family=Family.GAIN,
    title="command that acts stronger in one direction than in the other",
    place=Place.ACTUATOR,
    equation="u_acting = u + asymmetry |u|",
    parameters=(
        EffectParameter(
            "asymmetry",
            "1",
            "how much stronger positive, and weaker negative commands act",
            amplitude=True,
            scale="0.1",
            lower="-0.9",
            upper="0.9",
        ),
    ),
    command="command + asymmetry * abs(command)",
    signature="The missing torque follows the command's size, not its sign: excitation drives the actuator away to "
    "one side.",
    confused_with=("input_gain",),
    separated_by="Excitation of both signs that is strong enough: a gain error is alike on both sides.",
    source="piecewise linear actuator; Tao, Kokotovic (1996)",
)

INPUT_GAIN = Effect(
    name="input_gain",
    family=Family.GAIN,
    title="command whose gain is off",
    place=Place.ACTUATOR,
    equation="u_acting = (1 + gain) u",
    parameters=(
        EffectParameter(
            "gain", "1", "relative error of the gain", amplitude=True, scale="0.1", lower="-0.9", upper="5"
        ),
    ),
    command="command * (1 + gain)",
    signature="The missing torque is a copy of the command, at every amplitude and frequency.",
    confused_with=("input_deadband", "input_asymmetry", "gimbal_angle_coupling", "sensor_scale"),
    separated_by="A measured motion of the actuator, or one known force: without an anchor, inertia and stiffness "
    "absorb it.",
    source="Ljung, System Identification (1999), section 4.6: identifiability",
)
