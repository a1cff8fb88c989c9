"""What a model needs of a table."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Wanted:
    """A channel that is needed: its `name` and `unit`. `measured`: an output of the model. `held`: a command that stays
    until the next one. Of a `part` that a vehicle may
    not have (a trim mass), all channels are at rest if none of them is there."""

    name: str
    unit: str = ""
    measured: bool = False
    held: bool = False
    part: str = ""
