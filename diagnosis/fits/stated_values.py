"""Values that the model states with their ±, and that the record contradicts.

A fit weighs what is stated of a parameter against the record, and a rich record wins: with other values the model is
adequate, and no effect is missing. But a number of a drawing or of a data sheet is wrong, or its ± too small, and an
effect that does the same as another value may be named for the sake of the stated one alone.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from upright.diagnosis.evidence import LEVEL, beyond_chance, by_chance
from upright.diagnosis.fits.refit import FURTHER_FITS, FullFit, full, off_prior
from upright.diagnosis.prepare.workspace import Workspace
from upright.estimators.fit.random.disturbance import is_of_disturbance
from upright.estimators.fit.result import inverse
from upright.estimators.numbers import with_error
from upright.models.parts import Parameter

ROUNDING = 1e-9
"""Of a variance: where a record says nothing of a parameter, its estimate is what is stated, to this."""


@dataclass(frozen=True, slots=True)
class Contradiction:
    """`parameter` is `stated` ± `stated_std`, and fits with `value` ± `std`, in `unit`. `instead_of`: effects that the
    record needs only if the stated value is right."""

    parameter: str
    unit: str
    stated: float
    stated_std: float
    value: float
    std: float
    instead_of: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "parameter": self.parameter,
            "unit": self.unit,
            "stated": self.stated,
            "stated_std": self.stated_std,
            "value": self.value,
            "std": self.std,
            "instead_of": list(self.instead_of),
        }

    def __str__(self) -> str:
        """`inertia is stated as 0.500 ± 0.010 kg m^2, and 0.6203 ± 0.0004 kg m^2 fits`."""
        stated = with_error(self.stated, self.stated_std, self.unit)
        return f"{self.parameter} is stated as {stated}, and {with_error(self.value, self.std, self.unit)} fits"


def contradictions(
    base: FullFit, last: FullFit, stated: Collection[str], workspace: Workspace
) -> tuple[Contradiction, ...]:
    """Those of the parameters `stated` whose stated values the record contradicts.

    `base` is the fit of the model alone, `last` that with the effects that are named. If the record does not need these
    once the model alone is fitted without the values that are stated wrong, these are the contradictions.
    """
    effects = tuple(each.name for each in last.model.effects if each not in base.model.effects)
    for fitted, instead_of in ((base, effects), (last, ())) if effects else ((last, ()),):
        wrong = stated_wrong(fitted, stated)
        without = workspace.in_time(partial(_unstated, fitted, wrong, workspace)) if wrong else None
        if without is None or not without.fit.minimum.converged or (instead_of and _needed(without, last)):
            continue
        return tuple(_contradiction(without, each, instead_of) for each in wrong)
    return ()


def stated_wrong(fitted: FullFit, stated: Collection[str]) -> list[Parameter]:
    """Those of the parameters `stated`, as they are stated, that the record of `fitted` contradicts: chance makes one
    of them as far off in less than LEVEL of records.

    One wrong value pulls all others off what is stated of them. So the one that is furthest off is judged first, and
    the others without it. An estimate of variance C differs from its stated value, of variance S, by a variance of
    S - C. Near the estimate the likelihood is taken for that of a normal distribution.
    """
    task, of_disturbance = fitted.fit.problem, is_of_disturbance(fitted.model)
    left = [
        place
        for place, each in enumerate(task.parameters)
        if each.name in stated and each.name not in of_disturbance and each.std > 0.0
    ]
    count, wrong = len(left), list[Parameter]()
    information, values = fitted.fit.minimum.information.copy(), fitted.fit.minimum.common.copy()
    while left:
        covariance = inverse(information)
        variances = {place: task.parameters[place].std ** 2 for place in left}
        off = {
            place: (values[place] - task.start[place]) ** 2 / max(known - covariance[place, place], ROUNDING * known)
            for place, known in variances.items()
        }
        furthest = max(off, key=off.__getitem__)
        if count * by_chance(0.5 * off[furthest], 1) >= LEVEL:
            break
        left.remove(furthest)
        wrong.append(task.parameters[furthest])
        weight = 1.0 / variances[furthest]
        information[furthest, furthest] -= weight
        values += inverse(information)[:, furthest] * weight * (values[furthest] - task.start[furthest])
    return wrong


def _unstated(fitted: FullFit, wrong: Sequence[Parameter], workspace: Workspace) -> FullFit:
    """The fit of the same model to which nothing is stated of the parameters that are stated `wrong`."""
    names, model = {each.name for each in wrong}, fitted.model
    parameters = tuple(replace(each, std=0.0) if each.name in names else each for each in model.base_parameters)
    begin = fitted.fit.end
    return full(replace(model, base_parameters=parameters), workspace, begin=begin, longer=FURTHER_FITS)


def _needed(without: FullFit, last: FullFit) -> bool:
    """Whether chance does not make the effects of `last` explain the record so much better than they do `without`."""
    of_record = [each.log_likelihood + off_prior(each.fit) for each in (without, last)]
    return beyond_chance(of_record[1] - of_record[0], last.count - without.count)


def _contradiction(without: FullFit, wrong: Parameter, instead_of: tuple[str, ...]) -> Contradiction:
    fitted = without.fit
    place = [each.name for each in fitted.problem.parameters].index(wrong.name)
    std = math.sqrt(fitted.joint_covariance()[1][place, place])
    value = float(fitted.minimum.common[place])
    return Contradiction(wrong.name, wrong.unit, wrong.value, wrong.std, value, std, instead_of)
