"""Dry friction: a force against the motion whose magnitude does not depend on the speed, or decreases with it.

sign(rate) is approximated by tanh(rate / smooth_rate); a positive amplitude always dissipates energy.

No real contact reverses its force at once. Bristles bend by `travel` before they slide, and are damped while they bend:

    F = -level (bend + bend_time bend'),  bend' = (rate - |rate| bend) / travel

(LuGre, Canudas de Wit, Olsson, Astrom, Lischinsky, IEEE Trans. Automatic Control 40 (1995) 419, with the deflection as
a share of that at which they slide). So each effect has a finer formula, which a diagnosis uses if the record needs it.
"""

from __future__ import annotations

from dataclasses import replace

from upright.models.effect import Effect, EffectParameter, EffectState, Family
from upright.models.parts import Place

# Bristles that slide fast stay bent. A lag, negligible for the motion, avoids shorter integration steps for them.
_BENDING = "(rate - abs(rate) * bend) / (travel + 0.005 * time_scale * abs(rate))"
_BRISTLES = (
    EffectParameter(
        "travel",
        "{coordinate}",
        "deflection of the contact before it slides",
        value="coordinate_scale / 100",
        scale="coordinate_scale / 200",
        lower="coordinate_scale / 20000",
        upper="coordinate_scale",
    ),
    EffectParameter(
        "bend_time",
        "s",
        "damping of the contact over its stiffness",
        value="0.025 * time_scale",
        scale="0.025 * time_scale",
        lower="0",
        upper="time_scale",
    ),
)


def _with_bristles(effect: Effect) -> Effect:
    """`effect` with its finer formula, in which bristles replace the sign of the rate."""
    magnitude = effect.force.removesuffix("tanh(rate / smooth_rate)")
    finer = replace(
        effect,
        equation=f"{effect.equation},  with bend + bend_time bend' for sgn(rate),  travel bend' = rate - |rate| bend",
        parameters=(*effect.parameters, *_BRISTLES),
        states=(EffectState("bend", "1", _BENDING, "deflection of the contact over that at which it slides"),),
        force=f"{magnitude}(bend + bend_time * {_BENDING})",
    )
    return replace(effect, finer=finer)


_COULOMB = Effect(
    name="coulomb_friction",
    family=Family.DRY_FRICTION,
    title="dry friction of constant magnitude",
    place=Place.JOINT,
    equation="F = -torque sgn(rate)",
    parameters=(EffectParameter("torque", "{force}", "magnitude", amplitude=True, scale="force_scale", lower="0"),),
    force="-torque * tanh(rate / smooth_rate)",
    signature="The residual torque is a square wave with the sign of the rate, independent of the amplitude.",
    confused_with=(
        "viscous_friction",
        "stribeck_friction",
        "asymmetric_friction",
        "load_dependent_friction",
        "hysteresis",
        "backlash",
    ),
    separated_by="The same square or sine wave at two amplitudes: dry friction keeps its magnitude, viscous friction "
    "doubles with the rate.",
    dissipative=True,
    source="Coulomb; Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994) 1083, section 2",
)
COULOMB_FRICTION = _with_bristles(_COULOMB)

