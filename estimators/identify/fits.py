"""The fits of all methods, measured alike, and the poles of the model at each method's values.

For the MONOCAB's balance the predictions are in closed form from the measured state (estimators.identify.prediction);
for any other model they are those of a filter (estimators.identify.common_fit).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from estimators.identify.choice import ALIKE, OWN
from estimators.identify.common_fit import CommonPredictor
from estimators.identify.prediction import free_motion, predict, sensor_noise
from models.model import Model
from telemetry.errors import UprightError
from telemetry.recording import Recording

ROLL_HORIZON = 0.5
"""s ahead that the fit of the MONOCAB's roll is measured."""
ROLL_CHANNELS = ("roll", "roll_rate")

Values = Mapping[str, float]
Percent = Callable[[Values], dict[str, float]]
"""From a method's values to percent by channel."""


@dataclass(frozen=True, slots=True)
class Subject:
    """What is identified: a model with its start values, and what the vehicle file says of the vehicle.

    `parameters` and `deviations` are CAD values and their standard deviations, by name; `support` rad is the roll angle
    at which the supports carry, None for a vehicle without any; `bandwidth` rad/s of the filter of the regressions,
    None for their own.
    """

    model: Model
    parameters: Mapping[str, float]
    deviations: Mapping[str, float]
    support: float | None
    bandwidth: float | None = None

    @property
    def values(self) -> dict[str, float]:
        """All values before the identification."""
        return {**self.parameters, **self.model.values}

    @property
    def is_roll(self) -> bool:
        """Whether the model is the MONOCAB's balance with no more than a static torque."""
        names = {parameter.name for parameter in self.model.parameters}
        plain = {effect.name for effect in self.model.effects} <= {"static_torque"}
        return self.model.name.startswith("monocab") and plain and names >= {"inertia", "gravity_stiffness"}


def measure(entries: Mapping[str, dict[str, Any]], subject: Subject, recordings: Sequence[Recording]) -> float | None:
    """Write into each method's entry its `fit_percent`, `fit_measured` and `pole` (1/s, None where it is not known).

    Returns the horizon, s; None where no fit could be measured alike, each then being the method's own.
    """
    known = {
        name: {parameter: told["value"] for parameter, told in entry["parameters"].items() if told["value"] is not None}
        for name, entry in entries.items()
    }
    try:
        common: CommonPredictor | None = CommonPredictor.of(subject.model, recordings, subject.support)
    except UprightError:
        common = None
    whole = {name: values for name, each in known.items() if (values := _whole(subject.model, each)) is not None}
    for name, entry in entries.items():
        entry["fit_measured"], entry["pole"] = OWN, None
        if common is not None and name in whole:
            entry["pole"] = common.growth(whole[name])
    percent = _of_roll(recordings, subject) if subject.is_roll else None
    if percent is not None:
        for name, entry in entries.items():
            entry["fit_percent"], entry["fit_measured"] = percent(known[name]), ALIKE
        return ROLL_HORIZON
    if common is None or not whole:
        return None
    horizon = common.horizon(list(whole.values()))
    for name, values in whole.items():
        entry = entries[name]
        try:
            entry["fit_percent"], entry["fit_measured"] = common.percent(values, horizon), ALIKE
        except ArithmeticError as error:
            entry["fit_percent"], entry["fit_measured"] = {}, ALIKE
            entry["reason"] = "; ".join(filter(None, (entry["reason"], str(error))))
        except UprightError:
            continue
    return horizon if any(entry["fit_measured"] == ALIKE for entry in entries.values()) else None


def _whole(model: Model, known: Values) -> Values | None:
    """What a method knows of the model, None where it lacks what cannot be zero.

    An effect may be absent, an inertia may not.
    """
    absent = {name: 0.0 for effect in model.effects for name in effect.amplitudes}
    values = {each.name: known.get(each.name, absent.get(each.name)) for each in model.parameters if each.estimated}
    told = {name: value for name, value in values.items() if value is not None}
    return told if known and len(told) == len(values) else None


def _of_roll(recordings: Sequence[Recording], subject: Subject) -> Percent | None:
    """The fit of the MONOCAB's balance; None where the recordings do not have what it takes."""
    support = subject.support
    if support is None:
        return None
    try:
        stretches = [stretch for recording in recordings for stretch in free_motion(recording, support)]
        noise = sensor_noise(stretches)
    except UprightError:
        return None

    def percent(values: Values) -> dict[str, float]:
        if not values.keys() >= {"inertia", "gravity_stiffness"}:
            return {}
        prediction = predict(stretches, {**subject.values, **values}, ROLL_HORIZON, noise)
        return {} if prediction is None else {channel: prediction.fit_percent(channel) for channel in ROLL_CHANNELS}

    return percent
