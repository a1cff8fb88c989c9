"""Completes a model before it is fitted to recordings: with what every recording has, whoever wrote the model."""

from __future__ import annotations

from collections.abc import Sequence

from upright.diagnosis.prepare.time_offsets import timed, untimed
from upright.estimators.data.as_recorded import as_recorded
from upright.models.model import Model
from upright.models.random.disturbance import disturbed, undisturbed
from upright.models.random.input_noise import without_input_noise
from upright.telemetry.recording import Recording


def ready(model: Model, recordings: Sequence[Recording]) -> Model:
    """`model` with the sensors that `recordings` show, a disturbance at its joints, and inputs with an unknown time
    offset."""
    return timed(disturbed(as_recorded(model, recordings), recordings), recordings)


def unready(model: Model, fitted: Model) -> Model:
    """`fitted`, which derives from what `ready` made of `model`, without the parts that belong to the recordings and
    not to the machine."""
    return untimed(model, undisturbed(model, without_input_noise(model, fitted)))
