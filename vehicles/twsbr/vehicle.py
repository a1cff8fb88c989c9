"""The two-wheeled balancing robot, as the registry has it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehicles.contract import Prediction, VehicleKind
from vehicles.twsbr.file import TwsbrFile
from vehicles.twsbr.kind import Twsbr

if TYPE_CHECKING:
    from diagnosis.prediction.closed_loop_error import Loop
    from telemetry.recording import Recording


def _recorded_loop(vehicle: TwsbrFile, recording: Recording) -> Loop | str:
    from vehicles.twsbr.recorded_loop import recorded_loop

    return recorded_loop(vehicle, recording)


def _prediction() -> Prediction:
    from vehicles.twsbr import predicted

    return Prediction(predicted.NEEDS, predicted.GIVES, predicted.predictor, predicted.UNTOLD, predicted.assumed)


KIND = VehicleKind(TwsbrFile, Twsbr, _recorded_loop, _prediction)
