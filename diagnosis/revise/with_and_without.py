"""The fits that a revision compares: a model alone, and with one effect more, by the engine of the search.

So `upright model add`, `upright model drop-test` and `upright diagnose` say the same of one effect on the same samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from diagnosis.evidence import likelier
from diagnosis.fits.finer import finest
from diagnosis.fits.refit import FullFit, full, settled, t_ratio
from diagnosis.prepare.candidates import Candidate
from diagnosis.prepare.workspace import Workspace
from diagnosis.score.score_test import ScoreTest
from diagnosis.search.contenders import each_fitted, look
from diagnosis.trial import tried
from estimators.contract import Estimate, EstimationError, Status
from estimators.fit.innovations import NoiseModel
from estimators.fit.result import inverse
from estimators.methods.prediction_error import result
from models.model import Model
from telemetry.recording import Recording

UNKNOWN = 1e6
"""Typical sizes: the largest standard deviation that is reported, of a parameter that the record does not determine."""
DETERMINED = (Status.OK, Status.AT_BOUND)
"""Of a shape that a record determines."""


@dataclass(frozen=True, slots=True)
class Estimated:
    """A fit in numbers: what it estimates, and of every estimated parameter, by name, `values` and `deviations`, also
    of those that `estimate` does not determine. `bic` = parameters ln(rows) - 2 log likelihood."""

    full: FullFit
    estimate: Estimate
    values: dict[str, float]
    deviations: dict[str, float]

    @classmethod
    def of(cls, fitted: FullFit) -> Estimated:
        task, minimum = fitted.fit.problem, fitted.fit.minimum
        with np.errstate(all="ignore"):
            estimate = result(fitted.fit, 0.0)
            covariance = inverse(minimum.information)
        names = [parameter.name for parameter in task.parameters]
        count = len(names)
        deviations = np.minimum(np.sqrt(np.diag(covariance)[:count]), UNKNOWN * task.scale)
        known = {name: p.std for name, p in estimate.parameters.items() if p.std is not None}
        values = dict(zip(names, minimum.common[:count].tolist(), strict=True))
        return cls(fitted, estimate, values, dict(zip(names, deviations.tolist(), strict=True)) | known)

    @property
    def log_likelihood(self) -> float:
        return self.full.log_likelihood

    @property
    def bic(self) -> float:
        count = len(self.values) + NoiseModel.of(self.full.fit.problem).size
        return count * float(np.log(self.full.rows)) - 2.0 * self.log_likelihood

    @property
    def model(self) -> Model:
        """With the fitted values and their standard deviations."""
        return self.full.model.change(self.values, deviations=self.deviations)

    def t_ratio(self, effect: str) -> float:
        """As of diagnosis.fits.refit.t_ratio; infinite for an `effect` none of whose amplitudes is estimated."""
        attached = next(each for each in self.full.model.effects if each.name == effect)
        return t_ratio(self.full, effect) if set(attached.amplitudes) & set(self.values) else float("inf")


def alone(model: Model, workspace: Workspace) -> FullFit:
    """The fit of `model` to the samples of `workspace`, its CAD values as prior.

    Effects that nothing is known of from before are started from zero as well as from the model's values, since a large
    friction may be no start at all: at rest, where the first filter gain is made, it is all there is.

    Raises EstimationError where the model diverges. A fit that did not settle says so in its estimate.
    """
    neutral = model.change({
        name: 0.0 for each in model.effects for name in each.amplitudes
        if model.parameter(name).estimated and not model.parameter(name).std
    })  # fmt: skip
    found: list[FullFit] = []
    for start in (model, neutral) if neutral != model else (model,):
        try:
            found.append(settled(start, workspace))
        except (ArithmeticError, np.linalg.LinAlgError) as error:
            failed = error
    if found:
        return max(found, key=lambda each: each.log_likelihood)
    remedy = "check the model against the recording with `upright compare`."
    raise EstimationError(f"model {model.name}", str(failed), remedy=remedy) from failed


def each_with(
    base: FullFit,
    candidates: Sequence[Candidate],
    workspace: Workspace,
    tell: Callable[[str, float], None],
) -> tuple[dict[str, FullFit], ScoreTest]:
    """The model of `base` with each of `candidates`, by name, without those that no fit of ends; and their score test.

    By its finer formula where the record asks for it. A shape that the record does not determine is held at its usual
    value.
    """
    workspace = replace(workspace, candidates=tuple(candidates))
    scored = tried(partial(look, base, workspace)) or ScoreTest((), {})
    fits = each_fitted(base, scored, workspace, tell)
    likeliest = sorted(fits.values(), key=lambda each: -each.evidence)
    return {each.name: _shapes_held(each, workspace) for each in finest(likeliest, workspace)}, scored


def _shapes_held(fitted: FullFit, workspace: Workspace) -> FullFit:
    """`fitted` with those shapes of its effect held at their usual values that the record does not determine, unless it
    is likelier with them free: several together may be determined that one by one are not."""
    candidate = fitted.candidate
    assert candidate is not None
    attached = next(each for each in fitted.model.effects if each.name == fitted.name)
    shapes = [p.name for p in attached.parameters if p.estimated and p.name not in attached.amplitudes]
    estimates = result(fitted.fit, 0.0).parameters
    silent = [name for name in shapes if estimates[name].status not in DETERMINED]
    if not silent:
        return fitted
    usual = {p.name: p.value for p in fitted.model.remove(fitted.name).add(attached.effect, attached.at).parameters}
    known = {name: value for name, value in fitted.fitted.values.items() if name.startswith(f"{fitted.name}.")}
    held = fitted.model.change(
        {**known, **{name: usual[name] for name in silent}},
        estimated=[p.name for p in fitted.model.parameters if p.estimated and p.name not in silent],
    )
    end = fitted.fit.end
    begin = replace(end, values={name: value for name, value in end.values.items() if name not in silent})
    again = tried(partial(full, held, workspace, candidate, begin))
    if again is None or not again.fit.minimum.converged or likelier(fitted.evidence - again.evidence):
        return fitted
    return again


def training(
    model: Model, recordings: Sequence[Recording], support: float | None, candidates: Sequence[Candidate] = ()
) -> Workspace:
    """The samples that are fitted, the same for `model` with each of `candidates`. Raises DataError."""
    effects = tuple({each.effect.name: each.effect for each in candidates}.values())
    return Workspace.of(model, recordings, support, effects)
