"""Effects that remember where the motion came from: yielding material and play.

What yields has a state z, -1 to 1, that follows the motion and stops at +-1, by the equation of Bouc and Wen:

    z' = (rate / travel) (1 - |z|^2 (1 + sgn(rate z)) / 2)

Play lies between a motor, whose motion is measured, and what it moves. The torque that the two exchange presses them on
one flank or the other, and this is what it has to do behind the play: to accelerate the load and to carry the reaction
of the joint, which is gain x rate, since no power is lost (a gyroscope's, or that of a gear). When it changes its sign
the load is late by the play, and on either flank it is late by the elastic twist. Both are motions that the motor does
not make. The crossing itself is short and is drawn as a lag. That the flank is the torque's sets this apart
from the play of a kinematic chain that only friction drags along: there the motor's reversal decides.

Where the motor is one of the moving masses, with a rotor heavier than all that is behind its gear, play is another
sight: the rotor hardly feels it, and what is behind falls through the gap and is struck by the flank. There the place
within the play has equations of motion of its own: the relative acceleration of two masses that exchange no torque,
until a flank stops it, by Hunt and Crossley, so damped that nothing rebounds.
"""

from __future__ import annotations

from models.effect import Effect, EffectParameter, EffectState, Family
from models.parts import Place

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

_QUICK = "(0.005 * time_scale)"
"""s: by so much the motor's acceleration is late, which is nothing beside the crossing of any play."""
_PUSH = f"(gain * rate + load_inertia * (actuator_rate - follower) / {_QUICK})"
# What the motor did before the first row is not known: that the follower is behind there is no acceleration.
_TWIST = f"(begun ** 2 * {_PUSH} / torque - elastic) / {_QUICK}"
_CROSSING = f"(begun ** 2 * tanh({_PUSH} / (gain * smooth_rate)) - flank) / closing_time"

# On which flank it lies at the first row is not known: nothing is struck on the way there, and no row corrects it.
_AFTER = "2 * max(0, begun - 0.5)"
# The torque that a gear without play would pass on, over the inertias that it would then not keep together.
_FALL = f"{_AFTER} * (gain * actuator_rate * inertia / actuator_inertia - load) / (inertia - actuator_inertia)"
_GIVE = "(8e4 / time_scale ** 2)"
"""1/s^2, of a flank: a blow takes a hundredth of the natural time (4 ms of the robot), less than the rows of most
records are apart."""
_FORWARD = "max(0, place + 0.01) * max(0, 1 + 0.25 * time_scale * speed)"
_BACKWARD = "max(0, -2 - place) * max(0, 1 - 0.25 * time_scale * speed)"
# At rest it lies on a flank, so that a fit sees at once how short the steps have to be.
_ACROSS = f"({_FALL} / half_width - {_GIVE} * ({_FORWARD} - {_BACKWARD}))"

_BACKLASH_OF_A_GEAR = Effect(
    name="backlash",
    family=Family.MEMORY,
    title="play between a motor and what it moves",
    place=Place.JOINT,
    equation='F = -actuator_inertia (width / 2) z",  half_width z" = (gain actuator_rate inertia / actuator_inertia'
    " - load) / (inertia - actuator_inertia) between the flanks, -1 < z < 1;  the actuator is (width / 2) z ahead",
    parameters=(
        EffectParameter(
            "width",
            "{coordinate}",
            "whole play, by how hard the flanks strike",
            amplitude=True,
            scale="coordinate_scale / 3000",
            lower="0",
            upper="coordinate_scale / 10",
        ),
        EffectParameter(
            "half_width",
            "{coordinate}",
            "half of it, by how long it takes to cross: the same where the formula is right",
            value="coordinate_scale / 6000",
            scale="coordinate_scale / 6000",
            lower="coordinate_scale / 300000",
            upper="coordinate_scale / 20",
            # A blow that is expected a row early or late explains nothing: each is a third larger than the one before.
            starts=tuple(f"coordinate_scale * {1.35**step / 6000.0:.3g}" for step in (*range(-5, 0), *range(1, 6))),
        ),
    ),
    states=(
        EffectState("place", "1", "speed", "within the play, over half of it: 0 at one flank, -2 at the other"),
        EffectState("speed", "1/s", _ACROSS, "of the crossing"),
        EffectState("begun", "1", "(1 - begun) / (0.125 * time_scale)", "how much of the first moments is over"),
    ),
    force=f"-0.5 * width * actuator_inertia * {_AFTER} * {_ACROSS}",
    twist="0.5 * width * place",
    signature="Whenever the torque in the gear changes its sign, what is behind it falls through the gap, and a blow "
    "ends that: the rate of the body makes a step from one row to the next. The motor's encoder does not show it.",
    confused_with=(
        "hysteresis",
        "coulomb_friction",
        "stribeck_friction",
        "flexible_mode",
        "input_deadband",
        "input_delay",
        "actuator_lag",
    ),
    separated_by="The same excitation at two amplitudes: the blows come as often, while those of a lag or of a delay "
    "grow. An encoder behind the gear shows the play itself.",
    impacts=True,
    stiff=True,
    # An impact that comes a row early or late is an error of dozens of deviations: so far apart fits of one model end.
    formula_error=0.2,
    source="Nordin, Gutman, Automatica 38 (2002) 1633, two masses with play; the flanks by Hunt, Crossley, J. Appl. "
    "Mech. 42 (1975) 440",
)

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
            value="0.375 * force_scale * time_scale ** 2 / angle_scale",
            scale="0.1875 * force_scale * time_scale ** 2 / angle_scale",
            lower="0",
            upper="187.5 * force_scale * time_scale ** 2 / angle_scale",
        ),
        EffectParameter(
            "closing_time",
            "s",
            "that the load takes from flank to flank",
            value="time_scale / 50",
            scale="time_scale / 100",
            lower="time_scale / 400",
            upper="time_scale / 2",
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
    stiff=True,
    source="Nordin, Gutman, Automatica 38 (2002) 1633, the physical model of a shaft with play: the flank is that of "
    "the torque that the shaft carries, and its elastic twist is added",
    instead=_BACKLASH_OF_A_GEAR,
)
