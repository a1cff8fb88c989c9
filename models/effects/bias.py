"""Torques that do not depend on the motion: constant, stepped or creeping. N m, or N if a joint slides."""

from __future__ import annotations

from upright.models.effect import Effect, EffectParameter, Family, Role
from upright.models.parts import Place

STATIC_TORQUE = Effect(
    name="static_torque",
    family=Family.BIAS,
    title="constant torque, e.g. from an offset of the centre of gravity",
    place=Place.JOINT,
    equation="F = torque",
    parameters=(EffectParameter("torque", "{force}", "constant force", amplitude=True, scale="force_scale"),),
    force="torque",
    signature="The mean of the residual torque is not zero. A balanced vehicle stands at another angle, or its "
    "actuator drifts away at a steady rate.",
    confused_with=(
        "torque_step",
        "torque_drift",
        "asymmetric_friction",
        "gimbal_imbalance",
        "sensor_offset",
        "gyro_bias",
    ),
    separated_by="A square wave of the angle's reference: a constant torque stays the same while friction changes its "
    "sign. A known payload at a known place changes the torque, but not an offset of the sensor.",
    formula_error=0.0,
    source="Griese et al. (MONOCAB): the static torque missing in their model",
)

TORQUE_STEP = Effect(
    name="torque_step",
    family=Family.BIAS,
    title="torque that sets in during the record, e.g. when a person sits down",
    place=Place.JOINT,
    equation="F = torque (1 + tanh(2.65 ((t - start) / rise - 1/2))) / 2",
    parameters=(
        EffectParameter("torque", "{force}", "height of the step", amplitude=True, scale="force_scale"),
        EffectParameter(
            "start",
            "s",
            "time of the onset since the first sample of the record",
            role=Role.INSTANT,
            value="2.5 * time_scale",
            scale="time_scale / 4",
            lower="0",
            starts=tuple(f"{each} * time_scale" for each in (5, 7.5, 12.5, 17.5, 25, 32.5, 40, 50, 62.5, 75, 100, 125)),
        ),
        EffectParameter(
            "rise",
            "s",
            "rise time of the step",
            role=Role.DURATION,
            value="0.75 * time_scale",
            scale="time_scale / 4",
            lower="time_scale / 20",
            upper="12.5 * time_scale",
        ),
    ),
    force="torque * 0.5 * (1 + tanh(2.65 * ((time - start) / rise - 0.5)))",
    signature="The mean of the residual torque changes at one instant.",
    confused_with=("static_torque", "torque_drift"),
    separated_by="A longer record, in which the parts before and after the step each last longer than the slowest "
    "motion of the vehicle.",
    beyond=("static_torque",),
    onset_of="static_torque",
    formula_error=0.0,
    source="Griese et al. (MONOCAB): side load; tanh is the best fit to a straight ramp, to 7 % of the step",
)

TORQUE_DRIFT = Effect(
    name="torque_drift",
    family=Family.BIAS,
    title="slowly rising torque, e.g. from a load that settles or a part that warms up",
    place=Place.JOINT,
    equation="F = torque (1 - exp(-t / time_constant))",
    parameters=(
        EffectParameter("torque", "{force}", "final value", amplitude=True, scale="force_scale"),
        EffectParameter(
            "time_constant",
            "s",
            "time constant of the creep",
            role=Role.DURATION,
            value="75 * time_scale",
            scale="25 * time_scale",
            lower="2.5 * time_scale",
            upper="9000 * time_scale",
            starts=("12.5 * time_scale", "250 * time_scale", "1500 * time_scale"),
        ),
    ),
    force="torque * (1 - exp(-time / time_constant))",
    signature="The residual torque grows slowly from the start of the record and levels off.",
    confused_with=(
        "static_torque",
        "torque_step",
        "sensor_offset",
        "gyro_bias",
    ),
    separated_by="A record of several time constants; a second record without a pause does not show the drift again.",
    beyond=("static_torque",),
    sets_in=False,
    formula_error=0.0,
    source="first-order creep; Lakes, Viscoelastic Materials (2009), standard linear solid",
)
