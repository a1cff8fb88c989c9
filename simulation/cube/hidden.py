"""What the reaction-wheel cube may contain that its nominal model lacks.

Amplitudes at level 1 are plausible for a cube of 0.6 kg: gravity exerts 8 mN m per degree of tilt, the drive 160 mN m.
Effects named `wheel_...` act between wheel and body, as in bearings; other torques act on the body, as at the edge.
Formulas are in `effects`, `simulation.physics.friction`, `simulation.physics.input_effects` and
`simulation.bus.imu_node`.
"""

from __future__ import annotations

from upright.simulation.physics.disturbance import Disturbance
from upright.simulation.physics.narrow_band import NarrowBand
from upright.simulation.registry import HiddenEffect, Registry

CUBE_HIDDEN: dict[str, HiddenEffect] = {
    effect.name: effect
    for effect in (
        HiddenEffect("static_torque", "N m", 4.0e-3, "constant tilt torque: a cable pulls forward", signed=True),
        HiddenEffect("viscous_friction", "N m s/rad", 6.0e-3, "torque at the edge against the tilt rate"),
        HiddenEffect("coulomb_friction", "N m", 2.0e-3, "dry friction of the edge (LuGre bristles)"),
        HiddenEffect("stribeck_friction", "N m", 3.0e-3, "breakaway torque of the edge, half of it lost in motion"),
        HiddenEffect("asymmetric_friction", "N m", 2.0e-3, "dry friction of the edge, a third of it backward"),
        HiddenEffect("cubic_stiffness", "N m/rad^3", 30.0, "restoring torque of a cable to the bench"),
        HiddenEffect("periodic_disturbance", "N m", 4.0e-3, "sinusoidal tilt torque at 1.3 Hz: a fan", signed=True),
        HiddenEffect("torque_step", "N m", 4.0e-3, "a load is added after 10 s, as a ramp of 0.3 s", signed=True),
        HiddenEffect("torque_drift", "N m", 4.0e-3, "tilt torque that creeps up, time constant 45 s", signed=True),
        HiddenEffect("wheel_viscous_friction", "N m s/rad", 1.0e-4, "torque on the wheel against its rate"),
        HiddenEffect("wheel_coulomb_friction", "N m", 1.5e-3, "dry friction of the wheel's bearings (LuGre bristles)"),
        HiddenEffect("wheel_drag", "N m s^2/rad^2", 4.0e-6, "torque on the wheel against its rate squared: air"),
        HiddenEffect("wheel_cogging", "N m", 3.0e-3, "torque on the wheel, seven periods per turn", signed=True),
        HiddenEffect("input_deadband", "N m", 2.0e-3, "torques smaller than this do nothing"),
        HiddenEffect("input_delay", "s", 0.006, "the torque acts this much later"),
        HiddenEffect("actuator_lag", "s", 0.006, "a first-order lag between target and torque"),
        HiddenEffect("input_asymmetry", "1", 0.08, "relative gain: forward torques stronger, back weaker", signed=True),
        HiddenEffect("input_gain", "1", -0.08, "relative error of the torque", signed=True),
        HiddenEffect("gyro_bias", "rad/s", 8.7e-3, "further bias of the tilt gyro (0.5 deg/s)", signed=True),
        HiddenEffect("sensor_offset", "rad", 8.7e-3, "the IMU is mounted tilted by this much (0.5 deg)", signed=True),
        HiddenEffect("sensor_lag", "s", 0.005, "low pass inside the IMU"),
        HiddenEffect("sensor_delay", "s", 0.005, "delay of the IMU's readings"),
        HiddenEffect("sensor_scale", "1", 0.03, "relative error of the gyro's scale", signed=True),
    )
}
"""Every listed effect by name. Those at the edge have their canonical names, those at the wheel have these in a
catalogue:"""

AT_THE_WHEEL = {
    "wheel_viscous_friction": "viscous_friction@wheel",
    "wheel_coulomb_friction": "coulomb_friction@wheel",
    "wheel_drag": "quadratic_drag@wheel",
    "wheel_cogging": "position_cogging@wheel",
}

CUBE_UNLISTED: dict[str, HiddenEffect] = {
    effect.name: effect
    for effect in (
        HiddenEffect("test_cubic_drag", "N m s^3/rad^3", 5.0e-3, "torque at the edge against the rate cubed"),
        HiddenEffect(
            "test_varying_stiffness", "N m/rad", 0.06, "gravity stiffness that swings at 0.7 Hz: sloshing", signed=True
        ),
    )
}
"""Effects that no catalogue contains."""

CUBE = Registry(
    CUBE_HIDDEN,
    CUBE_UNLISTED,
    frozenset(
        {
            "static_torque",
            "viscous_friction",
            "coulomb_friction",
            "stribeck_friction",
            "asymmetric_friction",
            "cubic_stiffness",
            "periodic_disturbance",
            "torque_step",
            *AT_THE_WHEEL,
            *CUBE_UNLISTED,
        }
    ),
    Disturbance(rms=4.0e-4, correlation_time=0.3),
    NarrowBand(rms=4.0e-4, frequency=2.0, damping=0.05),
)
"""The registry of the cube. Torques can set in during a run. Its disturbance, on the tilt, is a draught in a room and a
bench that is leaned on, 5 % of the gravity torque at 1 deg; the calculation is in docs/explanation/disturbance.md."""
