"""How the torque of a gimbal depends on its angle. `gain` is the angular momentum if the actuator is a gimbal."""

from __future__ import annotations

from upright.models.effect import Effect, EffectParameter, Family
from upright.models.parts import Place

GIMBAL_ANGLE_COUPLING = Effect(
    name="gimbal_angle_coupling",
    family=Family.COUPLING,
    title="gyroscopic torque that decreases with the cosine of the precession angle",
    place=Place.JOINT,
    equation="F = coupling gain actuator_rate (cos(actuator_angle) - 1)",
    parameters=(
        EffectParameter("coupling", "1", "1 for an ideal geometry", amplitude=True, scale="1", lower="0", upper="10"),
    ),
    force="coupling * gain * actuator_rate * (cos(actuator_angle) - 1)",
    signature="The actuator becomes weaker the farther it is turned, equally in both directions.",
    confused_with=("input_gain",),
    separated_by="The same excitation around a precession angle of zero and around a large one, e.g. under a side "
    "load.",
    in_radians=("actuator_angle",),
    sets_in=False,
    source="Arnold, Maunder, Gyrodynamics (1961); Griese et al. (MONOCAB), linearised there",
)

GIMBAL_IMBALANCE = Effect(
    name="gimbal_imbalance",
    family=Family.COUPLING,
    title="torque proportional to the sine of the precession angle: the gimbals' centre of gravity is off their axis",
    place=Place.JOINT,
    equation="F = torque sin(actuator_angle)",
    parameters=(EffectParameter("torque", "{force}", "torque at a quarter turn", amplitude=True, scale="force_scale"),),
    force="torque * sin(actuator_angle)",
    signature="The residual torque is a linear function of the precession angle.",
    confused_with=("static_torque", "viscous_friction"),
    separated_by="Excitation well below the unstable pole, or the vehicle held for seconds at two precession angles: a "
    "fast precession is proportional to the roll rate, and a constant precession angle acts like a static torque.",
    in_radians=("actuator_angle",),
    sets_in=False,
    source="Arnold, Maunder, Gyrodynamics (1961)",
)
