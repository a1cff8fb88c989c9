"""The subject of an identification, and the methods that a kind of vehicle adds to those for every model.

A kind of vehicle defines them in its folder (`vehicles.registry.of(kind).identification()`); this package names none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from upright.estimators.contract import Estimator, ParameterEstimate
from upright.models.model import Model
from upright.telemetry.channels import ChannelTable
from upright.telemetry.recording import Recording

Values = Mapping[str, float]
Percent = Callable[[Values], dict[str, float]]
"""Function from a method's values to percent by channel."""


@dataclass(frozen=True, slots=True)
class Regression:
    """A recursive regression of one kind of vehicle, for use while it runs or on recordings.

    `channels` are those that it uses. `make` takes the CAD values, their standard deviations, the angle on a support
    (rad) and the channel table of the cycles. It raises EstimationError if a value is missing.
    """

    channels: ChannelTable
    make: Callable[[Values, Values, float, ChannelTable], Estimator]


@dataclass(frozen=True, slots=True)
class Prediction:
    """How well a method's values predict, by the vehicle's own measure, `horizon` s ahead of the measured state."""

    horizon: float
    percent: Percent


@dataclass(frozen=True, slots=True)
class OwnMethods:
    """The methods of a kind of vehicle.

    `regressions` by the name of their method (estimators.identify.table). `asked`: further methods that are run for
    such a vehicle if none is named. `settings` of methods, by name: the keyword arguments of their functions.
    `prediction` measures a fit in place of the measure that is common to all models; it returns None if the subject or
    the recordings lack what it needs. `derived` computes further parameters from those of a method of the drives, those
    of the best method, and the vehicle file's values with their standard deviations.
    """

    regressions: Mapping[str, Regression] = field(default_factory=dict)
    asked: tuple[str, ...] = ()
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    prediction: Callable[[Subject, Sequence[Recording]], Prediction | None] = lambda subject, recordings: None
    derived: Callable[
        [Mapping[str, ParameterEstimate], Mapping[str, ParameterEstimate], Mapping[str, tuple[float, float]]],
        dict[str, ParameterEstimate],
    ] = lambda drives, best, vehicle: {}


NOTHING_OWN = OwnMethods()


@dataclass(frozen=True, slots=True)
class Subject:
    """The subject of an identification: a model with its start values, and data of the vehicle file.

    `parameters` and `deviations` are CAD values and their standard deviations, by name; `support` (rad) is the angle at
    which supports carry the vehicle, None without supports; `bandwidth` (rad/s) is that of the filter of the
    regressions, None for their default; `own` are the methods of its kind of vehicle.
    """

    model: Model
    parameters: Values
    deviations: Values
    support: float | None
    bandwidth: float | None = None
    own: OwnMethods = NOTHING_OWN

    @property
    def values(self) -> dict[str, float]:
        """All values before the identification."""
        return {**self.parameters, **self.model.values}
