"""Effects that remember where the motion came from: yielding material and play.

What yields has a state z, -1 to 1, that follows the motion and stops at +-1, by the equation of Bouc and Wen:

    z' = (rate / travel) (1 - |z|^2 (1 + sgn(rate z)) / 2)

Play lies between a motor, whose motion is measured, and what it moves. The torque that the two exchange presses them on
one flank or the other, and this is what it has to do behind the play: to accelerate the load and to carry the reaction
of the joint, which is gain x rate, since no power is lost (a gyroscope's, or that of a gear). When it changes its sign
the load is late by the play, and on either flank it is late by the elastic twist. Both are motions that the motor does
not make. The crossing itself takes milliseconds and is drawn as a lag. That the flank is the torque's sets this apart
from the play of a kinematic chain that only friction drags along: there the motor's reversal decides.
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

_QUICK = "0.002"
"""s: by so much the motor's acceleration is late, which is nothing beside the crossing of any play."""
_PUSH = f"(gain * rate + load_inertia * (actuator_rate - follower) / {_QUICK})"
# What the motor did before the first row is not known: that the follower is behind there is no acceleration.
_TWIST = f"(begun ** 2 * {_PUSH} / torque - elastic) / {_QUICK}"
_CROSSING = f"(begun ** 2 * tanh({_PUSH} / (gain * smooth_rate)) - flank) / closing_time"

BACKLASH = Effect(
    name="backlash",
    family=Family.MEMORY,
    title="play between a motor and what it moves",
    place=Place.JOINT,
    equation="F = -gain (width / 2) (z + T / torque)',  closing_time z' = sgn(T) - z,  T = gain rate + load_inertia "
    "actuator_rate'",
    parameters=(
        EffectParameter(
            "width",
            "{angle}",
            "whole play, as a motion of what is moved",
            amplitude=True,
            scale="angle_scale / 1000",
            lower="0",
            upper="angle_scale",
        ),
        EffectParameter(
            "torque",
            "{force}",
            "on what is moved that twists shaft and gear by half the play; large where they are stiff",
            value="force_scale / 3",
            scale="force_scale / 3",
            lower="force_scale / 100",
            upper="1000 * force_scale",
            starts=("10 * force_scale",),
        ),
        EffectParameter(
            "load_inertia",
            "{force} s^2/{angle}",
            "of what is moved, behind the play",
            value="force_scale / 5",
            scale="force_scale / 10",
            lower="0",
            upper="100 * force_scale",
        ),
        EffectParameter(
            "closing_time",
            "s",
            "that the load takes from flank to flank",
            value="0.008",
            scale="0.004",
            lower="0.001",
            upper="0.2",
        ),
    ),
    states=(
        EffectState(
            "follower", "{command}", f"(actuator_rate - follower) / {_QUICK}", "the motor's rate, a little late"
        ),
        EffectState("begun", "1", f"(1 - begun) / (10 * {_QUICK})", "how much of the first moments is over"),
        EffectState("elastic", "1", _TWIST, "twist of shaft and gear over half the play"),
        EffectState("flank", "1", _CROSSING, "place within the play, over half of it"),
    ),
    force=f"-0.5 * width * gain * ({_CROSSING} + {_TWIST})",
    signature="Whenever the torque on what is moved changes its sign, this falls back by a fixed angle, which its "
    "motor does not show: the rate of the joint makes a small step.",
    confused_with=(
        "hysteresis",
        "coulomb_friction",
        "stribeck_friction",
        "flexible_mode",
        "input_deadband",
        "input_delay",
        "actuator_lag",
    ),
    separated_by="The same excitation at two amplitudes: the steps keep their size, while those of a lag or of a "
    "delay grow.",
    source="Nordin, Gutman, Automatica 38 (2002) 1633, the physical model of a shaft with play: the flank is that of "
    "the torque that the shaft carries, and its elastic twist is added",
)
