"""The MONOCAB, as the registry has it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehicles.contract import Prediction, VehicleKind
from vehicles.monocab.file import MonocabFile
from vehicles.monocab.kind import Monocab

if TYPE_CHECKING:
    from diagnosis.prediction.closed_loop_error import Loop
    from telemetry.recording import Recording


def _recorded_loop(vehicle: MonocabFile, recording: Recording) -> Loop | str:
    from vehicles.monocab.recorded_loop import recorded_loop

    return recorded_loop(vehicle, recording)


def _prediction() -> Prediction:
    from vehicles.monocab import predicted

    return Prediction(predicted.NEEDS, predicted.GIVES, predicted.predictor)


KIND = VehicleKind(MonocabFile, Monocab, _recorded_loop, _prediction)
