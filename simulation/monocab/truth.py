"""The true MONOCAB."""

from __future__ import annotations

import math
from dataclasses import dataclass

from upright.simulation.monocab.hidden import MONOCAB
from upright.simulation.registry import Registry


@dataclass(frozen=True, slots=True)
class PlantTruth:
    """The true parameters of the MONOCAB; the vehicle file's CAD values are deliberately off by 10 to 20 %."""

    inertia: float = 1650.0
    """kg m^2, mechanical, about the rail head, trim mass in the middle included."""
    gravity_stiffness: float = 14500.0
    """N m/rad: mass x gravity x height of the centre of gravity."""
    angular_momentum: float = 3300.0
    """N m s, both flywheels together."""
    flywheel_inertia: float = 2.626
    """kg m^2 of each flywheel about its axis of rotation: 6,000 rpm at half the angular momentum."""
    gimbal_inertia: float = 60.0
    """kg m^2 about the precession axes, both gimbals with their reflected rotors."""
    gimbal_time_constant: float = 0.01
    """s, small time constant of the speed loop (tau_sigma); the closed loop lags by four times this."""
    gimbal_torque_limit: float = 1500.0
    """N m at each gimbal."""
    gimbal_drag: float = 20.0
    """N m s/rad of each gimbal: bearings, chain and gear."""
    gimbal_brake_torque: float = 1500.0
    """N m that the holding brake of each gimbal can carry."""
    trim_mass: float = 500.0
    """kg."""
    trim_height: float = 0.4
    """m above the rail head."""
    trim_drive_mass: float = 150.0
    """kg, ball screw and rotor reflected to the carriage."""
    trim_time_constant: float = 0.02
    """s, small time constant of the trim drive's speed loop."""
    trim_force_limit: float = 6000.0
    """N."""
    trim_drag: float = 400.0
    """N s/m."""
    support_angle: float = math.radians(4.0)
    """rad, where the supports touch."""
    support_stiffness: float = 2.0e6
    """N m/rad."""
    support_damping: float = 4.6e4
    """N m s/rad, in contact: 0.4 of critical with the inertia above, a restitution of about a quarter."""
    rail_friction: float = 0.0
    """N m s/rad of the roll motion."""
    gravity: float = 9.81
    """m/s^2."""
    encoder_increments_per_turn: int = 1 << 20
    """Of the motor encoders, inside the drives."""

    @property
    def falling_inertia(self) -> float:
        return self.inertia

    @property
    def registry(self) -> Registry:
        return MONOCAB
