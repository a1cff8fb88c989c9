"""Models: of a file, shipped, or of a vehicle, with the effects that were added to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any

from upright.library.estimates import Value
from upright.library.layers.effects import Effect
from upright.library.layers.results import (
    ModelFile,
    load_vehicle,
    print_model,
    save,
    started,
    with_effect,
    without_effect,
)
from upright.library.shown import as_frame, as_html, as_text

if TYPE_CHECKING:
    import pandas
    from rich.console import Console


@dataclass(frozen=True, slots=True, repr=False)
class Model:
    """A machine's equations with their parameters, the effects that were added, and a history of the additions.

    It is never changed: each method returns another model. `file` is its content, of which nothing is stable.
    """

    file: ModelFile

    @classmethod
    def load(
        cls, name_or_path: str | PathLike[str] | None = None, *, vehicle: str | PathLike[str] | None = None
    ) -> Model:
        """A model file, or a shipped model by name, with the values of a `vehicle` if one is given; by default the
        vehicle's own.

        Raises UprightError, which names file, key and remedy.
        """
        known = None if vehicle is None else load_vehicle(fspath(vehicle))
        return cls(started(None if name_or_path is None else fspath(name_or_path), known))

    @property
    def name(self) -> str:
        return self.file.model.name

    @property
    def title(self) -> str:
        return self.file.model.title

    @property
    def parameters(self) -> dict[str, Value]:
        """Value, standard deviation and unit of each parameter, by name."""
        return {each.name: Value(each.value, each.std, each.unit) for each in self.file.model.parameters}

    @property
    def effects(self) -> tuple[str, ...]:
        """The effects that were added: `EFFECT`, or `EFFECT@PLACE` at a place other than the first that can have it."""
        return tuple(each.name for each in self.file.model.effects)

    @property
    def history(self) -> tuple[Mapping[str, Any], ...]:
        """What was added when, on which recording, the oldest first."""
        return self.file.history

    def add(self, effect: str | PathLike[str] | Effect, at: str = "") -> Model:
        """With an effect: one of the catalogue by name, or one of your own, by its file (.toml, .py) or as an object.

        It changes nothing until it is identified. `at`: joint, actuator or sensor, by default the first that can have
        it. Raises UprightError.
        """
        return Model(with_effect(self.file, effect if isinstance(effect, Effect) else fspath(effect), at))

    def remove(self, effect: str) -> Model:
        """Without an effect, one of `effects`. Raises UprightError."""
        return Model(without_effect(self.file, effect))

    def change(self, values: Mapping[str, float]) -> Model:
        """With other values of parameters, by name. Raises UprightError."""
        return Model(replace(self.file, model=self.file.model.change(values)))

    def save(self, path: str | PathLike[str]) -> Path:
        """Write a model file, whole or not at all, and return its path; an existing file keeps its comments.

        Raises UprightError, for an effect that is an object, too: a model file names its file.
        """
        save(self.file, Path(path))
        return Path(path)

    def to_frame(self) -> pandas.DataFrame:
        """The parameters as a table of pandas. Raises MissingPackage."""
        names = ("parameter", "value", "std", "unit", "lower", "upper", "estimated", "meaning")
        known = self.file.model.parameters
        rows = [(p.name, p.value, p.std, p.unit, p.lower, p.upper, p.estimated, p.meaning) for p in known]
        return as_frame(names, rows)

    def __str__(self) -> str:
        return as_text(self._print)

    def __repr__(self) -> str:
        return f"Model({self.name!r}, effects={list(self.effects)})"

    def _repr_html_(self) -> str:
        return as_html(self._print)

    def _print(self, to: Console) -> None:
        print_model(self.file.model, self.file.history, to)
