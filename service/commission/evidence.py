"""What an evaluation is given, and what it gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from upright.vehicles.commissioning import CommissioningError, Number, Step
from upright.vehicles.sections import VehicleFile

Request = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Evidence:
    """Of one step. `recordings`: its own first, then those of the steps in `of`. `results`: the JSON documents that
    these steps wrote, by their ids, and `model` the model with accepted effects, None if none of them wrote one.
    `folder` is where files of the commissioning are, and `number` that of the entry to come.

    `ask` sends a request to the daemon and returns its result; `upright` runs a command line and returns the document
    that it prints.
    """

    vehicle: VehicleFile
    step: Step
    recordings: Sequence[Path]
    results: Mapping[str, Path]
    folder: Path
    ask: Callable[[Request], dict[str, Any]]
    upright: Callable[[Sequence[str]], dict[str, Any]]
    model: Path | None = None
    number: int = 0

    @property
    def recording(self) -> Path:
        """The first recording. Raises CommissioningError if there is none."""
        if not self.recordings:
            raise CommissioningError(
                f"{self.step.id} needs a recording, and there is none.", remedy="Carry out the steps before it."
            )
        return self.recordings[0]

    @property
    def result(self) -> Path:
        """The newest of the results. Raises CommissioningError if there is none."""
        if not self.results:
            raise CommissioningError(
                f"{self.step.id} needs the result of {', '.join(self.step.of)}, and there is none.",
                remedy="Carry out these steps before it.",
            )
        return list(self.results.values())[-1]

    def at(self, ending: str) -> Path:
        """A file of this step. A repetition writes others, so that what the record says of them stays true."""
        return self.folder / f"{self.number:02d}_{self.step.id}{ending}"


@dataclass(frozen=True, slots=True)
class Found:
    """The numbers of an evaluation by name, what else it found in words, and the files that it wrote; among them
    `result` is the JSON document that later steps use, and `model` a model with accepted effects."""

    numbers: Mapping[str, Number] = field(default_factory=dict)
    text: Sequence[str] = ()
    files: Sequence[Path] = ()
    result: Path | None = None
    model: Path | None = None


Evaluation = Callable[[Evidence], Found]
