"""Identification: the parameters of a model from recordings, by several methods side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from upright.library.estimates import Value
from upright.library.inputs import Given, content, gathered
from upright.library.layers.recordings import Recorded, in_python
from upright.library.layers.results import (
    Identified,
    ModelFile,
    Provenance,
    identified,
    identified_file,
    name_of,
    print_methods,
    provenance,
    write_whole,
)
from upright.library.model import Model
from upright.library.shown import as_frame, as_html, as_text, existing
from upright.library.threads import one_thread

if TYPE_CHECKING:
    import pandas
    from rich.console import Console

    from upright.library.layers.pictures import Picture


@dataclass(frozen=True, slots=True, repr=False)
class Identification:
    """The estimates of all methods, and the method to rely on (`best`, "" for none, with its `best_reason`)."""

    answer: Identified
    fitted: ModelFile | None
    origin: Provenance

    @property
    def best(self) -> str:
        return str(self.answer.document["best"])

    @property
    def best_reason(self) -> str:
        return str(self.answer.document["best_reason"])

    @property
    def methods(self) -> dict[str, dict[str, Value]]:
        """By method, the parameters that it estimates from all recordings together, by name."""
        return {
            method: {name: Value.of(each) for name, each in entry["parameters"].items()}
            for method, entry in self.answer.document["methods"].items()
        }

    @property
    def parameters(self) -> dict[str, Value]:
        """The estimates of the `best` method, by name; empty if there is none."""
        return self.methods.get(self.best, {})

    @property
    def model(self) -> Model | None:
        """The model with the estimates of the `best` method; None if there is none."""
        return None if self.fitted is None else Model(self.fitted)

    def to_json(self) -> dict[str, Any]:
        """The document of `upright identify --json`."""
        return dict(self.answer.document)

    def to_frame(self) -> pandas.DataFrame:
        """One row a method and parameter, as a table of pandas. Raises MissingPackage."""
        rows = [
            (method, name, each.value, each.std, each.unit, method == self.best, each.reason)
            for method, parameters in self.methods.items()
            for name, each in parameters.items()
        ]
        return as_frame(("method", "parameter", "value", "std", "unit", "best", "reason"), rows)

    def plot(self) -> Picture:
        """The methods side by side, one panel a parameter, as a figure of matplotlib. Raises UprightError if no method
        has an estimate."""
        from upright.library.layers.pictures import method_figure

        return method_figure(self.answer.document)

    def report(self, path: str | PathLike[str]) -> Path:
        """Write a self-contained page to read, mail and print (.html), whole or not at all, and return its path."""
        subject = name_of(self.answer.model, self.answer.vehicle)
        with one_thread():
            text = self.answer.page(replace(self.origin, vehicle=subject))
        write_whole(Path(path), text)
        return Path(path)

    def __str__(self) -> str:
        return as_text(self._print)

    def __repr__(self) -> str:
        return f"Identification(best={self.best!r}, methods={list(self.methods)})"

    def _repr_html_(self) -> str:
        return as_html(self._print)

    def _print(self, to: Console) -> None:
        print_methods(self.answer.document, {}, to)


@in_python()
def identify(
    recordings: Recorded | Sequence[Recorded],
    model: Given | None = None,
    *,
    vehicle: str | PathLike[str] | None = None,
    methods: str | Sequence[str] = (),
    every: bool = False,
    bandwidth: float | None = None,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> Identification:
    """Estimate the parameters of a model from recordings, with their standard deviations, by several methods.

    `model`: a model file, a shipped model by name, or a Model; by default that of the `vehicle`, which is a shipped
    one, a vehicle file, or by default the shipped one that the recordings name. `methods`: names of methods, by default
    all that suit; with `every` each gets all recordings, not only the suitable ones. `bandwidth` Hz, of the filter of
    the regressions. `progress` is called with the current step and the share that is done, 0 to 1; an exception that it
    raises ends the work.
    Raises UprightError, with the remedy, for a model or name that is invalid. A method that fails says so.
    """
    found, file = gathered(recordings, vehicle)
    start = None if model is None else content(model, file)
    origin = provenance("", existing(found))
    with one_thread():
        answer = identified(
            found,
            file,
            model=None if start is None else start.model,
            methods=[methods] if isinstance(methods, str) else methods,
            every=every,
            bandwidth=bandwidth,
            progress=lambda method, label, done, total: progress(f"{method}: {label}", done / total),
        )
    if answer.document["cancelled"]:
        raise KeyboardInterrupt
    return Identification(answer, identified_file(start or ModelFile(answer.model), answer, origin.hashes), origin)
