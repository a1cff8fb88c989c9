"""The fits of all methods, measured in the same way, and the poles of the model at each method's values.

The predictions are those of a common filter (estimators.identify.common_fit), or those that the kind of vehicle defines
(estimators.identify.subject).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from upright.estimators.identify.choice import COMMON, OWN
from upright.estimators.identify.common_fit import CommonPredictor
from upright.estimators.identify.subject import Subject, Values
from upright.models.model import Model
from upright.telemetry.errors import UprightError
from upright.telemetry.recording import Recording


def measure(entries: Mapping[str, dict[str, Any]], subject: Subject, recordings: Sequence[Recording]) -> float | None:
    """Write into each method's entry its `fit_percent`, `fit_measured` and `pole` (1/s, None if it is not known).

    Returns the horizon, s; None if no fit could be measured in the common way, so that each is the method's own.
    """
    known = {
        name: {parameter: each["value"] for parameter, each in entry["parameters"].items() if each["value"] is not None}
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
    own = subject.own.prediction(subject, recordings)
    if own is not None:
        for name, entry in entries.items():
            entry["fit_percent"], entry["fit_measured"] = own.percent(known[name]), COMMON
        return own.horizon
    if common is None or not whole:
        return None
    horizon = common.horizon(list(whole.values()))
    for name, values in whole.items():
        entry = entries[name]
        try:
            entry["fit_percent"], entry["fit_measured"] = common.percent(values, horizon), COMMON
        except ArithmeticError as error:
            entry["fit_percent"], entry["fit_measured"] = {}, COMMON
            entry["reason"] = "; ".join(filter(None, (entry["reason"], str(error))))
        except UprightError:
            continue
    return horizon if any(entry["fit_measured"] == COMMON for entry in entries.values()) else None


def _whole(model: Model, known: Values) -> Values | None:
    """The model's values by a method; None if a value is lacking that cannot be zero.

    An effect may be absent, an inertia may not.
    """
    absent = {name: 0.0 for effect in model.effects for name in effect.amplitudes}
    values = {each.name: known.get(each.name, absent.get(each.name)) for each in model.parameters if each.estimated}
    found = {name: value for name, value in values.items() if value is not None}
    return found if known and len(found) == len(values) else None
