"""What the MONOCAB may contain that its nominal model lacks.

Amplitudes at level 1 are physically plausible: a few percent of the 1000 N m that gravity exerts at the supports,
or a few milliseconds. Formulas are in `roll_effects`, `simulation.physics.friction`,
`simulation.physics.input_effects`, `gimbal` and `simulation.bus.imu_node`.
"""

from __future__ import annotations

from upright.simulation.physics.disturbance import Disturbance
from upright.simulation.physics.narrow_band import NarrowBand
from upright.simulation.registry import HiddenEffect, Registry

HIDDEN: dict[str, HiddenEffect] = {
    effect.name: effect
    for effect in (
        HiddenEffect(
            "static_torque", "N m", 120.0, "constant roll torque: the centre of gravity is off the middle", signed=True
        ),
        HiddenEffect("viscous_friction", "N m s/rad", 400.0, "roll torque against the roll rate"),
        HiddenEffect("coulomb_friction", "N m", 60.0, "dry friction of the safety catch (LuGre bristles)"),
        HiddenEffect("stribeck_friction", "N m", 80.0, "breakaway torque, half of it lost when sliding (LuGre)"),
        HiddenEffect("asymmetric_friction", "N m", 60.0, "dry friction right side down, a third of it the other way"),
        HiddenEffect("load_dependent_friction", "1", 0.2, "dry friction as a share of the gyroscopic torque"),
        HiddenEffect("quadratic_drag", "N m s^2/rad^2", 5000.0, "roll torque against the rate squared"),
        HiddenEffect("cubic_stiffness", "N m/rad^3", 1.0e6, "restoring torque of a progressive suspension"),
        HiddenEffect("end_stop", "N m/rad", 5.0e4, "rubber buffers that touch at +-0.5 deg"),
        HiddenEffect("hysteresis", "N m", 60.0, "hysteretic torque of flange and cables (Bouc-Wen, yields in 2 mrad)"),
        HiddenEffect(
            "position_cogging", "N m", 40.0, "torque that repeats every 5 mrad of roll: a worn rail head", signed=True
        ),
        HiddenEffect(
            "periodic_disturbance", "N m", 40.0, "sinusoidal roll torque at 1.3 Hz: machinery on board", signed=True
        ),
        HiddenEffect(
            "torque_step",
            "N m",
            550.0,
            "a person sits down 10 s after the drives started, as a ramp of 0.3 s",
            signed=True,
        ),
        HiddenEffect(
            "torque_drift", "N m", 150.0, "roll torque that creeps up with a time constant of 45 s", signed=True
        ),
        HiddenEffect(
            "flexible_mode", "1", 0.12, "share of the inertia that is sprung at 7 Hz: the cabin on the frame", most=0.9
        ),
        HiddenEffect("gimbal_angle_coupling", "1", 1.0, "gyroscopic torque falls with the cosine of precession"),
        HiddenEffect(
            "gimbal_imbalance",
            "N m",
            80.0,
            "roll torque in proportion to the sine of precession: eccentric gimbals",
            signed=True,
        ),
        HiddenEffect("backlash", "rad", 5.0e-3, "backlash between gimbal motor and gimbal, as an angle of the gimbal"),
        HiddenEffect("input_deadband", "rad/s", 6.0e-3, "precession rate setpoints smaller than this do nothing"),
        HiddenEffect("input_delay", "s", 0.012, "the setpoint acts this much later"),
        HiddenEffect("actuator_lag", "s", 0.03, "a further first-order lag ahead of the speed loop"),
        HiddenEffect(
            "input_asymmetry",
            "1",
            0.08,
            "relative gain: positive setpoints stronger, negative ones weaker",
            signed=True,
        ),
        HiddenEffect("input_gain", "1", -0.08, "relative error of the setpoint's gain", signed=True),
        HiddenEffect("gyro_bias", "rad/s", 8.7e-3, "further bias of the roll gyro (0.5 deg/s)", signed=True),
        HiddenEffect("sensor_offset", "rad", 8.7e-3, "the IMU is mounted rolled by this much (0.5 deg)", signed=True),
        HiddenEffect("sensor_lag", "s", 0.02, "low pass inside the IMU"),
        HiddenEffect("sensor_delay", "s", 0.012, "delay of the IMU's readings"),
        HiddenEffect("sensor_scale", "1", 0.03, "relative error of the gyro's scale", signed=True),
    )
}
"""Every hidden effect by its canonical name."""

UNLISTED: dict[str, HiddenEffect] = {
    effect.name: effect
    for effect in (
        HiddenEffect("test_cubic_drag", "N m s^3/rad^3", 1.5e5, "roll torque against the rate cubed", signed=True),
        HiddenEffect(
            "test_one_sided_damping", "N m s/rad^2", 5.0e4, "damping that grows with the roll angle", signed=True
        ),
        HiddenEffect(
            "test_varying_stiffness", "N m/rad", 3.0e3, "stiffness that swings with time, at 0.7 Hz", signed=True
        ),
        HiddenEffect(
            "test_patchy_damping", "N m s/rad", 6.0e2, "damping that changes sign every 5 mrad of roll", signed=True
        ),
    )
}
"""Effects that no catalogue contains, to test whether a diagnosis reports an unknown cause. Their prefix is `test_`."""

LATE = frozenset(
    {
        "static_torque",
        "viscous_friction",
        "coulomb_friction",
        "stribeck_friction",
        "asymmetric_friction",
        "load_dependent_friction",
        "quadratic_drag",
        "cubic_stiffness",
        "end_stop",
        "hysteresis",
        "position_cogging",
        "periodic_disturbance",
        "torque_step",
        *UNLISTED,
    }
)
"""Effects that can set in during a run: torques on the roll axis."""

MONOCAB = Registry(
    HIDDEN,
    UNLISTED,
    LATE,
    Disturbance(rms=8.0, correlation_time=0.3),
    NarrowBand(rms=4.0, frequency=2.0, damping=0.05),
)
"""The registry of the MONOCAB. Its disturbance is that of a worn rail's alignment at walking pace, 3 % of the gravity
torque at 1 deg; the calculation, and the effect of wind, are in docs/explanation/disturbance.md."""
