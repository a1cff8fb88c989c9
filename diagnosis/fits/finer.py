"""Effects with a finer formula if the record requires it, before any further effect is looked for.

What the usual formula of an effect leaves looks like another effect. Dry friction whose contact bends before it slides,
modelled as the sign of the rate, leaves what looks like backlash, like friction that falls with the rate, or like
something that no effect explains (tests/diagnosis/fits/test_finer.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from upright.diagnosis.evidence import likelier
from upright.diagnosis.fits.refit import FURTHER_FITS, FullFit, full, with_effect
from upright.diagnosis.prepare.candidates import candidate_of
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.side_by_side import side_by_side
from upright.diagnosis.trial import tried
from upright.estimators.budget import OutOfTime
from upright.models.effect import AttachedEffect
from upright.models.model import Model


def finest(fits: Sequence[FullFit], workspace: Workspace) -> list[FullFit]:
    """`fits`, the one with most evidence first, each with the formula of its effect that has more evidence.

    The likeliest of those that have a finer formula decides whether the record requires any: what is finer in them is
    the same physics.
    """
    able = max((each for each in fits if _attached(each).effect.finer), key=lambda each: each.evidence, default=None)
    if able is None or (first := _likelier(able, workspace)) is able:
        return list(fits)
    others = [each for each in fits if each is not able]
    found = [first, *side_by_side(lambda each: _likelier(each, workspace), others)]
    return sorted(found, key=lambda each: -each.evidence)


def is_finer(model: Model, workspace: Workspace) -> bool:
    """Whether `model` has an effect of `workspace` with its finer formula."""
    return any(each.effect is usual.effect.finer for each in model.effects for usual in workspace.candidates)


def _likelier(fitted: FullFit, workspace: Workspace) -> FullFit:
    try:
        finer = tried(partial(_finer, fitted, workspace.for_one))
    except OutOfTime:
        workspace.leave(f"the finer formula of {fitted.name}")
        return fitted
    if finer is None or not finer.fit.minimum.converged or not likelier(finer.evidence - fitted.evidence):
        return fitted
    return finer


def _finer(fitted: FullFit, workspace: Workspace) -> FullFit | None:
    """`fitted` with the finer formula of the effect that was added last; None if it has none."""
    attached = _attached(fitted)
    if attached.effect.finer is None:
        return None
    model, values = fitted.model.remove(attached.name), fitted.fitted.values
    candidate = candidate_of(model, model.add(attached.effect.finer, attached.at).effects[-1])
    own = {parameter.name: values[parameter.name] for parameter in attached.parameters}
    begun = with_effect(model, candidate, {**candidate.variants[0], **own})
    # The noise starts afresh: with the coarser formula another noise may have accounted for what this one explains.
    return full(begun, workspace, candidate, longer=FURTHER_FITS)


def _attached(fitted: FullFit) -> AttachedEffect:
    """The effect that was added last."""
    return next(each for each in fitted.model.effects if each.name == fitted.name)
