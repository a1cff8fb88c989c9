"""Comparison: how well models predict recordings, which force they lack, and where they fail."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from upright.library.inputs import Given, content, gathered
from upright.library.layers.recordings import Recorded, in_python
from upright.library.layers.results import (
    Compared,
    EstimationError,
    GreyBox,
    Provenance,
    compared,
    compared_models,
    name_of,
    print_comparisons,
    provenance,
    write_comparison,
    write_whole,
)
from upright.library.model import Model
from upright.library.shown import as_frame, as_html, as_text, existing
from upright.library.threads import one_thread

if TYPE_CHECKING:
    import pandas
    from rich.console import Console

    from upright.library.layers.pictures import Picture
    from upright.library.layers.results import VehicleFile


@dataclass(frozen=True, slots=True, repr=False)
class Comparison:
    """Models beside each other on each recording. `answers`, of which nothing is stable: by recording, the models."""

    answers: tuple[tuple[str, Sequence[Compared]], ...]
    origin: Provenance

    @property
    def adequate(self) -> dict[str, bool]:
        """By model, whether it explains all recordings to within the noise."""
        found: dict[str, bool] = {}
        for _, each in self._each():
            found[each.name] = found.get(each.name, True) and each.adequate
        return found

    @property
    def fails(self) -> dict[str, list[str]]:
        """By model, sentences about where it fails: in time, in frequency, on which coordinate."""
        found: dict[str, list[str]] = {}
        for _, each in self._each():
            found.setdefault(each.name, []).extend(each.summary)
        return found

    def to_json(self) -> dict[str, Any]:
        """The document of `upright compare --json`."""
        return {"models": [{**each.to_json(), "recording": source} for source, each in self._each()]}

    def to_frame(self) -> pandas.DataFrame:
        """One row a recording, model and channel, as a table of pandas: fit and RMS error of the prediction `horizon` s
        ahead, and the error that noise alone causes. Raises MissingPackage."""
        columns = ("recording", "model", "channel", "horizon", "fit_percent", "rmse", "noise_floor", "adequate")
        rows = [
            (
                source,
                each.name,
                channel,
                each.shown_horizon,
                fit,
                each.rmse[channel],
                each.noise_floor[channel],
                each.adequate,
            )
            for source, each in self._each()
            for channel, fit in each.fit_percent.items()
        ]
        return as_frame(columns, rows)

    def plot(self, recording: int = 0) -> Picture:
        """Prediction over measurement, and where the models fail, on one of the recordings: a figure of matplotlib."""
        from upright.library.layers.pictures import comparison_figure

        return comparison_figure(self.answers[recording][1])

    def report(self, path: str | PathLike[str]) -> Path:
        """Write a self-contained page to read, mail and print (.html), whole or not at all, and return its path."""
        write_whole(Path(path), write_comparison(self.answers, provenance=self.origin))
        return Path(path)

    def _each(self) -> list[tuple[str, Compared]]:
        return [(source, each) for source, found in self.answers for each in found]

    def __str__(self) -> str:
        return as_text(self._print)

    def __repr__(self) -> str:
        return f"Comparison(adequate={self.adequate})"

    def _repr_html_(self) -> str:
        return as_html(self._print)

    def _print(self, to: Console) -> None:
        for source, found in self.answers:
            print_comparisons(found, Path(source).name, to)


@in_python()
def compare(
    recordings: Recorded | Sequence[Recorded],
    models: Given | Sequence[Given] | Mapping[str, Given] | None = None,
    *,
    vehicle: str | PathLike[str] | None = None,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> Comparison:
    """Compare models with recordings, each recording by itself. The measure is the error that noise alone causes.

    `models`: one or several model files, shipped models by name, or Models, or a mapping of names for the result to
    such; by default that of the `vehicle`, as for `identify`. `progress` is called with the current step and the share
    that is done, 0 to 1; an exception that it raises ends the work.
    Raises UprightError, with the remedy, for a model that is invalid or recordings that cannot be used.
    """
    found, file = gathered(recordings, vehicle)
    chosen = _named(models, file)
    origin = provenance(name_of(next(iter(chosen.values())), file), existing(found))
    answers: list[tuple[str, Sequence[Compared]]] = []
    each = compared(found, chosen, file, lambda text: progress(text, len(answers) / len(found)))
    with one_thread():
        for recording, answer in zip(found, each, strict=True):
            answers.append((recording.source, answer))
    return Comparison(tuple(answers), origin)


def _named(
    models: Given | Sequence[Given] | Mapping[str, Given] | None, file: VehicleFile | None
) -> dict[str, GreyBox]:
    """The models by their names in the result: each its own, with a number if it is not the first of this name."""
    if models is None:
        return compared_models((), file)
    found: dict[str, GreyBox] = {}
    if isinstance(models, Mapping):
        found = {name: content(each, file).model for name, each in models.items()}
    else:
        for each in (models,) if isinstance(models, str | PathLike | Model) else models:
            model = content(each, file).model
            same = sum(name == model.name or name.startswith(f"{model.name} (") for name in found)
            found[f"{model.name} ({same + 1})" if same else model.name] = model
    if not found:
        raise EstimationError("models", "there is none", remedy="leave them out, or name some.")
    return found
