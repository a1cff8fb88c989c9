"""Periodic torques, in time or over the coordinate. Two amplitudes, of sine and cosine, represent any phase."""

from __future__ import annotations

from upright.models.effect import Effect, EffectParameter, Family, Role
from upright.models.parts import Place

PERIODIC_DISTURBANCE = Effect(
    name="periodic_disturbance",
    family=Family.PERIODIC,
    title="torque that is periodic in time, e.g. from machinery on board",
    place=Place.JOINT,
    equation="F = amplitude_sin sin(2 pi frequency t) + amplitude_cos cos(2 pi frequency t)",
    parameters=(
        EffectParameter("amplitude_sin", "{force}", "amplitude of the sine", amplitude=True, scale="force_scale"),
        EffectParameter("amplitude_cos", "{force}", "amplitude of the cosine", amplitude=True, scale="force_scale"),
        EffectParameter(
            "frequency",
            "Hz",
            "frequency of the peak in the spectrum of the innovations",
            role=Role.FREQUENCY,
            value="0.4 / time_scale",
            scale="0.004 / time_scale",
            lower="0.008 / time_scale",
            upper="80 / time_scale",
            starts=tuple(f"{each} / time_scale" for each in (0.08, 0.2, 0.6, 0.8, 1.2, 2, 2.8, 4, 6, 8)),
        ),
    ),
    force="amplitude_sin * sin(2 * pi * frequency * time) + amplitude_cos * cos(2 * pi * frequency * time)",
    signature="A spectral line of the residual torque, at the same frequency for any motion of the vehicle.",
    confused_with=("position_cogging", "flexible_mode"),
    separated_by="A record without excitation: the spectral line remains. Its phase is constant throughout; that of a "
    "lightly damped mode is not.",
    source="Ljung, System Identification (1999), section 2.3",
)

POSITION_COGGING = Effect(
    name="position_cogging",
    family=Family.PERIODIC,
    title="torque that is periodic over the coordinate, e.g. from magnets, teeth or a worn rail",
    place=Place.JOINT,
    equation="F = amplitude_sin sin(2 pi coordinate / pitch) + amplitude_cos cos(2 pi coordinate / pitch)",
    parameters=(
        EffectParameter("amplitude_sin", "{force}", "amplitude of the sine", amplitude=True, scale="force_scale"),
        EffectParameter("amplitude_cos", "{force}", "amplitude of the cosine", amplitude=True, scale="force_scale"),
        EffectParameter(
            "pitch",
            "{coordinate}",
            "period over the coordinate",
            value="coordinate_scale / 4",
            scale="coordinate_scale / 200",
            lower="coordinate_scale / 1000",
            upper="coordinate_scale",
            starts=(
                "coordinate_scale / 10",
                "coordinate_scale / 7",
                "coordinate_scale / 5",
                "coordinate_scale / 3",
                "coordinate_scale / 2",
                "coordinate_scale",
            ),
        ),
    ),
    force="amplitude_sin * sin(2 * pi * coordinate / pitch) + amplitude_cos * cos(2 * pi * coordinate / pitch)",
    signature="The residual torque over the coordinate is periodic; its frequency in time increases with the speed.",
    confused_with=("periodic_disturbance",),
    separated_by="Slow motion through the same range at two speeds: the spectral line moves with the speed.",
    source="Hanselman, Brushless Permanent Magnet Motor Design (2003), cogging torque",
)
