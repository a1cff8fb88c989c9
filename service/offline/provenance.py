"""The provenance of a report, for its footer."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path

from upright.diagnosis.report import Provenance
from upright.telemetry.recording import Recording


def provenance(vehicle: str, recordings: Sequence[Path], read: Sequence[Recording] = ()) -> Provenance:
    """The provenance with the present contents of `recordings`, as files may change later, and how they were `read`.

    Raises OSError.
    """
    hashes = {path.name: sha256(path.read_bytes()).hexdigest() for path in recordings}
    return Provenance(
        vehicle, version("upright"), datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"), hashes, assumed(read)
    )


def assumed(recordings: Sequence[Recording]) -> dict[str, list[str]]:
    """What was assumed to read each recording of another origin, by its name."""
    return {Path(each.source).name: list(each.assumed) for each in recordings if each.assumed}
