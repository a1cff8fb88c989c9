"""The record of a fit in a model file: rounded values, the recordings with their SHA-256, and the errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

from upright.diagnosis.revise.result import Revision
from upright.estimators.numbers import significant
from upright.models.file.history import values_of
from upright.models.model import Model


def rounded(found: Revision) -> Model:
    """The fitted model, its numbers rounded to two digits more than the significant ones."""
    own = {name: each for name, each in found.after.parameters.items() if name in found.model.values}
    digits = {name: significant(each.std) + 2 for name, each in own.items()}
    return found.model.change(
        {name: round(each.value, digits[name]) for name, each in own.items()},
        deviations={name: round(each.std, digits[name]) for name, each in own.items()},
    )


def fit_entry(
    found: Revision, before: Model, after: Model, recordings: Sequence[Path], held_out: Sequence[Path]
) -> Mapping[str, Any]:
    """The history entry of a fit. The errors are those at the horizon of the error budget."""

    def last(errors: Mapping[str, Sequence[float]]) -> dict[str, float]:
        return {channel: float(f"{each[-1]:.4g}") for channel, each in errors.items()}

    entry: dict[str, Any] = {
        "recording": [path.name for path in recordings],
        "sha256": [_sha256(path) for path in recordings],
        "held_out": list(found.held_out),
    }
    if held_out:
        entry["held_out_sha256"] = [_sha256(path) for path in held_out]
    return {
        **entry,
        "horizon": found.horizons[-1],
        "error_before": last(found.before.training),
        "error_after": last(found.after.training),
        "held_out_error_before": last(found.before.held_out),
        "held_out_error_after": last(found.after.held_out),
        **values_of(before, after),
    }


def _sha256(path: Path) -> str:
    """Of a file, or of all files of a rosbag."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return sha256(b"".join(each.read_bytes() for each in files)).hexdigest()
