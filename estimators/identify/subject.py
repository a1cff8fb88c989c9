"""What is identified, and what a kind of vehicle has of its own in an identification beside what works for every model.

A kind states it in its folder (`vehicles.registry.of(kind).identification()`); nothing here names one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from estimators.contract import Estimator, ParameterEstimate
from models.model import Model
from telemetry.channels import ChannelTable
from telemetry.recording import Recording

Values = Mapping[str, float]
Percent = Callable[[Values], dict[str, float]]
"""From a method's values to percent by channel."""


@dataclass(frozen=True, slots=True)
class Regression:
    """A recursive regression of one kind of vehicle, while it runs or on recordings.

    `channels` are what it takes. `make` takes the CAD values, their standard deviations, the angle on a support (rad)
    and the channel table of the cycles. It raises EstimationError where a value is missing.
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
    """What a kind of vehicle has of its own.

    `regressions` by the name of their method (estimators.identify.table). `asked`: further methods that are asked of
    such a vehicle where none is named. `settings` of methods, by name: the keyword arguments of their functions.
    `prediction` measures a fit, in place of the measure that is common to all models; None where the subject or the
    recordings do not have what it takes. `derived` makes further parameters of those that a method of the drives and
    the best method give, by name, and of the vehicle file's values with their standard deviations.
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
    """What is identified: a model with its start values, and what the vehicle file says of the vehicle.

    `parameters` and `deviations` are CAD values and their standard deviations, by name; `support` rad is the angle at
    which the supports carry, None for a vehicle without any; `bandwidth` rad/s of the filter of the regressions, None
    for their own; `own` what its kind of vehicle has of its own.
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
