"""A body that is not rigid: part of the inertia is suspended by a spring and a damper."""

from __future__ import annotations

from upright.models.effect import Effect, EffectParameter, EffectState, Family, Role
from upright.models.parts import Place

_SPRING = "((2 * pi * frequency) ** 2 * twist + 4 * pi * frequency * damping_ratio * twist_rate)"

FLEXIBLE_MODE = Effect(
    name="flexible_mode",
    family=Family.STRUCTURE,
    title="part of the inertia on a spring, e.g. a cabin on its frame",
    place=Place.JOINT,
    equation="F = share / (1 - share) (load + inertia c),  c = (2 pi frequency)^2 twist + 4 pi frequency "
    "damping_ratio twist',  twist'' = -c - (load + F) / inertia",
    parameters=(
        EffectParameter(
            "share", "1", "share of the inertia that is sprung", amplitude=True, scale="0.1", lower="0", upper="0.95"
        ),
        EffectParameter(
            "frequency",
            "Hz",
            "natural frequency of the sprung part with the frame held",
            role=Role.FREQUENCY,
            value="2 / time_scale",
            scale="0.08 / time_scale",
            lower="0.04 / time_scale",
            upper="24 / time_scale",
            starts=tuple(f"{each} / time_scale" for each in (0.4, 0.8, 1.4, 2.8, 4, 5.6, 8)),
        ),
        EffectParameter(
            "damping_ratio",
            "1",
            "damping ratio of the sprung part with the frame held",
            value="0.03",
            scale="0.02",
            lower="1e-3",
            upper="1",
            starts=("0.15",),
        ),
    ),
    states=(
        EffectState(
            "twist",
            "{coordinate}",
            "twist_rate",
            "of the sprung part relative to the rest",
            spread="coordinate_scale / 20",
        ),
        EffectState("twist_rate", "{coordinate}/s", f"-{_SPRING} - (load + force) / inertia", spread="rate_scale / 2"),
    ),
    force=f"share / (1 - share) * (load + inertia * {_SPRING})",
    signature="The residual torque rings at one frequency after each impulse; the frequency response has a notch and a "
    "peak.",
    confused_with=("periodic_disturbance", "backlash"),
    separated_by="A chirp from 1 to 20 Hz, then no excitation: a mode responds to the excitation and decays, a "
    "periodic disturbance remains.",
    source="Craig, Kurdila, Fundamentals of Structural Dynamics (2006), base excitation",
)
