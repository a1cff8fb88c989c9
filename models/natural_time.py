"""The natural time T of a model, s: what windows, horizons, frequencies and lags are multiples of, in place of seconds.

    T = coordinate_scale / rate_scale,    of the slowest joint

is how long a joint takes through its typical deflection at its typical rate: the inverse of the angular frequency at
which it usually moves, 0.4 s of the MONOCAB. With time in other units, or of the same plant at another pace, it changes
as everything in seconds does. The scales are known before anything is compiled or recorded, they are the same for all
fits of a model, and a factor of two in them is a factor of two in a window, which decides nothing. Poles would not do:
they move with every fit, those of a mass or a balanced vehicle are at zero or unstable, and which of many is the
motion's no matrix says. What a record says of scales that are far off is in estimators.data.time_scale.

A model of actuators alone has its loops' time constants instead: what follows a command is over after ten of them.
Their typical sizes (`scale`) count, which no fit moves.
"""

from __future__ import annotations

from models.grey_box import GreyBox

OF_A_LOOP = 10.0
"""Time constants of an actuator's loop after which its answer is over."""
USUAL = 0.4
"""s, where a model says nothing of its times at all: that of a vehicle."""
DIGITS = 15
"""Kept of a quotient of scales, so that 0.02 over 0.05 is 0.4."""


def natural_time(model: GreyBox) -> float | None:
    """T of `model`, s; None where it has neither joints nor time constants."""
    joints = [joint.coordinate_scale / joint.rate_scale for joint in model.joints]
    # How late a command comes, and how long a noise lasts, say nothing of the loop.
    others = {name for each in model.inputs for name in each.delays} | {s.correlation_time for s in model.base_states}
    times = [each for each in model.base_parameters if each.unit == "s" and each.name not in others]
    lags = [each.scale or abs(each.value) for each in times]
    longest = max(joints) if joints else OF_A_LOOP * max(lags, default=0.0)
    return rounded(longest) or None


def rounded(value: float) -> float:
    """`value` without the digits that products and quotients of decimal fractions leave."""
    return float(f"{value:.{DIGITS}g}")
