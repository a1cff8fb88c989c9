"""What a model is given before it is diagnosed or repaired: what no recording lacks, whoever wrote the model."""

from __future__ import annotations

from collections.abc import Sequence

from diagnosis.disturbed import disturbed
from diagnosis.timed import timed
from estimators.as_recorded import as_recorded
from models.model import Model
from telemetry.recording import Recording


def ready(model: Model, recordings: Sequence[Recording]) -> Model:
    """`model` with the sensors that `recordings` show, process noise, and inputs whose time is not known exactly."""
    return timed(disturbed(as_recorded(model, recordings)), recordings)
