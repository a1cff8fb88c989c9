"""Drag that increases with the rate: in oil films and bearings with the rate itself, in air with its square."""

from __future__ import annotations

from upright.models.effect import Effect, EffectParameter, Family
from upright.models.parts import Place

VISCOUS_FRICTION = Effect(
    name="viscous_friction",
    family=Family.SPEED_DRAG,
    title="drag proportional to the rate",
    place=Place.JOINT,
    equation="F = -coefficient rate",
    parameters=(
        EffectParameter(
            "coefficient",
            "{force} s/{coordinate}",
            "force per unit of rate",
            amplitude=True,
            scale="force_scale / rate_scale",
            lower="0",
        ),
    ),
    force="-coefficient * rate",
    signature="The residual torque is proportional to the rate; poles are damped more than modelled.",
    confused_with=(
        "coulomb_friction",
        "stribeck_friction",
        "load_dependent_friction",
        "quadratic_drag",
        "gimbal_imbalance",
    ),
    separated_by="The same square or sine wave at two amplitudes: viscous friction doubles with the rate, dry friction "
    "is constant, quadratic drag is four times as large.",
    dissipative=True,
    source="Olsson et al., Eur. J. Control 4 (1998) 176, section 2",
)

QUADRATIC_DRAG = Effect(
    name="quadratic_drag",
    family=Family.SPEED_DRAG,
    title="drag proportional to the square of the rate, e.g. in air",
    place=Place.JOINT,
    equation="F = -coefficient rate |rate|",
    parameters=(
        EffectParameter(
            "coefficient",
            "{force} s^2/{coordinate}^2",
            "force per unit of rate squared",
            amplitude=True,
            scale="force_scale / rate_scale ** 2",
            lower="0",
        ),
    ),
    force="-coefficient * rate * abs(rate)",
    signature="The residual torque over the rate is flat near zero and steep at high rates.",
    confused_with=(
        "viscous_friction",
        "load_dependent_friction",
    ),
    separated_by="The same sine wave at two amplitudes that are far apart; one amplitude cannot separate it from "
    "viscous friction.",
    dissipative=True,
    source="aerodynamic drag; Olsson et al., Eur. J. Control 4 (1998) 176",
)
