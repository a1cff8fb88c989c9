"""Lists of documents that the daemon keeps in its data folder, each in one JSON file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from upright.service.whole_file import write_whole
from upright.telemetry.documents import from_json


def read(path: Path) -> list[Any]:
    """The documents in the file, none if it does not exist. Raises OSError, ValueError."""
    return list(from_json(path.read_text("utf-8"))) if path.exists() else []


def replace(path: Path, documents: Sequence[Any]) -> None:
    """Replace the file at once, so that there is never half of it. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(list(documents), indent=1) + "\n")
