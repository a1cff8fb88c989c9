"""The fits that a revision compares: a model alone, and with one more effect, by the engine of the search.

So `upright model add`, `upright model drop-test` and `upright diagnose` agree about an effect on the same samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from upright.diagnosis.evidence import likelier
from upright.diagnosis.fits.finer import finest
from upright.diagnosis.fits.refit import FullFit, exactly, full, settled, t_ratio
from upright.diagnosis.prepare.candidates import Candidate
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.score.score_test import ScoreTest
from upright.diagnosis.search.contenders import each_fitted, look
from upright.diagnosis.trial import tried
from upright.estimators.contract import Estimate, EstimationError, Status
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.result import inverse
from upright.estimators.methods.prediction_error import result
from upright.models.model import Model
from upright.telemetry.recording import Recording

UNKNOWN = 1e6
"""The largest standard deviation that is reported, in typical sizes, if the record does not determine a parameter."""
DETERMINED = (Status.OK, Status.AT_BOUND)
"""Statuses of a shape that a record determines."""


@dataclass(frozen=True, slots=True)
class Estimated:
    """A fit in numbers: its `estimate`, and `values` and `deviations` by name of every estimated parameter, including
    those that `estimate` does not determine. `bic` = parameters ln(rows) - 2 log-likelihood."""

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
        """As diagnosis.fits.refit.t_ratio; infinite for an `effect` none of whose amplitudes is estimated."""
        attached = next(each for each in self.full.model.effects if each.name == effect)
        return t_ratio(self.full, effect) if set(attached.amplitudes) & set(self.values) else float("inf")


def alone(model: Model, workspace: Workspace) -> FullFit:
    """The fit of `model` to the samples of `workspace`, its CAD values as prior.

    Effects without a prior are started from zero as well as from the model's values, since a fit may fail to start from
    a large friction: at rest, where the first filter gain is computed, it dominates everything else.

    Raises EstimationError if the model diverges. A fit that did not converge says so in its estimate.
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
    report: Callable[[str, float], None],
) -> tuple[dict[str, FullFit], ScoreTest]:
    """The model of `base` with each of `candidates`, by name, without those whose fits all fail; and their score test.

    A candidate has its finer formula if the record supports it. A shape that the record does not determine is held at
    its usual value.
    """
    workspace = replace(workspace, candidates=tuple(candidates))
    scored = tried(partial(look, base, workspace)) or ScoreTest((), {})
    fits = each_fitted(base, scored, workspace, report)
    likeliest = sorted(fits.values(), key=lambda each: -each.evidence)
    held = [_shapes_held(each, workspace) for each in finest(likeliest, workspace)]
    return {each.name: exactly(each, workspace) for each in held}, scored


def _shapes_held(fitted: FullFit, workspace: Workspace) -> FullFit:
    """`fitted` with the shapes of its effect held at their usual values that the record does not determine, unless it
    is more likely with them free: several may be determined together that are not determined one by one."""
    candidate = fitted.candidate
    assert candidate is not None
    attached = next(each for each in fitted.model.effects if each.name == fitted.name)
    shapes = [p.name for p in attached.parameters if p.estimated and p.name not in attached.amplitudes]
    estimates = result(fitted.fit, 0.0).parameters
    undetermined = [name for name in shapes if estimates[name].status not in DETERMINED]
    if not undetermined:
        return fitted
    usual = {p.name: p.value for p in fitted.model.remove(fitted.name).add(attached.effect, attached.at).parameters}
    known = {name: value for name, value in fitted.fitted.values.items() if name.startswith(f"{fitted.name}.")}
    held = fitted.model.change(
        {**known, **{name: usual[name] for name in undetermined}},
        estimated=[p.name for p in fitted.model.parameters if p.estimated and p.name not in undetermined],
    )
    end = fitted.fit.end
    begin = replace(end, values={name: value for name, value in end.values.items() if name not in undetermined})
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
