"""Models between which a record could not decide, each with the noise that its predictor assumes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.fits.refit import FullFit, full
from upright.diagnosis.prediction.closed_loop import causal
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.search.contenders import each_fitted, look
from upright.estimators.budget import UNLIMITED, Budget, OutOfTime
from upright.estimators.data.segments import after_settling
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.likelihood import FLOOR as SENSOR_FLOOR
from upright.estimators.fit.stationary import stationary
from upright.models.model import Model
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

NOTHING_MORE = "nothing more"
"""Name of the rival without a further effect."""


@dataclass(frozen=True, slots=True)
class Rival:
    """`model` has its values and states which parameters are estimated.

    `noise`: natural logarithms of its process and sensor noise relative to what it states, by ("state" or "output",
    name), as in a fit (estimators.fit.innovations); `scale`, by output: ratio of the variance of its innovations to
    that which follows from this noise.
    """

    name: str
    model: Model
    noise: Mapping[tuple[str, str], float] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, fitted: FullFit) -> Rival:
        """The rival with the result of a fit."""
        task, known = fitted.fit.problem, fitted.fit.values
        model = causal(fitted.model.change(dict(zip(task.kernel.parameters, known.tolist(), strict=True))))
        logarithms = fitted.fit.minimum.common[len(task.free) :]
        noise = NoiseModel.of(task)
        expected = innovation_covariance(noise, known, logarithms, fitted.fit.gain)
        fitted_noise = {each: float(logarithms[place]) for each, place in _noisy(noise)}
        # The fit's noises are ratios, and it assumes more noise for outputs whose noise it takes as known.
        shown = np.diag(fitted.fit.covariance) - added_variance(model)
        scale = np.maximum(shown, 0.0) / np.diag(expected)
        return cls(name, model, fitted_noise, dict(zip(task.kernel.outputs, scale.tolist(), strict=True)))

    @classmethod
    def assumed(cls, name: str, model: Model) -> Rival:
        """`model` as it is, with the noise that it states."""
        return cls(name, causal(model))

    def covariance(self, noise: NoiseModel, values: Array, logarithms: Array, gain: Array) -> Array:
        """Covariance of the innovations as a fit assumes it, (ny, ny); arguments as of `innovation_covariance`."""
        model = noise.problem.model
        factor = np.sqrt([self.scale.get(output.name, 1.0) for output in model.outputs])
        expected = innovation_covariance(noise, values, logarithms, gain)
        return np.asarray(np.outer(factor, factor) * expected + np.diag(added_variance(model)))

    def logarithms(self, noise: NoiseModel) -> Array:
        """Its noise in the order of `noise`, (q,): outputs whose readings are identical in one record share one noise
        there, in another each has its own."""
        found = np.zeros(noise.size)
        for name, place in _noisy(noise):
            found[place] = self.noise.get(name, 0.0)
        return found


def _noisy(noise: NoiseModel) -> list[tuple[tuple[str, str], int]]:
    """States and outputs whose noise is not known, each with the place of its logarithm."""
    states, outputs = noise.problem.model.states, noise.problem.model.outputs
    names = [("state", states[each].name) for each in noise.noisy]
    names += [("output", outputs[each].name) for each in noise.loud]
    return list(zip(names, (*noise.process_place, *noise.sensor_place), strict=True))


def added_variance(model: Model) -> Array:
    """Variance (ny,) that a fit adds to the innovations of outputs whose noise is known."""
    return np.array([(SENSOR_FLOOR * each.noise) ** 2 if each.noise_known else 0.0 for each in model.outputs])


def with_named(model: Model, name: str) -> Model:
    """`model` with the effect `name`, EFFECT or EFFECT@PLACE. Raises ModelError."""
    effect, _, place = name.partition("@")
    return model.add(effect, place)


def innovation_covariance(noise: NoiseModel, values: Array, logarithms: Array, gain: Array) -> Array:
    """Covariance (ny, ny) of the innovations of a predictor with `gain` (nx, ny), which need not be optimal for its
    noise."""
    transition, output, process, sensor, across = noise.covariances(values, logarithms)
    ahead = transition @ gain
    driven = process + ahead @ sensor @ ahead.T - across @ ahead.T - ahead @ across.T
    state = stationary(transition - ahead @ output, driven)
    return np.asarray(output @ state @ output.T + sensor)


def fitted(model: Model, recordings: Sequence[Recording], support: float | None, budget: Budget = UNLIMITED) -> Rival:
    """`model` as it is, fitted to `recordings`. Raises DataError if these cannot be used, OutOfTime."""
    workspace = Workspace.of(model, after_settling(model, recordings, support), support, ())
    workspace = replace(workspace, budget=budget)
    return Rival.of(NOTHING_MORE, full(model, workspace))


def fitted_rivals(
    model: Model,
    recordings: Sequence[Recording],
    support: float | None,
    effects: Sequence[str],
    budget: Budget = UNLIMITED,
) -> list[Rival]:
    """`model` with each of `effects` (EFFECT, or EFFECT@PLACE as a finding names it), fitted to `recordings`; an effect
    with which it diverges is left out.

    All assume the noise of the rival that explains them best: the excess of the others is what they fail to explain.
    Raises DataError if the recordings cannot be used, OutOfTime after `budget`.
    """
    names = [with_named(model, name).effects[-1].name for name in effects]
    recordings = after_settling(model, recordings, support)
    workspace = Workspace.of(model, recordings, support, tuple(dict.fromkeys(name.split("@")[0] for name in names)))
    chosen = tuple(each for each in workspace.candidates if each.name in names)
    workspace = replace(workspace, candidates=chosen, budget=budget)
    base = full(model, workspace)
    fits = each_fitted(base, look(base, workspace), workspace)
    if workspace.untried:  # with fewer rivals it would be another comparison
        raise OutOfTime(f"no time was left for {workspace.untried[0]}")
    if not fits:
        return []
    best = max(fits, key=lambda name: fits[name].log_likelihood)
    known = Rival.of(best, fits[best])
    return [replace(Rival.of(name, fits[name]), noise=known.noise, scale=known.scale) for name in names if name in fits]
