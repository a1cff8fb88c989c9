"""The equations of motion of the balancing robot (Lagrange, from the energies of the paper as corrected).

Coordinates: `travel` a and `turn` c, mean and half difference of the wheel angles relative to the floor (left = a - c,
right = a + c; the robot moves by r a and yaws by 2 r c / d), and `tilt` q. With s the slope, positive uphill ahead,

    kinetic   = (3/2) m_w r^2 (a'^2 + c'^2) + n^2 J_r ((a' - q')^2 + c'^2)
                + (J_K q'^2 + (J_J + m_b l^2 sin(q)^2) yaw'^2) / 2
                + m_b (r^2 a'^2 + 2 r l a' q' cos(q + s) + l^2 q'^2) / 2
    potential = m_b g l cos(q) + (m_b + 2 m_w) g r a sin(s)

In these coordinates only travel and tilt are coupled by inertia. Backlash separates each rotor from its wheel: the
rotor's angle relative to the body is then a coordinate of its own, and a stiff contact couples the two. rad, N m.
"""

from __future__ import annotations

import math

from upright.simulation.physics.contact import Supports
from upright.simulation.twsbr.truth import TwsbrTruth

BACKLASH_STIFFNESS = 560.0
"""N m/rad of a gear, at the wheel, beyond its backlash: its shaft, 18 mm of steel 6 mm thick, G pi d^4 / (32 length).

With a quarter of that and half the damping, the paper's gains at 200 Hz make the robot oscillate by itself between both
limits of the supply, even with negligible backlash.
"""
BACKLASH_DAMPING = 0.3
"""N m s/rad, in contact: half of critical for wheels and body relative to each other."""

State = tuple[float, ...]
"""travel, turn, tilt, left and right rotor at the wheel (relative to the body); then their rates. See `PLACES`."""
PLACES = 5
Drive = tuple[float, float]
"""A motor at the wheel: its torque at standstill, N m, and its damping, N m s/rad."""
Held = tuple[float, float, float]
"""Further torques over a step: on the left wheel, the right one, the tilt; N m."""


class Mechanics:
    """`rates` is the time derivative of a state; `integrate` advances one."""

    def __init__(self, truth: TwsbrTruth, *, backlash: float = 0.0, slope: float = 0.0) -> None:
        radius, height = truth.wheel_radius, truth.centre_of_gravity_height
        self.floor = Supports(truth.floor_angle, truth.floor_stiffness, truth.floor_damping)
        self.gravity_stiffness = truth.body_mass * truth.gravity * height
        self.yaw_per_turn = 2.0 * radius / truth.wheel_distance
        self.held_upright = False
        """A stand holds the tilt."""
        rotor = truth.gear_ratio**2 * truth.rotor_inertia
        wheels = 3.0 * truth.wheel_mass * radius**2
        lumped = 0.0 if backlash else 2.0 * rotor
        self._backlash = backlash
        self._rotor = rotor
        self._lumped = lumped
        self._travel_inertia = wheels + truth.body_mass * radius**2 + lumped
        self._tilt_inertia = truth.body_mass * height**2 + truth.tilt_inertia + lumped
        self._turn_inertia = wheels + truth.yaw_inertia * self.yaw_per_turn**2 + lumped
        self._coupling = truth.body_mass * radius * height
        self._leaning = truth.body_mass * (height * self.yaw_per_turn) ** 2
        self._slope = slope
        self._downhill = -(truth.body_mass + 2.0 * truth.wheel_mass) * truth.gravity * radius * math.sin(slope)
        self._motor_friction = truth.motor_friction
        self._wheel_friction = truth.wheel_friction

    def rates(self, state: State, left: Drive, right: Drive, held: Held) -> State:
        """Its coordinates' rates, then their accelerations, with these motors and further torques."""
        travel, turn, tilt, left_rotor, right_rotor, travel_rate, turn_rate, tilt_rate, left_speed, right_speed = state
        left_rate, right_rate = travel_rate - turn_rate, travel_rate + turn_rate
        if self._backlash:
            gear_left = self._contact(left_rotor - travel + turn + tilt, left_speed - left_rate + tilt_rate)
            gear_right = self._contact(right_rotor - travel - turn + tilt, right_speed - right_rate + tilt_rate)
            left_spin = (self._motor(left, left_speed) - gear_left) / self._rotor
            right_spin = (self._motor(right, right_speed) - gear_right) / self._rotor
        else:
            gear_left = self._motor(left, left_rate - tilt_rate)
            gear_right = self._motor(right, right_rate - tilt_rate)
        on_left = gear_left - self._wheel_friction * left_rate + held[0]
        on_right = gear_right - self._wheel_friction * right_rate + held[1]

        sine, cosine = math.sin(tilt), math.cos(tilt)
        ahead = tilt + self._slope
        torque = on_left + on_right + self._downhill + self._coupling * math.sin(ahead) * tilt_rate * tilt_rate
        tipping = self.gravity_stiffness * sine - gear_left - gear_right + held[2] + self.floor.torque(tilt, tilt_rate)
        tipping += self._leaning * sine * cosine * turn_rate * turn_rate
        turning = on_right - on_left - 2.0 * self._leaning * sine * cosine * tilt_rate * turn_rate

        mixed = self._coupling * math.cos(ahead) - self._lumped
        if self.held_upright:
            forward, tip = torque / self._travel_inertia, 0.0
        else:
            determinant = self._travel_inertia * self._tilt_inertia - mixed * mixed
            forward = (self._tilt_inertia * torque - mixed * tipping) / determinant
            tip = (self._travel_inertia * tipping - mixed * torque) / determinant
        swing = turning / (self._turn_inertia + self._leaning * sine * sine)
        if not self._backlash:
            left_speed, right_speed = left_rate - tilt_rate, right_rate - tilt_rate
            left_spin, right_spin = forward - swing - tip, forward + swing - tip
        return travel_rate, turn_rate, tilt_rate, left_speed, right_speed, forward, swing, tip, left_spin, right_spin

    def integrate(self, state: State, step: float, left: Drive, right: Drive, held: Held) -> State:
        """The state `step` s later (Runge-Kutta of order four)."""
        half = 0.5 * step
        k1 = self.rates(state, left, right, held)
        k2 = self.rates(tuple([x + half * k for x, k in zip(state, k1, strict=True)]), left, right, held)
        k3 = self.rates(tuple([x + half * k for x, k in zip(state, k2, strict=True)]), left, right, held)
        k4 = self.rates(tuple([x + step * k for x, k in zip(state, k3, strict=True)]), left, right, held)
        sixth = step / 6.0
        return tuple([x + sixth * (a + 2.0 * (b + c) + d) for x, a, b, c, d in zip(state, k1, k2, k3, k4, strict=True)])

    def _motor(self, drive: Drive, rate: float) -> float:
        standstill, damping = drive
        return standstill - (damping + self._motor_friction) * rate

    def _contact(self, twist: float, twist_rate: float) -> float:
        """Torque that a rotor ahead of its wheel by `twist` transmits: they push but never pull."""
        beyond = twist - min(0.5 * self._backlash, max(-0.5 * self._backlash, twist))
        if beyond > 0.0:
            return max(0.0, BACKLASH_STIFFNESS * beyond + BACKLASH_DAMPING * twist_rate)
        if beyond < 0.0:
            return min(0.0, BACKLASH_STIFFNESS * beyond + BACKLASH_DAMPING * twist_rate)
        return 0.0
