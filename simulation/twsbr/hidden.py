"""What the balancing robot may contain that its nominal model lacks.

Amplitudes at level 1 are plausible for a robot of 0.85 kg: 12 V at standstill give 0.67 N m per wheel, 1 deg of tilt
6 mN m of gravity. "On each wheel" is between wheel and floor, "in each gear" between motor and body, at the wheel. The
latter is where a small robot has its dry friction, from brushes and the gear's first stages, as large as 0.2 to 0.5 V;
that of a tyre on a hard floor is a tenth of it. Formulas are in `effects`, `mechanics` and `motor`.
"""

from __future__ import annotations

from upright.simulation.physics.disturbance import Disturbance
from upright.simulation.physics.narrow_band import NarrowBand
from upright.simulation.registry import HiddenEffect, Registry

TWSBR_HIDDEN: dict[str, HiddenEffect] = {
    effect.name: effect
    for effect in (
        HiddenEffect("static_torque", "N m", 0.01, "constant tilt torque: the battery sits 1.4 mm ahead", signed=True),
        HiddenEffect(
            "slope", "rad", 0.035, "the floor rises ahead by this (2 deg): a static torque on the wheels", signed=True
        ),
        HiddenEffect("viscous_friction", "N m s/rad", 3.0e-3, "torque on each wheel against its rate"),
        HiddenEffect("coulomb_friction", "N m", 0.01, "dry friction in each gear (LuGre bristles)"),
        HiddenEffect("stribeck_friction", "N m", 0.015, "breakaway torque in each gear, half of it lost when sliding"),
        HiddenEffect("asymmetric_friction", "N m", 0.01, "dry friction in each gear, a third of it backwards"),
        HiddenEffect(
            "load_dependent_friction", "1", 0.1, "dry friction in each gear, as a share of the motor's torque"
        ),
        HiddenEffect("quadratic_drag", "N m s^2/rad^2", 3.0e-4, "torque on each wheel against its rate squared"),
        HiddenEffect("cubic_stiffness", "N m/rad^3", 200.0, "restoring tilt torque of a cable to the bench"),
        HiddenEffect("periodic_disturbance", "N m", 0.02, "sinusoidal tilt torque at 1.3 Hz: a fan", signed=True),
        HiddenEffect(
            "position_cogging", "N m", 0.015, "torque that repeats twice per wheel turn: an oval wheel", signed=True
        ),
        HiddenEffect("torque_step", "N m", 0.01, "a load is added after 10 s, as a ramp of 0.3 s", signed=True),
        HiddenEffect("torque_drift", "N m", 0.01, "tilt torque that creeps up, time constant 45 s", signed=True),
        HiddenEffect("backlash", "rad", 1.0e-3, "backlash of each gear, as an angle of the wheel"),
        HiddenEffect("input_deadband", "V", 0.6, "voltages smaller than this do nothing: the bridge's own drop"),
        HiddenEffect("input_delay", "s", 0.005, "the voltage acts this much later"),
        HiddenEffect("actuator_lag", "s", 0.005, "a first-order lag between target and voltage"),
        HiddenEffect(
            "input_asymmetry", "1", 0.08, "relative gain: forward voltages stronger, back weaker", signed=True
        ),
        HiddenEffect("input_gain", "1", -0.08, "relative error of the voltage", signed=True),
        HiddenEffect("gyro_bias", "rad/s", 8.7e-3, "further bias of the tilt gyro (0.5 deg/s)", signed=True),
        HiddenEffect("sensor_offset", "rad", 8.7e-3, "the IMU is mounted tilted by this much (0.5 deg)", signed=True),
        HiddenEffect("sensor_lag", "s", 0.004, "low pass inside the IMU"),
        HiddenEffect("sensor_delay", "s", 0.004, "delay of the IMU's readings"),
        HiddenEffect("sensor_scale", "1", 0.03, "relative error of the gyro's scale", signed=True),
    )
}
"""Every listed effect by name, all canonical but `slope`, which is `static_torque` at the wheels in a catalogue."""

TWSBR_UNLISTED: dict[str, HiddenEffect] = {
    effect.name: effect
    for effect in (
        HiddenEffect("test_battery_sag", "ohm", 0.6, "resistance of the battery, common to both motors"),
        HiddenEffect("test_cubic_drag", "N m s^3/rad^3", 3.0e-5, "torque on each wheel against its rate cubed"),
        HiddenEffect(
            "test_varying_stiffness", "N m/rad", 0.15, "gravity stiffness that swings at 0.7 Hz: sloshing", signed=True
        ),
    )
}
"""Effects that no catalogue contains."""

TWSBR = Registry(
    TWSBR_HIDDEN,
    TWSBR_UNLISTED,
    frozenset(
        {
            "static_torque",
            "viscous_friction",
            "coulomb_friction",
            "stribeck_friction",
            "asymmetric_friction",
            "load_dependent_friction",
            "quadratic_drag",
            "cubic_stiffness",
            "periodic_disturbance",
            "position_cogging",
            "torque_step",
            "test_cubic_drag",
            "test_varying_stiffness",
        }
    ),
    Disturbance(rms=5.0e-4, correlation_time=0.3),
    NarrowBand(rms=5.0e-4, frequency=2.0, damping=0.05),
)
"""The registry of the balancing robot. Torques can set in during a run. Its disturbance, on the tilt, is a draught in a
room, 8 % of the gravity torque at 1 deg; the calculation is in docs/explanation/disturbance.md."""
