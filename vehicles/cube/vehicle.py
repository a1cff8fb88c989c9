"""The reaction-wheel cube's entry in the registry."""

from __future__ import annotations

from typing import TYPE_CHECKING

from upright.vehicles.contract import Models, Prediction, Twin, VehicleKind
from upright.vehicles.cube.channels import CHANNELS
from upright.vehicles.cube.controller import design
from upright.vehicles.cube.file import CubeFile
from upright.vehicles.cube.kind import Cube
from upright.vehicles.cube.views import VIEWS

if TYPE_CHECKING:
    from upright.diagnosis.prediction.closed_loop_error import Loop
    from upright.estimators.identify.subject import OwnMethods
    from upright.models.control_design.robustness import CheckedDesign, Known
    from upright.telemetry.recording import Recording


def _models() -> Models:
    from upright.vehicles.cube.model import CUBE

    return Models(CUBE)


def _identification() -> OwnMethods:
    """Nothing: the methods for every model work for it."""
    from upright.estimators.identify.subject import NOTHING_OWN

    return NOTHING_OWN


def _recorded_loop(vehicle: CubeFile, recording: Recording) -> Loop | str:
    from upright.vehicles.cube.recorded_loop import recorded_loop

    return recorded_loop(vehicle, recording)


def _designs(vehicle: CubeFile, known: Known) -> dict[str, CheckedDesign]:
    return {"wheel": design(vehicle, known=known)}


def _prediction() -> Prediction:
    from upright.vehicles.cube import predicted

    return Prediction(
        predicted.NEEDS, predicted.GIVES, predicted.predictor, predicted.HARDEST_TO_SEPARATE, predicted.assumed
    )


def _twin() -> Twin:
    from upright.simulation.cube.truth import CubeTruth

    return Twin(CubeTruth(), "upright_torque.eds")


KIND = VehicleKind(
    file=CubeFile,
    channels=CHANNELS,
    kind=Cube,
    views=VIEWS,
    models=_models,
    identification=_identification,
    recorded_loop=_recorded_loop,
    designs=_designs,
    prediction=_prediction,
    twin=_twin,
    shaken=(1.0e-4, 1.0e-3),
)
