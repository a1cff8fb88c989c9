"""The speed loop of estimators.speed_loop, one sample at a time, for simulation within a closed loop.

Each mode of its step responses is a state that decays. A step of the setpoint or of the roll acceleration adds to it.
Setpoints are held. The roll rate is extrapolated from its last three samples, since the next one is not known yet. SI
units.
"""

from __future__ import annotations

from cmath import exp

from upright.estimators.speed_loop import MODES, Loop


class SpeedLoopSteps:
    """A speed loop that begins in steady state at `setpoint`; `step` returns the rate one `period` (s) later.

    `lag`, `offset` (the delay until a setpoint begins to act, 0 to `period`) and `reaction` in s.
    """

    __slots__ = ("_decay", "_load", "_load_share", "_rates", "_reaction", "_rest", "_setpoint", "_share", "_state")

    def __init__(self, lag: float, offset: float, reaction: float, period: float, setpoint: float) -> None:
        modes = MODES[Loop.SYMMETRIC_OPTIMUM]
        speeds = [complex(modes.pace / lag * speed) for speed in modes.speed]
        self._decay = [exp(-speed * period) for speed in speeds]
        self._rest = [exp(-speed * (period - offset)) for speed in speeds]
        self._share = [complex(each) for each in modes.setpoint]
        self._load_share = [complex(each) for each in modes.load]
        self._reaction = reaction / period
        self._setpoint = setpoint
        self._state = [0j] * len(speeds)
        self._load = [0j] * len(speeds)
        self._rates: tuple[float, ...] = ()

    def step(self, setpoint: float, roll_rate: float) -> float:
        """The rate one sample later, rad/s, if `setpoint` (rad/s) is sent at this sample and the vehicle rolls with
        `roll_rate`."""
        rate, load = self.parts(setpoint, roll_rate)
        return rate - self._reaction * load

    def parts(self, setpoint: float, roll_rate: float) -> tuple[float, float]:
        """As `step`, in two parts: what the setpoint makes of the rate, and the response to the change of the roll rate
        over one period, of which the reaction over a period is taken away."""
        jump, self._setpoint = setpoint - self._setpoint, setpoint
        before = self._rates or (roll_rate,) * 4
        # Change of the roll rate until the next sample, and until this one, each extrapolated from earlier samples.
        one, two, three, four = roll_rate, *before[:3]
        change = 2.0 * one - 3.0 * two + three
        last = 2.0 * two - 3.0 * three + four
        self._rates = (one, two, three, four)
        rate = setpoint
        load = change
        for place, decay in enumerate(self._decay):
            self._state[place] = self._state[place] * decay + jump * self._rest[place]
            self._load[place] = (self._load[place] + change - last) * decay
            rate += (self._share[place] * self._state[place]).real
            load += (self._load_share[place] * self._load[place]).real
        return rate, load
