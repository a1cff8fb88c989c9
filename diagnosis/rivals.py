"""Models between which a record could not decide, each with the noise that its predictor counts with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diagnosis.closed_loop import causal
from diagnosis.refit import FullFit, full, quick, with_effect
from diagnosis.screen import screen
from diagnosis.stationary import stationary
from diagnosis.whitened import Whitened
from diagnosis.workspace import Workspace, attached
from estimators.innovations import NoiseModel
from models.model import Model
from telemetry.recording import Recording

Array = NDArray[np.float64]

NOTHING_MORE = "nothing more"
"""Name of the rival that has no further effect."""


@dataclass(frozen=True, slots=True)
class Rival:
    """`model` has its values and says what is estimated.

    `noise`: natural logarithms (q,) of its process and sensor noise against what it states, as in a fit
    (estimators.innovations); `scale`: variance of what is measured over what that makes of it.
    """

    name: str
    model: Model
    noise: Array
    scale: float = 1.0

    @classmethod
    def of(cls, name: str, fitted: FullFit) -> Rival:
        """What a fit ended with."""
        task, known = fitted.fit.problem, fitted.fit.values
        model = causal(fitted.model.change(dict(zip(task.kernel.parameters, known.tolist(), strict=True))))
        logarithms = fitted.fit.minimum.common[len(task.free) :]
        expected = innovation_covariance(NoiseModel.of(task), known, logarithms, fitted.fit.gain)
        # The fit's noises are ratios to the last output's, so that one tells the scale.
        return cls(name, model, logarithms, float(fitted.fit.covariance[-1, -1] / expected[-1, -1]))

    @classmethod
    def assumed(cls, name: str, model: Model) -> Rival:
        """`model` as it is, with the noise that it states."""
        model = causal(model)
        noisy = sum(state.process_noise > 0.0 and not state.noise_known for state in model.states)
        loud = sum(not output.noise_known for output in model.outputs[:-1])
        return cls(name, model, np.zeros(noisy + loud))


def innovation_covariance(noise: NoiseModel, values: Array, logarithms: Array, gain: Array) -> Array:
    """Covariance (ny, ny) of the innovations of a predictor with `gain` (nx, ny), not the best one for its noise."""
    transition, output, process, sensor, across = noise.covariances(values, logarithms)
    ahead = transition @ gain
    driven = process + ahead @ sensor @ ahead.T - across @ ahead.T - ahead @ across.T
    state = stationary(transition - ahead @ output, driven)
    return np.asarray(output @ state @ output.T + sensor)


def fitted(model: Model, recordings: Sequence[Recording], support: float | None) -> Rival:
    """`model` as it is, fitted to `recordings`. Raises DataError where they cannot be used."""
    return Rival.of(NOTHING_MORE, full(model, Workspace.of(model, recordings, support, ())))


def fitted_rivals(
    model: Model, recordings: Sequence[Recording], support: float | None, effects: Sequence[str]
) -> list[Rival]:
    """`model` with each of `effects`, fitted to `recordings`; an effect under which it runs away is left out.

    All count with the noise of the one that explains them best: what the others have more is what they fail to explain.
    Raises DataError where the recordings cannot be used.
    """
    workspace = Workspace.of(model, recordings, support, tuple(effects))
    base = full(model, workspace)
    screened = screen(
        Whitened.of(base.fit),
        lambda group: workspace.problem(attached(base.model, group)),
        workspace.others(base.model),
    )
    fits: dict[str, FullFit] = {}
    for score in screened.scores:
        start = quick(base.fit, base.model, score, workspace).values
        try:
            fits[score.candidate.name] = full(
                with_effect(base.model, score.candidate, start), workspace, score.candidate
            )
        except ArithmeticError:
            continue
    if not fits:
        return []
    best = max(fits, key=lambda name: fits[name].log_likelihood)
    known = Rival.of(best, fits[best])
    return [
        replace(Rival.of(name, fits[name]), noise=known.noise, scale=known.scale) for name in effects if name in fits
    ]
