"""The tilt controller of the balancing robot: the source paper's PID, and the lean that brings the wheels back.

Inner loop, one step per control cycle, with the tilt in degrees and the motors' voltage in V (Hassan et al., section
4.1: gains 25, 3 and 3.5, 5 ms):

    voltage = K_p e + K_i (integral of e) + K_d tilt' + excitation,        e = tilt - reference

limited to the supply voltage. The integral is held while that limit is active and it would grow further (conditional
integration; Astroem and Haegglund, Advanced PID Control, section 3.5): a robot that gets up from its bumper is at the
limit for most of the way, and a wound-up integral would throw it over.

Outer loop: the PID holds only the tilt, so the wheels drift, and any shift of the balance (a load, an IMU that is
mounted at a slant) accelerates the robot until its motors have no voltage reserve left. Leaning by `reference`
accelerates it by about g * reference, so that with

    reference = -(2 / T * speed + 1 / T^2 * place) / g

the place obeys place'' + 2 / T * place' + place / T^2 = 0: both poles at -1/T, T being `wheel_return_time`. It must be
slow compared with the inner loop, since the wheels first go the other way.

Tilt and reference in rad, positive forward; a positive voltage drives forward, under a body that leans forward.
"""

from __future__ import annotations

from math import degrees, radians

from upright.models.gravity import GRAVITY
from upright.vehicles.twsbr.file import TwsbrFile


class WheelReturn:
    """The outer loop: place and speed on the floor in, lean of the robot out, at most `limit` rad to either side."""

    __slots__ = ("_limit", "_of_place", "_of_speed")

    def __init__(self, time: float, limit: float) -> None:
        """`time` in s; 0 is off, as in the paper."""
        self._of_place = 1.0 / (GRAVITY * time**2) if time else 0.0
        self._of_speed = 2.0 / (GRAVITY * time) if time else 0.0
        self._limit = limit

    def lean(self, place: float, speed: float) -> float:
        """rad, from m and m/s."""
        wanted = -(self._of_place * place + self._of_speed * speed)
        limit = self._limit
        return limit if wanted > limit else -limit if wanted < -limit else wanted


class TiltController:
    """Holds the robot up: tilt and its rate in, the motors' voltage out.

    `reference` is the tilt aimed at in the last step, lean included; `limited` whether the supply limited the
    voltage.
    """

    __slots__ = (
        "_derivative",
        "_integral",
        "_integral_gain",
        "_limit",
        "_proportional",
        "_return",
        "limited",
        "reference",
    )

    def __init__(
        self, proportional: float, integral: float, derivative: float, *, limit: float, wheel_return: WheelReturn
    ) -> None:
        """Gains in V/deg, V/(deg s) and V s/deg, as in the paper; `limit` in V."""
        self._proportional = degrees(proportional)
        self._integral_gain = degrees(integral)
        self._derivative = degrees(derivative)
        self._limit = limit
        self._return = wheel_return
        self._integral = 0.0
        self.reference = 0.0
        self.limited = False

    @classmethod
    def of(cls, vehicle: TwsbrFile) -> TiltController:
        """The controller of a vehicle file."""
        section = vehicle.controller
        return cls(
            section.proportional_gain,
            section.integral_gain,
            section.derivative_gain,
            limit=vehicle.limits.voltage,
            wheel_return=WheelReturn(section.wheel_return_time, radians(section.wheel_return_limit_deg)),
        )

    def step(
        self,
        tilt: float,
        tilt_rate: float,
        place: float,
        speed: float,
        reference: float,
        dt: float,
        excitation: float = 0.0,
    ) -> float:
        """One cycle: the voltage, V.

        `place` (m) and `speed` (m/s) are those on the floor, from where the robot got up; `reference` (rad) does
        not include the lean; `excitation` (V) is added to the PID's output before the limit; `dt` s since the last
        cycle.
        """
        reference += self._return.lean(place, speed)
        self.reference = reference
        error = tilt - reference
        integral = self._integral + error * dt
        wanted = self._proportional * error + self._integral_gain * integral + self._derivative * tilt_rate + excitation
        limit = self._limit
        voltage = limit if wanted > limit else -limit if wanted < -limit else wanted
        self.limited = voltage != wanted
        if not self.limited or error * wanted < 0.0:
            self._integral = integral
        return voltage
