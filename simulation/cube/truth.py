"""The true reaction-wheel cube, from which its virtual vehicle is built."""

from __future__ import annotations

import math
from dataclasses import dataclass

from upright.simulation.cube.hidden import CUBE
from upright.simulation.registry import Registry


@dataclass(frozen=True, slots=True)
class CubeTruth:
    """Deliberately off table I of Gajamohan et al.: masses and heights 3 %, inertias 6 to 8 %, friction 20 %."""

    body_mass: float = 0.43
    """kg (m_b)."""
    body_height: float = 0.073
    """m of the body's centre of mass over the edge (l_b)."""
    body_inertia: float = 3.6e-3
    """kg m^2 of the body about the edge (I_b)."""
    wheel_mass: float = 0.21
    """kg (m_w)."""
    wheel_height: float = 0.0855
    """m of the wheel's axle over the edge (l)."""
    wheel_inertia: float = 0.535e-3
    """kg m^2 of the wheel with its rotor about its axle (I_w)."""
    edge_friction: float = 1.22e-3
    """N m s/rad between edge and table (C_b)."""
    wheel_friction: float = 0.06e-3
    """N m s/rad of the wheel's bearings and air (C_w)."""
    gravity: float = 9.81
    """m/s^2."""
    torque_lag: float = 0.15e-3
    """s, of the current loop: a bandwidth of 1 kHz."""
    torque_noise: float = 5.0e-5
    """N m RMS per step: a current sensor of 12 bits over six times the rated torque, averaged over the step."""
    torque_limit: float = 0.16
    """N m: that of the drive's current limit."""
    encoder_increments_per_turn: int = 8192
    """Of the wheel's encoder."""
    rate_filter: float = 2.0e-3
    """s, low pass of the drive's rate, a difference of the encoder's counts."""
    support_angle: float = math.radians(8.0)
    """rad, where the supports touch, front and rear."""
    support_stiffness: float = 60.0
    """N m/rad."""
    support_damping: float = 0.43
    """N m s/rad, in contact: 0.4 of critical with the body's inertia about the edge."""

    @property
    def inertia(self) -> float:
        """kg m^2 of the body about the edge, with the wheel's mass at its axle."""
        return self.body_inertia + self.wheel_mass * self.wheel_height**2

    @property
    def gravity_stiffness(self) -> float:
        """N m/rad near upright."""
        return self.gravity * (self.body_mass * self.body_height + self.wheel_mass * self.wheel_height)

    @property
    def falling_inertia(self) -> float:
        """The wheel turns freely, so that only its mass contributes."""
        return self.inertia

    @property
    def parameters(self) -> dict[str, float]:
        """Its parameters, by their names in a vehicle file."""
        return {
            "inertia": self.inertia,
            "gravity_stiffness": self.gravity_stiffness,
            "wheel_inertia": self.wheel_inertia,
            "edge_friction": self.edge_friction,
            "wheel_friction": self.wheel_friction,
        }

    @property
    def registry(self) -> Registry:
        return CUBE
