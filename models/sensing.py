"""How an effect on a sensor acts beyond one reading: a filter integrates a rate, and a delay applies to all readings.

If a filter computes the angle from the rate (models.parts.Filter), an error of the rate alone enters the angle and is
corrected slowly, and a constant error is learned. An effect that adds to the rate alone has the filter's states for
this.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from upright.models.grey_box import GreyBox
from upright.models.parts import Actuator, Joint, Place, Sensor
from upright.models.place import VOCABULARY
from upright.models.text.expressions import names_in, number

if TYPE_CHECKING:
    from upright.models.effect import AttachedEffect, Effect

_SEEN = "(level_error + lever * error / smoothing)"
FILTERED: Mapping[str, str] = {
    "angle_error": f"error - bias_error - proportional * (angle_error - {_SEEN})",
    "bias_error": f"integral * (angle_error - {_SEEN})",
    "level_error": f"error - bias_error - {_SEEN} / smoothing",
}
"""Local name to derivative of the states of a filter that the `error` of its rate drives.

Besides `error` and each other they use the fields of models.parts.Filter. The first is added to the angle, the second
is subtracted from the rate.
"""
BEGUN = 0.01
"""Standard deviation of a filter's errors when a segment begins, as a share of the sensor's typical angle and rate."""


def integrated(place: Joint | Actuator | Sensor, effect: Effect) -> bool:
    """Whether a filter integrates what `effect` adds to the rate at `place`.

    An effect that changes the angle as well defines the error of the angle itself.
    """
    if not isinstance(place, Sensor) or place.filter is None:
        return False
    return bool(place.angle and place.rate and effect.rate_reading) and not effect.angle_reading


def filter_inputs(model: GreyBox) -> frozenset[str]:
    """The inputs of `model` that are used by the filters through which errors of its sensors pass."""
    found: set[str] = set()
    for sensor in model.sensors:
        through = any(each.at == sensor.name and integrated(sensor, each.effect) for each in model.effects)
        if through and sensor.filter is not None and isinstance(sensor.filter.integral, str):
            found |= names_in(sensor.filter.integral)
    return frozenset(found)


def is_learned_bias(sensor: Sensor, effect: Effect) -> bool:
    """Whether `effect` adds a constant to the rate of `sensor` that a filter has learned before a record begins."""
    if not integrated(sensor, effect) or sensor.filter is None or not sensor.filter.integral or effect.states:
        return False
    own = dict.fromkeys(effect.own_names, 1.0)
    motions = [{**own, **dict.fromkeys(VOCABULARY[Place.SENSOR], value)} for value in (0.25, 0.5)]
    less, more = (number(effect.rate_reading, each) - each["rate"] for each in motions)
    return math.isclose(less, more, rel_tol=1e-9)


def delayed(model: GreyBox, attached: AttachedEffect) -> tuple[str, ...]:
    """Names of the inputs of `model` that the effect's `delay` delays; none if it delays none.

    A delay of a sensor that shows all outputs is equivalent to a delay of all inputs that drive the vehicle.
    """
    effect = attached.effect
    if not effect.delay:
        return ()
    if effect.place is Place.ACTUATOR:
        commands = {name for each in model.actuators if each.name == attached.at for name in each.commands}
        return tuple(each.name for each in model.inputs if each.channel in commands)
    shown = {name for sensor in model.sensors if sensor.name == attached.at for name in (sensor.angle, sensor.rate)}
    # What a filter states about itself is delayed with the readings.
    driving = tuple(each.name for each in model.inputs if each.usual is None)
    return driving if shown.issuperset(each.name for each in model.outputs) else ()