_STRIBECK = Effect(
    name="stribeck_friction",
    family=Family.DRY_FRICTION,
    title="dry friction that is largest at rest and decreases with speed",
    place=Place.JOINT,
    equation="F = -torque (sliding + (1 - sliding) exp(-(rate / stribeck_rate)^2)) sgn(rate)",
    parameters=(
        EffectParameter("torque", "{force}", "breakaway magnitude", amplitude=True, scale="force_scale", lower="0"),
        EffectParameter(
            "sliding",
            "1",
            "share of it that remains in fast motion; 1 is Coulomb friction",
            value="0.5",
            scale="0.1",
            lower="0",
            upper="1",
            starts=("0",),
        ),
        EffectParameter(
            "stribeck_rate",
            "{coordinate}/s",
            "rate at which most of the decrease has taken place",
            value="rate_scale / 5",
            scale="rate_scale / 20",
            lower="smooth_rate",
            upper="10 * rate_scale",
            starts=("rate_scale / 15", "rate_scale / 2"),
        ),
    ),
    force="-torque * (sliding + (1 - sliding) * exp(-(rate / stribeck_rate) ** 2)) * tanh(rate / smooth_rate)",
    signature="The residual torque changes sign with the rate and is largest just after a reversal: stick-slip.",
    confused_with=(
        "coulomb_friction",
        "viscous_friction",
        "asymmetric_friction",
        "load_dependent_friction",
        "hysteresis",
        "backlash",
    ),
    beyond=("coulomb_friction",),
    separated_by="Slow and fast motion in one record, e.g. a triangle wave of the angle at two frequencies: Stribeck "
    "friction decreases with the rate, Coulomb friction is constant and viscous friction increases.",
    dissipative=True,
    source="Stribeck; Armstrong-Helouvry et al., Automatica 30 (1994) 1083; Olsson et al., Eur. J. Control 4 (1998) "
    "176",
)
STRIBECK_FRICTION = _with_bristles(_STRIBECK)

_LOAD_DEPENDENT = Effect(
    name="load_dependent_friction",
    family=Family.DRY_FRICTION,
    title="dry friction that increases with the force that the actuator transmits",
    place=Place.JOINT,
    equation="F = -share |gain actuator_rate| sgn(rate)",
    parameters=(
        EffectParameter(
            "share", "1", "friction per unit of actuator force", amplitude=True, scale="0.1", lower="0", upper="1"
        ),
    ),
    force="-share * abs(gain * actuator_rate) * tanh(rate / smooth_rate)",
    signature="The residual torque changes sign with the rate and is large when the actuator force is large.",
    confused_with=(
        "coulomb_friction",
        "stribeck_friction",
        "viscous_friction",
        "quadratic_drag",
    ),
    separated_by="The same slow motion with a small and a large actuator force, e.g. with and without a known side "
    "load.",
    dissipative=True,
    source="Armstrong-Helouvry et al., Automatica 30 (1994) 1083; Hamon, Gautier, Garrec, IROS 2010",
)
LOAD_DEPENDENT_FRICTION = _with_bristles(_LOAD_DEPENDENT)

_ASYMMETRIC = Effect(
    name="asymmetric_friction",
    family=Family.DRY_FRICTION,
    title="dry friction that differs between the two directions",
    place=Place.JOINT,
    equation="F = -torque_forward for rate > 0, +torque_backward for rate < 0",
    parameters=(
        EffectParameter(
            "torque_forward", "{force}", "magnitude at a positive rate", amplitude=True, scale="force_scale", lower="0"
        ),
        EffectParameter(
            "torque_backward", "{force}", "magnitude at a negative rate", amplitude=True, scale="force_scale", lower="0"
        ),
    ),
    force=(
        "-0.5 * (torque_forward * (1 + tanh(rate / smooth_rate)) + torque_backward * (1 - tanh(rate / smooth_rate)))"
        " * tanh(rate / smooth_rate)"
    ),
    signature="The residual torque changes sign with the rate and has a nonzero mean only during motion.",
    confused_with=(
        "coulomb_friction",
        "stribeck_friction",
        "hysteresis",
        "static_torque",
    ),
    separated_by="No motion separates it from Coulomb friction with a static torque where the friction sticks: both "
    "then hold against the same loads. Another load or balance changes the torque alone, another lubricant or "
    "temperature the friction.",
    made_of=("coulomb_friction", "static_torque"),
    beyond=("coulomb_friction",),
    dissipative=True,
    source="Armstrong-Helouvry, Control of Machines with Friction (1991)",
)
ASYMMETRIC_FRICTION = _with_bristles(_ASYMMETRIC)
