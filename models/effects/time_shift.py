"""A command that acts later: delayed as a whole (delay) or gradually (lag). Both are exact and neutral at 0 s."""

from __future__ import annotations

from upright.models.effect import Effect, EffectParameter, Family
from upright.models.parts import Place

INPUT_DELAY = Effect(
    name="input_delay",
    family=Family.TIME_SHIFT,
    title="delayed command",
    place=Place.ACTUATOR,
    equation="u_acting(t) = u(t - delay)",
    parameters=(
        EffectParameter(
            "delay",
            "s",
            "delay of the command",
            amplitude=True,
            scale="time_scale / 80",
            lower="0",
            upper="0.75 * time_scale",
            starts=("time_scale / 80", "3 * time_scale / 80", "time_scale / 10", "time_scale / 4"),
        ),
    ),
    delay="delay",
    signature="The residual torque resembles the slope of the command: spikes where the command steps. The phase falls "
    "in proportion to the frequency, the amplitude does not change.",
    confused_with=("actuator_lag", "backlash", "sensor_delay", "sensor_lag"),
    separated_by="Fast excitation, with frequencies beyond 0.3 / delay, or single steps of the command: after a delay "
    "the response starts late at its full slope, after a lag at once and gradually.",
    source="Åström, Wittenmark, Computer-Controlled Systems (1997), section 2.4",
)

ACTUATOR_LAG = Effect(
    name="actuator_lag",
    family=Family.TIME_SHIFT,
    title="first-order lag between command and actuator",
    place=Place.ACTUATOR,
    equation="lag u_acting' = u - u_acting",
    parameters=(
        EffectParameter(
            "lag",
            "s",
            "time constant",
            amplitude=True,
            scale="time_scale / 40",
            lower="0",
            upper="2.5 * time_scale",
            starts=("time_scale / 80", "time_scale / 20", "0.15 * time_scale", "time_scale / 2"),
        ),
    ),
    lag="lag",
    signature="Phase and amplitude fall at high frequencies; steps of the command arrive rounded.",
    confused_with=("input_delay", "backlash", "sensor_delay", "sensor_lag"),
    separated_by="Fast excitation, with frequencies beyond 0.3 / lag, or single steps of the command: a lag responds "
    "at once and gradually, a delay late and at its full slope.",
    source="Leonhard, Control of Electrical Drives (2001): closed current and speed loops",
)
