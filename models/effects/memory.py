"""Effects that remember where the motion came from: yielding material and play. Each has one state z, -1 to 1.

    z' = (rate / travel) (1 - |z|^n (1 + sgn(rate z)) / 2)

is Bouc and Wen's equation: z follows the motion and stops at +-1. n = 2 is soft like material, n = 4 is sharper, like
play.
"""

from __future__ import annotations

from models.effect import Effect, EffectParameter, EffectState, Family, Place

HYSTERESIS = Effect(
    name="hysteresis",
    family=Family.MEMORY,
    title="torque that follows the deflection elastically, then yields, whatever the speed",
    place=Place.JOINT,
    equation="F = -torque z,  z' = (rate / yield_travel) (1 - z^2 (1 + sgn(rate z)) / 2)",
    parameters=(
        EffectParameter("torque", "{force}", "at which it yields", amplitude=True, scale="force_scale", lower="0"),
        EffectParameter(
            "yield_travel",
            "{coordinate}",
            "deflection by which it yields",
            value="coordinate_scale / 10",
            scale="coordinate_scale / 50",
            lower="coordinate_scale / 1000",
            upper="10 * coordinate_scale",
            starts=("coordinate_scale / 50", "coordinate_scale / 25", "coordinate_scale / 3", "coordinate_scale"),
        ),
    ),
    states=(
        EffectState(
            "z", "1", "(rate - 0.5 * z * (rate * z + abs(rate) * abs(z))) / yield_travel", "share of the yield torque"
        ),
    ),
    force="-torque * z",
    signature="The missing torque over the coordinate is a loop whose shape does not depend on the speed.",
    confused_with=(
        "coulomb_friction",
        "stribeck_friction",
        "asymmetric_friction",
        "backlash",
    ),
    separated_by="The same slow triangle wave at two amplitudes, one smaller than the yield travel: small loops close "
    "to a line, as of a spring, where those of dry friction stay rectangles.",
    dissipative=True,
    source="Bouc (1967); Wen, J. Eng. Mech. 102 (1976) 249, with n = 2, beta = gamma = 1/2",
)

BACKLASH = Effect(
    name="backlash",
    family=Family.MEMORY,
    title="play between a motor and what it moves",
    place=Place.JOINT,
    equation="F = -gain z' width / 2,  z' = (actuator_rate / (width/2 + softness)) (1 - z^4 (1 + sgn(actuator_rate "
    "z)) / 2)",
    parameters=(
        EffectParameter(
            "width",
            "{angle}",
            "whole play, as a motion of what is moved",
            amplitude=True,
            scale="angle_scale / 50",
            lower="0",
            upper="angle_scale",
        ),
        EffectParameter(
            "softness",
            "{angle}",
            "further travel over which the play closes; 0 would be a hard contact",
            value="angle_scale / 200",
            scale="angle_scale / 200",
            lower="angle_scale / 1000",
            upper="angle_scale",
            starts=("angle_scale / 30",),
        ),
    ),
    states=(
        EffectState(
            "z",
            "1",
            "(actuator_rate - 0.5 * z ** 3 * (actuator_rate * z + abs(actuator_rate) * abs(z)))"
            " / (0.5 * width + softness)",
            "place within the play",
        ),
    ),
    force=(
        "-0.5 * width * gain * (actuator_rate - 0.5 * z ** 3 * (actuator_rate * z + abs(actuator_rate) * abs(z)))"
        " / (0.5 * width + softness)"
    ),
    signature="After each reversal of the actuator nothing happens for a fixed travel; then it acts as modelled.",
    confused_with=("hysteresis", "input_deadband", "input_delay", "actuator_lag"),
    separated_by="The same triangle wave at two speeds: the time lost after a reversal is a fixed travel with "
    "backlash, a fixed time with a delay.",
    source="Nordin, Gutman, Automatica 38 (2002) 1633; Tao, Kokotovic, Adaptive Control of Systems with Actuator and "
    "Sensor Nonlinearities (1996)",
)
