"""Sentences about a diagnosis that every page shows: the disturbance, what was left untried, which findings matter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from upright.diagnosis.findings import Diagnosis, Finding
from upright.diagnosis.report.revision_words import readable
from upright.estimators.disturbance_estimate import DisturbanceEstimate, in_words

NOTHING_MATTERS = "nothing is missing that matters"
"""Said of a model all of whose findings are negligible."""
MORE = 5.0
"""Multiple of the time budget that is named as the remedy if it was too short."""


def mattering(diagnosis: Diagnosis) -> list[Finding]:
    """The findings that are not negligible, in order: they come first."""
    return [each for each in diagnosis.findings if not each.negligible]


def negligible(diagnosis: Diagnosis) -> list[Finding]:
    """The findings that account for no error that matters."""
    return [each for each in diagnosis.findings if each.negligible]


def to_within(diagnosis: Diagnosis) -> str:
    """How accurately an adequate model explains its recordings."""
    shown = [each for each in diagnosis.disturbance if each.acts]
    sizes = [each.size + (f" at {each.joint}" if len(shown) > 1 else "") for each in shown]
    return "to within their noise" + (f" and a random disturbance of {' and '.join(sizes)}" if sizes else "")


def disturbance_text(found: Sequence[DisturbanceEstimate]) -> str:
    """`8.1 ± 0.4 N m RMS, correlation time 0.31 ± 0.03 s`, with the joint if there are several; or empty."""
    return "; ".join(f"{each.joint}: {each}" if len(found) > 1 else str(each) for each in found)


def disturbance_sentences(diagnosis: Diagnosis) -> str:
    """The disturbance, how much it limits a prediction, and the random errors of sensors; empty if nothing is known."""
    return " ".join(filter(None, (_shaking(diagnosis), _erring(diagnosis))))


def contradiction_sentences(diagnosis: Diagnosis) -> str:
    """The stated values that the recordings contradict, and the question that follows; empty if there are none."""
    found = diagnosis.contradicted
    if not found:
        return ""
    values = "; ".join(map(str, found))
    effects = " and ".join(dict.fromkeys(name for each in found for name in each.instead_of))
    if not effects:
        return f"The recordings contradict what the model states: {values}. Check the stated values and their ±."
    return (
        "Are the stated values right? The recordings contradict some of them, and need"
        f" {effects} only if they are right. Without {effects}, {values}."
    )


def _erring(diagnosis: Diagnosis) -> str:
    """The random errors of the sensors, of all parts."""
    errors = {each.channel: each for part in (*diagnosis.parts, diagnosis) for each in part.sensor_errors}
    if not errors:
        return ""
    sizes = "; ".join(f"{channel}: {each.scaled(*readable(each.unit))}" for channel, each in errors.items())
    return f"Random sensor errors in addition to the white noise of outputs, not a property of the vehicle: {sizes}."


def _shaking(diagnosis: Diagnosis) -> str:
    """The disturbance, and how much it limits a prediction."""
    words = in_words(diagnosis.disturbance)
    if not words:
        return ""
    shown = any(each.acts for each in diagnosis.disturbance)
    disturbance = f"{words[:1].upper()}{words[1:]}{'; no effect explains it' if shown else ''}."
    limits = " and ".join(_limits(diagnosis, shown))
    if diagnosis.prediction_limit is None or not limits:
        return disturbance
    # Events are in the reason, which the pages show if there is no finding.
    happened = "".join(f" {each}" for each in diagnosis.events) if diagnosis.findings else ""
    return (
        f"{disturbance} The best possible prediction {diagnosis.prediction_limit.horizon:.3g} s ahead has an error of"
        f" {limits}.{happened}"
    )


def _limits(diagnosis: Diagnosis, shown: bool) -> Iterator[str]:
    """The limits for the measured ones of the coordinates at which the disturbance acts."""
    limit = diagnosis.prediction_limit
    if limit is None or not diagnosis.steps:
        return
    model = diagnosis.steps[-1].model
    places = {each.joint for each in diagnosis.disturbance if each.acts or not shown}
    coordinates = {each.coordinate for each in model.joints if each.name in places}
    for output in model.outputs:
        if output.name in coordinates and output.name in limit.disturbed:
            unit, factor = readable(output.unit)
            error, without = (factor * each[output.name] for each in (limit.disturbed, limit.undisturbed))
            apart = f" ({two_digits(without)} {unit} without the disturbance)" if shown else ""
            yield f"{two_digits(error)} {unit} RMS in {output.name}{apart}"


def two_digits(value: float) -> str:
    """`0.032`, `840`: two digits, and no power of ten for a large number."""
    return f"{float(f'{value:.2g}'):.0f}" if value >= 100.0 else f"{value:.2g}"


def untried_sentence(diagnosis: Diagnosis, seconds: float | None = None) -> str:
    """What was left untried for want of time, and the remedy; empty if nothing was. `seconds`: the budget, if known."""
    if not diagnosis.untried:
        return ""
    within = "" if seconds is None else f" ({seconds:.0f} s)"
    more = "SECONDS" if seconds is None else f"{MORE * seconds:.0f}"
    return f"Left untried for want of time{within}: {'; '.join(diagnosis.untried)}. Remedy: --budget {more}."
