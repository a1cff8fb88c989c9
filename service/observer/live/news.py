"""New findings of a live diagnosis: each missing effect is reported once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class News:
    """The effects that the diagnoses of one recording have reported so far."""

    def __init__(self) -> None:
        self._reported: set[str] = set()

    def of(self, diagnosis: Mapping[str, Any] | None) -> list[str]:
        """A sentence for each effect that this diagnosis is the first to name."""
        new = [each for each in (diagnosis or {}).get("findings", ()) if each["effect"] not in self._reported]
        self._reported |= {each["effect"] for each in new}
        return [f"missing effect: {each['explanation']}" for each in new]
