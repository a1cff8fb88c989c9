"""Diagnosis: which physical effect a model lacks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any

from upright.library.estimates import Value
from upright.library.inputs import Given, content, gathered
from upright.library.layers.effects import Effect
from upright.library.layers.recordings import Recorded, in_python
from upright.library.layers.results import (
    Candidates,
    Diagnosed,
    EstimationError,
    Found,
    ModelFile,
    Provenance,
    before_and_after,
    diagnosed,
    headline,
    name_of,
    now,
    print_diagnosis,
    provenance,
    report_paths,
    revised,
    write_whole,
)
from upright.library.model import Model
from upright.library.shown import as_frame, as_html, as_text, existing
from upright.library.threads import one_thread

if TYPE_CHECKING:
    import pandas
    from rich.console import Console

    from upright.library.layers.pictures import Picture


GivenEffect = str | PathLike[str] | Effect
"""An effect as a user gives it: its name, its file, or itself."""


@dataclass(frozen=True, slots=True)
class Finding:
    """An effect that the model lacks: its parameters by name, and how sure it is.

    `probability` among all effects that were looked for and none; `p_value` corrected for their number. `tied_with`:
    effects that these recordings cannot distinguish from it. `held_out_error_closed_percent`: the share of the error on
    data that were not fitted that it removes, None if there are none. `negligible`: it is significant, but its error
    does not matter.
    """

    effect: str
    family: str
    parameters: Mapping[str, Value]
    probability: float
    p_value: float
    tied_with: tuple[str, ...]
    held_out_error_closed_percent: float | None
    negligible: bool
    explanation: str

    @classmethod
    def of(cls, found: Found) -> Finding:
        """From the layers below."""
        return cls(
            effect=found.effect,
            family=str(found.family),
            parameters={
                name: Value(each.value, each.std, each.unit, each.reason) for name, each in found.parameters.items()
            },
            probability=found.probability,
            p_value=found.p_value,
            tied_with=found.tied_with,
            held_out_error_closed_percent=found.held_out_error_closed_percent,
            negligible=found.negligible,
            explanation=found.explanation,
        )


@dataclass(frozen=True, slots=True, repr=False)
class Diagnosis:
    """The verdict about a model, and the effects that it lacks, the likeliest first."""

    answer: Diagnosed
    revised: ModelFile | None
    origin: Provenance

    @property
    def verdict(self) -> str:
        """adequate, missing_effect, unknown (no effect that was looked for explains the error) or insufficient_data."""
        return self.answer.found.verdict.value

    @property
    def adequate(self) -> bool:
        """Whether the model explains the recordings to within the noise."""
        return self.answer.found.adequate

    @property
    def headline(self) -> str:
        """The verdict as one sentence."""
        return f"{headline(self.answer.found).text}."

    @property
    @in_python()
    def next_step(self) -> str:
        """What to do now, as one sentence."""
        return headline(self.answer.found).next_step

    @property
    def reason(self) -> str:
        return self.answer.found.reason

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The missing effects, the negligible ones last."""
        return tuple(map(Finding.of, self.answer.found.findings))

    @property
    def effects(self) -> tuple[str, ...]:
        """The names of the missing effects that matter."""
        return tuple(each.effect for each in self.findings if not each.negligible)

    @property
    def minimum_detectable(self) -> dict[str, float]:
        """By effect, the smallest amplitude that these recordings would have shown, in its unit."""
        return dict(self.answer.found.minimum_detectable or {})

    @property
    def model(self) -> Model | None:
        """The model with the missing effects, fitted; None if the recordings cannot be used."""
        return None if self.revised is None else Model(self.revised)

    def to_json(self) -> dict[str, Any]:
        """The document of `upright diagnose --json`."""
        return self.answer.found.to_json()

    def to_frame(self) -> pandas.DataFrame:
        """One row a parameter of each missing effect, as a table of pandas. Raises MissingPackage."""
        columns = ("effect", "family", "parameter", "value", "std", "unit", "probability", "p_value", "tied_with")
        rows = [
            (f.effect, f.family, name, v.value, v.std, v.unit, f.probability, f.p_value, ", ".join(f.tied_with))
            for f in self.findings
            for name, v in f.parameters.items()
        ]
        return as_frame(columns, rows)

    def plot(self) -> Picture:
        """The model before and after the effects were added: prediction over measurement, and where each fails, as a
        figure of matplotlib. Raises UprightError if no model could be fitted."""
        (part, *_) = self.answer.parts
        with one_thread():
            comparisons, why = before_and_after(part.found, part.recordings, self.answer.support)
        if not comparisons:
            raise EstimationError("plot", why.rstrip("."), remedy=self.next_step)
        from upright.library.layers.pictures import comparison_figure

        return comparison_figure(comparisons)

    def report(self, path: str | PathLike[str]) -> Path:
        """Write a self-contained page to read, mail and print (.html), whole or not at all, and return its path. If a
        vehicle and its actuators both lack something, a second page is beside it (NAME-2.html)."""
        with one_thread():
            texts = self.answer.pages(self.origin)
        for target, text in zip(report_paths(Path(path), len(texts)), texts, strict=True):
            write_whole(target, text)
        return Path(path)

    def __str__(self) -> str:
        return as_text(self._print)

    def __repr__(self) -> str:
        return f"Diagnosis({self.verdict!r}, effects={list(self.effects)})"

    def _repr_html_(self) -> str:
        return as_html(self._print)

    def _print(self, to: Console) -> None:
        print_diagnosis(self.answer.found, self.answer.seconds, to)


@in_python()
def diagnose(
    recordings: Recorded | Sequence[Recorded],
    model: Given | None = None,
    *,
    vehicle: str | PathLike[str] | None = None,
    effects: GivenEffect | Sequence[GivenEffect] | None = None,
    also: GivenEffect | Sequence[GivenEffect] = (),
    most: int = 3,
    budget: float | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Diagnosis:
    """Find the physical effect that a model lacks to explain recordings, or say that they are not sufficient.

    The last of several recordings is held out for validation, or each third of a single one in turn. `model` and
    `vehicle` as for `identify`. `effects` to look for, by default the whole catalogue, and `also` these: names, files
    of your own (.toml, .py), or Effects, one or several. At most `most` of them are added. `budget` s: the time limit,
    `math.inf` for none, by default 60 s and proportionally more for over 12,000 samples; what could not be tried is
    reported. `progress` is called with the current step and the share that is done, 0 to 1; an exception that it raises
    ends the work.
    Raises UprightError, with the remedy, for a model or an effect that is invalid. Recordings that cannot be used give
    the verdict insufficient_data.
    """
    found, file = gathered(recordings, vehicle)
    start = None if model is None else content(model, file)
    candidates = Candidates.of(None if effects is None else _each(effects), _each(also))
    origin = provenance("", existing(found))  # now, since minutes later a file may have changed
    with one_thread():
        answer = diagnosed(
            found,
            file,
            model=None if start is None else start.model,
            candidates=candidates.effects,
            most=most,
            seconds=budget,
            progress=progress,
        )
    after = None
    if answer.found.revised is not None:
        before = start or ModelFile(answer.model)
        after = revised(before, answer.found, origin.hashes, candidates.files, now())
    return Diagnosis(answer, after, replace(origin, vehicle=name_of(answer.model, file)))


def _each(effects: GivenEffect | Sequence[GivenEffect]) -> list[str | Effect]:
    """One or several, for the layers below."""
    several = [effects] if isinstance(effects, str | PathLike | Effect) else effects
    return [each if isinstance(each, Effect) else fspath(each) for each in several]
