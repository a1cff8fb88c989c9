"""Hidden effects between a gimbal drive's setpoint and its speed loop: rad/s in, rad/s out, once per step."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping

InputEffect = Callable[[float], float]


def _gain(error: float) -> InputEffect:
    return lambda setpoint: setpoint * (1.0 + error)


def _asymmetry(size: float) -> InputEffect:
    return lambda setpoint: setpoint * (1.0 + size if setpoint > 0.0 else 1.0 - size)


def _deadband(width: float) -> InputEffect:
    return lambda setpoint: math.copysign(max(0.0, abs(setpoint) - width), setpoint)


class Delay:
    """A shift register of integration steps."""

    def __init__(self, delay: float, step: float) -> None:
        self._register = deque([0.0] * max(1, round(delay / step)))

    def __call__(self, setpoint: float) -> float:
        self._register.append(setpoint)
        return self._register.popleft()


class Lag:
    """A first-order lag, exact for an input that is held over the step."""

    def __init__(self, time_constant: float, step: float) -> None:
        self._gain = -math.expm1(-step / time_constant)
        self._output = 0.0

    def __call__(self, setpoint: float) -> float:
        self._output += self._gain * (setpoint - self._output)
        return self._output


def input_effects(sizes: Mapping[str, float], step: float) -> tuple[InputEffect, ...]:
    """The input effects among the hidden effects `sizes`, in the order in which they act on a signal."""
    makers: dict[str, Callable[[float], InputEffect]] = {
        "input_gain": _gain,
        "input_asymmetry": _asymmetry,
        "input_deadband": _deadband,
        "input_delay": lambda size: Delay(size, step),
        "actuator_lag": lambda size: Lag(size, step),
    }
    return tuple(maker(sizes[name]) for name, maker in makers.items() if name in sizes)
