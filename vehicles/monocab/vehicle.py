"""The MONOCAB, as the registry has it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from vehicles.contract import Models, Prediction, Twin, VehicleKind
from vehicles.monocab.file import MonocabFile
from vehicles.monocab.kind import Monocab
from vehicles.monocab.views import VIEWS

if TYPE_CHECKING:
    from diagnosis.prediction.closed_loop_error import Loop
    from estimators.contract import Estimator
    from telemetry.recording import Recording


def _models() -> Models:
    from models import library
    from models.library.monocab_gimbals import SPEED_LOOPS

    return Models(library.get("monocab_roll").add("static_torque"), SPEED_LOOPS)


def _regressions(parameters: Mapping[str, float], deviations: Mapping[str, float], support: float) -> list[Estimator]:
    from vehicles.monocab.estimators import regressions

    return regressions(parameters, deviations, support)


def _recorded_loop(vehicle: MonocabFile, recording: Recording) -> Loop | str:
    from vehicles.monocab.recorded_loop import recorded_loop

    return recorded_loop(vehicle, recording)


def _prediction() -> Prediction:
    from vehicles.monocab import predicted

    return Prediction(predicted.NEEDS, predicted.GIVES, predicted.predictor)


def _twin() -> Twin:
    from simulation.monocab.truth import PlantTruth

    return Twin(PlantTruth(), "upright_servo.eds")


KIND = VehicleKind(
    file=MonocabFile,
    kind=Monocab,
    views=VIEWS,
    models=_models,
    regressions=_regressions,
    recorded_loop=_recorded_loop,
    prediction=_prediction,
    twin=_twin,
    shaken=(2.0, 20.0),
)
