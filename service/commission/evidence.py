"""What an evaluation is given, and what it gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vehicles.commissioning import CommissioningError, Number, Step
from vehicles.sections import VehicleFile

Request = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Evidence:
    """Of one step. `recordings`: its own first, then those of the steps in `of`. `results`: the JSON documents that
    these steps wrote, by their ids. `folder` is where files of the commissioning are.

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

    @property
    def model(self) -> Path:
        """The model file that effects are added to; it need not exist yet."""
        return self.folder / "model.toml"

    def at(self, name: str) -> Path:
        """A file of this step."""
        return self.folder / name


@dataclass(frozen=True, slots=True)
class Found:
    """The numbers of an evaluation by name, what else it found in words, and the files that it wrote; `result` is the
    JSON document among them that later steps use."""

    numbers: Mapping[str, Number] = field(default_factory=dict)
    text: Sequence[str] = ()
    files: Sequence[Path] = ()
    result: Path | None = None


Evaluation = Callable[[Evidence], Found]
