"""The two-wheeled balancing robot, as the registry has it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from vehicles.contract import Models, Prediction, Twin, VehicleKind
from vehicles.twsbr.file import TwsbrFile
from vehicles.twsbr.kind import Twsbr
from vehicles.twsbr.views import VIEWS

if TYPE_CHECKING:
    from diagnosis.prediction.closed_loop_error import Loop
    from estimators.contract import Estimator
    from telemetry.recording import Recording


def _models() -> Models:
    from models import library

    return Models(library.get("twsbr"))


def _regressions(parameters: Mapping[str, float], deviations: Mapping[str, float], support: float) -> list[Estimator]:
    """None: each of its equations holds several unknowns in products, which none can take apart."""
    return []


def _recorded_loop(vehicle: TwsbrFile, recording: Recording) -> Loop | str:
    from vehicles.twsbr.recorded_loop import recorded_loop

    return recorded_loop(vehicle, recording)


def _prediction() -> Prediction:
    from vehicles.twsbr import predicted

    return Prediction(predicted.NEEDS, predicted.GIVES, predicted.predictor, predicted.UNTOLD, predicted.assumed)


def _twin() -> Twin:
    from simulation.twsbr.truth import TwsbrTruth

    return Twin(TwsbrTruth(), "upright_motor.eds")


KIND = VehicleKind(
    file=TwsbrFile,
    kind=Twsbr,
    views=VIEWS,
    models=_models,
    regressions=_regressions,
    recorded_loop=_recorded_loop,
    prediction=_prediction,
    twin=_twin,
    shaken=(1.0e-4, 1.0e-3),
)
