"""The fit of several sets of parameter values, measured by the same predictor for all, for any compiled model.

A Kalman filter with the method's parameter values follows the record. Every `horizon` s its state is predicted for
`horizon` s without correction, and the error is compared with the channel's own variation
(estimators.methods.prediction_error.predicted_percent). The noise and the initial states are fitted for each set of
values, by maximum likelihood with the values held, so that no method is judged by a filter that was tuned for the
values of another.

The horizon follows from the model's time scale: HORIZON over the real part of the fastest unstable pole, or over the
absolute value of the slowest pole of a stable model. Poles slower than the longest segment act as integrators in this
record and do not count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from upright.estimators.data.as_recorded import as_recorded
from upright.estimators.fit.maximum_likelihood import fit
from upright.estimators.fit.problem import Problem, at_rest, linearise, problem, typical_motion
from upright.estimators.methods.prediction_error import predicted_percent
from upright.models.model import Model
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

HORIZON = 1.5
"""Horizon times pole: an oscillation advances by a quarter period, an unstable motion grows by e^1.5 = 4.5. For the
MONOCAB, with a pole at 3 rad/s, the horizon is 0.5 s."""
PARTS = 20.0
"""Length of the longest segment in horizons if the model has no time scale of its own."""
ITERATIONS = 40
"""Largest number of steps of the fit of noise and initial states."""
SHORT = 1e-6
"""s over which the model is linearised."""
DIVERGED = -1e6
"""Percent of fit below which a prediction has diverged."""


@dataclass(frozen=True, slots=True)
class CommonPredictor:
    """A model on recordings. `task` is the problem for which the recordings were prepared; its own values do not
    matter."""

    task: Problem

    @classmethod
    def of(cls, model: Model, recordings: Sequence[Recording], support: float | None) -> CommonPredictor:
        """`support`: rad, the vehicle is free at a smaller coordinate.

        Raises DataError if the recordings cannot be used, ModelError and EstimationError for an invalid model.
        """
        return cls(problem(as_recorded(model, recordings), recordings, support=support))

    def poles(self, values: Mapping[str, float]) -> Array:
        """The poles (nx,), 1/s, of the model at these values by name, linearised in typical motion at the mean of the
        measurements."""
        task = self.task
        names = [state.name for state in task.model.states]
        rates = {joint.rate for joint in task.model.joints}
        state = typical_motion(task.model, task.segments)
        means = np.nanmean(np.concatenate([segment.measured for segment in task.segments]), axis=0)
        for output, mean in zip(task.kernel.outputs, means.tolist(), strict=True):
            if output in names and output not in rates:
                state[names.index(output)] = mean
        vector = task.kernel.vector({**task.model.values, **values})
        rest = at_rest(task.kernel, task.segments, SHORT)
        transition, _ = linearise(task.kernel, vector[None], rest, state)
        system = (transition[0] - np.eye(len(names))) / SHORT
        return np.asarray(np.linalg.eigvals(system)) if np.isfinite(system).all() else np.zeros(0)

    def growth(self, values: Mapping[str, float]) -> float | None:
        """The largest real part of the poles, 1/s: positive for an unstable model. None without finite poles."""
        poles = self.poles(values)
        return float(np.max(poles.real)) if len(poles) else None

    def horizon(self, sets: Sequence[Mapping[str, float]]) -> float:
        """Prediction horizon, s: the median over the models with these `sets` of values, so that a single method whose
        values are far off does not decide it."""
        longest = max(segment.duration for segment in self.task.segments)
        found = []
        for values in sets:
            poles = self.poles(values)
            unstable, sizes = poles.real[poles.real > 1.0 / longest], np.abs(poles)[np.abs(poles) > 1.0 / longest]
            if len(unstable):
                found.append(HORIZON / float(np.max(unstable)))
            elif len(sizes):
                found.append(HORIZON / float(np.min(sizes)))
        spacing = float(np.median(np.diff(self.task.segments[0].time)))
        median = float(np.median(found)) if found else longest / PARTS
        return float(np.clip(median, spacing, max(spacing, longest / 3.0)))

    def percent(self, values: Mapping[str, float], horizon: float) -> dict[str, float]:
        """By channel, percent of its variation that is predicted `horizon` s ahead; empty if no segment is that long.

        Raises ArithmeticError if the model diverges with these values, EstimationError if they are out of bounds.
        """
        model = self.task.model.change(values)
        task = replace(problem(model, (), rows=self.task.segments), free=())
        with np.errstate(all="ignore"):
            found = predicted_percent(fit(task, iterations=ITERATIONS), horizon)
        if not all(each > DIVERGED for each in found.values()):  # not a number is not greater
            raise ArithmeticError("with these values the model diverges from the record")
        return found
