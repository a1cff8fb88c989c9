"""The two-wheeled balancing robot's entry in the registry."""

from __future__ import annotations

from typing import TYPE_CHECKING

from upright.vehicles.contract import Models, Prediction, Twin, VehicleKind
from upright.vehicles.twsbr.channels import CHANNELS
from upright.vehicles.twsbr.file import TwsbrFile
from upright.vehicles.twsbr.kind import Twsbr
from upright.vehicles.twsbr.views import VIEWS

if TYPE_CHECKING:
    from upright.diagnosis.prediction.closed_loop_error import Loop
    from upright.estimators.identify.subject import OwnMethods
    from upright.models.control_design.robustness import CheckedDesign, Known
    from upright.telemetry.recording import Recording


def _models() -> Models:
    from upright.vehicles.twsbr.model import TWSBR

    return Models(TWSBR)


def _identification() -> OwnMethods:
    """Nothing: each of its equations holds products of several unknowns, which no linear regression can separate."""
    from upright.estimators.identify.subject import NOTHING_OWN

    return NOTHING_OWN


def _recorded_loop(vehicle: TwsbrFile, recording: Recording) -> Loop | str:
    from upright.vehicles.twsbr.recorded_loop import recorded_loop

    return recorded_loop(vehicle, recording)


def _designs(vehicle: TwsbrFile, known: Known) -> dict[str, CheckedDesign]:
    """None: the gains of its PID are in the vehicle file, as in the paper."""
    return {}


def _prediction() -> Prediction:
    from upright.vehicles.twsbr import predicted

    return Prediction(
        predicted.NEEDS, predicted.GIVES, predicted.predictor, predicted.HARDEST_TO_SEPARATE, predicted.assumed
    )


def _twin() -> Twin:
    from upright.simulation.twsbr.truth import TwsbrTruth

    return Twin(TwsbrTruth(), "upright_motor.eds")


KIND = VehicleKind(
    file=TwsbrFile,
    channels=CHANNELS,
    kind=Twsbr,
    views=VIEWS,
    models=_models,
    identification=_identification,
    recorded_loop=_recorded_loop,
    designs=_designs,
    prediction=_prediction,
    twin=_twin,
    shaken=(1.0e-4, 1.0e-3),
)
