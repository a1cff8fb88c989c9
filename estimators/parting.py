"""Where methods part: two estimates of one parameter that differ by more than their standard deviations allow.

    sigmas = |a - b| / sqrt(std_a^2 + std_b^2)

This is the difference in standard deviations of the difference of two independent estimates. Methods that run over the
same cycles, from the same CAD values, are not independent: usually their errors agree in part, the difference varies
less, and they part later than they could. A standard deviation describes scatter, not bias: where methods part, at
least one of them is biased (docs/explanation/methods.md says by what).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

SIGMAS = 2.0
"""Two methods part beyond this number of standard deviations of their difference."""


@dataclass(frozen=True, slots=True)
class Parting:
    """Two `methods` whose estimates of `parameter` differ by `sigmas` standard deviations of the difference."""

    parameter: str
    methods: tuple[str, str]
    sigmas: float

    def __str__(self) -> str:
        one, other = (method.replace("_", " ") for method in self.methods)
        return f"{self.parameter}: {one} and {other} part, by {self.sigmas:.1f} standard deviations of their difference"

    def to_json(self) -> dict[str, Any]:
        """As JSON-ready values, with the sentence as `text`."""
        return {
            "parameter": self.parameter,
            "methods": list(self.methods),
            "sigmas": round(self.sigmas, 2),
            "text": str(self),
        }


def partings(estimates: Mapping[str, Mapping[str, Any]]) -> tuple[Parting, ...]:
    """Where methods part, in the order of `estimates`: results by method as of `Estimate.to_json`.

    An estimate without a value or without a standard deviation is not compared.
    """
    found: dict[str, list[tuple[str, float, float]]] = {}
    for method, estimate in estimates.items():
        for name, entry in estimate["parameters"].items():
            if _is_number(entry["value"]) and _is_number(entry["std"]):
                found.setdefault(name, []).append((method, entry["value"], entry["std"]))
    return tuple(each for name, known in found.items() for each in _of_parameter(name, known))


def _of_parameter(name: str, known: list[tuple[str, float, float]]) -> Iterator[Parting]:
    for (one, value, std), (other, its_value, its_std) in combinations(known, 2):
        spread = math.hypot(std, its_std)
        if spread > 0.0 and (sigmas := abs(value - its_value) / spread) > SIGMAS:
            yield Parting(name, (one, other), sigmas)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)
