"""What a model is given before it meets recordings: what no recording lacks, whoever wrote the model."""

from __future__ import annotations

from collections.abc import Sequence

from diagnosis.prepare.time_offsets import timed, untimed
from estimators.data.as_recorded import as_recorded
from models.model import Model
from models.random.disturbance import disturbed, undisturbed
from models.random.input_noise import without_input_noise
from telemetry.recording import Recording


def ready(model: Model, recordings: Sequence[Recording]) -> Model:
    """`model` with the sensors that `recordings` show, a disturbance at its joints, and inputs whose time is not known
    exactly."""
    return timed(disturbed(as_recorded(model, recordings), recordings), recordings)


def unready(model: Model, fitted: Model) -> Model:
    """`fitted`, which came of what `ready` made of `model`, without what is the recordings' and not the machine's."""
    return untimed(model, undisturbed(model, without_input_noise(model, fitted)))
