"""A number that was estimated: value, standard deviation and unit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True, repr=False)
class Value:
    """`value` and its standard deviation `std`, in `unit`. Both are None if the recordings do not determine it;
    `reason` then says why."""

    value: float | None
    std: float | None
    unit: str
    reason: str = ""

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> Value:
        """From an entry of the JSON documents."""
        return cls(entry["value"], entry["std"], entry["unit"], entry.get("reason", ""))

    def __str__(self) -> str:
        from upright.library.layers.results import with_error

        if self.value is None:
            return f"not determined: {self.reason}" if self.reason else "not determined"
        return with_error(self.value, self.std, self.unit)

    def __repr__(self) -> str:
        return f"Value({self})"
