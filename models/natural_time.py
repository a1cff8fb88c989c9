"""The natural time T of a model, s: the unit of windows, horizons, frequencies and lags, in place of seconds.

    T = coordinate_scale / rate_scale,    of the slowest joint

is the time that a joint takes to move through its typical deflection at its typical rate: the inverse of the angular
frequency at which it usually moves, 0.4 s for the MONOCAB. In other units of time, or for the same plant at another
pace, it scales like every duration. The scales are known before anything is compiled or recorded, and they are the same
for all fits of a model. A factor of two in them is a factor of two in a window, which is not critical. Poles are
unsuitable: they change with every fit, those of a mass or a balanced vehicle are at zero or unstable, and no matrix
shows which of many poles belongs to the motion. estimators.data.time_scale bounds T by the motion that a
record shows.

A model of actuators alone uses the time constants of its loops instead: the response to a command is over after ten of
them. Their typical sizes (`scale`) are used, since no fit changes these.
"""

from __future__ import annotations

from upright.models.grey_box import GreyBox

OF_A_LOOP = 10.0
"""Time constants of an actuator's loop after which its response is over."""
USUAL = 0.4
"""s, if a model states no durations at all: that of a vehicle."""
DIGITS = 15
"""Significant digits kept of a quotient of scales, so that 0.02 / 0.05 is 0.4."""


def natural_time(model: GreyBox) -> float | None:
    """T of `model`, s; None if it has neither joints nor time constants."""
    joints = [joint.coordinate_scale / joint.rate_scale for joint in model.joints]
    # The delay of a command and the correlation time of a noise say nothing about the loop.
    others = {name for each in model.inputs for name in each.delays} | {s.correlation_time for s in model.base_states}
    times = [each for each in model.base_parameters if each.unit == "s" and each.name not in others]
    lags = [each.scale or abs(each.value) for each in times]
    longest = max(joints) if joints else OF_A_LOOP * max(lags, default=0.0)
    return rounded(longest) or None


def rounded(value: float) -> float:
    """`value` without the rounding errors of products and quotients of decimal fractions."""
    return float(f"{value:.{DIGITS}g}")
