"""What is new in a live diagnosis: each missing effect is told once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class News:
    """What one recording's diagnoses have said so far."""

    def __init__(self) -> None:
        self._told: set[str] = set()

    def of(self, diagnosis: Mapping[str, Any] | None) -> list[str]:
        """A sentence for each effect that this diagnosis names and none before it did."""
        new = [each for each in (diagnosis or {}).get("findings", ()) if each["effect"] not in self._told]
        self._told |= {each["effect"] for each in new}
        return [f"missing effect: {each['explanation']}" for each in new]
