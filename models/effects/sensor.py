"""Errors of sensors. They change the readings, not the motion.

A lag has its reading as a state. The delay of a sensor that shows all outputs of the model is a delay of all inputs
that drive the model, and exact; otherwise it is a second-order expansion in time, valid for frequencies below 0.3 /
delay.
"""

from __future__ import annotations

from upright.models.effect import Effect, EffectParameter, EffectState, Family
from upright.models.parts import Place

GYRO_BIAS = Effect(
    name="gyro_bias",
    family=Family.SENSOR,
    title="constant offset of the rate reading",
    place=Place.SENSOR,
    equation="rate_shown = rate + bias",
    parameters=(EffectParameter("bias", "{rate}", "reading at rest", amplitude=True, scale="rate_scale / 10"),),
    rate_reading="rate + bias",
    signature="The innovation of the rate has a nonzero mean; the slope of the angle differs from the rate reading.",
    confused_with=(
        "sensor_offset",
        "static_torque",
        "torque_drift",
    ),
    separated_by="A few seconds at rest on a support.",
    formula_error=0.0,
    source="Titterton, Weston, Strapdown Inertial Navigation Technology (2004), chapter 4",
)

SENSOR_OFFSET = Effect(
    name="sensor_offset",
    family=Family.SENSOR,
    title="constant offset of the angle reading: a misaligned sensor",
    place=Place.SENSOR,
    equation="angle_shown = angle + offset",
    parameters=(EffectParameter("offset", "{angle}", "reading at zero", amplitude=True, scale="angle_scale / 2"),),
    angle_reading="angle + offset",
    signature="A balanced vehicle stands at a nonzero reading; its dynamics do not change.",
    confused_with=(
        "static_torque",
        "gyro_bias",
        "torque_drift",
    ),
    separated_by="Rest on both supports in turn, whose angles are known to be equal, or a spirit level.",
    sets_in=False,
    formula_error=0.0,
    source="Titterton, Weston, Strapdown Inertial Navigation Technology (2004), chapter 4",
)


def _shift(name: str, meaning: str) -> tuple[EffectParameter, ...]:
    return (
        EffectParameter(
            name,
            "s",
            meaning,
            amplitude=True,
            scale="time_scale / 80",
            lower="0",
            upper="time_scale / 4",
            starts=("time_scale / 80", "3 * time_scale / 80", "3 * time_scale / 40"),
        ),
    )


# For lags above a hundredth of the natural time the root is about the lag; at no lag it keeps the derivative finite.
_LATE = "({0} - late_{0}) / sqrt(lag ** 2 + (0.005 * time_scale) ** 2)"

SENSOR_LAG = Effect(
    name="sensor_lag",
    family=Family.SENSOR,
    title="readings that pass a first-order low-pass filter",
    place=Place.SENSOR,
    equation="lag x_shown' = x - x_shown for angle and rate, which is x / (1 + lag s)",
    parameters=_shift("lag", "time constant"),
    states=(
        EffectState("late_angle", "{angle}", _LATE.format("angle"), "lagged angle", initial="angle"),
        EffectState("late_rate", "{rate}", _LATE.format("rate"), "lagged rate", initial="rate"),
    ),
    angle_reading=f"angle - lag * {_LATE.format('angle')}",
    rate_reading=f"rate - lag * {_LATE.format('rate')}",
    signature="Readings are late, and attenuated at high frequencies.",
    confused_with=("sensor_delay", "input_delay", "actuator_lag"),
    separated_by="Fast excitation, or a second sensor of the same motion; a measured motion of the actuator separates "
    "actuator and sensor.",
    stiff=True,
    formula_error=0.0,
    source="data sheets' bandwidth; Titterton, Weston (2004), chapter 4",
)

SENSOR_DELAY = Effect(
    name="sensor_delay",
    family=Family.SENSOR,
    title="delayed readings",
    place=Place.SENSOR,
    equation="x_shown = x(t - delay) for angle and rate; with other sensors x - delay x' + delay^2 x'' / 2",
    parameters=_shift("delay", "age of the readings"),
    angle_reading="angle - delay * angle_1 + 0.5 * delay ** 2 * angle_2",
    rate_reading="rate - delay * rate_1 + 0.5 * delay ** 2 * rate_2",
    delay="delay",
    signature="Readings are late, at their full amplitude.",
    confused_with=("sensor_lag", "input_delay", "actuator_lag"),
    separated_by="Fast excitation, or a second sensor of the same motion; a measured motion of the actuator separates "
    "actuator and sensor.",
    formula_error=0.0,
    source="Åström, Wittenmark, Computer-Controlled Systems (1997), section 2.4",
)

SENSOR_SCALE = Effect(
    name="sensor_scale",
    family=Family.SENSOR,
    title="scale error of the rate reading",
    place=Place.SENSOR,
    equation="rate_shown = (1 + scale) rate",
    parameters=(
        EffectParameter(
            "scale", "1", "relative error of the scale", amplitude=True, scale="0.02", lower="-0.5", upper="1"
        ),
    ),
    rate_reading="rate * (1 + scale)",
    signature="The rate reading is a multiple of the slope of the angle reading.",
    confused_with=("input_gain",),
    separated_by="Large motion with angle and rate both measured: the angle's slope is the rate.",
    sets_in=False,
    formula_error=0.0,
    source="Titterton, Weston, Strapdown Inertial Navigation Technology (2004), chapter 4",
)
