"""Model formulas for the effects outside the catalogue, only used to find the minimum size of one that is
distinguishable from all effects of the catalogue.

The virtual vehicle has its own formulas for them (simulation.monocab.roll_effects). They are never candidates of a
diagnosis that has to find a missing effect.
"""

from __future__ import annotations

from upright.models.effect import Effect, EffectParameter, Family
from upright.models.effects.catalogue import CATALOGUE
from upright.models.parts import Place


def _torque(name: str, title: str, unit: str, scale: str, shape: str, cosine: str = "") -> Effect:
    amplitudes = [EffectParameter("coefficient", unit, "size", amplitude=True, scale=scale)]
    force = f"coefficient * {shape}"
    if cosine:
        amplitudes.append(EffectParameter("cosine", unit, "amplitude of the cosine part", amplitude=True, scale=scale))
        force += f" + cosine * {cosine}"
    return Effect(
        name=name,
        family=Family.STRUCTURE,
        title=title,
        place=Place.JOINT,
        equation=f"F = {force}",
        parameters=tuple(amplitudes),
        signature="",
        confused_with=(),
        separated_by="",
        # Below that size, the record cannot distinguish it from the most similar effect of the catalogue.
        beyond=tuple(CATALOGUE),
        force=force,
    )


UNLISTED_EFFECTS: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        _torque(
            "test_cubic_drag",
            "drag that grows with the rate cubed",
            "{force} s^3/{coordinate}^3",
            "force_scale / rate_scale ** 3",
            "(0 - rate ** 3)",
        ),
        _torque(
            "test_one_sided_damping",
            "damping that grows with the coordinate",
            "{force} s/{coordinate}^2",
            "force_scale / (coordinate_scale * rate_scale)",
            "(0 - coordinate * rate)",
        ),
        _torque(
            "test_varying_stiffness",
            "stiffness that swings with time",
            "{force}/{coordinate}",
            "force_scale / coordinate_scale",
            "coordinate * sin(2 * pi * 0.7 * time)",
            "coordinate * cos(2 * pi * 0.7 * time)",
        ),
        _torque(
            "test_patchy_damping",
            "damping that changes its sign with the coordinate",
            "{force} s/{coordinate}",
            "force_scale / rate_scale",
            "(0 - rate * sin(2 * pi * coordinate / 0.01))",
        ),
    )
}
"""By the names in `simulation.monocab.hidden.UNLISTED`."""
