"""The places of a model where an effect can act: joints, actuators, sensors, and the names that each offers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from upright.models.grey_box import GreyBox
from upright.models.natural_time import USUAL, natural_time
from upright.models.parts import Actuator, Joint, Place, Sensor

_ANYWHERE = ("time", "time_scale")
"""`time_scale`, s, is a number: the model's natural time (models.natural_time)."""
EVERY_JOINT = ("coordinate", "rate", "inertia", "load", "smooth_rate")
"""Names that the joints of all models offer."""
_MOVED = ("actuator_rate", "actuator_angle")
_READINGS = {each: (each, f"{each}_1", f"{each}_2") for each in ("angle", "rate")}

VOCABULARY: Mapping[Place, frozenset[str]] = {
    Place.JOINT: frozenset((*_ANYWHERE, *EVERY_JOINT, *_MOVED, "gain", "actuator_inertia")),
    Place.ACTUATOR: frozenset((*_ANYWHERE, "command", *_MOVED)),
    Place.SENSOR: frozenset((*_ANYWHERE, *_READINGS["angle"], *_READINGS["rate"])),
}
"""Names that the expressions of an effect may use besides its own parameters and states, if its place has them."""

_JOINT_SCALES = ("force_scale", "coordinate_scale", "rate_scale", "smooth_rate")
SCALES: Mapping[Place, frozenset[str]] = {
    Place.JOINT: frozenset((*_JOINT_SCALES, "command_scale", "angle_scale", "time_scale")),
    Place.ACTUATOR: frozenset((*_JOINT_SCALES, "command_scale", "angle_scale", "time_scale")),
    Place.SENSOR: frozenset(("angle_scale", "rate_scale", "time_scale")),
}
"""Numbers that the values, scales, bounds and starts of an effect's parameters may use, if its place has them."""

UNITS: Mapping[Place, frozenset[str]] = {
    Place.JOINT: frozenset(("force", "coordinate", "command", "angle")),
    Place.ACTUATOR: frozenset(("force", "coordinate", "command", "angle")),
    Place.SENSOR: frozenset(("angle", "rate")),
}
"""Units that the units of an effect's parameters may contain, in curly brackets, if its place has them."""


@dataclass(frozen=True, slots=True)
class Offer:
    """What one place offers: `names` of its vocabulary, the angles `in_radians` among them, scales and units."""

    names: frozenset[str]
    in_radians: frozenset[str]
    scales: Mapping[str, float]
    units: Mapping[str, str]


def places_of(model: GreyBox, place: Place) -> tuple[Joint | Actuator | Sensor, ...]:
    """The places of a kind that `model` has, without actuators that are not `commanded`: they have no command."""
    match place:
        case Place.JOINT:
            return model.joints
        case Place.ACTUATOR:
            return tuple(actuator for actuator in model.actuators if actuator.commanded)
        case Place.SENSOR:
            return model.sensors


def offer(model: GreyBox, place: Joint | Actuator | Sensor) -> Offer:
    """What `place`, one of `model`'s, offers."""
    scales: dict[str, float] = {"time_scale": natural_time(model) or USUAL}
    if isinstance(place, Sensor):
        return _sensor(place, scales)
    joint: Joint | None
    if isinstance(place, Actuator):
        joint = next((joint for joint in model.joints if joint.name == place.joint), None)
        actuator: Actuator | None = place
        names = {*_ANYWHERE, "command"}
    else:
        joint = place
        actuator = next((each for each in model.actuators if each.joint == joint.name), None)
        names = {*_ANYWHERE, *EVERY_JOINT}
    units: dict[str, str] = {}
    measured_in: dict[str, str] = {}
    if joint is not None:
        scales |= {name: float(getattr(joint, name)) for name in _JOINT_SCALES}
        units |= {"force": joint.force_unit, "coordinate": joint.coordinate_unit}
        measured_in["coordinate"] = joint.coordinate_unit
    if actuator is not None:
        kind = Place.JOINT if isinstance(place, Joint) else Place.ACTUATOR
        names |= actuator.moved.keys() & VOCABULARY[kind]
        scales |= {"command_scale": actuator.command_scale, "angle_scale": actuator.angle_scale}
        units |= {"command": actuator.rate_unit, "angle": actuator.angle_unit}
        measured_in["actuator_angle"] = actuator.angle_unit
    radians = frozenset(name for name, unit in measured_in.items() if unit == "rad" and name in names)
    return Offer(frozenset(names), radians, scales, units)


def _sensor(sensor: Sensor, scales: Mapping[str, float]) -> Offer:
    measured = {"angle": sensor.angle, "rate": sensor.rate}
    names = {name for each, output in measured.items() if output for name in _READINGS[each]}
    return Offer(
        frozenset((*_ANYWHERE, *names)),
        frozenset({"angle"} & names) if sensor.angle_unit == "rad" else frozenset(),
        {**scales, "angle_scale": sensor.angle_scale, "rate_scale": sensor.rate_scale},
        {"angle": sensor.angle_unit, "rate": sensor.rate_unit},
    )
