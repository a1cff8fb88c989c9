"""Restoring forces that are not linear in the coordinate."""

from __future__ import annotations

from upright.models.effect import Effect, EffectParameter, Family
from upright.models.parts import Place

CUBIC_STIFFNESS = Effect(
    name="cubic_stiffness",
    family=Family.STIFFNESS,
    title="spring that gets stiffer (or, if negative, softer) with the deflection",
    place=Place.JOINT,
    equation="F = -coefficient coordinate^3",
    parameters=(
        EffectParameter(
            "coefficient",
            "{force}/{coordinate}^3",
            "force per unit of deflection cubed; negative if it gets softer",
            amplitude=True,
            scale="force_scale / coordinate_scale ** 3",
        ),
    ),
    force="-coefficient * coordinate ** 3",
    signature="The residual torque over the coordinate is flat in the middle and steep towards both ends.",
    confused_with=("gravity_nonlinearity", "end_stop"),
    separated_by="Slow motion at two amplitudes, the larger one near the limits.",
    source="Duffing; Nayfeh, Mook, Nonlinear Oscillations (1979), chapter 4",
)

GRAVITY_NONLINEARITY = Effect(
    name="gravity_nonlinearity",
    family=Family.STIFFNESS,
    title="gravity proportional to the sine of the angle instead of the angle",
    place=Place.JOINT,
    equation="F = stiffness (sin(coordinate) - coordinate)",
    parameters=(
        EffectParameter(
            "stiffness",
            "{force}/{coordinate}",
            "mass x g x height of the centre of gravity; negative if the mass hangs",
            amplitude=True,
            scale="force_scale / coordinate_scale",
            lower="-10 * force_scale / coordinate_scale",
            upper="10 * force_scale / coordinate_scale",
        ),
    ),
    force="stiffness * (sin(coordinate) - coordinate)",
    signature="The residual torque over the angle is flat in the middle and pulls back at large angles; at 5 degrees "
    "it is 0.1 % of gravity and cannot be detected. A residual torque larger than gravity can cause has another "
    "origin.",
    confused_with=("cubic_stiffness", "end_stop"),
    separated_by="Large angles, beyond 20 degrees, on a stand that allows them; its magnitude is known, that of "
    "gravity itself.",
    in_radians=("coordinate",),
    sets_in=False,
    source="Griese et al. (MONOCAB), linearised there",
)

END_STOP = Effect(
    name="end_stop",
    family=Family.STIFFNESS,
    title="elastic buffers on both sides",
    place=Place.JOINT,
    equation="F = -stiffness (|coordinate| - gap) sgn(coordinate) beyond the gap, 0 within it",
    parameters=(
        EffectParameter(
            "stiffness",
            "{force}/{coordinate}",
            "stiffness of the buffers",
            amplitude=True,
            scale="force_scale / coordinate_scale",
            lower="0",
        ),
        EffectParameter(
            "gap",
            "{coordinate}",
            "deflection at which they touch",
            value="coordinate_scale / 2",
            scale="coordinate_scale / 10",
            lower="coordinate_scale / 1000",
            starts=(
                "coordinate_scale / 30",
                "coordinate_scale / 10",
                "coordinate_scale / 5",
                "coordinate_scale",
                "2 * coordinate_scale",
            ),
        ),
    ),
    force="-stiffness * (max(coordinate - gap, 0) + min(coordinate + gap, 0))",
    signature="The residual torque is zero in the middle and a straight line beyond a kink on each side.",
    confused_with=("cubic_stiffness", "gravity_nonlinearity"),
    separated_by="Motion that reaches the stops now and then: a kink at the same deflection each time, and none "
    "without contact.",
    source="piecewise linear stiffness; Nayfeh, Mook, Nonlinear Oscillations (1979), chapter 4",
)
