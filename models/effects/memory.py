"""Effects with a memory of the motion: hysteresis of a yielding material, and backlash.

A yielding material has a state z, -1 to 1, that follows the motion and saturates at +-1, by the equation of Bouc and
Wen:

    z' = (rate / travel) (1 - |z|^2 (1 + sgn(rate z)) / 2)

Backlash lies between a motor, whose motion is measured, and its load. The torque that the two exchange presses them on
one flank or the other. It is the torque that is needed behind the backlash: to accelerate the load and to carry the
reaction of the joint, which is gain x rate, since no power is lost (in a gyroscope, or in a gear). When it changes its
sign, the load lags by the backlash, and on either flank it lags by the elastic twist. The motor makes neither of these
motions. The crossing itself is short and is approximated by a lag. The torque determines the flank. This distinguishes
the effect from the backlash of a kinematic chain that only friction drags along, in which the motor's reversal decides.

If the motor is one of the moving masses, with a rotor heavier than everything behind its gear, backlash looks
different: the rotor hardly responds to it, and the part behind it falls through the gap and collides with the flank.
There the position within the backlash has equations of motion of its own: the relative acceleration of two masses that
exchange no torque until a flank stops them, by Hunt and Crossley, with enough damping to prevent a rebound.
"""

from __future__ import annotations

from upright.models.effect import Effect, EffectParameter, EffectState, Family
from upright.models.parts import Place

