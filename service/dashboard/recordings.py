"""The recordings in a folder, of every format that is read, for the dashboard.

Names from outside are only looked up among the existing ones. Symbolic links in the folder are not followed: with one,
any file that the server may read would be served.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from upright.telemetry.documents import from_json
from upright.telemetry.errors import RecordingError, UprightError
from upright.telemetry.formats.files import SUFFIXES
from upright.telemetry.storage import load

MOST_LISTED = 500
MOST_POINTS = 4000


class UnknownRecording(UprightError):
    """There is no recording of that name in the folder."""


class Folder:
    """Recordings of one folder, the newest first."""

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()

    def names(self) -> list[str]:
        """The names, newest first, since they begin with the time."""
        if not self.path.is_dir():
            return []
        found = [each.name for each in self.path.iterdir() if each.suffix.lower() in SUFFIXES and own_file(each)]
        return sorted(found, reverse=True)[:MOST_LISTED]

    def find(self, name: str) -> Path:
        """The path of a recording. Raises UnknownRecording for any name that is not in the listing."""
        if name not in self.names():
            raise UnknownRecording("there is no recording with that name.", remedy="Reload the list.")
        return self.path / name

    def list(self) -> list[dict[str, Any]]:
        """The information about each recording from the file system, since reading them all would take long."""
        listed = []
        for name in self.names():
            path = self.path / name
            try:
                stat = path.stat()
            except OSError:
                continue
            listed.append(
                {
                    "name": name,
                    "bytes": stat.st_size,
                    "modified": stat.st_mtime,
                    "log": own_file(path.with_suffix(".log")),
                    "estimates": own_file(path.with_suffix(".estimates.json")),
                }
            )
        return listed

    def open(self, name: str, points: int) -> dict[str, Any]:
        """Channels decimated to at most `points` samples, with metadata and the live estimates.

        Raises UnknownRecording, RecordingError.
        """
        path = self.find(name)
        recording = load(path)
        step = max(1, math.ceil(len(recording) / max(2, min(points, MOST_POINTS))))
        return {
            "name": name,
            "metadata": {key: str(value)[:400] for key, value in recording.metadata.items()},
            "truncated": recording.truncated,
            "seconds": recording.duration,
            "rows": len(recording),
            "time": _numbers(recording.time[::step]),
            "channels": {
                channel.name: {"unit": channel.unit, "values": _numbers(recording[channel.name][::step])}
                for channel in recording.channels
            },
            "estimates": self._beside(path),
        }

    def download(self, name: str, what: str) -> Path:
        """The file itself, its raw log or its estimates. Raises UnknownRecording."""
        path = self.find(name)
        beside = {"recording": path, "log": path.with_suffix(".log"), "estimates": path.with_suffix(".estimates.json")}
        target = beside.get(what)
        if target is None or not own_file(target):
            raise UnknownRecording(f"this recording has no {what[:20]}.", remedy="Download the recording itself.")
        return target

    def _beside(self, path: Path) -> dict[str, Any] | None:
        estimates = path.with_suffix(".estimates.json")
        try:
            document = from_json(estimates.read_text(encoding="utf-8")) if own_file(estimates) else None
        except (OSError, ValueError):
            return None
        return document if isinstance(document, dict) else None


def own_file(path: Path) -> bool:
    """Whether `path` is a file itself, and not a link to one."""
    return path.is_file() and not path.is_symlink()


def _numbers(values: Any) -> list[float | None]:
    finite = np.isfinite(values)
    return [float(f"{value:.7g}") if known else None for value, known in zip(values, finite, strict=True)]


__all__ = ["Folder", "RecordingError", "UnknownRecording", "own_file"]
