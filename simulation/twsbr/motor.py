"""A geared DC motor on a PWM bridge, at the wheel; its encoder, and the wheel that it turns.

current = (voltage - n K rate) / R and torque = n K current, rate being the wheel's relative to the body. With an open
bridge no current flows. The bridge outputs whole steps of the supply; the hidden input effects act on its output.
"""

from __future__ import annotations

import math

from upright.simulation.physics.input_effects import InputEffect
from upright.simulation.twsbr.mechanics import Drive
from upright.simulation.twsbr.truth import TwsbrTruth


class Motor:
    """Of one wheel. Call `set_voltage` before a step, and `follow` after it."""

    def __init__(self, truth: TwsbrTruth, step: float, effects: tuple[InputEffect, ...]) -> None:
        self.powered = False
        self.target = 0.0
        """V."""
        self.limited = False
        self.duty = 0.0
        """Share of the supply that the bridge puts on the motor, -1 to 1."""
        self.wheel_angle = 0.0
        """rad of the wheel, relative to the floor."""
        self.wheel_rate = 0.0
        self.rotor_rate = 0.0
        """rad/s of the motor, at the wheel and relative to the body."""
        self.torque = 0.0
        """N m at the wheel."""
        self._encoder = Encoder(2.0 * math.pi / truth.encoder_counts_per_turn, step)
        self.effects = effects
        """What lies between target and bridge, in the order in which it acts."""
        self._nominal = truth.supply_voltage
        self._pwm_steps = truth.pwm_steps
        self._constant = truth.gear_ratio * truth.torque_constant
        self._resistance = truth.resistance
        self._drive: Drive = (0.0, 0.0)

    @property
    def demand(self) -> float:
        """V that the bridge outputs for the target at the nominal supply."""
        return self.duty * self._nominal

    @property
    def current(self) -> float:
        """A."""
        return self.torque / self._constant

    @property
    def measured_position(self) -> float:
        """rad of the motor, at the wheel and relative to the body."""
        return self._encoder.position

    @property
    def measured_rate(self) -> float:
        """rad/s of the same."""
        return self._encoder.rate

    def set_voltage(self, supply: float) -> Drive:
        """The effect of the bridge in the next step, with a supply of `supply` V."""
        if not self.powered:
            self.duty, self.limited, self._drive = 0.0, False, (0.0, 0.0)
            return self._drive
        share = self.target / self._nominal
        self.limited = abs(share) > 1.0
        volts = round(min(1.0, max(-1.0, share)) * self._pwm_steps) / self._pwm_steps * self._nominal
        for effect in self.effects:
            volts = effect(volts)
        self.duty = min(1.0, max(-1.0, volts / self._nominal))
        gain = self._constant / self._resistance
        self._drive = (gain * self.duty * supply, gain * self._constant)
        return self._drive

    def follow(self, wheel_angle: float, wheel_rate: float, rotor: float, rotor_rate: float) -> None:
        """Take the motion at the end of a step; `rotor` is the motor's angle at the wheel, relative to the body."""
        self.wheel_angle, self.wheel_rate, self.rotor_rate = wheel_angle, wheel_rate, rotor_rate
        standstill, damping = self._drive
        self.torque = standstill - damping * rotor_rate
        self._encoder.read(rotor)


class Encoder:
    """Counts the edges of a coarse encoder and records their times, as small motor controllers do; starts between two.

    The rate is that between the last two edges, limited to one edge in the time since the last.
    """

    def __init__(self, pitch: float, step: float) -> None:
        self._pitch = pitch
        self._step = step
        self._place = 0.5
        """Position of the disc, in counts."""
        self._count = 0
        self._since = math.inf
        """s since the last edge."""
        self._edge = 0
        self._rate = 0.0

    @property
    def position(self) -> float:
        """rad, in whole counts."""
        return self._count * self._pitch

    @property
    def rate(self) -> float:
        """rad/s."""
        most = self._pitch / self._since if self._since > 0.0 else math.inf
        return min(most, max(-most, self._rate))

    def read(self, angle: float) -> None:
        """Sample the disc's angle one step later."""
        place = angle / self._pitch + 0.5
        count = math.floor(place)
        before, self._place = self._place, place
        self._since += self._step
        if count == self._count:
            return
        edge = count if count > self._count else count + 1
        ago = self._step * (place - edge) / (place - before)
        self._rate = (edge - self._edge) * self._pitch / (self._since - ago)
        self._count, self._edge, self._since = count, edge, ago