HYSTERESIS = Effect(
    name="hysteresis",
    family=Family.MEMORY,
    title="torque that follows the deflection elastically and then yields, independent of the speed",
    place=Place.JOINT,
    equation="F = -torque z,  z' = (rate / yield_travel) (1 - z^2 (1 + sgn(rate z)) / 2)",
    parameters=(
        EffectParameter("torque", "{force}", "yield torque", amplitude=True, scale="force_scale", lower="0"),
        EffectParameter(
            "yield_travel",
            "{coordinate}",
            "deflection at which it yields",
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
    signature="The residual torque over the coordinate is a loop whose shape does not depend on the speed.",
    confused_with=(
        "coulomb_friction",
        "stribeck_friction",
        "asymmetric_friction",
        "backlash",
    ),
    separated_by="The same slow triangle wave at two amplitudes, one smaller than the yield travel: small loops shrink "
    "to a line, like those of a spring, while those of dry friction remain rectangles.",
    dissipative=True,
    source="Bouc (1967); Wen, J. Eng. Mech. 102 (1976) 249, with n = 2, beta = gamma = 1/2",
)

_QUICK = "(0.005 * time_scale)"
"""s: lag of the motor's acceleration, negligible compared with the crossing time of any backlash."""
_PUSH = f"(gain * rate + load_inertia * (actuator_rate - follower) / {_QUICK})"
# The motion before the first sample is unknown: an initial distance of the follower does not mean an acceleration.
_TWIST = f"(begun ** 2 * {_PUSH} / torque - elastic) / {_QUICK}"
_CROSSING = f"(begun ** 2 * tanh({_PUSH} / (gain * smooth_rate)) - flank) / closing_time"

# The flank at the first sample is unknown: there is no impact on the way to it, and no sample corrects it.
_AFTER = "2 * max(0, begun - 0.5)"
# The torque that a gear without backlash would transmit, over the inertias that the gap leaves apart.
_FALL = f"{_AFTER} * (gain * actuator_rate * inertia / actuator_inertia - load) / (inertia - actuator_inertia)"
_GIVE = "(8e4 / time_scale ** 2)"
"""1/s^2, of a flank: an impact takes a hundredth of the natural time (4 ms for the robot), less than the sampling
interval of most records."""
_FORWARD = "max(0, place + 0.01) * max(0, 1 + 0.25 * time_scale * speed)"
_BACKWARD = "max(0, -2 - place) * max(0, 1 - 0.25 * time_scale * speed)"
# At rest the position is on a flank, so that a fit detects at once how short the steps have to be.
_ACROSS = f"({_FALL} / half_width - {_GIVE} * ({_FORWARD} - {_BACKWARD}))"

_BACKLASH_OF_A_GEAR = Effect(
    name="backlash",
    family=Family.MEMORY,
    title="backlash between a motor and its load",
    place=Place.JOINT,
    equation='F = -actuator_inertia (width / 2) z",  half_width z" = (gain actuator_rate inertia / actuator_inertia'
    " - load) / (inertia - actuator_inertia) between the flanks, -1 < z < 1;  the actuator is (width / 2) z ahead",
    parameters=(
        EffectParameter(
            "width",
            "{coordinate}",
            "total backlash, from the strength of the impacts",
            amplitude=True,
            scale="coordinate_scale / 3000",
            lower="0",
            upper="coordinate_scale / 10",
        ),
        EffectParameter(
            "half_width",
            "{coordinate}",
            "half of it, from the crossing time: the same if the formula is right",
            value="coordinate_scale / 6000",
            scale="coordinate_scale / 6000",
            lower="coordinate_scale / 300000",
            upper="coordinate_scale / 20",
            # An impact predicted a sample early or late explains nothing: each is a third larger than the one before.
            starts=tuple(f"coordinate_scale * {1.35**step / 6000.0:.3g}" for step in (*range(-5, 0), *range(1, 6))),
        ),
    ),
    states=(
        EffectState(
            "place", "1", "speed", "position within the backlash, over half of it: 0 at one flank, -2 at the other"
        ),
        EffectState("speed", "1/s", _ACROSS, "speed of the crossing"),
        EffectState("begun", "1", "(1 - begun) / (0.125 * time_scale)", "share of the first moments that is over"),
    ),
    force=f"-0.5 * width * actuator_inertia * {_AFTER} * {_ACROSS}",
    twist="0.5 * width * place",
    signature="Whenever the torque in the gear changes its sign, the part behind the gear falls through the gap until "
    "an impact: the rate of the body makes a step from one sample to the next. The motor's encoder does not show it.",
    confused_with=(
        "hysteresis",
        "coulomb_friction",
        "stribeck_friction",
        "flexible_mode",
        "input_deadband",
        "input_delay",
        "actuator_lag",
    ),
    separated_by="The same excitation at two amplitudes: the impacts stay as frequent, while the steps of a lag or of "
    "a delay grow. An encoder behind the gear shows the backlash itself.",
    impacts=True,
    stiff=True,
    # An impact a sample early or late is an error of dozens of deviations: fits of one model end this far apart.
    formula_error=0.2,
    source="Nordin, Gutman, Automatica 38 (2002) 1633, two masses with backlash; the flanks by Hunt, Crossley, J. "
    "Appl. Mech. 42 (1975) 440",
)

BACKLASH = Effect(
    name="backlash",
    family=Family.MEMORY,
    title="backlash between a motor and its load",
    place=Place.JOINT,
    equation="F = -gain (width / 2) (z + T / torque)',  closing_time z' = sgn(T) - z,  T = gain rate + load_inertia "
    "actuator_rate'",
    parameters=(
        EffectParameter(
            "width",
            "{angle}",
            "total backlash, as a motion of the load",
            amplitude=True,
            scale="angle_scale / 1000",
            lower="0",
            upper="angle_scale",
        ),
        EffectParameter(
            "torque",
            "{force}",
            "torque on the load that twists shaft and gear by half the backlash; large if they are stiff",
            value="force_scale / 3",
            scale="force_scale / 3",
            lower="force_scale / 100",
            upper="1000 * force_scale",
            starts=("10 * force_scale",),
        ),
        EffectParameter(
            "load_inertia",
            "{force} s^2/{angle}",
            "inertia of the load, behind the backlash",
            value="0.375 * force_scale * time_scale ** 2 / angle_scale",
            scale="0.1875 * force_scale * time_scale ** 2 / angle_scale",
            lower="0",
            upper="187.5 * force_scale * time_scale ** 2 / angle_scale",
        ),
        EffectParameter(
            "closing_time",
            "s",
            "time that the load takes from flank to flank",
            value="time_scale / 50",
            scale="time_scale / 100",
            lower="time_scale / 400",
            upper="time_scale / 2",
        ),
    ),
    states=(
        EffectState(
            "follower", "{command}", f"(actuator_rate - follower) / {_QUICK}", "the motor's rate, slightly lagged"
        ),
        EffectState("begun", "1", f"(1 - begun) / (10 * {_QUICK})", "share of the first moments that is over"),
        EffectState("elastic", "1", _TWIST, "twist of shaft and gear over half the backlash"),
        EffectState("flank", "1", _CROSSING, "position within the backlash, over half of it"),
    ),
    force=f"-0.5 * width * gain * ({_CROSSING} + {_TWIST})",
    signature="Whenever the torque on the load changes its sign, the load falls back by a fixed angle that the motor "
    "does not show: the rate of the joint makes a small step.",
    confused_with=(
        "hysteresis",
        "coulomb_friction",
        "stribeck_friction",
        "flexible_mode",
        "input_deadband",
        "input_delay",
        "actuator_lag",
    ),
    separated_by="The same excitation at two amplitudes: the steps keep their height, while those of a lag or of a "
    "delay grow.",
    stiff=True,
    source="Nordin, Gutman, Automatica 38 (2002) 1633, the physical model of a shaft with backlash: the torque that "
    "the shaft carries determines the flank, and its elastic twist is added",
    instead=_BACKLASH_OF_A_GEAR,
)
