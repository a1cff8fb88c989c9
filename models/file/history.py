"""Uses of a model file's history: to undo the last addition, and to recover what was known before any fit.

An entry that was written by a fit has `values_before` and `values_after`: value and standard deviation of every
parameter that the fit changed. The parameters of the effect that it added are in `values_after` alone. If a parameter's
value in the file is not the one that the history wrote, it was changed by hand since; this change is newer and is kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from upright.models.file.document import ModelFile
from upright.models.model import Model
from upright.models.parts import ModelError


def values_of(before: Model, after: Model) -> dict[str, dict[str, dict[str, float]]]:
    """`values_before` and `values_after` of an entry: the parameters of `after` that differ in value or deviation."""
    known = {parameter.name: parameter for parameter in before.parameters}
    changed = [p for p in after.parameters if p.name not in known or _pair(known[p.name]) != _pair(p)]
    return {
        "values_before": {p.name: _pair(known[p.name]) for p in changed if p.name in known},
        "values_after": {p.name: _pair(p) for p in changed},
    }


def undone(file: ModelFile) -> tuple[ModelFile, str, tuple[str, ...]]:
    """`file` without the last entry of its history, the effect that this removes, and the parameters that keep their
    values because they were changed by hand.

    Raises ModelError if the last entry did not add an effect.
    """
    where = f"model {file.model.name}"
    if not file.history:
        remedy = "use `upright model remove`, or remove the effect's lines from the file."
        raise ModelError(where, "has no history, so there is nothing to undo", remedy=remedy)
    *history, last = file.history
    name = last.get("effect")
    if last["action"] != "add" or name is None:
        what = f"the last entry of its history is {last['action']!r}, and only 'add' can be undone"
        raise ModelError(where, what, remedy="use `upright model add` or `upright model remove`.")
    there = any(attached.name == name for attached in file.model.effects)
    model = file.model.remove(name) if there else file.model
    before, after = last.get("values_before", {}), last.get("values_after", {})
    written = [name for name in before if name in model.values]
    back = [name for name in written if _pair(model.parameter(name)) == after.get(name)]
    model = _changed(model, {name: before[name] for name in back})
    files = {own: path for own, path in file.effect_files.items() if own != name}
    return (
        replace(file, model=model, history=tuple(history), effect_files=files),
        name,
        tuple(sorted({*written} - {*back})),
    )


def before_fits(file: ModelFile) -> Model:
    """The model with what was known of its parameters before any fit in its history.

    That is the prior of the next fit: a fitted value would count the same recording twice. The values that an earlier
    fit found for the effect it added stay as start values, without a deviation.
    """
    model = file.model
    for entry in reversed(file.history):
        before: Mapping[str, Any] = entry.get("values_before", {})
        for name, after in entry.get("values_after", {}).items():
            if name in model.values and _pair(model.parameter(name)) == after:
                model = _changed(model, {name: before.get(name, {"value": after["value"], "std": 0.0})})
    return model


def _changed(model: Model, pairs: Mapping[str, Mapping[str, float]]) -> Model:
    return model.change(
        {name: pair["value"] for name, pair in pairs.items()},
        deviations={name: pair["std"] for name, pair in pairs.items()},
    )


def _pair(parameter: Any) -> dict[str, float]:
    return {"value": parameter.value, "std": parameter.std}
