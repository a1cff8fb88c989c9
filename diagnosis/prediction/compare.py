"""Model against measurement: how well it predicts, what force it lacks, and whether that is more than noise.

This works for any model: its kernel is run over the record as a Kalman predictor whose gain and floor come from the
process noise that the model states and from the sensors' noise in the record itself (diagnosis.lack_of_fit.floor).
Quantities that are not properties of the vehicle are fitted, too: a fraction of a sample of misalignment between a
device's samples and those of the record, and the initial states. Everything else stays as in the model. `adequate` is
the outcome of four views (where_it_fails), which together call a correct model inadequate once in a hundred records.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from upright.diagnosis.lack_of_fit.floor import OFFSET, Innovations, nuisances, shaken_as, with_nuisances
from upright.diagnosis.lack_of_fit.where_it_fails import Entry, Views, summary, views
from upright.diagnosis.prediction.closed_loop_error import ClosedLoop, Loop, closed_loop
from upright.diagnosis.prediction.horizons import Prediction, predictions
from upright.diagnosis.prepare.ready import ready
from upright.diagnosis.trial import FAILURES
from upright.estimators.data.segments import channels_of, segments
from upright.estimators.data.time_scale import horizon
from upright.estimators.disturbance_estimate import DisturbanceEstimate
from upright.estimators.fit.maximum_likelihood import Fit, fit
from upright.estimators.fit.problem import Problem, problem
from upright.estimators.fit.random.disturbance import disturbances, is_of_disturbance
from upright.models.compiler.kernel import Progress
from upright.models.model import Model
from upright.models.segment import Segment
from upright.telemetry.recording import Recording

DOUBTFUL = 2.0
"""Deviation of a time offset from its prior, in standard deviations, beyond which it is reported as doubtful."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """One model against one or several recordings. Numbers by channel are for predictions `shown_horizon` s ahead, half
    a second of the MONOCAB; `fails` has the four views, all empty if the model is adequate. `offsets` are the time
    offsets that were fitted, too, s by name; `events` the parameters of what the experiment asked for, a load, by
    name."""

    name: str
    fit_percent: Mapping[str, float]
    rmse: Mapping[str, float]
    noise_floor: Mapping[str, float]
    innovation_ratio: float
    adequate: bool
    fails: Mapping[str, Sequence[Entry]]
    offsets: Mapping[str, float]
    events: Mapping[str, float]
    predictions: Sequence[Prediction] = field(repr=False)
    views: Views = field(repr=False)
    innovations: Innovations = field(repr=False)
    shown_horizon: float
    closed_loop: ClosedLoop = field(default_factory=ClosedLoop, repr=False)
    disturbance: tuple[DisturbanceEstimate, ...] = ()

    @property
    def summary(self) -> list[str]:
        """Where it fails, in words; empty if it does not."""
        words = summary(self.fails)
        for parameter in self.innovations.problem.parameters:
            offset = self.offsets.get(parameter.name, parameter.value)
            if words and 0.0 < DOUBTFUL * parameter.std < abs(offset - parameter.value):
                sentence = (
                    f"{parameter.name} was fitted, too, and came out at {1e3 * offset:.1f} ms, more than is plausible:"
                )
                words.append(f"{sentence} it has absorbed a part of what is missing.")
        return words

    def to_json(self) -> dict[str, Any]:
        """One entry of `compare --json`."""
        return {
            "name": self.name,
            "fit_percent": dict(self.fit_percent),
            "rmse": dict(self.rmse),
            "noise_floor": dict(self.noise_floor),
            "innovation_ratio": self.innovation_ratio,
            "disturbance": {each.joint: each.to_json() for each in self.disturbance},
            "adequate": self.adequate,
            "fails": {view: [dict(entry) for entry in entries] for view, entries in self.fails.items()},
            "summary": self.summary,
            "offsets": dict(self.offsets),
            "events": dict(self.events),
            "missing_force": {
                force.joint: {
                    "mean": mean.force if mean else None,
                    "mean_std": mean.std if mean else None,
                    "rms": force.rms,
                    "std": force.std,
                    "floor": force.floor,
                    "unit": force.unit,
                }
                for force, mean in zip(self.views.forces, self.views.means, strict=True)
            },
            "by_horizon": [
                {"horizon": p.horizon, "rmse": {c: p.rmse(c) for c in p.measured}, "noise_floor": dict(p.floor)}
                for p in self.predictions
            ],
            "closed_loop": self.closed_loop.to_json(),
        }


def compare(
    models: Mapping[str, Model],
    recordings: Sequence[Recording],
    *,
    support: float | None = None,
    loops: Sequence[Loop | str] = (),
    progress: Progress | None = None,
) -> list[Comparison]:
    """Every model, by name, against all of `recordings` together; `support` as in estimators.data.segments.

    `loops` are the controllers that closed the loop on each recording, or why one is not known, for
    `Comparison.closed_loop`.

    Raises DataError if the data cannot be used for a model, ModelError if a model is wrong, EstimationError if it has
    no stable predictor or diverges from the record.
    """
    tasks = {name: _task(ready(model, recordings), recordings, support, progress) for name, model in models.items()}
    shaken = {name: _shaken(task) for name, (task, _) in tasks.items()}
    return [
        _compare(name, task, owners, shaken[name], _best(task, shaken.values()), loops, progress)
        for name, (task, owners) in tasks.items()
    ]


def _shaken(task: Problem) -> Fit | None:
    """The disturbances that the model of `task` leaves with the values that it has, estimated with its nuisances; None
    if it has no joint, or cannot follow the record."""
    times = [task.kernel.index(name) for name in sorted(is_of_disturbance(task.model))]
    if not times:
        return None
    try:
        return fit(replace(task, free=tuple(dict.fromkeys((*times, *nuisances(task))))))
    except FAILURES:
        return None


def _best(task: Problem, shaken: Iterable[Fit | None]) -> Fit | None:
    """The most likely of those that have the outputs of `task`: the disturbance is what the best model leaves, and each
    model runs through a filter with that disturbance."""
    comparable = [each for each in shaken if each is not None and each.problem.kernel.outputs == task.kernel.outputs]
    return min(comparable, key=lambda each: each.minimum.cost, default=None)


def _task(
    model: Model, recordings: Sequence[Recording], support: float | None, progress: Progress | None
) -> tuple[Problem, list[int]]:
    """The data for `model`, with no parameter estimated, so that one out of its bounds is no obstacle; and the
    recording of each segment."""
    inside = [p.name for p in model.parameters if p.lower <= p.value <= p.upper and p.lower < p.upper]
    used = [(row, place) for place, recording in enumerate(recordings) for row in _segments(model, recording, support)]
    task = problem(model, recordings, estimate=inside[:1], rows=[row for row, _ in used], progress=progress)
    return replace(task, model=model, free=()), [place for _, place in used]


def _segments(model: Model, recording: Recording, support: float | None) -> Iterator[Segment]:
    """With the inputs that the model does not use, too: what it lacks may depend on one of them."""
    used = channels_of(model)
    idle = {place: each.name for place, each in enumerate(model.inputs) if each.name not in used and each.usual is None}
    for segment in segments(model, [recording], support=support):
        inputs = segment.inputs.copy()
        for place, name in idle.items():
            if name in recording.values and np.all(np.isfinite(recording[name])):
                inputs[segment.earlier :, place] = np.interp(segment.time, recording.time, recording[name])
        yield replace(segment, inputs=inputs)


def _compare(
    name: str,
    task: Problem,
    owners: Sequence[int],
    own: Fit | None,
    best: Fit | None,
    loops: Sequence[Loop | str],
    progress: Progress | None,
) -> Comparison:
    values = task.kernel.vector()
    if best is not None:
        task, values = shaken_as(task, values, best)
    found = with_nuisances(task, values)
    seen = views(found, progress=progress)
    ahead = predictions(found)
    reach = horizon(task.model, task.segments)
    shown = next((each for each in reversed(ahead) if each.horizon <= reach), None)
    channels = task.kernel.outputs if shown else ()
    places = zip(found.problem.parameters, found.problem.free, strict=True)
    fitted = {parameter.name: float(found.fit.values[place]) for parameter, place in places}
    return Comparison(
        name=name,
        fit_percent={channel: shown.fit_percent(channel) for channel in channels} if shown else {},
        rmse={channel: shown.rmse(channel) for channel in channels} if shown else {},
        noise_floor=dict(shown.floor) if shown else {},
        innovation_ratio=found.ratio,
        adequate=seen.adequate,
        fails=seen.fails,
        offsets={name: value for name, value in fitted.items() if name.endswith(OFFSET)},
        events={name: value for name, value in fitted.items() if not name.endswith(OFFSET)},
        predictions=ahead,
        views=seen,
        innovations=found,
        shown_horizon=reach,
        disturbance=disturbances(own) if own else (),
        closed_loop=closed_loop(found, owners, loops),
    )
