"""The true balancing robot, in the symbols of the paper's table 1, from which its virtual vehicle is built."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from upright.simulation.registry import Registry
from upright.simulation.twsbr.hidden import TWSBR


@dataclass(frozen=True, slots=True)
class TwsbrTruth:
    """Deliberately off the paper's table 1: lengths and masses by less than 10 %, inertias and friction by more."""

    wheel_radius: float = 0.0318
    """m (r)."""
    wheel_mass: float = 0.055
    """kg each (m_w); a wheel is a solid disc."""
    centre_of_gravity_height: float = 0.0475
    """m of the body's centre of gravity above the axle (l)."""
    body_mass: float = 0.74
    """kg (m_b)."""
    wheel_distance: float = 0.164
    """m (d)."""
    yaw_inertia: float = 6.1e-3
    """kg m^2 about the upright axis (J_J)."""
    tilt_inertia: float = 1.58e-3
    """kg m^2 of the body about its centre of gravity, across (J_K)."""
    gear_ratio: float = 43.8
    """Motor turns per wheel turn (n)."""
    rotor_inertia: float = 3.1e-6
    """kg m^2 (J_r)."""
    resistance: float = 4.4
    """ohm (R). The time constant of the armature, 5 microseconds, is neglected: the current follows at once."""
    torque_constant: float = 5.6e-3
    """N m/A, and V s/rad (K_T, K_E)."""
    motor_friction: float = 9.0e-6
    """N m s/rad between wheel and body (b)."""
    wheel_friction: float = 7.5e-4
    """N m s/rad between wheel and floor (f_v)."""
    gravity: float = 9.81
    """m/s^2."""
    supply_voltage: float = 12.0
    """V."""
    pwm_steps: int = 255
    """Of the bridge, from 0 to the supply, either way."""
    encoder_counts_per_turn: int = 700
    """Per wheel turn. The encoder sits on the motor's shaft and counts its rotation relative to the body."""
    floor_angle: float = math.radians(12.0)
    """rad, where the bumpers, front and rear, touch the floor."""
    floor_stiffness: float = 150.0
    """N m/rad, of a bumper."""
    floor_damping: float = 0.6
    """N m s/rad, in contact: 0.4 of critical with the body's inertia about the axle."""
    start: Literal["lying", "held"] = "lying"
    """At rest on the front bumper, or upright in a stand that releases it when the motors have power."""

    @property
    def table_1(self) -> dict[str, float]:
        """The numbers of the paper's table 1 by their names in a vehicle file, except the inductance."""
        same = ("wheel_radius", "wheel_mass", "body_mass", "wheel_distance", "yaw_inertia", "tilt_inertia")
        also_same = ("gear_ratio", "rotor_inertia", "motor_friction", "wheel_friction")
        renamed = {
            "com_height": self.centre_of_gravity_height,
            "armature_resistance": self.resistance,
            "motor_constant": self.torque_constant,
        }
        return {**{name: float(getattr(self, name)) for name in (*same, *also_same)}, **renamed}

    @property
    def falling_inertia(self) -> float:
        """kg m^2: effective inertia for a torque on the tilt, upright on level ground with free wheels."""
        radius, rotors = self.wheel_radius, 2.0 * self.gear_ratio**2 * self.rotor_inertia
        travel = 3.0 * self.wheel_mass * radius**2 + self.body_mass * radius**2 + rotors
        tilt = self.body_mass * self.centre_of_gravity_height**2 + self.tilt_inertia + rotors
        mixed = self.body_mass * radius * self.centre_of_gravity_height - rotors
        return tilt - mixed * mixed / travel

    @property
    def registry(self) -> Registry:
        return TWSBR
